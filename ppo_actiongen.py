"""PPO with a policy over changing sets of actions: train, validate, test on unseen actions.

The policy never sees action ids. It scores every action on offer by a shared utility of state and
representation c_i (hvae.py), and takes a softmax over the set A on offer:

    pi(a_i | s, A) = exp f_nu(c_i, f_omega(s)) / sum_{j in A} exp f_nu(c_j, f_omega(s))

So new actions are simply another list of vectors. Three things help: a random subset of the
training actions in every episode, an entropy bonus, and selection on held-out *validation* actions.

    python ppo_actiongen.py gridworld --quick         # minutes; or: recsys, create, stacking
    python ppo_actiongen.py gridworld --recipe paper  # the policy of Tables 3 and 4
    python ppo_actiongen.py gridworld --method nearest-neighbor | --ent-coef 0 | --no-subsample
    python ppo_actiongen.py gridworld --finetune runs/gridworld-ours-s0     # C.2
    python ppo_actiongen.py evaluate runs/gridworld-ours-s0 --num-available 20

Paper map, in the order of this file: Tables 3, 4 -> Args, TABLE_3 (ours: FAST, QUICK); D.3.2 state
encoder f_omega and critic -> mlp, cnn, Agent.encode; utility f_nu -> utility, Agent.choice_logits;
auxiliary policy, C.4 -> position_head, Agent.act; baselines -> Agent.act, Agent.slot;
Algorithm 1 -> rollout, gae, ppo_loss, update, train; Algorithm 2 -> evaluate; A.3 -> restrict_pool.

Shapes: T rollout steps, N environments, B rows of a batch, K actions on offer, D size of a
representation, H hidden units, A rows of the table, n of them trained on.
"""

import atexit
import csv
import ctypes
import io
import json
import math
import os
import shlex
import sys
import time
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import torch.distributed as dist
import torch.distributed.nn  # else Adam does, too late: gloo's threads stay
import torch.nn as nn
import torch.nn.functional as F
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch.distributions import Beta, Categorical, Distribution, Normal

import hvae

Distribution.set_default_validate_args(False)  # the checks cost as much as the draws
RANK, WORLD_SIZE = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))

# ---- Tables 3 and 4: the hyper-parameters ----
AUX_ENT_SCALE = 0.1  # Table 3 "continuous entropy scaling", D.3.2


@dataclass
class Args:
    """Train on training actions, select on validation actions, test on unseen ones."""

    env: Annotated[str, tyro.conf.Positional] = "gridworld"  # or recsys, create, stacking
    method: Literal["utility", "nearest-neighbor", "continuous"] = "utility"  # ours or baseline
    representation: str = "hvae"  # hvae, hvae-all, vae, engineered[-5d, -path], FILE.npz
    modality: str | None = None  # what the action encoder sees (B)
    split: str = "default"  # of the actions (A.1 to A.4): default, full, ...
    split_seed: int = 0  # published: one split for all seeds
    recipe: Literal["fast", "paper"] = "fast"  # ours, or the policy of Tables 3 and 4
    quick: bool = False  # the same protocol at a laptop's budget
    seed: int = 0  # one run, bit for bit, on one kind of CPU
    task: str | None = None  # CREATE: one of 12 (C.1)
    subgoal_reward: bool = True  # CREATE: --no-subgoal-reward is C.3
    fully_observable: bool = False  # Recommender: c_i holds mu_i, too (C.5)
    placement: str | None = None  # Stacking: none, 1d, 2d (C.6)
    adapt: bool = False  # C.2: train on the test actions, as one set
    finetune: str | None = None  # C.2: --adapt, from this run; needs its flags
    ent_coef: float = 0.05  # Table 3; 0: the ablation without entropy
    ent_floor: float = 1.0  # ours: it decays to this fraction (paper: 1)
    num_available: int = 50  # Table 3 "actions per episode", K
    eval_available: int | None = None  # K of evaluations (None: num_available)
    total_timesteps: int = 40_000_000  # Table 3; one step = one action
    minibatch_size: int = 4096  # Table 3 "PPO batch size"
    num_minibatches: int = 4  # published code; so many are a rollout
    subsample: bool = True  # --no-subsample: always all training actions
    fixed_set_size: int | None = None  # then, or with --adapt: only so many
    learning_rate: float = 1e-3  # Table 4, of Adam
    lr_decay_steps: int | None = None  # decays in so many steps (None: all)
    gamma: float = 0.99  # Table 4
    num_envs: int = 32  # Table 4 "parallel processes"
    hidden_size: int = 64  # Table 4
    vf_coef: float = 0.5  # Table 4
    update_epochs: int = 4  # Table 4
    clip_coef: float = 0.1  # Table 4
    clip_vloss: bool = True  # published code: clip the value's steps, too
    aux_conditioned: bool = False  # C.4: the position sees the chosen action
    one_hot: bool = False  # ours: integer states enter one-hot
    bilinear: bool = False  # ours: f_nu = c . M f_omega(s)
    small_gains: bool = True  # published code: f_nu starts with gains of 0.01
    ink: bool = False  # ours: small pictures, lines on nothing
    eval_every: int = 410_000  # steps between evaluations
    valid_episodes: int = 640  # of each
    eval_episodes: int = 5000  # of the test (published code)
    hvae_recipe: str = "laptop"  # of the encoder: laptop, quick, paper
    runs_dir: str = "runs"  # of runs and representations
    run_name: str | None = None  # the run's folder (None: see run_path)
    resume: bool = False  # go on, bit for bit
    device: Literal["auto", "cpu", "cuda"] = "auto"  # auto: a GPU if any

    def __post_init__(self):
        self.adapt = self.adapt or self.finetune is not None


TABLE_3 = {
    "env": ("gridworld", "recsys", "create", "stacking"),
    "ent_coef": (0.05, 0.01, 0.005, 0.01),
    "num_available": (50, 500, 50, 20),
    "total_timesteps": (40_000_000, 40_000_000, 60_000_000, 3_000_000),
    "minibatch_size": (4096, 2048, 3072, 1024),
    # What else is not the same in all of them (A.2, B, C.6, published code).
    "representation": ("hvae", "engineered", "hvae", "hvae"),  # A.2: recsys provides them
    "modality": ("xy", None, "xy", "image"),
    "task": (None, None, "push", None),
    "placement": (None, None, None, "1d"),
    "lr_decay_steps": (None, None, 100_000_000, 100_000_000),  # longer than the run
    "fixed_set_size": (None, 2000, None, None),  # for the cost of all 5,000
    "eval_every": (410_000, 164_000, 615_000, 102_400),  # 25, 20, 50, 25 updates
    "valid_episodes": (640, 160, 640, 200),  # stacking: 40, too few
}
COLUMNS_3 = zip(*TABLE_3.values(), strict=True)
PRESETS = {column[0]: Args(**dict(zip(TABLE_3, column, strict=True))) for column in COLUMNS_3}
# Our recipe: every difference from Tables 3 and 4, with its reason.
FAST = {
    "gridworld": dict(
        one_hot=True,  # ids are names, not quantities
        minibatch_size=512,  # eight times as many updates per step
        num_available=20,  # a smaller set has fewer favourites: more get practice
        eval_available=50,  # ... the tests stay Table 3's
        ent_floor=0.1,  # commit in the end: a stray skill ends in lava
        hidden_size=128,  # much to know about skills
        small_gains=False,  # 0.01 in all layers starves the gradient at first
        total_timesteps=10_000_000,
    ),
    "recsys": dict(
        bilinear=True,  # an MLP learns single products by heart
        hidden_size=256,  # 64 miss more of the taste
        gamma=0.0,  # later clicks only drown the one that was earned
        minibatch_size=512,
        num_available=100,  # a fifth of the cost of a step
        eval_available=500,
        total_timesteps=10_000_000,
    ),
    "create": dict(
        ink=True,  # white paper drowns what tells pictures apart
        aux_conditioned=True,  # a ramp and a cannon belong in different places
        small_gains=False,
        hidden_size=256,  # which tool, and where: more to know
        minibatch_size=128,
        num_minibatches=16,
        update_epochs=1,  # four move the policy too far
        learning_rate=5e-4,
        clip_coef=0.2,  # goals are rare: let each one teach more
        vf_coef=0.02,  # a goal is worth 10: at 0.5 the convolutions are the critic's
        clip_vloss=False,  # ... and clipped steps are too small for it
        total_timesteps=4_000_000,
        eval_every=102_400,
    ),
    "stacking": dict(
        small_gains=False,
        minibatch_size=32,  # physics is the bill: learn more from it
        clip_vloss=False,
        total_timesteps=400_000,
        eval_every=20_500,
    ),
}
# --quick: so many steps, 500 test episodes, the encoder's quick recipe.
QUICK = {"gridworld": 1_500_000, "recsys": 1_000_000, "create": 700_000, "stacking": 60_000}
CEILINGS = {  # best possible on (seen, unseen) actions, with Table 3's K
    "gridworld": (1.0, 1.0),  # exact search: all but 1 in 7,000 sets
    "recsys": (0.657, 0.301),  # greedy play; mu_i can be known if seen
    "recsys-full": (0.657, 0.659),
}


def default_args(env: str, recipe: str = "fast", quick: bool = False) -> Args:
    """Table 3, then our differences, then --quick; ValueError for an unknown environment."""
    hvae.load_environment(env)
    args = replace(PRESETS.get(env, Args(env)), recipe=recipe, quick=quick)
    if recipe == "fast":
        args = replace(args, lr_decay_steps=None, **FAST.get(env, {}))
    if quick:
        steps = QUICK.get(env, 100_000)
        args = replace(args, total_timesteps=steps, eval_episodes=500, hvae_recipe="quick")
        args.eval_every = min(args.eval_every, steps // 4)  # checkpoints to choose from
    return args


# ---- D.3.2: the networks ----
def layer_init(layer: nn.Module, gain: float = math.sqrt(2)) -> nn.Module:
    """Orthogonal weights, zero bias (published code)."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def mlp(inputs: int, H: int) -> nn.Sequential:
    """f_omega of vectors (D.3.2): "2-layer MLP with tanh activation"."""
    first, second = layer_init(nn.Linear(inputs, H)), layer_init(nn.Linear(H, H))
    return nn.Sequential(first, nn.Tanh(), second, nn.Tanh())


def cnn(frames: int, H: int, ink: bool) -> nn.Sequential:
    """f_omega of pictures (D.3.2): "5-layer convolutional network", linear, ReLU; ink: 3."""
    # published code: 84 -> 42 -> 21 -> 11 -> 6 -> 3 pixels a side. Ink: 42 -> 21 -> 11 -> 6. From
    # 3 x 3 the code knows less well where the balls are: push, 4M steps, validation .64, not .75.
    channels, side = ([frames, 16, 32, 64], 6) if ink else ([frames, 16, 16, 32, 32, 32], 3)
    layers, features = [], channels[-1] * side**2
    for into, out in pairwise(channels):
        conv = nn.Conv2d(into, out, 3, stride=2, padding=1)
        # published code: PyTorch's own weights; they hide what differs between pictures
        layers += [layer_init(conv) if ink else conv, nn.ReLU()]
    # (B, C, h, w) -> (B, C h w); ink, few lines on the picture or many: features of one size
    layers += [nn.Flatten(), *[nn.LayerNorm(features, elementwise_affine=False)] * ink]
    return nn.Sequential(*layers, layer_init(nn.Linear(features, H)), nn.ReLU())


def position_head(H: int, d: int, args: Args) -> nn.Module:
    """D.3.2: linear, of the code (B, H). C.4: two layers, of [code; action] (B, 2H)."""
    if not args.aux_conditioned:
        return layer_init(nn.Linear(H, d), 1.0)
    # published code: gain 1, at first a random place per tool; ours: one place
    out = layer_init(nn.Linear(H, d), 1.0 if args.small_gains else 0.01)
    return nn.Sequential(layer_init(nn.Linear(2 * H, H), 1.0), nn.ReLU(), out)


def as_ink(frames: torch.Tensor) -> torch.Tensor:
    """Pictures (N, C, 84, 84) uint8, black on white -> (N, C, 42, 42) uint8, 255 on 0."""
    rows = frames[:, :, ::2].float() + frames[:, :, 1::2]  # (N, C, 42, 84)
    ink = 255 - (rows[..., ::2] + rows[..., 1::2]) / 4  # (N, C, 42, 42)
    return (ink * frames.flatten(2).any(2)[..., None, None]).byte()  # black: no frame


class RunningMeanStd(nn.Module):
    """Mean and std of a stream of numbers: count, sum, sum of squares in float64."""

    def __init__(self, shape: tuple[int, ...] = ()):
        super().__init__()
        prior = [torch.full(shape, x, dtype=torch.float64) for x in (1e-4, 0.0, 1e-4)]
        self.register_buffer("sums", torch.stack(prior))  # published code

    def update(self, x: torch.Tensor) -> None:
        """Add a batch (n, *shape), those of all processes together."""
        x = torch.cat(everyone(x)).double()
        self.sums += torch.stack([torch.ones_like(x), x, x.square()]).sum(1)

    def mean_std(self) -> tuple[torch.Tensor, torch.Tensor]:
        mean, square = self.sums[1:] / self.sums[0]
        return mean.float(), (square - mean.square() + 1e-8).sqrt().float()


def utility(u, P, w, available):
    """logits[b, k] = w . relu(u[b] + P[available[b, k]]), for all k on offer.

    The hidden layer of f_nu sees the concatenation [code s; projected action A c + a]. It splits:
    W [s; A c + a] + b = W_s s + (W_c (A c + a) + b) = u + P, with u once per state, and P once per
    action of the whole table.
    """
    x = u[:, None] + P[available]  # (B, 1, H) + (B, K, H)
    return F.relu(x) @ w  # (B, K, H) @ (H,) -> (B, K)


class Utility(torch.autograd.Function):
    """The same on a CPU: in pieces that stay in its cache, the hidden layer never stored.

    With g the gradient of a logit and G_u, G_P the sums of g over the open units of a state, of an
    action: dL/du = G_u w, dL/dP = G_P w, and dL/dw = sum_b u G_u + sum_a P G_P.
    """

    @staticmethod
    def hidden(u, P, sets):  # (b, H), (A, H), (b, K) -> (b, K, H)
        return P.index_select(0, sets.reshape(-1)).view(*sets.shape, -1).add_(u[:, None])

    @staticmethod
    def forward(ctx, u, P, w, available):
        ctx.save_for_backward(u, P, w, available)
        rows = max(1, 800_000 // (available.shape[1] * u.shape[1]))  # 3 MB of float32
        ctx.pieces = [slice(i, i + rows) for i in range(0, len(u), rows)]
        return torch.cat([Utility.hidden(u[r], P, available[r]).relu_() @ w for r in ctx.pieces])

    @staticmethod
    def backward(ctx, grad):
        u, P, w, available = ctx.saved_tensors
        G_u, G_P = torch.empty_like(u), torch.zeros_like(P)
        for r in ctx.pieces:
            g, sets = grad[r], available[r]  # (b, K) both
            x = Utility.hidden(u[r], P, sets).gt_(0)  # 1 where the ReLU is open, else 0
            G_u[r] = torch.bmm(g[:, None], x)[:, 0]  # (b, 1, K) @ (b, K, H) -> (b, H)
            G_P.index_add_(0, sets.reshape(-1), x.mul_(g[..., None]).flatten(0, 1))
        return G_u * w, G_P * w, (u * G_u).sum(0) + (P * G_P).sum(0), None


class Agent(nn.Module):
    """The policy and the critic of D.3.2, or a baseline's policy.

    `table` (A, D): a representation per action, fixed. `train_ids` (n,): those of training, sorted.
    """

    def __init__(self, envs: VectorEnv, table, train_ids, args: Args):
        super().__init__()
        shape, self.args = envs.single_observation_space["state"].shape, args
        H, D, self.is_image = args.hidden_size, table.shape[1], len(shape) == 3
        self.register_buffer("table", torch.tensor(table, dtype=torch.float32))  # (A, D)
        self.register_buffer("train_ids", torch.tensor(train_ids))  # (n,)
        # State encoder and critic share the convolutions; without pictures, nothing.
        if self.is_image:
            self.encoder, self.critic = cnn(shape[0], H, args.ink), layer_init(nn.Linear(H, 1))
        else:
            self.obs_stats, width = RunningMeanStd(shape), math.prod(shape)
            if args.one_hot:  # Grid World shows all of its ids in every first state
                ids = torch.unique(torch.as_tensor(envs.reset()[0]["state"]))
                self.register_buffer("cell_ids", ids)
                width *= len(ids)
            self.encoder = mlp(width, H)
            self.critic = nn.Sequential(mlp(width, H), layer_init(nn.Linear(H, 1)))
        # Utility. Gains of 0.01 (published code) make a uniform policy, and gradients of 1e-6.
        project, hidden, out = (0.01,) * 3 if args.small_gains else (1.0, math.sqrt(2), 0.01)
        if args.method == "utility" and not args.bilinear or args.aux_conditioned:
            self.action_project = layer_init(nn.Linear(D, H), project)
        if args.method == "nearest-neighbor":  # a logit per training action
            self.head = layer_init(nn.Linear(H, len(train_ids)), 0.01)
        elif args.method == "continuous":  # a Gaussian over representations
            self.head_mean, self.head_var = (layer_init(nn.Linear(H, D), 1.0) for _ in "mv")
        elif args.bilinear:
            self.utility_query = layer_init(nn.Linear(H, D), 0.01)
        else:
            self.utility_hidden = layer_init(nn.Linear(2 * H, H), hidden)
            self.utility_out = layer_init(nn.Linear(H, 1), out)
        heads = getattr(envs.single_action_space, "spaces", {})
        self.has_position, self.has_stop = "position" in heads, "stop" in heads
        if self.has_position:
            d = heads["position"].shape[0]
            self.fc_alpha, self.fc_beta = (position_head(H, d, args) for _ in "ab")
        if self.has_stop:
            self.fc_stop = layer_init(nn.Linear(H, 2), 0.01)
            if not args.small_gains:  # ours: else a new policy stops after two shapes
                nn.init.constant_(self.fc_stop.bias[0], 4.0)

    def see(self, obs: dict[str, np.ndarray]) -> tuple[torch.Tensor, torch.Tensor]:
        """An observation as tensors: state (N, ...) and ids on offer (N, K)."""
        state, available = (torch.as_tensor(obs[k]) for k in ("state", "available"))
        state = as_ink(state) if self.args.ink else state
        return state.to(self.table.device), available.to(self.table.device)

    def encode(self, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """State (B, ...) -> its code f_omega(s) (B, H) and its value V(s) (B,)."""
        if self.is_image:
            code = self.encoder(state.float() / 255)
            return code, self.critic(code)[:, 0]
        if self.args.one_hot:
            names = torch.searchsorted(self.cell_ids, state)  # ids -> 0, 1, 2, ...
            x = F.one_hot(names, len(self.cell_ids)).flatten(1).float()  # (B, cells * ids)
        else:
            mean, std = self.obs_stats.mean_std()
            x = ((state - mean) / std).clamp(-10, 10)  # published code
        return self.encoder(x), self.critic(x)[:, 0]

    def project_actions(self, ids: torch.Tensor | None = None) -> torch.Tensor:
        """P, the action's part of `utility`: for all (A, H), or for `ids` (n, H)."""
        table = self.table if ids is None else self.table[ids]
        if self.args.method != "utility" or self.args.bilinear:
            return table
        W_c = self.utility_hidden.weight[:, self.args.hidden_size :]  # (H, H)
        return self.action_project(table) @ W_c.T + self.utility_hidden.bias

    def choice_logits(self, code, available, P):
        """Code (B, H), rows of P on offer (B, K) -> logits (B, K); nearest neighbour: (B, n)."""
        if self.args.method == "nearest-neighbor":
            return self.head(code)
        if self.args.bilinear:  # (B, 1, D) @ (B, D, K) -> (B, 1, K)
            return torch.bmm(self.utility_query(code)[:, None], P[available].mT)[:, 0]
        u = code @ self.utility_hidden.weight[:, : self.args.hidden_size].T  # (B, H): W_s s
        score = utility if u.is_cuda else Utility.apply
        return score(u, P, self.utility_out.weight[0], available) + self.utility_out.bias

    def slot(self, output, available):
        """Output of the policy -> slot (B,) of the set on offer."""
        # Baselines: the action nearest to the training action or to the point (B, D) that is put
        # out. This is part of the environment: no gradient goes through it.
        if self.args.method == "utility":
            return output
        if self.args.method == "nearest-neighbor":
            output = self.table[self.train_ids[output]]  # (B,) -> (B, D)
        return (self.table[available] - output[:, None]).square().sum(2).argmin(1)  # of (B, K, D)

    def act(self, state, available, P, action=None, greedy=False):
        """Choose, or score what was chosen: CleanRL's `get_action_and_value`.

        state (B, ...), rows of P on offer (B, K) -> action, log-probability, entropy, value, each
        (B,). action: "output" (of the policy), "choice" (the slot that is executed),
        "taken" (its id), "position", "stop".
        """

        def draw(policy):  # greedy: the likeliest choice, the mean position (published code)
            best = policy.mode if isinstance(policy, Categorical) else policy.mean
            return best if greedy else policy.sample()

        (code, value), new = self.encode(state), action is None
        action = {} if new else action
        if self.args.method == "continuous":  # published code
            policy = Normal(self.head_mean(code), F.softplus(self.head_var(code)).sqrt())
        else:
            policy = Categorical(logits=self.choice_logits(code, available, P))
        if new:
            action["output"] = draw(policy)
            action["choice"] = self.slot(action["output"], available)
            action["taken"] = available.gather(1, action["choice"][:, None])[:, 0]
        logprob, entropy = policy.log_prob(action["output"]), policy.entropy()
        if self.args.method == "continuous":
            # published code: the sum of entropies in Grid World, else the mean; we: the mean, so
            # that its coefficient does not depend on D. The clamp is the published code's.
            logprob, entropy = logprob.sum(1).clamp(-1e5, 1e5), entropy.mean(1)
        if self.has_position:
            x = code
            if self.args.aux_conditioned:  # C.4: (B, 2H)
                x = torch.cat([code, self.action_project(self.table[action["taken"]])], dim=1)
            # At least 1: a single peak, never one at each border (D.3.2).
            place = Beta(1 + F.softplus(self.fc_alpha(x)), 1 + F.softplus(self.fc_beta(x)))
            if new:
                action["position"] = 2 * draw(place) - 1  # (B, d) in [-1, 1]
            # float32 can round to the border, where the density may be infinite. Half of it per
            # dimension is the density on [-1, 1]: PPO's ratio does not see a constant.
            unit = (0.5 + action["position"] / 2).clamp(1e-6, 1 - 1e-6)
            logprob = logprob + place.log_prob(unit).sum(1)
            entropy = entropy + AUX_ENT_SCALE * place.entropy().sum(1)
        if self.has_stop:  # A.4: "a binary episode termination action"
            stop = Categorical(logits=self.fc_stop(code))
            if new:
                action["stop"] = draw(stop)
            logprob, entropy = logprob + stop.log_prob(action["stop"]), entropy + stop.entropy()
        return action, logprob, entropy, value


# ---- Algorithm 1: rollout, advantages, update ----
@torch.no_grad()
def step(envs, obs, agent: Agent, P, greedy: bool = False):
    """One step: the transition, done (N,), finished episodes (N, 3), the next obs."""
    state, available = agent.see(obs)
    action, logprob, _, value = agent.act(state, available, P, greedy=greedy)
    parts = {k: action[k].cpu().numpy() for k in ("choice", "position", "stop") if k in action}
    executed = parts if len(parts) > 1 else parts["choice"]  # slots (N,) alone
    obs, reward, terminated, truncated, infos = envs.step(executed)
    # Time limits count as ends: short, and part of these tasks (published code).
    done, episodes = terminated | truncated, None
    taken = dict(state=state, available=available, logprob=logprob, value=value) | action
    taken |= {k: torch.as_tensor(x).to(value) for k, x in (("reward", reward), ("done", done))}
    if "episode" in infos:  # where somebody is done: score, return, length
        score = infos["final_info"][hvae.load_environment(agent.args.env).METRIC]
        episodes = np.stack([score, infos["episode"]["r"], infos["episode"]["l"]], axis=1)
    return taken, done, episodes, obs


def rollout(envs, obs, agent: Agent, num_steps: int):
    """Collect T steps: a batch of (T, N, ...) tensors, the next obs, finished episodes."""
    # It holds ids (T, N, K): the update takes the softmax over what was on offer.
    P, steps, finished = agent.project_actions(), [], []
    for _ in range(num_steps):
        taken, done, episodes, obs = step(envs, obs, agent, P)
        steps.append(taken)
        finished += [*episodes[done]] if done.any() else []
    return {k: torch.stack([s[k] for s in steps]) for k in steps[0]}, obs, finished


def gae(rewards, values, dones, next_value, gamma: float, lam: float = 0.95):
    """Generalised advantage estimation; all (T, N), next_value (N,).

    delta_t = r_t + gamma (1 - done_t) V_{t+1} - V_t
    A_t = delta_t + gamma lam (1 - done_t) A_{t+1}
    """  # done_t says that *this* step ended the episode (CleanRL's is shifted by one)
    advantages, last = torch.empty_like(rewards), 0.0
    for t in reversed(range(len(rewards))):
        alive = 1.0 - dones[t]
        delta = rewards[t] + gamma * alive * next_value - values[t]
        advantages[t] = last = delta + gamma * lam * alive * last
        next_value = values[t]
    return advantages


def discounted_returns(rewards, dones, G, gamma: float):
    """G <- gamma G + r over a rollout: all of them (T, N) and the last one (N,)."""
    returns = torch.empty_like(rewards)
    for t in range(len(rewards)):
        returns[t] = G = gamma * G + rewards[t]
        G = G * (1 - dones[t])
    return returns, G


def ppo_loss(agent: Agent, mb: dict, P, ent_coef: float, args: Args):
    """The clipped loss of one minibatch, and its parts for the record."""
    _, logprob, entropy, value = agent.act(mb["state"], mb["available"], P, action=mb)
    logratio = logprob - mb["logprob"]
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    pg_loss = -torch.min(ratio * mb["advantage"], clipped * mb["advantage"]).mean()
    v_error = (value - mb["return"]).square()
    if args.clip_vloss:  # published code: on the value's own scale
        near = mb["value"] + (value - mb["value"]).clamp(-args.clip_coef, args.clip_coef)
        v_error = torch.max(v_error, (near - mb["return"]).square())
    v_loss, entropy = 0.5 * v_error.mean(), entropy.mean()
    loss = pg_loss + args.vf_coef * v_loss - ent_coef * entropy
    parts = dict(pg_loss=pg_loss, v_loss=v_loss, entropy=entropy)
    parts["clip_fraction"] = ((ratio - 1).abs() > args.clip_coef).float().mean()
    parts["approx_kl"] = (ratio - 1 - logratio).mean()  # E[r - 1 - log r]
    return loss, parts


def update(agent: Agent, optimizer, batch: dict, ent_coef: float, args: Args) -> dict[str, float]:
    """PPO's epochs over one rollout; returns the parts of the loss."""
    b = {k: v.flatten(0, 1) for k, v in batch.items()}  # (T, N, ...) -> (T * N, ...)
    # Only training actions were on offer: only their rows of P are computed.
    row = torch.zeros(len(agent.table), dtype=torch.int64, device=agent.table.device)
    row[agent.train_ids] = torch.arange(len(agent.train_ids), device=row.device)
    b["available"] = row[b["available"]]  # (T * N, K)
    everyones = torch.cat(everyone(b["advantage"]))  # published code: of the whole rollout
    b["advantage"] = (b["advantage"] - everyones.mean()) / (everyones.std() + 1e-5)
    size, parameters = args.minibatch_size // WORLD_SIZE, list(agent.parameters())
    for _ in range(args.update_epochs):
        for mb_inds in torch.randperm(len(b["value"]), device=row.device).split(size):
            mb = {k: v.index_select(0, mb_inds) for k, v in b.items()}
            P = agent.project_actions(agent.train_ids)  # (n, H)
            loss, parts = ppo_loss(agent, mb, P, ent_coef, args)
            optimizer.zero_grad()
            loss.backward()
            for p in parameters if WORLD_SIZE > 1 else ():  # equal shares: their mean
                dist.all_reduce(p.grad)
                p.grad /= WORLD_SIZE
            nn.utils.clip_grad_norm_(parameters, 0.5)  # published code
            optimizer.step()
    return {name: part.item() for name, part in parts.items()}  # of the last one


def everyone(x) -> list:
    """Everyone's `x`, in the order of the ranks; all of them wait here.

    torchrun: each process (rank) plays its share of the environments, and learns from its share
    of each minibatch. Rank 0 alone evaluates, writes and speaks.
    """
    parts = [x] * WORLD_SIZE
    if WORLD_SIZE > 1:
        dist.all_gather_object(parts, x)
    return [p.to(x.device) if isinstance(x, torch.Tensor) else p for p in parts]


# ---- what is on offer, what is known about it, and what cannot be trained ----
OPTIONS = {"create": ("task", "subgoal_reward"), "stacking": ("placement",)}  # of envs
ENCODERS = {"hvae": {}, "hvae-all": dict(train_on="all"), "vae": dict(hierarchical=False)}


def seeds(n: int, *stream: int) -> list[int]:
    """`n` seeds of one stream of random numbers, independent of all other streams."""
    # It is named by the seed and by: 1 training, 2 PyTorch, 3 validation, 4 test, 5 evaluate.
    return np.random.SeedSequence(stream).generate_state(n).tolist()


def task_options(args: Args) -> dict:
    """The options of this environment, out of the flags."""
    return {name: getattr(args, name) for name in OPTIONS.get(args.env, ())}


def make_envs(args: Args, pool, num_envs: int, num_available: int, *stream: int):
    """Environments that offer `num_available` actions of `pool` per episode."""
    make_vec = hvae.load_environment(args.env).make_vec
    envs = make_vec(num_envs, pool, num_available, list(stream), **task_options(args))
    return RecordEpisodeStatistics(envs)


def action_pools(args: Args) -> tuple[dict[str, tuple], np.ndarray]:
    """(Sorted ids, K on offer) of each phase; all ids (n,) on offer in training."""
    # "learn" is the training itself; "train", "valid", "test" are evaluations. What learns from one
    # set is scored on it (published code), and after adaptation on nothing else.
    module = hvae.load_environment(args.env)
    split = module.split_actions(args.split, args.split_seed)
    pool, K = split["test" if args.adapt else "train"], args.num_available
    eval_K = args.eval_available or K
    no_op = [module.NO_OP] if hasattr(module, "NO_OP") else []  # CREATE
    one_set = args.method == "nearest-neighbor" or args.adapt or not args.subsample
    if one_set:
        if args.fixed_set_size and args.method != "nearest-neighbor":
            rng = np.random.default_rng(42)  # published code
            pool = np.sort(rng.choice(pool, args.fixed_set_size, replace=False))
        K = len(pool) + len(no_op)
    phases = {"learn": (pool, K), "train": (pool, K if one_set else eval_K)}
    phases |= {} if args.adapt else {p: (split[p], eval_K) for p in ("valid", "test")}
    for phase, (ids, k) in phases.items():
        if k > len(ids) + len(no_op):
            raise ValueError(f"{k} on offer out of {len(ids) + len(no_op)} actions ({phase})")
    return phases, np.union1d(no_op, pool).astype(np.int64)


def load_table(args: Args) -> np.ndarray:
    """The representations (A, D); trains the encoder if they are not there yet."""
    if args.finetune:
        return load(Path(args.finetune) / "best.pt")["agent"]["table"].numpy()
    kind, _, variant = args.representation.partition("-")
    if kind == "engineered":
        options = dict(variant=variant) if variant else {}
        options |= dict(fully_observable=True) if args.fully_observable else {}
        return hvae.load_environment(args.env).engineered_representations(**options)
    path, wanted = Path(args.representation), {}
    if args.representation in ENCODERS:
        # One table serves all policy seeds, as published: the encoder's seed stays 0.
        same = {k: getattr(args, k) for k in ("split", "split_seed", "device", "runs_dir")}
        encoder = hvae.default_args(args.env, args.hvae_recipe, args.modality)
        encoder = replace(encoder, **same, **ENCODERS[args.representation])
        path, wanted = hvae.representation_path(encoder), vars(encoder)
        if not path.exists():
            print(f"no {path} yet: training the encoder first", flush=True)
            hvae.train(encoder)
    loaded = hvae.load_representation(path, args.env, args.split, args.split_seed)
    if stale := [k for k in wanted if loaded["config"].get(k, wanted[k]) != wanted[k]]:
        raise ValueError(f"{path} has another {stale[0]} than the recipe: delete it")
    return loaded["mean"]


def check(args: Args) -> None:
    """Refuse, before anything is made, what cannot be trained or has no effect."""
    for name, value in vars(args).items():
        least = int(type(value) is int and "seed" not in name)
        if type(value) in (int, float) and not value >= least:
            raise ValueError(f"{name} cannot be {value}")
    size = args.minibatch_size * args.num_minibatches
    if size % args.num_envs or args.num_envs % WORLD_SIZE or args.minibatch_size % WORLD_SIZE:
        raise ValueError(f"{size} steps: no multiple of num_envs, or of {WORLD_SIZE} processes")
    if not 2 <= size <= args.total_timesteps:
        raise ValueError(f"total_timesteps {args.total_timesteps}: one rollout takes {size}")
    env, nearest, is_ours = args.env, args.method == "nearest-neighbor", args.method == "utility"
    learned, default = args.representation in ENCODERS, default_args(env, args.recipe, args.quick)
    one_set = nearest or args.adapt or not args.subsample
    effects = {  # flags: whether they change anything; a run is named after them
        "modality": learned,
        "hvae_recipe": learned and not args.finetune,
        "task subgoal_reward": env == "create",
        "placement": env == "stacking",
        "fully_observable": env == "recsys" and args.representation == "engineered",
        "representation": env == "gridworld" or not args.representation.startswith("engineered-"),
        "ent_floor": args.ent_coef > 0,
        "num_available": not one_set or not (args.eval_available or args.adapt),
        "eval_available": not args.adapt,
        "subsample": not nearest and not args.adapt,  # these have one set anyway
        "device": args.device != "cuda" or torch.cuda.is_available(),
        "fixed_set_size": one_set and not nearest,
        "aux_conditioned": env == "create" or args.placement in ("1d", "2d"),
        "one_hot": env not in ("recsys", "create", "stacking"),  # states of integers
        "ink": env not in ("gridworld", "recsys"),  # pictures
        "bilinear": is_ours,
        "small_gains": is_ours and not args.bilinear or args.aux_conditioned,
    }
    for flags, has_effect in effects.items():
        for flag in flags.split() if not has_effect else ():
            if getattr(args, flag) != getattr(default, flag):
                raise ValueError(f"{flag} {getattr(args, flag)} has no effect or sense here")
    if args.finetune:
        theirs = load(Path(args.finetune) / "best.pt")["args"]
        same = "env method representation modality split split_seed fully_observable placement"
        for name in f"{same} hidden_size one_hot bilinear ink aux_conditioned".split():
            if (there := getattr(theirs, name)) != getattr(args, name):
                raise ValueError(f"{args.finetune} cannot be fine-tuned: its {name} is {there!r}")


# ---- Algorithm 1: the training loop ----
def train(args: Args) -> dict:
    """Learn, select on validation actions, test once; returns what results.json holds."""
    from torch.utils.tensorboard import SummaryWriter  # takes 1.5 s

    check(args)
    cuda = args.device != "cpu" and torch.cuda.is_available()
    device = torch.device(f"cuda:{os.environ.get('LOCAL_RANK', 0)}" if cuda else "cpu")
    N, batch_size = args.num_envs // WORLD_SIZE, args.minibatch_size * args.num_minibatches
    phases, train_ids = action_pools(args)
    pool, K = phases.pop("learn")
    envs = make_envs(args, pool, N, K, args.seed, 1)
    folder, table, checkpoint = everyone(None if RANK else open_run(args))[0]
    torch.manual_seed(seeds(1, args.seed, 2, RANK)[0])
    agent = Agent(envs, table, train_ids, args).to(device)
    if args.finetune:  # published code: discrete outputs are actions, so they are new
        theirs, own = load(Path(args.finetune) / "best.pt")["agent"], agent.state_dict()
        new = ("train_ids", *["head.", "fc_stop."] * (args.method == "nearest-neighbor"))
        agent.load_state_dict({k: (own if k.startswith(new) else theirs)[k] for k in own})
    agent.load_state_dict(everyone(agent.state_dict())[0])  # rank 0's
    optimizer = torch.optim.Adam(agent.parameters(), args.learning_rate, eps=1e-5, fused=True)
    reward_stats, G = RunningMeanStd().to(device), torch.zeros(N, device=device)
    generator = torch.cuda if cuda else torch
    update_index, seconds, best_score, size = 0, 0.0, -math.inf, 0
    if checkpoint:
        for name, part in dict(agent=agent, optimizer=optimizer, rewards=reward_stats).items():
            part.load_state_dict(checkpoint[name])
        generator.set_rng_state(checkpoint["generators"][RANK])
        update_index, seconds, best_score, size = checkpoint["progress"]
    num_updates = args.total_timesteps // batch_size
    eval_every = max(1, args.eval_every // batch_size)  # in updates
    decay_updates = max(1, (args.lr_decay_steps or args.total_timesteps) // batch_size)
    metrics = io.StringIO() if RANK else open(folder / "metrics.csv", "a", buffering=1)
    metrics.seek(metrics.truncate(size))  # what came after the checkpoint is made again
    writer = None if RANK else SummaryWriter(folder, purge_step=update_index * batch_size)
    obs, _ = envs.reset(seed=seeds(N, args.seed, 1, update_index, RANK))
    while update_index < num_updates:
        began = time.perf_counter()
        left = 1 - min(1.0, update_index / decay_updates)
        lr = args.learning_rate * (0.1 + 0.9 * left)  # D.2; published code: to 0.1
        optimizer.param_groups[0]["lr"] = lr
        ent_coef = args.ent_coef * (args.ent_floor + (1 - args.ent_floor) * left)

        # Collect: every episode draws its own subset of the training actions.
        batch, obs, episodes = rollout(envs, obs, agent, batch_size // args.num_envs)
        rewards = batch["reward"]
        if not agent.is_image:  # published code: only vectors
            returns, G = discounted_returns(rewards, batch["done"], G, args.gamma)
            reward_stats.update(returns.flatten())
            rewards = (rewards / reward_stats.mean_std()[1]).clamp(-10, 10)
        with torch.no_grad():
            next_value = agent.encode(agent.see(obs)[0])[1]  # (N,)
        batch["advantage"] = gae(rewards, batch["value"], batch["done"], next_value, args.gamma)
        batch["return"] = batch["advantage"] + batch["value"]

        # Learn. Then the normaliser catches up: what collects is what learns.
        row = update(agent, optimizer, batch, ent_coef, args)
        if not (agent.is_image or args.one_hot or args.finetune):  # C.2: frozen
            agent.obs_stats.update(batch["state"].flatten(0, 1))
        if not all(p.isfinite().all() for p in agent.parameters()):
            raise ValueError(f"learning_rate {args.learning_rate} is too high: NaN")
        update_index += 1
        row |= dict(step=update_index * batch_size, learning_rate=lr)
        row["explained_variance"] = float(1 - batch["advantage"].var() / batch["return"].var())
        if episodes := sum(everyone(episodes), []):
            row |= zip(COLUMNS[5:8], np.mean(episodes, 0), strict=True)

        # Select: the best on validation actions [adaptation: on what it adapts to].
        is_checkpoint = update_index % eval_every == 0 or update_index == num_updates
        state = dict(args=vars(args), agent=agent.state_dict(), step=row["step"])
        if is_checkpoint and not RANK:
            for k, phase in enumerate([phase for phase in phases if phase != "test"]):
                played = phases[phase], args.valid_episodes, (args.seed, 3, update_index, k)
                row[f"{phase}_score"] = score = evaluate(agent, *played)["score"]
            if score > best_score:
                best_score = score
                hvae.write(folder / "best.pt", partial(torch.save, state))
        row["sps"] = batch_size / (time.perf_counter() - began)
        row["seconds"] = seconds = seconds + time.perf_counter() - began
        record(row, metrics, writer)
        if is_checkpoint:
            state |= dict(optimizer=optimizer.state_dict(), rewards=reward_stats.state_dict())
            state["progress"] = update_index, seconds, best_score, metrics.tell()
            state["generators"] = everyone(generator.get_rng_state())
            if not RANK:
                hvae.write(folder / "checkpoint.pt", partial(torch.save, state))
            # Episodes start afresh: a resumed run repeats an unbroken one.
            obs, _ = envs.reset(seed=seeds(N, args.seed, 1, update_index, RANK))
            G = torch.zeros_like(G)
    envs.close()
    return {} if RANK else finish(folder, agent, phases, num_updates * batch_size, seconds)


# ---- Algorithm 2: acting with new actions ----
def evaluate(agent: Agent, offer: tuple, episodes: int, stream: tuple, greedy=False) -> dict:
    """Score of the frozen policy; `offer` is (sorted ids, K on offer), `stream`: see `seeds`."""
    # published code: the first 5,000 episodes to finish in 40 environments; we: as many in each,
    # because those that finish first are the short ones
    N = min(episodes, 40)
    quota, results = episodes // N + (np.arange(N) < episodes % N), []  # left to play, (N,)
    envs = make_envs(agent.args, offer[0], N, offer[1], *stream)
    (obs, _), P = envs.reset(), agent.project_actions()
    while (quota > 0).any():
        _, done, ended, obs = step(envs, obs, agent, P, greedy)
        results += [*ended[done & (quota > 0)]] if done.any() else []
        quota = quota - done
    envs.close()
    score, total, length = np.mean(results, 0).tolist()
    stderr = float(np.std(results, 0)[0] / math.sqrt(episodes))
    return dict(score=score, stderr=stderr, length=length, episodes=episodes) | {"return": total}


# ---- what a run leaves behind ----
METHODS = {  # of published_results.csv, and what sets each apart from ours
    "nearest_neighbor": ("method", "nearest-neighbor"),
    "continuous_output": ("method", "continuous"),
    "ours_no_subsampling": ("subsample", False),
    "ours_no_entropy": ("ent_coef", 0.0),
    "oracle_encoder_all_actions": ("representation", "hvae-all"),
    "non_hierarchical_vae": ("representation", "vae"),
    "engineered": ("representation", "engineered"),
    "ours_alternate_modality": ("modality", "onehot"),
    "ours_video": ("modality", "video"),
    "ours_full_split": ("split", "full"),
    "ours_conditioned_auxiliary": ("aux_conditioned", True),
    "ours_no_subgoal_reward": ("subgoal_reward", False),
    "ours_no_place": ("placement", "none"),
    "ours_2d_place": ("placement", "2d"),
}
FREE = "runs_dir run_name resume device".split()  # they make no other result
APART = "env task fully_observable recipe quick seed bilinear adapt finetune".split()


def describe(args: Args) -> tuple[str, str, dict]:
    """The experiment, the method, all else that is not as in the recipe."""
    default = vars(default_args(args.env, args.recipe, args.quick))
    others = {k: v for k, v in vars(args).items() if v != default[k] and k not in FREE + APART}
    found = [m for m, change in METHODS.items() if change in others.items()]
    if found:
        del others[METHODS[found[0]][0]]
    method = found[0] if found else "ours"
    # C.2; from which run is not in the name: a second one is refused
    method += "_finetuned" if args.finetune else "_from_scratch" * args.adapt
    method += "_bilinear" * (args.bilinear and args.method == "utility")  # not the paper's
    experiment = args.env, args.task, "full" if args.fully_observable else None
    return "-".join(filter(None, experiment)), method, others


def run_path(args: Args) -> Path:
    """<runs_dir>/<env>[-task][-full]-<method>[-quick][-paper][-<option>-<value>]*-s<seed>."""
    *parts, others = describe(args)
    parts += ["quick"] * args.quick + ["paper"] * (args.recipe == "paper")
    parts += [f"{k}-{v}".replace("/", "_") for k, v in others.items()]
    return Path(args.runs_dir) / (args.run_name or "-".join([*parts, f"s{args.seed}"]))


def published_scores(args: Args) -> dict[str, float]:
    """Published mean per phase of this method, {} where there is none."""
    _, method, others = describe(args)
    if others.keys() & {flag for flag, _ in METHODS.values()}:
        return {}  # two changes at once: nobody has published that
    text = (Path(__file__).parent / "results" / "published_results.csv").read_text()
    key = args.env + "_full" * args.fully_observable, method
    rows = [r for r in csv.DictReader(text.splitlines()) if (r["env"], r["method"]) == key]
    return {r["phase"]: float(r["mean"]) for r in rows if r["task"] in ("", args.task)}


def open_run(args: Args) -> tuple[Path, np.ndarray, dict | None]:
    """Claim the run's folder: it, the representations, the checkpoint to go on from."""
    # The new folder is the claim; without representations it is given back.
    folder = run_path(args)
    saved, path = folder / "args.json", folder / "checkpoint.pt"
    if is_new := not (args.resume and saved.exists()):
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise ValueError(f"{folder} exists; --resume goes on with it") from None
        hvae.write(saved, lambda file: file.write(json.dumps(vars(args), indent=1).encode()))
    for name, there in json.loads(saved.read_text()).items():
        if name not in FREE and there != (here := getattr(args, name, None)):
            raise ValueError(f"cannot resume {folder}: {name} is {there!r} there, {here!r} here")
    try:
        return folder, load_table(args), load(path) if path.exists() else None
    except BaseException:
        if is_new:
            saved.unlink()
            folder.rmdir()
        raise


def load(path: Path) -> dict:
    """A checkpoint, its "args" as Args. No code in it is run; ValueError if damaged."""
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        return checkpoint | dict(args=Args(**checkpoint["args"]))
    except Exception as e:  # torch has a dozen kinds of errors
        raise ValueError(f"{path} is no checkpoint: {type(e).__name__}") from None


COLUMNS = "step seconds sps train_score valid_score".split()
COLUMNS += "episode_score episode_return episode_length pg_loss v_loss entropy".split()
COLUMNS += "clip_fraction approx_kl learning_rate explained_variance".split()


def record(row: dict, metrics, writer) -> None:
    """A row into metrics.csv and TensorBoard, scores onto the screen (rank 0)."""
    table = csv.DictWriter(metrics, COLUMNS, lineterminator="\n")
    if metrics.tell() == 0:
        table.writeheader()
    table.writerow({k: v if k == "step" else f"{v:.6g}" for k, v in row.items()})
    for name, value in row.items() if writer else ():
        writer.add_scalar(name, value, row["step"])
    if scores := [f"{k[:5]} {row[k]:.3f}" for k in ("train_score", "valid_score") if k in row]:
        print(f"step {row['step']:,}: {', '.join(scores)}", flush=True)


def finish(folder: Path, agent: Agent, phases: dict, steps: int, seconds: float) -> dict:
    """Test the best checkpoint, once; write results.json; then draw and print."""
    args, best = agent.args, load(folder / "best.pt")
    agent.load_state_dict(best["agent"])
    experiment, method, _ = describe(args)
    launcher = f"torchrun --nproc_per_node={WORLD_SIZE}" if WORLD_SIZE > 1 else "python"
    words = [Path(sys.argv[0]).name, *(word for word in sys.argv[1:] if word != "--resume")]
    metric = hvae.load_environment(args.env).METRIC
    results = dict(metric=metric, method=method, published=published_scores(args), ceiling={})
    results |= dict(steps=steps, best_step=best["step"], hours=seconds / 3600, seed=args.seed)
    results["command"] = f"{launcher} {shlex.join(words)}"
    for k, (phase, offer) in enumerate(phases.items()):
        results[phase] = evaluate(agent, offer, args.eval_episodes, (args.seed, 4, k))
        if experiment in CEILINGS and offer[1] == PRESETS[args.env].num_available:
            results["ceiling"][phase] = CEILINGS[experiment][phase != "train"]
    text = json.dumps(results, indent=1)
    hvae.write(folder / "results.json", lambda file: file.write(text.encode()))
    try:
        plot_curve(folder, results)
        record_episode(agent, offer, folder / "episode.gif", args.seed)
    except Exception as e:  # whatever it is, the results are safe
        print(f"note: a picture is missing: {type(e).__name__}: {e}")
    print(f"\n{metric:10} {'ours':>14} {'published':>10} {'ceiling':>8}   ({method})")
    names = ["adapted to"] if args.adapt else ["seen", "validation", "unseen"]
    for phase, name in zip(phases, names, strict=True):
        others = (results[key].get(phase) for key in ("published", "ceiling"))
        published, ceiling = ("-" if x is None else f"{x:.3f}" for x in others)
        ours = "{score:7.3f} ±{stderr:.3f}".format(**results[phase])
        print(f"{name:10} {ours} {published:>10} {ceiling:>8}")
    print(f"curve, episode, metrics and checkpoints: {folder}/")
    return results


def plot_curve(folder: Path, results: dict) -> None:
    """Scores over steps as curve.png, raw: not held at their maximum."""
    os.environ.pop("MPLBACKEND", None)  # a notebook's can end the import
    from matplotlib.figure import Figure  # not pyplot: that would look for a display

    rows = [r for r in csv.DictReader((folder / "metrics.csv").open()) if r["train_score"]]
    axes = (figure := Figure(figsize=(6, 4), layout="tight")).subplots()
    for name in [n for n in ("train_score", "valid_score") if rows[0][n]]:
        points = [(int(row["step"]) / 1e6, float(row[name])) for row in rows]
        axes.plot(*zip(*points, strict=True), marker=".", label=name)
    axes.set(xlabel="million steps", ylabel=results["metric"], ylim=(0, None))
    axes.legend(frameon=False)
    hvae.write(folder / "curve.png", lambda file: figure.savefig(file, format="png", dpi=120))


def record_episode(agent: Agent, offer: tuple, path: Path, seed: int) -> None:
    """Play one episode and save it as a GIF, in colour."""
    args, module = agent.args, hvae.load_environment(agent.args.env)
    name = {"gridworld": "GridWorld", "recsys": "RecSys"}.get(args.env, args.env.capitalize())
    env = getattr(module, f"{name}Env")(*offer, render_mode="rgb_array", **task_options(args))
    envs = SyncVectorEnv([lambda: env], autoreset_mode=AutoresetMode.DISABLED)
    (obs, _), P, done, frames = envs.reset(seed=seed), agent.project_actions(), [False], []
    frames += [env.render()]
    while not done[0]:
        _, done, _, obs = step(envs, obs, agent, P)
        frames += env.render_frames()
    envs.close()
    module.save_gif(path, frames, fps=env.metadata["render_fps"])


# ---- python ppo_actiongen.py evaluate RUN: other sets, the analyses of A.3 ----
@dataclass
class EvaluateArgs:
    """Score best.pt of a run with any actions."""

    run: tyro.conf.Positional[str]  # folder of the run
    actions: Literal["train", "valid", "test"] = "test"  # which of them are on offer
    num_available: int | None = None  # K (None: as in the run's own test)
    min_angle_gap: float | None = None  # CREATE: degrees to training tools
    min_embedding_distance: str | None = None  # squared; or a quantile: q0.5
    unseen_ratio: float | None = None  # this share, the rest training actions
    greedy: bool = False  # take the likeliest choice and the mean position
    episodes: int = 5000  # to play
    seed: int = 0  # of environments and policy
    save: bool = False  # into evaluations.csv in the run's folder
    gif: str | None = None  # play an episode into this file


def restrict_pool(options: EvaluateArgs, table, pool, known) -> np.ndarray:
    """The analyses of A.3: which of `pool` (m,) are on offer; `known` (n,) were trained on."""
    analyses = options.min_angle_gap, options.min_embedding_distance, options.unseen_ratio
    gap, distance, ratio = analyses
    if analyses != (None, None, None) and np.isin(pool, known).any():
        raise ValueError("the analyses choose among unseen actions")
    if gap is not None:
        pool = pool[hvae.load_environment("create").angle_gaps(pool, known) >= gap]
    if distance is not None:
        squared = torch.cdist(table[pool].double(), table[known].double()).amin(1).square().numpy()
        # published: absolute distances, which depend on the encoder
        least = float(distance.removeprefix("q"))
        least = np.quantile(squared, least) if distance[0] == "q" else least
        pool = pool[squared >= least]
    if ratio is not None:  # of two pools of one size, so that it is that of what is on offer
        rng, size = np.random.default_rng(options.seed), min(len(pool), len(known))
        count = round(ratio * size)
        unseen = rng.choice(pool, count, replace=False)
        pool = np.union1d(unseen, rng.choice(known, size - count, replace=False))
    return pool


def evaluate_run(options: EvaluateArgs) -> dict:
    """Score a finished run, print it, and write what --save and --gif ask for."""
    best = load(Path(options.run) / "best.pt")
    args, weights, stream = best["args"], best["agent"], (options.seed, 5)
    phases, train_ids = action_pools(args)
    pool, K = phases["train" if args.adapt else options.actions]  # adapted: to the test actions
    if options.episodes < 1:
        raise ValueError(f"episodes cannot be {options.episodes}")
    for flag in ["min_angle_gap"] * (args.env != "create") + ["actions"] * args.adapt:
        if (value := getattr(options, flag)) not in (None, "test"):
            raise ValueError(f"{flag} {value} has no effect or sense here")
    pool = restrict_pool(options, weights["table"], pool, phases["learn"][0])
    offer = pool, min(K, len(pool)) if options.num_available is None else options.num_available
    envs = make_envs(args, pool, 1, offer[1], *stream)
    agent = Agent(envs, weights["table"].numpy(), train_ids, args)
    envs.close()
    agent.load_state_dict(weights)
    torch.manual_seed(seeds(1, *stream)[0])
    result = evaluate(agent, offer, options.episodes, stream, options.greedy)
    print(f"{options.actions} actions, K={offer[1]}, {options.episodes} episodes: ", end="")
    print(f"{result['score']:.4f} ± {result['stderr']:.4f} (pool of {len(pool)})")
    if options.save:
        path = Path(options.run) / "evaluations.csv"
        keys = [k for k in vars(options) if k not in ("run", "save", "gif")]
        row = vars(options) | dict(num_available=offer[1], pool_size=len(pool)) | result
        row = {k: "" if row[k] is None else str(row[k]) for k in [*keys, "pool_size", *result]}
        old = csv.DictReader(path.read_text().splitlines()) if path.exists() else ()
        rows = [r for r in old if any(r[k] != row[k] for k in keys)] + [row]
        text = "\n".join([",".join(row), *(",".join(r.values()) for r in rows), ""])
        hvae.write(path, lambda file: file.write(text.encode()))
    if options.gif:
        record_episode(agent, offer, Path(options.gif), options.seed)
    return result


def main(words: list[str]) -> None:
    """Train what the command line says, or evaluate what was trained."""
    # ours: for layers this small a second thread waits more than it works
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", 1)))
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        # Keep freed memory for the next array: else CREATE takes 1.2 (paper: 2.3) times as long.
        libc.mallopt(-1, 2**31 - 1), libc.mallopt(-3, 2**31 - 1)  # M_TRIM_, M_MMAP_THRESHOLD
    if words[:1] == ["evaluate"]:
        return evaluate_run(tyro.cli(EvaluateArgs, args=words[1:]))
    # Three words decide the defaults, so the line is read twice.
    first = tyro.cli(Args, args=[word for word in words if word not in ("-h", "--help")])
    default = default_args(first.env, first.recipe, first.quick)
    args = tyro.cli(Args, args=words or ["--help"], default=default)
    if WORLD_SIZE > 1:  # the others may wait for hours while rank 0 trains an encoder
        dist.init_process_group("gloo", timeout=timedelta(days=3))
        atexit.register(dist.destroy_process_group)
    train(args)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from None
