"""Grid World with 1,024 five-move skills (appendix A.1).

An agent on a 9x9 grid crosses a river of lava through its one opening and walks to the goal. An
action is a whole *skill*: five moves up, down, left or right. In every episode 50 skills are on
offer. At test time they are skills never used in training: the agent has to understand a skill
from recordings of it in another, larger and empty grid.

    #########     #  wall
    #A..~...#     A  agent, always starts at (1, 1)
    #...~...#     ~  lava: a whole row or column, here the column x = 4
    #...o...#     o  the opening (the subgoal), here at y = 3
    #...~...#     G  goal, always at (7, 7)
    #...~...#     x grows to the right, y grows downwards, both 0..8
    #...~...#
    #...~..G#     e.g. skill DDRRR, then RRRDD, then DDDDD: subgoal at move 5, goal at move 12
    #########

Commands:

    python gridworld.py       # a planned and a random episode as text and GIF, and one picture of
                              # layouts, skills and recordings, in runs/demo (5 seconds)
    python gridworld.py --pool train --num-available 10 --seed 3

Paper map (appendix -> here):

    A.1 Actions                SKILL_MOVES, walk
    A.1 Action set split       split_actions
    B   engineered             engineered_representations
    B   Fig. 4 (quadrants)     action_labels
    A.1 State                  LAYOUTS, GridWorldEnv._observe
    A.1 Reward, Eq. 1          GridWorldEnv.step
    A.1 Action observations    action_observations
    Table 3 (50 actions, 10)   NUM_AVAILABLE, MAX_SKILLS
"""

import functools
import heapq
import operator
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from PIL import Image, ImageColor, ImageDraw, ImageFont

# ---- constants (each with its source) ----
NUM_ACTIONS = 1024  # A.1: 4^5 sequences of 5 moves in 4 directions
SKILL_LENGTH = 5  # A.1
METRIC = "success"  # 1.0 when the episode ended on the goal, else 0.0
MODALITIES = ("xy", "onehot")  # B: state trajectories (the default), one-hot states
NUM_AVAILABLE = 50  # Table 3 "actions per episode"
MAX_SKILLS = 10  # A.1, Table 3 "max. episode length"
MAX_MOVES = MAX_SKILLS * SKILL_LENGTH  # A.1: 50, N_max of Eq. 1
LAMBDA_SUBGOAL = 0.1  # Eq. 1
LAMBDA_GOAL = 0.9  # Eq. 1
SIZE = 9  # A.1; the outer ring is wall, so the agent walks on 7x7 cells
EMPTY, WALL, GOAL, LAVA, AGENT, SUBGOAL = 1, 2, 8, 9, 10, 11  # published code (A.1: "integer ID")
START = 1 * SIZE + 1  # A.1: top left. A cell (x, y) is the number x * 9 + y (published code)
RIVERS = (3, 4, 5)  # published code: rows or columns of the lava (A.1: "randomly placed")
OPENINGS = (1, 2, 3, 4, 5, 6, 7)  # published code: any cell of the river may be the opening
PLAY_LOW, PLAY_HIGH = 1, 78  # A.1: 80x80 grid; published code: its ring is wall

# ---- A.1 Actions, action set split; B: what is known about them ----
MOVE_NAMES = "RDLU"  # published code: right, down, left, up are the moves 0..3
MOVE_DELTAS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])  # (4, 2): (dx, dy)
# published code: ids in base 4, the first move is the lowest digit: 0 = RRRRR, 1 = DRRRR.
SKILL_MOVES = np.arange(NUM_ACTIONS)[:, None] // 4 ** np.arange(SKILL_LENGTH) % 4  # (1024, 5)
SKILL_NAMES = ["".join(MOVE_NAMES[move] for move in moves) for moves in SKILL_MOVES]
# The same moves as steps from one cell number to the next, as plain integers (fast to go through).
SKILL_STEPS = (MOVE_DELTAS @ (SIZE, 1))[SKILL_MOVES].tolist()  # (1024, 5)
# B, Figure 4: upper right is red. In the order of the quarter turns from due east to due south.
QUADRANTS = {"upper right": "tab:red", "upper left": "tab:green",
             "lower left": "tab:blue", "lower right": "tab:orange"}  # fmt: skip


def action_labels() -> np.ndarray:
    """The quadrant each skill leads to (colours of Fig. 4), str (1024,): 256 skills of each."""
    east, south = MOVE_DELTAS[SKILL_MOVES].sum(1).T  # (1024,) each
    # Five is odd, so no skill ends where it began. A half axis belongs to the quadrant that follows
    # it against the clock (published code): due east is upper right, due north is upper left.
    turns = np.arctan2(-south, east) // (np.pi / 2)  # -2..2 quarter turns, 2 is -2
    return np.array(list(QUADRANTS))[turns.astype(int)]


def engineered_representations(variant: str = "12d") -> np.ndarray:
    """Ground-truth features of all skills, float32 (1024, d), in cells; y grows downwards.

    "12d": net (dx, dy) of the skill, then (dx, dy) of each of its five moves.
    "5d": the five moves (B), right, down, left, up as -1, -1/3, 1/3, 1.
    "path": (x, y) from the start after each of the five moves, d = 10.
    """
    # appendix: 5-d; published code: 12-d, signs flipped; we default to 12-d, because the published
    # score was reached with it and move ids have no order. To a network our signs are the same.
    deltas = MOVE_DELTAS[SKILL_MOVES]  # (1024, 5, 2)
    tables = {
        "12d": np.column_stack([deltas.sum(1), deltas.reshape(-1, 10)]),
        "5d": SKILL_MOVES * 2 / 3 - 1,
        # ours: skills are alike if they pass the same cells
        "path": deltas.cumsum(1).reshape(-1, 10),
    }
    if variant not in tables:
        raise ValueError(f"variant {variant!r} is unknown; there are {', '.join(tables)}")
    return tables[variant].astype(np.float32)


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Cut the skills at random 2:1:1 (A.1) into sorted ids "train", "valid", "test".

    512 / 256 / 256 ids, disjoint. ValueError for any split but "default".
    """
    if split != "default":
        raise ValueError(f"split {split!r} is unknown; Grid World has only 'default'")
    order = np.random.default_rng(seed).permutation(NUM_ACTIONS)
    parts = np.split(order, [NUM_ACTIONS // 2, NUM_ACTIONS * 3 // 4])
    return dict(zip(("train", "valid", "test"), map(np.sort, parts), strict=True))


def check_ids(ids: Sequence[int], num_available: int = 1) -> np.ndarray:
    """`ids` (n,) as integers; ValueError unless distinct, known, and enough to offer so many."""
    ids = np.asarray(ids)
    if ids.ndim != 1 or ids.dtype.kind not in "iu" or len(np.unique(ids)) < len(ids):
        raise ValueError("action ids must be a list of distinct integers")
    if not 1 <= num_available <= len(ids):
        raise ValueError(
            f"{num_available} actions on offer out of {len(ids)}: from 1 to {len(ids)}"
        )
    if not 0 <= ids.min() <= ids.max() < NUM_ACTIONS:
        raise ValueError(f"action ids lie in 0..{NUM_ACTIONS - 1}, got {ids.min()}..{ids.max()}")
    return ids.astype(np.int64)


# ---- A.1 State: the grids; what a skill does in them ----

# The 2 x 3 x 7 = 42 layouts without the agent. Start and goal lie outside of every river, so each
# can be solved. Number: 7 * (river - 3) + opening - 1, and 21 more when the river is a row.
LAYOUTS = np.full((2, len(RIVERS), len(OPENINGS), SIZE, SIZE), EMPTY, np.uint8)  # [..., x, y]
LAYOUTS[..., [0, -1], :] = LAYOUTS[..., [0, -1]] = WALL
LAYOUTS[..., 7, 7] = GOAL  # A.1: bottom right corner
for i, j in np.ndindex(len(RIVERS), len(OPENINGS)):
    LAYOUTS[0, i, j, RIVERS[i], 1:-1] = LAVA  # a column: one x, all y
    LAYOUTS[0, i, j, RIVERS[i], OPENINGS[j]] = SUBGOAL
LAYOUTS[1] = LAYOUTS[0].swapaxes(2, 3)  # the same as rows
LAYOUTS = LAYOUTS.reshape(-1, SIZE * SIZE)  # (42, 81): cell (x, y) at index x * 9 + y


def walk(grid: list[int], cell: int, skill: int) -> list[int]:
    """The cells after each move of `skill`; fewer than five if the episode ends.

    Moves are absolute. E.g. UUURD from (3, 2), cell 29: 28, 28, 28, 37, 38 (two bumps).
    """
    cells = []
    for step in SKILL_STEPS[skill]:
        if grid[cell + step] != WALL:  # A.1: a null move, it counts as one
            cell += step
        cells.append(cell)
        if grid[cell] in (GOAL, LAVA):  # A.1: lava; published code: also the goal
            break
    return cells


# ---- A.1 the environment ----


class GridWorldEnv(gym.Env):
    """Lava crossing with five-move skills (appendix A.1).

    ## Description
    A 9x9 grid with a ring of wall. One row or column (3, 4 or 5) is lava with a single opening, the
    subgoal. Moves are absolute and deterministic. A move into a wall does nothing, but counts.

    ## Action Space
    `Discrete(K)`: a position in `available`. The skill's five moves are cut short by goal or lava.

    ## Observation Space
    `Dict(state=Box(0, 11, (81,), uint8), available=Box(0, 1023, (K,), int64))`. `state[x * 9 + y]`
    is the id of the cell (x, y): 1 empty, 2 wall, 8 goal, 9 lava, 10 agent (hides what it stands
    on), 11 subgoal. `available` are the ids of the K skills on offer in this episode.

    ## Rewards
    0.1 for entering the subgoal the first time, 1 - 0.9 N / 50 for entering the goal with move N
    (Eq. 1), else 0. The best return is 0.1 + 1 - 0.9 * 12 / 50 = 0.884 in every layout.

    ## Starting State
    Agent at (1, 1), goal at (7, 7), one of 42 layouts, K skills drawn from `action_pool` without
    replacement. With K = size of the pool, `available` is the pool in ascending order, always.

    ## Episode End
    `terminated` on goal or lava, `truncated` after 10 skills. The last info: `success`, 0.0 or 1.0.

    ## Arguments
    `action_pool`: distinct ids (default: the training skills). `num_available`: K (Table 3: 50).
    `render_mode`: None or "rgb_array". `reset(options={"layout": 7})` chooses one of 0..41.
    ValueError for a pool, K, action, layout or render_mode that does not exist.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(self, action_pool=None, num_available=NUM_AVAILABLE, render_mode=None):
        pool = split_actions()["train"] if action_pool is None else action_pool
        self.action_pool = np.sort(check_ids(pool, num_available))
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode {render_mode!r} is unknown; there is 'rgb_array'")
        self.num_available, self.render_mode = num_available, render_mode
        self.observation_space = gym.spaces.Dict(
            state=gym.spaces.Box(0, SUBGOAL, (SIZE * SIZE,), np.uint8),
            available=gym.spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
        )
        self.action_space = gym.spaces.Discrete(num_available)
        self.trace, self.over = [], True  # cells of the last skill; nothing to step yet

    def reset(self, *, seed=None, options=None):
        """Draw a layout and the skills on offer; returns (observation, {})."""
        super().reset(seed=None if seed is None else operator.index(seed))  # numpy integers, too
        drawn = self.np_random.integers(len(LAYOUTS))
        layout = operator.index((options or {}).get("layout", drawn))
        if layout not in range(len(LAYOUTS)):
            raise ValueError(f"layout is {layout}; there are 0..{len(LAYOUTS) - 1}")
        # published code: draws sets from the system's entropy; ours: from the seeded generator.
        self.available = pool = self.action_pool  # all of them: a position keeps its meaning
        if self.num_available < len(pool):
            self.available = self.np_random.choice(pool, self.num_available, replace=False)
        self.layout, self.grid = layout, LAYOUTS[layout].tolist()  # integers, without the agent
        self.trace, self.skill, self.moves = [START], None, 0
        self.subgoal_taken = self.over = False
        return self._observe(), {}

    def step(self, action):
        """Carry out one skill; returns (observation, reward, terminated, truncated, info)."""
        if self.over:
            raise gym.error.ResetNeeded("the episode is over: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action is {action!r}; there are 0..{self.num_available - 1}")
        self.skill = int(self.available[action])
        cells = walk(self.grid, self.trace[-1], self.skill)
        self.trace = [self.trace[-1], *cells]
        self.moves += len(cells)
        kinds = [self.grid[cell] for cell in cells]
        reward = 0.0
        if SUBGOAL in kinds and not self.subgoal_taken:  # Eq. 1: "for the first time"
            self.subgoal_taken = True
            reward += LAMBDA_SUBGOAL
        if success := kinds[-1] == GOAL:
            # appendix: (1 - 0.9) * N/50; published code: 1 - 0.9 * N/50; we do the latter, because
            # the printed form pays more for a longer path, against its text ("a shorter path").
            reward += 1 - LAMBDA_GOAL * self.moves / MAX_MOVES
        terminated = success or kinds[-1] == LAVA
        # published code: the limit is a true end. We report `truncated`; the learner may treat
        # both alike. It falls on the last move of a skill: 10 skills of 5 moves are 50 moves.
        truncated = not terminated and self.moves >= MAX_MOVES
        self.over = terminated or truncated
        info = {METRIC: float(success)} if self.over else {}
        return self._observe(), reward, terminated, truncated, info

    def _observe(self):
        # A.1: raw ids; the published learner normalises them, not the environment. Neither the
        # moves that are left nor whether the subgoal has been paid is part of the state.
        state = LAYOUTS[self.layout].copy()  # fresh arrays: a learner may keep them
        state[self.trace[-1]] = AGENT
        return {"state": state, "available": self.available.copy()}

    def render(self):
        """The last of `render_frames`."""
        return self.render_frames()[-1] if self.render_mode else None

    def render_frames(self) -> list[np.ndarray]:
        """Pictures of the last skill, one per move (after a reset: one); [] without render_mode."""
        if self.render_mode is None:
            return []
        if not self.trace:
            raise gym.error.ResetNeeded("call reset() before the first picture")
        return [draw_frame(self, done) for done in range(1, len(self.trace)) or [0]]


gym.register("ActionGen/GridWorld-v0", entry_point="gridworld:GridWorldEnv")


def make_vec(num_envs, action_pool, num_available=NUM_AVAILABLE, seed=0, **options) -> VectorEnv:
    """`num_envs` environments with independent streams, restarted within the step that ends one.

    `envs.reset()` without a seed goes on with these streams. ValueError: see `GridWorldEnv`.
    """
    one = functools.partial(GridWorldEnv, action_pool, num_available, **options)
    envs = SyncVectorEnv([one] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    # seed + i would let neighbouring seeds share environments; a SeedSequence's words do not.
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs


# ---- A.1 Action Observations: the play world ----


def action_observations(action_ids, num_observations=1024, modality="xy", seed=0, workers=1):
    """Record skills in an empty 80x80 grid from random cells (A.1; Table 4: 1,024 of each).

    Returns uint8 (len(action_ids), num_observations, 6, 2): the cell (x, y), 1..78, before the
    skill and after each move. E.g. UUURD from (3, 2): (3, 2) (3, 1) (3, 1) (3, 1) (4, 1) (4, 2).
    "onehot" is the same numbers: the encoder expands them to 80 + 80 zeros and ones per state.

    A skill's recordings depend on (seed, id) only. `workers` is ignored: all takes a second.
    ValueError for ids that are unknown or repeated, an unknown modality, no observations.
    """
    if modality not in MODALITIES:
        raise ValueError(f"modality {modality!r} is unknown; there are {', '.join(MODALITIES)}")
    if num_observations < 1:
        raise ValueError(f"num_observations is {num_observations}, at least 1")
    action_ids = check_ids(action_ids)
    paths = np.empty((len(action_ids), num_observations, SKILL_LENGTH + 1, 2), np.int8)
    for i, action in enumerate(action_ids):
        rng = np.random.default_rng([seed, action])
        # published code: a goal was left over on (78, 78) and cut recordings short; we have none.
        paths[i, :, 0] = rng.integers(PLAY_LOW, PLAY_HIGH + 1, (num_observations, 2))
    deltas = MOVE_DELTAS.astype(np.int8)[SKILL_MOVES[action_ids]]  # (A, 5, 2)
    for t in range(SKILL_LENGTH):
        after = paths[:, :, t] + deltas[:, None, t]  # (A, n, 2) + (A, 1, 2)
        paths[:, :, t + 1] = after.clip(PLAY_LOW, PLAY_HIGH)  # a bump at the wall: it stays
    return paths.view(np.uint8)


# ---- pictures for people (Figure 1) ----

CELL = 160  # ours: drawn 4 times larger, then averaged down: smooth edges
COLORS = {EMPTY: "#17191d", WALL: "#6f7378", GOAL: "#35b44a",
          LAVA: "#f5821f", SUBGOAL: "#2f6fe4", AGENT: "#ee2b2b"}  # fmt: skip
LINE, TRAIL, KEY, TEXT, DIM, WAVE = "#3c4046", "#8f2c2c", "#2a2d33", "#f2f2f2", "#80858c", "#a94a06"


def draw_frame(env: GridWorldEnv, done: int) -> np.ndarray:
    """Figure 1 after `done` moves of the last skill, the state beside: uint8 (420, 600, 3).

    The policy looks between skills only: in its state the agent is where the skill began.
    """
    image = Image.new("RGB", (2400, 1680), COLORS[EMPTY])
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(60)
    draw.rectangle((1444, 0, 2400, 1680), KEY)
    draw.text((1920, 256), "what the policy saw: 81 ids", TEXT, font, "mm")
    for cell, kind in enumerate(env.grid):
        column, row = divmod(cell, SIZE)
        x, y = column * CELL, row * CELL
        draw.rectangle((x, y, x + CELL, y + CELL), COLORS[kind], LINE, 4)
        for height in (48, 80, 112) if kind == LAVA else ():
            draw.line([(x + 16 + 32 * i, y + height - 8 * (-1) ** i) for i in range(5)], WAVE, 8)
        x, y = 1536 + column * 96, 416 + row * 96
        draw.rectangle((x - 48, y - 48, x + 48, y + 48), COLORS[EMPTY], LINE, 4)
        seen = AGENT if cell == env.trace[0] else kind
        draw.text((x, y), str(seen), DIM if seen in (EMPTY, WALL) else COLORS[seen], font, "mm")
    path = np.array([divmod(c, SIZE) for c in env.trace[: done + 1]]) * CELL + 80.0  # (done + 1, 2)
    draw.line(path.ravel().tolist(), TRAIL, 16, "curve")
    for x, y in path[:-1]:
        draw.ellipse((x - 20, y - 20, x + 20, y + 20), TRAIL)
    # A triangle as in Figure 1. Pillow's first one points up and turns against the clock.
    heading = int(SKILL_MOVES[env.skill, done - 1]) if done else 0
    draw.regular_polygon((*path[-1], 64), 3, -90 * (heading + 1), COLORS[AGENT], "#5c0d0d", 4)
    for t, letter in enumerate(SKILL_NAMES[env.skill] if done else " " * SKILL_LENGTH):
        x, y = 120 + 148 * t, 1560
        fill = COLORS[AGENT] if t == done - 1 else KEY  # the present move is lit
        draw.rounded_rectangle((x - 64, y - 64, x + 64, y + 64), 24, fill, LINE, 4)
        draw.text((x, y), letter, TEXT if t < done else DIM, font, "mm")
    moves = env.moves - len(env.trace) + 1 + done
    draw.text((1384, 1524), f"move {moves} / {MAX_MOVES}", TEXT, font, "rm")
    kind = env.grid[env.trace[done]]
    word = {SUBGOAL: "subgoal", GOAL: "goal reached", LAVA: "lava"}.get(kind, "")
    draw.text((1384, 1600), word, COLORS[kind], font, "rm")
    return np.array(image.reduce(4))


def draw_sheet(path: Path, pool: np.ndarray, seed: int) -> None:
    """One picture: the layouts, where skills lead, recordings of one skill of each quadrant."""
    # An inherited backend (a notebook's) that is not installed would make the import fail.
    os.environ.pop("MPLBACKEND", None)
    from matplotlib.figure import Figure  # here: training needs no pictures

    figure, labels = Figure((15, 6), layout="constrained"), action_labels()
    left, middle, right = figure.subplots(1, 3)
    palette = np.full((SUBGOAL + 1, 3), 255)  # by cell id; between the layouts (id 0) white
    palette[list(COLORS)] = [ImageColor.getrgb(color) for color in COLORS.values()]
    boards = np.pad(LAYOUTS.reshape(6, 7, SIZE, SIZE), ((0, 0), (0, 0), (1, 1), (1, 1)))
    # (6 rows, 7 columns, x, y) -> (rows, y, columns, x): one picture
    left.imshow(palette[boards.transpose(0, 3, 1, 2).reshape(6 * 11, 7 * 11)])
    left.set(title="the 42 layouts", xticks=[], yticks=[])
    for quadrant, color in QUADRANTS.items():
        ends = MOVE_DELTAS[SKILL_MOVES[labels == quadrant]].sum(1)  # (256, 2)
        cells, counts = np.unique(ends, axis=0, return_counts=True)
        middle.scatter(*cells.T, 7 * counts, color)
        skill = pool[labels[pool] == quadrant][0]
        paths = action_observations([skill], 40, seed=seed)[0]  # (40, 6, 2)
        right.plot(*paths.T, color=color)
        right.scatter(*paths[:, 0].T, 12, color, label=SKILL_NAMES[skill])
    middle.set(title="where all skills lead (area: how many)", aspect="equal", ylim=(5.5, -5.5))
    right.set(title="recordings (dot: start)", aspect="equal", xlim=(0, 79), ylim=(79, 0))
    figure.legend(loc="outside lower right", ncols=4)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    figure.savefig(temporary, format="png")
    temporary.replace(path)


def save_gif(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write frames (H, W, 3) uint8 as an endless GIF, whole or not at all."""
    images = [Image.fromarray(frame) for frame in frames]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    duration = round(1000 / fps)  # ms
    images[0].save(
        temporary, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0
    )
    temporary.replace(path)


# ---- the script ----


def best_plan(layout: int, available: Sequence[int]) -> list[int]:
    """Positions in `available` that reach the goal in the fewest moves; [] if none do."""
    grid, seen = LAYOUTS[layout].tolist(), set()
    queue = [(0, START, [])]  # (moves made, cell, plan), the fewest moves first: Dijkstra
    while queue:
        moves, cell, plan = heapq.heappop(queue)
        if grid[cell] == GOAL:
            return plan
        if grid[cell] == LAVA or cell in seen or moves >= MAX_MOVES:
            continue
        seen.add(cell)
        for position, skill in enumerate(available):
            cells = walk(grid, cell, skill)
            heapq.heappush(queue, (moves + len(cells), cells[-1], [*plan, position]))
    return []


@dataclass
class Args:
    pool: Literal["train", "valid", "test"] = "test"  # skills to draw from
    num_available: int = NUM_AVAILABLE  # skills on offer in an episode (Table 3)
    seed: int = 0  # of the split, the layout and the skills on offer
    out: Path = Path("runs/demo")  # folder for the pictures


def main(args: Args) -> None:
    """One episode planned and one at random, as text and GIF; a picture of the action set."""
    pool = split_actions(seed=args.seed)[args.pool]
    env = GridWorldEnv(pool, args.num_available, "rgb_array")
    for name in ("planned", "random"):
        env.reset(seed=args.seed)
        plan = best_plan(env.layout, env.available)  # empty where nothing leads to the goal
        if name == "random":
            plan = env.np_random.integers(args.num_available, size=MAX_SKILLS)
        frames = env.render_frames()
        for action in plan:
            _, reward, terminated, truncated, _ = env.step(action)
            frames += env.render_frames()
            end = divmod(env.trace[-1], SIZE)
            print(f"{name}: {SKILL_NAMES[env.skill]} to {end}, move {env.moves}, {reward:.3f}")
            if terminated or truncated:
                break
        frames += frames[-1:] * 5  # one second more to see the outcome
        save_gif(args.out / f"gridworld_{name}.gif", frames, env.metadata["render_fps"])
    solved = sum(bool(best_plan(layout, env.available)) for layout in range(len(LAYOUTS)))
    print(f"the {args.num_available} skills on offer solve {solved} of {len(LAYOUTS)} layouts")
    draw_sheet(args.out / "gridworld_sheet.png", pool, args.seed)
    print(f"wrote gridworld_planned.gif, gridworld_random.gif, gridworld_sheet.png to {args.out}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from None
