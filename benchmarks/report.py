"""Tables and pictures from results/*.csv; nothing is shown that is not in those files.

    python benchmarks/report.py            # results/*.png, and the tables in both README.md
    python benchmarks/report.py --check    # exit 1 where a README.md disagrees with the CSV files

A table and its picture go between `<!-- begin:NAME -->` and `<!-- end:NAME -->`, where NAME is a
figure of benchmarks/paper.py, `<figure>-paper` for --recipe paper, `main` (the summary) or `fig14`
(all learning curves). A picture shows a task at one number of steps, that of most methods.
"""

import os
import re
import sys
import textwrap
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
from paper import ROOT, TABLE, hvae, read  # noqa: E402

# ---- what is known about methods, environments, published scores ----

METHODS = {  # name -> label and colour, the same in every table and picture, in this order
    "ours": ("HVAE + utility", "#0b5394"),
    "ours_conditioned_auxiliary": ("HVAE + utility, conditioned", "#3d7ab8"),
    "ours_linear_path": ("HVAE + utility, linear path [here]", "#45a0d8"),
    "ours_bilinear": ("HVAE + utility, bilinear [here]", "#45a0d8"),
    "ours_one_pass": ("HVAE + utility, w/o head epochs [here]", "#45a0d8"),
    "ours_small_steps": ("HVAE + utility, rate 2.5e-4, entropy 0.005 [here]", "#45d8c0"),
    "ours_more_entropy": ("HVAE + utility, entropy 0.02 throughout [here]", "#45a0d8"),
    "ours_alternate_modality": ("HVAE + utility, one-hot", "#7fb8e0"),
    "ours_video": ("HVAE + utility, video", "#7fb8e0"),
    "ours_xy": ("HVAE + utility, (x, y)", "#a8cbe6"),
    "engineered": ("Engineered", "#2e8b6f"),
    "oracle_encoder_all_actions": ("Oracle encoder", "#86bf91"),
    "non_hierarchical_vae": ("VAE", "#e08a3c"),
    "ours_no_entropy": ("w/o entropy", "#a58cc9"),
    "ours_no_subsampling": ("w/o subsampling", "#6f4fa0"),
    "nearest_neighbor": ("Nearest neighbour", "#b5403e"),
    "continuous_output": ("Continuous output", "#d9a5a0"),
    "ours_no_subgoal_reward": ("No subgoal reward", "#5f9ea0"),
    "ours_no_place": ("No place", "#9aa5b1"),
    "ours_2d_place": ("2D place", "#5f9ea0"),
    "ours_full_split": ("Full Split", "#c2785c"),
    "ours_from_scratch": ("Utility, from scratch", "#7fb8e0"),
    "ours_finetuned": ("Utility, fine-tuned", "#0b5394"),
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
# All other methods of these differ from the published ones, whose scores get a star: CREATE's are
# conditioned (C.4), Shape Stacking's encoders have a linear path, Figure 12's tests other numbers.
LIKE = dict(create=("ours", "ours_conditioned_auxiliary"), stacking=("engineered",), recsys_full=())
# The best that unseen actions allow. Grid World: all but 1 in 7,000 sets of skills allow a path.
# Recommender: greedy play, told the user, but the popularity only if it is in the vector.
CEILINGS = {"gridworld": 1.0, "recsys": 0.301, "recsys_full": 0.659}
ANALYSES = {  # figure -> its name in published_analyses.csv ("": in other units), what is varied
    "analysis-angle": ("angle", "least angle to a training tool, degrees"),
    "analysis-embedding": ("", "share of near tools left out"),
    "analysis-unseen-ratio": ("ratio", "share of unseen tools available"),
    "analysis-set-size": ("action_set_size", "available tools"),
}
MAIN = ("gridworld", "recsys", "create-push", "stacking")  # the figures of the summary
FIGURE_14 = ("gridworld", "recsys", "fig12", *(f"create-{t}" for t in paper.TASKS), "stacking")
SUMMARY = ["ours", "ours_conditioned_auxiliary", "ours_linear_path", "ours_bilinear", "engineered"]
SUMMARY += ["nearest_neighbor", "continuous_output"]
HEADS = {"train": "seen (published)", "test": "**unseen** (published)"}
RESULTS = ROOT / "results"
PUBLISHED = {}  # the columns that name a row -> mean and standard deviation
for file, key in (("results", "env task method phase"), ("analyses", "analysis task method x")):
    for row in read(RESULTS / f"published_{file}.csv"):
        numbers = (float(row["mean"]), float(row["std"]))
        PUBLISHED[tuple(row[name] for name in key.split())] = numbers
LOOK = {"font.size": 8, "axes.titlesize": 8.5, "axes.titlelocation": "left"}
LOOK |= {"axes.spines.top": False, "axes.spines.right": False}
LEGEND = dict(loc="outside lower center", frameon=False)

Place = tuple[str, str, int]  # env, task ("" without one), number of steps
Cells = dict[tuple[Place, str], dict[str, list[float]]]  # place, method -> phase -> its seeds


def rows_of(figure: str) -> list[dict]:
    """A table's rows. CREATE's random split and older recipe are tasks of their own, not mixed."""
    rows = read(RESULTS / f"{figure}.csv")
    for row in rows:
        for column, value in (("split", "random"), ("recipe", "older")):
            if row.get(column) == value:
                row["task"] = f"{row['task']}, {value} {column}".removeprefix(", ")
        METHODS.setdefault(row["method"], (row["method"], "grey"))  # your own
    return rows


def published(figure: str, place: Place, method: str, phase: str) -> tuple:
    """Published mean and standard deviation of one cell's phase (or None), and "*" if unlike."""
    env, task = place[0], place[1].split(",")[0]
    if figure in ANALYSES:
        env, phase = ANALYSES[figure][0], phase.split("=")[1]
    star = "" if method in LIKE.get(place[0], METHODS) or figure.endswith("-paper") else "*"
    found = PUBLISHED.get((env, task, method, phase))
    if found is None and method == "ours_conditioned_auxiliary":
        found, star = PUBLISHED.get((env, task, "ours", phase)), "*"
    return *(found or (None, None)), star


def tested(phase: str) -> float:
    """The number in a phase: 15 of min-angle-gap=15, a step; 0 without one."""
    found = re.search(r"(?:^|=)([\d.]+)$", phase)
    return float(found[1]) if found else 0.0


def group(rows: list[dict], phase="phase", column="score", every=False) -> Cells:
    """A column's numbers by place, method, phase (or another column), in the order of METHODS."""
    # Unless `every`, one number of steps per task: that of most methods, or the largest.
    rows = [row | {"steps": int(row["steps"] or 0)} for row in rows]
    usual: dict[str, tuple] = {}
    runs = {(row["env"], row["task"], row["steps"], row["method"]) for row in rows}
    for (*task, steps), n in Counter(run[:3] for run in runs).items():
        usual[tuple(task)] = max(usual.get(tuple(task), (0, 0)), (n, steps))
    tasks = list(dict.fromkeys((row["env"], row["task"]) for row in rows))

    def order(row):
        task = tasks.index((row["env"], row["task"]))
        return task, [*METHODS].index(row["method"]), row["steps"], tested(row[phase])

    cells: Cells = defaultdict(lambda: defaultdict(list))
    for row in sorted(rows, key=order):
        if row[column] and (every or row["steps"] == usual[row["env"], row["task"]][1]):
            place = (row["env"], row["task"], row["steps"])
            cells[place, row["method"]][row[phase]].append(float(row[column]))
    return cells


def names(place: Place, method: str) -> tuple[str, str, str]:
    """Environment and task; method; number of steps: 10M, 0.04M, "" of an encoder."""
    env, task, steps = place
    label = METHODS[method][0]
    if env.startswith("recsys"):  # no encoder: its representations are given
        label = label.replace("HVAE + u", "U")
    if not steps:  # an encoder alone
        label = label.replace(" + utility", "")
    millions = round(steps / 1e6, 2 if steps < 1e7 else 0)
    return f"{ENVIRONMENTS[env][0]} {task}".strip(), label, f"{millions:g}M" if steps else ""


# ---- tables ----


def table(figure: str, cells: Cells) -> str:
    """One row per environment and method, one column per phase; published means in brackets."""
    phases = dict.fromkeys(phase for cell in cells.values() for phase in cell)
    phases = sorted(phases, key=lambda x: ([*HEADS, x].index(x), tested(x)))  # seen, unseen, others
    tasks = {place[:2] for place, _ in cells}
    named = figure in ("main", *ANALYSES) or len(tasks) > 1 or re.search("random|older", str(tasks))
    lines = []
    for (place, method), cell in cells.items():
        line = [*names(place, method), str(max(map(len, cell.values())))]
        for phase in phases:
            seeds = cell.get(phase, [])
            theirs, _, star = published(figure, place, method, phase)
            text = f"{mean(seeds):.3f}" if seeds else ""
            if len(seeds) > 1:
                text += f"±{pstdev(seeds):.3f}"
            if seeds and theirs is not None:
                text += f" ({theirs:.3f}{star})"
            line.append(text)
        line.append(f"{CEILINGS[place[0]]:.3f}" if "test" in cell and place[0] in CEILINGS else "")
        lines.append(line if named else ["", *line[1:]])
    heads = [HEADS.get(p, p.split("=")[-1] if figure in ANALYSES else p) for p in phases]
    head = [ANALYSES.get(figure, ("", " "))[1], "method", "steps", "seeds", *heads, "ceiling"]
    keep = [i for i in range(len(head)) if any(line[i] for line in lines)]  # no empty columns
    lines = [head, ["---"] * len(head), *([text or "-" for text in line] for line in lines)]
    return "\n".join("|" + "|".join(line[i] for i in keep) + "|" for line in lines)


# ---- pictures ----


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


def draw_bars(path: Path, cells: Cells) -> None:
    """Per method: unseen actions full, seen ones pale, published outlined, seeds as dots."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    methods = sorted({method for _, method in cells}, key=[*METHODS].index)
    places = list(dict.fromkeys(place for place, _ in cells))
    width = 3.3 if len(places) > 1 else 6.5
    figure, axes = canvas(len(places), 3, width, 0.32 * len(methods) + 0.7, sharey=True)
    outline = dict(fill=False, edgecolor="0.2", lw=0.9)
    key = {"unseen": Patch(color="0.35"), "seen": Patch(color="0.35", alpha=0.4)}
    key |= {"published": Patch(**outline), "seed": Line2D([], [], color="0", marker=".", ls="")}
    for place, axis in zip(places, axes, strict=True):
        if place[0] in CEILINGS:
            key["ceiling, unseen"] = axis.axvline(CEILINGS[place[0]], color="0.5", lw=0.8, ls="--")
    for (place, method), cell in cells.items():
        axis = axes[places.index(place)]
        title, _, steps = names(place, method)
        title = f"{title}, {steps} steps".replace(", ", "\n", 1)  # panels are narrow
        axis.set(title=title, xlabel=ENVIRONMENTS[place[0]][1])
        y = methods.index(method)
        for at, phase, alpha in ((y - 0.2, "test", 1.0), (y + 0.2, "train", 0.4)):
            seeds = cell.get(phase)
            if seeds:
                axis.barh(at, mean(seeds), 0.36, color=METHODS[method][1], alpha=alpha)
                axis.plot(seeds, [at] * len(seeds), ".", color="black", ms=3, zorder=3)
                theirs, _, star = published("", place, method, phase)
                axis.barh(at, 0 if star else theirs or 0, 0.36, **outline)
    axes[0].set_yticks(range(len(methods)), [names(places[0], method)[1] for method in methods])
    axes[0].invert_yaxis()
    figure.legend(key.values(), key, ncols=5, **LEGEND)
    hvae.write(path, partial(figure.savefig, format="png", dpi=110))


def draw_lines(path: Path, panels: dict, xlabel: str, columns=3, width=3.1) -> None:
    """Panels of (label, {phase or step: its seeds}, look): mean and standard deviation."""
    size = (max(width, 6.5 / len(panels)), 0.3 + 0.7 * width)  # at least: room for the legend
    figure, axes = canvas(len(panels), columns, *size)
    unit = 1e6 if xlabel == "million steps" else 1
    key = {}
    for axis, (name, some) in zip(axes, panels.items(), strict=True):
        for text, phases, look in some:
            x = [tested(phase) / unit for phase in phases]
            y = np.array([mean(seeds) for seeds in phases.values()])
            std = np.array([pstdev(seeds) for seeds in phases.values()])
            (key[text],) = axis.plot(x, y, **dict(lw=1.3, ms=3.5) | look)
            axis.fill_between(x, y - std, y + std, color=look["color"], alpha=0.2, lw=0)
        axis.set_title(name, fontsize=8 if width > 2 else 7)
        axis.set_ylim(0, None)
    for axis in axes[-columns:]:
        axis.set_xlabel(xlabel)
    figure.legend(key.values(), key, ncols=3, **LEGEND)
    hvae.write(path, partial(figure.savefig, format="png", dpi=110))


def lines_of(figure: str, cells: Cells, zero: dict[Place, float]) -> dict[str, list[tuple]]:
    """A panel per environment for `draw_lines`: measured, published, the zero-shot score."""
    panels = defaultdict(list)
    mark = "o" if figure in ANALYSES else ""
    for (place, method), phases in cells.items():
        title, label, _ = names(place, method)
        panel = panels[f"{title}, {ENVIRONMENTS[place[0]][1]}"]
        color = METHODS[method][1]
        panel.append((label, phases, dict(color=color, marker=mark)))
        both = {phase: published(figure, place, method, phase) for phase in phases}
        theirs = {p: [m - std, m + std] for p, (m, std, _) in both.items() if m is not None}
        if theirs:
            look = dict(color=color, ls=":", marker="s", mfc="white", alpha=0.5)
            panel.append((f"{label.removesuffix(', conditioned')}, published", theirs, look))
        if place in zero:
            level = {step: [zero[place]] for step in phases}
            panel.append(("zero-shot", level, dict(color="black", ls="--")))
    return panels


def draw_engineered() -> None:
    """Figure 4's picture without an encoder: the five moves of the held-out skills (B)."""
    module = hvae.load_environment("gridworld")
    _, *held_out = module.split_actions().values()
    held_out = np.concatenate(held_out)
    moves = module.engineered_representations("5d")[held_out]
    path = RESULTS / "fig4-tsne-engineered.png"
    hvae.plot_tsne(moves, module.action_labels()[held_out], path)


# ---- the pages ----


def section(name: str, draw: bool) -> str:
    """What stands between a name's markers, "" without results; with `draw`, the picture too."""
    figure = name.removesuffix("-paper")
    path = RESULTS / f"{name}.png"
    files = {"main": MAIN, "fig14": [f"{f}_curves" for f in FIGURE_14]}.get(name, [name])
    rows = [row for file in files for row in rows_of(file)]
    if not rows:
        return ""
    picture = text = None
    if name == "fig14":
        seen = group(rows, "step", "train_score", True)
        panels = {}  # a method's longest runs come last, and stay
        for (place, method), points in group(rows, "step", "valid_score", True).items():
            lines = [("training actions", seen[place, method], dict(color="0.5", ls="--"))]
            lines.append(("validation actions", points, dict(color=METHODS[method][1])))
            title, label, _ = names(place, method)
            panels["\n".join(textwrap.fill(x, 18) for x in (title, label))] = lines  # narrow
        picture = partial(draw_lines, path, panels, "million steps", 9, 1.4)
    elif figure == "fig9":
        tests = group([row for row in rows if row["phase"] == "zero-shot"])
        zero = {place: mean(cell["zero-shot"]) for (place, _), cell in tests.items()}
        curves = group(rows_of(f"{name}_curves"), "step", "episode_score")
        curves = {key: points for key, points in curves.items() if key[0] in zero}
        picture = partial(draw_lines, path, lines_of(figure, curves, zero), "million steps")
        text = "Score with unseen actions over steps of training on them."
    elif figure in ANALYSES:
        text = table(figure, group(rows, every=True))
        picture = partial(draw_lines, path, lines_of(figure, group(rows), {}), ANALYSES[figure][1])
    elif figure in ("fig4", "fig5", "fig6"):  # t-SNE by hvae.py, one picture per encoder
        text = table(name, group(rows))
        picture = draw_engineered if name == "fig4" else None
    else:
        rows = [row for row in rows if row["phase"] != "valid"]
        cells = group(rows, every=True)
        # At random CREATE's tasks reach 0.025 at most. Who learned no more is named in the text.
        shown = {k: v for k, v in cells.items() if k[0][0] != "create" or mean(v["test"]) >= 0.03}
        if name == "main":
            shown = {k: v for k, v in shown.items() if k[1] in SUMMARY and "," not in k[0][1]}
        text = table(name, shown)
        if name not in ("main", "quick"):
            picture = partial(draw_bars, path, group(rows))
    if draw and picture:
        picture()
    pictures = [path, *sorted(RESULTS.glob(f"{name}-tsne-*.png"))]
    images = [f"![{p.stem}]({p.name})" for p in pictures if p.exists()]
    return "\n\n".join(filter(None, [text, *images])) + "\n"


def main(check: bool = False) -> None:
    """Draw everything there are results for, and write both pages; or only `check` them."""
    figures = [name for name in TABLE if name != "analysis"]  # no result of its own
    names = ["main", *figures, *(f"{name}-paper" for name in figures), "fig14"]
    with matplotlib.rc_context(LOOK):  # for these pictures only
        contents = {name: section(name, not check) for name in names}
    for page, folder in ((RESULTS / "README.md", ""), (RESULTS.parent / "README.md", "results/")):
        text = new = page.read_text(encoding="utf-8") if page.exists() else ""
        for name, content in contents.items():
            between = rf"(?<=<!-- begin:{name} -->\n).*?(?=<!-- end:{name} -->)"
            new = re.sub(between, content.replace("](", f"]({folder}"), new, flags=re.S)
        if check and new != text:
            raise SystemExit(f"error: {page} disagrees with the CSV files: run report.py")
        if new != text:
            hvae.write(page, lambda file, new=new: file.write(new.encode("utf-8")))


if __name__ == "__main__":
    tyro.cli(main)
