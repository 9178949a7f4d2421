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
    ____________|_|___|_|____________  table, z = 0        1 unit = 1 m, angles in radians

Commands:

    python stacking_env.py                  # a planned and a random tower as GIFs, a sheet of all
                                            # families, in runs/demo (about 10 seconds)
    python stacking_env.py --split full     # the same with Table 2's unseen classes on offer

Paper map (appendix -> here):

    A.4 Actions, the 810 shapes   FAMILIES, SHAPES; StackingEnv.step
    A.4 Action set split, Table 2 split_actions
    A.4 State                     photograph, StackingEnv._observe
    A.4 Action observations, B    action_observations
    A.4 Reward, Eq. 4             eq4_reward
    B, Fig. 6 (classes)           action_labels
    C.6, Fig. 13                  PLACEMENTS (No Place, 1D Place, 2D Place), split "full"
    Table 3 (20 actions, 10)      NUM_AVAILABLE, MAX_STEPS
"""

import colorsys
import functools
import itertools
import math
import multiprocessing
import operator
import os
import weakref
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import pybullet as p
import tyro
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import Rotation
from tqdm import tqdm

METRIC = "height"
MODALITIES = ("image",)  # A.4: "images of the shape from various camera angles and heights"
# C.6, Figure 13: No Place, 1D Place (default), 2D Place; the number of coordinates the agent gives
PLACEMENTS = {"none": 0, "1d": 1, "2d": 2}

# ---- rules of the game (A.4) ----
MAX_STEPS = 10  # A.4 "terminates after 10 shape placements"; Table 3 max. episode length
NUM_AVAILABLE = 20  # Table 3 "actions per episode"
LAMBDA_TOP = LAMBDA_AVG = 0.5  # Eq. 4
FRAMES = 4  # A.4 "stack past 4 frames"
SIZE = 84  # A.4 "84x84 grayscale image"
DROP_GAP = 0.02  # ours, m: A.4 "soft drop"; the shapes are .16 to 1.92 m wide
CYLINDERS = (798, 799, 800)  # published code: the start cylinders are two copies of one of these
CENTRE, AXIS_GAP = (-0.2, 0.2), (1.0, 1.6)  # published code, m: "random locations on a line" (A.4)

# ---- physics (A.4 names only the 300 steps) ----
SIM_STEPS = 300  # A.4 "acts every 300 physics simulator steps"
TIME_STEP = 0.01  # published code, s
GRAVITY = -9.81  # m/s^2
# ours: at most 50 iterations of the contact solver per step (with 20, tall towers creep and fall),
# fewer once it has converged: 1e-5 in place of Bullet's 1e-7 saves 5 % of a step's time.
SOLVER_ITERATIONS, SOLVER_RESIDUAL = 50, 1e-5
# published code: density 1000, so masses differ 1000-fold, which breaks Bullet's solver: a tower of
# five cubes, larger upwards, falls within 3 s. With mass 1 each, and the true inertia, it stands.
MASS = 1.0
# published code: sliding, spinning, rolling friction 2, 2, .25, close to glue; ours: 1, .1, .05, so
# that spheres come to rest but the class of a shape still decides what can stand on it. Bullet
# multiplies the sliding coefficients of a pair and mixes the others as r1 f2 + r2 f1, hence the 2.
FRICTION = {"lateralFriction": 1.0, "spinningFriction": 0.1 / 2, "rollingFriction": 0.05 / 2}
# appendix: always 300 steps; ours: stop once all is at rest. Looking every 5th step, at rest = two
# looks in a row with every (angular) velocity component below .05. It is part of the task's
# definition, not only a saving: a tower that stands is not sheared apart by solver noise.
CHECK_EVERY, FIRST_CHECK, LOOKS, REST_SPEED = 5, 10, 2, 0.05
REST_DEPTH = 0.01  # ours, m: at rest, two bodies overlap by less; an eighth of the thinnest shape

# ---- pictures ----
FOV = 45.0  # published code, degrees
# published code: eye and target, here mirrored to the -y side; right = +x, floor z = 0. The picture
# ends at a height of 5.4 (2D Place: 3.9): the policy does not see the top of its best towers.
FRONT = (0.0, -7.0, 2.5), (0.0, 0.0, 2.5)
RAISED = (0.0, -4.0, 5.5), (0.0, 1.66, 0.0)  # the same for 2D Place
VIEW_RADIUS, VIEW_HEIGHT = 2.0, (0.5, 2.0)  # published code, m: a circle around the shape, heights
# ours: the light shines over the photographer's right shoulder (right, up, back; length 1). It goes
# along with the camera, so that faces of a shape differ in brightness from every viewpoint.
LIGHT = (0.24, 0.52, 0.82)
AMBIENT, DIFFUSE = 0.35, 0.65  # ours: a face turned away from the light keeps a third of its colour
LUMINANCE = (0.299, 0.587, 0.114)  # published code: grey of red, green, blue
TABLE = (4.0, 2.0, 0.1)  # half sizes, m: published code draws 8 x 4; the thickness is ours
WOOD = (0.82, 0.66, 0.45)  # ours: a lit table top of 120 of 255 in grey (2D Place: 167)


# ---- A.4: the 810 shapes ----


def prism(*polygon: tuple[float, float]) -> np.ndarray:
    """Corners (2n, 3) of a polygon (n, 2) in x, z that is drawn out along y from -1 to 1."""
    return np.array([(x, y, z) for y in (-1, 1) for x, z in polygon], dtype=float)


def box(x: float, y: float, z: float, centre: tuple = (0, 0, 0)) -> np.ndarray:
    """The eight corners (8, 3) of a box with these half sizes."""
    return np.array(list(itertools.product((-x, x), (-y, y), (-z, z)))) + centre


def ring(count: int, z: float, radius: float = 1.0, turn: float = 2) -> np.ndarray:
    """`count` points (count, 3) evenly on a circle at the height z, from the angle 0 to turn pi."""
    angles = np.linspace(0, turn * math.pi, count, endpoint=turn < 2)
    flat = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (count, 2)
    return np.insert(flat, 2, z, axis=1)


def ball(z: float = 0.0) -> np.ndarray:
    """Points (266, 3) all over a sphere of radius 1 about (0, 0, z), a ring every 15 degrees."""
    polar = np.linspace(0, math.pi, 13)[1:-1]
    rings = [ring(24, z + math.cos(angle), math.sin(angle)) for angle in polar]
    return np.vstack([[(0, 0, z + 1), (0, 0, z - 1)], *rings])


@dataclass(frozen=True, eq=False)
class Family:
    """A grid of shapes: `scales` sizes from lo to hi, each turned to `angles` angles in [0, turn).

    A shape is the convex hull of its points (of each eight, for kind "box"), given about the point
    that carries its position (the published code's origin). `same_as` names a family of the same
    solid: resting on another face, or a second mesh of it.
    """

    name: str  # published code's name
    label: str  # class of Table 2
    full_train: bool  # Table 2: in the training row?
    points: np.ndarray  # (V, 3) at scale 1
    lo: float
    hi: float
    scales: int
    turn: float  # in units of pi
    angles: int
    kind: str = "hull"  # or a solid of Bullet: "box", "sphere", "capsule", "cylinder"
    same_as: str = ""

    def parts(self) -> np.ndarray:
        """The convex parts (P, V, 3): one, but three for the arch."""
        return self.points.reshape(-1, 8, 3) if self.kind == "box" else self.points[None]


DOME = ring(13, 0, turn=1)[:, :2] - (0, 0.5)  # half-circle in x, z; flat side down at z = -.5
HAT = prism((-1, 0), (1, 0), (0, 1)) * (math.sqrt(2), 1, math.sqrt(2))  # lies on its long side
CONE = np.vstack([ring(20, -1), (0, 0, 1)])
# published code: drawn with a round tunnel but collides as a full block; ours: the tunnel is real,
# two legs and a lintel, and the picture shows exactly what collides.
ARCH = [box(0.375, 1, 1, (x, 0, 0)) for x in (-1.625, 1.625)] + [box(1.25, 1, 0.375, (0, 0, 0.625))]

# Grids of the published code: A.4 "varying the scale and vertical orientation in each shape class".
# One correction: `rectangle` has a square footprint, so the published 6 x 30 degrees up to pi give
# every shape twice; A.4 wants all shapes different, so we use 6 x 15 degrees up to pi / 2. The cone
# appears twice in the published list (same scales, another mesh); kept, for the count of 810.
FAMILIES = (
    Family("middle_triangle", "angled-triangle", False,
           prism((-1, -1), (1, -1), (0, 1)), 0.1, 0.5, 6, 1, 10),
    Family("hat", "angled-triangle", False,
           HAT[:, [1, 0, 2]], 0.1, 0.5, 6, 1, 10, same_as="triangle"),  # its ridge is along x
    Family("triangle", "triangle", True,
           prism((-1, -1), (1, -1), (-1, 1)), 0.1, 0.5, 6, 2, 10),
    Family("tall_triangle", "triangle", True,
           prism((-1, -2), (1, -2), (-1, 2)), 0.1, 0.3, 6, 2, 10),
    Family("horizontal_rectangle", "angled-rectangle", False,
           box(2, 1, 1), 0.1, 0.5, 6, 1, 10, "box", same_as="rectangle"),
    Family("dome", "dome", True,  # published code: half a cylinder, not half a ball
           prism(*DOME), 0.2, 0.6, 6, 1, 10),
    Family("cone-hires", "cone", False, CONE, 0.1, 0.6, 30, 0, 1, same_as="cone"),
    Family("cone", "cone", False, CONE, 0.1, 0.6, 30, 0, 1),
    Family("tetrahedron", "tetrahedron", False,  # published code: a pyramid on a square
           np.vstack([box(1, 1, 1)[::2], (0, 0, 1)]), 0.1, 0.6, 10, 0.25, 6),
    Family("arch", "arch", True, np.vstack(ARCH), 0.1, 0.5, 6, 1, 10, "box"),
    Family("rectangle", "rectangle", True, box(1, 1, 2), 0.1, 0.3, 10, 0.5, 6, "box"),
    Family("half_rectangle", "rectangle", True, box(2, 1, 0.5), 0.1, 0.6, 10, 1, 6, "box"),
    Family("cube", "cube", False, box(1, 1, 1), 0.1, 0.6, 10, 0.25, 6, "box"),
    Family("sphere", "sphere", True, ball(), 0.1, 0.8, 30, 0, 1, "sphere"),
    Family("capsule", "capsule", True,
           np.vstack([ball(1), ball(-1)]), 0.1, 0.4, 30, 0, 1, "capsule"),
    Family("cylinder", "cylinder", False,
           np.vstack([ring(32, 1), ring(32, -1)]), 0.1, 0.6, 30, 0, 1, "cylinder"),
)  # fmt: skip
SCALE_FACTOR = 0.8  # published code: every scale of the grid times .8


class Shape(NamedTuple):
    """One of the 810 actions."""

    family: Family
    scale: float  # m
    angle: float  # rotation about the vertical, radians

    def size(self) -> tuple[str, float]:
        """What is on one side of a default split: the solid and its scale, however it rests."""
        return self.family.same_as or self.family.name, self.scale


SHAPES = [  # in the order of the ids: family, then scale, then angle
    Shape(family, scale, angle)
    for family in FAMILIES
    for scale in (SCALE_FACTOR * np.linspace(family.lo, family.hi, family.scales)).tolist()
    for angle in np.linspace(0, family.turn * math.pi, family.angles, endpoint=False).tolist()
]
NUM_ACTIONS = len(SHAPES)  # A.4: 810


def random_colour(rng: np.random.Generator) -> tuple[float, float, float]:
    """Red, green, blue in [0, 1]; A.4 mentions "random ... colors"."""
    # published code: random hue, saturation .5-1, value .5-1; ours: lighter, so that no shape is
    # close to black on the black background.
    return colorsys.hsv_to_rgb(*rng.uniform((0.0, 0.35, 0.65), (1.0, 0.75, 1.0)))


_rng = np.random.default_rng(42)  # published code: one colour per shape, from the seed 42
COLOURS = [random_colour(_rng) for _ in SHAPES]


@functools.cache
def mass_properties(family: Family) -> tuple[np.ndarray, Rotation, np.ndarray]:
    """Centre of mass (3,), principal axes, moments of inertia (3,) about them; scale 1, mass 1."""
    # Of the solids with curved sides that Bullet has itself, the moments are known in closed form.
    # Capsule: a tube (mass share 3/5) and two half-balls (2/5), each 3/8 beyond an end of the tube.
    capsule = 0.6 * 7 / 12 + 0.4 * (0.4 + 1 + 2 * 3 / 8), 0.6 / 2 + 0.4 * 0.4  # across, along z
    curved = {"sphere": (0.4, 0.4), "cylinder": (7 / 12, 1 / 2), "capsule": capsule}
    if family.kind in curved:
        across, along = curved[family.kind]
        return np.zeros(3), Rotation.identity(), np.array([across, across, along])
    tets = np.vstack([part[Delaunay(part).simplices] for part in family.parts()])  # (T, 4, 3)
    volumes = np.abs(np.linalg.det(tets[:, 1:] - tets[:, :1])) / 6  # (T,)
    shares = volumes / volumes.sum()
    com = shares @ tets.mean(axis=1)  # (3,)
    corners = tets - com
    total = corners.sum(axis=1)  # (T, 3)
    # the mean of x x^T over a tetrahedron is (sum of v v^T + (sum of v) (sum of v)^T) / 20
    moments = np.einsum("t,tvi,tvj->ij", shares, corners, corners)
    moments = (moments + np.einsum("t,ti,tj->ij", shares, total, total)) / 20
    inertia = np.trace(moments) * np.eye(3) - moments
    if np.allclose(inertia, np.diag(np.diag(inertia)), atol=1e-9):  # all but two of the triangles
        return com, Rotation.identity(), np.diag(inertia)
    principal, axes = np.linalg.eigh(inertia)
    axes *= np.linalg.det(axes)  # a rotation, not a mirror image
    return com, Rotation.from_matrix(axes), principal


# ---- A.4: ids, labels, features, split ----


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


def action_labels() -> np.ndarray:
    """Class of every shape by Table 2's names (NUM_ACTIONS,) str; what Figure 6 colours by.

    Without the prefix "angled-" these are the ten classes of A.4.
    """
    return np.array([shape.family.label for shape in SHAPES])


def engineered_representations() -> np.ndarray:
    """Ground truth: scale, sin and cos of the angle, one-hot family; (NUM_ACTIONS, 19) float32."""
    # published code: scale, axis (0, 0, 1), angle, one-hot; we write the angle as a point on the
    # circle, so that turning by almost 360 degrees is close to not turning at all.
    table = np.zeros((NUM_ACTIONS, 3 + len(FAMILIES)), dtype=np.float32)
    for row, shape in zip(table, SHAPES, strict=True):
        row[:3] = shape.scale, math.sin(shape.angle), math.cos(shape.angle)
        row[3 + FAMILIES.index(shape.family)] = 1
    return table


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Train, validation and test ids, about 2:1:1 (A.4).

    Args:
        split: "default" draws half of the scales of every family for training; all angles of a
            scale stay together, and so do families of the same solid. "full" trains on the classes
            of Table 2's first row.
        seed: of the draw of the scales and of the halving of the rest.

    Returns:
        {"train", "valid", "test"}: sorted, disjoint int64 arrays; 405 / 202 / 203 ids by default,
        420 / 195 / 195 for "full". ValueError for another name of a split.
    """
    if split not in ("default", "full"):
        raise ValueError(f"unknown split {split!r}; allowed: default, full")
    rng = np.random.default_rng(seed)
    # published code: a draw per family. Then a cone would be in training and its copy, the other
    # cone, in the test. The same solid is one draw here: both cones; hat and triangle; and the
    # smallest of both rectangles, the only scale that these have in common.
    chosen: dict[tuple[str, float], bool] = {}  # Shape.size() -> used in training?
    for family in FAMILIES:
        sizes = list(dict.fromkeys(shape.size() for shape in SHAPES if shape.family is family))
        new = [size for size in sizes if size not in chosen]
        wanted = len(sizes) // 2 - sum(chosen.get(size, False) for size in sizes)
        chosen |= {new[k]: rank < wanted for rank, k in enumerate(rng.permutation(len(new)))}
    if split == "full":  # Table 2: here `triangle` and `hat`, one solid on two faces, are apart
        train = np.array([shape.family.full_train for shape in SHAPES])
    else:
        train = np.array([chosen[shape.size()] for shape in SHAPES])
    # A.4: "randomly splitting the test set into half", but what looks the same goes together
    twins: dict[tuple, list[int]] = {}
    for i in np.flatnonzero(~train).tolist():
        twins.setdefault((*SHAPES[i].size(), SHAPES[i].angle), []).append(i)
    groups, valid = list(twins.values()), []
    for k in rng.permutation(len(groups)):
        if len(valid) + len(groups[k]) <= (~train).sum() // 2:
            valid += groups[k]
    test = np.setdiff1d(np.flatnonzero(~train), valid)
    return {"train": np.flatnonzero(train), "valid": np.sort(valid), "test": test}


# ---- what Bullet simulates and draws ----


class Bullet:
    """A physics simulation of its own: pybullet's functions, with the client number filled in."""

    def __init__(self) -> None:
        self.client = p.connect(p.DIRECT)
        weakref.finalize(self, p.disconnect, self.client)  # it ends when nobody holds it any more

    def __getattr__(self, name: str) -> Any:
        function = functools.partial(getattr(p, name), physicsClientId=self.client)
        setattr(self, name, function)  # the next time it is found at once
        return function


@functools.cache
def geometry(family: Family) -> tuple[list, dict[str, list]]:
    """What Bullet gets of a family, at scale 1: its V corners, and T triangles for the pictures.

    Each triangle has vertices of its own, all with the normal of its plane: a face is evenly bright
    and an edge is sharp.
    """
    # pybullet never frees a list of vertices that it was given. So each family's lists are made
    # once (meshScale does the rest): with new lists, an episode would leak 200 kB and more.
    vertices, normals = [], []
    for part in family.parts():
        hull = ConvexHull(part)
        outward = hull.equations[:, :3]  # (T, 3)
        a, b, c = np.moveaxis(part[hull.simplices], 1, 0)  # (T, 3) each
        inside_out = (np.cross(b - a, c - a) * outward).sum(axis=1, keepdims=True) < 0  # (T, 1)
        b, c = np.where(inside_out, c, b), np.where(inside_out, b, c)
        vertices += np.stack([a, b, c], axis=1).reshape(-1, 3).tolist()  # (3 T, 3)
        normals += outward.repeat(3, axis=0).tolist()  # (3 T, 3)
    triangles = {"vertices": vertices, "normals": normals, "indices": list(range(len(vertices)))}
    return family.points.tolist(), triangles


def add_shape(bullet: Bullet, shape_id: int, origin: Sequence[float], rgb: Sequence[float]) -> int:
    """Put an upright shape's origin at a place in the world; returns Bullet's number of it."""
    family, scale, angle = SHAPES[shape_id]
    (corners, triangles), zoom = geometry(family), {"meshScale": [scale] * 3}
    if family.kind == "sphere":
        solid = bullet.createCollisionShape(p.GEOM_SPHERE, radius=scale)
    elif family.kind in ("cylinder", "capsule"):
        geom = p.GEOM_CYLINDER if family.kind == "cylinder" else p.GEOM_CAPSULE
        solid = bullet.createCollisionShape(geom, radius=scale, height=2 * scale)
    elif family.kind == "box":
        parts = scale * family.parts()  # (P, 8, 3)
        solid = bullet.createCollisionShapeArray(
            [p.GEOM_BOX] * len(parts),
            halfExtents=(np.ptp(parts, axis=1) / 2).tolist(),
            collisionFramePositions=parts.mean(axis=1).tolist(),
        )
    else:  # Points only, Bullet makes the hull. With triangles it would fall through the table.
        solid = bullet.createCollisionShape(p.GEOM_MESH, vertices=corners, **zoom)
    look = bullet.createVisualShape(p.GEOM_MESH, **triangles, **zoom, rgbaColor=(*rgb, 1))
    # The body's frame has its origin at the centre of mass and goes along the principal axes; this
    # is what getBasePositionAndOrientation tells later. The pose here is of the shape's own frame.
    com, axes, moments = mass_properties(family)
    body = bullet.createMultiBody(
        MASS, solid, look, list(origin), p.getQuaternionFromEuler((0, 0, angle)),
        baseInertialFramePosition=(scale * com).tolist(),
        baseInertialFrameOrientation=axes.as_quat().tolist(),  # x, y, z, w
        useMaximalCoordinates=1,  # plain rigid bodies, 1.4 times faster than Bullet's multibodies
    )  # fmt: skip
    # Bullet would take the inertia of the bounding box. Mass must be given along with the inertia:
    # alone, it makes the body massless and its pose NaN.
    inertia = (MASS * scale**2 * moments).tolist()
    bullet.changeDynamics(
        body, -1, mass=MASS, localInertiaDiagonal=inertia, **FRICTION, restitution=0,
        linearDamping=0, angularDamping=0,
    )  # fmt: skip
    return body


def empty_world(bullet: Bullet) -> None:
    """A table and nothing on it; for each episode anew, so that none leaves traces."""
    bullet.resetSimulation()
    bullet.setGravity(0, 0, GRAVITY)
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=TIME_STEP, numSolverIterations=SOLVER_ITERATIONS,
        solverResidualThreshold=SOLVER_RESIDUAL, deterministicOverlappingPairs=1,
    )  # fmt: skip
    # The floor has no end (published code: invisible walls at the left and at the back). What is
    # drawn of it is a board of 8 x 4 m.
    plane = bullet.createCollisionShape(p.GEOM_PLANE)
    board = bullet.createVisualShape(
        p.GEOM_BOX, halfExtents=TABLE, rgbaColor=(*WOOD, 1), visualFramePosition=(0, 0, -TABLE[2])
    )
    floor = bullet.createMultiBody(0, plane, board, useMaximalCoordinates=1)
    bullet.changeDynamics(floor, -1, **FRICTION, restitution=0)


def photograph(bullet: Bullet, camera: tuple, size=SIZE, fov=FOV, sky=(0, 0, 0)) -> np.ndarray:
    """The picture of a camera (eye, target), (size, size, 3) uint8; `sky` where nothing is."""
    view = p.computeViewMatrix(*camera, (0, 0, 1))
    lens = p.computeProjectionMatrixFOV(fov, 1, 0.1, 40)  # square; sees from .1 to 40 m
    axes = np.reshape(view, (4, 4))[:3, :3]  # columns: right, up, back in the world
    _, _, rgba, _, owner = bullet.getCameraImage(
        size, size, view, lens, renderer=p.ER_TINY_RENDERER, lightDirection=(axes @ LIGHT).tolist(),
        lightAmbientCoeff=AMBIENT, lightDiffuseCoeff=DIFFUSE, lightSpecularCoeff=0, shadow=0,
    )  # fmt: skip
    # owner (size, size): number of the body that is seen, -1 where there is none
    return np.where(owner[:, :, None] < 0, np.uint8(sky), rgba[:, :, :3])


def grey(rgb: np.ndarray) -> np.ndarray:
    """Luminance of a picture (H, W, 3), (H, W) uint8."""
    return (rgb @ LUMINANCE).astype(np.uint8)


# ---- A.4: the environment ----


def eq4_reward(heights: np.ndarray) -> float:
    """Eq. 4 at the end of an episode, from the heights h_i of all N shapes in the scene (N,)."""
    # appendix: all N shapes (here with the two cylinders); published code: the mean runs only over
    # shapes whose origin is above .5 and is measured .5 lower. We do Eq. 4 as written.
    return float(LAMBDA_TOP * heights.max() + LAMBDA_AVG * heights.mean())


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
    | position | `Box(-1, 1, (d,))` | where, in m: x (1d), x and y (2d); no such key for "none" |
    | stop | `Discrete(2)` | 1: end the episode now, nothing is placed |

    A shape that has been placed cannot be placed again: choosing it only uses up the step. A place
    outside of [-1, 1] does the same. ValueError, before anything moves, for a choice or stop out of
    range and for a position of another length or that is not finite.

    ## Observation Space
    `Dict`: state `Box(0, 255, (4, 84, 84), uint8)`, the last four grayscale pictures, newest last,
    zeros before the episode began; available `Box(0, 809, (K,), int64)`, the ids of the shapes on
    offer, redrawn at every reset (where K is the whole pool: always the pool, in order).

    ## Rewards
    Eq. 4 on the last step, else 0: half the height of the highest shape plus half the mean height
    of all shapes, the cylinders included. Heights, in m, are of centres of mass above the table;
    the place of a shape is that of its origin, for most the middle of the bounding box.

    ## Starting State
    Two copies of one of three cylinders (.66, .68, .71 m high) in random colours, their axes 1.0 to
    1.6 m apart.

    ## Episode End
    1. Termination: the stop action. 2. Truncation: the tenth action, repeats included. The last
    step's info has `height`, that of the highest shape. As `action_space.sample()` stops with
    probability .5, it ends an episode after 2 steps on average. A random policy that does not stop:

    >>> env = StackingEnv()
    >>> obs, info = env.reset(seed=0)
    >>> while "height" not in info:
    ...     obs, reward, _, _, info = env.step({**env.action_space.sample(), "stop": 0})

    ## Arguments
    action_pool: ids to draw from (default: the training split); num_available: K; render_mode: None
    or "rgb_array"; placement: "none" (always over the centre), "1d" or "2d" (C.6); early_stop:
    False runs the full 300 steps after each drop, as A.4 has it. ValueError for an unknown option,
    for unknown or repeated ids, for a pool smaller than K.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        action_pool: Sequence[int] | None = None,
        num_available: int = NUM_AVAILABLE,
        render_mode: str | None = None,
        placement: str = "1d",
        early_stop: bool = True,
    ) -> None:
        if placement not in PLACEMENTS:
            raise ValueError(f"unknown placement {placement!r}; allowed: {', '.join(PLACEMENTS)}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; allowed: rgb_array")
        pool = split_actions()["train"] if action_pool is None else action_pool
        self.action_pool = np.sort(check_ids(pool, num_available))
        self.num_available, self.render_mode = num_available, render_mode
        self.placement, self.early_stop = placement, early_stop
        self.observation_space = spaces.Dict(
            state=spaces.Box(0, 255, (FRAMES, SIZE, SIZE), np.uint8),
            available=spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
        )
        parts = {"choice": spaces.Discrete(num_available), "stop": spaces.Discrete(2)}
        if PLACEMENTS[placement]:
            parts["position"] = spaces.Box(-1, 1, (PLACEMENTS[placement],), np.float32)
        self.action_space = spaces.Dict(parts)
        # The simulation is made in the first reset, so in the worker process of a vector env.
        self._bullet: Bullet | None = None
        self._over = True  # nothing to step yet
        self._frames: list[np.ndarray] = []  # colour pictures of the last reset or step

    def __reduce__(self) -> None:
        raise TypeError("a StackingEnv holds a running simulation: make a new one, do not copy it")

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Draw the shapes on offer, drop the two cylinders; returns (observation, {})."""
        super().reset(seed=None if seed is None else operator.index(seed))  # numpy integers, too
        rng = self.np_random
        self.available = self.action_pool
        if self.num_available < len(self.action_pool):
            self.available = rng.choice(self.action_pool, self.num_available, replace=False)
        self._bullet = self._bullet or Bullet()
        empty_world(self._bullet)
        self._bodies: list[int] = []  # Bullet's numbers
        self.shape_ids: list[int] = []  # ids of the shapes in the scene, the two cylinders first
        self._steps, self._frames, self._over = 0, [], False
        # appendix: "random heights"; published code: one of three, the same for both, as here
        cylinder = int(rng.choice(CYLINDERS))
        centre, gap = rng.uniform(*CENTRE), rng.uniform(*AXIS_GAP)
        for x in (centre - gap / 2, centre + gap / 2):
            self._add(cylinder, x, 0.0, 0.0, random_colour(rng))
        self._settle()
        self._stack = np.zeros((FRAMES, SIZE, SIZE), dtype=np.uint8)
        return self._observe(moved=True), {}

    def step(self, action: dict) -> tuple[dict, float, bool, bool, dict]:
        """One action; see the class for what it must be. After the end: ResetNeeded."""
        if self._over:
            raise ResetNeeded("the episode is over (or none began): call reset()")
        choice, stop = operator.index(action["choice"]), operator.index(action["stop"])
        place = np.asarray(action.get("position", ()), dtype=float)  # (d,)
        if not 0 <= choice < self.num_available or stop not in (0, 1):
            raise ValueError(f"choice {choice} or stop {stop} is out of range")
        if place.shape != (PLACEMENTS[self.placement],) or not np.isfinite(place).all():
            raise ValueError(f"position must be {PLACEMENTS[self.placement]} finite numbers")
        self._steps, self._frames = self._steps + 1, []
        shape_id = int(self.available[choice])
        # A.4: "trying to place it again does nothing"; ours: nor does a place beyond [-1, 1]
        inside = bool((np.abs(place) <= 1).all())
        drop = not stop and inside and shape_id not in self.shape_ids[2:]
        if drop:
            for body in self._bodies:  # published code: all stands still when a shape is added
                self._bullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))
            # C.6: No Place is over the centre; in 1D Place "the y-coordinate ... is fixed"
            x, y = (*place.tolist(), 0.0, 0.0)[:2]
            self._add(shape_id, x, y, self.top(), COLOURS[shape_id])
            self._settle()
        terminated, truncated = bool(stop), not stop and self._steps >= MAX_STEPS
        reward, info, self._over = 0.0, {}, terminated or truncated
        if self._over:
            heights = self.poses()[0][:, 2]
            # published code: the score uses shape origins; ours: centres of mass, as in the reward
            reward, info = eq4_reward(heights), {METRIC: float(heights.max())}
        return self._observe(moved=drop), reward, terminated, truncated, info

    def _add(self, shape_id: int, x: float, y: float, top: float, rgb: tuple) -> None:
        """Let a shape go with its origin over (x, y) and its lowest point just above `top`."""
        # published code: above the scene by the radii of the two bounding spheres
        shape = SHAPES[shape_id]
        z = top + DROP_GAP - shape.scale * shape.family.points[:, 2].min()
        self._bodies.append(add_shape(self._bullet, shape_id, (x, y, z), rgb))
        self.shape_ids.append(shape_id)

    def _settle(self) -> None:
        """Simulate until at rest, at most 300 steps."""
        quiet = 0
        for done in range(CHECK_EVERY, SIM_STEPS + 1, CHECK_EVERY):
            if self.render_mode and (done - CHECK_EVERY) % FRAME_EVERY == 0:
                self._frames.append(self.render())
            for _ in range(CHECK_EVERY):
                self._bullet.stepSimulation()
            if self.early_stop and done >= FIRST_CHECK:
                quiet = quiet + 1 if self._at_rest() else 0
                if quiet == LOOKS:
                    break

    def _at_rest(self) -> bool:
        """Is every velocity and angular velocity below REST_SPEED, and nothing inside another?

        A thin shape can enter the table in the step it hits it; Bullet pushes it out too slowly to
        count as moving.
        """
        for body in reversed(self._bodies):  # the newest moves most
            linear, angular = self._bullet.getBaseVelocity(body)
            if max(map(abs, linear + angular)) >= REST_SPEED:
                return False
        distance = 8  # where a contact point holds it, below 0 if the two overlap
        return all(contact[distance] > -REST_DEPTH for contact in self._bullet.getContactPoints())

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres of mass (n, 3), rotations (n, 3, 3) of the bodies in the scene (`shape_ids`)."""
        poses = [self._bullet.getBasePositionAndOrientation(body) for body in self._bodies]
        rotations = [p.getMatrixFromQuaternion(quaternion) for _, quaternion in poses]
        return np.array([centre for centre, _ in poses]), np.reshape(rotations, (-1, 3, 3))

    def top(self) -> float:
        """Height of the highest point of the scene; of what is round, within .01 m."""
        highest = 0.0
        for shape_id, centre, rotation in zip(self.shape_ids, *self.poses(), strict=True):
            family, scale, _ = SHAPES[shape_id]
            com, axes, _ = mass_properties(family)
            up = axes.apply(rotation[2])  # (3,) the world's up in the shape's own frame
            highest = max(highest, centre[2] + scale * ((family.points - com) @ up).max())
        return float(highest)

    def _observe(self, moved: bool) -> dict[str, np.ndarray]:
        """A.4 State: push a picture onto the stack of four; the last one again if nothing moved."""
        picture = self._stack[-1]
        if moved:
            camera = RAISED if self.placement == "2d" else FRONT
            picture = grey(photograph(self._bullet, camera))
        self._stack = np.concatenate([self._stack[1:], picture[None]])  # (4, 84, 84)
        return {"state": self._stack.copy(), "available": self.available.copy()}

    def render(self) -> np.ndarray | None:
        """The scene in colour, (336, 336, 3) uint8 (None without render_mode)."""
        if self.render_mode is None:
            return None
        if self._bullet is None:
            raise ResetNeeded("call reset() before the first render()")
        height = self.poses()[0][:, 2].max()
        caption = f"step {self._steps:2d} of {MAX_STEPS}   height {height:.2f}"
        return colour_picture(self._bullet, caption)

    def render_frames(self) -> list[np.ndarray]:
        """Colour pictures of the last reset or step, the fall included; [] without render_mode."""
        return [*self._frames, self.render()] if self.render_mode else []

    def close(self) -> None:
        self._bullet = None  # the simulation ends with it


gym.register(id="ActionGen/Stacking-v0", entry_point="stacking_env:StackingEnv")


def make_vec(
    num_envs: int,
    action_pool: Sequence[int] | None = None,
    num_available: int = NUM_AVAILABLE,
    seed: int = 0,
    **options: Any,
) -> gym.vector.VectorEnv:
    """`num_envs` environments in a process each, with independent streams; see StackingEnv.

    They restart in the step in which an episode ends (SAME_STEP). Processes, as a step of random
    play takes 8 ms. ValueError for what StackingEnv refuses.
    """
    one = functools.partial(StackingEnv, action_pool, num_available, **options)
    envs = AsyncVectorEnv([one] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    # seed + i would let neighbouring seeds share environments; a SeedSequence's words do not.
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs


# ---- A.4, B: action observations ----


def _views(shape_id: int, num_views: int, seed: int) -> np.ndarray:
    """Pictures of one shape from random viewpoints, (num_views, 84, 84) uint8."""
    bullet = Bullet()
    add_shape(bullet, shape_id, (0, 0, 0), COLOURS[shape_id])
    # A generator per shape and two numbers per view: the first n views are the same however many
    # are asked for, and whoever else is asked for. published code: 1,024 views, of which 32 differ.
    random = np.random.default_rng([seed, shape_id]).random((num_views, 2))
    out = np.empty((num_views, SIZE, SIZE), dtype=np.uint8)
    for picture, (turn, lift) in zip(out, random.tolist(), strict=True):
        turn *= 2 * math.pi
        height = VIEW_HEIGHT[0] + lift * (VIEW_HEIGHT[1] - VIEW_HEIGHT[0])
        eye = VIEW_RADIUS * math.cos(turn), VIEW_RADIUS * math.sin(turn), height
        picture[:] = grey(photograph(bullet, (eye, (0, 0, 0))))  # it looks at the shape's origin
    return out


def action_observations(
    action_ids: Sequence[int],
    num_observations: int = 1024,  # A.4
    modality: str = "image",
    seed: int = 0,
    workers: int = 1,
) -> np.ndarray:
    """Pictures of each shape, alone on black, from independent random viewpoints (A.4).

    Args:
        action_ids: (n,) distinct ids in 0..809.
        num_observations: views per shape; view k is the same for every number > k.
        modality: "image" is the only one.
        seed: one seed gives the same bytes, whatever `workers` and the other ids asked for.
        workers: processes.

    Returns:
        (n, num_observations, 84, 84) uint8. published code: in colour; ours: grey, as the states.

    Raises:
        ValueError: unknown or repeated ids, another modality, no observations or workers.
    """
    ids = check_ids(action_ids)
    if modality not in MODALITIES:
        raise ValueError(f"unknown modality {modality!r}; allowed: {', '.join(MODALITIES)}")
    if num_observations < 1 or workers < 1:
        raise ValueError(f"{num_observations} observations, {workers} workers: at least 1 each")
    out = np.empty((len(ids), num_observations, SIZE, SIZE), dtype=np.uint8)
    one = functools.partial(_views, num_views=num_observations, seed=seed)
    # a bar after 2 s, where somebody looks (None: only in a terminal)
    bar = {"desc": "action observations", "unit": "shape", "delay": 2, "disable": None}
    with multiprocessing.Pool(workers) if workers > 1 else nullcontext() as pool:
        results = (pool.imap if pool else map)(one, ids.tolist())
        for row, views in zip(out, tqdm(results, total=len(ids), **bar), strict=True):
            row[:] = views
    return out


# ---- pictures for people ----

COLOUR_SIZE = 336  # ours: two of the policy's pictures, each twice as large, are as high
COLOUR_CAMERA = (0.0, -12.0, 5.0), (0.0, 0.0, 3.2)  # ours: eye, target; up to a height of 7.2
PORTRAIT = (0.0, -3.0, 1.7), (0.0, 0.0, 0.4)  # ours: for one shape
COLOUR_FOV, SKY, INK = 38.0, (234, 242, 250), (60, 50, 40)  # ours: degrees, two colours
FRAME_EVERY = 20  # ours: simulation steps per picture; at 10 a second, twice as fast as real


def colour_picture(bullet: Bullet, caption: str, camera=COLOUR_CAMERA, size=COLOUR_SIZE):
    """The scene in colour, with a text in the corner, (size, size, 3) uint8."""
    # drawn at twice the size, then averaged: smooth edges
    image = Image.fromarray(photograph(bullet, camera, 2 * size, COLOUR_FOV, SKY)).reduce(2)
    ImageDraw.Draw(image).text((8, 5), caption, INK, ImageFont.load_default(size=14))
    return np.asarray(image)


def shape_sheet(size: int = 168) -> Image.Image:
    """All 16 families: smallest, middle and largest shape in colour, three views of the largest."""
    bullet, rows = Bullet(), []
    for family in FAMILIES:
        ids = [i for i, shape in enumerate(SHAPES) if shape.family is family]
        captions, cells = [f"{family.name}\n{len(ids)}, {family.label}", "", ""], []
        picked = ids[0], ids[len(ids) // 2 + family.angles // 3], ids[-1]
        for shape_id, caption in zip(picked, captions, strict=True):
            empty_world(bullet)
            z = -SHAPES[shape_id].scale * family.points[:, 2].min()
            add_shape(bullet, shape_id, (0, 0, z), COLOURS[shape_id])
            cells.append(colour_picture(bullet, caption, PORTRAIT, size))
        for view in _views(ids[-1], 3, 0):
            cells.append(np.asarray(Image.fromarray(view).convert("RGB").resize((size, size), 0)))
        rows.append(np.concatenate(cells, axis=1))  # (size, 6 size, 3)
    halves = [np.concatenate(half) for half in (rows[:8], rows[8:])]
    return Image.fromarray(np.concatenate(halves, axis=1))


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


# ---- a plan to compare with, and the command line ----

FLAT = ("horizontal_rectangle", "half_rectangle", "cube", "arch", "rectangle", "cylinder")


def greedy_plan(available: Sequence[int]) -> list[int]:
    """Order of positions in `available` for a flat tower, at most ten (ours; not in the appendix).

    The nine tallest shapes with flat top and bottom, widest first, then the tallest of the rest.
    All over one cylinder they reach a mean height of 5.0 to 5.4, depending on which scales are in
    the pool; random play reaches 1.5 to 1.6.
    """
    shapes = [SHAPES[shape_id] for shape_id in available]
    extents = np.array([s.scale * np.ptp(s.family.points, axis=0) for s in shapes])  # (K, 3)
    tallest = np.argsort(-extents[:, 2], kind="stable").tolist()
    flat = [slot for slot in tallest if shapes[slot].family.name in FLAT]
    base = sorted(flat[:9], key=lambda slot: -extents[slot, 0] * extents[slot, 1])
    rest = [slot for slot in tallest if slot not in flat]
    return (base + flat[9:] + rest)[:MAX_STEPS]


def play(env: StackingEnv, seed: int, policy: str = "greedy") -> tuple[float, list[np.ndarray]]:
    """One episode without stopping: the height, and the frames beside what the policy sees."""
    obs, _ = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    plan = greedy_plan(obs["available"])
    left = float(np.clip(env.poses()[0][0, 0], -1, 1))  # greedy: all over the left cylinder
    size, info, frames = PLACEMENTS[env.placement], {}, []
    for step in itertools.count():
        for frame in env.render_frames():
            # (4, 84, 84) -> (2 x 84, 2 x 84), the newest last, then each pixel as 2 x 2 in grey
            grid = obs["state"].reshape(2, 2, SIZE, SIZE).swapaxes(1, 2).reshape(2 * SIZE, 2 * SIZE)
            seen = grid.repeat(2, axis=0).repeat(2, axis=1)[..., None].repeat(3, axis=2)
            frames.append(np.concatenate([frame, seen], axis=1))
        if info:
            return info[METRIC], frames
        if policy == "greedy":
            choice, place = plan[step % len(plan)], np.array([left, 0.0])[:size]
        else:
            choice, place = rng.integers(env.num_available), rng.uniform(-1, 1, size)
        action = {"choice": choice, "stop": 0} | ({"position": place} if size else {})
        obs, *_, info = env.step(action)


@dataclass
class Args:
    """Build a planned and a random tower, draw the shapes, print a summary."""

    seed: int = 0  # of the split and of the episodes
    out: Path = Path("runs/demo")  # folder for the GIFs and the sheet
    split: Literal["default", "full"] = "default"  # how the shapes are divided (A.4, Table 2)
    pool: Literal["train", "valid", "test"] = "test"  # part of the split that is on offer
    num_available: int = NUM_AVAILABLE  # shapes on offer in an episode (Table 3)
    placement: Literal["none", "1d", "2d"] = "1d"  # where the agent may drop shapes (C.6)


def main(args: Args) -> None:
    """The script: see the top of the file."""
    parts, labels = split_actions(args.split, args.seed), action_labels()
    env = StackingEnv(parts[args.pool], args.num_available, "rgb_array", placement=args.placement)
    print(f"{NUM_ACTIONS} shapes; {args.split} split {args.seed}, {args.num_available} on offer:")
    print("".join(f"{name:>8}" for name in parts) + "  class")
    for label in np.unique(labels):
        print("".join(f"{(labels[ids] == label).sum():8}" for ids in parts.values()) + f"  {label}")
    for policy in ("greedy", "random"):
        height, frames = play(env, args.seed, policy)
        path = args.out / f"stacking_{policy}.gif"
        # the outcome stays for 1.5 s
        save_gif(path, frames + 15 * frames[-1:], env.metadata["render_fps"])
        print(f"{policy} tower of {args.pool} shapes: height {height:.2f}, wrote {path}")
    env.close()
    path = args.out / "stacking_shapes.png"
    shape_sheet().save(temporary := path.with_suffix(f".{os.getpid()}.tmp"), "PNG")
    temporary.replace(path)
    print(f"wrote {path}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from None
