"""Every figure and analysis of the appendix as commands: print them, or run what is missing.

    python benchmarks/paper.py all --dry-run               # every command, ready to be pasted
    python benchmarks/paper.py gridworld --jobs 2          # run them, two at a time
    python benchmarks/paper.py fig10 --only push --seeds 0 --budget 0.1
    python benchmarks/paper.py gridworld --recipe paper    # the policy of Tables 3 and 4

TABLE is the whole matrix: figure -> row -> command. A command's first word says what it is: an
environment (a training), `evaluate` (a test of a finished training) or `hvae` (an encoder). {row}
in a command is the folder, or the table, of another row, {figure/row} that of another figure's;
these come along. What is finished is not run again, what was stopped goes on from its checkpoint,
and rows of several figures that are the same run share it. Scores go to results/<figure>.csv, one
row per run and phase, learning curves to results/<figure>_curves.csv; with --recipe paper to
<figure>-paper.csv. benchmarks/report.py draws them.
"""

import csv
import io
import json
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import hvae  # noqa: E402
import ppo_actiongen as ppo  # noqa: E402
from hvae import UserError  # noqa: E402

# ---- which commands make which row ----

# Rows have the names of results/published_results.csv ("ours": HVAE + utility), which they join,
# and their method's own flags; --recipe paper is Tables 3 and 4 but for these.

CREATE = "create"  # how every training in CREATE begins; options for all of its rows stand here
TASKS = ("push", "seesaw", "obstacle")  # CREATE's in the main paper
NINE = "navigate cannon ladder belt buckets basket collide moving funnel".split()  # C.1

ABLATIONS = {
    "ours": "",
    "ours_no_entropy": "--ent-coef 0",
    "ours_no_subsampling": "--no-subsample",
    "nearest_neighbor": "--method nearest-neighbor",
    "continuous_output": "--method continuous",
}
FIGURE_8 = ABLATIONS | {"non_hierarchical_vae": "--representation vae"}
METHODS = FIGURE_8 | {"oracle_encoder_all_actions": "--representation hvae-all"}
# A.2 gives the representations: no encoder to compare. "ours": D.3.2's utility, Table 4's units.
RECSYS = {name: f"--no-bilinear --hidden-size 64 {flags}" for name, flags in ABLATIONS.items()}
RECSYS["ours_bilinear"] = "--bilinear"
ENGINEERED = {"engineered": "--representation engineered"}
# [code] learned CREATE's tables from six numbers, which are the default; appendix: (x, y).
INPUTS = {"ours_video": "--modality video", "ours_xy": "--modality xy"}
ONE_HOT = {"ours_alternate_modality": "--modality onehot"}
OPTIONS = {"ours_one_pass": "--head-epochs 0"}  # what they are worth [here]
OPTIONS["ours_small_steps"] = "--learning-rate 2.5e-4 --ent-coef 0.005"  # bonus of Table 3
FULL_SPLIT = {"ours_full_split": "--split full"}  # Tables 1 and 2
LINEAR = {"ours_linear_path": "--linear-path"}  # [here] of encoders
SUBGOAL = {"ours": "", "ours_no_subgoal_reward": "--no-subgoal-reward"}  # C.3
# C.4. Both in full: the recipes differ in which of them is the default.
AUXILIARY = {"ours": "--no-aux-conditioned", "ours_conditioned_auxiliary": "--aux-conditioned"}
PLACEMENT = {"ours_no_place": "--placement none", "ours": "", "ours_2d_place": "--placement 2d"}
# A.3: "HVAE was trained as an oracle encoder over the entire action set"; one policy for all.
ANALYSIS = {"ours": "--split analysis --representation hvae-all"}
TEST = "evaluate {analysis/TASK/ours} --num-available 50"  # K of Table 3
ENCODERS = {"ours": "", "non_hierarchical_vae": "--no-hierarchical"}


def rows(command: str, methods: dict[str, str], tasks=("",)) -> dict[str, str]:
    """[task/]method -> `command` with the method's flags; TASK in it becomes the task."""
    return {
        f"{task}/{name}".strip("/"): f"{command} {flags}".replace("TASK", task).strip()
        for task in tasks
        for name, flags in methods.items()
    }


def vary(flag: str, *values) -> dict[str, str]:
    """One test per value of an option of `evaluate`; report.py reads the value from the name."""
    return {f"{flag}={value}": f"--{flag} {value}" for value in values}


TABLE = {
    "quick": {  # the README's first commands
        "gridworld/ours": "gridworld --quick",
        "recsys/ours_bilinear": "recsys --quick --bilinear",
        "create/ours": f"{CREATE} --quick",
        "stacking/ours": "stacking --quick",
    },
    "gridworld": rows("gridworld", METHODS | ENGINEERED | ONE_HOT)
    | {"ours_linear_path": "gridworld --representation {fig4/ours_linear_path}"},
    "recsys": rows("recsys", RECSYS),
    "create-push": rows(f"{CREATE} --task push", METHODS | INPUTS | ENGINEERED | OPTIONS),
    "create-seesaw": rows(f"{CREATE} --task seesaw", METHODS | INPUTS | ENGINEERED | OPTIONS),
    "create-obstacle": rows(f"{CREATE} --task obstacle", METHODS | INPUTS | OPTIONS),
    "stacking": rows("stacking", METHODS | ENGINEERED),
    "fig4": rows("hvae gridworld", ENCODERS | ONE_HOT | LINEAR),
    "fig5": rows("hvae create", ENCODERS | INPUTS | FULL_SPLIT),
    "fig6": rows("hvae stacking", ENCODERS | FULL_SPLIT),
    "fig8": rows(f"{CREATE} --task TASK", FIGURE_8, NINE),
    "fig9": {},  # below
    "fig10": rows(f"{CREATE} --task TASK", SUBGOAL, TASKS),
    "fig11": rows(f"{CREATE} --task TASK", AUXILIARY, TASKS),
    # C.5. Runs are tested with 500 products available (Table 3); [code] with 25.
    "fig12": rows("recsys --fully-observable", RECSYS)
    | rows("evaluate {ours}", vary("num-available", 25)),
    "fig13": rows("stacking", PLACEMENT | FULL_SPLIT),  # C.6
    "table1": rows(f"{CREATE} --task TASK", {"ours": ""} | FULL_SPLIT, TASKS),
    "analysis": rows(f"{CREATE} --task TASK", ANALYSIS, TASKS),
    "analysis-angle": rows(TEST, vary("min-angle-gap", 15, 12, 9, 6, 3), TASKS),
    # Published: squared distances in one encoder's table. [here] the share of too near ones.
    "analysis-embedding": rows(
        TEST, vary("min-embedding-distance", *(f"0.{q}" for q in range(10))), TASKS
    ),
    # Published ratios: up to 0.8; and of unseen tools only those above a distance of 3, the sixth
    # of the ten distances above.
    "analysis-unseen-ratio": rows(
        f"{TEST} --min-embedding-distance 0.5",
        vary("unseen-ratio", 0.0, 0.2, 0.4, 0.6, 0.8, 1.0),
        TASKS,
    ),
    "analysis-set-size": {},  # below
}
for method in ("ours", "ours_no_entropy", "ours_no_subsampling"):
    test = f"evaluate {{create-TASK/{method}}} --episodes 1000"  # [code]
    tests = rows(test, vary("num-available", *range(10, 61, 5)), TASKS[:2])
    TABLE["analysis-set-size"] |= {f"{method}/{row}": command for row, command in tests.items()}
# C.2. Zero-shot is tested as the others learn: with all unseen actions available at once. [code]
# 500 products in the Recommender's zero-shot test; [here] the 2,000 that its policies adapt to.
WHOLE = {"create-obstacle": 507, "create-seesaw": 507, "stacking": 203, "gridworld": 256}
for name, size in (WHOLE | {"recsys": 2000}).items():
    TABLE["fig9"][f"{name}/zero-shot"] = f"evaluate {{{name}/ours}} --num-available {size}"
    for theirs, method in (("ours", "ours"), ("discrete", "nearest_neighbor")):
        train = TABLE[name][method]
        TABLE["fig9"][f"{name}/{theirs}_from_scratch"] = f"{train} --adapt"
        TABLE["fig9"][f"{name}/{theirs}_finetuned"] = f"{train} --finetune {{{name}/{method}}}"


@dataclass(frozen=True)
class Args:
    figures: tyro.conf.Positional[tuple[str, ...]]  # names in TABLE, or all
    only: tuple[str, ...] = ()  # rows: their names, or what stands between slashes in them
    seeds: tuple[int, ...] = (0, 1, 2)  # published: 5 seeds, 8 in Grid World
    recipe: Literal["fast", "paper"] = "fast"  # of policies; paper: of Figures 4-6's encoders, too
    budget: float = 1.0  # factor on the recipe's number of environment steps
    jobs: int = 1  # commands at a time; 0: only write the scores of what is finished
    dry_run: bool = False  # only print the commands
    runs_dir: str = "runs"  # where the runs live, from the repository's root
    results_dir: str = "results"  # where the tables go


@dataclass(eq=False)  # a job equals itself only
class Job:
    """One row of TABLE for one seed."""

    figure: str
    row: str
    seed: int
    kind: str  # train, evaluate or hvae
    command: str
    args: ppo.Args | ppo.EvaluateArgs | hvae.Args  # as the script reads the command
    folder: Path  # of the run; of an encoder: its table
    needs: "list[Job]"  # all that has to be there before; of a test, the run comes last


@cache  # what several rows need is one job
def expand(figure: str, row: str, seed: int, args: Args) -> Job:
    """The job of one row and seed."""
    kind, *words = shlex.split(TABLE[figure][row])
    needs = []
    for i, word in enumerate(words):
        if word.startswith("{"):
            name = word.strip("{}")
            where = (figure, name) if name in TABLE[figure] else name.split("/", 1)
            parent = expand(*where, seed, replace(args, recipe="fast") if "fig4" in where else args)
            needs += [*parent.needs, parent]
            words[i] = parent.folder.as_posix()
    if kind == "evaluate":
        words.append("--save")
        command = f"python ppo_actiongen.py evaluate {shlex.join(words)}"
        test = tyro.cli(ppo.EvaluateArgs, args=words)
        return Job(figure, row, seed, kind, command, test, parent.folder, needs)

    if kind != "hvae":  # one encoder seed for all policies, as published
        words = [kind, *words, "--seed", str(seed)]
    if words[0] in ("gridworld", "recsys"):
        # [here] Where the split is random, every seed has its own, so that the spread over seeds
        # holds the luck of the split. CREATE and Stacking: one split for all seeds, as published.
        words += ["--split-seed", str(seed)]
    if args.recipe == "paper":
        words += ["--recipe", "paper"]
    if args.runs_dir != "runs":
        words += ["--runs-dir", args.runs_dir]
    if kind == "hvae":
        command = f"python hvae.py {shlex.join(words)}"
        encoder = hvae.parse_args(words)
        table = hvae.representation_path(encoder)
        return Job(figure, row, encoder.split_seed, kind, command, encoder, table, needs)

    training = ppo.parse_args(words)
    if args.budget != 1:
        training.total_timesteps = round(args.budget * training.total_timesteps)
        words += ["--total-timesteps", str(training.total_timesteps)]
    command = f"python ppo_actiongen.py {shlex.join(words)}"
    folder = Path(args.runs_dir) / ppo.run_name_of(training)
    return Job(figure, row, seed, "train", command, training, folder, needs)


def plan(args: Args) -> list[Job]:
    """The jobs of these figures, each after what it needs; UserError for what cannot be meant."""
    for figure in args.figures or [""]:
        hvae.choose("figure", figure, [*TABLE, "all"])
    figures = TABLE if "all" in args.figures else args.figures
    names = {(f, row): {row, *row.split("/")} for f in figures for row in TABLE[f]}
    for name in args.only:
        hvae.choose("row", name, sorted(set().union(*names.values())))
    if not args.seeds or not args.budget > 0 or args.jobs < 0:
        raise UserError("at least one seed, a budget above 0, and no negative jobs are needed")
    chosen = [where for where, words in names.items() if not args.only or words & {*args.only}]
    # Seed by seed, so that an interrupted matrix is balanced.
    jobs = [expand(*where, seed, args) for seed in args.seeds for where in chosen]
    jobs = [one for job in jobs for one in (*job.needs, job)]
    return list({(job.figure, job.row, job.command): job for job in jobs}.values())  # each once


# ---- what a finished command has left behind ----

KEY = "env task method seed split split_seed recipe steps phase".split()
COLUMNS = KEY + "score stderr episodes pool_size hours machine command".split()
CURVE_KEY = "env task method seed split recipe steps step".split()
CURVES = CURVE_KEY + "train_score valid_score episode_score".split()
# What a test is asked, and its answer: columns of evaluations.csv.
QUESTION = "actions num_available min_angle_gap min_embedding_distance unseen_ratio episodes"
ANSWER = ("score", "stderr", "episodes", "pool_size")


def read(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file, [] if there is none."""
    if not path.exists():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@cache
def machine() -> str:
    """The processor: hours mean little without it. All scripts use one thread."""
    cpu = Path("/proc/cpuinfo")  # Linux
    names = re.findall("model name.*: (.+)", cpu.read_text("utf-8")) if cpu.exists() else []
    return f"{names[0] if names else platform.processor()}, 1 thread(s)"


def score_rows(job: Job) -> list[dict]:
    """The rows of results/<figure>.csv for one job, [] if it is not finished.

    UserError if the folder holds another command's run: its scores are not this row's.
    """
    run = job.needs[-1] if job.kind == "evaluate" else job
    row = {name: getattr(run.args, name) for name in ("env", "split", "split_seed", "recipe")}
    row.update(task=getattr(run.args, "task", None) or "", method=run.row.split("/")[-1])
    row.update(seed=job.seed, machine=machine(), command=job.command)
    if getattr(run.args, "fully_observable", False):
        row["env"] = "recsys_full"
    if row["method"] == "ours" and getattr(run.args, "aux_conditioned", False):
        row["method"] = "ours_conditioned_auxiliary"  # C.4: with CREATE's fast recipe, too

    if job.kind == "hvae":
        path = job.folder.with_suffix(".json")
        scores = json.loads(path.read_text("utf-8")) if path.exists() else {}
        return [row | {"phase": name, "score": score} for name, score in scores.items()]

    path = run.folder / "results.json"  # what a training writes at its end
    if not path.exists():
        return []
    trained = json.loads(path.read_text("utf-8"))
    made = json.loads(path.with_name("args.json").read_text("utf-8"))
    for name, wanted in vars(run.args).items():
        if name not in ppo.FREE and made.get(name, "missing") != wanted:
            raise UserError(f"{run.folder} holds a run with another {name}: move it away")
    row["steps"] = trained["steps"]
    if job.kind == "evaluate":  # of the checkpoint that the run has now; the last answer counts
        asked = {name: getattr(job.args, name) for name in QUESTION.split()}
        asked["best_step"] = trained["best_step"]
        wanted = {name: "" if x is None else str(x) for name, x in asked.items()}
        answers = read(job.folder / "evaluations.csv")
        answers = [answer for answer in answers if wanted.items() <= answer.items()]
        row["phase"] = job.row.split("/")[-1]
        return [row | {name: float(answer[name]) for name in ANSWER} for answer in answers[-1:]]
    row["hours"] = trained["hours"]
    # A policy that adapts has one set of actions, and one phase.
    phases = [phase for phase in ("train", "valid", "test") if phase in trained]
    return [row | trained[phase] | {"phase": phase} for phase in phases]


def curve_rows(job: Job) -> list[dict]:
    """A training's learning curve: at most 50 points, not held at their maximum."""
    # A policy that adapts is trained on what it is tested on: its own episodes are the curve.
    names = ["episode_score"] if job.args.adapt else ["train_score", "valid_score"]
    points = [point for point in read(job.folder / "metrics.csv") if point[names[0]]]
    every = len(points) // 50 + 1
    points = points[::-every][::-1]  # with the last one
    row = {name: value for name, value in score_rows(job)[0].items() if name in CURVES}
    return [row | {name: point[name] for name in ("step", *names)} for point in points]


def merge(path: Path, columns: list[str], key: list[str], rows: list[dict]) -> None:
    """Put rows into a CSV file, in the place of those of the same key; never half a file."""
    table = {}
    for row in [*read(path), *rows]:
        short = {k: f"{x:.6g}" if isinstance(x, float) else str(x) for k, x in row.items()}
        line = {column: short.get(column, "") for column in columns}
        place = [line[column] for column in key]
        table[tuple(x.zfill(9) if x.isdigit() else x for x in place)] = line  # 9 before 10
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(table[place] for place in sorted(table))
    hvae.write(path, lambda file: file.write(text.getvalue().encode("utf-8")))


# ---- running what is missing ----


def start(job: Job) -> subprocess.Popen:
    """Start a job's command; a training goes on if it has a checkpoint."""
    words = shlex.split(job.command)[1:]
    if job.kind == "train" and (job.folder / "checkpoint.pt").exists():
        words.append("--resume")
    job.folder.parent.mkdir(parents=True, exist_ok=True)
    with open(f"{job.folder}.log", "ab") as log:
        # A process group of its own (not on Windows), so that all of it can be stopped.
        output = dict(stdout=log, stderr=log, process_group=0)
        return subprocess.Popen([sys.executable, *words], **output)


def record(job: Job, args: Args) -> bool:
    """Write a job's scores into the tables; whether there are any."""
    found = score_rows(job)
    if not found:
        print(f"  FAILED  {job.command}  (see {job.folder}.log)", flush=True)
        return False
    name = job.figure + ("-paper" if getattr(job.args, "recipe", args.recipe) == "paper" else "")
    results = Path(args.results_dir)
    merge(results / f"{name}.csv", COLUMNS, KEY, found)
    picture = job.folder.with_name(f"{job.folder.stem}-tsne.png")
    if job.kind == "hvae" and picture.exists():
        shutil.copy(picture, results / f"{name}-tsne-{job.row}.png")
    if job.kind == "train":
        merge(results / f"{name}_curves.csv", CURVES, CURVE_KEY, curve_rows(job))
    print(f"{found[-1]['score']:8.3f}  {job.command}", flush=True)
    return True


def run_all(jobs: list[Job], args: Args) -> int:
    """Run what has no result, `args.jobs` at a time; the number of jobs without a result."""
    waiting = list(jobs)
    running: dict[subprocess.Popen, Job] = {}
    succeeded: dict[str, bool] = {}  # by command: jobs of several figures may share one
    try:
        while waiting or running:
            for process, job in list(running.items()):
                if process.poll() is not None:
                    del running[process]
                    succeeded[job.command] = record(job, args)
            for job in list(waiting):
                needed = [succeeded.get(need.command) for need in job.needs]
                busy = [other.folder for other in running.values()]
                if len(running) == max(1, args.jobs):
                    break
                if None in needed or job.folder in busy:  # one process in a folder
                    continue
                waiting.remove(job)
                if False in needed or succeeded.get(job.command) is False:
                    print(f"  SKIPPED {job.command}", flush=True)
                    succeeded[job.command] = False
                elif score_rows(job):
                    succeeded[job.command] = record(job, args)
                else:
                    running[start(job)] = job
            time.sleep(0.2)
    finally:  # Ctrl-C, SIGTERM, or an error of ours: nothing goes on without us
        for process in running:
            if process.poll() is None:  # as Ctrl-C would, so that it tidies up
                process.terminate() if os.name == "nt" else os.killpg(process.pid, signal.SIGINT)
        for process in running:
            process.wait()
    return sum(not succeeded[job.command] for job in jobs)


def main(args: Args) -> None:
    """Print or run the commands."""
    os.chdir(ROOT)  # the paths of all commands start here
    jobs = plan(args)
    if args.dry_run:
        print("\n".join(dict.fromkeys(job.command for job in jobs)))
        return
    # Now, because a folder of another run is an error.
    finished = [job for job in jobs if all(map(score_rows, [*job.needs, job]))]
    print(f"{len(jobs) - len(finished)} of {len(jobs)} commands to run", flush=True)
    failures = run_all(jobs if args.jobs else finished, args)
    if failures:
        raise SystemExit(f"error: {failures} of {len(jobs)} commands have no result")


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # also where a shell switched Ctrl-C off
        signal.signal(number, signal.default_int_handler)
    try:
        main(tyro.cli(Args, description=__doc__))
    except UserError as e:
        raise SystemExit(f"error: {e}") from None
    except KeyboardInterrupt:
        raise SystemExit("stopped: the same command goes on") from None
