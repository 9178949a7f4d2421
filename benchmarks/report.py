"""Tables and pictures from results/*.csv; nothing is shown that is not in those files.

    python benchmarks/report.py            # results/*.png, and the tables in both README.md
    python benchmarks/report.py --check    # exit 1 where a README.md disagrees with the CSV files

A table and its picture go between `<!-- begin:NAME -->` and `<!-- end:NAME -->`, where NAME is a
figure of benchmarks/paper.py, `<figure>-paper` for --recipe paper, `main` (the summary) or `fig14`
(all learning curves). A page has the markers it wants; what has no results stays empty.
Each environment is shown at one number of steps, the one most rows of the figure have. Methods
within two standard errors of random play are not in the table, but in one line below it.
"""

import importlib
import io
import os
import re
import sys
from collections import Counter, defaultdict
from functools import cache, partial
from pathlib import Path
from statistics import mean, pstdev

import numpy as np
import tyro

os.environ["MPLBACKEND"] = "agg"  # an inherited one may not exist here, and ends the import
sys.path.insert(0, str(Path(__file__).parent))
import paper  # noqa: E402
from paper import ROOT, TABLE, ppo_actiongen, read  # noqa: E402

METHODS = {  # name -> label and colour, the same in every table and picture, in this order
    "ours": ("Ours", "#0b5394"),
    "ours_bilinear": ("Ours, bilinear", "#45a0d8"),
    "ours_alternate_modality": ("Ours, one-hot", "#7fb8e0"),
    "ours_video": ("Ours, video", "#7fb8e0"),
    "engineered": ("Engineered", "#2e8b6f"),
    "oracle_encoder_all_actions": ("Oracle encoder", "#86bf91"),
    "non_hierarchical_vae": ("VAE", "#e08a3c"),
    "ours_no_entropy": ("w/o entropy", "#a58cc9"),
    "ours_no_subsampling": ("w/o subsampling", "#6f4fa0"),
    "nearest_neighbor": ("Nearest neighbour", "#b5403e"),
    "continuous_output": ("Continuous output", "#d9a5a0"),
    "ours_no_subgoal_reward": ("No subgoal reward", "#5f9ea0"),
    "ours_conditioned_auxiliary": ("Conditioned auxiliary", "#5f9ea0"),
    "ours_no_place": ("No place", "#9aa5b1"),
    "ours_2d_place": ("2D place", "#5f9ea0"),
    "ours_full_split": ("Full Split", "#c2785c"),
    "ours_from_scratch": ("Ours, from scratch", "#7fb8e0"),
    "ours_finetuned": ("Ours, fine-tuned", "#0b5394"),
    "discrete_from_scratch": ("Discrete, from scratch", "#e3b09c"),
    "discrete_finetuned": ("Discrete, fine-tuned", "#b5403e"),
}
ENVIRONMENTS = {  # title, what a score is
    "gridworld": ("Grid World", "success rate"),
    "recsys": ("Recommender", "click-through rate"),
    "recsys_full": ("Recommender, fully observable", "click-through rate"),
    "create": ("CREATE", "success rate"),
    "stacking": ("Shape Stacking", "height"),
}
# Mean score of random play, `python benchmarks/throughput.py random_play`; tasks not listed: 0.
CHANCE = {"gridworld": 0.003, "recsys": 0.155, "recsys_full": 0.155, "stacking": 1.6}
CHANCE |= {"push": 0.016, "seesaw": 0.003}
ANALYSES = {  # figure -> its name in published_analyses.csv, what is varied
    "analysis-angle": ("angle", "least angle to a training tool, degrees"),
    "analysis-embedding": ("emb", "quantile of the distance to a training tool"),
    "analysis-unseen-ratio": ("ratio", "share of unseen tools on offer"),
    "analysis-set-size": ("action_set_size", "tools on offer"),
}
MAIN = ("gridworld", "recsys", "create-push", "stacking")  # the figures of the summary
FIGURE_14 = ("gridworld", "recsys", "fig12", *(f"create-{t}" for t in paper.CREATE), "stacking")
SHOWN = {  # the methods of long tables; the pictures have all of them
    "main": ("ours", "ours_bilinear", "engineered", "nearest_neighbor", "continuous_output"),
    "fig8": ("ours",),
}
HEADS = {"train": "seen (published)", "test": "**unseen** (published)"}
RESULTS = ROOT / "results"

# ---- scores ----

Place = tuple[str, str, int]  # env, task ("" without one), number of steps
Cells = dict[tuple[Place, str], dict[str, list[float]]]  # place, method -> phase -> its seeds


def tested(phase: str) -> float:
    """The number in a phase: 15 of min-angle-gap=15, 0.5 of ...=q0.5, a step; 0 without one."""
    return float(re.search(r"[\d.]*$", phase)[0] or 0)


def group(rows: list[dict], phase: str = "phase", column: str = "score") -> Cells:
    """A column's numbers by place, method and phase (or another column), in the order of METHODS.

    Of each environment only one number of steps: the one of most rows, then the largest.
    """
    usual: dict[str, tuple] = {}
    for (env, steps), n in Counter((row["env"], int(row["steps"] or 0)) for row in rows).items():
        usual[env] = max(usual.get(env, (0, 0)), (n, steps))
    cells: Cells = defaultdict(lambda: defaultdict(list))
    for row in sorted(rows, key=lambda row: tested(row[phase])):
        if int(row["steps"] or 0) == usual[row["env"]][1] and row[column]:
            place = row["env"], row["task"], usual[row["env"]][1]
            cells[place, row["method"]][row[phase]].append(float(row[column]))
    tasks, methods = [*dict.fromkeys((row["env"], row["task"]) for row in rows)], [*METHODS]
    keys = sorted(cells, key=lambda key: (tasks.index(key[0][:2]), methods.index(key[1])))
    return {key: cells[key] for key in keys}


def places(cells: Cells) -> list[Place]:
    """The environments of these cells."""
    return [*dict.fromkeys(place for place, _ in cells)]


def methods_of(cells: Cells) -> list[str]:
    """Their methods, in the order of METHODS."""
    return [name for name in METHODS if any(method == name for _, method in cells)]


def title(place: Place) -> str:
    """How an environment and task are called."""
    return f"{ENVIRONMENTS[place[0]][0]} {place[1]}".strip()


def steps(place: Place) -> str:
    """The number of steps: 10M, 0.04M; "" of an encoder."""
    return f"{round(place[2] / 1e6, 2 if place[2] < 1e7 else 0):g}M" if place[2] else ""


@cache
def all_published() -> dict[tuple, tuple[float, float]]:
    """Both files of published scores: a row's key -> mean and standard deviation."""
    found = {}
    for row in read(ROOT / "results/published_results.csv"):
        key = row["env"], row["task"], row["method"], row["phase"]
        found[key] = float(row["mean"]), float(row["std"])
    for row in read(ROOT / "results/published_analyses.csv"):
        # Distances 0.5 .. 5 of another table of representations: by rank, as our quantiles 0 .. 0.9
        x = float(row["x"]) if row["analysis"] != "emb" else round(float(row["x"]) / 5 - 0.1, 1)
        key = row["analysis"], row["task"], row["method"], x
        found[key] = float(row["mean"]), float(row["std"])
    return found


def published(figure: str, place: Place, method: str, phase: str) -> tuple[float, float] | None:
    """Published mean and standard deviation of one cell's phase, None where there are none."""
    analysis = ANALYSES.get(figure, ("",))[0], place[1], method, tested(phase)
    return all_published().get(analysis if figure in ANALYSES else (*place[:2], method, phase))


def ceiling(place: Place) -> float | None:
    """The best that unseen actions allow, where it is known."""
    return ppo_actiongen.CEILINGS.get(place[0].replace("_", "-"), (None, None))[1]


def drop_not_learned(cells: Cells, errors: Cells) -> list[str]:
    """Take out the methods whose best phase is within two errors of random play; notes on them."""
    failed = defaultdict(list)
    for (place, method), phases in list(cells.items()):
        best = max(phases, key=lambda phase: mean(phases[phase]))
        error = max(pstdev(phases[best]), mean(errors[place, method][best]))
        chance = CHANCE.get(place[1] or place[0], 0.0)
        if mean(phases[best]) <= chance + 2 * error / len(phases[best]) ** 0.5:
            del cells[place, method]
            about = f"{title(place)}, not learned at {steps(place)} steps (random play: {chance:g})"
            failed[about].append(METHODS[method][0])
    return [f"{about}: {', '.join(labels)}." for about, labels in failed.items()]


# ---- tables ----


def markdown(head: list[str], lines: list[list[str]]) -> str:
    """A table, without the columns in which nothing stands; "" without lines."""
    keep = [i for i in range(len(head)) if any(line[i] for line in lines)]
    cells = [head, ["---"] * len(head), *([c or "-" for c in line] for line in lines)]
    return "\n".join("|" + "|".join(line[i] for i in keep) + "|" for line in cells if keep)


def table(figure: str, cells: Cells) -> str:
    """One row per environment and method, one column per phase; published means in brackets."""
    phases = [*dict.fromkeys(phase for cell in cells.values() for phase in cell)]
    lines = []
    for (place, method), cell in cells.items():
        line = [title(place) * (len(places(cells)) > 1), METHODS[method][0], steps(place)]
        line.append(str(max(map(len, cell.values()))))
        for phase in phases:
            ours, theirs = cell.get(phase, []), published(figure, place, method, phase)
            line.append(f"{mean(ours):.3f}" if ours else "")
            line[-1] += f"±{pstdev(ours):.3f}" if len(ours) > 1 else ""
            line[-1] += f" ({theirs[0]:.3f})" if ours and theirs else ""
        lines.append([*line, "" if ceiling(place) is None else f"{ceiling(place):.3f}"])
    heads = [HEADS.get(phase, phase.replace("=", " ")) for phase in phases]
    return markdown([" ", "method", "steps", "seeds", *heads, "ceiling"], lines)


def adaptation_table(curves: Cells, zero: dict[Place, float]) -> str:
    """Figure 9: steps on the unseen actions that it takes to reach what zero-shot has at once."""
    lines = []
    for place in places(curves):
        lines.append([title(place), f"{zero[place]:.3f}"])
        for points in (curves.get((place, method), {}) for method in methods_of(curves)):
            # One point may jump over the line; the mean of a point and the next four does not.
            y, x = [*map(mean, points.values())], [*map(int, points)]
            above = [s for i, s in enumerate(x[:-4]) if mean(y[i : i + 5]) > zero[place]]
            lines[-1].append(f"{above[0]:,}" if above else f"not in {x[-1]:,}" if x else "")
    return markdown([" ", "zero-shot", *(METHODS[m][0] for m in methods_of(curves))], lines)


# ---- pictures ----


def canvas(count: int, columns: int, width: float, height: float, **options):
    """A figure with `count` panels of this size in inches, and its panels."""
    import matplotlib
    from matplotlib.figure import Figure  # not pyplot, which would look for a screen

    look = {"font.size": 8, "axes.titlesize": 8.5, "axes.titlelocation": "left"}
    look |= {"axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6}
    matplotlib.rcParams.update(look | {"xtick.major.width": 0.6, "ytick.major.width": 0.6})
    columns = min(columns, count)
    lines = -(-count // columns)
    figure = Figure((width * columns, height * lines + 0.3), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False, **options)
    for axis in axes.flat[count:]:
        axis.axis("off")
    return figure, axes.flat[:count]


def save(figure, path: Path, key: dict, columns: int = 5) -> None:
    """Write a picture with its legend, in 64 colours: a third of the bytes."""
    from PIL import Image

    figure.legend(key.values(), key, loc="outside lower center", ncols=columns, frameon=False)
    with io.BytesIO() as file:
        figure.savefig(file, dpi=110)
        picture = Image.open(file).convert("RGB")
    # The usual median cut gives small areas, such as dots, the colour of their neighbours.
    picture = picture.quantize(64, method=Image.Quantize.MAXCOVERAGE, kmeans=4)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    picture.save(temporary, "PNG", optimize=True)
    temporary.replace(path)


def draw_bars(path: Path, cells: Cells) -> None:
    """Per method: unseen actions full, seen ones pale, published outlined, seeds as dots."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    methods, count = methods_of(cells), len(places(cells))
    width, height = 3.3 if count > 1 else 6.5, 0.32 * len(methods) + 0.7
    figure, axes = canvas(count, 3, width, height, sharey=True)
    outline, line = dict(fill=False, edgecolor="0.2", lw=0.9), dict(color="0.5", lw=0.8, ls="--")
    key = {"unseen": Patch(color="0.35"), "seen": Patch(color="0.35", alpha=0.4)}
    key |= {"published": Patch(**outline), "seed": Line2D([], [], color="0", marker=".", ls="")}
    panels = dict(zip(places(cells), axes, strict=True))
    for (place, method), cell in cells.items():
        axis, y = panels[place], methods.index(method)
        for at, phase, alpha in ((y - 0.2, "test", 1.0), (y + 0.2, "train", 0.4)):
            if ours := cell.get(phase):
                axis.barh(at, mean(ours), 0.36, color=METHODS[method][1], alpha=alpha)
                axis.plot(ours, [at] * len(ours), ".", color="black", ms=3, zorder=3)
                axis.barh(at, (published("", place, method, phase) or (0,))[0], 0.36, **outline)
        if ceiling(place) is not None:
            key["ceiling, unseen"] = axis.axvline(ceiling(place), **line)
        axis.set(title=f"{title(place)}, {steps(place)} steps", xlabel=ENVIRONMENTS[place[0]][1])
    axes[0].set_yticks(range(len(methods)), [METHODS[m][0] for m in methods])
    axes[0].invert_yaxis()
    save(figure, path, key)


def draw_lines(path: Path, figure: str, cells: Cells, zero: dict[Place, float]) -> None:
    """Mean and standard deviation over phases, one panel per environment; published hollow."""
    picture, axes = canvas(len(places(cells)), 3, 3.1, 2.4)
    panels, key = dict(zip(places(cells), axes, strict=True)), {}
    for (place, method), phases in cells.items():
        (label, color), axis = METHODS[method], panels[place]
        y, std = (np.array([f(numbers) for numbers in phases.values()]) for f in (mean, pstdev))
        x = [tested(phase) / (1 if figure in ANALYSES else 1e6) for phase in phases]
        style = dict(color=color, lw=1.4, ms=3.5, marker="o" if figure in ANALYSES else "")
        (key[label],) = axis.plot(x, y, **style)
        axis.fill_between(x, y - std, y + std, color=color, alpha=0.2, lw=0)
        theirs = {tested(phase): published(figure, place, method, phase) for phase in phases}
        if theirs := {x: pair for x, pair in theirs.items() if pair}:
            look = dict(marker="s", mfc="white", lw=1, ls=":", alpha=0.6, capsize=2)
            y, std = zip(*theirs.values(), strict=True)
            key[f"{label}, published"] = axis.errorbar([*theirs], y, std, **style | look)
        xlabel = ANALYSES.get(figure, ("", "million steps"))[1]
        axis.set(title=title(place), xlabel=xlabel, ylabel=ENVIRONMENTS[place[0]][1])
    for place, axis in panels.items():
        if place in zero:
            key["Ours, zero-shot"] = axis.axhline(zero[place], color="black", lw=1, ls="--")
        axis.set_ylim(0, None)
    save(picture, path, key, 3)


def draw_curves(path: Path, seen: Cells, valid: Cells) -> None:
    """Figure 14: mean and standard deviation over seeds, raw; a row of panels per environment."""
    lines = [[key for key in valid if key[0] == place] for place in places(valid)]
    columns = max(map(len, lines))
    keys = [line[i] if i < len(line) else None for line in lines for i in range(columns)]
    figure, axes = canvas(len(keys), columns, 1.25, 1.2)
    for axis, key in zip(axes, keys, strict=True):
        if key is None:
            axis.axis("off")
            continue
        place, (label, color) = key[0], METHODS[key[1]]
        for points, look in ((seen[key], ("--", "0.45")), (valid[key], ("-", color))):
            y, std = (np.array([f(p) for p in points.values()]) for f in (mean, pstdev))
            x = [int(step) / 1e6 for step in points]
            axis.plot(x, y, look[0], color=look[1], lw=1.2)
            axis.fill_between(x, y - std, y + std, color=look[1], alpha=0.25, lw=0)
        axis.set_ylim(0, 1 if place[0] in ("gridworld", "create") else None)
        axis.tick_params(labelsize=6)
        axis.set_title(label, fontsize=7)
        if key[1] == "ours":
            axis.set_ylabel(title(place).replace(" ", "\n"), fontsize=7)
    figure.supxlabel("million steps; full: validation actions, dashed: training actions")
    save(figure, path, {})


def draw_embeddings(path: Path, figure: str) -> None:
    """Figures 4-6: a t-SNE panel per encoder that has been trained, unseen actions by label."""
    from matplotlib import colormaps
    from sklearn.manifold import TSNE

    panels = {}  # label -> representations and labels of unseen actions
    for row in TABLE[figure]:
        job = paper.expand(figure, row, 0, paper.Args((figure,)))
        module = importlib.import_module(ppo_actiongen.MODULES[job.args.env])
        split = module.split_actions(job.args.split, job.args.split_seed)
        unseen = np.setdiff1d([*split["valid"], *split["test"]], split["train"])
        if (ROOT / job.folder).exists():
            table = np.load(ROOT / job.folder, allow_pickle=False)["mean"]
            panels[METHODS[row][0]] = table[unseen], module.action_labels()[unseen]
    if not panels:
        return  # the picture that was drawn where the encoders are stays
    if figure == "fig4" and "Ours" in panels:
        panels["Engineered"] = module.engineered_representations()[unseen], panels["Ours"][1]
    names = sorted({label for _, labels in panels.values() for label in labels})
    picture, axes = canvas(len(panels), 4, 2.6, 2.7)
    key = {}
    for axis, (name, (table, labels)) in zip(axes, panels.items(), strict=True):
        spots = TSNE(perplexity=10, init="pca", random_state=0).fit_transform(table)  # (n, 2)
        for i, label in enumerate(names):
            look = dict(s=8, marker="osD^"[i % 4], lw=0)
            color = colormaps["hsv"](0.95 * i / len(names))
            key[label] = axis.scatter(*spots[labels == label].T, color=color, **look)
        axis.set(title=name, xticks=[], yticks=[])
    save(picture, path, key, 7)


# ---- pages ----


def section(name: str, draw: bool) -> str:
    """What stands between a name's markers, "" without results; with `draw`, the picture too."""
    figure, path = name.removesuffix("-paper"), RESULTS / f"{name}.png"
    files = {"main": MAIN, "fig14": [f"{f}_curves" for f in FIGURE_14]}.get(name, [name])
    rows = [row for file in files for row in read(RESULTS / f"{file}.csv")]
    picture, notes = None, []
    if not rows:
        return ""
    if name == "fig14":
        seen, valid = (group(rows, "step", f"{phase}_score") for phase in ("train", "valid"))
        text, picture = "", partial(draw_curves, path, seen, valid)
    elif name == "fig9":
        zero = group([row for row in rows if row["phase"] == "zero-shot"])
        zero = {place[:2]: mean(phases["zero-shot"]) for (place, _), phases in zero.items()}
        curves = group(read(RESULTS / "fig9_curves.csv"), "step", "episode_score")
        curves = {key: points for key, points in curves.items() if key[0][:2] in zero}
        zero = {place: zero[place[:2]] for place in places(curves)}
        text, picture = (
            adaptation_table(curves, zero),
            partial(draw_lines, path, name, curves, zero),
        )
    elif name in ANALYSES:
        cells = group(rows)
        text, picture = table(name, cells), partial(draw_lines, path, name, cells, {})
    elif figure in ("fig4", "fig5", "fig6"):
        text, picture = table(name, group(rows)), partial(draw_embeddings, path, figure)
    else:
        rows = [row for row in rows if row["phase"] != "valid"]
        cells = group(rows)
        notes = drop_not_learned(cells, group(rows, column="stderr"))
        chosen = SHOWN.get(name, METHODS)
        text = table(name, {key: cell for key, cell in cells.items() if key[1] in chosen})
        picture = (
            partial(draw_bars, path, cells) if cells and name not in ("main", "quick") else None
        )
    if picture and draw:
        picture()
    image = f"![{name}]({{folder}}{name}.png)" if picture and path.exists() else ""
    return "\n\n".join(filter(None, [text, *notes, image])) + "\n"


def main(check: bool = False) -> None:
    """Draw everything there are results for, and write both pages.

    Args:
        check: change nothing, exit 1 where a page disagrees with the CSV files.
    """
    names = ["main", *TABLE, *(f"{figure}-paper" for figure in TABLE), "fig14"]
    contents = {name: section(name, not check) for name in names}
    for page, folder in ((RESULTS / "README.md", ""), (RESULTS.parent / "README.md", "results/")):
        text = page.read_text() if page.exists() else ""
        new = text
        for name, content in contents.items():
            content = content.replace("{folder}", folder)
            marks = re.compile(rf"(<!-- begin:{name} -->\n).*?(<!-- end:{name} -->)", re.S)
            new = marks.sub(lambda m, content=content: m[1] + content + m[2], new)
        if check and new != text:
            raise SystemExit(
                f"error: {page} disagrees with its CSV files: run benchmarks/report.py"
            )
        if new != text:
            page.write_text(new)


if __name__ == "__main__":
    tyro.cli(main)
