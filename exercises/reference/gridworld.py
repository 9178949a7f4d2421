"""Grid World with 1,024 five-move skills (appendix A.1).

An agent on a 9x9 grid crosses a river of lava (A.1: "lava wall") through its one opening and walks
to the goal. An action is a whole *skill*: five moves, each up, down, left or right. In every
episode 50 skills are available. At test time none of them was used in training: the agent has to
understand a skill from recordings of it in another, larger and empty grid.

    #########     #  wall: here always the outer ring, which only stops the agent
    #A..~...#     A  agent, always starts at (1, 1)
    #...~...#     ~  lava: a whole row or column, here the column x = 4
    #...o...#     o  the opening (the subgoal), here at y = 3
    #...~...#     G  goal, always at (7, 7)
    #...~...#     x grows to the right, y grows downwards, both 0..8
    #...~...#
    #...~..G#     e.g. skill DDRRR, then RRRDD, then DDDDD: subgoal at move 5, goal at move 12
    #########

    python gridworld.py       # two episodes as text and GIFs; a PNG of layouts and skills (5 s)
    python gridworld.py --part train --num-available 10 --seed 3

Sections have A.1's names (Reward: see `step`). [code] is what the authors' released implementation
does, mostly followed where the appendix is silent; [here] is this repository's choice, with reason.
"""

import heapq
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from PIL import Image, ImageDraw, ImageFont

# ---- constants (each with its source) ----
NUM_ACTIONS = 1024  # A.1: 4^5 sequences of 5 moves in 4 directions
SKILL_LENGTH = 5  # A.1
NUM_AVAILABLE = 50  # Table 3 "actions per episode"
MAX_SKILLS = 10  # A.1, Table 3 "max. episode length"
MAX_MOVES = 50  # A.1: 10 skills of 5 moves; N_max of Eq. 1
LAMBDA_SUBGOAL = 0.1  # Eq. 1
LAMBDA_GOAL = 0.9  # Eq. 1

# Read by the other files. In each tuple the first entry is the default.
METRIC = "success"  # 1.0 when the episode ended on the goal, else 0.0
SPLITS = ("default",)  # A.1
MODALITIES = ("xy", "onehot")  # appendix B: forms of a recording, (x, y) or one-hot vectors
VARIANTS = ("12d", "5d")  # of the engineered representations

SIZE = 9  # A.1; the outer ring is wall [code], so the agent walks on 7x7 cells
EMPTY, WALL, GOAL, LAVA, AGENT, SUBGOAL = 1, 2, 8, 9, 10, 11  # [code] (A.1: "integer ID")
RIVERS = (3, 4, 5)  # [code]: rows or columns of the lava (A.1: "randomly placed")
OPENINGS = (1, 2, 3, 4, 5, 6, 7)  # [code]: any cell of the river may be the opening
# The 80x80 grid of the recordings has a ring of wall, too [code]: the agent stands on 1..78.
PLAY_LOW = 1
PLAY_HIGH = 78

# ---- A.1 Actions and action set split, B: what is known about the skills ----
MOVE_NAMES = "RDLU"  # [code]: right, down, left, up are the moves 0..3
MOVE_DELTAS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])  # (4, 2): (dx, dy)

# A skill's id written in base 4 is its moves, the first move being the lowest digit [code]:
# 0 = RRRRR, 1 = DRRRR, 340 = RDDDD, 1023 = UUUUU.
SKILL_MOVES = (np.arange(NUM_ACTIONS)[:, None] // (4 ** np.arange(SKILL_LENGTH))) % 4  # (1024, 5)
SKILL_NAMES = ["".join(MOVE_NAMES[move] for move in moves) for moves in SKILL_MOVES]


def action_labels() -> np.ndarray:
    """The quadrant each skill leads to (the colours of Fig. 4): str (1024,), 256 of each."""
    # No skill ends where it began: dx + dy is odd. Ties [code]: straight up counts as upper left,
    # straight left as lower left, straight down as lower right, straight right as upper right.
    east, south = MOVE_DELTAS[SKILL_MOVES].sum(1).T  # (1024,) each: net displacement
    labels = np.full(NUM_ACTIONS, "upper right")
    labels[(south < 0) & (east <= 0)] = "upper left"
    labels[(south >= 0) & (east < 0)] = "lower left"
    labels[(south > 0) & (east >= 0)] = "lower right"
    return labels


def engineered_representations(variant: str = "12d") -> np.ndarray:
    """Ground-truth features of all skills (B), float32 (1024, d).

    "12d": in cells, y downwards: net (dx, dy) of the skill, then (dx, dy) of each of its moves.
    "5d": the five moves; right, down, left, up as -1, -1/3, 1/3, 1. ValueError for others.
    """
    # appendix: 5-d; [code] 12-d with all signs flipped, which is the same to a learner; [here] 12-d
    # by default, not flipped: the paper's result was reached with 12-d, and the numbers of 5-d
    # suggest an order of the moves that does not exist.
    if variant not in VARIANTS:
        raise ValueError(f"variant {variant!r} is unknown; there are {VARIANTS}")
    if variant == "5d":
        return (SKILL_MOVES * 2 / 3 - 1).astype(np.float32)
    deltas = MOVE_DELTAS[SKILL_MOVES]  # (1024, 5, 2)
    table = np.column_stack([deltas.sum(1), deltas.reshape(-1, 10)])  # (1024, 2 + 10)
    return table.astype(np.float32)


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Random ids (A.1), sorted: 512 "train", 256 "valid", 256 "test". ValueError: other splits."""
    if split not in SPLITS:
        raise ValueError(f"split {split!r} is unknown; Grid World has only 'default'")
    order = np.random.default_rng(seed).permutation(NUM_ACTIONS)
    train, valid, test = np.split(order, [512, 768])
    return dict(train=np.sort(train), valid=np.sort(valid), test=np.sort(test))


def check_ids(ids: Sequence[int], num_available: int = 1) -> np.ndarray:
    """`ids`, sorted, int64 (m,); ValueError unless distinct, known, and m >= num_available >= 1."""
    ids = np.asarray(ids)
    if ids.ndim != 1 or ids.dtype.kind not in "iu" or len(np.unique(ids)) < len(ids):
        raise ValueError("action ids must be a list of distinct integers")
    if len(ids) == 0 or ids.min() < 0 or ids.max() >= NUM_ACTIONS:
        raise ValueError(f"action ids must lie in 0..{NUM_ACTIONS - 1}")
    if not 1 <= num_available <= len(ids):
        raise ValueError(f"{num_available} available actions out of a pool of {len(ids)}")
    return np.sort(ids).astype(np.int64)


# ---- A.1 State: the grids; what a skill does in them ----
# One grid for each river that is a column and each opening in it, indexed [x, y], without agent.
# Start and goal lie outside of every river, so that each layout can be solved.
columns = []
for river in RIVERS:
    for opening in OPENINGS:
        grid = np.full((SIZE, SIZE), WALL, np.uint8)
        grid[1:-1, 1:-1] = EMPTY
        grid[7, 7] = GOAL  # A.1: bottom right corner
        grid[river, 1:-1] = LAVA
        grid[river, opening] = SUBGOAL
        columns.append(grid)
rows = [grid.T for grid in columns]  # the same with x and y exchanged
LAYOUTS = np.array(columns + rows).reshape(42, SIZE * SIZE)  # (42, 9, 9) -> (42, 81)

# A cell (x, y) is one number, x * 9 + y [code]: R, D, L, U add +9, +1, -9, -1 to it.
START = 1 * SIZE + 1  # A.1: top left, the cell (1, 1)
SKILL_OFFSETS = (MOVE_DELTAS @ (SIZE, 1))[SKILL_MOVES].tolist()  # 1024 lists of 5 such numbers


def walk(grid: list[int], cell: int, skill: int) -> list[int]:
    """The cells after each move of `skill` from `cell`; fewer than five if the episode ends."""
    # E.g. UUURD from (1, 2), cell 11: 10, 10, 10, 19, 20. Its second and third up meet the wall.
    cells = []
    for offset in SKILL_OFFSETS[skill]:
        # A.1: at the wall the agent stays where it is. This "null interaction" counts as a move.
        if grid[cell + offset] != WALL:
            cell += offset
        cells.append(cell)
        # A.1: lava ends the game even in the middle of a skill; [code] the goal does, too.
        if grid[cell] in (GOAL, LAVA):
            break
    return cells


# ---- A.1 the environment ----
class GridWorldEnv(gym.Env):
    """Lava crossing with five-move skills (appendix A.1).

    One row or column (3, 4 or 5) is lava with one opening, the subgoal. A move into a wall does
    nothing, but counts.

    ## Action Space
    `Discrete(K)`, K = `num_available`: action k carries out the skill `available[k]`.

    ## Observation Space
    `Dict(state=Box(0, 11, (81,), uint8), available=Box(0, 1023, (K,), int64))`. `state[x * 9 + y]`
    is the id of the cell (x, y): 1 empty, 2 wall, 8 goal, 9 lava, 10 agent (hides what it stands
    on), 11 subgoal. `available` are the ids of the K skills of this episode.

    ## Rewards
    0.1 for entering the subgoal the first time, 1 - 0.9 N / 50 for entering the goal with move N
    (Eq. 1, see `step`), else 0. The best return, with suitable skills and gamma = 1, is 0.1 + 1 -
    0.9 * 12 / 50 = 0.884 in every layout.

    ## Starting State
    Agent at (1, 1), goal at (7, 7), one of 42 layouts, K skills drawn from `action_pool` without
    replacement. With K = size of the pool, `available` is the pool in ascending order, always.

    ## Episode End
    `terminated` on goal or lava, `truncated` after 10 skills. The last info: `success`, 0.0 or 1.0.

    ## Arguments
    `action_pool`: ids that `available` is drawn from (default: training skills of split seed 0).
    `num_available`: K (Table 3: 50). `render_mode`: None or "rgb_array".
    `reset(options={"layout": n})` chooses the layout: n = 7 * (river - 3) +
    opening - 1, and 21 more when the river is a row. ValueError for an unknown layout.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(self, action_pool=None, num_available=NUM_AVAILABLE, render_mode=None):
        if action_pool is None:
            action_pool = split_actions()["train"]
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode {render_mode!r} is unknown; there is 'rgb_array'")
        self.action_pool = check_ids(action_pool, num_available)
        self.num_available = num_available
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Dict(
            state=gym.spaces.Box(0, SUBGOAL, (SIZE * SIZE,), np.uint8),
            available=gym.spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
        )
        self.action_space = gym.spaces.Discrete(num_available)
        self.over = True  # so `step` is refused before the first reset

    def reset(self, *, seed=None, options=None):
        """Draw a layout and the available skills; returns (observation, {})."""
        super().reset(seed=seed)
        # A.1: "a randomly placed lava wall". It is drawn even when `options` name a layout, so that
        # a seed draws the same skills whatever the layout.
        drawn = self.np_random.integers(len(LAYOUTS))
        layout = (options or {}).get("layout", drawn)
        if layout not in range(len(LAYOUTS)):
            raise ValueError(f"layout is {layout}; there are 0..{len(LAYOUTS) - 1}")
        self.layout = int(layout)
        self.grid = LAYOUTS[self.layout].tolist()  # plain integers, without the agent

        # Every episode has its own random subset of the pool: the paper's *subsampling*. [code]
        # draws it from the system's entropy; [here] the seeded generator, so a run can be repeated.
        # A whole pool keeps its order, for a policy with one output per action. Else the order is
        # random, too, which is no matter for a policy that scores each skill by itself.
        pool = self.action_pool
        self.available = pool
        if self.num_available < len(pool):
            self.available = self.np_random.choice(pool, self.num_available, replace=False)

        self.trace = [START]  # the cells of this episode: its start, and one after every move
        self.skill = None  # id of the last skill
        self.skill_start = 0  # index in `trace` of the cell where the last skill began
        self.subgoal_taken = False
        self.over = False
        return self._observe(), {}

    def step(self, action):
        """Carry out one skill; returns (observation, reward, terminated, truncated, info)."""
        if self.over:
            raise gym.error.ResetNeeded("the episode is over: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action is {action!r}; there are 0..{self.num_available - 1}")

        # Walk. A move into a wall counts; those that goal or lava cut off do not.
        self.skill = int(self.available[action])
        self.skill_start = len(self.trace) - 1
        cells = walk(self.grid, self.trace[-1], self.skill)
        self.trace += cells
        moves = len(self.trace) - 1  # N_total of Eq. 1

        # Reward (A.1, Eq. 1): the subgoal "for the first time" only, and the goal.
        entered = [self.grid[cell] for cell in cells]
        reward = 0.0
        if SUBGOAL in entered and not self.subgoal_taken:
            self.subgoal_taken = True
            reward += LAMBDA_SUBGOAL
        success = entered[-1] == GOAL
        if success:
            # appendix: (1 - 0.9) * N/50; [code] 1 - 0.9 * N/50; [here] the latter, because the
            # printed form pays more for a longer path, against its text ("a shorter path").
            reward += 1 - LAMBDA_GOAL * moves / MAX_MOVES

        # End (A.1): goal, lava, or the limit. [here] the limit is `truncated`, gymnasium's word for
        # an end that only a clock makes. Learning ignores the difference: [code] and
        # ppo_actiongen.py bootstrap after neither. At the limit exactly ten skills were used.
        terminated = success or entered[-1] == LAVA
        truncated = not terminated and moves >= MAX_MOVES
        self.over = terminated or truncated
        info = {METRIC: float(success)} if self.over else {}
        return self._observe(), reward, terminated, truncated, info

    def _observe(self):
        # State (A.1): the ids as they are; the learner scales them. Neither the moves that are left
        # nor whether the subgoal has been paid can be seen in it. Both arrays are copies.
        state = LAYOUTS[self.layout].copy()
        state[self.trace[-1]] = AGENT
        return {"state": state, "available": self.available.copy()}

    def render(self):
        """A picture of the episode after its last move, or None without a render_mode."""
        return draw_frame(self, len(self.trace) - 1) if self.render_mode else None

    def render_frames(self) -> list[np.ndarray]:
        """Pictures of the last skill: its start, then one per move; [] without a render_mode."""
        if self.render_mode is None:
            return []
        return [draw_frame(self, moves) for moves in range(self.skill_start, len(self.trace))]


gym.register("ActionGen/GridWorld-v0", entry_point="gridworld:GridWorldEnv")


def make_vec(num_envs, action_pool=None, num_available=NUM_AVAILABLE, seed=0, **options):
    """A SyncVectorEnv of GridWorldEnv(action_pool, num_available, **options), seeded already.

    SAME_STEP: the step that ends an episode returns the first observation of the next one, and
    infos["final_info"] holds `success`. Call `envs.reset()` for the first observations; a seed
    given to it would replace `seed`. ValueError as in GridWorldEnv.
    """

    def make_env():
        return GridWorldEnv(action_pool, num_available, **options)

    envs = SyncVectorEnv([make_env] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    # Gymnasium would seed environment i with seed + i, so runs with seeds 0 and 1 would share all
    # environments but one. SeedSequence gives unrelated seeds.
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs


# ---- A.1 Action Observations: the world of the recordings ----
# hvae.py scales a first state to (cell - centre) / half_width, about -1..1. A later one it takes as
# the difference from the first, or from the one before, divided by `step`: in cells [here]. The
# decoder's standard deviation is at least 0.135 [code]. A move of 1 cell is 7 times that; scaled
# like a first state it would be 1 / 39.5 = 0.025, too small to matter.
UNITS = dict(centre=39.5, half_width=39.5, step=1.0)


def action_observations(action_ids, num_observations=1024, modality="xy", seed=0, workers=1):
    """Record skills in an empty 80x80 grid from random cells (A.1; Table 4: 1,024 of each).

    Returns uint8 (len(action_ids), num_observations, 6, 2): the cell (x, y), 1..78, before the
    skill and after each move. E.g. UUURD from (3, 2): (3, 2) (3, 1) (3, 1) (3, 1) (4, 1) (4, 2).
    "onehot" is the same numbers: hvae.py expands them to 80 + 80 zeros and ones per state.
    A skill's recordings depend on (seed, id) only. `workers` is for slower environments; here it is
    ignored. ValueError for an unknown modality and for ids that are unknown or repeated.
    """
    if modality not in MODALITIES:
        raise ValueError(f"modality {modality!r} is unknown; there are {MODALITIES}")
    check_ids(action_ids)
    action_ids = np.asarray(action_ids)  # in the order of the caller

    # A start for every recording, anywhere. In [code] a goal was left over at (78, 78), which cut
    # recordings short; [here] there is none, because A.1 says "no obstacles".
    paths = np.empty((len(action_ids), num_observations, SKILL_LENGTH + 1, 2), np.int8)
    for i, action in enumerate(action_ids):
        rng = np.random.default_rng([seed, action])
        paths[i, :, 0] = rng.integers(PLAY_LOW, PLAY_HIGH + 1, (num_observations, 2))

    # All recordings move at once, in int8, since a move can be -1. Clipping keeps an agent that
    # would walk into the wall where it is.
    deltas = MOVE_DELTAS.astype(np.int8)[SKILL_MOVES[action_ids]]  # (A, 5, 2)
    for t in range(SKILL_LENGTH):
        after = paths[:, :, t] + deltas[:, None, t]  # (A, n, 2) + (A, 1, 2)
        paths[:, :, t + 1] = after.clip(PLAY_LOW, PLAY_HIGH)
    return paths.view(np.uint8)  # the same bytes (all are 1..78); other recordings are uint8, too


# ---- pictures for people (Figure 1) ----
COLORS = {
    EMPTY: "#17191d",
    WALL: "#6f7378",
    GOAL: "#35b44a",
    LAVA: "#f5821f",
    SUBGOAL: "#2f6fe4",
    AGENT: "#ee2b2b",
}
QUADRANTS = {  # B, Figure 4: upper right is red
    "upper right": "tab:red",
    "upper left": "tab:green",
    "lower left": "tab:blue",
    "lower right": "tab:orange",
}


def draw_frame(env: GridWorldEnv, moves: int) -> np.ndarray:
    """As in Figure 1, after `moves` moves; beside it what the policy saw: uint8 (420, 600, 3)."""
    # Drawn four times too large and averaged down, for smooth edges: a grid cell has 160 pixels.
    image = Image.new("RGB", (2400, 1680), COLORS[EMPTY])
    draw = ImageDraw.Draw(image)
    draw.font = ImageFont.load_default(60)

    # Left: the grid. Right: the ids the policy saw, with the agent where the skill began.
    draw.rectangle((1444, 0, 2400, 1680), "#f4f4f2")
    draw.text((1920, 256), "what the policy saw: 81 ids", COLORS[EMPTY], anchor="mm")
    for cell, kind in enumerate(env.grid):
        x, y = divmod(cell, SIZE)
        corners = (160 * x, 160 * y, 160 * x + 160, 160 * y + 160)
        draw.rectangle(corners, COLORS[kind], "#3c4046", 4)
        seen = AGENT if cell == env.trace[env.skill_start] else kind
        draw.text((1536 + 96 * x, 416 + 96 * y), str(seen), COLORS[seen], anchor="mm")

    # The way so far, and the agent. The triangle of Figure 1 shows no heading: moves are absolute.
    path = []
    for cell in env.trace[: moves + 1]:
        x, y = divmod(cell, SIZE)
        path.append((160 * x + 80, 160 * y + 80))
    draw.line(path, "#8f2c2c", 24, "curve")
    x, y = path[-1]
    draw.regular_polygon((x, y, 64), 3, 0, COLORS[AGENT], "#5c0d0d", 4)

    # Below: the skill, its moves still to come in grey, and the moves of the episode so far.
    if env.skill is not None:
        done = moves - env.skill_start
        for t, letter in enumerate(SKILL_NAMES[env.skill]):
            color = "white" if t < done else "gray"
            draw.text((120 + 100 * t, 1560), letter, color, anchor="mm")
    draw.text((1384, 1560), f"move {moves} / {MAX_MOVES}", "white", anchor="rm")
    return np.array(image.reduce(4))


def draw_sheet(path: Path, skills: np.ndarray, seed: int) -> None:
    """A PNG: the layouts, where skills lead, recordings of one of `skills` per quadrant."""
    # Imported here: training needs no pictures. A notebook sets MPLBACKEND, perhaps to a backend
    # that is not installed here, and the import would fail.
    os.environ.pop("MPLBACKEND", None)
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    figure = Figure((15, 6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    # Six rows of seven layouts, in one picture.
    boards = LAYOUTS.reshape(6, 7, SIZE, SIZE).transpose(0, 3, 1, 2)  # (rows, y, columns, x)
    palette = ListedColormap([COLORS.get(kind, "white") for kind in range(SUBGOAL + 1)])
    left.imshow(boards.reshape(6 * SIZE, 7 * SIZE), palette, vmin=0, vmax=SUBGOAL)
    left.set(title="the 42 layouts", xticks=[], yticks=[])
    labels = action_labels()
    for quadrant, color in QUADRANTS.items():
        ends = MOVE_DELTAS[SKILL_MOVES[labels == quadrant]].sum(1)  # (256, 2)
        places, counts = np.unique(ends, axis=0, return_counts=True)  # (places, 2), (places,)
        middle.scatter(*places.T, 7 * counts, color)
        skill = skills[labels[skills] == quadrant][0]
        paths = action_observations([skill], 40, seed=seed)[0]  # (40, 6, 2)
        right.plot(*paths.T, color=color)  # x and y, (6, 40) each: a line per recording
        right.scatter(*paths[:, 0].T, 12, color, label=SKILL_NAMES[skill])
    middle.set(title="where all skills lead (area: how many)", aspect="equal", ylim=(5.5, -5.5))
    right.set(title="recordings (dot: start)", aspect="equal", xlim=(0, 79), ylim=(79, 0))
    figure.legend(loc="outside lower right", ncols=4)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def save_gif(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write pictures (h, w, 3) uint8 as a GIF that rests on its last one; all of it or no file."""
    pictures = [Image.fromarray(frame) for frame in frames]
    durations = [round(1000 / fps)] * len(pictures)  # ms
    durations[-1] = 2000  # so that the end can be seen
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    # If this fails, on a full disk for instance, Pillow removes what it has begun.
    pictures[0].save(
        path, "gif", append_images=pictures[1:], save_all=True, duration=durations, loop=0
    )


# ---- the script ----
def best_plan(layout: int, available: Sequence[int]) -> list[int]:
    """Positions in `available` that reach the goal in the fewest moves; [] if none do."""
    # Dijkstra's search: always go on from the cell that was reached in the fewest moves.
    grid = LAYOUTS[layout].tolist()
    visited = set()
    queue = [(0, START, [])]  # (moves made, cell, plan that leads there)
    while queue:
        moves, cell, plan = heapq.heappop(queue)
        if grid[cell] == GOAL:
            return plan
        if grid[cell] == LAVA or cell in visited or moves >= MAX_MOVES:
            continue
        visited.add(cell)
        for position, skill in enumerate(available):
            cells = walk(grid, cell, skill)
            heapq.heappush(queue, (moves + len(cells), cells[-1], [*plan, position]))
    return []


def play(env: GridWorldEnv, plan: Sequence[int]) -> list[np.ndarray]:
    """Carry out `plan` until the episode ends, tell it as text, and return its pictures."""
    frames = env.render_frames()
    for action in plan:
        _, reward, terminated, truncated, _ = env.step(action)
        frames += env.render_frames()
        cell = divmod(env.trace[-1], SIZE)
        name = SKILL_NAMES[env.skill]
        print(f"    {name} to {cell}, move {len(env.trace) - 1}, reward {reward:.3f}")
        if terminated or truncated:
            break
    return frames


@dataclass
class Args:
    part: Literal["train", "valid", "test"] = "test"  # part of the split that skills come from
    num_available: int = NUM_AVAILABLE  # skills that are available in an episode (Table 3)
    seed: int = 0  # of the split, the layout and the available skills, 0 or more
    out: Path = Path("runs/demo")  # folder for the pictures


def main(args: Args) -> None:
    """One episode planned and one at random, as text and GIF; a picture of the action set."""
    try:
        skills = split_actions(seed=args.seed)[args.part]
        env = GridWorldEnv(skills, args.num_available, "rgb_array")
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    fps = env.metadata["render_fps"]
    # The plan is made by a search that knows the grid and what skills do.
    print("planned:")
    env.reset(seed=args.seed)
    plan = best_plan(env.layout, env.available)
    if not plan:
        print("    none: the available skills do not lead to the goal")
    save_gif(args.out / "gridworld_planned.gif", play(env, plan), fps)

    print("random:")
    env.reset(seed=args.seed)  # the same layout and the same skills again
    plan = env.np_random.integers(args.num_available, size=MAX_SKILLS)
    save_gif(args.out / "gridworld_random.gif", play(env, plan), fps)
    draw_sheet(args.out / "gridworld_sheet.png", skills, args.seed)
    print(f"wrote gridworld_planned.gif, gridworld_random.gif, gridworld_sheet.png to {args.out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
