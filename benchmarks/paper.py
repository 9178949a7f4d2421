"""Every figure and analysis of the appendix as commands: print them, or run what is missing.

    python benchmarks/paper.py all --dry-run               # every command, ready to be pasted
    python benchmarks/paper.py gridworld --jobs 2          # run them, two at a time
    python benchmarks/paper.py fig10 --only push --seeds 0 --budget 0.1
    python benchmarks/paper.py gridworld --recipe paper    # the policy of Tables 3 and 4

TABLE is the whole matrix: figure -> row -> command. A command's first word says what it is: an
environment (a training), `evaluate` (a test of a finished training) or `hvae` (an encoder). {row}
in a command is the folder of another row, {figure/row} that of another figure's; these come along.
What is finished is not run again, what was killed goes on from its checkpoint, and rows of several
figures that are the same run share it. Scores go to results/<figure>.csv, one row per run and
phase, learning curves to results/<figure>_curves.csv; with --recipe paper to <figure>-paper.csv,
since two recipes never share a table. benchmarks/report.py draws them.
"""

import csv
import io
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Literal

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import hvae  # noqa: E402
import ppo_actiongen  # noqa: E402

# Rows have the names of results/published_results.csv, so that ours and published scores join. They
# hold their method's own flags and nothing else: --recipe paper is Tables 3 and 4 but for these.

FIGURE_8 = {  # the baselines and ablations of the main paper
    "ours": "",
    "non_hierarchical_vae": "--representation vae",
    "ours_no_entropy": "--ent-coef 0",
    "ours_no_subsampling": "--no-subsample",
    "nearest_neighbor": "--method nearest-neighbor",
    "continuous_output": "--method continuous",
}
METHODS = FIGURE_8 | {"oracle_encoder_all_actions": "--representation hvae-all"}
ENGINEERED = {"engineered": "--representation engineered"}
VIDEO = {"ours_video": "--modality video"}
ONE_HOT = {"ours_alternate_modality": "--modality onehot"}
MORE_ENTROPY = {"ours_more_entropy": "--ent-coef 0.02"}  # beyond the paper: Table 3 has 0.005
FULL_SPLIT = {"ours_full_split": "--split full"}  # Tables 1 and 2
RECSYS = {  # A.2 gives the representations, so there is no encoder to compare
    "ours": "--no-bilinear --hidden-size 64",  # D.3.2's utility, Table 4's units
    "ours_bilinear": "--bilinear",  # beyond the paper; the fast recipe's default
    "ours_no_entropy": "--no-bilinear --hidden-size 64 --ent-coef 0",
    "ours_no_subsampling": "--no-bilinear --hidden-size 64 --no-subsample",
    "nearest_neighbor": "--method nearest-neighbor --hidden-size 64",
    "continuous_output": "--method continuous --hidden-size 64",
}
SUBGOAL = {"ours": "", "ours_no_subgoal_reward": "--no-subgoal-reward"}  # C.3
# C.4. Both in full: the recipes differ in which of them is the default.
AUXILIARY = {"ours": "--no-aux-conditioned", "ours_conditioned_auxiliary": "--aux-conditioned"}
PLACEMENT = {"ours_no_place": "--placement none", "ours": "", "ours_2d_place": "--placement 2d"}
# A.3: "HVAE was trained as an oracle encoder over the entire action set"; one policy for all.
ANALYSIS = {"ours": "--split analysis --representation hvae-all"}
TEST = "evaluate {analysis/TASK/ours} --num-available 50"  # K of Table 3
ENCODERS = {"ours": "", "non_hierarchical_vae": "--no-hierarchical"}
CREATE = "push seesaw obstacle".split()  # in the main paper
NINE = "navigate cannon ladder belt buckets basket collide moving funnel".split()  # C.1


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
        "gridworld/engineered": "gridworld --quick --representation engineered",
        "recsys/ours_bilinear": "recsys --quick --bilinear",
        "create/ours": "create --quick",
        "stacking/ours": "stacking --quick",
    },
    "gridworld": rows("gridworld", METHODS | ENGINEERED | ONE_HOT),
    "recsys": rows("recsys", RECSYS),
    "create-push": rows("create --task push", METHODS | VIDEO | MORE_ENTROPY),
    "create-seesaw": rows("create --task seesaw", METHODS | VIDEO | ENGINEERED | MORE_ENTROPY),
    "create-obstacle": rows("create --task obstacle", METHODS | VIDEO | MORE_ENTROPY),
    "stacking": rows("stacking", METHODS | ENGINEERED),
    "fig4": rows("hvae gridworld", ENCODERS | ONE_HOT),
    "fig5": rows("hvae create", ENCODERS | VIDEO | FULL_SPLIT),
    "fig6": rows("hvae stacking", ENCODERS | FULL_SPLIT),
    "fig8": rows("create --task TASK", FIGURE_8, NINE),
    "fig9": {},  # below
    "fig10": rows("create --task TASK", SUBGOAL, CREATE),
    "fig11": rows("create --task TASK", AUXILIARY, CREATE),
    # C.5. Runs are tested with 500 products on offer (Table 3); published code: with 25.
    "fig12": rows("recsys --fully-observable", RECSYS)
    | rows("evaluate {ours}", vary("num-available", 25)),
    "fig13": rows("stacking", PLACEMENT | FULL_SPLIT),  # C.6
    "table1": rows("create --task TASK", {"ours": ""} | FULL_SPLIT, CREATE),
    "analysis": rows("create --task TASK", ANALYSIS, CREATE),
    "analysis-angle": rows(TEST, vary("min-angle-gap", 15, 12, 9, 6, 3), CREATE),
    # Published: squared distances 0.5 .. 5, which depend on the scale of one encoder's table. Ours:
    # quantiles of the unseen tools' squared distance to the nearest training tool.
    "analysis-embedding": rows(
        TEST, vary("min-embedding-distance", *(f"q0.{q}" for q in range(10))), CREATE
    ),  # published ratios: up to 0.8
    "analysis-unseen-ratio": rows(TEST, vary("unseen-ratio", *(r / 5 for r in range(6))), CREATE),
    "analysis-set-size": {},  # below
}
for method in ("ours", "ours_no_entropy", "ours_no_subsampling"):
    start = f"evaluate {{create-TASK/{method}}} --episodes 1000"  # published code: 1,000
    tests = rows(start, vary("num-available", *range(10, 61, 5)), ("push", "seesaw"))
    TABLE["analysis-set-size"] |= {f"{method}/{row}": command for row, command in tests.items()}
# C.2. Zero-shot is tested as the others learn: with all unseen actions on offer at once. Published
# code: 500 products in the Recommender's zero-shot test; we take the 2,000 that ours adapts to.
WHOLE = {"create-obstacle": 507, "create-seesaw": 507, "stacking": 203, "gridworld": 256}
for name, size in (WHOLE | {"recsys": 2000}).items():
    ours, discrete = TABLE[name]["ours"], TABLE[name]["nearest_neighbor"]
    TABLE["fig9"] |= {
        f"{name}/zero-shot": f"evaluate {{{name}/ours}} --num-available {size}",
        f"{name}/ours_from_scratch": f"{ours} --adapt",
        f"{name}/ours_finetuned": f"{ours} --finetune {{{name}/ours}}",
        f"{name}/discrete_from_scratch": f"{discrete} --adapt",
        f"{name}/discrete_finetuned": f"{discrete} --finetune {{{name}/nearest_neighbor}}",
    }


@dataclass(frozen=True)
class Args:
    """Run the commands of these figures that have no result yet."""

    figures: tyro.conf.Positional[tuple[str, ...]]  # names in TABLE, or all
    only: tuple[str, ...] = ()  # rows: their names, or what stands between slashes in them
    seeds: tuple[int, ...] = (0, 1, 2)  # published: 5 seeds, 8 in Grid World
    recipe: Literal["fast", "paper"] = "fast"  # of policies; paper: of Figures 4-6's encoders, too
    budget: float = 1.0  # factor on the recipe's number of environment steps
    extra: str = ""  # flags for each training, as --extra="--ent-coef 0.02"; rows keep their names
    jobs: int = 1  # commands at a time
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
    words: list[str]  # of its command line
    args: ppo_actiongen.Args | ppo_actiongen.EvaluateArgs | hvae.Args  # as the script reads them
    folder: Path  # of the run; of an encoder: its table
    needs: "list[Job]"  # what it starts from

    @property
    def command(self) -> str:
        script = "hvae.py" if self.kind == "hvae" else "ppo_actiongen.py"
        return f"python {script} {shlex.join(self.words)}"


def parse(words: list[str]) -> ppo_actiongen.Args:
    """The options of a training, as the script reads them: the first three decide the defaults."""
    first = tyro.cli(ppo_actiongen.Args, args=words)
    default = ppo_actiongen.default_args(first.env, first.recipe, first.quick)
    return tyro.cli(ppo_actiongen.Args, args=words, default=default)


@cache  # what several rows need is one job
def expand(figure: str, row: str, seed: int, args: Args) -> Job:
    """The job of one row and seed."""
    (kind, *words), needs = shlex.split(TABLE[figure][row]), []
    for i, word in enumerate(words):
        if word.startswith("{"):
            name = word.strip("{}")
            where = (figure, name) if name in TABLE[figure] else name.split("/", 1)
            needs.append(expand(*where, seed, args))
            words[i] = str(needs[-1].folder)
    if kind == "evaluate":
        words = ["evaluate", *words, "--save"]
        test = tyro.cli(ppo_actiongen.EvaluateArgs, args=words[1:])
        return Job(figure, row, seed, kind, words, test, needs[0].folder, needs)
    words = words if kind == "hvae" else [kind, *words, "--seed", str(seed)]
    # Ours: where the split is random, every seed has its own, so that the spread over seeds holds
    # the luck of the split. CREATE and Stacking: one split for all seeds, as published.
    words += ["--split-seed", str(seed)] if words[0] in ("gridworld", "recsys") else []
    words += ["--recipe", "paper"] if args.recipe == "paper" else []
    words += ["--runs-dir", args.runs_dir] if args.runs_dir != "runs" else []
    if kind == "hvae":  # one encoder seed for all policies, as published
        encoder = hvae.parse_args(words)
        path = hvae.representation_path(encoder)
        return Job(figure, row, seed, kind, words, encoder, path, needs)
    if args.budget != 1:
        usual = parse(words).total_timesteps
        words += ["--total-timesteps", str(round(args.budget * usual))]
    words += shlex.split(args.extra)
    training = parse(words)
    path = ppo_actiongen.run_path(training)
    return Job(figure, row, seed, "train", words, training, path, needs)


def plan(args: Args) -> list[Job]:
    """The jobs of these figures, each after what it needs; ValueError for an unknown name."""
    figures = tuple(TABLE) if args.figures == ("all",) else args.figures
    if unknown := set(figures) - set(TABLE):
        raise ValueError(f"figure {min(unknown)!r} is not one of {', '.join(TABLE)}, all")
    named = {word for figure in figures for row in TABLE[figure] for word in (row, *row.split("/"))}
    if unknown := set(args.only) - named:
        raise ValueError(f"no row is called {min(unknown)}: see --dry-run")
    jobs: dict[tuple, Job] = {}

    def add(job: Job) -> None:
        for need in job.needs:
            add(need)
        jobs.setdefault((job.figure, job.row, job.command), job)  # encoders: once for all seeds

    for seed in args.seeds:  # seed by seed, so that an interrupted matrix is balanced
        for figure in figures:
            for row in TABLE[figure]:
                if not args.only or {row, *row.split("/")} & set(args.only):
                    add(expand(figure, row, seed, args))
    return list(jobs.values())


COLUMNS = "env task method seed split split_seed recipe steps phase".split()  # a row's key
COLUMNS += "score stderr episodes pool_size hours machine command".split()
CURVES = "env task method seed recipe steps step train_score valid_score episode_score".split()


def read(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file, [] if there is none."""
    return list(csv.DictReader(path.open())) if path.exists() else []


@cache
def machine() -> str:
    """Processor and threads of a job: hours mean little without them."""
    cpu = Path("/proc/cpuinfo")  # Linux
    found = re.search(r"model name\s*: (.+)", cpu.read_text()) if cpu.exists() else None
    name = found[1] if found else platform.processor()
    return f"{name}, {os.environ.get('OMP_NUM_THREADS', 1)} thread(s)"  # 1: as the scripts do


def score_rows(job: Job) -> list[dict]:
    """The rows of results/<figure>.csv for one job, [] if it is not finished.

    Raises ValueError if the folder holds another command's run: its scores are not this row's.
    """
    run, wanted = job.needs[0] if job.kind == "evaluate" else job, vars(job.args)
    row = {key: getattr(run.args, key) for key in ("env", "split", "split_seed", "recipe")}
    row["env"] += "_full" * getattr(run.args, "fully_observable", False)
    row |= {"task": getattr(run.args, "task", ""), "method": run.row.split("/")[-1]}
    row |= {"seed": job.seed, "machine": machine(), "command": job.command}
    if job.kind == "hvae":
        path = job.folder.with_suffix(".json")
        record = json.loads(path.read_text()) if path.exists() else defaultdict(dict)
        scores = {f"{k}, published": v for k, v in record["published"].items()} | record["scores"]
        found = [row | {"phase": k, "score": float(v)} for k, v in scores.items()]
        if row["split"] == "default":  # the yardstick: the same scores of the ground truth
            row["method"] = "engineered"
            true = [row | {"phase": k, "score": float(v)} for k, v in record["engineered"].items()]
            found = true + found
        return found
    if job.kind == "evaluate":
        for found in read(job.folder / "evaluations.csv"):
            same = {k: "" if v is None else str(v) for k, v in wanted.items() if k in found}
            if same == {k: found[k] for k in same} and (trained := score_rows(run)):
                row |= {"phase": job.row.split("/")[-1], "steps": trained[0]["steps"]}
                return [row | {k: float(found[k]) for k in COLUMNS[9:13]}]
        return []
    if not (job.folder / "results.json").exists():
        return []
    made = json.loads((job.folder / "args.json").read_text())
    for name in wanted.keys() - {"resume", "device", "runs_dir", "run_name"}:
        if made.get(name, "missing") != wanted[name]:
            raise ValueError(f"{job.folder} holds a run with another {name}: move it away")
    found = json.loads((job.folder / "results.json").read_text())
    row |= {"steps": found["steps"], "hours": found["hours"]}
    # A policy that adapts has one set of actions, and one phase.
    return [row | found[p] | {"phase": p} for p in ("train", "valid", "test") if p in found]


def curve_rows(job: Job) -> list[dict]:
    """A training's learning curve: at most 50 points, raw (published ones keep their maximum)."""
    # A policy that adapts is trained on what it is tested on: its own episodes are the curve.
    names = CURVES[-1:] if job.args.adapt else CURVES[-3:-1]
    points = [point for point in read(job.folder / "metrics.csv") if point[names[0]]]
    points = points[:: -(len(points) // 50 + 1)][::-1]  # with the last one
    same = {k: v for k, v in score_rows(job)[0].items() if k in CURVES}
    return [same | {name: point[name] for name in ("step", *names)} for point in points]


def merge(path: Path, columns: list[str], key: list[str], rows: list[dict]) -> None:
    """Put rows into a CSV file, in the place of those of the same key; never half a file."""
    if (old := read(path)) and [*old[0]] != columns:
        raise ValueError(f"{path} has other columns: move it away")
    table = {tuple(row[k] for k in key): row for row in old}
    for row in rows:
        row = {c: "" if row.get(c) is None else row[c] for c in columns}
        row = {c: f"{v:.6g}" if isinstance(v, float) else str(v) for c, v in row.items()}
        table[tuple(row[k] for k in key)] = row
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    order = sorted(table, key=lambda k: [part.zfill(9) * part.isdigit() or part for part in k])
    writer.writerows(table[k] for k in order)  # numbers by size
    hvae.write(path, lambda file: file.write(text.getvalue().encode()))


LOCK = Lock()  # one at a time writes tables


def run(job: Job, args: Args) -> bool:
    """Run a job unless it is finished, and write its scores; whether there are any."""
    log = Path(f"{job.folder}.log")
    if not score_rows(job):
        begun = job.kind == "train" and (job.folder / "args.json").exists()
        words = shlex.split(job.command)[1:] + ["--resume"] * begun
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as file:
            subprocess.run([sys.executable, *words], stdout=file, stderr=file)
    if not (found := score_rows(job)):
        print(f"  FAILED  {job.command}  (see {log})", flush=True)
        return False
    with LOCK:
        name = job.figure + "-paper" * (args.recipe == "paper")
        merge(Path(args.results_dir) / f"{name}.csv", COLUMNS, COLUMNS[:9], found)
        if (tsne := job.folder.with_name(f"{job.folder.stem}-tsne.png")).exists():
            shutil.copy(tsne, Path(args.results_dir) / f"{name}-tsne-{job.row}.png")
        if job.kind == "train":
            path = Path(args.results_dir) / f"{name}_curves.csv"
            merge(path, CURVES, CURVES[:7], curve_rows(job))
        print(f"{found[-1]['score']:8.3f}  {job.command}", flush=True)
    return True


def main(args: Args) -> None:
    """Print or run the commands."""
    os.chdir(ROOT)  # the paths of all commands start here
    jobs = plan(args)
    if args.dry_run:
        print("\n".join(dict.fromkeys(job.command for job in jobs)))
        return
    left = sum(not score_rows(job) for job in jobs)  # a folder of another run is an error now
    print(f"{left} of {len(jobs)} commands to run", flush=True)
    chains = defaultdict(list)  # one after the other: a training, all that starts from it
    for job in jobs:
        first = job
        while first.needs:
            first = first.needs[0]
        chains[first.folder].append(job)
    with ThreadPoolExecutor(args.jobs) as pool:
        done = pool.map(lambda chain: [run(job, args) for job in chain], chains.values())
        failed = sum(chain.count(False) for chain in done)
    if failed:
        raise SystemExit(f"error: {failed} of {len(jobs)} commands failed")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from None
