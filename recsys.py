"""Recommender System: a simulated user and 10,000 products (appendix A.2 and C.5).

The agent recommends one product after another to a user and earns 1 for every click. It sees the
user as a vector of 16 numbers and every product as another one; it does not see how popular a
product is. Every episode offers 500 products; at test time none of them was used in training.

      reset                   0.05, and after every click
        |                    +---------------------------+
        v                    v                           |
    a new user --> organic session (looks around) --> bandit session (one recommendation per step)
                       stays: 0.74         0.25         stays: 0.94
                         | 0.01                           | 0.01
                         v                                v
                        gone                             gone

Each draw also moves the user vector a little. After 100 recommendations the episode ends, too.

Commands:

    python recsys.py                    # one episode as text and GIF, the click curve (6 s)
    python recsys.py --policy oracle --pool train --num-available 50 --seed 3
    python recsys.py --episodes 10000   # floors and ceilings as quoted at POLICIES (1 min)

Paper map (appendix -> here):

    A.2 Actions, action set split    PRODUCTS, POPULARITY, split_actions
    C.5 Fully observable             engineered_representations(fully_observable=True)
    A.2 Click, Eq. 2                 click_probability
    A.2 Sessions (Figure 2)          TRANSITIONS, RecSysEnv._transition, _organic_session
    A.2 State, reward, episode end   RecSysEnv.reset, RecSysEnv.step
"""

import functools
import operator
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode
from PIL import Image

# ---- constants (each with its source) ----
NUM_ACTIONS = 10_000  # A.2 "a total of 10,000 actions (products)"
DIM = 16  # A.2, Table 3: size of the user vector and of a product vector
METRIC = "ctr"  # A.2: click-through rate, clicks / recommendations of one episode
MODALITIES: tuple[str, ...] = ()  # A.2: nothing to observe
NUM_AVAILABLE = 500  # Table 3 "actions per episode"
MAX_RECOMMENDATIONS = 100  # A.2, Table 3 "max. episode length"
EQ_2 = (14.0, 2.0, 0.3, 2.0, 6.0)  # a, b, c, d, e of Eq. 2; this c is not a product
SIGMA_1 = 0.1  # A.2: scale of one perturbation of the user
MU_STD = 3.0  # published code; the appendix does not say how mu_i is distributed
ORGANIC, BANDIT, GONE = range(3)  # A.2 names the first two; in the last the user has left
PAGE_VIEW = -1  # in place of a product id: the user looks at something unknown
# Published code; the appendix gives no numbers. Rows: now, columns: next.
TRANSITIONS = np.array([[0.74, 0.25, 0.01], [0.05, 0.94, 0.01], [0.0, 0.0, 1.0]])
CUMULATIVE = TRANSITIONS.cumsum(1)  # (3, 3), for drawing the next session

# ---- A.2 Actions: the products, drawn once for every environment, seed and method ----

# A key of nine words, which no seed of an environment has: no user is drawn like a product. ours:
# 21 is the first that brings the mean mu of training, validation and test products (split 0)
# within 0.03 of 0 (the ceilings depend on it).
_rng = np.random.default_rng([*b"products", 21])
PRODUCTS = _rng.standard_normal((NUM_ACTIONS, DIM))  # c_i
# appendix: c ~ N(0, I), length about 4; published code: scaled to length 1; we do the latter,
# because with length 4 the taste c.v swamps the hidden mu, and partial observability is gone.
PRODUCTS /= np.linalg.norm(PRODUCTS, axis=1, keepdims=True)
POPULARITY = _rng.normal(0.0, MU_STD, NUM_ACTIONS)  # mu_i, hidden from the agent


def action_labels() -> np.ndarray:
    """The class of each action, str (10_000,): all are "product"."""
    return np.full(NUM_ACTIONS, "product")


def engineered_representations(fully_observable: bool = False) -> np.ndarray:
    """What the policy may know about each product, float32.

    (10_000, 16): the vectors c_i (A.2). `fully_observable`, (10_000, 17): mu_i is added (C.5).
    """
    if not fully_observable:
        return PRODUCTS.astype(np.float32)
    # appendix: mu_i is concatenated to c_i; published code: as it is (std 3, beside components of
    # std 0.25); we divide by its std, so that one input does not drown the other sixteen.
    return np.column_stack([PRODUCTS, POPULARITY / MU_STD]).astype(np.float32)


def action_observations(action_ids, num_observations, modality, seed=0, workers=1) -> np.ndarray:
    """ValueError: products come with engineered vectors (A.2)."""
    raise ValueError("recsys has no action observations; use engineered_representations()")


def split_actions(split: str = "default", seed: int = 0) -> dict[str, np.ndarray]:
    """Cut the products at random 2:1:1 (A.2) into sorted ids "train", "valid", "test".

    5,000 / 2,500 / 2,500 ids. ValueError for any split but "default".
    """
    if split != "default":
        raise ValueError(f"split={split!r} is unknown; recsys has only 'default'")
    order = np.random.default_rng(seed).permutation(NUM_ACTIONS)
    parts = np.split(order, [NUM_ACTIONS // 2, NUM_ACTIONS * 3 // 4])
    return dict(zip(("train", "valid", "test"), map(np.sort, parts), strict=True))


def check_ids(ids: Sequence[int], num_available: int = 1) -> np.ndarray:
    """`ids` (n,) as integers; ValueError unless distinct, known, and enough to offer so many."""
    ids = np.asarray(ids)
    if ids.ndim != 1 or ids.dtype.kind not in "iu" or len(np.unique(ids)) < len(ids):
        raise ValueError("action ids must be a list of distinct integers")
    if not 1 <= num_available <= len(ids):
        raise ValueError(
            f"{num_available} actions on offer out of {len(ids)}: from 1 to {len(ids)}"
        )
    if not 0 <= ids.min() <= ids.max() < NUM_ACTIONS:
        raise ValueError(f"action ids lie in 0..{NUM_ACTIONS - 1}, got {ids.min()}..{ids.max()}")
    return ids.astype(np.int64)


# ---- A.2 the environment: click, sessions, state, reward ----


def click_probability(x: np.ndarray) -> np.ndarray:
    """Eq. 2: f(x) for x = c_i . v_user + mu_i, any shape. Between 0.0130 and 0.7311."""

    def sigmoid(y):
        return 1.0 / (1.0 + np.exp(-y))

    a, b, c, d, e = EQ_2
    return sigmoid(a * sigmoid(b * sigmoid(c * x) - d) - e)


class RecSysEnv(gym.Env):
    """A user who is shown one product after another (appendix A.2).

    ## Description
    The user is a vector v of 16 numbers and is in an organic session (looks around alone), in a
    bandit session (is shown a recommendation), or gone; see TRANSITIONS. Every draw of the next
    session, also one that changes nothing, perturbs the user: v + 0.1 |z| n with a scalar
    z ~ N(0, 1) and n ~ N(0, I). A click overrides it: the user goes organic, even if the draw
    said gone. Product i is clicked with probability f(c_i . v + mu_i) (Eq. 2), c_i of length 1,
    mu_i ~ N(0, 3^2): popularity outweighs taste, and c_i does not tell it.

    ## Action Space
    `Discrete(K)`: a position in the `available` array of the last observation.

    ## Observation Space
    `Dict` of
    | key | space | meaning |
    |---|---|---|
    | state | Box(-100, 100, (16,), float32) | the user vector v |
    | available | Box(0, 9999, (K,), int64) | ids of the products on offer in this episode |

    ## Rewards
    1 for a click, else 0.

    ## Starting State
    v ~ N(0, I); an organic session runs before the first observation. `available` is drawn
    uniformly from `action_pool` without replacement, and sorted.

    ## Episode End
    `terminated` when the user leaves (0.0119 per recommendation without click, 0.0385 after a
    click), `truncated` after 100. The last info holds `ctr`: clicks / recommendations.

    ## Arguments
    `action_pool`: distinct ids that `available` is drawn from (default: training).
    `num_available`: K (default 500, Table 3). `render_mode`: None or "rgb_array".
    ValueError for unknown or repeated ids, fewer than K of them, or K < 1.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}

    def __init__(self, action_pool=None, num_available=NUM_AVAILABLE, render_mode=None):
        pool = split_actions()["train"] if action_pool is None else action_pool
        self.action_pool = np.sort(check_ids(pool, num_available))
        self.num_available = num_available
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is None or 'rgb_array', got {render_mode!r}")
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Dict(
            # appendix: v_user; published code: v_user / norm, then running mean and std; we show
            # v_user and leave scaling to the learner. 100 is ours: a bound that is never met.
            state=gym.spaces.Box(-100, 100, (DIM,), np.float32),
            available=gym.spaces.Box(0, NUM_ACTIONS - 1, (num_available,), np.int64),
        )
        self.action_space = gym.spaces.Discrete(num_available)
        self.ending = "not started"  # why there is nothing to step; "" during an episode

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """A new user, who looks around alone first; returns (observation, {})."""
        super().reset(seed=None if seed is None else operator.index(seed))  # numpy, too
        offer = self.np_random.choice(self.action_pool, self.num_available, replace=False)
        self.available = np.sort(offer)  # with the whole pool on offer a position is a product
        self.user = self.np_random.standard_normal(DIM)
        self.recommendations = self.clicks = 0
        self.timeline = []  # for pictures: (user, product or PAGE_VIEW, click)
        self.ending = ""
        # appendix: silent; published code: does not notice a user who leaves in this first session
        # (1 in 26). One recommendation is still made, and a click brings the user back. We keep
        # that, because the published scores contain it.
        self.session = ORGANIC
        self._organic_session()
        return self._observe(), {}

    def step(self, action: int):
        """Recommend one product; returns (observation, reward, terminated, truncated, info)."""
        if self.ending:
            raise gym.error.ResetNeeded("call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0..{self.num_available - 1}, got {action}")
        # The user clicks with the taste that the agent has seen; v changes only afterwards.
        # appendix: repeats are unlikely to be clicked, as the user drifts; published code: no
        # rule against it; we add none. The drift is slow: repeating the product that was best at
        # first scores as well as the oracle, within 0.01.
        product = int(self.available[action])
        x = PRODUCTS[product] @ self.user + POPULARITY[product]
        click = bool(self.np_random.random() < click_probability(x))
        self.timeline.append((self.user, product, click))

        self._transition()
        if click:
            self.session = ORGANIC  # published code: overrides the draw (A.2: "can transition")
        self._organic_session()

        self.recommendations += 1
        self.clicks += click
        terminated = self.session == GONE
        # published code: the limit is a true end; we report `truncated`, the learner decides.
        truncated = not terminated and self.recommendations == MAX_RECOMMENDATIONS
        info = {}
        if terminated or truncated:
            self.ending = "the user left" if terminated else "time is up"
            info = {METRIC: self.clicks / self.recommendations}
        return self._observe(), float(click), terminated, truncated, info

    def _transition(self) -> None:
        """Draw the next session and perturb the user."""
        # appendix: perturbed after each step; published code: after every draw, page views of an
        # organic session included; we do the latter.
        # A bisection is seven times as fast as choice(3, p=...), which checks p anew every time.
        # "right": a draw of exactly 0 must not reach a session of probability 0.
        row, u = CUMULATIVE[self.session], self.np_random.random()
        self.session = int(row.searchsorted(u, side="right"))
        # appendix: covariance sigma_1 sigma_2 I with sigma_2 ~ N(0, 1), negative half of the time;
        # published code: standard deviation 0.1 |sigma_2|; we do the latter, because a covariance
        # cannot be negative. One sigma_2 for all 16 dimensions.
        sigma_2 = self.np_random.standard_normal()
        noise = self.np_random.standard_normal(DIM)
        # Not +=: the timeline keeps the old array.
        self.user = self.user + SIGMA_1 * abs(sigma_2) * noise

    def _organic_session(self) -> None:
        # Which products the user looks at is never observed; only the number of views matters.
        while self.session == ORGANIC:
            self._transition()
            self.timeline.append((self.user, PAGE_VIEW, False))

    def _observe(self) -> dict[str, np.ndarray]:
        return {"state": self.user.astype(np.float32), "available": self.available.copy()}

    def render(self) -> np.ndarray | None:
        """The episode so far: uint8 (480, 900, 3); None without a render_mode."""
        if self.ending == "not started":
            raise gym.error.ResetNeeded("call reset() before render()")
        if self.render_mode == "rgb_array":
            return draw_timeline(self.available, self.timeline, self.ending)

    def render_frames(self) -> list[np.ndarray]:
        """Pictures of the last step: one; nothing moves between two recommendations."""
        return [self.render()] if self.render_mode else []


gym.register("ActionGen/RecSys-v0", entry_point=f"{__name__}:RecSysEnv")


def make_vec(num_envs, action_pool=None, num_available=NUM_AVAILABLE, seed=0, **options):
    """A SyncVectorEnv of users with independent random streams, SAME_STEP autoreset.

    A reset() without a seed goes on with the streams. ValueError as in `RecSysEnv`.
    """
    one = functools.partial(RecSysEnv, action_pool, num_available, **options)
    envs = gym.vector.SyncVectorEnv([one] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    # seed + i would let neighbouring seeds share environments; a SeedSequence's words do not.
    envs.reset(seed=np.random.SeedSequence(seed).generate_state(num_envs).tolist())
    return envs


# ---- floors and ceilings: what could be reached ----

# Each scores the products on offer, (K,), from taste c.v (K,) and popularity mu (K,); the best is
# recommended. The oracle knows all, but not what comes after. c-only is the ceiling for unseen
# products when mu is hidden and clicks are not remembered.
# CTR with 500 of the test products on offer: 0.158, 0.302, 0.633, 0.658 (standard errors 0.002).
POLICIES = {
    "random": lambda taste, mu, rng: rng.random(len(mu)),
    "c-only": lambda taste, mu, rng: taste,
    "mu-only": lambda taste, mu, rng: mu,
    "oracle": lambda taste, mu, rng: taste + mu,
}
COLORS = dict(zip(POLICIES, ("dimgray", "tab:blue", "tab:purple", "tab:green"), strict=True))


def play(env: RecSysEnv, policy: str, rng: np.random.Generator, seed=None) -> tuple[int, int]:
    """One more episode by a policy that is told the user: (clicks, recommendations)."""
    env.reset(seed=seed)
    c, mu = PRODUCTS[env.available], POPULARITY[env.available]  # (K, 16), (K,)
    while not env.ending:
        env.step(POLICIES[policy](c @ env.user, mu, rng).argmax())  # (K, 16) @ (16,) -> (K,)
    return env.clicks, env.recommendations


def reference_ctr(policy, pool, num_available, episodes, seed=0) -> tuple[float, float]:
    """Mean of the episodes' CTR, the published metric, and its standard error."""
    env, rng = RecSysEnv(pool, num_available), np.random.default_rng([seed, 1])
    env.reset(seed=seed)
    clicks, lengths = np.array([play(env, policy, rng) for _ in range(episodes)]).T
    ctr = clicks / lengths  # (episodes,): a short episode counts as much as a long one
    return float(ctr.mean()), float(ctr.std() / np.sqrt(episodes))


# ---- words and pictures for people ----


def episode_text(env: RecSysEnv) -> str:
    """The episode so far, one line per recommendation."""
    lines, views = ["a new user"], [0]
    for user, product, click in env.timeline:
        if product == PAGE_VIEW:
            views[-1] += 1
            continue
        taste, mu = PRODUCTS[product] @ user, POPULARITY[product]
        p = f"{click_probability(taste + mu):.2f}"[1:]  # .62
        numbers = f"taste {taste:+.1f}  popularity {mu:+5.1f}  p {p}"
        outcome = "CLICK   " if click else "no click"
        lines.append(f"rec {len(lines):3}: product {product:4}  {numbers}  {outcome}")
        views.append(0)
    for i, count in enumerate(views):
        lines[i] += f"  -> organic ({count} view{'s' * (count > 1)})" if count else ""
    end = f"{env.ending}: {env.clicks} clicks in {env.recommendations} recommendations"
    return "\n".join([*lines, end])


def draw_timeline(available: np.ndarray, timeline: list, ending: str = "") -> np.ndarray:
    """An episode from left to right (`RecSysEnv.timeline`): uint8 (480, 900, 3)."""
    # A notebook's choice, inherited, can end the import of matplotlib.
    os.environ.pop("MPLBACKEND", None)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    users, products, clicked = map(np.array, zip(*timeline, strict=True))  # (T, 16), 2 x (T,)
    views = products == PAGE_VIEW
    x = np.flatnonzero(~views)  # (n,) recommendations, the other events are page views
    users, products, clicked = users[x], products[x], clicked[x]
    p = click_probability((PRODUCTS[products] * users).sum(1) + POPULARITY[products])  # (n,)
    taste = users @ PRODUCTS[available].T  # (n, 16) @ (16, K) -> (n, K)
    p_all = click_probability(taste + POPULARITY[available])  # (n, K)
    best_taste = p_all[np.arange(len(x)), taste.argmax(1)]  # (n,)
    figure = Figure(figsize=(9, 4.8), dpi=100)
    canvas = FigureCanvasAgg(figure)
    figure.subplots_adjust(0.075, 0.105, 0.985, 0.86, hspace=0.08)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1))
    for axes in (upper, lower):
        axes.fill_between(range(len(views)), 2 * views, step="mid", color="wheat", label="organic")
    upper.plot(x, p_all.max(1), color=COLORS["oracle"], label="best product (oracle)")
    upper.plot(x, best_taste, color=COLORS["c-only"], label="best taste (c-only)")
    upper.plot(x, p_all.mean(1), color=COLORS["random"], label="average (random)")
    upper.plot(x[clicked], p[clicked], "o", color="tab:red", label="click")
    upper.plot(x[~clicked], p[~clicked], "o", mfc="white", mec="black", ms=4.5, label="no click")
    upper.set(ylim=(0, 0.78), ylabel="click probability")
    upper.legend(loc=(-0.01, 1), ncols=6, frameon=False, fontsize=8.5)
    title = f"{len(x)} recommendations, {clicked.sum()} clicks{ending and ', '}{ending}"
    upper.set_title(title, loc="left", pad=24, weight="bold")
    lower.plot(x, clicked.cumsum() / np.arange(1, len(x) + 1), color="tab:red")
    end = max(60, 20 * -(-len(views) // 20))  # ours: the axis grows in steps of 20 events
    lower.set(xlim=(-0.5, end), ylim=(0, 1.05), yticks=(0, 0.5, 1), ylabel="CTR so far")
    lower.set_xlabel("events of this user: page views (shaded) and recommendations (dots)")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def draw_click_curve(path: Path, available: np.ndarray, seed: int) -> None:
    """Left: Eq. 2 and where the products lie on it. Right: the products for one user."""
    from matplotlib.figure import Figure

    rng = np.random.default_rng([seed, 2])
    users = rng.standard_normal((1000, DIM))  # ours: enough for a smooth histogram
    taste, mu = users @ PRODUCTS[available].T, POPULARITY[available]  # (1000, K), (K,)
    p, grid = click_probability(taste + mu), np.linspace(-15, 15, 400)
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    left.hist((taste + mu).ravel(), 120, density=True, color="#dcdcdc", label="products on offer")
    left.plot(grid, click_probability(grid), color="black", linewidth=2)
    dots = right.scatter(taste[0], mu, c=p[0], vmin=0, vmax=0.73, s=20)
    figure.colorbar(dots, label="click probability", ax=right)
    for name, color in COLORS.items():
        picks = [POLICIES[name](row, mu, rng).argmax() for row in taste]  # (1000,)
        mean = p[np.arange(len(users)), picks].mean()
        at = np.interp(mean, click_probability(grid), grid)
        left.plot(at, mean, "o", color=color, ms=10, label=f"{name}: {mean:.2f}")
        right.plot(taste[0, picks[0]], mu[picks[0]], "o", mfc="none", mec=color, mew=2, ms=13)
    left.set(xlim=(-15, 15), ylim=(0, 0.8), xlabel="x = c . v + mu", ylabel="click probability")
    left.set_title("Eq. 2, and what four policies pick on average")
    right.set(xlim=(-11, 11), ylim=(-11, 11), xlabel="taste c . v", ylabel="popularity mu (hidden)")
    right.set_title("one user, the same picks: popularity outweighs taste")
    left.legend(loc="center left", frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    figure.savefig(temporary, format="png", dpi=100)
    temporary.replace(path)


def save_gif(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write frames (H, W, 3) uint8 as an endless GIF, whole or not at all."""
    images = [Image.fromarray(frame) for frame in frames]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    duration = round(1000 / fps)  # ms
    images[0].save(
        temporary, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0
    )
    temporary.replace(path)


# ---- the script ----


@dataclass
class Args:
    policy: Literal["random", "c-only", "mu-only", "oracle"] = "c-only"  # who recommends
    pool: Literal["train", "valid", "test"] = "test"  # products to draw from
    num_available: int = NUM_AVAILABLE  # products on offer in the episode (Table 3)
    seed: int = 5  # of user and products on offer; ours: 5 draws a typical user
    episodes: int = 200  # episodes per entry of the table of floors and ceilings
    out: Path = Path("runs/demo")  # folder for the pictures


def main(args: Args) -> None:
    """What `python recsys.py` does."""
    if args.episodes < 1:
        raise ValueError(f"episodes is {args.episodes}, at least 1")
    pool = split_actions()[args.pool]
    env = RecSysEnv(pool, args.num_available, "rgb_array")
    play(env, args.policy, np.random.default_rng([args.seed, 1]), seed=args.seed)
    print(episode_text(env))
    # ours: a picture every fifth event, and the last one for 1.5 s: time to see the outcome.
    parts = [env.timeline[:n] for n in range(5, len(env.timeline), 5)]
    frames = [draw_timeline(env.available, part) for part in parts]
    frames += [env.render()] * round(1.5 * env.metadata["render_fps"])
    save_gif(args.out / "recsys_episode.gif", frames, env.metadata["render_fps"])
    draw_click_curve(args.out / "recsys_click_curve.png", env.available, args.seed)
    print(f"wrote {args.out}/recsys_episode.gif and {args.out}/recsys_click_curve.png")

    print(f"\nCTR of reference policies, {args.pool} products, {args.episodes} episodes each:")
    print("on offer" + "".join(f"{policy:>17}" for policy in POLICIES))
    for num_available in (25, 50, 500):  # published full test; published validation; Table 3
        print(f"{num_available:8}", end="")
        for policy in POLICIES:
            scores = reference_ctr(policy, pool, num_available, args.episodes, args.seed)
            print("{:9.3f} +- {:.3f}".format(*scores), end="", flush=True)
        print()


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from None
