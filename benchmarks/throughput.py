"""Steps per second of every environment and of training by its default recipe, one thread each.

    python benchmarks/throughput.py               # all four
    python benchmarks/throughput.py create recsys

These are the rates of this machine at this hour: compare only numbers of one run of this script.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Literal

import tyro

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads that share a core wait for each other
from paper import ROOT, hvae, read  # noqa: E402

STEPS = {"gridworld": 200_000, "recsys": 60_000, "create": 25_000, "stacking": 1_500}  # seconds


def play(env: str) -> float:
    """Steps per second of 32 environments with random actions, resets included."""
    module = hvae.load_environment(env)
    envs = module.make_vec(32, module.split_actions()["train"], seed=0)
    envs.reset()
    actions = [envs.action_space.sample() for _ in range(STEPS[env] // 32)]
    started = time.perf_counter()
    for action in actions:
        envs.step(action)
    return 32 * len(actions) / (time.perf_counter() - started)


def train(env: str) -> float:
    """Steps per second of the default recipe without evaluations, on engineered actions."""
    with tempfile.TemporaryDirectory() as folder:
        words = f"{env} --representation engineered --total-timesteps {STEPS[env]}"
        words += f" --eval-every 9999999 --valid-episodes 2 --eval-episodes 2 --runs-dir {folder}"
        command = [sys.executable, str(ROOT / "ppo_actiongen.py"), *words.split()]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        (metrics,) = Path(folder).glob("*/metrics.csv")
        # The last row holds the evaluation at the end.
        return statistics.median(float(row["sps"]) for row in read(metrics)[:-1])


def main(environments: tyro.conf.Positional[tuple[Literal[tuple(STEPS)], ...]] = tuple(STEPS)):
    for env in environments:
        print(f"{env:10} environment {play(env):9,.0f}  training {train(env):9,.0f}", flush=True)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
