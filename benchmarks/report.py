"""Tables and pictures from results/*.csv; nothing is shown that is not in those files.

    python benchmarks/report.py            # results/*.png, and the tables in both README.md
    python benchmarks/report.py --check    # exit 1 where a README.md disagrees with the CSV files

A table and its picture go between `<!-- begin:NAME -->` and `<!-- end:NAME -->`, where NAME is a
figure of benchmarks/paper.py, `<figure>-paper` for --recipe paper, `main` (the summary) or `fig14`
(all learning curves). A page has the markers it wants; what has no results stays empty.
A picture shows each environment at one number of steps, the one most methods of the figure have.
A method without a seed two standard errors above random play is named in one line below a table.
"""

import io
import os
import re
import sys
from collections import Counter, defaultdict
from functools import partial
from pathlib import Path
from statistics import mean, pstdev

import numpy as np
import tyro

os.environ["MPLBACKEND"] = "agg"  # an inherited one may not exist here, and ends the import
sys.path.insert(0, str(Path(__file__).parent))
import matplotlib  # noqa: E402
import paper  # noqa: E402
from paper import ROOT, TABLE, hvae, ppo_actiongen, read  # noqa: E402

METHODS = {  # name -> label and colour, the same in every table and picture, in this order
    "ours": ("Ours", "#0b5394"),
    "ours_bilinear": ("Ours, bilinear", "#45a0d8"),
    "ours_more_entropy": ("Ours, entropy 0.02", "#45a0d8"),
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
    "recsys_full": ("Full Recommender", "click-through rate"),
    "create": ("CREATE", "success rate"),
    "stacking": ("Shape Stacking", "height"),
}
# Mean score of random play (slow tests of the environments). Not listed: 0.
CHANCE = {"gridworld": 0.003, "recsys": 0.156, "recsys_full": 0.156, "stacking": 1.6}
CHANCE |= {"push": 0.016, "seesaw": 0.003, "navigate": 0.002, "buckets": 0.005, "cannon": 0.004}
CHANCE |= {"collide": 0.008, "moving": 0.023, "ladder": 0.003, "basket": 0.011, "funnel": 0.022}
ANALYSES = {  # figure -> its name in published_analyses.csv, what is varied
    "analysis-angle": ("angle", "least angle to a training tool, degrees"),
    "analysis-embedding": ("emb", "quantile of the distance to a training tool"),
    "analysis-unseen-ratio": ("ratio", "share of unseen tools on offer"),
    "analysis-set-size": ("action_set_size", "tools on offer"),
}
MAIN = ("gridworld", "recsys", "create-push", "stacking")  # the figures of the summary
FIGURE_14 = ("gridworld", "recsys", "fig12", *(f"create-{t}" for t in paper.CREATE), "stacking")
SUMMARY = ("ours", "ours_bilinear", "engineered", "nearest_neighbor", "continuous_output")
SHOWN = {"main": SUMMARY, "fig8": [*paper.FIGURE_8][:3]}  # of long tables; pictures have all
HEADS = {"train": "seen (published)", "test": "**unseen** (published)"}
# The best that unseen actions allow, where it is known.
CEILINGS = {env.replace("-", "_"): unseen for env, (_, unseen) in ppo_actiongen.CEILINGS.items()}
PUBLISHED = {}  # the columns that name a row -> mean and standard deviation
for file, key in (("results", "env task method phase"), ("analyses", "analysis task method x")):
    for row in read(ROOT / f"results/published_{file}.csv"):
        PUBLISHED[tuple(row[k] for k in key.split())] = float(row["mean"]), float(row["std"])
RESULTS = ROOT / "results"
LOOK = {"font.size": 8, "axes.titlesize": 8.5, "axes.titlelocation": "left"}
LOOK |= {"axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6}

Place = tuple[str, str, int]  # env, task ("" without one), number of steps
Cells = dict[tuple[Place, str], dict[str, list[float]]]  # place, method -> phase -> its seeds


def tested(phase: str) -> float:
    """The number in a phase: 15 of min-angle-gap=15, 0.5 of ...=q0.5, a step; 0 without one."""
    found = re.search(r"(?:^|=q?)([\d.]+)$", phase)
    return float(found[1]) if found else 0.0


def group(rows: list[dict], phase="phase", column="score", every=False) -> Cells:
    """A column's numbers by place, method, phase (or another column), in the order of METHODS."""
    # Unless `every`, one number of steps per environment: that of most methods, or the largest.
    usual: dict[str, tuple] = {}
    runs = {(row["env"], int(row["steps"] or 0), row["method"]) for row in rows}
    for (env, steps), n in Counter(run[:2] for run in runs).items():
        usual[env] = max(usual.get(env, (0, 0)), (n, steps))
    cells: Cells = defaultdict(lambda: defaultdict(list))
    for row in sorted(rows, key=lambda row: tested(row[phase])):
        place = row["env"], row["task"], int(row["steps"] or 0)
        if row[column] and (every or place[2] == usual[row["env"]][1]):
            cells[place, row["method"]][row[phase]].append(float(row[column]))
    tasks, methods = [*dict.fromkeys((row["env"], row["task"]) for row in rows)], [*METHODS]
    order = {k: (tasks.index(k[0][:2]), methods.index(k[1]), k[0][2]) for k in cells}
    return {key: cells[key] for key in sorted(cells, key=order.get)}


def places(cells: Cells) -> list[Place]:
    """The environments of these cells."""
    return [*dict.fromkeys(place for place, _ in cells)]


def title(place: Place) -> str:
    """How an environment and task are called."""
    return f"{ENVIRONMENTS[place[0]][0]} {place[1]}".strip()


def steps(place: Place) -> str:
    """The number of steps: 10M, 0.04M; "" of an encoder."""
    return f"{round(place[2] / 1e6, 2 if place[2] < 1e7 else 0):g}M" if place[2] else ""


def published(figure: str, place: Place, method: str, phase: str) -> tuple:
    """Published mean and standard deviation of one cell's phase; (None, None) without them."""
    key = *place[:2], method, phase
    if figure in ANALYSES:
        # Published distances are 0.5 .. 5 of another table: by rank, as our quantiles 0 .. 0.9 are.
        by_rank = f"{5 * tested(phase) + 0.5:.1f}" if "embedding" in figure else None
        key = ANALYSES[figure][0], place[1], method, by_rank or phase.split("=")[1]
    return PUBLISHED.get(key, (None, None))


def drop_not_learned(cells: Cells, errors: Cells) -> list[str]:
    """Take out the methods without a seed two errors above random play; notes on them."""
    failed = defaultdict(list)
    for (place, method), phases in list(cells.items()):
        best = max(phases, key=lambda phase: mean(phases[phase]))
        chance = CHANCE.get(place[1] or place[0], 0.0)
        seeds = zip(phases[best], errors[place, method][best], strict=True)
        if all(score <= chance + 2 * error for score, error in seeds):
            del cells[place, method]
            about = f"{title(place)}, not learned at {steps(place)} steps (random play: {chance:g})"
            failed[about].append(METHODS[method][0])
    return [f"{about}: {'; '.join(labels)}." for about, labels in failed.items()]


def markdown(head: list[str], lines: list[list[str]]) -> str:
    """A table, without the columns in which nothing stands; "" without lines."""
    keep = [i for i in range(len(head)) if any(line[i] for line in lines)]
    cells = [head, ["---"] * len(head), *([c or "-" for c in line] for line in lines)]
    return "\n".join("|" + "|".join(line[i] for i in keep) + "|" for line in cells if keep)


def table(figure: str, cells: Cells) -> str:
    """One row per environment and method, one column per phase; published means in brackets."""
    phases = dict.fromkeys(p for cell in cells.values() for p in cell if ", published" not in p)
    phases = sorted(phases, key=lambda phase: [*HEADS, phase].index(phase))  # seen, unseen, others
    lines = []
    for (place, method), cell in cells.items():
        named = len({place[:2] for place in places(cells)}) > 1 or figure == "main"
        line = [title(place) * named, METHODS[method][0], steps(place)]
        line.append(str(max(map(len, cell.values()))))
        for phase in phases:
            theirs = cell.get(f"{phase}, published") or published(figure, place, method, phase)
            ours = cell.get(phase, [])
            line.append(f"{mean(ours):.3f}" if ours else "")
            line[-1] += f"±{pstdev(ours):.3f}" if len(ours) > 1 else ""
            line[-1] += f" ({theirs[0]:.3f})" if ours and theirs[0] is not None else ""
        known = "test" in cell and place[0] in CEILINGS
        lines.append([*line, f"{CEILINGS[place[0]]:.3f}" if known else ""])
    heads = [HEADS.get(p, p.split("=")[-1] if figure in ANALYSES else p) for p in phases]
    corner = ANALYSES.get(figure, (figure, " "))[1]
    return markdown([corner, "method", "steps", "seeds", *heads, "ceiling"], lines)


def canvas(count: int, columns: int, width: float, height: float, **options):
    """A figure with `count` panels of this size in inches, and its panels."""
    from matplotlib.figure import Figure  # not pyplot, which would look for a screen

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
    hvae.write(path, lambda file: picture.save(file, "PNG", optimize=True))


def draw_bars(path: Path, cells: Cells) -> None:
    """Per method: unseen actions full, seen ones pale, published outlined, seeds as dots."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    methods, count = sorted({m for _, m in cells}, key=[*METHODS].index), len(places(cells))
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
                axis.barh(at, published("", place, method, phase)[0] or 0, 0.36, **outline)
        if place[0] in CEILINGS:
            key["ceiling, unseen"] = axis.axvline(CEILINGS[place[0]], **line)
        axis.set(title=f"{title(place)}, {steps(place)} steps", xlabel=ENVIRONMENTS[place[0]][1])
    axes[0].set_yticks(range(len(methods)), [METHODS[m][0] for m in methods])
    axes[0].invert_yaxis()
    save(figure, path, key)


def draw_lines(path: Path, panels: dict, xlabel: str, columns=3, width=3.1) -> None:
    """Panels of (label, {phase or step: its seeds}, look): mean and standard deviation."""
    size = max(width, 6.5 / len(panels)), 0.3 + 0.7 * width  # at least: room for the legend
    (figure, axes), key = canvas(len(panels), columns, *size), {}
    for axis, (name, some) in zip(axes, panels.items(), strict=True):
        for label, phases, look in some:
            x = [tested(phase) / (1e6 if xlabel == "million steps" else 1) for phase in phases]
            y, std = (np.array([f(seeds) for seeds in phases.values()]) for f in (mean, pstdev))
            (key[label],) = axis.plot(x, y, **dict(lw=1.3, ms=3.5) | look)
            axis.fill_between(x, y - std, y + std, color=look["color"], alpha=0.2, lw=0)
        axis.set_title(name, fontsize=8 if width > 2 else 7)
        axis.set_ylim(0, None)
    for axis in axes[-columns:]:
        axis.set_xlabel(xlabel)
    save(figure, path, key, 3)


def lines_of(figure: str, cells: Cells, zero: dict[Place, float]) -> dict[str, list[tuple]]:
    """A panel per environment for `draw_lines`: ours, published, the zero-shot score."""
    panels = defaultdict(list)
    for (place, method), phases in cells.items():
        name, (label, color) = f"{title(place)}, {ENVIRONMENTS[place[0]][1]}", METHODS[method]
        mark, hollow = "o" if figure in ANALYSES else "", dict(marker="s", mfc="white", alpha=0.5)
        panels[name].append((label, phases, dict(color=color, marker=mark)))
        theirs = {phase: published(figure, place, method, phase) for phase in phases}
        if theirs := {p: [m - std, m + std] for p, (m, std) in theirs.items() if m is not None}:
            panels[name].append((f"{label}, published", theirs, hollow | dict(color=color, ls=":")))
        if place in zero:
            level = {step: [zero[place]] for step in phases}
            panels[name].append(("Ours, zero-shot", level, dict(color="black", ls="--")))
    return panels


def section(name: str, draw: bool) -> str:
    """What stands between a name's markers, "" without results; with `draw`, the picture too."""
    figure, path, notes = name.removesuffix("-paper"), RESULTS / f"{name}.png", []
    files = {"main": MAIN, "fig14": [f"{f}_curves" for f in FIGURE_14]}.get(name, [name])
    rows = [row for file in files for row in read(RESULTS / f"{file}.csv")]
    if not rows:
        return ""
    METHODS.update({m: (m, "grey") for r in rows if (m := r["method"]) not in METHODS})  # your own
    if name == "fig14":
        seen, valid = (group(rows, "step", f"{phase}_score", True) for phase in ("train", "valid"))
        panels, grey = {}, dict(color="0.5", ls="--")  # a method's longest runs come last, and stay
        for (place, method), points in valid.items():
            lines = [("training actions", seen[place, method], grey)]
            lines.append(("validation actions", points, dict(color=METHODS[method][1])))
            panels[f"{title(place)}\n{METHODS[method][0]}"] = lines
        text, picture = "", partial(draw_lines, path, panels, "million steps", 9, 1.4)
    elif name == "fig9":
        tests = group([row for row in rows if row["phase"] == "zero-shot"])
        zero = {place: mean(cell["zero-shot"]) for (place, _), cell in tests.items()}
        curves = group(read(RESULTS / "fig9_curves.csv"), "step", "episode_score")
        curves = {key: points for key, points in curves.items() if key[0] in zero}
        picture = partial(draw_lines, path, lines_of(name, curves, zero), "million steps")
        text = "Success with unseen actions over steps of training on them."
    elif name in ANALYSES:
        text, lines = table(name, group(rows, every=True)), lines_of(name, group(rows), {})
        picture = partial(draw_lines, path, lines, ANALYSES[name][1])
    elif figure in ("fig4", "fig5", "fig6"):  # t-SNE by hvae.py, one picture per encoder
        text, picture = table(name, group(rows)), None
    else:
        rows = [row for row in rows if row["phase"] != "valid"]
        cells = group(rows, every=True)
        notes = drop_not_learned(cells, group(rows, column="stderr", every=True))
        some = {k: cell for k, cell in cells.items() if k[1] in SHOWN.get(name, METHODS)}
        text, bars = table(name, some), {k: cells[k] for k in group(rows) if k in cells}
        picture = partial(draw_bars, path, bars) if bars and name not in ("main", "quick") else None
    if draw and picture:
        with matplotlib.rc_context(LOOK):
            picture()
    pictures = [path, *sorted(RESULTS.glob(f"{name}-tsne-*.png"))]
    images = [f"![{p.stem}]({{folder}}{p.name})" for p in pictures if p.exists()]
    return "\n\n".join(filter(None, [text, *notes, *images])) + "\n"


def main(check: bool = False) -> None:
    """Draw everything there are results for, and write both pages.

    Args:
        check: change nothing, exit 1 where a page disagrees with the CSV files.
    """
    figures = [name for name in TABLE if name != "analysis"]  # no result of its own
    names = ["main", *figures, *(f"{name}-paper" for name in figures), "fig14"]
    contents = {name: section(name, not check) for name in names}
    for page, folder in ((RESULTS / "README.md", ""), (RESULTS.parent / "README.md", "results/")):
        text = page.read_text() if page.exists() else ""
        new = text
        for name, content in contents.items():
            content = content.replace("{folder}", folder)
            marks = re.compile(rf"(<!-- begin:{name} -->\n).*?(<!-- end:{name} -->)", re.S)
            new = marks.sub(lambda m, content=content: m[1] + content + m[2], new)
        if check and new != text:
            raise SystemExit(f"error: {page} disagrees with the CSV files: run report.py")
        if new != text:
            page.write_text(new)


if __name__ == "__main__":
    tyro.cli(main)
