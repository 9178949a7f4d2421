"""CREATE, the Chain REAction Tool Environment (appendix A.3, B, C.1, C.3 and Table 1).

A two-dimensional physics puzzle. Balls fall; every 40 physics steps the agent picks one of the
tools on offer and a place to put it, so that the red target ball reaches the green goal. Twelve
tasks, 2,111 tools (and 6,248 more for the Full split and the analyses).

    python create_env.py --task push            # the best of 400 random episodes as a GIF (5 s)
    python create_env.py --all-tasks            # Figure 7: the 12 tasks on one sheet
    python create_env.py --show-tools           # one tool of each class
    python create_env.py --show-probe Cannon    # probe-ball trajectories over a tool (class or id)

Paper map
    A.3 actions              _generate_tools(), TOOLS         A.3 state     observation_picture()
    A.3 splits, Table 1      split_actions()                  A.3 eq. (3)   CreateEnv._reward()
    A.3 action observations  action_observations()            B (labels)    action_labels()
    C.1, Figure 7            TASKS                            C.3           subgoal_reward=False

Units: the world is a square of 84 x 84 units, one unit per pixel of the observation, x to the
right, y up, origin in the lower left corner. "norm" means agent coordinates: unit = (norm + 1) 42.
Angles are degrees counter-clockwise in the tables and radians in the physics.
"""

import enum
import hashlib
import math
import multiprocessing
import operator
import os
import zipfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
import pymunk
import pymunk.batch
import tyro
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

try:  # see `advance`; a private name of pymunk's, so it may be gone one day
    from pymunk._chipmunk import lib as chipmunk
except ImportError:
    chipmunk = None

# ---- constants ----

WORLD = 84.0  # A.3: the screen is 84 x 84; published code: physics units are its pixels
GRAVITY = (0.0, -2.0)  # published code, units/s^2
DT = 1 / 30  # published code, seconds per physics step
SUBSTEPS = 40  # A.3 "acts every 40 physics simulation steps"
SLEEP_TIME = 0.3  # published code, s: a ball at rest this long is put to sleep
MAX_ACTIONS = 30  # A.3 and Table 3 "max. episode length"
NUM_AVAILABLE = 50  # Table 3 "actions per episode"
NUM_FRAMES = 3  # A.3 "past 3 frames are stacked channel-wise"

LAMBDA_ALIVE = 0.01  # eq. (3)
LAMBDA_GOAL = 10.0  # eq. (3)
LAMBDA_SUBGOAL = 2.0  # eq. (3)
LAMBDA_TARGET_HIT = 1.0  # eq. (3); the task table sets 2.0 for obstacle, as the published code does
LAMBDA_INVALID = -0.01  # eq. (3)
LAMBDA_OVERLAP = -0.01  # eq. (3)

MIN_TOOL_GAP = (
    0.3  # published code: norm distance between tool centres at or below which is "overlap"
)
STILL_SPEED = 0.05  # published code, units/s: slower than this is "not moving"
STILL_ACTIONS = (
    2  # published code: action ends without motion (not necessarily in a row) until "over"
)
HIT_DISTANCE = 0.03  # published code: target counts as hit after this share of the screen diagonal

BALL_RADIUS, BALL_MASS = 4.0, 10.0  # published code: target, marker, goal and probe ball
PLANK_MASS, PLANK_MOMENT = 10.0, 10_000.0  # published code: levers and see-saws, very sluggish
LADDER_ANGLE = 95.0  # published code, degrees
BELT_LIFT = 4.0  # published code: a ladder multiplies the sideways part of its motion by this

FRAMES_PER_ACTION = 5  # ours: pictures per action in GIFs; divides 40

METRIC = "success"  # the goal was reached in the episode (0 or 1)
MODALITIES = ("xy", "state", "video")  # B: (x, y) of the ball is the default


class Contact(enum.IntEnum):
    """Collision types: which pairs of shapes have a rule of their own (see `Scene`)."""

    PLAIN = 0
    MOVING = 1  # balls and loose boxes
    CANNON = 2
    FAN = 3
    BELT = 4
    FUNNEL = 5
    BUCKET = 6
    LADDER = 7
    PLANK = 10
    GOAL = 15


# ---- A.3 actions: what a tool is ----


class Tool(NamedTuple):
    """One tool, or one object of a level. Parameters a class does not use are 0."""

    kind: str
    elasticity: float = 0.0
    angle: float = 0.0  # degrees
    size: float = 0.0  # length of segments and planks, radius of balls, circumradius of the others
    # of levers and see-saws: see `_on_plank`; of ramps a feature of `engineered_representations`
    # alone, their physics has `Kind.friction`
    friction: float = 0.0
    max_angle: float = 0.0  # degrees, see-saws
    mass: float = 0.0  # weight on one end of a see-saw; mass of level balls and boxes
    on_left: bool = False  # which end of a see-saw starts up, with the weight on the other one
    force: float = 0.0  # cannon (impulse), fan (force)
    speed: float = 0.0  # belt and ladder, units/s


class Kind(NamedTuple):
    """What all tools of one kind share."""

    family: str  # how it is built and drawn
    contact: Contact = Contact.PLAIN
    friction: float = 1.0  # the contact law multiplies: tool friction x ball friction (1)
    grey: int = 159  # observation; nominal grey of the published picture
    colour: str = "#fa8535"  # human picture; close to the published palette
    sides: int = 0
    radius: float = 0.0  # half thickness of segments


ORANGE, BLUE, PLANK_ORANGE = "#fa8535", "#086788", "#fa9149"  # published palette
KINDS: dict[str, Kind] = {
    # tools, static unless they are planks; published code never sets the friction of balls, planks
    "No-op": Kind("nothing"),
    "Ramp": Kind("segment", grey=159, colour=ORANGE, radius=1.0),
    "Trampoline": Kind("segment", grey=99, colour="#3d5a98", radius=1.0),
    "Triangle": Kind("polygon", grey=159, colour=ORANGE, sides=3),
    "Bouncy Triangle": Kind("polygon", grey=78, colour=BLUE, sides=3),
    "Square": Kind("polygon", grey=159, colour=ORANGE, sides=4),
    "Bouncy Square": Kind("polygon", grey=78, colour=BLUE, sides=4),
    "Pentagon": Kind("polygon", grey=159, colour=ORANGE, sides=5),
    "Bouncy Pentagon": Kind("polygon", grey=78, colour=BLUE, sides=5),
    "Hexagon": Kind("polygon", grey=159, colour=ORANGE, sides=6),
    "Bouncy Hexagon": Kind("polygon", grey=78, colour=BLUE, sides=6),
    "Hinged See-saw": Kind("plank", Contact.PLANK, 0.0, grey=168, colour=PLANK_ORANGE),
    "See-saw": Kind("plank", Contact.PLANK, 0.0, grey=168, colour=PLANK_ORANGE),
    "Cannon": Kind("box", Contact.CANNON, grey=107, colour="#b3392f"),
    "Fan": Kind("box", Contact.FAN, grey=117, colour="#3f7cac"),
    "Funnel": Kind("polygon", Contact.FUNNEL, grey=146, colour="#8d99ae", sides=3),
    "Bucket": Kind("polygon", Contact.BUCKET, grey=136, colour="#b5651d", sides=4),
    "Ball": Kind("disc", friction=0.0, grey=159, colour=ORANGE),
    "Bouncy Ball": Kind("disc", friction=0.0, grey=78, colour=BLUE),
    "Lever": Kind("plank", Contact.PLANK, 0.0, grey=168, colour=PLANK_ORANGE),
    "Conveyor Belt": Kind("segment", Contact.BELT, grey=121, colour="#4a4e69", radius=1.0),
    # level objects
    "Target": Kind("ball", Contact.MOVING, grey=138, colour="#f45b69"),
    "Basketball": Kind("ball", Contact.MOVING, grey=132, colour="#e8772e"),
    "Marker": Kind("ball", Contact.MOVING, grey=163, colour="#79addc"),
    "Goal ball": Kind("ball", Contact.MOVING, grey=191, colour="#5fd32a"),
    "Heavy ball": Kind("ball", Contact.MOVING, grey=0, colour="#2b2d42"),
    "Box": Kind("crate", Contact.MOVING, grey=131, colour="#b08968"),
    "Goal star": Kind("polygon", Contact.GOAL, grey=191, colour="#5fd32a", sides=5),
    "Basket": Kind("basket", Contact.GOAL, grey=188, colour="#e07a5f"),
    "Subgoal": Kind("disc", Contact.GOAL, grey=233, colour="#d3feb9"),
    "Thin line": Kind("segment", grey=118, colour="#4682b4", radius=0.0),  # thickness 1
    "Line": Kind("segment", grey=118, colour="#4682b4", radius=1.0),  # thickness 2 and 2.5
    "Boundary": Kind("segment", grey=193, colour="#b0c4de", radius=1.0),
    "Ladder": Kind("segment", Contact.LADDER, grey=163, colour="#a47148", radius=1.0),
}
SENSORS = (Contact.CANNON, Contact.FAN, Contact.BELT, Contact.LADDER, Contact.GOAL)

SOFT, BOUNCY = (0.1, 0.3, 0.5), (0.8, 1.0, 1.2)  # published code: the two elasticity ranges
SOFT_FINE, BOUNCY_FINE = (0.1, 0.2, 0.3, 0.4, 0.5), (0.8, 0.9, 1.0, 1.1, 1.2)
# A full turn of a class: the angle after which the shape repeats. Angles run over [0, turn) in
# steps of 15 degrees, which is the appendix's "no two tools are within 15 degrees difference of
# each other" (but for pentagons: 60 degrees is 12 from the next 0).
TURN = {"Ramp": 180, "Trampoline": 180, "Cannon": 360, "Fan": 360, "Funnel": 360, "Bucket": 360}
for _sides, _name in ((3, "Triangle"), (4, "Square"), (5, "Pentagon"), (6, "Hexagon")):
    TURN[_name] = TURN[f"Bouncy {_name}"] = 360 // _sides
ANALYSIS_KINDS = ("Ramp", "Trampoline", "Triangle", "Bouncy Triangle", "Hinged See-saw", "See-saw")
ANALYSIS_KINDS += ("Cannon", "Fan", "Funnel", "Bucket")  # published code


def _angled_tools(kind: str, step: int) -> list[Tool]:
    """All tools of one class that has an angle (see-saws: a largest one), `step` degrees apart."""
    if kind == "Hinged See-saw":
        return [
            Tool(kind, size=size, max_angle=m, friction=f)
            for size in (12, 14, 16, 18, 20)
            for m in range(5, 90, step)
            for f in (1.0, 1.05, 1.1)
        ]
    if kind == "See-saw":
        return [
            Tool(kind, size=size, max_angle=m, on_left=left, mass=mass, friction=1.0)
            for size in (12, 14, 16, 18, 20)
            for m in range(5, 60, step)
            for left in (True, False)
            for mass in (2, 6, 10, 14)
        ]
    angles = range(0, TURN[kind], step)
    if kind in ("Ramp", "Trampoline"):
        levels, mu = (SOFT, 1.0) if kind == "Ramp" else (BOUNCY, 0.0)
        lengths = (6, 10, 14, 18, 22)
        return [Tool(kind, e, a, s, mu) for e in levels for a in angles for s in lengths]
    if kind in ("Cannon", "Fan"):
        forces = range(60, 121, 10) if kind == "Cannon" else range(30, 121, 15)
        return [Tool(kind, angle=a, force=f) for a in angles for f in forces]
    if kind in ("Funnel", "Bucket"):
        return [Tool(kind, angle=a, size=r) for a in angles for r in (3, 5, 7, 9, 11)]
    levels = BOUNCY if kind.startswith("Bouncy") else SOFT
    if kind.endswith("Square"):  # published code drops the one that equals an axis-aligned box
        angles = [a for a in angles if a != 45]
    return [Tool(kind, e, a, r) for a in angles for e in levels for r in range(3, 10)]


def _generate_tools() -> tuple[list[Tool], int, int]:
    """The whole action set, in the order that fixes the ids; and where its first two parts end.

    id 0 is the no-op; 1..2,110 the tools of the Default Split (with the no-op the 2,111 of A.3);
    2,111..2,325 the classes that only the Full Split uses; the rest only the analyses at 3 degrees.
    """
    tools = [Tool("No-op")]
    for kind in list(KINDS)[1 : list(KINDS).index("Ball")]:
        tools += _angled_tools(kind, 15)
    # appendix: lists lever, ball and belt among the 2,111; published code: its 2,111 ids hold none
    # of them (with them there would be 2,326). We keep 2,111 and give the others the ids after it.
    num_default = len(tools)
    tools += [Tool("Ball", e, size=r) for e in SOFT_FINE for r in (3, 5, 7, 9)]
    tools += [Tool("Bouncy Ball", e, size=r) for e in BOUNCY_FINE for r in (3, 5, 7, 9)]
    lever_friction = [round(1 + f / 100, 2) for f in range(11)]
    tools += [
        Tool("Lever", size=s, friction=f) for s in (6, 12, 18, 24, 30) for f in lever_friction
    ]
    speeds = (1, 2, 3, 4, 5, 6, -1, -2, -3, -4, -5, -6)
    tools += [Tool("Conveyor Belt", size=s, speed=v) for s in range(6, 25, 2) for v in speeds]
    num_base, known = len(tools), set(tools)
    for kind in ANALYSIS_KINDS:
        tools += [tool for tool in _angled_tools(kind, 3) if tool not in known]
    return tools, num_default, num_base


TOOLS, NUM_DEFAULT, _NUM_BASE = _generate_tools()
NUM_ACTIONS = len(TOOLS)  # 8,359 distinct tools over all splits
NO_OP = 0


def action_labels() -> np.ndarray:
    """Class of every tool, (NUM_ACTIONS,) of str: the names of Table 1, both see-saws as one."""
    merged = {"Hinged See-saw": "See-saw"}
    return np.array([merged.get(tool.kind, tool.kind) for tool in TOOLS])


def engineered_representations() -> np.ndarray:
    """Ground-truth features of every tool, float32 (NUM_ACTIONS, 30) (published code; section B).

    One-hot of the 21 classes in alphabetical order, then elasticity, angle (rad), size, friction,
    largest angle (rad), weight, on_left, force, speed, standardised over the 2,326 tools that are
    15 degrees apart (over the 2,111 alone the speed would be constant).
    """
    # published code: 23 classes (two box classes that no split uses) in an order that changes from
    # run to run; we sort and leave the boxes out.
    classes = sorted({tool.kind for tool in TOOLS})
    one_hot = np.array([[tool.kind == name for name in classes] for tool in TOOLS], np.float64)
    numbers = np.array([tool[1:] for tool in TOOLS], np.float64)  # (NUM_ACTIONS, 9)
    numbers[:, [1, 4]] = np.radians(numbers[:, [1, 4]])
    base = numbers[:_NUM_BASE]
    numbers = (numbers - base.mean(axis=0)) / base.std(axis=0)
    return np.concatenate([one_hot, numbers], axis=1).astype(np.float32)  # (NUM_ACTIONS, 30)


# ---- A.3 action set splits, Table 1 ----

# Default Split: one draw of angles per group, so that a bouncy triangle never shares its angle
# across training and testing with a plain one.
SPLIT_GROUPS = (
    ("Ramp", "Trampoline"),
    ("Triangle", "Bouncy Triangle"),
    ("Square", "Bouncy Square"),
    ("Pentagon", "Bouncy Pentagon"),
    ("Hexagon", "Bouncy Hexagon"),
    *((name,) for name in ("Hinged See-saw", "See-saw", "Cannon", "Fan", "Funnel", "Bucket")),
)
FULL_TRAIN = ("Ramp", "Trampoline", "Ball", "Bouncy Ball", "See-saw", "Cannon", "Bucket")  # Table 1
FULL_TEST = ("Triangle", "Bouncy Triangle", "Lever", "Fan", "Conveyor Belt", "Funnel")  # Table 1
SPLITS = ("default", "full", "analysis")


def primary_values() -> np.ndarray:
    """What tools are split by, int64 (NUM_ACTIONS,) degrees: angle, or a see-saw's limit."""
    return np.array([tool.max_angle or tool.angle for tool in TOOLS], np.int64)


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Train, validation and test ids, each a sorted int64 array (A.3, Table 1).

    | split    | train | valid | test  | training tools                                            |
    |----------|-------|-------|-------|-----------------------------------------------------------|
    | default  | 1,098 | 507   | 507   | half of the angles of each class                          |
    | full     | 939   | 400   | 400   | by tool class, Table 1                                    |
    | analysis | 762   | 3,397 | 3,398 | multiples of 30 degrees, out of the pool at 3 degrees     |

    The sets are disjoint except for the no-op (id 0), which is always on offer: as in the published
    arrays it counts once in train and once in the held-out half (here in test).
    Raises ValueError for an unknown split, or a seed that is no whole number from 0 on.
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; allowed: {', '.join(SPLITS)}")
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed must be a whole number, 0 or more, got {seed!r}")
    rng = np.random.default_rng(seed)
    kinds, labels, values = (
        np.array([tool.kind for tool in TOOLS]),
        action_labels(),
        primary_values(),
    )
    base = np.arange(NUM_ACTIONS) < _NUM_BASE
    if split == "default":
        pool = np.arange(NUM_ACTIONS) < NUM_DEFAULT
        train = np.zeros(NUM_ACTIONS, bool)
        for group in SPLIT_GROUPS:
            members = pool & np.isin(kinds, group)
            order = rng.permutation(np.unique(values[members]))
            train |= members & np.isin(values, order[: math.ceil(len(order) / 2)])
    elif split == "full":
        train = base & np.isin(labels, FULL_TRAIN)
        pool = train | base & np.isin(labels, FULL_TEST)
    else:
        pool = np.isin(kinds, ANALYSIS_KINDS)  # 7,555 and the no-op; appendix: 7,566 (a misprint)
        # appendix: "at least 15 degrees"; published code: 30 degrees. Only 30 gives its 762 tools.
        tilt = np.where(np.isin(kinds, ("See-saw", "Hinged See-saw")), 5, 0)
        train = pool & ((values - tilt) % 30 == 0)
    held_out = rng.permutation(np.flatnonzero(pool & ~train & (kinds != "No-op")))
    half = math.ceil(len(held_out) / 2)
    train[NO_OP] = True
    return {
        "train": np.flatnonzero(train),
        "valid": np.sort(held_out[:half]),
        "test": np.concatenate([[NO_OP], np.sort(held_out[half:])]),
    }


def angle_gaps(action_ids: Sequence[int], train_ids: Sequence[int]) -> np.ndarray:
    """Degrees to the nearest training tool of the same class, float64 (len(action_ids),).

    Angles wrap at the class's full turn (a ramp at 177 is 3 degrees from one at 0), see-saw limits
    do not. A tool whose class has no training tool is infinitely far, the no-op 0 away. Raises
    ValueError for ids that do not exist.
    """
    # published code: compares with every class at once and without wrapping, so that 345 is 345
    # from 0.
    kinds, values = np.array([tool.kind for tool in TOOLS]), primary_values()
    ids, train_ids = np.asarray(action_ids, np.int64), np.asarray(train_ids, np.int64)
    for some in (ids, train_ids):
        if some.size and (some.min() < 0 or some.max() >= NUM_ACTIONS):
            raise ValueError(f"ids must be 0..{NUM_ACTIONS - 1}, got {some.min()}..{some.max()}")
    gaps = np.full(len(ids), np.inf)
    for kind in np.unique(kinds[ids]):
        here, known = kinds[ids] == kind, values[train_ids[kinds[train_ids] == kind]]
        if kind == "No-op" or len(known) == 0:
            gaps[here] = 0.0 if kind == "No-op" else np.inf
            continue
        gap = np.abs(
            values[ids[here]][:, None] - np.unique(known)[None]
        )  # (tools, training angles)
        gaps[here] = np.minimum(gap, abs(TURN.get(kind, 10**6) - gap)).min(axis=1)
    return gaps


# ---- C.1, Figure 7: the 12 tasks as tables ----

Range = tuple[float, float]


class Item(NamedTuple):
    """One object of a level: what, where (norm), and the name of the random shift it shares."""

    tool: Tool
    x: float
    y: float
    shift: str = ""


@dataclass(frozen=True)
class Task:
    """One level. `shifts` maps a name to the ranges (norm) its x and y shifts are drawn from.

    A level with a marker ball (always its first item) wants the target hit before the goal counts.
    """

    items: tuple[Item, ...]
    target: Item
    goal: Item
    shifts: dict[str, tuple[Range, Range]] = field(default_factory=dict)
    subgoals: tuple[
        tuple[float, float], ...
    ] = ()  # for the marker if there is one, else the target
    boundary: str = ""  # of "R" right wall, "L" left wall, "C" ceiling; there is never a floor
    marker_must_hit: bool = False  # target-hit counts only after marker and target have touched
    target_hit_reward: float = LAMBDA_TARGET_HIT
    goal_on_either_side: bool = False  # the goal's x changes sign with probability 1/2
    max_actions: int = MAX_ACTIONS


def _even(x: float, y: float | None = None) -> tuple[Range, Range]:
    """Shift range: x uniform in [-x, x], y in [-y, y] (default the same)."""
    y = x if y is None else y
    return (-x, x), (-y, y)


def _line(x, y, length, angle=0, shift="", kind="Thin line") -> Item:
    return Item(Tool(kind, 0.5, angle, length, 1.0), x, y, shift)


def _wall(x, y, length, shift="", kind="Thin line") -> Item:
    return _line(x, y, length, 90, shift, kind)


def _ball(kind, x, y, shift="", size=BALL_RADIUS, mass=BALL_MASS, elasticity=1.0) -> Item:
    return Item(Tool(kind, elasticity, size=size, friction=1.0, mass=mass), x, y, shift)


def _star(x, y, shift="") -> Item:
    return Item(Tool("Goal star", angle=90, size=4), x, y, shift)


def _crate(x, y) -> Item:
    return Item(Tool("Box", 0.1, size=5, mass=30), x, y)


def _belt(x, y, speed) -> Item:
    return Item(Tool("Conveyor Belt", size=7, speed=speed), x, y)


def _ladder(x, y, length) -> Item:
    return Item(Tool("Ladder", angle=LADDER_ANGLE, size=length, speed=4.0), x, y)


# All numbers: published task files. Positions norm, lengths and radii in units.
TASKS: dict[str, Task] = {
    # results in the main paper
    "push": Task(
        items=(
            _ball("Marker", 0.6, 0.75, "marker"),
            _line(0.1, -0.25, 16, shift="target"),
            _line(-0.7, -0.75, 16, shift="goal"),
        ),
        target=_ball("Target", 0.1, -0.14, "target"),
        goal=_star(-0.7, -0.64, "goal"),
        shifts={"marker": _even(0.2), "target": _even(0.2), "goal": _even(0.2)},
    ),
    "obstacle": Task(
        items=(
            _ball("Marker", -0.8, 0.8, "marker"),
            _line(-0.61, 0.39, 35.6, -30),
            _wall(-0.25, 0.04, 12.7),
            _line(0.07, -0.1, 26),
            _line(-0.8, -0.81, 16),
            _line(0.12, -0.59, 16),
            _line(-0.34, -0.70, 24.5, 22.5),
            _crate(-0.7, 0.3),
            _crate(-0.7, 0.2),
            _wall(-0.6, 0.18, 15),
            _wall(-0.8, 0.18, 15),
            _wall(0.35, 0.8, 15),
            _crate(0.25, 0.93),
            _crate(0.25, 0.83),
            _wall(0.15, 0.8, 15),
        ),
        target=_ball("Target", 0.1, -0.47, "target"),
        goal=_star(-0.9, -0.69),
        shifts={"marker": _even(0.02), "target": _even(0.02, 0.0)},
        subgoals=((0.7, -0.1),),
        boundary="RLC",
        marker_must_hit=True,
        target_hit_reward=2.0,  # appendix: 1; published task file: 2
        max_actions=50,  # appendix: 30; published task file: 50
    ),
    "seesaw": Task(
        items=(
            _ball("Heavy ball", -0.3, 0.5, "ball", mass=30, elasticity=0.1),
            Item(
                Tool("See-saw", size=30, friction=1.0, max_angle=30, mass=1, on_left=True),
                -0.3,
                -0.1,
            ),
            _wall(0.1, -0.7, 40),
            _line(-0.9, -0.3, 20),
        ),
        target=_ball("Target", 0.2, 0.9, "target"),
        goal=_star(-0.8, -0.8),
        shifts={"ball": _even(0.05), "target": _even(0.1)},
        subgoals=((-0.1, -0.45),),
        boundary="RLC",
    ),
    # the other nine, Figure 8
    "navigate": Task(
        items=(
            _ball("Marker", -0.6, 0.75),
            _line(0.1, -0.35, 16, shift="target"),
            _line(-0.65, -0.7, 16, shift="goal"),
            _line(-0.5, 0.1, 40),
        ),
        target=_ball("Target", 0.1, -0.24, "target"),
        goal=_star(-0.65, -0.59, "goal"),
        shifts={"target": _even(0.1), "goal": _even(0.2)},
    ),
    "belt": Task(
        items=(
            _belt(0.55, 0.25, -2.5),
            _belt(0.05, 0.2, -2.5),
            _belt(-0.3, -0.6, 5.0),
            _line(0.41, -0.30, 65, kind="Line"),
            _wall(-0.34, -0.17, 12.7, kind="Line"),
        ),
        target=_ball("Target", 0.75, 0.75, "target", size=3),
        goal=_star(0.5, -0.7, "goal"),
        shifts={"target": _even(0.1), "goal": _even(0.1)},
        subgoals=((-0.6, -0.35), (-0.15, 0.28), (-0.1, -0.5)),
        max_actions=50,  # appendix: 30; published task file: 50
    ),
    "buckets": Task(
        items=(
            _line(-0.48, -0.99, 45),
            _line(-0.75, -0.15, 25),
            _wall(-0.99, -0.7, 45),
            _wall(0.05, -0.7, 45),
            Item(Tool("Bucket", size=4), 0.05, -0.10),
            Item(Tool("Bucket", size=4), -0.45, -0.10),
        ),
        target=_ball("Target", 0.75, 0.75, "target", size=3),
        goal=_star(-0.85, -0.85),
        shifts={"target": _even(0.1)},
        subgoals=((-0.20, -0.10),),
    ),
    "cannon": Task(
        items=(
            _ball("Marker", 0.8, 0.75, "marker"),
            _wall(-0.1, 0.35, 55),
            Item(Tool("Cannon", angle=110, force=140), -0.1, -0.8),
            _line(0.4, 0.0, 8, shift="target"),
        ),
        target=_ball("Target", 0.4, 0.11, "target"),
        goal=_star(-0.7, -0.1, "goal"),
        shifts={"marker": _even(0.1), "target": _even(0.05), "goal": _even(0.05)},
        boundary="RC",
        marker_must_hit=True,
    ),
    "collide": Task(
        items=(_wall(0.0, 0.25, 35),),
        target=_ball("Target", 0.6, 0.7, "target"),
        goal=_ball("Goal ball", -0.6, 0.7, "goal"),
        shifts={"target": _even(0.1), "goal": _even(0.1)},
        boundary="RLC",
    ),
    "moving": Task(
        items=(Item(Tool("Trampoline", 1.0, 0, 16), -0.7, -0.75),),
        target=_ball("Target", 0.6, 0.75, "target"),
        goal=_ball("Goal ball", -0.7, 0.0, "goal"),
        shifts={"target": _even(0.2), "goal": _even(0.0, 0.5)},
    ),
    "ladder": Task(
        items=(
            _ball("Marker", 0.7, 0.75),
            _line(0.35, -0.2, 5, shift="target"),
            _line(-0.75, -0.2, 5, shift="goal"),
            _ladder(-0.1, -0.1, 20),
        ),
        target=_ball("Target", 0.35, -0.09, "target"),
        goal=_star(-0.75, -0.09, "goal"),
        shifts={"target": _even(0.1), "goal": _even(0.2)},
    ),
    "basket": Task(
        items=(_ladder(0.5, -0.4, 15), _ladder(-0.05, 0.0, 15), _ladder(-0.55, 0.35, 15)),
        target=_ball("Basketball", 0.75, 0.75, "target", size=3.5),
        goal=Item(Tool("Basket", size=10), -0.75, 0.65, "goal"),
        shifts={"target": _even(0.1), "goal": _even(0.1)},
        subgoals=((0.35, -0.05), (-0.15, 0.35)),
        max_actions=40,  # appendix: 30; published task file: 40
    ),
    "funnel": Task(
        items=tuple(
            Item(item.tool._replace(angle=side * item.tool.angle), side * item.x, item.y)
            for side in (1, -1)
            for item in (
                _line(-0.56, -0.99, 35.5),
                _line(-0.88, -0.16, 10),
                _line(-0.257, -0.16, 10),
                _wall(-0.99, -0.7, 45),
                _wall(-0.15, -0.7, 45),
                Item(Tool("Funnel", angle=-45, size=8), -0.6, -0.15),
            )
        ),
        target=_ball("Target", 0.0, 0.9, "target"),
        goal=_star(-0.28, -0.8),
        shifts={"target": ((-0.2, 0.05), (-0.2, 0.05))},
        goal_on_either_side=True,
    ),
}
BOUNDARY = {"R": _wall(1, 0, 90, kind="Boundary"), "L": _wall(-1, 0, 90, kind="Boundary")}
BOUNDARY["C"] = _line(0, 1, 90, kind="Boundary")  # no task has a floor


# ---- the physics: objects, and what happens when they touch ----


def to_units(norm: float) -> float:
    """Agent coordinates [-1, 1] -> world units [0, 84]."""
    return (norm + 1.0) * WORLD / 2


class Thing:
    """One object in a scene: its table entry, its place (units), its pymunk parts."""

    __slots__ = ("tool", "kind", "x", "y", "shape", "body", "parts", "corners", "wants", "touched")
    __slots__ += ("holder", "first_contact", "shown", "drawn_at", "stamps")

    def __init__(self, tool: Tool, x: float, y: float):
        self.tool, self.kind, self.x, self.y = tool, KINDS[tool.kind], float(x), float(y)
        self.shape = self.body = None  # pymunk's; a body only if it can move
        self.parts: tuple = ()  # everything to add to the space, bodies first
        self.corners: list = []  # world units; of a plank: in its own frame, the weight third
        self.wants = None  # the ball whose touch this goal, subgoal or marker waits for ...
        self.touched = False  # ... and whether it came; never cleared
        self.holder = None  # the bucket that holds this ball
        self.first_contact = None  # probe balls only: physics step of the first contact
        self.drawn_at, self.stamps = None, []  # cache of the observation's picture
        self.shown = None  # while a past moment is drawn: the pose it had then

    def pose(self) -> tuple[float, float, float]:
        """x, y (units) and angle (rad), now."""
        if self.shown is not None:
            return self.shown
        if self.body is None:
            return self.x, self.y, 0.0
        x, y = self.body.position
        return x, y, self.body.angle


def _ring(x: float, y: float, radius: float, degrees: float, sides: int) -> list:
    """Corners of a regular polygon, the first one step after the one in direction `degrees`."""
    turn = 2 * math.pi / sides
    angles = [math.radians(degrees) + turn * k for k in range(1, sides + 1)]
    return [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]


def _rectangle(x: float, y: float, length: float, width: float, degrees: float) -> list:
    """Corners of a rectangle whose `length` runs along direction `degrees`."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    halves = [(i * length / 2, j * width / 2) for i, j in signs]
    return [(x + c * u - s * v, y + s * u + c * v) for u, v in halves]


# The rest of the geometry. Where the contact rules and the pictures need a corner by its role,
# these are the positions in `corners`: funnel 0 and 2 the mouth, 1 the nozzle; bucket 0 and 3 the
# opening.
FIRST_CORNER = {"Funnel": 30, "Bucket": 45}  # degrees at tool angle 0 (published code)
# appendix: a cannon "re-launches in a fixed direction"; published code: a 7.3 x 10 box frozen at 10
# rad, whatever the aim (two arguments swapped). We turn a 10 x 7.3 box with the aim; same muzzle,
# same shot.
BOX_SIZE = {"Cannon": (10.0, 7.3), "Fan": (6.7, 10.0)}  # published code, (along the aim, across)
# published code: where a cannon puts the ball, times (cos, sin) of the aim: half the sides of its
# unturned box, not of ours, so that every shot is the published one
MUZZLE = (5.0, 3.65)


def _build_static(thing: Thing, body: pymunk.Body) -> pymunk.Shape:
    """Shape of an object that never moves, in world coordinates on the space's static body."""
    tool, kind, x, y = thing.tool, thing.kind, thing.x, thing.y
    if kind.family == "segment":
        half = tool.size / 2
        dx, dy = (half * f(math.radians(tool.angle)) for f in (math.cos, math.sin))
        thing.corners = [(x - dx, y - dy), (x + dx, y + dy)]
        return pymunk.Segment(body, *thing.corners, kind.radius)
    if kind.family == "disc":
        return pymunk.Circle(body, tool.size, (x, y))
    if kind.family == "polygon":
        first = FIRST_CORNER.get(tool.kind, 0)
        thing.corners = _ring(x, y, tool.size, tool.angle + first, kind.sides)
    elif kind.family == "basket":
        thing.corners = _rectangle(x, y, tool.size, tool.size, 0)
    else:
        thing.corners = _rectangle(x, y, *BOX_SIZE[tool.kind], tool.angle)
    return pymunk.Poly(body, thing.corners)


def _build_moving(thing: Thing) -> tuple[pymunk.Body, pymunk.Shape]:
    """Body and shape of a loose ball or crate."""
    tool = thing.tool
    if thing.kind.family == "ball":
        body = pymunk.Body(tool.mass, tool.mass * tool.size**2 / 2)
        shape = pymunk.Circle(body, tool.size)
    else:
        body = pymunk.Body(tool.mass, tool.mass * 2 * tool.size**2 / 12)
        shape = pymunk.Poly.create_box(body, (tool.size, tool.size))
    body.position = thing.x, thing.y
    return body, shape


def _build_plank(thing: Thing, static_body: pymunk.Body) -> None:
    """Lever or see-saw: a plank on a pivot, perhaps with a limit and a weight on its low end."""
    tool, x, y = thing.tool, thing.x, thing.y
    limit, weighted = math.radians(tool.max_angle), tool.mass > 0
    # The tilt of a weighted see-saw is part of the segment; its body starts at angle 0.
    tilt = (-limit if tool.on_left else limit) if weighted else 0.0
    half = tool.size / 2
    thing.body = body = pymunk.Body(PLANK_MASS, PLANK_MOMENT)
    body.position = x, y
    end = (half * math.cos(tilt), half * math.sin(tilt))
    thing.corners = [(-end[0], -end[1]), end]  # in the frame of the plank
    thing.shape = pymunk.Segment(body, *thing.corners, 0.0)
    # published code: a pin joint of length zero and a slide joint; we use the joints made for the
    # purpose (same motion on average, and the centre stays put).
    parts = [body, pymunk.PivotJoint(body, static_body, (x, y))]
    if tool.max_angle:
        parts.append(pymunk.RotaryLimitJoint(static_body, body, -limit - tilt, limit - tilt))
    if weighted:
        weight = pymunk.Body(tool.mass, tool.mass)
        side = 1 if tool.on_left else -1
        at = (0.75 * half * math.cos(limit) * side, -0.75 * half * math.sin(limit))
        weight.position = x + at[0], y + at[1]
        thing.corners.append(at)
        joints = (
            pymunk.PivotJoint(body, weight, tuple(weight.position)),
            pymunk.GearJoint(body, weight, 0.0, 1.0),
        )
        parts += [weight, *joints]
    thing.parts = (*parts, thing.shape)


def build(tool: Tool, x: float, y: float, static_body: pymunk.Body) -> Thing:
    """Make an object at (x, y) units, not yet added to a space. `static_body`: that space's."""
    thing = Thing(tool, x, y)
    kind = thing.kind
    if kind.family == "plank":
        _build_plank(thing, static_body)
    elif kind.family in ("ball", "crate"):
        thing.body, thing.shape = _build_moving(thing)
        thing.parts = (thing.body, thing.shape)
    else:
        thing.shape = _build_static(thing, static_body)
        thing.parts = (thing.shape,)
    shape = thing.shape
    # most planks have friction 1.0, which slows nothing: they need no rule
    plain = kind.contact == Contact.PLANK and tool.friction <= 1.0
    shape.collision_type = int(Contact.PLAIN if plain else kind.contact)
    shape.sensor = kind.contact in SENSORS
    # published code: funnels and buckets 0.5, everything that lists an elasticity its own
    capturing = kind.contact in (Contact.FUNNEL, Contact.BUCKET)
    shape.elasticity = 0.5 if capturing else float(tool.elasticity)
    shape.friction = kind.friction
    shape.thing = thing
    return thing


# Contact rules. pymunk prints and swallows an exception raised inside one, so each is a few plain
# assignments; nothing here may fail. `process_collision` lasts as long as the contact: rules that
# decide anew at every step must write True as well as False.


def _stop(body: pymunk.Body, position: tuple[float, float]) -> None:
    """Put a body somewhere, at rest."""
    body.position, body.velocity, body.force = position, (0.0, 0.0), (0.0, 0.0)
    body.angle = body.angular_velocity = body.torque = 0.0


def _on_goal(arbiter, space, data) -> None:
    """Goals and subgoals remember the touch of the ball they wait for."""
    a, b = (shape.thing for shape in arbiter.shapes)
    if a.wants is b:
        a.touched = True
    if b.wants is a:
        b.touched = True


def _on_belt(arbiter, space, data) -> None:
    ball, belt = arbiter.shapes
    ball.body.velocity = float(belt.thing.tool.speed), 0.0


def _on_ladder(arbiter, space, data) -> None:
    ball, ladder = arbiter.shapes
    speed, angle = ladder.thing.tool.speed, math.radians(LADDER_ANGLE)
    ball.body.velocity = BELT_LIFT * speed * math.cos(angle), speed * math.sin(angle)


def _on_cannon(arbiter, space, data) -> None:
    """Catch the ball and shoot it; only when contact begins, so the shot is not caught again."""
    ball, cannon = (shape.thing for shape in arbiter.shapes)
    if ball.holder is not None:  # by a bucket, for good
        return
    aim, speed = math.radians(cannon.tool.angle), cannon.tool.force / ball.body.mass
    direction = math.cos(aim), math.sin(aim)
    _stop(ball.body, (cannon.x + MUZZLE[0] * direction[0], cannon.y + MUZZLE[1] * direction[1]))
    ball.body.velocity = speed * direction[0], speed * direction[1]


def _on_fan(arbiter, space, data) -> None:
    """Blow with the same force anywhere in the box."""
    ball, fan = arbiter.shapes
    aim, force = math.radians(fan.thing.tool.angle), fan.thing.tool.force
    push = force * math.cos(aim), force * math.sin(aim)
    # published code: force in the frame of the (rolling) ball; its stand-alone release: in the
    # world
    ball.body.apply_force_at_world_point(push, ball.body.position)


def _on_funnel(arbiter, space, data) -> None:
    """A ball on the side of the mouth leaves by the nozzle; from outside a funnel is solid."""
    ball, funnel = (shape.thing for shape in arbiter.shapes)
    left, nozzle, right = (math.dist(ball.body.position, corner) for corner in funnel.corners)
    caught = ball.holder is None and nozzle > left and nozzle > right
    if caught:
        _stop(ball.body, funnel.corners[1])
    arbiter.process_collision = not caught


def _on_bucket(arbiter, space, data) -> None:
    """A ball that comes in by the opening is held in the middle for good."""
    ball, bucket = (shape.thing for shape in arbiter.shapes)
    if ball.holder is None:
        d1, d2, d3, d4 = (math.dist(ball.body.position, corner) for corner in bucket.corners)
        if max(d1, d4) < min(d2, d3):
            ball.holder = bucket
    if ball.holder is bucket:
        # published code: resets the position only, so the ball's speed grows without end while it
        # hangs there; its stand-alone release also stops it, and so do we.
        _stop(ball.body, (bucket.x, bucket.y))
    arbiter.process_collision = ball.holder is None


def _on_plank(arbiter, space, data) -> None:
    """The "friction" of a plank: every step on it slows a ball by the factor 2 - friction."""
    ball, plank = (shape.thing for shape in arbiter.shapes)
    keep = 2.0 - plank.tool.friction
    if ball.kind.family == "ball":
        ball.body.velocity = ball.body.velocity * keep
        ball.body.angular_velocity *= keep


def advance(space: pymunk.Space, steps: int) -> None:
    """So many physics steps of DT, the same as calling space.step(DT) so many times.

    `Space.step` checks new bodies and looks for what a rule has put off until the step is over;
    then it calls the C library, the smaller part of its time. Our rules put nothing off, so after
    the first step the rest can go there directly.
    """
    space.step(DT)
    for _ in range(steps - 1):
        if chipmunk is None:
            space.step(DT)
        else:
            chipmunk.cpSpaceStep(space._space, DT)


def make_space() -> pymunk.Space:
    """An empty world with CREATE's gravity and contact rules, for the game and the probe ball."""
    space = pymunk.Space()  # 10 solver iterations and no damping are pymunk's defaults
    space.gravity, space.sleep_time_threshold = GRAVITY, SLEEP_TIME
    space.on_collision(Contact.GOAL, Contact.MOVING, begin=_on_goal)
    space.on_collision(Contact.MOVING, Contact.MOVING, begin=_on_goal)
    space.on_collision(Contact.MOVING, Contact.BELT, pre_solve=_on_belt)
    space.on_collision(Contact.MOVING, Contact.LADDER, pre_solve=_on_ladder)
    space.on_collision(Contact.MOVING, Contact.CANNON, begin=_on_cannon)
    space.on_collision(Contact.MOVING, Contact.FAN, pre_solve=_on_fan)
    space.on_collision(Contact.MOVING, Contact.FUNNEL, pre_solve=_on_funnel)
    space.on_collision(Contact.MOVING, Contact.BUCKET, pre_solve=_on_bucket)
    space.on_collision(Contact.MOVING, Contact.PLANK, post_solve=_on_plank)
    return space


# ---- A.3 state: the 84 x 84 grey picture ----


def grey_strokes(thing: Thing) -> tuple:
    """What the observation shows of an object: strokes (grey, shape, numbers) in units, y up.

    Shapes: "disc" x y radius, "bar" x1 y1 x2 y2 half-width, "poly" corners. They follow the contact
    shape, plus the marks that tell a direction (muzzle, blowing side, nozzle, opening, belt head).
    """
    # published code: aliased flat shapes and rotated PNGs squeezed into boxes, in a palette of 8
    # bits, the whole picture mirrored left to right; we draw it upright, flat shapes
    # with soft edges (a move of an eighth of a unit is visible) at the same nominal greys.
    tool, kind, grey, corners = thing.tool, thing.kind, thing.kind.grey, thing.corners
    x, y, angle = thing.pose()
    aim = math.radians(tool.angle)
    direction = math.cos(aim), math.sin(aim)
    if kind.family in ("ball", "disc"):
        return ((grey, "disc", (x, y, float(tool.size))),)
    if kind.family == "crate":
        return ((grey, "poly", _rectangle(x, y, tool.size, tool.size, math.degrees(angle))),)
    if kind.family == "segment":
        bar = (grey, "bar", (*corners[0], *corners[1], max(kind.radius, 0.5)))
        if kind.contact != Contact.BELT:
            return (bar,)
        return bar, (grey, "disc", (*corners[tool.speed > 0], 1.8))
    if kind.family == "plank":
        c, s = math.cos(angle), math.sin(angle)
        ends = [(x + c * u - s * v, y + s * u + c * v) for u, v in corners]
        foot = (grey, "poly", [(x, y), (x - 2, y - 2), (x + 2, y - 2)])
        weight = tuple((grey, "disc", (*end, 1.5)) for end in ends[2:])
        return (grey, "bar", (*ends[0], *ends[1], 0.5)), foot, *weight
    edges = list(zip(corners, corners[1:] + corners[:1], strict=True))
    if tool.kind == "Cannon":
        mouth = (x + 3.5 * direction[0], y + 3.5 * direction[1], 1.5)
        return (grey, "poly", corners), (255, "disc", mouth)
    if tool.kind == "Fan":
        tip = (x + 3.35 * direction[0], y + 3.35 * direction[1])
        sides = [(grey, "bar", (*a, *b, 0.5)) for a, b in edges]
        return (*sides, (grey, "bar", (x, y, *tip, 0.8)))
    if tool.kind == "Funnel":
        edges = edges[:2]  # mouth left open
    elif tool.kind == "Bucket":
        edges = edges[:3]
    elif tool.kind != "Basket":
        return ((grey, "poly", corners),)
    return tuple((grey, "bar", (*a, *b, 0.6)) for a, b in edges)


@lru_cache(maxsize=8)
def _pixel_grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """World x of every column and y of every row of a size x size picture (pixel centres)."""
    centres = ((np.arange(size) + 0.5) * WORLD / size).astype(np.float32)
    return centres, centres[::-1].copy()  # row 0 is the top


def signed_distance(shape: str, numbers, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
    """Units from pixels (columns xs, rows ys) to the edge of a stroke, negative inside, (h, w)."""
    if shape == "disc":
        x, y, radius = numbers
        return np.sqrt((xs - x) ** 2 + (ys - y)[:, None] ** 2) - radius
    if shape == "bar":
        x1, y1, x2, y2, half = numbers
        dx, dy = x2 - x1, y2 - y1
        along = ((xs - x1) * dx + ((ys - y1) * dy)[:, None]) / (dx * dx + dy * dy)  # (h, w)
        np.minimum(np.maximum(along, 0.0, out=along), 1.0, out=along)  # half the time of np.clip
        return np.sqrt((xs - x1 - along * dx) ** 2 + ((ys - y1)[:, None] - along * dy) ** 2) - half
    inside = None
    for (x1, y1), (x2, y2) in zip(numbers, [*numbers[1:], numbers[0]], strict=True):
        dx, dy = x2 - x1, y2 - y1  # corners run counter-clockwise: the outside is on the right
        scale = 1.0 / math.hypot(dx, dy)
        edge = (xs - x1) * (dy * scale) - ((ys - y1) * (dx * scale))[:, None]  # (h, w)
        inside = edge if inside is None else np.maximum(inside, edge, out=inside)
    return inside


def _coverage(shape: str, numbers, xs, ys, scale: float) -> np.ndarray:
    """Share of each pixel that a stroke covers (edges one pixel soft), (h, w)."""
    cover = 0.5 - scale * signed_distance(shape, numbers, xs, ys)
    return np.minimum(np.maximum(cover, 0.0, out=cover), 1.0, out=cover)


DISC_PHASES = 8  # ours: discs are kept at eighths of a pixel; pasting one is faster than computing


@lru_cache(maxsize=4096)
def _disc_coverage(radius: float, phase_x: int, phase_y: int, reach: int) -> np.ndarray:
    """Coverage of a disc (pixels) whose centre is `phase` eighths past the middle of the window."""
    middle = np.arange(-reach, reach, dtype=np.float32) + 0.5
    x, y = phase_x / DISC_PHASES, phase_y / DISC_PHASES
    return _coverage("disc", (x, y, radius), middle, middle, 1.0)  # (2 reach, 2 reach)


def _disc_window(numbers, size: int) -> tuple[np.ndarray, int, int]:
    """Coverage of a disc and where its window begins (row, column), not yet cut to the picture."""
    scale = size / WORLD
    column, row, radius = numbers[0] * scale, size - numbers[1] * scale, numbers[2] * scale
    left, phase_x = divmod(round(column * DISC_PHASES), DISC_PHASES)
    top, phase_y = divmod(round(row * DISC_PHASES), DISC_PHASES)
    reach = int(radius) + 2
    return _disc_coverage(radius, phase_x, phase_y, reach), top - reach, left - reach


def stamps(strokes: tuple, size: int) -> list[tuple]:
    """Turn strokes into what `paste` needs: rows, columns, grey x coverage, 1 - coverage."""
    scale = size / WORLD  # pixels per unit
    xs, ys = _pixel_grid(size)
    result = []
    for grey, shape, numbers in strokes:
        if shape == "disc":
            cover, r0, c0 = _disc_window(numbers, size)
            r1, c1 = r0 + len(cover), c0 + len(cover)
            if r0 < 0 or c0 < 0 or r1 > size or c1 > size:
                cover = cover[max(0, -r0) : max(0, size - r0), max(0, -c0) : max(0, size - c0)]
                r0, c0, r1, c1 = max(0, r0), max(0, c0), min(size, r1), min(size, c1)
        else:
            bar = shape == "bar"
            px = numbers[0:4:2] if bar else [corner[0] for corner in numbers]
            py = numbers[1:4:2] if bar else [corner[1] for corner in numbers]
            reach = numbers[4] if bar else 0.0
            c0 = max(0, int((min(px) - reach) * scale - 1))
            c1 = min(size, int((max(px) + reach) * scale + 2))
            r0 = max(0, int(size - (max(py) + reach) * scale - 1))
            r1 = min(size, int(size - (min(py) - reach) * scale + 2))
            if r0 < r1 and c0 < c1:
                cover = _coverage(shape, numbers, xs[c0:c1], ys[r0:r1], scale)  # (h, w)
        if r0 < r1 and c0 < c1:  # else off the screen
            result.append((slice(r0, r1), slice(c0, c1), grey * cover, 1.0 - cover))
    return result


def paste(canvas: np.ndarray, pieces: list[tuple]) -> None:
    """Draw stamps into a square float32 canvas (size, size) of greys, later ones over earlier."""
    for rows, columns, ink, left in pieces:
        window = canvas[rows, columns]
        window *= left
        window += ink


def paint(canvas: np.ndarray, strokes: tuple) -> None:
    """Draw strokes into a square float32 canvas (size, size)."""
    paste(canvas, stamps(strokes, canvas.shape[0]))


# ---- the environment ----


class Placement(enum.IntEnum):
    """What came of placing a tool: `info["placement"]` of every step."""

    PLACED = 0
    NO_OP = 1
    BLOCKED_BY_TOOL = 2  # centre too close to the centre of a tool placed before
    BLOCKED_BY_SHAPE = 3  # would touch something in the scene, goals and subgoals included
    OUTSIDE = 4  # the position is not on the screen


def check_pool(action_pool: Sequence[int] | None, num_available: int) -> np.ndarray:
    """The tools an environment may offer, sorted, without the no-op; ValueError if unusable."""
    pool = np.asarray(split_actions()["train"] if action_pool is None else action_pool)
    if pool.ndim != 1 or not np.issubdtype(pool.dtype, np.integer):
        raise ValueError(
            f"action_pool must be a list of integer ids, got {pool.dtype} {pool.shape}"
        )
    if pool.size and (pool.min() < 0 or pool.max() >= NUM_ACTIONS):
        raise ValueError(
            f"action_pool ids must be 0..{NUM_ACTIONS - 1}, got {pool.min()}..{pool.max()}"
        )
    tools = np.unique(pool).astype(np.int64)
    if len(tools) != len(pool):
        raise ValueError(f"action_pool has {len(pool) - len(tools)} repeated ids")
    tools = tools[tools != NO_OP]
    most, whole = len(tools) + 1, isinstance(num_available, int | np.integer)
    if not whole or not 1 <= num_available <= most:
        raise ValueError(
            f"num_available must be an integer in 1..{most} (the pool's tools and the no-op), "
            f"got {num_available!r}"
        )
    return tools


class CreateEnv(gymnasium.Env):
    """Place tools so that the target ball reaches the goal (appendix A.3).

    ## Description
    A 2-D world of 84 x 84 units with gravity. Every action places at most one tool, then 40 physics
    steps (1.33 s) run. A placed tool stays for the rest of the episode. There is no floor.

    ## Action Space
    `Dict(choice=Discrete(K), position=Box(-1, 1, (2,), float32))`: a position in `available`, and
    where to put the tool's centre (x to the right, y up, in norm). Choice 0 is always the no-op.

    ## Observation Space
    | key       | space                              | meaning                                    |
    |-----------|------------------------------------|--------------------------------------------|
    | state     | Box(0, 255, (3, 84, 84), uint8)    | last 3 grey pictures, newest last; black   |
    |           |                                    | before the episode began                   |
    | available | Box(0, NUM_ACTIONS-1, (K,), int64) | the tools on offer in this episode         |

    `available` is the no-op and K - 1 tools drawn without replacement from the pool at every reset.
    If K is the pool's size (no-op included) there is nothing to draw: the no-op, then the rest of
    the pool in sorted order, so that positions keep their meaning.

    ## Rewards
    0.01 per action; +10 for the goal; +2 for each subgoal once; -0.01 for a blocked placement or
    one outside the screen. In tasks with a marker ball, blue marker -> red target -> green goal
    (Figure 3): +1 (obstacle 2) for the target hit, the target's first move of 3.56 units (obstacle,
    cannon: after the marker touched it); the goal counts only from then on.

    ## Starting State
    The task's level with its random shifts; everything at rest.

    ## Episode End
    Terminated: goal reached; target off the screen; marker off the screen before the target hit;
    nothing moving at the end of two actions. Truncated: 30 actions (obstacle, belt 50; basket 40).
    On the last step `info` has `success` (0.0 or 1.0) and `episode` = {"r", "l"}; on every step
    `placement` (see `Placement`).

    ## Arguments
    `action_pool` ids (default: training split), `num_available` K, `task` one of `TASKS`,
    `subgoal_reward=False` pays neither subgoals nor target-hit (C.3), `tool_cost` is taken off the
    goal and each subgoal per placed tool (0.0; the published curves were made with 0.1),
    `render_size` pixels of the colour picture. Bad arguments or actions raise ValueError and change
    nothing.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}

    def __init__(
        self,
        action_pool: Sequence[int] | None = None,
        num_available: int = NUM_AVAILABLE,
        render_mode: str | None = None,
        task: str = "push",
        subgoal_reward: bool = True,
        tool_cost: float = 0.0,
        render_size: int = 420,
    ):
        if not isinstance(task, str) or task not in TASKS:
            raise ValueError(f"unknown task {task!r}; allowed: {', '.join(TASKS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render_mode {render_mode!r}; allowed: None, 'rgb_array'")
        if not isinstance(subgoal_reward, bool | np.bool_):
            raise ValueError(f"subgoal_reward must be True or False, got {subgoal_reward!r}")
        number = isinstance(tool_cost, float | int | np.floating | np.integer)
        if not (number and 0 <= tool_cost < math.inf):
            raise ValueError(f"tool_cost must be a finite number, 0 or more, got {tool_cost!r}")
        if not isinstance(render_size, int | np.integer) or render_size < 84:
            raise ValueError(f"render_size must be a whole number, 84 or more, got {render_size}")
        self._tools_on_offer = check_pool(action_pool, num_available)
        self._draws = num_available < len(self._tools_on_offer) + 1  # else a fixed, sorted set
        self.task, self.render_mode, self.render_size = TASKS[task], render_mode, render_size
        self.subgoal_reward, self.tool_cost = subgoal_reward, tool_cost
        k = int(num_available)
        self.observation_space = spaces.Dict(
            state=spaces.Box(0, 255, (NUM_FRAMES, 84, 84), np.uint8),
            available=spaces.Box(0, NUM_ACTIONS - 1, (k,), np.int64),
        )
        self.action_space = spaces.Dict(
            choice=spaces.Discrete(k), position=spaces.Box(-1.0, 1.0, (2,), np.float32)
        )
        self._over = True  # no episode yet
        self._level_stamps: dict[tuple, list] = {}

    # -- reset --

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode with a new set of tools; returns (observation, {})."""
        super().reset(seed=seed)
        # published code: the Full split's test draws a class, then a tool of it; we: as in training
        tools, k = self._tools_on_offer, self.action_space["choice"].n
        drawn = self.np_random.choice(tools, k - 1, replace=False) if self._draws else tools
        self._available = np.concatenate([[NO_OP], drawn])  # (K,)
        self._build_level()
        self._centres: list[tuple[float, float]] = []  # norm, of the tools placed so far
        self._goal_hit, self._target_hit = False, self._marker is None
        self._still, self._actions, self._return = 0, 0, 0.0
        self._over = False
        self._trails = [(ball, []) for ball in (self._target, self._marker) if ball is not None]
        self._last = (TOOLS[NO_OP], (0.0, 0.0), Placement.NO_OP)
        self._collected: list[Thing] = []  # subgoals of the last step, for its pictures
        self._page = None
        self._snapshots = [self._poses()]
        self._frames = np.zeros((NUM_FRAMES, 84, 84), np.uint8)
        return self._observe(), {}

    def _build_level(self) -> None:
        """A fresh space with the task's objects; the picture of all that stands still."""
        task, rng = self.task, self.np_random
        shift = {name: [rng.uniform(*r) for r in ranges] for name, ranges in task.shifts.items()}
        shift[""] = (0.0, 0.0)
        self._space, self._things = make_space(), []

        def add(item: Item, side: int = 1) -> Thing:
            dx, dy = shift[item.shift]
            x, y = to_units(side * item.x + dx), to_units(item.y + dy)
            thing = build(item.tool, x, y, self._space.static_body)
            self._space.add(*thing.parts)
            self._things.append(thing)
            return thing

        first = [add(item) for item in task.items][0]
        self._marker = first if first.tool.kind == "Marker" else None
        self._subgoals = [add(Item(Tool("Subgoal", size=3), x, y)) for x, y in task.subgoals]
        for side in task.boundary:
            add(BOUNDARY[side])
        self._target = add(task.target)
        self._goal = add(task.goal, -1 if task.goal_on_either_side and rng.random() < 0.5 else 1)
        self._goal.wants = self._target
        if self._marker is not None:
            self._marker.wants = self._target
        for subgoal in self._subgoals:
            subgoal.wants = self._marker or self._target
        self._start = self._target.pose()[:2]
        self._moving = [thing for thing in self._things if thing.body is not None]
        self._repaint()

    # -- step --

    def step(self, action: dict):
        """Place a tool, run 40 physics steps, settle accounts.

        Raises ValueError for an action that is not a choice in 0..K-1 and two finite numbers, and
        gymnasium's ResetNeeded after the end of an episode.
        """
        choice, x, y = self._read(action)
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over (or none began): call reset()")
        tool = TOOLS[self._available[choice]]
        placement = self._place(tool, x, y)
        self._last = tool, (x, y), placement
        self._simulate()
        self._actions += 1
        paid = self._settle()
        reward = self._reward(placement, *paid)
        terminated, truncated = self._ended()
        self._return += reward
        info = {"placement": int(placement)}
        if terminated or truncated:
            self._over = True
            info[METRIC] = float(self._goal_hit)
            info["episode"] = {"r": self._return, "l": self._actions}
        return self._observe(), reward, terminated, truncated, info

    def _read(self, action: dict) -> tuple[int, float, float]:
        """Check an action completely before anything changes."""
        k = int(self.action_space["choice"].n)
        try:
            choice, position = operator.index(action["choice"]), np.asarray(action["position"])
            if position.shape != (2,) or position.dtype.kind not in "fiu":
                raise TypeError("position")
            x, y = position.tolist()
        except (TypeError, ValueError, KeyError, IndexError) as e:
            raise ValueError(
                "action must be a dict of an integer 'choice' and two numbers 'position', "
                f"got {action!r}"
            ) from e
        if not 0 <= choice < k:
            raise ValueError(f"choice must be 0..{k - 1}, got {choice}")
        if not (math.isfinite(x) and math.isfinite(y)):
            raise ValueError(f"position must be two finite numbers, got ({x}, {y})")
        return choice, x, y

    def _place(self, tool: Tool, x: float, y: float) -> Placement:
        """Put a tool at (x, y) norm if it may stand there."""
        if tool.kind == "No-op":
            return Placement.NO_OP
        # published code: clips the position first, so its invalid penalty never fires; we do not
        if max(abs(x), abs(y)) > 1.0:
            return Placement.OUTSIDE
        # appendix: "overlap over existing objects"; published code: this distance to earlier tools,
        # or contact of the exact shapes with anything in the scene. As published.
        if any(math.dist((x, y), centre) <= MIN_TOOL_GAP for centre in self._centres):
            return Placement.BLOCKED_BY_TOOL
        thing = build(tool, to_units(x), to_units(y), self._space.static_body)
        if self._space.shape_query(thing.shape):  # sensors count
            return Placement.BLOCKED_BY_SHAPE
        self._space.add(*thing.parts)
        self._things.append(thing)
        self._centres.append((x, y))
        if thing.body is None:
            paint(self._canvas, grey_strokes(thing))
        else:
            self._moving.append(thing)
        return Placement.PLACED

    def _simulate(self) -> None:
        """40 physics steps; when someone watches, note where things are on the way."""
        if self.render_mode is None:
            return advance(self._space, SUBSTEPS)
        self._snapshots = []
        for _ in range(FRAMES_PER_ACTION):
            advance(self._space, SUBSTEPS // FRAMES_PER_ACTION)
            self._snapshots.append(self._poses())

    def _settle(self) -> tuple[bool, int, bool]:
        """Who touched what: (goal reached, subgoals reached, target first moved) in this step."""
        moved = False
        if not self._target_hit:
            far = _screen_distance(self._target.pose()[:2], self._start) > HIT_DISTANCE
            if far and (self._marker.touched or not self.task.marker_must_hit):
                self._target_hit = moved = True
        # published code: tests the goal before target-hit, so a goal in the same action counts one
        # action later, or never if the episode ends first
        if self._target_hit and self._goal.touched:
            self._goal_hit = True
        # published code: a subgoal counts if touched at the end of an action; we: at any time in it
        reached = [subgoal for subgoal in self._subgoals if subgoal.touched]
        self._collected = reached
        for subgoal in reached:
            self._space.remove(*subgoal.parts)
            self._things.remove(subgoal)
            self._subgoals.remove(subgoal)
        if reached:
            self._repaint()
        return self._goal_hit, len(reached), moved

    def _reward(self, placement: Placement, goal: bool, subgoals: int, target_moved: bool) -> float:
        """Equation (3). Appendix: products of the bonus terms; published code: sums, as here."""
        cost = self.tool_cost * len(self._centres)  # appendix: none; published code: 0.1 per tool
        reward = LAMBDA_ALIVE
        if placement in (Placement.BLOCKED_BY_TOOL, Placement.BLOCKED_BY_SHAPE):
            reward += LAMBDA_OVERLAP
        if placement == Placement.OUTSIDE:
            reward += LAMBDA_INVALID
        if goal:
            reward += LAMBDA_GOAL - cost
        # C.3 names subgoals; push has none and was run without them all the same, so the reward for
        # the target hit must have been meant too.
        if self.subgoal_reward:
            reward += subgoals * max(0.0, LAMBDA_SUBGOAL - cost)
            reward += target_moved * self.task.target_hit_reward
        return reward

    def _ended(self) -> tuple[bool, bool]:
        """(terminated, truncated) after this action."""
        # appendix: the episode ends at the goal; published code: goes on. As the appendix.
        # appendix: silent about balls that leave; published code: ends, as here.
        lost = not _on_screen(self._target)
        if self._marker is not None and not self._target_hit:
            lost = lost or not _on_screen(self._marker)
        # A ball in a bucket is at rest, though gravity has just added 0.07 to its speed.
        balls = (thing for thing in self._moving if thing.holder is None)
        if all(thing.body.velocity.length < STILL_SPEED for thing in balls):
            self._still += 1
        terminated = self._goal_hit or lost or self._still >= STILL_ACTIONS
        # appendix: 30; published code: one more than its limit. The exact limit.
        return terminated, not terminated and self._actions >= self.task.max_actions

    # -- pictures --

    def _repaint(self) -> None:
        """Rebuild the cached layer of everything that stands still."""
        self._canvas = np.full((84, 84), 255.0, np.float32)  # white
        for thing in self._things:
            if thing.body is None:
                key = thing.tool, thing.x, thing.y  # level objects without a shift come again
                if key not in self._level_stamps:
                    if len(self._level_stamps) >= 256:
                        self._level_stamps.clear()
                    self._level_stamps[key] = stamps(grey_strokes(thing), 84)
                paste(self._canvas, self._level_stamps[key])

    def _observe(self) -> dict[str, np.ndarray]:
        canvas = self._canvas.copy()
        for thing in self._moving:
            x, y, angle = thing.pose()
            # A ball that spins looks the same. What has hardly moved is drawn as the last time.
            turn = 0 if thing.kind.family == "ball" else round(100 * angle)
            key = round(DISC_PHASES * x), round(DISC_PHASES * y), turn
            if key != thing.drawn_at:
                thing.drawn_at, thing.stamps = key, stamps(grey_strokes(thing), 84)
            paste(canvas, thing.stamps)
        picture = (canvas + 0.5).astype(np.uint8)[None]  # (1, 84, 84), rounded
        self._frames = np.concatenate([self._frames[1:], picture])  # (3, 84, 84), a fresh array
        return {"state": self._frames.copy(), "available": self._available.copy()}

    def _poses(self) -> list:
        """Where the moving things are; and one more point on the trails of the balls."""
        for ball, trail in self._trails:
            trail.append(ball.pose()[:2])
        return [(thing, thing.pose()) for thing in self._moving]

    def render(self) -> np.ndarray | None:
        """The scene now, in colour, uint8 (height, render_size, 3); None without render_mode."""
        if self.render_mode and not hasattr(self, "_things"):
            raise gymnasium.error.ResetNeeded("call reset() before the first render()")
        return self.render_frames()[-1] if self.render_mode else None

    def render_frames(self) -> list[np.ndarray]:
        """Pictures of the last step, one every 8 physics steps: 5, or 1 right after a reset.

        None at all without render_mode.
        """
        if self.render_mode is None:
            return []
        if not hasattr(self, "_things"):
            raise gymnasium.error.ResetNeeded("call reset() before the first render_frames()")
        still = [thing for thing in self._things if thing.body is None]
        if self._page is None or self._page[0] != still:  # cached until something is placed
            pen = blank_page(self.render_size)
            for thing in still:
                draw_thing(pen, thing)
            self._page = still, pen.image
        last = len(self._snapshots) - 1
        return [self._draw(poses, k - last) for k, poses in enumerate(self._snapshots)]

    def _draw(self, poses: list, age: int) -> np.ndarray:
        """One picture; `age` 0 is now, -1 the snapshot before."""
        pen = Pen(self.render_size, self._page[1].copy())
        for ball, trail in self._trails:
            draw_trail(pen, trail[: len(trail) + age], ball.kind.colour)
        for thing in self._collected if age < 0 else ():  # there until the action ends
            draw_thing(pen, thing)
        for thing, pose in poses:
            thing.shown = pose
            draw_thing(pen, thing)
            thing.shown = None
        tool, (x, y), placement = self._last
        words, colour = OUTCOME[placement] if self._actions else ("", INK)
        if placement >= Placement.BLOCKED_BY_TOOL:
            x, y = (min(max(to_units(value), 2.0), WORLD - 2.0) for value in (x, y))
            for sign in (-1, 1):
                pen.line([(x - 1.6, y - 1.6 * sign), (x + 1.6, y + 1.6 * sign)], 0.8, colour)
        if self._goal_hit and age == 0:
            words, colour = "goal!", "#2a7f3f"
            pen.disc(self._goal.pose()[:2], 7.5, None, "#5fd32a", 0.8)
        name = tool.kind if self._actions else ""
        draw_caption(pen, f"{self._actions}/{self.task.max_actions}  {name}", words, colour)
        return pen.picture()


def _screen_distance(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Distance of two places (units), clipped to the screen, as a share of its diagonal."""
    a, b = ([min(max(value, 0.0), WORLD) for value in point] for point in (a, b))
    return math.dist(a, b) / (WORLD * math.sqrt(2))


def _on_screen(thing: Thing) -> bool:
    x, y = thing.body.position
    return 0.0 < x < WORLD and 0.0 < y < WORLD


def make_vec(
    num_envs: int,
    action_pool: Sequence[int] | None = None,
    num_available: int = NUM_AVAILABLE,
    seed: int = 0,
    async_envs: bool | None = None,
    **task_options,
) -> VectorEnv:
    """`num_envs` environments as one (SAME_STEP autoreset); `task_options` go to `CreateEnv`.

    `async_envs`: one process per environment (True), all in this process (False), or by the number
    of cores (None). Both give the same bytes. Environment i starts from seed + i; `reset()` without
    a seed continues from there, `reset(seed=s)` reseeds with s + i. ValueErrors as `CreateEnv`.
    """
    for name, value, least in (("num_envs", num_envs, 1), ("seed", seed, 0)):
        if not isinstance(value, int | np.integer) or value < least:
            raise ValueError(f"{name} must be a whole number, {least} or more, got {value!r}")
    CreateEnv(action_pool, num_available, **task_options)  # fail here, not in a worker

    def make(index: int) -> CreateEnv:
        env = CreateEnv(action_pool, num_available, **task_options)
        env.np_random = gymnasium.utils.seeding.np_random(seed + index)[0]
        return env

    # ours: processes cost 2.5 times the processor time (benchmarks/throughput.py, N = 32), so they
    # pay from about four cores on.
    if async_envs is None:
        async_envs = (os.cpu_count() or 1) >= 4 and num_envs > 1
    thunks = [partial(make, index) for index in range(num_envs)]
    vector = AsyncVectorEnv if async_envs else SyncVectorEnv
    return vector(thunks, autoreset_mode=AutoresetMode.SAME_STEP)


gymnasium.register("ActionGen/Create-v0", entry_point=f"{__name__}:CreateEnv")
for _task in TASKS:  # ActionGen/Create-Push-v0 and so on
    gymnasium.register(
        f"ActionGen/Create-{_task.capitalize()}-v0",
        entry_point=f"{__name__}:CreateEnv",
        kwargs={"task": _task},
    )


# ---- A.3 action observations: the probe ball ----

PROBE_ATTEMPTS = 8  # published code: launches until the ball touches the tool
PROBE_STEPS = 90  # published code: physics steps per launch
PROBE_EVERY = 10  # published code: a state is recorded after steps 10, 20, ..., 90
PROBE_LENGTH = 7  # A.3 "ball trajectories of length 7", cut out of the 9 recorded states
PROBE_SPEED = 12.5  # published code, units/s, times U(0.6, 1.4) (1 + 0.4 attempt) (1 + distance)
PROBE_AREA = 0.7  # published code, norm: the tool stands in [-0.7, 0.7]^2
PROBE_VIDEO = 48  # A.3 and D.3.1 (section B says 84)
PROBE_BALL = Tool("Marker", 1.0, size=BALL_RADIUS, friction=1.0, mass=BALL_MASS)
# The no-op has no shape to touch; passing this near to its place counts (published code, norm
# units; there only looked at after steps 30, 60 and 90, here after every step).
NO_OP_REACH = 0.1 * math.sqrt(8)
CACHE_FROM = 2**14  # ours: requests of fewer trajectories (a second) are not worth a file
CELL = 1_000.0  # ours, units: trajectories run side by side in one space, too far apart to meet


def action_observations(
    action_ids: Sequence[int],
    num_observations: int,
    modality: str = "xy",
    seed: int = 0,
    workers: int = 1,
    cache: str | Path | None = "runs/cache",
) -> np.ndarray:
    """Trajectories of a probe ball launched at each tool (A.3 action observations, section B).

    | modality | result                                                                           |
    |----------|----------------------------------------------------------------------------------|
    | "xy"     | float32 (len(ids), n, 7, 2): ball x, y (norm; the paper's default)               |
    | "state"  | float32 (len(ids), n, 7, 6): tool x, y, ball x, y (norm), ball velocity (norm/s) |
    | "video"  | uint8 (len(ids), n, 7, 48, 48): grey pictures of the same trajectories           |

    n = `num_observations` (paper: 1,024). Frames are 1/3 s apart; the contact is near the middle.
    The bytes for one tool depend on (seed, tool, n) only, not on `workers` or the other ids.
    "video" needs 16 MB per tool at n = 1,024: ask for some tools or few trajectories at a time.
    Trajectories of larger requests are kept under `cache` (None: nowhere) and found again.
    Raises ValueError for unknown ids or modality, or numbers below 1.
    """
    ids = np.asarray(action_ids)
    if ids.ndim != 1 or (ids.size and not np.issubdtype(ids.dtype, np.integer)):
        raise ValueError(f"action_ids must be a list of integers, got {ids.dtype} {ids.shape}")
    if ids.size and (ids.min() < 0 or ids.max() >= NUM_ACTIONS):
        raise ValueError(f"action_ids must be 0..{NUM_ACTIONS - 1}, got {ids.min()}..{ids.max()}")
    if modality not in MODALITIES:
        raise ValueError(f"unknown modality {modality!r}; allowed: {', '.join(MODALITIES)}")
    limits = (("num_observations", num_observations, 1), ("workers", workers, 1), ("seed", seed, 0))
    for name, value, least in limits:
        if not isinstance(value, int | np.integer) or value < least:
            raise ValueError(f"{name} must be a whole number, {least} or more, got {value!r}")
    ids, num_observations, seed = ids.astype(np.int64), int(num_observations), int(seed)
    states = _cached_states(ids, num_observations, seed, workers, cache)  # (ids, n, 7, 7)
    if modality == "xy":
        return np.ascontiguousarray(states[..., 2:4])
    if modality == "state":
        return np.ascontiguousarray(states[..., :6])
    jobs = list(zip(ids.tolist(), states, strict=True))
    videos = np.empty((*states.shape[:3], PROBE_VIDEO, PROBE_VIDEO), np.uint8)
    for row, video in enumerate(_spread(_probe_video, jobs, workers, "probe videos")):
        videos[row] = video
    return videos


def _spread(work, jobs: list, workers: int, what: str) -> Iterator:
    """Results of work(job) in order, over processes, with a bar once it has taken two seconds."""
    bar = partial(tqdm, total=len(jobs), desc=what, unit="tool", delay=2.0, leave=False)
    if workers == 1 or len(jobs) < 2:
        yield from bar(map(work, jobs))
        return
    # fork, where there is one: the workers run nothing but numpy and pymunk, and start at once
    method = "fork" if "fork" in multiprocessing.get_all_start_methods() else None
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from bar(pool.map(work, jobs, chunksize=4))


def _cached_states(ids, n: int, seed: int, workers: int, cache) -> np.ndarray:
    """States of every id, float32 (len(ids), n, 7, 7); computes and keeps what is missing.

    One file per (tool list, physics, n, seed); it grows as more tools are asked for. The physics is
    known by what it does: four trajectories of one tool of each kind.
    """
    known: dict[int, np.ndarray] = {}
    path = None
    if cache is not None:
        firsts = {tool.kind: action for action, tool in reversed([*enumerate(TOOLS)])}
        fingerprint = repr((TOOLS, pymunk.version, pymunk.chipmunk_version, n, seed)).encode()
        fingerprint += b"".join(_probe_states((i, 4, 0)).tobytes() for i in firsts.values())
        digest = hashlib.sha256(fingerprint).hexdigest()[:16]
        path = Path(cache) / f"create-probe-n{n}-s{seed}-{digest}.npz"
        try:
            with np.load(path, allow_pickle=False) as stored:
                known = dict(zip(stored["ids"].tolist(), stored["states"], strict=True))
        except FileNotFoundError:
            pass
        except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as e:
            print(f"{path} is damaged ({e}): its trajectories are recorded again", flush=True)
    missing = [action for action in dict.fromkeys(ids.tolist()) if action not in known]
    jobs = [(action, n, seed) for action in missing]
    known.update(zip(missing, _spread(_probe_states, jobs, workers, "probe ball"), strict=True))
    if path is not None and len(missing) * n >= CACHE_FROM:
        keep = sorted(known)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.stem}.{os.getpid()}.part.npz")
        try:
            np.savez(part, ids=np.array(keep), states=np.stack([known[action] for action in keep]))
            os.replace(part, path)  # a broken-off run leaves no half-written file behind
        finally:
            part.unlink(missing_ok=True)
    if not len(ids):
        return np.empty((0, n, PROBE_LENGTH, 7), np.float32)
    return np.stack([known[action] for action in ids.tolist()])  # (ids, n, 7, 7)


def _probe_states(job: tuple[int, int, int]) -> np.ndarray:
    """All trajectories of one tool, float32 (n, 7, 7): 6-number states and the plank's angle (rad).

    The rounds are the attempts: the first launches all n balls, the next those that missed.
    """
    action, n, seed = job
    tool, rng = TOOLS[action], np.random.default_rng([seed, action])
    places = rng.uniform(-PROBE_AREA, PROBE_AREA, (n, 2))  # norm, one per trajectory
    result = np.zeros((n, PROBE_LENGTH, 7), np.float32)
    waiting, attempt = np.arange(n), 0
    while len(waiting):
        speed_factor = 1 + 0.4 * min(attempt, PROBE_ATTEMPTS - 1)
        start = rng.uniform(-1.0, 1.0, (len(waiting), 2))
        gap = places[waiting] - start
        distance = np.linalg.norm(gap, axis=1, keepdims=True)  # (waiting, 1) norm
        speed = PROBE_SPEED * speed_factor * (1 + distance)  # (waiting, 1) units/s
        speed *= rng.uniform(0.6, 1.4, (len(waiting), 1))
        velocity = speed * gap / np.maximum(distance, 1e-9)
        states, contact = _launch(tool, places[waiting], start, velocity)
        # contact: physics step 1..90 of the first touch, 0 overlap at launch, 91 never
        last = attempt >= PROBE_ATTEMPTS - 1  # then a miss is kept, an overlap draws again
        done = (contact > 0) & ((contact <= PROBE_STEPS) | last)
        first = (contact[done] - 1) // PROBE_EVERY  # the first state at or after the touch
        cut = np.where(contact[done] > PROBE_STEPS, 1, np.clip(first - 3, 0, 2))
        frames = cut[:, None] + np.arange(PROBE_LENGTH)  # (done, 7)
        result[waiting[done]] = states[done][np.arange(done.sum())[:, None], frames]
        waiting, attempt = waiting[~done], attempt + 1
    return result


def _launch(tool: Tool, places, start, velocity) -> tuple[np.ndarray, np.ndarray]:
    """Launch m balls at m copies of a tool, each pair in its own cell of one big space.

    places, start (m, 2) norm; velocity (m, 2) units/s. Returns states (m, 9, 7) float32 and the
    step of the first contact (m,): 0 overlap at launch, 91 never.
    """
    m = len(places)
    space = make_space()
    clock, steps = [0], PROBE_STEPS

    def note_contact(arbiter, space, data) -> None:
        ball = arbiter.shapes[0].thing
        if ball.first_contact is None:
            ball.first_contact = clock[0]

    space.on_collision(Contact.MOVING, None, begin=note_contact)
    side = math.ceil(math.sqrt(m))
    offsets = CELL * np.stack(np.divmod(np.arange(m), side), axis=1)  # (m, 2) units
    tool_at, ball_at = (to_units(at) + offsets for at in (places, start))
    tools = []
    if tool.kind != "No-op":
        tools = [build(tool, x, y, space.static_body) for x, y in tool_at.tolist()]
        space.add(*(part for thing in tools for part in thing.parts))
    balls = [build(PROBE_BALL, x, y, space.static_body) for x, y in ball_at.tolist()]
    for ball, speed in zip(balls, velocity.tolist(), strict=True):
        ball.body.velocity = tuple(speed)
    overlap = np.zeros(m, bool)
    reach = tool.size + 2 * BALL_RADIUS + sum(BOX_SIZE.get(tool.kind, (0.0, 0.0)))  # generous
    for i in np.flatnonzero(np.hypot(*(ball_at - tool_at).T) < reach):
        overlap[i] = bool(space.shape_query(balls[i].shape))
    space.add(*(part for ball in balls for part in ball.parts))
    bodies = [ball.body for ball in balls] + [thing.body for thing in tools if thing.body]
    read = _reader(space, bodies)
    recorded = np.zeros((m, steps // PROBE_EVERY, 7))
    recorded[..., :2] = places[:, None]
    near = np.full(m, steps + 1)
    for clock[0] in range(1, steps + 1):
        space.step(DT)
        if tool.kind == "No-op" or clock[0] % PROBE_EVERY == 0:
            now = read()  # (bodies, 5): position, angle, velocity
        if tool.kind == "No-op":
            close = np.hypot(*(now[:m, :2] - tool_at).T) <= NO_OP_REACH * WORLD / 2
            near[close & (near > steps)] = clock[0]
        if clock[0] % PROBE_EVERY == 0:
            frame = recorded[:, clock[0] // PROBE_EVERY - 1]  # (m, 7)
            frame[:, 2:4] = (now[:m, :2] - offsets) * 2 / WORLD - 1
            # published code: velocities through the map of positions (v/42 - 1, a slip); v/42 here
            frame[:, 4:6] = now[:m, 3:5] * 2 / WORLD
            frame[:, 6] = now[m:, 2] if len(now) > m else 0.0
    if tool.kind == "No-op":
        return recorded.astype(np.float32), np.where(overlap, 0, near)
    never = steps + 1
    contact = [never if ball.first_contact is None else ball.first_contact for ball in balls]
    return recorded.astype(np.float32), np.where(overlap, 0, contact)


def _reader(space: pymunk.Space, bodies: list) -> "partial":
    """A function that returns x, y, angle, vx, vy of the given bodies, (len(bodies), 5) float64."""
    fields = pymunk.batch.BodyFields
    wanted = fields.BODY_ID | fields.POSITION | fields.ANGLE | fields.VELOCITY
    ids = np.array([body.id for body in bodies])

    def read() -> np.ndarray:
        data = pymunk.batch.Buffer()
        pymunk.batch.get_space_bodies(space, wanted, data)
        rows = np.frombuffer(data.float_buf()).reshape(-1, 5)  # (all bodies, 5)
        row_ids = np.frombuffer(data.int_buf(), np.uint64)  # sleeping changes the order of the rows
        order = np.argsort(row_ids)
        return rows[order[np.searchsorted(row_ids, ids, sorter=order)]]

    return read


def _probe_video(job: tuple[int, np.ndarray]) -> np.ndarray:
    """Pictures of one tool's trajectories, uint8 (n, 7, 48, 48), from its states (n, 7, 7).

    The camera stands over the tool. appendix: silent; published code: over the scene, with the tool
    anywhere in it. Where a tool was put says nothing about what it does, and there is nothing else
    in the scene, so that it can move along.
    """
    action, states = job
    tool, static_body = TOOLS[action], pymunk.Space().static_body
    ball = build(PROBE_BALL, 0.0, 0.0, static_body)
    video = np.empty((*states.shape[:2], PROBE_VIDEO, PROBE_VIDEO), np.uint8)
    scene = np.full((PROBE_VIDEO, PROBE_VIDEO), 255.0, np.float32)
    thing = None
    if tool.kind != "No-op":
        thing = build(tool, *to_units(np.zeros(2)), static_body)
        if thing.body is None:
            paint(scene, grey_strokes(thing))
    for trajectory, pictures in zip(states.astype(np.float64), video, strict=True):
        camera = trajectory[0, :2]
        for state, picture in zip(trajectory, pictures, strict=True):
            canvas = scene.copy()
            if thing is not None and thing.body is not None:
                thing.body.angle = state[6]
                paint(canvas, grey_strokes(thing))
            ball.body.position = tuple(to_units(state[2:4] - camera).tolist())
            paint(canvas, grey_strokes(ball))
            picture[:] = canvas + 0.5
    return video


# ---- pictures for people (Figures 3 and 7): the same scene, large and in colour ----

CAPTION = 6.0  # ours: units of room under the scene for a line of words
SMOOTH = 3  # ours: drawn this many times too large, then averaged, which gives soft edges
PAPER, GRID, INK = "#fdfcf8", "#f1efe8", "#3b3a44"
WOOD, WOOD_EDGE = "#e0a35c", "#9c6b30"


def _shade(colour: str, factor: float) -> tuple[int, int, int]:
    """A colour made darker (factor < 1) or lighter (> 1, towards white at 2)."""
    rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    if factor > 1:
        return tuple(int(c + (255 - c) * (factor - 1)) for c in rgb)
    return tuple(int(c * factor) for c in rgb)


class Pen:
    """Pillow with world units: y up, sizes in units, soft edges. `picture()` gives the pixels."""

    def __init__(self, size: int, image: Image.Image | None = None):
        self.size, self.scale = size, size * SMOOTH / WORLD
        height = size + round(size * CAPTION / WORLD)  # pixels
        self.image = image or Image.new("RGB", (size * SMOOTH, height * SMOOTH), PAPER)
        self.draw = ImageDraw.Draw(self.image, "RGBA")

    def at(self, point) -> tuple[float, float]:
        """World point -> pixel."""
        return point[0] * self.scale, (WORLD - point[1]) * self.scale

    def disc(self, centre, radius, fill, edge=None, width=0.35) -> None:
        """Filled circle, perhaps with a rim inside it."""
        x, y = self.at(centre)
        r, w = radius * self.scale, round(width * self.scale)
        self.draw.ellipse(
            (x - r, y - r, x + r, y + r), fill=fill, outline=edge, width=w if edge else 0
        )

    def line(self, points, width, fill) -> None:
        """Polyline with round joints and ends."""
        pixels = [self.at(point) for point in points]
        self.draw.line(pixels, fill=fill, width=max(1, round(width * self.scale)))
        for point in points:
            self.disc(point, width / 2, fill)

    def poly(self, corners, fill, edge=None, width=0.5) -> None:
        """Filled polygon, perhaps with a rim on its edges."""
        self.draw.polygon([self.at(corner) for corner in corners], fill=fill)
        if edge:
            self.line([*corners, corners[0]], width, edge)

    def text(self, point, words, height, fill, anchor="la") -> None:
        """Words at a point; `height` in units."""
        font = ImageFont.load_default(size=height * self.scale)
        self.draw.text(self.at(point), words, fill=fill, font=font, anchor=anchor)

    def picture(self) -> np.ndarray:
        """The finished picture, uint8 (size and 1/14 of it for the caption, size, 3)."""
        return np.asarray(self.image.reduce(SMOOTH)).copy()


def _frame_of(thing: Thing, angle: float):
    """Function (along, across) -> world point, in a frame at the thing's place, turned."""
    x, y = thing.pose()[:2]
    c, s = math.cos(angle), math.sin(angle)
    return lambda u, v=0.0: (x + c * u - s * v, y + s * u + c * v)


def _draw_bar(pen: Pen, thing: Thing) -> None:
    """Ramps, floors, walls; trampolines on legs; belts with rollers; ladders with rungs."""
    tool, colour, (a, b) = thing.tool, thing.kind.colour, thing.corners
    at, half = _frame_of(thing, math.radians(tool.angle)), tool.size / 2
    if tool.kind == "Ladder":
        for side in (-1.3, 1.3):
            pen.line([at(-half, side), at(half, side)], 0.7, colour)
        for k in range(int(half // 1.25)):
            pen.line(
                [at(-half + 1.25 + 2.5 * k, -1.3), at(-half + 1.25 + 2.5 * k, 1.3)], 0.5, colour
            )
        return
    width = max(2 * thing.kind.radius, 1.0)
    if tool.kind == "Trampoline":
        below = -1 if math.cos(math.radians(tool.angle)) > -1e-9 else 1  # the side of the ground
        for end in (-0.75 * half, 0.75 * half):
            pen.line([at(end), at(end * 1.1, 2.6 * below)], 0.6, "#9aa0ac")
        pen.line([a, b], width, _shade(colour, 0.75))
        pen.line([at(-half + 0.4), at(half - 0.4)], 0.8, "#8fb8ff")
        return
    pen.line([a, b], width, _shade(colour, 0.72))
    pen.line([a, b], width * 0.62, colour)
    if tool.kind == "Conveyor Belt":
        rollers = max(2, int(half // 1.2))
        for k in range(rollers + 1):
            pen.disc(at(half * (2 * k / rollers - 1)), 0.55, "#c9cad6")
        way = math.copysign(1, tool.speed)
        for k in range(1 + abs(round(tool.speed)) // 3):  # one to three arrow heads, by speed
            u = way * (0.8 + 1.6 * k) - 1.2 * way
            pen.line([at(u - 0.8 * way, 3.0), at(u, 2.2), at(u - 0.8 * way, 1.4)], 0.4, "#4a4e69")


def _draw_plank(pen: Pen, thing: Thing) -> None:
    """Levers and see-saws: foot, plank, bolt, weight; those with a limit stand on a plate."""
    x, y, angle = thing.pose()
    at = _frame_of(thing, angle)
    ends = [at(*corner) for corner in thing.corners]
    pen.poly([(x, y), (x - 2.2, y - 3), (x + 2.2, y - 3)], "#8d8a94", "#6a6772", 0.3)
    if thing.tool.max_angle:
        pen.line([(x - 2.9, y - 3.1), (x + 2.9, y - 3.1)], 0.7, "#6a6772")
    pen.line(ends[:2], 1.5, WOOD_EDGE)
    pen.line(ends[:2], 0.9, WOOD)
    for end in ends[2:]:
        radius = 1.2 + 0.07 * thing.tool.mass
        pen.disc(end, radius, "#4c4a57", "#2f2d38", 0.3)
    pen.disc((x, y), 0.7, "#55525f")


def _draw_polygon(pen: Pen, thing: Thing) -> None:
    """Solid polygons; bouncy ones carry a bright rubber rim, soft ones a plain face."""
    colour, corners = thing.kind.colour, thing.corners
    inner = [(thing.x + 0.55 * (u - thing.x), thing.y + 0.55 * (v - thing.y)) for u, v in corners]
    pen.poly(corners, colour, _shade(colour, 0.72), 0.45)
    bouncy = thing.tool.kind.startswith("Bouncy")
    pen.poly(inner, _shade(colour, 1.35) if bouncy else _shade(colour, 1.2))


def _draw_cannon(pen: Pen, thing: Thing) -> None:
    """A barrel on a wheel, its mouth in the direction of the shot."""
    colour, at = thing.kind.colour, _frame_of(thing, math.radians(thing.tool.angle))
    pen.disc(at(-2.2), 3.2, _shade(colour, 0.62))
    pen.poly([at(-2.2, 3.2), at(-2.2, -3.2), at(4.6, -2.6), at(4.6, 2.6)], _shade(colour, 0.62))
    pen.disc(at(-2.2), 2.7, colour)
    pen.poly([at(-2.2, 2.7), at(-2.2, -2.7), at(4.2, -2.1), at(4.2, 2.1)], colour)
    pen.line([at(-2.0, 1.5), at(3.6, 1.2)], 0.7, _shade(colour, 1.35))
    pen.poly([at(3.9, 3.5), at(3.9, -3.5), at(5.0, -3.5), at(5.0, 3.5)], _shade(colour, 0.5))
    pen.disc(at(-2.2), 1.5, "#6b4f3a", "#4a3526", 0.35)


def _draw_fan(pen: Pen, thing: Thing) -> None:
    """A rotor seen from the side at the back, and the wind it makes, longer for a stronger fan."""
    colour, at = thing.kind.colour, _frame_of(thing, math.radians(thing.tool.angle))
    pen.poly(thing.corners, (*_shade(colour, 1.85), 150))
    pen.poly([at(-3.3, 1.1), at(-3.3, -1.1), at(-1.9, -0.8), at(-1.9, 0.8)], _shade(colour, 0.7))
    for side in (1, -1):
        blade = [at(-1.9, 0), at(-1.0, 1.6 * side), at(-1.5, 4.6 * side), at(-2.4, 2.6 * side)]
        pen.poly(blade, colour, _shade(colour, 0.7), 0.3)
    pen.disc(at(-1.9), 0.9, _shade(colour, 0.6))
    reach = 0.6 + 2.4 * thing.tool.force / 120
    for v in (-3.0, 0.0, 3.0):
        pen.line([at(0.1, v), at(reach, v)], 0.4, "#8fb9d8")
        pen.line([at(reach - 0.8, v + 0.7), at(reach, v), at(reach - 0.8, v - 0.7)], 0.4, "#8fb9d8")


def _draw_funnel(pen: Pen, thing: Thing) -> None:
    """A cone with a dark mouth and a nozzle."""
    colour, (left, nozzle, right) = thing.kind.colour, thing.corners

    def mix(a, b, t):
        return a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])

    pen.poly(thing.corners, colour, _shade(colour, 0.7), 0.5)
    pen.poly([mix(left, right, 0.18), mix(left, right, 0.42), nozzle], _shade(colour, 1.45))
    pen.line([left, right], 1.0, _shade(colour, 0.55))
    pen.disc(nozzle, 0.8, _shade(colour, 0.55))


def _draw_bucket(pen: Pen, thing: Thing) -> None:
    """A pail: two hoops, a bright rim at the opening, a handle over it."""
    colour, half = thing.kind.colour, thing.tool.size / math.sqrt(2)
    at = _frame_of(thing, math.radians(thing.tool.angle))
    turns = [k / 8 * math.pi for k in range(9)]
    handle = [at(half * math.cos(t), half * (1 + 0.55 * math.sin(t))) for t in turns]
    pen.line(handle, 0.35, "#8b8b94")
    pen.poly(thing.corners, colour, _shade(colour, 0.65), 0.4)
    shine = [
        at(u * half, v * half) for u, v in ((-0.7, 0.8), (-0.7, -0.9), (-0.35, -0.9), (-0.35, 0.8))
    ]
    pen.poly(shine, _shade(colour, 1.25))
    for v in (0.3 * half, -0.55 * half):
        pen.line([at(-half, v), at(half, v)], 0.4, _shade(colour, 0.65))
    pen.line([at(-half, half), at(half, half)], 1.0, _shade(colour, 1.6))


def _draw_ball(pen: Pen, thing: Thing) -> None:
    """Balls that move: a stripe shows the spin, a spot of light the roundness."""
    (x, y, angle), radius, colour = thing.pose(), float(thing.tool.size), thing.kind.colour
    pen.disc((x, y), radius, colour, _shade(colour, 0.7), 0.45)
    c, s = math.cos(angle), math.sin(angle)
    reach = 0.72 * radius
    if thing.tool.kind == "Basketball":
        for u, v in ((c, s), (-s, c)):
            seam = [(x - reach * u, y - reach * v), (x + reach * u, y + reach * v)]
            pen.line(seam, 0.35, _shade(colour, 0.55))
    else:
        stripe = [(x - reach * c, y - reach * s), (x + reach * c, y + reach * s)]
        pen.line(stripe, 0.5, (*_shade(colour, 0.75), 150))
    pen.disc((x - 0.36 * radius, y + 0.38 * radius), 0.24 * radius, (255, 255, 255, 170))


def _draw_goal(pen: Pen, thing: Thing) -> None:
    """The star, the basketball basket and the pale subgoals."""
    x, y, colour = thing.x, thing.y, thing.kind.colour
    if thing.tool.kind == "Goal star":
        points = [(4.3 if k % 2 == 0 else 1.9, math.pi * (0.5 + k / 5)) for k in range(10)]
        pen.disc((x, y), 5.2, (*_shade(colour, 1.5), 90))
        corners = [(x + r * math.cos(a), y + r * math.sin(a)) for r, a in points]
        pen.poly(corners, colour, _shade(colour, 0.7), 0.45)
        return
    if thing.tool.kind == "Subgoal":
        pen.disc((x, y), 3.0, (*_shade(colour, 1.0), 200), "#8fd16a", 0.45)
        pen.disc((x, y), 1.1, "#a9e08a")
        return
    for k in range(-2, 3):  # net
        pen.line([(x + 2.3 * k, y + 4.2), (x + 1.3 * k - 1.2, y - 4.6)], 0.25, "#9c9ca8")
        pen.line([(x + 2.3 * k, y + 4.2), (x + 1.3 * k + 1.2, y - 4.6)], 0.25, "#9c9ca8")
    pen.disc((x, y), 5.0, (*_shade("#5fd32a", 1.5), 60))
    pen.line([(x - 5, y + 4.4), (x + 5, y + 4.4)], 1.1, colour)


def _draw_crate(pen: Pen, thing: Thing) -> None:
    half = thing.tool.size / 2
    at = _frame_of(thing, thing.pose()[2])
    corners = [at(-half, -half), at(half, -half), at(half, half), at(-half, half)]
    pen.poly(corners, "#c69c6d", "#8a6239", 0.5)
    pen.line([corners[0], corners[2]], 0.5, "#8a6239")


def _draw_disc(pen: Pen, thing: Thing) -> None:
    colour, place = thing.kind.colour, (thing.x, thing.y)
    pen.disc(place, thing.tool.size, colour, _shade(colour, 0.72), 0.45)
    bouncy = thing.tool.kind.startswith("Bouncy")
    pen.disc(place, 0.5 * thing.tool.size, _shade(colour, 1.35 if bouncy else 1.2))


_DRAW = {"segment": _draw_bar, "plank": _draw_plank, "polygon": _draw_polygon, "ball": _draw_ball}
_DRAW |= {"disc": _draw_disc, "crate": _draw_crate, "Cannon": _draw_cannon, "Fan": _draw_fan}
_DRAW |= {"Funnel": _draw_funnel, "Bucket": _draw_bucket, "Goal star": _draw_goal}
_DRAW |= {"Basket": _draw_goal, "Subgoal": _draw_goal}


def draw_thing(pen: Pen, thing: Thing) -> None:
    """Draw one object where it is now."""
    _DRAW.get(thing.tool.kind, _DRAW.get(thing.kind.family))(pen, thing)


def blank_page(size: int) -> Pen:
    """Paper with a faint grid every eighth of the screen."""
    pen = Pen(size)
    for k in range(1, 8):
        pen.line([(k * WORLD / 8, 0), (k * WORLD / 8, WORLD)], 0.12, GRID)
        pen.line([(0, k * WORLD / 8), (WORLD, k * WORLD / 8)], 0.12, GRID)
    return pen


def draw_trail(pen: Pen, trail: list, colour: str) -> None:
    """The way a ball came: dots that fade with age."""
    recent = trail[-90:]
    for k, point in enumerate(recent):
        alpha = int(40 + 150 * k / len(recent))
        pen.disc(point, 0.55, (*_shade(colour, 1.1), alpha))


OUTCOME = {
    Placement.PLACED: ("placed", "#2a7f3f"),
    Placement.NO_OP: ("waits", "#6a6772"),
    Placement.BLOCKED_BY_TOOL: ("too close to a tool", "#c1121f"),
    Placement.BLOCKED_BY_SHAPE: ("blocked by a shape", "#c1121f"),
    Placement.OUTSIDE: ("outside the screen", "#c1121f"),
}


def draw_caption(pen: Pen, left: str, right: str, colour: str) -> None:
    """A line of words under the scene."""
    pen.draw.rectangle((*pen.at((0, 0)), *pen.image.size), fill=PAPER)
    pen.line([(0, -0.1), (WORLD, -0.1)], 0.25, "#cfcdd6")
    pen.text((1.5, -CAPTION / 2), left, 3.1, INK, "lm")
    pen.text((WORLD - 1.5, -CAPTION / 2), right, 3.1, colour, "rm")


# ---- demo ----


def save_gif(path: str | Path, frames: list[np.ndarray], fps: float) -> None:
    """Write pictures as an endless GIF; the last one stays for 1.5 s. Creates missing folders."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = [round(1000 / fps)] * (len(frames) - 1) + [1500]  # ours: time to see the outcome
    # 128 colours without dithering: half the size, and flat areas stay flat
    images = [Image.fromarray(frame).quantize(128, dither=Image.Dither.NONE) for frame in frames]
    temporary = path.with_name(path.name + ".part")  # a reader never meets a half-written file
    with open(temporary, "wb") as file:
        images[0].save(
            file, "GIF", save_all=True, append_images=images[1:], duration=durations, loop=0
        )
    os.replace(temporary, path)


def play_episode(env: CreateEnv, seed: int) -> tuple[list[np.ndarray], float, int]:
    """A random episode: (colour frames, return, length). A tool is tried on half the steps."""
    env.reset(seed=seed)
    watched = env.render_mode is not None
    rng, frames, over = np.random.default_rng(seed), env.render_frames() if watched else [], False
    while not over:
        choice = int(rng.integers(1, NUM_AVAILABLE)) if rng.random() < 0.5 else 0
        action = {"choice": choice, "position": rng.uniform(-0.9, 0.9, 2)}
        _, _, terminated, truncated, info = env.step(action)
        frames += env.render_frames() if watched else []
        over = terminated or truncated
    return frames, info["episode"]["r"], info["episode"]["l"]


def sheet(tiles: Sequence[np.ndarray], titles: Sequence[str], columns: int) -> Image.Image:
    """Pictures of one size on a sheet, a title under each."""
    size, bar, gap = tiles[0].shape[1], 26, 10
    rows = math.ceil(len(tiles) / columns)
    page = Image.new(
        "RGB", (columns * (size + gap) + gap, rows * (size + bar + gap) + gap), "white"
    )
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(size=17)
    for k, (tile, title) in enumerate(zip(tiles, titles, strict=True)):
        x, y = gap + k % columns * (size + gap), gap + k // columns * (size + bar + gap)
        page.paste(Image.fromarray(tile[:size]), (x, y))  # without its caption
        draw.rectangle((x, y, x + size - 1, y + size - 1), outline="#b8b6c0")
        draw.text((x + size / 2, y + size + bar / 2 + 1), title, fill=INK, font=font, anchor="mm")
    return page


def all_tasks_sheet(size: int = 300) -> Image.Image:
    """Figure 7: the 12 tasks as they start."""
    tiles = []
    for task in TASKS:
        env = CreateEnv(task=task, render_mode="rgb_array", render_size=size)
        env.reset(seed=0)
        tiles.append(env.render())
    return sheet(tiles, [f"({'abcdefghijkl'[k]}) {task}" for k, task in enumerate(TASKS)], 4)


def tools_sheet(size: int = 300) -> Image.Image:
    """Four tools of each class, and how many there are 15 degrees apart."""
    labels, tiles, titles = action_labels(), [], []
    for label in dict.fromkeys(labels[1:_NUM_BASE]):
        ids = np.flatnonzero(labels[:_NUM_BASE] == label)
        pen, static_body = blank_page(size), pymunk.Space().static_body
        spots = [(x, y) for y in (58, 26) for x in (26, 58)]
        for spot, share in zip(spots, (0.98, 0.12, 0.45, 0.7), strict=True):
            draw_thing(pen, build(TOOLS[ids[int(share * len(ids))]], *spot, static_body))
        edge = size // 10  # cut the margin off
        tiles.append(pen.picture()[edge : size - edge, edge : size - edge])
        titles.append(f"{label} ({len(ids)})")
    return sheet(tiles, titles, 5)


def probe_sheet(name: str, size: int = 420, trajectories: int = 40) -> Image.Image:
    """Probe-ball trajectories over one tool, moved so that the tool stands in the middle."""
    labels = action_labels()
    if name.isdecimal() and int(name) < NUM_ACTIONS:
        ids = [int(name)]
    else:
        members = np.flatnonzero(np.char.lower(labels[:_NUM_BASE]) == name.lower())
        if not len(members):
            raise ValueError(
                f"unknown tool {name!r}; allowed: 0..{NUM_ACTIONS - 1} or a class: "
                + ", ".join(dict.fromkeys(labels.tolist()))
            )
        ids = [int(members[int(share * len(members))]) for share in (0.1, 0.5, 0.9)]
    tiles, titles = [], []
    for action in ids:
        states = action_observations([action], trajectories, "state", cache=None)[0]
        pen, static_body = blank_page(size), pymunk.Space().static_body
        paths = to_units(states[..., 2:4] - states[..., :2]).tolist()
        for k, path in enumerate(paths):
            hue = Image.new("HSV", (1, 1), (k * 255 // trajectories, 150, 215)).convert("RGB")
            colour = "#{:02x}{:02x}{:02x}".format(*hue.getpixel((0, 0)))
            pen.line(path, 0.3, (*_shade(colour, 1.0), 150))
            for age, point in enumerate(path):
                pen.disc(point, 0.35 + 0.11 * age, colour)
        if TOOLS[action].kind != "No-op":
            draw_thing(pen, build(TOOLS[action], WORLD / 2, WORLD / 2, static_body))
        tiles.append(pen.picture())
        titles.append(f"{labels[action]}, id {action}")
    return sheet(tiles, titles, len(tiles))


@dataclass
class Args:
    """CREATE: play an episode and write a GIF, or draw tasks, tools or probe trajectories."""

    task: str = "push"  # one of the 12 tasks of Figure 7
    seed: int = 0  # of the first episode: level, tools on offer, random actions
    tries: int = 400  # random episodes played; the one with the best return is drawn
    all_tasks: bool = False  # draw the 12 tasks on one sheet (Figure 7)
    show_tools: bool = False  # draw tools of every class
    show_probe: str | None = None  # draw probe-ball trajectories over a tool (class name or id)
    out: Path = Path("runs/demo")  # folder for the pictures


def main(args: Args) -> None:
    """Draw what was asked for and say where it is."""
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        if args.all_tasks or args.show_tools or args.show_probe is not None:
            for wanted, name, draw in (
                (args.all_tasks, "create_tasks.png", all_tasks_sheet),
                (args.show_tools, "create_tools.png", tools_sheet),
                (
                    args.show_probe is not None,
                    "create_probe.png",
                    lambda: probe_sheet(args.show_probe),
                ),
            ):
                if wanted:
                    draw().save(args.out / name)
                    print(f"wrote {args.out / name}")
            return
        if args.tries < 1 or args.seed < 0:
            raise ValueError(
                f"tries must be 1 or more and seed 0 or more, got {args.tries}, {args.seed}"
            )
        seeds = range(args.seed, args.seed + args.tries)
        env = CreateEnv(task=args.task)
        best = max(seeds, key=lambda seed: play_episode(env, seed)[1])
        env = CreateEnv(task=args.task, render_mode="rgb_array")
        frames, total, length = play_episode(env, best)
        path = args.out / f"create_{args.task}.gif"
        save_gif(path, frames, env.metadata["render_fps"])
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from e
    print(
        f"best of {args.tries} random episodes of {args.task}: seed {best}, {length} actions, ",
        end="",
    )
    print(f"return {total:.2f}; wrote {path}")
    labels = action_labels()
    print(f"{NUM_DEFAULT:,} tools in the Default Split, {NUM_ACTIONS:,} over all splits; by class:")
    for label in dict.fromkeys(labels):
        ids = np.flatnonzero(labels == label)
        print(f"  {label:16} {np.sum(ids < NUM_DEFAULT):5,} {len(ids):6,}")
    for split in SPLITS:
        sizes = ", ".join(f"{part} {len(ids):,}" for part, ids in split_actions(split).items())
        print(f"  split {split:9} {sizes}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=Args.__doc__))
