"""The contract every environment file keeps, run over all four of them."""

import importlib
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import ppo_actiongen

ROOT = Path(__file__).parent.parent
NAMES = list(ppo_actiongen.MODULES)
SIZES = {  # all actions, train, validation, test (appendix A; CREATE's no-op is in train and test)
    "gridworld": (1024, 512, 256, 256),
    "recsys": (10_000, 5_000, 2_500, 2_500),
    "create": (None, 1098, 507, 507),
    "stacking": (810, 405, 202, 203),
}


@pytest.fixture(params=NAMES)
def env_file(request):
    """(name, module) of each environment."""
    if request.param == "stacking":
        pytest.importorskip("pybullet")
    return request.param, importlib.import_module(ppo_actiongen.MODULES[request.param])


def test_files_import_neither_torch_nor_each_other(env_file):
    name, module = env_file
    others = {m for m in [*ppo_actiongen.MODULES.values(), "hvae", "torch"] if m != module.__name__}
    code = f"import sys, {module.__name__}; print(*sorted(set(sys.modules) & {others!r}))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert out.stdout.strip().splitlines()[-1:] in ([], [""]), out.stdout


def test_splits_are_sorted_disjoint_and_of_the_papers_size(env_file):
    name, module = env_file
    split = module.split_actions()
    total, *sizes = SIZES[name]
    assert total in (None, module.NUM_ACTIONS)
    assert [len(split[k]) for k in ("train", "valid", "test")] == sizes
    for ids in split.values():
        assert np.array_equal(ids, np.unique(ids)) and 0 <= ids[0] and ids[-1] < module.NUM_ACTIONS
    shared = 1 if name == "create" else 0  # the no-op belongs to every pool
    for a, b in (("train", "valid"), ("train", "test"), ("valid", "test")):
        assert len(np.intersect1d(split[a], split[b])) <= shared
    again = module.split_actions()
    assert all(np.array_equal(split[k], again[k]) for k in split)
    with pytest.raises(ValueError, match="nonsense"):
        module.split_actions("nonsense")


def test_representations_and_labels_have_one_row_per_action(env_file):
    _, module = env_file
    table = module.engineered_representations()
    assert table.shape[0] == module.NUM_ACTIONS and table.dtype == np.float32
    assert np.isfinite(table).all()
    assert module.action_labels().shape == (module.NUM_ACTIONS,)


def test_action_observations_repeat_and_do_not_depend_on_the_other_ids(env_file):
    _, module = env_file
    for modality in module.MODALITIES:
        both = module.action_observations(np.array([3, 40]), 4, modality, seed=1, workers=1)
        one = module.action_observations(np.array([40]), 4, modality, seed=1, workers=1)
        assert both.shape[:2] == (2, 4) and np.array_equal(both[1:], one)


def random_action(space, rng, n):
    """A batch of n random actions of a vector environment whose single space is `space`."""

    def draw(s):
        if isinstance(s, gym.spaces.Discrete):
            return rng.integers(s.n, size=n)
        return rng.uniform(-1, 1, (n, *s.shape)).astype(np.float32)

    if isinstance(space, gym.spaces.Dict):
        action = {k: draw(s) for k, s in space.spaces.items()}
        if "stop" in action:
            action["stop"] = (rng.random(n) < 0.2).astype(np.int64)
        return action
    return draw(space)


def play(module, seed, steps=25, n=3):
    pool = module.split_actions()["valid"]
    envs = module.make_vec(n, pool, 7, seed)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    rng, trace, scores = np.random.default_rng(0), [], []
    obs, _ = envs.reset()
    for _ in range(steps):
        offered = obs["available"]
        assert offered.shape == (n, 7) and np.issubdtype(offered.dtype, np.integer)
        assert all(len(set(row)) == 7 for row in offered.tolist())
        beyond = set(offered.ravel().tolist()) - set(pool.tolist())
        assert not beyond or (module.__name__ == "create_env" and len(beyond) == 1)  # the no-op
        obs, reward, terminated, truncated, infos = envs.step(
            random_action(envs.single_action_space, rng, n)
        )
        trace += [obs["state"].copy(), obs["available"].copy(), reward, terminated, truncated]
        done = terminated | truncated
        if done.any():
            final = infos["final_info"]
            assert (infos["_final_info"] == done).all()
            scores += final[module.METRIC][done].tolist()
            assert (final["episode"]["l"][done] >= 1).all()
    envs.close()
    return trace, scores


def test_one_seed_gives_one_sequence_and_episodes_end_with_a_score(env_file):
    name, module = env_file
    steps = 120 if name == "recsys" else 35 if name == "create" else 25
    (a, scores), (b, again), (c, _) = (play(module, s, steps) for s in (5, 5, 6))
    assert scores and scores == again
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    assert not all(np.array_equal(x, y) for x, y in zip(a, c, strict=True))


def test_with_the_whole_pool_on_offer_positions_have_a_fixed_meaning(env_file):
    _, module = env_file
    pool = module.split_actions()["train"][:40]
    envs = module.make_vec(2, pool, len(pool), 0)
    first, _ = envs.reset()
    second, _ = envs.reset()
    assert (first["available"] == second["available"]).all()
    assert (first["available"][0] == first["available"][1]).all()
    envs.close()


def test_bad_pools_are_refused(env_file):
    _, module = env_file
    for pool, K, word in (
        ([0, 1, 2], 4, "4"),
        ([0, 1, 1, 2], 2, "1"),
        ([0, 1, module.NUM_ACTIONS], 2, str(module.NUM_ACTIONS)),
        ([0, 1, 2], 0, "0"),
    ):
        with pytest.raises(ValueError, match=word):
            module.make_vec(1, np.array(pool), K, 0).reset()


def test_pictures_come_after_a_reset_and_only_where_they_were_asked_for(env_file):
    name, module = env_file
    make = getattr(module, {"gridworld": "GridWorldEnv", "recsys": "RecSysEnv",
                            "create": "CreateEnv", "stacking": "StackingEnv"}[name])  # fmt: skip
    env = make(render_mode="rgb_array")
    for draw in (env.render, env.render_frames):
        with pytest.raises(gym.error.ResetNeeded):
            draw()
    env.reset(seed=0)
    frames = env.render_frames()
    assert np.array_equal(frames[-1], env.render()) and frames[-1].dtype == np.uint8
    env.close()
    silent = make()
    silent.reset(seed=0)
    assert silent.render_frames() == []


def test_registered_environments_can_be_written_down(env_file):
    name, module = env_file
    ids = [i for i in gym.registry if i.startswith("ActionGen/") and module.__name__ in
           str(gym.spec(i).entry_point)]  # fmt: skip
    assert len(ids) == (13 if name == "create" else 1)
    for each in ids:
        assert module.__name__ in gym.spec(each).to_json()
