"""Shape Stacking against slow obvious versions, the published numbers, and its own promises."""

import copy
import doctest
import math
import pickle
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial import Delaunay
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

stacking_env = pytest.importorskip("stacking_env")  # skipped, with the reason, without pybullet
FAMILIES = stacking_env.FAMILIES
SHAPES = stacking_env.SHAPES
StackingEnv = stacking_env.StackingEnv
Bullet = stacking_env.Bullet
action_observations = stacking_env.action_observations
make_vec = stacking_env.make_vec

ROOT = Path(__file__).parent.parent
IDS = {family.name: [i for i, s in enumerate(SHAPES) if s.family is family] for family in FAMILIES}
LARGEST = {name: ids[-1] for name, ids in IDS.items()}


def act(choice=0, x=0.0, stop=0):
    return {"choice": choice, "position": np.array([x], np.float32), "stop": stop}


def turned(shape_id):
    """Corners of a shape (V, 3) as it stands in the world, about its origin."""
    family, scale, angle = SHAPES[shape_id]
    return scale * Rotation.from_euler("z", angle).apply(family.points)


def inside(family, points):
    """Which points (n, 3), in the shape's own coordinates at scale 1, are in the solid."""
    x, y, z = points.T
    across, above = np.hypot(x, y), np.maximum(np.abs(z) - 1, 0)
    if family.name == "sphere":
        return np.hypot(across, z) <= 1
    if family.name == "cylinder":
        return (across <= 1) & (above == 0)
    if family.name == "capsule":
        return np.hypot(across, above) <= 1
    return np.any([Delaunay(part).find_simplex(points) >= 0 for part in family.parts()], axis=0)


@pytest.fixture
def env():
    env = StackingEnv()
    yield env
    env.close()


# ---- the 810 shapes ----


def test_810_shapes_in_the_published_families():
    starts = {"middle_triangle": 0, "hat": 60, "triangle": 120, "tall_triangle": 180,
              "horizontal_rectangle": 240, "dome": 300, "cone-hires": 360, "cone": 390,
              "tetrahedron": 420, "arch": 480, "rectangle": 540, "half_rectangle": 600,
              "cube": 660, "sphere": 720, "capsule": 750, "cylinder": 780}  # fmt: skip
    assert {name: ids[0] for name, ids in IDS.items()} == starts
    assert stacking_env.NUM_ACTIONS == len(SHAPES) == 810
    labels = Counter(stacking_env.action_labels().tolist())
    assert labels["angled-triangle"] == 120 and labels["angled-rectangle"] == 60
    classes = Counter(label.removeprefix("angled-") for label in labels.elements())
    assert classes == dict(triangle=240, rectangle=180, cone=60, tetrahedron=60, dome=60, arch=60,
                           cube=60, sphere=30, capsule=30, cylinder=30)  # fmt: skip


@pytest.mark.parametrize("name, low, high, turn", [
    ("middle_triangle", 0.08, 0.40, 180), ("hat", 0.08, 0.40, 180), ("triangle", 0.08, 0.40, 360),
    ("tall_triangle", 0.08, 0.24, 360), ("dome", 0.16, 0.48, 180), ("tetrahedron", 0.08, 0.48, 45),
    ("rectangle", 0.08, 0.24, 90), ("sphere", 0.08, 0.64, 0), ("capsule", 0.08, 0.32, 0),
])  # fmt: skip
def test_scales_and_angles_of_a_family(name, low, high, turn):
    scales = sorted({SHAPES[i].scale for i in IDS[name]})
    angles = sorted({SHAPES[i].angle for i in IDS[name]})
    assert scales[0] == pytest.approx(low) and scales[-1] == pytest.approx(high)
    assert len(scales) * len(angles) == len(IDS[name])
    assert np.allclose(angles, math.radians(turn) / len(angles) * np.arange(len(angles)))


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_mass_properties_equal_random_sampling(family):
    com, axes, moments = stacking_env.mass_properties(family)
    points = np.random.default_rng(0).uniform(-2, 2, (200_000, 3))
    points = axes.inv().apply(points[inside(family, points)] - com)  # in the body's frame
    assert np.allclose(points.mean(0), 0, atol=0.02)
    covariance = points.T @ points / len(points)
    inertia = np.trace(covariance) * np.eye(3) - covariance
    assert np.allclose(inertia, np.diag(moments), atol=0.035)


def test_engineered_representation_has_scale_angle_family():
    table = stacking_env.engineered_representations()
    assert table.shape == (810, 19) and np.allclose(table[:, 0], [s.scale for s in SHAPES])
    angles = np.arctan2(table[:, 1], table[:, 2]) % (2 * np.pi)
    assert np.allclose(angles, [s.angle for s in SHAPES])
    assert [FAMILIES[k] for k in table[:, 3:].argmax(1)] == [s.family for s in SHAPES]


# ---- splits ----


@pytest.mark.parametrize("split, sizes", [("default", (405, 202, 203)), ("full", (420, 195, 195))])
@pytest.mark.parametrize("seed", range(6))
def test_split_sizes(split, sizes, seed):
    parts = stacking_env.split_actions(split, seed)
    assert tuple(len(parts[k]) for k in ("train", "valid", "test")) == sizes
    assert np.array_equal(np.sort(np.concatenate(list(parts.values()))), np.arange(810))
    assert all(ids.dtype == np.int64 and (np.diff(ids) > 0).all() for ids in parts.values())


def test_default_split_trains_on_half_of_the_scales_of_every_family():
    counts = Counter()
    for seed in range(40):
        train = set(stacking_env.split_actions("default", seed)["train"].tolist())
        for name, ids in IDS.items():
            seen = {SHAPES[i].scale for i in ids if i in train}
            unseen = {SHAPES[i].scale for i in ids if i not in train}
            assert not seen & unseen and len(seen) == len(unseen)
            counts.update((name, scale) for scale in seen)
    assert len(counts) == 232 and 6 <= min(counts.values()) <= max(counts.values()) <= 34  # of 40


def test_full_split_is_table_2():
    labels, parts = stacking_env.action_labels(), stacking_env.split_actions("full")
    train = {"dome", "rectangle", "capsule", "triangle", "arch", "sphere"}
    rest = {"cylinder", "tetrahedron", "cube", "cone", "angled-rectangle", "angled-triangle"}
    assert set(labels[parts["train"]]) == train
    assert set(labels[parts["valid"]]) == set(labels[parts["test"]]) == rest


def looks(shape_id):
    """What is the same for two congruent solids however they lie; for two that a turn about the
    vertical or a mirror image makes one; for two that look the same."""
    points = turned(shape_id)
    points[:, 2] -= points[:, 2].min()
    distances, heights = np.sort(pdist(points)), np.sort(points[:, 2])
    pose, heights, stand = (
        (np.round(each, 6) + 0.0).tobytes()
        for each in (distances, heights, points[np.lexsort(np.round(points.T, 6))])
    )
    return pose, pose + heights, stand


def test_no_geometry_is_on_both_sides_of_a_split():
    """Of the default split not even on another face; Table 2 has one solid on two faces apart."""
    pose, turn, stand = zip(*map(looks, range(810)), strict=True)
    assert [len(set(kind)) for kind in (pose, turn, stand)] == [195, 202, 780]  # two equal cones
    for seed in range(8):
        for split, look in (("default", pose), ("full", turn)):
            parts = stacking_env.split_actions(split, seed)
            seen, unseen = parts["train"], np.append(parts["valid"], parts["test"])
            assert not {look[i] for i in seen} & {look[i] for i in unseen}
            assert not {stand[i] for i in parts["valid"]} & {stand[i] for i in parts["test"]}


# ---- pictures ----


@pytest.mark.parametrize("name", IDS)
def test_a_picture_shows_exactly_what_collides(name):
    """A ray through a pixel's lower left corner, where the renderer looks, meets Bullet's solid."""
    bullet, size, eye = Bullet(), 60, np.array([1.3, -2.0, 1.4])
    stacking_env.add_shape(bullet, LARGEST[name], (0.1, -0.1, 0.2), (1, 1, 1))
    seen = stacking_env.photograph(bullet, (eye.tolist(), (0, 0, 0)), size)[..., 0] > 0
    back = eye / np.linalg.norm(eye)
    right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
    u, v = np.meshgrid(2 * np.arange(size) / size - 1, 1 - 2 * (np.arange(size) + 1) / size)
    across = u[..., None] * right + v[..., None] * np.cross(back, right)  # (60, 60, 3)
    ends = eye + 5 * (math.tan(math.pi / 8) * across - back)
    hits = bullet.rayTestBatch([eye.tolist()] * size**2, ends.reshape(-1, 3).tolist())
    hits = np.reshape([hit[0] == 0 for hit in hits], (size, size))
    assert seen.mean() > 0.02 and (seen & hits).sum() / (seen | hits).sum() > 0.975


def test_the_state_shows_the_right_side_and_the_published_scale(env):
    before = env.reset(seed=2)[0]["state"][3].astype(int)
    after = env.step(act(0, 1.0))[0]["state"][3].astype(int)
    changed = np.abs(after - before) > 8
    assert changed[:, 42:].sum() > 3 * changed[:, :42].sum() and changed.sum() > 10
    # nothing above the horizon, the table from row 70 down, 120 of 255
    assert before[:50].max() == 0 and before[69, 0] == 0 and abs(before[72, 0] - 120) <= 1
    stacking_env.empty_world(env._bullet)
    stacking_env.add_shape(env._bullet, LARGEST["cube"] - 5, (0, 0.48, 3), (1, 1, 1))
    seen = stacking_env.photograph(env._bullet, stacking_env.FRONT)[:60, :, 0] > 0
    assert abs(seen.any(0).sum() - 14.5 * 0.96) <= 1  # pixels; its front is at y = 0


def test_views_repeat_for_any_workers_order_and_number():
    ids = [700, 3, 500, 809]
    one = action_observations(ids, 6, "image", seed=2, workers=1)
    assert one.shape == (4, 6, 84, 84) and one.dtype == np.uint8
    assert np.array_equal(one, action_observations(ids, 6, "image", seed=2, workers=3))
    assert np.array_equal(one[1:2, :4], action_observations([3], 4, "image", seed=2))


def test_viewpoints_lie_on_the_published_circles(monkeypatch):
    eyes, blank = [], np.zeros((84, 84, 3))
    monkeypatch.setattr(stacking_env, "photograph", lambda _, c: eyes.append(c[0]) or blank)
    stacking_env._views(12, 400, 0)
    x, y, z = np.array(eyes).T
    assert np.allclose(np.hypot(x, y), 2.0) and 0.5 <= z.min() < 0.52 and 1.98 < z.max() <= 2.0
    assert abs(np.cos(np.arctan2(y, x)).mean()) < 0.1 and abs(z.mean() - 1.25) < 0.08


@pytest.mark.parametrize("bad, word", [
    ({"modality": "video"}, "video"), ({"num_observations": 0}, "0"), ({"workers": 0}, "processes"),
    ({"seed": -1}, "negative"), ({"action_ids": [810]}, "809"), ({"action_ids": [1.5]}, "integers"),
])  # fmt: skip
def test_bad_requests_for_observations_are_refused(bad, word):
    with pytest.raises(ValueError, match=word):
        action_observations(**({"action_ids": [1], "num_observations": 2} | bad))


# ---- physics ----


@pytest.mark.parametrize("early_stop, every, slide, lean", [
    (True, 1, 0.002, 0.01), (False, 29, 0.006, 0.03),
])  # fmt: skip
def test_every_shape_comes_to_rest_where_it_was_put(early_stop, every, slide, lean):
    """Let go 2 cm over the table: no sinking, no exploding, no sliding, no tipping."""
    env = StackingEnv(early_stop=early_stop)
    env.reset(seed=0)
    for shape_id in range(0, 810, every):
        stacking_env.empty_world(env._bullet)
        env._bodies, env.shape_ids = [], []
        env._drop(shape_id, 0.3, 0.0, 0.0, (1, 1, 1))
        (start,), (upright,) = env.poses()
        env._settle()
        (end,), (rotation,) = env.poses()
        assert np.abs(start - end - (0, 0, stacking_env.DROP_GAP)).max() < slide, shape_id
        assert np.abs(rotation - upright).max() < lean, shape_id
    env.close()


@pytest.mark.parametrize("name", IDS)
def test_bullet_has_mass_1_the_true_inertia_and_the_centre_of_mass(name):
    family, scale, angle = SHAPES[LARGEST[name]]
    com, axes, moments = stacking_env.mass_properties(family)
    bullet, origin = Bullet(), np.array([0.3, -0.2, 0.5])
    number = stacking_env.add_shape(bullet, LARGEST[name], origin, (1, 1, 1))
    mass, friction, inertia = bullet.getDynamicsInfo(number, -1)[:3]
    assert mass == 1 and friction == 1 and np.allclose(inertia, moments * scale**2, rtol=1e-5)
    position, quaternion = bullet.getBasePositionAndOrientation(number)
    upright = Rotation.from_euler("z", angle)
    assert np.allclose(position, origin + scale * upright.apply(com), atol=1e-6)
    body = Rotation.from_quat(quaternion).as_matrix()
    assert np.allclose(body, (upright * axes).as_matrix(), atol=1e-6)


@pytest.mark.parametrize("policy, episodes, low, high", [
    ("random", 16, 1.2, 2.1),  # 1.60 expected; standard error .11
    ("greedy", 10, 4.0, 6.6),  # 5.14 expected; standard error .35
])  # fmt: skip
def test_play_reaches_the_expected_height(env, policy, episodes, low, high):
    heights = [stacking_env.play(env, seed, policy)[0] for seed in range(episodes)]
    assert low < np.mean(heights) < high


def test_one_seed_builds_one_tower_bit_for_bit_whatever_came_before(env):
    def tower(env, seed):
        height, _ = stacking_env.play(env, seed, "random")
        return height, *(part.tobytes() for part in env.poses())

    first = tower(env, 1)
    for seed in range(100, 150):  # other episodes, of one drop each
        env.reset(seed=seed)
        env.step(act(seed % 20, 0.4))
    fresh = StackingEnv()
    assert tower(env, 1) == tower(fresh, 1) == first
    fresh.close()


@example(4600, [(0, 0.0)])  # thin, hits the table at 3.5 m/s and is met .05 inside it, slow already
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


# ---- rules ----


def test_start_two_equal_cylinders_apart_in_random_colours(env):
    sizes, colours = set(), set()
    for seed in range(40):
        obs, info = env.reset(seed=seed)
        (a, b), _ = env.poses()
        assert env.shape_ids[0] == env.shape_ids[1] in stacking_env.CYLINDERS and info == {}
        assert -1 <= a[0] <= -0.3 and 0.3 <= b[0] <= 1 and 0.99 < b[0] - a[0] < 1.61
        assert 0.32 < a[2] < 0.36 and abs(a[2] - b[2]) < 1e-3 and abs(a[1]) < 1e-3
        assert obs["state"][:3].max() == 0 and obs["state"][3].max() > 0  # only the newest frame
        sizes.add(round(2 * SHAPES[env.shape_ids[0]].scale, 3))
        colours |= {env._bullet.getVisualShapeData(body)[0][7] for body in env._bodies}
    assert sizes == {0.657, 0.684, 0.712} and len(colours) == 80  # the published heights


def test_reward_is_eq_4_on_the_last_step_only(env):
    env.reset(seed=1)
    for step in range(1, 11):
        _, reward, terminated, truncated, info = env.step(act(step, -0.5 + step / 10))
        assert (terminated, truncated) == (False, step == 10)
        assert step == 10 or (reward == 0 and info == {})
    heights = [position[2] for position in env.poses()[0]]
    assert len(heights) == 12
    assert reward == pytest.approx(0.5 * max(heights) + 0.5 * sum(heights) / 12)
    assert info == {"height": max(heights)}


def test_stop_places_nothing_and_terminates(env):
    first, _ = env.reset(seed=4)
    before = env.poses()[0]
    obs, reward, terminated, truncated, info = env.step(act(3, 0.2, stop=1))
    assert terminated and not truncated and info["height"] == before[:, 2].max()
    assert np.array_equal(env.poses()[0], before) and len(env.shape_ids) == 2
    assert reward == pytest.approx(before[0, 2], abs=1e-3)  # empty table: the cylinders' height
    assert np.array_equal(obs["available"], first["available"])


@pytest.mark.parametrize("nothing", [act(7, -0.9), act(3, 1.0001), act(3, -5)])
def test_a_repeat_or_a_place_outside_changes_nothing_but_the_step_counter(env, nothing):
    env.reset(seed=5)
    once, *_ = env.step(act(7, 0.3))
    poses = env.poses()
    again, reward, terminated, truncated, _ = env.step(nothing)
    assert all(np.array_equal(a, b) for a, b in zip(env.poses(), poses, strict=True))
    assert np.array_equal(again["state"][3], once["state"][3]) and reward == 0
    assert np.array_equal(again["state"][:3], once["state"][1:]) and not (terminated or truncated)
    for step in range(3, 11):
        *_, truncated, info = env.step(nothing)
        assert truncated == (step == 10)
    assert info["height"] > 0.3 and len(env.shape_ids) == 3


@pytest.mark.parametrize("placement, dims", [("none", 0), ("1d", 1), ("2d", 2)])
def test_a_shape_is_let_go_at_its_place_just_above_everything(placement, dims, monkeypatch):
    env = StackingEnv(placement=placement)
    obs, _ = env.reset(seed=6)
    assert ("position" in env.action_space.spaces) == (dims > 0)
    settle, let_go = StackingEnv._settle, []
    monkeypatch.setattr(StackingEnv, "_settle", lambda e: let_go.append(e.poses()) or settle(e))
    for choice in range(5):
        corners = []  # of all shapes, in the world
        for i, centre, rotation in zip(env.shape_ids, *env.poses(), strict=True):
            com, axes, _ = stacking_env.mass_properties(SHAPES[i].family)
            own = SHAPES[i].scale * axes.inv().apply(SHAPES[i].family.points - com)
            corners += list(centre + own @ rotation.T)
        highest = np.max(corners, axis=0)[2]
        assert env.top() == pytest.approx(highest)
        place = np.array([0.7, -0.6])[:dims]
        env.step({"choice": choice, "stop": 0} | ({"position": place} if dims else {}))
        family, scale, angle = SHAPES[shape_id := int(obs["available"][choice])]
        com = Rotation.from_euler("z", angle).apply(stacking_env.mass_properties(family)[0])
        origin = np.append(place, np.zeros(2))[:2]
        bottom = highest + stacking_env.DROP_GAP - turned(shape_id)[:, 2].min()
        assert np.allclose(let_go[-1][0][-1], [*origin, bottom] + scale * com, atol=1e-5)
    env.close()


def test_bad_arguments_are_refused():
    for bad in ({"placement": "3d"}, {"render_mode": "human"}, {"num_available": 406}):
        with pytest.raises(ValueError, match=str(*bad.values())):
            StackingEnv(**bad)
    with pytest.raises(ValueError, match="3d"):
        make_vec(2, placement="3d")


def test_bad_actions_are_refused_and_leave_no_trace(env):
    env.reset(seed=8)
    before = env.poses()
    for bad, words in (
        (act(x=float("nan")), "position"), (act(x=-np.inf), "position"), (act(20), "choice"),
        (act(-1), "choice"), (act(stop=2), "stop"), ({"choice": 1, "stop": 0}, "position"),
        (act() | {"position": np.zeros(2)}, "position"), (act() | {"position": 0.5}, "position"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            env.step(bad)
    assert all(np.array_equal(a, b) for a, b in zip(env.poses(), before, strict=True))
    *_, truncated, _ = env.step(act() | {"position": [1]})  # whole numbers are fine
    assert not truncated and len(env.shape_ids) == 3 and env._steps == 1


# ---- interfaces ----


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_copies_are_refused_and_nobody_ends_anothers_simulation(env, duplicate):
    env.reset(seed=0)
    with pytest.raises(TypeError, match="do not copy"):
        duplicate(env)
    other = StackingEnv()
    other.reset(seed=0)
    other.close()
    other.close()
    del other
    env.step(act())
    assert len(env.poses()[0]) == 3


def test_no_bodies_clients_or_memory_are_left_behind(env):
    def memory():  # kB
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4

    clients, before = set(), 0
    for seed in range(160):
        env.reset(seed=seed)
        assert env._bullet.getNumBodies() == 3  # the table and two cylinders
        env.step(act(seed % 20, 0.2))
        before = memory() if seed == 80 else before
    assert memory() - before < 4_000  # with lists of vertices made anew: 200 kB per episode
    for _ in range(20):  # environments that nobody closes
        forgotten = StackingEnv()
        forgotten.reset(seed=0)
        clients.add(forgotten._bullet.client)
        del forgotten
    assert len(clients) <= 2


def test_the_example_in_the_docstring_runs_to_the_tenth_step():
    text, space = StackingEnv.__doc__, {"StackingEnv": StackingEnv}
    example = doctest.DocTestParser().get_doctest(text, space, "StackingEnv", None, None)
    assert len(example.examples) == 3
    assert doctest.DocTestRunner().run(example, clear_globs=False).failed == 0
    assert example.globs["env"]._steps == 10 and example.globs["info"]["height"] > 0.3


def test_processes_play_the_same_episodes_as_single_environments():
    envs, single = make_vec(2, seed=11), StackingEnv()
    single.reset(seed=np.random.SeedSequence(11).generate_state(2)[1])
    (obs, _), (expected, _) = envs.reset(), single.reset()
    for step in range(12):  # the first one stops in step 4, the second one plays to the end
        assert all(np.array_equal(obs[k][1], expected[k]) for k in obs)
        one, other = act(step, 0.5, stop=int(step == 3)), act(step, 0.1 * step - 0.5)
        obs, reward, *_, info = envs.step({k: np.array([one[k], other[k]]) for k in one})
        expected, single_reward, _, ended, single_info = single.step(other)
        assert single_reward == reward[1] and ended == (step == 9)
        if ended:
            assert info["final_info"]["height"][1] == single_info["height"]
            expected, _ = single.reset()
    envs.close()


def test_watching_shows_the_fall_and_changes_nothing(env):
    watched = StackingEnv(render_mode="rgb_array")
    for each in (watched, env):
        each.reset(seed=3)
        each.step(act(1, 0.8))
    frames = watched.render_frames()
    assert len(frames) >= 3 and not np.array_equal(frames[0], frames[-1])
    assert np.array_equal(watched.poses()[0], env.poses()[0])
    watched.close()


def test_a_tower_of_nine_metres_fits_beside_the_text_and_the_policys_view():
    env = StackingEnv(render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render().astype(int)
    stacking_env.add_shape(env._bullet, LARGEST["cube"], (-1, 0, 8.5), (0, 0, 0))
    rows, columns = np.nonzero(np.abs(env.render() - before).sum(axis=2))
    assert 0 < rows.min() < rows.max() < 60 and 100 < columns.min() < columns.max() < 336 - 84
    env.close()


def test_command_line(tmp_path):
    command = [sys.executable, "stacking_env.py", "--split", "full", "--out", str(tmp_path)]
    out = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert out.returncode == 0 and "greedy tower" in out.stdout, out.stderr
    names = ["stacking_greedy.gif", "stacking_random.gif", "stacking_shapes.png"]
    assert sorted(f.name for f in tmp_path.iterdir()) == names
    gif, sheet = Image.open(tmp_path / names[0]), Image.open(tmp_path / names[2])
    assert gif.n_frames > 15 and gif.size == (336, 336) and sheet.size == (12 * 84, 16 * 84)


def test_without_pybullet_one_sentence_says_what_is_missing():
    code = "import sys; sys.modules['pybullet'] = None; import stacking_env"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    last = out.stderr.splitlines()[-1]
    assert out.returncode == 1 and "needs pybullet" in last and "conda-forge" in last
