"""What the tables of hvae.py tell about held-out actions: results/encoders.csv and Figures 4 to 6.

Trains nothing: reads every table in <runs-dir>/hvae, one row per table and probe score (hvae.probe
says what they mean) beside the same read-outs from the ground truth and from the released tables.

    python hvae.py create                          # any number of encoders
    python benchmarks/encoders.py                  # then this
"""

import csv
import json
import sys
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import hvae

FIGURES = {  # appendix: held-out actions by t-SNE -> the table it is drawn from
    "fig4_tsne_gridworld": "gridworld-xy-hvae-default-laptop-s0",
    "fig5_tsne_create": "create-xy-hvae-default-laptop-s0",
    "fig6_tsne_stacking": "stacking-image-hvae-default-laptop-s0",
}


@dataclass
class Args:
    """Collect probe scores and pictures of encoders."""

    runs_dir: str = "runs"  # tables are in <runs_dir>/hvae
    results_dir: str = "results"


def arguments(path: Path) -> hvae.Args:
    """The resolved arguments that a table was trained with."""
    with np.load(path, allow_pickle=False) as file:
        config = json.loads(str(file["config"]))
    known = {field.name for field in fields(hvae.Args)}
    given = {key: value for key, value in config.items() if key in known}
    return hvae.Args(env=config["environment"], **given)


def command(args: hvae.Args) -> str:
    """The shortest command that trains this table again."""
    words = ["python hvae.py", args.env]
    for name in ("modality", "train_on", "split", "split_seed", "recipe", "seed"):
        default = getattr(hvae.Args(), name)
        if name == "modality":
            default = hvae.load_environment(args.env).MODALITIES[0]
        if (value := getattr(args, name)) != default:
            words.append(f"--{name.replace('_', '-')} {value}")
    return " ".join(words + ["--no-hierarchical"] * (not args.hierarchical))


def rows_of(path: Path) -> list[dict]:
    """Rows of results/encoders.csv for one table; minutes are of training alone, by the clock."""
    args = arguments(path)
    table = hvae.load_representation(path, args.env, args.split, args.split_seed)
    with open(path.with_suffix(".csv"), newline="") as file:
        last = list(csv.DictReader(file))[-1]
    about = dict(table=path.stem, updates=last["update"])
    about |= dict(minutes=round(float(last["seconds"]) / 60, 1))
    rows = hvae.probe_rows(table["mean"], args)
    return [about | row | dict(command=command(args)) for row in rows]


def main(args: Args) -> None:
    folder, results = Path(args.runs_dir) / "hvae", Path(args.results_dir)
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise FileNotFoundError(f"no tables in {folder}: train one with hvae.py")
    rows = [row for path in paths for row in rows_of(path)]
    path = results / "encoders.csv"
    hvae.write_atomically(path, lambda file: hvae.write_csv(file, rows))
    print(f"{len(paths)} tables, {len(rows)} scores: {path}")
    for figure, name in FIGURES.items():
        if (path := folder / f"{name}.npz") in paths:
            table, split = hvae.load_representation(path, name.split("-")[0])["mean"], "default"
            held_out, labels = hvae.held_out_labels(arguments(path))
            caption = f"{name}: {len(held_out)} held-out actions, split {split}"
            hvae.plot_tsne(table[held_out], labels, results / f"{figure}.png", caption)
            print(results / f"{figure}.png")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except (ValueError, FileNotFoundError) as e:
        raise SystemExit(f"error: {e}") from None
