"""CREATE, the Chain REAction Tool Environment (appendix A.3, B, C.1, C.3 and Table 1).

A two-dimensional physics puzzle. Balls fall. Every 40 physics steps the agent picks one of the
tools on offer and a place for it, so that the red target ball reaches the green goal. There are
twelve tasks and 2,111 tools, and 6,248 more for the Full Split and the analyses.

    python create_env.py --task push           # the best of 400 random episodes as a GIF, beside
                                               # it what the policy sees (--tries 1: a typical one)
    python create_env.py --play --task push    # place the tools yourself: mouse and space
    python create_env.py --all-tasks           # Figure 7: the 12 tasks on one sheet
    python create_env.py --show-tools          # four tools of each class
    python create_env.py --show-probe Cannon   # probe-ball trajectories over a tool (class or id)

Paper map
    A.3 actions              KINDS, TOOLS               A.3 state     strokes(), CreateEnv
    A.3 splits, Table 1      split_actions()            A.3 Eq. 3     CreateEnv._reward()
    A.3 action observations  action_observations()      B (labels)    action_labels()
    C.1, Figure 7            TASKS                      C.3           subgoal_reward=False

Units: the world is a square of 84 x 84 units, one unit per pixel of the observation, x to the
right, y up, origin in the lower left corner. "norm" means agent coordinates: unit = (norm + 1) 42.
Angles are degrees counter-clockwise in the tables and radians in the physics.

A task of your own is an entry of TASKS, in this file or in yours:

    TASKS["gap"] = Task(
        target=ball("Target", -0.6, 0.6, "target"), goal=star(0.7, -0.1),
        items=(line(-0.5, 0.1, 34), line(0.7, -0.2, 20)),  # x, y (norm), length (units)
        shifts={"target": (0.1, 0.0)},  # the target's x moves by U(-0.1, 0.1) at every reset
    )

A tool of your own is one line of KINDS. It gets the ids after all others and a 2:1:1 split:

    "Octagon": Kind("polygon", 159, ORANGE, 45, "octagon", "", POLYGONS, 8),

What it does to a ball is a contact rule (`make_space`). Mind that pymunk prints an exception raised
in a contact rule and swallows it: the run goes on without the rule. So watch stderr.
"""

import colorsys
import contextlib
import copy
import enum
import functools
import itertools
import math
import multiprocessing
import operator
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pymunk
import tyro
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

# ---- constants ----

WORLD = 84.0  # A.3: the screen is 84 x 84; published code: physics units are its pixels
GRAVITY = (0.0, -2.0)  # published code, units/s^2
DT = 1 / 30  # published code, seconds per physics step
SUBSTEPS = 40  # A.3 "acts every 40 physics simulation steps"
SLEEP_TIME = 0.3  # published code, s: a ball at rest this long is put to sleep
MAX_ACTIONS = 30  # A.3 and Table 3 "max. episode length"
NUM_AVAILABLE = 50  # Table 3 "actions per episode"; the no-op is one of them
NUM_FRAMES = 3  # A.3 "past 3 frames are stacked channel-wise"

LAMBDA_ALIVE = 0.01  # Eq. 3
LAMBDA_GOAL = 10.0  # Eq. 3
LAMBDA_SUBGOAL = 2.0  # Eq. 3
LAMBDA_TARGET_HIT = 1.0  # Eq. 3; 2 in obstacle, as in the published task file
LAMBDA_INVALID = -0.01  # Eq. 3
LAMBDA_OVERLAP = -0.01  # Eq. 3

MIN_TOOL_GAP = 0.3  # published code, norm: tool centres this close "overlap"
STILL_SPEED = 0.05  # published code, units/s: slower than this is "not moving"
STILL_ACTIONS = 2  # published code: so many actions that end without motion are the end
HIT_DISTANCE = 0.03  # published code, share of the screen's diagonal: then the target counts as hit
PICTURE_EVERY = 8  # ours, physics steps: 5 colour pictures per action

BALL_RADIUS, BALL_MASS = 4.0, 10.0  # published code: target, marker, goal and probe ball
PLANK_MASS, PLANK_MOMENT = 10.0, 10_000.0  # published code: levers and see-saws, very sluggish
LADDER_ANGLE = 95.0  # published code, degrees
LADDER_LEAN = 4.0  # published code: a ladder multiplies the sideways part of its motion by this
VESSEL_ELASTICITY = 0.5  # published code: funnels and buckets

METRIC = "success"  # the goal was reached in the episode (0 or 1)
MODALITIES = ("xy", "state", "video")  # B: (x, y) of the ball is the default


# ---- A.3 actions: the tools ----

# Collision types: pairs of them have rules (`make_space`). MOVING are balls and loose boxes. Balls
# pass through shapes from GOAL on, only the rule acts.
Contact = enum.IntEnum("Contact", "PLAIN MOVING PLANK FUNNEL BUCKET GOAL CANNON FAN BELT LADDER")


class Tool(NamedTuple):
    """One tool, or one object of a level. Parameters a class does not use are 0."""

    kind: str
    elasticity: float = 0.0
    angle: float = 0.0  # degrees
    size: float = 0.0  # length of segments and planks, radius of balls, circumradius of the others
    # The appendix's "friction": a ball on a plank keeps 2 - damping of its speed at every step. On
    # ramps (1.0) it only stands in the published list of features.
    damping: float = 0.0
    max_angle: float = 0.0  # degrees, see-saws
    mass: float = 0.0  # weight on one end of a see-saw; mass of level balls and boxes
    on_left: bool = False  # which end of a see-saw starts up, with the weight on the other one
    force: float = 0.0  # cannon (impulse), fan (force)
    speed: float = 0.0  # belt and ladder, units/s


class Kind(NamedTuple):
    """Everything that holds for one class of tools, or of level objects."""

    family: str  # how it is built (`build`) and drawn (`strokes`)
    grey: int = 159  # of the observation; nominal grey of the published picture
    colour: str = "#fa8535"  # of pictures for people; close to the published palette
    turn: int = 0  # degrees after which the shape repeats; of see-saws: their limits stay below it
    group: str = ""  # Default Split: classes of one group share their draw of angles
    table1: str = ""  # Full Split: "train" or "test" (Table 1)
    # The tools of the class: values of each parameter, the outermost loop of the ids first. None:
    # angles (or limits) from 0 (5) on, below `turn`.
    vary: dict[str, Sequence | None] = {}
    sides: int = 0  # of polygons
    contact: Contact = Contact.PLAIN
    radius: float = 1.0  # half thickness of segments, units


# All parameters: published code.
SOFT, BOUNCY = (0.1, 0.3, 0.5), (0.8, 1.0, 1.2)  # elasticities
LENGTHS, PLANKS = (6, 10, 14, 18, 22), (12, 14, 16, 18, 20)
RAMPS = {"elasticity": SOFT, "angle": None, "size": LENGTHS, "damping": (1.0,)}
TRAMPOLINES = {"elasticity": BOUNCY, "angle": None, "size": LENGTHS}
POLYGONS = {"angle": None, "elasticity": SOFT, "size": range(3, 10)}
BOUNCERS = {"angle": None, "elasticity": BOUNCY, "size": range(3, 10)}
NO_BOX = {"angle": (0, 15, 30, 60, 75)}  # a square at 45 would be an upright box
HINGED = {"size": PLANKS, "max_angle": None, "damping": (1.0, 1.05, 1.1)}
WEIGHTED = {"size": PLANKS, "max_angle": None, "on_left": (True, False), "mass": (2, 6, 10, 14)}
WEIGHTED |= {"damping": (1.0,)}
CANNONS = {"angle": None, "force": range(60, 121, 10)}
FANS = {"angle": None, "force": range(30, 121, 15)}
VESSELS = {"angle": None, "size": (3, 5, 7, 9, 11)}
BALLS = {"elasticity": (0.1, 0.2, 0.3, 0.4, 0.5), "size": (3, 5, 7, 9)}
BOUNCY_BALLS = {"elasticity": (0.8, 0.9, 1.0, 1.1, 1.2), "size": (3, 5, 7, 9)}
LEVERS = {"size": (6, 12, 18, 24, 30), "damping": [round(1 + k / 100, 2) for k in range(11)]}
BELTS = {"size": range(6, 25, 2), "speed": (1, 2, 3, 4, 5, 6, -1, -2, -3, -4, -5, -6)}

ORANGE, BLUE, WOOD, GREEN = "#fa8535", "#086788", "#fa9149", "#5fd32a"  # as published, or near
KINDS: dict[str, Kind] = {
    # family, grey, colour, full turn, group, row of Table 1, parameters, sides
    "No-op": Kind("disc", contact=Contact.GOAL),  # never placed; see NO_OP_RADIUS
    "Ramp": Kind("segment", 159, ORANGE, 180, "bar", "train", RAMPS),
    "Trampoline": Kind("segment", 99, "#3d5a98", 180, "bar", "train", TRAMPOLINES),
    "Triangle": Kind("polygon", 159, ORANGE, 120, "triangle", "test", POLYGONS, 3),
    "Bouncy Triangle": Kind("polygon", 78, BLUE, 120, "triangle", "test", BOUNCERS, 3),
    "Square": Kind("polygon", 159, ORANGE, 90, "square", "", POLYGONS | NO_BOX, 4),
    "Bouncy Square": Kind("polygon", 78, BLUE, 90, "square", "", BOUNCERS | NO_BOX, 4),
    "Pentagon": Kind("polygon", 159, ORANGE, 72, "pentagon", "", POLYGONS, 5),
    "Bouncy Pentagon": Kind("polygon", 78, BLUE, 72, "pentagon", "", BOUNCERS, 5),
    "Hexagon": Kind("polygon", 159, ORANGE, 60, "hexagon", "", POLYGONS, 6),
    "Bouncy Hexagon": Kind("polygon", 78, BLUE, 60, "hexagon", "", BOUNCERS, 6),
    "Hinged See-saw": Kind("plank", 168, WOOD, 90, "hinged", "train", HINGED, 0, Contact.PLANK),
    "See-saw": Kind("plank", 168, WOOD, 60, "weighted", "train", WEIGHTED, 0, Contact.PLANK),
    "Cannon": Kind("box", 107, "#b3392f", 360, "cannon", "train", CANNONS, 0, Contact.CANNON),
    "Fan": Kind("box", 117, "#3f7cac", 360, "fan", "test", FANS, 0, Contact.FAN),
    "Funnel": Kind("vessel", 146, "#8d99ae", 360, "funnel", "test", VESSELS, 3, Contact.FUNNEL),
    "Bucket": Kind("vessel", 136, "#b5651d", 360, "bucket", "train", VESSELS, 4, Contact.BUCKET),
    "Ball": Kind("disc", 159, ORANGE, 0, "", "train", BALLS),
    "Bouncy Ball": Kind("disc", 78, BLUE, 0, "", "train", BOUNCY_BALLS),
    "Lever": Kind("plank", 168, WOOD, 0, "", "test", LEVERS, 0, Contact.PLANK),
    "Conveyor Belt": Kind("segment", 121, "#4a4e69", 0, "", "test", BELTS, 0, Contact.BELT),
    # level objects
    "Target": Kind("ball", 138, "#f45b69", contact=Contact.MOVING),
    "Basketball": Kind("ball", 132, "#e8772e", contact=Contact.MOVING),
    "Marker": Kind("ball", 163, "#79addc", contact=Contact.MOVING),
    "Goal ball": Kind("ball", 191, GREEN, contact=Contact.MOVING),
    "Heavy ball": Kind("ball", 0, "#2b2d42", contact=Contact.MOVING),
    "Box": Kind("crate", 131, "#c69c6d", contact=Contact.MOVING),
    "Goal star": Kind("polygon", 191, GREEN, sides=5, contact=Contact.GOAL),
    "Basket": Kind("box", 188, "#e07a5f", contact=Contact.GOAL),
    "Subgoal": Kind("disc", 233, "#d3feb9", contact=Contact.GOAL),
    "Thin line": Kind("segment", 118, "#4682b4", radius=0.0),  # thickness 1
    "Line": Kind("segment", 118, "#4682b4"),  # thickness 2 and 2.5
    "Boundary": Kind("segment", 193, "#b0c4de"),
    "Ladder": Kind("segment", 163, "#a47148", contact=Contact.LADDER),
}
# The order of the ids: learned tables and runs rely on it. A class of your own, not named here,
# gets the ids after all others.
ID_ORDER = (
    *("Ramp", "Trampoline", "Triangle", "Bouncy Triangle", "Square", "Bouncy Square", "Pentagon"),
    *("Bouncy Pentagon", "Hexagon", "Bouncy Hexagon", "Hinged See-saw", "See-saw", "Cannon", "Fan"),
    *("Funnel", "Bucket"),  # so far the Default Split; the others are in the Full Split alone
    *("Ball", "Bouncy Ball", "Lever", "Conveyor Belt"),
)
FIRST_LIMIT = 5  # published code, degrees: see-saw limits are 5, 20, 35, ...


def _tools_of(name: str, step: int) -> list[Tool]:
    """All tools of one class, `step` degrees apart."""
    kind = KINDS[name]
    # appendix: no two tools within 15 degrees; published code: but for pentagons, whose 60 degrees
    # are 12 from the next 0. As published.
    steps = {"angle": range(0, kind.turn, step), "max_angle": range(FIRST_LIMIT, kind.turn, step)}
    values = [steps[key] if some is None else some for key, some in kind.vary.items()]
    rows = itertools.product(*values)
    return [Tool(name, **dict(zip(kind.vary, row, strict=True))) for row in rows]


# A tool's place in the list is its id. 0 is the no-op; 1..2,110 are the tools of the Default Split
# (with the no-op A.3's 2,111); 2,111..2,325 the classes of the Full Split alone. Appendix: lists
# lever, ball and belt among the 2,111; published code: its 2,111 hold none of them (with them there
# would be 2,326). We keep 2,111 and give the others the ids after it.
_COARSE = [Tool("No-op"), *(tool for name in ID_ORDER for tool in _tools_of(name, 15))]
_KNOWN = set(_COARSE)
# Then the analyses' tools at 3 degrees. Published code: of the classes that both splits have.
_BOTH = [name for name in ID_ORDER if KINDS[name].group and KINDS[name].table1]
_FINE = [t for name in _BOTH for t in _tools_of(name, 3) if t not in _KNOWN]
_ADDED = [name for name, kind in KINDS.items() if kind.vary and name not in ID_ORDER]
_OWN = [tool for name in _ADDED for tool in _tools_of(name, 15)]
TOOLS = _COARSE + _FINE + _OWN
NUM_ACTIONS = len(TOOLS)  # 8,359 distinct tools over all splits
NO_OP = 0
IS_COARSE = np.repeat([True, False, True], [len(_COARSE), len(_FINE), len(_OWN)])
# What most tools are split by, (NUM_ACTIONS,): the angle, or a see-saw's limit from the first on.
DEGREES = np.array([t.max_angle - FIRST_LIMIT if t.max_angle else t.angle for t in TOOLS])


def action_labels() -> np.ndarray:
    """Class of every tool, (NUM_ACTIONS,) of str: the names of Table 1, both see-saws as one."""
    return np.array([tool.kind.removeprefix("Hinged ") for tool in TOOLS])


def engineered_representations() -> np.ndarray:
    """Ground-truth features of every tool, float32 (NUM_ACTIONS, 30) (published code; section B).

    One-hot of the 21 classes in alphabetical order, then elasticity, angle (rad), size, damping,
    largest angle (rad), weight, on_left, force, speed, standardised over the 2,326 tools that are
    15 degrees apart (over the 2,111 alone the speed would be constant).
    """
    # published code: 23 classes (with two of boxes) in an order that changes from run to run; we
    # sort and leave the boxes out, because no split uses them
    classes = sorted({tool.kind for tool in TOOLS})
    one_hot = np.array([[tool.kind == name for name in classes] for tool in TOOLS], np.float64)
    numbers = np.array([tool[1:] for tool in TOOLS], np.float64)  # (NUM_ACTIONS, 9)
    numbers[:, [1, 4]] = np.radians(numbers[:, [1, 4]])
    coarse = numbers[IS_COARSE]
    numbers = (numbers - coarse.mean(axis=0)) / coarse.std(axis=0)
    return np.concatenate([one_hot, numbers], axis=1).astype(np.float32)  # (NUM_ACTIONS, 30)


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Train, validation and test ids, each a sorted int64 array (A.3, Table 1).

    | split    | train | valid | test  | training tools                                            |
    |----------|-------|-------|-------|-----------------------------------------------------------|
    | default  | 1,097 | 507   | 506   | half of the angles of each class                          |
    | full     | 938   | 400   | 399   | by tool class, Table 1                                    |
    | analysis | 761   | 3,397 | 3,397 | multiples of 30 degrees, out of the pool at 3 degrees     |

    The parts are disjoint. The no-op (id 0) is in none of them, because it is always on offer; the
    paper's 2,111, 1,739 (twice) and 762 count it. Raises ValueError for an unknown split.
    """
    rng = np.random.default_rng(seed)
    group = np.array([KINDS[tool.kind].group for tool in TOOLS])
    table1 = np.array([KINDS[tool.kind].table1 for tool in TOOLS])
    if split == "default":
        pool, train = IS_COARSE & (group != ""), np.zeros(NUM_ACTIONS, bool)
        sizes = np.array([tool.size for tool in TOOLS])
        for name in dict.fromkeys(group[pool].tolist()):
            members = pool & (group == name)
            # "the primary parameter (angle for most)"; a class without angles goes by size
            primary = DEGREES if np.ptp(DEGREES[members]) else sizes
            order = rng.permutation(np.unique(primary[members]))
            train |= members & np.isin(primary, order[: math.ceil(len(order) / 2)])
    elif split == "full":
        pool, train = IS_COARSE & (table1 != ""), IS_COARSE & (table1 == "train")
    elif split == "analysis":
        # appendix: 7,566 tools; published code: 7,555 and the no-op. A misprint, we think.
        pool = (group != "") & (table1 != "")
        # appendix: "at least 15 degrees"; published code: 30 degrees. Only 30 gives its 762 tools.
        train = pool & (DEGREES % 30 == 0)
    else:
        raise ValueError(f"unknown split {split!r}; allowed: default, full, analysis")
    held_out = rng.permutation(np.flatnonzero(pool & ~train))
    half = math.ceil(len(held_out) / 2)
    parts = np.flatnonzero(train), np.sort(held_out[:half]), np.sort(held_out[half:])
    return dict(zip(("train", "valid", "test"), parts, strict=True))


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


def angle_gaps(action_ids: Sequence[int], train_ids: Sequence[int]) -> np.ndarray:
    """Degrees to the nearest training tool of the same class, float64 (len(action_ids),).

    Angles wrap at the class's full turn (a ramp at 177 is 3 degrees from one at 0), see-saw limits
    do not. A tool whose class has no training tool is infinitely far. ValueError for bad ids.
    """
    # published code: compares with all classes at once, without wrapping (345 is 345 from 0)
    ids, train_ids = check_ids(action_ids), check_ids(train_ids)
    kinds = np.array([tool.kind for tool in TOOLS])
    gaps = np.full(len(ids), np.inf)
    for name in np.unique(kinds[ids]):
        here, known = kinds[ids] == name, DEGREES[train_ids[kinds[train_ids] == name]]
        if len(known):
            gap = np.abs(DEGREES[ids[here]][:, None] - np.unique(known))  # (tools, training angles)
            if "angle" in KINDS[name].vary:
                gap = np.minimum(gap, KINDS[name].turn - gap)
            gaps[here] = gap.min(axis=1)
    return gaps


# ---- C.1, Figure 7: the 12 tasks as tables ----


class Item(NamedTuple):
    """One object of a level: what, where (norm), and the name of the random shift it shares."""

    tool: Tool
    x: float
    y: float
    shift: str = ""


@dataclass(frozen=True)
class Task:
    """One level. With a marker ball the target has to be hit before the goal counts."""

    items: tuple[Item, ...]
    target: Item
    goal: Item
    marker: Item | None = None
    # half ranges (norm) of the uniform shifts of x and y, drawn once per name at every reset
    shifts: dict[str, tuple[float, float]] = field(default_factory=dict)
    subgoals: tuple = ()  # places (norm), for the marker if there is one, else the target
    boundary: str = ""  # of "R" right wall, "L" left wall, "C" ceiling; there is never a floor
    marker_must_hit: bool = False  # the target hit counts only after marker and target have touched
    target_hit_reward: float = LAMBDA_TARGET_HIT
    goal_on_either_side: bool = False  # the goal's x changes sign with probability 1/2
    max_actions: int = MAX_ACTIONS


def line(x, y, length, angle=0, shift="", kind="Thin line") -> Item:  # floor, ramp or wall
    return Item(Tool(kind, 0.5, angle, length), x, y, shift)


def ball(kind, x, y, shift="", size=BALL_RADIUS, mass=BALL_MASS, elasticity=1.0) -> Item:
    return Item(Tool(kind, elasticity, size=size, mass=mass), x, y, shift)


def star(x, y, shift="") -> Item:  # the goal of most tasks
    return Item(Tool("Goal star", angle=90, size=4), x, y, shift)


def item(kind, x, y, shift="", **parameters) -> Item:  # anything else, tools among it
    return Item(Tool(kind, **parameters), x, y, shift)


BOX = dict(elasticity=0.1, size=5, mass=30)
STAIR = dict(angle=LADDER_ANGLE, size=15, speed=4)
# All numbers: published task files. Positions norm, lengths and radii units, angles degrees.
# fmt: off
TASKS: dict[str, Task] = {
    # results in the main paper
    "push": Task(
        marker=ball("Marker", 0.6, 0.75, "marker"),
        target=ball("Target", 0.1, -0.14, "target"), goal=star(-0.7, -0.64, "goal"),
        items=(line(0.1, -0.25, 16, 0, "target"), line(-0.7, -0.75, 16, 0, "goal")),
        shifts={"marker": (0.2, 0.2), "target": (0.2, 0.2), "goal": (0.2, 0.2)},
    ),
    "obstacle": Task(
        marker=ball("Marker", -0.8, 0.8, "marker"),
        target=ball("Target", 0.1, -0.47, "target"), goal=star(-0.9, -0.69),
        items=(line(-0.61, 0.39, 35.6, -30), line(-0.25, 0.04, 12.7, 90), line(0.07, -0.1, 26),
               line(-0.8, -0.81, 16), line(0.12, -0.59, 16), line(-0.34, -0.70, 24.5, 22.5),
               item("Box", -0.7, 0.3, **BOX), item("Box", -0.7, 0.2, **BOX),
               line(-0.6, 0.18, 15, 90), line(-0.8, 0.18, 15, 90), line(0.35, 0.8, 15, 90),
               item("Box", 0.25, 0.93, **BOX), item("Box", 0.25, 0.83, **BOX),
               line(0.15, 0.8, 15, 90)),
        shifts={"marker": (0.02, 0.02), "target": (0.02, 0.0)},
        subgoals=((0.7, -0.1),), boundary="RLC", marker_must_hit=True,
        target_hit_reward=2.0,  # appendix: 1; published task file: 2; as published
        max_actions=50,  # appendix: 30; published task file: 50; as published
    ),
    "seesaw": Task(
        target=ball("Target", 0.2, 0.9, "target"), goal=star(-0.8, -0.8),
        items=(ball("Heavy ball", -0.3, 0.5, "ball", mass=30, elasticity=0.1),
               item("See-saw", -0.3, -0.1, size=30, damping=1, max_angle=30, mass=1, on_left=True),
               line(0.1, -0.7, 40, 90), line(-0.9, -0.3, 20)),
        shifts={"ball": (0.05, 0.05), "target": (0.1, 0.1)},
        subgoals=((-0.1, -0.45),), boundary="RLC",
    ),
    # the other nine, Figure 8
    "navigate": Task(
        marker=ball("Marker", -0.6, 0.75),
        target=ball("Target", 0.1, -0.24, "target"), goal=star(-0.65, -0.59, "goal"),
        items=(line(0.1, -0.35, 16, 0, "target"), line(-0.65, -0.7, 16, 0, "goal"),
               line(-0.5, 0.1, 40)),
        shifts={"target": (0.1, 0.1), "goal": (0.2, 0.2)},
    ),
    "belt": Task(
        target=ball("Target", 0.75, 0.75, "target", size=3), goal=star(0.5, -0.7, "goal"),
        items=(item("Conveyor Belt", 0.55, 0.25, size=7, speed=-2.5),
               item("Conveyor Belt", 0.05, 0.2, size=7, speed=-2.5),
               item("Conveyor Belt", -0.3, -0.6, size=7, speed=5.0),
               line(0.41, -0.30, 65, kind="Line"), line(-0.34, -0.17, 12.7, 90, kind="Line")),
        shifts={"target": (0.1, 0.1), "goal": (0.1, 0.1)},
        subgoals=((-0.6, -0.35), (-0.15, 0.28), (-0.1, -0.5)),
        max_actions=50,  # appendix: 30; published task file: 50; as published
    ),
    "buckets": Task(
        target=ball("Target", 0.75, 0.75, "target", size=3), goal=star(-0.85, -0.85),
        items=(line(-0.48, -0.99, 45), line(-0.75, -0.15, 25),
               line(-0.99, -0.7, 45, 90), line(0.05, -0.7, 45, 90),
               item("Bucket", 0.05, -0.10, size=4), item("Bucket", -0.45, -0.10, size=4)),
        shifts={"target": (0.1, 0.1)}, subgoals=((-0.20, -0.10),),
    ),
    "cannon": Task(
        marker=ball("Marker", 0.8, 0.75, "marker"),
        target=ball("Target", 0.4, 0.11, "target"), goal=star(-0.7, -0.1, "goal"),
        items=(line(-0.1, 0.35, 55, 90), item("Cannon", -0.1, -0.8, angle=110, force=140),
               line(0.4, 0.0, 8, 0, "target")),
        shifts={"marker": (0.1, 0.1), "target": (0.05, 0.05), "goal": (0.05, 0.05)},
        boundary="RC", marker_must_hit=True,
    ),
    "collide": Task(
        target=ball("Target", 0.6, 0.7, "target"), goal=ball("Goal ball", -0.6, 0.7, "goal"),
        items=(line(0.0, 0.25, 35, 90),),
        shifts={"target": (0.1, 0.1), "goal": (0.1, 0.1)}, boundary="RLC",
    ),
    "moving": Task(
        target=ball("Target", 0.6, 0.75, "target"), goal=ball("Goal ball", -0.7, 0.0, "goal"),
        items=(item("Trampoline", -0.7, -0.75, elasticity=1.0, size=16),),
        shifts={"target": (0.2, 0.2), "goal": (0.0, 0.5)},
    ),
    "ladder": Task(
        marker=ball("Marker", 0.7, 0.75),
        target=ball("Target", 0.35, -0.09, "target"), goal=star(-0.75, -0.09, "goal"),
        items=(line(0.35, -0.2, 5, 0, "target"), line(-0.75, -0.2, 5, 0, "goal"),
               item("Ladder", -0.1, -0.1, **STAIR | {"size": 20})),
        shifts={"target": (0.1, 0.1), "goal": (0.2, 0.2)},
    ),
    "basket": Task(
        target=ball("Basketball", 0.75, 0.75, "target", size=3.5),
        goal=item("Basket", -0.75, 0.65, "goal", size=10),
        items=(item("Ladder", 0.5, -0.4, **STAIR), item("Ladder", -0.05, 0.0, **STAIR),
               item("Ladder", -0.55, 0.35, **STAIR)),
        shifts={"target": (0.1, 0.1), "goal": (0.1, 0.1)},
        subgoals=((0.35, -0.05), (-0.15, 0.35)),
        max_actions=40,  # appendix: 30; published task file: 40; as published
    ),
    "funnel": Task(
        # published task file: (0, 0.9), both coordinates shifted by U(-0.2, 0.05)
        target=ball("Target", -0.075, 0.825, "target"), goal=star(-0.28, -0.8),
        items=tuple(
            Item(one.tool._replace(angle=side * one.tool.angle), side * one.x, one.y)
            for side in (1, -1)
            for one in (
                line(-0.56, -0.99, 35.5), line(-0.88, -0.16, 10), line(-0.257, -0.16, 10),
                line(-0.99, -0.7, 45, 90), line(-0.15, -0.7, 45, 90),
                item("Funnel", -0.6, -0.15, angle=-45, size=8),
            )
        ),
        shifts={"target": (0.125, 0.125)}, goal_on_either_side=True,
    ),
}
# fmt: on
BOUNDARY = {side: line(x, 0, 90, 90, kind="Boundary") for side, x in (("R", 1), ("L", -1))}
BOUNDARY["C"] = line(0, 1, 90, kind="Boundary")  # no task has a floor


# ---- the physics: objects ----


def to_units(norm):
    """Agent coordinates [-1, 1] -> world units [0, 84]; numbers or arrays."""
    return (norm + 1.0) * WORLD / 2


def frame(x: float, y: float, angle: float) -> Callable:
    """Function (along, across) -> world point, in a frame at (x, y) turned by `angle` (rad)."""
    c, s = math.cos(angle), math.sin(angle)
    return lambda u, v=0.0: (x + c * u - s * v, y + s * u + c * v)


# appendix: a cannon "re-launches in a fixed direction"; published code: a 7.3 x 10 box frozen at 10
# rad, whatever the aim (two arguments swapped). We turn a 10 x 7.3 box with the aim, because that
# is what the picture shows; same muzzle, same shot.
BOX_SIZE = {"Cannon": (10.0, 7.3), "Fan": (6.7, 10.0), "Basket": (10.0, 10.0)}  # (along, across)
# published code: where a cannon puts the ball, times (cos, sin) of the aim: half the sides of its
# unturned box, not of ours, so that every shot is the published one
MUZZLE = (5.0, 3.65)
FIRST_CORNER = {"Funnel": 30, "Bucket": 45}  # published code, degrees at tool angle 0
# The no-op has nothing to touch. For the probe ball alone it is a disc to fly through: published
# code counts a ball as near within 0.1 sqrt(8) norm of the place, 11.9 units.
NO_OP_RADIUS = 0.1 * math.sqrt(8) * WORLD / 2 - BALL_RADIUS


def outline(tool: Tool) -> list[tuple[float, float]]:
    """Corners of an object, or ends of its line, around its place; discs have none.

    Where rules and pictures need a corner by its role: funnel 0 and 2 the mouth, 1 the nozzle;
    bucket 0 and 3 the opening; a weighted plank has its weight as the third point.
    """
    kind, half = KINDS[tool.kind], tool.size / 2
    at = frame(0.0, 0.0, math.radians(tool.angle))
    if kind.family == "segment":
        return [at(-half), at(half)]
    if kind.family == "plank":
        limit, side = math.radians(tool.max_angle), 1 if tool.on_left else -1
        tilt = -side * limit if tool.mass else 0.0  # a weighted see-saw starts on its limit
        end = (half * math.cos(tilt), half * math.sin(tilt))
        weight = (0.75 * half * math.cos(limit) * side, -0.75 * half * math.sin(limit))
        return [(-end[0], -end[1]), end] + [weight] * (tool.mass > 0)
    if kind.sides:  # the first corner is one step after the one at `angle`
        first = math.radians(tool.angle + FIRST_CORNER.get(tool.kind, 0))
        turns = [first + 2 * math.pi / kind.sides * k for k in range(1, kind.sides + 1)]
        return [(tool.size * math.cos(a), tool.size * math.sin(a)) for a in turns]
    if kind.family in ("box", "crate"):
        along, across = BOX_SIZE.get(tool.kind, (tool.size, tool.size))
        return [at(i * along / 2, j * across / 2) for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return []


@dataclass(eq=False)  # two balls with equal numbers are still two balls
class Thing:
    """One object in a scene: its table entry, its place (units), its pymunk parts."""

    tool: Tool
    kind: Kind
    x: float
    y: float
    corners: list  # of `outline`, units; what moves does not keep them
    shape: pymunk.Shape = None
    body: pymunk.Body = None  # only if it can move
    parts: tuple = ()  # everything to add to the space, bodies first
    wants: "Thing" = None  # the ball whose touch this goal, subgoal or marker waits for ...
    touched: bool = False  # ... and whether it came
    holder: "Thing" = None  # the bucket that holds this ball

    def pose(self) -> tuple[float, float, float]:
        """x, y (units) and angle (rad), now."""
        if self.body is None:
            return self.x, self.y, 0.0
        return *self.body.position, self.body.angle


def build(tool: Tool, x: float, y: float, static_body: pymunk.Body) -> Thing:
    """Make an object at (x, y) units, not yet added to a space. `static_body`: that space's."""
    kind, corners, mass, size = KINDS[tool.kind], outline(tool), tool.mass, tool.size
    thing = Thing(tool, kind, float(x), float(y), [(x + u, y + v) for u, v in corners])
    family, place, body, joints = kind.family, (thing.x, thing.y), static_body, []
    moments = {"ball": mass * size**2 / 2, "crate": mass * size**2 / 6, "plank": PLANK_MOMENT}
    if family in moments:
        body = pymunk.Body(PLANK_MASS if family == "plank" else mass, moments[family])
        body.position, thing.body = place, body
    if family in ("ball", "disc"):
        at = (0.0, 0.0) if thing.body else place
        shape = pymunk.Circle(body, size or NO_OP_RADIUS, at)
    elif family == "crate":
        shape = pymunk.Poly.create_box(body, (size, size))
    elif family == "segment":
        shape = pymunk.Segment(body, *thing.corners, kind.radius)
    elif family == "plank":
        # published code: a pin joint of length zero and a slide joint; we use the joints made for
        # the purpose, because with them the centre stays put (same motion on average)
        shape = pymunk.Segment(body, *corners[:2], 0.0)
        joints.append(pymunk.PivotJoint(body, static_body, place))
        if tool.max_angle:  # the tilt at the start is part of the segment, the body starts at 0
            limit = math.radians(tool.max_angle)
            tilt = (-limit if tool.on_left else limit) if mass else 0.0
            joints.append(pymunk.RotaryLimitJoint(static_body, body, -limit - tilt, limit - tilt))
        for at in thing.corners[2:]:
            weight = pymunk.Body(mass, mass)  # published code: mass = moment, no shape
            weight.position = at
            joints += [weight, pymunk.PivotJoint(body, weight, at)]
            joints.append(pymunk.GearJoint(body, weight, 0.0, 1.0))
    else:
        shape = pymunk.Poly(body, thing.corners)
    shape.collision_type, shape.sensor = int(kind.contact), kind.contact >= Contact.GOAL
    # The contact law multiplies both numbers of the two shapes; of most balls 1.
    shape.elasticity = VESSEL_ELASTICITY if family == "vessel" else float(tool.elasticity)
    # published code: never sets the friction of ball tools and planks, which leaves it at 0
    shape.friction = 0.0 if family in ("disc", "plank") else 1.0
    shape.thing = thing  # so that a contact rule knows what it has before it
    thing.shape, thing.parts = shape, (*([body] if thing.body else []), *joints, shape)
    return thing


# ---- the physics: what happens when two objects touch ----

# pymunk prints and swallows an exception raised in one of these rules, so each is a few plain
# assignments. `process_collision` lasts as long as the contact: a rule that decides anew at every
# step must write True as well as False.


def _stop(body: pymunk.Body, position: tuple[float, float]) -> None:  # there, at rest
    body.position, body.velocity, body.force = position, (0.0, 0.0), (0.0, 0.0)
    body.angle = body.angular_velocity = body.torque = 0.0


def _on_goal(arbiter, space, data) -> None:  # goals and subgoals remember the touch they wait for
    a, b = (shape.thing for shape in arbiter.shapes)
    a.touched |= a.wants is b
    b.touched |= b.wants is a


def _on_carrier(arbiter, space, data) -> None:  # on belts and ladders a ball moves as they do
    ball, carrier = arbiter.shapes
    speed, aim = carrier.thing.tool.speed, math.radians(carrier.thing.tool.angle)
    lean = LADDER_LEAN if carrier.thing.kind.contact == Contact.LADDER else 1.0
    ball.body.velocity = lean * speed * math.cos(aim), speed * math.sin(aim)


def _on_cannon(arbiter, space, data) -> None:  # when contact begins, lest it catch its own shot
    ball, cannon = (shape.thing for shape in arbiter.shapes)
    if ball.holder is not None:  # by a bucket, for good
        return
    aim, speed = math.radians(cannon.tool.angle), cannon.tool.force / ball.body.mass
    direction = math.cos(aim), math.sin(aim)
    _stop(ball.body, (cannon.x + MUZZLE[0] * direction[0], cannon.y + MUZZLE[1] * direction[1]))
    ball.body.velocity = speed * direction[0], speed * direction[1]


def _on_fan(arbiter, space, data) -> None:  # the same force anywhere in the box
    ball, fan = arbiter.shapes
    aim, force = math.radians(fan.thing.tool.angle), fan.thing.tool.force
    push = force * math.cos(aim), force * math.sin(aim)
    # appendix: silent; published code: force in the frame of the (rolling) ball, its stand-alone
    # release: in the world. As the release, because wind does not turn with the ball.
    ball.body.apply_force_at_world_point(push, ball.body.position)


def _on_funnel(arbiter, space, data) -> None:  # in by the mouth, out by the nozzle, else solid
    ball, funnel = (shape.thing for shape in arbiter.shapes)
    left, nozzle, right = (math.dist(ball.body.position, corner) for corner in funnel.corners)
    caught = ball.holder is None and nozzle > left and nozzle > right
    if caught:
        _stop(ball.body, funnel.corners[1])
    arbiter.process_collision = not caught


def _on_bucket(arbiter, space, data) -> None:  # holds what comes in by the opening for good
    ball, bucket = (shape.thing for shape in arbiter.shapes)
    if ball.holder is None:
        d1, d2, d3, d4 = (math.dist(ball.body.position, corner) for corner in bucket.corners)
        if max(d1, d4) < min(d2, d3):
            ball.holder = bucket
    if ball.holder is bucket:
        # appendix: silent; published code: resets the position only, so the ball's speed grows
        # without end; its stand-alone release also stops it. As the release.
        _stop(ball.body, (bucket.x, bucket.y))
    arbiter.process_collision = ball.holder is None


def _on_plank(arbiter, space, data) -> None:  # a damping above 1 slows a ball at every step
    ball, plank = (shape.thing for shape in arbiter.shapes)
    keep = 2.0 - plank.tool.damping
    if ball.kind.family == "ball" and keep < 1.0:  # writing a speed wakes a sleeping ball
        ball.body.velocity = ball.body.velocity * keep
        ball.body.angular_velocity *= keep


def make_space() -> pymunk.Space:
    """An empty world with CREATE's gravity and contact rules, for the game and the probe ball."""
    space = pymunk.Space()  # 10 solver iterations and no damping are pymunk's defaults
    space.gravity, space.sleep_time_threshold = GRAVITY, SLEEP_TIME
    moving = Contact.MOVING
    space.on_collision(Contact.GOAL, moving, pre_solve=_on_goal)
    space.on_collision(moving, moving, begin=_on_goal)
    space.on_collision(moving, Contact.BELT, pre_solve=_on_carrier)
    space.on_collision(moving, Contact.LADDER, pre_solve=_on_carrier)
    space.on_collision(moving, Contact.CANNON, begin=_on_cannon)
    space.on_collision(moving, Contact.FAN, pre_solve=_on_fan)
    space.on_collision(moving, Contact.FUNNEL, pre_solve=_on_funnel)
    space.on_collision(moving, Contact.BUCKET, pre_solve=_on_bucket)
    space.on_collision(moving, Contact.PLANK, post_solve=_on_plank)
    return space


# ---- A.3 state: one table of strokes for the observation, the probe videos and people ----

# A stroke is (points, width, grey, colour): points in units, y up. One point is a dot of that
# width, several are a line with round ends. Width 0 fills a polygon, a negative one draws its edge.
# Grey None: only people see it; colour None: only the policy does. Greys follow the contact shape,
# plus the marks that tell a direction (muzzle, blowing side, nozzle, opening, head of a belt).
Stroke = tuple[list, float, int | None, str | tuple | None]
PAPER, INK, STEEL, DARK = "#fdfcf8", "#3b3a44", "#8d8a94", "#55525f"


@functools.cache
def shade(colour: str, factor: float, alpha: int = 255) -> tuple[int, int, int, int]:
    """A colour made darker (factor < 1) or lighter (> 1, white at 2), perhaps see-through."""
    rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    paler = [c + (255 - c) * (factor - 1) if factor > 1 else c * factor for c in rgb]
    return (*map(int, paler), alpha)


def strokes(tool: Tool, pose: tuple[float, float, float]) -> list[Stroke]:
    """How an object looks at x, y (units) and angle (rad), whoever looks."""
    # published code: aliased flat shapes and rotated PNGs squeezed into boxes, in a palette of 8
    # bits, the whole picture mirrored left to right. We draw upright, flat shapes at the same
    # nominal greys, because a picture should not depend on image files and their palette.
    x, y, angle = pose
    kind, turned = KINDS[tool.kind], frame(x, y, angle)
    corners = [turned(u, v) for u, v in outline(tool)]
    at = frame(x, y, angle + math.radians(tool.angle))  # (along the aim, across)
    return [*LOOKS[kind.family](tool, kind, kind.colour, corners, at)]


def _look_round(tool, kind, colour, corners, at):  # balls that move, ball tools, subgoals
    (x, y), size, subgoal = at(0), float(tool.size), tool.kind == "Subgoal"
    if tool.kind == "No-op":
        return
    yield [(x, y)], 2 * size, kind.grey, "#8fd16a" if subgoal else shade(colour, 0.7)
    yield [(x, y)], 2 * size - 0.9, None, colour
    if kind.family == "disc":  # a paler middle, more so if it is bouncy
        pale = "#a9e08a" if subgoal else shade(colour, 1.35 if tool.elasticity > 0.6 else 1.2)
        yield [(x, y)], 0.8 * size if subgoal else size, None, pale
        return
    reach, seam = 0.72 * size, shade(colour, 0.75, 150)  # a stripe shows the spin
    yield [at(-reach), at(reach)], 0.5, None, seam
    if tool.kind == "Basketball":
        yield [at(0, -reach), at(0, reach)], 0.5, None, seam
    yield [(x - 0.36 * size, y + 0.38 * size)], 0.48 * size, None, (255, 255, 255, 170)


def _look_flat(tool, kind, colour, corners, at):  # polygons, crates, the star
    (x, y), edge = at(0), shade(colour, 0.7)
    if tool.kind == "Goal star":
        turns = [(4.3 if k % 2 == 0 else 1.9, math.pi * (0.5 + k / 5)) for k in range(10)]
        points = [(x + r * math.cos(a), y + r * math.sin(a)) for r, a in turns]
        yield corners, 0, kind.grey, None  # the pentagon that counts
        yield [(x, y)], 10.4, None, shade(colour, 1.5, 90)
        yield points, 0, None, colour
        yield points, -0.45, None, edge
        return
    yield corners, 0, kind.grey, colour
    yield corners, -0.5, None, edge
    if kind.family == "crate":
        yield corners[::2], 0.5, None, edge
    else:
        inner = [(x + 0.55 * (u - x), y + 0.55 * (v - y)) for u, v in corners]
        yield inner, 0, None, shade(colour, 1.35 if tool.elasticity > 0.6 else 1.2)


def _look_bar(tool, kind, colour, corners, at):  # ramps, walls; trampolines; belts; ladders
    half, width = tool.size / 2, max(2 * kind.radius, 1.0)
    if tool.kind == "Ladder":
        yield corners, width, kind.grey, None
        for v in (-1.3, 1.3):
            yield [at(-half, v), at(half, v)], 0.7, None, colour
        for k in range(int(half // 1.25)):
            u = 1.25 + 2.5 * k - half
            yield [at(u, -1.3), at(u, 1.3)], 0.5, None, colour
        return
    if tool.kind == "Trampoline":  # on legs
        below = -1 if math.cos(math.radians(tool.angle)) > -1e-9 else 1  # the side of the ground
        for u in (-0.75 * half, 0.75 * half):
            yield [at(u), at(1.1 * u, 2.6 * below)], 0.6, None, "#9aa0ac"
        colour = "#8fb8ff"
    yield corners, width, kind.grey, shade(kind.colour, 0.72)
    yield corners, (0.4 if tool.kind == "Trampoline" else 0.62) * width, None, colour
    if tool.kind == "Conveyor Belt":
        way, rollers = math.copysign(1, tool.speed), max(2, int(half // 1.2))
        yield [corners[tool.speed > 0]], 3.6, kind.grey, None
        for k in range(rollers + 1):
            yield [at(half * (2 * k / rollers - 1))], 1.1, None, "#c9cad6"
        for k in range(1 + abs(round(tool.speed)) // 3):  # one to three arrow heads, by speed
            u = way * (1.6 * k - 0.4)
            yield [at(u - 0.8 * way, 3), at(u, 2.2), at(u - 0.8 * way, 1.4)], 0.4, None, colour


def _look_plank(tool, kind, colour, corners, at):  # levers and see-saws
    (x, y), ends = at(0), corners[:2]
    yield [(x, y), (x - 2, y - 2), (x + 2, y - 2)], 0, kind.grey, None
    yield [(x, y), (x - 2.2, y - 3), (x + 2.2, y - 3)], 0, None, STEEL
    if tool.max_angle:  # a plate tells a see-saw from a lever
        yield [(x - 2.9, y - 3.1), (x + 2.9, y - 3.1)], 0.7, None, DARK
    yield ends, 1.0, kind.grey, None
    yield ends, 1.5, None, "#9c6b30"
    yield ends, 0.9, None, "#e0a35c"
    for point in corners[2:]:
        yield [point], 3.0, kind.grey, None
        yield [point], 2.4 + 0.14 * tool.mass, None, "#2f2d38"  # only people see how heavy
        yield [point], 1.8 + 0.14 * tool.mass, None, "#4c4a57"
    yield [(x, y)], 1.4, None, DARK


def _look_box(tool, kind, colour, corners, at):  # cannon, fan, basket
    dark = shade(colour, 0.62)
    if tool.kind == "Cannon":  # a barrel on a wheel
        yield corners, 0, kind.grey, None
        yield [at(3.5)], 3.0, 255, None
        for b, f, u, ink in ((3.2, 2.6, 4.6, dark), (2.7, 2.1, 4.2, colour)):
            yield [at(-2.2)], 2 * b, None, ink
            yield [at(-2.2, b), at(-2.2, -b), at(u, -f), at(u, f)], 0, None, ink
        yield [at(-2.0, 1.5), at(3.6, 1.2)], 0.7, None, shade(colour, 1.35)
        yield [at(3.9, 3.5), at(3.9, -3.5), at(5, -3.5), at(5, 3.5)], 0, None, shade(colour, 0.5)
        yield [at(-2.2)], 3.0, None, "#4a3526"
        yield [at(-2.2)], 2.3, None, "#6b4f3a"
        return
    yield corners, -1.0, kind.grey, None
    if tool.kind == "Basket":  # a ring and its net
        for k in range(-2, 3):
            for side in (-1.2, 1.2):
                yield [at(2.3 * k, 4.2), at(1.3 * k + side, -4.6)], 0.25, None, "#9c9ca8"
        yield [at(0)], 10.0, None, shade(GREEN, 1.5, 60)
        yield [at(-5, 4.4), at(5, 4.4)], 1.1, None, colour
        return
    yield [at(0), at(3.35)], 1.6, kind.grey, None  # where the fan blows to
    yield corners, 0, None, shade(colour, 1.85, 150)
    yield [at(-3.3, 1.1), at(-3.3, -1.1), at(-1.9, -0.8), at(-1.9, 0.8)], 0, None, dark
    for v in (1, -1):
        blade = [at(-1.9), at(-1.0, 1.6 * v), at(-1.5, 4.6 * v), at(-2.4, 2.6 * v)]
        yield blade, 0, None, colour
        yield blade, -0.3, None, dark
    yield [at(-1.9)], 1.8, None, dark
    reach = 0.6 + 2.4 * tool.force / 120  # its wind, longer for a stronger fan
    for v in (-3.0, 0.0, 3.0):
        yield [at(0.1, v), at(reach, v)], 0.4, None, "#8fb9d8"
        head = [at(reach - 0.8, v + 0.7), at(reach, v), at(reach - 0.8, v - 0.7)]
        yield head, 0.4, None, "#8fb9d8"


def _look_vessel(tool, kind, colour, corners, at):  # funnel and bucket
    size, half = tool.size, tool.size / math.sqrt(2)
    yield corners, 1.2, kind.grey, None  # not closed: the open side is missing
    if tool.kind == "Funnel":  # a cone with a dark mouth and a nozzle
        yield corners, 0, None, colour
        yield corners, -0.5, None, shade(colour, 0.7)
        shine = [at(-0.55 * size, size / 2), at(-0.14 * size, size / 2), corners[1]]
        yield shine, 0, None, shade(colour, 1.45)
        yield corners[::2], 1.0, None, shade(colour, 0.55)
        yield [corners[1]], 1.6, None, shade(colour, 0.55)
        return
    # a pail with a handle, a shine, two hoops and a bright rim at the opening
    handle = [(math.cos(k * math.pi / 8), 1 + 0.55 * math.sin(k * math.pi / 8)) for k in range(9)]
    yield [at(u * half, v * half) for u, v in handle], 0.35, None, "#8b8b94"
    yield corners, 0, None, colour
    yield corners, -0.4, None, shade(colour, 0.65)
    shine = [(-0.7, 0.8), (-0.7, -0.9), (-0.35, -0.9), (-0.35, 0.8)]
    yield [at(u * half, v * half) for u, v in shine], 0, None, shade(colour, 1.25)
    for v in (0.3 * half, -0.55 * half):
        yield [at(-half, v), at(half, v)], 0.4, None, shade(colour, 0.65)
    yield [at(-half, half), at(half, half)], 1.0, None, shade(colour, 1.6)


LOOKS = {"disc": _look_round, "ball": _look_round, "polygon": _look_flat, "crate": _look_flat}
LOOKS |= {"segment": _look_bar, "plank": _look_plank, "box": _look_box, "vessel": _look_vessel}
FINE = 3  # ours: drawn so many times too large and averaged, for soft edges and small moves
CAPTION = 6.0  # ours, units: room under the colour picture for a line of words


class Canvas:
    """A picture of the world, in grey (size x size) or in colour with room for a caption."""

    def __init__(self, size: int, colour: bool = False):
        self.colour, self.scale = colour, size * FINE / WORLD  # fine pixels per unit
        height = size + colour * round(size * CAPTION / WORLD)
        mode, paper = ("RGB", PAPER) if colour else ("L", 255)  # the observation is on white
        self.image = Image.new(mode, (size * FINE, height * FINE), paper)
        for v in np.arange(1, 8) * WORLD / 8 if colour else ():
            grid = ([(v, 0), (v, WORLD)], [(0, v), (WORLD, v)])
            self.draw([(points, 0.12, None, "#f1efe8") for points in grid])

    def copy(self) -> "Canvas":
        other = copy.copy(self)
        other.image = self.image.copy()
        return other

    def draw(self, marks: Iterable[Stroke]) -> "Canvas":
        """Draw strokes, later ones over earlier ones."""
        pen = ImageDraw.Draw(self.image, "RGBA" if self.colour else "L")
        for points, width, grey, colour in marks:
            ink = colour if self.colour else grey
            if ink is None:
                continue
            # Pillow rounds to fine pixels: in the observation a ball moves in thirds of a unit.
            pixels = [(x * self.scale, (WORLD - y) * self.scale) for x, y in points]
            pixels += pixels[:1] if width < 0 else []
            wide = max(1, round(abs(width) * self.scale))
            if width == 0:
                pen.polygon(pixels, fill=ink)
            elif len(points) > 1:
                pen.line(pixels, fill=ink, width=wide)
            for x, y in pixels if width and wide > 2 else ():
                left, top = round(x - wide / 2), round(y - wide / 2)
                pen.ellipse((left, top, left + wide - 1, top + wide - 1), fill=ink)
        return self

    def picture(self) -> np.ndarray:
        """uint8 (size, size) grey, or (height, size, 3) in colour."""
        return np.array(self.image.reduce(FINE))


# ---- A.3 the environment ----

# What came of the last action (`CreateEnv.placement`). TOO_CLOSE: to a tool placed before. BLOCKED:
# by a shape, goals and subgoals included. OUTSIDE: of the screen.
Placement = enum.Enum("Placement", "PLACED WAITED TOO_CLOSE BLOCKED OUTSIDE")
PENALTY = {Placement.TOO_CLOSE: LAMBDA_OVERLAP, Placement.BLOCKED: LAMBDA_OVERLAP}
PENALTY |= {Placement.OUTSIDE: LAMBDA_INVALID}


class CreateEnv(gym.Env):
    """Place tools so that the target ball reaches the goal (appendix A.3).

    ## Description
    A 2-D world of 84 x 84 units with gravity. Every action places at most one tool, then 40 physics
    steps (1.33 s) run. A placed tool stays for the rest of the episode. There is no floor.

    ## Action Space
    `Dict(choice=Discrete(K), position=Box(-1, 1, (2,), float32))`: a place in `available`, and
    where to put the tool's centre (x to the right, y up, in norm). Choice 0 is always the no-op.

    ## Observation Space
    | key       | space                              | meaning                                    |
    |-----------|------------------------------------|--------------------------------------------|
    | state     | Box(0, 255, (3, 84, 84), uint8)    | last 3 grey pictures, newest last          |
    | available | Box(0, NUM_ACTIONS-1, (K,), int64) | the tools on offer in this episode         |

    Before the first picture `state` is black. `available` is the no-op and K - 1 tools, drawn
    without replacement from the pool at every reset. So it is for every pool: N tools allow K up to
    N + 1, and then there is nothing to draw: the no-op, then the pool in sorted order.

    ## Rewards
    0.01 per action; +10 for the goal; +2 for each subgoal once; -0.01 for a blocked placement or
    one outside the screen. In tasks with a marker ball, blue marker -> red target -> green goal
    (Figure 3): +1 (obstacle 2) for the target hit, the target's first move of 3.56 units (obstacle,
    cannon: after the marker touched it). The goal counts only from then on.

    ## Starting State
    The task's level with its random shifts; everything at rest.

    ## Episode End
    Terminated: goal reached; target off the screen; marker off the screen before the target hit;
    nothing moving at the end of two actions. Truncated: 30 actions (obstacle, belt 50; basket 40).
    On the last step `info` has `success`, 0.0 or 1.0.

    ## Arguments
    `action_pool` ids (default: training split; the no-op may be among them), `num_available` K,
    `task` one of `TASKS`, `subgoal_reward=False` pays neither subgoals nor target hit (C.3),
    `render_size` pixels of the colour picture. What does not exist of these, and bad actions, raise
    ValueError and change nothing.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}

    def __init__(
        self, action_pool=None, num_available=NUM_AVAILABLE, render_mode=None,
        task="push", subgoal_reward=True, render_size=420,
    ):  # fmt: skip
        if task not in TASKS:
            raise ValueError(f"unknown task {task!r}; allowed: {', '.join(TASKS)}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; allowed: None, 'rgb_array'")
        ids = check_ids(split_actions()["train"] if action_pool is None else action_pool)
        self.action_pool = np.sort(ids[ids != NO_OP])
        check_ids([NO_OP, *self.action_pool], num_available)
        self.num_available, self.task = num_available, TASKS[task]
        self.subgoal_reward = subgoal_reward
        self.render_mode, self.render_size = render_mode, render_size
        self.observation_space = spaces.Dict(
            state=spaces.Box(0, 255, (NUM_FRAMES, 84, 84), np.uint8),
            available=spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
        )
        self.action_space = spaces.Dict(
            choice=spaces.Discrete(num_available), position=spaces.Box(-1, 1, (2,), np.float32)
        )
        self._over, self._pictures = True, []  # no episode yet

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode with a new set of tools; returns (observation, {})."""
        super().reset(seed=None if seed is None else operator.index(seed))  # numpy integers, too
        # published code: the Full Split's test draws a class, then a tool of it; we: as in
        # training, because the appendix names no other way
        drawn, k = self.action_pool, self.num_available - 1
        if k < len(drawn):
            drawn = self.np_random.choice(drawn, k, replace=False)
        self.available = np.concatenate([[NO_OP], drawn])  # (K,)
        self._build_level()
        self._centres: list[list[float]] = []  # norm, of the tools placed so far
        self._goal_hit, self._target_hit = False, self._marker is None
        self._still, self._actions, self._over = 0, 0, False
        self._tool, self._position, self.placement = TOOLS[NO_OP], [0.0, 0.0], Placement.WAITED
        self._frames = np.zeros((NUM_FRAMES, 84, 84), np.uint8)
        self._trails = [(ball, []) for ball in (self._target, self._marker) if ball]
        observation = self._observe()
        self._pictures = [self._draw()] if self.render_mode else []
        return observation, {}

    def _build_level(self) -> None:
        """A fresh space with the task's objects."""
        task, rng = self.task, self.np_random
        shift = {name: rng.uniform((-x, -y), (x, y)) for name, (x, y) in task.shifts.items()}
        self._space, self._things = make_space(), []

        def add(item: Item, side: int = 1) -> Thing:
            dx, dy = shift.get(item.shift, (0.0, 0.0))
            x, y = to_units(side * item.x + dx), to_units(item.y + dy)
            self._things.append(build(item.tool, x, y, self._space.static_body))
            self._space.add(*self._things[-1].parts)
            return self._things[-1]

        self._marker = add(task.marker) if task.marker else None
        for one in task.items:
            add(one)
        self._subgoals = [add(item("Subgoal", x, y, size=3)) for x, y in task.subgoals]
        for side in task.boundary:
            add(BOUNDARY[side])
        self._target = add(task.target)
        self._goal = add(task.goal, -1 if task.goal_on_either_side and rng.random() < 0.5 else 1)
        self._goal.wants, self._start = self._target, self._target.pose()[:2]
        if self._marker:
            self._marker.wants = self._target
        for subgoal in self._subgoals:
            subgoal.wants = self._marker or self._target
        self._repaint()

    def step(self, action: dict):
        """Place a tool, run 40 physics steps, settle accounts. After the end: ResetNeeded."""
        choice, position = action["choice"], np.asarray(action["position"], np.float64)
        if not self.action_space["choice"].contains(choice):
            raise ValueError(f"choice must be 0..{self.num_available - 1}, got {choice!r}")
        if position.shape != (2,) or not np.isfinite(position).all():
            raise ValueError(f"position must be two finite numbers, got {position}")
        if self._over:
            raise gym.error.ResetNeeded("the episode is over (or none began): call reset()")
        self._tool, self._position = TOOLS[self.available[choice]], position.tolist()
        self.placement, self._pictures = self._place(), []
        for substep in range(SUBSTEPS):
            if self.render_mode and substep and substep % PICTURE_EVERY == 0:
                self._pictures.append(self._draw())
            self._space.step(DT)
        self._actions += 1
        reward = self._reward(*self._settle())
        terminated, truncated = self._ended()
        self._over, observation = terminated or truncated, self._observe()
        if self.render_mode:
            self._pictures.append(self._draw())
        info = {METRIC: float(self._goal_hit)} if self._over else {}
        return observation, reward, terminated, truncated, info

    def _place(self) -> Placement:
        """Put the chosen tool at its position if it may stand there."""
        if self._tool.kind == "No-op":
            return Placement.WAITED
        # appendix: a penalty "for placing outside the scene"; published code: clips the position
        # first, so its penalty never fires; we do not clip, because the appendix has it
        if max(map(abs, self._position)) > 1.0:
            return Placement.OUTSIDE
        # appendix: "overlap over existing objects"; published code: this distance to earlier tools,
        # or contact of the exact shapes with anything in the scene. As published.
        if any(math.dist(self._position, centre) <= MIN_TOOL_GAP for centre in self._centres):
            return Placement.TOO_CLOSE
        thing = build(self._tool, *map(to_units, self._position), self._space.static_body)
        if self._space.shape_query(thing.shape):  # sensors count
            return Placement.BLOCKED
        self._space.add(*thing.parts)
        self._things.append(thing)
        self._centres.append(self._position)
        self._paint([thing])
        return Placement.PLACED

    def _settle(self) -> tuple[bool, int, bool]:
        """Who touched what: (goal reached, subgoals reached, target first moved) in this step."""
        moved = False
        if not self._target_hit:
            # in shares of the screen's diagonal; who has left the screen counts at its edge
            now = [min(max(value, 0.0), WORLD) for value in self._target.body.position]
            far = math.dist(now, self._start) > HIT_DISTANCE * WORLD * math.sqrt(2)
            moved = far and (self._marker.touched or not self.task.marker_must_hit)
            self._target_hit = moved
        # published code: tests the goal before the target hit and never forgets a touch, so a goal
        # touched too soon counts at the hit, wherever the target is by then. We: a touch in the
        # action of the hit counts, an earlier one does not, because the hit is the way to the goal.
        self._goal.touched = self._goal_hit = self._target_hit and self._goal.touched
        # published code: a subgoal counts if touched at the end of an action; we: at any time in
        # it, because that is the rule of the goal
        reached = [subgoal for subgoal in self._subgoals if subgoal.touched]
        for subgoal in reached:
            self._space.remove(*subgoal.parts)
            self._things.remove(subgoal)
            self._subgoals.remove(subgoal)
        if reached:
            self._repaint()
        return self._goal_hit, len(reached), moved

    def _reward(self, goal: bool, subgoals: int, target_moved: bool) -> float:
        """Equation 3. Appendix: products of the bonus terms; published code: sums, as here."""
        # published code: the goal and each subgoal pay 0.1 less per placed tool; we: as Eq. 3
        reward = LAMBDA_ALIVE + goal * LAMBDA_GOAL + PENALTY.get(self.placement, 0.0)
        # C.3 names subgoals; push has none and was run without them all the same, so the reward for
        # the target hit must have been meant too.
        if self.subgoal_reward:
            reward += subgoals * LAMBDA_SUBGOAL + target_moved * self.task.target_hit_reward
        return reward

    def _ended(self) -> tuple[bool, bool]:
        """(terminated, truncated) after this action."""
        # appendix: silent about balls that leave; published code: ends, as here
        needed = [self._target] if self._target_hit else [self._target, self._marker]
        lost = not all(0.0 < value < WORLD for ball in needed for value in ball.body.position)
        # "no moving objects": planks count, a see-saw's weight does not (published code). A ball in
        # a bucket is at rest, though gravity has just added 0.07 to its speed.
        moving = (thing.body for thing in self._things if thing.body and not thing.holder)
        self._still += all(body.velocity.length < STILL_SPEED for body in moving)
        # appendix: the episode ends at the goal; published code: goes on. As the appendix.
        terminated = self._goal_hit or lost or self._still >= STILL_ACTIONS
        # appendix: 30; published code: one more than its limit. The exact limit.
        return terminated, not terminated and self._actions >= self.task.max_actions

    def _repaint(self) -> None:
        """Pictures of all that stands still; what moves is drawn on copies of them."""
        self._canvases = [Canvas(84)]
        if self.render_mode:
            self._canvases.append(Canvas(self.render_size, colour=True))
        self._paint(self._things)

    def _paint(self, things: Sequence[Thing]) -> None:
        for thing in things:
            for canvas in self._canvases if thing.body is None else ():
                canvas.draw(strokes(thing.tool, thing.pose()))

    def _moving(self) -> Iterable[Stroke]:
        # published code: target and goal first, tools, level objects last; we: what stands still
        # first, because it can be kept from step to step
        for thing in self._things:
            if thing.body:
                yield from strokes(thing.tool, thing.pose())

    def _observe(self) -> dict[str, np.ndarray]:
        picture = self._canvases[0].copy().draw(self._moving()).picture()[None]  # (1, 84, 84)
        self._frames = np.concatenate([self._frames[1:], picture])  # (3, 84, 84), a fresh array
        return {"state": self._frames.copy(), "available": self.available.copy()}

    def _draw(self) -> np.ndarray:
        """This moment in colour, with trails and a caption; beside it the policy's last state."""
        canvas = self._canvases[1].copy()
        for ball, trail in self._trails:  # dots that fade with age
            trail.append(ball.pose()[:2])
            for k, point in enumerate(trail[-90:]):
                alpha = 40 + 150 * k // min(len(trail), 90)
                canvas.draw([([point], 1.1, None, shade(ball.kind.colour, 1.1, alpha))])
        canvas.draw(self._moving())
        words, colour = self.placement.name.lower().replace("_", " "), "#2a7f3f"
        if self.placement in PENALTY:  # a red cross where it may not stand
            (x, y), colour = np.clip(np.add(self._position, 1) * 42, 2, WORLD - 2), "#c1121f"
            for v in (-1.6, 1.6):
                canvas.draw([([(x - 1.6, y - v), (x + 1.6, y + v)], 0.8, None, colour)])
        if self._goal_hit:
            words, (x, y) = "goal!", self._goal.pose()[:2]
            turns = [k / 18 * math.pi for k in range(37)]
            ring = [(x + 7.1 * math.cos(turn), y + 7.1 * math.sin(turn)) for turn in turns]
            canvas.draw([(ring, 0.8, None, GREEN)])
        paper = [(0, 0), (WORLD, 0), (WORLD, -CAPTION), (0, -CAPTION)]
        canvas.draw([(paper, 0, None, PAPER), (paper[:2], 0.25, None, "#cfcdd6")])
        pen, scale = ImageDraw.Draw(canvas.image), canvas.scale
        font, y = ImageFont.load_default(3.1 * scale), (WORLD + CAPTION / 2) * scale
        name = f"{self._actions}/{self.task.max_actions}  {self._tool.kind}"
        pen.text((1.5 * scale, y), name, INK, font, "lm")
        pen.text(((WORLD - 1.5) * scale, y), words * (self._actions > 0), colour, font, "rm")
        picture, size, eye = canvas.picture(), self.render_size, np.vstack(self._frames)
        page = Image.new("RGB", (size + 6 + size // 3, len(picture)), PAPER)
        page.paste(Image.fromarray(picture))
        page.paste(Image.fromarray(eye).resize((size // 3, size)), (size + 6, 0))
        return np.array(page)

    def render(self) -> np.ndarray | None:
        """The scene now and what the policy sees, uint8 (height, width, 3), or None."""
        return self.render_frames()[-1] if self.render_mode else None

    def render_frames(self) -> list[np.ndarray]:
        """Pictures of the last step: 5, or 1 right after a reset, or none without render_mode."""
        if self.render_mode and not self._pictures:
            raise gym.error.ResetNeeded("call reset() before the first picture")
        return self._pictures


gym.register("ActionGen/Create-v0", entry_point=f"{__name__}:CreateEnv")
for _task in TASKS:  # ActionGen/Create-Push-v0 and so on
    _id = f"ActionGen/Create-{_task.capitalize()}-v0"
    gym.register(_id, entry_point=f"{__name__}:CreateEnv", kwargs={"task": _task})


def make_vec(num_envs, action_pool=None, num_available=NUM_AVAILABLE, seed=0, **options):
    """SyncVectorEnv of `num_envs` independent streams; `options`, ValueErrors as `CreateEnv`."""
    one = functools.partial(CreateEnv, action_pool, num_available, **options)
    envs = gym.vector.SyncVectorEnv([one] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    # seed + i would let neighbouring seeds share environments; a SeedSequence's words do not.
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs


# ---- A.3, B action observations: the probe ball ----

PROBE_ATTEMPTS = 8  # published code: launches until the ball touches the tool
PROBE_STEPS = 90  # published code: physics steps per launch
PROBE_EVERY = 10  # published code: a state is recorded after steps 10, 20, ..., 90
PROBE_LENGTH = 7  # A.3 "ball trajectories of length 7", cut out of the 9 recorded states
PROBE_SPEED = 12.5  # published code, units/s
PROBE_AREA = 0.7  # published code, norm: the tool stands in [-0.7, 0.7]^2
PROBE_VIDEO = 48  # appendix: 48x48 in A.3 and D.3.1, 84x84 in B; published code: 48x48. As A.3.
PROBE_BALL = Tool("Marker", 1.0, size=BALL_RADIUS, mass=BALL_MASS)
CELL = 1_000.0  # ours, units: trajectories run side by side in one space, too far apart to meet


def action_observations(action_ids, num_observations, modality="xy", seed=0, workers=1):
    """Trajectories of a probe ball launched at each tool, an array (A.3 action observations, B).

    | modality | result                                                                           |
    |----------|----------------------------------------------------------------------------------|
    | "xy"     | float32 (len(ids), n, 7, 2): ball x, y (norm; the paper's default)               |
    | "state"  | float32 (len(ids), n, 7, 6): tool x, y, ball x, y (norm), ball velocity (norm/s) |
    | "video"  | uint8 (len(ids), n, 7, 48, 48): grey pictures of the same scenes                 |

    n = `num_observations` (paper: 1,024). Frames are 1/3 s apart; the contact is near the middle.
    The bytes for one tool depend on (seed, tool, n) only, not on `workers` or the other ids.
    "video" needs 16 MB per tool at n = 1,024. Raises ValueError for bad ids, modality or n.
    """
    ids, shapes = check_ids(action_ids), {"xy": (2,), "state": (6,), "video": (PROBE_VIDEO,) * 2}
    if modality not in shapes or num_observations < 1:
        raise ValueError(f"modality {modality!r} is not one of {MODALITIES}, or n is below 1")
    shape = (len(ids), num_observations, PROBE_LENGTH, *shapes[modality])
    result = np.empty(shape, np.uint8 if modality == "video" else np.float32)
    job = functools.partial(_record, num_observations, modality, seed)
    with multiprocessing.Pool(workers) if workers > 1 else contextlib.nullcontext() as pool:
        rows = pool.imap(job, ids.tolist(), 4) if pool else map(job, ids.tolist())
        # disable=None: no bar where nobody watches (a log file, a test)
        bar = tqdm(rows, "probe ball", len(ids), delay=2.0, unit="tool", leave=False, disable=None)
        for row, recorded in enumerate(bar):
            result[row] = recorded
    return result


def _record(n: int, modality: str, seed: int, action: int) -> np.ndarray:
    """All observations of one tool: launch n balls, then again those that missed."""
    tool, rng = TOOLS[action], np.random.default_rng([seed, action])
    places = rng.uniform(-PROBE_AREA, PROBE_AREA, (n, 2))  # norm, one per trajectory
    result = np.zeros((n, PROBE_LENGTH, 7), np.float32)
    waiting, attempt = np.arange(n), 0
    while len(waiting):
        last = attempt >= PROBE_ATTEMPTS - 1  # then a miss is kept, an overlap draws again
        start = rng.uniform(-1.0, 1.0, (len(waiting), 2))
        gap = places[waiting] - start  # the ball flies at the tool's centre
        distance = np.linalg.norm(gap, axis=1, keepdims=True)  # (waiting, 1) norm
        # published code: faster from afar, and at every new attempt
        speed = PROBE_SPEED * (1 + 0.4 * min(attempt, PROBE_ATTEMPTS - 1)) * (1 + distance)
        speed *= rng.uniform(0.6, 1.4, (len(waiting), 1))
        velocity = speed * gap / np.maximum(distance, 1e-9)
        states, contact = _launch(tool, places[waiting], start, velocity)
        # contact: physics step 1..90 of the first touch, 0 overlap at launch, 91 never
        done = (contact > 0) & ((contact <= PROBE_STEPS) | last)
        first = (contact[done] - 1) // PROBE_EVERY  # the first state at or after the touch
        cut = np.where(contact[done] > PROBE_STEPS, 1, np.clip(first - 3, 0, 2))
        frames = cut[:, None] + np.arange(PROBE_LENGTH)  # (done, 7)
        result[waiting[done]] = states[done][np.arange(done.sum())[:, None], frames]
        waiting, attempt = waiting[~done], attempt + 1
    if modality == "video":
        return _film(tool, result)
    return result[..., 2:4] if modality == "xy" else result[..., :6]


def _launch(tool: Tool, places, start, velocity) -> tuple[np.ndarray, np.ndarray]:
    """Launch m balls at m copies of a tool, each pair in its own cell of one big space.

    places, start (m, 2) norm; velocity (m, 2) units/s. Returns states (m, 9, 7) float32, the last
    number a plank's angle, and the step of the first contact (m,): 0 overlap at launch, 91 never.
    """
    m, space, met = len(places), make_space(), []
    space.on_collision(Contact.MOVING, begin=lambda a, *_: met.append(a.shapes[0].thing))
    offsets = CELL * np.stack(np.divmod(np.arange(m), math.ceil(math.sqrt(m))), axis=1)  # (m, 2)
    tools = [build(tool, *at, space.static_body) for at in (to_units(places) + offsets).tolist()]
    balls = [build(PROBE_BALL, *at, None) for at in (to_units(start) + offsets).tolist()]
    space.add(*(part for thing in tools for part in thing.parts))
    overlap = [bool(space.shape_query(ball.shape)) for ball in balls]
    for ball, speed in zip(balls, velocity.tolist(), strict=True):
        ball.body.velocity = tuple(speed)
        space.add(*ball.parts)
    first: dict[Thing, int] = {}
    recorded = np.zeros((m, PROBE_STEPS // PROBE_EVERY, 7), np.float32)
    recorded[..., :2] = places[:, None]
    for step in range(1, PROBE_STEPS + 1):
        space.step(DT)
        while met:
            first.setdefault(met.pop(), step)
        if step % PROBE_EVERY == 0:
            now = recorded[:, step // PROBE_EVERY - 1]  # (m, 7)
            now[:, 2:4] = ([ball.body.position for ball in balls] - offsets) * 2 / WORLD - 1
            # published code: velocities through the map of positions (v/42 - 1, a slip); we: v/42
            now[:, 4:6] = np.array([ball.body.velocity for ball in balls]) * 2 / WORLD
            now[:, 6] = [thing.pose()[2] for thing in tools]
    contact = [first.get(ball, PROBE_STEPS + 1) for ball in balls]
    return recorded, np.where(overlap, 0, contact)


def _film(tool: Tool, states: np.ndarray) -> np.ndarray:
    """One tool's trajectories (n, 7, 7) as pictures, uint8 (n, 7, 48, 48).

    B: "collected identically as the state case, only the modality changes": the whole scene.
    """
    blank, video = Canvas(PROBE_VIDEO), np.empty((*states.shape[:2], 48, 48), np.uint8)
    for frame_at in np.ndindex(states.shape[:2]):
        *places, _, _, angle = states[frame_at].tolist()
        x, y, u, v = map(to_units, places)
        scene = strokes(tool, (x, y, angle)) + strokes(PROBE_BALL, (u, v, 0.0))
        video[frame_at] = blank.copy().draw(scene).picture()
    return video


# ---- pictures for people (Figures 3 and 7), and a window to play in ----


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


def play_episode(env: CreateEnv, seed: int) -> tuple[list[np.ndarray], float]:
    """A random episode: (frames, return). A tool is tried on half the steps."""
    rng, total, over = np.random.default_rng(seed), 0.0, False
    env.reset(seed=seed)
    frames = env.render_frames()
    while not over:
        choice = int(rng.integers(env.num_available)) if rng.random() < 0.5 else NO_OP
        action = {"choice": choice, "position": rng.uniform(-0.9, 0.9, 2)}
        _, reward, terminated, truncated, _ = env.step(action)
        total, over = total + reward, terminated or truncated
        frames = frames + env.render_frames()
    return frames, total


def sheet(tiles: dict[str, np.ndarray], columns: int) -> Image.Image:
    """Square pictures of one size on a sheet, their titles under them."""
    size, bar, gap = next(iter(tiles.values())).shape[1], 26, 10
    rows = math.ceil(len(tiles) / columns)
    shape = (columns * (size + gap) + gap, rows * (size + bar + gap) + gap)
    page, font = Image.new("RGB", shape, "white"), ImageFont.load_default(size=17)
    pen = ImageDraw.Draw(page)
    for k, (title, tile) in enumerate(tiles.items()):
        x, y = gap + k % columns * (size + gap), gap + k // columns * (size + bar + gap)
        page.paste(Image.fromarray(tile), (x, y))
        pen.rectangle((x, y, x + size - 1, y + size - 1), outline="#b8b6c0")
        pen.text((x + size / 2, y + size + bar / 2 + 1), title, INK, font, "mm")
    return page


def tasks_sheet() -> Image.Image:
    """Figure 7: the 12 tasks as they start."""
    tiles = {}
    for letter, task in zip("abcdefghijkl", TASKS, strict=False):
        env = CreateEnv(task=task, render_mode="rgb_array", render_size=300)
        env.reset(seed=0)
        tiles[f"({letter}) {task}"] = env.render()[:300, :300]  # the scene alone
    return sheet(tiles, 4)


def portrait(tools: Sequence[Tool], spots: Sequence[tuple], units: float, size: int) -> np.ndarray:
    """Tools at their spots in so many units around the middle, uint8 (size, size, 3)."""
    whole = round(size * WORLD / units)  # pixels
    canvas, edge = Canvas(whole, colour=True), (whole - size) // 2
    for tool, spot in zip(tools, spots, strict=True):
        canvas.draw(strokes(tool, (*spot, 0.0)))
    return canvas.picture()[edge : edge + size, edge : edge + size]


def tools_sheet() -> Image.Image:
    """Four tools of each class, and how many there are 15 degrees apart."""
    labels, tiles = action_labels(), {}
    for label in dict.fromkeys(labels[1:].tolist()):
        ids = np.flatnonzero((labels == label) & IS_COARSE)
        four = [TOOLS[ids[int(share * len(ids))]] for share in (0.98, 0.12, 0.45, 0.7)]
        spots = [(28, 56), (56, 56), (28, 28), (56, 28)]
        tiles[f"{label} ({len(ids)})"] = portrait(four, spots, 60, 300)
    return sheet(tiles, 5)


def probe_sheet(name: str) -> Image.Image:
    """Probe-ball trajectories over tools, moved so that the tool stands in the middle."""
    labels, tiles = action_labels(), {}
    members = np.flatnonzero((np.char.lower(labels) == name.lower()) & IS_COARSE)
    if not (name.isdecimal() or len(members)):
        raise ValueError(f"unknown tool {name!r}; classes: {', '.join(sorted(set(labels)))}")
    some = np.unique(len(members) * np.array([1, 5, 9]) // 10)  # a class may have one member
    ids = [int(name)] if name.isdecimal() else members[some]
    for states, action in zip(action_observations(ids, 40, "state"), ids, strict=True):
        canvas = Canvas(420, colour=True)
        for k, path in enumerate(to_units(states[..., 2:4] - states[..., :2]).tolist()):
            hue = tuple(int(255 * share) for share in colorsys.hsv_to_rgb(k / 40, 0.6, 0.85))
            dots = [([point], 0.7 + 0.22 * age, None, hue) for age, point in enumerate(path)]
            canvas.draw([(path, 0.3, None, (*hue, 150)), *dots])
        canvas.draw(strokes(TOOLS[action], (WORLD / 2, WORLD / 2, 0.0)))
        tiles[f"{labels[action]}, id {action}"] = canvas.picture()[:420]
    return sheet(tiles, len(ids))


def play(env: CreateEnv, seed: int = 0) -> None:
    """Place tools by mouse: click on a tool, then on the scene; space waits.

    To the right is what the policy sees, the newest picture at the bottom.
    """
    import matplotlib.pyplot as plt  # here, so that no other command needs a display

    figure, (strip, scene) = plt.subplots(1, 2, figsize=(13, 6.5), width_ratios=(1, 2))
    chosen, total, said = NO_OP, 0.0, ""
    env.reset(seed=seed)

    def show() -> None:
        tiles = [portrait([TOOLS[action]], [(42, 42)], 36, 70) for action in env.available]
        tiles[chosen] = tiles[chosen] // 4 * 3  # in the shade
        tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % 5)
        rows = [np.hstack(tiles[k : k + 5]) for k in range(0, len(tiles), 5)]
        picture, unit = env.render(), env.render_size / WORLD  # pixels
        for axes in (strip, scene):
            axes.clear()
        strip.imshow(np.vstack(rows), extent=(0, 5, len(rows), 0))
        scene.imshow(picture, extent=(0, picture.shape[1] / unit, -CAPTION, WORLD))
        strip.set(title=TOOLS[env.available[chosen]].kind, xticks=[], yticks=[])
        scene.set(title=f"return {total:.2f}{said}", xticks=[], yticks=[])
        figure.canvas.draw_idle()

    def on_event(event) -> None:
        nonlocal chosen, total, said
        where = event.inaxes if event.name == "button_press_event" else None
        action = {"choice": NO_OP, "position": (0, 0)} if event.key == " " else None
        if where is strip:
            chosen = min(int(event.ydata) * 5 + int(event.xdata), env.num_available - 1)
        elif where is scene and event.xdata < WORLD and event.ydata > 0:
            position = event.xdata * 2 / WORLD - 1, event.ydata * 2 / WORLD - 1
            action = {"choice": chosen, "position": position}
        if action:
            _, reward, terminated, truncated, info = env.step(action)
            total, said = total + reward, ""
            if terminated or truncated:
                total, said = 0.0, f" (last: {total:.2f}, {'a' if info[METRIC] else 'no'} goal)"
                env.reset()
        show()

    for name in ("button_press_event", "key_press_event"):
        figure.canvas.mpl_connect(name, on_event)
    show()
    plt.show()


# ---- the command ----


@dataclass
class Args:
    """CREATE: play an episode and write a GIF, or draw tasks, tools or probe trajectories."""

    task: str = "push"  # one of the 12 tasks of Figure 7
    seed: int = 0  # of the first episode: level, tools on offer, random actions
    tries: int = 400  # random episodes played; the one with the best return is drawn
    play: bool = False  # open a window and place the tools yourself
    all_tasks: bool = False  # draw the 12 tasks on one sheet (Figure 7)
    show_tools: bool = False  # draw tools of every class
    show_probe: str = ""  # draw probe-ball trajectories over a tool (class name or id)
    out: Path = Path("runs/demo")  # folder for the pictures


def main(args: Args) -> None:
    """Draw what was asked for and say where it is."""
    if args.tries < 1:
        raise ValueError(f"tries is {args.tries}, at least 1")
    env = CreateEnv(task=args.task, render_mode="rgb_array")
    if args.play:
        return play(env, args.seed)
    sheets = {"tasks": tasks_sheet} if args.all_tasks else {}
    sheets |= {"tools": tools_sheet} if args.show_tools else {}
    sheets |= {"probe": functools.partial(probe_sheet, args.show_probe)} if args.show_probe else {}
    for name, draw in sheets.items():
        picture, path = draw(), args.out / f"create_{name}.png"
        args.out.mkdir(parents=True, exist_ok=True)
        picture.save(temporary := path.with_suffix(f".{os.getpid()}.tmp"), "PNG")
        temporary.replace(path)
        print(f"wrote {path}")
    if not sheets:
        seeds, blind = range(args.seed, args.seed + args.tries), CreateEnv(task=args.task)
        best = max(seeds, key=lambda seed: play_episode(blind, seed)[1])
        frames, total = play_episode(env, best)
        path = args.out / f"create_{args.task}.gif"
        save_gif(path, frames + frames[-1:] * 20, env.metadata["render_fps"])  # time to see the end
        print(f"best of {args.tries} episodes: seed {best}, return {total:.2f}; wrote {path}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from None
