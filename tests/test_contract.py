"""What every environment file has to hold; then what the four of this repository promise."""

import copy
import importlib
import inspect
import os
import subprocess
import sys
import zlib
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from PIL import Image

import hvae

ROOT = Path(__file__).parent.parent
DIAL = str(ROOT / "exercises/dial.py")  # an environment of one's own
ENVIRONMENTS = {  # file -> (class, id, actions in all and in each part of the default split)
    "gridworld": ("GridWorldEnv", "GridWorld", (1024, 512, 256, 256)),
    "recsys": ("RecSysEnv", "RecSys", (10_000, 5_000, 2_500, 2_500)),
    "create_env": ("CreateEnv", "Create", (8_359, 1_097, 507, 506)),
    "stacking_env": ("StackingEnv", "Stacking", (810, 405, 202, 203)),
}
CRC = dict(gridworld=3310007546, recsys=129395535, create_env=1111710827, stacking_env=2309518735)


def load(name):
    if name == "stacking_env":
        pytest.importorskip("pybullet", reason="Shape Stacking needs pybullet")
    return hvae.load_environment(name) if name == DIAL else importlib.import_module(name)


@pytest.fixture(params=[*ENVIRONMENTS, DIAL], ids=lambda name: Path(name).stem)
def environment(request):
    return load(request.param)


@pytest.fixture(params=ENVIRONMENTS)
def module(request):
    return load(request.param)


def make(module, **options):
    """The environment of this file, found as ppo_actiongen.py does; seven available actions."""
    classes = [x for x in vars(module).values() if isinstance(x, type) and issubclass(x, gym.Env)]
    (own,) = [x for x in classes if x.__module__ == module.__name__]
    pool = dict(action_pool=module.split_actions()["train"], num_available=7)
    spec = EnvSpec("Own-v0", own, disable_env_checker=True, kwargs=pool)
    return gym.make(spec, **options)


def equal(a, b):
    return all(np.array_equal(a[k], b[k]) for k in a)


# ---- every environment ----


def test_the_parts_of_every_split_are_known_and_disjoint(environment):
    for name in getattr(environment, "SPLITS", ("default",)):
        split = environment.split_actions(name, 1)
        assert list(split) == ["train", "valid", "test"]
        together = np.concatenate([*split.values()])
        assert len(np.unique(together)) == len(together) > 0
        assert together.min() >= 0 and together.max() < environment.NUM_ACTIONS
        assert getattr(environment, "NO_OP", -1) not in together
        assert equal(split, environment.split_actions(name, 1))


def test_representations_and_labels_have_one_row_per_action(environment):
    table = environment.engineered_representations()
    assert len(table) == environment.NUM_ACTIONS and table.dtype == np.float32
    assert np.isfinite(table).all()
    assert environment.action_labels().shape == (environment.NUM_ACTIONS,)


def test_action_observations_depend_on_the_seed_and_the_action_alone(environment):
    no_op = getattr(environment, "NO_OP", 0)  # an action like every other
    for modality in environment.MODALITIES:
        several = environment.action_observations([40, no_op, 3], 4, modality, 1)
        one = environment.action_observations(np.array([no_op]), 4, modality, 1, 2)  # 2 workers
        assert several.shape[:2] == (3, 4) and np.array_equal(several[1:2], one)


def test_check_env_has_nothing_to_say(environment, recwarn):
    env = make(environment, render_mode="rgb_array").unwrapped
    check_env(env, skip_render_check=False)
    assert [str(w.message) for w in recwarn if "gymnasium" in str(w.filename)] == []
    env.reset(seed=0)
    frames = env.render_frames()
    assert np.array_equal(frames[-1], env.render()) and frames[-1].dtype == np.uint8
    env.close()


def play(environment, seed, steps, n=3):
    pool = environment.split_actions()["valid"]
    envs = environment.make_vec(n, pool, 7, seed)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    envs.action_space.seed(0)
    obs, _ = envs.reset()
    trace, scores = [obs], []
    for _ in range(steps):
        assert all(len(set(row)) == 7 for row in obs["available"].tolist())
        assert np.isin(obs["available"], [getattr(environment, "NO_OP", pool[0]), *pool]).all()
        action = envs.action_space.sample()
        if isinstance(action, dict) and "stop" in action:
            action["stop"][:] = 0
        obs, reward, terminated, truncated, infos = envs.step(action)
        trace.append(copy.deepcopy(obs) | dict(reward=reward, ended=terminated, late=truncated))
        if (done := terminated | truncated).any():
            final = infos["final_info"]
            assert (infos["_final_info"] == done).all() and "episode" not in final
            scores += final[environment.METRIC][done].tolist()
    envs.close()
    return trace, scores


def test_one_seed_gives_one_sequence_and_episodes_end_with_a_score(environment):
    state = np.random.get_state()[1].tolist()  # noqa: NPY002
    steps = 120 if environment.__name__ == "recsys" else 35
    (a, scores), (b, again), (c, _) = (play(environment, s, steps) for s in (5, 5, 6))
    assert scores and scores == again and all(map(equal, a, b))
    assert not all(map(equal, a, c))
    assert np.random.get_state()[1].tolist() == state  # noqa: NPY002 (left alone)


def test_neighbouring_seeds_share_no_environment(environment):
    first = []
    for seed in (0, 1, [0, 1], [1, 1]):  # a list: a stream, as in ppo_actiongen.py
        envs = environment.make_vec(3, environment.split_actions()["train"], 7, seed)
        first += envs.reset()[0]["available"].tolist()
        again = envs.reset(seed=[5, 6, 7])[0]
        assert equal(again, envs.reset(seed=[5, 6, 7])[0])
        envs.close()
    assert len(set(map(tuple, first))) == 12


def test_gymnasiums_wrappers_work(environment):
    env = make(environment, render_mode="rgb_array")
    flat = gym.spaces.flatdim(env.observation_space)
    env = wrappers.RenderCollection(wrappers.TimeLimit(env, max_episode_steps=1))
    env = wrappers.FlattenObservation(wrappers.RecordEpisodeStatistics(env))
    assert env.reset(seed=0)[0].shape == (flat,)
    _, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert (terminated or truncated) and info["episode"]["l"] == 1
    assert info["episode"]["r"] == pytest.approx(reward, abs=1e-5)
    assert len(env.render()) == 2
    env.close()


# ---- the four of this repository, besides ----


def test_files_import_neither_torch_nor_each_other(module):
    others = {*ENVIRONMENTS, "hvae", "ppo_actiongen", "torch", "matplotlib.pyplot"}
    others -= {module.__name__}
    code = f"import sys, {module.__name__}; print('found', *set(sys.modules) & {others!r})"
    env = os.environ | {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    command = [sys.executable, "-c", code]
    out = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=env)
    assert out.stdout.split()[-1:] == ["found"], out.stdout + out.stderr


def test_the_four_have_the_same_names_and_the_same_small_functions(module):
    own = dict(gridworld="UNITS VARIANTS", create_env="UNITS TASKS NO_OP")
    own["stacking_env"] = "PLACEMENTS"
    names = "METRIC SPLITS MODALITIES NUM_ACTIONS NUM_AVAILABLE " + own.get(module.__name__, "")
    assert [name for name in names.split() if not hasattr(module, name)] == []
    assert {*getattr(module, "UNITS", {})} <= {"centre", "half_width", "step"}
    model = importlib.import_module("gridworld")
    for name in ("check_ids", "save_gif"):
        assert inspect.getsource(getattr(module, name)) == inspect.getsource(getattr(model, name))
    cls, id, _ = ENVIRONMENTS[module.__name__]
    assert gym.spec(f"ActionGen/{id}-v0").entry_point == f"{module.__name__}:{cls}"
    for variant in getattr(module, "VARIANTS", ()):
        assert len(module.engineered_representations(variant)) == module.NUM_ACTIONS


def test_make_vec_needs_no_more_than_a_number(module):
    envs = module.make_vec(2)
    available, train = envs.reset()[0]["available"], module.split_actions()["train"]
    assert available.shape == (2, module.NUM_AVAILABLE)
    assert np.isin(available, [getattr(module, "NO_OP", train[0]), *train]).all()
    envs.close()


def test_the_default_split_comes_first_and_is_of_the_papers_size(module):
    total, *sizes = ENVIRONMENTS[module.__name__][2]
    split = module.split_actions()
    assert total == module.NUM_ACTIONS and [*map(len, split.values())] == sizes
    assert equal(split, module.split_actions(module.SPLITS[0], seed=0))
    ids = np.concatenate([*split.values()]).astype("<i8")  # or earlier runs were trained on others
    assert zlib.crc32(ids.tobytes()) == CRC[module.__name__]
    assert not np.array_equal(split["test"], module.split_actions(seed=1)["test"])
    assert all((np.diff(ids) > 0).all() for ids in split.values())
    with pytest.raises(ValueError, match="nonsense"):
        module.split_actions("nonsense")


def test_what_does_not_exist_is_refused(module):
    for modality in module.MODALITIES:
        with pytest.raises(ValueError):
            module.action_observations([module.NUM_ACTIONS], 4, modality)
    with pytest.raises(ValueError):
        module.action_observations([3], 4, "smell")
    for bad, error in ((-1, ValueError), (2.0, TypeError)):
        with pytest.raises(error):
            module.make_vec(1, None, 7, bad)
        with pytest.raises(error):
            module.split_actions(seed=bad)
    create = getattr(module, ENVIRONMENTS[module.__name__][0])
    with pytest.raises(ValueError, match="human"):
        create(render_mode="human")
    unknown = [1, 2, module.NUM_ACTIONS]
    for pool, K in (([1, 2, 3], 5), ([1, 2, 2, 3], 2), (unknown, 2), ([1, 2, 3], 0), ([[1, 2]], 1),
                    ([1.0, 2.0], 2), ([-1, 2], 2), ([], 1), (5, 1)):  # fmt: skip
        with pytest.raises(ValueError):
            create(np.array(pool), K)


def test_with_the_whole_pool_available_positions_have_a_fixed_meaning(module):
    pool = module.split_actions()["train"][:40]
    envs = module.make_vec(2, pool, len(pool) + hasattr(module, "NO_OP"), 0)
    first, second = (envs.reset()[0]["available"] for _ in range(2))
    assert (first == second).all() and (first[0] == first[1]).all()
    envs.close()


def test_nothing_is_drawn_unasked_and_no_step_taken_outside_of_an_episode(module):
    env = make(module).unwrapped
    env.action_space.seed(0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.reset(seed=0)
    assert env.render_frames() == [] and env.render() is None
    while not any(env.step(env.action_space.sample())[2:4]):
        pass
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())


def test_a_gif_rests_on_its_end_and_appears_whole_or_not_at_all(module, tmp_path, monkeypatch):
    frames = [np.full((6, 5, 3), shade, np.uint8) for shade in (0, 255)]
    module.save_gif(tmp_path / "new" / "a.gif", frames, fps=10)
    with Image.open(tmp_path / "new" / "a.gif") as picture:
        assert (picture.size, picture.n_frames, picture.info["duration"]) == ((5, 6), 2, 100)
        picture.seek(1)
        assert picture.info["duration"] == 2000

    def full_disk(picture, file, name):
        file.write(b"GIF89a")
        raise OSError("no space left on device")

    monkeypatch.setitem(Image.SAVE_ALL, "GIF", full_disk)
    with pytest.raises(OSError):
        module.save_gif(tmp_path / "b.gif", frames, fps=10)
    assert [p.name for p in tmp_path.rglob("*.*")] == ["a.gif"]
