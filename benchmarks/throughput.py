"""What each speed-up is worth: ratios, measured in one run of this script.

    python benchmarks/throughput.py                    # all groups
    python benchmarks/throughput.py utility learner    # only these
    python benchmarks/throughput.py random_play        # what a random policy scores, all tasks

The two sides of a ratio take turns, so that whatever else the machine does slows both. The rates
behind it are this machine's at this hour, and of no use elsewhere.
"""

import csv
import importlib
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads that share a core wait for each other
ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
CLASSES = {"gridworld": "GridWorldEnv", "recsys": "RecSysEnv", "create_env": "CreateEnv"}
CLASSES |= {"stacking_env": "StackingEnv"}
TASKS = "push navigate obstacle seesaw belt buckets cannon collide moving ladder basket funnel"


def compare(what: str, count: int, works: dict[str, Callable], seconds=6.0) -> None:
    """Print the ratio of the rates of two works, which take turns; each does `count` units."""
    calls, spent = 0, dict.fromkeys(works, 0.0)
    for work in works.values():
        work()  # memory, caches, first resets
    while min(spent.values()) < seconds:
        calls += 1
        for name, work in works.items():
            start = time.perf_counter()
            work()
            spent[name] += time.perf_counter() - start
    fast, slow = (calls * count / t for t in spent.values())
    print(
        f"{what}: {' : '.join(works)} = {fast / slow:.2f}   ({fast:,.0f} : {slow:,.0f} per second)"
    )


def make_env(name: str, **options):
    """A module, one of its environments, and an endless row of random actions for that."""
    module = importlib.import_module(name)
    env = getattr(module, CLASSES[name])(module.split_actions()["train"], **options)
    env.action_space.seed(0)
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(5000)]
    if name == "stacking_env":  # a random stop would come after two shapes
        actions = [action | {"stop": 0} for action in actions]
    return module, env, itertools.cycle(actions)


def play(env, actions, steps: int, metric: str = "") -> list[float]:
    """So many steps of one environment, restarts included; the metric of each episode."""
    scores = []
    for action in itertools.islice(actions, steps):
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            scores.append(float(info.get(metric, 0)))
            env.reset()
    return scores


def environments() -> None:
    """32 environments in gymnasium's vector environment, against one alone: steps."""
    for name in CLASSES:
        module, env, actions = make_env(name)
        envs = module.make_vec(32, module.split_actions()["train"], seed=0)
        envs.reset()
        batches = itertools.cycle([envs.action_space.sample() for _ in range(100)])
        vector = partial(lambda envs, batches: envs.step(next(batches)), envs, batches)
        compare(name, 32, {"vector": vector, "alone": partial(play, env, actions, 32)})
        envs.close()
        env.close()


def physics() -> None:
    """Shape Stacking until all shapes are at rest, against 300 exact steps each: actions."""
    module, env, actions = make_env("stacking_env")

    def work(early_stop: bool, residual: float) -> None:
        env.early_stop, module.SOLVER_RESIDUAL = early_stop, residual
        play(env, actions, 20)

    ours, plain = (
        partial(work, True, module.SOLVER_RESIDUAL),
        partial(work, False, 1e-7),
    )  # Bullet's
    compare("stacking", 20, {"ours": ours, "plain": plain}, 20.0)


def utility() -> None:
    """Utility's own backward pass against autograd's, a minibatch there and back: states."""
    import torch

    import ppo_actiongen as ppo

    def work(form: Callable, *inputs) -> None:
        form(*inputs).square().mean().backward()

    torch.set_num_threads(1)
    for name, B, K, A in (
        ("Grid World, fast", 512, 20, 1024),
        ("Grid World, paper", 4096, 50, 1024),
        ("Recommender, paper", 2048, 500, 10_000),
    ):
        inputs = [torch.randn(*n, requires_grad=True) for n in ((B, 64), (A, 64), (64,))]
        inputs.append(torch.stack([torch.randperm(A)[:K] for _ in range(B)]))
        works = {"kernel": ppo.Utility.apply, "autograd": ppo.utility}
        compare(name, B, {key: partial(work, form, *inputs) for key, form in works.items()})


def learner() -> None:
    """Training end to end without evaluations, engineered actions: fast against paper's recipe."""
    for env, steps in (("gridworld", 200_000), ("recsys", 60_000), ("create", 25_000)):
        rates: dict[str, list] = {"fast": [], "paper": []}
        for recipe in [*rates] * 2:
            with tempfile.TemporaryDirectory() as folder:
                words = f"{env} --recipe {recipe} --representation engineered --eval-every 9999999"
                words += f" --total-timesteps {steps} --valid-episodes 2 --eval-episodes 2"
                command = [sys.executable, str(ROOT / "ppo_actiongen.py"), *words.split()]
                command += ["--runs-dir", folder]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                (metrics,) = Path(folder).glob("*/metrics.csv")
                rates[recipe] += [float(row["sps"]) for row in csv.DictReader(metrics.open())]
        fast, paper = map(statistics.median, rates.values())
        print(f"{env}: fast : paper = {fast / paper:.2f}   ({fast:,.0f} : {paper:,.0f} steps/s)")


def random_play() -> None:
    """What a random policy scores: CHANCE in report.py."""
    rows = [("gridworld", {}, 400_000), ("recsys", {}, 100_000), ("stacking_env", {}, 1_000)]
    for name, options, steps in rows + [("create_env", {"task": t}, 30_000) for t in TASKS.split()]:
        module, env, actions = make_env(name, **options)
        scores = play(env, actions, steps, module.METRIC)
        error = statistics.pstdev(scores) / len(scores) ** 0.5
        print(" ".join([name, *options.values()]), end=": ")
        print(f"{statistics.mean(scores):.4f} ± {error:.4f}, {len(scores)} episodes", flush=True)
        env.close()


GROUPS = {f.__name__: f for f in (environments, physics, utility, learner, random_play)}

if __name__ == "__main__":
    for name in sys.argv[1:] or GROUPS:
        if name not in GROUPS:
            raise SystemExit(f"{__doc__}\nerror: {name!r} is not one of {', '.join(GROUPS)}")
        print(f"\n{name}: {GROUPS[name].__doc__}")
        GROUPS[name]()
