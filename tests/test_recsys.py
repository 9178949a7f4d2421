"""Recommender System: worked examples, slow against fast, distributions, properties, API."""

import inspect
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import recsys
from recsys import BANDIT, GONE, ORGANIC, RecSysEnv, make_vec

SMALL = np.arange(30, 50)  # a pool of 20 products
TEST = recsys.split_actions()["test"]


def constant_click(monkeypatch, p):
    monkeypatch.setattr(recsys, "click_probability", lambda x: np.full(np.shape(x), float(p)))


# ---- Eq. 2, products, split ----


@pytest.mark.parametrize(
    ("x", "p"),
    [
        *[(-10, 0.0150), (-7, 0.0183), (-4, 0.0287), (-2, 0.0483), (-1, 0.0672), (0, 0.0967)],
        *[(1, 0.1405), (2, 0.2008), (4, 0.3562), (6, 0.5034), (8, 0.6033), (10, 0.6611)],
        *[(-1000, 0.0130), (1000, 0.7311)],
    ],
)
def test_click_probability_worked_examples(x, p):
    assert recsys.click_probability(x) == pytest.approx(p, abs=5e-5)


def test_mean_click_probability_of_a_random_product():
    x = np.random.default_rng(0).normal(0, np.sqrt(10), 1_000_000)
    assert recsys.click_probability(x).mean() == pytest.approx(0.149, abs=1e-3)


def test_products_are_unit_vectors_and_mu_has_std_3():
    c, mu = recsys.product_vectors(), recsys.product_bias()
    assert c.shape == (10_000, 16) and mu.shape == (10_000,)
    np.testing.assert_allclose(np.linalg.norm(c, axis=1), 1)
    assert abs(mu.std() - 3) < 0.1 and abs(mu.mean()) < 0.1
    np.testing.assert_allclose(
        c.T @ c / len(c), np.eye(16) / 16, atol=0.004
    )  # no direction is special
    assert np.abs(np.corrcoef(c.T, mu)[-1, :-1]).max() < 0.04  # c tells nothing about mu


def test_products_are_drawn_once():
    assert recsys.product_vectors() is recsys.product_vectors(0)
    assert not np.array_equal(recsys.product_vectors(1), recsys.product_vectors())
    with pytest.raises(ValueError, match="read-only"):
        recsys.product_bias()[0] = 1


def test_split_is_2_1_1_disjoint_and_complete():
    split = recsys.split_actions()
    assert [len(ids) for ids in split.values()] == [5000, 2500, 2500]
    assert list(split) == ["train", "valid", "test"]
    for ids in split.values():
        assert ids.dtype == np.int64 and np.all(np.diff(ids) > 0)
    assert np.array_equal(np.sort(np.concatenate(list(split.values()))), np.arange(10_000))
    assert np.array_equal(recsys.split_actions(seed=0)["test"], TEST)
    assert not np.array_equal(recsys.split_actions(seed=1)["test"], TEST)
    with pytest.raises(ValueError, match="full"):
        recsys.split_actions("full")


def test_representations_labels_and_no_observations():
    c, full = recsys.engineered_representations(), recsys.engineered_representations(True)
    assert c.shape == (10_000, 16) and full.shape == (10_000, 17)
    assert c.dtype == full.dtype == np.float32
    assert np.array_equal(full[:, :16], c)
    np.testing.assert_allclose(full[:, 16] * 3, recsys.product_bias(), rtol=1e-6)
    assert set(recsys.action_labels()) == {"product"} and len(recsys.action_labels()) == 10_000
    assert recsys.MODALITIES == () and recsys.METRIC == "ctr" and recsys.NUM_ACTIONS == 10_000
    with pytest.raises(ValueError, match="no action observations; use the engineered"):
        recsys.action_observations(TEST, 4, "state")


# ---- the user model, draw by draw ----


def test_transition_frequencies_and_perturbation_of_a_draw():
    env, n = RecSysEnv(SMALL, 5), 20_000
    env.reset(seed=0)
    for mode in (ORGANIC, BANDIT, GONE):
        counts, squares = np.zeros(3), np.zeros(n)
        for i in range(n):
            env.mode, env.user = mode, np.zeros(16)
            env._draw()
            counts[env.mode] += 1
            squares[i] = np.mean(env.user**2)
        expected = recsys.TRANSITIONS[mode]
        assert np.all(np.abs(counts / n - expected) <= 4 * np.sqrt(expected * (1 - expected) / n))
        # 0.01 sigma_2^2 n^2: mean 0.01; the scalar sigma_2 is shared, so the spread is wide
        assert squares.mean() == pytest.approx(0.01, abs=4 * squares.std() / np.sqrt(n))
    assert recsys.TRANSITIONS.tolist() == [[0.74, 0.25, 0.01], [0.05, 0.94, 0.01], [0, 0, 1]]


def ks_distance(a, b):
    """Largest gap between two empirical distribution functions (Kolmogorov-Smirnov)."""
    points = np.concatenate([a, b])
    return np.abs(
        np.searchsorted(np.sort(a), points, "right") / len(a)
        - np.searchsorted(np.sort(b), points, "right") / len(b)
    ).max()


def test_closed_form_session_equals_the_loop():
    n, env, rng = 20_000, RecSysEnv(SMALL, 5), np.random.default_rng(1)
    env.reset(seed=0)
    moved, views, left = np.zeros((n, 16)), np.zeros(n), np.zeros(n, bool)
    for i in range(n):
        env.mode, env.user, env.timeline = ORGANIC, np.zeros(16), []
        env._organic_session()
        moved[i], views[i], left[i] = env.user, len(env.timeline), env.mode == GONE
    variance, fast_left = recsys.organic_sessions(rng, n)
    fast = 0.1 * np.sqrt(variance)[:, None] * rng.standard_normal((n, 16))
    assert views.min() == 1
    assert views.mean() == pytest.approx(1 / 0.26, abs=4 * views.std() / np.sqrt(n))  # 3.85
    for rate in (left.mean(), fast_left.mean()):
        assert rate == pytest.approx(0.0385, abs=4 * np.sqrt(0.0385 / n))
    for sample in (moved, fast):
        squares = (sample**2).mean(1)
        assert squares.mean() == pytest.approx(0.01 / 0.26, abs=4 * squares.std() / np.sqrt(n))
        assert np.abs(sample.mean(0)).max() < 5 * sample.std() / np.sqrt(n)
    bound = 1.63 * np.sqrt(2 / n)  # 1 % level
    assert ks_distance((moved**2).sum(1), (fast**2).sum(1)) < bound
    assert ks_distance(moved[:, 3], fast[:, 3]) < bound


def test_a_click_always_leads_to_an_organic_session(monkeypatch):
    constant_click(monkeypatch, 1)
    env, sessions = RecSysEnv(SMALL, 5, "rgb_array"), 0
    for seed in range(30):
        env.reset(seed=seed)
        over = False
        while not over:
            before = len(env.timeline)
            _, reward, terminated, truncated, _ = env.step(0)
            over = terminated or truncated
            assert reward == 1 and env.timeline[before][1]
            assert env.timeline[before + 1 :] and set(env.timeline[before + 1 :]) == {None}
            sessions += 1
    assert sessions > 300


@pytest.mark.parametrize(
    ("p", "options", "first", "later"),
    [  # chance to end at the first and at a later recommendation
        (0, {}, 1 / 26 + 25 / 26 * (0.01 + 0.05 / 26), 0.01 + 0.05 / 26),
        (1, {}, 1 / 26, 1 / 26),  # a click revives who left unnoticed during the reset
        (0, {"leave_at_reset": False}, 0.01 + 0.05 / 26, 0.01 + 0.05 / 26),
        (1, {"leave_at_reset": False}, 1 / 26, 1 / 26),
    ],
)
def test_leave_rates(monkeypatch, p, options, first, later):
    constant_click(monkeypatch, p)
    envs = make_vec(1000, SMALL, 5, 0, **options)
    envs.reset()
    counts = np.zeros((2, 2))  # (first or later, all or left)
    for _ in range(200):
        at_first = envs.recommendations == 0
        _, _, terminated, _, _ = envs.step(np.zeros(1000, int))
        for row, mask in enumerate((at_first, ~at_first)):
            counts[row] += mask.sum(), terminated[mask].sum()
    for (total, left), expected in zip(counts, (first, later), strict=True):
        assert left / total == pytest.approx(expected, abs=4 * np.sqrt(expected / total))
    scalar, n = RecSysEnv(SMALL, 5, **options), 3000
    scalar.reset(seed=0)
    ended = sum(scalar.reset() is not None and scalar.step(0)[2] for _ in range(n))
    assert ended / n == pytest.approx(first, abs=4 * np.sqrt(first / n))


def test_no_repeat_reward_pays_a_product_once(monkeypatch):
    constant_click(monkeypatch, 1)
    envs = make_vec(50, SMALL, 5, 0, no_repeat_reward=True)
    envs.reset()
    first = np.ones(50, bool)
    for _ in range(60):
        _, rewards, terminated, truncated, infos = envs.step(np.full(50, 2))
        assert np.array_equal(rewards, first.astype(float))
        first = terminated | truncated
        if first.any():
            assert np.all(infos["final_info"]["clicks"][first] == 1)
    env = RecSysEnv(SMALL, 5, no_repeat_reward=True, leave_at_reset=False)
    rewards = [(env.reset(seed=0), env.step(2)[1], env.step(2)[1], env.step(3)[1])[1:]]
    assert rewards == [(1.0, 0.0, 1.0)]


# ---- the batched environment against the scalar one ----


class Recorder:
    """A generator that writes down what it returned."""

    def __init__(self, rng):
        self.rng, self.log = rng, []

    def __getattr__(self, name):
        def call(*args, **kwargs):
            value = getattr(self.rng, name)(*args, **kwargs)
            self.log.append(np.array(value))
            return value

        return call


class Script:
    """A generator that returns prepared values, for the scalar environment."""

    def __init__(self):
        self.queue = []

    def _next(self, *args, **kwargs):
        return self.queue.pop(0)

    random = standard_normal = choice = _next

    def session(self, views, left):
        """The draws of an organic session that does not move the user any further."""
        modes = [ORGANIC] * (views - 1) + [GONE if left else BANDIT]
        self.queue += [value for mode in modes for value in (mode, 0.0, np.zeros(16))]


def script_resets(scripts, envs, log, available):
    users, views, variance, u_left, noise = log
    left = u_left < recsys.SESSION_LEAVE
    for row, i in enumerate(envs):
        script = scripts[i]
        if available is not None:
            script.queue.append(available[i])
        script.queue.append(users[row])
        script.session(views[row], left[row])
        # the whole session's perturbation goes to its first draw: [..., mode, sigma_2, noise, ...]
        script.queue[-3 * views[row] + 1] = np.sqrt(variance[row])
        script.queue[-3 * views[row] + 2] = noise[row]


def script_steps(scripts, gone, organic, log):
    (u_click, u_mode), z, views, variance, u_left, noise = log
    total = z**2
    total[organic] += variance  # all the perturbations of a step go to its first draw
    left = u_left < recsys.SESSION_LEAVE
    sessions = dict(zip(np.flatnonzero(organic), zip(views, left, strict=True), strict=True))
    for i, script in enumerate(scripts):
        mode = ORGANIC if u_mode[i] < 0.05 else GONE if u_mode[i] < 0.06 else BANDIT
        mode = GONE if gone[i] else mode
        script.queue += [u_click[i], mode, np.sqrt(total[i]), noise[i]]
        if i in sessions:
            script.session(*sessions[i])


@pytest.mark.parametrize("num_available", [7, 20])
@pytest.mark.parametrize(
    "options",
    [{}, {"unit_norm_state": True, "leave_at_reset": False}, {"no_repeat_reward": True}],
    ids=str,
)
@pytest.mark.parametrize("rare_events", [False, True])
def test_vector_env_equals_scalar_env_on_shared_random_numbers(
    monkeypatch, num_available, options, rare_events
):
    if rare_events:  # make leaving unnoticed, coming back, and the time limit frequent
        monkeypatch.setattr(recsys, "SESSION_LEAVE", 0.5)
        monkeypatch.setattr(recsys, "MAX_RECOMMENDATIONS", 4)
    n, rng = 6, np.random.default_rng(3)
    envs = make_vec(n, SMALL, num_available, 5, **options)
    recorder = envs._np_random = Recorder(envs._np_random)
    scalars = [RecSysEnv(SMALL, num_available, **options) for _ in range(n)]
    scripts = [Script() for _ in range(n)]
    for scalar, script in zip(scalars, scripts, strict=True):
        scalar._np_random = script

    def take_log(count):
        log, recorder.log = recorder.log, []
        return log[:count]

    def available():
        return envs.available.copy() if num_available < len(SMALL) else None

    observation, _ = envs.reset()
    script_resets(scripts, range(n), take_log(5), available())
    for i, scalar in enumerate(scalars):
        compare(scalar.reset()[0], observation, i)
    ended = clicked = timed_out = unnoticed = 0
    for _ in range(200 if rare_events else 1000):
        actions, gone = (
            rng.integers(num_available, size=n),
            np.array([e.mode for e in scalars]) == GONE,
        )
        users, ids = envs.users.copy(), envs.available[np.arange(n), actions]
        observation, rewards, terminated, truncated, infos = envs.step(actions)
        over = terminated | truncated
        log = take_log(None)
        p = recsys.click_probability((envs.c[ids] * users).sum(1) + envs.mu[ids])
        click = log[0][0] < p
        script_steps(scripts, gone, click | ((log[0][1] < 0.05) & ~gone), log[:6])
        for i, scalar in enumerate(scalars):
            last, reward, *flags, info = scalar.step(actions[i])
            assert scripts[i].queue == []
            assert [reward, *flags] == [rewards[i], terminated[i], truncated[i]]
            if not over[i]:
                assert info == {}
                compare(last, observation, i)
            else:
                compare(last, {key: [v] for key, v in infos["final_obs"][i].items()}, 0)
                compare_info(info, infos["final_info"], i)
        if over.any():
            script_resets(scripts, np.flatnonzero(over), log[6:11], available())
            for i in np.flatnonzero(over):
                compare(scalars[i].reset()[0], observation, i)
        else:
            assert infos == {}
        ended, clicked = ended + over.sum(), clicked + click.sum()
        timed_out, unnoticed = timed_out + truncated.sum(), unnoticed + gone.sum()
    assert ended > 80 and clicked > 100 and timed_out > 10  # every rule was at work
    assert (unnoticed > 0) == options.get("leave_at_reset", True)


def compare(scalar_observation, observation, i):
    np.testing.assert_allclose(scalar_observation["state"], observation["state"][i], atol=1e-5)
    assert np.array_equal(scalar_observation["available"], observation["available"][i])


def compare_info(info, final_info, i):
    assert set(final_info) == set(info) | {f"_{key}" for key in info}
    for key, value in info.items():
        assert final_info[f"_{key}"][i]
        if isinstance(value, dict):
            compare_info(value, final_info[key], i)
        else:
            assert final_info[key][i] == value


def play_scalar(episodes, num_available, seed, **options):
    """(clicks, recommendations) of episodes in which position 0 is chosen always; (episodes, 2)."""
    env, results = RecSysEnv(TEST, num_available, **options), []
    env.reset(seed=seed)
    for _ in range(episodes):
        env.reset()
        info = {}
        while not info:
            info = env.step(0)[-1]
        results.append((info["clicks"], info["recommendations"]))
    return np.array(results)


def test_scalar_and_batched_distributions_agree():
    slow = play_scalar(1200, 100, 0)
    n, quota = 100, 100
    envs, fast = make_vec(n, TEST, 100, 1), [[] for _ in range(n)]
    envs.reset()
    while min(map(len, fast)) < quota:
        infos = envs.step(np.zeros(n, int))[-1]
        for i in np.flatnonzero(infos.get("_final_info", [])):
            info = infos["final_info"]
            fast[i].append((info["clicks"][i], info["recommendations"][i]))
    fast = np.concatenate([episodes[:quota] for episodes in fast])  # (10_000, 2)
    for statistic in (
        lambda x: x[:, 0] / x[:, 1],  # CTR
        lambda x: x[:, 0],  # clicks
        lambda x: x[:, 1],  # length
        lambda x: x[:, 1] == 1,
        lambda x: x[:, 1] == 100,
    ):
        a, b = statistic(slow), statistic(fast)
        error = np.sqrt(a.var() / len(a) + b.var() / len(b))
        assert abs(a.mean() - b.mean()) < 4 * error
    assert ks_distance(slow[:, 1], fast[:, 1]) < 1.63 * np.sqrt(1 / len(slow) + 1 / len(fast))


def structure(value):
    """Keys, types and shapes of an info, without its values."""
    if isinstance(value, dict):
        return {key: structure(item) for key, item in value.items()}
    return (value.dtype, value.shape) if isinstance(value, np.ndarray) else type(value)


def test_same_step_infos_have_the_structure_of_sync_vector_env():
    n = 8
    sync = SyncVectorEnv([lambda: RecSysEnv(SMALL, 5)] * n, autoreset_mode=AutoresetMode.SAME_STEP)
    envs = make_vec(n, SMALL, 5, 0)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    for space in ("observation_space", "action_space"):
        assert getattr(envs, space) == getattr(sync, space)
        assert getattr(envs, f"single_{space}") == getattr(sync, f"single_{space}")
    seen = []
    for vector in (sync, envs):
        observation, infos = vector.reset(seed=1)
        assert infos == {} and observation in vector.observation_space
        for _ in range(1000):
            observation, rewards, terminated, truncated, infos = vector.step(np.zeros(n, int))
            assert observation in vector.observation_space
            over = terminated | truncated
            assert (infos == {}) == (not over.any())
            if 0 < over.sum() < n:
                seen.append((structure(infos), structure(rewards), structure(terminated)))
                final = infos["final_obs"]
                assert [f is not None for f in final] == over.tolist()
                seen[-1] += (structure(final[over][0]), structure(observation))
                assert np.array_equal(infos["_final_info"], over)
                for key in ("ctr", "clicks", "recommendations"):
                    assert not infos["final_info"][key][~over].any()
                break
    assert len(seen) == 2 and seen[0] == seen[1]


def test_infos_add_up_to_the_rewards():
    n, rng = 16, np.random.default_rng(0)
    envs = make_vec(n, SMALL, 5, 0)
    observation, _ = envs.reset()
    total, length, offers, episodes = np.zeros(n), np.zeros(n, int), observation["available"], 0
    for _ in range(600):
        observation, rewards, terminated, truncated, infos = envs.step(rng.integers(5, size=n))
        total, length = total + rewards, length + 1
        assert length.max() <= 100
        assert np.array_equal(truncated, (length == 100) & ~terminated)
        for i in np.flatnonzero(terminated | truncated):
            info = infos["final_info"]
            assert info["episode"]["r"][i] == info["clicks"][i] == total[i]
            assert info["episode"]["l"][i] == info["recommendations"][i] == length[i]
            assert info["ctr"][i] == total[i] / length[i]
            assert np.array_equal(infos["final_obs"][i]["available"], offers[i])
            offers[i], total[i], length[i] = observation["available"][i], 0, 0
            episodes += 1
        assert np.array_equal(observation["available"], offers)
    assert episodes > 100


# ---- what is on offer ----


@pytest.mark.parametrize("kind", ["scalar", "vector"])
def test_available_is_a_uniform_draw_without_replacement(kind):
    pool, K, n = np.arange(100, 112), 5, 6000
    if kind == "scalar":
        env = RecSysEnv(pool, K)
        env.reset(seed=0)
        draws = np.array([env.reset()[0]["available"] for _ in range(n)])
    else:
        envs = make_vec(7, pool, K, 0)  # 7 does not divide the bank's blocks
        draws = np.concatenate([envs.reset(seed=s)[0]["available"] for s in range(n // 7)])
    assert np.all(np.diff(np.sort(draws), axis=1) > 0) and np.isin(draws, pool).all()
    held = (draws[:, :, None] == pool).any(1).astype(float)  # (n, 12)
    assert np.abs(held.mean(0) - K / 12).max() < 0.03
    pairs = (held.T @ held / len(held))[~np.eye(12, dtype=bool)]
    assert np.abs(pairs - K * (K - 1) / (12 * 11)).max() < 0.03
    first = np.bincount(draws[:, 0] - 100, minlength=12) / len(draws)  # each position is uniform
    assert np.abs(first - 1 / 12).max() < 0.016


def test_available_changes_per_episode_and_full_pool_keeps_its_order():
    shuffled = np.random.default_rng(0).permutation(SMALL)
    for options in ({"num_available": 20}, {"num_available": 5}):
        env, sets = RecSysEnv(shuffled, **options), []
        for seed in range(5):
            sets.append(env.reset(seed=seed)[0]["available"])
        envs = make_vec(5, shuffled, seed=0, **options)
        sets += list(envs.reset()[0]["available"])
        for _ in range(300):
            observation, _, terminated, truncated, _ = envs.step(np.zeros(5, int))
            sets += list(observation["available"][terminated | truncated])
        different = len({tuple(s) for s in sets})
        if options["num_available"] == 20:
            assert different == 1 and np.array_equal(sets[0], SMALL)
        else:
            assert different > 0.9 * len(sets)


@pytest.mark.parametrize(
    ("pool", "num_available", "message"),
    [
        (np.arange(5), 6, "num_available is 6; allowed: integers 1..5"),
        (np.arange(5), 0, "num_available is 0"),
        ([1, 2, 2], 2, "2 is in the pool twice"),
        ([1, 10_000], 2, "10000 does not exist; allowed: 0..9999"),
        ([-1, 3], 2, "-1 does not exist"),
        ([0.5, 3], 2, "float64"),
        ([[1, 2], [3, 4]], 2, "1-D"),
        ([], 1, "num_available is 1"),
    ],
)
def test_bad_pools(pool, num_available, message):
    with pytest.raises(ValueError, match=message):
        RecSysEnv(pool, num_available)
    with pytest.raises(ValueError, match=message):
        make_vec(2, pool, num_available, 0)


def test_other_bad_input():
    with pytest.raises(ValueError, match="num_envs is 0"):
        make_vec(0, SMALL, 5, 0)
    with pytest.raises(ValueError, match="human"):
        RecSysEnv(SMALL, 5, render_mode="human")
    env, envs = RecSysEnv(SMALL, 5), make_vec(2, SMALL, 5, 0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)
    env.reset(seed=0), envs.reset()
    for action in (-1, 5):
        with pytest.raises(ValueError, match=r"allowed: 0\.\.4"):
            env.step(action)
        with pytest.raises(ValueError, match=r"allowed: 0\.\.4"):
            envs.step(np.array([0, action]))
    for action in (1.5, None, True, [1]):
        with pytest.raises(ValueError, match="allowed: one integer"):
            env.step(action)
    for actions in (np.array([0]), [0.0, 1.0], [np.nan, 0], [True, False]):
        with pytest.raises(ValueError, match="allowed: 2 integers"):
            envs.step(actions)
    with pytest.raises(gym.error.ResetNeeded):
        make_vec(2, SMALL, 5, 0).step([0, 0])
    with pytest.raises(ValueError, match="num_available is 5.0"):
        RecSysEnv(SMALL, 5.0)
    with pytest.raises(gym.error.ResetNeeded):
        RecSysEnv(SMALL, 5, render_mode="rgb_array").render()
    with pytest.raises(ValueError, match="unknown policy 'best'"):
        recsys.reference_ctr("best", SMALL, 5, 10, 0)
    with pytest.raises(ValueError, match="episodes is 0"):
        recsys.reference_ctr("random", SMALL, 5, 0, 0)


# ---- API, seeds, properties ----


@pytest.mark.parametrize("part", ["train", "valid", "test"])
@pytest.mark.parametrize("options", [{}, {"unit_norm_state": True, "fully_observable": True}])
def test_check_env_without_warnings(part, options):
    pool = recsys.split_actions()[part]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        name = "ActionGen/RecSys-v0"
        env = gym.make(name, action_pool=pool, render_mode="rgb_array", **options)
        check_env(env.unwrapped)
    assert env.unwrapped.num_available == 500 and env.action_space == gym.spaces.Discrete(500)
    assert np.array_equal(RecSysEnv().action_pool, recsys.split_actions()["train"])


def rollout(envs, steps=150, **reset):
    rng = np.random.default_rng(0)
    log = [envs.reset(**reset)[0]]
    for _ in range(steps):
        observation, *rest, _ = envs.step(rng.integers(envs.num_available, size=envs.num_envs))
        log.append((observation, *rest))
    return log


def test_one_seed_one_run():
    reference = rollout(make_vec(4, SMALL, 5, 7))
    np.testing.assert_equal(rollout(make_vec(4, SMALL, 5, 7)), reference)
    np.testing.assert_equal(rollout(make_vec(4, SMALL, 5, 7, fully_observable=True)), reference)
    used = make_vec(4, SMALL, 5, 99)
    rollout(used)
    np.testing.assert_equal(rollout(used, seed=7), reference)  # a seed forgets everything before
    with pytest.raises(AssertionError):
        np.testing.assert_equal(rollout(make_vec(4, SMALL, 5, 8)), reference)
    with pytest.raises(AssertionError):
        np.testing.assert_equal(rollout(used), reference)  # without a seed: new users
    first, second = RecSysEnv(SMALL, 5), RecSysEnv(SMALL, 5, "rgb_array")
    np.testing.assert_equal(first.reset(seed=3), second.reset(seed=3))
    while not first._over:  # recording the timeline draws nothing
        np.testing.assert_equal(first.step(1), second.step(1))


def test_global_numpy_state_is_neither_read_nor_changed():
    np.random.seed(0)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    rollout(make_vec(4, SMALL, 5, 7), steps=20)
    recsys.reference_ctr("random", SMALL, 5, 10, 0)
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_observations_are_fresh_arrays():
    envs = make_vec(4, SMALL, 5, 0)
    kept = [envs.reset()[0]]
    copies = [{key: value.copy() for key, value in kept[0].items()}]
    for _ in range(200):
        observation, _, _, _, infos = envs.step(np.zeros(4, int))
        for one in [observation, *filter(None, infos.get("final_obs", []))]:
            kept.append(one)
            copies.append({key: value.copy() for key, value in one.items()})
    np.testing.assert_equal(kept, copies)
    kept[-1]["available"][:] = 0  # the learner may also write into them
    kept[-1]["state"][:] = 0
    assert np.isin(envs.available, SMALL).all() and np.abs(envs.users).min() > 0


def test_unit_norm_state_is_the_direction_of_the_same_user():
    raw, unit = (make_vec(6, SMALL, 5, 0, unit_norm_state=flag) for flag in (False, True))
    for (a, b), _ in zip(
        zip(rollout(raw)[1:], rollout(unit)[1:], strict=True), range(50), strict=False
    ):
        norm = np.linalg.norm(a[0]["state"], axis=1, keepdims=True)
        np.testing.assert_allclose(a[0]["state"] / norm, b[0]["state"], atol=1e-5)


@given(x=st.floats(-50, 50), step=st.floats(0.01, 10))
def test_click_probability_grows_and_stays_in_its_limits(x, step):
    p, q = recsys.click_probability(x), recsys.click_probability(x + step)
    assert 0.0129 < p <= q < 0.7312


@settings(max_examples=40, deadline=None)
@given(data=st.data(), seed=st.integers(0, 2**31))
def test_any_pool_any_actions(data, seed):
    ids = st.integers(0, recsys.NUM_ACTIONS - 1)
    pool = data.draw(st.lists(ids, min_size=1, max_size=30, unique=True))
    num_available = data.draw(st.integers(1, len(pool)))
    num_envs = data.draw(st.integers(1, 5))
    options = {key: data.draw(st.booleans()) for key in ("no_repeat_reward", "unit_norm_state")}
    envs = make_vec(num_envs, pool, num_available, seed, **options)
    rng = np.random.default_rng(seed)
    observation, _ = envs.reset()
    for _ in range(60):
        assert observation in envs.observation_space
        assert np.isin(observation["available"], pool).all()
        assert np.all(np.diff(np.sort(observation["available"], axis=1), axis=1) > 0)
        actions = rng.integers(num_available, size=num_envs)
        observation, rewards, terminated, truncated, infos = envs.step(actions)
        assert set(rewards) <= {0.0, 1.0} and not (terminated & truncated).any()
        if infos:
            assert np.all((infos["final_info"]["ctr"] >= 0) & (infos["final_info"]["ctr"] <= 1))
            if options["no_repeat_reward"]:
                assert infos["final_info"]["clicks"].max() <= num_available


# ---- floors and ceilings ----


def test_reference_policies_choose_what_they_say():
    rng = np.random.default_rng(0)
    users, c, mu = rng.normal(size=(9, 16)), rng.normal(size=(9, 12, 16)), rng.normal(size=(9, 12))
    for i in range(9):
        taste = [sum(c[i, k] * users[i]) for k in range(12)]
        assert recsys.c_only(users, c, mu, rng)[i] == np.argmax(taste)
        assert recsys.mu_only(users, c, mu, rng)[i] == np.argmax(mu[i])
        assert recsys.oracle(users, c, mu, rng)[i] == np.argmax(taste + mu[i])
    assert set(recsys.random_choice(users, c, mu, rng)) <= set(range(12))


@pytest.mark.parametrize("policy", recsys.POLICIES)
def test_reference_ctr_equals_a_plain_loop(policy):
    """Same seed, same environment, but products looked up anew in every step, and kept per slot."""
    envs, episodes = make_vec(10, TEST, 50, 4), [[] for _ in range(10)]
    rng = np.random.default_rng([4, 1])
    envs.reset()
    while min(map(len, episodes)) < 1:
        c = envs.c.astype(np.float32)[envs.available]
        actions = recsys.POLICIES[policy](envs.users, c, envs.mu[envs.available], rng)
        infos = envs.step(actions)[-1]
        for i in np.flatnonzero(infos.get("_final_info", [])):
            info = infos["final_info"]
            episodes[i].append((info["clicks"][i], info["recommendations"][i]))
    clicks, lengths = np.array([played[0] for played in episodes]).T  # one episode per slot
    score = recsys.reference_ctr(policy, TEST, 50, 10, 4)
    assert score["ctr"] == pytest.approx(np.mean(clicks / lengths))  # macro: mean of ratios
    assert score["pooled"] == pytest.approx(clicks.sum() / lengths.sum())
    assert score["length"] == pytest.approx(lengths.mean())
    assert score["stderr"] == pytest.approx(np.std(clicks / lengths) / np.sqrt(10))


@pytest.mark.parametrize(
    ("policy", "published_model", "tolerance", "length"),
    [
        ("random", 0.155, 0.005, 47.6),
        ("c-only", 0.297, 0.006, 42.7),
        ("oracle", 0.664, 0.006, 31.8),
    ],
)
def test_floor_and_ceilings_on_unseen_products(policy, published_model, tolerance, length):
    score = recsys.reference_ctr(policy, TEST, 500, 10_000, 0)
    assert score["stderr"] < tolerance / 3
    assert score["ctr"] == pytest.approx(published_model, abs=tolerance)
    assert score["length"] == pytest.approx(length, abs=1.6)
    assert 0 < score["ctr"] - score["pooled"] < 0.02  # short episodes are luckier, slightly


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "options", "num_available", "expected"),
    [
        ("c-only", {}, 50, 0.261),
        ("c-only", {}, 25, 0.250),
        ("mu-only", {}, 500, 0.647),
        ("oracle", {}, 50, 0.573),
        ("oracle", {}, 25, 0.523),
        ("random", {"leave_at_reset": False}, 500, 0.162),
        ("c-only", {"leave_at_reset": False}, 500, 0.308),
        ("oracle", {"leave_at_reset": False}, 500, 0.674),
    ],
)
def test_other_published_cells(policy, options, num_available, expected):
    """Tolerance: another draw of the products moves these numbers by about 0.01."""
    score = recsys.reference_ctr(policy, TEST, num_available, 10_000, 0, **options)
    assert score["ctr"] == pytest.approx(expected, abs=0.015)


def first_episodes(choose, **options):
    """CTR of the first episode of 3,000 users, unseen products, 500 on offer."""
    n = 3000
    envs = make_vec(n, TEST, 500, 0, **options)
    envs.reset()
    c, mu = envs.c.astype(np.float32)[envs.available], envs.mu[envs.available]  # (n, 500, 16), ...
    ctr, playing = np.zeros(n), np.ones(n, bool)
    while playing.any():
        infos = envs.step(choose(envs, c, mu))[-1]
        if infos:
            ended = infos["_final_info"] & playing
            ctr[ended] = infos["final_info"]["ctr"][ended]
            playing &= ~ended
    return ctr.mean()


@pytest.mark.slow
def test_repeating_the_first_best_product_costs_nothing():
    """A.2 says repeats do not pay; with its own numbers they do."""
    first = []

    def repeat(envs, c, mu):
        if not first:
            first.append(recsys.oracle(envs.users, c, mu, None))
        return first[0]

    best = recsys.reference_ctr("oracle", TEST, 500, 5000, 0)["ctr"]
    assert first_episodes(repeat) == pytest.approx(best, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("weight_of_mu", "expected"), [(0, 0.224), (1, 0.583)])
def test_no_repeat_reward_published_cells(weight_of_mu, expected):
    """c-only and oracle, avoiding what was clicked already."""

    def avoid(envs, c, mu):
        score = np.matmul(c, envs.users.astype(np.float32)[:, :, None])[:, :, 0] + weight_of_mu * mu
        return np.where(envs._clicked, -np.inf, score).argmax(1)

    assert first_episodes(avoid, no_repeat_reward=True) == pytest.approx(expected, abs=0.015)


# ---- pictures, script ----


def test_first_sets_of_the_sub_environments_are_independent():
    """Overlap of two independent 500-subsets of 2,500: 500 * 500 / 2500 = 100 on average."""
    overlaps = []
    for seed in range(20):
        available = make_vec(6, recsys.split_actions()["test"], 500, seed).reset()[0]["available"]
        assert all(len(set(row)) == 500 for row in available)
        overlaps += [len(set(available[i]) & set(available[i + 1])) for i in range(5)]
    assert np.mean(overlaps) == pytest.approx(100, abs=4)  # 5 standard errors


def test_the_timeline_counts_the_clicks_that_pay():
    env = RecSysEnv(
        recsys.split_actions()["test"], 1, no_repeat_reward=True, render_mode="rgb_array"
    )
    env.reset(seed=0)
    over = False
    while not over:  # the same product again and again: it pays once
        *_, terminated, truncated, info = env.step(0)
        over = terminated or truncated
    assert info["clicks"] == sum(click for _, click, *_ in filter(None, env.timeline)) <= 1


def test_render_frames_have_one_size_and_change():
    env = RecSysEnv(SMALL, 5, "rgb_array")
    env.reset(seed=1)
    frames, over = env.render_frames(), False
    while not over and len(frames) < 6:
        over = env.step(0)[2]
        frames += env.render_frames()
    for frame in frames:
        assert frame.shape == (480, 900, 3) and frame.dtype == np.uint8 and frame.std() > 10
    assert len({frame.tobytes() for frame in frames}) == len(frames) > 2
    with pytest.warns(UserWarning, match="rgb_array"):
        assert RecSysEnv(SMALL, 5).render() is None


def test_save_gif_round_trip_and_shared_text(tmp_path):
    frames = [np.full((8, 9, 3), value, np.uint8) for value in (0, 120, 255)]
    recsys.save_gif(tmp_path / "new" / "a.gif", frames, 5)
    with Image.open(tmp_path / "new" / "a.gif") as gif:
        assert gif.n_frames == 3 and gif.size == (9, 8)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.gif"]
    gridworld = pytest.importorskip("gridworld")
    assert inspect.getsource(recsys.save_gif) == inspect.getsource(gridworld.save_gif)


def test_script_writes_pictures_and_prints_the_table(tmp_path, capsys):
    args = recsys.Args(out=tmp_path / "demo", episodes=5, num_available=20, policy="random")
    recsys.main(args)
    names = sorted(path.name for path in (tmp_path / "demo").iterdir())
    assert names == ["recsys_click_curve.png", "recsys_episode.gif", "recsys_timeline.png"]
    out = capsys.readouterr().out
    assert "train 5000, valid 2500, test 2500" in out and "oracle" in out
    with pytest.raises(ValueError, match="episodes is 0"):
        recsys.main(recsys.Args(episodes=0, out=tmp_path / "none"))
    with pytest.raises(ValueError, match="num_available is 3000"):
        recsys.main(recsys.Args(num_available=3000, out=tmp_path / "none"))
    assert not (tmp_path / "none").exists()


def test_command_line_and_light_import():
    root = Path(recsys.__file__).parent
    bad = [sys.executable, "recsys.py", "--num-available", "0"]
    result = subprocess.run(bad, cwd=root, capture_output=True, text=True)
    assert result.returncode == 1 and result.stderr.startswith("error: num_available is 0")
    assert result.stderr.count("\n") == 1
    code = "import recsys, sys; assert not {'torch', 'matplotlib', 'gridworld'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=root, check=True)
