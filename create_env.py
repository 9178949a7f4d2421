"""CREATE, the Chain REAction Tool Environment (appendix A.3, B, C.1, C.3 and Table 1).

A two-dimensional physics puzzle. Balls fall. Every 40 physics steps the agent picks one of the
available tools and a place for it, so that the red target ball reaches the green goal. There are
twelve tasks and 2,111 tools (one, the no-op, does nothing), and 6,248 more for the Full Split and
the analyses. What a tool does is told by a probe ball that is launched at it (action observations).

In five of the tasks the target rests, and a second, blue ball, the *marker*, is there to knock it.
There the authors' code counts the goal only from the *target hit* on: the target has moved over
3.56 units from its start, whatever moved it (obstacle, cannon: the marker must have touched it).

    python create_env.py --task push                # a GIF of the best of 400 random episodes
    python create_env.py --play --tools Fan Funnel  # place tools of these classes by mouse
    python create_env.py --sheet tasks              # Figure 7; others: tools, probe

Paper map
    A.3 actions              KINDS, TOOLS           A.3 state        CreateEnv._observe(), draw()
    A.3 splits, Table 1      split_actions()        A.3 Eq. 3        CreateEnv._pay()
    A.3 action observations  action_observations()  B (labels)       action_labels()
    C.1, Figure 7            TASKS                  C.3              subgoal_reward=False

[code] marks the authors' released implementation, used where the appendix is silent; [here] marks a
choice of this repository, with its reason. Where the two sources differ, a comment has "appendix:",
"[code]" and, after "[here]", which of them is followed.

Units: the world is a square of 84 x 84 units, one unit per pixel of the observation, x to the
right, y up, origin in the lower left corner. "norm" means agent coordinates in [-1, 1]:
unit = 42 * (norm + 1). Angles are degrees counter-clockwise in the tables, radians in the physics.

A task of your own is one more entry of TASKS, for instance right after the table:

    TASKS["gap"] = Task(
        target=ball("Target", -0.6, 0.6), goal=star(0.7, -0.1),
        items=(line(-0.5, 0.1, 34), line(0.7, -0.2, 20)),  # x, y (norm), length (units)
        shifts={"target": (0.1, 0.0)},  # at every reset its x moves by U(-0.1, 0.1), its y stays
    )

A tool class of your own is an entry of OWN_KINDS. Its tools get the ids after all others:

    OWN_KINDS = {"Octagon": Kind("polygon", ORANGE, sides=8, turn=45, vary=SOLIDS)}

Every split divides these, too (see `split_actions`), and no other tool changes its part; but
`engineered_representations` gets a column more and other standardised numbers. What a class does to
a ball is a contact rule (`make_space`). If a rule raises, pymunk prints the exception and goes on.
"""

import multiprocessing
import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from math import ceil, cos, dist, pi, radians, sin, sqrt
from pathlib import Path
from typing import Literal, NamedTuple

import gymnasium as gym
import numpy as np
import pymunk
import tyro
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from PIL import Image, ImageDraw, ImageFont
from pymunk import Vec2d
from tqdm import tqdm

WORLD = 84.0  # A.3: the screen is 84 x 84; [code] physics units are its pixels
GRAVITY = (0.0, -2.0)  # [code] units/s^2
DT = 1 / 30  # [code] seconds per physics step
SUBSTEPS = 40  # A.3 "acts every 40 physics simulation steps"
SLEEP_TIME = 0.3  # [code] s: pymunk leaves out a ball at rest this long, until it is hit
MAX_ACTIONS = 30  # A.3 and Table 3 "max. episode length"
NUM_AVAILABLE = 50  # Table 3 "actions per episode"; the no-op is one of them
NUM_FRAMES = 3  # A.3 "past 3 frames are stacked channel-wise"

LAMBDA_ALIVE = 0.01  # Eq. 3
LAMBDA_GOAL = 10.0  # Eq. 3
LAMBDA_SUBGOAL = 2.0  # Eq. 3
LAMBDA_TARGET_HIT = 1.0  # Eq. 3; 2 in obstacle [code]
LAMBDA_INVALID = -0.01  # Eq. 3
LAMBDA_OVERLAP = -0.01  # Eq. 3

MIN_TOOL_GAP = 0.3  # [code] norm: tool centres this close "overlap"
# A.3 "no moving objects" [code]: an action is still if at its end no centre is faster than
# STILL_SPEED. The second still action ends the episode, even if things moved in between.
STILL_SPEED = 0.05  # units/s
STILL_ACTIONS = 2
HIT_DISTANCE = 0.03  # [code] share of the screen's diagonal, 3.56 units: the target hit
PICTURE_EVERY = 8  # [here] physics steps between colour pictures: 5 pictures per action

BALL_RADIUS = 4.0  # [code] units: marker, goal and probe ball, and the target in most tasks
BALL_MASS = 10.0  # [code]
PLANK_MASS = 10.0  # [code] of levers and see-saws
PLANK_MOMENT = 10_000.0  # [code] a rod of 20 units would have 333, so planks turn slowly
LADDER_LEAN = 4.0  # [code] factor on the sideways speed of a ball on a ladder: it drifts off
VESSEL_ELASTICITY = 0.5  # [code] of all funnels and buckets; not in engineered_representations

METRIC = "success"  # the goal was reached in the episode (0 or 1)
MODALITIES = ("state", "xy", "video")  # the first is the default; see action_observations
SPLITS = ("default", "random", "full", "analysis")  # of `split_actions`, the default first
NO_OP = 0  # id of the no-operation action


# ---- A.3 actions: the tools ----

# Collision types: when two objects touch, the rule of their two types acts (`make_space`). Level
# balls and loose boxes are MOVING, planks turn, and all else is fixed, the tools Ball and Bouncy
# Ball too. Balls pass through SENSORS: there is no bounce, only the rule acts.
PLAIN, MOVING, PLANK, FUNNEL, BUCKET, GOAL, CANNON, FAN, BELT, LADDER = range(10)
SENSORS = (GOAL, CANNON, FAN, BELT, LADDER)


class Tool(NamedTuple):
    """One tool, or one object of a level. What its class does not use keeps its default."""

    kind: str  # its class, a key of KINDS
    elasticity: float = 0.0
    angle: float = 0.0  # degrees
    size: float = 0.0  # units: length of segments and planks, side of boxes, radius of others
    damping: float = 0.0  # of planks: 1.05 takes 5 % of a ball's speed at every step; <= 1: none
    max_angle: float = 0.0  # degrees: see-saws turn by so much to both sides
    mass: float = 0.0  # of balls and boxes; of the weight on one end of a see-saw
    left_up: bool = False  # True: a see-saw's left end starts up, the weight sits on the right one
    force: float = 0.0  # impulse of a cannon, force of a fan
    speed: float = 0.0  # units/s, of belts and ladders
    friction: float = 1.0  # Coulomb friction; a contact has the product of both objects'


class Kind(NamedTuple):
    """Everything that holds for one class of tools, or of level objects."""

    shape: str  # how it is built and drawn: "disc", "segment", "polygon" or "box"
    colour: str  # as people see it; the policy sees the grey that Pillow makes of it
    contact: int = PLAIN
    sides: int = 0  # of polygons
    radius: float = 1.0  # units, of segments: half their width ([code]: 0 or 1)
    # Degrees after which the shape repeats: the angles of tools stay below. For see-saws a bound
    # on `max_angle`: [code] 60 with a weight, 90 without.
    turn: int = 360
    # The tools of the class: the values of each parameter. The first parameter varies slowest from
    # id to id. Level objects have none.
    vary: dict[str, Sequence] = {}


# The parameters of the tools [code]. A.3: angles are 15 degrees apart.
COARSE_STEP = 15
FINE_STEP = 3  # A.3: "tools generated at 3 degree angle differences for analysis experiments"
FIRST_LIMIT = 5  # degrees: the limits of see-saws are 5, 20, 35, ...
ANGLES = range(0, 360, COARSE_STEP)
LIMITS = range(FIRST_LIMIT, 90, COARSE_STEP)
SOFT = (0.1, 0.3, 0.5)  # elasticities
BOUNCY = (0.8, 1.0, 1.2)
LENGTHS = (6, 10, 14, 18, 22)
PLANK_LENGTHS = (12, 14, 16, 18, 20)
# [code] Ramps have a damping of 1, which does nothing but show in engineered_representations.
RAMPS = {"elasticity": SOFT, "angle": ANGLES, "size": LENGTHS, "damping": (1.0,)}
TRAMPOLINES = {"elasticity": BOUNCY, "angle": ANGLES, "size": LENGTHS}
SOLIDS = {"angle": ANGLES, "elasticity": SOFT, "size": range(3, 10)}
BOUNCERS = {"angle": ANGLES, "elasticity": BOUNCY, "size": range(3, 10)}
# A corner points to the angle. 45 is left out, a flat square: [code] has it, but in no split.
NOT_FLAT = {"angle": (0, 15, 30, 60, 75)}
# Planks turn on a pivot: levers freely, hinged see-saws up to a limit, see-saws too, but with a
# weight on one end. What A.3 calls friction is their damping; Coulomb friction is 0 [code].
HINGED = {"size": PLANK_LENGTHS, "max_angle": LIMITS, "damping": (1.0, 1.05, 1.1), "friction": (0,)}
WEIGHTED = {"size": PLANK_LENGTHS, "max_angle": LIMITS, "left_up": (True, False)}
WEIGHTED |= {"mass": (2, 6, 10, 14), "damping": (1.0,), "friction": (0,)}
DAMPINGS = [round(1 + k / 100, 2) for k in range(11)]
LEVERS = {"size": (6, 12, 18, 24, 30), "damping": DAMPINGS, "friction": (0,)}
CANNONS = {"angle": ANGLES, "force": range(60, 121, 10)}
FANS = {"angle": ANGLES, "force": range(30, 121, 15)}
VESSELS = {"angle": ANGLES, "size": (3, 5, 7, 9, 11)}
BALLS = {"elasticity": (0.1, 0.2, 0.3, 0.4, 0.5), "size": (3, 5, 7, 9), "friction": (0,)}
BOUNCY_BALLS = {"elasticity": (0.8, 0.9, 1.0, 1.1, 1.2), "size": (3, 5, 7, 9), "friction": (0,)}
BELTS = {"size": range(6, 25, 2), "speed": (1, 2, 3, 4, 5, 6, -1, -2, -3, -4, -5, -6)}

# Colours whose greys (0.299 R + 0.587 G + 0.114 B) are those that [code] shows to the policy. Its
# pictures are mirrored left to right, and some are image files; [here] flat shapes, not mirrored.
ORANGE = "#fa8535"
BLUE = "#086788"
WOOD = "#fa9149"
GREEN = "#7cfd2e"
STEEL = "#4682b4"

# fmt: off
KINDS = {
    # Never placed in a game. For the probe ball a disc of NO_OP_RADIUS, a sensor: only felt.
    "No-op": Kind("disc", GREEN, GOAL),
    # The tools in the order of their ids, which saved representations and runs rely on. Down to the
    # bucket they are those of the Default Split.
    "Ramp": Kind("segment", ORANGE, turn=180, vary=RAMPS),
    "Trampoline": Kind("segment", "#47659f", turn=180, vary=TRAMPOLINES),
    "Triangle": Kind("polygon", ORANGE, sides=3, turn=120, vary=SOLIDS),
    "Bouncy Triangle": Kind("polygon", BLUE, sides=3, turn=120, vary=BOUNCERS),
    "Square": Kind("polygon", ORANGE, sides=4, turn=90, vary=SOLIDS | NOT_FLAT),
    "Bouncy Square": Kind("polygon", BLUE, sides=4, turn=90, vary=BOUNCERS | NOT_FLAT),
    "Pentagon": Kind("polygon", ORANGE, sides=5, turn=72, vary=SOLIDS),
    "Bouncy Pentagon": Kind("polygon", BLUE, sides=5, turn=72, vary=BOUNCERS),
    "Hexagon": Kind("polygon", ORANGE, sides=6, turn=60, vary=SOLIDS),
    "Bouncy Hexagon": Kind("polygon", BLUE, sides=6, turn=60, vary=BOUNCERS),
    "Hinged See-saw": Kind("segment", WOOD, PLANK, radius=0, turn=90, vary=HINGED),
    "See-saw": Kind("segment", WOOD, PLANK, radius=0, turn=60, vary=WEIGHTED),
    "Cannon": Kind("box", "#c7463b", CANNON, vary=CANNONS),
    "Fan": Kind("box", "#3f85ad", FAN, vary=FANS),
    "Funnel": Kind("polygon", "#8793a8", FUNNEL, sides=3, vary=VESSELS),
    "Bucket": Kind("polygon", "#cb782a", BUCKET, sides=4, vary=VESSELS),
    "Ball": Kind("disc", ORANGE, vary=BALLS),
    "Bouncy Ball": Kind("disc", BLUE, vary=BOUNCY_BALLS),
    "Lever": Kind("segment", WOOD, PLANK, radius=0, vary=LEVERS),
    "Conveyor Belt": Kind("segment", "#737696", BELT, vary=BELTS),
    # Level objects
    "Target": Kind("disc", "#f45b69", MOVING),
    "Basketball": Kind("disc", "#da6a26", MOVING),
    "Marker": Kind("disc", "#79addc", MOVING),
    "Goal ball": Kind("disc", GREEN, MOVING),
    "Heavy ball": Kind("disc", "#000000", MOVING),
    "Box": Kind("box", "#a87b4c", MOVING),
    "Level see-saw": Kind("segment", WOOD, PLANK, radius=0),
    "Goal star": Kind("polygon", GREEN, GOAL, sides=5),
    "Basket": Kind("box", "#f2a98c", GOAL),
    "Subgoal": Kind("disc", "#d3feb9", GOAL),
    "Thin line": Kind("segment", STEEL, radius=0),
    "Line": Kind("segment", STEEL),
    "Boundary": Kind("segment", "#b0c4de"),
    "Ladder": Kind("segment", "#cc9a64", LADDER),
}
OWN_KINDS = {}  # tool classes of your own, see the docstring

# Table 1: the classes of the Full Split. See-saws are of two kinds, with and without a weight.
TABLE_1_TRAIN = (
    "Ramp", "Trampoline", "Ball", "Bouncy Ball", "Hinged See-saw", "See-saw", "Cannon", "Bucket")
TABLE_1_TEST = ("Triangle", "Bouncy Triangle", "Lever", "Fan", "Conveyor Belt", "Funnel")
# fmt: on
TABLE_1 = TABLE_1_TRAIN + TABLE_1_TEST

# Your own classes join after the paper's, so that no id of the paper's tools changes.
PAPER_KINDS = [name for name, kind in KINDS.items() if kind.vary]
KINDS |= OWN_KINDS
# [code] The classes of the analyses: those of Table 1 that have angles or limits.
ANGULAR = ("angle", "max_angle")
FINE_KINDS = [name for name in PAPER_KINDS if name in TABLE_1 and KINDS[name].vary.keys() & ANGULAR]


def _tools_of(name: str, step: int = COARSE_STEP) -> list[Tool]:
    """All tools of one class, their angles `step` degrees apart."""
    # appendix: no two tools within 15 degrees; [code] has pentagons at 0 and 60, 12 apart as they
    # repeat after 72; [here] as [code], because the 2,111 need them.
    kind = KINDS[name]
    choices = dict(kind.vary)
    for parameter in kind.vary.keys() & ANGULAR:
        values = kind.vary[parameter]
        if step == FINE_STEP:  # the same range in smaller steps (all of these classes have ranges)
            values = range(values.start, values.stop, step)
        choices[parameter] = [value for value in values if value < kind.turn]
    rows = product(*choices.values())
    return [Tool(name, **dict(zip(choices, row, strict=True))) for row in rows]


def _all_tools() -> list[Tool]:
    """Every tool; its place in the list is its id."""
    # Id 0 is the no-op, ids 1 to 2,110 are the Default Split: together they are A.3's 2,111 tools.
    # Ids 2,111 to 2,325 are in the Full Split alone. appendix: lever, ball and belt are among the
    # 2,111; [code] they are not; [here] as [code], because with them it would be 2,326.
    tools = [Tool("No-op")]
    for name in PAPER_KINDS:
        tools += _tools_of(name)
    # Then the tools of the analyses, 3 degrees apart, without those that we have already.
    known = set(tools)
    for name in FINE_KINDS:
        tools += [tool for tool in _tools_of(name, FINE_STEP) if tool not in known]
    for name in OWN_KINDS:
        tools += _tools_of(name)
    return tools


TOOLS = _all_tools()
NUM_ACTIONS = len(TOOLS)  # 8,359 distinct tools over all splits
# Arrays (NUM_ACTIONS,): the class; the angle in degrees (of see-saws the limit, 0 without angles).
TOOL_KINDS = np.array([tool.kind for tool in TOOLS])
TOOL_ANGLES = np.array([tool.max_angle or tool.angle for tool in TOOLS])
# Is it one of the tools 15 degrees apart, not one that the analyses add?
IS_COARSE = np.arange(NUM_ACTIONS) < 2_326
IS_COARSE |= np.isin(TOOL_KINDS, list(OWN_KINDS))


def action_labels() -> np.ndarray:
    """Class of every tool, (NUM_ACTIONS,) of str: the keys of KINDS, both see-saws as one."""
    return np.array([tool.kind.removeprefix("Hinged ") for tool in TOOLS])


TOOL_CLASSES = tuple(dict.fromkeys(action_labels()[1:].tolist()))  # without the no-op


def engineered_representations() -> np.ndarray:
    """Ground-truth features of every tool, float32 (NUM_ACTIONS, 30).

    B describes "engineered" representations for Grid World; for CREATE they are [code]'s: one-hot
    of the 21 classes (20 and the no-op), then elasticity, angle (rad), size, damping, largest angle
    (rad), weight, left_up, force, speed, standardised over the 2,326 tools that are 15 degrees
    apart (over the 2,111 alone the speed would be constant).
    """
    # [code] orders its classes (flat squares are one) anew in every run; [here] sorted, without it.
    one_hot = TOOL_KINDS[:, None] == np.unique(TOOL_KINDS)  # (NUM_ACTIONS, 21)
    numbers = np.array([tool[1:10] for tool in TOOLS], np.float64)  # (NUM_ACTIONS, 9)
    numbers[:, [1, 4]] = np.radians(numbers[:, [1, 4]])  # the angles
    coarse = numbers[IS_COARSE]
    numbers = (numbers - coarse.mean(axis=0)) / coarse.std(axis=0)
    return np.concatenate([one_hot, numbers], axis=1).astype(np.float32)  # (NUM_ACTIONS, 30)


# ---- A.3: the action set and its splits, Table 1 ----

# The Default Split is one draw that [code] ships: the training angles of each group of classes (of
# see-saws the limits). Two classes of one shape share them: a held-out angle is new for both. The
# paper's results are of this draw (cannons: 12 of 24 angles). In 1.9 % of draws training has all
# five cannon angles from 120 to 180 degrees: harder, as no test cannon shoots up and well to the
# left, where most goals are.
TRAINING_ANGLES = {
    ("Ramp", "Trampoline"): (45, 60, 75, 90, 105, 165),
    ("Triangle", "Bouncy Triangle"): (30, 45, 60, 105),
    ("Square", "Bouncy Square"): (15, 30, 75),
    ("Pentagon", "Bouncy Pentagon"): (15, 45, 60),
    ("Hexagon", "Bouncy Hexagon"): (15, 45),
    ("Hinged See-saw",): (50, 65, 80),
    ("See-saw",): (5, 50),
    ("Cannon",): (0, 15, 45, 60, 105, 120, 165, 240, 255, 300, 315, 330),
    ("Fan",): (60, 90, 135, 195, 210, 225, 240, 255, 270, 285, 300, 330),
    ("Funnel",): (15, 30, 45, 60, 75, 105, 135, 195, 255, 270, 285, 300),
    ("Bucket",): (15, 45, 75, 90, 105, 150, 180, 195, 210, 240, 255, 345),
}


def _halves(rng: np.random.Generator, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct values, shuffled and cut into two halves; the first one may have one more."""
    shuffled = rng.permutation(np.unique(values))
    middle = ceil(len(shuffled) / 2)
    return shuffled[:middle], shuffled[middle:]


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Train, validation and test ids, each a sorted int64 array (A.3, Table 1).

    | split    | train | valid | test  | training tools                                         |
    |----------|-------|-------|-------|--------------------------------------------------------|
    | default  | 1,097 | 507   | 506   | half of the angles of each class, the published draw   |
    | random   | 1,097 | 507   | 506   | half of the angles of each class, drawn by `seed`      |
    | full     | 938   | 400   | 399   | by tool class, Table 1                                 |
    | analysis | 761   | 3,397 | 3,397 | 30 degrees apart; the rest: 3 degrees apart            |

    `seed` also draws which held-out tools are for validation, which for the test. The parts are
    disjoint. The no-op (id 0) is in none of them, because it is always available. The paper counts
    it: once in the 2,111 of the default split and in the 762 training tools of the analyses, twice
    in the 1,739 of the Full Split (in training and held out). Default and random have no balls,
    bouncy balls, levers or belts, full has no 4- to 6-sided polygons, analysis has neither.
    A class of your own is in every split; half of its first parameter's values train (2 of 3).
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; allowed: {', '.join(SPLITS)}")
    rng = np.random.default_rng(seed)

    # Two masks over all tools: which belong to the split, and which of these are for training. The
    # rest of the split is held out.
    pool = np.zeros(NUM_ACTIONS, bool)
    train = np.zeros(NUM_ACTIONS, bool)
    if split == "full":  # whole classes are held out
        pool = IS_COARSE & np.isin(TOOL_KINDS, TABLE_1)
        train = IS_COARSE & np.isin(TOOL_KINDS, TABLE_1_TRAIN)
    elif split == "analysis":
        # appendix: 7,566 tools, "at least 15 degrees" between the 762 training tools; [code] 7,556
        # with the no-op, and 30 degrees; [here] as [code], because only 30 degrees give 762.
        pool = np.isin(TOOL_KINDS, FINE_KINDS)
        train = pool & np.isin(TOOL_ANGLES % 30, (0, FIRST_LIMIT))  # see-saws: limits 5, 35, 65
    else:  # angles are held out
        for group, angles in TRAINING_ANGLES.items():
            members = IS_COARSE & np.isin(TOOL_KINDS, group)
            if split == "random":
                angles, _ = _halves(rng, TOOL_ANGLES[members])
            pool |= members
            train |= members & np.isin(TOOL_ANGLES, angles)

    # A.3: "The validation set is obtained by randomly splitting the testing set into half."
    valid, test = _halves(rng, np.flatnonzero(pool & ~train))

    # A class of your own has its own random numbers, so that it moves no other tool.
    for name in OWN_KINDS:
        rng = np.random.default_rng([seed, *name.encode()])
        primary = next(iter(KINDS[name].vary))
        values = np.array([getattr(tool, primary) for tool in TOOLS])
        members = TOOL_KINDS == name
        train_values, _ = _halves(rng, values[members])
        train |= members & np.isin(values, train_values)
        own_valid, own_test = _halves(rng, np.flatnonzero(members & ~train))
        valid = np.concatenate([valid, own_valid])
        test = np.concatenate([test, own_test])
    return {"train": np.flatnonzero(train), "valid": np.sort(valid), "test": np.sort(test)}


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


def angle_gaps(action_ids: Sequence[int], train_ids: Sequence[int]) -> np.ndarray:
    """Degrees to the nearest training tool of the same class, float64 (len(action_ids),).

    Angles wrap at the class's full turn (a ramp at 177 is 3 degrees from one at 0), see-saw limits
    do not. 0 in a class without angles, infinity without a training tool. ValueError: bad ids.
    """
    # [code] compares with all classes at once and without wrapping (345 is 345 away from 0). [here]
    # class by class, because a ramp at 15 degrees does not tell what a fan at 15 does.
    check_ids(action_ids)
    ids = np.asarray(action_ids)  # in the order asked for
    train_ids = check_ids(train_ids)
    gaps = np.full(len(ids), np.inf)
    for name in np.unique(TOOL_KINDS[train_ids]):
        members = TOOL_KINDS[ids] == name
        train_angles = np.unique(TOOL_ANGLES[train_ids[TOOL_KINDS[train_ids] == name]])
        gap = np.abs(TOOL_ANGLES[ids[members]][:, None] - train_angles)  # (tools, training angles)
        if "angle" in KINDS[name].vary:
            gap = np.minimum(gap, KINDS[name].turn - gap)
        gaps[members] = gap.min(axis=1)
    return gaps


# ---- C.1, Figure 7: the 12 tasks as tables ----


class Item(NamedTuple):
    """One object of a level: what, where (norm), and whose random shift it shares, if any."""

    tool: Tool
    x: float
    y: float
    shift: str = ""


@dataclass(frozen=True)
class Task:
    """One level. With a marker ball the goal counts only from the target hit on."""

    items: tuple[Item, ...]
    target: Item
    goal: Item
    marker: Item | None = None
    # By name: the half range (norm) of a uniform shift of x and y (one number: of both), drawn at
    # every reset for target, goal, marker, and all items that have the name as their `shift`.
    shifts: dict[str, float | tuple[float, float]] = field(default_factory=dict)
    subgoals: tuple = ()  # places (norm), for the marker if there is one, else the target
    marker_must_touch: bool = False  # [code] no target hit before marker and target have touched
    target_hit_reward: float = LAMBDA_TARGET_HIT
    goal_on_either_side: bool = False  # the goal's x changes sign with probability 1/2
    max_actions: int = MAX_ACTIONS


def item(kind: str, x: float, y: float, shift: str = "", **parameters) -> Item:
    """An object of any class, with the parameters of `Tool`."""
    return Item(Tool(kind, **parameters), x, y, shift)


def line(x, y, length, angle=0, shift="", kind="Thin line") -> Item:
    """A floor, a wall (90 degrees) or a slope around (x, y)."""
    return item(kind, x, y, shift, elasticity=0.5, angle=angle, size=length)


# `item` with some parameters given: star(x, y), ladder(x, y, size=20), ball(kind, x, y).
ball = partial(item, elasticity=1.0, size=BALL_RADIUS, mass=BALL_MASS)
star = partial(item, "Goal star", angle=90, size=4)  # the goal of most tasks
box = partial(item, "Box", elasticity=0.1, size=5, mass=30)
bucket = partial(item, "Bucket", size=4)
belt = partial(item, "Conveyor Belt", size=7)
ladder = partial(item, "Ladder", angle=95, speed=4)
# Walls at the edges of the screen, never at the bottom.
RIGHT_WALL = line(1, 0, 90, 90, kind="Boundary")
LEFT_WALL = line(-1, 0, 90, 90, kind="Boundary")
CEILING = line(0, 1, 90, kind="Boundary")
ROOM = (RIGHT_WALL, LEFT_WALL, CEILING)


def chamber(sign: int) -> tuple[Item, ...]:
    """A chamber of the task "funnel": the left one (sign 1) or its mirror image (-1)."""
    return (
        line(-0.56 * sign, -0.99, 35.5),
        line(-0.88 * sign, -0.16, 10),  # the lid, to both sides of the funnel
        line(-0.257 * sign, -0.16, 10),
        line(-0.99 * sign, -0.7, 45, 90 * sign),
        line(-0.15 * sign, -0.7, 45, 90 * sign),
        item("Funnel", -0.6 * sign, -0.15, angle=-45 * sign, size=8),
    )


# [code] All numbers: positions in norm, lengths and radii in units, degrees. The first three tasks
# are in the main paper, the other nine in Figure 8.
# fmt: off
TASKS = {
    # The marker falls at the right: bend its way, so that it knocks the target to the star.
    "push": Task(
        marker=ball("Marker", 0.6, 0.75), target=ball("Target", 0.1, -0.14), goal=star(-0.7, -0.64),
        items=(line(0.1, -0.25, 16, shift="target"), line(-0.7, -0.75, 16, shift="goal")),
        shifts={"marker": 0.2, "target": 0.2, "goal": 0.2}),
    # Two pairs of boxes fall: catch them. Else the right one stops the marker (its way: right to
    # the subgoal, down, back left), the left one the target (left, down a slope to the star).
    "obstacle": Task(
        marker=ball("Marker", -0.8, 0.8), target=ball("Target", 0.1, -0.47), goal=star(-0.9, -0.69),
        items=(line(-0.61, 0.39, 35.6, -30), line(-0.25, 0.04, 12.7, 90), line(0.07, -0.1, 26),
               line(-0.8, -0.81, 16), line(0.12, -0.59, 16), line(-0.34, -0.70, 24.5, 22.5),
               box(-0.7, 0.3), box(-0.7, 0.2), line(-0.6, 0.18, 15, 90), line(-0.8, 0.18, 15, 90),
               line(0.35, 0.8, 15, 90), box(0.25, 0.93), box(0.25, 0.83), line(0.15, 0.8, 15, 90),
               *ROOM),
        shifts={"marker": 0.02, "target": (0.02, 0.0)},
        subgoals=((0.7, -0.1),), marker_must_touch=True,
        target_hit_reward=2.0,  # appendix: 1; [code] 2; [here] as [code]
        max_actions=50),  # appendix: 30; [code] 50; [here] as [code], the published task
    # The see-saw's low right end bars the gap left of the wall: the heavy ball, led to the
    # see-saw's left, lifts it.
    "seesaw": Task(
        target=ball("Target", 0.2, 0.9), goal=star(-0.8, -0.8),
        items=(ball("Heavy ball", -0.3, 0.5, "ball", mass=30, elasticity=0.1),
               item("Level see-saw", -0.3, -0.1, size=30, max_angle=30, mass=1, left_up=True,
                    friction=0),
               line(0.1, -0.7, 40, 90), line(-0.9, -0.3, 20), *ROOM),
        shifts={"ball": 0.05, "target": 0.1}, subgoals=((-0.1, -0.45),)),
    # The marker falls onto a long floor: move it over the edge, then the target back to the left.
    "navigate": Task(
        marker=ball("Marker", -0.6, 0.75), target=ball("Target", 0.1, -0.24),
        goal=star(-0.65, -0.59), shifts={"target": 0.1, "goal": 0.2},
        items=(line(0.1, -0.35, 16, shift="target"), line(-0.65, -0.7, 16, shift="goal"),
               line(-0.5, 0.1, 40))),
    # Two belts carry the ball to the left, above the floor; the third, below, back to the right.
    "belt": Task(
        target=ball("Target", 0.75, 0.75, size=3), goal=star(0.5, -0.7),
        items=(belt(0.55, 0.25, speed=-2.5), belt(0.05, 0.2, speed=-2.5),
               belt(-0.3, -0.6, speed=5.0), line(0.41, -0.30, 65, kind="Line"),
               line(-0.34, -0.17, 12.7, 90, kind="Line")),
        shifts={"target": 0.1, "goal": 0.1}, subgoals=((-0.6, -0.35), (-0.15, 0.28), (-0.1, -0.5)),
        max_actions=50),  # appendix: 30; [code] 50; [here] as [code]
    # Through the gap between two buckets, each a trap, to the far left of the chamber.
    "buckets": Task(
        target=ball("Target", 0.75, 0.75, size=3), goal=star(-0.85, -0.85),
        items=(line(-0.48, -0.99, 45), line(-0.75, -0.15, 25),
               line(-0.99, -0.7, 45, 90), line(0.05, -0.7, 45, 90),
               bucket(0.05, -0.10), bucket(-0.45, -0.10)),
        shifts={"target": 0.1}, subgoals=((-0.20, -0.10),)),
    # The target, knocked off its shelf, falls into the cannon; its flight has to be bent.
    "cannon": Task(
        marker=ball("Marker", 0.8, 0.75), target=ball("Target", 0.4, 0.11), goal=star(-0.7, -0.1),
        items=(RIGHT_WALL, CEILING, line(-0.1, 0.35, 55, 90),
               item("Cannon", -0.1, -0.8, angle=110, force=140), line(0.4, 0.0, 8, shift="target")),
        shifts={"marker": 0.1, "target": 0.05, "goal": 0.05}, marker_must_touch=True),
    # Two balls fall on two sides of a wall: make them meet.
    "collide": Task(
        target=ball("Target", 0.6, 0.7), goal=ball("Goal ball", -0.6, 0.7),
        items=(line(0.0, 0.25, 35, 90), *ROOM), shifts={"target": 0.1, "goal": 0.1}),
    # The goal is a ball that bounces on a trampoline.
    "moving": Task(
        target=ball("Target", 0.6, 0.75), goal=ball("Goal ball", -0.7, 0.0),
        items=(item("Trampoline", -0.7, -0.75, elasticity=1.0, size=16),),
        shifts={"target": 0.2, "goal": (0.0, 0.5)}),
    # Push the target to the ladder, which lifts it, and on to the star.
    "ladder": Task(
        marker=ball("Marker", 0.7, 0.75), target=ball("Target", 0.35, -0.09),
        goal=star(-0.75, -0.09), shifts={"target": 0.1, "goal": 0.2},
        items=(line(0.35, -0.2, 5, shift="target"), line(-0.75, -0.2, 5, shift="goal"),
               ladder(-0.1, -0.1, size=20))),
    # Up three ladders, as up stairs, into the basket.
    "basket": Task(
        target=ball("Basketball", 0.75, 0.75, size=3.5), goal=item("Basket", -0.75, 0.65, size=10),
        items=(ladder(0.5, -0.4, size=15), ladder(-0.05, 0.0, size=15),
               ladder(-0.55, 0.35, size=15)),
        shifts={"target": 0.1, "goal": 0.1}, subgoals=((0.35, -0.05), (-0.15, 0.35)),
        max_actions=40),  # appendix: 30; [code] 40; [here] as [code]
    # Into the funnel of the chamber with the star; a ball between the chambers is lost.
    "funnel": Task(
        target=ball("Target", -0.075, 0.825), goal=star(-0.28, -0.8),
        items=chamber(1) + chamber(-1), shifts={"target": 0.125}, goal_on_either_side=True),
}
# fmt: on


# ---- the physics: objects ----

# One step: the chosen tool becomes a SceneObject, whose parts join the pymunk space. 40 times
# pymunk moves everything, and when two shapes touch it calls the contact rule of their types, which
# moves a ball or notes the touch. Then CreateEnv reads the positions and the notes, and pays.


def to_units(norm):
    """Agent coordinates [-1, 1] -> world units [0, 84]; numbers or arrays."""
    return (norm + 1.0) * WORLD / 2


# (along, across) units; other boxes are squares. [code] swaps two arguments, so that a cannon's
# contact box never turns. [here] it turns with the aim, as its picture does. This changes only
# where it catches a ball, not where or how fast it shoots.
BOX_SIZE = {"Cannon": (10.0, 7.3), "Fan": (6.7, 10.0)}
MUZZLE = (5.0, 3.65)  # [code] units, half the unturned box: a shot starts (5 cos, 3.65 sin) away
# [code] Funnels and buckets are open between their last corner and their first. At tool angle 0 a
# funnel's are at 150 (left rim), 270 (nozzle) and 30 degrees, a bucket's at 135, 225, 315 and 45.
LAST_CORNER = {"Funnel": 30, "Bucket": 45}
# The no-op is recorded, too. [code] The probe ball touches it if its centre is within 0.1 sqrt(8)
# norm, 11.9 units: a disc smaller by the ball's radius. A sensor (GOAL), it is only felt.
NO_OP_RADIUS = 0.1 * sqrt(8) * WORLD / 2 - BALL_RADIUS


def outline(tool: Tool) -> list[Vec2d]:
    """Corners of an object, or ends of its line, around its place; discs have none."""
    kind = KINDS[tool.kind]
    angle = radians(tool.angle)
    if kind.shape == "segment":
        end = Vec2d.from_polar(tool.size / 2, angle + start_tilt(tool))
        return [-end, end]
    if kind.shape == "polygon":  # counter-clockwise
        last = radians(tool.angle + LAST_CORNER.get(tool.kind, 0))
        turn = 2 * pi / kind.sides
        return [Vec2d.from_polar(tool.size, last + turn * k) for k in range(1, kind.sides + 1)]
    if kind.shape == "box":
        along, across = BOX_SIZE.get(tool.kind, (tool.size, tool.size))
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        return [Vec2d(i * along / 2, j * across / 2).rotated(angle) for i, j in signs]
    return []


def start_tilt(tool: Tool) -> float:
    """Angle (rad) of a see-saw at the start: with a weight it rests on its limit."""
    if tool.mass == 0:
        return 0.0
    limit = radians(tool.max_angle)
    return -limit if tool.left_up else limit


def weight_place(tool: Tool) -> Vec2d:
    """Where the weight of a see-saw is, from its pivot: three quarters down the lower half."""
    u, v = Vec2d.from_polar(0.75 * tool.size / 2, -radians(tool.max_angle))
    return Vec2d(u if tool.left_up else -u, v)


class SceneObject:
    """One object at a place (units). Its `parts` are still to be added to the space."""

    def __init__(self, tool: Tool, place: Vec2d, static_body: pymunk.Body):
        kind = KINDS[tool.kind]
        self.tool = tool
        self.kind = kind
        self.place = place  # where it is put
        self.waits_for = None  # the ball whose touch a goal, subgoal or marker awaits ...
        self.touched = False  # ... and whether it came
        self.held_by = None  # the bucket that has caught a ball

        # What moves has a body of its own, and its shape is given around that body's centre. All
        # else is a part of the space's static body, and its shape is given in the world.
        self.body = None
        if kind.contact == PLANK:
            self.body = pymunk.Body(PLANK_MASS, PLANK_MOMENT)
        elif kind.contact == MOVING:
            divisor = 2 if kind.shape == "disc" else 6  # moment of a disc, of a square
            self.body = pymunk.Body(tool.mass, tool.mass * tool.size**2 / divisor)
        if self.body:
            self.body.position = place
        body = self.body or static_body
        origin = Vec2d(0, 0) if self.body else place

        # The shape is what others collide with.
        self.corners = [origin + corner for corner in outline(tool)]
        if kind.shape == "disc":
            shape = pymunk.Circle(body, tool.size or NO_OP_RADIUS, origin)
        elif kind.shape == "segment":
            shape = pymunk.Segment(body, *self.corners, kind.radius)
        else:
            shape = pymunk.Poly(body, self.corners)

        # Its collision type chooses the contact rule. Elasticity and friction of a contact are the
        # products of the two objects' numbers; a ball's are mostly 1, so that the tool decides.
        is_vessel = kind.contact in (FUNNEL, BUCKET)
        shape.collision_type = kind.contact
        shape.sensor = kind.contact in SENSORS
        shape.elasticity = VESSEL_ELASTICITY if is_vessel else float(tool.elasticity)
        shape.friction = float(tool.friction)
        shape.owner = self  # so that a contact rule knows what it has before it
        self.shape = shape

        # pymunk wants a body before what hangs on it.
        self.parts = [self.body] if self.body else []
        if kind.contact == PLANK:
            self.parts += self._fixtures(static_body)
        self.parts.append(shape)

    def _fixtures(self, static_body: pymunk.Body) -> list:
        """What holds a plank at its pivot and limits its turn; the weight on its end, if any."""
        # [code] has a pin and a slide joint: under a load the plank's centre shakes. [here] pivot
        # and limit joints; over 800 launches per class balls move as in [code].
        limit = radians(self.tool.max_angle)
        tilt = start_tilt(self.tool)
        if self.tool.kind == "Level see-saw":
            # As in [code]: its centre shakes, which counts as motion; else episodes end early.
            # The point 1 unit left of the pivot stays within 2 sin(limit / 2) of its level place.
            fixtures = [pymunk.PinJoint(self.body, static_body, (0, 0), self.place)]
            slide = (Vec2d.from_polar(-1, tilt), self.place - (1, 0), 0, 2 * sin(limit / 2))
            fixtures.append(pymunk.SlideJoint(self.body, static_body, *slide))
        else:
            fixtures = [pymunk.PivotJoint(self.body, static_body, self.place)]
            if limit:
                # The body's angle starts at 0, with the plank at `tilt`; limits count from there.
                low, high = -limit - tilt, limit - tilt
                fixtures.append(pymunk.RotaryLimitJoint(static_body, self.body, low, high))
        if self.tool.mass:
            # [code] Without a shape, nothing hits it. The GearJoint makes it turn with the plank.
            weight = pymunk.Body(self.tool.mass, self.tool.mass)  # mass, moment of inertia [code]
            weight.position = self.place + weight_place(self.tool)
            pivot = pymunk.PivotJoint(self.body, weight, weight.position)
            fixtures += [weight, pivot, pymunk.GearJoint(self.body, weight, 0.0, 1.0)]
        return fixtures


# ---- the physics: what happens when two objects touch ----

# In these rules `mover` is the ball or loose box that touches something. A rule is called once, as
# a contact begins (`begin`), or at every step of it, before or after its forces (`pre_solve`,
# `post_solve`). `process_collision` False lets the two pass through each other, and stays False as
# long as they touch: a rule that decides anew at every step must write True and False.


def _put_at_rest(body: pymunk.Body, position: tuple[float, float]) -> None:
    body.position = position
    body.velocity = (0.0, 0.0)
    body.force = (0.0, 0.0)
    body.angle = 0.0
    body.angular_velocity = 0.0


def _on_goal(arbiter, space, data) -> None:
    """Goals, subgoals and markers remember the touch that they wait for."""
    a, b = (shape.owner for shape in arbiter.shapes)
    a.touched |= a.waits_for is b
    b.touched |= b.waits_for is a


def _on_carrier(arbiter, space, data) -> None:
    """Belts and ladders set a ball's velocity at every step, so it does not fall through."""
    mover, carrier = (shape.owner for shape in arbiter.shapes)
    aim = radians(carrier.tool.angle)
    lean = LADDER_LEAN if carrier.kind.contact == LADDER else 1.0
    speed = carrier.tool.speed
    mover.body.velocity = (lean * speed * cos(aim), speed * sin(aim))


def _on_cannon(arbiter, space, data) -> None:
    """A cannon shoots when a contact begins; later it would catch its own shot again."""
    mover, cannon = (shape.owner for shape in arbiter.shapes)
    aim = radians(cannon.tool.angle)
    if mover.held_by is None:  # a bucket does not let go
        _put_at_rest(mover.body, cannon.place + (MUZZLE[0] * cos(aim), MUZZLE[1] * sin(aim)))
        mover.body.velocity = Vec2d.from_polar(cannon.tool.force / mover.body.mass, aim)


def _on_fan(arbiter, space, data) -> None:
    """A fan blows with the same force anywhere in its box."""
    mover, fan = (shape.owner for shape in arbiter.shapes)
    push = Vec2d.from_polar(fan.tool.force, radians(fan.tool.angle))
    # [code] turns the force with the ball as it rolls. [here] not, because wind does not turn with
    # a ball; nor does it in the authors' second release, which is of CREATE alone.
    mover.body.apply_force_at_world_point(push, mover.body.position)


def _on_funnel(arbiter, space, data) -> None:
    """In by the mouth, out by the nozzle; from elsewhere a funnel is solid."""
    mover, funnel = (shape.owner for shape in arbiter.shapes)
    left, nozzle, right = (dist(mover.body.position, corner) for corner in funnel.corners)
    caught = mover.held_by is None and nozzle > left and nozzle > right
    if caught:
        # At the nozzle it is not caught again: the funnel, solid now, pushes it out.
        _put_at_rest(mover.body, funnel.corners[1])
    arbiter.process_collision = not caught


def _on_bucket(arbiter, space, data) -> None:
    """What comes in by the opening stays in for good; from elsewhere a bucket is solid."""
    mover, holder = (shape.owner for shape in arbiter.shapes)
    if mover.held_by is None:
        gaps = (dist(mover.body.position, corner) for corner in holder.corners)
        top_left, low_left, low_right, top_right = gaps  # as the corners are at tool angle 0
        if max(top_left, top_right) < min(low_left, low_right):
            mover.held_by = holder
    if mover.held_by is holder:
        # [code] resets the position alone, and the ball's speed grows without end. [here] it is
        # stopped as well, as in the authors' second release (see `_on_fan`).
        _put_at_rest(mover.body, holder.place)
    arbiter.process_collision = mover.held_by is None


def _on_plank(arbiter, space, data) -> None:
    """[code] A damping above 1 slows balls, not boxes, at every step: 1.05 by 5 %."""
    mover, plank = (shape.owner for shape in arbiter.shapes)
    keep = 2.0 - plank.tool.damping
    # With a damping of 1 nothing is written, because that would wake a sleeping ball.
    if mover.kind.shape == "disc" and keep < 1.0:
        mover.body.velocity = mover.body.velocity * keep
        mover.body.angular_velocity *= keep


def make_space() -> pymunk.Space:
    """An empty world with CREATE's gravity and contact rules, for the game and the probe ball."""
    space = pymunk.Space()  # 10 solver iterations and no damping are pymunk's defaults
    space.gravity = GRAVITY
    space.sleep_time_threshold = SLEEP_TIME
    # A target that stays on a goal is noted anew: `_judge` forgets the touch after each action.
    space.on_collision(GOAL, MOVING, pre_solve=_on_goal)
    # Two balls: as their touch begins [code]. So never give a task a marker and a goal ball: a
    # touch before the target hit is forgotten by `_judge`, and while it lasts none begins again.
    space.on_collision(MOVING, MOVING, begin=_on_goal)
    space.on_collision(MOVING, BELT, pre_solve=_on_carrier)
    space.on_collision(MOVING, LADDER, pre_solve=_on_carrier)
    space.on_collision(MOVING, CANNON, begin=_on_cannon)
    space.on_collision(MOVING, FAN, pre_solve=_on_fan)
    space.on_collision(MOVING, FUNNEL, pre_solve=_on_funnel)
    space.on_collision(MOVING, BUCKET, pre_solve=_on_bucket)
    space.on_collision(MOVING, PLANK, post_solve=_on_plank)  # damps the speed after the forces
    return space


# ---- A.3 state: one set of flat shapes, in grey for the policy and in colour for people ----

ZOOM = 3  # [here] drawn so many times too large and averaged, for soft edges and small moves
EDGE = 0.25  # [here] units: the dark edge that people see around every shape
INK = "#3b3a44"


class Canvas:
    """A square picture of so many units: grey on white for the policy, in colour for people."""

    def __init__(self, size: int, in_colour: bool, units: float = WORLD):
        self.in_colour = in_colour
        self.units = units
        self.scale = size * ZOOM / units  # pixels per unit, before they are averaged
        # In mode "L", grey, Pillow turns every colour it is given into its grey.
        self.image = Image.new("RGB" if in_colour else "L", (size * ZOOM, size * ZOOM), "white")
        self.pen = ImageDraw.Draw(self.image)

    def stroke(self, points, width: float, colour: str) -> None:
        """A line with round ends and corners through points (units). Through one: a disc."""
        pixels = self._to_pixels(points)
        thick = max(1, round(width * self.scale))
        if len(pixels) > 1:
            self.pen.line(pixels, colour, thick)
        if thick > 2:
            for x, y in pixels:
                left = round(x - thick / 2)
                top = round(y - thick / 2)
                self.pen.ellipse((left, top, left + thick - 1, top + thick - 1), colour)

    def line(self, points, width: float, colour: str) -> None:
        """The same; in colour with a dark edge."""
        if self.in_colour:
            self.stroke(points, width + 2 * EDGE, INK)
        self.stroke(points, width, colour)

    def polygon(self, corners: list[Vec2d], colour: str) -> None:
        if self.in_colour:
            self.stroke([*corners, corners[0]], 2 * EDGE, INK)
        self.pen.polygon(self._to_pixels(corners), colour)

    def _to_pixels(self, points) -> list:
        # Pillow rounds to these pixels: in the observation a ball moves in thirds of a unit.
        return [(x * self.scale, (self.units - y) * self.scale) for x, y in points]

    def picture(self) -> np.ndarray:
        """uint8 (size, size) in grey, (size, size, 3) in colour."""
        return np.array(self.image.reduce(ZOOM))


def draw(canvas: Canvas, tool: Tool, place: Vec2d, angle: float = 0.0) -> None:
    """Draw an object: the shape that others collide with, and marks that show what it does."""
    kind = KINDS[tool.kind]
    colour = kind.colour
    half = tool.size / 2
    corners = [place + corner.rotated(angle) for corner in outline(tool)]
    aim = angle + radians(tool.angle)

    def at(along: float, across: float = 0.0) -> Vec2d:
        """A point in the object's own frame, which is turned by its angle."""
        return place + Vec2d(along, across).rotated(aim)

    match tool.kind:
        case "No-op":
            pass  # it has no picture
        case "Cannon":
            canvas.polygon(corners, colour)
            canvas.polygon([at(4.6), at(1.6, 2.2), at(1.6, -2.2)], "white")  # where it shoots
        case "Fan":
            canvas.line([*corners, corners[0]], 1.0, colour)
            canvas.line([at(-1), at(3.35)], 1.0, colour)  # an arrow, where the wind goes
            canvas.polygon([at(3.35), at(1.0, 2.0), at(1.0, -2.0)], colour)
        case "Funnel" | "Bucket":
            canvas.polygon(corners, "white")
            canvas.line(corners, 1.2, colour)  # open from the last corner to the first
        case "Basket":
            canvas.line([*corners, corners[0]], 1.0, colour)
        case "Goal star" if canvas.in_colour:  # grey: [code]'s pentagon, which balls touch
            canvas.polygon([corners[k] for k in (0, 2, 4, 1, 3)], colour)
            canvas.stroke([place], 2.8, colour)  # Pillow leaves the middle of the star empty
        case "Ladder":
            canvas.line(corners, 2.0, colour)
            for u in np.arange(1.0 - half, half, 2.0).tolist():
                canvas.line([at(u, -1.0), at(u, 1.0)], 0.1, colour)
        case "Conveyor Belt":
            canvas.line(corners, 2.0, colour)
            ahead = 1 if tool.speed > 0 else -1  # an arrow head shows where it runs to
            end = ahead * half
            canvas.polygon([at(end + 2 * ahead), at(end, 1.9), at(end, -1.9)], colour)
        case _ if kind.contact == PLANK:
            canvas.polygon([place, place + (-2, -2), place + (2, -2)], colour)
            canvas.line(corners, 1.0, colour)
            if tool.mass:
                canvas.line([at(*weight_place(tool))], 3.0, colour)
        case _ if kind.shape == "disc":
            canvas.line([place], 2 * tool.size, colour)
        case _ if kind.shape == "segment":
            canvas.line(corners, max(2 * kind.radius, 1.0), colour)
        case _:
            canvas.polygon(corners, colour)


# ---- A.3 the environment ----

# Why a tool is refused, and what Eq. 3 takes for it: it is too close to a tool placed before,
# blocked by any shape (goals and subgoals too), or outside of the screen.
REFUSED = {"too close": LAMBDA_OVERLAP, "blocked": LAMBDA_OVERLAP, "outside": LAMBDA_INVALID}
PICTURE_SIZE = 420  # [here] pixels, of the scene in colour


class CreateEnv(gym.Env):
    """Place tools so that the target ball reaches the goal (appendix A.3).

    Every action places at most one tool, which then stays; after it 40 physics steps (1.33 s) run.

    ## Action Space
    `Dict(choice=Discrete(K), position=Box(-1, 1, (2,), float32))`: an index of `available`, and
    where to put the tool's centre (norm). Choice 0 is always the no-op. `step` also accepts
    positions outside of the Box, as an unclipped Gaussian policy makes them: the tool is refused.
    The attribute `placement` is then "placed", "waited", "outside", "too close" or "blocked".

    ## Observation Space
    `state`, Box(0, 255, (3, 84, 84), uint8): grey pictures, one at the end of each of the last 3
    actions, newest last; after reset the two older ones are black. `available`, Box(0, NUM_ACTIONS
    - 1, (K,), int64): the no-op and K - 1 tools of the pool, drawn without replacement at reset.

    ## Rewards
    0.01 per action; +10 for the goal; +2 for each subgoal once; -0.01 for a tool that is refused.
    In tasks with a marker the goal counts only from the target hit on. This pays +1 (obstacle: +2),
    once: at the first end of an action with the target over 3.56 units from its start, whatever
    moved it; in obstacle and cannon the marker must also have touched it.

    ## Episode End
    Terminated: goal reached; target off the screen; marker off it before the target hit; nothing
    moves at the end of an action for the second time, in a row or not. Truncated: 30 actions
    (obstacle, belt 50; basket 40). On the last step `info` has `success`, 0.0 or 1.0.

    ## Arguments
    `action_pool` ids (default: training split), `num_available` K, `task` of TASKS. Without
    `subgoal_reward` subgoals and target hit pay 0 (C.3). Bad values: ValueError.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}  # four times as fast as the world

    def __init__(self, action_pool=None, num_available=NUM_AVAILABLE, render_mode=None,
                 task="push", subgoal_reward=True):  # fmt: skip
        if task not in TASKS:
            raise ValueError(f"unknown task {task!r}; allowed: {', '.join(TASKS)}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; allowed: rgb_array")
        # The pool holds tools alone; the no-op is available beside whatever is drawn from it.
        ids = check_ids(split_actions()["train"] if action_pool is None else action_pool)
        self.action_pool = ids[ids != NO_OP]
        check_ids([NO_OP, *self.action_pool], num_available)
        self.num_available = num_available
        self.task = TASKS[task]
        self.subgoal_reward = subgoal_reward
        self.render_mode = render_mode
        state = spaces.Box(0, 255, (NUM_FRAMES, 84, 84), np.uint8)
        available = spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64)
        self.observation_space = spaces.Dict(state=state, available=available)
        position = spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = spaces.Dict(choice=spaces.Discrete(num_available), position=position)
        self._over = True  # no episode yet

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode with newly drawn available tools; returns (observation, {})."""
        super().reset(seed=seed)

        # Subsampling: every episode has its own few tools of the pool, unless all are available.
        # ([code] draws a class first in the Full Split's tests; [here] every split draws alike.)
        tools = self.action_pool
        if self.num_available - 1 < len(tools):
            tools = self.np_random.choice(tools, self.num_available - 1, replace=False)
        self.available = np.concatenate([[NO_OP], tools])  # (K,)

        self._build_level()
        self._actions = 0
        self._centres = []  # norm, of the tools placed so far
        self._tool = TOOLS[NO_OP]  # of the last action
        self.placement = "waited"  # what came of it

        # What has been reached. Without a marker ball no target hit is asked for.
        self._goal_reached = False
        self._target_hit = self._marker is None
        self._still = 0  # actions that ended without motion; it only grows
        self._over = False

        self._frames = np.zeros((NUM_FRAMES, 84, 84), np.uint8)
        observation = self._observe()
        self._pictures = []
        self._trail = []  # where balls have been, for people
        self._take_picture()
        return observation, {}

    def _build_level(self) -> None:
        """A fresh space with the task's objects, each at its place plus its random shift."""
        task = self.task
        # Objects that share a shift, as a ball and its shelf do, move together: one draw for all.
        self._shifts = {}
        for name, half_range in task.shifts.items():
            self._shifts[name] = self.np_random.uniform(np.negative(half_range), half_range, 2)

        # Contacts are solved in the order of adding, so it is part of a level: it is [code]'s.
        self._space = make_space()
        self._objects = []
        self._marker = self._add(task.marker, "marker") if task.marker else None
        for one in task.items:
            self._add(one, one.shift)
        self._subgoals = [self._add(item("Subgoal", x, y, size=3)) for x, y in task.subgoals]
        self._target = self._add(task.target, "target")
        goal = task.goal
        if task.goal_on_either_side and self.np_random.random() < 0.5:
            goal = goal._replace(x=-goal.x)
        self._goal = self._add(goal, "goal")

        # Who has to touch whom: the target the goal, the marker the target; subgoals wait for the
        # ball that the agent has to guide first.
        self._goal.waits_for = self._target
        if self._marker:
            self._marker.waits_for = self._target
        for subgoal in self._subgoals:
            subgoal.waits_for = self._marker or self._target

        # The grey picture of all that stands still is kept; what moves is drawn on copies of it.
        self._background = self._draw_objects(Canvas(84, in_colour=False), moving=False)

    def _add(self, one: Item, shift: str = "") -> SceneObject:
        dx, dy = self._shifts.get(shift, (0.0, 0.0))
        place = Vec2d(to_units(one.x + dx), to_units(one.y + dy))
        new = SceneObject(one.tool, place, self._space.static_body)
        self._space.add(*new.parts)
        self._objects.append(new)
        return new

    def step(self, action: dict):
        """Place a tool, simulate, judge, pay. ValueError: bad action. ResetNeeded: it is over."""
        choice = action["choice"]
        position = np.asarray(action["position"], np.float64)
        if not self.action_space["choice"].contains(choice):
            raise ValueError(f"choice must be 0..{self.num_available - 1}, got {choice!r}")
        if position.shape != (2,) or not np.isfinite(position).all():
            raise ValueError(f"position must be two finite numbers, got {position}")
        if self._over:
            raise gym.error.ResetNeeded("the episode is over (or none began): call reset()")

        # Place: the chosen tool goes where the agent wants it, or is refused. Time goes on anyway.
        self._tool = TOOLS[self.available[choice]]
        self.placement = self._place(position.tolist())
        self._actions += 1

        # Simulate: let the world run for 40 physics steps, 1.33 s (A.3).
        self._pictures = []
        for substep in range(1, SUBSTEPS + 1):
            self._space.step(DT)
            if substep % PICTURE_EVERY == 0 and substep < SUBSTEPS:
                self._take_picture()

        # Judge: who touched whom meanwhile, and is the episode over?
        subgoals_reached, hit_now = self._judge()
        terminated, truncated = self._ended()
        self._over = terminated or truncated

        # Pay by Equation 3, and show the agent what has become of the world.
        reward = self._pay(subgoals_reached, hit_now)
        observation = self._observe()
        self._take_picture()
        info = {METRIC: float(self._goal_reached)} if self._over else {}
        return observation, reward, terminated, truncated, info

    def _place(self, position: list[float]) -> str:
        """Put the chosen tool at this position (norm) if it may stand there."""
        if self._tool.kind == "No-op":
            return "waited"
        # appendix: a penalty "for placing outside the scene"; [code] clips the position first, so
        # that its penalty never fires; [here] as the appendix.
        if max(map(abs, position)) > 1.0:
            return "outside"
        # appendix: "overlap ... over existing objects"; [code] refuses a tool that is so near to an
        # earlier one, or whose exact shape touches anything in the scene; [here] as [code].
        if any(dist(position, centre) <= MIN_TOOL_GAP for centre in self._centres):
            return "too close"
        place = Vec2d(*map(to_units, position))
        new = SceneObject(self._tool, place, self._space.static_body)
        if self._space.shape_query(new.shape):  # sensors, as goals are, block too
            return "blocked"

        # It stays. What does not move joins the picture of all that stands still.
        self._space.add(*new.parts)
        self._objects.append(new)
        self._centres.append(position)
        if new.body is None:
            draw(self._background, new.tool, place)
        return "placed"

    def _judge(self) -> tuple[int, bool]:
        """What this action achieved; returns (subgoals reached, target hit just now)."""
        # First the target hit: far from its start (off the screen: as at its edge [code]) and, if
        # the task asks, touched by the marker. [code] does this last, so a goal counts late.
        hit_now = False
        if not self._target_hit:
            place = np.clip(self._target.body.position, 0.0, WORLD)
            moved_far = dist(place, self._target.place) > HIT_DISTANCE * WORLD * sqrt(2)
            hit_now = moved_far and (self._marker.touched or not self.task.marker_must_touch)
            self._target_hit = hit_now

        # Then the goal. In obstacle and cannon a fan can bring the target there before the marker
        # touches it. [code] remembers that until the hit; [here] not: a goal counts when reached.
        self._goal_reached = self._target_hit and self._goal.touched
        self._goal.touched = False

        # Then the subgoals; one reached now is not in this picture ([code]: from the next on). And
        # [code] counts what is touched as an action ends; [here] at any time in it, as the goal.
        reached = [subgoal for subgoal in self._subgoals if subgoal.touched]
        for subgoal in reached:
            self._space.remove(*subgoal.parts)
            self._objects.remove(subgoal)
            self._subgoals.remove(subgoal)
        if reached:
            self._background = self._draw_objects(Canvas(84, in_colour=False), moving=False)
        return len(reached), hit_now

    def _pay(self, subgoals_reached: int, hit_now: bool) -> float:
        """The reward, A.3 Equation 3: alive, goal, subgoals, target hit, invalid, overlap."""
        # appendix: a product of the three bonuses, 0 unless all come in one action. [code] sums
        # them, and takes off 0.1 per placed tool. [here] sums; the appendix has no cost of tools.
        reward = LAMBDA_ALIVE + REFUSED.get(self.placement, 0.0)
        reward += self._goal_reached * LAMBDA_GOAL  # an indicator of Eq. 3 is True or False, 1 or 0
        # C.3 switches off the rewards of subgoals. [here] the target hit's, too: Figure 10 shows
        # push, which has no subgoals.
        if self.subgoal_reward:
            reward += subgoals_reached * LAMBDA_SUBGOAL
            reward += hit_now * self.task.target_hit_reward
        return reward

    def _ended(self) -> tuple[bool, bool]:
        """(terminated, truncated) after this action."""
        # The ends: the goal, a second still action, the limit of actions; [code], not the appendix,
        # a lost ball, too (the marker: only until the target hit).
        needed = [self._target] if self._target_hit else [self._target, self._marker]
        lost = not all(0.0 < value < WORLD for one in needed for value in one.body.position)
        # A.3 "no moving objects" [code], by the speed of centres: a tool's plank only turns, so it
        # is still; a lost ball that is not needed falls on, so it moves. One in a bucket is left
        # out: gravity alone gives it 0.07 units/s in a step.
        moving = [one.body for one in self._objects if one.body and not one.held_by]
        if all(body.velocity.length < STILL_SPEED for body in moving):
            self._still += 1
        # appendix: the episode ends at the goal; [code] goes on; [here] as the appendix.
        terminated = self._goal_reached or lost or self._still >= STILL_ACTIONS
        # appendix: 30 actions; [code] one more than its limit; [here] the exact limit, `truncated`.
        return terminated, not terminated and self._actions >= self.task.max_actions

    def _draw_objects(self, canvas: Canvas, moving: bool) -> Canvas:
        for one in self._objects:
            if moving and one.body:
                draw(canvas, one.tool, one.body.position, one.body.angle)
            elif not moving and not one.body:
                draw(canvas, one.tool, one.place)
        return canvas

    def _observe(self) -> dict[str, np.ndarray]:
        # A.3 State: the newest grey picture and the two before it. Copies go out.
        canvas = Canvas(84, in_colour=False)
        canvas.image.paste(self._background.image)
        newest = self._draw_objects(canvas, moving=True).picture()
        self._frames = np.concatenate([self._frames[1:], newest[None]])  # (3, 84, 84)
        return {"state": self._frames.copy(), "available": self.available.copy()}

    def _take_picture(self) -> None:
        """This moment for people: the scene, a caption, and beside it the policy's last state."""
        if not self.render_mode:
            return
        # The scene: what stands still, small dots where the balls have been, what moves.
        for one in self._objects:
            if one.kind.contact == MOVING and one.kind.shape == "disc":
                self._trail.append((one.body.position, one.kind.colour))
        canvas = self._draw_objects(Canvas(PICTURE_SIZE, in_colour=True), moving=False)
        for place, colour in self._trail:
            canvas.stroke([place], 0.8, colour)
        self._draw_objects(canvas, moving=True)

        size = PICTURE_SIZE
        page = Image.new("RGB", (size + 6 + size // 3, size + 30), "lightgrey")
        page.paste(Image.fromarray(canvas.picture()))
        state = Image.fromarray(np.vstack(self._frames)).resize((size // 3, size))
        page.paste(state, (size + 6, 0))
        caption = f"{self._actions}/{self.task.max_actions}  {self._tool.kind} {self.placement}"
        if self._goal_reached:
            caption += ", goal!"
        ImageDraw.Draw(page).text((8, size + 15), caption, INK, ImageFont.load_default(16), "lm")
        self._pictures.append(np.array(page))

    def render(self) -> np.ndarray | None:
        """The scene now and what the policy sees, uint8 (height, width, 3), or None."""
        return self.render_frames()[-1] if self.render_mode else None

    def render_frames(self) -> list[np.ndarray]:
        """Pictures of the last step: 5, or 1 right after a reset, or none without render_mode."""
        return list(self._pictures)


gym.register("ActionGen/Create-v0", entry_point=f"{__name__}:CreateEnv")


def make_vec(num_envs, action_pool=None, num_available=NUM_AVAILABLE, seed=0, **options):
    """SyncVectorEnv of `num_envs` independent streams, already seeded; `options` as `CreateEnv`."""
    one = partial(CreateEnv, action_pool, num_available, **options)
    envs = gym.vector.SyncVectorEnv([one] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    # seed + i would let neighbouring seeds share environments; these seeds are unrelated.
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs


# ---- A.3, B action observations: the probe ball ----

# How a tool deflects a ball tells what it does, so the agent can use one that it has never tried.
PROBE_ATTEMPTS = 8  # [code] launches of a ball that misses the tool; the last one is kept
PROBE_STEPS = 90  # [code] physics steps per launch
PROBE_EVERY = 10  # [code] a state is recorded after steps 10, 20, ..., 90
PROBE_LENGTH = 7  # A.3 "ball trajectories of length 7", cut out of the 9 recorded states
PROBE_SPEED = 12.5  # [code] units/s
PROBE_AREA = 0.7  # [code] norm: the tool stands in [-0.7, 0.7]^2
PROBE_VIDEO = 48  # appendix: 48x48 in A.3 and D.3.1, 84x84 in B; [code] 48x48; [here] as A.3
PROBE_BALL = ball("Marker", 0, 0).tool
CELL = 1_000.0  # [here] units: the launches of a tool share one space, too far apart to meet
# For hvae.py: it divides differences between states by `step`; first states stay as they are.
# [here] 4 units, 4 / 42 norm: hvae.py keeps the decoder's standard deviation above exp(-2) = 0.135
# steps, which is then half a unit, half a pixel of the observation.
UNITS = dict(centre=0.0, half_width=1.0, step=4 / 42)


def action_observations(action_ids, num_observations, modality="state", seed=0, workers=1):
    """Trajectories of a probe ball launched at each tool, an array (A.3 action observations, B).

    | modality | result                                                                           |
    |----------|----------------------------------------------------------------------------------|
    | "state"  | float32 (len(ids), n, 7, 6): tool x, y, ball x, y (norm), ball velocity (norm/s) |
    | "xy"     | float32 (len(ids), n, 7, 2): ball x, y (norm)                                    |
    | "video"  | uint8 (len(ids), n, 7, 48, 48): grey pictures of the same scenes                 |
    appendix: (x, y); [code] learned the published tables from "state"; [here] as [code].
    n = `num_observations` (paper: 1,024). Frames are 1/3 s apart, the contact in the middle where
    it can be. The bytes for one tool depend on (seed, tool, n) only, not on `workers` or other ids.
    "video" needs 16 MB per tool at n = 1,024. Raises ValueError for bad ids, modality or n.
    """
    check_ids(action_ids)
    shapes = {"xy": (2,), "state": (6,), "video": (PROBE_VIDEO, PROBE_VIDEO)}
    if modality not in shapes:
        raise ValueError(f"unknown modality {modality!r}; allowed: {', '.join(MODALITIES)}")
    if num_observations < 1:
        raise ValueError(f"{num_observations} observations, must be at least 1")
    shape = (len(action_ids), num_observations, PROBE_LENGTH, *shapes[modality])
    result = np.empty(shape, np.uint8 if modality == "video" else np.float32)
    record = partial(_record, num_observations, modality, seed)
    ids = np.asarray(action_ids).tolist()
    # In several processes or in this one. disable=None: no bar where nobody watches (a log file).
    with multiprocessing.Pool(workers) if workers > 1 else nullcontext() as pool:
        recordings = pool.imap(record, ids, chunksize=4) if pool else map(record, ids)
        for row, recording in enumerate(tqdm(recordings, "probe ball", len(ids), disable=None)):
            result[row] = recording
    return result


def _record(n: int, modality: str, seed: int, action: int) -> np.ndarray:
    """All observations of one tool: launch n balls; again those that missed or began inside."""
    tool = TOOLS[action]
    rng = np.random.default_rng([seed, action])
    places = rng.uniform(-PROBE_AREA, PROBE_AREA, (n, 2))  # norm, of the tool in each trajectory
    trajectories = np.zeros((n, PROBE_LENGTH, 7), np.float32)  # 6 of "state" and a plank's angle
    missing = np.arange(n)  # trajectories that are still to be recorded
    attempt = 0
    while len(missing):
        # From anywhere a ball flies towards the tool, faster from afar and after misses [code].
        start = rng.uniform(-1.0, 1.0, (len(missing), 2))
        gap = places[missing] - start
        distance = np.linalg.norm(gap, axis=1, keepdims=True)  # (missing, 1)
        speed = PROBE_SPEED * (1 + 0.4 * min(attempt, PROBE_ATTEMPTS - 1)) * (1 + distance)
        speed *= rng.uniform(0.6, 1.4, (len(missing), 1))
        velocity = speed * gap / np.maximum(distance, 1e-9)
        states, touched_at = _launch(tool, places[missing], start, velocity)

        # `touched_at`: 0 = started inside the tool, always launch again; 1..90 = step of the first
        # touch, keep; 91 = a miss, launch again, but from the 8th launch on keep it.
        hit = touched_at <= PROBE_STEPS
        done = (touched_at > 0) & (hit | (attempt >= PROBE_ATTEMPTS - 1))

        # Keep 7 of 9 states, starting 3 before the touch, clipped to a start of 0..2; after a miss
        # start at 1. So touches at steps 31 to 60 are in the middle.
        touch = (touched_at[done] - 1) // PROBE_EVERY  # the first state recorded at it or later
        first = np.where(hit[done], np.clip(touch - 3, 0, 2), 1)
        columns = first[:, None] + np.arange(PROBE_LENGTH)  # (done, 7)
        trajectories[missing[done]] = np.take_along_axis(states[done], columns[..., None], axis=1)
        missing = missing[~done]
        attempt += 1
    if modality == "video":
        return _film(tool, trajectories)
    return trajectories[..., 2:4] if modality == "xy" else trajectories[..., :6]


def _launch(tool: Tool, places, start, velocity) -> tuple[np.ndarray, np.ndarray]:
    """Launch m balls at m copies of a tool, each pair in its own cell of one big space.

    places, start (m, 2) norm; velocity (m, 2) units/s -> states (m, 9, 7) float32, the last number
    a plank's angle; the step of the first contact (m,), 0 if they overlap at launch, 91 for none.
    """
    m = len(places)
    offsets = CELL * np.stack(np.divmod(np.arange(m), ceil(sqrt(m))), axis=1)  # (m, 2) units
    space = make_space()

    # A rule for a ball and whatever it touches; the rules of `make_space` act as well.
    def on_touch(arbiter, space, data) -> None:
        arbiter.shapes[0].owner.touched = True

    space.on_collision(MOVING, begin=on_touch)
    tools = []
    for place in (to_units(places) + offsets).tolist():
        tools.append(SceneObject(tool, Vec2d(*place), space.static_body))
        space.add(*tools[-1].parts)
    probes = []
    for place, speed in zip((to_units(start) + offsets).tolist(), velocity.tolist(), strict=True):
        probes.append(SceneObject(PROBE_BALL, Vec2d(*place), space.static_body))
        probes[-1].body.velocity = tuple(speed)
        space.add(*probes[-1].parts)
    overlap = [bool(space.shape_query(probe.shape)) for probe in probes]  # does not find itself

    states = np.zeros((m, PROBE_STEPS // PROBE_EVERY, 7), np.float32)
    states[..., :2] = places[:, None]
    touched_at = np.ones(m, int)  # grows with every step until the ball touches the tool
    for step in range(1, PROBE_STEPS + 1):
        space.step(DT)
        touched_at += [not probe.touched for probe in probes]
        if step % PROBE_EVERY == 0:
            now = states[:, step // PROBE_EVERY - 1]  # (m, 7), a view
            now[:, 2:4] = ([probe.body.position for probe in probes] - offsets) * 2 / WORLD - 1
            # [code] maps velocities like positions (v/42 - 1, a slip); [here] v/42
            now[:, 4:6] = np.array([probe.body.velocity for probe in probes]) * 2 / WORLD
            now[:, 6] = [one.body.angle if one.body else 0.0 for one in tools]
    touched_at[overlap] = 0
    return states, touched_at


def _film(tool: Tool, trajectories: np.ndarray) -> np.ndarray:
    """The scenes of one tool's trajectories (n, 7, 7) as pictures, uint8 (n, 7, 48, 48)."""
    video = np.empty((*trajectories.shape[:2], PROBE_VIDEO, PROBE_VIDEO), np.uint8)
    for index in np.ndindex(video.shape[:2]):
        *places, _, _, angle = trajectories[index].tolist()
        tool_x, tool_y, ball_x, ball_y = map(to_units, places)
        canvas = Canvas(PROBE_VIDEO, in_colour=False)
        draw(canvas, tool, Vec2d(tool_x, tool_y), angle)
        draw(canvas, PROBE_BALL, Vec2d(ball_x, ball_y))
        video[index] = canvas.picture()
    return video


# ---- pictures for people (Figures 3 and 7), a window to play in, and the command ----


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


def play_episode(env: CreateEnv, seed: int) -> tuple[list[np.ndarray], float, bool]:
    """A random episode: (frames, return, goal reached)."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    frames = env.render_frames()
    total = 0.0
    over = False
    while not over:
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total += reward
        over = terminated or truncated
        frames += env.render_frames()
    return frames, total, bool(info[METRIC])


def portraits(tools: Sequence[Tool], columns: int, units: float = 36.0) -> np.ndarray:
    """Tools in rows, each in the middle of so many units; uint8 (600, 600, 3)."""
    canvas = Canvas(600, in_colour=True, units=units * columns)
    for number, tool in enumerate(tools):
        row, column = divmod(number, columns)
        draw(canvas, tool, Vec2d(column + 0.5, columns - row - 0.5) * units)
    return canvas.picture()


def draw_sheet(name: str, pool: np.ndarray):
    """A matplotlib figure: "tasks", "tools", or "probe" with three tools of `pool`."""
    os.environ.pop("MPLBACKEND", None)  # a notebook sets it to one that may not be installed here
    from matplotlib.figure import Figure  # here, so that training does not need it

    pictures = {}  # title: square picture
    if name == "tasks":  # Figure 7: every task as it starts
        for task in TASKS:
            env = CreateEnv(task=task, render_mode="rgb_array")
            env.reset(seed=0)
            pictures[task] = env.render()[:PICTURE_SIZE, :PICTURE_SIZE]  # the scene
    elif name == "tools":  # four tools of each class, spread over its ids
        for label in TOOL_CLASSES:
            ids = np.flatnonzero((action_labels() == label) & IS_COARSE)
            four = ids[len(ids) // 10 :: ceil(len(ids) / 4)]
            pictures[label] = portraits([TOOLS[action] for action in four], columns=2)
    else:  # three tools from all over the pool, each alone in the world
        ids = np.unique(pool[[len(pool) // 8, len(pool) // 2, -1]])
        for action in ids:
            title = f"{TOOLS[action].kind}, id {action}"
            pictures[title] = portraits([TOOLS[action]], columns=1, units=WORLD)

    columns = min(len(pictures), 4)
    rows = ceil(len(pictures) / columns)
    sheet = Figure(figsize=(3 * columns, 3.3 * rows), layout="constrained")
    for number, (title, picture) in enumerate(pictures.items()):
        axes = sheet.add_subplot(rows, columns, number + 1)
        axes.imshow(picture, extent=(0, WORLD, 0, WORLD))
        axes.set(title=title, xticks=[], yticks=[])
    if name == "probe":  # trajectories, moved so that the tool stands in the middle
        recordings = action_observations(ids, 40, "state")  # (tools, 40, 7, 6)
        for axes, states in zip(sheet.axes, recordings, strict=True):
            x, y = to_units(states[..., 2:4] - states[..., :2]).T  # (7, 40) each
            axes.plot(x, y, ".-", linewidth=0.6, markersize=3)
            axes.set(xlim=(0, WORLD), ylim=(0, WORLD))
    return sheet


def play(env: CreateEnv, seed: int = 0) -> None:
    """Place tools by mouse: click on a tool, then on the scene; space waits."""
    import matplotlib.pyplot as plt  # here, so that no other command needs a display

    figure, (menu, scene) = plt.subplots(1, 2, figsize=(13, 6.5), layout="constrained")
    columns = ceil(sqrt(env.num_available))  # of the menu
    chosen = 0  # place in `available`; that of the no-op
    total = 0.0
    env.reset(seed=seed)

    def show() -> None:
        """To the left the available tools, to the right the last picture of the episode."""
        tools = [TOOLS[action] for action in env.available]
        menu.clear()
        menu.imshow(portraits(tools, columns), extent=(0, columns, columns, 0))
        menu.set(title=f"chosen: {tools[chosen].kind}", xticks=[], yticks=[])
        scene.clear()
        scene.imshow(env.render())
        scene.set(title=f"return {total:.2f}", xticks=[], yticks=[])
        figure.canvas.draw_idle()

    def act(choice, position) -> None:
        """One step. The end of an episode stays in view; the act after it begins the next."""
        nonlocal chosen, total
        if env._over:
            env.reset()
            chosen = 0
            total = 0.0
        else:
            total += env.step({"choice": choice, "position": position})[1]
        show()

    def on_click(event) -> None:
        """In the menu: choose a tool. In the scene: place it."""
        nonlocal chosen
        if event.inaxes is menu:
            number = int(event.ydata) * columns + int(event.xdata)
            chosen = min(number, env.num_available - 1)
            show()
        elif event.inaxes is scene and max(event.xdata, event.ydata) <= PICTURE_SIZE:
            # From pixels to norm. The caption and the policy's pictures are no place for a tool.
            half = PICTURE_SIZE / 2
            act(chosen, (event.xdata / half - 1, 1 - event.ydata / half))

    def on_key(event) -> None:
        if event.key == " ":
            act(0, (0.0, 0.0))

    figure.canvas.mpl_connect("button_press_event", on_click)
    figure.canvas.mpl_connect("key_press_event", on_key)
    show()
    plt.show()


@dataclass
class Args:
    """CREATE: play an episode and write a GIF, or draw tasks, tools or probe trajectories."""

    task: Literal[tuple(TASKS)] = "push"  # one of the tasks of Figure 7
    tools: tuple[Literal[TOOL_CLASSES], ...] = ()  # available are only tools of these classes
    seed: int = 0  # of the first episode: level, available tools, random actions
    tries: int = 400  # random episodes played; the one with the best return is drawn
    play: bool = False  # open a window and place the tools yourself
    # draw the tasks (Figure 7), tools of every class, or probe-ball trajectories over three tools
    sheet: Literal["tasks", "tools", "probe"] | None = None
    out: Path = Path("runs/demo")  # folder for the pictures


def main(args: Args) -> None:
    """Draw what was asked for and say where it is."""
    pool = split_actions()["train"]
    if args.tools:
        pool = np.flatnonzero(np.isin(action_labels(), args.tools) & IS_COARSE)
    num_available = min(NUM_AVAILABLE, len(pool) + 1)
    env = CreateEnv(pool, num_available, "rgb_array", args.task)
    if args.play:
        play(env, args.seed)
        return
    if args.sheet:
        args.out.mkdir(parents=True, exist_ok=True)
        path = args.out / f"create_{args.sheet}.png"
        draw_sheet(args.sheet, pool).savefig(path)
        print(f"wrote {path}")
        return

    # Find the best episode without pictures, then play it again with pictures.
    blind = CreateEnv(pool, num_available, task=args.task)
    results = [play_episode(blind, args.seed + number)[1:] for number in range(args.tries)]
    goals = sum(reached for _, reached in results)
    print(f"{goals} of {args.tries} random episodes reach the goal")
    best = args.seed + results.index(max(results))
    frames, total, _ = play_episode(env, best)
    path = args.out / f"create_{args.task}.gif"
    save_gif(path, frames, env.metadata["render_fps"])
    print(f"best episode: seed {best}, return {total:.2f}; wrote {path}")


if __name__ == "__main__":
    main(tyro.cli(Args))
