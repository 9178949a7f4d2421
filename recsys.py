"""Recommender System: a simulated user and 10,000 products (appendix A.2 and C.5).

A user alternates between browsing alone (organic session) and being shown recommendations (bandit
session). The agent sees the user as 16 numbers, picks one of the products on offer, and is paid 1
for a click. The user drifts all the time, so the same person slowly changes taste.

        reset                         +-- 0.05, or any click --+
          |                           |                        v
          +--> [organic session] --> [bandit: one recommendation]  -- 0.01 --> user leaves
                 stays 0.74   ^--------------- 0.94 ------^   (organic also leaves: 0.01 per view)

    python recsys.py                    # plays an episode, writes pictures, prints the ceilings

Paper map:  State A.2 -> RecSysEnv.reset, _draw     Eq. 2 -> click_probability
            Actions A.2 -> product_vectors, product_bias     Split A.2 -> split_actions
            Fully observable C.5 -> engineered_representations(fully_observable=True)
"""

import functools

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

# ---- constants (each with its source) ----
NUM_ACTIONS = 10_000  # A.2 "a total of 10,000 actions (products)"
DIM = 16  # A.2, Table 3: size of the user vector and of a product vector
METRIC = "ctr"  # A.2: click-through rate, clicks / recommendations of one episode
MODALITIES: tuple[str, ...] = ()  # A.2: engineered representations only, nothing to observe
NUM_AVAILABLE = 500  # Table 3 "actions per episode"
MAX_RECOMMENDATIONS = 100  # A.2, Table 3 "max. episode length"
A, B, C, D, E = 14.0, 2.0, 0.3, 2.0, 6.0  # Eq. 2
SIGMA_1 = 0.1  # A.2: scale of one perturbation of the user
USER_BOUND = 100.0  # ours: a Gaussian has no bound; its std stays below 2, so 100 is never met
MU_STD = 3.0  # published code; the appendix does not say how mu_i is distributed
ORGANIC, BANDIT, LEAVE = range(3)  # A.2 names the first two; leaving is "stochastically"
TRANSITIONS = np.array(  # published code; the appendix gives no numbers. Rows: now, columns: next
    [[0.74, 0.25, 0.01], [0.05, 0.94, 0.01], [0.0, 0.0, 1.0]]
)
SESSION_END = 1 - TRANSITIONS[ORGANIC, ORGANIC]  # 0.26: chance that a page view is the last one
SESSION_LEAVE = TRANSITIONS[ORGANIC, LEAVE] / SESSION_END  # 1/26: chance that it ends in leaving


# ---- the products: what an action is, and how the set is split (A.2) ----
@functools.lru_cache(maxsize=4)
def _products(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    c = rng.standard_normal((NUM_ACTIONS, DIM))  # (10_000, 16)
    # appendix: c ~ N(0, I), norm about 4; published code: scaled to length 1; we do the latter
    # because with norm 4 the taste c.v swamps the hidden mu, and partial observability is gone.
    c /= np.linalg.norm(c, axis=1, keepdims=True)
    mu = rng.normal(0.0, MU_STD, NUM_ACTIONS)  # (10_000,)
    c.setflags(write=False)  # the cache hands the same two arrays to everybody
    mu.setflags(write=False)
    return c, mu


def product_vectors(seed: int = 0) -> np.ndarray:
    """Return the vectors c_i of all products, (10_000, 16) float64 of unit length, read-only.

    Drawn once and shared by every environment, training seed and method, as in the published code.
    """
    return _products(seed)[0]


def product_bias(seed: int = 0) -> np.ndarray:
    """Return the constants mu_i of Eq. 2, (10_000,) float64, read-only: a product's popularity."""
    return _products(seed)[1]


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Cut the products at random 2:1:1 (A.2) into sorted ids "train", "valid", "test".

    5,000 / 2,500 / 2,500 ids, int64. Raises ValueError for any split but "default".
    """
    if split != "default":
        raise ValueError(f"split={split!r} is unknown; the Recommender System has only 'default'")
    order = np.random.default_rng(seed).permutation(NUM_ACTIONS)
    half, quarter = NUM_ACTIONS // 2, NUM_ACTIONS // 4
    parts = np.split(order, [half, half + quarter])
    return dict(zip(("train", "valid", "test"), map(np.sort, parts), strict=True))


def action_observations(action_ids, num_observations, modality, seed=0, workers=1) -> np.ndarray:
    """Raise ValueError: products come with engineered vectors, nobody observes them (A.2)."""
    raise ValueError(
        "recsys has no action observations; use the engineered representation "
        "(recsys.engineered_representations)"
    )


def engineered_representations(fully_observable: bool = False) -> np.ndarray:
    """Return what the policy may know about each product, float32.

    (10_000, 16): the vectors c_i (A.2). With `fully_observable` (C.5) (10_000, 17): mu_i appended.
    """
    c = product_vectors()
    if not fully_observable:
        return c.astype(np.float32)
    # Published code appends mu itself (std 3) to components of std 0.25; we divide by its std, so
    # that this one input does not drown the other sixteen at the start of learning.
    return np.column_stack([c, product_bias() / MU_STD]).astype(np.float32)


def action_labels() -> np.ndarray:
    """Return the class of each action, str array (10_000,): products have none, all "product"."""
    return np.full(NUM_ACTIONS, "product")


# ---- the user (A.2) ----
def click_probability(x: np.ndarray) -> np.ndarray:
    """Eq. 2: f(x) for x = c_i . v_user + mu_i, any shape. Between 0.0130 and 0.7311."""

    def sigmoid(y):
        return 1.0 / (1.0 + np.exp(-y))

    return sigmoid(A * sigmoid(B * sigmoid(C * x) - D) - E)


def organic_sessions(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Play n whole organic sessions at once: (sum of z squared, whether the user left), each (n,).

    A session is a loop: draw the next mode, perturb the user by 0.1 |z_k| n_k, until the mode is
    not organic. Its length is geometric. A sum of independent Gaussians with variances
    0.01 z_k^2 is one Gaussian with variance 0.01 sum z_k^2, and that sum is chi-squared; so three
    draws replace the loop without changing the distribution.
    """
    views = rng.geometric(SESSION_END, n)  # >= 1, mean 3.85
    return rng.chisquare(views), rng.random(n) < SESSION_LEAVE


def _check_pool(action_pool, num_available: int) -> np.ndarray:
    """Return the pool as sorted int64 ids; ValueError if it cannot serve `num_available` ids."""
    pool = np.sort(np.asarray(action_pool, dtype=np.int64).ravel())
    if pool.size and (pool[0] < 0 or pool[-1] >= NUM_ACTIONS):
        raise ValueError(f"action_pool holds ids {pool[0]}..{pool[-1]}; allowed 0..{NUM_ACTIONS - 1}")
    if np.any(pool[1:] == pool[:-1]):
        raise ValueError(f"action_pool repeats id {pool[:-1][pool[1:] == pool[:-1]][0]}")
    if not 1 <= num_available <= pool.size:
        raise ValueError(f"num_available={num_available}; allowed 1..{pool.size} (the pool's size)")
    return pool


def _spaces(num_available: int, unit_norm_state: bool) -> tuple[Dict, Discrete]:
    bound = 1.0 if unit_norm_state else USER_BOUND
    state = Box(-bound, bound, (DIM,), np.float32)
    available = Box(0, NUM_ACTIONS - 1, (num_available,), np.int64)
    return Dict(state=state, available=available), Discrete(num_available)


def _state(user: np.ndarray, unit_norm_state: bool) -> np.ndarray:
    """What the agent sees of the user, (..., 16) float32, always a fresh array."""
    # appendix: v_user itself; published code: v_user / norm, then running statistics; we return
    # v_user and leave scaling to the agent (the oracle loses nothing either way).
    if unit_norm_state:
        user = user / np.linalg.norm(user, axis=-1, keepdims=True)
    return user.astype(np.float32)


# ---- the environment, one user, written step by step ----
class RecSysEnv(gym.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}

    def __init__(
        self,
        action_pool=None,
        num_available: int = NUM_AVAILABLE,
        render_mode: str | None = None,
        fully_observable: bool = False,
        unit_norm_state: bool = False,
        no_repeat_reward: bool = False,
        leave_at_reset: bool = True,
    ):
        pool = split_actions()["train"] if action_pool is None else action_pool
        self.pool = _check_pool(pool, num_available)
        self.observation_space, self.action_space = _spaces(num_available, unit_norm_state)
        self.render_mode = render_mode
        self.unit_norm_state = unit_norm_state
        self.no_repeat_reward, self.leave_at_reset = no_repeat_reward, leave_at_reset
        self.c, self.mu = product_vectors(), product_bias()

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        num_available = int(self.action_space.n)
        if num_available == len(self.pool):  # a fixed order: position i always means product i
            self.available = self.pool.copy()
        else:
            self.available = self.np_random.choice(self.pool, num_available, replace=False)
        self.user = self.np_random.standard_normal(DIM)  # a new user every episode
        self.recommendations, self.clicks, self.clicked = 0, 0, set()
        self.mode = ORGANIC
        self._organic_session()
        # Published code does not notice a user who leaves in this first session (1 in 26): one
        # recommendation is still made, and a click brings the user back. Kept, because the
        # published scores contain it; `leave_at_reset=False` gives the clean rule instead.
        if self.mode == LEAVE and not self.leave_at_reset:
            self.mode = BANDIT
        return self._obs(), {}

    def step(self, action):
        if not self.action_space.contains(action):
            raise ValueError(f"action={action!r}; allowed 0..{self.action_space.n - 1}")
        product = int(self.available[action])
        # Every draw uses the user as just observed; the user changes only afterwards.
        p_click = click_probability(self.c[product] @ self.user + self.mu[product])
        click = bool(self.np_random.random() < p_click)
        reward = float(click and not (self.no_repeat_reward and product in self.clicked))
        if click:
            self.clicked.add(product)

        self._draw()
        if click:
            self.mode = ORGANIC  # a click opens a page, whatever was drawn, even "leave"
        self._organic_session()

        self.recommendations += 1
        self.clicks += int(reward)
        terminated = self.mode == LEAVE
        truncated = self.recommendations >= MAX_RECOMMENDATIONS
        info = self._final_info() if terminated or truncated else {}
        return self._obs(), reward, terminated, truncated, info

    def _draw(self) -> None:
        """One transition between sessions; each one perturbs the user, also if the mode stays."""
        self.mode = int(self.np_random.choice(3, p=TRANSITIONS[self.mode]))
        # appendix: covariance sigma_1 sigma_2 I with sigma_2 ~ N(0, 1), negative half of the time;
        # published code: standard deviation 0.1 |sigma_2|; we do the latter.
        sigma_2 = self.np_random.standard_normal()
        self.user = self.user + SIGMA_1 * abs(sigma_2) * self.np_random.standard_normal(DIM)

    def _organic_session(self) -> None:
        # Which products the user looks at is never observed, so only the views' number matters.
        while self.mode == ORGANIC:
            self._draw()

    def _obs(self) -> dict[str, np.ndarray]:
        state = _state(self.user, self.unit_norm_state)
        return {"state": state, "available": self.available.copy()}

    def _final_info(self) -> dict:
        ctr = self.clicks / self.recommendations
        episode = {"r": float(self.clicks), "l": self.recommendations}
        counts = {"clicks": self.clicks, "recommendations": self.recommendations}
        return {METRIC: ctr, **counts, "episode": episode}


# ---- the same rules on arrays, for training ----
class RecSysVectorEnv(VectorEnv):
    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int,
        action_pool,
        num_available: int,
        seed: int,
        fully_observable: bool = False,
        unit_norm_state: bool = False,
        no_repeat_reward: bool = False,
        leave_at_reset: bool = True,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs}; allowed 1, 2, ...")
        self.num_envs = num_envs
        self.pool = _check_pool(action_pool, num_available)
        spaces = _spaces(num_available, unit_norm_state)
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (batch_space(s, num_envs) for s in spaces)
        self.num_available, self.unit_norm_state = num_available, unit_norm_state
        self.no_repeat_reward, self.leave_at_reset = no_repeat_reward, leave_at_reset
        self.c, self.mu = product_vectors(), product_bias()
        self._rows = np.arange(num_envs)
        super().reset(seed=seed)  # so that reset() without a seed is determined by `seed`

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        n = self.num_envs
        self._bank = np.empty((0, self.num_available), np.int64)  # a fresh one: see _draw_available
        self.users = np.empty((n, DIM))
        self.available = np.empty((n, self.num_available), np.int64)
        self.gone = np.empty(n, bool)  # left during reset, not noticed yet
        self.recommendations = np.empty(n, np.int64)
        self.clicks = np.empty(n, np.int64)
        self._clicked = np.zeros((n, self.num_available), bool)  # by position; for no_repeat_reward
        self._start(self._rows)
        return self._obs(), {}

    def step(self, actions):
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or actions.min() < 0:
            raise ValueError(f"actions must be {self.num_envs} positions >= 0, got {actions}")
        rng, rows = self.np_random, self._rows
        ids = self.available[rows, actions]  # (N,)
        x = np.einsum("nd,nd->n", self.c[ids], self.users) + self.mu[ids]  # (N,)
        u_click, u_next = rng.random((2, self.num_envs))
        clicks = u_click < click_probability(x)
        rewards = clicks.astype(np.float64)
        if self.no_repeat_reward:
            rewards[self._clicked[rows, actions]] = 0.0
            self._clicked[rows, actions] |= clicks

        # Next mode: the unit interval is cut into [organic | leave | bandit].
        to_organic, to_leave = TRANSITIONS[BANDIT, ORGANIC], TRANSITIONS[BANDIT, LEAVE]
        organic = clicks | ((u_next < to_organic) & ~self.gone)
        left = ((u_next < to_organic + to_leave) | self.gone) & ~organic
        z2 = rng.standard_normal(self.num_envs) ** 2  # the transition's own perturbation
        browsing = np.flatnonzero(organic)
        session_z2, left[browsing] = organic_sessions(rng, browsing.size)
        z2[browsing] += session_z2
        noise = rng.standard_normal((self.num_envs, DIM))
        self.users += SIGMA_1 * np.sqrt(z2)[:, None] * noise  # (N, 1) * (N, 16)

        self.gone[:] = False
        self.recommendations += 1
        self.clicks += rewards.astype(np.int64)
        truncated = self.recommendations >= MAX_RECOMMENDATIONS
        done = left | truncated
        infos = {}
        if done.any():
            infos = self._final_infos(done)
            self._start(np.flatnonzero(done))
        return self._obs(), rewards, left, truncated, infos

    def _start(self, envs: np.ndarray) -> None:
        """Start a new episode in the environments with these indices."""
        users = self.np_random.standard_normal((envs.size, DIM))
        z2, left = organic_sessions(self.np_random, envs.size)
        noise = self.np_random.standard_normal((envs.size, DIM))
        self.users[envs] = users + SIGMA_1 * np.sqrt(z2)[:, None] * noise
        self.gone[envs] = left & self.leave_at_reset
        self.recommendations[envs] = self.clicks[envs] = 0
        if self.no_repeat_reward:
            self._clicked[envs] = False
        for i in envs:
            self.available[i] = self._draw_available()

    def _draw_available(self) -> np.ndarray:
        """Return num_available ids of the pool, each subset equally likely; (K,) int64.

        One random permutation of the pool is cut into blocks of K; each block alone is a uniform
        draw without replacement, and 10 blocks for the price of one make resets cheap.
        """
        if self.num_available == len(self.pool):
            return self.pool  # a fixed order: position i always means product i
        if len(self._bank) == 0:
            blocks = len(self.pool) // self.num_available
            order = self.np_random.permutation(self.pool)[: blocks * self.num_available]
            self._bank = order.reshape(blocks, self.num_available)  # (blocks, K)
        ids, self._bank = self._bank[0], self._bank[1:]
        return ids

    def _obs(self) -> dict[str, np.ndarray]:
        state = _state(self.users, self.unit_norm_state)
        return {"state": state, "available": self.available.copy()}

    def _final_infos(self, done: np.ndarray) -> dict:
        """The entries that gymnasium's SyncVectorEnv returns in SAME_STEP mode for ended episodes.

        Arrays are zero where no episode ended; the mask of key "k" is under "_k".
        """
        obs, final_obs = self._obs(), np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(done):
            final_obs[i] = {key: value[i].copy() for key, value in obs.items()}

        def masked(**arrays):
            return arrays | {f"_{key}": done.copy() for key in arrays}

        clicks = np.where(done, self.clicks, 0)
        length = np.where(done, self.recommendations, 0)
        final_info = masked(
            ctr=clicks / np.maximum(length, 1),
            clicks=clicks,
            recommendations=length,
            episode=masked(r=clicks.astype(np.float64), l=length.copy()),
        )
        return masked(final_obs=final_obs, final_info=final_info)


def make_vec(num_envs, action_pool, num_available, seed, **task_options) -> RecSysVectorEnv:
    """Make the batched environment; see RecSysVectorEnv for the task options."""
    return RecSysVectorEnv(num_envs, action_pool, num_available, seed, **task_options)


gym.register("ActionGen/RecSys-v0", entry_point=f"{__name__}:RecSysEnv")
