"""The paper's experiments as lists of commands: print them, run what is missing, collect scores.

    python benchmarks/paper.py --dry-run gridworld            # the commands and their hours
    python benchmarks/paper.py gridworld --jobs 2             # run them, two at a time
    python benchmarks/paper.py gridworld --budget 0.1 --seeds 0 1 2
    python benchmarks/paper.py gridworld --methods ours engineered

Finished runs are skipped, killed ones go on from their checkpoint. After every run its scores are
written to results/<env>.csv (one row per phase, with the command that made it) and its learning
curve to results/<env>_curves.csv; benchmarks/report.py draws both.
"""

import csv
import json
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import ppo_actiongen  # noqa: E402

# One experiment = the methods of one published figure; names as in published_results.csv.
EXPERIMENTS: dict[str, dict[str, str]] = {
    "gridworld": {
        "ours": "gridworld",
        "engineered": "gridworld --representation engineered",
        "ours_alternate_modality": "gridworld --modality onehot",
        "oracle_encoder_all_actions": "gridworld --representation hvae-all",
        "non_hierarchical_vae": "gridworld --representation vae",
        "ours_no_entropy": "gridworld --ent-coef 0",
        # Ten times the cost per step of the others, so a narrower utility and fewer steps.
        "ours_no_subsampling": "gridworld --no-subsample --utility-hidden 64 --budget 0.2",
        "nearest_neighbor": "gridworld --method nearest-neighbor",
        "continuous_output": "gridworld --method continuous",
        "ours_mlp_encoder": "gridworld --hvae-recipe quick",  # beyond the paper
    },
    # What each difference of the fast recipe is worth: the recipe, then one difference undone.
    "gridworld-recipe": {
        "fast": "gridworld --representation engineered",
        "numbers_not_one_hot": "gridworld --representation engineered --no-one-hot",
        "minibatch_4096": "gridworld --representation engineered --minibatch-size 4096",
        "train_with_50": "gridworld --representation engineered --num-available 50",
        "not_standardized": "gridworld --representation engineered --no-standardize",
        "entropy_constant": "gridworld --representation engineered --ent-floor 1",
        "utility_width_64": "gridworld --representation engineered --utility-hidden 64",
        "gains_0.01": "gridworld --representation engineered --utility-gains 0.01 0.01 0.01",
    },
    "recsys": {
        "ours": "recsys --utility mlp",
        "ours_no_entropy": "recsys --utility mlp --ent-coef 0",
        "ours_no_subsampling": "recsys --utility mlp --no-subsample",
        "nearest_neighbor": "recsys --utility mlp --method nearest-neighbor",
        "continuous_output": "recsys --utility mlp --method continuous",
        "ours_bilinear": "recsys",  # beyond the paper, the fast recipe's default
    },
}
EXPERIMENTS["recsys-full"] = {
    method: f"{command} --fully-observable" for method, command in EXPERIMENTS["recsys"].items()
}

COLUMNS = (
    "env task method representation modality split seed steps phase score stderr episodes "
    "published hours command"
).split()
CURVE_COLUMNS = "env task method seed step train_score valid_score".split()


@dataclass
class Args:
    """Run the experiments of the paper that have no result yet."""

    experiments: tyro.conf.Positional[tuple[str, ...]]
    """Names of experiments, or `all`."""
    methods: tuple[str, ...] = ()
    """Only these methods (default: all of the experiment)."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds; the same number seeds the random split of the actions."""
    budget: float = 1.0
    """Factor on each preset's number of environment steps; the rows name the steps really run."""
    recipe: str = "fast"
    """fast or paper, see ppo_actiongen.py."""
    extra: str = ""
    """Further flags for every command, as one string."""
    jobs: int = 1
    """How many runs at a time, one thread each."""
    dry_run: bool = False
    """Only print the commands and their estimated hours."""
    rate: float = 15_000.0
    """Environment steps per second of one run, for the estimate (benchmarks/throughput.py)."""
    runs_dir: str = "runs/paper"
    """Where the runs live."""
    results_dir: str = "results"
    """Where the tables go."""


@dataclass
class Job:
    """One command of one experiment."""

    experiment: str
    method: str
    seed: int
    words: list[str]
    steps: int
    folder: Path
    lock: Lock = field(default_factory=Lock)

    @property
    def command(self) -> str:
        return "python ppo_actiongen.py " + shlex.join(self.words)

    @property
    def finished(self) -> bool:
        return (self.folder / "results.json").exists()


def jobs_of(args: Args) -> list[Job]:
    """All commands of the chosen experiments; ValueError for an unknown name."""
    names = list(EXPERIMENTS) if args.experiments == ("all",) else args.experiments
    jobs = []
    for seed in args.seeds:  # seed by seed, so that an interrupted matrix is still balanced
        for name in names:
            if name not in EXPERIMENTS:
                raise ValueError(f"experiment {name!r} is not one of {', '.join(EXPERIMENTS)}, all")
            for method in args.methods or EXPERIMENTS[name]:
                if method not in EXPERIMENTS[name]:
                    raise ValueError(
                        f"method {method!r} is not one of {', '.join(EXPERIMENTS[name])}"
                    )
                words, budget = shlex.split(EXPERIMENTS[name][method]), args.budget
                if "--budget" in words:  # this method's own factor on top
                    at = words.index("--budget")
                    budget *= float(words[at + 1])
                    del words[at : at + 2]
                preset = ppo_actiongen.default_args(words[0], args.recipe, False)
                steps = round(preset.total_timesteps * budget)
                # ours: every seed has its own split, so that the spread over seeds holds the luck
                # of the split too (published: one split; ours differ by 0.1 in difficulty).
                words += ["--seed", str(seed), "--split-seed", str(seed), "--threads", "1"]
                words += ["--total-timesteps", str(steps), *shlex.split(args.extra)]
                if args.recipe != "fast":
                    words += ["--recipe", args.recipe]
                folder = Path(args.runs_dir) / f"{name}-{method}-{args.recipe}-{steps}-s{seed}"
                jobs.append(Job(name, method, seed, words, steps, folder))
    return jobs


def rows_of(job: Job) -> tuple[list[dict], list[dict]]:
    """The rows of results/<env>.csv and of its learning curve for one finished run."""
    results = json.loads((job.folder / "results.json").read_text())
    run_args = json.loads((job.folder / "args.json").read_text())
    same = {k: run_args[k] for k in ("env", "task", "representation", "modality", "split", "seed")}
    same |= {"env": job.experiment, "method": job.method, "command": job.command}
    scores = [
        same
        | {k: results[phase][k] for k in ("score", "stderr", "episodes")}
        | {"phase": phase, "published": results["published"].get(phase)}
        | {"steps": results["steps"], "hours": results["hours"]}
        for phase in ("train", "valid", "test")
    ]
    rows = csv.DictReader((job.folder / "metrics.csv").open())
    curve = [same | row for row in rows if row["valid_score"]]
    return scores, curve


def merge(path: Path, columns: list[str], rows: list[dict], key: tuple[str, ...]) -> None:
    """Replace the rows of the same key in a CSV by these, keep the rest; atomically."""

    def key_of(row):
        return tuple(str(row.get(k) or "") for k in key)

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


def collect(job: Job, results_dir: Path) -> None:
    """Write one finished run into the tables."""
    scores, curve = rows_of(job)
    name = job.experiment
    merge(results_dir / f"{name}.csv", COLUMNS, scores, ("method", "seed", "command"))
    merge(results_dir / f"{name}_curves.csv", CURVE_COLUMNS, curve, ("method", "seed"))


def run(job: Job, args: Args, lock: Lock) -> bool:
    """Run one command unless it is finished; True if there is a result in the end."""
    if not job.finished:
        job.folder.parent.mkdir(parents=True, exist_ok=True)
        log = job.folder.with_suffix(".log")
        flags = ["--runs-dir", args.runs_dir, "--run-name", job.folder.name, "--resume"]
        flags += ["--no-tensorboard"]
        with log.open("a") as file:
            words = [sys.executable, str(ROOT / "ppo_actiongen.py"), *job.words, *flags]
            subprocess.run(words, stdout=file, stderr=subprocess.STDOUT, check=False)
    with lock:
        if not job.finished:
            print(f"FAILED  {job.command}   (see {job.folder.with_suffix('.log')})", flush=True)
            return False
        collect(job, Path(args.results_dir))
        score = json.loads((job.folder / "results.json").read_text())["test"]["score"]
        print(f"{score:.3f}  {job.command}", flush=True)
    return True


def main() -> None:
    """Print or run the jobs."""
    args = tyro.cli(Args)
    try:
        jobs = jobs_of(args)
    except ValueError as e:
        raise SystemExit(f"error: {e}") from None
    if args.dry_run:
        for job in jobs:
            state = "done" if job.finished else f"{job.steps / args.rate / 3600:.2f} h"
            print(f"{state:>8}  {job.command}")
        hours = sum(j.steps for j in jobs if not j.finished) / args.rate / 3600 / args.jobs
        print(f"{sum(not j.finished for j in jobs)} of {len(jobs)} to run, about {hours:.1f} hours")
        return
    # Representations are shared between runs, so make each of them once, before the runs start.
    for words in {tuple(j.words): j.words for j in jobs if not j.finished}.values():
        preset = ppo_actiongen.default_args(words[0], args.recipe, False)
        run_args = tyro.cli(ppo_actiongen.Args, args=words[1:], default=preset)
        run_args.runs_dir = args.runs_dir
        pools, *_ = ppo_actiongen.action_pools(run_args)
        ppo_actiongen.load_table(run_args, pools["train"])
    lock = Lock()
    with ThreadPoolExecutor(args.jobs) as pool:
        done = list(pool.map(lambda job: run(job, args, lock), jobs))
    if not all(done):
        raise SystemExit(f"error: {done.count(False)} of {len(done)} runs failed")


if __name__ == "__main__":
    main()
