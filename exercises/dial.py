"""An environment of your own: turn a dial to its mark by turns of fixed angles nobody wrote on it.

    python ppo_actiongen.py exercises/dial.py --representation engineered    # a minute
    python hvae.py exercises/dial.py                  # an encoder, from recordings of turns
    python ppo_actiongen.py exercises/dial.py         # encoder and policy

The agent has four turns per episode. Of the 200 actions, 20 are available in an episode. This is
all that the scripts ask of an environment: tests/test_contract.py says it in code.
"""

from functools import partial

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from PIL import Image

NUM_ACTIONS = 200
METRIC = "success"
MODALITIES = ("angle",)  # what hvae.py can learn the actions from; (): nothing to record
DEFAULTS = dict(  # of ppo_actiongen.py
    num_available=20,
    minibatch_size=256,
    total_timesteps=60_000,
    eval_every=20_000,
    eval_episodes=1000,
    hvae_recipe="quick",
    published_init=False,
    ent_coef=0.01,
)
TURNS = np.random.default_rng(0).uniform(-np.pi, np.pi, NUM_ACTIONS)  # radians


def split_actions(split="default", seed=0):
    ids = np.random.default_rng(seed).permutation(NUM_ACTIONS)
    return {"train": np.sort(ids[:100]), "valid": np.sort(ids[100:150]), "test": np.sort(ids[150:])}


def action_observations(action_ids, num_observations, modality, seed=0, workers=1):
    """Recordings for hvae.py: angles of a dial before and after a turn, (len(ids), n, 2, 1)."""
    recorded = []
    for i in action_ids:
        start = np.random.default_rng([seed, i]).uniform(-np.pi, np.pi, num_observations)  # (n,)
        recorded.append(np.stack([start, start + TURNS[i]], axis=1))  # (n, 2)
    return np.array(recorded, np.float32)[..., None]


def engineered_representations():
    return np.stack([np.cos(TURNS), np.sin(TURNS)], axis=1).astype(np.float32)  # (200, 2)


def action_labels():
    return np.where(TURNS > 0, "left", "right")


def save_gif(path, frames, fps):
    first, *others = [Image.fromarray(frame) for frame in frames]
    first.save(path, save_all=True, append_images=others, duration=1000 / fps)


class DialEnv(gym.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}

    def __init__(self, action_pool, num_available=20, render_mode=None):
        self.action_pool = np.sort(action_pool)
        self.num_available = num_available
        self.render_mode = render_mode
        available = gym.spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64)
        state = gym.spaces.Box(-1, 1, (2,), np.float32)  # cos and sin of what is left to turn
        self.observation_space = gym.spaces.Dict(state=state, available=available)
        self.action_space = gym.spaces.Discrete(num_available)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.available = self.np_random.choice(self.action_pool, self.num_available, replace=False)
        self.left = self.np_random.uniform(-np.pi, np.pi)
        self.moves = 0
        return self._observe(), {}

    def step(self, action):
        self.left -= TURNS[self.available[action]]
        self.moves += 1
        success = bool(np.cos(self.left) > np.cos(0.2))
        late = self.moves == 4 and not success
        info = {METRIC: float(success)} if success or late else {}
        return self._observe(), float(success), success, late, info

    def _observe(self):
        state = np.array([np.cos(self.left), np.sin(self.left)], np.float32)
        return {"state": state, "available": self.available.copy()}

    def render(self):
        image = np.full((64, 64, 3), 255, np.uint8)
        x, y = (32 + 28 * np.array([np.sin(self.left), -np.cos(self.left)])).astype(int)
        image[y - 3 : y + 3, x - 3 : x + 3] = (200, 30, 30)
        return image

    def render_frames(self):
        return [self.render()]


def make_vec(num_envs, action_pool, num_available=20, seed=0):
    one = partial(DialEnv, action_pool, num_available)
    envs = SyncVectorEnv([one] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs
