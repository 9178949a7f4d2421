"""The policy script: its pieces against slow obvious versions, then whole short runs."""

import csv
import json
import math
import os
import pickle
import shlex
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from gymnasium import spaces
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch.distributions import Beta, Categorical, Normal

import create_env
import gridworld
import ppo_actiongen as ppo
from hvae import UserError

ROOT = Path(__file__).parent.parent
VECTOR = spaces.Box(-10, 10, (7,), np.float32)
FRAMES = spaces.Box(0, 255, (3, 84, 84), np.uint8)
PLACE, STOP = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2)
HYBRID = spaces.Dict(choice=spaces.Discrete(5), position=PLACE, stop=STOP)


def stand_in(state=VECTOR, action=None):
    """What an Agent wants to know about its environments."""
    action = action or spaces.Discrete(5)
    return SimpleNamespace(single_observation_space={"state": state}, single_action_space=action)


def make_agent(action=None, state=VECTOR, **changes):
    """A small agent with a random table of 30 actions, 20 of them trained on, and its arguments."""
    args = replace(ppo.default_args(recipe="paper"), **(dict(published_init=False) | changes))
    table = np.random.default_rng(0).standard_normal((30, 4)).astype(np.float32)
    return ppo.Agent(stand_in(state, action), table, np.arange(20), args), args


@pytest.fixture(autouse=True)
def seeded():
    """Every test draws its numbers from the same place, on one thread."""
    torch.manual_seed(0)
    torch.set_num_threads(1)


def random_sets(rows, K=5, A=30, seed=0):
    rng = np.random.default_rng(seed)
    return torch.as_tensor(np.stack([rng.choice(A, K, replace=False) for _ in range(rows)]))


# ---- the utility ----
def naive_logits(agent, code, available):
    """D.3.2 word for word: project c, concatenate [state; action], 2-layer MLP, one logit each."""
    c = agent.action_project(agent.table[available])  # (B, K, H)
    s = code[:, None].expand(-1, available.shape[1], -1)  # (B, K, H)
    hidden = F.relu(agent.utility_hidden(torch.cat([s, c], dim=-1)))  # (B, K, H)
    return agent.utility_out(hidden)[..., 0]  # (B, K)


@settings(max_examples=20, deadline=None)
@given(B=st.integers(1, 40), K=st.integers(1, 12), width=st.sampled_from([16, 64]))
@example(B=3000, K=5, width=64)  # 960,000 numbers: two pieces
def test_the_utility_equals_the_concatenation_of_the_appendix(B, K, width):
    agent, _ = make_agent(hidden_size=width)
    code, available = torch.randn(B, width).requires_grad_(), random_sets(B, K)
    weights, grads = torch.arange(1.0, B * K + 1).view(B, K).sin(), []
    for logits in (naive_logits(agent, code, available), agent.utility(code, available)):
        agent.zero_grad()
        code.grad = None
        (logits * weights).sum().backward()
        grads.append([p.grad.clone() for p in agent.parameters() if p.grad is not None])
        grads[-1] += [code.grad.clone(), logits.detach()]
    assert len(grads[0]) == len(grads[1]) == 8
    torch.testing.assert_close(grads[0][-1], grads[1][-1], rtol=0, atol=1e-5)
    order = torch.randperm(K)  # the policy does not care for the order of the available actions
    torch.testing.assert_close(logits[:, order], agent.utility(code, available[:, order]))
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


def test_the_papers_utility_is_uniform_at_first():
    code, sets = torch.randn(9, 64), random_sets(9)
    agent, _ = make_agent(published_init=True)
    logits = agent.utility(code, sets)
    # A constant per state does not matter to the softmax; the spread over actions does.
    assert (logits.max(1).values - logits.min(1).values).max() < 1e-5


# ---- distributions ----
METHODS = {}, {"bilinear": True}, {"method": "nearest-neighbor"}, {"method": "continuous"}


@pytest.mark.parametrize("conditioned", [False, True])
@pytest.mark.parametrize("changes", METHODS)
def test_log_probability_when_acting_equals_that_when_learning(changes, conditioned):
    agent, _ = make_agent(HYBRID, aux_conditioned=conditioned, **changes)
    state, sets = torch.randn(11, 7), random_sets(11, A=20)
    action, *acted = agent.act(state, sets)
    _, *learned = agent.act(state, sets, action)
    for a, b in zip(acted, learned, strict=True):
        torch.testing.assert_close(a, b)
    assert set(action) == {"drawn", "choice", "action_id", "position", "stop"}
    assert action["position"].abs().max() <= 1 and action["choice"].max() < 5
    assert torch.equal(action["action_id"], sets[torch.arange(11), action["choice"]])


def place_of(agent, code):
    """D.3.2: the Beta over positions."""
    return Beta(1 + F.softplus(agent.fc_alpha(code)), 1 + F.softplus(agent.fc_beta(code)))


def test_hybrid_log_probability_and_entropy_are_sums_of_their_parts():
    agent, _ = make_agent(HYBRID)
    state, sets = torch.randn(6, 7), random_sets(6)
    action, logprob, entropy, _ = agent.act(state, sets)
    code, _ = agent.encode(state)
    choice = Categorical(logits=naive_logits(agent, code, sets))
    place, stop = place_of(agent, code), Categorical(logits=agent.fc_stop(code))
    expected = choice.log_prob(action["choice"]) + stop.log_prob(action["stop"])
    expected = expected + place.log_prob(0.5 + action["position"] / 2).sum(1)
    torch.testing.assert_close(logprob, expected, rtol=1e-4, atol=1e-4)
    parts = choice.entropy() + stop.entropy() + 0.1 * place.entropy().sum(1)  # Table 3
    torch.testing.assert_close(entropy, parts, rtol=1e-4, atol=1e-4)


def test_initial_beta_and_gaussian_have_the_published_widths():
    agent, _ = make_agent(HYBRID, method="continuous")
    state, sets = torch.zeros(20_000, 7), random_sets(1).expand(20_000, -1)
    action, logprob, entropy, _ = agent.act(state, sets)  # biases are 0: so is the code
    assert abs(action["position"].std().item() - 0.477) < 0.01  # alpha = beta = 1 + log 2
    assert abs(action["drawn"].std().item() - 0.833) < 0.01  # sigma^2 = softplus(0)
    agent.action_parts = {}
    _, logprob, entropy, _ = agent.act(state, sets, action)
    policy = Normal(torch.zeros(4), math.sqrt(math.log(2)))
    torch.testing.assert_close(logprob, policy.log_prob(action["drawn"]).sum(1))
    torch.testing.assert_close(entropy[0], policy.entropy().mean())


def test_conditioned_position_head_is_the_mlp_of_code_and_chosen_action():
    agent, _ = make_agent(HYBRID, aux_conditioned=True, published_init=True)
    agent.action_parts = {"position": PLACE}
    state, sets = torch.randn(7, 7), random_sets(7)
    action, together, *_ = agent.act(state, sets)
    code, _ = agent.encode(state)
    choice = Categorical(logits=naive_logits(agent, code, sets)).log_prob(action["choice"])
    for i in range(7):  # slow and obvious: one sample at a time
        both = torch.cat([code[i], agent.action_project(agent.table[action["action_id"][i]])])
        density = place_of(agent, both).log_prob((action["position"][i] + 1) / 2).sum()
        torch.testing.assert_close(together[i], density + choice[i], rtol=1e-4, atol=1e-4)
    fast, _ = make_agent(HYBRID, aux_conditioned=True)  # ours: the same place for all at first
    both = torch.cat([torch.randn(1, 64).expand(30, -1), 30 * torch.randn(30, 64)], 1)
    assert fast.fc_alpha(both).std() < 0.02 * agent.fc_alpha(both).std()


@pytest.mark.parametrize("method", ["nearest-neighbor", "continuous"])
def test_baselines_choose_what_is_nearest_even_far_from_the_origin(method):
    agent, _ = make_agent(method=method)
    agent.table += 1000  # squares near 1e6 for distances near 1: products would lose them
    sets = random_sets(200, A=10) + 20  # only actions 20..29: none of the training actions
    output = torch.randint(20, (200,))
    wish = agent.table[output]
    if method == "continuous":
        wish = output = agent.table[sets[:, 3]] + 0.3 * torch.randn(200, 4)
    for slot, w, offered in zip(agent.index_of(output, sets), wish.double(), sets, strict=True):
        distances = [float((w - agent.table[j].double()).square().sum()) for j in offered]
        assert slot == int(np.argmin(distances))


# ---- states ----
def test_small_pictures_are_means_of_blocks_and_zero_where_there_is_nothing():
    state = torch.randint(0, 256, (2, 3, 84, 84), dtype=torch.uint8)
    state[0, 2], state[1, 0] = 255, 0  # nothing but paper; before the episode
    small = ppo.small_inverted(state)
    blocks = 255 - state.unfold(2, 2, 2).unfold(3, 2, 2).float().mean((4, 5))  # (2, 3, 42, 42)
    blocks[1, 0] = 0
    assert small.dtype == torch.uint8 and not small[0, 2].any()
    assert (small - blocks).abs().max() < 1
    agent, _ = make_agent(HYBRID, FRAMES, small_pictures=True)
    near, far = (agent.encode(small[:1] // 4 * k)[0] for k in (1, 2))  # twice as dark, same code
    torch.testing.assert_close(near, far, rtol=0.05, atol=0.05)
    agent, _ = make_agent(HYBRID, FRAMES)
    torch.testing.assert_close(agent.encode(state)[0], agent.encoder(state / 255))


def test_states_are_brought_to_mean_0_and_standard_deviation_1():
    agent, _ = make_agent()
    agent.obs_stats.update(torch.tensor([1.0, 5.0]).repeat(50_000)[:, None].expand(-1, 7))
    state, same = torch.tensor([[[3.0, 5, 1, 3, 3, 3, 99]], [[0, 1, -1, 0, 0, 0, 10]]])
    torch.testing.assert_close(agent.encode(state)[0], agent.encoder(same), rtol=0, atol=1e-3)


def test_one_hot_states_name_each_of_the_ids_that_there_are():
    args, ids = ppo.default_args("gridworld"), [1, 2, 8, 9, 10, 11]
    envs, _ = ppo.make_envs(args, (np.arange(50), 50), 3, (0,))
    agent = ppo.Agent(envs, np.zeros((1024, 4)), np.arange(50), args)
    state = agent.to_tensors(envs.reset()[0])[0]
    named = [[float(cell == i) for cell in row for i in ids] for row in state.tolist()]
    torch.testing.assert_close(agent.encode(state)[0], agent.encoder(torch.tensor(named)))


def test_running_statistics_equal_those_of_all_data_at_once():
    batches, stats = [3 + 2 * torch.randn(n, 4) for n in (1, 5, 100)], ppo.RunningMeanStd((4,))
    for b in batches:
        stats.update(b)
    mean, std = stats.mean_std()
    everything = torch.cat(batches)
    torch.testing.assert_close(mean, everything.mean(0), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(std, everything.std(0, correction=0), rtol=1e-3, atol=1e-3)


# ---- PPO's arithmetic ----
def test_gae_and_running_returns_equal_their_definitions():
    r, v, nv = (torch.randn(s, dtype=torch.float64) for s in ((9, 3), (9, 3), (3,)))
    d = (torch.rand(9, 3) < 0.3).double()

    def slow(t, n):  # A_t = sum_l (gamma lam)^l delta_{t+l}, cut where the episode ends
        if t == 9:
            return 0.0
        after = v[t + 1, n] if t < 8 else nv[n]
        delta = r[t, n] + 0.9 * (1 - d[t, n]) * after - v[t, n]
        return delta + 0.9 * 0.8 * (1 - d[t, n]) * slow(t + 1, n)

    def so_far(t, n):  # G_t = r_t + gamma G_{t-1}, from the start of the episode
        return r[t, n] + (0.9 * (1 - d[t - 1, n]) * so_far(t - 1, n) if t else 0.0)

    advantages = ppo.gae(r, v, d, nv, 0.9, 0.8)
    first, G = ppo.running_returns(r[:4], d[:4], torch.zeros(3), 0.9)
    second, _ = ppo.running_returns(r[4:], d[4:], G, 0.9)  # goes on with the next rollout
    returns = torch.cat([first, second])
    for t, n in np.ndindex(9, 3):
        assert math.isclose(advantages[t, n], slow(t, n), abs_tol=1e-12)
        assert math.isclose(returns[t, n], so_far(t, n), abs_tol=1e-12)


@pytest.mark.parametrize("clip_vloss", [True, False])
def test_the_loss_has_the_gradient_of_the_naive_one(clip_vloss):
    agent, args = make_agent(clip_vloss=clip_vloss, vf_coef=0.3)
    sets, state = random_sets(32), torch.randn(32, 7)
    action, logprob, _, value = agent.act(state, sets)
    value, logprob = (x.detach() + 0.3 * torch.randn(32) for x in (value, logprob))
    adv, returns = torch.randn(2, 32)
    mb = dict(state=state, available=sets, logprob=logprob, value=value, advantage=adv)
    loss, _ = ppo.ppo_loss(agent, mb | action | {"return": returns}, 0.05)
    code, v = agent.encode(state)
    policy = Categorical(logits=naive_logits(agent, code, sets))
    ratio = (policy.log_prob(action["choice"]) - logprob).exp()
    surrogate = torch.min(ratio * adv, ratio.clamp(0.9, 1.1) * adv).mean()
    error = (v - returns) ** 2
    if clip_vloss:
        error = torch.max(error, (value + (v - value).clamp(-0.1, 0.1) - returns) ** 2)
    expected = -surrogate + 0.3 * 0.5 * error.mean() - 0.05 * policy.entropy().mean()
    torch.testing.assert_close(loss, expected)
    both = (torch.autograd.grad(x, [*agent.parameters()], retain_graph=True)
            for x in (loss, expected))  # fmt: skip
    for a, b in zip(*both, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-6)


# ---- Tables 3 and 4 ----
def test_paper_presets_are_tables_3_and_4():
    table3 = {  # entropy, K, steps, batch; published code: steps per environment and rollout
        "gridworld": (0.05, 50, 40_000_000, 4096, 512),
        "recsys": (0.01, 500, 40_000_000, 2048, 256),
        "create": (0.005, 50, 60_000_000, 3072, 384),
        "stacking": (0.01, 20, 3_000_000, 1024, 128),
    }
    for env, row in table3.items():
        a = ppo.default_args(env, "paper")
        T = a.minibatch_size * a.num_minibatches // a.num_envs
        assert (a.ent_coef, a.num_available, a.total_timesteps, a.minibatch_size, T) == row
        table4 = a.learning_rate, a.gamma, a.num_envs, a.hidden_size, a.vf_coef
        assert table4 == (1e-3, 0.99, 32, 64, 0.5)
        assert (a.update_epochs, a.clip_coef, ppo.AUX_ENT_SCALE) == (4, 0.1, 0.1)
        ours = a.one_hot, a.bilinear, a.small_pictures, a.aux_conditioned
        assert a.ent_floor == 1 and a.eval_available is None and ours == (False,) * 4
        assert a.published_init and a.clip_vloss and a.subsample
        budget = "quick total_timesteps eval_every eval_episodes hvae_recipe".split()
        quick = ppo.default_args(env, "paper", quick=True)  # smaller, and otherwise the paper's
        assert replace(quick, **{k: getattr(a, k) for k in budget}) == a
        assert quick.total_timesteps // quick.eval_every >= 4


def test_numbers_of_parameters_are_those_of_the_published_policies():
    four, x = spaces.Box(0, 255, (4, 84, 84)), spaces.Box(-1, 1, (1,))
    for env, state, action, D, count in (
        ("gridworld", spaces.Box(0, 11, (81,)), None, 16, 28_290),
        ("create", FRAMES, spaces.Dict(position=PLACE), 128, 61_302),
        ("stacking", four, spaces.Dict(position=x, stop=STOP), 128, 61_446),
    ):
        args = ppo.default_args(env, "paper")
        agent = ppo.Agent(stand_in(state, action), np.zeros((9, D)), np.arange(9), args)
        assert sum(p.numel() for p in agent.parameters()) == count


# ---- whole runs ----
TINY = "--representation engineered --minibatch-size 64 --eval-every 768 --valid-episodes 32"
TINY += " --eval-episodes 64 --total-timesteps 3072 --device cpu --run-name run"
SHORT = "--total-timesteps 768 --eval-every 256 --valid-episodes 4 --eval-episodes 8"
TORCHRUN = "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"


def words(folder, *extra):
    return ["gridworld", "--runs-dir", str(folder), *TINY.split(), *map(str, extra)]


def run(*command, **kwargs):
    kwargs = dict(capture_output=True, text=True, cwd=ROOT, timeout=300) | kwargs
    result = subprocess.run([sys.executable, *map(str, command)], **kwargs)
    assert result.returncode == 0, result.stderr
    return result.stdout


def small(folder, *extra):
    """A shorter run, in this process."""
    return ppo.main(words(folder, *SHORT.split(), *extra))


def rows_of(folder, *skip):
    rows = csv.DictReader((folder / "metrics.csv").read_text(encoding="utf-8").splitlines())
    return [{k: v for k, v in r.items() if k not in skip} for r in rows]


def assert_same_run(a, b):
    assert rows_of(a, "seconds", "sps") == rows_of(b, "seconds", "sps")
    weights = [ppo.load(folder / "checkpoint.pt")["agent"] for folder in (a, b)]
    assert all(torch.equal(weights[0][k], weights[1][k]) for k in weights[0])
    texts = [(folder / "results.json").read_text(encoding="utf-8") for folder in (a, b)]
    assert json.loads(texts[0])["test"] == json.loads(texts[1])["test"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of one finished tiny run, and what it printed."""
    folder = tmp_path_factory.mktemp("it's here")
    # A backend inherited from a notebook is none of its business.
    environ = os.environ | {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    return folder / "run", run("ppo_actiongen.py", *words(folder), env=environ)


def test_a_run_leaves_what_it_promises(finished):
    folder, out = finished
    names = {p.name for p in folder.iterdir()}
    files = "args.json metrics.csv checkpoint.pt best.pt results.json curve.png episode.gif"
    events = {name for name in names if name.startswith("events.")}
    assert events and names - events - {".lock"} == set(files.split())
    assert [r["step"] for r in rows_of(folder) if r["valid_score"]] == "768 1536 2304 3072".split()
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert results["test"]["episodes"] == 64 and results["metric"] == "success"
    assert shlex.split(results["command"])[1:] == ["ppo_actiongen.py", *words(folder.parent)]
    assert f"run: {folder}" in out and "unseen" in out and out.count("step ") == 4
    assert "note:" not in out and out.isascii()  # a console of any code page can show it
    best = torch.load(folder / "best.pt", weights_only=True)
    assert set(best) == {"args", "agent", "step"}  # small: no optimiser
    scores = {r["step"]: float(r["valid_score"]) for r in rows_of(folder) if r["valid_score"]}
    assert str(best["step"]) == max(scores, key=scores.get)  # validation has chosen


@pytest.mark.parametrize("rows", [1, 4])  # before the first checkpoint, and after it
def test_a_killed_and_resumed_run_equals_one_never_killed(finished, tmp_path, rows):
    command = [sys.executable, "ppo_actiongen.py", *words(tmp_path)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    metrics, deadline = tmp_path / "run" / "metrics.csv", time.time() + 120
    while time.time() < deadline and process.poll() is None:
        if metrics.exists() and len(metrics.read_text(encoding="utf-8").splitlines()) > rows:
            break
        time.sleep(0.002)
    process.kill()
    assert process.wait() != 0  # it was still running
    ppo.main(words(tmp_path, "--resume"))
    assert_same_run(finished[0], tmp_path / "run")


@pytest.mark.parametrize("extra, message", [("", "run exists: --resume"),
    ("--resume --ent-coef 0.3", "its ent_coef is 0.05")])  # fmt: skip
def test_an_existing_run_is_not_replaced(finished, extra, message):
    folder, before = finished[0], (finished[0] / "metrics.csv").read_bytes()
    with pytest.raises(UserError, match=message):
        ppo.main(words(folder.parent, *extra.split()))
    assert (folder / "metrics.csv").read_bytes() == before


def test_a_run_in_use_is_refused_and_an_empty_folder_is_not(tmp_path):
    (tmp_path / "run").mkdir()
    holder = "import filelock, sys, time; lock = filelock.FileLock(sys.argv[1]); lock.acquire()"
    holder += "; print(1, flush=True); time.sleep(60)"
    command = [sys.executable, "-c", holder, tmp_path / "run" / ".lock"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        with pytest.raises(UserError, match="run is in use by another process"):
            small(tmp_path)
        process.kill()
    small(tmp_path)  # what a killed process has left is no hindrance
    assert (tmp_path / "run" / "results.json").exists()


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_broken_and_foreign_checkpoints_are_refused_in_one_sentence(finished, tmp_path):
    good = (finished[0] / "checkpoint.pt").read_bytes()
    torch.save({"weights": torch.zeros(2)}, tmp_path / "foreign")
    broken = dict(truncated=good[: len(good) // 2], empty=b"", pickle=pickle.dumps({"args": 1}))
    for name, content in broken.items():
        (tmp_path / name).write_bytes(content)
    for name in (*broken, "foreign", "nowhere"):
        with pytest.raises(UserError, match=f"{name} is no checkpoint of this script") as e:
            ppo.load(tmp_path / name)
        assert "\n" not in str(e.value)
    # A student's option, a student's layer: each is named.
    student = torch.load(finished[0] / "checkpoint.pt", weights_only=True)
    torch.save(student | dict(args=student["args"] | dict(outcome_coef=0.5)), tmp_path / "option")
    with pytest.raises(UserError, match="outcome_coef"):
        ppo.load(tmp_path / "option")
    agent, _ = make_agent(hidden_size=16)
    layer = student | dict(agent=agent.state_dict() | dict(outcome=torch.ones(2)))
    for states, reason in ((layer, "Unexpected.*outcome"), (student, "size mismatch for ")):
        torch.save(states, tmp_path / "student")
        with pytest.raises(UserError, match=f"student is no checkpoint .*: {reason}"):
            ppo.load(tmp_path / "student", agent=agent)


def test_a_run_that_diverges_says_so(tmp_path):
    with pytest.raises(UserError, match=r"infinite or NaN weights: is learning_rate 1e\+30"):
        small(tmp_path, "--learning-rate", "1e30")


# ---- options ----
REFUSED = """gridworld --num-available 600; 600 available
gridworld --eval-episodes 0; must be at least 1
gridworld --total-timesteps 10; one rollout takes 2048
gridworld --num-envs 33; num_envs 33 must divide
gridworld --representation missing.npz; missing.npz
gridworld --representation hvea; 'hvea'; allowed: hvae, hvae-all, vae, engineered
gridworld --representation engineered-6d; engineered-12d, engineered-5d
gridworld --task push; 'push'; allowed: default
gridworld --fully-observable; only the Recommender
create --task pus; 'pus'; allowed: push
gridworld --finetune nowhere; nowhere is not the folder of a finished run
evaluate nowhere --episodes 0; must be at least 1
evaluate nowhere; nowhere/best.pt is no checkpoint"""


@pytest.mark.parametrize("case", REFUSED.splitlines())
def test_mistakes_are_told_in_one_sentence_and_leave_nothing(tmp_path, case, monkeypatch):
    monkeypatch.setattr(ppo.hvae, "train", lambda args: pytest.fail("an encoder is trained"))
    line, message = case.split("; ", 1)
    folder = [] if line.startswith("evaluate") else ["--runs-dir", str(tmp_path)]
    with pytest.raises(UserError) as e:
        ppo.main([*line.split(), *folder])
    assert message in str(e.value) and "\n" not in str(e.value)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.name != ".lock"]


def test_test_actions_neither_train_nor_choose(tmp_path, monkeypatch):
    pools, make_envs = {}, ppo.make_envs

    def spy(args, phase, num_envs, stream):
        pools.setdefault(stream[1], set()).update(phase[0])
        return make_envs(args, phase, num_envs, stream)

    def score(agent, phase, n, stream, real=ppo.evaluate):
        # Seen scores rise with the step, those of validation fall: the first checkpoint is best.
        if stream[1] == ppo.TEST:
            best = ppo.load(tmp_path / "run" / "best.pt")
            same = [torch.equal(x, best["agent"][k]) for k, x in agent.state_dict().items()]
            assert best["step"] == 256 and all(same)
        rising = phase[0][0] in train
        return real(agent, phase, n, stream) | {"score": stream[-1] if rising else -stream[-1]}

    train, valid, test = (set(ids) for ids in gridworld.split_actions().values())
    monkeypatch.setattr(ppo, "make_envs", spy)
    monkeypatch.setattr(ppo, "evaluate", score)
    small(tmp_path)
    assert pools == {ppo.TRAINING: train, ppo.VALIDATION: train | valid,
                     ppo.TEST: train | valid | test}  # fmt: skip


def test_the_entropy_bonus_and_the_learning_rate_fall(tmp_path, monkeypatch):
    seen, loss = [], ppo.ppo_loss
    monkeypatch.setattr(ppo, "ppo_loss", lambda *args: seen.append(args[2]) or loss(*args))
    small(tmp_path)
    assert seen[::16] == pytest.approx([0.05, 0.035, 0.02])
    adam = ppo.load(tmp_path / "run" / "checkpoint.pt")["optimizer"]
    assert adam["param_groups"][0]["lr"] == pytest.approx(4e-4)


def test_advantages_come_from_scaled_rewards_and_the_next_state(tmp_path, monkeypatch):
    batches, update = [], ppo.update
    monkeypatch.setattr(ppo, "update", lambda *args: batches.append(args[2]) or update(*args))
    small(tmp_path, "--learning-rate", 0, "--eval-every", 768)  # the critic stays as it is
    b, after = batches[0], batches[1]["value"][0]
    G, _ = ppo.running_returns(b["reward"], b["done"], torch.zeros(32), 0.99)
    rewards = (b["reward"] / G.std(correction=0)).clamp(-10, 10)
    expected = ppo.gae(rewards, b["value"], b["done"], after, 0.99)
    assert b["reward"].any() and after.any()
    torch.testing.assert_close(b["advantage"], expected, rtol=0.02, atol=0.02)


def test_a_programming_error_shows_where_it_is(tmp_path, monkeypatch):
    def slip(*args):
        return np.ones(3) + np.ones(4)

    monkeypatch.setattr(ppo, "gae", slip)
    with pytest.raises(ValueError, match="could not be broadcast"):
        small(tmp_path)
    monkeypatch.undo()
    small(tmp_path)  # the corrected second try is not hindered by the first


@pytest.mark.parametrize("line", ["", "--help", "recsys --help", "evaluate --help"])
def test_help_works_with_and_without_an_environment(line, capsys):
    with pytest.raises(SystemExit, match="^0$"):
        ppo.main(line.split())
    out = capsys.readouterr().out
    assert "evaluate" in out and ("ppo_actiongen.py evaluate" in out) >= line.startswith("evaluate")


NAMES = """gridworld; gridworld-s0
gridworld --recipe paper --quick --seed 3; gridworld-recipe-paper-quick-s3
gridworld --split-seed 3 --device cpu; gridworld-split_seed-3-s0
gridworld --ent-coef 0 --modality onehot; gridworld-modality-onehot-ent_coef-0.0-s0
gridworld --representation a/my.npz; gridworld-representation-a_my.npz-s0
gridworld --finetune C:\\x; gridworld-adapt-finetune-C__x-s0
gridworld --run-name a:b; a_b
gridworld --run-name ..; _.
create --task seesaw --no-subgoal-reward; create-task-seesaw-subgoal_reward-False-s0"""


def test_names_of_runs_tell_them_apart_and_suit_every_file_system():
    for line, name in (row.split("; ") for row in NAMES.splitlines()):
        assert ppo.run_name_of(ppo.parse_args(line.split())) == name
    long = ppo.run_name_of(ppo.parse_args(["gridworld", "--representation", 300 * "x" + ".npz"]))
    assert len(long) < 130 and long.endswith("-s0")


# Each option that is [here], and each ablation, with the value that switches it off.
OFF = """--ent-floor 1.0;--no-one-hot;--no-bilinear;--no-small-pictures;--no-aux-conditioned
--subsample;--published-init;--clip-vloss;--eval-available 50;--lr-decay-steps 768"""


def test_every_option_switched_off_gives_the_same_bits(tmp_path):
    line = ["--recipe", "paper", "--total-timesteps", "768"]
    small(tmp_path / "without", *line)
    options = OFF.replace("\n", ";").split(";")
    small(tmp_path / "with", *line, *" ".join(options).split())
    assert_same_run(tmp_path / "without" / "run", tmp_path / "with" / "run")


@pytest.mark.parametrize("env", ["recsys", "create", "stacking"])
def test_every_environment_is_trained_and_tested(tmp_path, env):
    line = f"{env} --representation engineered --num-envs 4 --minibatch-size 16 --num-minibatches 2"
    line += " --total-timesteps 64 --eval-every 32 --valid-episodes 4 --eval-episodes 4"
    assert ppo.main([*line.split(), "--runs-dir", str(tmp_path)])["test"]["episodes"] == 4


def test_options_of_a_task_reach_its_environment():
    args = replace(ppo.default_args("create"), task="belt", subgoal_reward=False)
    (env,) = ppo.make_envs(args, (np.arange(1, 9), 5), 1, (0,))[0].unwrapped.envs
    assert env.unwrapped.task is create_env.TASKS["belt"] and not env.unwrapped.subgoal_reward


def test_representations_made_by_hand_and_a_fixed_set_of_test_products():
    args = replace(ppo.default_args("recsys"), fully_observable=True, adapt=True)
    assert ppo.load_table(args).shape == (10_000, 17)
    pool, K = ppo.action_phases(args)[0]["learn"]
    test = ppo.hvae.load_environment("recsys").split_actions()["test"]
    assert len(pool) == K == 2000 and np.isin(pool, test).all()
    args = replace(ppo.default_args("gridworld"), representation="engineered-5d")
    assert ppo.load_table(args).shape == (1024, 5)


@pytest.mark.parametrize("name, changes", [("hvae", {}), ("hvae-all", {"train_on": "all"}),
    ("vae", {"hierarchical": False})])  # fmt: skip
def test_the_encoder_that_is_asked_for_is_trained_once(tmp_path, monkeypatch, name, changes):
    made = []

    def fake(args):
        made.append(args)
        path = ppo.hvae.representation_path(args)
        ppo.hvae.save_representation(path, np.ones((1024, 4)), [], vars(args))

    monkeypatch.setattr(ppo.hvae, "train", fake)
    args = replace(ppo.default_args("gridworld"), representation=name, split_seed=3)
    args = replace(args, runs_dir=str(tmp_path), hvae_recipe="paper")
    assert all(ppo.load_table(args).shape == (1024, 4) for _ in range(2))
    (one,) = made
    assert one == replace(ppo.hvae.default_args("gridworld", "paper"), split_seed=3, device="auto",
                          runs_dir=str(tmp_path), **changes)  # fmt: skip


# ---- an environment of one's own ----
OWN = """from gridworld import *
import gridworld
DEFAULTS = dict(num_available=5, minibatch_size=64, total_timesteps=768, eval_every=256,
                valid_episodes=4, eval_episodes=8, representation="engineered")
"""
BREACHES = {  # an environment that makes a result wrong -> the sentence that refuses it
    "leak": ("def split_actions(split='default', seed=0):\n"
             "    parts = gridworld.split_actions(split, seed)\n"
             "    return parts | dict(test=parts['train'])\n", "overlap"),
    "outside": ("old = make_vec\ndef make_vec(n, pool=None, *rest):\n"
                "    return old(n, np.setdiff1d(np.arange(1024), pool), *rest)\n",
                "not in its action_pool"),
    "short": ("def engineered_representations():\n    return np.ones((1023, 2))\n", r"\(1024, D\)"),
    "nan": ("def engineered_representations():\n    return np.full((1024, 2), np.nan)\n", "finite"),
    "silent": ("METRIC = 'height'\n", "metric 'height'"),
}  # fmt: skip


@pytest.mark.parametrize("name", BREACHES)
def test_an_environment_that_makes_results_wrong_is_refused(tmp_path, name):
    code, message = BREACHES[name]
    path = tmp_path / f"{name}_env.py"
    path.write_text(OWN + code, encoding="utf-8")
    with pytest.raises(UserError, match=message):
        ppo.main([str(path), "--num-envs", "8", "--runs-dir", str(tmp_path)])


# ---- methods, evaluation, adaptation ----
@pytest.mark.parametrize("line, K", [("method nearest-neighbor", 512), ("method continuous", 50),
    ("no-subsample", 512)])  # fmt: skip
def test_baselines_and_ablations_run_and_are_evaluated(tmp_path, line, K, capsys):
    small(tmp_path, *f"--{line}".split())
    ppo.main(["evaluate", str(tmp_path / "run"), "--actions", "train", "--episodes", "8"])
    out = capsys.readouterr().out
    assert "unseen" in out and f"train: {K} of 512 actions available, 8 episodes" in out


def test_the_no_op_of_create_is_available_beside_every_pool():
    args = replace(ppo.default_args("create"), method="nearest-neighbor")
    phases, train_ids = ppo.action_phases(args)
    assert phases["learn"][1] == len(train_ids) == 1_098 and create_env.NO_OP in train_ids
    assert create_env.NO_OP not in phases["test"][0] and phases["test"][1] == 50


def test_evaluation_plays_the_same_number_of_episodes_in_every_environment(monkeypatch):
    args = replace(ppo.default_args("gridworld"), representation="engineered", one_hot=False)
    phases, train_ids = ppo.action_phases(args)
    envs, _ = ppo.make_envs(args, phases["test"], 1, (0,))
    agent = ppo.Agent(envs, ppo.load_table(args), train_ids, args)
    result = ppo.evaluate(agent, phases["test"], 1000, (0, 3))
    # An untrained policy is the uniform one: 0.3 % success, 4.9 skills an episode (exact values).
    assert result["score"] < result["return"] < 0.03 and abs(result["length"] - 4.92) < 0.35
    count = lambda played: (np.bincount([n for n, *_ in played]).tolist(), 0.0, 0.0)  # noqa: E731
    monkeypatch.setattr(ppo, "episode_means", count)
    counts = ppo.evaluate(agent, phases["test"], 50, (0, 3))["score"]
    assert counts == [2] * 10 + [1] * 30


def test_evaluate_appends_a_row_and_makes_a_gif(finished, tmp_path, capsys):
    (tmp_path / "best.pt").write_bytes((finished[0] / "best.pt").read_bytes())  # it needs no more
    common, gif = dict(run=str(tmp_path), episodes=8, save=True), tmp_path / "out.gif"
    for options in (dict(gif=str(gif)), dict(num_available=10), dict(unseen_ratio=0.5)):
        ppo.evaluate_run(ppo.EvaluateArgs(**common, **options))
    text = (tmp_path / "evaluations.csv").read_text(encoding="utf-8")
    rows = [r for r in csv.DictReader(text.splitlines()) if 0 <= float(r["score"]) <= 1]
    asked = [(r["num_available"], r["unseen_ratio"]) for r in rows]
    assert asked == [("50", ""), ("10", ""), ("50", "0.5")] and gif.read_bytes()[:3] == b"GIF"
    step = torch.load(tmp_path / "best.pt", weights_only=True)["step"]
    assert {r["best_step"] for r in rows} == {str(step)}
    out = capsys.readouterr().out
    assert "success 0." in out and f"episode: {gif}" in out
    for options, message in (
        (dict(num_available=0), "0 available"),
        (dict(num_available=300), "300 available"),
        (dict(unseen_ratio=40.0), "no share"),
        (dict(min_embedding_distance=1.5), "no share"),
        (dict(actions="train", unseen_ratio=0.5), "unseen actions"),
        (dict(min_angle_gap=9.0), "only the tools of CREATE"),
        (dict(gif="out.mp4"), "end in .gif"),
        (dict(run=str(finished[0] / "best.pt")), "the run's folder"),
    ):
        with pytest.raises(UserError, match=message):
            ppo.evaluate_run(ppo.EvaluateArgs(**(common | options)))
    assert len((tmp_path / "evaluations.csv").read_text(encoding="utf-8").splitlines()) == 4


def test_pools_of_the_analyses():
    split, table = create_env.split_actions("analysis"), torch.randn(create_env.NUM_ACTIONS, 3)
    known, test = split["train"], split["test"]

    def pool(**options):
        return ppo.restrict_pool(ppo.EvaluateArgs("", **options), create_env, table, test, known)

    assert np.array_equal(pool(), test)
    sizes = [len(pool(min_angle_gap=gap)) for gap in (3, 6, 9, 12, 15)]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] > 50
    assert (create_env.angle_gaps(pool(min_angle_gap=9), known) >= 9).all()
    squared = np.array([(table[known] - table[tool]).square().sum(1).min() for tool in test])
    far = test[squared >= np.quantile(squared, 0.3)]  # slow and obvious
    assert len(np.setxor1d(far, pool(min_embedding_distance=0.3))) <= 1
    for ratio in (0.0, 0.2, 0.6, 1.0):
        mixed = pool(unseen_ratio=ratio)
        assert len(np.unique(mixed)) == len(mixed)
        assert np.isin(mixed, test).mean() == pytest.approx(ratio, abs=0.001)


@pytest.mark.parametrize("method", ["utility", "nearest-neighbor"])
def test_adaptation_is_to_the_whole_test_set_from_scratch_or_from_a_run(tmp_path, method):
    first, still = str(tmp_path / "first"), ["--learning-rate", "0"]  # weights stay as they are
    for name, extra in (("first", []), ("new", ["--adapt"]), ("tuned", ["--finetune", first])):
        small(tmp_path, "--method", method, "--run-name", name, *still, *extra)
        results = json.loads((tmp_path / name / "results.json").read_text(encoding="utf-8"))
        assert ("test" in results) == (not extra)
        args = ppo.load(tmp_path / name / "best.pt")["args"]
        pool = gridworld.split_actions()["test" if extra else "train"]
        assert np.array_equal(ppo.action_phases(args)[1], pool)
    source, weights = (ppo.load(tmp_path / k / "best.pt")["agent"] for k in ("first", "tuned"))
    changed = {k for k in source if not torch.equal(weights[k], source[k])}
    head = {"head.weight"} if method == "nearest-neighbor" else set()
    assert changed - {"head.bias"} == head  # published: its outputs are new
    for name, there in (("split_seed", 0), ("task", None)):
        with pytest.raises(UserError, match=f"cannot be fine-tuned: its {name} is {there}"):
            ppo.start_from(SimpleNamespace(args=replace(args, **{name: 7})), Path(first))


# ---- torchrun ----
JOINT = """import sys; sys.path[:0] = [{root!r}, {root!r} + "/tests"]
import atexit, pathlib, ppo_actiongen as ppo, test_ppo_actiongen as test; ppo.join_processes()
ppo.MAX_GRAD_NORM, ppo.ppo_loss = 1e9, test.raw_loss
test.torch.save(test.joint_update(ppo.RANK, ppo.WORLD_SIZE), {folder!r} + f"/{{ppo.RANK}}")
ppo.dist.barrier(); atexit._run_exitfuncs(); test.time.sleep(1)  # no thread outlives it
assert not any("gloo" in p.read_text() for p in pathlib.Path("/proc/self/task").glob("*/comm"))
"""


def raw_loss(agent, mb, ent_coef, loss=ppo.ppo_loss):
    """Without normalised advantages, which each process normalises by its own share."""
    return loss(agent, mb | {"advantage": mb["raw"]}, ent_coef)


def joint_update(rank, world, passes=2):
    """Start and end of `passes` + 1 updates by this process's share of one made-up rollout."""
    torch.manual_seed(0)
    agent, args = make_agent(HYBRID, minibatch_size=24, update_epochs=passes, head_epochs=1)
    start = torch.cat([p.detach().flatten() for p in agent.parameters()])
    T, N, mine = 6, 4, slice(rank * 4 // world, (rank + 1) * 4 // world)
    state, sets = torch.randn(T * N, 7), random_sets(T * N, A=20)
    action, logprob, _, value = agent.act(state, sets)
    flat = dict(state=state, available=sets, logprob=logprob, value=value) | action
    flat |= {"advantage": 3 + torch.randn(T * N), "return": torch.randn(T * N)}
    flat["raw"] = flat["advantage"]
    batch = {k: v.detach().unflatten(0, (T, N))[:, mine] for k, v in flat.items()}
    ppo.update(agent, torch.optim.SGD(agent.parameters(), 0.1), batch, 0.01)
    stats = ppo.RunningMeanStd((7,))
    stats.update(batch["state"].flatten(0, 1))
    return [start, torch.cat([p.detach().flatten() for p in agent.parameters()]), stats.sums]


def test_advantages_are_normalised(monkeypatch):
    seen, loss = [], ppo.ppo_loss
    monkeypatch.setattr(ppo, "ppo_loss", lambda *a: seen.append(a[1]["advantage"]) or loss(*a))
    joint_update(0, 1)
    assert len(seen) == 3 and all(abs(x.mean()) < 1e-5 and abs(x.std() - 1) < 1e-3 for x in seen)


def test_two_processes_learn_what_one_learns_from_the_joint_batch(tmp_path, monkeypatch):
    monkeypatch.setattr(ppo, "MAX_GRAD_NORM", 1e9)  # it would hide a factor
    monkeypatch.setattr(ppo, "ppo_loss", raw_loss)
    script = tmp_path / "joint.py"
    script.write_text(JOINT.format(root=str(ROOT), folder=str(tmp_path)))
    run(*TORCHRUN, script)
    one, first, second = joint_update(0, 1), *(torch.load(tmp_path / rank) for rank in "01")
    assert (one[1] - one[0]).abs().max() > 1e-3  # it did learn
    start, end, _ = joint_update(0, 1, passes=0)  # head_epochs leave the state encoder: 4,672 first
    assert torch.equal(start[:4672], end[:4672]) and not torch.equal(start, end)
    for a, b, c in zip(one, first, second, strict=True):
        assert torch.equal(b, c)  # the same bits on both
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_a_run_in_two_processes(tmp_path):
    extra = "--recipe paper --total-timesteps 1536 --eval-every 512".split()
    out = run(*TORCHRUN, "ppo_actiongen.py", *words(tmp_path, *extra))
    assert out.count("run: ") == 1  # only one of them speaks
    assert [r["step"] for r in rows_of(tmp_path / "run")] == [str(256 * i) for i in range(1, 7)]
    results = json.loads((tmp_path / "run" / "results.json").read_text(encoding="utf-8"))
    assert results["test"]["episodes"] == 64
    seen = ppo.load(tmp_path / "run" / "checkpoint.pt")["agent"]["obs_stats.sums"][0, 0].item()
    assert seen == pytest.approx(1536 + 1e-4)  # of both
    run(*TORCHRUN, "ppo_actiongen.py", *words(tmp_path, *extra, "--resume"))
    ppo.main(words(tmp_path, *extra, "--resume"))  # with one process, too


@pytest.mark.slow
def test_learning_reaches_unseen_skills(tmp_path):
    line = "--minibatch-size 512 --eval-every 200000 --eval-episodes 1000 --total-timesteps 600000"
    run("ppo_actiongen.py", *words(tmp_path, *line.split()), timeout=3600)
    results = json.loads((tmp_path / "run" / "results.json").read_text(encoding="utf-8"))
    assert results["test"]["score"] > 0.15  # a random policy: 0.003
