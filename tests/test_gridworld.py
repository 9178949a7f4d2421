"""Grid World against a slow, obvious version of its rules, worked examples and known numbers."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gridworld
from gridworld import SKILL_NAMES, GridWorldEnv, action_observations, split_actions

ALL = np.arange(1024)
DELTAS = {"R": (1, 0), "D": (0, 1), "L": (-1, 0), "U": (0, -1)}
RIVERS = [(kind, river, opening) for kind in ("column", "row")
          for river in (3, 4, 5) for opening in range(1, 8)]  # fmt: skip


def ascii_layout(kind, river, opening):
    """A layout as nine rows of text, written without the module: row y, column x."""
    rows = [["#" if {x, y} & {0, 8} else "." for x in range(9)] for y in range(9)]
    rows[7][7] = "G"
    for along in range(1, 8):
        x, y = (river, along) if kind == "column" else (along, river)
        rows[y][x] = "o" if along == opening else "~"
    return rows


class SlowWorld:
    """The rules on text, one move at a time: the oracle of the environment."""

    def __init__(self, kind, river, opening):
        self.rows = ascii_layout(kind, river, opening)
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


def all_skills_env(*river, **kwargs):
    """An environment in which position = skill id, at the start of the layout `river`."""
    env = GridWorldEnv(ALL, 1024, **kwargs)
    env.reset(seed=0, options={"layout": RIVERS.index(river)})
    return env


# ---- against the slow version ----


def test_layouts_are_the_42_grids_of_the_paper():
    assert len(RIVERS) == len({grid.tobytes() for grid in gridworld.LAYOUTS}) == 42
    for river in RIVERS:
        state = all_skills_env(*river)._observe()["state"]
        np.testing.assert_array_equal(state, SlowWorld(*river).state())
        assert state[10] == 10 and state[70] == 8


def test_env_equals_slow_world_on_random_skills():
    rng, endings = np.random.default_rng(0), set()
    for episode in range(420):
        river = RIVERS[episode % 42]
        env, slow, skills, total = all_skills_env(*river), SlowWorld(*river), 0, 0.0
        while not slow.over:
            # half of the time no left or up, so that subgoals and goals are met often
            moves = rng.integers(4 if episode % 2 else 2, size=5)
            observation, reward, terminated, truncated, info = env.step(moves @ 4 ** np.arange(5))
            assert reward == slow.skill("".join("RDLU"[move] for move in moves))
            np.testing.assert_array_equal(observation["state"], slow.state())
            assert terminated == (slow.over == "terminated")
            assert truncated == (slow.over == "truncated")
            skills, total = skills + 1, total + reward
            assert slow.over or (info == {} and slow.n == 5 * skills)
        assert slow.n == len(env.trace) - 1 <= 50 and skills <= 10
        assert info == {"success": float(slow.success)} and env.subgoal_taken == slow.paid
        possible = 1.1 - 0.018 * slow.n if slow.success else 0.1 * slow.paid
        assert total == pytest.approx(possible, abs=1e-9)
        endings.add((slow.over, slow.success))
    assert endings == {("terminated", True), ("terminated", False), ("truncated", False)}


# ---- worked examples and numbers of the paper and of the published environment ----


@pytest.mark.parametrize(
    ("river", "skills", "rewards", "cells", "moves", "outcome"),
    [
        (("column", 3, 1), ["RRRRR", "RDDDD", "DDLLL"], [0.1, 0, 0.784],
         [(6, 1), (7, 5), (7, 7)], [5, 10, 12], "goal"),
        (("column", 4, 3), ["DDRRR", "RRRDD", "DDDDD"], [0.1, 0, 0.784],
         [(4, 3), (7, 5), (7, 7)], [5, 10, 12], "goal"),  # of the module's docstring
        (("column", 3, 7), ["RRRRR"], [0], [(3, 1)], [2], "lava"),
        (("row", 5, 4), ["UUUUU"] * 10, [0] * 10, [(1, 1)] * 10, [*range(5, 51, 5)], "limit"),
        (("column", 3, 1), ["LLLLL"] * 9 + ["RRRRR"], [0] * 9 + [0.1],
         [(1, 1)] * 9 + [(6, 1)], [*range(5, 51, 5)], "limit"),
        # the limit and the goal on the same move
        (("column", 3, 1), ["UUUUU"] * 7 + ["UUURR", "RRRRD", "DDDDD"], [0] * 7 + [0.1, 0, 0.1],
         [(1, 1)] * 7 + [(3, 1), (7, 2), (7, 7)], [*range(5, 51, 5)], "goal"),
    ],
)  # fmt: skip
def test_worked_examples(river, skills, rewards, cells, moves, outcome):
    env = all_skills_env(*river)
    for i, skill in enumerate(skills):
        observation, reward, terminated, truncated, info = env.step(SKILL_NAMES.index(skill))
        assert reward == pytest.approx(rewards[i], abs=1e-12) and isinstance(reward, float)
        assert observation["state"].reshape(9, 9)[cells[i]] == 10
        assert len(env.trace) - 1 == moves[i]
        assert (terminated or truncated) == (i == len(skills) - 1)
    assert (terminated, truncated) == (outcome != "limit", outcome == "limit")
    assert info == {"success": float(outcome == "goal")}


def test_best_return_is_0_884_in_every_layout():
    forward = np.flatnonzero((gridworld.SKILL_MOVES < 2).all(1))  # 12 moves right and down: enough
    for layout, river in enumerate(RIVERS):
        env = all_skills_env(*river)
        plan = gridworld.best_plan(layout, forward)
        for _ in range(2):  # the second episode pays as the first
            assert sum(env.step(forward[i])[1] for i in plan) == pytest.approx(0.884)
            assert len(env.trace) - 1 == 12 and len(plan) == 3
            env.reset(options={"layout": layout})


# ---- the action set ----


def test_quadrants():
    labels = gridworld.action_labels()
    assert labels[SKILL_NAMES.index("UUURD")] == "upper right"  # the example of appendix B
    for name, label in zip(SKILL_NAMES, labels, strict=True):  # the published rule, in moves
        east, north = name.count("R") - name.count("L"), name.count("U") - name.count("D")
        rule = {
            "upper right": north >= 0 and east > 0,
            "lower right": north < 0 and east >= 0,
            "lower left": north <= 0 and east < 0,
            "upper left": north > 0 and east <= 0,
        }
        assert [quadrant for quadrant, holds in rule.items() if holds] == [label]


def test_engineered_representations():
    wide = gridworld.engineered_representations()
    for name, row in zip(SKILL_NAMES, wide.tolist(), strict=True):
        deltas = [DELTAS[letter] for letter in name]
        assert row == [*np.sum(deltas, 0), *np.concatenate(deltas)]
    assert len(np.unique(wide[:, :2], axis=0)) == 36  # net displacements, never none
    assert np.abs(wide[:, :2]).sum(1).min() == 1
    skill = SKILL_NAMES.index("RDLUR")
    narrow = gridworld.engineered_representations("5d")
    np.testing.assert_allclose(narrow[skill], [-1, -1 / 3, 1 / 3, 1, -1], atol=1e-6)
    assert all(len(np.unique(table, axis=0)) == 1024 for table in (wide, narrow))
    with pytest.raises(ValueError, match="'3d'.*12d.*5d"):
        gridworld.engineered_representations("3d")


# ---- action observations ----


@settings(max_examples=50, deadline=None)
@given(
    st.sets(st.integers(0, 1023), min_size=1, max_size=5), st.integers(1, 20), st.integers(0, 99)
)
def test_recordings_are_clipped_cumulative_sums(ids, n, seed):
    ids = sorted(ids)
    paths = action_observations(ids, n, seed=seed)
    assert paths.shape == (len(ids), n, 6, 2) and paths.dtype == np.uint8
    np.testing.assert_array_equal(paths, action_observations(ids, n, "onehot", seed))
    for skill, recordings in zip(ids, paths.tolist(), strict=True):
        for (x, y), *states in recordings:
            for letter, after in zip(SKILL_NAMES[skill], states, strict=True):
                x = min(max(x + DELTAS[letter][0], 1), 78)
                y = min(max(y + DELTAS[letter][1], 1), 78)
                assert after == [x, y]


def test_recordings_start_anywhere_and_4_3_percent_meet_the_wall():
    paths = action_observations(ALL, 256).astype(int)
    starts, counts = np.unique(paths[:, :, 0].reshape(-1, 2), axis=0, return_counts=True)
    assert len(starts) == 78 * 78 and starts.min() == 1 and starts.max() == 78
    expected = 1024 * 256 / 78**2
    chi_squared = ((counts - expected) ** 2 / expected).sum()  # mean 6083, deviation 110
    assert abs(chi_squared - 6083) < 5 * 110
    moved = np.abs(np.diff(paths, axis=2)).sum(-1)  # (1024, 256, 5)
    assert (moved == 0).any(-1).mean() == pytest.approx(0.0433, abs=0.002)


# ---- the available skills ----


def test_layouts_and_available_sets_are_uniform():
    pool = split_actions()["test"]
    env, counts, firsts, layouts = GridWorldEnv(pool), *np.zeros((3, 1024))
    env.reset(seed=0)
    for _ in range(3000):
        before, (observation, _) = env.available, env.reset()
        available = observation["available"]
        assert len(set(available)) == 50 and set(available) != set(before)
        counts[available] += 1
        firsts[available[0]] += 1  # a position favours no skill either
        layouts[env.layout] += 1
    expected = 3000 * 50 / 256
    assert np.abs(counts[pool] - expected).max() < 5 * expected**0.5 and counts.sum() == 150_000
    ordered = GridWorldEnv([700, 3, 41, 9], 4).reset()[0]["available"]
    assert ordered.tolist() == [3, 9, 41, 700]  # the whole pool
    for seen, freedom in ((firsts[pool], 255), (layouts[:42], 41)):
        chi_squared = ((seen - seen.mean()) ** 2 / seen.mean()).sum()
        assert abs(chi_squared - freedom) < 5 * (2 * freedom) ** 0.5


def test_bad_input():
    env = GridWorldEnv()
    env.reset(seed=0, options={"layout": np.int64(7)})
    for layout in (42, -1):  # and the episode goes on
        with pytest.raises(ValueError, match=rf"layout is {layout}; there are 0\.\.41"):
            env.reset(seed=0, options={"layout": layout})
    for action in (-1, 50, 1.0, [1], None):
        with pytest.raises(ValueError, match=r"action is .*; there are 0\.\.49"):
            env.step(action)
    env.step(0)


# ---- pictures and the script ----


def test_render_shows_the_cells_where_they_are():
    """The middle of each cell has the colour of its kind: x to the right, y down."""
    env = all_skills_env("row", 4, 6, render_mode="rgb_array")
    picture = env.render()
    assert picture.shape == (420, 600, 3) and picture.dtype == np.uint8
    colors = {".": "#17191d", "#": "#6f7378", "G": "#35b44a", "o": "#2f6fe4", "~": "#f5821f"}
    for y, row in enumerate(ascii_layout("row", 4, 6)):
        for x, kind in enumerate(row):
            if (x, y) != (1, 1):
                color = [int(colors[kind][i : i + 2], 16) for i in (1, 3, 5)]
                assert picture[y * 40 + 20, x * 40 + 20].tolist() == color
    red = [0xEE, 0x2B, 0x2B]  # the agent at (1, 1)
    assert picture[60, 60].tolist() == red
    env.step(SKILL_NAMES.index("DDDDD"))  # ends on the lava at (1, 4)
    assert env.render()[180, 60].tolist() == red


def test_the_state_beside_the_picture_changes_between_skills_only():
    env = all_skills_env("column", 3, 1, render_mode="rgb_array")
    (start,) = env.render_frames()
    env.step(SKILL_NAMES.index("RRRRR"))
    first = env.render_frames()
    env.step(SKILL_NAMES.index("RDDDD"))
    second = env.render_frames()
    assert len(first) == len(second) == 6  # where the skill begins, and five moves
    assert all((frame[:, 364:] == start[:, 364:]).all() for frame in first)
    assert all((a != b).any() for a, b in zip(first, first[1:], strict=False))
    assert (second[0][:, 364:] != start[:, 364:]).any()


def test_script(tmp_path):
    notebook = os.environ | {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    command = [sys.executable, gridworld.__file__]
    done = subprocess.run(command, cwd=tmp_path, env=notebook, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "to (7, 7), move 15, reward 0.730" in done.stdout
    names = sorted(path.name for path in (tmp_path / "runs" / "demo").iterdir())
    assert names == ["gridworld_planned.gif", "gridworld_random.gif", "gridworld_sheet.png"]
    with pytest.raises(SystemExit, match="error: 300 available actions out of a pool of 256"):
        gridworld.main(gridworld.Args(num_available=300, out=tmp_path / "no"))
    assert not (tmp_path / "no").exists()
