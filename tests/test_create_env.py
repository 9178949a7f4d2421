"""CREATE: the tables of the appendix, the physics, the rules, the pictures and the probe ball."""

import dataclasses
import math
import re
import subprocess
import sys
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pymunk
import pytest
from PIL import ImageColor
from pymunk import Vec2d

import create_env as c
from create_env import CreateEnv, SceneObject, Tool

SCRIPT = Path(c.__file__)
WAIT = {"choice": 0, "position": (0, 0)}
KINDS = list(dict.fromkeys(tool.kind for tool in c.TOOLS))
COARSE = [tool for tool, coarse in zip(c.TOOLS, c.IS_COARSE, strict=True) if coarse]
EXAMPLES = {kind: [tool for tool in COARSE if tool.kind == kind] for kind in KINDS}


def find_tool(kind: str, **values) -> int:
    """First id of a class with these parameters."""
    wanted = ((i, t) for i, t in enumerate(c.TOOLS) if t.kind == kind)
    return next(i for i, t in wanted if all(getattr(t, k) == v for k, v in values.items()))


def fixed_env(task: str, tool: int = 1, **options) -> CreateEnv:
    """An environment that offers the no-op (0) and one tool (1), just reset."""
    env = CreateEnv([tool], 2, task=task, **options)
    env.reset(seed=0)
    return env


def drop(tool: Tool | None, ball: tuple, velocity=(0.0, 0.0), at=(42.0, 42.0), steps=0):
    """A space with one tool and one ball after so many steps: (space, tool, ball)."""
    space, thing = c.make_space(), None
    if tool is not None:
        thing = SceneObject(tool, Vec2d(*at), space.static_body)
        space.add(*thing.parts)
    probe = SceneObject(c.PROBE_BALL, Vec2d(*ball), space.static_body)
    space.add(*probe.parts)
    probe.body.velocity = velocity
    for _ in range(steps):
        space.step(c.DT)
    return space, thing, probe


# ---- the action set ----

# fmt: off
# class: first id, 15-degree tools, default train, full train, full held out (published lists)
CLASS_TABLE = {
    "Ramp": (1, 180, 90, 180, 0), "Trampoline": (181, 180, 90, 180, 0),
    "Triangle": (361, 168, 84, 0, 168), "Bouncy Triangle": (529, 168, 84, 0, 168),
    "Square": (697, 105, 63, 0, 0), "Bouncy Square": (802, 105, 63, 0, 0),
    "Pentagon": (907, 105, 63, 0, 0), "Bouncy Pentagon": (1012, 105, 63, 0, 0),
    "Hexagon": (1117, 84, 42, 0, 0), "Bouncy Hexagon": (1201, 84, 42, 0, 0),
    "Hinged See-saw": (1285, 90, 45, 90, 0), "See-saw": (1375, 160, 80, 160, 0),
    "Cannon": (1535, 168, 84, 168, 0), "Fan": (1703, 168, 84, 0, 168),
    "Funnel": (1871, 120, 60, 0, 120), "Bucket": (1991, 120, 60, 120, 0),
    "Ball": (2111, 20, 0, 20, 0), "Bouncy Ball": (2131, 20, 0, 20, 0),
    "Lever": (2151, 55, 0, 0, 55), "Conveyor Belt": (2206, 120, 0, 0, 120),
}
# fmt: on


def test_class_table():
    default, full = c.split_actions("default", 1), c.split_actions("full", 1)
    held_out = np.concatenate([full["valid"], full["test"]])
    sets = (np.flatnonzero(c.IS_COARSE), default["train"], full["train"], held_out)
    counts = [Counter(c.TOOLS[i].kind for i in ids) for ids in sets]
    found = {kind: (find_tool(kind), *(count[kind] for count in counts)) for kind in CLASS_TABLE}
    assert found == CLASS_TABLE and set(KINDS) == {"No-op", *CLASS_TABLE}
    labels = c.action_labels()  # Table 1 to the letter
    train = "Ramp, Trampoline, Ball, Bouncy Ball, See-saw, Cannon, Bucket"
    test = "Triangle, Bouncy Triangle, Lever, Fan, Conveyor Belt, Funnel"
    assert set(labels[full["train"]]) == set(train.split(", "))
    assert set(labels[full["valid"]]) == set(labels[full["test"]]) == set(test.split(", "))


def physics_of(tool: Tool) -> tuple:
    """All that makes a tool behave as it does, whatever its id and its class are called."""
    thing = SceneObject(tool, Vec2d(42, 42), pymunk.Space().static_body)
    shape, kind = thing.shape, thing.kind
    corners = sorted((round(x, 6), round(y, 6)) for x, y in thing.corners)
    aimed = kind.contact in (c.CANNON, c.FAN, c.FUNNEL, c.BUCKET)
    what = (*corners, shape.elasticity, shape.friction, shape.collision_type, shape.radius)
    more = (tool.max_angle, tool.mass, tool.left_up, tool.force, tool.speed, tool.angle * aimed)
    return (*what, *more, tool.damping * (kind.contact == c.PLANK))


def test_no_two_tools_are_one_tool_so_no_split_has_a_twin_on_both_sides():
    assert len({physics_of(tool) for tool in c.TOOLS}) == len(c.TOOLS)


@pytest.mark.parametrize("seed", [0, 1, 2, 10**6])
def test_splits_have_the_papers_sizes_and_a_group_shares_no_angle(seed):
    sizes = {"default": [1097, 507, 506], "full": [938, 400, 399], "analysis": [761, 3397, 3397]}
    sizes["random"] = sizes["default"]
    for split in c.SPLITS:
        parts = c.split_actions(split, seed)
        assert [len(ids) for ids in parts.values()] == sizes[split]
        held_out = np.concatenate([parts["valid"], parts["test"]])
        groups = c.TRAINING_ANGLES if split in ("default", "random") else {}
        for group, published in groups.items():
            ids = np.flatnonzero(np.isin(c.TOOL_KINDS, group))
            a = set(c.TOOL_ANGLES[np.intersect1d(ids, parts["train"])])
            b = set(c.TOOL_ANGLES[np.intersect1d(ids, held_out)])
            assert a and b and not a & b
            assert split == "random" or a == set(published)  # whatever the seed
    assert not np.array_equal(*(c.split_actions("random", s)["train"] for s in (seed, seed + 1)))


def test_angle_gaps_of_the_analysis_as_counted_class_by_class():
    parts = c.split_actions("analysis")
    gaps = c.angle_gaps(np.concatenate([parts["valid"], parts["test"]]), parts["train"])
    assert [int((gaps >= d).sum()) for d in (15, 12, 9, 6, 3)] == [926, 2393, 3860, 5327, 6794]
    ramp = [find_tool("Ramp", angle=angle) for angle in (0, 177, 90)]
    assert c.angle_gaps(ramp, ramp[:1]).tolist() == [0.0, 3.0, 90.0]  # 180 is 0 again
    assert c.angle_gaps([find_tool("Fan")], ramp).tolist() == [np.inf]
    with pytest.raises(ValueError, match="action ids must lie in 0.."):
        c.angle_gaps([1], [c.NUM_ACTIONS])


def test_engineered_representations_are_standardised_as_published():
    features = c.engineered_representations()
    assert features.shape == (c.NUM_ACTIONS, 30) and (features[:, :21].sum(axis=1) == 1).all()
    coarse = features[c.IS_COARSE, 21:].astype(np.float64)
    assert np.allclose(coarse.mean(0), 0, atol=1e-5) and np.allclose(coarse.std(0), 1, 1e-4)
    # published means and deviations are over 2,366 tools: ours and 40 boxes of no split
    levels = c.BALLS["elasticity"] + c.BOUNCY_BALLS["elasticity"]
    boxes = [(e, 0, s, 0, 0, 0, 0, 0, 0) for e in levels for s in (5, 8, 11, 14)]
    numbers = np.array([t[1:10] for t in COARSE] + boxes, np.float64)
    numbers[:, [1, 4]] = np.radians(numbers[:, [1, 4]])
    mean = [0.37473, 1.21229, 8.31530, 0.20805, 0.06067, 0.54100, 0.03381, 11.71598, 0]
    std = [0.43465, 1.50205, 6.28853, 0.40996, 0.21500, 2.32116, 0.18075, 30.48934, 0.87706]
    assert np.allclose(numbers.mean(axis=0), mean, atol=6e-6)
    assert np.allclose(numbers.std(axis=0), std, atol=6e-6)


def test_a_new_class_is_the_docstrings_example(tmp_path):
    """The docstring's Octagon, written into a copy of the file, and a class without a turn."""
    source = SCRIPT.read_text(encoding="utf-8")
    (example,) = re.findall(r"^    (OWN_KINDS = {.*)}$", c.__doc__, re.M)
    more = example + ', "Vane": Kind("segment", ORANGE, vary={"angle": ANGLES, "size": (9,)})}'
    assert source.count("\nOWN_KINDS = {}") == 1
    source = source.replace("\nOWN_KINDS = {}", "\n" + more)
    (tmp_path / "more_env.py").write_text(source, "utf-8")
    code = """
import create_env as c, more_env as m, numpy as np
assert [tuple(t) for t in m.TOOLS[:8359]] == [tuple(t) for t in c.TOOLS]
assert m.TOOL_KINDS[8359:].tolist() == 63 * ["Octagon"] + 24 * ["Vane"] and m.IS_COARSE[8359:].all()
for split in c.SPLITS:  # no other tool changes its part
    old, now = c.split_actions(split, 3), m.split_actions(split, 3)
    assert all(np.array_equal(old[part], now[part][now[part] < 8359]) for part in old)
    assert [int((ids >= 8359).sum()) for ids in now.values()] == [42 + 12, 11 + 6, 10 + 6]
assert m.TOOL_CLASSES[-2:] == ("Octagon", "Vane")
env = m.CreateEnv([8400], 2)
env.reset(seed=0)
env.step({"choice": 1, "position": (-0.2, 0.3)})
assert env.placement == "placed" and m.engineered_representations().shape == (8446, 32)
assert m.action_labels()[8400] == "Octagon" and m.action_observations([8400], 2).any()
"""
    code = f"import sys; sys.path[:0] = {[str(tmp_path), str(SCRIPT.parent)]!r}" + code
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_new_task_is_the_docstrings_example(monkeypatch):
    example = c.__doc__[c.__doc__.index('    TASKS["gap"]') : c.__doc__.index("A tool class of")]
    monkeypatch.setattr(c, "TASKS", dict(c.TASKS))
    exec("if True:\n" + example, vars(c))
    env, seen = CreateEnv(task="gap"), set()
    for seed in range(3):
        env.reset(seed=seed)
        x, y = env._target.place
        seen.add(x)
        assert y == c.to_units(0.6) and abs(x - c.to_units(-0.6)) <= 4.2
    assert len(seen) == 3 and not env.step(WAIT)[2]


# ---- the physics of single tools ----


def test_free_fall():
    for k, fallen in enumerate((1.733, 7.02, 15.87, 28.27), start=1):  # units after k actions
        y = drop(None, (42.0, 80.0), steps=40 * k)[2].body.position.y
        assert 80 - y == pytest.approx(fallen, abs=0.02)


@pytest.mark.parametrize("elasticity, apexes", [(0.8, (8.31, 5.30)), (1.0, (13, 13)),
    (1.2, (18.7, 26.9))])  # fmt: skip
def test_trampoline_apexes_scale_with_elasticity_squared(elasticity, apexes):
    space, _, ball = drop(Tool("Trampoline", elasticity, 0, 22), (42.0, 42 + 1 + 4 + 13))
    tops, rising = [], False
    while len(tops) < 2:
        space.step(c.DT)
        up = ball.body.velocity.y > 0
        tops += [ball.body.position.y - 47] if rising and not up else []
        rising = up
    assert tops == pytest.approx(apexes, abs=0.45)


@pytest.mark.parametrize("angle, force", [(0, 60), (105, 100), (240, 120)])
def test_cannon_shoots_from_its_mouth_and_fan_adds_force_over_300_per_step(angle, force):
    aim = math.radians(angle)
    ball = drop(Tool("Cannon", angle=angle, force=force), (42.0, 42.0), steps=1)[2]
    mouth = (42 + 5 * math.cos(aim), 42 + 3.65 * math.sin(aim))
    assert tuple(ball.body.position) == pytest.approx(mouth)
    shot = (force / 10 * math.cos(aim), force / 10 * math.sin(aim) - 2 / 30)
    assert tuple(ball.body.velocity) == pytest.approx(shot)
    ball = drop(Tool("Cannon", force=100), (42.0, 42.0), steps=41)[2]
    assert ball.body.position.x == pytest.approx(47 + 40 * 10 / 30)  # it is shot once
    space, _, ball = drop(Tool("Fan", angle=angle, force=force), (42.0, 42.0))
    ball.body.angle = 1.0  # the wind does not turn with the ball
    for k in range(1, 4):
        space.step(c.DT)
        gain = (k * force / 300 * math.cos(aim), k * (force / 300 * math.sin(aim) - 2 / 30))
        assert tuple(ball.body.velocity) == pytest.approx(gain)


def test_belts_and_ladders_carry_at_their_speed():
    for speed in (-6, 1, 5):
        belt, place = Tool("Conveyor Belt", size=24, speed=speed), (42.0, 46.9)
        before, after = (drop(belt, place, steps=k)[2].body for k in (19, 20))
        assert tuple(after.velocity) == (speed, pytest.approx(-2 / 30))
        assert before.position.y - after.position.y == pytest.approx(2 / 900)
    ladder = Tool("Ladder", angle=95, size=20, speed=4.0)
    ball = drop(ladder, (42.0, 40.0), steps=5)[2]
    assert tuple(ball.body.velocity) == pytest.approx((-1.3945, 3.9848 - 2 / 30), abs=1e-4)


def test_funnel_lets_the_ball_out_at_its_nozzle_and_is_solid_from_below():
    space, _, ball = drop(Tool("Funnel", angle=0, size=11), (43.0, 60.0))
    path = [(43.0, 60.0)]
    while path[-1][1] > 25:
        space.step(c.DT)
        path.append(tuple(ball.body.position))
    jump = next(b for a, b in zip(path, path[1:], strict=False) if a[1] - b[1] > 3)
    assert jump == pytest.approx((42.0, 31.0), abs=0.2)
    assert path[-1][0] == pytest.approx(42.0, abs=0.5)
    space, funnel, ball = drop(Tool("Funnel", angle=180, size=11), (42.3, 70.0))
    for _ in range(300):
        space.step(c.DT)
        assert math.dist(ball.body.position, funnel.corners[1]) > 3.5  # rolls off the tip


@pytest.mark.parametrize("other, x", [(None, 0), (Tool("Funnel", size=11), 42),
    (Tool("Cannon", angle=270, force=100), 38)])  # fmt: skip
def test_bucket_holds_a_ball_for_good_whatever_else_touches_it(other, x):
    space, _, ball = drop(other, (42.2, 52.0), at=(x, 34.0))
    bucket = SceneObject(Tool("Bucket", angle=0, size=3), Vec2d(42, 42), space.static_body)
    space.add(*bucket.parts)
    for _ in range(3000):
        space.step(c.DT)
    assert ball.held_by is bucket and ball.body.velocity.length < 0.1
    assert tuple(ball.body.position) == pytest.approx((42.0, 42.0), abs=0.1)


@pytest.mark.parametrize("kind", ["Hinged See-saw", "See-saw", "Level see-saw"])
def test_see_saws_keep_their_limit_and_their_centre(kind):
    tools = EXAMPLES.get(kind, [c.TASKS["seesaw"].items[1].tool])
    for i in np.random.default_rng(0).permutation(len(tools))[:12]:
        tool = tools[i]
        start = c.outline(tool)[1].angle
        for dx in (-6.0, 5.0):
            space, plank, _ = drop(tool, (42 + dx, 60.0), (0, -25.0))
            for _ in range(200):
                space.step(c.DT)
                assert abs(math.degrees(plank.body.angle + start)) <= tool.max_angle + 10
                assert math.dist(plank.body.position, (42, 42)) < 1
        if kind != "Hinged See-saw":  # starts low on the side of its weight, and stays there
            right_end, weight = c.outline(tool)[1], c.weight_place(tool)
            assert (right_end[1] < 0) == tool.left_up == (weight[0] > 0) and weight[1] < 0
            assert abs(drop(tool, (42.0, 500.0), steps=300)[1].body.angle) < math.radians(3)


def test_levers_damp_a_ball_and_ball_tools_give_no_spin():
    speeds = []
    for damping in (1.0, 1.1):
        lever = Tool("Lever", size=30, damping=damping, friction=0)
        speeds.append(drop(lever, (42.0, 46.0), (3.0, 0.0), steps=30)[2].body.velocity.x)
    assert speeds[0] > 2.5 and speeds[1] < 0.5 * speeds[0]
    ball = drop(c.TOOLS[find_tool("Ball", size=9)], (45.0, 58.0), steps=200)[2].body
    assert abs(ball.angular_velocity) < 1e-12 and ball.velocity.x > 0.5
    rough = drop(Tool("Ramp", 0.5, size=22), (38.0, 47.5), (4.0, 0.0), steps=40)[2].body
    assert abs(rough.angular_velocity) > 0.1  # friction gives spin


# ---- the levels ----

# Checksums of the 12 levels, which agree with a second typing of the published task files.
# fmt: off
LEVELS = {
    "push": 4210932188, "obstacle": 2486773148, "seesaw": 524385262, "navigate": 4051243966,
    "belt": 3305266569, "buckets": 2777755141, "cannon": 3417787106, "collide": 1431420209,
    "moving": 1456642797, "ladder": 3543628966, "basket": 1333958255, "funnel": 4232504059,
}
# fmt: on


@pytest.mark.parametrize("task", LEVELS)
def test_level_is_the_published_one(task):
    level = repr(c.TASKS[task])
    assert zlib.crc32(level.encode()) == LEVELS[task], f"{task} is no longer as published: {level}"


def test_level_shifts_stay_in_range_and_are_shared():
    push, funnel, seen, sides = CreateEnv(task="push"), CreateEnv(task="funnel"), [], set()
    starts = set()
    for seed in range(40):
        push.reset(seed=seed), funnel.reset(seed=seed)
        x, y = push._target.place
        assert (x, y) - push._objects[1].place == pytest.approx((0, 0.11 * 42))
        assert push._goal.place - push._objects[2].place == pytest.approx((0, 0.11 * 42))
        starts |= {push._marker.place, push._goal.place}
        seen.append((x / 42 - 1 - 0.1, y / 42 - 1 + 0.14))
        sides.add(round(funnel._goal.place.x / 42 - 1, 6))
    assert 0.15 < np.abs(seen).max() <= 0.2 and sides == {-0.28, 0.28} and len(starts) == 80


def wait_for_the_end(env: CreateEnv, action: dict = WAIT) -> list[float]:
    """The rewards of an episode in which nothing is done after the first action."""
    rewards, over = [], False
    while not over:
        _, reward, *ends, info = env.step(WAIT if rewards else action)
        rewards.append(reward)
        over = any(ends)
        assert info == ({"success": 0.0} if over else {})
    return rewards


def test_untouched_balls_are_gone_after_seven_actions_and_navigate_rests_after_twelve():
    for task in ("collide", "moving", "ladder", "basket", "buckets", "cannon"):
        assert wait_for_the_end(fixed_env(task)) == [pytest.approx(0.01)] * 7
    assert len(wait_for_the_end(fixed_env("navigate"))) == 12


def test_the_level_see_saw_shakes_so_that_an_episode_with_a_resting_target_goes_on():
    env, lengths = fixed_env("seesaw", find_tool("Ramp", angle=0, size=22)), []
    for seed in range(8):
        env.reset(seed=seed)
        lengths.append(len(wait_for_the_end(env, {"choice": 1, "position": (0.2, 0.6)})))
    assert np.median(lengths) == 30  # with firm joints 9.5


def move_ball(thing, x: float, y: float) -> None:
    thing.body.position, thing.body.velocity = (x, y), (0.0, 0.0)


def test_ball_in_the_level_bucket_is_at_rest():
    env = fixed_env("buckets")
    move_ball(env._target, c.to_units(0.05), 63.0)
    assert len(wait_for_the_end(env)) < 30
    assert tuple(env._target.body.position) == pytest.approx((44.1, 37.8), abs=0.01)


# ---- placing tools, rewards, ends ----


def test_small_tools_must_be_more_than_0_3_apart_and_shapes_must_not_touch():
    for gap, outcome in ((0.29, "too close"), (0.31, "placed")):
        env = fixed_env("moving", find_tool("Triangle", size=3))
        for x in (-0.2, -0.2 + gap):
            env.step({"choice": 1, "position": (x, 0.5)})
        assert env.placement == outcome
    for distance, outcome in ((6.9, "blocked"), (7.1, "placed")):  # radii of 3 and 4
        env = fixed_env("moving", find_tool("Ball", size=3))
        x, y = env._goal.place
        env.step({"choice": 1, "position": ((x + distance) / 42 - 1, y / 42 - 1)})
        assert env.placement == outcome


@pytest.mark.parametrize("task", ["basket", "seesaw", "push", "obstacle"])
def test_goals_and_subgoals_block_tools(task):
    env = fixed_env(task, find_tool("Triangle", size=3))
    for thing in (env._goal, *env._subgoals):
        env.step({"choice": 1, "position": thing.place / 42 - (1, 1)})
        assert env.placement == "blocked" and not env._centres


def test_outcomes_and_their_rewards():
    env = fixed_env("collide", find_tool("Ramp"))
    for choice, position, outcome, reward in (
        (0, (0.5, 0.5), "waited", 0.01),
        (1, (-0.5, -0.5), "placed", 0.01),
        (1, (-0.5, -0.6), "too close", 0.0),
        (1, (0.0, 0.25), "blocked", 0.0),
        (1, (1.0000001, 0.0), "outside", 0.0),
        (1, (0.3, -1.0000001), "outside", 0.0),
        (1, np.array([0, -1]), "placed", 0.01),  # whole numbers are numbers
    ):
        _, paid, *_ = env.step({"choice": choice, "position": position})
        assert (env.placement, paid) == (outcome, pytest.approx(reward))


@pytest.mark.parametrize("task, paid, reward", [("collide", True, 10.01), ("push", True, 11.01),
    ("push", False, 10.01)])  # fmt: skip
def test_goal_pays_ten_and_ends_and_in_push_the_target_hit_pays_with_it(task, paid, reward):
    env = fixed_env(task, subgoal_reward=paid)
    move_ball(env._target, *(env._goal.place + (7.0, 2.0)))
    assert env.step(WAIT)[1:] == (pytest.approx(reward), True, False, {"success": 1.0})
    if task == "push":
        env.reset(seed=0)
        env._target_hit = True
        move_ball(env._marker, *(env._goal.place + (7.0, 2.0)))
        assert not env.step(WAIT)[2]  # the wrong ball


@pytest.mark.parametrize("stays", [False, True])
def test_a_goal_touched_before_the_required_hit_counts_only_if_it_is_touched_then(stays):
    env = fixed_env("cannon")
    x, y = env._goal.place
    move_ball(env._target, x, y)
    env.step(WAIT)  # on the star, without a touch of the marker
    assert not env._goal_reached and not env._target_hit
    move_ball(env._target, *((x, y) if stays else (60.0, 56.0)))
    move_ball(env._marker, env._target.body.position.x, env._target.body.position.y + 7.9)
    _, reward, terminated, *_ = env.step(WAIT)
    assert env._target_hit and terminated == stays
    assert reward == pytest.approx(11.01 if stays else 1.01)


def test_target_counts_as_hit_from_3_56_units_and_obstacle_wants_the_marker_and_pays_two():
    for moved, reward in ((3.5, 0.01), (3.6, 1.01)):
        env = fixed_env("push")
        env._target.place -= (moved, 0.0)  # where it started
        assert env.step(WAIT)[1] == pytest.approx(reward)
    env = fixed_env("obstacle")
    env._target.place = Vec2d(0, 0)
    assert env.step(WAIT)[1] == pytest.approx(0.01)
    env._marker.touched = True
    assert env.step(WAIT)[1] == pytest.approx(2.01)
    assert env.step(WAIT)[1] == pytest.approx(0.01)  # once


@pytest.mark.parametrize("task, ball", [("seesaw", "_target"), ("obstacle", "_marker")])
@pytest.mark.parametrize("paid, reward", [(True, 2.01), (False, 0.01)])
def test_subgoal_pays_once_and_goes(paid, reward, task, ball):
    env = fixed_env(task, subgoal_reward=paid)
    subgoal = env._subgoals[0]
    for expected in (reward, 0.01):
        move_ball(getattr(env, ball), *subgoal.place)
        assert env.step(WAIT)[1] == pytest.approx(expected)
        assert not env._subgoals and subgoal not in env._objects
    move_ball(getattr(env, ball), 80.0, 80.0)
    x, y = map(int, subgoal.place)
    assert env.step(WAIT)[0]["state"][-1, 84 - y, x] == 255  # nor is it seen any more


def test_time_limit_truncates_and_balls_that_leave_terminate():
    env = fixed_env("push")
    env.task = dataclasses.replace(env.task, max_actions=2)
    assert env.step(WAIT)[2:4] == (False, False)
    assert env.step(WAIT)[2:] == (False, True, {"success": 0.0})
    env = fixed_env("push")
    move_ball(env._marker, -1.0, 40.0)
    assert env.step(WAIT)[2] is True
    env.reset(seed=0)
    env._target_hit = True  # then the marker does not matter any more
    move_ball(env._marker, -1.0, 40.0)
    assert env.step(WAIT)[2] is False
    for place in ((40.0, -5.0), (90.0, 40.0), (40.0, 90.0)):
        env = fixed_env("push")
        move_ball(env._target, *place)
        assert env.step(WAIT)[2] is True


# ---- what the agent sees and may do ----


class SlowCanvas:
    """The obvious picture without Pillow: which of a pixel's 25 points are in which shape?"""

    in_colour = False

    def __init__(self, fine: int = 5):
        at = (np.arange(84 * fine) + 0.5) / fine
        self.points = at[None, :] + 1j * at[::-1, None]  # row 0 is the top
        self.image = np.full(self.points.shape, 255.0)

    def polygon(self, corners, colour):
        z = [complex(*corner) for corner in corners]
        sides = [((self.points - a) / (b - a)).imag for a, b in zip(z, z[1:] + z[:1], strict=True)]
        inside = np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)
        self.image[inside] = ImageColor.getcolor(colour, "L")

    def line(self, points, width, colour):
        z = [complex(*point) for point in points]
        for a, b in zip(z, z[1:] or z, strict=False):
            along = np.clip(((self.points - a) / (b - a or 1)).real, 0, 1)
            near = np.abs(self.points - a - along * (b - a)) <= width / 2
            self.image[near] = ImageColor.getcolor(colour, "L")


@pytest.mark.parametrize("task", list(c.TASKS))
def test_picture_equals_the_slow_obvious_one(task):
    env = CreateEnv(range(c.NUM_ACTIONS), 50, task=task)
    env.reset(seed=4)
    env.action_space.seed(1)
    for _ in range(8):
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    slow = SlowCanvas()
    for thing in sorted(env._objects, key=lambda thing: thing.body is not None):
        now = (thing.body.position, thing.body.angle) if thing.body else (thing.place,)
        c.draw(slow, thing.tool, *now)
    slow = slow.image.reshape(84, 5, 84, 5).mean(axis=(1, 3))
    error = np.abs(observation["state"][-1] - slow)  # thin lines: a third of a unit
    assert error.mean() < 2 and (error > 100).mean() < 0.004


def test_frames_are_stacked_newest_last_after_black_upright_and_not_mirrored():
    env = CreateEnv(task="collide")
    first = env.reset(seed=0)[0]["state"]
    assert first.shape == (3, 84, 84) and first.dtype == np.uint8
    assert not first[:2].any() and first[2].max() == 255
    assert env._target.place.x > 42  # to the right in the world and in the picture
    for thing, grey in ((env._target, 138), (env._goal, 191)):
        assert first[2][int(84 - thing.place.y), int(thing.place.x)] == grey
    second = env.step(WAIT)[0]["state"]
    assert np.array_equal(second[1], first[2]) and not np.array_equal(second[2], second[1])
    assert not first[:2].any()  # earlier arrays are left alone
    second[2] = 7
    assert env.step(WAIT)[0]["state"][1].max() == 255  # and what is done to them has no effect


@pytest.mark.parametrize("colour", [False, True])
def test_every_class_has_its_own_look(colour):
    looks = set()
    for kind in KINDS[1:]:
        canvas = c.Canvas(84, colour)
        c.draw(canvas, EXAMPLES[kind][0], Vec2d(42, 42))
        assert canvas.picture().min() < 200, kind
        looks.add(canvas.picture().tobytes())
    assert len(looks) == len(KINDS) - 1
    c.draw(canvas, Tool("Lever", size=30), Vec2d(42, 42), math.pi / 2)
    assert canvas.picture()[30, 41:43].min() < 230  # it turns


def test_the_no_op_and_k_minus_1_tools_are_available():
    pool = c.split_actions()["valid"]
    env, seen = CreateEnv(pool, 50), set()
    for seed in range(60):
        available = env.reset(seed=seed)[0]["available"]
        assert available[0] == c.NO_OP and len(set(available)) == 50
        seen |= set(available[1:])
    assert seen <= set(pool) and len(seen) > 0.9 * len(pool)
    assert CreateEnv([0, *pool]).action_pool.tolist() == pool.tolist()


def test_bad_arguments_and_actions_change_nothing():
    env, clean = CreateEnv(), CreateEnv()
    env.reset(seed=0), clean.reset(seed=0)
    bad = [(choice, (0, 0)) for choice in (50, -1, 1.0)]
    bad += [(1, position) for position in ((math.nan, 0), (0, math.inf), (0, 0, 0), 0.5)]
    for choice, position in bad:
        with pytest.raises(ValueError, match="choice|position"):
            env.step({"choice": choice, "position": position})
    np.testing.assert_equal(env.step(WAIT), clean.step(WAIT))
    with pytest.raises(ValueError, match="unknown task 'pull'; allowed: push, "):
        CreateEnv(task="pull")


# pytest turns what a contact rule raises into a warning
@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_five_thousand_random_steps():
    rng, placed = np.random.default_rng(1), Counter()
    for task in c.TASKS:
        env = CreateEnv(task=task)
        env.reset(seed=1)
        for _ in range(5000 // len(c.TASKS)):
            tools = EXAMPLES[KINDS[rng.integers(len(KINDS))]]  # uniform over classes
            tool = tools[rng.integers(len(tools))]
            env.available[1] = c.TOOLS.index(tool)
            action = {"choice": 1, "position": rng.uniform(-1.02, 1.02, 2)}
            observation, reward, terminated, truncated, _ = env.step(action)
            assert math.isfinite(reward) and observation["state"][-1].std() > 0
            placed[tool.kind] += env.placement == "placed"
            if terminated or truncated:  # no lost or leaked parts, no NaN
                space, parts = env._space, sum(len(thing.parts) for thing in env._objects)
                assert len(space.bodies) + len(space.constraints) + len(space.shapes) == parts
                bodies = [thing.body for thing in env._objects if thing.body]
                assert np.isfinite([(*body.position, body.angle) for body in bodies]).all()
                env.reset()
    assert all(placed[kind] > 20 for kind in KINDS[1:]), placed


# Published: success in % and mean length of 2,000 random episodes, mean length of 200 no-op ones.
# fmt: off
PUBLISHED = {
    "push": (1.6, 10.1, 7.2), "navigate": (0.1, 13.6, 12.0), "obstacle": (0.0, 35.7, 40.1),
    "seesaw": (0.15, 14.2, 8.5), "belt": (0.0, 29.8, 30.0), "buckets": (0.6, 8.9, 7.0),
    "cannon": (0.35, 10.1, 7.0), "collide": (0.75, 11.6, 7.0), "moving": (2.5, 10.2, 7.0),
    "ladder": (0.3, 9.7, 7.0), "basket": (0.65, 10.2, 7.0), "funnel": (1.9, 15.3, 13.0),
}
# fmt: on


@pytest.mark.parametrize("task, episodes", [("push", 200), ("moving", 200)]
    + [pytest.param(task, 2000, marks=pytest.mark.slow) for task in c.TASKS])  # fmt: skip
def test_random_success_and_lengths_as_published(task, episodes):
    env, hits, lengths, waits = CreateEnv(task=task), 0, [], []
    for seed in range(episodes):
        hits += c.play_episode(env, seed)[2]
        lengths.append(env._actions)
    for seed in range(episodes // 10):
        env.reset(seed=seed)
        waits.append(len(wait_for_the_end(env)))
    success, length, wait = PUBLISHED[task]
    pooled = (hits + success * 20 + 1) / (episodes + 2002)  # published: 2,000 episodes
    error = math.sqrt(pooled * (1 - pooled) * (1 / episodes + 1 / 2000))
    assert abs(hits / episodes - success / 100) <= 3.5 * error, (hits / episodes, success, error)
    # Published episodes go on after the goal, and for one action after the limit (belt: 41 % end
    # there). In navigate planks of [code], which shake, delay the end: 13.6 actions, here 12.4.
    for found, expected, number, slack in (
        (lengths, length, 2000, 1.4 if task == "navigate" else 0.5),
        (waits, wait, 200, 0.46 if task == "belt" else 0.05),
    ):
        slack += 3.5 * np.std(found) * math.sqrt(1 / len(found) + 1 / number)
        assert abs(np.mean(found) - expected) <= slack, (np.mean(found), expected, slack)


# ---- the probe ball ----


def launch_alone(tool: Tool, place, start, velocity) -> tuple[np.ndarray, int]:
    """The slow obvious launch: one scene, contact by a query after every step."""
    space, thing, ball = drop(tool, c.to_units(start), tuple(velocity), c.to_units(place))
    contact, places = c.PROBE_STEPS + 1, []
    for step in range(1, c.PROBE_STEPS + 1):
        space.step(c.DT)
        touching = any(hit.shape is thing.shape for hit in space.shape_query(ball.shape))
        contact = min(contact, step) if touching else contact
        state = *ball.body.position, *ball.body.velocity
        places += [state] if step % c.PROBE_EVERY == 0 else []
    return np.array(places), contact


@pytest.mark.parametrize("kind", KINDS)
def test_launches_side_by_side_equal_launches_alone(kind):
    rng = np.random.default_rng(3)
    tool = EXAMPLES[kind][rng.integers(len(EXAMPLES[kind]))]
    places, start = rng.uniform(-0.7, 0.7, (12, 2)), rng.uniform(-1, 1, (12, 2))
    velocity = 25 * (places - start) / np.linalg.norm(places - start, axis=1, keepdims=True)
    states, contact = c._launch(tool, places, start, velocity)
    tolerance = 2.0 if kind == "See-saw" else 1e-4  # starts on its joint limit: rounding grows
    agree = 0
    for i in np.flatnonzero(contact):  # but for overlaps at launch
        alone, alone_contact = launch_alone(tool, places[i], start[i], velocity[i])
        assert np.abs(c.to_units(states[i, :, 2:4]) - alone[:, :2]).max() < tolerance
        assert np.abs(42 * states[i, :, 4:6] - alone[:, 2:]).max() < 100 * tolerance
        agree += abs(int(contact[i]) - alone_contact) <= 1
    # the query sees a teleported or held ball where it is now, the callback where it was
    assert agree >= (contact > 0).sum() - (4 if kind in ("Cannon", "Funnel", "Bucket") else 1)


@pytest.mark.parametrize("kind", KINDS)
def test_probe_trajectories_meet_the_tool(kind):
    states = c.action_observations([c.TOOLS.index(EXAMPLES[kind][-1])], 64, "state")[0]
    assert states.shape == (64, 7, 6) and states.dtype == np.float32 and np.isfinite(states).all()
    assert (np.abs(states[:, 0, :2]) <= 0.7).all()
    assert np.array_equal(states[..., :2], np.repeat(states[:, :1, :2], 7, axis=1))
    distance = np.linalg.norm(states[..., 2:4] - states[..., :2], axis=-1)  # (64, 7)
    assert 1.5 <= np.median(distance.argmin(axis=1)) <= 4.5
    assert (distance.min(axis=1) < 0.75).mean() > 0.95


def test_probe_balls_that_miss_or_begin_inside_are_launched_again(monkeypatch):
    calls, launch = [], c._launch
    monkeypatch.setattr(c, "_launch", lambda *a: calls.append(launch(*a)) or calls[-1])
    c.action_observations([find_tool("Ramp", size=6)], 200)
    again = [int(np.isin(contact, (0, c.PROBE_STEPS + 1)).sum()) for _, contact in calls]
    assert again[0] > 0 and [len(contact) for _, contact in calls] == [200, *again[:-1]]


def test_observations_of_all_modalities_are_of_the_same_scenes(capfd):
    ids = [5, 1500, 900, 2050]
    states = c.action_observations(ids, 3, "state", seed=4, workers=2)
    assert np.array_equal(states[..., 2:4], c.action_observations(ids, 3, "xy", seed=4))
    assert not np.array_equal(states[..., 2:4], c.action_observations(ids, 3, "xy", seed=5))
    assert capfd.readouterr().err == ""  # no bar where nobody watches
    with pytest.raises(ValueError, match="0 observations, must be at least 1"):
        c.action_observations([1], 0)


def test_videos_show_the_scenes_of_the_states():
    ids = [find_tool("Ball", size=9), find_tool("See-saw"), 0]
    states, video = (c.action_observations(ids, 8, kind) for kind in ("state", "video"))
    assert video.shape == (3, 8, 7, 48, 48) and video.dtype == np.uint8
    for frame, state in zip(video[0].reshape(-1, 48, 48), states[0].reshape(-1, 6), strict=True):
        for x, y in (state[:2], state[2:4]):  # the tool's grey is 159, that of the ball over it 163
            column, row = int(x * 24 + 24), int(24 - y * 24)
            if 0 <= column < 48 and 0 <= row < 48:
                assert 159 <= frame[row, column] <= 163
    assert (video[2].reshape(56, -1).min(axis=1) >= 163).all()  # the no-op has no picture


# ---- playing and the command ----


def test_play_follows_mouse_and_keys_without_a_display(monkeypatch):
    pytest.importorskip("matplotlib").use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.backend_bases import KeyEvent, MouseEvent

    env = CreateEnv([5, 900, 1500], 3, "rgb_array", "push")

    def events() -> None:
        figure = plt.gcf()
        menu, scene = figure.axes

        def send(event) -> tuple[int, str]:
            figure.canvas.callbacks.process(event.name, event)
            return env._actions, env.placement

        def click(axes, x, y) -> tuple[int, str]:
            x, y = axes.transData.transform((x, y))
            return send(MouseEvent("button_press_event", figure.canvas, x, y, 1))

        space = KeyEvent("key_press_event", figure.canvas, " ")
        figure.canvas.draw()
        assert click(scene, 500, 170) == (0, "waited")  # the policy's pictures
        assert click(scene, 150, 170) == (1, "waited")  # the no-op is chosen at first
        assert click(menu, 0.5, 1.5) == (1, "waited")
        assert menu.get_title() == f"chosen: {c.TOOLS[env.available[2]].kind}"
        assert click(scene, 150, 170) == (2, "placed")
        assert env._centres == [pytest.approx([150 / 210 - 1, 1 - 170 / 210])]
        env._actions = 29
        assert send(space) == (30, "waited") and env._over  # the end stays in view
        assert send(space) == (0, "waited") and not env._over  # the next episode
        assert menu.get_title() == "chosen: No-op"

    monkeypatch.setattr(plt, "show", events)
    c.play(env)
    plt.close("all")


@pytest.mark.parametrize(
    "arguments, files",
    [
        ("--tries 3 --task moving --tools Fan Funnel", {"create_moving.gif"}),
        ("--sheet tasks", {"create_tasks.png"}),
        ("--sheet tools", {"create_tools.png"}),
        ("--sheet probe --tools Bucket", {"create_probe.png"}),
        ("--task pull", None),
        ("--tools Spoon", None),
    ],
)
def test_command_draws_or_says_what_is_wrong(arguments, files, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "missing")  # of a notebook
    command = [sys.executable, SCRIPT, *arguments.split(), "--out", tmp_path / "new"]
    done = subprocess.run(command, capture_output=True, text=True)
    if files is None:
        assert done.returncode != 0 and "Traceback" not in done.stderr
        assert arguments.split()[0] in done.stderr and not (tmp_path / "new").exists()
    else:
        assert done.returncode == 0, done.stderr
        assert {path.name for path in (tmp_path / "new").iterdir()} == files
        assert "gif" not in done.stdout or "of 3 random episodes reach the goal" in done.stdout
