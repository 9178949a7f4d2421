"""Does a solution do what its exercise says?

    python exercises/check.py 6                    # your own change of the scripts here
    python exercises/check.py 6 7                  # two exercises
    python exercises/check.py 7 alice.py bob.py    # files handed in: one line for each of them
    python exercises/check.py 9 alice bob          # folders that hold both scripts (exercise 9)
    python exercises/check.py same alice.py        # new options off: the same run, bit for bit?

README.md has the exercises; there are checks for 2, 3, 5, 6, 7, 8 and 9. A check looks only at what
the scripts do: it calls functions as the scripts given out call them, and options by the names that
the exercise states. It compares with the policy script as it was given out, exercises/reference/.
"""

import contextlib
import importlib.util
import io
import re
import sys
import traceback
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp

import gymnasium as gym
import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

ROOT = Path(__file__).resolve().parent.parent
torch.set_num_threads(1)  # as in the scripts
RUNS = TemporaryDirectory(ignore_cleanup_errors=True)
N = 8  # environments
K = 20  # available skills


def load(name, path):
    """Import a file under this name, in place of what had the name before."""
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


sys.path.insert(0, str(ROOT))
reference = load("reference", ROOT / "exercises/reference/ppo_actiongen.py")
load_environment = reference.hvae.load_environment  # Grid World as it was handed in


# ---- what the checks share ----


class Wrong(Exception):
    """A sentence: what was expected and what was seen."""


def expect(condition, expected, seen):
    if not condition:
        raise Wrong(f"expected {expected}; seen: {seen}")


def expect_close(a, b, expected):
    difference = (a - b).abs().max().item()
    expect(difference < 1e-4, expected, f"a difference of {difference:.2g}")


def need_option(ppo, name):
    if not hasattr(ppo.Args(), name):
        raise Wrong(f"not begun: Args has no option {name}")


def need_change(ppo):
    texts = [Path(module.__file__).read_text(encoding="utf-8") for module in (ppo, reference)]
    if texts[0] == texts[1]:
        raise Wrong("not begun: ppo_actiongen.py is as it was given out")


class Placed(gym.vector.VectorWrapper):
    """Grid World whose actions also have a position, which does nothing."""

    def __init__(self, envs):
        super().__init__(envs)
        position = gym.spaces.Box(-1, 1, (2,))
        self.single_action_space = gym.spaces.Dict(choice=gym.spaces.Discrete(K), position=position)

    def step(self, actions):
        return self.env.step(actions["choice"])


def tiny(ppo, **options):
    """Args of a very small policy, in a runs_dir of its own."""
    options = dict(hidden_size=16, minibatch_size=64, num_available=K, valid_episodes=8) | options
    args = replace(ppo.default_args("gridworld"), representation="engineered", num_envs=N)
    return replace(args, runs_dir=mkdtemp(dir=RUNS.name), eval_available=K, **options)


def make(ppo, table=None, **options):
    """An agent, one of the reference with its weights, environments, their first observation."""
    gridworld = load_environment("gridworld")
    args = tiny(ppo, **options)
    ids = gridworld.split_actions()["train"]
    envs, obs = ppo.make_envs(args, (ids, args.num_available), N, (0,))
    if args.aux_conditioned:
        envs = Placed(envs)
    if table is None:
        table = gridworld.engineered_representations()
    torch.manual_seed(0)
    agent = ppo.Agent(envs, table, ids, args)
    for name, weight in agent.named_parameters():
        if name in ("utility_out.weight", "utility_query.weight", "fc_alpha.2.weight"):
            weight.data *= 1000  # an agent with opinions
    before = reference.Agent(envs, table, ids, args)
    before.load_state_dict(agent.state_dict(), strict=False)
    return agent, before, envs, *agent.to_tensors(obs)


@torch.no_grad()
def log_probs(agent, state, available):
    """Log-probabilities of all available actions (B, K): `act` judges each of them."""
    size, K = available.shape
    rows = torch.arange(size).repeat_interleave(K)  # (B * K,)
    output = torch.arange(K).repeat(size)
    action = dict(drawn=output, choice=output, action_id=available.flatten())
    return agent.act(state[rows], available[rows], action)[1].view(size, K)


def rollout_and_update(ppo, agent, envs, num_steps=32):
    """A rollout, flat. Its update at learning rate 0 has to find ratios of 1, finite gradients."""
    batch, *_ = ppo.rollout(envs, envs.reset()[0], agent, num_steps)
    batch |= {"advantage": batch["reward"], "return": batch["value"]}
    numbers = ppo.update(agent, torch.optim.SGD(agent.parameters(), 0.0), batch, 0.05)
    unmoved = abs(numbers["approx_kl"]) < 1e-5 and numbers["clip_fraction"] == 0
    expect(unmoved, "ratios of 1 while no weight has changed", numbers)
    finite = all(p.grad is None or p.grad.isfinite().all() for p in agent.parameters())
    expect(finite, "finite gradients", "others")
    return {name: x.flatten(0, 1) for name, x in batch.items()}


def expect_pi_in_evaluate(ppo, agent, before):
    """While `evaluate` plays, actions are drawn with the probabilities that the reference has."""
    act = agent.act

    def spy(state, available, *rest, **more):
        result = act(state, available, *rest, **more)
        expected = before.act(state, available, dict(result[0]))[1]
        expect_close(result[1], expected, "the policy as it was in `evaluate`")
        return result

    agent.act = spy
    ppo.evaluate(agent, (agent.train_ids.numpy(), K), 8, (0,))
    del agent.act


def train(ppo, **options):
    """Two updates, without the test; the weights of best.pt."""
    ppo.finish = lambda folder, *_: folder
    sizes = dict(total_timesteps=512, minibatch_size=256, num_minibatches=1, learning_rate=0.01)
    folder = ppo.train(tiny(ppo, **sizes, **options))
    return ppo.load(folder / "best.pt")["agent"]


# ---- the checks ----


def check_02(ppo):
    need_change(ppo)
    H = 64
    agent, before, envs, state, available = make(ppo, hidden_size=H)
    expected = log_probs(before, state, available)
    expect_close(log_probs(agent, state, available), expected, "the same logits as before")
    flops = []
    many = torch.arange(N).repeat(16)  # more pairs than actions: pairs decide the cost
    for policy in (before, agent):
        with FlopCounterMode(display=False) as counter:
            policy.act(state[many], available[many])
        flops.append(counter.get_total_flops())
    pairs = len(many) * K * 2 * (2 * H * H)  # the hidden layer for every pair of state and action
    seen = f"{flops[1]:,}, and {flops[0]:,} as it was given out"
    expect(flops[1] - flops[0] > 0.8 * pairs, f"{pairs:,} operations for concatenated pairs", seen)
    rollout_and_update(ppo, agent, envs)


def check_03(_):
    gridworld = load_environment("gridworld")

    def play(skills):  # all skills are available; the river is x = 3, its opening y = 1
        env = gridworld.GridWorldEnv(np.arange(1024), 1024)
        env.reset(options={"layout": 0})
        names = gridworld.SKILL_NAMES
        return [round(float(env.step(names.index(skill))[1]), 6) for skill in skills.split()]

    short = play("RRRRR RDDDD DDLLL")
    if short == [0.1, 0, 0.784]:
        raise Wrong("not begun: the goal is paid for as it was")
    expect(short == [0.1, 0, 0.024], "rewards 0.1, 0, 0.024 for 12 moves to the goal", short)
    longer = play("LLLLL RRRRR RDDDD DDLLL")
    expect(longer == [0, 0.1, 0, 0.034], "0.034 at the goal after five moves more", longer)


def check_05(ppo):
    need_option(ppo, "outcome_coef")
    check_same(ppo)
    update = ppo.update

    def spy(agent, optimizer, batch, ent_coef):
        numbers = [update(agent, optimizer, batch, ent_coef) for _ in range(20)]
        expect("outcome_loss" in numbers[0], "a number outcome_loss", [*numbers[0]])
        first, last = numbers[0]["outcome_loss"], numbers[-1]["outcome_loss"]
        expect(last < 0.8 * first, "outcome_loss to fall in 20 updates", f"{first} to {last}")
        # Where nothing else moves the utility, the outcome does.
        mb = {name: x.flatten(0, 1) for name, x in batch.items()}
        mb["advantage"] = torch.zeros_like(mb["advantage"])
        optimizer.zero_grad()
        ppo.ppo_loss(agent, mb, 0.0)[0].backward()
        gradient = agent.utility_hidden.weight.grad
        learns = gradient is not None and gradient.abs().sum() > 0
        expect(learns, "the utility's hidden layer to learn from the outcome", "no gradient")
        return numbers[-1]

    ppo.update = spy
    train(ppo, outcome_coef=0.5)


def check_06(ppo):
    need_change(ppo)
    agent, before, envs, *_ = make(ppo)
    expect_pi_in_evaluate(ppo, agent, before)
    batch = rollout_and_update(ppo, agent, envs, num_steps=128)
    with torch.no_grad():
        code, _ = before.encode(batch["state"])
        pi = before.choice_policy(code, batch["available"])
        _, numbers = ppo.ppo_loss(agent, batch, 0.05)
    mixture = 0.9 * pi.probs + 0.1 / K  # (T * N, K)
    drawn = batch["drawn"][:, None]
    expected = mixture.gather(1, drawn)[:, 0].log()
    expect_close(batch["logprob"], expected, "log-probabilities of 0.9 pi + 0.1 / K in a rollout")
    rare = pi.probs < 0.02  # drawn mostly by the uniform part
    often, seen = (mixture * rare).sum().item(), rare.gather(1, drawn).sum().item()
    expected = f"about {often:.0f} of {len(drawn)} draws where pi is below 0.02"
    expect(abs(seen - often) < 5 * often**0.5, expected, seen)
    entropy, seen = pi.entropy().mean().item(), numbers["entropy"].item()
    expect(abs(seen - entropy) < 1e-4, f"the entropy of pi, {entropy:.4f}, in the bonus", seen)


def check_07(ppo):
    need_change(ppo)
    agent, before, envs, state, available = make(ppo)
    seen = [log_probs(before, state, available)]
    for _ in range(2):
        rollout_and_update(ppo, agent, envs)
        seen.append(log_probs(agent, state, available))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        expect((seen[a] - seen[b]).abs().max() > 0.01, "other noise in every rollout", "the same")
    expect_pi_in_evaluate(ppo, agent, before)

    # How much noise? A utility c[d] shows it. Here unseen actions differ more than training ones.
    gridworld = load_environment("gridworld")
    train_ids = gridworld.split_actions()["train"]
    table = 3 * gridworld.engineered_representations()
    table[train_ids] /= 3
    agent, _, envs, state, available = make(ppo, table, bilinear=True, num_available=512)
    rollout_and_update(ppo, agent, envs, num_steps=8)
    agent.utility_query.weight.data.zero_()
    for d in range(table.shape[1]):
        agent.utility_query.bias.data.zero_()[d] = 1
        noise = log_probs(agent, state[:1], available[:1])[0] - agent.table[available[0], d]
        ratio = (noise.std() / agent.table[train_ids, d].std()).item()
        expect(0.42 < ratio < 0.58, "noise of 0.5 standard deviations of training actions", ratio)

    # The position head of C.4 reads representations, too: the odds of two positions change.
    agent, before, envs, *_ = make(ppo, aux_conditioned=True)
    batch = rollout_and_update(ppo, agent, envs)
    scores = []
    for policy in (before, agent):
        for x in (-0.5, 0.5):
            action = batch | {"position": torch.full((len(batch["drawn"]), 2), x)}
            scores.append(policy.act(batch["state"], batch["available"], action)[1])
    change = (scores[0] - scores[1] - scores[2] + scores[3]).abs().max()
    expect(change > 1e-3, "noise in the position head (C.4)", "none")


def check_08(ppo):
    need_change(ppo)
    agent, _, envs, state, available = make(ppo)
    expected = log_probs(agent, state, available)
    order = torch.randperm(K)
    shuffled = log_probs(agent, state, available[:, order])
    expect_close(shuffled, expected[:, order], "probabilities that move with their actions")
    # The first two skills among other ones: without a summary they keep their odds.
    other = log_probs(agent, state, torch.cat([available[:, :2], available[:, 2:].flip(0)], dim=1))
    change = (expected[:, 0] - expected[:, 1] - other[:, 0] + other[:, 1]).abs().max().item()
    expect(change > 0.01, "odds of two actions that depend on the others", f"a change of {change}")
    twice = log_probs(agent, state, available.repeat(1, 2))[:, :K] + np.log(2)
    expect_close(twice, expected, "a mean: the same odds if every action is there twice")
    rollout_and_update(ppo, agent, envs)


def check_09(ppo):
    need_option(ppo, "once")
    for bilinear in (False, True):
        agent, _, envs, state, available = make(ppo, once=True, bilinear=bilinear)
        padded = torch.where(torch.rand(N, K) < 0.5, -1, available)
        seen = log_probs(agent, state, padded).exp()
        expect((seen[padded < 0] == 0).all(), "probability 0 for -1", seen[padded < 0].max().item())
        for n in range(N):
            kept = padded[n] >= 0
            alone = log_probs(agent, state[n : n + 1], available[n : n + 1, kept]).exp()
            expect_close(seen[n, kept], alone[0], "the others as if no -1 were there")
        batch = rollout_and_update(ppo, agent, envs)
        expect(batch["available"].min() == -1, "-1 for used skills in a rollout", "none")
    for method in ("nearest-neighbor", "continuous"):
        agent, _, _, state, available = make(ppo, once=True, method=method)
        padded = torch.where(torch.rand(100 * N, K) < 0.5, -1, available.repeat(100, 1))
        taken = agent.act(state.repeat(100, 1), padded)[0]["action_id"]
        expect(taken.min() >= 0, f"no -1 taken by --method {method}", f"{(taken < 0).sum()} of 800")

    env = load_environment("gridworld").GridWorldEnv([682, 1023], 2, once=True)
    for _ in range(2):
        obs, _ = env.reset()
        expect(min(obs["available"]) >= 0, "all skills after a reset", obs["available"])
        for choice in (0, 1):  # LLLLL, UUUUU: the agent stays where it is
            obs, _, _, truncated, _ = env.step(choice)
            expect(obs["available"][choice] == -1, "-1 for a used skill", obs["available"])
            expect(truncated == (choice == 1), "truncated when nothing is left, not before", "no")


def check_same(ppo):
    weights, expected = train(ppo), train(reference)
    others = weights.keys() ^ expected.keys()
    expect(not others, "no other layers while new options are off", others)
    for name, x in expected.items():
        same = torch.equal(weights[name], x)
        expect(same, f"the same bits in {name} while new options are off", "others")


# ---- the command line ----

CHECKS = {"02": check_02, "03": check_03, "05": check_05, "06": check_06, "07": check_07}
CHECKS |= {"08": check_08, "09": check_09, "same": check_same}


def grade(number, work):
    """Check a script, or a folder of scripts: "ok", or a sentence that says what is wrong."""
    work = work.resolve()
    grid, policy = ROOT / "gridworld.py", ROOT / "ppo_actiongen.py"
    try:
        if work.is_dir():
            grid = work / grid.name if (work / grid.name).exists() else grid
            policy = work / policy.name if (work / policy.name).exists() else policy
        elif "class GridWorldEnv" in work.read_text(encoding="utf-8"):
            grid = work
        else:
            policy = work
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            load("gridworld", grid)
            CHECKS[number](load("ppo_actiongen", policy))
    except Wrong as e:
        return str(e)
    except (Exception, SystemExit) as e:
        # A script that fails: where in it was that?
        where = ""
        for frame in traceback.extract_tb(e.__traceback__):
            if Path(frame.filename) in (grid, policy):
                where = f" ({Path(frame.filename).name}, line {frame.lineno})"
        return f"{type(e).__name__}: {e}{where}".replace("\n", " ")
    return "ok"


def main(words):
    if not words or "-h" in words or "--help" in words:
        print(__doc__)
        return
    words = [word.zfill(2) if re.fullmatch("[0-9]", word) else word for word in words]
    numbers = [word for word in words if word in CHECKS]
    works = [Path(word) for word in words if word not in CHECKS]
    for work in works:
        if not numbers or not work.exists():
            sys.exit(f"error: {work} is neither a file nor one of {', '.join(CHECKS)}")
    results = []
    for work in works or [ROOT]:
        for number in numbers:
            results.append(grade(number, work))
            file = f"{work}: " if works else ""
            print(f"{file}exercise {number}: {results[-1]}", flush=True)
    sys.exit(results.count("ok") < len(results))


if __name__ == "__main__":
    main(sys.argv[1:])
