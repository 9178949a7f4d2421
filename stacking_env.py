"""Shape Stacking: build the tallest tower from shapes never seen before (appendix A.4).

Two cylinders stand on a table. An action names one of 20 available shapes and the place above which
it is let go, and the physics (pybullet) decides what stays up. The score is the height of the
highest centre of mass (not top) when the agent stops or has acted ten times; the reward is Eq. 4's.
At test time the sizes (or classes) of the shapes were never used in training: the agent must
understand their pictures.

                       __
                      |__|     <- let go 0.02 above everything, at the x the agent chose
              ____________
             |____________|    z up, x to the right; the camera looks along y
                .-.   .-.
    ____________|_|___|_|____________  table, z = 0        1 unit = 1 m, angles in radians

    python stacking_env.py                # two towers as GIFs, all families as a picture (10 s)
    python stacking_env.py --split full   # the same with Table 2's unseen classes

Paper map (appendix -> here):
    A.4 Actions, the 810 shapes   FAMILIES, SHAPES; StackingEnv.step
    A.4 Split, Table 2            split_actions
    A.4 State                     photograph, StackingEnv._observe
    A.4 Action observations, B    action_observations
    A.4 Reward, Eq. 4             eq4_reward
    B, Fig. 6 (classes)           action_labels
    C.6, Fig. 13                  PLACEMENTS (No Place, 1D Place, 2D Place), split "full"
    Table 3 (20 actions, 10)      NUM_AVAILABLE, MAX_STEPS

[code], the authors' released implementation (with another physics engine, MuJoCo), is followed
where the appendix is silent; [here] is a choice of this repository, and replaces [code] where both
are named.
"""

import colorsys
import functools
import itertools
import math
import multiprocessing
import operator
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import tyro
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import Rotation
from tqdm import tqdm

try:
    import pybullet as p
except ModuleNotFoundError:
    sentence = (
        "Shape Stacking needs pybullet, which pip has ready-made for x86 Linux, Python 3.11; "
        "for others conda-forge has it: conda install -c conda-forge pybullet"
    )
    # The script ends with the sentence alone; hvae.py imports this file, and catches the exception.
    error = SystemExit if __name__ == "__main__" else ModuleNotFoundError
    raise error(sentence) from None

# Read by the other files. In each tuple the first entry is the default.
METRIC = "height"  # m above the table, of the highest centre of mass at the end of an episode
MODALITIES = ("image",)  # A.4: "images of the shape from various camera angles and heights"
SPLITS = ("default", "full")  # A.4
# C.6, Figure 13: how many coordinates of the place the agent decides. The default is 1D Place.
PLACEMENTS = {"none": 0, "1d": 1, "2d": 2}

# ---- rules of the game (A.4) ----
MAX_STEPS = 10  # Table 3 "max. episode length"; [code] counts repeats, A.4 only "placements"
NUM_AVAILABLE = 20  # Table 3, "actions per episode"
LAMBDA_TOP = 0.5  # Eq. 4
LAMBDA_AVG = 0.5  # Eq. 4
FRAMES = 4  # A.4: "stack past 4 frames"
SIZE = 84  # A.4: "84x84 grayscale image"
DROP_GAP = 0.02  # m [here]: A.4's "soft drop"; small beside shapes .16 to 1.92 m wide
# A scene starts with two copies of one of these, "at random locations on a line" (A.4), here x.
CYLINDERS = (798, 799, 800)  # [code]: ids in SHAPES, with radii of .33, .34 and .36 m
CENTRE = (-0.2, 0.2)  # m [code]: x of the middle between the two
AXIS_GAP = (1.0, 1.6)  # m [code]: from one axis to the other

# ---- physics: the appendix names only the 300 steps ----
SIM_STEPS = 300  # A.4: "acts every 300 physics simulator steps"
# [code] has one density, so the largest shape is 1000 times as heavy as the smallest; [here] every
# shape has mass 1 and the inertia of its form. Large ratios break Bullet's solver, which finds the
# forces of contacts step by step: five cubes, each larger than the one below, would fall in 3 s.
MASS = 1.0
# Friction between two bodies: [code] has 2 (sliding), 2 (spinning about the contact normal) and .25
# (rolling), which is close to glue; [here] 1, .1 and .05, because spheres then come to rest, but
# the class of a shape still decides what can stand on it. CONTACT holds the values of one body.
# Bullet makes those of a pair: 1 x 1, .05 + .05 and .025 + .025. [code] Nothing bounces.
CONTACT = dict(lateralFriction=1.0, spinningFriction=0.05, rollingFriction=0.025, restitution=0)
# A.4 always simulates 300 steps; [here] only until all is at rest. This saves time, and it changes
# the task: in the steps that are left out, small errors of the solver would shear a tower apart
# that already stands. The scripted `greedy_plan` (below) builds 5.3 m on average this way, 4.7 with
# all 300 steps; random play is as high either way. At rest means: at two checks in a row, five
# steps apart, every velocity is below REST_SPEED, and no two bodies overlap by REST_DEPTH or more.
CHECK_EVERY = 5  # simulation steps
CHECKS_IN_A_ROW = 2
REST_SPEED = 0.05  # m/s, and rad/s for angular velocities; of each component
REST_DEPTH = 0.01  # m; an eighth of the thinnest shape

# ---- pictures ----
# A camera is a pair (eye, target), m. The two of the state are those of [code], but on the side
# y < 0, so that +x is on the right. FRONT shows heights up to 5.4, RAISED up to 3.9: the policy
# does not see the top of a higher tower.
FRONT = ((0.0, -7.0, 2.5), (0.0, 0.0, 2.5))
RAISED = ((0.0, -4.0, 5.5), (0.0, 1.66, 0.0))  # for 2D Place, where depth matters
# Action observations are taken from a circle, at random heights [code]. 38 shapes fill more
# than the picture.
VIEW_RADIUS = 2.0  # m
VIEW_HEIGHT = (0.5, 2.0)  # m
# [here] The light comes from over the photographer's right shoulder: (right, up, back), of length
# 1. It moves with the camera, so the faces of a shape differ in brightness from every viewpoint.
LIGHT = (0.24, 0.52, 0.82)
TABLE = (4.0, 2.0, 0.1)  # half sizes, m; [code] draws 8 x 4, the thickness is [here]
WOOD = (0.82, 0.66, 0.45)  # [here] the lit table is 119 of 255 in grey (2D Place: 167)
# For people, all [here]: the colour pictures of `render`, and of GIFs while a shape falls.
COLOUR_SIZE = 336  # pixels
COLOUR_CAMERA = ((0.0, -12.8, 5.7), (0.0, 0.0, 4.35))  # up to a height of 9.5
FRAME_EVERY = 20  # simulation steps from picture to picture: .2 s, which a GIF shows in .1 s


# ---- A.4: the 810 shapes ----
def prism(*polygon: tuple) -> np.ndarray:
    """Corners (2n, 3) of a polygon (n, 2) in x, z that is drawn out along y from -1 to 1."""
    return np.array([(x, y, z) for y in (-1, 1) for x, z in polygon], dtype=float)


def box(x: float, y: float, z: float) -> np.ndarray:
    """The eight corners (8, 3) of a box with these half sizes."""
    return np.array(list(itertools.product((-x, x), (-y, y), (-z, z))))


def ring(count: int, z: float, radius: float = 1.0) -> np.ndarray:
    """`count` points (count, 3) evenly on a circle around the z axis, at the height z."""
    angles = np.linspace(0, 2 * math.pi, count, endpoint=False)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, z)], axis=1)


@dataclass(eq=False)  # compared by identity, so that functools.cache takes it as a key
class Family:
    """Shapes that differ in scale and in the angle about the vertical; all combinations occur.

    A class of A.4 consists of one or more of these families; families are [code]'s unit. What
    collides is, by `bullet_type`: the convex hull of `points` (MESH), boxes of eight points each,
    or a sphere, capsule or cylinder, which Bullet computes exactly; there `points` only sample
    the surface, for drawing, `top` and `_drop`.
    """

    name: str  # [code]
    points: np.ndarray  # (V, 3) at scale 1, measured from the origin, the point that is placed
    scales: tuple  # (smallest, largest, how many); sizes are these times SCALE_FACTOR
    num_angles: int = 1
    turn: float = 0  # degrees: `num_angles` equally spaced angles in [0, turn)
    label: str = ""  # its class in Table 2, where that is not the name
    bullet_type: int = p.GEOM_MESH
    moments: tuple = ()  # of inertia about x, y, z, scale 1, mass 1; () for flat sides
    same_as: str = ""  # the family whose body it is, laid on another face, or a plain copy

    def parts(self) -> np.ndarray:
        """The convex parts (P, V, 3): one, but three for the arch."""
        boxes = self.bullet_type == p.GEOM_BOX
        return self.points.reshape(-1, 8, 3) if boxes else self.points[None]


# [code] A dome is half a cylinder that lies: half a circle in x and z, its flat side at z = -.5.
HALF_CIRCLE = [(math.cos(a), math.sin(a) - 0.5) for a in np.linspace(0, math.pi, 13)]
# A hat is `triangle`'s prism on its longest side, its ridge along x. y and z are scaled by sqrt 2,
# so that its short sides are 2 long, as those of `triangle`: one solid.
HAT = prism((-1, 0), (1, 0), (0, 1))[:, [1, 0, 2]] * (1, math.sqrt(2), math.sqrt(2))
CONE = np.vstack([ring(20, -1), (0, 0, 1)])
# [code] draws a round tunnel through a block, but lets the full block collide; [here] the tunnel is
# real, two legs and a lintel, so that the picture shows what collides.
LEG = box(0.375, 1, 1)
LINTEL = box(1.25, 1, 0.375) + (0, 0, 0.625)
ARCH = np.vstack([LEG - (1.625, 0, 0), LEG + (1.625, 0, 0), LINTEL])
PYRAMID = np.vstack([box(1, 1, 1)[::2], (0, 0, 1)])  # the lower four corners of a cube, a top
# Points all over a sphere: its poles, and a ring every 15 degrees between them.
RINGS = [ring(24, math.cos(a), math.sin(a)) for a in np.linspace(0, math.pi, 13)[1:-1]]
BALL = np.vstack([(0, 0, 1), (0, 0, -1), *RINGS])
CAPSULE = np.vstack([BALL + (0, 0, 1), BALL - (0, 0, 1)])
CYLINDER = np.vstack([ring(32, 1), ring(32, -1)])

# A.4: "varying the scale and vertical orientation in each shape class". The scales and angles are
# those of [code], except for `rectangle`: its footprint is a square, so [code]'s six angles in half
# a turn show every shape twice; [here] they divide a quarter turn, because A.4 wants the shapes
# different. Cube and pyramid repeat after 90 degrees, of which [code] uses only the first 45; kept.
# [code] has two cone meshes; here one, twice, for the count of 810. Table 2 has two classes more
# than A.4, angled-triangle and angled-rectangle, and does not say what they are. In [code] they are
# the families `middle_triangle`, `hat` and `horizontal_rectangle`, unseen in its Full Split.
# The moments of a capsule: its tube (3/5 of the mass) and half a ball at each end.
FAMILIES = (
    Family("middle_triangle", points=prism((-1, -1), (1, -1), (0, 1)),
           scales=(0.1, 0.5, 6), num_angles=10, turn=180, label="angled-triangle"),
    Family("hat", points=HAT, same_as="triangle",
           scales=(0.1, 0.5, 6), num_angles=10, turn=180, label="angled-triangle"),
    Family("triangle", points=prism((-1, -1), (1, -1), (-1, 1)),
           scales=(0.1, 0.5, 6), num_angles=10, turn=360),
    Family("tall_triangle", points=prism((-1, -2), (1, -2), (-1, 2)),
           scales=(0.1, 0.3, 6), num_angles=10, turn=360, label="triangle"),
    Family("horizontal_rectangle", points=box(2, 1, 1), bullet_type=p.GEOM_BOX, same_as="rectangle",
           scales=(0.1, 0.5, 6), num_angles=10, turn=180, label="angled-rectangle"),
    Family("dome", points=prism(*HALF_CIRCLE),
           scales=(0.2, 0.6, 6), num_angles=10, turn=180),
    Family("cone-hires", points=CONE, same_as="cone", scales=(0.1, 0.6, 30), label="cone"),
    Family("cone", points=CONE, scales=(0.1, 0.6, 30)),
    Family("tetrahedron", points=PYRAMID,  # [code] calls it that; it is a pyramid on a square
           scales=(0.1, 0.6, 10), num_angles=6, turn=45),
    Family("arch", points=ARCH, bullet_type=p.GEOM_BOX,
           scales=(0.1, 0.5, 6), num_angles=10, turn=180),
    Family("rectangle", points=box(1, 1, 2), bullet_type=p.GEOM_BOX,
           scales=(0.1, 0.3, 10), num_angles=6, turn=90),
    Family("half_rectangle", points=box(2, 1, 0.5), bullet_type=p.GEOM_BOX,
           scales=(0.1, 0.6, 10), num_angles=6, turn=180, label="rectangle"),
    Family("cube", points=box(1, 1, 1), bullet_type=p.GEOM_BOX,
           scales=(0.1, 0.6, 10), num_angles=6, turn=45),
    Family("sphere", points=BALL, bullet_type=p.GEOM_SPHERE, moments=(0.4, 0.4, 0.4),
           scales=(0.1, 0.8, 30)),
    Family("capsule", points=CAPSULE, bullet_type=p.GEOM_CAPSULE, moments=(1.21, 1.21, 0.46),
           scales=(0.1, 0.4, 30)),
    Family("cylinder", points=CYLINDER, bullet_type=p.GEOM_CYLINDER,
           moments=(7 / 12, 7 / 12, 1 / 2), scales=(0.1, 0.6, 30)),
)  # fmt: skip
SCALE_FACTOR = 0.8  # [code] multiplies every scale by .8
TABLE_2_TRAIN = ("dome", "rectangle", "capsule", "triangle", "arch", "sphere")  # Table 2, row 1


class Shape(NamedTuple):
    """One of the 810 actions."""

    family: Family
    scale: float  # m
    angle: float  # about the vertical, radians; pictures do not tell it, see `_views`

    def solid_key(self) -> tuple:
        """(name, scale), equal for two shapes that are one solid, on whatever face they lie."""
        return self.family.same_as or self.family.name, self.scale


SHAPES = [  # in the order of the ids: by family, then by scale, then by angle
    Shape(family, scale, k * (math.radians(family.turn) / family.num_angles))
    for family in FAMILIES
    for scale in (SCALE_FACTOR * np.linspace(*family.scales)).tolist()
    for k in range(family.num_angles)
]
NUM_ACTIONS = len(SHAPES)  # A.4: 810


def random_colour(rng: np.random.Generator) -> tuple:
    """Red, green, blue in [0, 1]; A.4: cylinders of "random heights and colors"."""
    # [code] has saturation and value of .5 to 1; [here] lighter, because the background is black.
    return colorsys.hsv_to_rgb(*rng.uniform((0.0, 0.35, 0.65), (1.0, 0.75, 1.0)))


_rng = np.random.default_rng(42)  # [code] every shape has one colour for ever, from this seed
COLOURS = [random_colour(_rng) for _ in SHAPES]


@functools.cache
def mass_properties(family: Family) -> tuple:
    """Centre of mass (3,), principal axes (a Rotation), moments (3,); for scale 1, mass 1."""
    if family.moments:
        return np.zeros(3), Rotation.identity(), np.array(family.moments)
    # A solid with flat sides is cut into tetrahedra, whose volumes and centres are known.
    tetrahedra = np.vstack([part[Delaunay(part).simplices] for part in family.parts()])  # (T, 4, 3)
    volumes = np.abs(np.linalg.det(tetrahedra[:, 1:] - tetrahedra[:, :1])) / 6  # (T,)
    shares = volumes / volumes.sum()
    com = shares @ tetrahedra.mean(axis=1)  # (T,) @ (T, 3) -> (3,)
    # The inertia matrix is trace(m) I - m, where m is the mean of x x^T over the solid, x counted
    # from the centre of mass. A point of a tetrahedron is a weighted mean of the corners v. For
    # uniform points a squared weight has the mean 2/20, the product of two weights 1/20 (moments of
    # Dirichlet(1, 1, 1, 1)), so x x^T has the mean (sum of v v^T + (sum of v) (sum of v)^T) / 20.
    corners = tetrahedra - com
    total = corners.sum(axis=1)  # (T, 3)
    m = np.einsum("t,tvi,tvj->ij", shares, corners, corners)
    m = (m + np.einsum("t,ti,tj->ij", shares, total, total)) / 20
    inertia = np.trace(m) * np.eye(3) - m  # (3, 3)
    # Bullet wants the principal axes, in which this matrix is diagonal. They are the shape's x, y
    # and z, except for `triangle` and `tall_triangle`. The Rotation that is returned leads from
    # the body's frame, which lies along the principal axes, to the shape's own.
    diagonal = np.diag(inertia)
    if np.allclose(inertia, np.diag(diagonal), atol=1e-9):
        return com, Rotation.identity(), diagonal
    principal, axes = np.linalg.eigh(inertia)
    axes *= np.linalg.det(axes)  # det is +-1; in 3-D, flipping all three axes makes it +1
    return com, Rotation.from_matrix(axes), principal


# ---- A.4: ids, labels, features, split ----
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


def action_labels() -> np.ndarray:
    """Class of every shape (NUM_ACTIONS,) str, by Table 2's names; what Figure 6 colours by."""
    return np.array([shape.family.label or shape.family.name for shape in SHAPES])


def engineered_representations() -> np.ndarray:
    """Ground truth, to compare with: scale, sin, cos of angle, one-hot family; (810, 19)."""
    # [code] gives the angle itself (and an axis, always vertical); [here] a point on the circle, so
    # that 350 degrees is close to 0. Angles stop before the form repeats, so no form appears twice
    # within a family. Known flaw, as in [code]: a box repeats after 180 degrees, so at 162 it looks
    # much like at 0, but their rows are far apart.
    table = np.zeros((NUM_ACTIONS, 3 + len(FAMILIES)), dtype=np.float32)
    for row, shape in zip(table, SHAPES, strict=True):
        row[:3] = (shape.scale, math.sin(shape.angle), math.cos(shape.angle))
        row[3 + FAMILIES.index(shape.family)] = 1
    return table


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Train, validation and test ids, about 2:1:1 (A.4).

    "default" draws half of the scales of every family for training, "full" trains on the classes of
    Table 2's first row; `seed` is that of the draw and of the halving of the rest. Returns sorted,
    disjoint int64 arrays {"train", "valid", "test"}: 405 / 202 / 203 ids by default, 420 / 195 /
    195 for "full". ValueError for another name of a split.
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; allowed: {', '.join(SPLITS)}")
    rng = np.random.default_rng(seed)

    # Default Split (A.4): scale "is randomly split", so a test shape differs in size from every
    # training shape of its family; all angles of a scale stay together. (A.4: of its class,
    # but some classes have two families.) [code] draws per family; [here] per solid (form and
    # size): one draw holds for every family that has it, or one cone would train and its copy be
    # tested. Family by family, what is decided stays, and solids are drawn until half of the
    # family's are in training. `cone-hires` draws half of its solids; then all of `cone`'s are
    # decided; `rectangle` shares one with `horizontal_rectangle`.
    decided = set()
    train_solids = set()
    for family in FAMILIES:
        own = [shape.solid_key() for shape in SHAPES if shape.family is family]
        solids = list(dict.fromkeys(own))  # each once
        undecided = [solid for solid in solids if solid not in decided]
        # In training already: half of them, one, or none, so `missing` is never negative.
        missing = len(solids) // 2 - len(train_solids.intersection(solids))
        order = rng.permutation(len(undecided))
        train_solids.update(undecided[k] for k in order[:missing])
        decided.update(solids)
    train = np.array([shape.solid_key() in train_solids for shape in SHAPES])

    # Full Split (Table 2): the class alone decides. The draw above is thrown away here, but still
    # made: it advances `rng`; without it the halves would differ from those of saved results. One
    # solid can be on both sides: a `hat` is a `triangle` on another face.
    if split == "full":
        train = np.isin(action_labels(), TABLE_2_TRAIN)

    # A.4: "randomly splitting the test set into half". A solid at one angle is a group, so that the
    # two cones, copies, are on one side (some hats and triangles are, too: no harm). Groups in
    # random order go to validation where they still fit into its half, else to the test.
    unseen = np.flatnonzero(~train).tolist()
    copies = {}  # (solid, angle) -> ids
    for shape_id in unseen:
        shape = SHAPES[shape_id]
        copies.setdefault((shape.solid_key(), shape.angle), []).append(shape_id)
    groups = list(copies.values())
    valid = []
    for k in rng.permutation(len(groups)):
        if len(valid) + len(groups[k]) <= len(unseen) // 2:
            valid += groups[k]
    test = np.setdiff1d(unseen, valid)
    return {"train": np.flatnonzero(train), "valid": np.sort(valid), "test": test}


# ---- what Bullet simulates and draws ----
class Bullet:
    """One simulation: pybullet's functions, with the simulation's number already filled in."""

    # (pybullet_utils.bullet_client has one, too, but it prints a line per simulation.)
    def __init__(self) -> None:
        self.client = p.connect(p.DIRECT)  # without a window
        weakref.finalize(self, p.disconnect, self.client)  # when nobody holds `self` any more

    def __getattr__(self, name: str) -> Any:
        # Python calls this for a name that the object lacks, for example `stepSimulation`.
        return functools.partial(getattr(p, name), physicsClientId=self.client)


@functools.cache
def geometry(family: Family) -> tuple:
    """What Bullet gets of a family, at scale 1: its V corners, and T triangles for the pictures."""
    # pybullet never releases its reference to a list of vertices. The same list again costs
    # nothing, but new lists would leak 200 kB and more per episode. So the lists of a family are
    # made once, and `meshScale` gives the size.
    vertices = []
    normals = []
    for part in family.parts():
        hull = ConvexHull(part)
        faces = part[hull.simplices]  # (T, 3 corners, 3)
        # The renderer shows a triangle only from the side on which its corners go round
        # counterclockwise. This must be the outside: if the determinant is negative, turn it over.
        clockwise = np.linalg.det(faces - part.mean(axis=0)) < 0  # (T,)
        faces[clockwise] = faces[clockwise][:, [0, 2, 1]]
        vertices += faces.reshape(-1, 3).tolist()  # (3 T, 3)
        # All corners of a triangle have the normal of its plane, for an even brightness.
        normals += hull.equations[:, :3].repeat(3, axis=0).tolist()  # (3 T, 3)
    triangles = dict(vertices=vertices, normals=normals, indices=list(range(len(vertices))))
    return family.points.tolist(), triangles


def add_shape(bullet: Bullet, shape_id: int, origin: tuple, rgb: tuple) -> int:
    """Put an upright shape's origin at a place in the world; returns the body's Bullet number."""
    family, scale, angle = SHAPES[shape_id]
    corners, triangles = geometry(family)
    size = [scale] * 3

    # What collides. Of a hull Bullet gets the corners only, because a mesh of triangles would be an
    # empty shell to it and fall through the table.
    if family.bullet_type == p.GEOM_BOX:
        parts = scale * family.parts()  # (P, 8, 3)
        collision = bullet.createCollisionShapeArray(
            [p.GEOM_BOX] * len(parts),
            halfExtents=(np.ptp(parts, axis=1) / 2).tolist(),
            collisionFramePositions=parts.mean(axis=1).tolist(),
        )
    elif family.bullet_type == p.GEOM_MESH:
        collision = bullet.createCollisionShape(p.GEOM_MESH, vertices=corners, meshScale=size)
    else:  # height: of the straight part; a sphere has none
        collision = bullet.createCollisionShape(family.bullet_type, radius=scale, height=2 * scale)

    # What is drawn, and the body itself. Bullet later tells the pose of the body's frame (centre of
    # mass, principal axes); `origin` and `angle` are of the shape's own frame.
    rgba = (*rgb, 1)
    visual = bullet.createVisualShape(p.GEOM_MESH, **triangles, meshScale=size, rgbaColor=rgba)
    com, axes, moments = mass_properties(family)
    body = bullet.createMultiBody(
        MASS, collision, visual, origin, p.getQuaternionFromEuler((0, 0, angle)),
        baseInertialFramePosition=(scale * com).tolist(),
        baseInertialFrameOrientation=axes.as_quat().tolist(),  # x, y, z, w
        useMaximalCoordinates=1,  # a body without joints: 1.4 times faster than a "multibody"
    )  # fmt: skip

    # Bullet would take the inertia of the bounding box. With our inertia the mass must be repeated,
    # or it becomes 0 and the pose NaN. -1 is the body itself (no joint). [code] Nothing is damped.
    inertia = (MASS * scale**2 * moments).tolist()
    bullet.changeDynamics(
        body, -1, mass=MASS, localInertiaDiagonal=inertia, **CONTACT,
        linearDamping=0, angularDamping=0,
    )  # fmt: skip
    return body


def empty_world(bullet: Bullet) -> None:
    """A table and nothing on it; for each episode anew, so that none leaves traces."""
    bullet.resetSimulation()
    bullet.setGravity(0, 0, -9.81)  # m/s^2
    # In every step Bullet finds the contact forces by iteration, until they change by less than the
    # residual. [here] At most 50 iterations: with 20, tall towers creep and fall. A residual of
    # 1e-5 in place of Bullet's 1e-7 saves 5 % of the time.
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=0.01,  # s [code]
        numSolverIterations=50,
        solverResidualThreshold=1e-5,
        deterministicOverlappingPairs=1,  # one seed gives one tower, bit for bit
    )
    # [code] has invisible walls at the left and at the back, which 1 % of the shapes would reach;
    # [here] there are none. The floor has no end, though a board of finite size is drawn.
    plane = bullet.createCollisionShape(p.GEOM_PLANE)
    board = bullet.createVisualShape(
        p.GEOM_BOX, halfExtents=TABLE, rgbaColor=(*WOOD, 1), visualFramePosition=(0, 0, -TABLE[2])
    )
    floor = bullet.createMultiBody(0, plane, board, useMaximalCoordinates=1)  # mass 0: it is fixed
    bullet.changeDynamics(floor, -1, **CONTACT)


def photograph(bullet: Bullet, camera: tuple, size: int = SIZE, sky=(0, 0, 0)) -> np.ndarray:
    """The picture of a camera (eye, target), (size, size, 3) uint8; `sky` where nothing is."""
    view = p.computeViewMatrix(*camera, (0, 0, 1))
    lens = p.computeProjectionMatrixFOV(45, 1, 0.1, 40)  # degrees [code]; square; .1 to 40 m away
    axes = np.reshape(view, (4, 4))[:3, :3]  # columns: right, up, back in the world
    _, _, rgba, _, owner = bullet.getCameraImage(
        size, size, view, lens, renderer=p.ER_TINY_RENDERER,
        lightDirection=(axes @ LIGHT).tolist(),
        lightAmbientCoeff=0.35,  # [here] a face in the shade keeps a third of its colour
        lightDiffuseCoeff=0.65, lightSpecularCoeff=0, shadow=0,
    )  # fmt: skip
    # owner (size, size): the number of the body that is seen, -1 where there is none
    return np.where(owner[:, :, None] < 0, np.uint8(sky), rgba[:, :, :3])


def grey(rgb: np.ndarray) -> np.ndarray:
    """Luminance of a picture (H, W, 3), (H, W) uint8."""
    return (rgb @ (0.299, 0.587, 0.114)).astype(np.uint8)  # [code]


# ---- A.4: the environment ----
def eq4_reward(heights: np.ndarray) -> float:
    """Eq. 4 at the end of an episode, from the heights h_i (of centres of mass) of all N shapes."""
    # [code] has the mean only of shapes with an origin above .5 m, and subtracts .5 m from each;
    # [here] all N shapes in the scene count, as A.4 says, so the two cylinders as well.
    return float(LAMBDA_TOP * heights.max() + LAMBDA_AVG * heights.mean())


class StackingEnv(gym.Env):
    """Build a tower from the available shapes (appendix A.4).

    ## Description
    Two equal cylinders in random colours, .66, .68 or .71 m high, stand at random places on a line.
    Each action drops one shape, from above the highest point of the scene, at the place the agent
    names; the simulation runs until all is at rest, at most 300 steps of .01 s.

    ## Action Space
    | key of the `Dict` | space | meaning |
    |---|---|---|
    | choice | `Discrete(K)` | index into `available`: the shape to drop |
    | position | `Box(-1, 1, (d,))` | where, in m: x (1d), x and y (2d); no such key for "none" |
    | stop | `Discrete(2)` | 1: end the episode now, nothing is placed |

    A shape that has been placed cannot be placed again: choosing it only uses up the step. A place
    outside of [-1, 1] does the same. ValueError, before anything moves, for a missing key, a choice
    or stop out of range, and a position of another length or that is not finite.

    ## Observation Space
    `Dict`: state `Box(0, 255, (4, 84, 84), uint8)`, the last four grayscale pictures, newest last,
    zeros before the episode began; available `Box(0, 809, (K,), int64)`, the ids of the available
    shapes, redrawn at every reset (where K is the whole pool: always the pool, in order).

    ## Rewards
    Eq. 4 on the last step, else 0: half the height of the highest shape plus half the mean height
    of all shapes, the cylinders included. Heights, in m, are of centres of mass above the table.

    ## Episode End
    1. Termination: the stop action. 2. Truncation: the tenth action, repeats included; an end like
    the other, with the reward. The last step's info has `height`, that of the highest shape.
    `action_space.sample()` stops with probability 1/2 at each step; a policy that never stops:

    >>> env = StackingEnv()
    >>> obs, info = env.reset(seed=0)
    >>> while "height" not in info:
    ...     obs, reward, _, _, info = env.step({**env.action_space.sample(), "stop": 0})

    ## Arguments
    action_pool: ids to draw from (default: the training split); num_available: K; render_mode: None
    or "rgb_array"; placement: "none" (always over the centre), "1d" or "2d" (C.6); early_stop:
    False runs the full 300 steps after each drop, as A.4 has it. ValueError for bad arguments.
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
        if action_pool is None:
            action_pool = split_actions()["train"]
        self.action_pool = check_ids(action_pool, num_available)
        self.num_available = num_available
        self.render_mode = render_mode
        self.placement = placement
        self.early_stop = early_stop
        self.observation_space = spaces.Dict(
            state=spaces.Box(0, 255, (FRAMES, SIZE, SIZE), np.uint8),
            available=spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
        )
        parts = {"choice": spaces.Discrete(num_available), "stop": spaces.Discrete(2)}
        if PLACEMENTS[placement] > 0:
            parts["position"] = spaces.Box(-1, 1, (PLACEMENTS[placement],), np.float32)
        self.action_space = spaces.Dict(parts)
        self._bullet = None  # the first reset makes the simulation; the spaces need none
        self._over = True  # nothing to step yet
        self._frames = []  # colour pictures of the last reset or step

    def __reduce__(self) -> None:
        # Python asks here how to copy the object. A copy would share our simulation: the two would
        # play in one world, and the first to end would end it for both.
        raise TypeError("a StackingEnv holds a running simulation: make a new one, do not copy it")

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Draw the available shapes, drop the two cylinders; returns (observation, {})."""
        if seed is not None:
            seed = operator.index(seed)  # gymnasium takes no integers of numpy
        super().reset(seed=seed)
        rng = self.np_random

        # The paper's subsampling: a new random subset of the pool is available in every episode.
        self.available = self.action_pool
        if self.num_available < len(self.action_pool):
            self.available = rng.choice(self.action_pool, self.num_available, replace=False)

        if self._bullet is None:
            self._bullet = Bullet()
        empty_world(self._bullet)  # the table
        self._bodies = []  # Bullet's numbers
        self.shape_ids = []  # ids of the shapes in the scene, the two cylinders first
        self._steps = 0
        self._over = False
        self._frames = []
        self._stack = np.zeros((FRAMES, SIZE, SIZE), dtype=np.uint8)  # black before the first one

        # Two cylinders fall on the table. A.4: "of random heights"; [code], and so [here]: one
        # height for both. They stand apart, so both start from the table, with top 0.
        cylinder = rng.choice(CYLINDERS)
        centre = rng.uniform(*CENTRE)
        gap = rng.uniform(*AXIS_GAP)
        for x in (centre - gap / 2, centre + gap / 2):
            self._drop(cylinder, x, 0.0, 0.0, random_colour(rng))
        self._settle()
        return self._observe(), {}

    def step(self, action: dict) -> tuple[dict, float, bool, bool, dict]:
        """One action; see the class for what it must be. After the end: ResetNeeded."""
        if self._over:
            raise gym.error.ResetNeeded("no episode is running: call reset() before step()")

        # Read the action. What is wrong with it, a missing key too, is said before anything moves.
        choice = operator.index(action.get("choice", -1))
        stop = operator.index(action.get("stop", -1))
        position = np.asarray(action.get("position", ()), dtype=float)  # (d,)
        known = 0 <= choice < self.num_available and stop in (0, 1)
        complete = position.shape == (PLACEMENTS[self.placement],) and np.isfinite(position).all()
        if not known or not complete:
            raise ValueError(f"{action} is outside of {self.action_space}")
        self._steps += 1
        self._frames = []

        # A.4: "If a shape has already been placed, trying to place it again does nothing." The
        # starting cylinders may have the id of an available shape, which can still be placed.
        # [here] A place beyond [-1, 1] also does nothing: clipped, it would be one that the policy
        # did not choose. (D.3.2's Beta policy stays within; a Gaussian one may not.)
        shape_id = self.available[choice]
        inside = (np.abs(position) <= 1).all()

        # Drop the shape and wait until the scene has settled. ([code] also waits when nothing was
        # dropped; [here] not.) What still moves is halted first [code]: no measurable difference.
        # Coordinates that the agent does not decide are 0, the table's centre (C.6).
        if inside and shape_id not in self.shape_ids[2:] and not stop:
            for body in self._bodies:
                self._bullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))
            place = np.zeros(2)  # x, y
            place[: len(position)] = position
            self._drop(shape_id, *place.tolist(), self.top(), COLOURS[shape_id])
            self._settle()

        # The episode ends where the agent says so, and after ten actions. [here] the limit is
        # `truncated`, gymnasium's word for an end that only a clock makes. Learning ignores
        # the difference: [code] and ppo_actiongen.py bootstrap after neither.
        terminated = bool(stop)
        truncated = not terminated and self._steps >= MAX_STEPS
        self._over = terminated or truncated

        # Pay only at the end (Eq. 4: "1_Done"). A.4 leaves open what the height of a shape is: in
        # [code] that of its origin (the middle of a cube, but the bottom of a hat); [here] that of
        # its centre of mass, which means the same for every family.
        reward = 0.0
        info = {}
        if self._over:
            positions, _ = self.poses()
            heights = positions[:, 2]
            reward = eq4_reward(heights)
            info[METRIC] = float(heights.max())
        return self._observe(), reward, terminated, truncated, info

    def _drop(self, shape_id: int, x: float, y: float, top: float, rgb: tuple) -> None:
        """Let a shape go with its origin over (x, y) and its lowest point just above `top`."""
        # A.4: "calculated over the topmost shape, enabling a soft drop". [code] adds the radii of
        # bounding spheres, and a flat slab falls by a metre; [here] see `top`.
        family, scale, _ = SHAPES[shape_id]
        z = top + DROP_GAP - scale * family.points[:, 2].min()
        self._bodies.append(add_shape(self._bullet, shape_id, (x, y, z), rgb))
        self.shape_ids.append(shape_id)

    def _settle(self) -> None:
        """Simulate until all is at rest, at most 300 steps; see CHECK_EVERY for the reasons."""
        at_rest = 0  # checks in a row at which all was at rest
        for sim_step in range(1, SIM_STEPS + 1):
            if self.render_mode and sim_step % FRAME_EVERY == 1:
                self._frames.append(self.render())
            self._bullet.stepSimulation()
            if self.early_stop and sim_step % CHECK_EVERY == 0:
                at_rest = at_rest + 1 if self._at_rest() else 0
                if at_rest == CHECKS_IN_A_ROW:
                    break

    def _at_rest(self) -> bool:
        """Is every velocity and angular velocity below REST_SPEED, and nothing inside another?"""
        for body in reversed(self._bodies):  # the newest moves most
            linear, angular = self._bullet.getBaseVelocity(body)
            if max(map(abs, linear + angular)) >= REST_SPEED:  # two tuples in a row: six numbers
                return False
        # A thin shape can enter the table when it hits it. Bullet pushes it out too slowly to count
        # as moving. contact[8] is the distance of the two bodies, below 0 if they overlap.
        contacts = self._bullet.getContactPoints()
        return all(contact[8] > -REST_DEPTH for contact in contacts)

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres of mass (n, 3), rotations body -> world (n, 3, 3), ordered as `shape_ids`."""
        poses = map(self._bullet.getBasePositionAndOrientation, self._bodies)
        centres, quaternions = zip(*poses, strict=True)
        rotations = list(map(p.getMatrixFromQuaternion, quaternions))  # (n, 9)
        return np.array(centres), np.reshape(rotations, (-1, 3, 3))

    def top(self) -> float:
        """Height of the highest point; of what is round, to about .01 m (less than DROP_GAP)."""
        highest = 0.0
        for shape_id, centre, rotation in zip(self.shape_ids, *self.poses(), strict=True):
            # Turn the world's "up" into the shape's own frame, where `points` are given. World ->
            # body is the transpose of `rotation`, and its product with (0, 0, 1) the last row of
            # `rotation`. Body -> shape is `axes`. How far do the points reach that way?
            family, scale, _ = SHAPES[shape_id]
            com, axes, _ = mass_properties(family)
            up = axes.apply(rotation[2])  # (3,)
            reach = scale * ((family.points - com) @ up).max()  # (V, 3) @ (3,) -> (V,) -> ()
            highest = max(highest, centre[2] + reach)
        return highest

    def _observe(self) -> dict:
        """A.4 State: push a picture onto the stack of four, an equal one if nothing was placed."""
        camera = RAISED if self.placement == "2d" else FRONT
        picture = grey(photograph(self._bullet, camera))
        self._stack = np.concatenate([self._stack[1:], picture[None]])  # (4, 84, 84)
        return {"state": self._stack.copy(), "available": self.available.copy()}

    def render(self) -> np.ndarray | None:
        """The scene for people, (336, 336, 3) uint8 (None without render_mode)."""
        if self.render_mode is None:
            return None
        if self._bullet is None:
            raise gym.error.ResetNeeded("nothing to draw yet: call reset() before render()")
        # It is drawn at twice the size and averaged: this makes the edges smooth.
        scene = photograph(self._bullet, COLOUR_CAMERA, 2 * COLOUR_SIZE, sky=(234, 242, 250))
        image = Image.fromarray(scene).reduce(2)
        positions, _ = self.poses()
        caption = f"step {self._steps} of {MAX_STEPS}\nheight {positions[:, 2].max():.2f}"
        ImageDraw.Draw(image).text((8, 5), caption, "black", ImageFont.load_default(size=14))
        # In the corner: the newest picture that the policy has got.
        image.paste(Image.fromarray(self._stack[-1]), (COLOUR_SIZE - SIZE, 0))
        return np.asarray(image)

    def render_frames(self) -> list:
        """Colour pictures of the last reset or step, the fall included; [] without render_mode."""
        return [*self._frames, self.render()] if self.render_mode else []

    def close(self) -> None:
        self._bullet = None  # the simulation ends with it
        self._over = True  # until the next reset


gym.register(id="ActionGen/Stacking-v0", entry_point="stacking_env:StackingEnv")


def make_vec(
    num_envs: int,
    action_pool: Sequence[int] | None = None,
    num_available: int = NUM_AVAILABLE,
    seed: int = 0,
    **options: Any,
) -> gym.vector.VectorEnv:
    """`num_envs` environments, each in its own process, with its own seed; see StackingEnv."""
    # Processes, because the physics of a step takes 8 ms. SAME_STEP, because then no step is lost
    # between two episodes; what the ended one said last is in `final_obs` and `final_info`.
    make = functools.partial(StackingEnv, action_pool, num_available, **options)
    envs = AsyncVectorEnv([make] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    # Unrelated seeds: with gymnasium's seed + i, runs with seeds 0 and 1 would share environments.
    # This reset is for its seeds: call reset() without a seed for the first observation.
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs


# ---- A.4, B: action observations ----
def _views(shape_id: int, num_views: int, seed: int) -> np.ndarray:
    """Pictures of one shape from random viewpoints, (num_views, 84, 84) uint8."""
    bullet = Bullet()
    add_shape(bullet, shape_id, (0, 0, 0), COLOURS[shape_id])
    # Each view takes two numbers from its shape's own generator: view k depends only on the seed,
    # the shape and k. The camera goes all the way round [code], the light with it, so turning the
    # shape is the same as moving the camera: the pictures tell form, size and the shape's grey
    # level, not the angle, which the policy sees only once the shape stands in the scene.
    rng = np.random.default_rng([seed, shape_id])
    pictures = []
    for _ in range(num_views):
        angle = rng.uniform(0, 2 * math.pi)
        height = rng.uniform(*VIEW_HEIGHT)
        x = VIEW_RADIUS * math.cos(angle)
        y = VIEW_RADIUS * math.sin(angle)
        eye = (x, y, height)
        pictures.append(grey(photograph(bullet, (eye, (0, 0, 0)))))  # it looks at the origin
    return np.stack(pictures)


def action_observations(
    action_ids: Sequence[int],
    num_observations: int = 1024,  # A.4
    modality: str = "image",
    seed: int = 0,
    workers: int = 1,
) -> np.ndarray:
    """Pictures of each shape, alone on black, from independent random viewpoints (A.4).

    `action_ids` (n,) are distinct, "image" is the only modality, `workers` counts processes. One
    seed gives the same bytes, whatever `workers` and the other ids asked for. Returns
    (n, num_observations, 84, 84) uint8, in the order of the ids. ValueError for bad arguments.
    """
    # [code] has colour pictures, only 32 of them different; [here] all differ, in grey like states.
    check_ids(action_ids)
    if modality not in MODALITIES:
        raise ValueError(f"unknown modality {modality!r}; allowed: {', '.join(MODALITIES)}")
    if num_observations < 1:
        raise ValueError(f"num_observations must be at least 1, got {num_observations}")
    ids = np.asarray(action_ids).tolist()
    out = np.empty((len(ids), num_observations, SIZE, SIZE), dtype=np.uint8)
    record = functools.partial(_views, num_views=num_observations, seed=seed)

    def fill(recordings) -> None:
        # A progress bar after 2 s, where somebody looks (disable=None: only in a terminal).
        for k, views in enumerate(tqdm(recordings, "views", len(ids), delay=2, disable=None)):
            out[k] = views

    if workers == 1:
        fill(map(record, ids))
    else:
        with multiprocessing.Pool(workers) as pool:
            fill(pool.imap(record, ids))
    return out


# ---- for people [here]: pictures, a plan to compare with, the command line ----
def shape_sheet() -> Image.Image:
    """What the encoder sees: a row per family, six views each of its middle and largest shape."""
    ids = []
    for family in FAMILIES:
        own = [i for i, shape in enumerate(SHAPES) if shape.family is family]
        ids += [own[len(own) // 2], own[-1]]
    # Twelve pictures of a family in a row: (family, picture, y, x) -> (family, y, picture, x).
    views = action_observations(ids, 6).reshape(len(FAMILIES), 12, SIZE, SIZE)
    rows = views.swapaxes(1, 2).reshape(-1, 12 * SIZE)  # (families * y, pictures * x)
    sheet = Image.fromarray(rows)
    for row, family in enumerate(FAMILIES):
        ImageDraw.Draw(sheet).text((4, SIZE * row), family.name, 255)
    return sheet


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


FLAT = ("horizontal_rectangle", "half_rectangle", "cube", "arch", "rectangle", "cylinder")


def greedy_plan(available: Sequence[int]) -> list[int]:
    """Indices into `available` of at most ten shapes, in order, for a high tower.

    The shapes with flat top and bottom, largest first, then the tallest of the rest. If all are
    dropped over one cylinder, the mean is 5.1 to 5.4 m (splits differ); random play: 1.5 to 1.6.
    """

    def rank(k):  # the lowest comes first
        family, scale, _ = SHAPES[available[k]]
        width, depth, height = scale * np.ptp(family.points, axis=0)
        if family.name in FLAT:
            return False, -width * depth
        return True, -height

    return sorted(range(len(available)), key=rank)[:MAX_STEPS]


def play(env: StackingEnv, seed: int, policy: str = "greedy") -> tuple[float, list]:
    """One episode of 1D Place without stopping: the height, and the frames."""
    obs, _ = env.reset(seed=seed)
    if policy == "greedy":  # over the left cylinder; in landing it may move just beyond -1
        positions, _ = env.poses()
        choices = greedy_plan(obs["available"])
        places = np.full((MAX_STEPS, 1), max(-1, positions[0, 0]))
    else:
        rng = np.random.default_rng(seed)
        choices = rng.integers(env.num_available, size=MAX_STEPS)
        places = rng.uniform(-1, 1, (MAX_STEPS, 1))
    frames = env.render_frames()
    # A plan for fewer than ten shapes begins anew: a shape that is placed only uses up the step.
    for choice, place in zip(itertools.cycle(choices), places, strict=False):
        *_, info = env.step({"choice": choice, "position": place, "stop": 0})
        frames += env.render_frames()
    return info[METRIC], frames


@dataclass
class Args:
    """Build a planned and a random tower, draw the shapes."""

    seed: int = 0  # of the split and of the episodes
    out: Path = Path("runs/demo")  # folder for the GIFs and the sheet
    split: Literal["default", "full"] = "default"  # how the shapes are divided (A.4, Table 2)


def main(args: Args) -> None:
    """The script: see the top of the file."""
    parts = split_actions(args.split, args.seed)
    env = StackingEnv(parts["test"], render_mode="rgb_array")
    for policy in ("greedy", "random"):
        height, frames = play(env, args.seed, policy)
        save_gif(args.out / f"stacking_{policy}.gif", frames, env.metadata["render_fps"])
        print(f"{policy} tower of shapes of the test part: height {height:.2f}")
    env.close()
    shape_sheet().save(args.out / "stacking_shapes.png")
    print("wrote the GIFs and a picture of all families to", args.out)


if __name__ == "__main__":
    main(tyro.cli(Args))
