"""The contract that every environment file keeps, run over all four of them."""

import copy
import importlib
import inspect
import os
import subprocess
import sys
import types
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from PIL import Image

ROOT = Path(__file__).parent.parent
ENVIRONMENTS = {  # file -> (class, id, actions in all and in each part of the default split)
    "gridworld": ("GridWorldEnv", "GridWorld", (1024, 512, 256, 256)),
    "recsys": ("RecSysEnv", "RecSys", (10_000, 5_000, 2_500, 2_500)),
    "create_env": ("CreateEnv", "Create", (8_359, 1_097, 507, 506)),
    "stacking_env": ("StackingEnv", "Stacking", (810, 405, 202, 203)),
}


@pytest.fixture(params=ENVIRONMENTS)
def module(request):
    return importlib.import_module(request.param)


def make(module, **options):
    name = ENVIRONMENTS[module.__name__][1]
    return gym.make(f"ActionGen/{name}-v0", disable_env_checker=True, **options)


def equal(a, b):
    return all(np.array_equal(a[k], b[k]) for k in a)


def test_files_import_neither_torch_nor_each_other(module):
    others = {*ENVIRONMENTS, "hvae", "ppo_actiongen", "torch", "matplotlib.pyplot"} - {
        module.__name__
    }
    code = f"import sys, {module.__name__}; print('found', *set(sys.modules) & {others!r})"
    # A notebook's backend, inherited by a script, is none of its business.
    environ = os.environ | {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=environ
    )
    assert out.stdout.split()[-1:] == ["found"], out.stdout + out.stderr


def test_the_files_agree_to_the_letter_where_they_do_the_same():
    modules = [importlib.import_module(name) for name in ENVIRONMENTS]
    for name in ("check_ids", "save_gif"):
        assert len({inspect.getsource(getattr(m, name)) for m in modules}) == 1


def test_check_env_has_nothing_to_say(module, recwarn):
    env = make(module, render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=False)
    assert [str(w.message) for w in recwarn if "gymnasium" in str(w.filename)] == []
    env.close()


def test_splits_are_sorted_disjoint_and_of_the_papers_size(module):
    split, again = module.split_actions(), module.split_actions()
    total, *sizes = ENVIRONMENTS[module.__name__][2]
    assert total == module.NUM_ACTIONS and [*map(len, split.values())] == sizes
    for part, ids in split.items():
        assert np.array_equal(ids, np.unique(ids)) and np.array_equal(ids, again[part])
    together = np.concatenate([*split.values()])
    assert len(np.unique(together)) == len(together) and together.max() < module.NUM_ACTIONS
    assert not np.array_equal(split["train"], module.split_actions(seed=1)["train"])
    with pytest.raises(ValueError, match="nonsense"):
        module.split_actions("nonsense")


def test_representations_and_labels_have_one_row_per_action(module):
    table = module.engineered_representations()
    assert len(table) == module.NUM_ACTIONS and table.dtype == np.float32
    assert np.isfinite(table).all() and module.action_labels().shape == (module.NUM_ACTIONS,)


def test_action_observations_depend_on_the_seed_and_the_action_alone(module):
    for modality in module.MODALITIES:
        both = module.action_observations([3, 40], 4, modality, seed=np.int64(1))
        one = module.action_observations(np.array([40]), 4, modality, seed=1, workers=2)
        assert both.shape[:2] == (2, 4) and np.array_equal(both[1:], one)
        with pytest.raises(ValueError):
            module.action_observations([module.NUM_ACTIONS], 4, modality)
    for n, modality in ((4, "smell"), (0, (*module.MODALITIES, "")[0])):
        with pytest.raises(ValueError):
            module.action_observations([3], n, modality)


def play(module, seed, steps, n=3):
    pool, rng = module.split_actions()["valid"], np.random.default_rng(0)
    envs = module.make_vec(n, pool, 7, seed)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    envs.action_space.seed(int(rng.integers(100)))
    obs, _ = envs.reset()
    trace, scores = [obs], []
    for _ in range(steps):
        assert all(len(set(row)) == 7 for row in obs["available"].tolist())
        assert np.isin(obs["available"], [getattr(module, "NO_OP", pool[0]), *pool]).all()
        action = envs.action_space.sample()
        if isinstance(action, dict) and "stop" in action:
            action["stop"][:] = 0
        obs, reward, terminated, truncated, infos = envs.step(action)
        trace.append(copy.deepcopy(obs) | dict(reward=reward, ended=terminated, late=truncated))
        if (done := terminated | truncated).any():
            final = infos["final_info"]
            assert (infos["_final_info"] == done).all() and "episode" not in final
            scores += final[module.METRIC][done].tolist()
    envs.close()
    return trace, scores


def test_one_seed_gives_one_sequence_and_episodes_end_with_a_score(module):
    steps = 120 if module.__name__ == "recsys" else 35
    (a, scores), (b, again), (c, _) = (play(module, s, steps) for s in (5, np.int64(5), 6))
    assert scores and scores == again and all(map(equal, a, b))
    assert not all(map(equal, a, c))


def test_neighbouring_seeds_share_no_environment(module):
    pool = module.split_actions()["train"]
    first = []
    for seed in (0, 1):
        envs = module.make_vec(3, pool, 7, seed)
        first += envs.reset()[0]["available"].tolist()
        envs.close()
    assert len(set(map(tuple, first))) == 6


def test_seeds_are_judged_alike(module):
    env = make(module).unwrapped
    a, b = (env.reset(seed=seed)[0] for seed in (3, np.int64(3)))
    assert equal(a, b)
    for bad, error in ((-1, ValueError), (2.0, TypeError)):
        with pytest.raises(error):
            module.make_vec(1, module.split_actions()["valid"], 7, bad)
        with pytest.raises((error, gym.error.Error)):
            env.reset(seed=bad)
        with pytest.raises(error):
            module.split_actions(seed=bad)
    env.close()


def test_playing_leaves_the_global_random_state_alone(module):
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    play(module, 0, 3, n=1)
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


def test_with_the_whole_pool_on_offer_positions_have_a_fixed_meaning(module):
    pool = module.split_actions()["train"][:40]
    envs = module.make_vec(2, pool, len(pool) + hasattr(module, "NO_OP"), 0)
    first, second = (envs.reset()[0]["available"] for _ in range(2))
    assert (first == second).all() and (first[0] == first[1]).all()
    envs.close()


def test_bad_pools_are_refused(module):
    create = getattr(module, ENVIRONMENTS[module.__name__][0])
    unknown = [1, 2, module.NUM_ACTIONS]
    for pool, K in (([1, 2, 3], 5), ([1, 2, 2, 3], 2), (unknown, 2), ([1, 2, 3], 0), ([[1, 2]], 1),
                    ([1.0, 2.0], 2), ([-1, 2], 2), ([], 1)):  # fmt: skip
        with pytest.raises(ValueError):
            create(np.array(pool), K)


def test_a_step_before_the_reset_or_after_the_end_is_refused(module):
    env = make(module).unwrapped
    env.action_space.seed(0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.reset(seed=0)
    while not any(env.step(env.action_space.sample())[2:4]):
        pass
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())


def test_pictures_come_after_a_reset_and_only_where_they_were_asked_for(module):
    env, silent = make(module, render_mode="rgb_array").unwrapped, make(module).unwrapped
    for draw in (env.render, env.render_frames):
        with pytest.raises(gym.error.ResetNeeded):
            draw()
    env.reset(seed=0)
    frames = env.render_frames()
    assert np.array_equal(frames[-1], env.render()) and frames[-1].dtype == np.uint8
    silent.reset(seed=0)
    assert silent.render_frames() == []
    env.close(), silent.close()


def test_gymnasiums_wrappers_work(module, tmp_path, monkeypatch):
    """RecordVideo hands its frames to moviepy, which is not needed here: a stand-in counts them."""
    clips = []

    class Clip:
        def __init__(self, frames, fps):
            clips.append(frames)

        def write_videofile(self, *args, **kwargs):
            pass

    for name in (
        "moviepy",
        "moviepy.video",
        "moviepy.video.io",
        "moviepy.video.io.ImageSequenceClip",
    ):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    sys.modules[name].ImageSequenceClip = Clip
    env = make(module, render_mode="rgb_array")
    flat = gym.spaces.flatdim(env.observation_space)
    env = wrappers.RecordVideo(env, str(tmp_path / "videos"), episode_trigger=lambda episode: True)
    env = wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(env, max_episode_steps=2))
    env = wrappers.FlattenObservation(env)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (flat,)
    env.action_space.seed(0)
    total = 0.0
    for length in (1, 2):  # noqa: B007
        action = env.action_space.sample()
        if isinstance(action, dict) and "stop" in action:
            action["stop"] = np.int64(0)  # Shape Stacking goes on
        _, reward, terminated, truncated, info = env.step(action)
        total += reward
        if terminated or truncated:
            break
    assert info["episode"]["l"] == length and np.isclose(info["episode"]["r"], total, atol=1e-5)
    env.close()
    (frames,) = clips
    assert len(frames) == length + 1 and frames[0].ndim == 3


def test_a_gif_appears_whole_or_not_at_all(module, tmp_path):
    frames = [np.full((6, 5, 3), shade, np.uint8) for shade in (0, 255)]
    module.save_gif(tmp_path / "new" / "a.gif", frames, fps=10)
    with Image.open(tmp_path / "new" / "a.gif") as picture:
        assert (picture.size, picture.n_frames, picture.info["duration"]) == ((5, 6), 2, 100)
    with pytest.raises(IndexError):
        module.save_gif(tmp_path / "b.gif", [], fps=10)
    assert [p.name for p in tmp_path.rglob("*.*")] == ["a.gif"]
