"""Does a solution show what its exercise is about? Before you commit it:

    python exercises/check.py 06      # any of 02, 03, 05, 06, 07, 08, 09

`new` is the policy script as it is now, `old` the one that git has. Flags and attributes are called
as in the worked solutions, NN-*.patch here.
"""

import csv
import importlib
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import torch
from torch.testing import assert_close

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
gridworld, new = map(importlib.import_module, ("gridworld", "ppo_actiongen"))
show = ["git", "show", ":./ppo_actiongen.py"]  # from the index: changes that are not added differ
source = subprocess.run(show, cwd=ROOT, check=True, capture_output=True, text=True).stdout
old = sys.modules["old"] = types.ModuleType("old")
old.__file__ = new.__file__
exec(compile(source, "old.py", "exec"), vars(old))
N, K = 8, 20  # environments, skills on offer


def tiny(ppo, **flags):
    words = dict(representation="engineered", num_envs=N, hidden_size=16, minibatch_size=64)
    words |= dict(num_available=K, eval_available=K, valid_episodes=8, runs_dir=mkdtemp())
    return replace(ppo.default_args("gridworld"), **words | flags)


def make(ppo, **flags):
    """An agent with opinions (its last layer times 100), environments, a state and sets."""
    args, ids = tiny(ppo, **flags), gridworld.split_actions()["train"]
    envs, table = ppo.make_envs(args, ids, N, K, 0), gridworld.engineered_representations()
    torch.manual_seed(0)
    agent = ppo.Agent(envs, table, ids, args)
    (agent.utility_query if args.bilinear else agent.utility_out).weight.data *= 100
    return agent, envs, *agent.see(envs.reset(seed=0)[0])


@torch.no_grad()
def logits(agent, state, available, P=None):
    P = agent.project_actions() if P is None else P
    return agent.choice_logits(agent.encode(state)[0], available, P)


def rollout_and_ratios(agent, envs):
    """A rollout; then its update at learning rate 0 finds ratios of 1 and finite gradients."""
    batch, *_ = new.rollout(envs, envs.reset()[0], agent, 32)
    b = batch | {"advantage": batch["reward"], "return": batch["value"]}
    parts = new.update(agent, torch.optim.SGD(agent.parameters(), 0.0), b, 0.05, agent.args)
    assert abs(parts["approx_kl"]) < 1e-5 and parts["clip_fraction"] == 0, parts
    assert all(p.grad is None or p.grad.isfinite().all() for p in agent.parameters())
    return batch


def evaluate(agent):
    new.evaluate(agent, (agent.train_ids.numpy(), K), 8, (0,))


def check_02():
    (agent, _, state, available), (before, *_) = make(new), make(old)
    expected = logits(before, state, available)
    new.utility = new.Utility = None  # neither is called any more
    P = agent.action_project(agent.table)  # nor is anything multiplied in advance
    assert_close(logits(agent, state, available, P), expected, atol=1e-5, rtol=0)
    rollout_and_ratios(agent, make(new)[1])


def check_03():
    def play(skills):  # all skills are on offer; the river is x = 3, its opening y = 1
        env = gridworld.GridWorldEnv(np.arange(1024), 1024)
        env.reset(options={"layout": 0})
        return [env.step(gridworld.SKILL_NAMES.index(skill))[1] for skill in skills.split()]

    short, longer = play("RRRRR RDDDD DDLLL"), play("LLLLL RRRRR RDDDD DDLLL")
    np.testing.assert_allclose(short, [0.1, 0, (1 - 0.9) * 12 / 50])
    np.testing.assert_allclose(sum(longer) - sum(short), (1 - 0.9) * 5 / 50)


def check_05():
    def train(ppo, **flags):
        flags |= dict(total_timesteps=512, minibatch_size=256, num_minibatches=1)
        folder = ppo.train(tiny(ppo, learning_rate=0.01, **flags))
        rows = list(csv.DictReader((folder / "metrics.csv").read_text().splitlines()))
        return rows, ppo.load(folder / "best.pt")["agent"]

    def spy(agent, optimizer, batch, *rest):
        after = 0.99 * (1 - batch["done"][:-1]) * batch["value"][1:]
        scaled = batch["value_after"][:-1] - after  # the reward, with the scale V is learned at
        assert torch.equal(scaled.abs() > 1e-5, batch["reward"][:-1] > 0)
        losses = [update(agent, optimizer, batch, *rest)["outcome_loss"] for _ in range(20)]
        assert losses[-1] < 0.8 * losses[0], losses
        return update(agent, optimizer, batch, *rest)

    new.finish = old.finish = lambda folder, *_: folder  # no test, no pictures
    (rows_before, before), (_, weights) = train(old), train(new, outcome_coef=0.0)
    assert all(torch.equal(weights[name], before[name]) for name in before)
    update, new.update = new.update, spy
    rows, _ = train(new, outcome_coef=0.5)
    assert rows[0]["episode_return"] == rows_before[0]["episode_return"]  # the same first rollout


def check_06():
    def probabilities():
        P, slots = agent.project_actions(), torch.arange(K).expand(N, K)
        every = [agent.act(state, available, P, dict(output=slots[:, k]))[1] for k in range(K)]
        return torch.stack(every, 1).exp()  # (N, K)

    (agent, envs, state, available), (before, *_) = make(new), make(old)
    pi = logits(before, state, available).softmax(1)
    evaluate(agent)
    assert_close(probabilities(), pi)
    assert rollout_and_ratios(agent, envs)["logprob"].exp().min() > 0.0999 / K
    assert_close(probabilities(), 0.9 * pi + 0.1 / K)
    assert_close(probabilities().sum(1), torch.ones(N))


def check_07():
    agent, envs, state, available = make(new)
    clean, seen = logits(agent, state, available), []
    for _ in range(2):
        rollout_and_ratios(agent, envs)
        seen.append(logits(agent, state, available))
    assert all((a - b).abs().max() > 0.01 for a, b in ((clean, seen[0]), seen))
    assert 0.48 < (agent.noise / agent.table[agent.train_ids].std(0)).std() < 0.52
    evaluate(agent)
    assert_close(logits(agent, state, available), clean)


def check_08():
    agent, envs, state, available = make(new)
    order, expected = torch.randperm(K), logits(agent, state, available)
    assert_close(logits(agent, state, available[:, order]), expected[:, order])
    # The first two skills among other ones: without a summary they keep their odds.
    other = torch.cat([available[:, :2], available[:, 2:].flip(0)], dim=1)
    odds = [x[:, 0] - x[:, 1] for x in (expected, logits(agent, state, other))]
    assert (odds[0] - odds[1]).abs().max() > 0.01
    rollout_and_ratios(agent, envs)


def check_09():
    for bilinear in (False, True):
        agent, envs, state, available = make(new, once=True, bilinear=bilinear)
        padded = torch.where(torch.rand(N, K) < 0.5, -1, available)
        pi = logits(agent, state, padded).softmax(1)
        for b in range(N):
            kept = padded[b] >= 0
            alone = logits(agent, state[b : b + 1], available[b : b + 1, kept]).softmax(1)
            assert_close(pi[b, kept], alone[0])
        assert pi[padded < 0].eq(0).all()
        batch = rollout_and_ratios(agent, envs)
        assert batch["available"].min() == -1 and batch["taken"].min() >= 0
    env = gridworld.GridWorldEnv([682, 1023], 2, once=True)  # LLLLL, UUUUU: it stays where it is
    for _ in range(2):  # nor does a reset find the skills used up
        env.reset()
        assert [env.step(slot)[3] for slot in (0, 1)] == [False, True]  # truncated: nothing left


if __name__ == "__main__":
    if f"check_{sys.argv[-1]}" not in globals():
        sys.exit(__doc__)
    globals()[f"check_{sys.argv[-1]}"]()
    print(f"exercise {sys.argv[-1]}: ok")
