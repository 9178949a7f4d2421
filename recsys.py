"""Recommender System: a simulated user and 10,000 products (appendix A.2 and C.5).

The agent recommends one product after another to a user and earns 1 for every click. It sees the
user as a vector of 16 numbers and every product as another one; it does not see how popular a
product is. In every episode 500 products are on offer; at test time they are products never used
in training.

      reset                   0.05, and after every click
        |                    +---------------------------+
        v                    v                           |
    a new user --> organic session (looks around) --> bandit session (one recommendation per step)
                       stays: 0.74         0.25         stays: 0.94
                         | 0.01                           | 0.01
                         v                                v
                        gone                             gone

Each of these draws also moves the user vector a little. The episode ends when the user is gone, or
after 100 recommendations.

Commands:

    python recsys.py                   # one user's episode as a GIF and a picture, the click curve
                                       # in runs/demo, a table of floors and ceilings (10 seconds)
    python recsys.py --policy oracle --pool train --num-available 50 --seed 3

Paper map (appendix -> here):

    A.2 Sessions (Figure 2)     TRANSITIONS, RecSysEnv._draw, RecSysEnv._organic_session
    A.2 State                   RecSysEnv.reset, RecSysEnv._draw
    A.2 Actions                 product_vectors, product_bias
    A.2 Click, Eq. 2            click_probability
    A.2 Reward                  RecSysEnv.step
    A.2 Action set split        split_actions
    C.5 Fully observable        engineered_representations(fully_observable=True)
    Table 3 (500 actions, 100)  NUM_AVAILABLE, MAX_RECOMMENDATIONS
"""

import functools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from PIL import Image

# ---- constants (each with its source) ----
NUM_ACTIONS = 10_000  # A.2 "a total of 10,000 actions (products)"
DIM = 16  # A.2, Table 3: size of the user vector and of a product vector
METRIC = "ctr"  # A.2: click-through rate, clicks / recommendations of one episode
MODALITIES: tuple[str, ...] = ()  # A.2: engineered representations only, nothing to observe
NUM_AVAILABLE = 500  # Table 3 "actions per episode"
MAX_RECOMMENDATIONS = 100  # A.2, Table 3 "max. episode length"
A, B, C, D, E = 14.0, 2.0, 0.3, 2.0, 6.0  # Eq. 2
SIGMA_1 = 0.1  # A.2: scale of one perturbation of the user
USER_BOUND = 100.0  # ours: a Gaussian has no bound; its std stays near 2, so 100 is never met
MU_STD = 3.0  # published code; the appendix does not say how mu_i is distributed
ORGANIC, BANDIT, GONE = range(3)  # A.2 names the first two and "terminates stochastically"
TRANSITIONS = np.array(  # published code; the appendix gives no numbers. Rows: now, columns: next
    [[0.74, 0.25, 0.01], [0.05, 0.94, 0.01], [0.0, 0.0, 1.0]]
)
SESSION_END = 1 - TRANSITIONS[ORGANIC, ORGANIC]  # 0.26: chance that a page view is the last one
SESSION_LEAVE = TRANSITIONS[ORGANIC, GONE] / SESSION_END  # 1/26: chance that it ends in leaving
TO_ORGANIC, TO_GONE = TRANSITIONS[BANDIT, ORGANIC], TRANSITIONS[BANDIT, GONE]


# ---- the products: what an action is, and how the set is split (A.2) ----


@functools.cache
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
    # appendix: mu_i is concatenated to c_i; published code: as it is (std 3, beside components of
    # std 0.25); we divide by its std, so that one input does not drown the other sixteen.
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


def _check_ids(ids: np.ndarray) -> np.ndarray:
    """Product ids as a 1-D int64 array; ValueError when one is not in 0..9999."""
    ids = np.asarray(ids)
    if ids.ndim != 1 or (ids.size and not np.issubdtype(ids.dtype, np.integer)):
        raise ValueError(
            f"action ids have shape {ids.shape} and type {ids.dtype}; allowed: 1-D int"
        )
    bad = ids[(ids < 0) | (ids >= NUM_ACTIONS)]
    if bad.size:
        raise ValueError(f"action id {bad[0]} does not exist; allowed: 0..{NUM_ACTIONS - 1}")
    return ids.astype(np.int64)


def _check_pool(action_pool: np.ndarray | None, num_available: int) -> np.ndarray:
    """The pool in ascending order (default: training products); ValueError when it is unusable."""
    pool = np.sort(_check_ids(split_actions()["train"] if action_pool is None else action_pool))
    if (repeated := pool[1:][pool[1:] == pool[:-1]]).size:
        raise ValueError(f"action id {repeated[0]} is in the pool twice; allowed: once")
    if not isinstance(num_available, int | np.integer) or not 1 <= num_available <= len(pool):
        raise ValueError(
            f"num_available is {num_available!r}; allowed: integers 1..{len(pool)} (the pool)"
        )
    return pool


def _observation_space(num_available: int, unit_norm_state: bool) -> gym.spaces.Dict:
    bound = 1.0 if unit_norm_state else USER_BOUND
    return gym.spaces.Dict(
        state=gym.spaces.Box(-bound, bound, (DIM,), np.float32),
        available=gym.spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
    )


def _state(users: np.ndarray, unit_norm_state: bool) -> np.ndarray:
    """What the agent sees of one or many users: (..., 16) float32, always a fresh array."""
    # appendix: v_user; published code: v_user / norm, then running mean and std; we return v_user
    # (the spec) and leave scaling to the learner.
    if unit_norm_state:
        users = (users / np.linalg.norm(users, axis=-1, keepdims=True)).clip(-1, 1)
    return users.astype(np.float32)


# ---- the environment: one user, one draw at a time ----


class RecSysEnv(gym.Env):
    """A user who is shown one product after another (appendix A.2).

    ## Description
    The user is a vector v of 16 numbers and is in one of three modes: organic (looks around
    alone), bandit (is shown a recommendation), gone. Every draw of the next mode, also one that
    changes nothing, perturbs the user: v + 0.1 |z| n with a scalar z ~ N(0, 1) and n ~ N(0, I).
    | now \\ next | organic | bandit | gone |
    |---|---|---|---|
    | organic | 0.74 | 0.25 | 0.01 |
    | bandit | 0.05 | 0.94 | 0.01 |
    A click overrides the draw: the user goes organic, even if the draw said gone. Product i is
    clicked with probability f(c_i . v + mu_i) (Eq. 2, `click_probability`), c_i of length 1,
    mu_i ~ N(0, 3^2): popularity outweighs taste, and c_i does not tell it.

    A.2 argues that a product cannot be recommended twice because the user drifts. With these
    numbers it can: always repeating the first-best product scores as well as the oracle, within
    0.01. `no_repeat_reward` turns what A.2 describes into a rule.

    ## Action Space
    `Discrete(K)`: a position in the `available` array of the last observation.

    ## Observation Space
    `Dict` of
    | key | space | meaning |
    |---|---|---|
    | state | Box(-100, 100, (16,), float32) | the user vector v (of length 1: `unit_norm_state`) |
    | available | Box(0, 9999, (K,), int64) | ids of the products on offer in this episode |

    ## Rewards
    1 for a click, else 0.

    ## Starting State
    v ~ N(0, I); an organic session runs before the first observation. `available` is drawn
    uniformly from `action_pool` without replacement. When num_available is the size of the pool,
    `available` is the pool in ascending order, always, so that one position means one product.

    ## Episode End
    `terminated` when the user leaves (0.0119 per recommendation without click, 0.0385 after a
    click), `truncated` after 100 recommendations. The last step's info holds `ctr` (clicks /
    recommendations), `clicks`, `recommendations` and `episode` = {"r": return, "l": length}.

    ## Arguments
    `action_pool`: distinct ids that `available` is drawn from (default: the training products).
    `num_available`: K (default 500, Table 3). `render_mode`: None or "rgb_array".
    `fully_observable` (C.5): accepted so that it can be passed as a task option; it changes what
    the policy is told about products (`engineered_representations`), nothing here.
    `unit_norm_state`: show v / |v|, as the published code does. `no_repeat_reward`: a product that
    was clicked earlier in the episode pays nothing more. `leave_at_reset`: see `reset`.
    ValueError for a pool with unknown or repeated ids or fewer than K of them, and for K < 1.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}

    def __init__(
        self,
        action_pool: np.ndarray | None = None,
        num_available: int = NUM_AVAILABLE,
        render_mode: str | None = None,
        fully_observable: bool = False,
        unit_norm_state: bool = False,
        no_repeat_reward: bool = False,
        leave_at_reset: bool = True,
    ):
        self.action_pool = _check_pool(action_pool, num_available)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; allowed: None, 'rgb_array'")
        self.render_mode = render_mode
        self.num_available = num_available
        self.observation_space = _observation_space(num_available, unit_norm_state)
        self.action_space = gym.spaces.Discrete(num_available)
        self.unit_norm_state = unit_norm_state
        self.no_repeat_reward = no_repeat_reward
        self.leave_at_reset = leave_at_reset
        self.c, self.mu = product_vectors(), product_bias()
        self._over = True  # nothing to step until the first reset

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """A new user, who looks around alone first; returns (observation, {}).

        The published code does not notice a user who leaves in that first session (1 in 26): one
        recommendation is still made, and a click brings the user back. We keep that, because the
        published scores contain it. With `leave_at_reset=False` nobody leaves before the first
        recommendation; every score rises by about 0.01.
        """
        super().reset(seed=seed)
        self.available = self.action_pool.copy()
        if self.num_available < len(self.action_pool):
            choice = self.np_random.choice
            self.available = choice(self.action_pool, self.num_available, replace=False)
        self.user = self.np_random.standard_normal(DIM)
        self.recommendations = self.clicks = 0
        self.clicked: set[int] = set()
        self.timeline: list[tuple | None] = []  # for render: None is a page view
        self._over = False
        self.mode = ORGANIC
        self._organic_session()
        if self.mode == GONE and not self.leave_at_reset:
            self.mode = BANDIT
        return self._observation(), {}

    def step(self, action: int):
        """Recommend one product; returns (observation, reward, terminated, truncated, info)."""
        if self._over:
            raise gym.error.ResetNeeded("the episode is over: call reset() before step()")
        if np.ndim(action) or np.asarray(action).dtype.kind not in "iu":
            raise ValueError(f"action is {action!r}; allowed: one integer")
        if not 0 <= action < self.num_available:
            raise ValueError(f"action is {action}; allowed: 0..{self.num_available - 1}")
        product = int(self.available[action])
        # The user clicks with the taste that the agent has seen; v changes only afterwards.
        p_click = click_probability(self.c[product] @ self.user + self.mu[product])
        click = bool(self.np_random.random() < p_click)
        # appendix: a second click on a product is unlikely, as the user drifts; published code: no
        # rule against it, and the drift is far too slow; we add no rule either, but offer the flag.
        reward = float(click and not (self.no_repeat_reward and product in self.clicked))
        if click:
            self.clicked.add(product)
        if self.render_mode is not None:
            self.timeline.append((float(p_click), reward > 0, *self._reference_probabilities()))

        self._draw()
        if click:
            self.mode = ORGANIC  # published code: overrides the draw (A.2: "can transition")
        self._organic_session()

        self.recommendations += 1
        self.clicks += int(reward)
        terminated = self.mode == GONE
        # published code: the limit is a true end; we report `truncated`, the learner may treat both
        # alike.
        truncated = not terminated and self.recommendations >= MAX_RECOMMENDATIONS
        self._over = terminated or truncated
        info = {}
        if self._over:
            info = {
                METRIC: self.clicks / self.recommendations,
                "clicks": self.clicks,
                "recommendations": self.recommendations,
                "episode": {"r": float(self.clicks), "l": self.recommendations},
            }
        return self._observation(), reward, terminated, truncated, info

    def _draw(self) -> None:
        """The next mode; every draw perturbs the user, also one that leaves the mode as it is."""
        # appendix: perturbed after each step; published code: after every draw, page views of an
        # organic session included; we do the latter.
        self.mode = int(self.np_random.choice(3, p=TRANSITIONS[self.mode]))
        # appendix: covariance sigma_1 sigma_2 I with sigma_2 ~ N(0, 1), negative half of the time;
        # published code: standard deviation 0.1 |sigma_2|; we do the latter, because a covariance
        # cannot be negative. One sigma_2 for all 16 dimensions. (The published code also shares one
        # sequence of sigma_2 among all parallel users, through a fixed seed; we do not.)
        sigma_2 = self.np_random.standard_normal()
        self.user = self.user + SIGMA_1 * abs(sigma_2) * self.np_random.standard_normal(DIM)

    def _organic_session(self) -> None:
        # Which products the user looks at is never observed; only the number of views matters.
        while self.mode == ORGANIC:
            self._draw()
            self.timeline.append(None)

    def _observation(self) -> dict[str, np.ndarray]:
        state = _state(self.user, self.unit_norm_state)
        return {"state": state, "available": self.available.copy()}

    def _reference_probabilities(self) -> tuple[float, float, float]:
        """Click probability now for the oracle's, the c-only and the average product on offer."""
        taste = self.c[self.available] @ self.user  # (K, 16) @ (16,) -> (K,)
        p = click_probability(taste + self.mu[self.available])
        return float(p.max()), float(p[taste.argmax()]), float(p.mean())

    def render(self) -> np.ndarray | None:
        """One picture of the episode so far: uint8 (480, 900, 3)."""
        if self.render_mode is None:
            gym.logger.warn("render() needs render_mode='rgb_array'; nothing is drawn")
            return None
        if not hasattr(self, "timeline"):
            raise gym.error.ResetNeeded("call reset() before the first render()")
        ending = ""
        if self._over:
            ending = "the user left" if self.mode == GONE else "time is up"
        return draw_timeline(self.timeline, ending)

    def render_frames(self) -> list[np.ndarray]:
        """Pictures of the last step: one here, as nothing moves between two recommendations.

        None at all without render_mode.
        """
        return [self.render()] if self.render_mode else []


gym.register("ActionGen/RecSys-v0", entry_point=f"{__name__}:RecSysEnv")


# ---- the same rules on arrays, for training ----


def organic_sessions(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Play n whole organic sessions at once: (sum of sigma_2 squared, the user left), both (n,).

    A session is a loop: draw the next mode and perturb the user, until the mode is not organic. Its
    length k is geometric. The perturbations 0.1 |z_j| n_j, j = 1..k, are Gaussian given the z_j,
    so their sum is 0.1 sqrt(z_1^2 + ... + z_k^2) n with a single n, and the sum of squares is
    chi-squared with k degrees of freedom. Three draws replace the loop, the distribution is exactly
    the same.
    """
    views = rng.geometric(SESSION_END, n)  # 1, 2, ..., mean 3.85
    return rng.chisquare(views), rng.random(n) < SESSION_LEAVE


class RecSysVectorEnv(VectorEnv):
    """`num_envs` users in numpy arrays, with the rules, spaces and infos of `RecSysEnv`.

    Ended episodes restart within the same step (SAME_STEP autoreset): the last observation and info
    of such an episode are in infos["final_obs"] and infos["final_info"], in the form in which
    gymnasium's SyncVectorEnv returns them. Arguments and errors: see `RecSysEnv` and `make_vec`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int,
        action_pool: np.ndarray | None = None,
        num_available: int = NUM_AVAILABLE,
        seed: int | None = None,
        fully_observable: bool = False,
        unit_norm_state: bool = False,
        no_repeat_reward: bool = False,
        leave_at_reset: bool = True,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; allowed: 1 or more")
        self.action_pool = _check_pool(action_pool, num_available)
        self.num_envs, self.num_available = num_envs, num_available
        self.single_observation_space = _observation_space(num_available, unit_norm_state)
        self.single_action_space = gym.spaces.Discrete(num_available)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.unit_norm_state = unit_norm_state
        self.no_repeat_reward = no_repeat_reward
        self.leave_at_reset = leave_at_reset
        self._np_random, self._np_random_seed = gym.utils.seeding.np_random(seed)
        self.c, self.mu = product_vectors(), product_bias()
        self._rows = np.arange(num_envs)
        self.users = np.zeros((num_envs, DIM))
        self.available = np.tile(self.action_pool[:num_available], (num_envs, 1))  # (N, K)
        self.recommendations, self.clicks = np.zeros((2, num_envs), np.int64)
        self._gone = np.zeros(num_envs, bool)  # left in the session before the first recommendation
        self._clicked = np.zeros((num_envs, num_available), bool)  # positions, for no_repeat_reward
        self._bank = None  # sets drawn ahead; None until the first reset

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start all episodes anew; returns (observations, {}). A seed reseeds the one generator."""
        super().reset(seed=seed)
        self._bank = np.empty((0, self.num_available), np.int64)
        self._start(self._rows)
        return self._observation(), {}

    def _start(self, envs: np.ndarray) -> None:
        """New episodes for the sub-environments `envs` (m,)."""
        users = self.np_random.standard_normal((len(envs), DIM))
        variance, left = organic_sessions(self.np_random, len(envs))
        noise = self.np_random.standard_normal((len(envs), DIM))
        self.users[envs] = users + SIGMA_1 * np.sqrt(variance)[:, None] * noise  # (m, 16)
        self._gone[envs] = left & self.leave_at_reset
        self.recommendations[envs] = self.clicks[envs] = 0
        self._clicked[envs] = False
        if self.num_available < len(self.action_pool):
            self.available[envs] = self._draw_available(len(envs))

    def _draw_available(self, count: int) -> np.ndarray:
        """`count` random sets from the pool: (count, K).

        Drawing the sets one by one would cost as much as the rest of the step. A random permutation
        of the pool, cut into blocks of K, gives many sets for the price of one, each of them
        exactly a uniform draw without replacement; only blocks of the same permutation depend on
        each other (they are disjoint). The bank holds one permutation per sub-environment and
        hands out first all their first blocks, then all their second blocks, ..., so that such
        blocks are far apart.
        """
        taken, self._bank = self._bank[:count], self._bank[count:]
        if len(taken) < count:
            blocks = len(self.action_pool) // self.num_available
            pool = np.tile(self.action_pool, (self.num_envs, 1))
            pool = self.np_random.permuted(pool, axis=1)[:, : blocks * self.num_available]
            bank = pool.reshape(self.num_envs, blocks, -1).swapaxes(0, 1)  # (blocks, N, K)
            bank = bank.reshape(-1, self.num_available)  # (blocks * N, K), first blocks first
            missing = count - len(taken)
            taken, self._bank = np.concatenate([taken, bank[:missing]]), bank[missing:]
        return taken

    def _observation(self) -> dict[str, np.ndarray]:
        state = _state(self.users, self.unit_norm_state)
        return {"state": state, "available": self.available.copy()}

    def step(self, actions: np.ndarray):
        """One recommendation to every user: `actions` int (N,), positions in `available`."""
        if self._bank is None:
            raise gym.error.ResetNeeded("call reset() before the first step()")
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or actions.dtype.kind not in "iu":
            raise ValueError(f"actions are {actions!r}; allowed: {self.num_envs} integers")
        if actions.min() < 0 or actions.max() >= self.num_available:
            raise ValueError(f"actions are {actions}; allowed: 0..{self.num_available - 1}")
        rng = self.np_random
        products = self.available[self._rows, actions]  # (N,) ids
        taste = np.einsum("nd,nd->n", self.c[products], self.users)  # (N, 16), (N, 16) -> (N,)
        u_click, u_mode = rng.random((2, self.num_envs))
        clicks = u_click < click_probability(taste + self.mu[products])
        rewards = clicks.astype(np.float64)
        if self.no_repeat_reward:
            rewards[self._clicked[self._rows, actions]] = 0.0
            self._clicked[self._rows, actions] |= clicks

        # The next mode: u_mode falls in [0, 0.05) organic, [0.05, 0.06) gone, [0.06, 1) bandit.
        # Somebody gone stays gone, unless a click (which overrides everything) says organic.
        organic = clicks | ((u_mode < TO_ORGANIC) & ~self._gone)
        gone = ((u_mode < TO_ORGANIC + TO_GONE) | self._gone) & ~organic
        # All perturbations of this step are one Gaussian, see organic_sessions.
        variance = rng.standard_normal(self.num_envs) ** 2
        browsing = organic.nonzero()[0]
        session_variance, gone[browsing] = organic_sessions(rng, len(browsing))
        variance[browsing] += session_variance
        noise = rng.standard_normal((self.num_envs, DIM))
        self.users += SIGMA_1 * np.sqrt(variance)[:, None] * noise  # (N, 1) * (N, 16)

        self._gone[:] = False  # whoever left in the first session is noticed now
        self.recommendations += 1
        self.clicks += rewards.astype(np.int64)
        truncated = (self.recommendations >= MAX_RECOMMENDATIONS) & ~gone
        infos = {}
        if (over := gone | truncated).any():
            infos = self._final_infos(over)
            self._start(over.nonzero()[0])
        return self._observation(), rewards, gone, truncated, infos

    def _final_infos(self, over: np.ndarray) -> dict:
        """Last observations and infos of the episodes in the mask `over`, as SyncVectorEnv does."""
        final_obs = np.full(self.num_envs, None, object)
        for i in over.nonzero()[0]:
            state = _state(self.users[i], self.unit_norm_state)
            final_obs[i] = {"state": state, "available": self.available[i].copy()}

        def masked(**values: np.ndarray) -> dict:  # key -> values where over, _key -> the mask
            masks = {f"_{key}": over.copy() for key in values}
            return {key: value * over for key, value in values.items()} | masks

        ctr = self.clicks / self.recommendations
        info = masked(ctr=ctr, clicks=self.clicks, recommendations=self.recommendations)
        episode = masked(r=self.clicks.astype(float), l=self.recommendations)
        info |= {"episode": episode, "_episode": over.copy()}
        return {
            "final_obs": final_obs,
            "_final_obs": over.copy(),
            "final_info": info,
            "_final_info": over.copy(),
        }


def make_vec(
    num_envs: int,
    action_pool: np.ndarray | None = None,
    num_available: int = NUM_AVAILABLE,
    seed: int = 0,
    **task_options: bool,
) -> RecSysVectorEnv:
    """`num_envs` users for training, all random draws from one generator seeded with `seed`.

    A first reset() without a seed is determined by `seed`; reset(seed=s) reseeds everything.
    `task_options`: fully_observable, unit_norm_state, no_repeat_reward, leave_at_reset.
    Raises ValueError for a bad pool, num_available or num_envs (see `RecSysEnv`).
    """
    return RecSysVectorEnv(num_envs, action_pool, num_available, seed, **task_options)


# ---- floors and ceilings: what could be reached ----


def oracle(users: np.ndarray, c: np.ndarray, mu: np.ndarray, rng) -> np.ndarray:
    """Greedy with everything known: users (N, 16), c (N, K, 16), mu (N, K) -> positions (N,)."""
    return (np.matmul(c, users[:, :, None])[:, :, 0] + mu).argmax(1)  # (N, K, 1) -> (N, K)


def c_only(users: np.ndarray, c: np.ndarray, mu: np.ndarray, rng) -> np.ndarray:
    """Greedy on taste, mu hidden: the ceiling for unseen products in the main experiment."""
    return np.matmul(c, users[:, :, None])[:, :, 0].argmax(1)


def mu_only(users: np.ndarray, c: np.ndarray, mu: np.ndarray, rng) -> np.ndarray:
    """The most popular product on offer, for every user the same."""
    return mu.argmax(1)


def random_choice(users: np.ndarray, c: np.ndarray, mu: np.ndarray, rng) -> np.ndarray:
    """Any product: the floor."""
    return rng.integers(mu.shape[1], size=len(mu))


POLICIES = {"oracle": oracle, "mu-only": mu_only, "c-only": c_only, "random": random_choice}


def reference_ctr(
    policy: str, pool: np.ndarray, num_available: int, episodes: int, seed: int, **task_options
) -> dict[str, float]:
    """Play `episodes` episodes with a policy of POLICIES, which is told the true user.

    Returns "ctr" (mean of the episodes' CTR, the published metric) with its "stderr", "pooled" (all
    clicks / all recommendations) and the mean "length". Every user slot plays a fixed number of
    episodes; stopping at the first `episodes` to finish would favour short ones.
    ValueError for an unknown policy, episodes < 1, or a bad pool.
    """
    if policy not in POLICIES:
        raise ValueError(f"unknown policy {policy!r}; allowed: {', '.join(POLICIES)}")
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}; allowed: 1 or more")
    num_envs = min(episodes, 100)  # ours: small enough for the cache
    left = np.full(num_envs, episodes // num_envs)  # episodes still to play in each slot
    left[: episodes % num_envs] += 1
    envs = make_vec(num_envs, pool, num_available, seed, **task_options)
    envs.reset()
    rng = np.random.default_rng([seed, 1])  # the policy's own draws
    c, mu = envs.c.astype(np.float32)[envs.available], envs.mu[envs.available]  # (N, K, 16), (N, K)
    clicks, lengths = [], []
    while left.any():
        infos = envs.step(POLICIES[policy](envs.users, c, mu, rng))[-1]
        if infos:
            over, info = infos["_final_info"], infos["final_info"]
            clicks.extend(info["clicks"][over & (left > 0)])
            lengths.extend(info["recommendations"][over & (left > 0)])
            left[over & (left > 0)] -= 1
            c[over], mu[over] = envs.c[envs.available[over]], envs.mu[envs.available[over]]
    ctr = np.divide(clicks, lengths)  # (episodes,)
    return {
        "ctr": float(ctr.mean()),
        "stderr": float(ctr.std() / np.sqrt(episodes)),
        "pooled": float(sum(clicks) / sum(lengths)),
        "length": float(np.mean(lengths)),
    }


# ---- pictures ----

POLICY_COLORS = {  # ours: one colour per policy in all pictures
    "oracle": "#2ca02c",
    "mu-only": "#9467bd",
    "c-only": "#1f77b4",
    "random": "#555555",
}
BROWSING = "#f3e3c3"  # ours: organic sessions


def draw_timeline(timeline: list[tuple | None], ending: str = "") -> np.ndarray:
    """One user's episode from left to right: uint8 (480, 900, 3).

    `timeline` has one entry per event: None for a page view of an organic session, else
    (click probability, clicked, and the probability of the oracle's, the c-only and the average
    product at that moment). `ending`: why the episode ended, shown at the last event.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # here: training needs no pictures
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.8), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1))
    figure.subplots_adjust(0.075, 0.105, 0.985, 0.86, hspace=0.08)
    views = np.array([event is None for event in timeline], bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], views, [0]])))  # start, end, start, ...
    spans = [(start, end - start) for start, end in edges.reshape(-1, 2)]
    for panel in (axes, lower):
        panel.broken_barh(spans, (0, 1), color=BROWSING, linewidth=0)
        panel.spines[["top", "right"]].set_visible(False)
    x = np.flatnonzero(~views) + 0.5  # middles of the recommendations' slots
    shown = np.array([event for event in timeline if event is not None], float).reshape(-1, 5)
    p, clicked, *references = shown.T  # each (recommendations,)
    clicked = clicked > 0
    for name, line in zip(("oracle", "c-only", "random"), references, strict=True):
        axes.plot(x, line, color=POLICY_COLORS[name], linewidth=1.4)
    axes.vlines(x, 0, p, color="#dddddd", linewidth=1, zorder=1)
    axes.plot(x[~clicked], p[~clicked], "o", mfc="white", mec="#444444", markersize=4.5)
    axes.plot(x[clicked], p[clicked], "o", color="#d62728", markersize=6)
    axes.axhline(click_probability(1e3), color="black", linewidth=0.8, linestyle=":")  # the limit
    axes.set(ylim=(0, 0.78), ylabel="click probability")
    rate = clicked.cumsum() / np.arange(1, len(p) + 1)
    lower.plot(x, rate, color="#d62728", linewidth=1.8)
    length = max(60, 20 * -(-len(timeline) // 20))  # ours: the axis grows in steps of 20 events
    lower.set(xlim=(0, length), ylim=(0, 1.05), yticks=(0, 0.5, 1), ylabel="CTR so far")
    lower.set_xlabel("events of this user: page views (shaded) and recommendations (dots)")
    if ending:
        axes.axvline(len(timeline), color="black", linewidth=1.2)
        at = {"xytext": (-5, 0), "textcoords": "offset points", "ha": "right", "va": "center"}
        axes.annotate(ending, (len(timeline), 0.755), fontsize=9, **at)
    _timeline_caption(figure, len(p), int(clicked.sum()))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def _timeline_caption(figure, recommendations: int, clicks: int) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    rate = f", CTR {clicks / recommendations:.2f}" if recommendations else ""
    title = f"{recommendations} recommendations, {clicks} clicks{rate}"
    figure.text(0.075, 0.945, title, fontsize=12, weight="bold", va="center")
    line = {"linewidth": 1.6}
    handles = [
        Line2D([], [], color="#d62728", marker="o", linestyle="", label="clicked"),
        Line2D([], [], mfc="white", mec="#444444", marker="o", linestyle="", label="not clicked"),
        Line2D([], [], color=POLICY_COLORS["oracle"], label="best product (oracle)", **line),
        Line2D([], [], color=POLICY_COLORS["c-only"], label="best taste (c-only)", **line),
        Line2D([], [], color=POLICY_COLORS["random"], label="average (random)", **line),
        Patch(color=BROWSING, label="organic session"),
    ]
    figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.065, 0.93), ncols=6, frameon=False,
        fontsize=8.5, columnspacing=1.2, handletextpad=0.5,
    )  # fmt: skip


def save_gif(path: str | Path, frames: list[np.ndarray], fps: float) -> None:
    """Write pictures as an endless GIF; the last one stays for 1.5 s. Creates missing folders."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = [round(1000 / fps)] * (len(frames) - 1) + [1500]  # ours: time to see the outcome
    images = [Image.fromarray(frame) for frame in frames]
    temporary = path.with_name(path.name + ".part")  # a reader never meets a half-written file
    with open(temporary, "wb") as file:
        images[0].save(
            file, "GIF", save_all=True, append_images=images[1:], duration=durations, loop=0
        )
    os.replace(temporary, path)


def draw_click_curve(path: Path, pool: np.ndarray, num_available: int, seed: int) -> None:
    """Left: Eq. 2, and where the products lie on it. Right: the products as one user sees them."""
    import matplotlib.pyplot as plt

    rng = np.random.default_rng(seed)
    users = rng.standard_normal((2000, DIM))  # ours: enough for a smooth histogram
    offers = np.array([rng.choice(pool, num_available, replace=False) for _ in users])  # (2000, K)
    mu = product_bias()[offers]  # (2000, K)
    taste = np.matmul(product_vectors()[offers], users[:, :, None])[:, :, 0]  # (2000, K)
    picks = {"oracle": taste + mu, "mu-only": mu, "c-only": taste}
    picks = {name: score.argmax(1) for name, score in picks.items()}  # each (2000,)
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(13, 5.2), width_ratios=(1.25, 1), layout="constrained"
    )
    _draw_curve(left, taste + mu, picks)
    p = click_probability(taste[0] + mu[0])  # the first user
    dots = right.scatter(taste[0], mu[0], c=p, cmap="viridis", vmin=0, vmax=0.73, s=20)
    for product in sorted({int(pick[0]) for pick in picks.values()}):
        names = [name for name, pick in picks.items() if pick[0] == product]
        at, color = (taste[0, product], mu[0, product]), POLICY_COLORS[names[0]]
        right.plot(*at, "o", mfc="none", mec=color, mew=2.5, markersize=13)
        text = f"{' = '.join(names)}: {p[product]:.2f}"
        right.annotate(text, at, (12, -4), textcoords="offset points", color=color, fontsize=11)
    figure.colorbar(dots, label="click probability", ax=right)
    right.set(xlim=(-11, 11), ylim=(-11, 11), xlabel="taste c . v", ylabel="popularity mu (hidden)")
    right.set_title(f"one user, {num_available} products on offer: popularity outweighs taste")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    figure.savefig(temporary, format="png", dpi=100)
    os.replace(temporary, path)
    plt.close(figure)


def _draw_curve(axes, x: np.ndarray, picks: dict[str, np.ndarray]) -> None:
    """f(x), a histogram of x (users, K), and the average click probability of each policy."""
    grid = np.linspace(-15, 15, 400)
    bars = axes.twinx()
    bars.hist(x.ravel(), 120, range=(-15, 15), density=True, color="#dcdcdc")
    bars.set(ylim=(0, 0.5), yticks=[])
    axes.set_zorder(bars.get_zorder() + 1)
    axes.patch.set_visible(False)
    limits = click_probability(np.array([-1e3, 1e3]))
    for limit in limits:
        axes.axhline(limit, color="black", linewidth=0.8, linestyle=":")
        axes.annotate(f"limit {limit:.3f}", (-14.8, limit), (0, 4), textcoords="offset points")
    axes.plot(grid, click_probability(grid), color="black", linewidth=2)
    chosen = {name: x[np.arange(len(x)), pick] for name, pick in picks.items()} | {"random": x}
    for name, values in chosen.items():
        p = click_probability(values).mean()
        at = np.interp(p, click_probability(grid), grid)
        axes.plot(at, p, "o", color=POLICY_COLORS[name], markersize=9)
        beside = name in ("mu-only", "random")  # right of the curve: clear of the others
        axes.annotate(
            f"{name} {p:.2f}", (at, p), (3, -17) if beside else (-8, 6), textcoords="offset points",
            ha="left" if beside else "right", color=POLICY_COLORS[name], fontsize=11,
        )  # fmt: skip
    axes.set(xlim=(-15, 15), ylim=(0, 0.8), xlabel="x = c . v + mu")
    axes.set(ylabel="click probability f(x)")
    axes.set_title("Eq. 2; grey: products on offer; dots: average pick for a new user")


# ---- the script ----


@dataclass
class Args:
    """Play one episode, draw it and the click curve, print what could be reached."""

    seed: int = 0
    """seed of the split, the users and the products on offer"""
    out: Path = Path("runs/demo")
    """folder for the pictures"""
    pool: Literal["train", "valid", "test"] = "test"
    """products to draw from"""
    num_available: int = NUM_AVAILABLE
    """products on offer in the drawn episode (Table 3)"""
    policy: Literal["oracle", "mu-only", "c-only", "random"] = "c-only"
    """who recommends in the drawn episode"""
    episodes: int = 1000
    """episodes per entry of the table"""


def _print_summary(args: Args, pool: np.ndarray) -> None:
    parts = ", ".join(f"{name} {len(ids)}" for name, ids in split_actions(seed=args.seed).items())
    print(f"{NUM_ACTIONS} products with vectors of {DIM} numbers; split {args.seed}: {parts}")
    print(f"CTR of reference policies, {args.pool!r} products, {args.episodes} episodes each:")
    print(f"  {'available':>9}  " + "  ".join(f"{name:>15}" for name in POLICIES))
    for num_available in (500, 50, 25):  # Table 3; published validation; published full test
        if num_available <= len(pool):
            cells = []
            for policy in POLICIES:
                score = reference_ctr(policy, pool, num_available, args.episodes, args.seed)
                cells.append(f"{score['ctr']:.3f} +- {score['stderr']:.3f}")
            print(f"  {num_available:9}  " + "  ".join(f"{cell:>15}" for cell in cells), flush=True)


def play_episode(env: RecSysEnv, policy: str, seed: int, every: int = 0) -> tuple[list, dict]:
    """One episode with a policy of POLICIES: (a picture per `every` steps, info of the last step).

    With every = 0 nothing is drawn; else the first and the last moment are always among the
    pictures.
    """
    rng, over, info = np.random.default_rng(seed), False, {}
    env.reset(seed=seed)
    frames = env.render_frames() if every else []
    while not over:
        c, mu = env.c[env.available], env.mu[env.available]  # (K, 16), (K,)
        action = POLICIES[policy](env.user[None], c[None], mu[None], rng)[0]
        _, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        if every and (over or env.recommendations % every == 0):
            frames += env.render_frames()
    return frames, info


def main(args: Args) -> None:
    """What `python recsys.py` does."""
    for name, value, least in (("episodes", args.episodes, 1), ("seed", args.seed, 0)):
        if value < least:
            raise ValueError(f"{name} is {value}; allowed: {least} or more")
    pool = split_actions(seed=args.seed)[args.pool]
    env = RecSysEnv(pool, args.num_available, "rgb_array")
    _print_summary(args, pool)
    seed = args.seed  # ours: one episode in four is over before 15 recommendations; not worth a GIF
    while play_episode(env, args.policy, seed)[1]["recommendations"] < 30:
        seed += 1
    frames, info = play_episode(
        env, args.policy, seed, every=3
    )  # ours: a third of the drawing time
    shown = f"{info['clicks']} clicks in {info['recommendations']} recommendations"
    print(f"drawn: {args.policy}, user {seed}: {shown}")
    save_gif(args.out / "recsys_episode.gif", frames, env.metadata["render_fps"])
    temporary = args.out / "recsys_timeline.png.part"
    Image.fromarray(frames[-1]).save(temporary, "PNG")
    os.replace(temporary, args.out / "recsys_timeline.png")
    draw_click_curve(args.out / "recsys_click_curve.png", pool, args.num_available, args.seed)
    print(f"wrote {', '.join(sorted(str(path) for path in args.out.glob('recsys_*')))}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
