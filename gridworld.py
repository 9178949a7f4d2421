"""Grid World with 1,024 five-move skills (appendix A.1).

An agent on a 9x9 grid crosses a river of lava through its single opening and walks to the goal. One
action is a whole *skill*: five moves up, down, left or right, carried out one after the other. In
every episode only 50 skills are on offer; at test time they are skills never used in training, so
the agent has to understand what a skill does from recordings of it (the "play world" below).

    #########     #  wall
    #A..~...#     A  agent, always starts at (1, 1)
    #...~...#     ~  lava: a whole row or column, here the column x = 4
    #...o...#     o  the opening (the subgoal), here y = 3
    #...~...#     G  goal, always at (7, 7)
    #...~...#     x grows to the right, y grows downwards, both 0..8
    #...~...#
    #...~..G#     e.g. skill DDRRR then RRRDD then DDDDD: subgoal at move 5, goal at move 12
    #########

Commands:

    python gridworld.py                # a solved and a random episode as GIFs, pictures of layouts,
                                       # skills and recordings in runs/demo, a summary (seconds)
    python gridworld.py --pool train --num-available 10 --seed 3

In Python, `import gridworld` registers gym.make("ActionGen/GridWorld-v0").

Paper map (appendix -> here):

    A.1 State                 GridWorldEnv._observation
    A.1 Actions               SKILL_MOVES, GridWorldEnv.step
    A.1 Reward, Eq. 1         goal_reward, LAMBDA_SUBGOAL
    A.1 Action set split      split_actions
    A.1 Action observations   action_observations
    B, Fig. 4 (quadrants)     action_labels
    B, engineered             engineered_representations
    Table 3 (50 actions, 10)  NUM_AVAILABLE, MAX_SKILLS
"""

import functools
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

# ---- A.1 State: the cells of the 9x9 grid ----
SIZE = 9  # A.1; the outer ring is wall, so 7x7 cells can be walked on
EMPTY, WALL, GOAL, LAVA, AGENT, SUBGOAL = 1, 2, 8, 9, 10, 11  # published code (A.1: "integer ID")
START, GOAL_CELL = (1, 1), (7, 7)  # A.1: top left, bottom right corner
RIVERS = (3, 4, 5)  # published code: rows / columns that may hold the lava (A.1: "randomly placed")
OPENINGS = (1, 2, 3, 4, 5, 6, 7)  # published code: the opening is any cell of the river

# ---- A.1 Actions, Table 3 ----
MOVE_NAMES = "RDLU"  # move ids 0..3: right, down, left, up
MOVE_DELTAS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])  # (4, 2): (dx, dy), y grows downwards
SKILL_LENGTH = 5  # A.1
NUM_ACTIONS = len(MOVE_NAMES) ** SKILL_LENGTH  # A.1: 4^5 = 1,024
MAX_SKILLS = 10  # A.1, Table 3
MAX_MOVES = MAX_SKILLS * SKILL_LENGTH  # A.1: 50; N_max of Eq. 1
NUM_AVAILABLE = 50  # Table 3: actions on offer in one episode

# ---- A.1 Reward ----
LAMBDA_SUBGOAL = 0.1  # Eq. 1
LAMBDA_GOAL = 0.9  # Eq. 1

# ---- A.1 Action observations ----
PLAY_LOW, PLAY_HIGH = 1, 78  # A.1: 80x80 grid; its ring of wall leaves 78x78 cells (published code)

METRIC = "success"  # 1.0 when the episode ended on the goal, else 0.0
MODALITIES = ("xy", "onehot")  # Fig. 4, first = the default: (x, y) trajectories

# Skill id <-> moves: base 4, first move = least significant digit, so 0 = RRRRR and 1 = DRRRR.
SKILL_MOVES = np.arange(NUM_ACTIONS)[:, None] // 4 ** np.arange(SKILL_LENGTH) % 4  # (1024, 5)


def skill_name(skill: int) -> str:
    """The five letters of a skill, e.g. 340 -> "RDDDD"."""
    return "".join(MOVE_NAMES[move] for move in SKILL_MOVES[skill])


def skill_id(name: str) -> int:
    """The id of five letters, e.g. "RDDDD" -> 340."""
    return sum(MOVE_NAMES.index(letter) * 4**t for t, letter in enumerate(name))


def layout_id(orientation: str, river: int, opening: int) -> int:
    """Number 0..41 of a layout, e.g. ("vertical", 4, 3): lava in column x = 4, opening at y = 3."""
    row = ("vertical", "horizontal").index(orientation)
    return (row * len(RIVERS) + RIVERS.index(river)) * len(OPENINGS) + OPENINGS.index(opening)


def _build_layouts() -> np.ndarray:
    """All 2 x 3 x 7 = 42 grids without the agent, as they appear in the state: (42, 81) uint8."""
    grids = np.full((2, len(RIVERS), len(OPENINGS), SIZE, SIZE), EMPTY, np.uint8)  # [..., x, y]
    grids[..., [0, -1], :] = grids[..., :, [0, -1]] = WALL
    grids[..., *GOAL_CELL] = GOAL
    for i, river in enumerate(RIVERS):
        for j, opening in enumerate(OPENINGS):
            grids[0, i, j, river, 1:-1] = LAVA  # vertical: a column, all y at one x
            grids[0, i, j, river, opening] = SUBGOAL
            grids[1, i, j, 1:-1, river] = LAVA  # horizontal: a row, all x at one y
            grids[1, i, j, opening, river] = SUBGOAL
    return grids.reshape(-1, SIZE * SIZE)  # (42, 81): flat index = x * 9 + y (published code)


LAYOUTS = _build_layouts()  # start and goal lie outside rows/columns 3..5: all can be solved


def goal_reward(moves):
    """Goal part of Eq. 1 for `moves` = N_total moves made so far (a number or an array).

    Bumps count as moves, the move onto the goal counts, the unused rest of the last skill does not.
    """
    # appendix: (1 - 0.9) * N/50; published code: 1 - 0.9 * N/50; we do the latter because the
    # printed form pays *more* for a longer path, against the text ("encourage a shorter path").
    return 1 - LAMBDA_GOAL * moves / MAX_MOVES


# ---- A.1 Action Set Split; B and 5.4: what is known about each action ----


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Random 2:1:1 split of the 1,024 skills (A.1), the same for every run with the same `seed`.

    Returns sorted int64 ids: {"train": (512,), "valid": (256,), "test": (256,)}, disjoint.
    Raises ValueError for any `split` other than "default".
    """
    if split != "default":
        raise ValueError(f"unknown split {split!r}; allowed: 'default'")
    order = np.random.default_rng(seed).permutation(NUM_ACTIONS)
    train, valid, test = np.split(order, [NUM_ACTIONS // 2, NUM_ACTIONS * 3 // 4])
    return {"train": np.sort(train), "valid": np.sort(valid), "test": np.sort(test)}


def engineered_representations(variant: str = "12d") -> np.ndarray:
    """Ground-truth features of all skills, float32 (1024, 12), (1024, 5) or (1024, 10).

    "12d": net (dx, dy) of the skill, then (dx, dy) of each of its five moves, in cells.
    "5d": the id of each move, mapped from 0..3 to [-1, 1] (right, down, left, up).
    "path": where the skill has led after each of its five moves, (x, y) from its start, in cells.
    Raises ValueError for any other variant.
    """
    # appendix: 5-d, the five moves; published code: 12-d; we default to the latter because the
    # published "engineered" score was reached with it, and move ids have no meaningful order.
    # published code: signs flipped; ours: plain (dx, dy), which a network cannot tell apart.
    if variant == "12d":
        deltas = MOVE_DELTAS[SKILL_MOVES]  # (1024, 5, 2)
        features = np.concatenate([deltas.sum(1), deltas.reshape(NUM_ACTIONS, -1)], axis=1)
    elif variant == "5d":
        features = SKILL_MOVES * 2 / 3 - 1
    elif variant == "path":
        # ours: a linear map of "12d", but in the terms in which lava and goals are laid out, so a
        # utility that is smooth in it says the same of skills that pass the same cells.
        features = MOVE_DELTAS[SKILL_MOVES].cumsum(1).reshape(NUM_ACTIONS, -1)  # (1024, 5 * 2)
    else:
        raise ValueError(f"unknown variant {variant!r}; allowed: '12d', '5d', 'path'")
    return features.astype(np.float32)


def action_labels() -> np.ndarray:
    """Quadrant each skill moves the agent to (colours of Fig. 4): str (1024,), 256 of each kind.

    Five is odd, so no skill ends where it began; the half axes belong to the quadrant that follows
    counter-clockwise from them, due east to "upper right" (published code).
    """
    east, south = MOVE_DELTAS[SKILL_MOVES].sum(1).T  # (1024,) each
    quadrants = {
        "upper right": (south <= 0) & (east > 0),
        "lower right": (south > 0) & (east >= 0),
        "lower left": (south >= 0) & (east < 0),
        "upper left": (south < 0) & (east <= 0),
    }
    return np.select(list(quadrants.values()), list(quadrants), default="")


# ---- A.1 Action Observations: the play world ----


def action_observations(
    action_ids: np.ndarray,
    num_observations: int = 1024,
    modality: str = "xy",
    seed: int = 0,
    workers: int = 1,
) -> np.ndarray:
    """Record skills in an empty 80x80 grid from `num_observations` random cells (A.1, Table 4).

    Returns uint8 (len(action_ids), num_observations, 6, 2): the cell (x, y) before the skill and
    after each of its five moves, in cells, 1..78. E.g. skill UUURD from (3, 2): (3, 2) (3, 1)
    (3, 1) (3, 1) (4, 1) (4, 2); the second and third move bump into the wall.

    Both modalities are the same numbers: "xy" feeds them as they are, "onehot" is expanded by the
    encoder to 80 + 80 zeros and ones per state, which would take 80 times the memory here.

    Every skill has its own generator, seeded with (seed, id), so a recording does not depend on
    which others are asked for. `workers` is ignored: all of it takes about a second.
    Raises ValueError for ids outside 0..1023, num_observations < 1 or an unknown modality.
    """
    if modality not in MODALITIES:
        raise ValueError(f"unknown modality {modality!r}; allowed: {', '.join(MODALITIES)}")
    if num_observations < 1:
        raise ValueError(f"num_observations is {num_observations}; allowed: 1 or more")
    action_ids = _check_ids(action_ids)
    paths = np.empty((len(action_ids), num_observations, SKILL_LENGTH + 1, 2), np.int8)
    for i, action in enumerate(tqdm(action_ids, "recording skills", delay=2, disable=None)):
        rng = np.random.default_rng([seed, action])
        # published code: never starts on (78, 78), where a goal was left over; we have no goal.
        paths[i, :, 0] = rng.integers(PLAY_LOW, PLAY_HIGH + 1, (num_observations, 2))
    deltas = MOVE_DELTAS.astype(np.int8)[SKILL_MOVES[action_ids]]  # (A, 5, 2)
    for t in range(SKILL_LENGTH):
        after = paths[:, :, t] + deltas[:, None, t]  # (A, n, 2) + (A, 1, 2)
        paths[:, :, t + 1] = after.clip(PLAY_LOW, PLAY_HIGH)  # a bump at the wall = stay
    return paths.view(np.uint8)


# ---- the environment, one move at a time ----


def _check_ids(ids: np.ndarray) -> np.ndarray:
    """Skill ids as a 1-D int64 array; ValueError when one is not in 0..1023."""
    ids = np.asarray(ids)
    if ids.ndim != 1 or (ids.size and not np.issubdtype(ids.dtype, np.integer)):
        raise ValueError(
            f"action ids have shape {ids.shape} and type {ids.dtype}; allowed: 1-D int"
        )
    bad = ids[(ids < 0) | (ids >= NUM_ACTIONS)]
    if bad.size:
        raise ValueError(f"action id {bad[0]} does not exist; allowed: 0..{NUM_ACTIONS - 1}")
    return ids.astype(np.int64)


def _check_pool(action_pool: np.ndarray | None, num_available: int) -> np.ndarray:
    """Pool in ascending order (default: training skills); ValueError when it is unusable."""
    pool = np.sort(_check_ids(split_actions()["train"] if action_pool is None else action_pool))
    if (repeated := pool[1:][pool[1:] == pool[:-1]]).size:
        raise ValueError(f"action id {repeated[0]} is in the pool twice; allowed: once")
    if not isinstance(num_available, int | np.integer) or not 1 <= num_available <= len(pool):
        raise ValueError(
            f"num_available is {num_available!r}; allowed: integers 1..{len(pool)} (the pool)"
        )
    return pool


def _check_layout(options: dict | None) -> int | None:
    """The layout that `reset(options={"layout": 7})` asks for; ValueError if there is none."""
    layout = (options or {}).get("layout")
    whole = isinstance(layout, int | np.integer) and not isinstance(layout, bool)
    if layout is not None and not (whole and 0 <= layout < len(LAYOUTS)):
        raise ValueError(f"layout is {layout!r}; allowed: integers 0..{len(LAYOUTS) - 1}")
    return layout


def _observation_space(num_available: int) -> gym.spaces.Dict:
    return gym.spaces.Dict(
        state=gym.spaces.Box(0, SUBGOAL, (SIZE * SIZE,), np.uint8),
        available=gym.spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
    )


class GridWorldEnv(gym.Env):
    """Lava crossing with five-move skills (appendix A.1).

    ## Description
    A 9x9 grid with a ring of wall and one row or column of lava (index 3, 4 or 5) that has a single
    opening, the subgoal: 2 x 3 x 7 = 42 layouts. Moves are absolute and deterministic. A move into
    a wall leaves the agent where it is and still counts.

    ## Action Space
    `Discrete(K)`: a position in the `available` array of the last observation. The skill found
    there makes up to five moves; it is cut short by the goal or by lava.

    ## Observation Space
    `Dict` of
    | key | space | meaning |
    |---|---|---|
    | state | Box(0, 11, (81,), uint8) | cell ids, flat index x * 9 + y: 1 empty, 2 wall, 8 goal, 9 lava, 10 agent (hides what it stands on), 11 subgoal |
    | available | Box(0, 1023, (K,), int64) | ids of the skills on offer in this episode |

    ## Rewards
    0.1 for entering the subgoal the first time, 1 - 0.9 N / 50 for entering the goal with move
    number N (Eq. 1), else 0. The best return is 0.1 + 1 - 0.9 * 12 / 50 = 0.884 in every layout.

    ## Starting State
    Agent at (1, 1), goal at (7, 7); layout uniform over the 42; `available` is drawn uniformly from
    `action_pool` without replacement. When num_available is the size of the pool, `available` is
    the pool in ascending order, always, so that one position means one skill.

    ## Episode End
    `terminated` on the goal or on lava, `truncated` after 10 skills (50 moves). The last step's info
    holds `success` (1.0 or 0.0), `subgoal` (1 or 0), `moves` (1..50) and
    `episode` = {"r": return, "l": number of skills}.

    ## Arguments
    `action_pool`: distinct ids that `available` is drawn from (default: the training skills).
    `num_available`: K (default 50, Table 3). `render_mode`: None or "rgb_array".
    `reset(options={"layout": i})` chooses the layout (0..41, see `layout_id`).
    ValueError for a pool with unknown or repeated ids or fewer than K of them, and for K < 1.
    """  # noqa: E501 (table)

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(
        self,
        action_pool: np.ndarray | None = None,
        num_available: int = NUM_AVAILABLE,
        render_mode: str | None = None,
    ):
        self.action_pool = _check_pool(action_pool, num_available)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; allowed: None, 'rgb_array'")
        self.render_mode = render_mode
        self.num_available = num_available
        self.observation_space = _observation_space(num_available)
        self.action_space = gym.spaces.Discrete(num_available)
        self._over = True  # nothing to step until the first reset

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Draw a layout and the skills on offer; returns (observation, {})."""
        layout = _check_layout(options)
        super().reset(seed=seed)
        self._layout, self._available = self._draw_episode()
        if layout is not None:
            self._layout = layout
        self._grid = LAYOUTS[self._layout].reshape(SIZE, SIZE)  # [x, y], without the agent
        self._position = START
        self._moves = self._skills = 0
        self._return = 0.0
        self._subgoal_taken = self._over = False
        self._skill = None
        self.trace = [START]  # cells of the last step, for render_frames
        return self._observation(), {}

    def _draw_episode(self) -> tuple[int, np.ndarray]:
        # published code: new entropy from the system for every draw; ours: the seeded generator.
        layout = int(self.np_random.integers(len(LAYOUTS)))
        if self.num_available == len(self.action_pool):
            return layout, self.action_pool  # ascending order: a fixed meaning for every position
        return layout, self.np_random.choice(self.action_pool, self.num_available, replace=False)

    def _observation(self) -> dict[str, np.ndarray]:
        # Raw ids, as A.1 says; the published learner normalises them, and so does ours.
        state = self._grid.copy()  # fresh arrays: a learner may keep them
        state[self._position] = AGENT
        return {"state": state.reshape(-1), "available": self._available.copy()}

    def step(self, action: int):
        """Carry out one skill; returns (observation, reward, terminated, truncated, info)."""
        if self._over:
            raise gym.error.ResetNeeded("the episode is over: call reset() before step()")
        if np.ndim(action) or np.asarray(action).dtype.kind not in "iu":
            raise ValueError(f"action is {action!r}; allowed: one integer")
        if not 0 <= action < self.num_available:
            raise ValueError(f"action is {action}; allowed: 0..{self.num_available - 1}")
        self._skill = int(self._available[action])
        self._skills += 1
        self.trace = [self._position]
        reward, entered = 0.0, EMPTY
        for dx, dy in MOVE_DELTAS[SKILL_MOVES[self._skill]].tolist():
            self._moves += 1
            target = (self._position[0] + dx, self._position[1] + dy)
            entered = self._grid[target]
            if entered != WALL:  # a wall makes it a null move (A.1)
                self._position = target
            self.trace.append(self._position)
            if entered == SUBGOAL and not self._subgoal_taken:
                self._subgoal_taken = True
                reward += LAMBDA_SUBGOAL
            if entered == GOAL:
                reward += goal_reward(self._moves)
            if entered in (GOAL, LAVA):  # the rest of the skill is not carried out
                break
        success, terminated = bool(entered == GOAL), entered in (GOAL, LAVA)
        # published code: the limit is a true end; we report `truncated`, the learner may treat both
        # alike. It can only be reached with the last move of a skill: 10 x 5 moves are 50.
        truncated = not terminated and self._moves >= MAX_MOVES
        self._return += reward
        self._over = terminated or truncated
        info = {}
        if self._over:
            info = {
                METRIC: float(success),
                "subgoal": int(self._subgoal_taken),
                "moves": self._moves,
                "episode": {"r": self._return, "l": self._skills},
            }
        return self._observation(), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """One picture of the present state: uint8 (height, width, 3)."""
        if self.render_mode is None:
            gym.logger.warn("render() needs render_mode='rgb_array'; nothing is drawn")
            return None
        if not hasattr(self, "_layout"):
            raise gym.error.ResetNeeded("call reset() before the first render()")
        return draw_frame(self._layout, self.trace, self._skill, self._moves)

    def render_frames(self) -> list[np.ndarray]:
        """Pictures of the last step, one per move (after reset: one picture of the start).

        None at all without render_mode.
        """
        if self.render_mode is None:
            return []
        if not hasattr(self, "_layout"):
            raise gym.error.ResetNeeded("call reset() before the first render_frames()")
        first = 0 if self._skill is None else 1
        before = self._moves - (len(self.trace) - 1)  # moves made before this step
        return [
            draw_frame(self._layout, self.trace[: move + 1], self._skill, before + move)
            for move in range(first, len(self.trace))
        ]


gym.register("ActionGen/GridWorld-v0", entry_point="gridworld:GridWorldEnv")


# ---- the same rules as table look-ups, for training ----


@functools.cache
def skill_effects() -> np.ndarray:
    """What every skill does from every cell of every layout: uint8 (42, 81, 1024, 5), built once.

    Last axis: final cell, moves made, and 0/1 flags: subgoal entered, goal entered, lava entered.
    """
    effects = np.zeros((len(LAYOUTS), SIZE * SIZE, NUM_ACTIONS, 5), np.uint8)
    jumps = (MOVE_DELTAS @ (SIZE, 1))[SKILL_MOVES]  # (1024, 5): steps along the flat index
    for grid, effect in zip(LAYOUTS, effects, strict=True):
        cell = np.repeat(np.arange(SIZE * SIZE)[:, None], NUM_ACTIONS, 1)  # (81, 1024)
        moves, subgoal, goal, lava = np.zeros((4, *cell.shape), np.uint8)
        for t in range(SKILL_LENGTH):
            going = (goal | lava) == 0
            target = (cell + jumps[:, t]).clip(0, grid.size - 1)  # clip: nobody stands on the ring
            entered = np.where(going, grid[target], WALL)
            moves += going
            cell = np.where(entered == WALL, cell, target)
            subgoal |= entered == SUBGOAL
            goal |= entered == GOAL
            lava |= entered == LAVA
        effect[:] = np.stack([cell, moves, subgoal, goal, lava], axis=-1)  # (81, 1024, 5)
    return effects


class GridWorldVectorEnv(VectorEnv):
    """`num_envs` Grid Worlds in numpy arrays, with the rules, spaces and infos of `GridWorldEnv`.

    Ended episodes restart within the same step (SAME_STEP autoreset): the last observation and info
    of such an episode are in infos["final_obs"] and infos["final_info"], in the form in which
    gymnasium's SyncVectorEnv returns them. Arguments and errors: see `GridWorldEnv` and `make_vec`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int,
        action_pool: np.ndarray | None = None,
        num_available: int = NUM_AVAILABLE,
        seed: int | None = None,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; allowed: 1 or more")
        self.action_pool = _check_pool(action_pool, num_available)
        self.num_envs, self.num_available = num_envs, num_available
        self.single_observation_space = _observation_space(num_available)
        self.single_action_space = gym.spaces.Discrete(num_available)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._np_random, self._np_random_seed = gym.utils.seeding.np_random(seed)
        self._effects = skill_effects()
        self._rows = np.arange(num_envs)
        self._layout, self._cell, self._moves, self._skills = np.zeros((4, num_envs), np.int64)
        self._return = np.zeros(num_envs)
        self._subgoal_taken = np.zeros(num_envs, np.uint8)
        self._available = np.tile(self.action_pool[:num_available], (num_envs, 1))  # (N, K)
        self._bank = None  # sets drawn ahead; None until the first reset

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start all episodes anew; returns (observations, {}). A seed reseeds the one generator."""
        layout = _check_layout(options)
        super().reset(seed=seed)
        self._bank = np.empty((0, self.num_available), np.int64)
        self._start(self._rows)
        if layout is not None:
            self._layout[:] = layout
        return self._observation(), {}

    def _start(self, envs: np.ndarray) -> None:
        """New episodes for the sub-environments `envs` (m,)."""
        self._layout[envs] = self.np_random.integers(len(LAYOUTS), size=len(envs))
        if self.num_available < len(self.action_pool):
            self._available[envs] = self._draw_available(len(envs))
        self._cell[envs] = START[0] * SIZE + START[1]
        for counter in (self._moves, self._skills, self._return, self._subgoal_taken):
            counter[envs] = 0

    def _draw_available(self, count: int) -> np.ndarray:
        """`count` random sets from the pool: (count, K).

        Drawing the sets one by one would take longer than all the rest of a step. A random
        permutation of the pool, cut into blocks of K, gives many sets for the price of one, each of
        them exactly a uniform draw without replacement; only blocks of the same permutation depend
        on each other (they are disjoint). The bank holds one permutation per sub-environment and
        hands out first all their first blocks, then all their second blocks, ..., so that such
        blocks are far apart. No block is thrown away: that could favour some skills.
        """
        taken, self._bank = self._bank[:count], self._bank[count:]
        if len(taken) < count:
            blocks = len(self.action_pool) // self.num_available
            pool = np.tile(self.action_pool, (self.num_envs, 1))
            pool = self.np_random.permuted(pool, axis=1)[:, : blocks * self.num_available]
            bank = pool.reshape(self.num_envs, blocks, -1).swapaxes(0, 1)  # (blocks, N, K)
            bank = bank.reshape(-1, self.num_available)  # (blocks * N, K), first blocks first
            missing = count - len(taken)
            taken, self._bank = np.concatenate([taken, bank[:missing]]), bank[missing:]
        return taken

    def _observation(self) -> dict[str, np.ndarray]:
        state = LAYOUTS[self._layout]  # (N, 81), a copy
        state[self._rows, self._cell] = AGENT
        return {"state": state, "available": self._available.copy()}

    def step(self, actions: np.ndarray):
        """One skill in every sub-environment: `actions` int (N,), positions in `available`."""
        if self._bank is None:
            raise gym.error.ResetNeeded("call reset() before the first step()")
        actions, k = np.asarray(actions), self.num_available
        whole = actions.shape == self._rows.shape and actions.dtype.kind in "iu"
        if not whole or actions.min() < 0 or actions.max() >= k:
            raise ValueError(
                f"actions are {actions}; allowed: {self.num_envs} integers in 0..{k - 1}"
            )
        skills = self._available[self._rows, actions]  # (N,) ids
        self._cell[:], moves, subgoal, goal, lava = self._effects[
            self._layout, self._cell, skills
        ].T  # (N, 5) -> five (N,)
        self._moves += moves
        self._skills += 1
        first_time = subgoal > self._subgoal_taken
        self._subgoal_taken |= subgoal
        rewards = LAMBDA_SUBGOAL * first_time + goal * goal_reward(self._moves)
        self._return += rewards
        terminated = (goal | lava) > 0
        truncated = (self._moves >= MAX_MOVES) & ~terminated
        observation, infos = self._observation(), {}
        if (over := terminated | truncated).any():
            infos = self._final_infos(observation, over, goal)
            self._start(over.nonzero()[0])
            observation = self._observation()
        return observation, rewards, terminated, truncated, infos

    def _final_infos(self, observation: dict, over: np.ndarray, goal: np.ndarray) -> dict:
        """Last observations and infos of the episodes in the mask `over`, as SyncVectorEnv does."""
        final_obs = np.full(self.num_envs, None, object)
        for i in over.nonzero()[0]:
            final_obs[i] = {key: array[i] for key, array in observation.items()}

        def masked(**values: np.ndarray) -> dict:  # key -> values where over, _key -> the mask
            masks = {f"_{key}": over.copy() for key in values}
            return {key: value * over for key, value in values.items()} | masks

        info = masked(
            success=goal * 1.0, subgoal=self._subgoal_taken.astype(int), moves=self._moves
        )
        info |= {"episode": masked(r=self._return, l=self._skills), "_episode": over.copy()}
        return {
            "final_obs": final_obs,
            "_final_obs": over.copy(),
            "final_info": info,
            "_final_info": over.copy(),
        }


def make_vec(
    num_envs: int,
    action_pool: np.ndarray | None = None,
    num_available: int = NUM_AVAILABLE,
    seed: int = 0,
) -> GridWorldVectorEnv:
    """`num_envs` Grid Worlds for training, all random draws from one generator seeded with `seed`.

    A first reset() without a seed is determined by `seed`; reset(seed=s) reseeds everything.
    Raises ValueError for a bad pool, num_available or num_envs (see `GridWorldEnv`).
    """
    return GridWorldVectorEnv(num_envs, action_pool, num_available, seed)


# ---- pictures (Figure 1) ----

CELL = 40  # ours: pixels per cell, about the size of Figure 1 on a screen
CAPTION = 60  # ours: pixels below the grid for the skill and the move counter
FINE = 4  # ours: drawn 4 times larger, then averaged down: smooth edges without a drawing library
COLORS = {  # ours, after Figure 1: grey wall, green goal, orange lava, blue subgoal, red agent
    EMPTY: "#17191d",
    WALL: "#6f7378",
    GOAL: "#35b44a",
    LAVA: "#f5821f",
    SUBGOAL: "#2f6fe4",
    AGENT: "#ee2b2b",
}
GRID_LINE, TRAIL, TEXT, DIM_TEXT, LAVA_WAVE = "#3c4046", "#8f2c2c", "#f2f2f2", "#80858c", "#a94a06"


@functools.cache
def _board(layout: int) -> Image.Image:
    """The grid of a layout without the agent, FINE times too large."""
    cell = CELL * FINE
    image = Image.new("RGB", (SIZE * cell, SIZE * cell + CAPTION * FINE), COLORS[EMPTY])
    draw = ImageDraw.Draw(image)
    for (x, y), kind in np.ndenumerate(LAYOUTS[layout].reshape(SIZE, SIZE)):
        left, top = x * cell, y * cell
        draw.rectangle((left, top, left + cell, top + cell), COLORS[kind], GRID_LINE, FINE)
        if kind == LAVA:
            across = np.linspace(0.12, 0.88, 40)
            for height in (0.3, 0.5, 0.7):
                wave = height + 0.045 * np.sin(across * 4 * np.pi)
                points = np.stack([left + across * cell, top + wave * cell], 1)  # (40, 2)
                draw.line([*points.ravel()], LAVA_WAVE, 2 * FINE, "curve")
    return image


def draw_frame(layout: int, path: list, skill: int | None, moves: int) -> np.ndarray:
    """Picture of a grid and the skill below it: uint8 (420, 360, 3).

    `path`: the cells (x, y) from the start of the skill to the present one; `skill`: its id, None
    before the first; `moves`: moves made in the episode so far.
    """
    image = _board(layout).copy()
    draw = ImageDraw.Draw(image)
    centres = (np.array(path) + 0.5) * CELL * FINE  # (moves of this skill + 1, 2)
    done = len(path) - 1
    heading = 0 if skill is None else SKILL_MOVES[skill, done - 1]
    if done:
        draw.line([*centres.ravel()], TRAIL, 4 * FINE, "curve")
    for x, y in centres[:-1]:
        draw.ellipse((x - 5 * FINE, y - 5 * FINE, x + 5 * FINE, y + 5 * FINE), TRAIL)
    forward = MOVE_DELTAS[heading] * CELL * FINE * 0.36
    side = np.array((-forward[1], forward[0])) * 0.85
    tip, base = centres[-1] + forward, centres[-1] - forward * 0.8
    corners = [*tip, *(base + side), *(base - side)]
    draw.polygon(corners, COLORS[AGENT], "#5c0d0d", int(1.5 * FINE))
    _draw_caption(draw, path[-1], LAYOUTS[layout], skill, done, moves)
    return np.array(image.reduce(FINE))


def _draw_caption(draw, position, grid, skill, done: int, moves: int) -> None:
    """The five moves as keys (the present one lit), the move counter and what was entered."""
    key, top = 32 * FINE, (SIZE * CELL + (CAPTION - 32) // 2) * FINE
    for t, letter in enumerate(skill_name(skill) if skill is not None else " " * SKILL_LENGTH):
        left = 14 * FINE + t * (key + 5 * FINE)
        lit = skill is not None and t == done - 1
        box = (left, top, left + key, top + key)
        fill = COLORS[AGENT] if lit else "#2a2d33"
        draw.rounded_rectangle(box, 6 * FINE, fill, GRID_LINE, FINE)
        color = TEXT if t < done else DIM_TEXT
        _text(draw, left + key / 2, top + key / 2, letter, color, 19, "mm")
    kind = grid[position[0] * SIZE + position[1]]
    words = {SUBGOAL: "subgoal", GOAL: "goal reached", LAVA: "lava"}
    word, color = words.get(kind, ""), COLORS[kind]
    if moves >= MAX_MOVES and kind not in (GOAL, LAVA):
        word, color = "out of moves", TEXT
    right = (SIZE * CELL - 14) * FINE
    middle = top + key / 2
    _text(draw, right, middle - 9 * FINE, f"move {moves} / {MAX_MOVES}", TEXT, 15, "rm")
    _text(draw, right, middle + 10 * FINE, word, color, 15, "rm")


def _text(draw, x: float, y: float, text: str, color: str, size: int, anchor: str) -> None:
    draw.text((x, y), text, color, ImageFont.load_default(size * FINE), anchor)


def episode_frames(
    env: gym.Env, choose: Callable[[dict], int], seed: int | None = None, **reset_options
) -> tuple[list[np.ndarray], dict]:
    """Play one episode of `choose`(observation) -> action; returns (pictures, last info).

    `seed` and `reset_options` (e.g. layout=3) go to env.reset.
    """
    observation, info = env.reset(seed=seed, options=reset_options)
    frames, over = env.render_frames(), False
    while not over:
        observation, _, terminated, truncated, info = env.step(choose(observation))
        frames += env.render_frames()
        over = terminated or truncated
    return frames, info


def save_gif(path: str | Path, frames: list[np.ndarray], fps: float) -> None:
    """Write pictures as an endless GIF; the last one stays for 1.5 s. Creates missing folders."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = [round(1000 / fps)] * (len(frames) - 1) + [1500]  # ours: time to see the outcome
    images = [Image.fromarray(frame) for frame in frames]
    temporary = path.with_name(path.name + ".part")  # a reader never meets a half-written file
    with open(temporary, "wb") as file:
        images[0].save(
            file, "GIF", save_all=True, append_images=images[1:], duration=durations, loop=0
        )
    os.replace(temporary, path)


# ---- what can be reached, and the script ----


def best_plan(layout: int, available: np.ndarray) -> tuple[float, list[int]]:
    """Best return with the skills `available`, and the positions in it to choose one after another.

    The plan is empty when the goal is out of reach; the return is then 0.1 or 0. Breadth first: all
    cells reached with one skill, then with two, ... A skill that ends no episode makes five moves,
    so the first number of skills that allows the goal also holds the shortest way there.
    """
    effects = skill_effects()[layout][:, available]  # (81, K, 5)
    plans: dict[int, list[int]] = {START[0] * SIZE + START[1]: []}  # cell -> how to get there
    frontier, subgoal_seen = list(plans), False
    for skills_before in range(MAX_SKILLS):
        finishes, following = [], []
        for cell in frontier:
            after, moves, subgoal, goal, lava = effects[cell].T  # (K,) each
            subgoal_seen |= bool(subgoal.any())
            finishes += [(moves[i], plans[cell] + [int(i)]) for i in goal.nonzero()[0]]
            for i in (lava == 0).nonzero()[0]:
                if int(after[i]) not in plans:
                    plans[int(after[i])] = plans[cell] + [int(i)]
                    following.append(int(after[i]))
        if finishes:
            moves, plan = min(finishes)
            return LAMBDA_SUBGOAL + goal_reward(skills_before * SKILL_LENGTH + int(moves)), plan
        frontier = following
    return LAMBDA_SUBGOAL * subgoal_seen, []


@dataclass
class Args:
    """Play one solved and one random episode, draw the action set, print a summary."""

    seed: int = 0
    """seed of the split, the layouts and the skills on offer"""
    out: Path = Path("runs/demo")
    """folder for the GIFs and the picture"""
    pool: Literal["train", "valid", "test", "all"] = "test"
    """skills to draw from"""
    num_available: int = NUM_AVAILABLE
    """skills on offer in an episode (Table 3)"""


def _print_summary(args: Args, pool: np.ndarray) -> None:
    labels, kinds = action_labels(), ("upper right", "lower right", "lower left", "upper left")
    print(
        f"{NUM_ACTIONS} skills of {SKILL_LENGTH} moves, {len(LAYOUTS)} layouts; split {args.seed}:"
    )
    print(f"  {'':6} skills  {'  '.join(kinds)}")
    for name, ids in split_actions(seed=args.seed).items():
        counts = [f"{(labels[ids] == kind).sum():{len(kind)}}" for kind in kinds]
        print(f"  {name:6} {len(ids):6}  {'  '.join(counts)}")
    best = [best_plan(layout, np.arange(NUM_ACTIONS))[0] for layout in range(len(LAYOUTS))]
    print(f"best return with all skills: {min(best):.3f} to {max(best):.3f} over the layouts")
    rng, sets = np.random.default_rng(args.seed), 20  # ours: 840 searches, half a second
    draws = [rng.choice(pool, args.num_available, replace=False) for _ in range(sets)]
    found = [best_plan(layout, ids) for ids in draws for layout in range(len(LAYOUTS))]
    solved = np.mean([len(plan) > 0 for _, plan in found])
    print(f"{args.num_available} of the {len(pool)} skills of {args.pool!r}:")
    print(f"  best possible  success {solved:.3f}  return {np.mean([r for r, _ in found]):.3f}")
    envs, wins, returns = make_vec(256, pool, args.num_available, args.seed), [], []
    envs.reset()
    for _ in range(400):
        infos = envs.step(rng.integers(args.num_available, size=envs.num_envs))[-1]
        if infos:
            over, info = infos["_final_info"], infos["final_info"]
            wins.extend(info[METRIC][over])
            returns.extend(info["episode"]["r"][over])
    print(f"  random choice  success {np.mean(wins):.3f}  return {np.mean(returns):.3f}")


def _draw_sheet(path: Path, pool: np.ndarray, seed: int) -> None:
    """One picture: the 42 layouts, skills of the pool by quadrant, recordings in the play world."""
    import matplotlib.pyplot as plt  # here: training needs no pictures

    colors = {"upper right": "#d62728", "lower right": "#e0a106"}
    colors |= {"lower left": "#1f77b4", "upper left": "#2ca02c"}
    rng, labels = np.random.default_rng(seed), action_labels()
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(16, 5.7))
    boards = [np.array(_board(i).reduce(2 * FINE))[: SIZE * CELL // 2] for i in range(len(LAYOUTS))]
    boards = np.pad(boards, ((0, 0), (8, 8), (8, 8), (0, 0)), constant_values=255)
    rows = np.split(boards, len(LAYOUTS) // len(OPENINGS))  # 6 of (7, height, width, 3)
    left.imshow(np.concatenate([np.concatenate(row, axis=1) for row in rows]))
    left.set_title("the 42 layouts")
    shown = {kind: rng.permutation(pool[labels[pool] == kind])[:4] for kind in colors}
    for row, (kind, skills) in enumerate(shown.items()):
        for column, skill in enumerate(skills):
            moves = SKILL_MOVES[skill]
            steps = np.vstack([(0, 0), MOVE_DELTAS[moves].cumsum(0)])  # (6, 2)
            turns_back = np.append(False, (moves[1:] - moves[:-1]) % 4 == 2)
            lane = 0.25 * turns_back.cumsum()[:, None, None]  # the way back is drawn beside
            line = (np.stack([steps[:-1], steps[1:]], axis=1) + lane).reshape(-1, 2)  # (10, 2)
            x, y = (line - (line.min(0) + line.max(0)) / 2 + (7 * column, 8 * row)).T
            middle.plot(x, y, "-", color=colors[kind], linewidth=2)
            middle.plot(x[0], y[0], "o", color=colors[kind], markersize=8)
            middle.plot(x[-1], y[-1], "s", color=colors[kind], markersize=6)
            middle.text(7 * column, 8 * row + 4, skill_name(skill), ha="center", fontsize=9)
    middle.set(xlim=(-3, 24), ylim=(29, -3), title="skills (dot: start, square: end) by quadrant")
    for kind, skills in shown.items():
        for steps in action_observations(skills[:1], 40, seed=seed).reshape(-1, 6, 2):
            right.plot(*steps.T, color=colors[kind], linewidth=1.5)
            right.plot(*steps[0], "o", color=colors[kind], markersize=3.5)
    names = ", ".join(skill_name(skills[0]) for skills in shown.values() if len(skills))
    right.set(xlim=(0, 79), ylim=(79, 0), title=f"recordings (80x80): {names}")
    left.set_axis_off()
    middle.set_axis_off()
    middle.set_aspect("equal")
    right.set_aspect("equal")
    figure.subplots_adjust(0.01, 0.05, 0.99, 0.94, wspace=0.04)
    temporary = path.with_name(path.name + ".part")
    figure.savefig(temporary, format="png", dpi=100)
    os.replace(temporary, path)


def main(args: Args) -> None:
    """What `python gridworld.py` does; ValueError for a bad seed or num_available."""
    if args.seed < 0:
        raise ValueError(f"seed is {args.seed}; allowed: 0 or more")
    pool = np.arange(NUM_ACTIONS)
    if args.pool != "all":
        pool = split_actions(seed=args.seed)[args.pool]
    env = GridWorldEnv(pool, args.num_available, "rgb_array")
    _print_summary(args, pool)
    names = ["gridworld_random.gif", "gridworld_sheet.png"]
    for seed in range(args.seed, args.seed + 100):  # with few skills on offer, few can be solved
        observation, _ = env.reset(seed=seed)
        plan = best_plan(env._layout, observation["available"])[1]
        if plan:
            steps = iter(plan)
            frames, info = episode_frames(env, lambda _, steps=steps: next(steps), seed)
            skills = " ".join(skill_name(observation["available"][i]) for i in plan)
            print(f"solved in {info['moves']} moves: {skills}, return {info['episode']['r']:.3f}")
            names.append("gridworld_solved.gif")
            save_gif(args.out / names[-1], frames, env.metadata["render_fps"])
            break
    else:
        print("no solution with these skills in 100 episodes")
    env.action_space.seed(args.seed)
    frames, info = episode_frames(env, lambda _: int(env.action_space.sample()), args.seed)
    save_gif(args.out / names[0], frames, env.metadata["render_fps"])
    _draw_sheet(args.out / names[1], pool, args.seed)
    print(f"wrote {', '.join(names)} in {args.out}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
