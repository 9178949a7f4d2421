"""Shape Stacking against slow obvious versions, the published numbers, and its own promises."""

import errno
import importlib.util
import math
import os
import resource
import subprocess
import sys
import warnings
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

import stacking_env
from stacking_env import FAMILIES, SHAPES, SOLIDS, StackingEnv, action_observations, make_vec

ROOT = Path(__file__).parent.parent
needs_physics = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="pybullet is not installed"
)
IDS = {family.name: [i for i, s in enumerate(SHAPES) if FAMILIES[s.family] is family]
       for family in FAMILIES}  # fmt: skip
LARGEST = {name: ids[-1] for name, ids in IDS.items()}


def act(choice=0, x=0.0, stop=0):
    return {"choice": choice, "position": np.array([x], np.float32), "stop": stop}


def inside(solid, points):
    """Which points (..., 3), in body coordinates at scale 1, are in the solid."""
    found = np.zeros(points.shape[:-1], bool)
    for piece in solid.pieces:
        here = (points @ piece.normals.T <= piece.offsets + 1e-9).all(-1)
        if piece.round is not None:
            here &= ((points - piece.centre) ** 2 @ piece.round) <= 1
        found |= here
    return found


# ---- the 810 shapes ----


def test_810_shapes_in_the_published_families():
    starts = {"middle_triangle": 0, "hat": 60, "triangle": 120, "tall_triangle": 180,
              "horizontal_rectangle": 240, "dome": 300, "cone-hires": 360, "cone": 390,
              "tetrahedron": 420, "arch": 480, "rectangle": 540, "half_rectangle": 600,
              "cube": 660, "sphere": 720, "capsule": 750, "cylinder": 780}  # fmt: skip
    assert {name: ids[0] for name, ids in IDS.items()} == starts
    assert stacking_env.NUM_ACTIONS == len(SHAPES) == 810
    counts = Counter(s.removeprefix("angled-") for s in stacking_env.action_labels())
    assert counts == dict(triangle=240, rectangle=180, cone=60, tetrahedron=60, dome=60, arch=60,
                          cube=60, sphere=30, capsule=30, cylinder=30)  # fmt: skip
    assert Counter(stacking_env.action_labels())["angled-triangle"] == 120
    assert Counter(stacking_env.action_labels())["angled-rectangle"] == 60


@pytest.mark.parametrize("name, low, high, turn", [
    ("middle_triangle", 0.08, 0.40, 180), ("hat", 0.08, 0.40, 180), ("triangle", 0.08, 0.40, 360),
    ("tall_triangle", 0.08, 0.24, 360), ("horizontal_rectangle", 0.08, 0.40, 180),
    ("dome", 0.16, 0.48, 180), ("tetrahedron", 0.08, 0.48, 45), ("arch", 0.08, 0.40, 180),
    ("rectangle", 0.08, 0.24, 90), ("half_rectangle", 0.08, 0.48, 180), ("cube", 0.08, 0.48, 45),
    ("sphere", 0.08, 0.64, 0), ("capsule", 0.08, 0.32, 0), ("cylinder", 0.08, 0.48, 0),
])  # fmt: skip
def test_scales_and_angles_of_a_family(name, low, high, turn):
    scales = sorted({SHAPES[i].scale for i in IDS[name]})
    angles = sorted({SHAPES[i].angle for i in IDS[name]})
    assert scales[0] == pytest.approx(low) and scales[-1] == pytest.approx(high)
    assert len(scales) * len(angles) == len(IDS[name])
    step = math.radians(turn) / len(angles)
    assert np.allclose(angles, step * np.arange(len(angles)))


def test_start_cylinders_have_the_published_heights():
    heights = [2 * SHAPES[i].scale for i in stacking_env.CYLINDERS]
    assert np.round(heights, 3).tolist() == [0.657, 0.684, 0.712]


@pytest.mark.parametrize("name, com, inertia", [  # mass 1, scale 1, about the centre of mass
    ("middle_triangle", (0, -1 / 3), (0.556, 0.389, 0.500)),
    ("hat", (0, 0.4714), (0.444, 0.444, 0.667)),
    ("triangle", (-1 / 3, -1 / 3), (0.556 + 0.111, 0.444, 0.556 - 0.111)),
    ("dome", (0, -0.0756), (0.402, 0.316, 0.580)), ("cone", (0, -0.5), (0.298, 0.298, 0.295)),
    ("tetrahedron", (0, -0.5), (0.35, 0.35, 0.40)), ("arch", (0, 0.2078), None),
    ("cube", (0, 0), (2 / 3, 2 / 3, 2 / 3)), ("sphere", (0, 0), (0.4, 0.4, 0.4)),
    ("capsule", (0, 0), (1.21, 1.21, 0.46)), ("cylinder", (0, 0), (7 / 12, 7 / 12, 0.5)),
])  # fmt: skip
def test_mass_properties_are_the_published_ones(name, com, inertia):
    solid = SOLIDS[LARGEST[name]]
    assert np.allclose(solid.com[[0, 2]], com, atol=0.012) and abs(solid.com[1]) < 1e-9
    assert inertia is None or np.allclose(solid.inertia, inertia, atol=0.003)


@pytest.mark.parametrize("name", IDS)
def test_mass_properties_equal_random_sampling(name):
    """The centre is the origin of the body frame and its axes are the principal ones."""
    solid = SOLIDS[LARGEST[name]]
    low, high = solid.box.min(0), solid.box.max(0)
    points = np.random.default_rng(0).uniform(low, high, (120_000, 3))
    points = points[inside(solid, points)]
    assert np.allclose(points.mean(0), 0, atol=0.02)
    moments = points.T @ points / len(points)
    inertia = np.trace(moments) * np.eye(3) - moments
    assert np.allclose(inertia, np.diag(solid.inertia), atol=0.035)


def test_extent_below_the_centre_equals_brute_force():
    points = np.random.default_rng(1).uniform(-3, 3, (300_000, 3))
    for name in IDS:
        shape, solid = SHAPES[LARGEST[name]], SOLIDS[LARGEST[name]]
        rotation = stacking_env._rotations(np.array([stacking_env.upright_quaternion(shape)]))[0]
        inner = points[inside(solid, points)] @ rotation.T
        lowest = stacking_env.lowest(LARGEST[name]) / shape.scale
        assert lowest - 0.25 < -inner[:, 2].min() <= lowest + 1e-6, name


def test_engineered_representation_has_scale_angle_family():
    table = stacking_env.engineered_representations()
    assert table.shape == (810, 19) and table.dtype == np.float32
    assert np.allclose(table[:, 0], [s.scale for s in SHAPES])
    assert np.allclose(
        np.arctan2(table[:, 1], table[:, 2]) % (2 * np.pi), [s.angle for s in SHAPES]
    )
    assert np.array_equal(table[:, 3:].argmax(1), [s.family for s in SHAPES])


# ---- splits ----


@pytest.mark.parametrize("split, sizes", [("default", (405, 202, 203)), ("full", (420, 195, 195))])
@pytest.mark.parametrize("seed", [0, 5])
def test_split_sizes(split, sizes, seed):
    parts = stacking_env.split_actions(split, seed)
    assert tuple(len(parts[k]) for k in ("train", "valid", "test")) == sizes
    assert np.array_equal(np.sort(np.concatenate(list(parts.values()))), np.arange(810))
    assert all(ids.dtype == np.int64 and (np.diff(ids) > 0).all() for ids in parts.values())


def test_default_split_keeps_each_scale_of_a_family_together():
    train = set(stacking_env.split_actions("default", 3)["train"].tolist())
    for ids in IDS.values():
        inside_train = {SHAPES[i].scale for i in ids if i in train}
        outside = {SHAPES[i].scale for i in ids if i not in train}
        assert not inside_train & outside and len(inside_train) == len(outside)


def test_full_split_is_table_2():
    labels = stacking_env.action_labels()
    parts = stacking_env.split_actions("full")
    assert set(labels[parts["train"]]) == {
        "dome",
        "rectangle",
        "capsule",
        "triangle",
        "arch",
        "sphere",
    }
    unseen = set(labels[np.concatenate([parts["valid"], parts["test"]])])
    assert unseen == {
        "cylinder",
        "tetrahedron",
        "cube",
        "cone",
        "angled-rectangle",
        "angled-triangle",
    }


@pytest.mark.parametrize("ids", [[], [810], [-1], [1.5], [[1]], ["a"], [True]])
def test_unknown_ids_are_refused(ids):
    with pytest.raises(ValueError, match="action id"):
        action_observations(ids, 1)


# ---- the painter ----


@pytest.mark.parametrize("name", IDS)
def test_painter_equals_marching_along_every_ray(name):
    """Same hits, same depth, same surface as testing 600 points on each ray for being inside."""
    rng = np.random.default_rng(len(name))
    solid, scale = SOLIDS[LARGEST[name]], SHAPES[LARGEST[name]].scale
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    position = rng.uniform(-0.2, 0.2, 3)
    camera = stacking_env.look((1.2, -1.9, 1.1), (0, 0, 0), size=24)
    canvas = stacking_env.Canvas.blank(24)
    stacking_env._paint(canvas, camera, 3, solid, scale, position, rotation)
    u, v = camera.grid[None, :, None], -camera.grid[:, None, None]
    rays = u * camera.axes[0] + v * camera.axes[1] + camera.axes[2]
    depths = np.linspace(0.8, 4.4, 600)
    points = camera.eye + rays[:, :, None] * depths[:, None]  # (24, 24, 600, 3)
    hits = inside(solid, (points - position) @ rotation / scale)
    hit = hits.any(-1)
    assert (
        hit.mean() > 0.02 and (hit != (canvas.near > 0)).mean() < 0.012
    )  # grazing rays may differ
    both = hit & (canvas.near > 0)
    error = 1 / canvas.near[both] - depths[hits.argmax(-1)][both]
    assert np.quantile(np.abs(error), 0.97) < 0.01
    assert (canvas.owner[canvas.near > 0] == 3).all()
    # the light is the cosine of the surface normal, here from the depths of neighbouring pixels
    surface = camera.eye + rays / np.maximum(canvas.near, 1e-9)[..., None]
    normal = np.cross(
        surface[1:-1, 2:] - surface[1:-1, :-2], surface[:-2, 1:-1] - surface[2:, 1:-1]
    )
    cosine = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)) @ stacking_env.SUN
    solid_near = canvas.near > 0
    inner = solid_near[1:-1, 1:-1] & solid_near[1:-1, 2:] & solid_near[1:-1, :-2]
    inner &= solid_near[2:, 1:-1] & solid_near[:-2, 1:-1]
    if inner.sum() > 20:
        assert np.median(np.abs(cosine - canvas.light[1:-1, 1:-1])[inner]) < 0.03


def test_the_nearer_body_is_seen_whatever_the_order():
    camera = stacking_env.look((0, -5, 0), (0, 0, 0))
    cube, eye = SOLIDS[LARGEST["cube"]], np.eye(3)
    for order in ((1, 2), (2, 1)):
        canvas = stacking_env.Canvas.blank(84)
        for owner in order:
            y = -1.0 if owner == 1 else 1.0
            stacking_env._paint(canvas, camera, owner, cube, 0.5, np.array([0, y, 0]), eye)
        assert canvas.owner[42, 42] == 1 and 1 / canvas.near[42, 42] == pytest.approx(3.5)


@needs_physics
@pytest.mark.parametrize("name", ["cube", "cylinder", "rectangle"])  # its spheres are coarse
def test_silhouette_equals_bullets_own_renderer(name):
    import pybullet as p

    shape_id = LARGEST[name]
    env = StackingEnv()
    env._empty_world()
    env._add(shape_id, 0.1, 0.0, lowest_z=1.0)
    pose = [part[0] for part in env.poses()]
    view = p.computeViewMatrix((1.5, -2, 2.2), (0, 0, 1), (0, 0, 1))
    lens = p.computeProjectionMatrixFOV(45, 1, 0.1, 20)
    seen = p.getCameraImage(
        336, 336, view, lens, renderer=p.ER_TINY_RENDERER, physicsClientId=env._client
    )
    theirs = np.asarray(seen[4]).reshape(336, 336) == env._bodies[0]
    canvas = stacking_env.Canvas.blank(336)
    camera = stacking_env.look((1.5, -2, 2.2), (0, 0, 1), size=336)
    stacking_env._paint(canvas, camera, 0, SOLIDS[shape_id], SHAPES[shape_id].scale, *pose)
    ours = canvas.near > 0
    assert (ours & theirs).sum() / (ours | theirs).sum() > 0.965  # a pixel at the edge
    env.close()


# ---- action observations ----


def test_views_repeat_for_any_workers_order_and_number():
    ids = [700, 3, 500, 809]
    one = action_observations(ids, 6, "image", seed=2, workers=1)
    assert one.shape == (4, 6, 84, 84) and one.dtype == np.uint8
    assert np.array_equal(one, action_observations(ids, 6, "image", seed=2, workers=3))
    assert np.array_equal(one[1:2, :4], action_observations([3], 4, "image", seed=2))
    assert not np.array_equal(one, action_observations(ids, 6, "image", seed=3))


def test_every_shape_is_seen_from_all_around():
    views = action_observations(np.arange(0, 810, 9), 8)
    covered = (views > 0).mean((2, 3))
    assert covered.min() > 0.002 and covered.max() < 0.8
    assert len({view.tobytes() for view in views.reshape(-1, 84 * 84)}) > 0.9 * views.shape[0] * 8
    small, large = action_observations([IDS["cube"][0], IDS["cube"][-1]], 32)
    assert (large > 0).mean() > 20 * (small > 0).mean()  # scale 6 times, area up to 36 times


def test_viewpoints_lie_on_the_published_circles(monkeypatch):
    eyes = []
    original = stacking_env.look
    monkeypatch.setattr(stacking_env, "look", lambda eye, *a: eyes.append(eye) or original(eye, *a))
    stacking_env._views(12, 400, 0)
    x, y, z = np.array(eyes).T
    assert np.allclose(np.hypot(x, y), 2.0) and 0.5 <= z.min() < 0.52 and 1.98 < z.max() <= 2.0
    assert abs(np.cos(np.arctan2(y, x)).mean()) < 0.1 and abs(z.mean() - 1.25) < 0.08


def test_large_requests_are_cached_and_the_cache_is_safe(tmp_path, monkeypatch):
    monkeypatch.setattr(stacking_env, "CACHE_FROM", 6)
    first = action_observations([1, 2], 3, cache_dir=tmp_path)
    plain = np.array(first)
    assert [f.suffix for f in tmp_path.iterdir()] == [".npy"]
    first[:] = 0  # copy on write: the file must not change
    monkeypatch.setattr(stacking_env, "_fill", lambda *a: pytest.fail("the cache was not used"))
    assert np.array_equal(action_observations([1, 2], 3, cache_dir=tmp_path), plain)
    monkeypatch.undo()
    assert np.array_equal(action_observations([1, 2], 3, cache_dir=None), plain)
    monkeypatch.setattr(stacking_env, "CACHE_FROM", 6)

    def broken(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(stacking_env, "_fill", broken)
    for other in ({"seed": 1}, {"num_observations": 4}, {"action_ids": [2, 1]}):  # other pictures
        with pytest.raises(KeyboardInterrupt):
            args = {"action_ids": [1, 2], "num_observations": 3, "cache_dir": tmp_path} | other
            action_observations(**args)
    assert len(list(tmp_path.iterdir())) == 1  # nothing half-written stays


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="no way to ask this system for room")
def test_full_disk_is_an_error_and_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(stacking_env, "CACHE_FROM", 6)
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        action_observations([1, 2], 3, cache_dir=tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "bad",
    [
        {"modality": "video"},
        {"num_observations": 0},
        {"workers": 0},
        {"seed": -1},
        {"workers": 1.5},
    ],
)
def test_bad_requests_for_observations_are_refused(bad):
    with pytest.raises(ValueError, match=str(next(iter(bad.values())))):
        action_observations(**({"action_ids": [1], "num_observations": 2} | bad))


# ---- physics ----


@needs_physics
def test_every_shape_comes_to_rest_where_it_was_put():
    """All 810, let go 2 cm over the table: no sinking, no exploding, no sliding, no tipping."""
    env = StackingEnv()
    for shape_id in range(810):
        env._empty_world()
        env._add(shape_id, 0.3, 0.0, lowest_z=stacking_env.DROP_GAP)
        (start,), (upright,) = env.poses()
        env._settle()
        (position,), (rotation,) = env.poses()
        assert abs(position[2] - stacking_env.lowest(shape_id)) < 0.002, shape_id
        assert np.abs(position - start)[:2].max() < 0.002, shape_id
        assert np.abs(rotation - upright).max() < 0.01, shape_id
    env.close()


@needs_physics
@pytest.mark.slow
def test_every_shape_still_stands_after_the_full_300_steps():
    env = StackingEnv(early_stop=False)
    for shape_id in range(810):
        env._empty_world()
        env._add(shape_id, 0.3, 0.0, lowest_z=stacking_env.DROP_GAP)
        (start,), (upright,) = env.poses()
        env._settle()
        (position,), (rotation,) = env.poses()
        assert abs(position[2] - stacking_env.lowest(shape_id)) < 0.002, shape_id
        assert np.abs(position - start)[:2].max() < 0.006, shape_id
        assert np.abs(rotation - upright).max() < 0.03, shape_id
    env.close()


@needs_physics
def test_bullet_has_mass_1_and_the_true_inertia():
    import pybullet as p

    env = StackingEnv()
    for shape_id in LARGEST.values():
        env._empty_world()
        env._add(shape_id, 0.0, 0.0, lowest_z=0.5)
        mass, friction, inertia = p.getDynamicsInfo(env._bodies[0], -1, env._client)[:3]
        scale = SHAPES[shape_id].scale
        assert mass == 1 and friction == 1
        assert np.allclose(inertia, SOLIDS[shape_id].inertia * scale**2, rtol=1e-5)
    env.close()


def mean_height(policy, episodes, **options):
    env = StackingEnv(**options)
    heights = [stacking_env.play(env, seed, policy)[0] for seed in range(episodes)]
    env.close()
    return np.mean(heights)


@needs_physics
def test_random_play_and_a_flat_tower_reach_the_expected_heights():
    assert 1.2 < mean_height("random", 16) < 2.1  # 1.63; standard error .12
    assert 4.2 < mean_height("greedy", 10) < 6.6  # 5.39; standard error .4


@needs_physics
@pytest.mark.slow
def test_mean_heights_on_the_published_draw_of_scales():
    """The published training scales of each family; 1.63 and 5.39 were measured independently."""
    drawn = {"middle_triangle": [2, 4, 5], "hat": [3, 4, 5], "triangle": [0, 3, 5],
             "tall_triangle": [0, 1, 5], "horizontal_rectangle": [0, 1, 4], "dome": [0, 3, 4],
             "tetrahedron": [0, 3, 6, 7, 8], "arch": [1, 4, 5], "rectangle": [1, 4, 5, 8, 9],
             "half_rectangle": [0, 1, 3, 4, 8], "cube": [0, 2, 3, 6, 9],
             "cone-hires": [2, 4, 8, 9, 11, 12, 15, 16, 17, 20, 22, 23, 25, 26, 28],
             "cone": [0, 3, 4, 5, 7, 8, 15, 17, 18, 19, 21, 24, 26, 27, 28],
             "sphere": [0, 1, 2, 3, 6, 8, 11, 12, 15, 16, 20, 22, 24, 27, 29],
             "capsule": [0, 1, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 20, 27, 28],
             "cylinder": [1, 2, 5, 7, 8, 11, 14, 15, 19, 20, 22, 23, 25, 27, 28]}  # fmt: skip
    train = [IDS[f.name][k * f.angles + a] for f in FAMILIES for k in drawn[f.name]
             for a in range(f.angles)]  # fmt: skip
    assert len(train) == 405
    for pool in (train, np.setdiff1d(np.arange(810), train)):
        assert abs(mean_height("random", 150, action_pool=pool) - 1.63) < 0.2
        assert abs(mean_height("greedy", 80, action_pool=pool) - 5.39) < 0.5
    # early stopping changes the scores of random play by no more than noise
    assert abs(mean_height("random", 80, early_stop=False) - 1.65) < 0.25


@needs_physics
def test_one_seed_builds_one_tower_bit_for_bit_whatever_came_before():
    def tower(env, seed):
        height, _ = stacking_env.play(env, seed, "random")
        return height, *(part.tobytes() for part in env.poses())

    env = StackingEnv()
    first = [tower(env, seed) for seed in range(3)]
    for seed in range(100, 200):  # 100 other episodes, of one drop each
        env.reset(seed=seed)
        env.step(act(seed % 20, 0.4))
    assert [tower(env, seed) for seed in range(3)] == first
    env.close()
    fresh = StackingEnv()
    assert tower(fresh, 2) == first[2]
    fresh.close()


# ---- rules ----


@needs_physics
def test_start_two_equal_cylinders_apart():
    env = StackingEnv()
    sizes = set()
    for seed in range(60):
        obs, info = env.reset(seed=seed)
        (a, b), _ = env.poses()
        left, right = a[0], b[0]
        assert env.shape_ids[0] == env.shape_ids[1] in stacking_env.CYLINDERS and info == {}
        assert -1 <= left <= -0.3 and 0.3 <= right <= 1 and 0.99 < right - left < 1.61
        assert 0.32 < a[2] < 0.36 and abs(a[2] - b[2]) < 1e-3 and abs(a[1]) < 1e-3
        assert obs["state"][:3].max() == 0 and obs["state"][3].max() > 0  # only the newest frame
        sizes.add(env.shape_ids[0])
    assert sizes == set(stacking_env.CYLINDERS)
    env.close()


@needs_physics
def test_reward_is_eq_4_on_the_last_step_only():
    env = StackingEnv()
    env.reset(seed=1)
    for step in range(1, 11):
        obs, reward, terminated, truncated, info = env.step(act(step, -0.5 + step / 10))
        assert (terminated, truncated) == (False, step == 10)
        if step < 10:
            assert reward == 0 and info == {}
    heights = [position[2] for position in env.poses()[0]]
    assert len(heights) == 12
    expected = 0.5 * max(heights) + 0.5 * sum(heights) / 12
    assert reward == pytest.approx(expected) and info["height"] == max(heights)
    assert info["episode"] == {"r": reward, "l": 10}
    with pytest.raises(ResetNeeded):
        env.step(act())
    env.close()


@needs_physics
def test_stop_places_nothing_and_terminates():
    env = StackingEnv()
    first, _ = env.reset(seed=4)
    before = env.poses()[0]
    obs, reward, terminated, truncated, info = env.step(act(3, 0.2, stop=1))
    assert terminated and not truncated and info["episode"]["l"] == 1
    assert np.array_equal(env.poses()[0], before) and len(env.shape_ids) == 2
    assert reward == pytest.approx(before[0, 2], abs=1e-3)  # empty table: the cylinders' height
    assert np.array_equal(obs["available"], first["available"])
    env.close()


@needs_physics
def test_a_repeat_changes_nothing_but_the_step_counter():
    env = StackingEnv()
    env.reset(seed=5)
    once, *_ = env.step(act(7, 0.3))
    poses = env.poses()
    again, reward, terminated, truncated, _ = env.step(act(7, -0.9))
    assert all(np.array_equal(a, b) for a, b in zip(env.poses(), poses, strict=True))
    assert np.array_equal(again["state"][3], once["state"][3]) and reward == 0
    assert np.array_equal(again["state"][:3], once["state"][1:]) and not (terminated or truncated)
    for step in range(3, 11):
        *_, truncated, info = env.step(act(7, 0.0))
        assert truncated == (step == 10)
    assert info["episode"]["l"] == 10 and len(env.shape_ids) == 3
    env.close()


@needs_physics
def test_a_shape_is_let_go_just_above_everything():
    env = StackingEnv(render_mode="rgb_array")
    obs, _ = env.reset(seed=6)
    for choice in range(6):
        tops = []
        for shape_id, position, rotation in zip(env.shape_ids, *env.poses(), strict=True):
            points = np.random.default_rng(0).uniform(-3, 3, (20_000, 3))
            points = points[inside(SOLIDS[shape_id], points)] * SHAPES[shape_id].scale
            tops.append(position[2] + (points @ rotation.T)[:, 2].max())
        assert max(tops) <= env.top() + 1e-6 and env.top() < max(tops) + 0.12
        top = env.top()
        env.step(act(choice, 0.9))
        position, shape_id = env._trace[0][0][-1], int(obs["available"][choice])
        bottom = position[2] - stacking_env.lowest(shape_id)
        assert bottom == pytest.approx(top + stacking_env.DROP_GAP, abs=1e-6)
    env.close()


@needs_physics
@pytest.mark.parametrize("placement, dims", [("none", 0), ("1d", 1), ("2d", 2)])
def test_placement_modes(placement, dims):
    env = StackingEnv(placement=placement, render_mode="rgb_array")
    env.reset(seed=0)
    assert ("position" in env.action_space.spaces) == (dims > 0)
    action = {"choice": 2, "stop": 0}
    if dims:
        action["position"] = np.array([0.7, -0.6], np.float32)[:dims]
    env.step(action)
    shape_id = int(env.available[2])
    com = (
        stacking_env._turn(SHAPES[shape_id].angle, 2)
        @ SOLIDS[shape_id].com
        * SHAPES[shape_id].scale
    )
    let_go = env._trace[0][0][-1]
    expected = np.append(action.get("position", []), np.zeros(2))[:2]
    assert np.allclose(let_go[:2], expected + com[:2], atol=1e-6)  # the origin is over (x, y)
    env.close()


@needs_physics
def test_the_picture_shows_the_right_side_and_the_published_scale():
    env = StackingEnv()
    before = env.reset(seed=2)[0]["state"][3].astype(int)
    after = env.step(act(0, 1.0))[0]["state"][3].astype(int)
    changed = np.abs(after - before) > 8
    assert changed[:, 42:].sum() > 3 * changed[:, :42].sum() and changed.sum() > 10
    # nothing above the horizon, table from row 70 down at 120 of 255, 14.5 pixels per unit at y = 0
    assert before[:50].max() == 0 and before[69, 0] == 0 and abs(before[71, 0] - 120) <= 1
    camera, _ = stacking_env._stage(*stacking_env.FRONT)
    assert camera.focal / 7 == pytest.approx(14.5, abs=0.05)
    env.close()


@needs_physics
def test_a_pool_of_just_k_is_offered_in_order_always():
    env = StackingEnv([40, 7, 300], num_available=3)
    for seed in range(3):
        assert env.reset(seed=seed)[0]["available"].tolist() == [7, 40, 300]
    env.close()


@needs_physics
def test_shapes_on_offer_are_drawn_evenly_from_the_pool():
    env = StackingEnv(np.arange(100, 110), num_available=4)
    counts = np.zeros(810)
    for _ in range(300):
        ids = env.reset(seed=None)[0]["available"]
        assert len(set(ids.tolist())) == 4
        counts[ids] += 1
    assert counts.sum() == counts[100:110].sum() and counts[100:110].min() > 80  # 120 expected
    env.close()


@pytest.mark.parametrize("bad, words", [
    ({"num_available": 406}, "406"), ({"num_available": 0}, "0"), ({"num_available": 2.5}, "2.5"),
    ({"action_pool": [1, 1, 2], "num_available": 2}, "repeat"), ({"action_pool": [900]}, "900"),
    ({"placement": "3d"}, "3d"), ({"render_mode": "human"}, "human"),
])  # fmt: skip
def test_bad_arguments_are_refused(bad, words):
    with pytest.raises(ValueError, match=words):
        StackingEnv(**bad)
    if "render_mode" not in bad:
        with pytest.raises(ValueError, match=words):
            make_vec(2, **bad)


BAD_ACTIONS = [
    (act(x=float("nan")), "position"), (act(x=1.01), "position"), (act(x=-np.inf), "position"),
    (act(20), "choice"), (act(-1), "choice"), (act(1.0), "choice"), (act(True), "choice"),
    (act(None), "choice"), (act([1]), "choice"), (act("1"), "choice"),
    (act(stop=2), "stop"), (act(stop=0.0), "stop"), (5, "keys"), ({"choice": 1}, "keys"),
    ({"choice": 1, "stop": 0, "position": np.zeros(2, np.float32)}, "position"),
    ({"choice": 1, "stop": 0, "position": 0.5}, "position"),
    ({"choice": 1, "stop": 0, "position": np.array([1])}, "position"),
    ({"choice": 1, "stop": 0, "position": np.zeros(1, np.float32), "more": 0}, "keys"),
]  # fmt: skip


@needs_physics
def test_bad_actions_are_refused_and_leave_no_trace():
    env, twin = StackingEnv(), StackingEnv()
    env.reset(seed=8)
    twin.reset(seed=8)
    for step in range(4):
        for action, words in BAD_ACTIONS:
            with pytest.raises(ValueError, match=words):
                env.step(action)
        ours, theirs = env.step(act(step, 0.1)), twin.step(act(np.int64(step), 0.1))
        assert np.array_equal(ours[0]["state"], theirs[0]["state"])
        assert all(np.array_equal(a, b) for a, b in zip(env.poses(), twin.poses(), strict=True))
    env.close()
    twin.close()


@needs_physics
def test_step_before_reset_is_refused():
    with pytest.raises(ResetNeeded):
        StackingEnv().step(act())


@needs_physics
def test_a_shape_that_enters_the_table_is_waited_for():
    """This thin one hits the table at 3.5 m/s and is met 0.05 inside it, slow already."""
    env = StackingEnv(np.arange(810))
    env.reset(seed=4600)
    env.step(act(0, 0.0))
    thin = SHAPES[env.shape_ids[-1]]
    assert thin.scale == pytest.approx(0.08)
    assert env.poses()[0][-1, 2] > 0.4 * thin.scale  # lying flat: 0.5
    env.close()


@needs_physics
@example(4600, [(0, 0.0)])
@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**31), st.lists(st.tuples(st.integers(0, 19), st.floats(-1, 1, width=32)),
                                       min_size=1, max_size=10))  # fmt: skip
def test_any_play_keeps_a_finite_scene_on_the_table(seed, moves):
    env = StackingEnv(np.arange(810))
    env.reset(seed=seed)
    for step, (choice, x) in enumerate(moves, start=1):
        obs, reward, _, truncated, _ = env.step(act(choice, x))
        positions, rotations = env.poses()
        assert np.isfinite(positions).all() and np.isfinite(rotations).all()
        assert positions[:, 2].min() > 0.02 and np.abs(positions[:, :2]).max() < 12
        assert len(env.shape_ids) == 2 + len({c for c, _ in moves[:step]})
        assert env.observation_space.contains(obs) and reward >= 0
    assert truncated == (len(moves) == 10)
    env.close()


# ---- interfaces ----


@needs_physics
@pytest.mark.parametrize("placement", ["none", "1d", "2d"])
def test_check_env_without_warnings(placement):
    env = gym.make("ActionGen/Stacking-v0", placement=placement, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


@needs_physics
def test_render_frames_show_the_fall_and_cost_nothing_without_render_mode():
    env = StackingEnv(render_mode="rgb_array")
    env.reset(seed=3)
    env.step(act(1, 0.8))
    frames = env.render_frames()
    assert len(frames) >= 3 and all(f.shape == (360, 360, 3) for f in frames)
    assert frames[0].dtype == np.uint8 and not np.array_equal(frames[0], frames[-1])
    assert np.array_equal(frames[-1], env.render())
    env.close()
    silent = StackingEnv()
    silent.reset(seed=3)
    assert silent.render_frames() == [] and silent.render() is None and silent._trace == []
    silent.close()


def rollout(envs, seed, steps=24):
    rng = np.random.default_rng(0)
    obs, _ = envs.reset(seed=seed)
    log = [obs["state"].tobytes(), obs["available"].tobytes()]
    infos = []
    for _ in range(steps):
        n = envs.num_envs
        action = {
            "choice": rng.integers(20, size=n),
            "stop": (rng.random(n) < 0.15).astype(np.int64),
        }
        action["position"] = rng.uniform(-1, 1, (n, 1)).astype(np.float32)
        obs, reward, terminated, truncated, info = envs.step(action)
        log += [part.tobytes() for part in (*obs.values(), reward, terminated, truncated)]
        infos.append(info)
    envs.close()
    return log, infos


@needs_physics
def test_processes_and_single_process_give_the_same_episodes():
    pool = stacking_env.split_actions()["test"]
    apart, infos = rollout(make_vec(2, pool, 20, seed=11), None)
    together, _ = rollout(make_vec(2, pool, 20, seed=11, async_envs=False), None)
    reseeded, _ = rollout(make_vec(2, pool, 20, seed=99, async_envs=False), 11)
    assert apart == together == reseeded
    ended = [info for info in infos if "final_info" in info]
    assert ended and all(
        set(i["final_info"]) == {"height", "_height", "episode", "_episode"} for i in ended
    )
    for info in ended:
        over = info["_final_info"]
        assert (
            np.array_equal(over, info["_final_obs"])
            and (info["final_info"]["height"][over] > 0.3).all()
        )
        assert (info["final_info"]["episode"]["l"][over] >= 1).all()


@needs_physics
@pytest.mark.parametrize("episodes", [100, pytest.param(10_000, marks=pytest.mark.slow)])
def test_no_bodies_clients_or_memory_are_left_behind(episodes):
    import pybullet as p

    env = StackingEnv()
    memory = 0
    for seed in range(episodes):
        env.reset(seed=seed)
        assert p.getNumBodies(env._client) == 3  # the table and two cylinders
        env.step(act(seed % 20, 0.2))
        if seed == episodes // 2:
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 8_000  # kB
    client = env._client
    env.close()
    assert not p.getConnectionInfo(client)["isConnected"]
    clients = set()
    for _ in range(min(episodes, 300) // 5):  # environments that nobody closes
        forgotten = StackingEnv()
        forgotten.reset(seed=0)
        clients.add(forgotten._client)
        del forgotten
    assert len(clients) <= 2


def test_without_pybullet_all_but_the_simulation_works():
    code = (
        "import sys; sys.modules['pybullet'] = None; import stacking_env as s\n"
        "assert s.action_observations([5], 2).any() and len(s.split_actions()['train']) == 405\n"
        "try: s.StackingEnv().reset()\n"
        "except ImportError as e: print(e)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert "pip install pybullet" in out.stdout and "3.11" in out.stdout, out.stderr


@needs_physics
def test_command_line(tmp_path):
    command = [sys.executable, "stacking_env.py", "--out", str(tmp_path), "--num-available"]
    out = subprocess.run([*command, "20"], capture_output=True, text=True, cwd=ROOT)
    assert out.returncode == 0 and "810 shapes" in out.stdout, out.stderr
    assert sorted(f.name for f in tmp_path.iterdir()) == [
        "stacking_greedy.gif",
        "stacking_random.gif",
    ]
    assert Image.open(tmp_path / "stacking_greedy.gif").n_frames > 20
    out = subprocess.run([*command, "500"], capture_output=True, text=True, cwd=ROOT)
    assert out.returncode == 1 and "error: num_available must be in 1..203" in out.stderr


def test_shape_sheet_shows_all_families():
    sheet = np.asarray(stacking_env.shape_sheet(size=48))
    assert sheet.shape == (8 * 48, 12 * 48 + 12, 3)
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 500
