"""Does a solution do what its exercise says?

    python exercises/check.py 6                    # your own change of the scripts here
    python exercises/check.py 6 7                  # two exercises
    python exercises/check.py 7 alice.py bob.py    # files handed in: one line for each of them
    python exercises/check.py 9 alice bob          # folders that hold both scripts (exercise 9)
    python exercises/check.py same alice.py        # new options off: the same run, bit for bit?

README.md has the exercises; all but 10 have a check. A check looks only at what the scripts do: it
calls functions as the scripts given out call them, and options by the names that the exercise
states. It compares with the policy script as it was given out, exercises/reference/.
"""

import contextlib
import importlib.util
import io
import re
import subprocess
import sys
import traceback
from dataclasses import replace
from functools import partial
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
REFERENCE = ROOT / "exercises/reference"
reference = load("reference", REFERENCE / "ppo_actiongen.py")
hvae = reference.hvae
load_environment = hvae.load_environment  # Grid World as it was handed in


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


def check_01(order):
    agent, _, _, state, available = make(reference)
    seen = float(order.largest_change(agent, state, available))
    expect(0 <= seen < 1e-4, "logits that change by rounding alone", f"a change of {seen:.2g}")

    def by_place(
        fall, encoding, shown
    ):  # in the last state the first place is the best, whose ever
        logits = torch.zeros(shown.shape)
        logits[-1] = torch.arange(K, 0, -1)
        if not torch.equal(shown, available):
            logits[-1] -= fall  # of all, once they are shuffled
        return logits

    for fall in (0, 100):
        agent.utility = partial(by_place, fall)
        seen = float(order.largest_change(agent, state, available))
        expected = "a change where the logits go by the place (here: of the last state's actions)"
        expect(seen >= 1, expected, f"a change of {seen:.2g}")


def check_02(ppo):
    need_change(ppo)
    H = 64
    for bilinear in (True, False):
        agent, before, envs, state, available = make(ppo, hidden_size=H, bilinear=bilinear)
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


def check_04(path):
    gridworld = load_environment("gridworld")
    table = hvae.load_representation(path, "gridworld")["mean"]
    expect(table.shape == (1024, 2), "two numbers for each of 1,024 skills", table.shape)
    split = gridworld.split_actions()
    scores = hvae.probe(
        table, split["train"], np.union1d(split["valid"], split["test"]), "gridworld"
    )
    expected = "net_r2 above 0.99 (are differences of uint8 taken as such? 3 - 5 makes 254)"
    expect(scores["net_r2"] > 0.99, expected, scores["net_r2"])
    whole = (table == table.round()).all()
    expect(not whole, "means of recordings, in which walls stop some moves", "whole numbers")


def check_05(ppo):
    need_option(ppo, "outcome_coef")
    check_same(ppo)
    update = ppo.update
    rollouts = []

    def spy(agent, optimizer, batch, *rest, **more):
        # The target is V_t + delta_t, and delta_t = A_t - gamma lambda (1 - done_t) A_{t+1}.
        going_on = agent.args.gamma * reference.GAE_LAMBDA * (1 - batch["done"])
        later = torch.cat([batch["advantage"][1:], torch.zeros(1, N)])  # (T, N)
        target = batch["return"] - going_on * later
        known = [x for x in batch.values() if x.shape == target.shape]
        found = any(torch.allclose(x.float(), target, atol=1e-4) for x in known)
        expect(found, "the target of the first output in `batch`", [*batch])
        rollouts.append(target)
        if len(rollouts) > 1:  # what was learned in the first one may be hard to improve
            return update(agent, optimizer, batch, *rest, **more)
        numbers = [update(agent, optimizer, batch, *rest, **more) for _ in range(20)]
        expect("outcome_loss" in numbers[0], "a number outcome_loss", [*numbers[0]])
        first, last = numbers[0]["outcome_loss"], numbers[-1]["outcome_loss"]
        expect(last < 0.8 * first, "outcome_loss to fall in 20 updates", f"{first} to {last}")
        # Where nothing else moves the utility, the outcome does, by its weight.
        mb = {name: x.flatten(0, 1) for name, x in batch.items()}
        mb["advantage"] = torch.zeros_like(mb["advantage"])
        gradients = []
        for coef in (1.0, 0.5):
            agent.args.outcome_coef = coef
            optimizer.zero_grad()
            ppo.ppo_loss(agent, mb, 0.0)[0].backward()
            gradients.append(agent.utility_hidden.weight.grad)
        learns = gradients[1] is not None and gradients[1].abs().sum() > 0
        expect(learns, "the utility's hidden layer to learn from the outcome", "no gradient")
        ratio = (gradients[0].norm() / gradients[1].norm()).item()
        expect(abs(ratio - 2) < 0.01, "twice the gradient with twice the outcome_coef", ratio)
        given = ppo.ppo_loss(agent, mb, 0.0)[1]["outcome_loss"].item()
        other = ppo.ppo_loss(agent, mb | {"done": 1 - mb["done"]}, 0.0)[1]["outcome_loss"].item()
        expect(given != other, "outcome_loss to depend on `done`", "it does not")
        return numbers[-1]

    ppo.update = spy
    train(ppo, outcome_coef=0.5)


def check_06(ppo):
    need_change(ppo)
    for method in ("utility", "nearest-neighbor", "continuous"):
        agent, before, envs, *_ = make(ppo, method=method)
        expect_pi_in_evaluate(ppo, agent, before)
        batch = rollout_and_update(ppo, agent, envs, num_steps=128)
        if method == "continuous":  # nothing changes
            continue
        with torch.no_grad():
            code, _ = before.encode(batch["state"])
            pi = before.choice_policy(code, batch["available"])
            _, numbers = ppo.ppo_loss(agent, batch, 0.05)
        mixture = 0.9 * pi.probs + 0.1 / pi.probs.shape[1]  # (T * N, n)
        drawn = batch["drawn"][:, None]
        expected = mixture.gather(1, drawn)[:, 0].log()
        what = f"log-probabilities of 0.9 pi + 0.1 / n in a rollout of {method}"
        expect_close(batch["logprob"], expected, what)
        rare = pi.probs < 0.02  # drawn mostly by the uniform part
        often, seen = (mixture * rare).sum().item(), rare.gather(1, drawn).sum().item()
        expected = f"about {often:.0f} of {len(drawn)} draws where pi is below 0.02"
        expect(abs(seen - often) < 5 * often**0.5, expected, seen)
        entropy, seen = pi.entropy().mean().item(), numbers["entropy"].item()
        expect(abs(seen - entropy) < 1e-4, f"the entropy of pi, {entropy:.4f}, in the bonus", seen)
        expect_pi_in_evaluate(ppo, agent, before)  # after a rollout as well


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
    agent, before, envs, state, available = make(ppo, table, bilinear=True, num_available=512)
    rollout_and_update(ppo, agent, envs, num_steps=8)
    agent.utility_query.weight.data.zero_()
    columns = []
    for d in range(table.shape[1]):
        agent.utility_query.bias.data.zero_()[d] = 1
        noise = log_probs(agent, state[:1], available[:1])[0] - before.table[available[0], d]
        ratio = (noise.std() / before.table[train_ids, d].std()).item()
        expect(0.42 < ratio < 0.58, "noise of 0.5 standard deviations of training actions", ratio)
        columns.append(noise.numpy())
    alike = np.abs(np.corrcoef(columns) - np.eye(len(columns))).max()
    expect(alike < 0.3, "a draw for each number of the table", f"a correlation of {alike:.2f}")

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
    agent, before, envs, state, available = make(ppo)
    given_out = dict(before.named_parameters())
    for name, weight in agent.named_parameters():
        if name not in given_out:  # the new layer, which may have started with zeros
            torch.nn.init.normal_(weight, 0.0, 0.3)
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
    more = log_probs(agent, state, torch.cat([available, available[:, -1:].repeat(1, K)], dim=1))
    change = (expected[:, 0] - expected[:, 1] - more[:, 0] + more[:, 1]).abs().max().item()
    expect(change > 0.01, "a mean: other odds if one action comes often", f"a change of {change}")
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
            expect(env.observation_space.contains(obs), "-1 in the observation space", "none")
            expect(truncated == (choice == 1), "truncated when nothing is left, not before", "no")
            if choice == 0:
                with contextlib.suppress(ValueError):
                    env.step(choice)
                    raise Wrong("expected a ValueError for a used skill; seen: none")

    gridworld = load_environment("gridworld")  # three skills that end at the goal, all used
    skills = sorted(gridworld.SKILL_NAMES.index(name) for name in ("RRRRR", "RDDDD", "DDLLL"))
    env = gridworld.GridWorldEnv(skills, 3, once=True)
    env.reset(options={"layout": 0})
    for name in ("RRRRR", "RDDDD", "DDLLL"):
        ended = env.step(skills.index(gridworld.SKILL_NAMES.index(name)))[2:4]
    expect(ended == (True, False), "terminated, not truncated, at the goal", ended)


def check_11(recsys):
    ids = np.argsort(-recsys.POPULARITY)[:40]  # a try is a click 6 times in 10
    env = recsys.RecSysEnv(ids, 2)
    env.reset(seed=0)
    first = np.zeros((2, 2), int)  # clicks and tries of two products, up to their first click
    again = np.zeros(2, int)  # and afterwards
    for _ in range(300):
        env.reset()
        clicked = [False, False]
        for choice in [0] * 6 + [1] * 6 + [0] * 3:
            if env.ending:
                break
            click = bool(env.step(choice)[1])
            if clicked[choice]:
                again += (click, 1)
            else:
                first[choice] += (click, 1)
            clicked[choice] |= click
    if again[0] > 0.45 * again[1]:
        raise Wrong("not begun: what was clicked is clicked again, as before")
    seen = f"{again[0]} clicks in {again[1]} tries"
    expect(again[0] == 0, "no second click of a product in an episode", seen)
    for clicks, tries in first:
        expected = "first clicks as often as before, after every reset, for every product"
        expect(clicks > 0.45 * tries, expected, f"{clicks} clicks in {tries} tries")

    for seed in range(200):  # after a click: the same product again, or another one, not clicked
        users = []
        for second in (0, 1):
            env.reset(seed=seed)
            for choice in (0, second):
                if not env.ending:
                    env.step(choice)
            if list(map(bool, env.clicks)) == [True, False]:
                users.append(env.user)
        drawn = len(users) < 2 or np.allclose(*users)
        expect(drawn, "the same random numbers, whether a product was clicked or not", "others")

    env = recsys.RecSysEnv(recsys.split_actions()["test"], 500)
    rng = np.random.default_rng(0)
    for policy in ("oracle", "mu-only"):
        ctr = []
        repeats = 0
        for seed in range(40):
            ctr.append(recsys.play(env, policy, rng, seed))
            repeats += len(env.choices) - len(set(env.choices))
            bought = set()
            for choice, click in zip(env.choices, env.clicks, strict=True):
                again = choice in bought
                expect(not again, "`play` to recommend nothing that was clicked", f"{policy} does")
                if click:
                    bought.add(choice)
        expect(np.mean(ctr) > 0.5, f"a CTR above 0.5 of {policy}, which remembers", np.mean(ctr))
        expect(repeats > 0, "what was not clicked to be recommended again", "never")


def check_12(hvae):
    module = load_environment("gridworld")
    split = module.split_actions()
    held_out = np.union1d(split["valid"], split["test"])
    rng = np.random.default_rng(0)
    table = rng.normal(3.0, 0.3, (1024, 8))  # says little, around 3
    table[:, :3] = module.engineered_representations()[:, :3]  # says something
    table[split["train"], 3] *= rng.uniform(size=512)  # of training skills alone
    table[:, 4] *= 2  # standard deviation 0.6, variance 0.36
    scores = hvae.probe(table, split["train"], held_out, "gridworld")
    if "dims_in_use" not in scores:
        raise Wrong("not begun: probe has no score dims_in_use")
    expected = "4 dimensions in use (standard deviation above 0.5 over the held-out actions)"
    expect(scores["dims_in_use"] == 4, expected, scores["dims_in_use"])
    expect("nn_class" in scores, "the other scores as well", [*scores])


def random_rewards(gridworld, steps=3000):
    """What random choices earn in Grid World; some of them reach the goal."""
    env = gridworld.GridWorldEnv()
    env.reset(seed=0)
    rewards = []
    for choice in np.random.default_rng(0).integers(env.num_available, size=steps):
        _, reward, terminated, truncated, _ = env.step(choice)
        rewards.append(reward)
        if terminated or truncated:
            env.reset()
    return np.array(rewards)


def check_same(ppo):
    weights = train(ppo)
    rewards = random_rewards(load_environment("gridworld"))
    given_out = load("gridworld", REFERENCE / "gridworld.py")  # not the one that was handed in
    expected = train(reference)
    change = np.abs(rewards - random_rewards(given_out)).max()
    expect(change == 0, "the same rewards in Grid World", f"a difference of {change:.2g}")
    others = weights.keys() ^ expected.keys()
    expect(not others, "no other layers while new options are off", others)
    for name, x in expected.items():
        same = torch.equal(weights[name], x)
        expect(same, f"the same bits in {name} while new options are off", "others")


# ---- the command line ----

CHECKS = {"01": check_01, "02": check_02, "03": check_03, "04": check_04, "05": check_05}
CHECKS |= {"06": check_06, "07": check_07, "08": check_08, "09": check_09, "11": check_11}
CHECKS |= {"12": check_12, "same": check_same}
# What is handed in, if it is not the policy script (for 9: Grid World as well, so a folder).
FILES = {"01": "order.py", "03": "gridworld.py", "04": "net.npz", "11": "recsys.py"}
FILES |= {"12": "hvae.py"}
SECONDS = 600  # time limit of a file, where several are checked


def grade(number, work):
    """Check a file, or a folder of files: "ok", or a sentence that says what is wrong."""
    work = work.resolve()
    main = FILES.get(number, "ppo_actiongen.py")
    # A script that is not handed in is the one that was given out.
    paths = {name: REFERENCE / name for name in ("gridworld.py", main)}
    try:
        if work.is_dir():
            paths.update({name: work / name for name in paths if (work / name).exists()})
        elif work.suffix == ".py" and "class GridWorldEnv" in work.read_text(encoding="utf-8"):
            paths["gridworld.py"] = work
        else:
            paths[main] = work
        if not paths[main].exists():
            raise Wrong(f"not begun: there is no {main}")
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            handed_in = load("gridworld", paths["gridworld.py"])
            if main == "net.npz":
                handed_in = paths[main]
            elif main != "gridworld.py":
                handed_in = load("handed_in", paths[main])
            CHECKS[number](handed_in)
    except Wrong as e:
        return str(e)
    except (Exception, SystemExit) as e:
        # A script that fails: where in it was that?
        where = ""
        for frame in traceback.extract_tb(e.__traceback__):
            if Path(frame.filename) in paths.values():
                where = f" ({Path(frame.filename).name}, line {frame.lineno})"
        return f"{type(e).__name__}: {e}{where}".replace("\n", " ")
    return "ok"


def grade_alone(number, work):
    """`grade` in a process of its own: one student's endless loop or changed torch stays there."""
    command = [sys.executable, __file__, number, str(work)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return f"not finished after {SECONDS} seconds"
    last = (done.stderr + done.stdout).strip().splitlines()[-1:]  # none if Python crashed
    return "".join(last).removeprefix(f"{work}: exercise {number}: ") or "Python crashed"


def main(words):
    if not words or "-h" in words or "--help" in words:
        print(__doc__)
        return
    words = [word.zfill(2) if re.fullmatch("[0-9]", word) else word for word in words]
    numbers = [word for word in words if word in CHECKS]
    works = [Path(word) for word in words if word not in CHECKS]
    for work in works:
        if not numbers or not work.exists():
            sys.exit(f"error: {work} is no file, and only {', '.join(CHECKS)} have a check")
    several = len(works) * len(numbers) > 1
    results = []
    for work in works or [ROOT]:
        for number in numbers:
            results.append(grade_alone(number, work) if several else grade(number, work))
            file = f"{work}: " if works else ""
            print(f"{file}exercise {number}: {results[-1]}", flush=True)
    sys.exit(results.count("ok") < len(results))


if __name__ == "__main__":
    main(sys.argv[1:])
