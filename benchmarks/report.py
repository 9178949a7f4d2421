"""Tables and figures from results/*.csv; nothing is computed that is not in those files.

    python benchmarks/report.py            # results/*.png and the tables in README.md
    python benchmarks/report.py --check    # exit 1 if README.md disagrees with the CSV files

Bars: our mean over seeds, filled; published mean, outlined; dots: our seeds; line: the ceiling.
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path
from statistics import mean, pstdev

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import ppo_actiongen  # noqa: E402

RESULTS = ROOT / "results"

# Order and labels of the methods in tables and figures.
METHODS = {
    "ours": "Ours",
    "ours_alternate_modality": "Ours, one-hot",
    "engineered": "Engineered",
    "oracle_encoder_all_actions": "Oracle encoder",
    "non_hierarchical_vae": "VAE",
    "ours_no_entropy": "w/o entropy",
    "ours_no_subsampling": "w/o subsampling",
    "nearest_neighbor": "Nearest neighbour",
    "continuous_output": "Continuous output",
    "ours_mlp_encoder": "Ours, MLP encoder",
    "ours_bilinear": "Ours, bilinear utility",
}
TITLES = {
    "gridworld": "Grid World, success rate",
    "recsys": "Recommender, click-through rate (partially observable)",
    "recsys-full": "Recommender, click-through rate (fully observable)",
}


RECIPES = ("gridworld-recipe",)

# The differences of the fast recipe: what is undone in each row of "gridworld-recipe".
RECIPE = {
    "fast": ("none: the fast recipe", ""),
    "gains_0.01": (
        "gains 0.01 in all three utility layers",
        "1, sqrt 2, 0.01: a product of three small layers starves its own gradient",
    ),
    "numbers_not_one_hot": (
        "cell ids as normalised numbers",
        "one-hot: ids are names, not quantities",
    ),
    "minibatch_4096": (
        "minibatches of 4,096",
        "512: eight times as many updates from the same steps",
    ),
    "utility_width_64": ("utility of width 64", '128: "left of the river after three moves"'),
    "train_with_50": (
        "50 skills on offer in training",
        "20: favourites are rarer, so more skills get practice; cheaper too",
    ),
    "not_standardized": ("representations as they come", "mean 0, std 1 over training actions"),
    "entropy_constant": (
        "constant entropy coefficient",
        "decays to a tenth: one stray sample ends an episode in lava",
    ),
}


def read(path: Path) -> list[dict]:
    """Rows of a CSV file, [] if there is none."""
    return list(csv.DictReader(path.open())) if path.exists() else []


def published(env: str) -> dict[tuple[str, str], tuple[float, float, int]]:
    """(method, phase) -> published mean, std, number of seeds."""
    env = env.replace("-", "_")
    rows = [r for r in read(RESULTS / "published_results.csv") if r["env"] == env]
    return {
        (r["method"], r["phase"]): (float(r["mean"]), float(r["std"]), int(r["n"])) for r in rows
    }


def scores(env: str) -> dict[tuple[str, str], list[dict]]:
    """(method, phase) -> our rows, one per seed; only the largest budget of each method."""
    rows = read(RESULTS / f"{env}.csv")
    steps: dict[str, int] = defaultdict(int)
    for r in rows:
        steps[r["method"]] = max(steps[r["method"]], int(r["steps"]))
    table = defaultdict(list)
    for r in rows:
        if int(r["steps"]) == steps[r["method"]]:
            table[r["method"], r["phase"]].append(r)
    return table


def table(env: str) -> str:
    """A Markdown table: per method ours (mean and std over seeds) beside the published numbers."""
    ours, theirs = scores(env), published(env)
    ceiling = ppo_actiongen.CEILINGS.get(env)
    phases = "" if not ceiling or ceiling[0] == ceiling[1] else " (seen: {0})"
    lines = [
        "| method | seen: ours | seen: published | **unseen: ours** | unseen: published "
        "| seeds | steps | hours |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for method in [m for m in METHODS if (m, "test") in ours]:
        cells = [METHODS[method]]
        for phase in ("train", "test"):
            values = [float(r["score"]) for r in ours[method, phase]]
            bold = "**" if phase == "test" else ""
            cells.append(f"{bold}{mean(values):.3f}{bold} ± {pstdev(values):.3f}")
            known = theirs.get((method, phase))
            cells.append(f"{known[0]:.3f} ± {known[1]:.3f}" if known else "-")
        rows = ours[method, "test"]
        hours = mean(float(r["hours"]) for r in rows)
        cells += [str(len(rows)), f"{int(rows[0]['steps']) / 1e6:.1f}M", f"{hours:.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    note = f"Ceiling: {ceiling[1]}{phases.format(*ceiling)}. " if ceiling else ""
    lines.append(
        f"\n{note}± is the standard deviation over seeds; hours are per seed on one CPU core. "
        f"Command: `python benchmarks/paper.py {env}`; every row's own command is in "
        f"`results/{env}.csv`."
    )
    return "\n".join(lines)


def recipe_table(env: str) -> str:
    """A Markdown table: the fast recipe, then each of its differences undone."""
    ours = scores(env)
    lines = [
        "| undone | what the recipe does | seen | validation | unseen |",
        "|---|---|---|---|---|",
    ]
    for method in [m for m in RECIPE if (m, "test") in ours]:
        cells = list(RECIPE[method])
        for phase in ("train", "valid", "test"):
            cells.append(f"{mean(float(r['score']) for r in ours[method, phase]):.3f}")
        lines.append("| " + " | ".join(cells) + " |")
    rows = ours["fast", "test"]
    steps = int(rows[0]["steps"]) / 1e6
    lines.append(
        f"\nEngineered representation, {steps:.1f}M steps, {len(rows)} seed(s): early in learning, "
        f"where its speed shows. Command: `python benchmarks/paper.py {env}`."
    )
    return "\n".join(lines)


def bar_figure(env: str, path: Path) -> None:
    """Train and test bars per method, ours filled and published outlined."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    ours, theirs = scores(env), published(env)
    methods = [m for m in METHODS if (m, "test") in ours]
    figure, axes = plt.subplots(1, 2, figsize=(11, 3.8), sharey=True)
    for axis, phase, title in zip(
        axes, ("train", "test"), ("training actions", "unseen actions"), strict=True
    ):
        for x, method in enumerate(methods):
            values = [float(r["score"]) for r in ours[method, phase]]
            axis.bar(x - 0.2, mean(values), 0.38, color=f"C{x}", alpha=0.85)
            axis.plot([x - 0.2] * len(values), values, "k.", ms=4)
            if (method, phase) in theirs:
                m, s, _ = theirs[method, phase]
                axis.bar(x + 0.2, m, 0.38, yerr=s, fill=False, edgecolor=f"C{x}", capsize=2)
        if env in ppo_actiongen.CEILINGS:
            ceiling = ppo_actiongen.CEILINGS[env][phase == "test"]
            axis.axhline(ceiling, color="grey", lw=1)
        axis.set_xticks(range(len(methods)), [METHODS[m] for m in methods], rotation=35, ha="right")
        axis.set_title(title)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel(TITLES.get(env, env))
    figure.suptitle(
        "filled: this repository (dots: seeds)   outlined: published   line: ceiling", fontsize=9
    )
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def curve_figure(env: str, path: Path) -> None:
    """Learning curves (Figure 14): train and validation score, raw, one line per seed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = read(RESULTS / f"{env}_curves.csv")
    methods = [m for m in METHODS if any(r["method"] == m for r in rows)]
    columns = min(5, len(methods))
    lines = -(-len(methods) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(2.6 * columns, 2.3 * lines), sharey=True, squeeze=False
    )
    for axis, method in zip(axes.flat, methods, strict=False):
        mine = [r for r in rows if r["method"] == method]
        for seed in sorted({r["seed"] for r in mine}):
            one = [r for r in mine if r["seed"] == seed]
            steps = [int(r["step"]) / 1e6 for r in one]
            axis.plot(steps, [float(r["train_score"]) for r in one], "C0", lw=1)
            axis.plot(steps, [float(r["valid_score"]) for r in one], "C1", lw=1)
        axis.set_title(METHODS[method], fontsize=9)
    for axis in axes.flat[len(methods) :]:
        axis.axis("off")
    for axis in axes[-1]:
        axis.set_xlabel("million steps", fontsize=8)
    figure.suptitle(
        f"{TITLES.get(env, env)}: training actions (blue), validation (orange)", fontsize=9
    )
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def fill(text: str, env: str) -> str:
    """README text with the table of `env` between its two markers."""
    start, end = f"<!-- results:{env} -->", f"<!-- end:{env} -->"
    before, rest = text.split(start)
    rows = recipe_table(env) if env in RECIPES else table(env)
    return f"{before}{start}\n{rows}\n{end}{rest.split(end)[1]}"


def main() -> None:
    """Draw everything there are results for, and write (or check) the README's tables."""
    readme = ROOT / "README.md"
    text = new = readme.read_text()
    for path in sorted(RESULTS.glob("*.csv")):
        env = path.stem
        if not read(path) or f"<!-- results:{env} -->" not in text:
            continue
        new = fill(new, env)
        if "--check" not in sys.argv and env not in RECIPES:
            bar_figure(env, RESULTS / f"{env}.png")
            if read(RESULTS / f"{env}_curves.csv"):
                curve_figure(env, RESULTS / f"{env}_curves.png")
    if "--check" in sys.argv:
        if new != text:
            raise SystemExit(
                "error: README.md disagrees with results/*.csv; run benchmarks/report.py"
            )
        return
    readme.write_text(new)


if __name__ == "__main__":
    main()
