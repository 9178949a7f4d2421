"""Every figure and analysis of the appendix as a list of commands: print, run what is missing.

    python benchmarks/paper.py --dry-run all                  # every command and its hours
    python benchmarks/paper.py gridworld --jobs 2             # run them, two at a time
    python benchmarks/paper.py fig8 --budget 0.1 --seeds 0 1 2
    python benchmarks/paper.py gridworld --methods ours engineered
    python benchmarks/paper.py fig9 --environments gridworld

Three kinds of commands: hvae.py trains an encoder, ppo_actiongen.py trains a policy, and
`ppo_actiongen.py evaluate` tests a finished policy with other sets of actions. A run is named after
what it is, so figures that show the same run share it. What is finished is skipped, what was killed
goes on from its checkpoint. Scores are written after every command, each row with its command, and
benchmarks/report.py draws them:

    results/<environment>.csv, _curves.csv    runs and their learning curves (create: all tasks)
    results/<experiment>.csv                  evaluations (analyses, fig9, fig12), t-SNE (fig4-6)
    results/fig9_curves.csv                   scores during fine-tuning
    results/encoders.csv                      what the encoders' tables tell (fig4-6)
"""

import csv
import json
import shlex
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from threading import Lock

import numpy as np
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import hvae  # noqa: E402
import ppo_actiongen  # noqa: E402

# ---- every run: environment -> method -> command ----
# Names of methods as in results/published_results.csv, so that the tables join. `--budget` is a
# method's own factor on its number of steps; {method} stands for the folder of that run.

BASELINES = {  # the methods of every comparison (main paper, Figures 8 and 12)
    "ours": "",
    "non_hierarchical_vae": "--representation vae",
    "ours_no_entropy": "--ent-coef 0",
    "ours_no_subsampling": "--no-subsample",
    "nearest_neighbor": "--method nearest-neighbor",
    "continuous_output": "--method continuous",
}
ORACLE = {"oracle_encoder_all_actions": "--representation hvae-all"}
ENGINEERED = {"engineered": "--representation engineered"}
VARIANTS = {  # of CREATE
    "ours_video": "--modality video",
    "ours_no_subgoal_reward": "--no-subgoal-reward",  # C.3
    "ours_conditioned_auxiliary": "--aux-conditioned",  # C.4
    "ours_full_split": "--split full",  # Table 1
    # A.3: one policy and "an oracle encoder over the entire action set" for all three analyses
    "ours_analysis": "--split analysis --representation hvae-all",
}
ADAPT = {  # C.2: learn on the unseen actions themselves, all of them on offer
    "ours_from_scratch": "--adapt",
    "ours_finetuned": "--finetune {ours}",
    "discrete_from_scratch": "--method nearest-neighbor --adapt",
    "discrete_finetuned": "--method nearest-neighbor --finetune {nearest_neighbor}",
}
# Grid World's methods are compared with the paper's loss and exploration, and with networks half as
# wide as the fast recipe's, at half the cost; the hidden size is that of Table 4.
PLAIN = "--outcome-coef 0 --explore 0"
NARROW = f"gridworld --hidden-size 64 --utility-hidden 128 {PLAIN}"
LSTM = f"{NARROW} --hvae-recipe lstm"
# CREATE's methods are compared with pictures as the paper's policy sees them, and what goes with
# them. The fast recipe's, twice as fast, are a row of their own.
# NARROW_CREATE is the fast recipe with Table 4's width and D.3.2's position head, in small steps.
SMALL = "--hidden-size 64 --minibatch-size 256 --no-aux-conditioned --no-aux-residual"
NARROW_CREATE = f"{SMALL} --learning-rate 0.0003"
AS_IS = f"{SMALL} --shrink 1 --no-white-is-zero --no-norm-features --learning-rate 0.001"
AS_IS += " --micro-batch 128"
PICTURES = f"{AS_IS} --clip-coef 0.1"
MAIN_TASKS = "push obstacle seesaw".split()  # CREATE in the main paper
MORE_TASKS = "navigate cannon ladder belt buckets basket collide moving funnel".split()  # Figure 8


def commands(start: str, *methods: dict[str, str], end: str = "") -> dict[str, str]:
    """method -> command line: `start`, the method's flags, `end`."""
    flags = {name: text for group in methods for name, text in group.items()}
    return {name: " ".join(filter(None, [start, text, end])) for name, text in flags.items()}


RUNS: dict[str, dict[str, str]] = {
    # The paper's encoder is a Bi-LSTM (D.3.1): recipe lstm. Our encoders are rows of their own, so
    # that all the others differ from "ours" in one thing.
    "gridworld": {
        "ours": LSTM,
        "engineered": f"{NARROW} --representation engineered",
        "ours_alternate_modality": f"{NARROW} --modality onehot",
        "oracle_encoder_all_actions": f"{LSTM} --representation hvae-all",
        "non_hierarchical_vae": f"{LSTM} --representation vae",
        "ours_no_entropy": f"{LSTM} --ent-coef 0",
        # Each step costs several times the others', so a still narrower utility and fewer steps.
        "ours_no_subsampling": f"gridworld --hidden-size 64 --utility-hidden 64 {PLAIN} "
        "--hvae-recipe lstm --no-subsample --budget 0.2",
        "nearest_neighbor": f"{LSTM} --method nearest-neighbor",
        "continuous_output": f"{LSTM} --method continuous",
        # Beyond the paper: an MLP as encoder; the fast recipe with the paper's loss and exploring,
        # with ours in the loss, in both; the same with known features.
        "ours_mlp_encoder": f"{NARROW} --hvae-recipe mlp",
        "ours_wide": f"gridworld {PLAIN} --budget 0.4",
        "ours_outcome": "gridworld --explore 0 --budget 0.4",
        "ours_fast": "gridworld --budget 0.4",
        "engineered_fast": "gridworld --representation engineered --budget 0.4",
        # Tables 3 and 4 to the letter, all 40M steps; the encoder as above.
        "ours_paper_recipe": "gridworld --recipe paper --hvae-recipe lstm",
        # published code: 1e7 of 4e7 steps
        **commands(LSTM, ADAPT, end="--budget 0.25"),
    },
    # What each difference of the fast recipe is worth: the recipe, then one difference undone after
    # the other down to narrow networks; below, one more difference undone beside those.
    "gridworld-recipe": {
        "fast": "gridworld --representation engineered",
        "no_exploring": "gridworld --representation engineered --explore 0",
        "no_outcome": f"gridworld --representation engineered {PLAIN}",
        "narrow": f"{NARROW} --representation engineered",
        "numbers_not_one_hot": f"{NARROW} --representation engineered --no-one-hot",
        "minibatch_4096": f"{NARROW} --representation engineered --minibatch-size 4096",
        "train_with_50": f"{NARROW} --representation engineered --num-available 50",
        "not_standardized": f"{NARROW} --representation engineered --no-standardize",
        "entropy_constant": f"{NARROW} --representation engineered --ent-floor 1",
        "utility_width_64": f"gridworld --hidden-size 64 --utility-hidden 64 {PLAIN} "
        "--representation engineered",
        "gains_0.01": f"{NARROW} --representation engineered --utility-gains 0.01 0.01 0.01",
    },
    "create-recipe": {
        "narrow": f"create {NARROW_CREATE}",
        "pictures_as_is": f"create {PICTURES}",
        "conv_default": f"create {PICTURES} --conv-gain None",
        "value_coefficient_0.5": f"create {PICTURES} --vf-coef 0.5",
        "minibatch_3072": f"create {PICTURES} --minibatch-size 3072",
    },
    "recsys": {
        "ours": "recsys --utility mlp",
        "ours_no_entropy": "recsys --utility mlp --ent-coef 0",
        # Two thousand products in every step instead of a hundred: fewer steps.
        "ours_no_subsampling": "recsys --utility mlp --no-subsample --budget 0.2",
        "nearest_neighbor": "recsys --utility mlp --method nearest-neighbor",
        "continuous_output": "recsys --utility mlp --method continuous",
        "ours_bilinear": "recsys",  # beyond the paper, the fast recipe's default
        # As Grid World's fast recipe starts: a product of three small layers learns late.
        "ours_gains": "recsys --utility mlp --utility-gains 1 1.41421356 0.01",
    },
    "stacking": commands("stacking", BASELINES, ORACLE, ENGINEERED, ADAPT)
    | {
        "ours_no_place": "stacking --placement none",  # C.6
        "ours_2d_place": "stacking --placement 2d",
        "ours_full_split": "stacking --split full",  # Table 2
    },
}
RUNS["recsys-full"] = {
    method: f"{command} --fully-observable" for method, command in RUNS["recsys"].items()
}
# ours: two thousand products on offer in every step cost twenty times the usual hundred
RUNS["recsys"] |= commands("recsys --utility mlp", ADAPT, end="--budget 0.1")
# The fast recipe in a hurry: heads at Table 4's rate, a wide clip, less and less entropy. Figure
# 8's nine tasks have it, since they get few steps here: pictures as they are take twice as long.
EARLY = f"{SMALL} --learning-rate 0.001 --encoder-rate 0.3 --clip-coef 0.3 --standardize"
EARLY += " --ent-floor 0.1"
for task in MORE_TASKS:
    RUNS[f"create-{task}"] = commands(f"create --task {task} {EARLY}", BASELINES)
for task in MAIN_TASKS:
    start = f"create --task {task} {PICTURES}"
    RUNS[f"create-{task}"] = commands(start, BASELINES)
    RUNS[f"create-{task}"] |= commands(start, ORACLE, VARIANTS)
    # published code: 5e6 to 2e7 of 6e7 steps
    RUNS[f"create-{task}"] |= commands(start, ADAPT, end="--budget 0.25")
    # Beyond the paper: the fast recipe, and what its networks and its position head are worth.
    RUNS[f"create-{task}"]["ours_fast"] = f"create --task {task}"
    RUNS[f"create-{task}"]["ours_fast_64"] = f"create --task {task} --hidden-size 64"
    RUNS[f"create-{task}"]["ours_fast_plain"] = f"create --task {task} --no-aux-conditioned"
    small_steps = "--minibatch-size 256 --learning-rate 0.0005"  # as --quick
    RUNS[f"create-{task}"]["ours_fast_small"] = f"create --task {task} {small_steps}"
    RUNS[f"create-{task}"]["ours_narrow"] = f"create --task {task} {NARROW_CREATE}"
# Published for seesaw only.
RUNS["create-seesaw"] |= commands(f"create --task seesaw {PICTURES}", ENGINEERED)
# Beyond the paper: the loss of Grid World's fast recipe, scaled down because a goal is worth 10.
RUNS["create-push"]["ours_predicts"] = f"create --task push {PICTURES} --outcome-coef 0.05"
# A wider clip, so that each rare goal teaches more.
for task in ("push", "seesaw"):
    RUNS[f"create-{task}"]["ours_clip"] = f"create --task {task} {AS_IS} --clip-coef 0.3"
STEADY = "--aux-conditioned --aux-residual --table-noise 0.5"
MORE_ENTROPY = "--ent-coef 0.02 --ent-floor 0.05"
for task in MAIN_TASKS:
    RUNS[f"create-{task}"]["ours_early"] = f"create --task {task} {EARLY}"
    narrow = f"create --task {task} {NARROW_CREATE}"
    # C.4: a tool's place can be learned before the choice has narrowed.
    RUNS[f"create-{task}"]["ours_placed"] = f"{narrow} --aux-conditioned"
    # Beyond C.4: the tool corrects its place, and the policy never sees the same table twice.
    steady = f"{narrow} {STEADY}"
    RUNS[f"create-{task}"]["ours_steady"] = steady
    # ... with fewer tools on offer while learning, as Grid World's fast recipe.
    RUNS[f"create-{task}"]["ours_steady_20"] = f"{steady} --num-available 20 --eval-available 50"
    # ... or with four times the entropy bonus at first: the first kind of tool that works now and
    # then should not be the only one that is practised. (Push: all methods, below.)
    if task != "push":
        RUNS[f"create-{task}"]["ours_steady_entropy"] = f"{steady} {MORE_ENTROPY}"
    # As published, and as anyone runs it who only says --seed: other seeds of training, one split.
    RUNS[f"create-{task}"]["ours_one_split"] = f"{narrow} --split-seed 0"
    # The three analyses of a policy that gets further in the same steps.
    analysis = VARIANTS["ours_analysis"]
    RUNS[f"create-{task}"]["ours_analysis_narrow"] = f"{narrow} {analysis}"
# All methods in the recipe whose seeds agree, where a policy gets far enough to tell them apart.
# The two baselines without a utility have no correction by the tool, no table to add noise to.
DISCRETE = {m: BASELINES[m] for m in ("nearest_neighbor", "continuous_output")}
narrow = f"create --task push {NARROW_CREATE}"
RUNS["create-push-steady"] = commands(
    f"{narrow} {STEADY} {MORE_ENTROPY}", BASELINES, ORACLE, ENGINEERED
) | commands(f"{narrow} {MORE_ENTROPY}", DISCRETE)


# ---- every figure and analysis: the runs it shows, and what they are tested with ----


@dataclass(frozen=True)
class Experiment:
    """One figure, table or analysis of the paper."""

    shows: str
    """What it is; the report's heading."""
    runs: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Environment -> methods, keys of RUNS."""
    tests: tuple[str, ...] = ()
    """Options of `ppo_actiongen.py evaluate`; {pool} is the number of test actions."""
    tested: tuple[str, ...] = ()
    """Only these methods are tested so (default: all)."""
    encoders: dict[str, str] = field(default_factory=dict)
    """Panel of a t-SNE picture -> options of hvae.py, or "<environment> engineered"."""


# Methods that are not the paper's
BEYOND = {"ours_mlp_encoder", "ours_wide", "ours_outcome", "ours_bilinear", "ours_gains"}
BEYOND |= {"ours_paper_recipe"}  # the paper's, but with --recipe paper it is the same as "ours"
BEYOND |= {"ours_fast_64", "ours_fast_plain", "ours_fast_small", "ours_narrow"}
BEYOND |= {"ours_fast", "engineered_fast", "ours_early", "ours_predicts", "ours_clip"}
BEYOND |= {"ours_placed", "ours_steady", "ours_steady_20", "ours_steady_entropy"}
BEYOND |= {"ours_one_split", "ours_analysis_narrow"}


def methods_of(environment: str, *, beyond: bool = True) -> tuple[str, ...]:
    """The methods of an environment's main comparison: all but variants and adaptation."""
    omit = set(ADAPT) | set(VARIANTS) - {"ours_video"} | {"ours_no_place", "ours_2d_place"}
    omit |= {"ours_analysis_narrow"} if beyond else BEYOND
    return tuple(m for m in RUNS[environment] if m not in omit)


def main_tasks(*methods: str) -> dict[str, tuple[str, ...]]:
    """The same methods on the three CREATE tasks of the main paper."""
    return {f"create-{task}": methods for task in MAIN_TASKS}


RECIPES = ("gridworld-recipe", "create-recipe")
MAIN = ["gridworld", "recsys", *(f"create-{task}" for task in MAIN_TASKS), "stacking"]
MAIN.insert(3, "create-push-steady")  # where the methods get far enough to tell them apart
TITLES = {
    "gridworld": "Grid World",
    "gridworld-recipe": "Grid World: what each difference of the fast recipe is worth",
    "create-recipe": "CREATE push: what each difference of the narrow recipe is worth",
    "recsys": "Recommender, partially observable",
    "recsys-full": "Recommender, fully observable",
    **{f"create-{task}": f"CREATE {task}" for task in MAIN_TASKS + MORE_TASKS},
    "create-push-steady": "CREATE push, steadied recipe",
    "stacking": "Shape Stacking",
}
EVALUATE = "--actions test --episodes 5000"  # as the final test of every run
ANALYSIS = f"{EVALUATE} --num-available 50"  # Table 3

EXPERIMENTS: dict[str, Experiment] = {
    name: Experiment(TITLES[name], {name: methods_of(name)})
    for name in ("gridworld", *RECIPES, "recsys", "recsys-full", *MAIN[2:])
}
EXPERIMENTS |= {
    "table-main": Experiment(
        "Main results: all methods on all environments",
        {name: methods_of(name, beyond=False) for name in MAIN},
    ),
    "table-full-split": Experiment(
        "CREATE with tools of unseen classes (Table 1)", main_tasks("ours", "ours_full_split")
    ),
    "fig4": Experiment(
        "Figure 4: representations of unseen skills, Grid World",
        encoders={
            "(x, y) trajectories": "gridworld --recipe lstm",  # the three of the policies' tables
            "VAE": "gridworld --recipe lstm --no-hierarchical",
            "one-hot": "gridworld --modality onehot",
            "MLP encoder": "gridworld --recipe mlp",  # beyond the paper
            "linear path": "gridworld",  # beyond the paper, the default
            "engineered": "gridworld engineered",
        },
    ),
    "fig5": Experiment(
        "Figure 5: representations of unseen tools, CREATE",
        encoders={
            "(x, y) trajectories": "create",
            "VAE": "create --no-hierarchical",
            "video": "create --modality video",
            "Full Split": "create --split full",
        },
    ),
    "fig6": Experiment(
        "Figure 6: representations of unseen shapes, Shape Stacking",
        encoders={
            "viewpoints": "stacking",
            "VAE": "stacking --no-hierarchical",
            "Full Split": "stacking --split full",
        },
    ),
    "fig8": Experiment(
        "Figure 8: the other nine CREATE tasks",
        {f"create-{task}": tuple(BASELINES) for task in MORE_TASKS},
    ),
    "fig9": Experiment(
        "Figure 9: learning on the unseen actions instead of zero-shot",
        {
            name: ("ours", "nearest_neighbor", *ADAPT)
            for name in ("create-obstacle", "create-seesaw", "stacking", "gridworld", "recsys")
        },
        tests=("--actions test --episodes 5000 --num-available {pool}",),  # the zero-shot line
        tested=("ours",),
    ),
    "fig10": Experiment(
        "Figure 10: CREATE without subgoal rewards", main_tasks("ours", "ours_no_subgoal_reward")
    ),
    "fig11": Experiment(
        "Figure 11: the auxiliary policy also sees the chosen action",
        main_tasks("ours", "ours_conditioned_auxiliary"),
    ),
    "fig12": Experiment(
        "Figure 12: fully observable Recommender",
        {"recsys-full": methods_of("recsys-full")},
        # 500: Table 3; 25: published code in this variant; 50: its validation
        tests=tuple(f"{EVALUATE} --num-available {K}" for K in (25, 50, 500)),
    ),
    "fig13": Experiment(
        "Figure 13: Shape Stacking, where shapes are placed, and unseen classes (Table 2)",
        {"stacking": ("ours_no_place", "ours", "ours_2d_place", "ours_full_split")},
    ),
    "fig14": Experiment(
        "Figure 14: learning curves",
        {name: methods_of(name, beyond=False) for name in MAIN},
    ),
    "analysis-angle": Experiment(
        "Analysis: tools at least so many degrees from every training tool of their class",
        main_tasks("ours_analysis", "ours_analysis_narrow"),
        tests=tuple(f"{ANALYSIS} --min-angle-gap {gap}" for gap in (15, 12, 9, 6, 3)),
    ),
    # Published: absolute squared distances 0.5 .. 5, which depend on the scale of one encoder's
    # table. Here: quantiles of the unseen tools' squared distance to the nearest training tool.
    "analysis-embedding": Experiment(
        "Analysis: tools whose representation is far from those of all training tools",
        main_tasks("ours_analysis", "ours_analysis_narrow"),
        tests=tuple(f"{ANALYSIS} --min-embedding-distance q0.{q}" for q in range(10)),
    ),
    "analysis-unseen-ratio": Experiment(
        "Analysis: share of unseen tools among those on offer",
        main_tasks("ours_analysis", "ours_analysis_narrow"),
        tests=tuple(f"{ANALYSIS} --unseen-ratio {r / 5}" for r in range(6)),
    ),
    "analysis-set-size": Experiment(
        "Analysis: number of tools on offer",
        main_tasks("ours", "ours_no_entropy", "ours_no_subsampling", "ours_fast", "ours_narrow")
        | {"create-push-steady": ("ours", "ours_no_entropy", "ours_no_subsampling")},
        tests=tuple(  # 1,000 episodes: published code
            f"--actions test --episodes 1000 --num-available {K}" for K in range(10, 61, 5)
        ),
    ),
}

# ---- what things cost, for --dry-run ----

RATES = {  # environment steps per second of one run on one core: benchmarks/throughput.py
    "gridworld": 15_000,
    "recsys": 4_600,
    "create": 800,
    "stacking": 100,
}
SHRUNK_RATE = 1_100  # CREATE with the fast recipe's pictures
WIDE_RATE = 4_000  # Grid World with the fast recipe's networks, as measured by its runs
# Our policy with whole sets in every step: w/o sub-sampling 512 skills or 2,000 products, and to
# adapt 256 or 2,500. CREATE's and Stacking's bill is pictures and physics all the same.
WHOLE_RATES = {"gridworld": 4_000, "recsys": 1_400}
EPISODE = {"gridworld": 10, "recsys": 100, "create": 30, "stacking": 10}  # steps at most, Table 3
TEST_ACTIONS = {"gridworld": 256, "recsys": 2500, "create": 507, "stacking": 203}  # 2:1:1, A
# Recipe laptop, one core; last `seconds` of the CSV beside each table: 230 s Grid World (x, y) with
# recipes lstm and mlp (laptop: 35 s), 267 s one-hot, 192 s CREATE (x, y), 220 s pictures; videos:
# 415 s.
ENCODER_HOURS = {
    ("gridworld", "xy"): 0.06,
    ("gridworld", "onehot"): 0.07,
    ("create", "xy"): 0.06,
    ("create", "video"): 0.12,
    ("stacking", "image"): 0.07,
}

COLUMNS = (
    "env task method representation modality split seed steps phase score stderr episodes "
    "published hours command"
).split()
CURVE_COLUMNS = "env task method seed step train_score valid_score".split()
ADAPT_COLUMNS = "env task method seed steps step episode_score".split()
OPTIONS = (  # what an evaluation is known by
    "actions num_available min_angle_gap min_embedding_distance unseen_ratio greedy episodes"
).split()
TEST_COLUMNS = [*"env task method seed steps".split(), *OPTIONS]
TEST_COLUMNS += "pool_size score stderr return length command".split()
ENCODER_COLUMNS = "figure panel env score value engineered published minutes command".split()
POINT_COLUMNS = "panel action label x y".split()


@dataclass
class Args:
    """Run the experiments of the paper that have no result yet."""

    experiments: tyro.conf.Positional[tuple[str, ...]]
    """Names of experiments, or `all`."""
    methods: tuple[str, ...] = ()
    """Only these methods (default: all of the experiment)."""
    environments: tuple[str, ...] = ()
    """Only these environments, as in gridworld or create-push (default: all it shows)."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds; the same number seeds the random split of the actions."""
    budget: float = 1.0
    """Factor on each preset's number of environment steps; the rows name the steps really run."""
    recipe: str = "fast"
    """fast or paper, see ppo_actiongen.py."""
    hvae_recipe: str = "laptop"
    """laptop, quick, lstm, mlp or paper, see hvae.py."""
    extra: str = ""
    """Further flags for every training command, as in --extra="--eval-episodes 100"."""
    extra_encoder: str = ""
    """Further flags for every hvae.py command of fig4 to fig6."""
    extra_test: str = ""
    """Further flags for every evaluation."""
    jobs: int = 1
    """How many runs at a time, one thread each."""
    dry_run: bool = False
    """Only print the commands and their estimated hours."""
    rate: float | None = None
    """Environment steps per second of one run, instead of RATES."""
    runs_dir: str = "runs/paper"
    """Where the runs live."""
    results_dir: str | None = None
    """Where the tables go (default: results; of other recipes, results-<recipes>: their rows are
    not further seeds of the same thing)."""

    @property
    def results(self) -> Path:
        """The folder that `results_dir` says or leaves open."""
        recipes = self.recipe.replace("fast", ""), self.hvae_recipe.replace("laptop", "")
        return Path(self.results_dir or "-".join(["results", *filter(None, recipes)]))


# ---- from experiments to commands ----


@dataclass
class Encoder:
    """One table of representations: a command of hvae.py."""

    words: list[str]
    path: Path

    @property
    def key(self) -> Path:  # the same table by other words is the same table
        return self.path

    @property
    def command(self) -> str:
        return "python hvae.py " + shlex.join(self.words)

    @property
    def finished(self) -> bool:
        return self.path.exists()

    @property
    def hours(self) -> float:
        """Measured for the laptop recipe; another one's share of observations for the others."""
        wanted = tyro.cli(hvae.Args, args=self.words)
        usual = replace(
            hvae.Args(env=wanted.env, modality=wanted.modality, hierarchical=wanted.hierarchical),
            recipe="lstm" if wanted.recipe == "lstm" else "laptop",
        )
        seen = [observations_seen(options) for options in (wanted, usual)]
        known = ENCODER_HOURS.get((wanted.env, hvae.resolve(usual).modality), 0.06)
        return known * seen[0] / seen[1]


def observations_seen(options: hvae.Args) -> int:
    """How many observations an encoder's training reads, the same one counted each time."""
    options = hvae.resolve(options)
    module = hvae.load_environment(options.env)
    train = len(module.split_actions(options.split, options.split_seed)["train"])
    actions = min(options.batch_size, train)
    updates = options.updates or options.epochs * (train // actions)
    return updates * actions * options.batch_observations


@dataclass
class Run:
    """One policy: a command of ppo_actiongen.py."""

    env: str  # key of RUNS
    method: str
    seed: int
    words: list[str]
    steps: int
    folder: Path
    start: "Run | None" = None  # the run whose policy is fine-tuned
    rate: float = 1.0
    recipe: str = "fast"

    @property
    def key(self) -> Path:
        return self.folder

    @property
    def command(self) -> str:
        return "python ppo_actiongen.py " + shlex.join(self.words)

    @property
    def finished(self) -> bool:
        return (self.folder / "results.json").exists()

    @property
    def hours(self) -> float:
        """Training, and at most (episodes of full length) that for all evaluations."""
        run_args = args_of(self)
        episodes = 2 * run_args.valid_episodes * (self.steps // run_args.eval_every + 1)
        episodes += 3 * run_args.eval_episodes
        return (self.steps + episodes * EPISODE[run_args.env]) / self.rate / 3600


@dataclass
class Test:
    """One evaluation of a finished run."""

    experiment: str
    run: Run
    words: list[str]

    @property
    def command(self) -> str:
        return "python ppo_actiongen.py " + shlex.join(self.words)

    key = command

    def row(self) -> dict | None:
        """The row of the run's evaluations.csv with these options, if there is one."""
        path = self.run.folder / "evaluations.csv"
        flags = dict(zip(self.words[2:-1:2], self.words[3::2], strict=False))
        wanted = {key: flags.get("--" + key.replace("_", "-"), "") for key in OPTIONS}
        wanted |= {"greedy": "False", "seed": flags.get("--seed", "0")}
        for row in csv.DictReader(path.open()) if path.exists() else ():
            if all(equal(row[key], value) for key, value in wanted.items()):
                return row
        return None

    @property
    def finished(self) -> bool:
        return self.row() is not None

    @property
    def hours(self) -> float:
        episodes = int(self.words[self.words.index("--episodes") + 1])
        return episodes * EPISODE[self.run.words[0]] / self.run.rate / 3600


def equal(a: str, b: str) -> bool:
    """Equal as numbers (15 and 15.0), or else as text."""
    try:
        return float(a) == float(b)
    except ValueError:
        return a == b


def make_run(env: str, method: str, seed: int, args: Args) -> Run:
    """The run of this method; its folder is named after what it is, not after a figure."""
    words, budget = shlex.split(RUNS[env][method]), args.budget
    recipe = "paper" if "--recipe" in words else args.recipe
    if "--budget" in words:  # this method's own factor on top
        at = words.index("--budget")
        budget *= float(words[at + 1])
        del words[at : at + 2]
    if args.recipe == "paper":  # the widths are Table 4's
        for flag in {"--hidden-size", "--utility-hidden"} & set(words):
            at = words.index(flag)
            del words[at : at + 2]
    start = None
    for i, word in enumerate(words):
        if word.startswith("{"):
            start = make_run(env, word.strip("{}"), seed, args)
            words[i] = str(start.folder)
    steps = round(ppo_actiongen.default_args(words[0], recipe, False).total_timesteps * budget)
    # ours: every seed has its own split, so that the spread over seeds holds the luck
    # of the split too (published: one split; ours differ by 0.1 in difficulty).
    words += ["--seed", str(seed)]
    words += [] if "--split-seed" in words else ["--split-seed", str(seed)]
    words += ["--threads", "1"]
    words += ["--total-timesteps", str(steps), *shlex.split(args.extra)]
    if recipe != "fast" and "--recipe" not in words:
        words += ["--recipe", recipe]
    name = f"{env}-{method}-{recipe}-{steps}-s{seed}"
    if args.hvae_recipe != "laptop":  # the last one counts
        words += ["--hvae-recipe", args.hvae_recipe]
        name += f"-{args.hvae_recipe}"
    wide = words[0] == "gridworld" and "--hidden-size" not in words and recipe == "fast"
    rates = RATES | ({"gridworld": WIDE_RATE} if wide else {})
    rates |= {"create": SHRUNK_RATE} if "--shrink" not in words and recipe == "fast" else {}
    whole = {"--no-subsample", "--adapt", "--finetune"} & set(words) and "--method" not in words
    rate = args.rate or (rates | (WHOLE_RATES if whole else {}))[words[0]]
    folder = Path(args.runs_dir) / name
    return Run(env, method, seed, words, steps, folder, start, rate, recipe)


def make_test(experiment: str, run: Run, options: str, args: Args) -> Test:
    """The evaluation of a run with these options."""
    options = options.replace("{pool}", str(TEST_ACTIONS[run.words[0]]))
    flags = {}  # flag -> value; later ones win
    for text in (options, args.extra_test):
        words = shlex.split(text.replace("=", " "))
        if len(words) % 2:
            raise ValueError(f"--extra-test {text!r}: every option needs a value")
        flags |= dict(zip(words[::2], words[1::2], strict=True))
    words = [word for pair in flags.items() for word in pair]
    return Test(experiment, run, ["evaluate", str(run.folder), *words, "--save"])


def make_encoder(options: str, split_seed: int, args: Args, extra: str = "") -> Encoder:
    """The encoder of these options of hvae.py."""
    words = [*shlex.split(options), "--split-seed", str(split_seed), *shlex.split(extra)]
    if args.hvae_recipe != "laptop" and "--recipe" not in words:
        words += ["--recipe", args.hvae_recipe]
    words += ["--runs-dir", args.runs_dir]
    return Encoder(words, hvae.representation_path(tyro.cli(hvae.Args, args=words)))


def args_of(run: Run) -> ppo_actiongen.Args:
    """What ppo_actiongen.py makes of this run's command."""
    return parse(run.recipe, *run.words)


@cache  # 20 ms, and asked for several times
def parse(recipe: str, env: str, *words: str) -> ppo_actiongen.Args:
    """Args of the flags `words` on top of the recipe's."""
    preset = ppo_actiongen.default_args(env, recipe, False)
    run_args = tyro.cli(ppo_actiongen.Args, args=words, default=preset)
    return replace(run_args, adapt=run_args.adapt or run_args.finetune is not None)


def check_finished(run: Run) -> None:
    """Raise ValueError if the folder holds a run of another command: its scores are not ours."""
    if not run.finished:
        return
    saved = json.loads((run.folder / "args.json").read_text())
    for name, theirs, ours in ppo_actiongen.difference(args_of(run), saved):
        raise ValueError(
            f"{run.folder} was made with {name} {theirs!r}, this command has {ours!r}; "
            "remove the folder or take another --runs-dir"
        )


def encoder_of(run: Run, args: Args) -> Encoder | None:
    """The encoder whose table this run needs, as `load_table` of ppo_actiongen.py makes it."""
    run_args = args_of(run)
    if run_args.representation not in ("hvae", "hvae-all", "vae"):
        return None
    options = [run_args.env]
    if run_args.modality:
        options += ["--modality", run_args.modality]
    options += ["--no-hierarchical"] * (run_args.representation == "vae")
    options += ["--train-on", "all"] * (run_args.representation == "hvae-all")
    options += ["--split", run_args.split, "--seed", str(run_args.hvae_seed)]
    options += ["--recipe", run_args.hvae_recipe]
    return make_encoder(shlex.join(options), run_args.split_seed, args)


@dataclass
class Plan:
    """The commands of one experiment, in the order they can run in."""

    name: str
    panels: dict[str, Encoder | None]  # of a t-SNE picture; None: engineered
    encoders: list[Encoder]
    runs: list[Run]
    tests: list[Test]

    @property
    def everything(self) -> list:
        return [*self.encoders, *self.runs, *self.tests]


def plan(args: Args) -> list[Plan]:
    """What each of the chosen experiments consists of; ValueError for an unknown name."""
    of_all = [name for name in EXPERIMENTS if args.recipe == "fast" or name not in RECIPES]
    names = of_all if args.experiments == ("all",) else args.experiments
    if not args.seeds:
        raise ValueError("seeds: at least one is needed")
    plans = []
    for name in names:
        if name not in EXPERIMENTS:
            raise ValueError(f"experiment {name!r} is not one of {', '.join(EXPERIMENTS)}, all")
        e, runs, tests = EXPERIMENTS[name], {}, []
        known = list(dict.fromkeys(m for methods in e.runs.values() for m in methods))
        if args.recipe == "paper" and known:
            known = [m for m in known if m not in BEYOND and name not in RECIPES]
            if not known:
                raise ValueError(f"{name} is about the fast recipe; there is none for paper")
        for method in args.methods if known else ():
            if method not in known:
                raise ValueError(f"method {method!r} is not one of {', '.join(known)}")
        for env in args.environments if known else ():
            if env not in e.runs:
                raise ValueError(f"environment {env!r} is not one of {', '.join(e.runs)}")
        for seed in args.seeds:  # seed by seed, so that an interrupted matrix is still balanced
            for env, methods in e.runs.items():
                if args.environments and env not in args.environments:
                    continue
                for method in (m for m in methods if m in (args.methods or known)):
                    run = make_run(env, method, seed, args)
                    for each in filter(None, (run.start, run)):  # a fine-tuned run after its start
                        runs.setdefault(each.folder, each)
                    if method in (e.tested or known):
                        tests += [make_test(name, run, options, args) for options in e.tests]
        panels = {
            panel: None
            if options.endswith(" engineered")
            else make_encoder(options, args.seeds[0], args, args.extra_encoder)
            for panel, options in e.encoders.items()
        }
        needed = [*panels.values(), *(encoder_of(run, args) for run in runs.values())]
        encoders = {encoder.path: encoder for encoder in needed if encoder}
        plans.append(Plan(name, panels, list(encoders.values()), list(runs.values()), tests))
    return plans


# ---- from finished runs to tables ----


def identity(run: Run) -> dict:
    """The columns that say which run a row is of."""
    run_args = json.loads((run.folder / "args.json").read_text())
    same = {k: run_args[k] for k in ("task", "representation", "modality", "split", "seed")}
    return same | {"env": run.env, "method": run.method, "command": run.command}


def rows_of(run: Run) -> tuple[list[dict], list[dict]]:
    """The rows of results/<env>.csv and of its learning curve for one finished run."""
    results = json.loads((run.folder / "results.json").read_text())
    same = identity(run)
    scores = [
        same
        | {k: results[phase][k] for k in ("score", "stderr", "episodes")}
        | {"phase": phase, "published": results["published"].get(phase)}
        | {"steps": results["steps"], "hours": results["hours"]}
        for phase in ("train", "valid", "test")
        if phase in results  # adaptation has only the set it adapts to
    ]
    rows = csv.DictReader((run.folder / "metrics.csv").open())
    curve = [same | row for row in rows if row["valid_score"]]
    return scores, curve


def adaptation_of(run: Run, points: int = 100) -> list[dict]:
    """Score during adaptation, averaged over a hundredth of the run each (Figure 9)."""
    metrics = list(csv.DictReader((run.folder / "metrics.csv").open()))
    rows = []
    for part in np.array_split(metrics, min(points, len(metrics))):
        scores = [float(row["episode_score"]) for row in part if row["episode_score"]]
        if scores:  # no episode may have ended in so short a time
            rows.append({"step": part[-1]["step"], "episode_score": float(np.mean(scores))})
    steps = json.loads((run.folder / "results.json").read_text())["steps"]
    return [identity(run) | {"steps": steps} | row for row in rows]


def merge(path: Path, columns: list[str], rows: list[dict], key: tuple[str, ...]) -> None:
    """Replace the rows of the same key in a CSV by these, keep the rest; atomically."""

    def key_of(row):
        return tuple("" if row.get(k) is None else str(row[k]) for k in key)

    def cell(value):
        return f"{value:.6g}" if isinstance(value, float) else value

    old = list(csv.DictReader(path.open())) if path.exists() else []
    new_keys = {key_of(row) for row in rows}
    merged = [row for row in old if key_of(row) not in new_keys] + rows

    def write(temporary):
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
            writer.writeheader()
            writer.writerows({k: cell(row.get(k)) for k in columns} for row in merged)

    path.parent.mkdir(parents=True, exist_ok=True)
    ppo_actiongen.write_atomically(path, write)


def file_of(env: str) -> str:
    """All CREATE tasks share one file; the column env tells them apart."""
    return "create" if env.startswith("create-") else env


def collect_run(run: Run, results_dir: Path) -> None:
    """Write one finished run into the tables.

    A run made again otherwise (--extra) takes the place of the first: it is not one more seed.
    """
    scores, curve = rows_of(run)
    key = ("env", "method", "seed", "steps")
    merge(results_dir / f"{file_of(run.env)}.csv", COLUMNS, scores, key)
    if run.method in ADAPT:
        merge(results_dir / "fig9_curves.csv", ADAPT_COLUMNS, adaptation_of(run), key)
        return
    path, last = results_dir / f"{file_of(run.env)}_curves.csv", int(curve[-1]["step"])
    old = csv.DictReader(path.open()) if path.exists() else ()
    same = [r for r in old if all(r[k] == str(curve[0][k]) for k in key[:3])]
    if all(int(r["step"]) <= last for r in same):  # the longest run of a method is its curve
        merge(path, CURVE_COLUMNS, curve, key[:3])


def collect_test(test: Test, results_dir: Path) -> None:
    """Write one evaluation into the table of its experiment."""
    steps = json.loads((test.run.folder / "results.json").read_text())["steps"]
    row = test.row() | identity(test.run) | {"steps": steps, "command": test.command}
    key = ("env", "method", "seed", "steps", *(o for o in OPTIONS if o != "episodes"))
    merge(results_dir / f"{test.experiment}.csv", TEST_COLUMNS, [row], key)


def collect_panel(figure: str, panel: str, encoder: Encoder | None, args: Args) -> None:
    """Probe scores and t-SNE places of one table's held-out actions (Figures 4-6)."""
    env = EXPERIMENTS[figure].encoders[panel].split()[0]
    module = hvae.load_environment(env)
    same = {"figure": figure, "panel": panel, "env": env}
    if encoder:
        options = hvae.resolve(tyro.cli(hvae.Args, args=encoder.words))
        mean = hvae.load_representation(encoder.path, env, options.split, options.split_seed)[
            "mean"
        ]
        updates = list(csv.DictReader(encoder.path.with_suffix(".csv").open()))
        minutes = round(float(updates[-1]["seconds"]) / 60, 1)  # of training alone, by the clock
        same |= {"minutes": minutes, "command": encoder.command}
    else:
        options = hvae.resolve(hvae.Args(env=env, split_seed=args.seeds[0]))
        mean = np.asarray(module.engineered_representations(), np.float32)
        same["command"] = f"python benchmarks/paper.py {figure}"
    rows = [same | row for row in hvae.probe_rows(mean, options)]
    if not encoder:  # the published scores are of an encoder's table
        rows = [row | {"published": None} for row in rows]
    held_out, labels = hvae.held_out_labels(options)
    results_dir = args.results
    merge(results_dir / "encoders.csv", ENCODER_COLUMNS, rows, ("figure", "panel"))
    places = hvae.tsne(mean[held_out])  # (n, D) -> (n, 2)
    points = [
        {"panel": panel, "action": i, "label": label, "x": round(x, 1), "y": round(y, 1)}
        for i, label, (x, y) in zip(held_out.tolist(), labels, places.tolist(), strict=True)
    ]
    merge(results_dir / f"{figure}.csv", POINT_COLUMNS, points, ("panel",))


# ---- running ----


def call(script: str, words: list[str], log: Path) -> None:
    """Run one script of this repository, its output appended to a log."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        words = [sys.executable, str(ROOT / script), *words]
        subprocess.run(words, stdout=file, stderr=subprocess.STDOUT, check=False)


def finish(job, log: Path, score) -> bool:
    """Print a command with its score, or that it failed; True if there is a result."""
    text = f"{score():7.3f}" if job.finished else " FAILED"
    print(f"{text}  {job.command}" + ("" if job.finished else f"   (see {log})"), flush=True)
    return job.finished


def train_encoder(encoder: Encoder) -> bool:
    """Train one encoder unless its table is there."""
    log = encoder.path.with_suffix(".log")
    if encoder.finished:
        return True
    call("hvae.py", encoder.words, log)
    record = encoder.path.with_suffix(".json")  # its first probe score stands for the table
    return finish(
        encoder, log, lambda: next(iter(json.loads(record.read_text())["scores"].values()))
    )


def train_policy(run: Run, args: Args, lock: Lock) -> bool:
    """Train one policy unless it is finished, and write its scores into the tables."""
    log = run.folder.with_suffix(".log")
    if not run.finished:
        flags = ["--runs-dir", args.runs_dir, "--run-name", run.folder.name, "--resume"]
        call("ppo_actiongen.py", [*run.words, *flags, "--no-tensorboard"], log)
    with lock:
        if run.finished:
            collect_run(run, args.results)
        phase = "train" if run.method in ADAPT else "test"
        results = run.folder / "results.json"
        return finish(run, log, lambda: json.loads(results.read_text())[phase]["score"])


def test_policy(tests: list[Test], args: Args, lock: Lock) -> list[bool]:
    """The evaluations of one run, one after the other: they share its evaluations.csv."""
    done = []
    for test in tests:
        log = test.run.folder.with_suffix(".log")
        if not test.finished:
            call("ppo_actiongen.py", [*test.words], log)
        with lock:
            if test.finished:
                collect_test(test, args.results)
            done.append(finish(test, log, lambda t=test: float(t.row()["score"])))
    return done


def run_all(plans: list[Plan], args: Args) -> list[bool]:
    """Encoders, policies, fine-tuned policies, evaluations, pictures: each needs those before."""
    encoders = {e.path: e for p in plans for e in p.encoders}
    runs = {run.folder: run for p in plans for run in p.runs}
    for run in runs.values():
        check_finished(run)
    tests = defaultdict(list)
    for test in (test for p in plans for test in p.tests):
        tests[test.run.folder].append(test)
    lock = Lock()
    with ThreadPoolExecutor(args.jobs) as pool:
        done = list(pool.map(train_encoder, encoders.values()))
        for tuned in (False, True):
            stage = [run for run in runs.values() if bool(run.start) == tuned]
            stage.sort(key=lambda run: args.seeds.index(run.seed))
            done += pool.map(lambda run: train_policy(run, args, lock), stage)
        for some in pool.map(lambda group: test_policy(group, args, lock), tests.values()):
            done += some
    for p in plans:
        for panel, encoder in p.panels.items():
            if encoder is None or encoder.finished:
                collect_panel(p.name, panel, encoder, args)
    return done


def show(plans: list[Plan], args: Args) -> None:
    """--dry-run: every command, to be run as it is, with its hours on one core; shared ones under
    the first figure."""
    listed, left, count = set(), 0.0, 0
    for p in plans:
        new = [job for job in p.everything if job.key not in listed]
        listed |= {job.key for job in new}
        shared = len(p.everything) - len(new)
        print(f"\n{p.name}: {EXPERIMENTS[p.name].shows}")
        print(f"    {len(new)} commands" + (f", {shared} more are listed above" * bool(shared)))
        for job in new:
            command = job.command
            if isinstance(job, Run):
                command += f" --runs-dir {args.runs_dir} --run-name {job.folder.name}"
            print(f"{'done' if job.finished else f'{job.hours:.2f} h':>8}  {command}")
            left, count = left + (0 if job.finished else job.hours), count + (not job.finished)
    print(
        f"\n{count} of {len(listed)} to run, about {left:.1f} hours on one core, "
        f"{left / 2:.1f} on two (--jobs 2); steps per second: {RATES} (benchmarks/throughput.py)"
    )


def main() -> None:
    """Print or run the commands."""
    args = tyro.cli(Args)
    try:
        plans = plan(args)
        if args.dry_run:
            return show(plans, args)
        done = run_all(plans, args)
    except ValueError as e:
        raise SystemExit(f"error: {e}") from None
    if not all(done):
        raise SystemExit(f"error: {done.count(False)} of {len(done)} commands failed")


if __name__ == "__main__":
    main()
