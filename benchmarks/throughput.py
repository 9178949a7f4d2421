"""How fast each part runs, beside its ceiling or the published implementation's rate.

    python benchmarks/throughput.py                    # every row (some minutes)
    python benchmarks/throughput.py gridworld recsys   # only these groups

Each group is one function that yields rows (what, rate, unit, reference, note). All numbers of a
group come from one process on one machine, so ratios between its rows can be trusted even when the
machine is slow or shared; absolute rates are this machine's. Nothing here is a timed test.
"""

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
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


def _learner(env: str, **changes):
    """A Run of the policy script in a temporary folder (engineered table), its two verbs."""
    import tempfile
    from dataclasses import replace

    import ppo_actiongen as ppo

    args = replace(ppo.default_args(env, changes.pop("recipe", "paper"), False), **changes)
    args = replace(
        args, representation="engineered", runs_dir=tempfile.mkdtemp(), tensorboard=False
    )
    run = ppo.Run(args)
    obs = run.envs.reset(seed=0)[0]

    def rollout():
        nonlocal obs
        parts = run.num_steps, run.generator, run.device, run.module.METRIC
        batch, obs, _ = ppo.rollout(run.envs, obs, run.agent, run.preprocess, *parts)
        ppo.add_targets(run, batch, obs)
        return batch

    def update(batch):
        ppo.update(run.agent, run.optimizer, batch, args.ent_coef, args, run.generator, run.device)

    return run, rollout, update


@group
def utility() -> Iterator[Row]:
    """The utility network on one minibatch, forward and backward, one thread: naive, factorised."""
    import gymnasium as gym
    import numpy as np
    import torch
    import torch.nn.functional as F

    import ppo_actiongen as ppo

    torch.set_num_threads(1)
    for name, B, K, D, A in (
        ("Grid World", 4096, 50, 16, 1024),
        ("Grid World, w/o subsampling,", 1024, 512, 16, 512),  # every set is the whole table
        ("Recommender", 512, 500, 16, 10_000),
    ):
        args = ppo.default_args("gridworld", "fast", False)
        args.hidden_size, args.utility_hidden = 64, 128
        space = gym.spaces.Box(-1, 1, (8,))
        table = np.random.default_rng(0).standard_normal((A, D)).astype(np.float32)
        parts = space, gym.spaces.Discrete(K), table, np.arange(A // 2)
        args.one_hot = False
        agent = ppo.Agent(*parts, args, ppo.Workers(1))
        sets = torch.stack([torch.randperm(A)[:K] for _ in range(B)])
        code = torch.randn(B, 64)

        def naive(agent=agent, sets=sets, code=code) -> int:
            c = agent.action_project(agent.table[sets])  # (B, K, H)
            s = code[:, None].expand(-1, sets.shape[1], -1)  # (B, K, H)
            hidden = F.relu(agent.utility_hidden(torch.cat([s, c], -1)))
            agent.utility_out(hidden).square().mean().backward()
            return len(sets)

        def factorised(agent=agent, sets=sets, code=code) -> int:
            agent.choice_logits(code, sets, agent.project_actions()).square().mean().backward()
            return len(sets)

        slow, fast = rate(naive), rate(factorised)
        yield f"{name} utility, naive concatenation, K={K}", slow, "states/s", "-", "appendix D.3.2"
        yield (
            f"{name} utility, factorised, K={K}",
            fast,
            "states/s",
            "-",
            f"{fast / slow:.1f} x naive",
        )


@group
def learner() -> Iterator[Row]:
    """Rollout alone, update alone, and both, of both recipes; engineered table, no evaluation."""
    ceiling = "ceiling of the factorised form, one core of another machine"
    for env, steps, one_core in (("gridworld", 500_000, 15_500), ("recsys", 33_000, 2_000)):
        for recipe, threads in (("paper", 1), ("paper", 2), ("fast", 1), ("fast", 2)):
            run, rollout, update = _learner(env, recipe=recipe, threads=threads)
            batch, label = rollout(), f"{env}, {recipe} recipe, {threads} thread(s)"
            update(batch)
            start, acting, done = time.perf_counter(), 0.0, 0
            while done < steps:
                before = time.perf_counter()
                batch = rollout()
                acting += time.perf_counter() - before
                update(batch)
                done += run.batch_size
            total = time.perf_counter() - start
            yield f"{label}: rollout alone", done / acting, "steps/s", "-", "acting + environment"
            yield f"{label}: update alone", done / (total - acting), "steps/s", "-", ""
            known = recipe == "paper"  # the ceiling is of its batches and widths
            reference = (f"{one_core * threads:,}", ceiling) if known else ("-", "")
            yield f"{label}: end to end", done / total, "steps/s", *reference
            run.envs.close()


def _plain_form(agent) -> None:
    """Make an image agent compute as D.3.2 reads: ordinary layers, one concatenation per action."""
    import torch
    import torch.nn.functional as F

    def choice_logits(code, available, P):
        c = agent.action_project(P[available])  # (B, K, D) -> (B, K, H)
        s = code[:, None].expand(-1, available.shape[1], -1)  # (B, K, H)
        hidden = F.relu(agent.utility_hidden(torch.cat([s, c], -1)))  # (B, K, W)
        return agent.utility_out(hidden)[..., 0]  # (B, K)

    agent.choice_logits = choice_logits
    agent.project_actions = lambda ids=None: agent.table if ids is None else agent.table[ids]
    for layer in agent.encoder.conv:
        layer.inplace = False
    agent.encoder.conv.to(memory_format=torch.contiguous_format)
    agent.encoder.convolve = lambda state: agent.encoder.conv(
        state.permute(0, 3, 1, 2).contiguous() / 255.0
    )


def _torchrun(steps: int) -> tuple[float, float]:
    """CREATE push in two processes: steps per second by the wall clock, CPU seconds of all."""
    import csv
    import statistics
    import subprocess
    import tempfile

    root = Path(__file__).resolve().parent.parent
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc_per_node=2"]
    command += [str(root / "ppo_actiongen.py"), "create", "--representation", "engineered"]
    command += ["--total-timesteps", str(steps), "--eval-every", "1000000000"]
    command += ["--valid-episodes", "2", "--eval-episodes", "2", "--no-tensorboard"]
    with tempfile.TemporaryDirectory() as folder:
        before = sum(os.times()[2:4])
        subprocess.run([*command, "--runs-dir", folder], check=True, capture_output=True)
        used = sum(os.times()[2:4]) - before
        (metrics,) = Path(folder).glob("*/metrics.csv")
        rates = [float(row["sps"]) for row in csv.DictReader(metrics.open())]
        return statistics.median(rates), used


@group
def image() -> Iterator[Row]:
    """CREATE push end to end (physics, pictures, learning) in both forms; Stacking's learner.

    By the processor's clock, so that other programs on the machine count less.
    """
    clock, cpu, rates = time.process_time, "per CPU second of one core", {}
    large = dict(shrink=1, micro_batch=128)  # the paper's pictures, in pieces that stay in memory
    for form in ("fast", "fast, 84 x 84 pixels", "plain, 84 x 84 pixels"):
        changes = {} if form == "fast" else large
        run, rollout, update = _learner("create", recipe="fast", threads=1, **changes)
        if form.startswith("plain"):
            _plain_form(run.agent)
            run.args.micro_batch = 0
        update(rollout())  # not timed: the first calls set up memory and kernels
        repeats, acting, start = 6, 0.0, clock()
        for _ in range(repeats):
            begin = clock()
            batch = rollout()
            acting += clock() - begin
            update(batch)
        total, steps = clock() - start, repeats * run.batch_size
        rates[form] = steps / total
        what = f"create push, {form} form"
        yield f"{what}: rollout alone", steps / acting, "steps/s", "-", cpu
        learning = steps / (total - acting)
        yield f"{what}: update alone", learning, "steps/s", "-", cpu
        yield f"{what}: end to end", rates[form], "steps/s", "850", cpu + "; aim"
        if form == "fast":
            used = {}  # CPU seconds, in turns; Run froze the libraries' objects
            for thaw in (False, True) * 2:
                (gc.unfreeze if thaw else gc.freeze)()
                begin = clock()
                for _ in range(3):
                    rollout()
                used[thaw] = used.get(thaw, 0.0) + clock() - begin
            ratio = used[True] / used[False]
            yield "  rollouts: ratio to no frozen objects", ratio, "x", "", "same process"
        run.envs.close()
    fast, large, plain = rates.values()
    yield "  ratio to the plain form, 84 x 84 pixels", large / plain, "x", "", "same process"
    yield "  ratio to it with half the pixels a side", fast / plain, "x", "", "same process"
    few, many = 12 * 1024, 36 * 1024  # 3 and 9 rollouts of the fast recipe
    (_, start), (wall, end) = _torchrun(few), _torchrun(many)
    both = 2 * (many - few) / (end - start)  # of what is in between, without start and end
    note = "per CPU second of both, times 2: what two free cores give"
    yield "create push, torchrun, 2 processes", both, "steps/s", "1,700", note + "; aim"
    yield "  the same by the wall clock", wall, "steps/s", "", "median update; depends on the load"

    # Stacking waits for Bullet nine tenths of its time, so its learner is looked at alone.
    run, rollout, update = _learner("stacking", recipe="fast", threads=1, minibatch_size=256)
    batch, P = rollout(), run.agent.project_actions()
    state, available = (batch[k][0] for k in ("state", "available"))  # (N, ...)
    start = clock()
    for _ in range(run.num_steps):
        run.agent.act(state, available, P, run.generator)
    update(batch)
    speed = run.batch_size / (clock() - start)
    note = f"{cpu}; ceiling: another machine's, without simulation"
    yield "stacking: acting and learning alone", speed, "steps/s", "1,200", note
    run.envs.close()


@group
def create() -> Iterator[Row]:
    """CREATE: every task, random placements, picture included; batches of 32; the probe ball."""
    import numpy as np

    import create_env

    published = {"push": 630, "navigate": 650, "obstacle": 450, "seesaw": 510, "belt": 450}
    published |= {"buckets": 610, "cannon": 460, "collide": 670, "moving": 630, "ladder": 580}
    published |= {"basket": 540, "funnel": 260}
    source = "published environment, random policy, one core of another machine"
    rng = np.random.default_rng(0)
    choices, positions = rng.integers(50, size=100), rng.uniform(-1, 1, (100, 2))
    actions = [{"choice": c, "position": p} for c, p in zip(choices, positions, strict=True)]
    rates, ceilings = [], []

    def per_core(work: Callable[[], int], seconds: float) -> float:
        """As `rate`, by the processor's clock: other programs on the machine count less."""
        work()
        done, start = 0, time.process_time()
        while (used := time.process_time() - start) < seconds:
            done += work()
        return done / used

    for task, reference in published.items():
        env = create_env.CreateEnv(task=task)
        env.reset(seed=0)

        def play(env=env) -> int:
            for action in actions:
                _, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    env.reset()
            return len(actions)

        def physics(env=env) -> int:
            for _ in range(10):  # of the scene that the last episode left
                env._simulate()
            return 10

        rates.append(per_core(play, 3.0))
        ceilings.append(per_core(physics, 1.0))
        yield f"create: {task}", rates[-1], "steps/s", f"{reference:,}", source
    mean, ceiling = float(np.mean(rates)), float(np.mean(ceilings))
    yield "create: mean of the 12 tasks", mean, "steps/s", "4,000", "aim; published about 450"
    yield "  40 bare physics steps (ceiling), mean", ceiling, "steps/s", "", "same process"
    yield "  share of that ceiling", 100 * mean / ceiling, "%", "", "same process"
    batch = {"choice": rng.integers(50, size=32), "position": rng.uniform(-1, 1, (32, 2))}
    batch["position"] = batch["position"].astype(np.float32)

    def processor_seconds(parallel: bool, steps: int) -> float:
        """Of all processes together, from start to end."""
        before = sum(os.times()[:4])
        envs = create_env.make_vec(32, None, 50, seed=0, async_envs=parallel)
        envs.reset()
        for _ in range(steps):
            envs.step(batch)
        envs.close()
        return sum(os.times()[:4]) - before

    for parallel in (False, True):
        name = "one process each" if parallel else "one process"
        cost = (processor_seconds(parallel, 220) - processor_seconds(parallel, 20)) / 200
        yield f"create: push, N = 32, {name}", 1000 * cost, "CPU ms/step", "", "all processes"
    ids, start = np.arange(0, create_env.NUM_DEFAULT, 53), time.process_time()
    create_env.action_observations(ids, 1024, cache=None)
    per_tool = (time.process_time() - start) / len(ids)
    note = f"from every 53rd tool ({len(ids)} tools) in one process"
    yield "create: probe ball, 1,024 trajectories", 1 / per_tool, "tools/s", "2.3", note
    minutes = per_tool * create_env.NUM_DEFAULT / 60 / 2
    yield "  all 2,111 tools on 2 cores, extrapolated", minutes, "minutes", "8", "aim"


def _timed_stacking(names: tuple[str, ...], spent: dict[str, float]):
    """A StackingEnv that adds the CPU time of the named methods to `spent`."""
    import stacking_env as stack

    def timed(name: str) -> Callable:
        method = getattr(stack.StackingEnv, name)

        def call(self, *args, **kwargs):
            start = time.process_time()
            result = method(self, *args, **kwargs)
            spent[name] += time.process_time() - start
            return result

        return call

    return type("Timed", (stack.StackingEnv,), {name: timed(name) for name in names})()


def _plain_stacking(env, seed: int, residual: float) -> tuple[float, float]:
    """A.4 to the letter: 300 steps after each of ten actions; CPU s of all, and of those steps."""
    import numpy as np

    import stacking_env as stack

    rng, bare = np.random.default_rng(seed), 0.0
    start = time.process_time()
    env.reset(seed=seed)
    bullet, client = env._bullet, {"physicsClientId": env._client}
    bullet.setPhysicsEngineParameter(solverResidualThreshold=residual, **client)
    for _ in range(stack.MAX_STEPS):  # the actions of stacking_env.play(env, seed, "random")
        choice, x = rng.integers(env.num_available), rng.uniform(-1, 1, 1)[0]
        if (shape_id := int(env.available[choice])) not in env._placed:
            env._placed.add(shape_id)
            env._add(shape_id, float(x), 0.0, env.top() + stack.DROP_GAP)
        loop = time.process_time()
        for _ in range(stack.SIM_STEPS):
            bullet.stepSimulation(**client)
        bare += time.process_time() - loop
        env._draw()
    return time.process_time() - start, bare


@group
def stacking() -> Iterator[Row]:
    """Random policy without stopping, on one core: steps, and where their time goes; pictures."""
    import numpy as np

    import stacking_env as stack

    names = ("_settle", "_draw", "_add", "top", "_empty_world")
    words = ("simulating", "picture", "adding a shape", "top of the scene", "new world")
    spent = dict.fromkeys(names, 0.0)
    env, plain, episodes = _timed_stacking(names, spent), stack.StackingEnv(), 40
    totals = np.zeros(5)
    for seed in range(episodes):  # taking turns, so that a busy machine slows all alike
        start = time.process_time()
        stack.play(env, seed, "random")
        ours = time.process_time() - start
        default, same = (_plain_stacking(plain, seed, r) for r in (1e-7, stack.SOLVER_RESIDUAL))
        totals += (ours, *default, *same)
    rates, cpu = episodes * stack.MAX_STEPS / totals, "per CPU second of one core"
    yield "Stacking, step with picture and resets, random", rates[0], "steps/s", "", cpu
    yield "  plain loop, 300 steps after each action", rates[1], "steps/s", "", cpu
    yield "  the same, nothing but stepSimulation", rates[2], "steps/s", "", cpu
    yield "  ratio to the plain loop", rates[0] / rates[1], "x", ">= 2.5", "aim"
    yield "  plain loop, our convergence threshold", rates[3], "steps/s", "", cpu
    yield "  ratio to that one", rates[0] / rates[3], "x", "", "early stop and repeats alone"
    shares = [f"{w} {100 * spent[n] / totals[0]:.0f}" for w, n in zip(words, names, strict=True)]
    shares.append(f"rest {100 * (1 - sum(spent.values()) / totals[0]):.0f}")
    yield "  profile", 100 * spent["_settle"] / totals[0], "% simulating", "", ", ".join(shares)
    env.close()
    plain.close()
    envs, rng = stack.make_vec(32), np.random.default_rng(0)
    envs.reset()

    def step() -> int:
        places = rng.uniform(-1, 1, (32, 1)).astype(np.float32)
        choices, stop = rng.integers(stack.NUM_AVAILABLE, size=32), np.zeros(32, np.int64)
        return len(envs.step({"choice": choices, "position": places, "stop": stop})[1])

    yield "  32 environments in processes", rate(step, 10.0), "steps/s", "", "wall clock"
    envs.close()
    yield from stacking_views()


def stacking_views() -> Iterator[Row]:
    """Viewpoint pictures: a stratified part of 810 x 1,024, and Bullet's renderer on one shape."""
    import numpy as np
    import pybullet as p

    import stacking_env as stack

    ids = np.arange(0, stack.NUM_ACTIONS, 10)  # a tenth of every family, all sizes
    start, views = time.process_time(), 64
    stack.action_observations(ids, views, seed=0)
    per_second = len(ids) * views / (time.process_time() - start)
    minutes = stack.NUM_ACTIONS * 1024 / per_second / 60
    note = f"extrapolated to 810 x 1,024: {minutes:.1f} CPU min, {minutes / 2:.1f} min on 2 cores"
    yield "Stacking, views of 84 x 84", per_second, "views/s/core", ">= 691", note + " (aim 10)"
    env, cylinder = stack.StackingEnv(), 800
    env._empty_world()
    env._add(cylinder, 0.0, 0.0, 1.0)
    view = p.computeViewMatrix((2, 0, 2), (0, 0, 1), (0, 0, 1))
    lens = p.computeProjectionMatrixFOV(stack.FOV, 1, 0.1, 20)
    options = {"renderer": p.ER_TINY_RENDERER, "shadow": 0, "physicsClientId": env._client}
    start = time.process_time()
    for _ in range(200):
        p.getCameraImage(stack.SIZE, stack.SIZE, view, lens, **options)
    theirs = 200 / (time.process_time() - start)
    start = time.process_time()
    stack._views(cylinder, 1000, 0)
    ours = 1000 / (time.process_time() - start)
    yield (
        "  one cylinder, this painter",
        ours,
        "views/s/core",
        f"{theirs:.0f}",
        "TinyRenderer, same run",
    )
    env.close()


@group
def hvae() -> Iterator[Row]:
    """Training updates of the action encoder: 128 actions x 4 observations, one thread."""
    import numpy as np
    import torch

    import gridworld as grid
    import hvae as encoder

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    first = None
    for what, changes in (
        ("hvae: Bi-LSTM, paper width", dict(recipe="lstm", compact=False)),
        ("hvae: Bi-LSTM, half width (recipe lstm)", dict(recipe="lstm")),
        ("hvae: MLP encoder (recipe mlp)", dict(recipe="mlp")),
        ("hvae: MLP and linear path (recipes laptop, quick)", {}),
    ):
        args = encoder.resolve(encoder.Args(**changes))
        raw = grid.action_observations(np.arange(128), 4, "xy")
        fmt = encoder.Format.of("gridworld", "xy", raw.shape, True)
        model, batch = encoder.HVAE(fmt, args), torch.from_numpy(raw)
        optimiser = torch.optim.RAdam(model.parameters(), lr=1e-3, foreach=True)

        def update(model=model, batch=batch, optimiser=optimiser) -> int:
            optimiser.zero_grad()
            model(batch)["loss"].backward()
            torch.nn.utils.clip_grad_value_(model.parameters(), encoder.GRADIENT_CLIP)
            optimiser.step()
            return 1

        speed = rate(update)
        first = first or speed
        yield what, speed, "updates/s", "", "one thread"
        yield "  ratio to the paper width", speed / first, "x", "", "same process"
    torch.set_num_threads(threads)
    yield from hvae_pictures()


def hvae_pictures() -> Iterator[Row]:
    """Updates on viewpoints of shapes, 16 shapes x 4 pictures, one thread; plain form first."""
    import ctypes

    import numpy as np
    import torch

    import hvae as encoder
    import stacking_env as stack

    threads, handed_back, first = torch.get_num_threads(), 128 << 10, None
    torch.set_num_threads(1)
    raw = torch.from_numpy(stack.action_observations(np.arange(0, 800, 50), 4, "image"))
    args = encoder.resolve(encoder.Args(env="stacking"))
    fmt = encoder.Format.of("stacking", "image", raw.shape, False)
    for what in ("hvae: pictures, plain form", "hvae: pictures, as trained"):
        model = encoder.HVAE(fmt, args)
        if first is None:  # glibc's default threshold, and PyTorch's default order in memory
            with suppress(AttributeError, OSError, TypeError):
                for option in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
                    ctypes.CDLL(None).mallopt(option, handed_back)
            model.to(memory_format=torch.contiguous_format)
        else:
            encoder.keep_memory()
        optimiser = torch.optim.RAdam(model.parameters(), lr=1e-3, foreach=True)

        def update(model=model, optimiser=optimiser) -> int:
            optimiser.zero_grad()
            model(raw)["loss"].backward()
            optimiser.step()
            return raw.shape[0] * raw.shape[1]

        speed = rate(update, 5.0)
        first = first or speed
        yield what, speed, "pictures/s", "", "84 x 84, one thread"
    yield "  ratio to the plain form", speed / first, "x", "", "same process"
    torch.set_num_threads(threads)


def main() -> None:
    """Run the groups named on the command line (default: all) and print one table."""
    names = sys.argv[1:] or list(GROUPS)
    if {"-h", "--help"} & set(names):
        raise SystemExit(f"{__doc__}\ngroups: {', '.join(GROUPS)}")
    unknown = [name for name in names if name not in GROUPS]
    if unknown:
        raise SystemExit(f"error: unknown group {unknown[0]!r}; allowed: {', '.join(GROUPS)}")
    print(f"{'what':58} {'rate':>12} {'unit':14} {'reference':>14}  source")
    for name in names:
        for what, value, unit, reference, source in GROUPS[name]():
            print(f"{what:58} {value:12,.1f} {unit:14} {reference:>14}  {source}", flush=True)


if __name__ == "__main__":
    main()
