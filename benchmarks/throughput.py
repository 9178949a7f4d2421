"""What each speed-up is worth: ratios, measured in one run of this script.

    python benchmarks/throughput.py                        # all groups, about ten minutes
    python benchmarks/throughput.py utility learner        # only these
    python benchmarks/throughput.py random_play            # the score of a random policy, all tasks

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

ENVIRONMENTS = {
    "gridworld": ("gridworld", "GridWorldEnv"),
    "recsys": ("recsys", "RecSysEnv"),
    "create": ("create_env", "CreateEnv"),
    "stacking": ("stacking_env", "StackingEnv"),
}
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


def make_env(name: str, actions: int = 1000, **options):
    """An environment with the training actions, and an endless row of random actions for it."""
    module, cls = ENVIRONMENTS[name]
    module = importlib.import_module(module)
    env = getattr(module, cls)(module.split_actions()["train"], **options)
    env.action_space.seed(0)
    env.reset(seed=0)
    return module, env, itertools.cycle([env.action_space.sample() for _ in range(actions)])


def play(env, actions, steps: int) -> int:
    """So many steps of one environment, restarts included."""
    for action in itertools.islice(actions, steps):
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return steps


# ---- groups: one function each ----


def environments() -> None:
    """What gymnasium's vector environments cost or gain against one environment alone."""
    for name in ENVIRONMENTS:
        module, env, actions = make_env(name)
        envs = module.make_vec(32, module.split_actions()["train"], seed=0)
        envs.action_space.seed(0)
        envs.reset()
        batches = itertools.cycle([envs.action_space.sample() for _ in range(100)])

        def together(envs=envs, batches=batches) -> int:
            for batch in itertools.islice(batches, 10):
                envs.step(batch)
            return 320

        alone = lambda env=env, actions=actions: play(env, actions, 320)  # noqa: E731
        compare(name, "steps/s", {"32 together": together, "one alone": alone})
        envs.close()
        env.close()


def physics() -> None:
    """Shape Stacking: stop when all shapes are at rest, against 300 steps after each action."""
    module, ours, actions = make_env("stacking")
    module.SOLVER_RESIDUAL = 1e-7  # Bullet's own
    _, plain, same = make_env("stacking")
    plain.early_stop = False
    works = {"ours": lambda: play(ours, actions, 20), "plain": lambda: play(plain, same, 20)}
    compare("stacking, physics and pictures", "steps/s", works, 20.0)


def utility() -> None:
    """The utility network on one minibatch, forward and backward: factorised, and D.3.2 as it reads.

    Utility's own backward pass is compared with the same four lines left to autograd.
    """
    import torch

    from ppo_actiongen import Utility

    torch.set_num_threads(1)
    for name, B, K, A in (
        ("Grid World, fast", 512, 20, 1024),
        ("Grid World, paper", 4096, 50, 1024),
        ("Recommender, paper", 2048, 500, 10_000),
    ):
        H, D = 64, 16
        u, w = torch.randn(B, H, requires_grad=True), torch.randn(H, requires_grad=True)
        P, c = torch.randn(A, H, requires_grad=True), torch.randn(A, D)
        sets = torch.stack([torch.randperm(A)[:K] for _ in range(B)])  # (B, K)
        project, hidden = torch.nn.Linear(D, H), torch.nn.Linear(2 * H, H)

        def kernel(u=u, P=P, w=w, sets=sets) -> int:
            Utility.apply(u, P, w, sets).square().mean().backward()
            return len(sets)

        def four_lines(u=u, P=P, w=w, sets=sets) -> int:
            (P[sets].add(u[:, None]).relu() @ w).square().mean().backward()
            return len(sets)

        def concatenated(u=u, w=w, sets=sets, c=c, project=project, hidden=hidden) -> int:
            pairs = [u[:, None].expand(-1, sets.shape[1], -1), project(c[sets])]  # each (B, K, H)
            (hidden(torch.cat(pairs, -1)).relu() @ w).square().mean().backward()
            return len(sets)

        compare(f"{name}, K={K}", "states/s", {"kernel": kernel, "four lines": four_lines})
        compare(f"{name}, K={K}", "states/s", {"kernel": kernel, "concatenated": concatenated})


def learner() -> None:
    """Training end to end without evaluations, engineered actions: the recipes' rates."""
    for env, steps in (("gridworld", 200_000), ("recsys", 60_000), ("create", 25_000)):
        rates = {}
        for recipe in ("fast", "paper") * 2:
            command = [sys.executable, str(ROOT / "ppo_actiongen.py"), env, "--recipe", recipe]
            command += ["--representation", "engineered", "--total-timesteps", str(steps)]
            command += ["--eval-every", str(10 * steps), "--valid-episodes", "2"]
            with tempfile.TemporaryDirectory() as folder:
                command += ["--eval-episodes", "2", "--runs-dir", folder]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                (metrics,) = Path(folder).glob("*/metrics.csv")
                rates.setdefault(recipe, [])
                rates[recipe] += [float(row["sps"]) for row in csv.DictReader(metrics.open())]
        fast, paper = (statistics.median(values) for values in rates.values())
        print(f"{env}: fast : paper = {fast / paper:.2f}   ({fast:,.0f} : {paper:,.0f} steps/s)")


def random_play() -> None:
    """What a random policy scores, the floor of every table (CHANCE in report.py)."""
    rows = [("gridworld", {}, 400_000), ("recsys", {}, 100_000), ("stacking", {}, 1_000)]
    rows += [("create", {"task": task}, 30_000) for task in TASKS.split()]
    for name, options, steps in rows:
        module, env, actions = make_env(name, steps, **options)
        scores = []
        for action in itertools.islice(actions, steps):
            _, _, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                scores.append(float(info[module.METRIC]))
                env.reset()
        env.close()
        error = statistics.pstdev(scores) / len(scores) ** 0.5
        what = " ".join([name, *options.values()])
        print(f"{what}: {statistics.mean(scores):.4f} ± {error:.4f}, {len(scores)} episodes")


GROUPS = {f.__name__: f for f in (environments, physics, utility, learner, random_play)}


def main(names: list[str]) -> None:
    """Run the groups of these names (default: all)."""
    if unknown := set(names) - set(GROUPS):
        raise ValueError(f"group {min(unknown)!r} is not one of {', '.join(GROUPS)}")
    for name in names or GROUPS:
        print(f"\n{name}: {GROUPS[name].__doc__.splitlines()[0]}")
        GROUPS[name]()


if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv):
        raise SystemExit(f"{__doc__}\ngroups: {', '.join(GROUPS)}")
    try:
        main(sys.argv[1:])
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from None
