"""Tables and figures from results/*.csv; nothing is computed that is not in those files.

    python benchmarks/report.py            # results/*.png and the tables in both README.md
    python benchmarks/report.py --check    # exit 1 if a README.md disagrees with the CSV files
    python benchmarks/report.py results-paper   # only the pictures, of and in another folder

One picture results/<experiment>.png per figure or analysis of benchmarks/paper.py, and one table
between the markers of that name in README.md (main results, recipes) or results/README.md
(everything else). What has no results yet is left out.
Bars: our mean over seeds, filled; published mean, outlined; dots: our seeds; line: the ceiling.
"""

import colorsys
import csv
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from statistics import mean, pstdev

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from PIL import Image  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]
import paper  # noqa: E402

import hvae  # noqa: E402
import ppo_actiongen  # noqa: E402

RESULTS = PUBLISHED = ROOT / "results"

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
    "ours_wide": "Fast recipe, paper's loss",
    "ours_outcome": "Fast recipe w/o exploring",
    "ours_fast": "Fast recipe",
    "ours_fast_64": "Fast recipe, width 64",
    "ours_fast_plain": "Fast recipe, D.3.2's place",
    "ours_fast_small": "Fast recipe, small steps",
    "ours_narrow": "Narrow recipe",
    "engineered_fast": "Fast recipe, engineered",
    "ours_paper_recipe": "Paper's recipe",
    "ours_early": "Narrow recipe in a hurry",
    "ours_predicts": "Ours, predicting outcomes",
    "ours_clip": "Ours, clip 0.3",
    "ours_bilinear": "Ours, bilinear utility",
    "ours_video": "Ours, video",
    "ours_no_subgoal_reward": "No subgoal reward",
    "ours_conditioned_auxiliary": "Conditioned auxiliary policy",
    "ours_no_place": "No Place",
    "ours_2d_place": "2D Place",
    "ours_full_split": "Full Split",
    "ours_analysis": "Ours, 762 tools",
    "ours_from_scratch": "Ours, from scratch",
    "ours_finetuned": "Ours, fine-tuned",
    "discrete_from_scratch": "Discrete, from scratch",
    "discrete_finetuned": "Discrete, fine-tuned",
    "ours_placed": "Narrow recipe, C.4",
    "ours_steady": "Narrow recipe, steadied",
    "ours_one_split": "Narrow recipe, one split",
    "ours_analysis_narrow": "Narrow recipe, 762 tools",
    "ours_gains": "Ours, larger gains",
    "ours_steady_20": "Steadied, 20 on offer",
    "ours_steady_entropy": "Steadied, entropy",
}
# What "ours" is called where it stands beside its own variants.
MAIN_LABELS = {
    "fig8": "Ours, in a hurry",
    "fig10": "Main",
    "fig11": "Main",
    "fig13": "1D Place",
    "table-full-split": "Default Split",
}
TITLES = {
    "gridworld": "Grid World, success rate",
    "recsys": "Recommender, click-through rate (partially observable)",
    "recsys-full": "Recommender, click-through rate (fully observable)",
    "stacking": "Shape Stacking, height",
}
QUANTITIES = {"recsys": "click-through rate", "stacking": "height"}  # others: success rate
BAR_KEY = "filled: this repository (dots: seeds)   outlined: published"
CEILING_KEY = "   line: ceiling with unseen actions"

# The differences of the fast recipe: what is undone in each row of "<environment>-recipe", and what
# the recipe does instead.
RECIPE = {
    "gridworld-recipe": {
        "fast": ("none: the fast recipe", ""),
        "no_exploring": (
            "no random choices while learning",
            "one in ten: what nobody tries any more is forgotten (pays later: after 4M steps)",
        ),
        "no_outcome": (
            "and the paper's loss alone",
            "the utility's hidden layer also learns what the chosen action led to",
        ),
        "narrow": (
            "and networks half as wide: 64, utility 128",
            '128, utility 256: "left of the river after three moves" takes many ReLUs',
        ),
        "utility_width_64": ("utility 64 instead of 128", ""),
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
        "train_with_50": (
            "50 skills on offer in training",
            "20: favourites are rarer, so more skills get practice; cheaper too",
        ),
        "not_standardized": ("representations as they come", "mean 0, std 1 over training actions"),
        "entropy_constant": (
            "constant entropy coefficient",
            "decays to a tenth: one stray sample ends an episode in lava",
        ),
    },
    "create-recipe": {
        "narrow": ("none: the narrow recipe", ""),
        "pictures_as_is": (
            "84 x 84 pixels, 255 for white, raw features; learning rate 0.001, clip 0.1",
            "42 x 42, 0 for white, normalised features; 0.0003, 0.2: cheaper updates, and it sees",
        ),
        "conv_default": (
            "convolutions as PyTorch initialises them",
            "orthogonal, gain sqrt 2: else the code hardly tells two pictures apart at first",
        ),
        "value_coefficient_0.5": (
            "value coefficient 0.5",
            "0.02: goals are worth 10, and critic and policy share the convolutions",
        ),
        "minibatch_3072": (
            "minibatches of 3,072",
            "256: twelve times as many updates from the same steps",
        ),
    },
}
RECIPE_NOTE = {
    "gridworld-recipe": "Engineered representation. Rows 2 to 4 add up: each keeps what those "
    "above it have undone. Every later row undoes one thing more, starting from row 4 (networks "
    "half as wide): compare it with that one",
    "create-recipe": "Learned representation; what the second row undoes pays later (2M steps, "
    "see *What we learned in CREATE* among all results), and each row below it keeps what it has "
    "undone",
}


def read(path: Path) -> list[dict]:
    """Rows of a CSV file, [] if there is none."""
    return list(csv.DictReader(path.open())) if path.exists() else []


def task_of(env: str) -> str | None:
    """CREATE's task; create-push-steady is push in another recipe."""
    return env.split("-")[1] if env.startswith("create-") else None


def published(env: str) -> dict[tuple[str, str], tuple[float, float, int]]:
    """(method, phase) -> published mean, std, number of seeds; env as in paper.RUNS."""
    name, task = (env, "") if task_of(env) is None else ("create", task_of(env))
    rows = [
        r
        for r in read(PUBLISHED / "published_results.csv")
        if (r["env"], r["task"]) == (name.replace("-", "_"), task)
    ]
    found = {
        (r["method"], r["phase"]): (float(r["mean"]), float(r["std"]), int(r["n"])) for r in rows
    }
    if "ours_paper_recipe" in paper.RUNS.get(env, {}):  # what the paper's "ours" was made with
        found |= {("ours_paper_recipe", p): v for (m, p), v in found.items() if m == "ours"}
    return found


def label(method: str, experiment: str = "") -> str:
    """How a method is called in an experiment's table and picture."""
    return MAIN_LABELS.get(experiment, METHODS[method]) if method == "ours" else METHODS[method]


def shown(experiment: str) -> dict[str, list[str]]:
    """Environment -> the experiment's methods that have a test score, in the order of METHODS."""
    runs = paper.EXPERIMENTS[experiment].runs
    found = {
        env: [m for m in methods if (m, "test") in scores(env)] for env, methods in runs.items()
    }
    if experiment not in MAIN_LABELS:
        order = {method: i for i, method in enumerate(METHODS)}
        found = {
            env: sorted(methods, key=lambda m: order.get(m, 0)) for env, methods in found.items()
        }
    return {env: methods for env, methods in found.items() if methods}


def color_of(method: str):
    """One colour per method, the same in every picture of bars."""
    return plt.get_cmap("tab20")(list(METHODS).index(method) % 20)


def spread(values: list[float], digits: int = 3) -> str:
    """Mean and, of two seeds or more, their standard deviation."""
    deviation = f" ± {pstdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{mean(values):.{digits}f}{deviation}"


def millions(rows: list[dict]) -> str:
    """The number of steps of these rows, as the tables write it: 10M, 0.04M."""
    steps = int(rows[0]["steps"]) / 1e6
    return f"{round(steps, 2 if steps < 10 else 1):g}M"


def usual_budget(ours: dict, methods: Sequence[str]) -> str:
    """The number of steps that most of these methods' test rows have; others need a label."""
    return Counter(millions(ours[m, "test"]) for m in methods).most_common(1)[0][0]


def with_budget(text: str, ours: dict, method: str, usual: str) -> str:
    """A method's name or score, and its number of steps where that is not the usual one."""
    steps = millions(ours[method, "test"])
    return text if steps == usual else f"{text}, {steps}"


def runs_of(env: str, kind: str = "") -> list[dict]:
    """Rows of one environment: of its runs, or with kind "_curves" of their learning curves."""
    return [r for r in read(RESULTS / f"{paper.file_of(env)}{kind}.csv") if r["env"] == env]


def by_budget(env: str) -> dict[tuple[str, str], dict[int, list[dict]]]:
    """(method, phase) -> steps -> our rows, one per seed."""
    table: dict = defaultdict(lambda: defaultdict(list))
    for r in runs_of(env):
        table[r["method"], r["phase"]][int(r["steps"])].append(r)
    return table


def scores(env: str, methods: Sequence[str] = ()) -> dict[tuple[str, str], list[dict]]:
    """(method, phase) -> our rows, one per seed; of each method the budget with most seeds, then
    that of most methods, then the largest: rows of other numbers of seeds, each its own split, or
    of other numbers of steps would not compare.

    With `methods`, those to compare: one budget that all of them have, chosen alike, if any."""
    table = by_budget(env)
    common = set.intersection(*(set(table[m, "test"]) for m in methods)) if methods else set()
    if common:
        one = max(common, key=lambda n: (sum(len(table[m, "test"][n]) for m in methods), n))
        return defaultdict(list, {key: v[one] for key, v in table.items() if one in v})
    shared = Counter(steps for v in table.values() for steps in v)  # budget -> methods and phases
    best = {
        k: max(v.items(), key=lambda b: (len(b[1]), shared[b[0]], b[0]))[1]
        for k, v in table.items()
        if v
    }
    return defaultdict(list, best)


def longest(env: str) -> dict[tuple[str, str], list[dict]]:
    """(method, phase) -> our rows of the method's largest budget, however few their seeds."""
    found = by_budget(env)
    return defaultdict(list, {key: v[max(v)] for key, v in found.items()})


def table(env: str) -> str:
    """A Markdown table: per method ours (mean and std over seeds) beside the published numbers."""
    ours, theirs = scores(env, shown(env)[env]), published(env)
    ceiling = ppo_actiongen.CEILINGS.get(env)
    phases = "" if not ceiling or ceiling[0] == ceiling[1] else " (seen: {0})"
    lines = [
        "| method | seen: ours | seen: published | **unseen: ours** | unseen: published "
        "| seeds | steps | hours |",
        "|---|---|---|---|---|---|---|---|",
    ]
    long = longest(env)
    # A method with longer runs of fewer seeds has a second row.
    sets = [(m, rows) for m in shown(env)[env] for rows in (ours, long)]
    for method, of in [(m, o) for m, o in sets if o is ours or o[m, "test"] != ours[m, "test"]]:
        cells = [METHODS[method]]
        for phase in ("train", "test"):
            values = [float(r["score"]) for r in of[method, phase]]
            bold = "**" if phase == "test" else ""
            cells.append(f"{bold}{spread(values)}".replace(" ±", f"{bold} ±"))
            cells[-1] += "" if len(values) > 1 else bold
            known = theirs.get((method, phase))
            cells.append(f"{known[0]:.3f} ± {known[1]:.3f}" if known else "-")
        rows = of[method, "test"]
        hours = mean(float(r["hours"]) for r in rows)
        cells += [str(len(rows)), millions(rows), f"{hours:.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    # Stacking's environments are processes of their own: physics takes every core there is.
    cores = "two CPU cores, other runs beside them" if env == "stacking" else "one CPU core"
    note = f"Ceiling: {ceiling[1]}{phases.format(*ceiling)}. " if ceiling else ""
    lines.append(
        f"\n{note}± is the standard deviation over seeds; hours are per seed on {cores}. "
        f"Command: `python benchmarks/paper.py {env}`, which makes all of it with three seeds and "
        "the full budgets; these rows were made with the `--seeds`, `--budget` and `--extra` that "
        f"their commands in `results/{paper.file_of(env)}.csv` show."
    )
    return "\n".join(lines)


def recipe_table(env: str) -> str:
    """A Markdown table: the fast recipe, then each of its differences undone."""
    ours = scores(env)
    lines = [
        "| undone | what the recipe does | seen | validation | unseen |",
        "|---|---|---|---|---|",
    ]
    known = [m for m in RECIPE[env] if (m, "test") in ours]
    for method in known:
        cells = list(RECIPE[env][method])
        for phase in ("train", "valid", "test"):
            cells.append(f"{mean(float(r['score']) for r in ours[method, phase]):.3f}")
        lines.append("| " + " | ".join(cells) + " |")
    rows = ours[known[0], "test"]
    lines.append(
        f"\n{RECIPE_NOTE[env]}, {millions(rows)} steps, {len(rows)} seed(s): early in learning, "
        f"where its speed shows. Command: `python benchmarks/paper.py {env}`."
    )
    return "\n".join(lines)


def bar_figure(env: str, path: Path) -> None:
    """Train and test bars per method, ours filled and published outlined."""
    methods = shown(env)[env]
    ours, long, theirs = scores(env, methods), longest(env), published(env)
    usual = usual_budget(ours, methods)
    # What has no published bar to stand beside is shown at its best: its longest runs.
    for key in [(m, p) for m in methods for p in ("train", "test") if (m, p) not in theirs]:
        ours[key] = long[key]
    figure, axes = plt.subplots(1, 2, figsize=(11, 3.8), sharey=True)
    for axis, phase, title in zip(
        axes, ("train", "test"), ("training actions", "unseen actions"), strict=True
    ):
        for x, method in enumerate(methods):
            values = [float(r["score"]) for r in ours[method, phase]]
            axis.bar(x - 0.2, mean(values), 0.38, color=color_of(method), alpha=0.85)
            axis.plot([x - 0.2] * len(values), values, "k.", ms=4)
            if (method, phase) in theirs:
                m, s, _ = theirs[method, phase]
                look = dict(fill=False, edgecolor=color_of(method), capsize=2)
                axis.bar(x + 0.2, m, 0.38, yerr=s, **look)
        if env in ppo_actiongen.CEILINGS:
            ceiling = ppo_actiongen.CEILINGS[env][phase == "test"]
            axis.axhline(ceiling, color="grey", lw=1)
        names = [with_budget(METHODS[m], ours, m, usual) for m in methods]
        axis.set_xticks(range(len(methods)), names, rotation=35, ha="right")
        axis.set_title(title)
        axis.spines[["top", "right"]].set_visible(False)
    name = TITLES.get(env, paper.TITLES.get(env, env))
    key = BAR_KEY + "   line: ceiling" * (env in ppo_actiongen.CEILINGS)
    figure.suptitle(f"{name}, {usual} steps where no others are named\n{key}", fontsize=9)
    figure.tight_layout()
    save(figure, path)


def curve_figure(env: str, path: Path) -> None:
    """Learning curves (Figure 14): train and validation score, raw, one line per seed."""
    rows = runs_of(env, "_curves")
    methods = [m for m in METHODS if any(r["method"] == m for r in rows)]
    columns = min(5, len(methods))
    lines = -(-len(methods) // columns)
    figure, axes = plt.subplots(
        lines,
        columns,
        figsize=(max(5, 2.6 * columns), 2.6 if lines == 1 else 2.3 * lines),
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    axes[0, 0].set_xlim(0, 1.02 * max(int(r["step"]) for r in rows) / 1e6)
    for axis, method in zip(axes.flat, methods, strict=False):
        mine = [r for r in rows if r["method"] == method]
        for seed in sorted({r["seed"] for r in mine}):
            one = [r for r in mine if r["seed"] == seed]
            steps = [int(r["step"]) / 1e6 for r in one]
            marker = "." if len(one) < 3 else None  # a line needs two points to be seen
            axis.plot(steps, [float(r["train_score"]) for r in one], "C0", lw=1, marker=marker)
            axis.plot(steps, [float(r["valid_score"]) for r in one], "C1", lw=1, marker=marker)
        axis.set_title(METHODS[method], fontsize=9)
    for axis in axes.flat[len(methods) :]:
        axis.axis("off")
    for i, axis in enumerate(axes.flat[: len(methods)]):
        if i + columns >= len(methods):  # the last one of its column
            axis.set_xlabel("million steps", fontsize=8)
            axis.tick_params(labelbottom=True)
    for axis in axes[:, 0]:
        axis.set_ylabel(quantity(env), fontsize=8)
    name = TITLES.get(env, paper.TITLES.get(env, env))
    figure.suptitle(f"{name}: training actions (blue), validation (orange)", fontsize=9)
    figure.tight_layout()
    save(figure, path)


# ---- figures and analyses of the appendix ----


def comparison(experiment: str) -> str:
    """Figures 8, 10, 11, 13, Table 1: one row per environment and method."""
    lines = [
        "| environment | method | seen: ours | seen: published | **unseen: ours** "
        "| unseen: published | seeds | steps |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for env, methods in shown(experiment).items():
        ours, theirs = scores(env, methods), published(env)
        for method in methods:
            cells = [paper.TITLES[env], label(method, experiment)]
            for phase in ("train", "test"):
                text = spread([float(r["score"]) for r in ours[method, phase]])
                known = theirs.get((method, phase))
                cells.append(text if phase == "train" else f"**{text}**")
                cells.append(f"{known[0]:.3f} ± {known[1]:.3f}" if known else "-")
            rows = ours[method, "test"]
            cells += [str(len(rows)), millions(rows)]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def overview(experiment: str) -> str:
    """The main results: methods down, environments across, unseen actions only."""
    found = shown(experiment)
    ours = {env: scores(env, methods) for env, methods in found.items()}
    usual = {env: usual_budget(ours[env], methods) for env, methods in found.items()}
    titles = [f"{paper.TITLES[env]}, {usual[env]} steps" for env in found]
    lines = ["| method | " + " | ".join(titles) + " |"]
    lines.append("|---" * (1 + len(found)) + "|")
    for method in [m for m in METHODS if any(m in methods for methods in found.values())]:
        cells = [METHODS[method]]
        for env, methods in found.items():
            known = published(env).get((method, "test"))
            text = "-"
            if method in methods:
                text = spread([float(r["score"]) for r in ours[env][method, "test"]])
            text += f" ({known[0]:.3f})" if known else ""
            if method in methods:
                text = with_budget(text, ours[env], method, usual[env])
            cells.append(text)
        lines.append("| " + " | ".join(cells) + " |")
    note = note_on_brackets(lines, "published (more steps: results/README.md)")
    return "\n".join(lines) + (
        f"\n\nUnseen actions{note} Without ±: one seed. Other numbers of steps stand by the score."
    )


def panel_figure(experiment: str, path: Path) -> None:
    """One panel per environment: per method a pale bar (seen) and a full one (unseen actions)."""
    found = shown(experiment)
    columns = min(3, len(found))
    lines = -(-len(found) // columns)
    width = max(3.2, 0.5 * max(map(len, found.values())) + 1)
    figure, axes = plt.subplots(
        lines, columns, figsize=(max(5, width * columns), 3.4 * lines), squeeze=False
    )
    for axis, (env, methods) in zip(axes.flat, found.items(), strict=False):
        ours, theirs = scores(env, methods), published(env)
        usual = usual_budget(ours, methods)
        for x, method in enumerate(methods):
            for at, phase, alpha in ((x - 0.2, "train", 0.35), (x + 0.2, "test", 0.9)):
                values = [float(r["score"]) for r in ours[method, phase]]
                axis.bar(at, mean(values), 0.32, color=color_of(method), alpha=alpha)
                axis.plot([at] * len(values), values, "k.", ms=3)
                if (method, phase) in theirs:
                    m, s, _ = theirs[method, phase]
                    axis.bar(at, m, 0.4, yerr=s, fill=False, edgecolor="0.35", capsize=2)
        if env in ppo_actiongen.CEILINGS:
            axis.axhline(ppo_actiongen.CEILINGS[env][1], color="grey", lw=1)
        middle, half = (len(methods) - 1) / 2, max(len(methods), 4) / 2 + 0.2
        axis.set_xlim(middle - half, middle + half)  # one method is a bar, not a wall
        names = [with_budget(label(m, experiment), ours, m, usual) for m in methods]
        axis.set_xticks(range(len(methods)), names, rotation=35, ha="right", fontsize=8)
        axis.set_title(f"{paper.TITLES[env]}, {usual} steps", fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes.flat[len(found) :]:
        axis.axis("off")
    key = BAR_KEY + CEILING_KEY * any(env in ppo_actiongen.CEILINGS for env in found)
    figure.suptitle(f"pale: seen, full: unseen actions\n{key}", fontsize=7)
    figure.tight_layout()
    save(figure, path)


def save(figure, path: Path, colors: int = 48) -> None:
    """Write a picture in few colours, a third of the bytes, and forget the figure."""
    with BytesIO() as file:
        figure.savefig(file, dpi=110)
        picture = Image.open(file).convert("RGB")
        # The usual median cut gives small areas, such as bars, the colour of their neighbours.
        palette = dict(method=Image.Quantize.MAXCOVERAGE, kmeans=4)
        picture.quantize(colors, **palette).save(path, optimize=True)
    plt.close(figure)


def all_curves(experiment: str, path: Path) -> None:
    """Figure 14: one column of panels per environment, one line of them per method."""
    curves = {env: runs_of(env, "_curves") for env in shown(experiment)}
    known = {method for methods in shown(experiment).values() for method in methods}
    methods = [
        m
        for m in METHODS
        if m in known and any(r["method"] == m for c in curves.values() for r in c)
    ]
    size = (1.75 * len(curves) + 0.3, 1.25 * len(methods) + 0.7)
    figure, axes = plt.subplots(
        len(methods), len(curves), figsize=size, squeeze=False, sharex="col", sharey="col"
    )
    for column, (env, rows) in zip(axes.T, curves.items(), strict=True):
        mine = [r for r in rows if r["method"] in methods]
        top = max(float(r[k]) for r in mine for k in ("train_score", "valid_score"))
        column[0].set_ylim(0, max(1.05 * top, 0.05))
        column[0].set_xlim(0, 1.03 * max(int(r["step"]) for r in mine) / 1e6)
        for axis, method in zip(column, methods, strict=True):
            of = [r for r in mine if r["method"] == method]
            for seed in sorted({r["seed"] for r in of}):
                one = [r for r in of if r["seed"] == seed]
                steps, few = [int(r["step"]) / 1e6 for r in one], len(one) < 3
                for color, key in (("C0", "train_score"), ("C1", "valid_score")):
                    look = dict(lw=1, marker=".", ms=5 if few else 2)
                    axis.plot(steps, [float(r[key]) for r in one], color, **look)
            axis.tick_params(labelsize=8)
            if not of:
                axis.text(0.5, 0.5, "-", transform=axis.transAxes, ha="center", color="0.6")
                axis.spines[:].set_visible(False)
                axis.tick_params(left=False, labelleft=False, bottom=axis is column[-1])
        column[0].set_title(paper.TITLES[env].replace(", ", "\n"), fontsize=8)
        column[-1].set_xlabel("million steps", fontsize=8)
    for line, method in zip(axes, methods, strict=True):
        line[0].set_ylabel(METHODS[method].replace(" ", "\n", 1), fontsize=8)
    figure.suptitle("scores with seen (blue) and validation actions (orange)", fontsize=9)
    figure.tight_layout()
    save(figure, path)


def one_budget(rows: Iterable[dict]) -> list[dict]:
    """Of these rows those of one number of steps: of most seeds, then the largest."""
    seeds = defaultdict(set)
    for r in (rows := list(rows)):
        seeds[int(r["steps"])].add(r["seed"])
    best = max(seeds, key=lambda steps: (len(seeds[steps]), steps), default=0)
    return [r for r in rows if int(r["steps"]) == best]


def quantity(env: str) -> str:
    """What a score of this environment is."""
    return QUANTITIES.get(env.split("-")[0], "success rate")


def adaptation(env: str) -> tuple[float | None, dict[str, list[tuple[int, float]]]]:
    """Figure 9: the zero-shot score, and per variant the seed-averaged curve while it adapts."""
    zero_shot = one_budget(r for r in read(RESULTS / "fig9.csv") if r["env"] == env)
    zero_shot = [float(r["score"]) for r in zero_shot]
    rows_of_env = [r for r in read(RESULTS / "fig9_curves.csv") if r["env"] == env]
    curves = {}
    for method in paper.ADAPT:
        rows = one_budget(r for r in rows_of_env if r["method"] == method)
        points = defaultdict(list)
        for r in rows:
            points[int(r["step"])].append(float(r["episode_score"]))
        seeds = len({r["seed"] for r in rows})
        full = [(step, mean(v)) for step, v in sorted(points.items()) if len(v) == seeds]
        if full:
            curves[method] = full
    return (mean(zero_shot) if zero_shot else None), curves


def adaptation_table(experiment: str) -> str:
    """How many steps on the unseen actions it takes to reach what zero-shot has at once."""
    lines = [
        "| environment | zero-shot | " + " | ".join(METHODS[m] for m in paper.ADAPT) + " | seeds |",
        "|---" * (3 + len(paper.ADAPT)) + "|",
    ]
    trained = []
    for env in paper.EXPERIMENTS[experiment].runs:
        line, curves = adaptation(env)
        if not curves:
            continue
        tested = one_budget(r for r in read(RESULTS / "fig9.csv") if r["env"] == env)
        cells = [paper.TITLES[env], "-" if line is None else f"{line:.3f}"]
        for method in paper.ADAPT:
            curve = curves.get(method, [])
            # One point may jump over the line; the mean of a point and the next four does not.
            means = [mean(score for _, score in curve[i : i + 5]) for i in range(len(curve) - 4)]
            above = next((curve[i][0] for i, m in enumerate(means) if m > (line or 0)), None)
            if line is None or method not in curves:
                cells.append("-")
            elif above is not None:
                cells.append(f"{above:,}")
            else:
                cells.append(f"not reached in {curves[method][-1][0]:,}")
        rows = [r for r in read(RESULTS / "fig9_curves.csv") if r["env"] == env]
        lines.append("| " + " | ".join([*cells, str(len({r["seed"] for r in rows}))]) + " |")
        trained.append(f"{millions(tested)} ({paper.TITLES[env]})" if tested else "")
    trained = list(filter(None, trained))
    return "\n".join(lines) + (
        "\n\nSteps until the training score exceeds the zero-shot score with all test actions on "
        "offer at once, both averaged over seeds, the former also over five hundredths of the run. "
        f"Zero-shot and fine-tuned policies were trained for {'; '.join(trained)} steps."
        + " The Recommender's ours adapts to 2,000 of its 2,500 test products, as published."
        * ("recsys" in {r["env"] for r in read(RESULTS / "fig9_curves.csv")})
    )


def adaptation_figure(experiment: str, path: Path) -> None:
    """Figure 9: one panel per environment, raw training scores and the zero-shot line."""
    data = {env: adaptation(env) for env in paper.EXPERIMENTS[experiment].runs}
    data = {env: found for env, found in data.items() if found[1]}
    figure, axes = plt.subplots(1, len(data), figsize=(3 * len(data) + 2, 3), squeeze=False)
    for axis, (env, (line, curves)) in zip(axes.flat, data.items(), strict=True):
        for i, method in enumerate(paper.ADAPT):
            if method in curves:
                steps, values = zip(*curves[method], strict=True)
                steps = [step / 1e6 for step in steps]
                axis.plot(steps, values, f"C{i}", lw=1, marker=".", ms=2, label=METHODS[method])
        if line is not None:
            axis.axhline(line, color="k", ls="--", lw=1, label="Ours, zero-shot")
        bottom, top = axis.get_ylim()
        if bottom < 0:  # no score is
            axis.set_ylim(0, max(top, 0.05))
        axis.set_title(paper.TITLES[env], fontsize=9)
        axis.set_xlabel("million steps", fontsize=8)
        axis.set_ylabel(quantity(env), fontsize=8)
    axes[0, -1].legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.tight_layout()
    save(figure, path)


ANALYSES = {  # experiment -> (x column, label of x, name in published_analyses.csv)
    "analysis-angle": ("min_angle_gap", "degrees to the nearest training tool", "angle"),
    "analysis-embedding": (
        "min_embedding_distance",
        "quantile of the squared distance to the nearest training tool",
        "emb",
    ),
    "analysis-unseen-ratio": ("unseen_ratio", "share of unseen tools", "ratio"),
    "analysis-set-size": ("num_available", "tools on offer", "action_set_size"),
    "fig12": ("num_available", "products on offer", ""),
}


def analysed(experiment: str) -> dict[tuple[str, str], dict[float, list[dict]]]:
    """(environment, method) -> x -> our rows, one per seed; only the largest budget."""
    rows, column = read(RESULTS / f"{experiment}.csv"), ANALYSES[experiment][0]
    steps: dict[tuple, int] = defaultdict(int)
    for r in rows:
        key = r["env"], r["method"]
        steps[key] = max(steps[key], int(r["steps"]))
    table = defaultdict(lambda: defaultdict(list))
    for r in rows:
        if int(r["steps"]) == steps[r["env"], r["method"]]:
            table[r["env"], r["method"]][float(r[column].removeprefix("q"))].append(r)
    return {key: dict(sorted(points.items())) for key, points in table.items()}


def note_on_brackets(lines: list[str], what: str) -> str:
    """The end of a table's note: what the numbers in brackets are, if there are any."""
    return f"; in brackets: {what}." if any("(0." in line for line in lines) else "."


def published_analysis(experiment: str, env: str, method: str) -> dict[float, tuple[float, float]]:
    """x -> published mean and std."""
    name, task = ANALYSES[experiment][2], task_of(env) or env
    method = method.replace("ours_analysis", "ours")
    rows = read(PUBLISHED / "published_analyses.csv")
    rows = [r for r in rows if (r["analysis"], r["task"], r["method"]) == (name, task, method)]
    return {float(r["x"]): (float(r["mean"]), float(r["std"])) for r in rows}


def analysis_table(experiment: str) -> str:
    """x down; environments and methods across, with the number of tools left to choose from."""
    found, (_, title, name) = analysed(experiment), ANALYSES[experiment]
    several = len({method for _, method in found}) > 1
    heads = [
        paper.TITLES[env] + (f": {METHODS[method]}" if several else "") for env, method in found
    ]
    lines = [f"| {title} | {' | '.join(heads)} | actions in the pool |"]
    lines.append("|---" * (2 + len(found)) + "|")
    for x in sorted({x for points in found.values() for x in points}):
        cells, sizes = [f"{x:g}"], []
        for (env, method), points in found.items():
            rows = points.get(x, [])
            text = spread([float(r["score"]) for r in rows]) if rows else "-"
            # The published distances belong to another table of representations.
            known = published_analysis(experiment, env, method).get(x) if name != "emb" else None
            cells.append(text + (f" ({known[0]:.3f})" if known else ""))
            sizes += [float(r["pool_size"]) for r in rows]
        sizes = sorted({round(min(sizes)), round(max(sizes))})
        lines.append("| " + " | ".join([*cells, " to ".join(map(str, sizes))]) + " |")
    policies = []  # every policy of the table, with its number of steps and of seeds
    for (env, method), points in found.items():
        rows = next(iter(points.values()))
        count = f"{len(rows)} seed{'s' * (len(rows) > 1)}"
        policies.append(f"{paper.TITLES[env]}, {METHODS[method]}: {millions(rows)} steps, {count}")
    on_offer = "Unseen and training actions" if name == "ratio" else "Unseen actions"
    note = note_on_brackets(lines, "published")
    return "\n".join(lines) + f"\n\n{on_offer}{note} {'; '.join(dict.fromkeys(policies))}."


def analysis_figure(experiment: str, path: Path) -> None:
    """One panel per environment; ours in colour, published in grey."""
    found, (_, title, name) = analysed(experiment), ANALYSES[experiment]
    envs, methods = (list(dict.fromkeys(names)) for names in zip(*found, strict=True))
    figure, axes = plt.subplots(1, len(envs), figsize=(3.4 * len(envs) + 3, 3.4), squeeze=False)
    legend = {}  # label -> handle, of all panels
    for axis, env in zip(axes.flat, envs, strict=True):
        # The published distances belong to another table of representations: an axis of their own.
        theirs = axis.twiny() if name == "emb" else axis
        for method in (m for e, m in found if e == env):
            points, i = found[env, method], methods.index(method)
            means = [mean(float(r["score"]) for r in rows) for rows in points.values()]
            # Standard error over the episodes of a test, and seeds as dots.
            errors = [mean(float(r["stderr"]) for r in rows) for rows in points.values()]
            look = dict(fmt=f"C{i}o-", ms=3, capsize=2, elinewidth=0.8)
            axis.errorbar(list(points), means, errors, label=METHODS[method], **look)
            for x, rows in points.items():
                axis.plot([x] * len(rows), [float(r["score"]) for r in rows], f"C{i}.", ms=2)
            known = published_analysis(experiment, env, method)
            if known:
                middle, std = zip(*known.values(), strict=True)
                theirs.errorbar(
                    list(known), middle, std, color=f"C{i}", ls=":", alpha=0.6, capsize=2,
                    mfc="none", marker="s", ms=3, lw=1, label=f"{METHODS[method]}, published",
                )  # fmt: skip
        if name == "angle":  # harder to the right
            axis.invert_xaxis() if axis.get_xlim()[0] > axis.get_xlim()[1] else None
        axis.set_xlabel(title, fontsize=8)
        axis.set_title(paper.TITLES[env], fontsize=9)
        axis.set_ylabel(quantity(env), fontsize=8)
        axis.set_ylim(0, None)
        if theirs is not axis:
            theirs.set_xlabel("published: squared distance of their representations", fontsize=8)
        for handles, labels in {a: a.get_legend_handles_labels() for a in (axis, theirs)}.values():
            legend |= dict(zip(labels, handles, strict=True))
    # Beside the panels: inside, there are curves everywhere.
    place = dict(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, fontsize=7)
    axes[0, -1].legend(legend.values(), legend.keys(), **place)
    figure.tight_layout()
    save(figure, path)


def encoder_table(experiment: str) -> str:
    """What each panel's table of representations tells about held-out actions."""
    rows = [r for r in read(RESULTS / "encoders.csv") if r["figure"] == experiment]
    names = list(dict.fromkeys(r["score"] for r in rows))
    names = [n for n in names if not n.startswith("move_") or n == "move_accuracy"]
    panels = [
        p for p in paper.EXPERIMENTS[experiment].encoders if any(r["panel"] == p for r in rows)
    ]
    known = any(r["published"] for r in rows)
    apart = "engineered" not in panels  # the engineered features need a column of their own
    last = ["engineered features"] * apart
    lines = ["| " + " | ".join(["score", *panels, *last]) + " |"]
    lines.append("|---" * (1 + len(panels) + apart) + "|")
    for name in names:
        of = {r["panel"]: r for r in rows if r["score"] == name}
        cells = [
            f"{float(of[p]['value']):.3f}"
            + (
                f" ({float(of[p]['published']):.3f})"
                if of[p]["published"] and p not in OUR_ENCODERS
                else ""
            )
            if p in of and of[p]["value"] != "nan"  # where all of them have the same value
            else "-"
            for p in panels
        ]
        # Full Split has its own held-out actions and values; all other panels share these.
        best = next(r["engineered"] for r in of.values())
        last = [f"{float(best):.3f}"] * apart
        lines.append("| " + " | ".join([f"`{name}`", *cells, *last]) + " |")
    minutes = {r["panel"]: r["minutes"] for r in rows}
    spent = [minutes[p] or "-" for p in panels]
    lines.append("| " + " | ".join(["minutes of training", *spent, *[""] * apart]) + " |")
    note = " In brackets: the published tables." if known else ""
    same = " *Engineered features*: the same read-outs from the ground truth (Default Split)."
    return "\n".join(lines) + (
        "\n\nHeld-out actions; `probe` in `hvae.py` says what the scores mean."
        f"{same * apart}{note} Minutes on one busy core."
    )


OUR_ENCODERS = ("MLP encoder", "linear path")  # panels of encoders that the paper does not have


def tsne_figure(experiment: str, path: Path) -> None:
    """Figures 4-6: one panel per table, unseen actions coloured by what they do."""
    rows = read(RESULTS / f"{experiment}.csv")
    panels = [
        p for p in paper.EXPERIMENTS[experiment].encoders if any(r["panel"] == p for r in rows)
    ]
    names = sorted({r["label"] for r in rows})
    across = len(panels) if len(panels) < 5 else -(-len(panels) // 2)  # many: two lines
    down = -(-len(panels) // across)
    figure, axes = plt.subplots(down, across, figsize=(4 * across, 4.2 * down), squeeze=False)
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis, panel in zip(axes.flat, panels, strict=False):
        for i, name in enumerate(names):
            mine = [r for r in rows if (r["panel"], r["label"]) == (panel, name)]
            color = colorsys.hls_to_rgb((i / len(names) + 0.7) % 1, 0.6, 0.9)  # as in hvae.py
            mark = hvae.MARKS[i % len(hvae.MARKS)] if len(names) > 6 else "o"
            look = dict(s=14, color=color, marker=mark, linewidths=0.2, edgecolors="#00000080")
            xy = [(float(r["x"]), float(r["y"])) for r in mine]
            axis.scatter(*(zip(*xy, strict=True) if xy else ((), ())), label=name, **look)
        axis.set(xticks=[], yticks=[])
        axis.set_title(panel, fontsize=10)
        axis.spines[:].set(linewidth=0.4, color="0.7")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    columns = min(8, len(names))
    figure.legend(handles, labels, loc="lower center", ncols=columns, frameon=False, fontsize=7)
    figure.tight_layout(rect=(0, (0.04 + 0.04 * -(-len(names) // columns)) / down, 1, 1))
    save(figure, path, colors=256)  # many classes, overlapping dots


# ---- README.md and results/README.md ----


def has_results(experiment: str) -> bool:
    """Whether there is anything to show: of a variant more than the main runs beside it."""
    e = paper.EXPERIMENTS[experiment]
    if e.encoders or experiment in ANALYSES and experiment != "fig12":
        return bool(read(RESULTS / f"{experiment}.csv"))
    if experiment == "fig9":
        return bool(read(RESULTS / "fig9_curves.csv"))
    if experiment in ("table-main", "fig14") and len(shown(experiment)) < 2:
        return False  # one environment has its own table and curves
    found = {method for methods in shown(experiment).values() for method in methods}
    return bool(found - ({"ours"} if experiment in MAIN_LABELS else set()))


def draw(experiment: str) -> list[Path]:
    """Draw an experiment's pictures; the paths of what was drawn."""
    if not has_results(experiment) or experiment in paper.RECIPES:
        return []
    path, kind = RESULTS / f"{experiment}.png", paper.EXPERIMENTS[experiment]
    if kind.encoders:
        tsne_figure(experiment, path)
    elif experiment == "fig9":
        adaptation_figure(experiment, path)
    elif experiment == "fig12":
        bar_figure("recsys-full", path)
    elif experiment == "fig14":
        all_curves(experiment, path)
    elif experiment in ANALYSES:
        analysis_figure(experiment, path)
    elif experiment in kind.runs:  # one environment, all its methods
        bar_figure(experiment, path)
        if runs_of(experiment, "_curves"):
            curve_figure(experiment, RESULTS / f"{experiment}_curves.png")
            return [path, RESULTS / f"{experiment}_curves.png"]
    else:
        panel_figure(experiment, path)
    return [path]


def section(experiment: str) -> str:
    """What stands between an experiment's markers, as in README.md; "" without results."""
    if not has_results(experiment):
        return ""
    if experiment in paper.RECIPES:
        return recipe_table(experiment)
    kind = paper.EXPERIMENTS[experiment]
    if experiment in kind.runs:
        return table(experiment)
    tables = {
        "table-main": overview,
        "fig9": adaptation_table,
        "fig12": lambda _: table("recsys-full"),
        "fig14": lambda _: "",
    }
    make = tables.get(experiment, comparison)
    if kind.encoders:
        make = encoder_table
    elif experiment in ANALYSES and experiment != "fig12":
        make = analysis_table
    parts = [f"### {kind.shows}", make(experiment)]
    if experiment == "fig12" and read(RESULTS / "fig12.csv"):
        parts.append(analysis_table("fig12"))
    parts.append(f"![{kind.shows.split(':')[0]}](results/{experiment}.png)")
    if experiment != "fig12":
        command = f"Command: `python benchmarks/paper.py {experiment}`"
        if make in (overview, comparison):  # most rows are of a part of it
            command += " makes all of it in full; the command of every row is in its CSV"
        parts.append(f"{command}.")
    return "\n\n".join(filter(None, parts))


def fill(text: str, experiment: str, readme: Path) -> str:
    """Text of a README with an experiment's table between its two markers, if it has them."""
    start, end = f"<!-- results:{experiment} -->", f"<!-- end:{experiment} -->"
    if start not in text:
        return text
    content = section(experiment)
    if readme.parent != ROOT:  # results/README.md: the pictures are beside it, headings go first
        content = content.replace("](results/", "](").replace("### ", "## ", 1)
    before, rest = text.split(start)
    return f"{before}{start}\n{content}{chr(10) if content else ''}{end}{rest.split(end)[1]}"


def main() -> None:
    """Draw everything there are results for, and write (or check) the tables of both READMEs."""
    global RESULTS
    for flag in (a for a in sys.argv[1:] if a.startswith("-") and a != "--check"):
        raise SystemExit(__doc__ if flag in ("-h", "--help") else f"error: unknown option {flag}")
    for folder in (a for a in sys.argv[1:] if not a.startswith("-")):
        RESULTS = Path(folder)
        if not RESULTS.is_dir():
            raise SystemExit(f"error: no folder {folder}")
        for experiment in paper.EXPERIMENTS:
            draw(experiment)
        return
    check = "--check" in sys.argv
    for experiment in paper.EXPERIMENTS:
        if not check:
            draw(experiment)
    for readme in (ROOT / "README.md", ROOT / "results/README.md"):
        text = new = readme.read_text()
        for experiment in paper.EXPERIMENTS:
            new = fill(new, experiment, readme)
        if check and new != text:
            name = readme.relative_to(ROOT)
            raise SystemExit(
                f"error: {name} disagrees with results/*.csv; run benchmarks/report.py"
            )
        if not check:
            readme.write_text(new)


if __name__ == "__main__":
    main()
