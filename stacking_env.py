"""Shape Stacking: build the tallest tower from shapes never seen before (appendix A.4).

Two cylinders stand on a table; 20 of 810 shapes are on offer. An action names a shape and the place
above which it is let go, and the physics (pybullet) decides what stays up. The score is the height
of the highest shape when the agent stops or has acted ten times. At test time the shapes on offer
are of sizes (or classes) never used in training, so the agent must understand pictures of them.

                       __
                      |__|     <- let go 0.02 above everything, at the x the agent chose
              ____________
             |____________|    z up, x to the right; the camera looks along y
                .-.   .-.
    ____________|_|___|_|____________  table, z = 0

Commands:

    python stacking_env.py                  # a planned and a random tower as GIFs in runs/demo, a
                                            # summary (about 15 seconds)
    python stacking_env.py --show-shapes    # also a sheet of all shape families and their views

Paper map (appendix -> here):

    A.4 Actions, the 810 shapes   FAMILIES, SHAPES; StackingEnv.step
    A.4 Action set split, Table 2 split_actions
    A.4 State                     StackingEnv._observe
    A.4 Action observations, B    action_observations
    A.4 Reward, Eq. 4             eq4_reward
    B, Fig. 6 (classes)           action_labels
    C.6, Fig. 13                  PLACEMENTS (No Place, 1D Place, 2D Place), split "full"
    Table 3 (20 actions, 10)      NUM_AVAILABLE, MAX_STEPS
"""

import hashlib
import math
import multiprocessing
import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import tyro
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

METRIC = "height"
MODALITIES = ("image",)  # A.4: "images of the shape from various camera angles and heights"
PLACEMENTS = {
    "none": 0,
    "1d": 1,
    "2d": 2,
}  # C.6 / Figure 13: No Place, 1D Place (default), 2D Place

# ---- rules of the game (A.4) ----
MAX_STEPS = 10  # A.4 "terminates after 10 shape placements"; Table 3 max. episode length
NUM_AVAILABLE = 20  # Table 3 "actions per episode"
LAMBDA_TOP = LAMBDA_AVG = 0.5  # Eq. 4
FRAMES = 4  # A.4 "stack past 4 frames"
SIZE = 84  # A.4 "84x84 grayscale image"
DROP_GAP = 0.02  # ours: a soft drop (A.4) from a gap of 2 cm; shapes are 16 to 192 wide
CYLINDERS = (798, 799, 800)  # published code: the start cylinders are two copies of one of these
CENTRE, AXIS_GAP = (-0.2, 0.2), (1.0, 1.6)  # published code: "random locations on a line" (A.4)

# ---- physics (A.4 names only the 300 steps) ----
SIM_STEPS = 300  # A.4 "acts every 300 physics simulator steps"
TIME_STEP = 0.01  # published code, seconds
GRAVITY = -9.81
# ours: at most 50 iterations of the contact solver per step (with 20, tall towers creep and fall),
# fewer once it has converged (Bullet's default is 1e-7). 1e-5 keeps the mean heights, and a lone
# shape creeps less than .006 in 300 steps, which 1e-4 does not hold; 1e-3 does not keep heights.
SOLVER_ITERATIONS, SOLVER_RESIDUAL = 50, 1e-5
# published code: density 1000, so masses differ 1000-fold, which breaks Bullet's solver; we give
# every shape mass 1 with its true inertia, and towers stand as long as they would in reality.
MASS = 1.0
# published code: sliding, spinning, rolling friction 2, 2, .25, close to glue; ours: 1, .1, .05, so
# that spheres come to rest but the class of a shape still decides what can stand on it. Bullet
# multiplies the sliding coefficients of a pair and mixes the others as r1 f2 + r2 f1, hence the 2.
FRICTION = {"lateralFriction": 1.0, "spinningFriction": 0.1 / 2, "rollingFriction": 0.05 / 2}
# appendix: always 300 steps; ours: stop once all is at rest. Looking every 5th step, at rest = two
# looks in a row with every (angular) velocity component below .05. It is part of the task's
# definition, not only a saving: a tower that stands is not sheared apart by solver noise.
CHECK_EVERY, FIRST_CHECK, LOOKS, REST_SPEED = 5, 10, 2, 0.05
REST_DEPTH = 0.01  # ours: at rest, two bodies overlap by less; an eighth of the thinnest shape

# ---- pictures ----
FOV = 45.0  # published code, degrees
# published code: eye and target, here mirrored to the -y side; right = +x, floor z = 0. The picture
# ends at a height of 5.4 (2D Place: 3.9): the policy does not see the top of its best towers.
FRONT = (0.0, -7.0, 2.5), (0.0, 0.0, 2.5)
RAISED = (0.0, -4.0, 5.5), (0.0, 1.66, 0.0)  # the same for 2D Place
VIEW_RADIUS, VIEW_HEIGHT = 2.0, (0.5, 2.0)  # published code: a circle around the shape, and heights
SUN = (0.24, -0.82, 0.52)  # ours: direction to the light, of length 1
# ours: brightness goes from the first to the second as the surface turns from away to towards the
# sun (half Lambert: faces away from the sun still differ, so no viewpoint hides a shape's edges)
DARK, BRIGHT = 0.25, 1.0
TABLE = (4.0, 2.0, 0.1)  # published code draws 8 x 4; the thickness is ours
TABLE_GRAY = 120 / (DARK + (BRIGHT - DARK) * (1 + SUN[2]) / 2)  # ours: its top is 120 of 255


# ---- A.4: the 810 shapes ----


class Piece(NamedTuple):
    """A convex part: all x with normals @ x <= offsets, and inside a round surface if there is one.

    The round surface is a sphere (round = 1, 1, 1) or an infinite cylinder (a 0 for its axis) of
    radius 1 about `centre`. All in body coordinates of the unit-scale shape.
    """

    normals: np.ndarray  # (P, 3)
    offsets: np.ndarray  # (P,)
    round: np.ndarray | None = None  # (3,) of 0 and 1
    centre: np.ndarray = np.zeros(3)


class Solid(NamedTuple):
    """One family's shape at scale 1, in Bullet's body frame: origin at the centre of mass, axes
    along the principal axes of inertia. It is as wide as `points` thickened by a ball or a z-disc.
    """

    kind: str  # "box" | "hull" | "boxes" | "sphere" | "capsule" | "cylinder": how Bullet gets it
    pieces: tuple[Piece, ...]  # for the pictures
    points: np.ndarray  # (V, 3)
    box: np.ndarray  # (8, 3) corners of the bounding box
    ball: float  # radius
    disc: float  # radius
    com: np.ndarray  # (3,) centre of mass in the shape's own coordinates (about its origin)
    inertia: np.ndarray  # (3,) principal moments for mass 1
    tilt: float  # rotation about y that takes body axes to shape axes, radians
    boxes: tuple = ()  # kind "boxes": (half sizes, centre, rotation about y) of each


def _turn(angle: float, axis: int) -> np.ndarray:
    """Rotation matrix (3, 3) about one coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = math.cos(angle)
    rotation[j, i] = math.sin(angle)
    rotation[i, j] = -rotation[j, i]
    return rotation


MassProperties = tuple[float, np.ndarray, np.ndarray]  # volume, centre (3,), inertia / mass (3, 3)


def _mass_properties(tets: np.ndarray, signs: np.ndarray) -> MassProperties:
    """Of a sum of tetrahedra (T, 4, 3), each added or (sign -1) taken away."""
    edges = tets[:, 1:] - tets[:, :1]  # (T, 3, 3)
    volumes = signs * np.abs(np.linalg.det(edges)) / 6  # (T,)
    com = (volumes[:, None] * tets.mean(1)).sum(0) / volumes.sum()
    corners = tets - com
    total = corners.sum(1)  # (T, 3)
    # the integral of x x^T over a tetrahedron is V/20 (sum of v v^T + (sum v)(sum v)^T)
    moments = np.einsum("tvi,tvj->tij", corners, corners) + total[:, :, None] * total[:, None, :]
    covariance = (volumes[:, None, None] * moments).sum(0) / 20 / volumes.sum()
    return volumes.sum(), com, np.trace(covariance) * np.eye(3) - covariance


def _body(kind: str, pieces: list[Piece], points: np.ndarray, properties: tuple, **extra: Any):
    """Move a shape given about its own origin into Bullet's body frame (see Solid)."""
    _, com, inertia = properties
    # All our solids are mirror images of themselves in y, so only x and z can be mixed.
    angle = 0.0
    if abs(inertia[0, 2]) > 1e-9:
        angle = 0.5 * math.atan2(2 * inertia[0, 2], inertia[0, 0] - inertia[2, 2])
    frame = _turn(angle, axis=1)  # body = frame @ shape; rows are the principal axes
    moved = []
    for piece in pieces:
        normals = piece.normals @ frame.T
        offsets = piece.offsets - piece.normals @ com
        moved.append(Piece(normals, offsets, piece.round, frame @ (piece.centre - com)))
    inertia = np.diag(frame @ inertia @ frame.T).copy()
    points = (points - com) @ frame.T
    ball, disc, boxes = extra.get("ball", 0.0), extra.get("disc", 0.0), extra.get("boxes", ())
    boxes = tuple((half, tuple(np.subtract(centre, com)), turn) for half, centre, turn in boxes)
    wide = ball + disc * np.array([1.0, 1.0, 0.0])
    low, high = points.min(0) - wide, points.max(0) + wide
    box = np.where(np.indices((2, 2, 2)).reshape(3, 8).T, high, low)  # (8, 3)
    return Solid(kind, tuple(moved), points, box, ball, disc, com, inertia, -angle, boxes)


def _prism_piece(polygon: np.ndarray) -> tuple[Piece, np.ndarray]:
    """Half-spaces, corners of a convex polygon (n, 2), counter-clockwise in x, z, over |y| <= 1."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    outward = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    sides = np.insert(outward, 1, 0.0, axis=1)  # (n, 3)
    normals = np.vstack([sides, [[0, 1, 0], [0, -1, 0]]])
    offsets = np.append((outward * polygon).sum(1), [1.0, 1.0])
    corners = np.vstack([np.insert(polygon, 1, y, axis=1) for y in (-1.0, 1.0)])  # (2n, 3)
    return Piece(normals, offsets), corners


def _prism_properties(polygon: np.ndarray) -> MassProperties:
    """Mass properties of any simple polygon in x, z over |y| <= 1 (a fan of signed triangles)."""
    tets, signs = [], []
    for b, c in zip(polygon[1:-1], polygon[2:], strict=True):
        low = [np.insert(p, 1, -1.0) for p in (polygon[0], b, c)]
        high = [np.insert(p, 1, 1.0) for p in (polygon[0], b, c)]
        tets += [[*low, high[0]], [*low[1:], *high[:2]], [low[2], *high]]
        (ux, uz), (vx, vz) = b - polygon[0], c - polygon[0]
        signs += [np.sign(ux * vz - uz * vx)] * 3
    return _mass_properties(np.array(tets), np.array(signs))


def _prism(
    points: Sequence[tuple[float, float]], along_x: bool = False, kind: str = "hull"
) -> Solid:
    """A convex polygon in x, z drawn out along y (or, turned by 90 degrees, along x)."""
    polygon = np.array(points, dtype=float)
    piece, corners = _prism_piece(polygon)
    volume, com, inertia = _prism_properties(polygon)
    if along_x:
        swap = [1, 0, 2]  # mirror-symmetric, so exchanging x and y is the quarter turn
        piece, corners = Piece(piece.normals[:, swap], piece.offsets), corners[:, swap]
        com, inertia = com[swap], inertia[np.ix_(swap, swap)]
    return _body(kind, [piece], corners, (volume, com, inertia))


def _pyramid(ring: np.ndarray) -> Solid:
    """Base polygon (n, 2) in x, y at z = -1, apex at (0, 0, 1)."""
    base, apex = np.insert(ring, 2, -1.0, axis=1), np.array([0.0, 0.0, 1.0])
    after = np.roll(base, -1, axis=0)
    sides = np.cross(after - base, apex - base)  # (n, 3)
    normals = np.vstack([sides / np.linalg.norm(sides, axis=1, keepdims=True), [[0, 0, -1]]])
    offsets = np.append(normals[:-1] @ apex, 1.0)
    fan = zip(base[1:-1], base[2:], strict=True)
    tets = np.array([[base[0], b, c, apex] for b, c in fan])
    properties = _mass_properties(tets, np.ones(len(tets)))
    return _body("hull", [Piece(normals, offsets)], np.vstack([base, apex]), properties)


def _arch() -> Solid:
    """A 4x2x2 block with a tunnel of radius 1.25 along y, as five boxes.

    published code: drawn with the tunnel but collides as a full block; ours: the tunnel is real,
    half of a regular octagon around the circle, and the picture shows exactly what collides.
    """
    radius, side = 1.25, 1.25 * math.tan(math.pi / 8)
    deep = 0.55  # the slanted boxes reach past the corners behind them, still inside the block
    boxes = [((0.375, 1, 1), (x, 0, 0), 0.0) for x in (-1.625, 1.625)] + [
        ((1.25, 1, 0.375), (0, 0, 0.625), 0.0)
    ]
    for sign in (-1, 1):
        middle = (radius + deep / 2) * math.sqrt(0.5)
        boxes.append(((side, 1, deep / 2), (sign * middle, 0, middle - 1), sign * math.pi / 4))
    pieces, points = [], []
    for half, centre, turn in boxes:
        (hx, _, hz), rotation = half, _turn(turn, axis=1)
        piece, corners = _prism_piece(np.array([(-hx, -hz), (hx, -hz), (hx, hz), (-hx, hz)]))
        normals = piece.normals @ rotation.T
        pieces.append(Piece(normals, piece.offsets + normals @ np.array(centre)))
        points.append(corners @ rotation.T + centre)
    tunnel = [(-radius, side - 1), (-side, radius - 1), (side, radius - 1), (radius, side - 1)]
    outline = [(-2, -1), (-radius, -1), *tunnel, (radius, -1), (2, -1), (2, 1), (-2, 1)]
    properties = _prism_properties(np.array(outline, dtype=float))
    return _body("boxes", pieces, np.vstack(points), properties, boxes=boxes)


def _round(kind: str) -> Solid:
    """Sphere of radius 1; capsule and cylinder of radius 1 with a straight part of 2 along z."""
    none, caps = (np.zeros((0, 3)), np.zeros(0)), np.array([[0, 0, 1.0], [0, 0, -1.0]])
    if kind == "sphere":
        properties = (4 / 3 * math.pi, np.zeros(3), 0.4 * np.eye(3))
        return _body(kind, [Piece(*none, np.ones(3))], np.zeros((1, 3)), properties, ball=1.0)
    tube = Piece(caps, np.ones(2), np.array([1.0, 1.0, 0.0]))
    if kind == "cylinder":
        properties = (2 * math.pi, np.zeros(3), np.diag([7 / 12, 7 / 12, 1 / 2]))
        return _body(kind, [tube], caps, properties, disc=1.0)
    balls = [Piece(*none, np.ones(3), cap) for cap in caps]
    # a tube (mass share 3/5) and two half-balls (2/5), each 3/8 beyond its own cap
    across = 0.6 * 7 / 12 + 0.4 * (0.4 + 1 + 2 * 3 / 8)
    properties = (10 / 3 * math.pi, np.zeros(3), np.diag([across, across, 0.6 / 2 + 0.4 * 0.4]))
    return _body(kind, [tube, *balls], caps, properties, ball=1.0)


def _box(x: float, z: float) -> Solid:
    """A box of half sizes x, 1, z."""
    return _prism([(-x, -z), (x, -z), (x, z), (-x, z)], kind="box")


def _ring(count: int, total: float = 2 * math.pi, ends: bool = False) -> np.ndarray:
    angles = np.linspace(0, total, count, endpoint=ends)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (count, 2)


def _dome() -> Solid:
    """A half-cylinder of radius 1 along y, flat side down at z = -.5 (13 points on the arc)."""
    hull = _prism(_ring(13, math.pi, ends=True) - (0.0, 0.5))
    # drawn smooth: the round surface takes the place of the twelve facets (at most .009 s apart)
    flat, axis = hull.pieces[0], np.array([0, 0, -0.5]) - hull.com
    keep = [12, 13, 14]  # the flat side, which closes the polygon, and the two ends
    smooth = Piece(flat.normals[keep], flat.offsets[keep], np.array([1.0, 0.0, 1.0]), axis)
    return hull._replace(pieces=(smooth,))


class Family(NamedTuple):
    """A grid of shapes: `scales` sizes in [lo, hi], each in `angles` rotations in [0, turn)."""

    name: str  # published code's name
    label: str  # class of Table 2
    full_train: bool  # Table 2: in the training row?
    solid: Solid
    lo: float
    hi: float
    scales: int
    turn: float  # in units of pi
    angles: int


SQUARE = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], dtype=float)
TALL = [(-1, -2), (1, -2), (-1, 2)]  # right triangle, twice as high as wide
HAT = [(-math.sqrt(2), 0), (math.sqrt(2), 0), (0, math.sqrt(2))]  # `triangle` on its long side
# Grids of the published code: A.4 "varying the scale and vertical orientation in each shape class".
# One correction: `rectangle` has a square footprint, so the published 6 x 30 degrees up to pi give
# every shape twice; A.4 wants all shapes different, so we use 6 x 15 degrees up to pi / 2. The cone
# appears twice in the published list (same scales, another mesh); kept, for the count of 810.
FAMILIES = (
    Family("middle_triangle", "angled-triangle", False, _prism([(-1, -1), (1, -1), (0, 1)]),
           0.1, 0.5, 6, 1, 10),
    Family("hat", "angled-triangle", False, _prism(HAT, along_x=True), 0.1, 0.5, 6, 1, 10),
    Family("triangle", "triangle", True, _prism([(-1, -1), (1, -1), (-1, 1)]), 0.1, 0.5, 6, 2, 10),
    Family("tall_triangle", "triangle", True, _prism(TALL), 0.1, 0.3, 6, 2, 10),
    Family("horizontal_rectangle", "angled-rectangle", False, _box(2, 1), 0.1, 0.5, 6, 1, 10),
    Family("dome", "dome", True, _dome(), 0.2, 0.6, 6, 1, 10),
    Family("cone-hires", "cone", False, _pyramid(_ring(20)), 0.1, 0.6, 30, 0, 1),
    Family("cone", "cone", False, _pyramid(_ring(20)), 0.1, 0.6, 30, 0, 1),
    Family("tetrahedron", "tetrahedron", False, _pyramid(SQUARE), 0.1, 0.6, 10, 0.25, 6),
    Family("arch", "arch", True, _arch(), 0.1, 0.5, 6, 1, 10),
    Family("rectangle", "rectangle", True, _box(1, 2), 0.1, 0.3, 10, 0.5, 6),
    Family("half_rectangle", "rectangle", True, _box(2, 0.5), 0.1, 0.6, 10, 1, 6),
    Family("cube", "cube", False, _box(1, 1), 0.1, 0.6, 10, 0.25, 6),
    Family("sphere", "sphere", True, _round("sphere"), 0.1, 0.8, 30, 0, 1),
    Family("capsule", "capsule", True, _round("capsule"), 0.1, 0.4, 30, 0, 1),
    Family("cylinder", "cylinder", False, _round("cylinder"), 0.1, 0.6, 30, 0, 1),
)  # fmt: skip
SCALE_FACTOR = 0.8  # published code: every scale of the grid times .8


class Shape(NamedTuple):
    """One of the 810 actions."""

    family: int  # index into FAMILIES
    scale: float
    angle: float  # rotation about the vertical, radians


def _all_shapes() -> list[Shape]:
    """The action set in the order of its ids: family, then scale, then angle."""
    shapes = []
    for index, family in enumerate(FAMILIES):
        for scale in SCALE_FACTOR * np.linspace(family.lo, family.hi, family.scales):
            angles = np.linspace(0, family.turn * math.pi, family.angles, endpoint=False)
            shapes += [Shape(index, float(scale), float(angle)) for angle in angles]
    return shapes


SHAPES = _all_shapes()
NUM_ACTIONS = len(SHAPES)  # A.4: 810
SOLIDS = [FAMILIES[shape.family].solid for shape in SHAPES]


def _colours() -> np.ndarray:
    """One RGB colour in [0, 1] per shape (NUM_ACTIONS, 3): A.4 mentions "random ... colors"."""
    # published code: random hue, saturation .5-1, value .5-1; ours: lighter, so that no shape is
    # close to black on the black background (luminance below .1 there).
    low, high = (0.0, 0.35, 0.65), (1.0, 0.75, 1.0)
    hue, saturation, value = np.random.default_rng(42).uniform(low, high, (NUM_ACTIONS, 3)).T
    k = (np.array([5, 3, 1])[:, None] + 6 * hue) % 6  # (3, NUM_ACTIONS), the usual HSV formula
    return (value - value * saturation * np.clip(np.minimum(k, 4 - k), 0, 1)).T


COLOURS = _colours()
GRAYS = COLOURS @ (0.299, 0.587, 0.114) * 255  # luminance, (NUM_ACTIONS,)


def check_ids(action_ids: Any, distinct: bool = False) -> np.ndarray:
    """The ids as an int64 array (n,); ValueError if they are not whole numbers in 0..809."""
    ids = np.asarray(action_ids)
    if ids.ndim != 1 or len(ids) == 0 or ids.dtype.kind not in "iu":
        raise ValueError(
            f"action ids must be a non-empty list of whole numbers, got {action_ids!r}"
        )
    if ids.min() < 0 or ids.max() >= NUM_ACTIONS:
        bad = ids[(ids < 0) | (ids >= NUM_ACTIONS)][0]
        raise ValueError(f"action id {bad} is not in 0..{NUM_ACTIONS - 1}")
    values, counts = np.unique(ids, return_counts=True)
    if distinct and counts.max() > 1:
        raise ValueError(f"action ids must not repeat, got {values[counts > 1][0]} more than once")
    return ids.astype(np.int64)


def action_labels() -> np.ndarray:
    """Class of every shape by Table 2's names (NUM_ACTIONS,) str; what Figure 6 colours by.

    Without the prefix "angled-" these are the ten classes of A.4.
    """
    return np.array([FAMILIES[shape.family].label for shape in SHAPES])


def engineered_representations() -> np.ndarray:
    """Ground truth: scale, sin and cos of the angle, one-hot family; (NUM_ACTIONS, 19) float32."""
    # published code: scale, axis (0, 0, 1), angle, one-hot; we write the angle as a point on the
    # circle, so that turning by almost 360 degrees is close to not turning at all.
    table = np.zeros((NUM_ACTIONS, 3 + len(FAMILIES)), dtype=np.float32)
    for row, shape in zip(table, SHAPES, strict=True):
        row[:3] = shape.scale, math.sin(shape.angle), math.cos(shape.angle)
        row[3 + shape.family] = 1
    return table


# ---- A.4: action set split ----


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Train, validation and test ids, about 2:1:1 (A.4).

    Args:
        split: "default" draws half of the scales of every family for training (all angles of a
            scale stay together); "full" trains on the classes of Table 2's first row.
        seed: of the draw of the scales and of the halving of the rest.

    Returns:
        {"train", "valid", "test"}: sorted, disjoint int64 arrays; 405 / 202 / 203 ids by default,
        420 / 195 / 195 for "full".

    Raises:
        ValueError: another split name, or a negative seed.
    """
    if seed < 0:
        raise ValueError(f"seed must be >= 0, got {seed}")
    rng = np.random.default_rng(seed)
    if split == "default":
        keep = []
        for family in FAMILIES:
            train_scales = rng.permutation(family.scales)[: family.scales // 2]
            in_train = np.isin(np.arange(family.scales), train_scales)
            keep.append(np.repeat(in_train, family.angles))  # all angles of a scale
        train_mask = np.concatenate(keep)
    elif split == "full":
        train_mask = np.array([FAMILIES[shape.family].full_train for shape in SHAPES])
    else:
        raise ValueError(f"unknown split {split!r}; allowed: default, full")
    rest = rng.permutation(np.flatnonzero(~train_mask))  # A.4 "randomly splitting the test set"
    half = len(rest) // 2
    parts = {"train": np.flatnonzero(train_mask), "valid": rest[:half], "test": rest[half:]}
    return {name: np.sort(ids).astype(np.int64) for name, ids in parts.items()}


# ---- pictures: one painter for states, action observations and colour pictures ----
#
# Along the ray eye + t d of a pixel, a plane n.x = c is met at t = (c - n.eye) / (n.d). The rays
# are d = forward + u right + v up, so 1/t is an affine function of the pixel (u, v): one
# multiply-add per pixel and plane. In w = 1/t, a convex piece is entered at the smallest w of the
# planes that the eye is outside of and left at the largest w of the others; it is hit if it is
# entered before it is left. Larger w = nearer; a depth buffer of zeros is infinitely far.


class Camera(NamedTuple):
    """A square pinhole camera."""

    eye: np.ndarray  # (3,)
    axes: np.ndarray  # (3, 3), rows: right, up, forward
    focal: float  # pixels
    grid: np.ndarray  # (size,) float32, u of the columns; -v of the rows


def look(
    eye: Sequence[float], target: Sequence[float], size: int = SIZE, fov: float = FOV
) -> Camera:
    """A camera at `eye` that looks at `target`, with an upright picture of size x size pixels."""
    eye = np.asarray(eye, dtype=float)
    forward = np.asarray(target, dtype=float) - eye
    forward /= np.linalg.norm(forward)
    right = np.array([forward[1], -forward[0], 0.0])  # forward x up
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), forward])
    focal = 0.5 * size / math.tan(math.radians(fov) / 2)
    grid = ((np.arange(size) + 0.5 - size / 2) / focal).astype(np.float32)
    return Camera(eye, axes, focal, grid)


class Canvas(NamedTuple):
    """What the painter fills in, per pixel."""

    near: np.ndarray  # (H, W) float32, 1 / depth of what is seen, 0 = nothing
    light: np.ndarray  # (H, W) float32, cosine between the surface normal and the sun
    owner: np.ndarray  # (H, W) int16, index of the body seen

    @classmethod
    def blank(cls, size: int) -> "Canvas":
        shape = (size, size)
        return cls(
            np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.int16)
        )


def _interval(
    piece: Piece, eye: np.ndarray, axes: np.ndarray, sun: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """w = 1/t where each ray enters and leaves a piece, and the light there; all (h, w) float32.

    Everything is in body coordinates; u is (w,), v is (h, 1). A missed piece has enter <= leave.
    """
    shape = (len(v), len(u))
    enter, light = np.full(shape, np.inf, np.float32), np.zeros(shape, np.float32)
    leave = np.zeros(shape, np.float32)
    if len(piece.offsets):
        gap = piece.offsets - piece.normals @ eye  # (P,), negative: the eye is outside
        gap = np.where(np.abs(gap) < 1e-6, 1e-6, gap)
        slopes = (piece.normals @ axes.T / gap[:, None]).astype(np.float32)[:, :, None, None]
        w = slopes[:, 0] * u + (slopes[:, 1] * v + slopes[:, 2])  # (P, h, w)
        front = gap < 0
        if front.any():
            facing = w[front]
            enter = facing.min(0)
            light = (piece.normals[front] @ sun).astype(np.float32)[facing.argmin(0)]
        if not front.all():
            leave = np.maximum(w[~front].max(0), 0)
    if piece.round is not None:
        used = np.flatnonzero(piece.round)
        start = (eye - piece.centre)[used].astype(np.float32)
        across = axes[:, used].astype(np.float32)  # (3, 2 or 3)
        along = across[0] * u[None, :, None] + across[1] * v[:, :, None] + across[2]  # (h, w, 2|3)
        # |start + along / w| = 1 is c w^2 + 2 b w + a = 0; c > 0: the eye is outside
        a, b, c = (along * along).sum(2), along @ start, float(start @ start) - 1
        square = b * b - a * c
        root = np.sqrt(np.maximum(square, 0))
        leave = np.maximum(leave, (-b - root) / c)
        if c > 0:
            first = np.where(square > 0, (root - b) / c, 0)
            flat = sun[used].astype(np.float32)
            shade = start @ flat + along @ flat / np.maximum(first, 1e-6)
            light = np.where(first < enter, shade, light)
            enter = np.minimum(enter, first)
    return enter, leave, light


def _paint(
    canvas: Canvas, camera: Camera, owner: int, solid: Solid, scale: float,
    position: np.ndarray, rotation: np.ndarray, sun: tuple[float, float, float] = SUN,
) -> None:  # fmt: skip
    """Add one body in the pose position (3,), rotation (3, 3) to the canvas."""
    eye = (camera.eye - position) @ rotation / scale  # body coordinates at scale 1
    axes = camera.axes @ rotation  # (3, 3), rows right, up, forward in body coordinates
    # the part of the picture that can change: where the corners of the bounding box fall
    right, up, ahead = axes @ (solid.box - eye).T  # (8,) each
    columns = camera.focal * right / ahead + len(camera.grid) / 2
    rows = -camera.focal * up / ahead + len(camera.grid) / 2
    window = (
        slice(max(int(rows.min()), 0), max(int(rows.max()) + 1, 0)),
        slice(max(int(columns.min()), 0), max(int(columns.max()) + 1, 0)),
    )
    near = canvas.near[window]  # (h, w), a view
    if near.size == 0:
        return
    u, v = camera.grid[window[1]], -camera.grid[window[0], None]
    for piece in solid.pieces:
        enter, leave, light = _interval(piece, eye, axes, np.array(sun) @ rotation, u, v)
        seen = (enter > leave) & (enter > near * np.float32(scale))
        np.copyto(near, enter / np.float32(scale), where=seen)
        np.copyto(canvas.light[window], light, where=seen)
        np.copyto(canvas.owner[window], owner, where=seen)


@cache
def _stage(
    eye: tuple, target: tuple, size: int = SIZE, fov: float = FOV, sun: tuple = SUN
) -> tuple[Camera, Canvas]:
    """A camera, and a canvas with the empty table (body 0) that is never painted twice."""
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T, TABLE, np.negative(TABLE))  # (8, 3)
    piece = Piece(np.vstack([np.eye(3), -np.eye(3)]), np.array([*TABLE, *TABLE]))
    table = SOLIDS[0]._replace(pieces=(piece,), box=corners)  # only these two matter here
    camera, canvas = look(eye, target, size, fov), Canvas.blank(size)
    _paint(canvas, camera, 0, table, 1.0, np.array([0, 0, -TABLE[2]]), np.eye(3), sun)
    return camera, canvas


def _paint_scene(
    stage: tuple[Camera, Canvas], shape_ids: Sequence[int], positions: np.ndarray,
    rotations: np.ndarray, sun: tuple = SUN,
) -> Canvas:  # fmt: skip
    """The table and n shapes, bodies 1..n, in the poses (n, 3) and (n, 3, 3)."""
    camera, empty = stage
    canvas = Canvas(*(layer.copy() for layer in empty))
    for body, (shape_id, *pose) in enumerate(zip(shape_ids, positions, rotations, strict=True), 1):
        _paint(canvas, camera, body, SOLIDS[shape_id], SHAPES[shape_id].scale, *pose, sun)
    return canvas


def _gray(canvas: Canvas, grays: np.ndarray) -> np.ndarray:
    """Canvas to (H, W) uint8: each body's gray (bodies,) times its brightness, background 0."""
    bright = np.float32((DARK + BRIGHT) / 2) + np.float32((BRIGHT - DARK) / 2) * canvas.light
    picture = grays.astype(np.float32)[canvas.owner] * bright
    return np.where(canvas.near > 0, picture, 0).astype(np.uint8)


# ---- A.4, B: action observations ----


def _views(shape_id: int, num_views: int, seed: int) -> np.ndarray:
    """Pictures of one shape from random viewpoints, (num_views, 84, 84) uint8.

    published code: 1,024 views of which 32 differ, in colour; here all are independent, and grey.
    """
    shape, solid = SHAPES[shape_id], SOLIDS[shape_id]
    # each shape has its own generator and each view its own two numbers: the first n views are the
    # same however many are asked for, and whoever else is asked for
    random = np.random.default_rng([seed, shape_id]).random((num_views, 2))
    turns = 2 * math.pi * random[:, 0]
    heights = VIEW_HEIGHT[0] + (VIEW_HEIGHT[1] - VIEW_HEIGHT[0]) * random[:, 1]
    upright = _turn(shape.angle, axis=2)
    position = upright @ solid.com * shape.scale  # the camera looks at the shape's own origin
    rotation = upright @ _turn(solid.tilt, axis=1)
    out = np.empty((num_views, SIZE, SIZE), dtype=np.uint8)
    for picture, turn, height in zip(out, turns, heights, strict=True):
        eye = (VIEW_RADIUS * math.cos(turn), VIEW_RADIUS * math.sin(turn), height)
        canvas = Canvas.blank(SIZE)
        _paint(canvas, look(eye, (0, 0, 0)), 0, solid, shape.scale, position, rotation)
        picture[:] = _gray(canvas, GRAYS[[shape_id]])
    return out


def _cache_path(cache_dir: str | Path, ids: np.ndarray, num: int, seed: int) -> Path:
    """File name from all the pictures depend on, the painter included (one view per family)."""
    firsts = [next(i for i, s in enumerate(SHAPES) if s.family == f) for f in range(len(FAMILIES))]
    digest = hashlib.sha256(repr((SHAPES, ids.tolist(), num, seed)).encode())
    digest.update(b"".join(_views(first, 1, 0).tobytes() for first in firsts))
    return Path(cache_dir) / f"stacking-image-{digest.hexdigest()[:16]}.npy"


CACHE_FROM = 50_000  # ours: pictures (350 MB, some 10 s of work) from which the disk is used


def action_observations(
    action_ids: Any,
    num_observations: int = 1024,  # A.4
    modality: str = "image",
    seed: int = 0,
    workers: int = 1,
    cache_dir: str | Path | None = "runs/cache",
) -> np.ndarray:
    """Pictures of each shape from independent random viewpoints (A.4).

    Args:
        action_ids: ids in 0..809.
        num_observations: views per shape, at least 1; view k is the same for every number > k.
        modality: "image" is the only one.
        seed: one seed gives the same bytes, whatever `workers` and the other ids asked for.
        workers: processes.
        cache_dir: requests of CACHE_FROM pictures or more are kept there (all 810 x 1,024 views are
            5.9 GB) and come back as a copy-on-write memory map: only what is read is in memory,
            writing to the array does not change the file. None: everything in memory, no file.

    Returns:
        (len(action_ids), num_observations, 84, 84) uint8.

    Raises:
        ValueError: unknown id or modality, a number below 1, or a negative seed.
        OSError: the disk has no room for the file.
    """
    ids = check_ids(action_ids)
    if modality not in MODALITIES:
        raise ValueError(f"unknown modality {modality!r}; allowed: {', '.join(MODALITIES)}")
    limits = (("num_observations", num_observations, 1), ("workers", workers, 1), ("seed", seed, 0))
    for name, value, least in limits:
        if not isinstance(value, int | np.integer) or value < least:
            raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")
    shape = (len(ids), num_observations, SIZE, SIZE)
    if cache_dir is None or len(ids) * num_observations < CACHE_FROM:
        out = np.empty(shape, dtype=np.uint8)
        _fill(out, ids, seed, workers)
        return out
    path = _cache_path(cache_dir, ids, num_observations, seed)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.name}.{os.getpid()}.part")
        try:
            out = np.lib.format.open_memmap(part, mode="w+", dtype=np.uint8, shape=shape)
            # A map may be larger than what the disk has left, and running into that kills the
            # process. Asking for the room now is an OSError instead.
            if hasattr(os, "posix_fallocate"):
                with open(part, "r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, part.stat().st_size)
            _fill(out, ids, seed, workers)
            out.flush()
            os.replace(part, path)  # a broken-off run leaves no half-written file behind
        finally:
            part.unlink(missing_ok=True)
    return np.load(path, mmap_mode="c", allow_pickle=False)


def _fill(out: np.ndarray, ids: np.ndarray, seed: int, workers: int) -> None:
    """Paint the views of ids[i] into out[i], in `workers` processes."""
    bar = {"total": len(ids), "desc": "action observations", "unit": "shape", "delay": 2}
    one_shape = partial(_views, num_views=out.shape[1], seed=seed)
    with multiprocessing.Pool(workers) if workers > 1 else nullcontext() as pool:
        # in order, one shape (7 MB at 1,024 views) at a time
        results = (pool.imap if pool else map)(one_shape, ids.tolist())
        for row, views in zip(out, tqdm(results, **bar), strict=True):
            row[:] = views


# ---- A.4: the environment ----


def eq4_reward(heights: np.ndarray) -> float:
    """Eq. 4 at the end of an episode, from the heights h_i of all N shapes in the scene (N,)."""
    # appendix: all N shapes (here with the two cylinders); published code: the mean runs only over
    # shapes whose origin is above .5 and is measured .5 lower. We do Eq. 4 as written.
    return float(LAMBDA_TOP * heights.max() + LAMBDA_AVG * heights.mean())


def _load_pybullet() -> Any:
    """Import pybullet only where a simulation starts: everything else here works without it."""
    try:
        import pybullet
    except ImportError as e:
        raise ImportError(
            "Shape Stacking needs pybullet: pip install pybullet (its wheels end at Python 3.11)"
        ) from e
    return pybullet


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """Unit quaternions x, y, z, w (n, 4) to rotation matrices (n, 3, 3)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def upright_quaternion(shape: Shape) -> tuple[float, float, float, float]:
    """Orientation x, y, z, w of the body frame of a shape that stands as A.4's orientation says."""
    turn, tilt = shape.angle / 2, FAMILIES[shape.family].solid.tilt / 2  # about z, after about y
    return (
        -math.sin(turn) * math.sin(tilt),
        math.cos(turn) * math.sin(tilt),
        math.sin(turn) * math.cos(tilt),
        math.cos(turn) * math.cos(tilt),
    )


def lowest(shape_id: int) -> float:
    """How far the lowest point of the upright shape is below its centre of mass."""
    solid, scale = SOLIDS[shape_id], SHAPES[shape_id].scale
    down = -_turn(solid.tilt, axis=1)[
        2
    ]  # world down in body coordinates (the turn about z drops out)
    return scale * float((solid.points @ down).max() + solid.ball)


class StackingEnv(gym.Env):
    """Build a tower from the shapes on offer (appendix A.4).

    ## Description
    Two equal cylinders stand at random places on a line. Each action drops one shape, from above
    the highest point of the scene, at the place the agent names; the simulation runs until all is
    at rest, at most 300 steps of .01 s.

    ## Action Space
    `Dict`:

    | key | space | meaning |
    |---|---|---|
    | choice | `Discrete(K)` | position in `available` of the shape to drop |
    | position | `Box(-1, 1, (d,))` | where: x (1d), x and y (2d); no such key for "none" |
    | stop | `Discrete(2)` | 1: end the episode now, nothing is placed |

    A shape that has been placed cannot be placed again: choosing it only uses up the step. An
    action outside of the space is refused with a ValueError before anything moves.

    ## Observation Space
    `Dict`: state `Box(0, 255, (4, 84, 84), uint8)`, the last four grayscale pictures, newest last,
    zeros before the episode began; available `Box(0, 809, (K,), int64)`, the ids of the shapes on
    offer, redrawn at every reset.

    ## Rewards
    Eq. 4 on the last step, else 0: half the height of the highest shape plus half the mean height
    of all shapes, the cylinders included. Heights are of centres of mass above the table.

    ## Starting State
    Two copies of one of three cylinders (heights .66, .68, .71), their axes 1.0 to 1.6 apart.

    ## Episode End
    1. Termination: the stop action. 2. Truncation: the tenth action, repeats included. The last
    step's info has `height` (of the highest shape) and `episode` (return "r", length "l").

    ## Arguments
    action_pool: ids to draw from (default: the training split); num_available: K (a pool of just K
    ids is offered in order, always); render_mode: None or "rgb_array"; placement: "none" (always
    over the centre), "1d" or "2d" (C.6); early_stop: False runs the full 300 steps after a drop.
    ValueError for a pool smaller than K, for unknown or repeated ids, for an unknown option.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    _client = -1  # number of the physics client, -1: none yet

    def __init__(
        self,
        action_pool: Any = None,
        num_available: int = NUM_AVAILABLE,
        render_mode: str | None = None,
        placement: str = "1d",
        early_stop: bool = True,
    ) -> None:
        pool = split_actions()["train"] if action_pool is None else action_pool
        self.action_pool = np.sort(check_ids(pool, distinct=True))
        size = len(self.action_pool)
        if not isinstance(num_available, int | np.integer) or not 1 <= num_available <= size:
            raise ValueError(f"num_available must be in 1..{size} (the pool), got {num_available}")
        if placement not in PLACEMENTS:
            raise ValueError(f"unknown placement {placement!r}; allowed: {', '.join(PLACEMENTS)}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; allowed: rgb_array")
        self.num_available, self.placement = int(num_available), placement
        self.render_mode, self.early_stop = render_mode, early_stop
        self.observation_space = spaces.Dict(
            {
                "state": spaces.Box(0, 255, (FRAMES, SIZE, SIZE), np.uint8),
                "available": spaces.Box(0, NUM_ACTIONS - 1, (self.num_available,), np.int64),
            }
        )
        parts = {"choice": spaces.Discrete(self.num_available), "stop": spaces.Discrete(2)}
        if PLACEMENTS[placement]:
            parts["position"] = spaces.Box(-1, 1, (PLACEMENTS[placement],), np.float32)
        self.action_space = spaces.Dict(parts)
        # The physics client is made in the first reset, so in the worker process of a vector env.
        self._bullet: Any = None
        self._running = False

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Draw the shapes on offer, drop the two cylinders; returns (observation, {})."""
        super().reset(seed=seed)
        rng = self.np_random
        self.available = self.action_pool.copy()
        if self.num_available < len(self.action_pool):
            self.available = rng.choice(self.action_pool, self.num_available, replace=False)
        self._empty_world()
        cylinder = int(rng.choice(CYLINDERS))
        # appendix: "random heights"; published code: one of three, the same for both, as here
        centre, gap = rng.uniform(*CENTRE), rng.uniform(*AXIS_GAP)
        for x in (centre - gap / 2, centre + gap / 2):
            self._add(cylinder, float(x), 0.0, lowest_z=DROP_GAP)
        self._settle()
        self._placed: set[int] = set()
        self._steps = 0
        self._running = True
        self._stack = np.zeros((FRAMES, SIZE, SIZE), dtype=np.uint8)
        self._picture = self._draw()
        return self._observe(), {}

    def step(self, action: dict) -> tuple[dict, float, bool, bool, dict]:
        """One action; ValueError (and nothing changed) if it is not one of the action space."""
        if not self._running:
            raise ResetNeeded("call reset() before step(): no episode is running")
        choice, (x, y), stop = self._read(action)
        self._trace = []
        self._steps += 1
        shape_id = int(self.available[choice])
        # A.4: trying to place it again does nothing (published code: the simulation goes on)
        if not stop and shape_id not in self._placed:
            self._placed.add(shape_id)
            self._drop(shape_id, x, y)
            self._picture = self._draw()
        terminated, truncated = stop, not stop and self._steps == MAX_STEPS
        reward, info = 0.0, {}
        if terminated or truncated:
            self._running = False
            heights = self.poses()[0][:, 2]
            reward = eq4_reward(heights)
            # published code: the score uses shape origins; ours: centres of mass, as in the reward
            info = {METRIC: float(heights.max()), "episode": {"r": reward, "l": self._steps}}
        return self._observe(), reward, terminated, truncated, info

    def _read(self, action: Any) -> tuple[int, tuple[float, float], bool]:
        """Check an action completely before anything moves; returns choice, (x, y), stop."""
        expected = set(self.action_space.spaces)
        if not isinstance(action, dict) or set(action) != expected:
            raise ValueError(f"action must be a dict with keys {sorted(expected)}, got {action!r}")
        numbers = {}
        for key, count in (("choice", self.num_available), ("stop", 2)):
            value = np.asarray(action[key])
            if value.shape != () or value.dtype.kind not in "iu" or not 0 <= value < count:
                raise ValueError(f"{key} must be a whole number in 0..{count - 1}, got {value!r}")
            numbers[key] = int(value)
        place = [0.0, 0.0]  # C.6 No Place: over the centre; 1D Place: "y ... fixed to the center"
        if "position" in expected:
            value, size = np.asarray(action["position"]), PLACEMENTS[self.placement]
            if value.shape != (size,) or value.dtype.kind != "f" or not (np.abs(value) <= 1).all():
                raise ValueError(f"position must be {size} float(s) in [-1, 1], got {value!r}")
            place[:size] = value.astype(float).tolist()
        return numbers["choice"], (place[0], place[1]), bool(numbers["stop"])

    def _empty_world(self) -> None:
        """A fresh simulation with a table, for each episode anew, so that none leaves traces."""
        if self._client < 0:
            self._bullet = _load_pybullet()
            self._client = self._bullet.connect(self._bullet.DIRECT)
        p, client = self._bullet, self._client
        p.resetSimulation(physicsClientId=client)
        p.setGravity(0, 0, GRAVITY, physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP, numSolverIterations=SOLVER_ITERATIONS,
            solverResidualThreshold=SOLVER_RESIDUAL, deterministicOverlappingPairs=1,
            physicsClientId=client,
        )  # fmt: skip
        # The floor has no end (published code: invisible walls at the left and at the back).
        plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        floor = p.createMultiBody(0, plane, useMaximalCoordinates=1, physicsClientId=client)
        p.changeDynamics(floor, -1, **FRICTION, restitution=0, physicsClientId=client)
        self._bodies: list[int] = []  # Bullet's numbers
        self.shape_ids: list[int] = []  # ids of the shapes in the scene, the two cylinders first
        self._trace: list[tuple[np.ndarray, np.ndarray]] = []

    def _collision_shape(self, shape_id: int) -> int:
        """Tell Bullet the exact solid: a primitive, a convex hull, or the arch's five boxes."""
        p, solid, scale = self._bullet, SOLIDS[shape_id], SHAPES[shape_id].scale
        client = {"physicsClientId": self._client}
        if solid.kind == "sphere":
            return p.createCollisionShape(p.GEOM_SPHERE, radius=scale, **client)
        if solid.kind in ("cylinder", "capsule"):
            geom = p.GEOM_CYLINDER if solid.kind == "cylinder" else p.GEOM_CAPSULE
            return p.createCollisionShape(geom, radius=scale, height=2 * scale, **client)
        if solid.kind == "box":
            half = (scale * solid.points.max(0)).tolist()
            return p.createCollisionShape(p.GEOM_BOX, halfExtents=half, **client)
        if (
            solid.kind == "hull"
        ):  # points only: with triangle indices it would fall through the table
            points = (scale * solid.points).tolist()
            return p.createCollisionShape(p.GEOM_MESH, vertices=points, **client)
        halves, centres, turns = zip(*solid.boxes, strict=True)
        return p.createCollisionShapeArray(
            shapeTypes=[p.GEOM_BOX] * len(halves),
            halfExtents=[[scale * h for h in half] for half in halves],
            collisionFramePositions=[[scale * c for c in centre] for centre in centres],
            collisionFrameOrientations=[[0, math.sin(t / 2), 0, math.cos(t / 2)] for t in turns],
            **client,
        )

    def _add(self, shape_id: int, x: float, y: float, lowest_z: float) -> None:
        """Add an upright shape: its origin over (x, y), its lowest point at the height lowest_z."""
        p, client, shape, solid = self._bullet, self._client, SHAPES[shape_id], SOLIDS[shape_id]
        com = _turn(shape.angle, axis=2) @ solid.com * shape.scale  # from the origin, in the world
        position = [x + float(com[0]), y + float(com[1]), lowest_z + lowest(shape_id)]
        # useMaximalCoordinates: plain rigid bodies, 1.4 times faster than Bullet's multibodies
        body = p.createMultiBody(
            MASS, self._collision_shape(shape_id), -1, position, upright_quaternion(shape),
            useMaximalCoordinates=1, physicsClientId=client,
        )  # fmt: skip
        # Bullet would take the inertia of the bounding box. Mass must be given along with the
        # inertia: alone, it makes the body massless and its pose NaN.
        inertia = (MASS * solid.inertia * shape.scale**2).tolist()
        p.changeDynamics(
            body, -1, mass=MASS, localInertiaDiagonal=inertia, **FRICTION, restitution=0,
            linearDamping=0, angularDamping=0, physicsClientId=client,
        )  # fmt: skip
        self._bodies.append(body)
        self.shape_ids.append(shape_id)

    def _drop(self, shape_id: int, x: float, y: float) -> None:
        """A.4: let a shape go just above "the topmost shape, enabling a soft drop".

        published code: above it by the radii of their bounding spheres.
        """
        for body in self._bodies:  # published code: everything stands still when a shape is added
            self._bullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0), physicsClientId=self._client)
        self._add(shape_id, x, y, lowest_z=self.top() + DROP_GAP)
        self._settle()

    def _settle(self) -> None:
        """Simulate until at rest, at most 300 steps."""
        p, client, quiet = self._bullet, self._client, 0
        for done in range(CHECK_EVERY, SIM_STEPS + 1, CHECK_EVERY):
            if self.render_mode is not None:
                self._trace.append(self.poses())
            for _ in range(CHECK_EVERY):
                p.stepSimulation(physicsClientId=client)
            if self.early_stop and done >= FIRST_CHECK:
                quiet = quiet + 1 if self._at_rest() else 0
                if quiet == LOOKS:
                    break

    def _at_rest(self) -> bool:
        """Is every velocity and angular velocity below REST_SPEED, and nothing inside another?

        A thin shape can enter the table in the step it hits it; Bullet pushes it out too slowly to
        count as moving.
        """
        p, client = self._bullet, self._client
        for body in reversed(self._bodies):  # the newest moves most
            linear, angular = p.getBaseVelocity(body, physicsClientId=client)
            if max(map(abs, linear + angular)) >= REST_SPEED:
                return False
        distance = 8  # where a contact point holds it, below 0 if the two overlap
        contacts = p.getContactPoints(physicsClientId=client)
        return all(contact[distance] > -REST_DEPTH for contact in contacts)

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres of mass (n, 3), rotations (n, 3, 3) of the shapes in the scene (`shape_ids`)."""
        pairs = [
            self._bullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
            for body in self._bodies
        ]
        return np.array([p for p, _ in pairs]), _rotations(np.array([q for _, q in pairs]))

    def top(self) -> float:
        """Height of the exact highest point of the scene."""
        highest = 0.0
        for shape_id, position, rotation in zip(self.shape_ids, *self.poses(), strict=True):
            solid, up = SOLIDS[shape_id], rotation[2]  # world up in body coordinates
            disc = solid.disc * math.sqrt(max(1 - up[2] ** 2, 0))
            reach = SHAPES[shape_id].scale * (float((solid.points @ up).max()) + solid.ball + disc)
            highest = max(highest, float(position[2]) + reach)
        return highest

    def _draw(self) -> np.ndarray:
        """The scene as the agent sees it, (84, 84) uint8."""
        stage = _stage(*(RAISED if self.placement == "2d" else FRONT))
        canvas = _paint_scene(stage, self.shape_ids, *self.poses())
        return _gray(canvas, np.concatenate([[TABLE_GRAY], GRAYS[self.shape_ids]]))

    def _observe(self) -> dict[str, np.ndarray]:
        """A.4 State: push the picture onto the stack of four."""
        self._stack = np.concatenate([self._stack[1:], self._picture[None]])  # (4, 84, 84)
        return {"state": self._stack.copy(), "available": self.available.astype(np.int64)}

    def close(self) -> None:
        if self._client >= 0:
            self._bullet.disconnect(physicsClientId=self._client)
        self._client, self._running = -1, False

    def __del__(self) -> None:
        self.close()

    # ---- colour pictures, only for people ----

    def render(self) -> np.ndarray | None:
        """The scene in colour, (360, 360, 3) uint8 (None without render_mode)."""
        if self.render_mode is None:
            return None
        if not hasattr(self, "_bodies") or self._client < 0:
            raise ResetNeeded("call reset() before the first render()")
        return colour_picture(self.shape_ids, *self.poses(), caption=self._caption())

    def render_frames(self) -> list[np.ndarray]:
        """Colour frames of the last reset or step, the fall included, each (360, 360, 3) uint8.

        Empty without render_mode. Poses are recorded while simulating and painted only here.
        """
        if self.render_mode is None:
            return []
        if not hasattr(self, "_bodies") or self._client < 0:
            raise ResetNeeded("call reset() before the first render_frames()")
        moments = self._trace[:12:2] + self._trace[12::6]  # the settling in brief
        frames = [
            colour_picture(self.shape_ids[: len(pose[0])], *pose, caption=self._caption(pose))
            for pose in moments
        ]
        return [*frames, self.render()]

    def _caption(self, pose: tuple | None = None) -> str:
        height = (pose or self.poses())[0][:, 2].max()
        return f"step {self._steps:2d} of {MAX_STEPS}   height {height:.2f}"


def make_vec(
    num_envs: int,
    action_pool: Any = None,
    num_available: int = NUM_AVAILABLE,
    seed: int = 0,
    async_envs: bool | None = None,
    **task: Any,
) -> gym.vector.VectorEnv:
    """Environments in worker processes, restarting in the same step (SAME_STEP).

    Args:
        num_envs: at least 1. Sub-environment i is seeded with seed + i, so that a first reset()
            without a seed gives what reset(seed=seed) gives.
        action_pool, num_available, **task: see StackingEnv.
        async_envs: True: one process each; False: one after the other in this process; None:
            processes from two environments on (a step costs 100 times more than its messages).

    Raises:
        ValueError: num_envs below 1, a negative seed, or a bad argument of StackingEnv.
    """
    if num_envs < 1 or seed < 0:
        raise ValueError(f"num_envs must be >= 1 and seed >= 0, got {num_envs}, {seed}")
    StackingEnv(action_pool, num_available, **task)  # bad arguments fail here, not in a worker
    _load_pybullet()  # once, before the workers are forked

    def make(index: int) -> StackingEnv:
        env = StackingEnv(action_pool, num_available, **task)
        env.np_random = np.random.default_rng(seed + index)  # the generator reset(seed=...) makes
        return env

    thunks = [partial(make, index) for index in range(num_envs)]
    if num_envs > 1 if async_envs is None else async_envs:
        return AsyncVectorEnv(thunks, autoreset_mode=AutoresetMode.SAME_STEP)
    return SyncVectorEnv(thunks, autoreset_mode=AutoresetMode.SAME_STEP)


gym.register(id="ActionGen/Stacking-v0", entry_point="stacking_env:StackingEnv")


# ---- colour pictures (ours; the agent never sees them) ----

COLOUR_SIZE = 360
COLOUR_EYE, COLOUR_TARGET, COLOUR_FOV = (0.0, -10.5, 5.0), (0.0, 0.0, 2.45), 38.0
COLOUR_SUN = (-0.44, -0.40, 0.804)
SUN_EYE = (-11.0, -10.0, 20.1)  # 25 along it
WOOD, SKY = (0.93, 0.87, 0.78), (0.92, 0.95, 0.98)


def _sunlit(camera: Camera, canvas: Canvas, sun_camera: Camera, sun_canvas: Canvas) -> np.ndarray:
    """Share of the sun that reaches each pixel (H, W): what the sun does not see is in shadow."""
    size, axes = len(sun_camera.grid), sun_camera.axes.T
    u, v, depth = camera.grid, -camera.grid[:, None], 1 / np.maximum(canvas.near, 1e-3)
    start = ((camera.eye - sun_camera.eye) @ axes).astype(np.float32)  # the eye as the sun sees it
    turned = (camera.axes @ axes).astype(np.float32)  # and the rays u right + v up + forward
    right, up, ahead = (
        start[k] + depth * (u * turned[0, k] + (v * turned[1, k] + turned[2, k])) for k in range(3)
    )  # each (H, W)
    scale = sun_camera.focal / ahead
    column, row = scale * right + size / 2, size / 2 - scale * up
    reach = 1 / np.maximum(sun_canvas.near, 1e-3) + 0.08  # how far the sun sees, with some slack
    lit = np.zeros(canvas.near.shape, np.float32)
    for down, across in ((-1.2, 0), (1.2, 0), (0, -1.2), (0, 1.2)):  # four samples: soft edges
        i = np.clip((row + down).astype(np.int32), 0, size - 1)
        j = np.clip((column + across).astype(np.int32), 0, size - 1)
        lit += ahead < reach[i, j]
    return lit / 4


def colour_picture(
    shape_ids: Sequence[int],
    positions: np.ndarray,
    rotations: np.ndarray,
    size: int = COLOUR_SIZE,
    caption: str = "",
    view: tuple = (COLOUR_EYE, COLOUR_TARGET, COLOUR_FOV),
) -> np.ndarray:
    """Paint shapes on the table with a sun and shadows, (size, size, 3) uint8.

    Args:
        shape_ids: (n,) ids; positions: (n, 3); rotations: (n, 3, 3), as StackingEnv.poses() gives.
        caption: a line of text at the top; view: eye, target and field of view of the camera.
    """
    fine = 2 * size  # painted at twice the size, then averaged: smooth edges
    camera, sun_camera = (
        _stage(*view[:2], fine, view[2], COLOUR_SUN),
        _stage(SUN_EYE, (0, 0, 1), 1080, 20.0, COLOUR_SUN),
    )
    bodies = (shape_ids, positions, rotations, COLOUR_SUN)
    canvas, shadow_map = _paint_scene(camera, *bodies), _paint_scene(sun_camera, *bodies)
    lit = _sunlit(camera[0], canvas, sun_camera[0], shadow_map)
    colours = np.vstack([[WOOD], COLOURS[list(shape_ids)]]).astype(np.float32)
    bright = 0.5 + 0.12 * canvas.light + 0.45 * np.maximum(canvas.light, 0) * lit
    rgb = colours[canvas.owner] * bright[..., None]  # (2 size, 2 size, 3)
    rgb[canvas.near == 0] = SKY
    rgb = (rgb[::2, ::2] + rgb[1::2, ::2] + rgb[::2, 1::2] + rgb[1::2, 1::2]) / 4
    image = Image.fromarray((255 * np.clip(rgb, 0, 1)).round().astype(np.uint8))
    if caption:
        font = ImageFont.load_default(size=size // 24)
        ImageDraw.Draw(image).text((size // 36, size // 45), caption, fill=(60, 50, 40), font=font)
    return np.asarray(image)


# ---- a plan to compare with, and the command line ----

FLAT = {"horizontal_rectangle": (4, 2), "half_rectangle": (4, 1), "cube": (2, 2), "arch": (4, 2)}
FLAT |= {"rectangle": (2, 4), "cylinder": (2, 2)}  # family: width, height at scale 1


def greedy_plan(available: Sequence[int]) -> list[int]:
    """Order of positions in `available` for a flat tower, at most ten (ours; not in the appendix).

    The nine tallest shapes with flat top and bottom, widest first, then the tallest of the rest.
    All over one cylinder they reach a mean height of 4.7 to 5.6, depending on which scales are in
    the pool; random play reaches 1.6.
    """
    flat, rest = [], []
    for slot, shape_id in enumerate(available):
        shape = SHAPES[int(shape_id)]
        name = FAMILIES[shape.family].name
        if name in FLAT:
            width, height = FLAT[name]
            # every flat solid is as deep as 2 scales, so the width decides the footprint
            flat.append((height * shape.scale, width * shape.scale * shape.scale, slot))
        else:
            rest.append((2 * lowest(int(shape_id)), slot))
    flat = sorted(flat, reverse=True)
    base = sorted(flat[:9], key=lambda entry: -entry[1])
    others = [slot for *_, slot in flat[9:]] + [slot for _, slot in sorted(rest, reverse=True)]
    return ([slot for *_, slot in base] + others)[:MAX_STEPS]


def play(env: StackingEnv, seed: int, policy: str = "greedy") -> tuple[float, list[np.ndarray]]:
    """One episode without stopping; returns the height and the colour frames (if rendering)."""
    obs, _ = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    frames = env.render_frames()
    plan = greedy_plan(obs["available"])
    left = float(np.clip(env.poses()[0][0, 0], -1, 1))  # greedy: all over the left cylinder
    dims = PLACEMENTS[env.placement]
    for step in range(MAX_STEPS):
        if policy == "greedy":
            choice, place = plan[step % len(plan)], np.array([left, 0.0])[:dims]
        else:
            choice, place = rng.integers(env.num_available), rng.uniform(-1, 1, dims)
        action = {"choice": np.int64(choice), "stop": np.int64(0)}
        if dims:
            action["position"] = place.astype(np.float32)
        *_, info = env.step(action)
        frames += env.render_frames()
    return info[METRIC], frames


def save_gif(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write pictures as an endless GIF; the last one stays for 1.5 s. Creates missing folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = [round(1000 / fps)] * (len(frames) - 1) + [1500]  # ours: time to see the outcome
    images = [Image.fromarray(frame).quantize(255) for frame in frames]
    part = path.with_name(path.name + ".part")  # a reader never meets a half-written file
    images[0].save(part, "GIF", save_all=True, append_images=images[1:], duration=durations, loop=0)
    os.replace(part, path)


def _portrait(shape_id: int, size: int) -> np.ndarray:
    """One shape standing on the table, in colour, (size, size, 3) uint8."""
    shape, solid = SHAPES[shape_id], SOLIDS[shape_id]
    upright = _turn(shape.angle, axis=2)
    middle = solid.points.mean(0)  # centred on the picture, not on the centre of mass
    rotation = upright @ _turn(solid.tilt, axis=1)
    position = -(rotation @ middle) * (shape.scale, shape.scale, 0) + (0, 0, lowest(shape_id))
    view = ((0.0, -3.6, 2.0), (0.0, 0.0, 0.45), 32.0)
    return colour_picture([shape_id], position[None], rotation[None], size, "", view)


def shape_sheet(size: int = 150) -> Image.Image:
    """All 16 families: smallest, middle and largest shape in colour, three views of the largest."""
    rows, font = [], ImageFont.load_default(size=15)
    for index, family in enumerate(FAMILIES):
        ids = [i for i, shape in enumerate(SHAPES) if shape.family == index]
        middle = family.scales // 2 * family.angles + 2 % family.angles
        picked = [ids[1 % family.angles], ids[middle], ids[-1]]
        cells = [_portrait(shape_id, size) for shape_id in picked]
        for view in _views(ids[-1], 3, 0):
            gray = Image.fromarray(view).resize((size, size), Image.Resampling.NEAREST)
            cells.append(np.asarray(gray.convert("RGB")))
        row = Image.fromarray(np.concatenate(cells, axis=1))
        text = f"{family.name}: {len(ids)}, {family.label}"
        ImageDraw.Draw(row).text((8, 5), text, fill=(60, 50, 40), font=font)
        rows.append(np.asarray(row))
    left, right = np.concatenate(rows[:8]), np.concatenate(rows[8:])
    gap = np.full((len(left), 12, 3), 255, dtype=np.uint8)
    return Image.fromarray(np.concatenate([left, gap, right], axis=1))


@dataclass
class Args:
    """Build a planned and a random tower, draw the shapes, print a summary."""

    seed: int = 0
    """seed of the split and of the episodes"""
    out: Path = Path("runs/demo")
    """folder for the GIFs and the sheet"""
    split: Literal["default", "full"] = "default"
    """how the shapes are divided (A.4, Table 2)"""
    pool: Literal["train", "valid", "test"] = "test"
    """part of the split whose shapes are on offer"""
    num_available: int = NUM_AVAILABLE
    """shapes on offer in an episode (Table 3)"""
    placement: Literal["none", "1d", "2d"] = "1d"
    """where the agent may drop shapes (C.6)"""
    show_shapes: bool = False
    """also draw a sheet of all shape families"""


def main(args: Args) -> None:
    """The script: see the top of the file."""
    parts = split_actions(args.split, args.seed)
    env = StackingEnv(parts[args.pool], args.num_available, "rgb_array", placement=args.placement)
    labels, counts = np.unique(action_labels(), return_counts=True)
    print(f"{NUM_ACTIONS} shapes; {args.split} split {args.seed}, {args.num_available} on offer:")
    print("  " + " ".join(f"{text:>8}" for text in ("all", *parts)) + "  class")
    for label, count in zip(labels, counts, strict=True):
        row = [count] + [int((action_labels()[ids] == label).sum()) for ids in parts.values()]
        print("  " + " ".join(f"{number:8}" for number in row) + f"  {label}")
    for policy in ("greedy", "random"):
        height, frames = play(env, args.seed, policy)
        path = args.out / f"stacking_{policy}.gif"
        save_gif(path, frames, env.metadata["render_fps"])
        print(f"{policy} tower of {args.pool} shapes: height {height:.2f}, wrote {path}")
    env.close()
    if args.show_shapes:
        path = args.out / "stacking_shapes.png"
        shape_sheet().save(path.with_suffix(".part"), "PNG")
        os.replace(path.with_suffix(".part"), path)
        print(f"wrote {path}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (ValueError, OSError, ImportError) as error:
        raise SystemExit(f"error: {error}") from None
