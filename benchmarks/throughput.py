"""How fast each part runs, beside its ceiling or the published implementation's rate.

    python benchmarks/throughput.py                    # every row (some minutes)
    python benchmarks/throughput.py gridworld recsys   # only these groups

Each group is one function that yields rows (what, rate, unit, reference, note). All numbers of a
group come from one process on one machine, so ratios between its rows can be trusted even when the
machine is slow or shared; absolute rates are this machine's. Nothing here is a timed test.
"""

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the scripts live one level up

Row = tuple[str, float, str, str, str]  # what, rate, unit, reference value, where it comes from
GROUPS: dict[str, Callable[[], Iterator[Row]]] = {}


def group(function: Callable[[], Iterator[Row]]) -> Callable[[], Iterator[Row]]:
    """Register a generator of rows under its own name."""
    GROUPS[function.__name__] = function
    return function


def rate(work: Callable[[], int], seconds: float = 2.0) -> float:
    """Units per second of `work` (returns how many units it did), after one call to warm up."""
    work()
    done, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        done += work()
    return done / elapsed


# ---- groups (one function per environment or algorithm) ----


@group
def recsys() -> Iterator[Row]:
    """Recommender System, environment alone: random actions, drawn before the clock starts."""
    import numpy as np

    from recsys import RecSysEnv, make_vec, split_actions

    pool, rng = split_actions()["train"], np.random.default_rng(0)
    source = "published environment, random policy, one process"
    env = RecSysEnv(pool, 500)
    env.reset(seed=0)
    choices = rng.integers(500, size=500).tolist()

    def one_by_one() -> int:
        for choice in choices:
            _, _, terminated, truncated, _ = env.step(choice)
            if terminated or truncated:
                env.reset()
        return len(choices)

    scalar = rate(one_by_one)
    yield "recsys: scalar environment, K = 500", scalar, "steps/s", "4,200", source
    for num_envs in (32, 1024):
        envs = make_vec(num_envs, pool, 500, seed=0)
        envs.reset()
        actions = rng.integers(500, size=(20, num_envs))

        def batched(envs=envs, actions=actions) -> int:
            for row in actions:
                envs.step(row)
            return actions.size

        fast = rate(batched)
        what = f"recsys: batched environment, N = {num_envs}, K = 500"
        yield what, fast, "steps/s", "4,200", source
        yield "  ratio to the scalar environment", fast / scalar, "x", "", "same process"


@group
def gridworld() -> Iterator[Row]:
    """The environment alone: skills per second under a random policy, restarts included."""
    import gymnasium as gym
    import numpy as np

    import gridworld as grid

    def steps(envs: gym.vector.VectorEnv, k: int) -> float:
        actions = np.random.default_rng(0).integers(k, size=(256, envs.num_envs))
        envs.reset()
        return rate(lambda: sum(len(envs.step(row)[1]) for row in actions))

    pools, published = grid.split_actions(), "published environment, single, in process"
    for num_envs, k, role in (
        (32, 50, "train"),
        (32, 50, "test"),
        (32, 512, "train"),
        (1024, 50, "train"),
    ):
        envs = grid.make_vec(num_envs, pools[role], k, seed=0)
        what = f"Grid World, tables, {num_envs} envs, {k} of {len(pools[role])} skills"
        yield what, steps(envs, k), "skills/s", "480", published
    envs = gym.vector.SyncVectorEnv([grid.GridWorldEnv] * 32, autoreset_mode="SameStep")
    what = "Grid World, move by move, 32 envs in SyncVectorEnv"
    yield what, steps(envs, 50), "skills/s", "480", published

    def record() -> int:
        return grid.action_observations(np.arange(grid.NUM_ACTIONS)).shape[0] * 1024

    yield "Grid World, recordings in the 80x80 grid", rate(record), "recordings/s", "-", ""


def main() -> None:
    """Run the groups named on the command line (default: all) and print one table."""
    names = sys.argv[1:] or list(GROUPS)
    unknown = [name for name in names if name not in GROUPS]
    if unknown:
        raise SystemExit(f"error: unknown group {unknown[0]!r}; allowed: {', '.join(GROUPS)}")
    print(f"{'what':58} {'rate':>12} {'unit':14} {'reference':>14}  source")
    for name in names:
        for what, value, unit, reference, source in GROUPS[name]():
            print(f"{what:58} {value:12,.1f} {unit:14} {reference:>14}  {source}", flush=True)


if __name__ == "__main__":
    main()
