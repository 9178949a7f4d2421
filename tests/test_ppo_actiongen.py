"""The policy script: its pieces against slow obvious versions, then whole short runs."""

import csv
import json
import math
import os
import pickle
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

import gridworld
import ppo_actiongen as ppo

ROOT = Path(__file__).parent.parent
VECTOR = gym.spaces.Box(-10, 10, (7,), np.float32)
HYBRID = gym.spaces.Dict(
    choice=gym.spaces.Discrete(5),
    position=gym.spaces.Box(-1, 1, (2,), np.float32),
    stop=gym.spaces.Discrete(2),
)


def make_agent(action_space=None, state_space=VECTOR, **changes):
    """A small agent with a random table of 30 actions, and its arguments."""
    defaults = dict(utility_gains=(1.0, 1.0, 1.0), norm_obs=False)
    args = replace(ppo.PRESETS["gridworld"], **(defaults | changes))
    table = np.random.default_rng(0).standard_normal((30, 4)).astype(np.float32)
    space = action_space or gym.spaces.Discrete(5)
    return ppo.Agent(state_space, space, table, np.arange(20), args, ppo.Workers(2)), args


@pytest.fixture(autouse=True)
def seeded():
    """Every test draws its inputs from the same place."""
    torch.manual_seed(0)


def parameter_vector(agent):
    return torch.cat([p.detach().flatten() for p in agent.parameters()])


def random_sets(rows, K=5, A=30, seed=0):
    rng = np.random.default_rng(seed)
    return torch.as_tensor(np.stack([rng.choice(A, K, replace=False) for _ in range(rows)]))


# ---- the utility ----


def naive_logits(agent, code, available):
    """D.3.2 word for word: project c, concatenate [state; action], 2-layer MLP, one logit each."""
    c = agent.action_project(agent.table[available])  # (B, K, H)
    s = code[:, None].expand(-1, available.shape[1], -1)  # (B, K, H)
    hidden = F.relu(agent.utility_hidden(torch.cat([s, c], dim=-1)))  # (B, K, W)
    return agent.utility_out(hidden)[..., 0]  # (B, K)


@settings(max_examples=20, deadline=None)
@given(B=st.integers(1, 40), K=st.integers(1, 12), width=st.sampled_from([16, 64]))
def test_factorised_utility_equals_the_concatenation(B, K, width):
    agent, _ = make_agent(utility_hidden=width)
    code, available = torch.randn(B, 64, generator=torch.Generator().manual_seed(B)), None
    code.requires_grad_()
    available = random_sets(B, K)
    weights = torch.arange(1.0, B * K + 1).view(B, K).sin()
    grads = []
    for logits in (
        naive_logits(agent, code, available),
        agent.choice_logits(code, available, agent.project_actions()),
    ):
        agent.zero_grad()
        code.grad = None
        (logits * weights).sum().backward()
        grads.append([p.grad.clone() for p in agent.parameters() if p.grad is not None])
        grads[-1] += [code.grad.clone(), logits.detach()]
    assert len(grads[0]) == len(grads[1]) == 8
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("on_offer", ["some", "all", "repeats"])
def test_utility_pieces_and_workers_do_not_change_the_result(count, on_offer):
    noise = torch.Generator().manual_seed(0)
    shapes = (3000, 64), (30, 64), (64,)  # more rows than one piece holds
    u, P, w = (torch.randn(s, generator=noise, dtype=torch.float64) for s in shapes)
    if on_offer == "repeats":
        sets = torch.randint(30, (3000, 30), generator=noise)
    else:  # all: w/o sub-sampling every set is the whole table, in an order of its own
        K = 5 if on_offer == "some" else 30
        sets = torch.rand(3000, 30, generator=noise).argsort(1)[:, :K]
    weights = torch.randn(sets.shape, generator=noise, dtype=torch.float64)
    results = []
    for factorised in (True, False):
        leaves = [x.clone().requires_grad_() for x in (u, P, w)]
        if factorised:
            logits = ppo.FactorisedUtility.apply(*leaves, sets, ppo.Workers(count))
        else:
            logits = torch.relu(leaves[0][:, None] + leaves[1][sets]) @ leaves[2]
        (logits * weights).sum().backward()
        results.append([logits.detach(), *(leaf.grad for leaf in leaves)])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("form", ["mlp", "bilinear"])
def test_policy_is_equivariant_to_the_order_of_the_available_actions(form):
    agent, _ = make_agent(utility=form)
    code, sets = torch.randn(9, 64), random_sets(9)
    P = agent.project_actions()
    order = torch.randperm(5)
    with torch.no_grad():
        a = agent.choice_logits(code, sets, P)[:, order]
        b = agent.choice_logits(code, sets[:, order], P)
    torch.testing.assert_close(a, b)


def test_bilinear_utility_is_a_product_of_code_and_representation():
    agent, _ = make_agent(utility="bilinear")
    code, sets = torch.randn(9, 64), random_sets(9)
    logits = agent.choice_logits(code, sets, agent.project_actions())
    for b in range(9):
        for k in range(5):
            expected = code[b] @ agent.utility_query.weight.T @ agent.table[sets[b, k]]
            torch.testing.assert_close(logits[b, k], expected)


def test_initial_policy_of_the_paper_is_uniform():
    agent, _ = make_agent(utility_gains=(0.01, 0.01, 0.01))
    with torch.no_grad():
        logits = agent.choice_logits(torch.randn(9, 64), random_sets(9), agent.project_actions())
    # A constant per state does not matter to the softmax; the spread over actions does.
    assert (logits.max(1).values - logits.min(1).values).max() < 1e-5


def test_one_hot_layer_equals_the_product_with_a_one_hot_vector():
    weight = torch.randn(7 * 6, 10, requires_grad=True)
    state = torch.randint(0, 6, (50, 7))
    mix = torch.randn(50, 10)
    results = []
    for y in (
        ppo.OneHotLinear.apply(state + 6 * torch.arange(7), weight),
        F.one_hot(state, 6).flatten(1).float() @ weight,
    ):
        weight.grad = None
        (y * mix).sum().backward()
        results.append((y.detach(), weight.grad.clone()))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b)


# ---- distributions ----


@pytest.mark.parametrize("explore", [0.0, 0.3])
@pytest.mark.parametrize("method", ["utility", "nearest-neighbor", "continuous"])
def test_log_probability_when_acting_equals_that_when_learning(method, explore):
    agent, _ = make_agent(HYBRID, method=method, explore=explore)
    state, sets = torch.randn(11, 7), random_sets(11)
    P = agent.project_actions()
    noise = torch.Generator().manual_seed(0)
    action, logprob, value = agent.act(state, sets, P, noise, learning=True)
    code, value2 = agent.encode(state)
    logprob2, entropy = agent.logprob_entropy(code, sets, action, P)
    torch.testing.assert_close(logprob, logprob2)
    torch.testing.assert_close(value, value2)
    assert set(action) >= {"choice", "position", "stop"} and entropy.shape == (11,)
    assert action["position"].abs().max() <= 1 and action["choice"].max() < 5


def test_exploring_mixes_in_uniform_choices_while_learning_only():
    agent, _ = make_agent(explore=0.25, utility_gains=(3.0, 3.0, 3.0))
    B = 4000
    state, sets = torch.randn(1, 7).expand(B, -1), random_sets(1).expand(B, -1)
    P, noise = agent.project_actions(), torch.Generator().manual_seed(0)
    pi = naive_logits(agent, agent.encode(state[:1])[0], sets[:1]).softmax(1)[0].detach()  # (5,)
    assert pi.max() > 0.5  # else there is nothing to see
    for learning, expected in ((False, pi), (True, 0.75 * pi + 0.05)):
        action, logprob, _ = agent.act(state, sets, P, noise, learning=learning)
        torch.testing.assert_close(logprob.exp(), expected[action["choice"]])
        share = torch.bincount(action["choice"], minlength=5) / B
        assert (share - expected).abs().max() < 4 * math.sqrt(0.25 / B)
    assert torch.equal(
        agent.act(state, sets, P, noise, greedy=True)[0]["choice"], pi.argmax().expand(B)
    )


def test_noise_moves_the_training_representations_by_its_share_of_their_spread():
    args = replace(ppo.PRESETS["gridworld"], norm_obs=False)
    table = np.random.default_rng(0).standard_normal((3000, 4)) * [0.1, 1, 10, 100]
    agent = ppo.Agent(VECTOR, gym.spaces.Discrete(5), table, np.arange(2000), args, ppo.Workers(1))
    agent.blur(0.5, 7)
    off = (agent.codes - agent.table).numpy()
    np.testing.assert_allclose(off[:2000].std(0), 0.5 * table[:2000].std(0), rtol=0.06)
    assert abs(off[:2000] / table.std(0)).max() > 1 and not off[2000:].any()
    same, other = (agent.codes.clone() for seed in (7, 8) if agent.blur(0.5, seed) is None)
    np.testing.assert_array_equal((same - agent.table).numpy(), off)
    assert not torch.equal(same, other)
    agent.blur(0, 9)
    assert agent.codes is agent.table and "noisy" not in agent.state_dict()


@pytest.mark.parametrize("conditioned", [False, True])
def test_a_rollout_and_its_update_see_the_same_noise(conditioned):
    agent, _ = make_agent(HYBRID, aux_conditioned=conditioned)
    state, sets = torch.randn(11, 7), random_sets(11, A=20)  # of the 20 it trains on
    noise = torch.Generator().manual_seed(0)
    plain = agent.project_actions()
    agent.blur(0.5, 1)
    P = agent.project_actions()
    assert not torch.allclose(P[:20], plain[:20]) and torch.equal(P[20:], plain[20:])
    action, logprob, _ = agent.act(state, sets, P, noise, learning=True)
    code, few = agent.encode(state)[0], agent.project_actions(torch.arange(20))
    torch.testing.assert_close(logprob, agent.logprob_entropy(code, sets, action, few)[0])
    agent.blur(0, None)
    other = agent.logprob_entropy(code, sets, action, agent.project_actions())[0]
    assert not torch.allclose(logprob, other)


def test_greedy_takes_the_mean_position_and_the_likelier_of_stop_and_go_on():
    agent, _ = make_agent(HYBRID)
    state, sets = torch.randn(64, 7), random_sets(64)
    P, code = agent.project_actions(), agent.encode(state)[0]
    played = [
        agent.act(state, sets, P, torch.Generator().manual_seed(s), greedy=True)[0] for s in (0, 1)
    ]
    alpha, beta = (1 + F.softplus(head(code)) for head in (agent.fc_alpha, agent.fc_beta))
    mean = 2 * torch.distributions.Beta(alpha, beta).mean - 1
    for action in played:
        torch.testing.assert_close(action["position"], mean)
        assert torch.equal(action["stop"], agent.fc_stop(code).argmax(1))


def test_hybrid_log_probability_and_entropy_are_sums_of_their_parts():
    agent, args = make_agent(HYBRID)
    state, sets = torch.randn(6, 7), random_sets(6)
    P = agent.project_actions()
    action, *_ = agent.act(state, sets, P, torch.Generator().manual_seed(1))
    code, _ = agent.encode(state)
    logprob, entropy = agent.logprob_entropy(code, sets, action, P)
    choice = torch.distributions.Categorical(logits=naive_logits(agent, code, sets))
    alpha, beta = 1 + F.softplus(agent.fc_alpha(code)), 1 + F.softplus(agent.fc_beta(code))
    position = torch.distributions.Beta(alpha, beta)
    stop = torch.distributions.Categorical(logits=agent.fc_stop(code))
    expected = choice.log_prob(action["choice"]) + stop.log_prob(action["stop"])
    expected = expected + position.log_prob(0.5 + action["position"] / 2).sum(1)
    torch.testing.assert_close(logprob, expected, rtol=1e-4, atol=1e-4)
    parts = choice.entropy() + stop.entropy() + 0.1 * position.entropy().sum(1)
    torch.testing.assert_close(entropy, parts, rtol=1e-4, atol=1e-4)


def test_initial_beta_has_the_published_width():
    agent, _ = make_agent(HYBRID)
    noise = torch.Generator().manual_seed(0)
    out, *_ = agent.auxiliary(torch.zeros(20_000, 64), noise)
    assert abs(out["position"].std().item() - 0.477) < 0.01  # alpha = beta = 1 + log 2


def test_sampling_follows_the_probabilities():
    logp = torch.tensor([0.1, 0.2, 0.7]).log().expand(60_000, 3)
    counts = torch.bincount(ppo.sample(logp, torch.Generator().manual_seed(0)), minlength=3)
    assert np.allclose(counts / 60_000, [0.1, 0.2, 0.7], atol=0.01)
    logp = torch.tensor([0.0, 0.5, 0.0, 0.5, 0.0]).log().expand(10_000, 5)
    drawn = ppo.sample(logp, torch.Generator().manual_seed(0)).unique()
    assert drawn.tolist() == [1, 3]  # never what has no probability


def test_nearest_neighbour_maps_the_training_action_to_the_nearest_on_offer():
    agent, _ = make_agent(method="nearest-neighbor")
    sets = random_sets(50) % 10 + 20  # only actions 20..29: none of the training actions
    action, *_ = agent.act(torch.randn(50, 7), sets, None, torch.Generator().manual_seed(0))
    for head, slot, offered in zip(action["head"], action["choice"], sets, strict=True):
        distances = [float((agent.table[head] - agent.table[j]).square().sum()) for j in offered]
        assert slot == int(np.argmin(distances))


def test_nearest_is_exact_far_from_the_origin():
    agent, _ = make_agent(method="continuous")
    agent.table += 1000  # squares near 1e6 for distances near 1: float32 products would lose them
    rng, (A, D) = torch.Generator().manual_seed(0), agent.table.shape
    sets = torch.stack([torch.randperm(A, generator=rng)[:8] for _ in range(200)])
    wish = agent.table[sets[:, 3]] + 0.3 * torch.randn(200, D, generator=rng)
    direct = (agent.table[sets] - wish[:, None]).square().sum(-1).argmin(1)  # (B, K, D) -> (B,)
    assert torch.equal(agent.nearest(wish, sets), direct)


# ---- PPO's arithmetic ----


def test_gae_equals_its_recursive_definition():
    rng = np.random.default_rng(0)
    r, v, nv = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), rng.normal(size=3)
    d = rng.random((9, 3)) < 0.3
    fast = ppo.gae(r, v, d, nv, 0.9, 0.8)

    def slow(t, n):  # A_t = sum_l (gamma lam)^l delta_{t+l}, cut where the episode ends
        if t == 9:
            return 0.0
        after = v[t + 1, n] if t < 8 else nv[n]
        delta = r[t, n] + 0.9 * (not d[t, n]) * after - v[t, n]
        return delta + 0.9 * 0.8 * (not d[t, n]) * slow(t + 1, n)

    for t in range(9):
        for n in range(3):
            assert math.isclose(fast[t, n], slow(t, n), abs_tol=1e-12)


def test_running_statistics_equal_those_of_all_data_at_once():
    rng = np.random.default_rng(0)
    batches = [rng.normal(3, 2, (n, 4)) for n in (1, 5, 100)]
    stats = ppo.RunningMeanStd((4,))
    for b in batches:
        stats.update(b)
    everything = np.concatenate(batches)
    assert np.allclose(stats.mean, everything.mean(0), atol=1e-4)
    assert np.allclose(stats.var, everything.var(0), rtol=1e-3)
    copy = ppo.RunningMeanStd((4,))
    copy.load(stats.state())
    assert np.array_equal(copy.normalize(everything), stats.normalize(everything))


def test_reward_scale_divides_by_the_std_of_the_discounted_return():
    rng = np.random.default_rng(0)
    rewards, dones = rng.random((20, 4)), rng.random((20, 4)) < 0.2
    returns, G = [], np.zeros(4)
    for r, d in zip(rewards, dones, strict=True):
        G = 0.99 * G + r
        returns.append(G)
        G = G * ~d
    scaled = ppo.RewardScale(4, 0.99)(rewards, dones)
    assert np.allclose(scaled, rewards / np.std(returns), rtol=1e-3)


@pytest.mark.parametrize("outcome_coef", [0.0, 0.5])
def test_a_full_batch_update_follows_the_gradient_of_the_naive_loss(outcome_coef):
    agent, args = make_agent(update_epochs=1, num_minibatches=1, outcome_coef=outcome_coef)
    B = 32
    sets, state = random_sets(B), torch.randn(B, 7)
    action, logprob, value = agent.act(
        state, sets, agent.project_actions(), torch.Generator().manual_seed(0)
    )
    adv, returns, q = torch.randn(3, B)
    mb = dict(state=state, available=sets, logprob=logprob, value=value, advantage=adv)
    mb |= dict(q=q, over=(torch.arange(B) % 3 == 0).float())
    loss, parts = ppo.ppo_loss(
        agent, mb | action | {"return": returns}, agent.project_actions(), 0.05, args
    )
    code, v = agent.encode(state)
    dist = torch.distributions.Categorical(logits=naive_logits(agent, code, sets))
    ratio = (dist.log_prob(action["choice"]) - logprob).exp()
    surrogate = torch.min(ratio * adv, ratio.clamp(0.9, 1.1) * adv).mean()
    v_clip = value + (v - value).clamp(-0.1, 0.1)
    v_loss = torch.max((v - returns) ** 2, (v_clip - returns) ** 2).mean() * 0.5
    expected = -surrogate + 0.5 * v_loss - 0.05 * dist.entropy().mean()
    if outcome_coef:  # the hidden layer of the concatenation, for the chosen action alone
        c = agent.action_project(agent.table[sets[range(B), action["choice"]]])  # (B, H)
        hidden = F.relu(agent.utility_hidden(torch.cat([code, c], dim=1)))  # (B, W)
        guess = agent.outcome(hidden)  # (B, 2)
        end = torch.sigmoid(guess[:, 1])
        unlikely = torch.where(mb["over"] == 1, -end.log(), -(1 - end).log())
        expected = expected + 0.5 * (0.5 * (guess[:, 0] - q) ** 2 + unlikely).mean()
    torch.testing.assert_close(loss, expected)
    assert parts["clip_fraction"] == parts["approx_kl"] == 0  # nothing has changed yet


def test_explained_variance_of_perfect_useless_and_harmful_critics():
    returns = torch.randn(8, 4, generator=torch.Generator().manual_seed(0))
    assert ppo.explained_variance(returns + 3, returns) == pytest.approx(1)  # a shift is no matter
    assert ppo.explained_variance(torch.full((8, 4), 7.0), returns) == pytest.approx(0)
    assert ppo.explained_variance(-returns, returns) == pytest.approx(-3)
    assert math.isnan(ppo.explained_variance(returns, torch.ones(8, 4)))


# ---- image states ----

FRAMES = gym.spaces.Box(0, 255, (3, 84, 84), np.uint8)


def image_batch(agent, T, N):
    """A made-up rollout (T, N, ...) of random pictures, as `rollout` would store it."""
    rng = torch.Generator().manual_seed(5)
    state = torch.randint(0, 256, (T * N, 84, 84, 3), generator=rng)
    state = (state * torch.rand(T * N, 1, 1, 1, generator=rng)).byte()  # some dark, some bright
    sets = random_sets(T * N, A=20)  # training actions only
    action, logprob, value = agent.act(state, sets, agent.project_actions(), rng)
    # Ratios inside the clip range and on both sides of it, none where rounding could change sides.
    logprob = logprob + torch.tensor([-0.05, 0.05, -0.3, 0.3]).repeat(T * N // 4)
    flat = dict(state=state, available=sets, logprob=logprob, value=value) | action
    flat["advantage"] = torch.randn(T * N, generator=rng)
    flat["return"] = torch.randn(T * N, generator=rng)
    flat["q"] = torch.randn(T * N, generator=rng)
    flat["over"] = (flat["q"] > 1).float()
    return {k: v.detach().unflatten(0, (T, N)) for k, v in flat.items()}


def plain_features(encoder, state):
    """The convolutions as D.3.2 reads: float32, one layer after the other, new memory for each."""
    x = state.permute(0, 3, 1, 2).contiguous().float() / 255
    for layer in encoder.conv:
        if isinstance(layer, torch.nn.Conv2d):
            x = F.relu(F.conv2d(x, layer.weight.contiguous(), layer.bias, stride=2, padding=1))
    return x.flatten(1)


def gradient_of(features, encoder, state):
    encoder.zero_grad()
    out = features(state)
    out.square().mean().backward()  # nothing cancels, so rounding shows at its own size
    conv = [p.grad.flatten() for n, p in encoder.named_parameters() if n.startswith("conv")]
    return out.detach(), torch.cat(conv)


def cosine(a, b):
    return F.cosine_similarity(a.flatten().double(), b.flatten().double(), dim=0).item()


@pytest.mark.parametrize("channels, shrink", [(3, 1), (4, 1), (3, 2), (3, 4)])
def test_fast_convolutions_equal_the_plain_ones(channels, shrink):
    space = gym.spaces.Box(0, 255, (channels, 84, 84), np.uint8)
    agent, _ = make_agent(HYBRID, space, shrink=shrink)
    size = 84 // shrink
    encoder, state = agent.encoder, torch.randint(0, 256, (40, size, size, channels)).byte()
    out, grad = gradient_of(lambda s: plain_features(encoder, s), encoder, state)
    encoder.bf16 = False
    same_out, same_grad = gradient_of(encoder.convolve, encoder, state)
    torch.testing.assert_close(same_out, out, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(same_grad, grad, rtol=1e-3, atol=1e-7)
    encoder.bf16 = True
    near_out, near_grad = gradient_of(encoder.convolve, encoder, state)
    assert near_out.dtype == torch.float32
    # bfloat16 keeps 8 bits: a number is off by one part in 512 at most, in five layers.
    assert (near_out - out).norm() / out.norm() < 5 / 512 and cosine(near_out, out) > 0.9999
    assert (near_grad - grad).norm() / grad.norm() < 10 / 512 and cosine(near_grad, grad) > 0.9999


@pytest.mark.parametrize("shrink", [1, 2, 4])
def test_shrunk_pictures_are_means_of_blocks(shrink):
    args, rng = replace(ppo.PRESETS["create"], shrink=shrink), np.random.default_rng(0)
    state = rng.integers(0, 256, (2, 3, 84, 84), dtype=np.uint8)
    frames = ppo.Preprocess(FRAMES, args)(state)
    size = 84 // shrink
    assert frames.shape == (2, size, size, 3) and frames.dtype == torch.uint8
    for n, y, x, c in rng.integers(0, (2, size, size, 3), (50, 4)):
        block = state[n, c, y * shrink : (y + 1) * shrink, x * shrink : (x + 1) * shrink]
        assert frames[n, y, x, c] == int(block.mean() + 0.5)


def test_white_is_zero_shows_ink_and_neither_paper_nor_frames_that_do_not_exist():
    args = replace(ppo.PRESETS["create"], white_is_zero=True, norm_features=True)
    state = np.full((2, 3, 84, 84), 255, np.uint8)
    state[0, 2, 10:20, 30:40] = 100
    state[1, 0] = 0  # before the episode
    frames = ppo.Preprocess(FRAMES, args)(state)
    assert frames.dtype == torch.uint8 and frames.sum() == 100 * 155
    assert (frames[0, 10:20, 30:40, 2] == 155).all()
    # Empty space adds nothing: without biases the features of a white picture are 0.
    agent, _ = make_agent(HYBRID, FRAMES, norm_features=True, conv_gain=4.0)
    assert agent.encoder.convolve(frames)[1].abs().max() == 0
    # Normalised features: twice the ink, the same code.
    near, far = (agent.encoder(frames[:1] // 155 * ink)[0] for ink in (60, 120))
    torch.testing.assert_close(near, far, rtol=0.05, atol=0.02)


def test_initial_encoder_tells_pictures_apart_only_with_a_gain():
    """What differs between two pictures is in the code from the start, not a thousandth of it."""
    space = gym.spaces.Box(0, 255, (3, 84, 84), np.uint8)
    state = torch.full((16, 84, 84, 3), 255, dtype=torch.uint8)
    for i in range(16):  # white, and one black square of 20 x 20 pixels somewhere
        y, x = 20 * (i // 4), 20 * (i % 4)
        state[i, y : y + 20, x : x + 20] = 0
    spread = {}
    for gain in (None, math.sqrt(2)):
        agent, _ = make_agent(HYBRID, space, conv_gain=gain)
        with torch.no_grad():
            spread[gain] = agent.encoder(state)[0].std(dim=0).mean()
    assert spread[None] < 0.005 and spread[math.sqrt(2)] > 0.05


def gradient_of_update(agent, args, batch):
    """What one minibatch's update subtracts from the parameters at learning rate 1."""
    before = parameter_vector(agent)
    optimizer = torch.optim.SGD(agent.parameters(), lr=1.0)
    noise = torch.Generator().manual_seed(0)
    ppo.update(agent, optimizer, batch, 0.01, args, noise, torch.device("cpu"))
    return before - parameter_vector(agent)


@pytest.mark.parametrize("method", ["utility", "continuous", "nearest-neighbor"])
def test_micro_batches_add_up_to_the_gradient_of_the_minibatch(method):
    once = dict(update_epochs=1, num_minibatches=1, max_grad_norm=1e9, method=method)
    once |= dict(outcome_coef=0.5)  # of no effect on the baselines
    agent, args = make_agent(HYBRID, FRAMES, bf16=False, **once)
    start, batch = {k: v.clone() for k, v in agent.state_dict().items()}, image_batch(agent, 8, 6)
    # The plain form: the whole minibatch at once, the table projected inside it, plain layers.
    flat = {k: v.flatten(0, 1) for k, v in batch.items()}
    adv = flat["advantage"]
    flat["advantage"] = (adv - adv.mean()) / (adv.std() + 1e-5)
    fast, agent.encoder.convolve = (
        agent.encoder.convolve,
        lambda state: plain_features(agent.encoder, state),
    )
    ppo.ppo_loss(agent, flat, agent.project_actions(), 0.01, args)[0].backward()
    plain = torch.cat([p.grad.flatten() for p in agent.parameters()])
    agent.encoder.convolve = fast
    for micro in (0, 48, 13, 1):  # 13: the last one is smaller
        agent.load_state_dict(start)
        grad = gradient_of_update(agent, replace(args, micro_batch=micro), batch)
        torch.testing.assert_close(grad, plain, rtol=1e-3, atol=2e-6)
    if method != "utility":  # bfloat16: the paper's policy only; the encoder is the same in all
        return
    agent.encoder.bf16 = True
    agent.load_state_dict(start)
    near = gradient_of_update(agent, replace(args, micro_batch=16), batch)
    # Advantages have mean 0, so much of the sum cancels; rounding is relative to what was added.
    parts = []
    for i in range(len(adv)):
        agent.load_state_dict(start)
        agent.zero_grad()
        row = {k: v[i : i + 1] for k, v in flat.items()}
        ppo.ppo_loss(agent, row, agent.project_actions(), 0.01, args)[0].backward()
        parts.append(torch.cat([p.grad.flatten() for p in agent.parameters()]).norm())
    assert (near - plain).norm() / torch.stack(parts).mean() < 10 / 512


@pytest.mark.parametrize("threads", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_bfloat16_updates_repeat_bit_for_bit(threads):
    before, results = torch.get_num_threads(), []
    torch.set_num_threads(threads)
    for _ in range(2):
        changes = dict(micro_batch=9, num_minibatches=1, update_epochs=2)
        agent, args = make_agent(HYBRID, FRAMES, bf16=True, **changes)
        optimizer = torch.optim.AdamW(agent.parameters(), lr=1e-3, fused=True)
        noise = torch.Generator().manual_seed(0)
        batch = image_batch(agent, 4, 4)
        ppo.update(agent, optimizer, batch, 0.01, args, noise, torch.device("cpu"))
        results.append(parameter_vector(agent))
    torch.set_num_threads(before)
    assert torch.equal(*results)


# ---- presets: Tables 3 and 4 ----


def test_paper_presets_are_tables_3_and_4():
    table3 = {  # entropy, K, steps, batch
        "gridworld": (0.05, 50, 40_000_000, 4096),
        "recsys": (0.01, 500, 40_000_000, 2048),
        "create": (0.005, 50, 60_000_000, 3072),
        "stacking": (0.01, 20, 3_000_000, 1024),
    }
    for env, row in table3.items():
        a = ppo.default_args(env, "paper", False)
        assert (a.ent_coef, a.num_available, a.total_timesteps, a.minibatch_size) == row
        table4 = a.learning_rate, a.gamma, a.num_envs, a.hidden_size, a.vf_coef
        assert table4 == (1e-3, 0.99, 32, 64, 0.5)
        assert (a.update_epochs, a.clip_coef, a.aux_ent_scale) == (4, 0.1, 0.1)


def test_number_of_parameters_of_the_grid_world_policy():
    space = gym.spaces.Box(0, 11, (81,), np.float32)
    args = ppo.default_args("gridworld", "paper", False)
    table = np.zeros((1024, 16), np.float32)
    agent = ppo.Agent(space, gym.spaces.Discrete(50), table, np.arange(512), args, ppo.Workers(1))
    assert sum(p.numel() for p in agent.parameters()) == 28_290


# ---- whole runs ----

TINY = [
    *["--representation", "engineered", "--minibatch-size", "64", "--eval-every", "768"],
    *["--valid-episodes", "32", "--eval-episodes", "64", "--threads", "1", "--no-tensorboard"],
    *["--device", "cpu"],  # bit for bit: a GPU adds up in no fixed order
]


def command(folder, *extra, steps=3072):
    return [
        *[sys.executable, str(ROOT / "ppo_actiongen.py"), "gridworld", "--runs-dir", str(folder)],
        *[*TINY, "--total-timesteps", str(steps), *extra],
    ]


def run(*args, **kwargs):
    return subprocess.run(*args, capture_output=True, text=True, cwd=ROOT, timeout=300, **kwargs)


def timeless(folder):
    rows = list(csv.DictReader((folder / "metrics.csv").open()))
    return [{k: v for k, v in r.items() if k not in ("seconds", "sps")} for r in rows]


def same_weights(a, b):
    a, b = (ppo.load_checkpoint(f / "checkpoint.pt", "cpu")["agent"] for f in (a, b))
    return all(torch.equal(a[k], b[k]) for k in a)


def kill_when(process, metrics, rows):
    """Wait for so many updates, then pull the plug."""
    deadline = time.time() + 120
    while time.time() < deadline and process.poll() is None:
        if metrics.exists() and len(metrics.read_text().splitlines()) > rows + 1:
            break
        time.sleep(0.002)
    process.kill()
    process.wait()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
@pytest.mark.parametrize("words", [[], ["--recipe", "paper"], ["--method", "continuous"]])
def test_a_run_on_a_gpu_goes_on_and_is_tested(tmp_path, words):
    words = ["--device", "cuda", "--run-name", "one", *words]
    process = subprocess.Popen(command(tmp_path, *words), cwd=ROOT, stdout=subprocess.DEVNULL)
    kill_when(process, tmp_path / "one" / "metrics.csv", 4)
    assert not (tmp_path / "one" / "results.json").exists()
    again = run(command(tmp_path, *words, "--resume"))
    assert again.returncode == 0, again.stderr
    test = [sys.executable, str(ROOT / "ppo_actiongen.py"), "evaluate", str(tmp_path / "one")]
    assert run([*test, "--episodes", "32"]).returncode == 0  # on the CPU
    elsewhere = run(command(tmp_path, *words, "--resume", "--device", "cpu"))
    assert "another kind of device" in elsewhere.stderr


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
@pytest.mark.parametrize("words", ["create --shrink 2", "create --recipe paper", "stacking"])
def test_pictures_and_positions_on_a_gpu(tmp_path, words):
    words = [*words.split(), "--device", "cuda", "--representation", "engineered"]
    words += "--num-envs 2 --minibatch-size 8 --total-timesteps 64 --eval-every 32".split()
    words += "--valid-episodes 2 --eval-episodes 2 --aux-conditioned --no-tensorboard".split()
    words += ["--runs-dir", str(tmp_path), "--run-name", "one"]
    result = run([sys.executable, str(ROOT / "ppo_actiongen.py"), *words])
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / "one" / "results.json").read_text())["steps"] == 64


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One finished tiny run."""
    folder = tmp_path_factory.mktemp("runs")
    result = run(command(folder))
    assert result.returncode == 0, result.stderr
    return folder / "gridworld-engineered-s0", result.stdout


def test_a_run_leaves_what_it_promises(finished):
    folder, out = finished
    names = {p.name for p in folder.iterdir()}
    files = "args.json metrics.csv checkpoint.pt best.pt results.json curve.png episode.gif"
    assert set(files.split()) <= names and not any(n.startswith(".") for n in names)
    rows = list(csv.DictReader((folder / "metrics.csv").open()))
    assert len(rows) == 12 and rows[-1]["step"] == "3072"
    assert [bool(r["valid_score"]) for r in rows] == [False, False, True] * 4
    results = json.loads((folder / "results.json").read_text())
    assert results["test"]["episodes"] >= 64 and 0 <= results["test"]["score"] <= 1
    assert results["method"] == "engineered" and results["steps"] == 3072
    assert results["published"]["test"] == pytest.approx(0.797, abs=1e-3)
    assert "unseen" in out and "published" in out


def test_one_seed_gives_one_run(finished, tmp_path):
    folder, _ = finished
    assert run(command(tmp_path)).returncode == 0
    again = tmp_path / folder.name
    assert timeless(folder) == timeless(again) and same_weights(folder, again)
    a, b = (json.loads((f / "results.json").read_text())["test"] for f in (folder, again))
    assert a == b


def test_one_seed_gives_one_run_with_two_threads(tmp_path):
    # Minibatches of the real size: smaller ones are not divided among threads by PyTorch, and so
    # cannot show gradients that are added in the order in which the threads happen to come.
    folders = [tmp_path / name / "gridworld-engineered-s0" for name in "ab"]
    for folder in folders:
        words = command(folder.parent, "--threads", "2", "--minibatch-size", "1024", steps=4096)
        assert run(words).returncode == 0
    assert timeless(folders[0]) == timeless(folders[1]) and same_weights(*folders)


def test_matrix_products_add_up_in_a_fixed_order():
    # Whether MKL would otherwise show different bits depends on the processor and the moment, so
    # this asks for its mode, which it prints with every product.
    program = "import torch, ppo_actiongen; torch.ones(64, 64) @ torch.ones(64, 64)"
    result = run([sys.executable, "-c", program], env=os.environ | {"MKL_VERBOSE": "1"})
    assert result.returncode == 0, result.stderr
    if "SGEMM" not in result.stdout:
        pytest.skip("PyTorch multiplies with another library here")
    assert "CNR:AUTO" in result.stdout and "CNR:OFF" not in result.stdout


@pytest.mark.parametrize("moment", [0.3, 0.8])
def test_a_killed_and_resumed_run_equals_one_never_killed(finished, tmp_path, moment):
    folder, _ = finished
    killed = tmp_path / folder.name
    process = subprocess.Popen(command(tmp_path), cwd=ROOT, stdout=subprocess.DEVNULL)
    kill_when(process, killed / "metrics.csv", moment * 12)
    result = run(command(tmp_path, "--resume"))
    assert result.returncode == 0, result.stderr
    assert timeless(folder) == timeless(killed) and same_weights(folder, killed)


JOINT = """
import os, sys; sys.path[:0] = [{root!r}, {root!r} + "/tests"]
import torch, torch.distributed as dist
import ppo_actiongen as ppo
from test_ppo_actiongen import joint_update
dist.init_process_group("gloo")
name = f"{{ppo.RANK}}of{{ppo.WORLD_SIZE}}"
torch.save(joint_update(ppo.RANK, ppo.WORLD_SIZE), {folder!r} + "/" + name)
dist.destroy_process_group()
threads = [open(f"/proc/self/task/{{i}}/comm").read() for i in os.listdir("/proc/self/task")]
assert not any("gloo" in name for name in threads), threads  # they abort a process that ends first
"""


def joint_update(rank, world):
    """Three updates by this process's share (N / world environments) of one made-up rollout."""
    agent, args = make_agent(HYBRID, num_minibatches=1, update_epochs=3, micro_batch=5)
    rng, T, N = torch.Generator().manual_seed(1), 6, 4
    state, sets = torch.randn(T * N, 7, generator=rng), random_sets(T * N, A=20)
    action, logprob, value = agent.act(state, sets, agent.project_actions(), rng)
    flat = dict(state=state, available=sets, logprob=logprob, value=value) | action
    flat["advantage"] = 3 + torch.randn(T * N, generator=rng)
    flat["return"] = torch.randn(T * N, generator=rng)
    mine = slice(rank * N // world, (rank + 1) * N // world)
    batch = {k: v.detach().unflatten(0, (T, N))[:, mine] for k, v in flat.items()}
    optimizer = torch.optim.AdamW(agent.parameters(), lr=1e-3, eps=args.adam_eps)
    noise = torch.Generator()
    parts = ppo.update(agent, optimizer, batch, 0.01, args, noise, torch.device("cpu"))
    scale = ppo.RewardScale(N // world, 0.99)
    rewards = np.random.default_rng(0).random((T, N))[:, mine]
    scale(rewards, np.zeros_like(rewards))
    vector = parameter_vector(agent)
    return {"agent": vector, "parts": parts, "scale": scale.stats.state()}


def torchrun(count, *words):
    options = ["--standalone", f"--nproc_per_node={count}"]
    return run([sys.executable, "-m", "torch.distributed.run", *options, *words])


def test_two_processes_learn_what_one_learns_from_the_joint_batch(tmp_path):
    script = tmp_path / "joint.py"
    script.write_text(JOINT.format(root=str(ROOT), folder=str(tmp_path)))
    result = torchrun(2, str(script))
    assert result.returncode == 0, result.stderr
    first, second = (torch.load(tmp_path / n) for n in ("0of2", "1of2"))
    one, start = joint_update(0, 1), parameter_vector(make_agent(HYBRID)[0])
    assert torch.equal(first["agent"], second["agent"])  # the same bits on both
    assert (one["agent"] - start).abs().max() > 1e-3  # it did learn
    torch.testing.assert_close(first["agent"], one["agent"], rtol=1e-4, atol=1e-5)
    for key in ("parts", "scale"):
        torch.testing.assert_close(first[key], one[key], rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=0)


def test_a_run_in_two_processes(tmp_path):
    words = command(tmp_path, "--valid-episodes", "33", "--recipe", "paper", steps=1536)[1:]
    result = torchrun(2, *words)
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("unseen") == 1  # only one of them speaks
    (folder,) = tmp_path.iterdir()
    rows = list(csv.DictReader((folder / "metrics.csv").open()))
    assert [r["step"] for r in rows] == [str(256 * i) for i in range(1, 7)]
    results = json.loads((folder / "results.json").read_text())
    assert results["test"]["episodes"] == 64
    assert results["command"].startswith("torchrun --nproc_per_node=2 ppo_actiongen.py gridworld")
    checkpoint = ppo.load_checkpoint(folder / "checkpoint.pt", "cpu")
    assert checkpoint["preprocess"]["count"].item() == pytest.approx(1536 + 1e-4)  # of both
    assert not torch.equal(*checkpoint["generator"])  # each draws its own noise
    before, more = (folder / "metrics.csv").read_bytes(), ["--resume", "--run-name", folder.name]
    result = run([sys.executable, *words, *more])  # one process cannot go on with it
    assert "2 processes there, 1 here" in result.stderr and result.stderr.count("\n") == 1
    result = torchrun(2, *words)
    assert result.stderr.count("error: ") == 1 and "--resume" in result.stderr
    assert (folder / "metrics.csv").read_bytes() == before


def test_environments_must_divide_among_processes(monkeypatch):
    monkeypatch.setattr(ppo, "WORLD_SIZE", 3)
    with pytest.raises(ValueError, match="multiples of torchrun's 3 processes"):
        ppo.check(ppo.default_args("gridworld", "fast", False))


def test_evaluate_a_saved_run(finished, monkeypatch, capsys):
    folder, _ = finished
    args = ["--num-available", "20", "--episodes", "41", "--actions", "valid"]
    monkeypatch.setattr(sys, "argv", ["ppo_actiongen.py", "evaluate", str(folder), *args])
    ppo.main()
    said = capsys.readouterr().out
    assert "K=20, 41 episodes" in said and "chosen: " in said and "different actions" in said
    for words, message in (
        (["--num-available", "257"], "257"),
        (["--num-available", "0"], "num_available 0 is not in 1..256"),
        (["--seed", "-1"], "seed -1"),
        (["--seed", str(2**64)], f"seed {2**64} is not allowed"),
        (["--actions", "train", "--unseen-ratio", "0.5"], "choose among unseen actions"),
        (["--actions", "train", "--min-embedding-distance", "1"], "choose among unseen actions"),
    ):
        monkeypatch.setattr(sys, "argv", [*sys.argv[:3], *words])
        with pytest.raises(SystemExit, match=message):
            ppo.main()


@pytest.mark.parametrize(
    "extra",
    [
        ["--method", "nearest-neighbor"],
        ["--method", "continuous"],
        ["--no-subsample", "--fixed-set-size", "60"],
        ["--recipe", "paper", "--ent-coef", "0"],
    ],
)
def test_baselines_and_ablations_run(tmp_path, extra, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", command(tmp_path, *extra, steps=768)[1:])
    ppo.main()
    (folder,) = tmp_path.glob("gridworld-*")
    assert 0 <= json.loads((folder / "results.json").read_text())["train"]["score"] <= 1
    assert "unseen" in capsys.readouterr().out
    # Scored again with as many on offer: a whole set, where the run was trained with one.
    test = ["evaluate", str(folder), "--actions", "train", "--episodes", "8"]
    monkeypatch.setattr(sys, "argv", ["ppo_actiongen.py", *test])
    ppo.main()
    K = 512 if "nearest-neighbor" in extra else 60 if "--no-subsample" in extra else 50
    assert f"train actions, K={K}, 8 episodes" in capsys.readouterr().out


@pytest.mark.parametrize(
    "extra, words",
    [
        (["--num-available", "0"], "num_available 0"),
        (["--num-available", "600"], "600 is more than the 512"),
        (["--conv-gain", "-1"], "conv_gain -1.0 is not above 0"),
        (["--shrink", "2"], "shrink: the states of gridworld are no pictures"),
        (["--norm-features"], "norm_features: the states of gridworld are no pictures"),
        (["--explore", "1"], "explore 1.0 is not at least 0 and below 1"),
        (["--outcome-coef", "-1"], "outcome_coef must be at least 0"),
        (["--vf-coef", "nan"], "vf_coef nan is not a finite number"),
        (["--total-timesteps", "-5"], "total_timesteps -5"),
        (["--total-timesteps", "10"], "less than one rollout of 256"),
        (["--representation", "nonsense"], "'nonsense'"),
        (["--representation", "missing.npz"], "missing.npz"),
        (["--split", "full"], "'full'"),
        (["--device", "tpu"], "'tpu'"),
        (["--task", "push"], "'push'"),
        (["--placement", "1d"], "placement"),
        (["--minibatch-size", "7"], "multiple of num_envs"),
        (["--micro-batch", "-1"], "micro_batch -1"),
        (["--seed", "-1"], "seed -1 is not allowed"),
        (["--split-seed", "-1"], "split_seed -1 is not allowed"),
        (
            ["--num-available", "300", "--eval-available", "None"],
            "num_available 300 is not in 1..2",
        ),
        (["--utility-hidden", "-1"], "utility_hidden -1"),
        (["--eval-available", "0"], "eval_available 0"),
        (["--lr-decay-steps", "0"], "lr_decay_steps 0"),
        (["--no-subgoal-reward"], "subgoal_reward is not an option of gridworld"),
        (["--utility", "bilinear", "--outcome-coef", "1"], "no hidden layer"),
        (["--utility-gains", "1", "1", "nan"], "utility_gains (1.0, 1.0, nan) is not a finite"),
        (["--gamma", "2"], "gamma 2.0 is not in 0..1"),
        (["--max-grad-norm", "0"], "max_grad_norm 0.0 is not above 0"),
        (["--weight-decay", "-1"], "weight_decay -1.0 is not at least 0"),
        (["--encoder-rate", "0"], "encoder_rate 0.0 is not above 0"),
        (["--adam-eps", "0"], "adam_eps 0.0 is not above 0"),
        (["--seed", str(2**64)], f"seed {2**64} is not allowed"),
        (["--threads", "100000"], "threads 100000 is not allowed"),
        (["--modality", "smell"], "modality 'smell' is not one of gridworld's: xy, onehot"),
        (["--eval-available", "300"], "eval_available 300 is not in 1..256"),
        (["--recipe", "paper", "--recipe", "fast"], "may be given only once"),
        (["--quick", "--no-quick"], "may be given only once"),
        (["--num-envs", "1", "--minibatch-size", "1", "--num-minibatches", "1"], "rollout of one"),
    ],
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(
    tmp_path, extra, words, monkeypatch, capsys
):
    argv = command(tmp_path, *extra)[1:]
    monkeypatch.setattr(sys, "argv", argv)
    with pytest.raises(SystemExit) as e:
        ppo.main()
    assert words in str(e.value) and str(e.value).startswith("error: ")
    assert "\n" not in str(e.value)
    assert not any(tmp_path.rglob("*.*"))


@pytest.mark.parametrize(
    "words, message",
    [
        (["create", "--task", "bogus"], "unknown task 'bogus'"),
        (["create", "--one-hot"], "the states of create are pictures"),
        (["stacking", "--placement", "3d"], "unknown placement '3d'"),
        (["recsys", "--modality", "xy"], "modality 'xy' is not one of recsys's: none"),
        (["gridworld", "--finetune", "nowhere"], "no checkpoint at nowhere"),
    ],
)
def test_a_wrong_option_shows_before_an_encoder_is_trained(tmp_path, words, message, monkeypatch):
    monkeypatch.setattr(ppo.hvae, "train", lambda args: pytest.fail("an encoder is trained"))
    argv = ["ppo_actiongen.py", *words, "--runs-dir", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", argv)
    with pytest.raises(SystemExit, match=message):
        ppo.main()
    assert not any(tmp_path.iterdir())


def test_a_refused_overwrite_leaves_the_old_run(finished, monkeypatch):
    folder, _ = finished
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    extra = ["--overwrite", "--run-name", folder.name, "--representation", "nofile.npz"]
    monkeypatch.setattr(sys, "argv", command(folder.parent, *extra)[1:])
    with pytest.raises(SystemExit, match="nofile.npz"):
        ppo.main()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_overwrite_throws_away_runs_only(tmp_path, monkeypatch):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("three years")
    for name, more in (("thesis", []), (".", []), ("thesis", ["--resume"]), (".", ["--resume"])):
        words = ["--overwrite", "--run-name", name, *more]
        monkeypatch.setattr(sys, "argv", command(tmp_path, *words, steps=768)[1:])
        with pytest.raises(SystemExit, match="is not a run's folder: --overwrite leaves it alone"):
            ppo.main()
    assert (tmp_path / "thesis" / "chapter.txt").read_text() == "three years"


def test_a_refused_run_of_processes_ends_quietly(tmp_path):
    words = "--representation engineered --num-envs 2 --minibatch-size 2 --total-timesteps 64"
    start = [sys.executable, str(ROOT / "ppo_actiongen.py"), "stacking", *words.split()]
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "args.json").write_text("{}")
    result = run([*start, "--runs-dir", str(tmp_path), "--run-name", "there"])
    lines = [line for line in result.stderr.splitlines() if "pybullet build time" not in line]
    assert len(lines) == 1 and "already holds a run" in lines[0]


def test_columns_that_are_constant_in_training_do_not_blow_up():
    args = ppo.default_args("stacking", "fast", False)
    args = replace(args, representation="engineered", split="full", standardize=True)
    pools, *_ = ppo.action_pools(args)
    table = ppo.load_table(args, pools["train"])
    assert np.abs(table).max() < 100
    spread = table[pools["train"]].std(0)
    assert (np.isclose(spread, 1, atol=1e-3) | (spread < 1e-3)).all() and (spread < 1e-3).any()


class OnAnotherDevice:
    """A tensor that, like one on a GPU, only gives its numbers to NumPy after .cpu()."""

    def __init__(self, value):
        self.value, self.ndim, self.item = value, value.ndim, value.item

    def cpu(self):
        return self.value

    def numpy(self):
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


def test_statistics_load_from_any_device():
    first, second = ppo.RunningMeanStd((3,)), ppo.RunningMeanStd((3,))
    first.update(np.random.default_rng(0).normal(size=(50, 3)))
    second.load({key: OnAnotherDevice(value) for key, value in first.state().items()})
    assert all(np.array_equal(v, second.state()[k]) for k, v in first.state().items())


def test_published_numbers_stand_only_beside_what_was_published():
    args = ppo.default_args("create", "fast", False)
    args.task = "push"
    assert ppo.published_scores(args)["test"] == pytest.approx(0.797, abs=0.001)
    args.split = "full"
    assert ppo.published_scores(args)
    args.method = "nearest-neighbor"
    assert ppo.published_scores(args) == {}
    args.method, args.split, args.representation = "utility", "analysis", "hvae-all"
    assert ppo.published_scores(args) == {}
    args.split, args.representation, args.subgoal_reward = "full", "hvae", False
    assert ppo.published_scores(args) == {}
    stacking = ppo.default_args("stacking", "fast", False)
    for placement, there in (("1d", True), ("2d", False)):
        stacking.placement, stacking.representation = placement, "engineered"
        assert bool(ppo.published_scores(stacking)) == there
        stacking.representation = "hvae"
        assert ppo.published_scores(stacking)
    # An ablation or a baseline was published with the usual representation only.
    for changes in (dict(ent_coef=0), dict(subsample=False), dict(method="nearest-neighbor")):
        usual = replace(ppo.default_args("gridworld", "fast", False), **changes)
        assert ppo.published_scores(usual)
        assert not ppo.published_scores(replace(usual, representation="engineered"))
    # ... and nothing with somebody's own table, nor an oracle of another modality.
    for changes in (
        dict(representation="mine.npz"),
        dict(representation="hvae-all", modality="xy"),
    ):
        usual = replace(ppo.default_args("gridworld", "fast", False), **changes)
        assert bool(ppo.published_scores(usual)) == (usual.modality == "xy")
    assert not ppo.published_scores(replace(usual, modality="onehot"))


def test_a_table_of_another_recipe_is_refused(tmp_path, monkeypatch):
    """A recipe that changed would else go on with the table it had before."""
    args = ppo.default_args("gridworld", "fast", False)
    args.runs_dir, args.standardize = str(tmp_path), False
    wanted = ppo.hvae.Args(env="gridworld", runs_dir=str(tmp_path))
    path, train_ids = ppo.hvae.representation_path(wanted), np.arange(512)
    table = np.random.default_rng(0).normal(size=(1024, 16)).astype(np.float32)
    config = ppo.hvae.settings(ppo.hvae.resolve(wanted))
    for updates, there in ((config["updates"], True), (9, False)):
        config["updates"] = updates
        ids = ppo.importlib.import_module("gridworld").split_actions()["train"]
        ppo.hvae.save_representation(path, "gridworld", table, table, ids, config)
        if there:
            np.testing.assert_array_equal(ppo.load_table(args, train_ids), table)
        else:
            with pytest.raises(ValueError, match="updates 9, the recipe now has 1000: delete it"):
                ppo.load_table(args, train_ids)


def test_names_tell_runs_apart():
    """The paper's methods and what we add to them have names, and so folders, of their own."""

    def name(env, **changes):
        return ppo.method_name(replace(ppo.default_args(env, "fast", False), **changes))

    ablations = dict(), dict(ent_coef=0.0), dict(subsample=False)
    assert [name("recsys", **c) for c in ablations] == [
        *("ours_bilinear", "ours_no_entropy_bilinear", "ours_no_subsampling_bilinear")
    ]
    assert name("recsys", ent_coef=0.0, utility="mlp") == "ours_no_entropy"
    assert name("recsys", method="nearest-neighbor") == "nearest_neighbor"
    assert name("gridworld", representation="a/mine.npz") == "ours_mine"
    assert name("gridworld", representation="vae", utility="bilinear").startswith("non_hier")
    # C.4 and what we make of it: a variant in Stacking, in CREATE's fast recipe how it is.
    corrected = dict(aux_conditioned=True, aux_residual=True)
    for env in ("create", "stacking"):
        conditioned = dict(aux_conditioned=True, aux_residual=False)
        assert name(env, **conditioned) == "ours_conditioned_auxiliary"
        assert name(env, aux_conditioned=False) == "ours"
    assert name("create", **corrected) == "ours"
    assert name("stacking", **corrected) == "ours_corrected_auxiliary"
    args = replace(ppo.default_args("stacking", "fast", False), **corrected)
    assert ppo.published_scores(args) == {}
    assert name("create", modality="video") == "ours_video"
    assert name("create", modality="xy") == name("create") == "ours"


def test_quick_paper_recipe_chooses_among_checkpoints():
    for env in ppo.PRESETS:
        args = ppo.default_args(env, "paper", True)
        updates = args.total_timesteps // (args.minibatch_size * args.num_minibatches)
        between = args.eval_every // (args.minibatch_size * args.num_minibatches)
        assert updates // max(1, between) >= 3, env
        assert args.minibatch_size == ppo.PRESETS[env].minibatch_size  # still the paper's
        assert args.learning_rate == ppo.PRESETS[env].learning_rate


def test_unknown_environment_and_recipe(monkeypatch):
    for argv, word in ((["chess"], "'chess'"), (["gridworld", "--recipe", "slow"], "'slow'")):
        monkeypatch.setattr(sys, "argv", ["ppo_actiongen.py", *argv])
        with pytest.raises(SystemExit, match=word):
            ppo.main()


def test_an_existing_run_is_not_overwritten_silently(finished, monkeypatch):
    folder, _ = finished
    before = (folder / "metrics.csv").read_bytes()
    other = ["--resume", "--ent-coef", "0.3", "--run-name", folder.name]
    for extra, word in (([], "--resume"), (other, "ent_coef")):
        monkeypatch.setattr(sys, "argv", command(folder.parent, *extra)[1:])
        with pytest.raises(SystemExit, match=word):
            ppo.main()
    assert (folder / "metrics.csv").read_bytes() == before


def test_broken_checkpoints_are_refused(finished, tmp_path):
    good = (finished[0] / "checkpoint.pt").read_bytes()
    for name, content in {
        "truncated": good[: len(good) // 2],
        "pickle": pickle.dumps({"agent": 1}, protocol=2),
        "empty": b"",
        "foreign": None,
    }.items():
        path = tmp_path / name
        torch.save({"weights": torch.zeros(2)}, path) if content is None else path.write_bytes(
            content
        )
        with pytest.raises(ValueError, match="not a checkpoint"):
            ppo.load_checkpoint(path, "cpu")
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        ppo.load_checkpoint(tmp_path / "nowhere", "cpu")


def test_evaluation_plays_the_same_number_of_episodes_in_every_environment():
    args = replace(ppo.default_args("gridworld", "fast", True), representation="engineered")
    args = replace(args, one_hot=False)
    space = gym.spaces.Box(0, 11, (81,), np.float32)
    table = gridworld.engineered_representations()
    agent = ppo.Agent(space, gym.spaces.Discrete(50), table, np.arange(512), args, ppo.Workers(1))
    preprocess = ppo.Preprocess(gridworld.GridWorldEnv().observation_space["state"], args)
    pool = gridworld.split_actions()["test"]
    result = ppo.evaluate(agent, preprocess, args, pool, 1000, seed=0)
    assert result["episodes"] == 1000
    # An untrained policy is the uniform one: 0.3 % success, 4.9 skills an episode (exact values).
    assert result["score"] < 0.02 and abs(result["length"] - 4.92) < 0.35


@pytest.mark.slow
def test_learning_reaches_unseen_skills(tmp_path):
    extra = ["--minibatch-size", "1024", "--eval-every", "200000", "--eval-episodes", "1000"]
    assert run(command(tmp_path, *extra, steps=600_000)).returncode == 0
    results = json.loads((tmp_path / "gridworld-engineered-s0" / "results.json").read_text())
    assert results["test"]["score"] > 0.15  # a random policy: 0.003


# ---- C.2 adaptation, C.4 conditioned position head, the analyses of A.3 ----


def test_conditioned_position_head_is_the_mlp_of_code_and_chosen_action():
    agent, _ = make_agent(HYBRID, aux_conditioned=True)
    code, available = torch.randn(7, 64), random_sets(7)
    generator = torch.Generator().manual_seed(0)
    P = agent.project_actions()
    action, logprob, _ = agent.act(torch.randn(7, 7), available, P, generator)
    ids = available[torch.arange(7), action["choice"]]
    assert torch.equal(action["taken"], ids)
    # Slow and obvious: one sample at a time, alpha and beta from [code; projected action].
    _, together, _ = agent.auxiliary(code, action=action, taken=ids)
    for i in range(7):
        c = agent.action_project(agent.table[ids[i]])
        heads = [
            1 + F.softplus(head(torch.cat([code[i], c])))
            for head in (agent.fc_alpha, agent.fc_beta)
        ]
        density = torch.distributions.Beta(*heads).log_prob((action["position"][i] + 1) / 2).sum()
        stop = F.log_softmax(agent.fc_stop(code[i]), 0)[action["stop"][i]]
        assert torch.allclose(together[i], density + stop, atol=1e-5)
    # Another choice, another distribution; without the flag there is none of this.
    _, other, _ = agent.auxiliary(code, action=action, taken=(ids + 1) % 30)
    assert not torch.allclose(together, other)
    plain, _ = make_agent(HYBRID)
    assert torch.equal(
        plain.auxiliary(code, action=action)[1], plain.auxiliary(code, action=action, taken=ids)[1]
    )


@pytest.mark.parametrize(
    "changes",
    [{}, {"method": "nearest-neighbor"}, {"method": "continuous"}, {"utility": "bilinear"}],
)
def test_conditioned_head_reproduces_the_log_probabilities_of_the_rollout(changes):
    agent, _ = make_agent(HYBRID, aux_conditioned=True, **changes)
    state, available = torch.randn(9, 7), random_sets(9)
    P, generator = agent.project_actions(), torch.Generator().manual_seed(1)
    action, logprob, _ = agent.act(state, available, P, generator)
    again, _ = agent.logprob_entropy(agent.encode(state)[0], available, action, P)
    assert torch.allclose(again, logprob, atol=1e-5)


def test_corrected_head_starts_as_the_plain_one_and_adds_what_the_action_says():
    agent, _ = make_agent(HYBRID, aux_conditioned=True, aux_residual=True)
    code, ids = torch.randn(7, 64), torch.arange(7)
    projected = agent.action_project(agent.table[ids])
    for head in (agent.fc_alpha, agent.fc_beta):
        start = head.plain(code)
        assert (head(torch.cat([code, projected], 1)) - start).abs().max() < 0.1 < start.std()
        torch.nn.init.normal_(head.correction.weight)
        for i in range(7):  # slow and obvious: one sample at a time
            hidden = F.relu(head.hidden(torch.cat([code[i], projected[i]])))
            expected = head.plain(code[i]) + head.correction(hidden)
            both = torch.cat([code[i : i + 1], projected[i : i + 1]], 1)
            torch.testing.assert_close(head(both)[0], expected, rtol=1e-4, atol=1e-5)


def small(tmp_path, *extra):
    """A short Grid World run through main(); returns its folder's parent."""
    words = "--representation engineered --threads 1 --minibatch-size 64 --eval-every 256"
    words += " --valid-episodes 4 --eval-episodes 8 --no-tensorboard --total-timesteps 1024"
    words += " --device cpu"  # bit for bit: a GPU adds up in no fixed order
    return ["ppo", "gridworld", *words.split(), "--runs-dir", str(tmp_path), *extra]


def test_a_noisy_run_goes_on_with_the_same_noise_and_is_tested_without(tmp_path, monkeypatch):
    folders, update, evaluate, calls = [], ppo.update, ppo.evaluate, []

    def interrupted(agent, *args):
        calls.append(agent.noisy)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return update(agent, *args)

    def noiseless(agent, *args, **kwargs):
        assert agent.noisy is None
        return evaluate(agent, *args, **kwargs)

    monkeypatch.setattr(ppo, "evaluate", noiseless)
    for name, do in (("whole", update), ("broken", interrupted)):
        folders.append(tmp_path / name)
        words = small(tmp_path, "--table-noise", "0.5", "--run-name", name)
        monkeypatch.setattr(sys, "argv", words)
        monkeypatch.setattr(ppo, "update", do)
        with pytest.raises(KeyboardInterrupt) if do is interrupted else nullcontext():
            ppo.main()
    assert not torch.equal(calls[0], calls[1])  # another one in every rollout
    monkeypatch.setattr(ppo, "update", update)
    monkeypatch.setattr(sys, "argv", [*words, "--resume"])
    ppo.main()
    assert timeless(folders[0]) == timeless(folders[1]) and same_weights(*folders)


@pytest.mark.parametrize("method", ["utility", "nearest-neighbor"])
def test_adaptation_trains_on_the_fixed_test_set_from_scratch_or_from_a_run(
    tmp_path, method, monkeypatch
):
    policy = {"utility": "ours", "nearest-neighbor": "discrete"}[method]
    start = {"utility": "engineered", "nearest-neighbor": "nearest_neighbor"}[method]
    folder = tmp_path / f"gridworld-{start}-s0"
    method = ["--method", method]
    for extra in ([], ["--adapt"], ["--finetune", str(folder)]):
        monkeypatch.setattr(sys, "argv", small(tmp_path, *method, *extra))
        ppo.main()
    test_ids = gridworld.split_actions()["test"]
    for name in (f"{policy}_from_scratch", f"{policy}_finetuned"):
        run = tmp_path / f"gridworld-{name}-s0"
        results = json.loads((run / "results.json").read_text())
        assert "test" not in results and results["train"]["episodes"] == 8
        best = ppo.load_checkpoint(run / "best.pt", "cpu")
        assert np.array_equal(best["agent"]["train_ids"], test_ids)
        rows = list(csv.DictReader((run / "metrics.csv").open()))
        assert all(r["train_score"] and not r["valid_score"] for r in rows)


def test_the_encoder_learns_at_its_own_rate(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", small(tmp_path, "--encoder-rate", "0.5", "--run-name", "run"))
    ppo.main()
    checkpoint = ppo.load_checkpoint(tmp_path / "run" / "checkpoint.pt", "cpu")
    encoder, *others = checkpoint["optimizer"]["param_groups"]
    own = [name for name in checkpoint["agent"] if name.startswith("encoder.")]
    assert len(encoder["params"]) == len(own) > 0 and len(others) == 2
    assert all(encoder["lr"] == 0.5 * group["lr"] > 0 for group in others)


def test_finetuning_starts_from_the_weights_of_the_run_and_resets_only_the_discrete_head(
    tmp_path, monkeypatch
):
    for method in ("utility", "nearest-neighbor"):
        argv = small(tmp_path, "--method", method, "--run-name", method)
        monkeypatch.setattr(sys, "argv", argv)
        ppo.main()
        words = [*argv[2:], "--run-name", f"{method}-more", "--finetune", str(tmp_path / method)]
        args = tyro_args([*words, "--adapt"])
        run = ppo.Run(args)
        theirs = ppo.load_checkpoint(tmp_path / method / "best.pt", "cpu")["agent"]
        own = run.agent.state_dict()
        same = {
            k for k in own if own[k].shape == theirs[k].shape and torch.equal(own[k], theirs[k])
        }
        fresh = {"train_ids"} | ({"head.weight", "head.bias"} if method != "utility" else set())
        # A bias of zeros may agree by chance of its initial value.
        assert set(own) - same <= fresh and "train_ids" not in same
        assert run.optimizer.state_dict()["state"] == {}


def tyro_args(words):
    return ppo.tyro.cli(ppo.Args, args=words, default=ppo.default_args("gridworld", "fast", False))


@pytest.mark.parametrize(
    "extra, words",
    [
        (["--finetune", "nowhere"], "no checkpoint"),
        (["--adapt", "--method", "continuous"], "continuous"),
        (["--aux-conditioned"], "no position"),
        (["--table-noise", "-1"], "table_noise -1.0 is not at least 0"),
        (["--table-noise", "1", "--method", "continuous"], "table_noise needs method 'utility'"),
    ],
)
def test_adaptation_refuses_with_one_line_and_leaves_nothing(tmp_path, extra, words, monkeypatch):
    monkeypatch.setattr(sys, "argv", small(tmp_path, *extra))
    with pytest.raises(SystemExit) as e:
        ppo.main()
    assert words in str(e.value) and "\n" not in str(e.value)
    assert not any(tmp_path.iterdir())


def test_finetuning_refuses_another_policy_table_split_or_state(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", small(tmp_path))
    ppo.main()
    run = str(tmp_path / "gridworld-engineered-s0")
    other = {
        "its networks differ": ["--representation", "engineered-5d"],
        r"its networks differ \(action_project.bias": ["--method", "nearest-neighbor"],
        "split_seed is 0 there, 1 here": ["--split-seed", "1"],
        "one_hot is True there, False here": ["--no-one-hot"],
    }
    for words, extra in other.items():
        monkeypatch.setattr(sys, "argv", small(tmp_path, *extra, "--finetune", run))
        with pytest.raises(SystemExit, match=f"cannot fine-tune .*: {words}"):
            ppo.main()
    assert [p.name for p in tmp_path.iterdir()] == ["gridworld-engineered-s0"]


def test_a_run_that_diverges_in_the_last_step_of_an_update_says_so(tmp_path, monkeypatch):
    update = ppo.update

    def ruined(agent, *args):
        losses = update(agent, *args)
        agent.critic.bias.data.fill_(float("nan"))
        return losses

    monkeypatch.setattr(ppo, "update", ruined)
    monkeypatch.setattr(sys, "argv", small(tmp_path))
    with pytest.raises(SystemExit, match="learning_rate .* is too high"):
        ppo.main()


def test_quick_is_nothing_special_for_an_environment_of_ones_own(monkeypatch):
    monkeypatch.setitem(ppo.PRESETS, "dial", ppo.Args(env="dial"))
    assert ppo.default_args("dial", "fast", True).quick


def test_a_run_that_diverges_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", small(tmp_path, "--learning-rate", "1e6"))
    with pytest.raises(SystemExit, match="learning_rate 1000000.0 is too high") as e:
        ppo.main()
    assert "\n" not in str(e.value)


def test_ceiling_of_fewer_skills_is_not_one(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", small(tmp_path, "--eval-available", "5"))
    ppo.main()
    results = json.loads((tmp_path / "gridworld-engineered-s0" / "results.json").read_text())
    assert results["ceiling"] == {"train": None, "valid": None, "test": None}
    monkeypatch.setattr(
        sys, "argv", ["ppo", "evaluate", str(tmp_path / "gridworld-engineered-s0"), "--episodes=0"]
    )
    with pytest.raises(SystemExit, match="episodes 0 is not allowed"):
        ppo.main()


def test_pools_of_the_analyses():
    import create_env

    split = create_env.split_actions("analysis")
    train, test = split["train"], split["test"]
    args = replace(ppo.PRESETS["create"], split="analysis")
    table = torch.randn(create_env.NUM_ACTIONS, 3, generator=torch.Generator().manual_seed(0))

    def pool(**options):
        return ppo.restrict_pool(ppo.EvaluateArgs(run="", **options), args, table, test, train)

    sizes = [len(pool(min_angle_gap=gap)) for gap in (3, 6, 9, 12, 15)]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] > 50
    far = pool(min_angle_gap=9)
    assert create_env.NO_OP in far
    assert (create_env.angle_gaps(far[far != create_env.NO_OP], train) >= 9).all()
    # Embedding distance: by brute force over a few tools; q0.5 keeps half of them.
    far = set(pool(min_embedding_distance="0.05"))
    for tool in test[1:30]:
        nearest = min(float((table[tool] - table[t]).square().sum()) for t in train)
        assert (tool in far) == (nearest >= 0.05)
    assert len(pool(min_embedding_distance="q0.5")) == pytest.approx(len(test) / 2, abs=2)
    # Unseen ratio: that share of the pool, the rest training tools; the no-op is in both.
    for ratio in (0.0, 0.2, 0.6, 1.0):
        mixed = pool(unseen_ratio=ratio)
        tools = mixed[mixed != create_env.NO_OP]
        assert len(np.unique(mixed)) == len(mixed)
        assert np.isin(tools, test).mean() == pytest.approx(ratio, abs=0.001)
        assert np.isin(tools, np.union1d(train, test)).all()
    for bad in (dict(unseen_ratio=1.5), dict(min_embedding_distance="q7")):
        with pytest.raises(ValueError):
            pool(**bad)


def test_the_tally_counts_what_was_chosen_and_what_was_on_offer():
    tally = np.array([[6, 0, 2, 0], [8, 8, 8, 8]])
    words = ppo.favourites(tally, np.array(["left", "left", "right", "none"]))
    assert words == (
        "chosen: left 75.0% (on offer 50.0%), right 25.0% (on offer 25.0%), none 0.0% (on offer "
        "25.0%); 2 different actions, most often 0 (left), 75.0%"
    )


def test_the_tally_of_an_evaluation_is_that_of_its_episodes(tmp_path):
    args = ppo.default_args("gridworld", "fast", False)
    args = replace(args, representation="engineered", runs_dir=str(tmp_path))
    run = ppo.Run(args)
    run.envs.close()
    pool, tally = run.pools["test"], np.zeros((2, gridworld.NUM_ACTIONS), np.int64)
    played = [
        ppo.evaluate(run.agent, run.preprocess, args, pool, 40, 3, 20, tally=t)
        for t in (tally, None)
    ]
    assert played[0] == played[1]  # counting changes nothing
    assert tally[0].sum() == round(40 * played[0]["length"])  # 40 environments, an episode each
    assert tally[1].sum() == 20 * tally[0].sum() and (tally[0] <= tally[1]).all()
    assert set(np.flatnonzero(tally[1])) <= set(pool)


def test_saved_evaluations_replace_their_own_row(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", small(tmp_path))
    ppo.main()
    run = str(tmp_path / "gridworld-engineered-s0")
    common = dict(run=run, episodes=8, save=True)
    for options in (dict(), dict(num_available=10), dict(), dict(unseen_ratio=0.5)):
        ppo.evaluate_run(ppo.EvaluateArgs(**common, **options))
    rows = list(csv.DictReader((Path(run) / "evaluations.csv").open()))
    assert [r["num_available"] for r in rows] == ["10", "50", "50"]
    assert [r["unseen_ratio"] for r in rows] == ["", "", "0.5"]
    assert all(0 <= float(r["score"]) <= 1 and r["episodes"] == "8" for r in rows)
