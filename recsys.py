"""Recommender System: a simulated user and 10,000 products (appendix A.2 and C.5).

The agent recommends one product after another to a user and earns 1 for every click. It sees the
user as a vector of 16 numbers and each product as another vector of 16 numbers; it does not see how
popular a product is. In every episode 500 products are available; at test time none of them was
used in training. What is reported is the click-through rate (CTR): clicks / recommendations.

      reset                   0.05, and after every click
        |                    +---------------------------+
        v                    v                           |
    a new user --> organic session (looks around) --> bandit session (one recommendation per step)
                       stays: 0.74      -- 0.25 ->      stays: 0.94
                         | 0.01                           | 0.01
                         v                                v
                        gone                             gone

The numbers are probabilities of the next session. It is drawn after every recommendation and after
every page viewed in an organic session; each draw also moves the user vector a little. After 100
recommendations the episode ends, too.

    python recsys.py                    # an episode (text, GIF), click curve, a rough table (8 s)
    python recsys.py --policy oracle --part train --num-available 50 --seed 3
    python recsys.py --episodes 10000   # what simple policies reach, as quoted at POLICIES (3 min)

Sections have A.2's names, in another order. [code] is what the authors' released implementation
does, mostly followed where the appendix is silent; [here] is this repository's choice, with reason.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from PIL import Image

# ---- constants (each with its source) ----
NUM_ACTIONS = 10_000  # A.2 "a total of 10,000 actions (products)"
DIM = 16  # A.2, Table 3: size of the user vector and of a product vector
NUM_AVAILABLE = 500  # Table 3 "actions per episode"; [code] has 50 in validation, 25 in C.5's test
MAX_RECOMMENDATIONS = 100  # A.2, Table 3 "max. episode length"
SIGMA_1 = 0.1  # A.2: scale of one perturbation of the user
MU_STD = 3.0  # [code]; the appendix does not say how mu_i is distributed

# Read by the other files. In each tuple the first entry is the default; an empty tuple: none.
METRIC = "ctr"  # A.2: click-through rate, clicks / recommendations of one episode
SPLITS = ("default",)  # A.2
MODALITIES = ()  # A.2: nothing to observe, products come with engineered representations

# A.2 names the first two sessions; in the third the user has left. Probabilities of the next
# session (column) given the present one (row): [code], the appendix has no numbers.
ORGANIC, BANDIT, GONE = 0, 1, 2
TRANSITIONS = np.array(
    [
        [0.74, 0.25, 0.01],  # from organic
        [0.05, 0.94, 0.01],  # from bandit
        [0.00, 0.00, 1.00],  # from gone: used only as `reset` explains
    ]
)
CUMULATIVE = TRANSITIONS.cumsum(1)  # (3, 3), for drawing the next session

# ---- A.2 Actions and action set split ----
# Products are the same in every run. Their seed begins with the letters of "products", as numbers,
# so they share no random numbers with an environment, whose seed is one number.
# [here] 21 is the first number for which the mean of mu_i over the training, the validation and the
# test products (split seed 0) lies within 0.03 of 0, so that scores of the parts can be compared.
# Other split seeds are not balanced.
_rng = np.random.default_rng([*b"products", 21])
PRODUCTS = _rng.standard_normal((NUM_ACTIONS, DIM))  # c_i

# appendix: c ~ N(0, I), of length about 4; [code] scaled to length 1, and so [here]. For a user v,
# call c_i . v the *taste* for product i, and mu_i its *popularity*. With length 4, taste (std 4)
# would outweigh popularity (std 3), and little would be hidden; with 1, taste starts with std 1.
PRODUCTS /= np.linalg.norm(PRODUCTS, axis=1, keepdims=True)
POPULARITY = _rng.normal(0.0, MU_STD, NUM_ACTIONS)  # mu_i, hidden from the agent


def action_labels() -> np.ndarray:
    """The class of each action, str (10_000,): all are "product"."""
    return np.full(NUM_ACTIONS, "product")


def engineered_representations(fully_observable: bool = False) -> np.ndarray:
    """What the policy may know about each product, float32.

    (10_000, 16): the vectors c_i (A.2). `fully_observable` adds a 17th number, mu_i / MU_STD (C.5).
    """
    if not fully_observable:
        return PRODUCTS.astype(np.float32)
    # appendix: mu_i is concatenated to c_i; [code] as it is (std 3, beside components of std
    # 0.25); [here] divided by its std, so that one input does not drown the other sixteen.
    return np.column_stack([PRODUCTS, POPULARITY / MU_STD]).astype(np.float32)


def action_observations(action_ids, num_observations, modality, seed=0, workers=1):
    """Always ValueError: products have engineered vectors (A.2). Every environment has this."""
    raise ValueError("recsys has no action observations; use engineered_representations()")


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Cut the products at random 2:1:1 (A.2) into "train", "valid", "test".

    5,000 / 2,500 / 2,500 sorted ids, disjoint. ValueError for any split but "default".
    """
    if split not in SPLITS:
        raise ValueError(f"split {split!r} is unknown; recsys has only 'default'")
    order = np.random.default_rng(seed).permutation(NUM_ACTIONS)
    train, valid, test = np.split(order, [5_000, 7_500])
    return dict(train=np.sort(train), valid=np.sort(valid), test=np.sort(test))


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


# ---- A.2 the environment: click, sessions, state, reward ----
def click_probability(x: np.ndarray) -> np.ndarray:
    """Eq. 2: f(x) for x = c_i . v_user + mu_i, any shape. Between 0.0130 and 0.7311."""

    def sigmoid(y):
        return 1.0 / (1.0 + np.exp(-y))

    # With the constants of Eq. 2: a = 14, b = 2, c = 0.3 (not the vector c_i), d = 2, e = 6.
    return sigmoid(14.0 * sigmoid(2.0 * sigmoid(0.3 * x) - 2.0) - 6.0)


class RecSysEnv(gym.Env):
    """A user who is shown one product after another (appendix A.2).

    The user is a vector v of 16 numbers and is in an organic session (looks around alone), in a
    bandit session (is shown a recommendation), or gone.

    ## Action Space
    `Discrete(K)`: a position in `available`.

    ## Observation Space
    `Dict(state=Box(-100, 100, (16,), float32), available=Box(0, 9999, (K,), int64))`: the user
    vector v, and the ids of the K products that are available in this episode.

    ## Rewards
    1 for a click, else 0. Product i is clicked with probability f(c_i . v + mu_i) (Eq. 2), c_i of
    length 1, mu_i ~ N(0, 3^2): popularity outweighs taste, and c_i has no information about mu_i.

    ## Starting State
    v ~ N(0, I); an organic session runs before the first observation. `available` is drawn
    uniformly from `action_pool` without replacement, and sorted.

    ## Episode End
    `terminated` when the user leaves. An organic session ends so with probability 0.01 / (0.25 +
    0.01) = 0.0385. So does a step after a click, which starts such a session; without a click it is
    0.01 + 0.05 * 0.0385 = 0.0119. A user gone before the first step still gets it, and a click
    brings them back. `truncated` after 100 steps. The last info holds `ctr`, clicks / steps.

    ## Arguments
    `action_pool`: distinct ids that `available` is drawn from (default: training products).
    `num_available`: K (Table 3: 500). `render_mode`: None or "rgb_array".
    ValueError for a pool, K, action or render_mode that does not exist.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}

    def __init__(self, action_pool=None, num_available=NUM_AVAILABLE, render_mode=None):
        if action_pool is None:
            action_pool = split_actions()["train"]
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode {render_mode!r} is unknown; there is 'rgb_array'")
        self.action_pool = check_ids(action_pool, num_available)
        self.num_available = num_available
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Dict(
            # appendix: v_user; [code] v_user / its length, minus a running mean, / a running std;
            # [here] v_user, for the learner to scale. 100 is never met, but gymnasium warns of
            # unbounded spaces.
            state=gym.spaces.Box(-100, 100, (DIM,), np.float32),
            available=gym.spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
        )
        self.action_space = gym.spaces.Discrete(num_available)
        self.ending = "not started"  # why no episode is running; "" while one is

    def reset(self, *, seed=None, options=None):
        """A new user, who looks around alone first; returns (observation, {})."""
        super().reset(seed=seed)

        # Every episode has its own random subset of the pool: the paper's *subsampling*. Sorted,
        # so that with the whole pool a position always means the same product.
        drawn = self.np_random.choice(self.action_pool, self.num_available, replace=False)
        self.available = np.sort(drawn)
        self.user = self.np_random.standard_normal(DIM)  # A.2: v_user ~ N(0, I)

        # The episode so far: for every recommendation the user vector, the position chosen and
        # whether it was clicked; and how many products the user looked at alone before the first
        # recommendation and after each.
        self.users = []
        self.choices = []
        self.clicks = []
        self.page_views = [0]
        self.ending = ""

        # [code] does not notice a user who leaves in this first session (1 in 26). One
        # recommendation is still made, and a click brings the user back. [here] the same, because
        # the scores of the paper contain it.
        self.session = ORGANIC
        self._organic_session()
        return self._observe(), {}

    def step(self, action):
        """Recommend one product; returns (observation, reward, terminated, truncated, info)."""
        if self.ending:
            raise gym.error.ResetNeeded("the episode is over: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action is {action!r}; there are 0..{self.num_available - 1}")

        # Click or not (Eq. 2), with the user vector that the agent has seen: it changes afterwards.
        # The appendix says that a product is unlikely to be clicked twice, because the user drifts.
        # That does not hold in [code], which has no rule against repeats, nor here: a policy that
        # repeats the product that was best at the start has a CTR less than 0.01 below the oracle's
        # (tests/test_recsys.py).
        product = self.available[action]
        x = PRODUCTS[product] @ self.user + POPULARITY[product]  # (16,) @ (16,) -> ()
        click = bool(self.np_random.random() < click_probability(x))
        self.users.append(self.user)
        self.choices.append(int(action))
        self.clicks.append(click)
        self.page_views.append(0)

        # Next session. The draw perturbs the user as well. [code]: a click always leads to an
        # organic session, even if "gone" was drawn (A.2 says only "can transition"). That session
        # then runs until the user is back in the bandit session, or gone.
        self._transition()
        if click:
            self.session = ORGANIC
        self._organic_session()

        # End (A.2): the user left, or the limit. [here] the limit is `truncated`, gymnasium's word
        # for an end that only a clock makes. Learning ignores the difference: [code] and
        # ppo_actiongen.py bootstrap after neither.
        terminated = self.session == GONE
        truncated = not terminated and len(self.clicks) == MAX_RECOMMENDATIONS
        info = {}
        if terminated or truncated:
            self.ending = "the user left" if terminated else "time is up"
            info = {METRIC: sum(self.clicks) / len(self.clicks)}
        # Reward (A.2): 1 for a click.
        return self._observe(), float(click), terminated, truncated, info

    def _transition(self):
        """Draw the next session and perturb the user."""
        # u is uniform in [0, 1). The next session is the number of cumulative probabilities that
        # are at most u; searchsorted counts them.
        u = self.np_random.random()
        self.session = int(CUMULATIVE[self.session].searchsorted(u, side="right"))

        # Perturb after every draw, even if the session stays the same: [code], and Figure 2 ("Each
        # transition updates the user vector"). A.2's "after each step" could be per recommendation.
        # appendix: covariance sigma_1 sigma_2 I with sigma_2 ~ N(0, 1), which is negative half of
        # the time; [code] standard deviation 0.1 |sigma_2|, and so [here], because a covariance
        # cannot be negative. All 16 dimensions share one sigma_2.
        sigma_2 = self.np_random.standard_normal()
        noise = self.np_random.standard_normal(DIM)
        self.user = self.user + SIGMA_1 * abs(sigma_2) * noise  # a new array: `users` keeps the old

    def _organic_session(self):
        # A page view is one product that the user looks at alone. Which one is never observed; only
        # the number of page views matters, because each perturbs the user.
        while self.session == ORGANIC:
            self._transition()
            self.page_views[-1] += 1

    def _observe(self):
        # State (A.2): the user vector. It does not tell what has been clicked.
        return {"state": self.user.astype(np.float32), "available": self.available.copy()}

    def render(self):
        """The episode so far: uint8 (480, 900, 3); None without a render_mode."""
        return draw_episode(self, len(self.clicks)) if self.render_mode else None

    def render_frames(self) -> list[np.ndarray]:
        """A list of one picture, after the last step; [] without a render_mode."""
        return [self.render()] if self.render_mode else []


gym.register("ActionGen/RecSys-v0", entry_point="recsys:RecSysEnv")


def make_vec(num_envs, action_pool=None, num_available=NUM_AVAILABLE, seed=0, **options):
    """A SyncVectorEnv of RecSysEnv(action_pool, num_available, **options), seeded already.

    SAME_STEP: the step that ends an episode returns the first observation of the next one, and
    infos["final_info"] holds `ctr`. Call `envs.reset()` for the first observations; a seed
    given to it would replace `seed`. ValueError as in RecSysEnv.
    """

    def make_env():
        return RecSysEnv(action_pool, num_available, **options)

    envs = SyncVectorEnv([make_env] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    # Gymnasium would seed environment i with seed + i, so runs with seeds 0 and 1 would share all
    # environments but one. SeedSequence gives unrelated seeds.
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs


# ---- floors and ceilings: what simple policies reach, to compare a trained one with ----
# Each policy scores the available products, (K,), from taste c.v (K,) and popularity mu (K,); the
# best is recommended. random is the floor. c-only knows c and v; with mu hidden it is the ceiling
# on unseen products (for a policy that remembers no clicks), because c says nothing about mu.
# mu-only ignores the user. The oracle recommends the likeliest click; it does not plan
# ahead. The numbers are the CTR with 500 available test products (10,000 episodes, this script's
# default seed, 5; standard errors up to 0.002).
POLICIES = {
    "random": lambda taste, mu, rng: rng.random(len(mu)),  # 0.158
    "c-only": lambda taste, mu, rng: taste,  # 0.302
    "mu-only": lambda taste, mu, rng: mu,  # 0.633
    "oracle": lambda taste, mu, rng: taste + mu,  # 0.658
}
COLORS = {
    "random": "dimgray",
    "c-only": "tab:blue",
    "mu-only": "tab:purple",
    "oracle": "tab:green",
}


def play(env: RecSysEnv, policy: str, rng: np.random.Generator, seed=None) -> float:
    """Play an episode, recommending what the policy scores highest; returns its CTR."""
    env.reset(seed=seed)
    c = PRODUCTS[env.available]  # (K, 16)
    mu = POPULARITY[env.available]  # (K,)
    while not env.ending:
        score = POLICIES[policy](c @ env.user, mu, rng)  # (K, 16) @ (16,) -> (K,)
        env.step(score.argmax())
    return np.mean(env.clicks)


def reference_ctr(policy, pool, num_available, episodes, seed=0) -> tuple:
    """The paper's metric (the mean of the episodes' CTR) and its standard error."""
    env = RecSysEnv(pool, num_available)
    env.reset(seed=seed)
    rng = np.random.default_rng([seed, 1])  # for "random": not the environment's numbers
    # [code]: an unweighted mean, so a short episode counts as much as a long one.
    ctr = [play(env, policy, rng) for _ in range(episodes)]
    return np.mean(ctr), np.std(ctr) / np.sqrt(episodes)


# ---- words and pictures for people ----
def episode_text(env: RecSysEnv) -> str:
    """The episode so far, one line per recommendation."""
    lines = [f"a new user, page views: {env.page_views[0]}"]
    for i, user in enumerate(env.users):
        product = env.available[env.choices[i]]
        taste = PRODUCTS[product] @ user
        mu = POPULARITY[product]
        p = click_probability(taste + mu)
        views = env.page_views[i + 1]
        line = (
            f"{i + 1:3}: product {product:4}, taste {taste:+.1f}, "
            f"popularity {mu:+5.1f}, click probability {p:.2f}"
        )
        if env.clicks[i]:
            line += ", CLICK"
        if views:
            line += f", page views: {views}"
        lines.append(line)
    lines.append(f"{env.ending}: {sum(env.clicks)} clicks in {len(env.clicks)} recommendations")
    return "\n".join(lines)


def draw_episode(env: RecSysEnv, shown: int) -> np.ndarray:
    """The first `shown` recommendations of an episode, from left to right: uint8 (480, 900, 3)."""
    # Matplotlib is imported here because training needs no pictures. A backend inherited from a
    # notebook may not be installed, and would make the import fail.
    os.environ.pop("MPLBACKEND", None)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # What every available product would have done at every recommendation.
    users = np.reshape(env.users[:shown], (shown, DIM))
    taste = users @ PRODUCTS[env.available].T  # (n, 16) @ (16, K) -> (n, K)
    p = click_probability(taste + POPULARITY[env.available])  # (n, K)
    row = np.arange(shown)  # (n,)
    chosen = p[row, np.array(env.choices[:shown], int)]  # (n,)
    clicked = np.array(env.clicks[:shown], bool)  # (n,)
    x = row + 1  # the first recommendation is number 1

    figure = Figure((9, 4.8))  # inches of 100 pixels
    canvas = FigureCanvasAgg(figure)
    figure.subplots_adjust(0.075, 0.105, 0.985, 0.86, hspace=0.08)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1))

    # Above: the curves of three policies, dots for what was recommended, and bars for organic
    # sessions, which lie between two recommendations.
    organic = np.flatnonzero(env.page_views[: shown + 1]) + 0.5
    upper.bar(organic, 0.8, 0.5, color="wheat", label="organic")
    upper.plot(x, p.max(1), color=COLORS["oracle"], label="best product (oracle)")
    upper.plot(x, p[row, taste.argmax(1)], color=COLORS["c-only"], label="best taste (c-only)")
    upper.plot(x, p.mean(1), color=COLORS["random"], label="average (random)")
    upper.plot(x[clicked], chosen[clicked], "o", color="tab:red", label="click")
    upper.plot(x[~clicked], chosen[~clicked], "o", mfc="white", mec="black", ms=4, label="no click")
    upper.set(ylim=(0, 0.78), ylabel="click probability")
    upper.legend(loc=(-0.01, 1), ncols=6, frameon=False, fontsize=8.5)
    title = f"{shown} recommendations, {clicked.sum()} clicks"
    if shown == len(env.clicks):
        title += f"    {env.ending}"
    upper.set_title(title, loc="left", pad=24, weight="bold")

    # Below: the CTR. The axis is as long as an episode can be, so it stands still in a GIF.
    lower.plot(x, clicked.cumsum() / x, color="tab:red")
    lower.set(xlim=(0, MAX_RECOMMENDATIONS + 1), ylim=(0, 1.05), yticks=(0, 0.5, 1))
    lower.set(xlabel="recommendation", ylabel="CTR so far")
    canvas.draw()
    return np.array(canvas.buffer_rgba())[:, :, :3]


def draw_click_curve(path: Path, available: np.ndarray, seed: int):
    """A PNG for a new user. Left: Eq. 2. Right: the products. On both, what each policy picks."""
    os.environ.pop("MPLBACKEND", None)  # see draw_episode
    from matplotlib.figure import Figure

    # A product's x in Eq. 2 is the sum of the user's taste for it and its popularity.
    rng = np.random.default_rng([seed, 2])
    user = rng.standard_normal(DIM)
    taste = PRODUCTS[available] @ user  # (K, 16) @ (16,) -> (K,)
    mu = POPULARITY[available]  # (K,)
    x = taste + mu
    p = click_probability(x)
    curve = np.linspace(-15, 15, 400)

    figure = Figure((13, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    left.hist(x, 40, density=True, color="#dcdcdc", label="products (density)")
    left.plot(curve, click_probability(curve), color="black")
    dots = right.scatter(taste, mu, c=p)
    figure.colorbar(dots, label="click probability")
    for name, color in COLORS.items():
        pick = POLICIES[name](taste, mu, rng).argmax()
        left.plot(x[pick], p[pick], "o", color=color, ms=10, label=f"{name}: {p[pick]:.2f}")
        right.plot(taste[pick], mu[pick], "o", mfc="none", mec=color, ms=14)
    left.set(ylim=(0, 0.8), xlabel="x = c . v + mu", ylabel="click probability")
    left.set(title="Eq. 2, and what four policies pick for one user")
    left.legend(loc="upper left")
    right.set(aspect="equal", adjustable="datalim", xlabel="taste c . v", ylabel="popularity mu")
    right.set(title="the same picks: the hidden popularity outweighs taste")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


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


# ---- the script ----
@dataclass
class Args:
    policy: Literal["random", "c-only", "mu-only", "oracle"] = "c-only"  # who recommends
    part: Literal["train", "valid", "test"] = "test"  # part of the split that products come from
    num_available: int = NUM_AVAILABLE  # products available in the episode shown
    seed: int = 5  # of the users and the available products, 0 or more
    episodes: int = 200  # episodes per entry of the table of floors and ceilings, 1 or more
    out: Path = Path("runs/demo")  # folder for the pictures


def main(args: Args) -> None:
    """One episode as text and GIF, the click curve, the table of floors and ceilings."""
    pool = split_actions()[args.part]
    try:
        env = RecSysEnv(pool, args.num_available, "rgb_array")
        rng = np.random.default_rng([args.seed, 1])  # a negative seed: ValueError
        if args.episodes < 1:
            raise ValueError("--episodes must be at least 1")
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None

    play(env, args.policy, rng, args.seed)
    print(episode_text(env))
    shown = [*range(0, len(env.clicks), 4), len(env.clicks)]  # a picture every fourth step
    frames = [draw_episode(env, n) for n in shown]
    save_gif(args.out / "recsys_episode.gif", frames, env.metadata["render_fps"])
    draw_click_curve(args.out / "recsys_click_curve.png", env.available, args.seed)
    print(f"wrote recsys_episode.gif and recsys_click_curve.png to {args.out}")

    print()
    print(f"CTR of reference policies, {args.part} products, {args.episodes} episodes each:")
    print("available", *(f"{policy:>17}" for policy in POLICIES))
    for num_available in (25, 50, 500):
        print(f"{num_available:9}", end="")
        for policy in POLICIES:
            mean, std_error = reference_ctr(policy, pool, num_available, args.episodes, args.seed)
            print(f"{mean:9.3f} +- {std_error:.3f}", end="", flush=True)
        print()


if __name__ == "__main__":
    main(tyro.cli(Args))
