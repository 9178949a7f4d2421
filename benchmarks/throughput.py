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
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads that share a core wait for each other
ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
CLASSES = {"gridworld": "GridWorldEnv", "recsys": "RecSysEnv", "create_env": "CreateEnv"}
CLASSES |= {"stacking_env": "StackingEnv"}
TASKS = "push navigate obstacle seesaw belt buckets cannon collide moving ladder basket funnel"


def compare(what: str, unit: str, works: dict[str, Callable[[], int]], seconds=6.0) -> None:
    """Print the ratio of two rates; the works take turns, each returns how many units it did."""
    done, spent = dict.fromkeys(works, 0), dict.fromkeys(works, 0.0)
    for work in works.values():
        work()  # memory, caches, first resets
    while min(spent.values()) < seconds:
        for name, work in works.items():
            start = time.perf_counter()
            done[name] += work()
            spent[name] += time.perf_counter() - start
    (a, fast), (b, slow) = [(name, done[name] / spent[name]) for name in works]
    print(f"{what}: {a} : {b} = {fast / slow:.2f}   ({fast:,.0f} : {slow:,.0f} {unit})", flush=True)


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


# ---- groups: one function each ----


def environments() -> None:
    """32 environments in gymnasium's vector environment, against one alone."""
    for name in CLASSES:
        module, env, actions = make_env(name)
        envs = module.make_vec(32, module.split_actions()["train"], seed=0)
        envs.reset()
        batch = itertools.cycle([envs.action_space.sample() for _ in range(100)])

        def vector(envs=envs, batch=batch) -> int:
            return len(envs.step(next(batch))[1])

        def alone(env=env, actions=actions) -> int:
            play(env, actions, 32)
            return 32

        compare(name, "steps/s", {"vector": vector, "alone": alone})
        envs.close()
        env.close()


def physics() -> None:
    """Shape Stacking: until all shapes are at rest, against 300 exact steps after each action."""
    module, env, actions = make_env("stacking_env")
    ours = module.SOLVER_RESIDUAL

    def run(early_stop: bool, residual: float) -> int:
        env.early_stop, module.SOLVER_RESIDUAL = early_stop, residual
        play(env, actions, 20)
        return 20

    works = {"ours": lambda: run(True, ours), "plain": lambda: run(False, 1e-7)}  # Bullet's own
    compare("stacking", "steps/s", works, 20.0)


def utility() -> None:
    """Utility's own backward pass against autograd's, one minibatch forward and backward."""
    import torch

    from ppo_actiongen import Utility

    torch.set_num_threads(1)
    for name, B, K, A in (
        ("Grid World, fast", 512, 20, 1024),
        ("Grid World, paper", 4096, 50, 1024),
        ("Recommender, paper", 2048, 500, 10_000),
    ):
        u, P, w = (torch.randn(*shape, requires_grad=True) for shape in ((B, 64), (A, 64), (64,)))
        sets = torch.stack([torch.randperm(A)[:K] for _ in range(B)])  # (B, K)

        def kernel(u=u, P=P, w=w, sets=sets) -> int:
            Utility.apply(u, P, w, sets).square().mean().backward()
            return len(sets)

        def plain(u=u, P=P, w=w, sets=sets) -> int:
            ((P[sets] + u[:, None]).relu() @ w).square().mean().backward()  # (B, K)
            return len(sets)

        compare(f"{name}, K={K}", "states/s", {"kernel": kernel, "autograd": plain})


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
