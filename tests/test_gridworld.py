"""Grid World against slow obvious versions of its rules, worked examples, the paper's numbers."""

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

import gridworld
from gridworld import GridWorldEnv, layout_id, make_vec, skill_id, skill_name, split_actions

ALL = np.arange(1024)
DELTAS = {"R": (1, 0), "D": (0, 1), "L": (-1, 0), "U": (0, -1)}
RIVERS = [(kind, river, opening) for kind in ("vertical", "horizontal")
          for river in (3, 4, 5) for opening in range(1, 8)]  # fmt: skip


def ascii_layout(orientation, river, opening):
    """A layout as nine rows of text, written without the module: row y, column x."""
    rows = [["#" if {x, y} & {0, 8} else "." for x in range(9)] for y in range(9)]
    rows[7][7] = "G"
    for along in range(1, 8):
        x, y = (river, along) if orientation == "vertical" else (along, river)
        rows[y][x] = "o" if along == opening else "~"
    return rows


class SlowWorld:
    """The rules of the fact sheet on text, one move at a time: the oracle of both environments."""

    def __init__(self, orientation, river, opening):
        self.rows = ascii_layout(orientation, river, opening)
        self.x = self.y = 1
        self.n, self.paid, self.over, self.success = 0, False, None, False

    def skill(self, letters):
        reward = 0.0
        for letter in letters:
            dx, dy = DELTAS[letter]
            self.n += 1
            cell = self.rows[self.y + dy][self.x + dx]
            if cell != "#":
                self.x, self.y = self.x + dx, self.y + dy
            if cell == "o" and not self.paid:
                reward, self.paid = reward + 0.1, True
            if cell == "G":
                reward += 1 - 0.9 * self.n / 50
                self.over, self.success = "terminated", True
            if cell == "~":
                self.over = "terminated"
            if self.over is None and self.n >= 50:
                self.over = "truncated"
            if self.over:
                break
        return reward

    def state(self):
        ids = {".": 1, "#": 2, "G": 8, "~": 9, "o": 11}
        grid = [[ids[self.rows[y][x]] for y in range(9)] for x in range(9)]  # x first
        grid[self.x][self.y] = 10
        return np.array(grid, np.uint8).reshape(81)


def all_skills_env(layout, **kwargs):
    """An environment in which position = skill id, at the start of `layout`."""
    env = GridWorldEnv(ALL, 1024, **kwargs)
    env.reset(seed=0, options={"layout": layout})
    return env


# ---- against slow versions ----


def test_layouts_are_the_42_grids_of_the_paper():
    assert len(RIVERS) == len(gridworld.LAYOUTS) == 42
    assert len({grid.tobytes() for grid in gridworld.LAYOUTS}) == 42
    assert set(np.unique(gridworld.LAYOUTS)) == {1, 2, 8, 9, 11}
    for river in RIVERS:
        observation, _ = all_skills_env(layout_id(*river)).reset(
            options={"layout": layout_id(*river)}
        )
        np.testing.assert_array_equal(observation["state"], SlowWorld(*river).state())
        assert observation["state"][10] == 10 and observation["state"][70] == 8


def test_scalar_env_equals_slow_world_on_random_skills():
    rng = np.random.default_rng(0)
    endings = set()
    for episode in range(400):
        river = RIVERS[episode % 42]
        env, slow, over = all_skills_env(layout_id(*river)), SlowWorld(*river), False
        total, skills = 0.0, 0
        while not over:
            # half of the time no left or up, so that subgoals and goals are met often
            moves = rng.integers(4 if episode % 2 else 2, size=5)
            action = int((moves * 4 ** np.arange(5)).sum())
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == slow.skill("".join("RDLU"[move] for move in moves))
            total, skills = total + reward, skills + 1
            np.testing.assert_array_equal(observation["state"], slow.state())
            assert terminated == (slow.over == "terminated")
            assert truncated == (slow.over == "truncated")
            over = terminated or truncated
            assert over or (info == {} and slow.n == 5 * skills)
        assert slow.n <= 50 and skills <= 10
        endings.add((slow.over, slow.success))
        assert info == {
            "success": float(slow.success),
            "subgoal": int(slow.paid),
            "moves": slow.n,
            "episode": {"r": total, "l": skills},
        }
    assert endings == {("terminated", True), ("terminated", False), ("truncated", False)}


def test_tables_equal_scalar_env_from_every_start():
    """Every skill from the start, and random skills from random cells, in every layout."""
    effects, rng = gridworld.skill_effects(), np.random.default_rng(1)
    for layout in range(42):
        cells = [(1, 1)] * 40 + [tuple(rng.integers(1, 8, 2)) for _ in range(60)]
        for cell, skill in zip(cells, rng.integers(1024, size=len(cells)), strict=True):
            env = all_skills_env(layout)
            if env._grid[cell] in (8, 9):  # nobody starts a skill on the goal or on lava
                continue
            env._position = (int(cell[0]), int(cell[1]))
            _, _, terminated, _, _ = env.step(skill)
            after, moves, subgoal, goal, lava = effects[layout, cell[0] * 9 + cell[1], skill]
            x, y = env._position
            assert (after, moves, subgoal) == (x * 9 + y, env._moves, env._subgoal_taken)
            assert (goal or lava) == terminated and goal == (env._grid[x, y] == 8)


class ToldEnv(GridWorldEnv):
    """Takes layouts and available sets from a queue instead of drawing them."""

    def _draw_episode(self):
        return self.queue.pop(0)


def assert_same(one, other, where="infos"):
    """Nested tuples, dicts and (object) arrays agree in keys, dtypes and values."""
    if isinstance(one, tuple):
        one, other = dict(enumerate(one)), dict(enumerate(other))
    if isinstance(one, dict):
        assert set(one) == set(other), where
        for key in one:
            assert_same(one[key], other[key], f"{where}[{key!r}]")
    elif isinstance(one, np.ndarray) and one.dtype == object:
        for a, b in zip(one, other, strict=True):
            assert_same(a, b, where)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype, where
        np.testing.assert_array_equal(one, other, where)
    else:
        assert one == other and type(one) is type(other), where


@pytest.mark.parametrize("num_available", [1, 50, 200, 256])
def test_vector_env_equals_sync_vector_env(num_available):
    """Observations, rewards, flags and infos equal those of gymnasium's own vector environment."""
    pool, num_envs = split_actions()["test"], 8
    vec = make_vec(num_envs, pool, num_available, seed=3)
    sync = SyncVectorEnv(
        [lambda: ToldEnv(pool, num_available)] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert vec.observation_space == sync.observation_space
    assert vec.action_space == sync.action_space
    assert vec.single_observation_space == sync.single_observation_space
    assert vec.metadata["autoreset_mode"] == sync.metadata["autoreset_mode"]

    def tell(envs):
        for i in envs:
            sync.envs[i].queue = [(int(vec._layout[i]), vec._available[i].copy())]

    observation = vec.reset()
    tell(range(num_envs))
    assert_same(observation, sync.reset())
    rng, ended, won = np.random.default_rng(0), 0, 0
    # skills without up and left first, so that goals are reached as well
    forward = np.isin(gridworld.SKILL_MOVES, (0, 1)).sum(1)  # (1024,)
    for step in range(400):
        actions = rng.integers(num_available, size=num_envs)
        if step % 2:
            actions = forward[vec._available].argmax(1)
        result = vec.step(actions)
        over = result[2] | result[3]
        tell(over.nonzero()[0])
        assert_same(result, sync.step(actions))
        ended += over.sum()
        won += result[-1]["final_info"]["success"].sum() if over.any() else 0
    assert ended > 100 and (won or num_available == 1)


def test_play_trajectories_are_clipped_cumulative_sums():
    ids = [0, 1023, 341, skill_id("UUURD"), 77]
    paths = gridworld.action_observations(ids, 300, "xy", seed=5)
    assert paths.shape == (5, 300, 6, 2) and paths.dtype == np.uint8
    for skill, recordings in zip(ids, paths.tolist(), strict=True):
        for recording in recordings:
            x, y = recording[0]
            for letter, after in zip(skill_name(skill), recording[1:], strict=True):
                x = min(max(x + DELTAS[letter][0], 1), 78)
                y = min(max(y + DELTAS[letter][1], 1), 78)
                assert after == [x, y]


# ---- worked examples and numbers of the paper and of the published environment ----


@pytest.mark.parametrize(
    ("river", "skills", "rewards", "cells", "moves", "outcome"),
    [
        (("vertical", 3, 1), ["RRRRR", "RDDDD", "DDLLL"], [0.1, 0, 0.784],
         [(6, 1), (7, 5), (7, 7)], [5, 10, 12], "success"),
        (("vertical", 3, 7), ["RRRRR"], [0], [(3, 1)], [2], "lava"),
        (("horizontal", 5, 4), ["UUUUU"] * 10, [0] * 10, [(1, 1)] * 10,
         [*range(5, 51, 5)], "limit"),
        (("vertical", 3, 1), ["LLLLL"] * 9 + ["RRRRR"], [0] * 9 + [0.1],
         [(1, 1)] * 9 + [(6, 1)], [*range(5, 51, 5)], "limit"),
    ],
)  # fmt: skip
def test_worked_examples(river, skills, rewards, cells, moves, outcome):
    env = all_skills_env(layout_id(*river))
    for i, skill in enumerate(skills):
        observation, reward, terminated, truncated, info = env.step(skill_id(skill))
        assert reward == pytest.approx(rewards[i], abs=1e-12) and isinstance(reward, float)
        assert env.trace[-1] == cells[i] and env._moves == moves[i]
        assert observation["state"][cells[i][0] * 9 + cells[i][1]] == 10
        assert (terminated or truncated) == (i == len(skills) - 1)
    assert info["success"] == (outcome == "success") and terminated == (outcome != "limit")
    assert truncated == (outcome == "limit") and info["moves"] == moves[-1]
    assert info["episode"] == {"r": pytest.approx(sum(rewards)), "l": len(skills)}


def test_goal_on_move_50_is_a_success_and_not_truncated():
    """A detour of 38 moves and the 12 to the goal: the limit and the goal on the same move."""
    env = all_skills_env(layout_id("vertical", 3, 1))
    for skill in ["UUUUU"] * 7 + ["UUURR", "RRRRD", "DDDDD"]:
        _, reward, terminated, truncated, info = env.step(skill_id(skill))
    assert (terminated, truncated, info["success"], info["moves"]) == (True, False, 1.0, 50)
    assert reward == pytest.approx(0.1)
    vec = make_vec(1, ALL, 1024)
    vec.reset()
    vec._layout[:] = layout_id("vertical", 3, 1)
    for skill in ["UUUUU"] * 7 + ["UUURR", "RRRRD", "DDDDD"]:
        _, rewards, terminated, truncated, infos = vec.step([skill_id(skill)])
    assert terminated[0] and not truncated[0] and infos["final_info"]["success"][0] == 1
    assert infos["final_info"]["episode"]["r"][0] == pytest.approx(1.1 - 0.018 * 50)


def test_eq1_goal_reward_follows_the_text():
    assert gridworld.goal_reward(12) == pytest.approx(0.784)
    assert gridworld.goal_reward(50) == pytest.approx(0.1)


def test_subgoal_pays_once_and_stays_visible():
    env = all_skills_env(layout_id("vertical", 3, 1))
    total = 0.0
    for skill in ("RRLRL", "RLRLR"):
        observation, reward, *_ = env.step(skill_id(skill))
        total += reward
    assert total == pytest.approx(0.1)
    observation, *_ = env.step(skill_id("LLLLL"))
    assert observation["state"][3 * 9 + 1] == 11


def test_skill_ids():
    known = {"RRRRR": 0, "DRRRR": 1, "RDDDD": 340, "DDDDD": 341, "LLLLL": 682, "UUUUU": 1023}
    for name, number in known.items():
        assert skill_id(name) == number and skill_name(number) == name
    assert sorted(skill_id(skill_name(number)) for number in ALL) == list(ALL)
    assert len({skill_name(number) for number in ALL}) == gridworld.NUM_ACTIONS == 1024


def test_best_return_is_0_884_in_every_layout():
    for layout in range(42):
        best, plan = gridworld.best_plan(layout, ALL)
        assert best == pytest.approx(0.884)
        env, total = all_skills_env(layout), 0.0
        for action in plan:
            _, reward, _, _, info = env.step(action)
            total += reward
        assert info["success"] == 1 and total == pytest.approx(best) and info["moves"] == 12


def test_best_plan_equals_dynamic_programming():
    """Backward induction over all cells and remaining skills, the subgoal flag included."""
    rng, effects = np.random.default_rng(2), gridworld.skill_effects().astype(int)
    for trial in range(60):
        layout, ids = int(rng.integers(42)), rng.choice(1024, rng.integers(2, 12), replace=False)
        after, moves, subgoal, goal, lava = np.moveaxis(effects[layout][:, ids], -1, 0)  # (81, K)
        value = np.zeros((2, 81))  # [subgoal already taken, cell]
        for skills_before in reversed(range(10)):
            pay = goal * (1 - 0.9 * (5 * skills_before + moves) / 50)
            go_on = (goal + lava) == 0
            fresh = (
                pay + 0.1 * subgoal + go_on * np.where(subgoal, value[1][after], value[0][after])
            )
            value = np.stack([fresh.max(1), (pay + go_on * value[1][after]).max(1)])
        best, plan = gridworld.best_plan(layout, ids)
        assert best == pytest.approx(value[0, 10]) and len(plan) <= 10
        assert (best > 0.15) == bool(plan), trial


def test_ceilings_of_random_subsets():
    """Success and return of the best plan as in an exhaustive study of 7,200 subsets."""
    rng = np.random.default_rng(0)
    for size, success, best in ((50, 1.0, 0.820), (10, 0.791, 0.547)):
        draws = [rng.choice(1024, size, replace=False) for _ in range(25)]
        found = [gridworld.best_plan(layout, ids) for ids in draws for layout in range(42)]
        # tolerances: 3 standard errors between subsets (measured 0.05 / 0.25 per subset)
        wide = 0.03 if size == 50 else 0.2
        assert np.mean([len(plan) > 0 for _, plan in found]) == pytest.approx(success, abs=wide)
        assert np.mean([value for value, _ in found]) == pytest.approx(best, abs=wide)


def test_random_policy_outcomes():
    """Goal 0.27 %, lava 84.5 %, limit 15.2 %, subgoal 12.3 %, return 0.0133 (published world)."""
    envs, rng = make_vec(512, ALL, 50, seed=0), np.random.default_rng(0)
    envs.reset()
    rows = []
    for _ in range(300):
        infos = envs.step(rng.integers(50, size=512))[-1]
        over, info = infos["_final_info"], infos["final_info"]
        episode = info["episode"]
        rows.append(np.stack([info["success"], info["subgoal"], info["moves"], episode["r"],
                              episode["l"]])[:, over])  # fmt: skip
    success, subgoal, moves, returns, length = np.concatenate(rows, axis=1)
    assert success.mean() == pytest.approx(0.0027, abs=0.001)
    assert (moves >= 50).mean() == pytest.approx(0.152, abs=0.01)
    assert subgoal.mean() == pytest.approx(0.123, abs=0.01)
    assert returns.mean() == pytest.approx(0.0134, abs=0.001)
    assert length.mean() == pytest.approx(4.87, abs=0.1)
    assert moves.mean() == pytest.approx(22.7, abs=0.5)


# ---- the action set ----


def test_splits():
    splits = split_actions(seed=0)
    assert {name: len(ids) for name, ids in splits.items()} == {
        "train": 512, "valid": 256, "test": 256,
    }  # fmt: skip
    np.testing.assert_array_equal(np.sort(np.concatenate(list(splits.values()))), ALL)
    for name, ids in splits.items():
        assert ids.dtype == np.int64 and (np.diff(ids) > 0).all()
        np.testing.assert_array_equal(ids, split_actions(seed=0)[name])
        assert not np.array_equal(ids, split_actions(seed=1)[name])
    with pytest.raises(ValueError, match="'full'.*'default'"):
        split_actions("full")


def test_quadrants():
    labels = gridworld.action_labels()
    assert labels.shape == (1024,) and labels.dtype.kind == "U"
    names, counts = np.unique(labels, return_counts=True)
    assert list(names) == ["lower left", "lower right", "upper left", "upper right"]
    assert list(counts) == [256] * 4
    assert labels[skill_id("UUURD")] == "upper right"  # the example of appendix B
    for skill in ALL:  # the rule of the published code, in words of moves
        name = skill_name(skill)
        east, north = name.count("R") - name.count("L"), name.count("U") - name.count("D")
        rule = {
            "upper right": north >= 0 and east > 0,
            "lower right": north < 0 and east >= 0,
            "lower left": north <= 0 and east < 0,
            "upper left": north > 0 and east <= 0,
        }
        assert [label for label, holds in rule.items() if holds] == [labels[skill]]


def test_engineered_representations():
    wide = gridworld.engineered_representations()
    assert wide.shape == (1024, 12) and wide.dtype == np.float32
    for skill in (0, 1, 340, 682, 1023, 77):
        deltas = [DELTAS[letter] for letter in skill_name(skill)]
        assert wide[skill].tolist() == [*np.sum(deltas, 0), *np.concatenate(deltas)]
    assert len(np.unique(wide[:, :2], axis=0)) == 36  # net displacements, never none
    assert np.abs(wide[:, :2]).sum(1).min() == 1
    narrow = gridworld.engineered_representations("5d")
    assert narrow.shape == (1024, 5) and narrow.dtype == np.float32
    np.testing.assert_allclose(narrow[skill_id("RDLUR")], [-1, -1 / 3, 1 / 3, 1, -1], atol=1e-6)
    assert len(np.unique(narrow, axis=0)) == len(np.unique(wide, axis=0)) == 1024
    path = gridworld.engineered_representations("path")
    assert path.shape == (1024, 10) and path.dtype == np.float32
    assert path[skill_id("RDLUR")].tolist() == [1, 0, 1, 1, 0, 1, 0, 0, 1, 0]  # y grows downwards
    with pytest.raises(ValueError, match="'3d'.*'12d', '5d', 'path'"):
        gridworld.engineered_representations("3d")


def test_recordings_of_a_skill_do_not_depend_on_the_others():
    together = gridworld.action_observations([5, 900, 17], 64, seed=4)
    alone = gridworld.action_observations(np.array([900]), 64, seed=4, workers=2)
    np.testing.assert_array_equal(together[1:2], alone)
    onehot = gridworld.action_observations([5, 900, 17], 64, "onehot", seed=4)
    np.testing.assert_array_equal(together, onehot)
    assert (gridworld.action_observations([900], 64, seed=5) != alone).any()


def test_recordings_start_anywhere_and_4_3_percent_meet_the_wall():
    paths = gridworld.action_observations(ALL, 512).astype(int)
    starts, counts = np.unique(paths[:, :, 0].reshape(-1, 2), axis=0, return_counts=True)
    assert len(starts) == 78 * 78 and starts.min() == 1 and starts.max() == 78
    expected = 1024 * 512 / 78**2
    chi_squared = ((counts - expected) ** 2 / expected).sum()  # mean 6083, deviation 110
    assert abs(chi_squared - 6083) < 5 * 110
    moved = np.abs(np.diff(paths, axis=2)).sum(-1)  # (1024, 512, 5)
    assert set(np.unique(moved)) == {0, 1}
    assert (moved == 0).any(-1).mean() == pytest.approx(0.0433, abs=0.002)


# ---- what is on offer ----


@pytest.mark.parametrize("role", ["train", "valid", "test"])
def test_available_sets_stay_in_the_pool_and_change(role):
    pool = split_actions()[role]
    env, seen, layouts = GridWorldEnv(pool), set(), np.zeros(42)
    observation, _ = env.reset(seed=0)
    for _ in range(1000):
        before, (observation, _) = observation["available"], env.reset()
        available = observation["available"]
        assert len(set(available)) == len(available) == 50 and available.dtype == np.int64
        assert set(before) != set(available)
        seen |= set(available.tolist())
        layouts[env._layout] += 1
    assert seen == set(pool.tolist())
    assert ((layouts - 1000 / 42) ** 2 / (1000 / 42)).sum() < 41 + 5 * 9.1  # chi-squared, 41 d.o.f.


@pytest.mark.parametrize("num_available", [50, 200])
def test_vector_env_draws_uniform_sets_from_the_pool(num_available):
    pool = split_actions()["test"]
    envs, rng = make_vec(16, pool, num_available, seed=1), np.random.default_rng(0)
    observation, _ = envs.reset()
    sets, firsts, layouts = [*observation["available"]], np.zeros(1024), np.zeros(42)
    for _ in range(1500):
        observation, _, terminated, truncated, _ = envs.step(rng.integers(num_available, size=16))
        over = terminated | truncated
        sets += [*observation["available"][over]]
        np.add.at(layouts, envs._layout[over], 1)
    sets = np.array(sets)  # (episodes, K)
    assert (np.diff(np.sort(sets)) > 0).all() and set(np.unique(sets)) == set(pool.tolist())
    expected = sets.size / len(pool)
    counts = np.bincount(sets.ravel(), minlength=1024)[pool]
    assert np.abs(counts - expected).max() < 5 * expected**0.5
    np.add.at(firsts, sets[:, 0], 1)  # a position favours no skill either
    expected = len(sets) / len(pool)
    chi_squared = ((firsts[pool] - expected) ** 2 / expected).sum()
    assert chi_squared < 255 + 5 * 22.6  # 255 degrees of freedom
    chi_squared = ((layouts - layouts.mean()) ** 2 / layouts.mean()).sum()
    assert chi_squared < 41 + 5 * 9.1


def test_vector_env_draws_pairs_uniformly():
    """Any two skills meet in one set as often as in a draw without replacement."""
    envs = make_vec(64, np.arange(12) * 7, 4, seed=0)
    envs.reset()
    sets = np.concatenate([envs._draw_available(64) for _ in range(500)]) // 7
    together = np.zeros((12, 12))
    for i in range(4):
        for j in range(i + 1, 4):
            np.add.at(together, (sets[:, i], sets[:, j]), 1)
            np.add.at(together, (sets[:, j], sets[:, i]), 1)
    pairs = together[np.triu_indices(12, 1)]
    expected = len(sets) * 6 / 66
    assert np.abs(pairs - expected).max() < 5 * expected**0.5


def test_first_sets_of_the_sub_environments_are_independent():
    """Overlap of two independent 50-subsets of 256: 50 * 50 / 256 = 9.77 on average."""
    overlaps = []
    for seed in range(60):
        available = make_vec(4, split_actions()["test"], 50, seed).reset()[0]["available"]
        overlaps += [len(set(available[i]) & set(available[i + 1])) for i in range(3)]
    assert np.mean(overlaps) == pytest.approx(9.77, abs=0.8)


def test_whole_pool_is_on_offer_in_ascending_order():
    pool = np.array([700, 3, 41, 9])
    env, envs = GridWorldEnv(pool, 4), make_vec(3, pool, 4)
    observation, _ = envs.reset()
    for _ in range(30):
        assert env.reset()[0]["available"].tolist() == [3, 9, 41, 700]
        assert observation["available"].tolist() == [[3, 9, 41, 700]] * 3
        observation, *_ = envs.step([0, 1, 2])


# ---- seeds, interface, errors ----


def run(envs, steps, rng_seed=0):
    """All arrays that a vector environment returns in `steps` steps."""
    rng, out = np.random.default_rng(rng_seed), []
    for _ in range(steps):
        observation, rewards, terminated, truncated, infos = envs.step(
            rng.integers(envs.num_available, size=envs.num_envs)
        )
        out += [observation["state"], observation["available"], rewards, terminated, truncated]
    return out


def test_seeds_decide_everything():
    def start(seed, reset_seed=None):
        envs = make_vec(4, None, 20, seed)
        first = envs.reset(seed=reset_seed)[0]
        return [first["state"], first["available"], *run(envs, 50)]

    def equal(one, other):
        return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))

    assert equal(start(1), start(1)) and not equal(start(1), start(2))
    assert equal(start(1, 9), start(2, 9)) and not equal(start(1, 9), start(1, 8))
    envs = make_vec(4, None, 20, 5)
    envs.reset()
    run(envs, 33)  # a reset with a seed forgets what came before, the bank included
    first = envs.reset(seed=9)[0]
    assert equal([first["state"], first["available"], *run(envs, 50)], start(1, 9))


def test_global_random_state_is_neither_read_nor_written():
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    make_vec(2, seed=0).reset()
    GridWorldEnv().reset(seed=0)
    gridworld.action_observations([0], 4)
    split_actions()
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


@pytest.mark.parametrize("role", ["train", "valid", "test"])
def test_check_env_without_warnings(role):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for kwargs in ({}, {"num_available": 1}, {"render_mode": "rgb_array"}):
            env = gym.make("ActionGen/GridWorld-v0", action_pool=split_actions()[role], **kwargs)
            check_env(env.unwrapped)


def test_observations_are_fresh_arrays():
    env = GridWorldEnv()
    first, _ = env.reset(seed=0)
    kept = {key: value.copy() for key, value in first.items()}
    second, *_ = env.step(0)
    assert not np.shares_memory(first["state"], second["state"])
    assert not np.shares_memory(first["available"], second["available"])
    first["available"][:] = -1
    assert second["available"].min() >= 0 and kept["available"].min() >= 0
    envs = make_vec(32, seed=0)
    outputs = [envs.reset()[0], *(envs.step(np.zeros(32, int))[0] for _ in range(20))]
    copies = [{key: value.copy() for key, value in output.items()} for output in outputs]
    run(envs, 20)
    for output, copy in zip(outputs, copies, strict=True):
        assert_same(output, copy)


def test_step_needs_a_reset():
    env = GridWorldEnv(ALL, 1024)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)
    env.reset(seed=0, options={"layout": layout_id("vertical", 3, 7)})
    env.step(skill_id("RRRRR"))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)
    with pytest.raises(gym.error.ResetNeeded):
        make_vec(1).step([0])


@pytest.mark.parametrize("build", [GridWorldEnv, lambda *args: make_vec(2, *args)])
@pytest.mark.parametrize(
    ("pool", "num_available", "message"),
    [
        ([1, 2, 3], 4, "num_available is 4; allowed: integers 1..3"),
        ([1, 2, 3], 0, "num_available is 0; allowed: integers 1..3"),
        ([1, 2, 1024], 2, "action id 1024 does not exist; allowed: 0..1023"),
        ([-1, 2, 3], 2, "action id -1 does not exist"),
        ([5, 2, 5], 2, "action id 5 is in the pool twice"),
        ([0.5, 2.0], 1, "type float64; allowed: 1-D"),
        ([[1, 2]], 1, r"shape \(1, 2\)"),
        ([], 1, "num_available is 1"),
    ],
)
def test_bad_pools(build, pool, num_available, message):
    with pytest.raises(ValueError, match=message):
        build(np.array(pool), num_available)


def test_a_layout_can_be_asked_for():
    envs, env = make_vec(3), GridWorldEnv()
    same = gridworld.LAYOUTS[7].copy()
    same[gridworld.START[0] * gridworld.SIZE + gridworld.START[1]] = gridworld.AGENT
    states = [*envs.reset(options={"layout": 7})[0]["state"]]
    states.append(env.reset(options={"layout": np.int64(7)})[0]["state"])
    assert all(np.array_equal(state, same) for state in states)


def test_other_bad_input():
    env = GridWorldEnv(ALL, 50)
    env.reset(seed=0)
    envs = make_vec(2)
    envs.reset()
    with pytest.raises(ValueError, match="num_envs is 0"):
        make_vec(0)
    with pytest.raises(ValueError, match="'human'.*'rgb_array'"):
        GridWorldEnv(render_mode="human")
    for layout in (42, -1, 3.0, True, "3"):
        for world in (env, envs):
            with pytest.raises(ValueError, match=r"layout is .*; allowed: integers 0\.\.41"):
                world.reset(options={"layout": layout})
    for action in (1.5, None, True, [1], "1"):
        with pytest.raises(ValueError, match="allowed: one integer"):
            env.step(action)
    for actions in ([1.0, 2.0], [np.nan, 0], [True, False], [[0, 1]], 0):
        with pytest.raises(ValueError, match=r"allowed: 2 integers in 0\.\.49"):
            envs.step(actions)
    with pytest.raises(ValueError, match="num_available is 20.0"):
        GridWorldEnv(ALL, 20.0)
    with pytest.raises(gym.error.ResetNeeded):
        GridWorldEnv(render_mode="rgb_array").render()
    for action in (-1, 50):
        with pytest.raises(ValueError, match=r"allowed: 0\.\.49"):
            env.step(action)
        with pytest.raises(ValueError, match=r"allowed: 2 integers in 0\.\.49"):
            envs.step([0, action])
    with pytest.raises(ValueError, match=r"allowed: 2 integers in 0\.\.49"):
        envs.step([0])
    with pytest.raises(ValueError, match="'video'.*xy, onehot"):
        gridworld.action_observations([0], 1, "video")
    with pytest.raises(ValueError, match="num_observations is 0"):
        gridworld.action_observations([0], 0)
    with pytest.raises(ValueError, match="action id 2000"):
        gridworld.action_observations([0, 2000], 1)


# ---- properties ----

LETTERS = st.text("RDLU", min_size=5, max_size=5)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(RIVERS), st.lists(LETTERS, min_size=10, max_size=10))
def test_any_ten_skills_end_the_episode_with_a_possible_return(river, skills):
    env, slow = all_skills_env(layout_id(*river)), SlowWorld(*river)
    for letters in skills:
        observation, reward, terminated, truncated, info = env.step(skill_id(letters))
        assert reward == slow.skill(letters)
        assert observation["state"].reshape(9, 9)[slow.x, slow.y] == 10
        assert set(observation["state"]) <= {1, 2, 8, 9, 10, 11}
        assert (observation["state"] == 10).sum() == 1
        assert 1 <= min(env.trace)[0] and env.trace[-1] == (slow.x, slow.y)
        if terminated or truncated:
            break
    possible = {0: [0, 0.1], 1: [1.1 - 0.018 * info["moves"]]}[int(info["success"])]
    assert any(info["episode"]["r"] == pytest.approx(value, abs=1e-9) for value in possible)
    assert 1 <= info["moves"] <= 50 and info["episode"]["l"] == -(-info["moves"] // 5)


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_any_pool_offers_distinct_members(data):
    pool = data.draw(st.lists(st.integers(0, 1023), min_size=1, max_size=40, unique=True))
    k = data.draw(st.integers(1, len(pool)))
    num_envs = data.draw(st.integers(1, 5))
    envs = make_vec(num_envs, np.array(pool), k, data.draw(st.integers(0, 2**31)))
    observation, _ = envs.reset()
    for _ in range(5):
        for available in observation["available"].tolist():
            assert len(set(available)) == k and set(available) <= set(pool)
        observation, *_ = envs.step(np.zeros(num_envs, int))


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(0, 1023), min_size=1, max_size=5), st.integers(1, 20), st.integers(0, 99)
)
def test_recordings_stay_inside_and_move_one_cell(ids, n, seed):
    paths = gridworld.action_observations(ids, n, seed=seed).astype(int)
    assert paths.shape == (len(ids), n, 6, 2) and paths.min() >= 1 and paths.max() <= 78
    assert np.abs(np.diff(paths, axis=2)).sum(-1).max() <= 1


# ---- pictures and the script ----


def test_render():
    env = GridWorldEnv(render_mode="rgb_array")
    env.reset(seed=0)
    start = env.render()
    assert start.shape == (420, 360, 3) and start.dtype == np.uint8
    (frame,) = env.render_frames()
    np.testing.assert_array_equal(start, frame)
    env.step(0)
    frames = env.render_frames()
    assert len(frames) == len(env.trace) - 1
    np.testing.assert_array_equal(frames[-1], env.render())
    assert any((frame != start).any() for frame in frames)


def test_render_shows_the_cells_where_they_are():
    """The middle of each cell has the colour of its kind: x to the right, y down."""
    env = all_skills_env(layout_id("horizontal", 4, 6), render_mode="rgb_array")
    picture = env.render()
    colors = {".": "#17191d", "#": "#6f7378", "G": "#35b44a", "o": "#2f6fe4"}
    for y, row in enumerate(ascii_layout("horizontal", 4, 6)):
        for x, kind in enumerate(row):
            if kind in colors and (x, y) != (1, 1):
                color = [int(colors[kind][i : i + 2], 16) for i in (1, 3, 5)]
                assert picture[y * 40 + 20, x * 40 + 20].tolist() == color
    red = [0xEE, 0x2B, 0x2B]  # the agent at (1, 1), a triangle that points to the right
    assert picture[60, 66].tolist() == red and picture[70, 60].tolist() != red
    env.step(skill_id("DDDDD"))  # ends on the lava at (1, 4), pointing down
    picture = env.render()
    assert picture[186, 60].tolist() == red and picture[180, 70].tolist() != red


def test_render_without_mode_warns():
    env = GridWorldEnv()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_episode_frames_and_gif(tmp_path):
    env = GridWorldEnv(ALL, 1024, "rgb_array")
    plan = iter([skill_id(name) for name in ("RRRRR", "RDDDD", "DDLLL")])
    frames, info = gridworld.episode_frames(
        env, lambda observation: next(plan), 0, layout=layout_id("vertical", 3, 1)
    )
    assert info["success"] == 1 and len(frames) == 1 + 12
    path = tmp_path / "new" / "episode.gif"
    gridworld.save_gif(path, frames, 5)
    with Image.open(path) as image:
        assert image.n_frames == 13 and image.size == (360, 420) and image.info["duration"] == 200
        assert np.abs(np.array(image.convert("RGB")).astype(int) - frames[0]).mean() < 3
    assert [file.name for file in path.parent.iterdir()] == ["episode.gif"]


def test_docstring_picture_and_plan():
    rows = [line.split()[0] for line in gridworld.__doc__.splitlines() if line.startswith("    #")]
    drawn = ["".join(row) for row in ascii_layout("vertical", 4, 3)]
    drawn[1] = drawn[1].replace("#.", "#A", 1)
    assert rows == drawn
    env = all_skills_env(layout_id("vertical", 4, 3))
    rewards = [env.step(skill_id(name))[1] for name in ("DDRRR", "RRRDD", "DDDDD")]
    assert rewards == pytest.approx([0.1, 0, 0.784])


def test_module_does_not_import_torch_or_other_project_files():
    code = (
        "import sys, gridworld\n"
        "bad = {'torch', 'matplotlib', 'sklearn', 'hvae', 'recsys', 'create_env', 'stacking_env'}\n"
        "sys.exit(str(bad & set(sys.modules)) if bad & set(sys.modules) else 0)"
    )
    root = Path(gridworld.__file__).parent
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_script(tmp_path):
    command = [sys.executable, gridworld.__file__, "--out", str(tmp_path), "--seed", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "best return with all skills: 0.884 to 0.884" in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "gridworld_random.gif",
        "gridworld_sheet.png",
        "gridworld_solved.gif",
    ]
    bad = [*command[:2], "--out", str(tmp_path / "no"), "--num-available", "300"]
    done = subprocess.run(bad, capture_output=True, text=True)
    assert done.returncode == 1 and not (tmp_path / "no").exists()
    assert done.stderr.strip() == "error: num_available is 300; allowed: integers 1..256 (the pool)"
