"""Recommender System: worked examples, plain against fast, distributions, pictures, script."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import recsys
from recsys import GONE, RecSysEnv

SPLIT = recsys.split_actions()
TEST = SPLIT["test"]
SMALL = np.arange(30, 50)  # a pool of 20 products


def always(monkeypatch, p):
    """Every recommendation is clicked with probability p."""
    monkeypatch.setattr(recsys, "click_probability", lambda x: np.full(np.shape(x), float(p)))


def about(value, sample, errors=4):
    """`value`, give or take that many standard errors of the sample's mean."""
    return pytest.approx(value, abs=errors * np.std(sample) / np.sqrt(len(sample)))


# ---- Eq. 2, products, split ----


def test_click_probability_worked_examples():
    x = np.array([-1000, -10, -4, -1, 0, 1, 4, 10, 1000])
    p = [0.0130, 0.0150, 0.0287, 0.0672, 0.0967, 0.1405, 0.3562, 0.6611, 0.7311]
    np.testing.assert_allclose(recsys.click_probability(x), p, rtol=0, atol=5e-5)


def test_products_are_unit_vectors_without_a_special_direction():
    c = recsys.PRODUCTS
    assert c.shape == (10_000, 16)
    np.testing.assert_allclose(np.linalg.norm(c, axis=1), 1)
    np.testing.assert_allclose(c.T @ c / len(c), np.eye(16) / 16, atol=0.004)


def test_popularity_has_std_3_mean_0_in_every_pool_and_cannot_be_told_from_c():
    mu = recsys.POPULARITY
    assert mu.shape == (10_000,) and abs(mu.std() - 3) < 0.1
    for ids in SPLIT.values():
        assert abs(mu[ids].mean()) < 0.03  # what the key of the stream was chosen for
    assert np.abs(np.corrcoef(recsys.PRODUCTS.T, mu)[-1, :-1]).max() < 0.04


def test_no_stream_of_users_repeats_the_stream_of_products():
    """With one stream for both, user i of some seed was product i: a cosine of 1."""
    c = recsys.PRODUCTS
    for seed in range(10):
        users = np.random.default_rng(seed).standard_normal((10_000, 16))
        users /= np.linalg.norm(users, axis=1, keepdims=True)
        cosines = (c * users).sum(1)  # product i and user i, (10_000,)
        assert cosines.mean() == about(0, cosines) and cosines.max() < 0.9
        env = RecSysEnv(SMALL, len(SMALL))
        env.reset(seed=seed)
        assert (c @ env.user).max() < 0.95 * np.linalg.norm(env.user)  # nor any other product


def test_representations_are_c_and_with_full_observability_a_third_of_mu():
    c, full = recsys.engineered_representations(), recsys.engineered_representations(True)
    assert c.shape == (10_000, 16) and full.shape == (10_000, 17)
    assert c.dtype == full.dtype == np.float32
    assert np.array_equal(full[:, :16], c)
    np.testing.assert_allclose(full[:, 16] * 3, recsys.POPULARITY, rtol=1e-6)


# ---- the user model ----


def plain_episode(seed, pool, num_available, positions):
    """The rules once more, slowly: (states, clicks, user left). `positions`: what is chosen."""
    rng, steps = np.random.default_rng(seed), iter(positions)
    available = sorted(rng.choice(pool, num_available, replace=False).tolist())
    v, mode = rng.standard_normal(16), "organic"
    rows = {"organic": (0.74, 0.25, 0.01), "bandit": (0.05, 0.94, 0.01), "gone": (0, 0, 1)}

    def draw(v, mode):
        mode = str(rng.choice(["organic", "bandit", "gone"], p=rows[mode]))
        z = rng.standard_normal()
        return v + 0.1 * abs(z) * rng.standard_normal(16), mode

    while mode == "organic":
        v, mode = draw(v, mode)
    states, clicks = [v], []
    while len(clicks) < 100 and (not clicks or mode != "gone"):
        product = available[next(steps)]
        x = sum(recsys.PRODUCTS[product] * v) + recsys.POPULARITY[product]
        inner = 2 / (1 + np.exp(-0.3 * x)) - 2
        click = rng.random() < 1 / (1 + np.exp(-(14 / (1 + np.exp(-inner)) - 6)))
        v, mode = draw(v, mode)
        mode = "organic" if click else mode
        while mode == "organic":
            v, mode = draw(v, mode)
        clicks.append(bool(click))
        states.append(v)
    return states, clicks, mode == "gone"


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), data=st.data())
def test_the_environment_equals_the_plain_rules_draw_by_draw(seed, data):
    pool = data.draw(st.lists(st.integers(0, 9999), min_size=1, max_size=30, unique=True))
    num_available = data.draw(st.integers(1, len(pool)))
    positions = np.random.default_rng([seed, 1]).integers(num_available, size=100)
    states, clicks, left = plain_episode(seed, np.sort(pool), num_available, positions)
    env, over = RecSysEnv(pool, num_available), False
    observations, rewards = [env.reset(seed=seed)[0]], []
    while not over:
        observation, reward, terminated, truncated, info = env.step(positions[len(rewards)])
        observations.append(observation)
        rewards.append(reward)
        over = terminated or truncated
        assert over or info == {}
    np.testing.assert_allclose([o["state"] for o in observations], states, rtol=1e-6)
    assert rewards == clicks and (terminated, truncated) == (left, not left)
    assert info == {"ctr": sum(clicks) / len(clicks)}
    assert len({o["available"].tobytes() for o in observations}) == 1


def test_a_draw_of_exactly_zero_never_reaches_an_impossible_session():
    assert [row.searchsorted(0.0, side="right") for row in recsys.CUMULATIVE] == [0, 0, GONE]
    assert np.array_equal(recsys.CUMULATIVE[:, 2], [1, 1, 1])  # nor does a draw just below 1


def test_time_is_up_after_100_recommendations(monkeypatch):
    monkeypatch.setattr(recsys, "CUMULATIVE", np.array([[0, 1, 1], [0, 1, 1], [0, 0, 1]]))
    env = RecSysEnv(SMALL, 5)
    env.reset(seed=0)
    flags = [env.step(0)[2:4] for _ in range(100)]
    assert flags == [(False, False)] * 99 + [(False, True)] and env.ending == "time is up"
    env.reset()
    env.session, env.clicks = GONE, [False] * 99
    always(monkeypatch, 0)
    assert env.step(0)[2:4] == (True, False)  # who leaves in the last step has left


def test_available_products_are_uniform_sorted_and_new_in_every_episode():
    env, counts = RecSysEnv(SMALL, 5), np.zeros(50)
    env.reset(seed=0)
    for _ in range(4000):
        available = env.reset()[0]["available"]
        assert np.all(np.diff(available) > 0)
        counts[available] += 1
    assert counts[:30].sum() == 0 and counts.sum() == 20_000
    spread = np.sqrt(4000 * 0.25 * 0.75)  # binomial: a product is available in a quarter of them
    assert np.abs(counts[30:] - 1000).max() < 4 * spread


def test_bad_input_is_one_value_error():
    env = RecSysEnv(SMALL, 5)
    env.reset(seed=0)
    for action in (-1, 5, np.int64(7), 1.5, None):
        with pytest.raises(ValueError, match=r"action is .*; there are 0\.\.4"):
            env.step(action)


# ---- floors and ceilings ----


def episodes(policy, num_available, n, pool=TEST, seed=0):
    """(CTR, length) of n episodes; CTR per episode, as published."""
    env, rng = RecSysEnv(pool, num_available), np.random.default_rng([seed, 1])
    env.reset(seed=seed)
    scores = [(recsys.play(env, policy, rng), len(env.clicks)) for _ in range(n)]
    return np.array(scores).T


@pytest.mark.parametrize("policy, ctr, length", [("random", 0.155, 48), ("c-only", 0.297, 43),
    ("mu-only", 0.64, 32), ("oracle", 0.664, 32)])  # fmt: skip
def test_floors_and_ceilings_on_unseen_products(policy, ctr, length):
    scores, lengths = episodes(policy, 500, 1000)
    margin = 0.01  # another draw of the products moves these numbers by so much
    assert scores.mean() == pytest.approx(ctr, abs=margin + 4 * scores.std() / np.sqrt(1000))
    assert lengths.mean() == about(length, lengths)
    pooled = (scores * lengths).sum() / lengths.sum()
    assert -0.005 < scores.mean() - pooled < 0.03  # short episodes are luckier, slightly
    assert recsys.reference_ctr(policy, TEST, 500, 50)[0] == pytest.approx(scores[:50].mean())


@pytest.mark.slow
def test_repeating_the_first_best_product_costs_nothing():
    """A.2 says repeats do not pay; with its own numbers they do."""
    env, scores = RecSysEnv(TEST), []
    env.reset(seed=1)
    for _ in range(5000):
        env.reset()
        c, mu = recsys.PRODUCTS[env.available], recsys.POPULARITY[env.available]
        best = (c @ env.user + mu).argmax()
        while not env.ending:
            env.step(best)
        scores.append(np.mean(env.clicks))
    assert np.mean(scores) == pytest.approx(episodes("oracle", 500, 5000)[0].mean(), abs=0.01)


# ---- words, pictures, script ----


def test_the_text_tells_the_episode():
    env = RecSysEnv(TEST)
    ctr = recsys.play(env, "c-only", np.random.default_rng(0), seed=5)
    n, clicks = len(env.clicks), sum(env.clicks)
    assert ctr == clicks / n
    first, *lines, last = recsys.episode_text(env).splitlines()
    assert first.startswith("a new user, page views: ") and len(lines) == n
    assert last == f"the user left: {clicks} clicks in {n} recommendations"
    assert sum("CLICK" in line for line in lines) == clicks
    assert all("page views" in line for line in lines if "CLICK" in line)
    product = env.available[env.choices[0]]
    taste, mu = recsys.PRODUCTS[product] @ env.users[0], recsys.POPULARITY[product]
    told = f"  1: product {product:4}, taste {taste:+.1f}, popularity {mu:+5.1f}"
    assert lines[0].startswith(told + ", click probability 0.18")
    assert recsys.click_probability(taste + mu) == pytest.approx(0.18, abs=0.005)


def test_pictures_have_one_size_and_one_axis_and_change():
    env = RecSysEnv(SMALL, 5, "rgb_array")
    env.reset(seed=1)
    frames = env.render_frames()
    while not env.ending and len(frames) < 5:
        env.step(0)
        frames += env.render_frames()
    frames.append(recsys.draw_episode(env, 2))  # a part of the episode is drawn as it was
    assert np.array_equal(frames[-1], frames[2])
    for frame in frames:
        assert frame.shape == (480, 900, 3) and frame.dtype == np.uint8 and frame.std() > 10
        assert np.array_equal(frame[440:], frames[0][440:])  # the numbers under the axis
    assert len({frame.tobytes() for frame in frames}) == len(frames) - 1 > 2


def test_the_script_runs_anywhere_and_with_a_notebooks_display(tmp_path):
    script = [sys.executable, Path(recsys.__file__), "--episodes", "3", "--num-available", "20"]
    display = {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    environment = os.environ | display
    done = subprocess.run(script, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "a new user" in done.stdout and "available" in done.stdout
    written = sorted(path.name for path in tmp_path.rglob("*.*"))
    assert written == ["recsys_click_curve.png", "recsys_episode.gif"]
    with pytest.raises(SystemExit, match="error: 3000 available actions out of a pool of 2500"):
        recsys.main(recsys.Args(num_available=3000, out=tmp_path / "none"))
    assert not (tmp_path / "none").exists()
