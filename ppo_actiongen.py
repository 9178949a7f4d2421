"""PPO with a policy over changing sets of actions, and the train / validate / test protocol.

The policy never sees action ids. It scores every action on offer by a shared utility of the state
and of that action's representation c_i (hvae.py), and takes a softmax over the set A on offer:

    pi(a_i | s, A) = exp f_nu(c_i, f_omega(s)) / sum_{j in A} exp f_nu(c_j, f_omega(s))

so a set of actions it was never trained on is simply another list of vectors. Three regularisers
make that work: a random subset of the training actions in every episode, an entropy bonus, and
model selection on held-out *validation* actions. The test actions are used once, at the end.

    python ppo_actiongen.py gridworld --quick        # the whole protocol in minutes on a laptop
    python ppo_actiongen.py gridworld                # our recipe, full budget
    python ppo_actiongen.py gridworld --recipe paper # the policy of Tables 3 and 4 to the letter
    python ppo_actiongen.py gridworld --method nearest-neighbor        # baselines of section 5.3
    python ppo_actiongen.py gridworld --ent-coef 0 | --no-subsample    # ablations
    python ppo_actiongen.py gridworld --finetune runs/gridworld-ours-s0 # C.2: adapt to the unseen
    python ppo_actiongen.py evaluate runs/gridworld-ours-s0 --actions test --num-available 20
    torchrun --nproc_per_node=2 ppo_actiongen.py create                # data-parallel processes
    python ppo_actiongen.py gridworld --help         # every hyper-parameter and its default

Paper map (appendix)                                  here
  Tables 3-4 hyper-parameters                         Args, PRESETS, FAST, QUICK
  D.3.2 state encoder f_omega, critic V               StateEncoder, Agent.encode
  D.3.2 utility function f_nu                         Agent.project_actions, FactorisedUtility
  D.3.2 auxiliary policy f_chi                        Agent.auxiliary
  baselines: nearest neighbour, continuous output     Agent.act, Agent.nearest, Agent.gaussian
  Algorithm 1: training with action-set subsampling   train, rollout, gae, update
  Algorithm 2: acting with new actions                evaluate

Letters in shape comments: T rollout steps, N environments, B = T*N, K actions on offer,
D size of a representation, H hidden units, A = NUM_ACTIONS rows of the table.
"""

import csv
import gc
import importlib
import json
import math
import os
import shutil
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from datetime import timedelta
from inspect import signature
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
import torch.distributed.nn  # now: see main(), where the processes part
import torch.nn as nn
import torch.nn.functional as F
import tyro
from tqdm import tqdm

import hvae

# Set by torchrun; without it one process does everything.
RANK, WORLD_SIZE = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))

# ---- hyper-parameters: Tables 3 and 4 ----

MODULES = {
    "gridworld": "gridworld",
    "recsys": "recsys",
    "create": "create_env",
    "stacking": "stacking_env",
}

# What each environment's constructor accepts beyond the contract (A.3, C.3, C.5, C.6).
TASK_OPTIONS = {
    "gridworld": (),
    "recsys": ("fully_observable",),
    "create": ("task", "subgoal_reward"),
    "stacking": ("placement",),
}


@dataclass
class Args:
    """Train a policy on training actions, select on validation actions, test on unseen ones."""

    env: tyro.conf.Suppress[str] = "gridworld"

    # What is trained
    method: Literal["utility", "nearest-neighbor", "continuous"] = "utility"
    """utility = the paper's policy; the other two are its baselines."""
    representation: str = "hvae"
    """hvae | hvae-all (oracle encoder) | vae | engineered(-5d, -path) | FILE.npz of hvae.py."""
    modality: str | None = None
    """Modality of the action observations the encoder sees (default: the environment's first)."""
    split: str = "default"
    """How the actions are split into train / validation / test (A.1-A.4)."""
    split_seed: int = 0
    """Seed of the random split; published: one split for all seeds."""
    recipe: Literal["fast", "paper"] = "fast"
    """fast = ours, every difference listed in FAST; paper = the policy's rows of Tables 3-4 to the
    letter (the encoder's: --hvae-recipe paper, days on a CPU)."""
    quick: bool = False
    """The same protocol at a laptop budget (some minutes)."""
    seed: int = 0
    """One seed gives one run, bit for bit on one machine (a GPU adds up in no fixed order)."""

    # Task options, each for the environments that have it
    task: str | None = None
    """CREATE: which of the 12 tasks."""
    subgoal_reward: bool = True
    """CREATE: --no-subgoal-reward is the ablation of C.3."""
    fully_observable: bool = False
    """Recommender: the representation also holds mu_i (C.5)."""
    placement: str | None = None
    """Stacking: none | 1d | 2d (C.6)."""

    # Adaptation to the unseen actions (C.2), the alternative to zero-shot
    adapt: bool = False
    """Train on the test actions, one fixed set in every episode, from scratch."""
    finetune: str | None = None
    """--adapt, starting from this finished run's folder; give the flags of that run."""

    # Policy, Table 3 (per environment, see PRESETS)
    ent_coef: float = 0.05
    """Entropy coefficient (Table 3); 0 is the ablation without entropy."""
    num_available: int = 50
    """K, actions on offer per training episode (Table 3)."""
    total_timesteps: int = 40_000_000
    """Environment steps; one step = one action (Table 3)."""
    minibatch_size: int = 4096
    """PPO batch size of Table 3; a rollout holds num_minibatches times as many transitions."""
    aux_ent_scale: float = 0.1
    """Factor on the entropy of the position head (Table 3, continuous entropy scaling)."""
    subsample: bool = True
    """--no-subsample: all training actions are on offer in every episode (ablation)."""
    fixed_set_size: int | None = None
    """With --no-subsample or --adapt, method utility: only this many random actions of the pool
    (published: 2,000 of recsys)."""

    # Policy, Table 4
    learning_rate: float = 1e-3
    """Adam's learning rate (Table 4)."""
    gamma: float = 0.99
    """Discount factor (Table 4)."""
    num_envs: int = 32
    """Parallel processes (Table 4)."""
    hidden_size: int = 64
    """Hidden layer size (Table 4)."""
    vf_coef: float = 0.5
    """Value loss coefficient (Table 4)."""
    update_epochs: int = 4
    """PPO epochs (Table 4)."""
    clip_coef: float = 0.1
    """PPO clip parameter (Table 4)."""

    # Not in the appendix; values of the published code unless said otherwise
    num_minibatches: int = 4
    """Minibatches per epoch."""
    gae_lambda: float = 0.95
    """GAE lambda."""
    max_grad_norm: float = 0.5
    """Clip the global gradient norm here."""
    adam_eps: float = 1e-5
    """Adam's epsilon."""
    lr_floor: float = 0.1
    """The learning rate decays linearly to this fraction, not to zero."""
    lr_decay_steps: int | None = None
    """Steps over which it decays (default: total_timesteps)."""
    ent_floor: float = 1.0
    """The entropy coefficient decays linearly to this fraction, in the learning rate's steps (ours;
    the paper: 1)."""
    clip_vloss: bool = True
    """Clip the value loss as PPO's original code does, on the raw value scale."""
    encoder_rate: float = 1.0
    """Factor on the learning rate of the state encoder (vector states: and of the critic's hidden
    layers; ours; the paper: 1)."""
    weight_decay: float = 0.0
    """Decoupled weight decay on the utility's weights and biases (ours; 0 = the paper's)."""
    conv_gain: float | None = None
    """Orthogonal gain of the image encoder's convolutions (None: PyTorch's own initialisation)."""
    shrink: Literal[1, 2, 4] = 1
    """Pictures become this many times smaller a side before the convolutions, blocks of pixels
    averaged (ours; the paper: 1)."""
    white_is_zero: bool = False
    """Black on white enters the convolutions as 255 on 0, a frame from before the episode as 0
    (ours; the paper: as it comes)."""
    norm_features: bool = False
    """Layer-normalise what the convolutions make of each picture (ours; the paper: no)."""
    utility_gains: tuple[float, float, float] = (0.01, 0.01, 0.01)
    """Orthogonal gains of the utility's projection, hidden and output layer."""
    one_hot: bool = False
    """Integer states enter encoder and critic one-hot instead of running-normalised numbers."""
    norm_obs: bool = True
    """Running mean/std normalisation of vector states, clipped to +-10, frozen at evaluation."""
    norm_reward: bool = True
    """Divide training rewards by the running std of the discounted return (vector states)."""
    standardize: bool = False
    """Shift and scale the table to mean 0, std 1 over the training actions (ours)."""
    utility: Literal["mlp", "bilinear"] = "mlp"
    """mlp = D.3.2; bilinear = code . M c, too plain to learn single actions by heart (ours)."""
    utility_hidden: int | None = None
    """Hidden width of the utility alone (default: hidden_size; wider is beyond the paper)."""
    explore: float = 0.0
    """While learning, this share of choices is uniform over those on offer (ours, method utility;
    paper: 0)."""
    outcome_coef: float = 0.0
    """Weight of outcome_loss: what the chosen action led to (ours, method utility with utility mlp;
    paper: 0)."""
    table_noise: float = 0.0
    """While learning, representations are off by Gaussian noise of this many of the table's
    standard deviations, another one in every rollout (ours, method utility; paper: 0)."""

    stop_bias: float = 0.0
    """Initial logit of going on, against stopping (ours; the paper: 0)."""
    aux_conditioned: bool = False
    """The position head also sees the chosen action (C.4; the paper's main results: no)."""
    aux_residual: bool = False
    """With --aux-conditioned: the chosen action only corrects the position of D.3.2, at first by
    next to nothing (ours; C.4 to the letter: --no-aux-residual)."""

    # Protocol
    eval_every: int = 410_000
    """Steps between evaluations on train and validation actions (published: 25 updates)."""
    valid_episodes: int = 640
    """Episodes per evaluation during training (published: 20 x 32)."""
    eval_episodes: int = 5000
    """Episodes of the final test (published: 5,000)."""
    eval_available: int | None = None
    """K at evaluation (default: num_available; Table 3 has one K for both)."""

    # The encoder, when a representation has to be made first
    hvae_recipe: str = "laptop"
    """Recipe of hvae.py."""
    hvae_seed: int = 0
    """Seed of the encoder; one table serves all policy seeds, as published."""

    # The run
    runs_dir: str = "runs"
    """Where runs and representations live."""
    run_name: str | None = None
    """Default: <env>[-task]-<method>-s<seed>."""
    resume: bool = False
    """Go on from the run's checkpoint, bit for bit."""
    overwrite: bool = False
    """Throw away a run of the same name."""
    device: str = "auto"
    """auto | cpu | cuda; auto takes a GPU if there is one."""
    threads: int = 2
    """CPU threads of the update (torchrun: of each process, default 1)."""
    micro_batch: int = 0
    """Rows per forward and backward pass; gradients of a minibatch add up (0: all at once)."""
    bf16: bool | None = None
    """Convolutions in bfloat16 (default: where the processor has instructions for it)."""
    tensorboard: bool = True
    """Write TensorBoard events."""


# Table 3, one row per environment.
PRESETS = {
    "gridworld": Args(env="gridworld"),
    "recsys": Args(
        env="recsys",
        representation="engineered",  # A.2: the environment provides the representations
        ent_coef=0.01,
        num_available=500,
        minibatch_size=2048,
        fixed_set_size=2000,  # published code: the set without subsampling, for its cost
        eval_every=164_000,  # published code: every 20 updates of 8,192 steps
        valid_episodes=160,  # published code: 20 x 8
    ),
    "create": Args(
        env="create",
        task="push",
        ent_coef=0.005,
        total_timesteps=60_000_000,
        minibatch_size=3072,
        lr_decay_steps=100_000_000,  # published code: the horizon is longer than the run
        eval_every=615_000,  # published code: every 50 updates of 12,288 steps
        micro_batch=128,  # ours: blocks of memory small enough to be used again and again
        # ours: convolutions of 128 images meet at a barrier every fraction of a millisecond, and
        # where anything else runs, two threads mostly wait there; torchrun uses more cores.
        threads=1,
    ),
    "stacking": Args(
        env="stacking",
        placement="1d",
        ent_coef=0.01,
        num_available=20,
        total_timesteps=3_000_000,
        minibatch_size=1024,
        lr_decay_steps=100_000_000,  # published code
        eval_every=102_400,  # published code: every 25 updates of 4,096 steps
        valid_episodes=200,  # ours; published code: 40, too few to choose by
        micro_batch=128,  # ours, as above
        threads=1,
    ),
}

# Our recipe: every difference from Tables 3-4, with its reason.
FAST = {
    "gridworld": dict(
        one_hot=True,  # ids are names, not quantities: a linear layer can read one-hot cells
        minibatch_size=512,  # rollouts of 64 steps: eight times as many updates per step
        num_available=20,  # a smaller random set makes favourites rarer: more skills get practice
        eval_available=50,  # ... the test stays Table 3's
        standardize=True,  # unit scale whatever the latents came out as (no gain with 12-d)
        ent_floor=0.1,  # explore first, commit later: one stray sample ends an episode in lava
        hidden_size=128,  # with the next line: 0.565 -> 0.695 after 1M steps, each twice as dear
        utility_hidden=256,  # "left of the river after three moves" takes many ReLUs
        utility_gains=(1.0, math.sqrt(2), 0.01),  # 0.01 everywhere starves the gradient at first
        explore=0.1,  # what nobody tries any more is forgotten; split 0, 4M steps: 0.895 -> 0.918
        outcome_coef=0.5,  # facts about skills, not opinions: 0.695 -> 0.819 after 1M steps
        total_timesteps=10_000_000,
    ),
    "recsys": dict(
        utility="bilinear",  # an MLP learns the hidden popularity of single products by heart
        # What is shown hardly changes what is clicked later, but the sum of all later clicks drowns
        # the one that a recommendation earned. The score is a mean over recommendations anyway.
        gamma=0.0,
        minibatch_size=512,  # rollouts of 64 steps
        num_available=100,  # a fifth of the cost per step
        eval_available=500,  # ... the test stays Table 3's
        standardize=True,
        total_timesteps=10_000_000,
    ),
    "create": dict(
        shrink=2,  # an update costs about half, and a ball is still 4 pixels across
        # White paper with a few lines on it: as it comes, what all pictures share drowns what tells
        # them apart, and the policy learns one place for its tools whatever the picture shows.
        white_is_zero=True,
        norm_features=True,
        clip_coef=0.2,  # goals are rare: let each one teach more (Table 4: 0.1)
        # Which tool, and where to put it in this picture: with 64 units and one place for all
        # tools, some seeds get stuck with what they happened to try first.
        hidden_size=256,
        aux_conditioned=True,  # a ramp and a cannon belong in different places,
        aux_residual=True,  # ... but begin in the same one, see CorrectedHead
        micro_batch=256,  # with these pictures that fits
        conv_gain=math.sqrt(2),  # PyTorch's own shrinks what differs between two pictures 100 times
        utility_gains=(1.0, math.sqrt(2), 0.01),
        # A goal is worth 10, so the critic's loss is a thousand times the policy's. They share the
        # convolutions: at Table 4's 0.5 these learn the critic's features alone.
        vf_coef=0.02,
        minibatch_size=1024,  # rollouts of 128 steps: three times as many updates per step
        clip_vloss=False,  # a goal is worth 10: with steps of 0.1 the critic needs 100 updates
        lr_decay_steps=None,  # over the run
        total_timesteps=2_000_000,
        eval_every=205_000,
    ),
    "stacking": dict(
        utility_gains=(1.0, math.sqrt(2), 0.01),
        minibatch_size=32,  # rollouts of 4 steps: physics is the bill, so learn more from each one
        stop_bias=4.0,  # a fresh stop head ends episodes after two shapes, before any tower
        clip_vloss=False,
        lr_decay_steps=None,
        total_timesteps=400_000,
        eval_every=20_500,
    ),
}

# --quick: either recipe with a smaller budget; the encoder is hvae.py's quick one.
QUICK = {
    "gridworld": dict(total_timesteps=1_500_000, hvae_recipe="quick"),
    "recsys": dict(total_timesteps=1_000_000),
    "create": dict(total_timesteps=400_000, hvae_recipe="quick", eval_episodes=500),
    "stacking": dict(total_timesteps=60_000, hvae_recipe="quick", eval_episodes=500),
}
# ... and of our recipe: so few steps go further in many small updates (push: 0.114 -> 0.272).
FAST_QUICK = {"create": dict(minibatch_size=256, learning_rate=5e-4)}

# Best score a policy of this kind can reach on (seen, unseen) actions, to read results by.
CEILINGS = {
    "gridworld": (1.0, 1.0),  # exact search: all but 1 in 7,000 sets of 50 skills hold a solution
    # Greedy play with the true user vector. mu_i is hidden: it can be learned by heart for products
    # seen in training, not for new ones; fully observable it is part of the representation.
    "recsys": (0.664, 0.297),
    "recsys-full": (0.664, 0.664),
}


# ---- D.3.2 the networks ----


def layer_init(layer: nn.Module, gain: float, generator: torch.Generator) -> nn.Module:
    """Orthogonal weights of the given gain, zero bias (published code)."""
    nn.init.orthogonal_(layer.weight, gain, generator=generator)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


class OneHotLinear(torch.autograd.Function):
    """y = W onehot(ids) + b without building the one-hot vector in the forward pass.

    A one-hot input only selects columns of W, so the product is a sum of table rows (embedding_bag,
    5-10 times cheaper than the matrix product). The gradient of W *is* a matrix product with the
    one-hot matrix, which is faster than scattering rows.
    """

    @staticmethod
    def forward(ctx, index, weight_t):
        ctx.save_for_backward(index)
        ctx.num_rows = weight_t.shape[0]
        return F.embedding_bag(index, weight_t, mode="sum")  # (B, cells) -> (B, out)

    @staticmethod
    def backward(ctx, grad):
        (index,) = ctx.saved_tensors
        one_hot = grad.new_zeros(len(index), ctx.num_rows).scatter_(1, index, 1.0)
        return None, one_hot.T @ grad  # (rows, B) @ (B, out)


def fast_bf16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 numbers faster than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(torch.cpu.get_capabilities().get("avx512_bf16"))


class StateEncoder(nn.Module):
    """f_omega and the critic's trunk (D.3.2).

    Vector states: two separate 2-layer tanh MLPs, one for the policy and one for the critic.
    Image states: five stride-2 convolutions, a linear layer and ReLU, shared by both. They are the
    whole bill of a step, and two formats make them about twice as fast, forward and backward:
      - channels last in memory, so that one pixel's channels are one vector of the processor;
      - bfloat16 (float32's range, 8 bits of mantissa) in the convolutions alone. Sums inside a
        convolution, weights, the optimiser and everything after the last layer stay float32.
    tests/ hold plain float32 layers as the oracle of both.
    """

    def __init__(self, space: gym.spaces.Box, args: Args, generator: torch.Generator):
        super().__init__()
        H, root2 = args.hidden_size, math.sqrt(2)  # gain sqrt(2): published code
        self.is_image, self.bf16 = len(space.shape) == 3, args.bf16
        self.norm_features = args.norm_features
        self.num_ids = int(space.high.max()) + 1 if args.one_hot else None  # see Preprocess
        if self.is_image:
            # 84 -> 42 -> 21 -> 11 -> 6 -> 3 pixels a side (published code; the appendix: 5 layers).
            # A picture that comes at half its size needs one layer less.
            outputs = [16, 16, 32, 32, 32][int(math.log2(args.shrink)) :]
            channels = zip([space.shape[0], *outputs], outputs, strict=False)  # into and out of
            convs = [nn.Conv2d(i, o, 3, stride=2, padding=1) for i, o in channels]
            for conv in convs:
                if args.conv_gain is not None:
                    layer_init(conv, args.conv_gain, generator)
                    continue
                # PyTorch's default distribution, drawn from our generator. It multiplies what
                # differs between two pictures by about 0.4 in every layer, 0.01 in all five.
                nn.init.kaiming_uniform_(conv.weight, a=math.sqrt(5), generator=generator)
                bound = 1 / math.sqrt(conv.weight[0].numel())
                nn.init.uniform_(conv.bias, -bound, bound, generator=generator)
            # ReLU in place: one array less to write and read again.
            layers = (m for c in convs for m in (c, nn.ReLU(inplace=True)))
            self.conv = nn.Sequential(*layers, nn.Flatten())
            self.conv.to(memory_format=torch.channels_last)
            self.project = layer_init(nn.Linear(32 * 3 * 3, H), root2, generator)
            return
        # The first layers of both nets read the same state, so they are one matrix of width 2H,
        # stored with one row per input: what OneHotLinear sums.
        inputs = math.prod(space.shape) * (self.num_ids or 1)
        halves = [nn.init.orthogonal_(torch.empty(H, inputs), root2, generator) for _ in "ac"]
        self.first = nn.Parameter(torch.cat(halves).T.contiguous())  # (inputs, 2H)
        self.first_bias = nn.Parameter(torch.zeros(2 * H))
        self.actor_hidden = layer_init(nn.Linear(H, H), root2, generator)
        self.critic_hidden = layer_init(nn.Linear(H, H), root2, generator)

    def forward(self, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """State (B, ...) -> policy code (B, H) and critic code (B, H)."""
        if self.is_image:
            features = self.convolve(state)  # (B, 32 * 3 * 3)
            if self.norm_features:
                features = F.layer_norm(features, features.shape[1:])
            code = F.relu(self.project(features))
            return code, code
        if self.num_ids:
            cells = torch.arange(state.shape[1], device=state.device) * self.num_ids
            first = OneHotLinear.apply(state + cells, self.first) + self.first_bias
        else:
            first = torch.addmm(self.first_bias, state, self.first)  # (B, inputs) -> (B, 2H)
        actor, critic = torch.tanh(first).chunk(2, dim=1)  # 2 x (B, H)
        return torch.tanh(self.actor_hidden(actor)), torch.tanh(self.critic_hidden(critic))

    def convolve(self, state: torch.Tensor) -> torch.Tensor:
        """Frames (B, 84, 84, C) uint8, see Preprocess -> features (B, 32 * 3 * 3) float32.

        With `shrink` 2 or 4 the frames are (B, 42, 42, C) or (B, 21, 21, C).
        """
        device, first = state.device, self.conv[0]
        bf16 = fast_bf16(device) if self.bf16 is None else self.bf16
        x = state.to(torch.bfloat16 if bf16 else torch.float32)  # 0 ... 255: exact in both
        x = x.permute(0, 3, 1, 2)  # (B, C, 84, 84) for PyTorch; in memory channels are still last
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            # The division of the pixels by 255 moves into the weights, which are far fewer.
            x = F.conv2d(x, first.weight / 255, first.bias, first.stride, first.padding)
            return self.conv[1:](x).float()


class FactorisedUtility(torch.autograd.Function):
    """logits[b, k] = w . relu(u[b] + P[available[b, k]]), in cache-sized pieces.

    The hidden layer of f_nu acts on the concatenation [state code; projected action], so its
    product splits into W_s s + W_c (A c + a): a state part u, once per state, and an action part
    P, once per action *of the whole table*. What is left per (state, action) pair is an addition,
    a ReLU and a dot product: memory traffic. Four ideas keep that cheap:
      - pieces of about 3 MB stay in the processor's cache through all their passes;
      - the backward pass computes the hidden layer again instead of storing B*K*H numbers, and
        writes in place what plain autograd would allocate each time;
      - relu(x) is x where the ReLU is open and 0 elsewhere, so the gradient of w follows from
        those of u and P (see backward), without a pass of its own;
      - where every set is the whole table (w/o sub-sampling, C.2), nothing has to be gathered and
        scattered but numbers: sets only differ in their order.
    tests/ hold the plain concatenation as its oracle.
    """

    @staticmethod
    def add(u, P, available):
        """u + P[available] of one piece: (b, H), (A, H), (b, K) -> (b, K, H).

        Where K reaches A: u + P, all actions in the table's order (b, A, H).
        """
        b, K = available.shape
        if K >= len(P):
            return u[:, None] + P
        x = P.index_select(0, available.reshape(-1)).view(b, K, -1)  # (b*K, H) -> (b, K, H)
        return x.add_(u[:, None])

    @staticmethod
    def logits(u, P, w, available):
        """One piece: u (b, H), P (A, H), w (H,), available (b, K) -> (b, K)."""
        logits = FactorisedUtility.add(u, P, available).relu_() @ w
        return logits.gather(1, available) if available.shape[1] >= len(P) else logits

    @staticmethod
    def forward(ctx, u, P, w, available, workers):
        """u (B, W), P (A, W), w (W,), available (B, K) -> logits (B, K)."""
        ctx.save_for_backward(u, P, w, available)
        ctx.workers = workers
        logits = u.new_empty(available.shape)  # (B, K)

        def piece(rows):
            logits[rows] = FactorisedUtility.logits(u[rows], P, w, available[rows])

        FactorisedUtility.run(piece, u, available, workers)
        return logits

    @staticmethod
    def backward(ctx, grad):
        """Gradient of the logits (B, K) -> gradients of u, P and w.

        With g the gradient of a logit and x = u + P the sum under its ReLU, every open unit h
        passes g w_h on to u_h and P_h, and gives w_h its g x_h = g u_h + g P_h. So with G_u and G_P
        the sums of g over the open units, for each state and each action:
            dL/du = G_u w,   dL/dP = G_P w,   dL/dw = sum_b u G_u + sum_a P G_P.
        """
        u, P, w, available = ctx.saved_tensors
        G_u = torch.empty_like(u)

        def piece(rows, G_P):
            """Write these rows of G_u, and add their part to G_P."""
            g, sets = grad[rows], available[rows]  # 2 x (b, K)
            whole = sets.shape[1] >= len(P)
            if whole:  # into the table's order
                g = g.new_zeros(len(g), len(P)).scatter_add_(1, sets, g)  # (b, A)
            x = FactorisedUtility.add(u[rows], P, sets).gt_(0)  # (b, K, H): 1 where open, else 0
            G_u[rows] = torch.bmm(g[:, None], x)[:, 0]  # (b, 1, K) @ (b, K, H) -> (b, H)
            x.mul_(g[..., None])
            if whole:
                G_P += x.sum(0)  # (b, A, H) -> (A, H)
            else:
                G_P.index_add_(0, sets.reshape(-1), x.view(-1, x.shape[2]))  # (b*K, H) -> (A, H)

        (parts,) = zip(*FactorisedUtility.run(piece, u, available, ctx.workers, P), strict=True)
        G_P = sum(parts)
        return G_u * w, G_P * w, (u * G_u).sum(0) + (P * G_P).sum(0), None, None

    @staticmethod
    def run(piece, u, available, workers, *like):
        """Call piece(rows, *accumulators) over all rows; each worker has its own accumulators.

        Workers are plain Python threads: torch releases the interpreter lock inside an operation.
        Rows are shared out in a fixed way and the sums are added in a fixed order, so a run with
        the same number of workers gives the same bits.
        """
        B, K = available.shape
        rows = max(1, 800_000 // (K * u.shape[1])) if u.device.type == "cpu" else B
        pieces = [slice(i, min(i + rows, B)) for i in range(0, B, rows)]
        shares = [s for s in (pieces[i :: workers.count] for i in range(workers.count)) if s]

        @torch.no_grad()  # gradient mode is per thread, and the pool's threads start with it on
        def work(share):
            sums = [torch.zeros_like(t) for t in like]
            for part in share:
                piece(part, *sums)
            return sums

        return [work(shares[0])] if len(shares) == 1 else list(workers.pool.map(work, shares))


class Workers:
    """A fixed number of threads for FactorisedUtility (1: no threads at all)."""

    def __init__(self, count: int):
        self.count = count
        # torch's own thread count is per calling thread: one each, so that the pool never nests.
        self.pool = ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,))


class CorrectedHead(nn.Module):
    """A position head that the chosen action corrects: [code; projected action] (B, 2H) -> (B, d).

    Ours, between D.3.2 and C.4: the linear head of D.3.2 on the code, plus the two layers of C.4,
    whose last one starts near zero. C.4 alone starts with a random place for each action, and what
    it then practises is the action whose random place happens to suit; this one starts with the
    same place for all.
    """

    def __init__(self, H, d, generator):
        super().__init__()
        self.plain = layer_init(nn.Linear(H, d), 1.0, generator)
        self.hidden = layer_init(nn.Linear(2 * H, H), 1.0, generator)
        self.correction = layer_init(nn.Linear(H, d), 0.01, generator)

    def forward(self, both):
        code = both[:, : self.plain.in_features]  # (B, 2H) -> (B, H)
        return self.plain(code) + self.correction(F.relu(self.hidden(both)))  # (B, d)


class Agent(nn.Module):
    """State encoder, critic, utility (or a baseline's head) and auxiliary heads.

    `table` (A, D) holds one fixed representation per action of the whole action set; it is never
    trained by RL. `train_ids` (n,) is the pool trained on; it also says what the outputs of the
    nearest-neighbour baseline mean.
    """

    def __init__(self, state_space, action_space, table, train_ids, args: Args, workers: Workers):
        super().__init__()
        hvae.keep_memory()  # for pictures; the other arrays are small enough to be kept anyway
        generator = torch.Generator().manual_seed(args.seed)
        self.method, self.aux_ent_scale, self.workers = args.method, args.aux_ent_scale, workers
        # torch.tensor copies into aligned memory: matrix products may round differently elsewhere.
        self.register_buffer("table", torch.tensor(table, dtype=torch.float32))  # (A, D)
        self.register_buffer("train_ids", torch.tensor(train_ids))
        self.noisy = None  # the table as the policy sees it during one rollout, see blur
        H, D = args.hidden_size, table.shape[1]
        W = args.utility_hidden or H
        self.encoder = StateEncoder(state_space, args, generator)
        self.critic = layer_init(nn.Linear(H, 1), math.sqrt(2), generator)
        self.bilinear = self.method == "utility" and args.utility == "bilinear"
        if self.bilinear:
            self.utility_query = layer_init(nn.Linear(H, D, bias=False), 0.01, generator)
        elif self.method == "utility":
            project, hidden, out = args.utility_gains
            self.action_project = layer_init(nn.Linear(D, H), project, generator)
            self.utility_hidden = layer_init(nn.Linear(2 * H, W), hidden, generator)
            self.utility_out = layer_init(nn.Linear(W, 1), out, generator)
            if args.outcome_coef:  # two readings of the hidden layer, see outcome_loss
                self.outcome = layer_init(nn.Linear(W, 2), 1.0, generator)
        elif self.method == "nearest-neighbor":  # one logit per *training* action
            self.head = layer_init(nn.Linear(H, len(train_ids)), 0.01, generator)
        else:  # continuous output: a Gaussian in representation space
            self.head_mean = layer_init(nn.Linear(H, D), 1.0, generator)
            self.head_var = layer_init(nn.Linear(H, D), 1.0, generator)
        heads = action_space.spaces if isinstance(action_space, gym.spaces.Dict) else {}
        self.has_position, self.has_stop = "position" in heads, "stop" in heads
        self.aux_conditioned = args.aux_conditioned
        self.explore = args.explore if self.method == "utility" else 0.0
        if self.has_position:
            d = heads["position"].shape[-1]
            if self.aux_conditioned and not hasattr(self, "action_project"):
                self.action_project = layer_init(nn.Linear(D, H), 1.0, generator)
            self.fc_alpha, self.fc_beta = (self.position_head(H, d, args, generator) for _ in "ab")
        if self.has_stop:
            self.fc_stop = layer_init(nn.Linear(H, 2), 0.01, generator)
            nn.init.constant_(self.fc_stop.bias[0], args.stop_bias)

    @staticmethod
    def position_head(H, d, args: Args, generator):
        """D.3.2: code -> d numbers; C.4: [code; projected action] -> hidden layer -> d numbers."""
        if not args.aux_conditioned:
            return layer_init(nn.Linear(H, d), 1.0, generator)
        if args.aux_residual:
            return CorrectedHead(H, d, generator)
        layers = nn.Linear(2 * H, H), nn.Linear(H, d)  # gains: published code
        first, last = (layer_init(layer, 1.0, generator) for layer in layers)
        return nn.Sequential(first, nn.ReLU(), last)

    def encode(self, state):
        """State (B, ...) -> code (B, H) and value (B,)."""
        code, critic_code = self.encoder(state)
        return code, self.critic(critic_code)[:, 0]

    def blur(self, scale, seed):
        """Let the policy see a noisy table from now on (scale 0: the table itself).

        Ours. With a thousand training actions the utility can learn single ones by heart. Noise
        leaves it what close actions have in common. One draw holds for a rollout and the update
        that learns from it, so PPO's two probabilities are of the same policy; its seed is the
        update's number, the same in every process and after --resume.
        """
        self.noisy = None
        if scale:
            noise = np.random.default_rng(seed).standard_normal(
                (len(self.train_ids), self.table.shape[1]), np.float32
            )  # (n, D)
            codes = self.table[self.train_ids]  # (n, D)
            off = scale * codes.std(0) * torch.as_tensor(noise, device=codes.device)
            self.noisy = self.table.index_copy(0, self.train_ids, codes + off)  # (A, D)

    @property
    def codes(self):
        """The representations (A, D) that the policy sees."""
        return self.table if self.noisy is None else self.noisy

    def project_actions(self, ids=None):
        """P (A, W): the action half of the utility's hidden layer, for every action there is.

        Depends on the parameters only: once per rollout when acting, once per minibatch when
        learning, and then only for the rows `ids` (n,) that the pool can offer, (n, W).
        D.3.2: c -> linear -> concatenate -> 2-layer MLP; no non-linearity in between.
        """
        if self.method != "utility":
            return None
        table = self.codes if ids is None else self.codes[ids]
        if self.bilinear:
            return table  # (A, D)
        H = self.action_project.out_features
        W_c = self.utility_hidden.weight[:, H:]  # (W, H): the columns that see the action
        return self.action_project(table) @ W_c.T + self.utility_hidden.bias  # (A, W)

    def choice_logits(self, code, available, P):
        """Logits over the K actions on offer, (B, K) [nearest neighbour: training actions]."""
        if self.method == "nearest-neighbor":
            return self.head(code)  # (B, N_train)
        if self.bilinear:  # (B, 1, D) @ (B, D, K) -> (B, 1, K)
            return torch.bmm(self.utility_query(code)[:, None], P[available].mT)[:, 0]
        H = self.action_project.out_features
        u = code @ self.utility_hidden.weight[:, :H].T  # (B, W): the columns that see the state
        w = self.utility_out.weight[0]
        if torch.is_grad_enabled():
            logits = FactorisedUtility.apply(u, P, w, available, self.workers)
        else:
            logits = FactorisedUtility.logits(u, P, w, available)
        return logits + self.utility_out.bias

    def predict_outcome(self, code, taken, P):
        """The utility's hidden layer for one action each, read out: (B, H), (B,) -> (B, 2)."""
        H = self.action_project.out_features
        u = code @ self.utility_hidden.weight[:, :H].T  # (B, W)
        # The gradient of P[taken] would add rows in whatever order the threads come to them.
        return self.outcome(F.relu(u + P.index_select(0, taken)))  # 2 x (B, W) -> (B, 2)

    def mixture(self, logp):
        """log of (1 - explore) pi + explore / K, the policy while learning: (B, K) -> (B, K).

        Ours. Our reading: a policy that improves stops trying what it takes to be bad, then forgets
        why; what it thinks of these actions is free to drift, and with it what it thinks of unseen
        ones, which no experience corrects. PPO learns the mixture, so it stays on-policy;
        evaluation plays pi alone. Actions that only `explore` would choose get hardly any policy
        gradient; what they teach is their outcome (outcome_loss). The entropy bonus stays pi's: it
        is pi that should not commit too early, the mixture never does.
        """
        if not self.explore:
            return logp
        return torch.log((1 - self.explore) * logp.exp() + self.explore / logp.shape[1])

    def gaussian(self, code):
        """Continuous output: mean and std (B, D) of the wished-for representation."""
        return self.head_mean(code), F.softplus(self.head_var(code)).sqrt()

    def nearest(self, wish, available):
        """Slot of the action on offer whose representation is nearest: (B, D), (B, K) -> (B,).

        |c - w|^2 = |c|^2 - 2 c.w + |w|^2, and the last term is the same for every action. The rest
        is one matrix product for the whole table, in double precision because it subtracts nearly
        equal numbers; the (B, K, D) array of differences never exists.
        """
        table = self.table.double()
        distance = table.square().sum(1) - 2 * wish.double() @ table.T  # (B, D) @ (D, A) -> (B, A)
        return distance.gather(1, available).argmin(1)  # (B, K) -> (B,)

    def auxiliary(self, code, noise=None, action=None, taken=None, greedy=False):
        """f_chi: position ~ Beta on [-1, 1] per dimension, stop ~ Categorical(2).

        Draws them when `action` is None (greedy: takes the mean position, the likelier of go on and
        stop). Returns the heads' values, summed log-probability (B,) and entropy (B,), the
        position's scaled by `aux_ent_scale`. `taken` (B,), the ids of the chosen actions, is what
        the position also depends on with --aux-conditioned (C.4).
        """
        out, logprob, entropy = {}, 0.0, 0.0
        stop_code = code  # C.4 conditions the position alone
        if self.has_position:
            if self.aux_conditioned:  # (B, H), (B, H) -> (B, 2H); the utility's own projection, if
                # there is a utility that has one
                code = torch.cat([code, self.action_project(self.codes[taken])], dim=1)
            # alpha, beta >= 1: a single peak, never piled up at both borders (D.3.2)
            alpha, beta = 1 + F.softplus(self.fc_alpha(code)), 1 + F.softplus(self.fc_beta(code))
            if action is None:
                both = torch.stack([alpha, beta], dim=-1)  # (B, d, 2)
                unit = alpha / (alpha + beta)  # (B, d), the mean
                if not greedy:  # a Beta is a 2-way Dirichlet; Beta.sample takes no generator
                    unit = torch._sample_dirichlet(both, noise)[..., 0]
                out["position"] = 2 * unit - 1  # (B, d) in [-1, 1]
            else:
                out["position"] = action["position"]
            dist = torch.distributions.Beta(alpha, beta, validate_args=False)
            # The density is that of [0, 1]; that of [-1, 1] is half of it per dimension, a constant
            # that PPO's ratio of two densities does not see. float32 can round to the border, where
            # the density may be zero or infinite.
            unit = (0.5 + out["position"] / 2).clamp(1e-6, 1 - 1e-6)
            logprob = logprob + dist.log_prob(unit).sum(1)
            entropy = entropy + self.aux_ent_scale * dist.entropy().sum(1)
        if self.has_stop:
            logp = F.log_softmax(self.fc_stop(stop_code), dim=1)  # (B, 2)
            if action is None:
                out["stop"] = logp.argmax(1) if greedy else sample(logp, noise)
            else:
                out["stop"] = action["stop"]
            logprob = logprob + logp.gather(1, out["stop"][:, None])[:, 0]
            entropy = entropy - (logp.exp() * logp).sum(1)
        return out, logprob, entropy

    @torch.no_grad()
    def act(self, state, available, P, generator, greedy=False, learning=False):
        """Choose actions: (B, ...), (B, K) -> (action dict, log-probability (B,), value (B,)).

        action["choice"] is a slot of `available`, what the environment executes. The baselines
        also return what the policy gradient acts on: "head" (training-action index) or "wish" (a
        point in representation space); turning it into a slot is then part of the environment.
        """
        code, value = self.encode(state)
        action = {}
        if self.method == "continuous":
            mean, std = self.gaussian(code)
            noise = torch.randn(mean.shape, generator=generator, device=mean.device)
            action["wish"] = mean if greedy else mean + std * noise
            logprob = gaussian_logprob(action["wish"], mean, std)
            action["choice"] = self.nearest(action["wish"], available)
        else:
            logp = F.log_softmax(self.choice_logits(code, available, P), dim=1)
            logp = self.mixture(logp) if learning else logp
            choice = logp.argmax(1) if greedy else sample(logp, generator)
            logprob = logp.gather(1, choice[:, None])[:, 0]
            if self.method == "nearest-neighbor":
                action["head"] = choice
                choice = self.nearest(self.table[self.train_ids[choice]], available)
            action["choice"] = choice
        if self.aux_conditioned:
            action["taken"] = available.gather(1, action["choice"][:, None])[:, 0]  # (B,) ids
        aux, aux_logprob, _ = self.auxiliary(
            code, generator, taken=action.get("taken"), greedy=greedy
        )
        return action | aux, logprob + aux_logprob, value

    def logprob_entropy(self, code, available, action, P):
        """Log-probability and entropy, each (B,), of stored actions under the current policy."""
        if self.method == "continuous":
            mean, std = self.gaussian(code)
            logprob = gaussian_logprob(action["wish"], mean, std)
            # Averaged over dimensions, so that the coefficient does not depend on D (published
            # code: the sum in Grid World, the average elsewhere).
            entropy = (0.5 + 0.5 * math.log(2 * math.pi) + std.log()).mean(1)
        else:
            logp = F.log_softmax(self.choice_logits(code, available, P), dim=1)  # (B, K)
            taken = action["choice" if self.method == "utility" else "head"]
            logprob = self.mixture(logp).gather(1, taken[:, None])[:, 0]
            entropy = -(logp.exp() * logp).sum(1)
        _, aux_logprob, aux_entropy = self.auxiliary(
            code, action=action, taken=action["taken"] if self.aux_conditioned else None
        )
        return logprob + aux_logprob, entropy + aux_entropy


def sample(logp: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """One draw per row from log-probabilities (B, K) -> (B,).

    A uniform number falls between two of the sums p_1, p_1 + p_2, ...; one number per row, where
    torch.multinomial or Gumbel noise draw K. In float64, so that rare actions keep their share.
    """
    cdf = logp.exp().cumsum(1, dtype=torch.float64)  # (B, K)
    u = torch.rand(len(cdf), 1, generator=generator, dtype=cdf.dtype, device=cdf.device)
    return torch.searchsorted(cdf, u * cdf[:, -1:], right=True)[:, 0]  # the first sum above it


def gaussian_logprob(x, mean, std):
    """Diagonal Gaussian log-density summed over dimensions, clamped to +-1e5 (published code)."""
    logp = -0.5 * ((x - mean) / std).square() - std.log() - 0.5 * math.log(2 * math.pi)
    return logp.sum(1).clamp(-1e5, 1e5)


class RunningMeanStd:
    """Mean and variance over a stream of batches (float64, parallel-variance formula).

    Published code updates it every step; we update once per rollout, so that the policy that
    collects is exactly the policy that learns (and it costs 1/T of the time).
    """

    def __init__(self, shape: tuple[int, ...] = ()):
        self.mean, self.var, self.count = np.zeros(shape), np.ones(shape), 1e-4

    def update(self, x: np.ndarray) -> None:
        """Merge a batch (n, *shape)."""
        n, delta = len(x), x.mean(0, dtype=np.float64) - self.mean
        total = self.count + n
        squares = self.var * self.count + x.var(0, dtype=np.float64) * n
        self.var = (squares + delta**2 * self.count * n / total) / total
        self.mean, self.count = self.mean + delta * n / total, total

    def normalize(self, x: np.ndarray) -> np.ndarray:
        """(x - mean) / std clipped to +-10, as float32 (eps and clip: published code)."""
        return ((x - self.mean) / np.sqrt(self.var + 1e-8)).clip(-10, 10).astype(np.float32)

    def state(self) -> dict:
        """Plain tensors, for the checkpoint."""
        return {k: torch.as_tensor(v, dtype=torch.float64) for k, v in vars(self).items()}

    def load(self, state: dict) -> None:
        """The inverse of `state`."""
        for key, value in state.items():
            setattr(self, key, value.cpu().numpy().copy() if value.ndim else value.item())


# ---- environments, pools, representations ----


def task_options(args: Args) -> dict:
    """The options this environment's constructor takes, from the fields of Args."""
    names = TASK_OPTIONS.get(args.env, ())
    return {n: getattr(args, n) for n in names if getattr(args, n) is not None}


def make_envs(args: Args, pool: np.ndarray, num_envs: int, num_available: int, seed: int):
    """A vector environment that offers `num_available` actions of `pool` per episode."""
    module = importlib.import_module(MODULES[args.env])
    return module.make_vec(num_envs, pool, num_available, seed, **task_options(args))


def action_pools(args: Args) -> tuple[dict[str, np.ndarray], np.ndarray, int]:
    """The three pools of the split, the pool trained on and how many of it are on offer."""
    module = importlib.import_module(MODULES[args.env])
    pools = module.split_actions(args.split, args.split_seed)
    pool, num_available = pools["test" if args.adapt else "train"], args.num_available
    # The nearest-neighbour baseline, the ablation and adaptation see one set in every episode.
    fixed = args.method == "nearest-neighbor" or args.adapt or not args.subsample
    if fixed:
        size = args.fixed_set_size if args.method == "utility" else None
        if size is not None and size < len(pool):
            pool = np.sort(np.random.default_rng(42).choice(pool, size, replace=False))
        num_available = len(pool)
    if num_available > len(pool):
        raise ValueError(
            f"num_available {num_available} is more than the {len(pool)} training actions"
        )
    return pools, pool, num_available


def load_table(args: Args, train_ids: np.ndarray) -> np.ndarray:
    """The table of representations (A, D); trains the encoder first if it is not on disk.

    Raises ValueError or FileNotFoundError when a named file is missing, broken or was made for
    another environment, split or action set.
    """
    module = importlib.import_module(MODULES[args.env])
    kind = args.representation
    if kind.startswith("engineered"):
        options = task_options(args)
        if kind != "engineered":
            options["variant"] = kind.removeprefix("engineered-")
        known = signature(module.engineered_representations).parameters
        table = module.engineered_representations(**{k: options[k] for k in options if k in known})
        if "variant" in options and "variant" not in known:
            raise ValueError(f"representation {kind!r}: {args.env} has only 'engineered'")
    else:
        path = Path(kind)
        if kind in ("hvae", "hvae-all", "vae"):
            hvae_args = hvae.Args(
                env=args.env,
                modality=args.modality,
                hierarchical=kind != "vae",
                train_on="all" if kind == "hvae-all" else "train",
                split=args.split,
                split_seed=args.split_seed,
                seed=args.hvae_seed,
                recipe=args.hvae_recipe,
                device=args.device,
                runs_dir=args.runs_dir,
            )
            path = hvae.representation_path(hvae_args)
            if not path.exists():
                print(f"no representation at {path} yet: training the encoder first", flush=True)
                hvae.train(hvae_args)
        elif path.suffix != ".npz":
            raise ValueError(
                f"representation {kind!r} is not one of hvae, hvae-all, vae, engineered, "
                "engineered-5d, engineered-path, or the path of an .npz file"
            )
        loaded = hvae.load_representation(path, args.env, args.split, args.split_seed)
        if kind in ("hvae", "hvae-all", "vae"):
            # A recipe may have changed since its table was made.
            wanted = hvae.settings(hvae.resolve(hvae_args))
            for name in hvae.OVERRIDES:
                if (there := loaded["config"].get(name, wanted[name])) != wanted[name]:
                    raise ValueError(
                        f"{path} was made with {name} {there}, the recipe now has {wanted[name]}: "
                        "delete it, and it is made again"
                    )
        table = loaded["mean"]
    if args.standardize:
        std = table[train_ids].std(0)
        std[std < 1e-6] = 1.0  # constant in training: no scale to learn, whatever others have
        table = (table - table[train_ids].mean(0)) / (std + 1e-8)
    return np.ascontiguousarray(table, dtype=np.float32)


class Preprocess:
    """What the agent does to a state before its networks see it (section 2.1 of the protocol).

    Vector states: numbers are normalised by running statistics, which stand still at evaluation;
    with `one_hot`, integer ids are renumbered 0, 1, 2, ... (Grid World uses 6 of the ids 0..11), so
    that the one-hot vectors hold no entry that never occurs. Image states stay uint8; they become
    (N, 84, 84, C), the order the convolutions read, once here instead of in every epoch. With
    `shrink` 2, every 2 x 2 pixels become their mean: (N, 42, 42, C). With `white_is_zero` a pixel
    is how dark it is, so that empty space adds nothing to any feature. As it comes, white adds the
    same large number everywhere, and what differs between two pictures is lost in it.
    `space` describes the result; `first_states` (N, ...) shows which ids there are.
    """

    def __init__(self, space: gym.spaces.Box, args: Args, first_states=None):
        self.one_hot, self.is_image = args.one_hot, len(space.shape) == 3
        self.shrink, self.white_is_zero = args.shrink, args.white_is_zero
        self.normalizes = args.norm_obs and not (self.one_hot or self.is_image)
        self.stats, self.space, self.ids = RunningMeanStd(space.shape), space, np.zeros(0, int)
        if self.one_hot:
            if not np.issubdtype(space.dtype, np.integer):
                raise ValueError(f"one_hot needs integer states; these are {space.dtype}")
            self.set_ids(np.unique(first_states))

    def set_ids(self, ids: np.ndarray) -> None:
        """Number the ids that occur; any other id would share number 0."""
        self.ids, self.number = ids, np.zeros(256, dtype=np.int64)
        self.number[ids] = np.arange(len(ids))
        self.space = gym.spaces.Box(0, len(ids) - 1, self.space.shape, np.int64)

    def __call__(self, state: np.ndarray) -> torch.Tensor:
        if self.one_hot:
            return torch.from_numpy(self.number[state])
        if self.is_image:
            if (k := self.shrink) > 1:  # whole numbers: faster than avg_pool2d of floats
                rows = sum(state[:, :, i::k].astype(np.uint16) for i in range(k))
                total = sum(rows[..., i::k] for i in range(k))  # (N, C, 84 / k, 84 / k)
                state = ((total + k * k // 2) // (k * k)).astype(np.uint8)  # rounded
            if self.white_is_zero:
                exists = state.any(axis=(2, 3), keepdims=True)  # (N, C, 1, 1); else all black
                state = (255 - state) * exists
            return torch.as_tensor(state).permute(0, 2, 3, 1).contiguous()  # (N, 84, 84, C)
        x = self.stats.normalize(state) if self.normalizes else state.astype(np.float32)
        return torch.from_numpy(x).clone()  # into aligned memory, see Agent

    def state(self) -> dict:
        """Plain tensors, for the checkpoint."""
        return self.stats.state() | {"ids": torch.as_tensor(self.ids)}

    def load(self, state: dict) -> None:
        """The inverse of `state`."""
        self.stats.load({k: v for k, v in state.items() if k != "ids"})
        if self.one_hot:
            self.set_ids(state["ids"].cpu().numpy())


# ---- several processes: `torchrun --nproc_per_node=N ppo_actiongen.py ...` ----
#
# Every process (rank) holds the same agent, plays num_envs / N environments and learns from its own
# part of each minibatch. What must be equal everywhere (gradients, running statistics, scores) is
# exchanged by the two functions below; files and screen belong to rank 0.


def gathered(x) -> list:
    """Everyone's `x`, in the order of the ranks (one process: only its own); all ranks wait."""
    if WORLD_SIZE == 1:
        return [x]
    everyone = [None] * WORLD_SIZE
    dist.all_gather_object(everyone, x)
    return everyone


def average_gradients(parameters) -> None:
    """Replace every gradient by its mean over the ranks: one message for all of them."""
    if WORLD_SIZE == 1:
        return
    grads = [p.grad for p in parameters if p.grad is not None]
    flat = torch.cat([g.flatten() for g in grads])
    dist.all_reduce(flat)
    means = (flat / WORLD_SIZE).split([g.numel() for g in grads])
    for grad, mean in zip(grads, means, strict=True):
        grad.copy_(mean.view_as(grad))


# ---- Algorithm 1: rollout, advantages, update ----


def to_env(action: dict[str, torch.Tensor]):
    """The part of an action the environment executes, as numpy (a dict only if it is hybrid)."""
    parts = {k: v.cpu().numpy() for k, v in action.items() if k in ("choice", "position", "stop")}
    return parts if len(parts) > 1 else parts["choice"]


@torch.no_grad()
def rollout(envs, obs, agent, preprocess, num_steps, generator, device, metric):
    """Collect T steps from N environments.

    Stores the ids on offer (T, N, K), never their representations: the update rebuilds the softmax
    over the very set that was offered. Returns (batch of (T, N, ...) tensors, next observation,
    list of (score, return, length) of the episodes that ended).
    """
    P = agent.project_actions()
    steps, episodes = [], []
    for _ in range(num_steps):
        state, available = preprocess(obs["state"]), torch.as_tensor(obs["available"])
        action, logprob, value = agent.act(
            state.to(device), available.to(device), P, generator, learning=True
        )
        step = dict(state=state, available=available, logprob=logprob, value=value) | action
        if preprocess.normalizes:
            step["raw"] = obs["state"]  # for its running statistics
        obs, reward, terminated, truncated, infos = envs.step(to_env(action))
        # Time limits count as ends: they are part of these tasks and short (published code).
        done = terminated | truncated
        steps.append(step | dict(reward=reward, done=done))
        if done.any():
            final, episode = infos["final_info"], infos["final_info"]["episode"]
            episodes += zip(
                final[metric][done], episode["r"][done], episode["l"][done], strict=True
            )
    batch = {
        key: torch.stack([torch.as_tensor(s[key]) for s in steps])  # (T, N, ...)
        for key in steps[0]
    }
    return batch, obs, episodes


def gae(rewards, values, dones, next_value, gamma, lam):
    """Generalised advantage estimation, backwards in time; all arrays (T, N) [next_value (N,)].

    delta_t = r_t + gamma (1 - done_t) V_{t+1} - V_t
    A_t = delta_t + gamma lam (1 - done_t) A_{t+1}
    Here done_t says that *this* step ended the episode (CleanRL's dones are shifted by one).
    """
    advantages, last = np.zeros_like(rewards), np.zeros_like(next_value)
    for t in reversed(range(len(rewards))):
        alive = 1.0 - dones[t]
        delta = rewards[t] + gamma * alive * next_value - values[t]
        advantages[t] = last = delta + gamma * lam * alive * last
        next_value = values[t]
    return advantages


def explained_variance(values, returns) -> float:
    """1 - Var[return - V] / Var[return] over the rollout: 1 a perfect critic, 0 a useless one."""
    pair = np.stack([x.flatten().cpu().double().numpy() for x in (values, returns)])  # (2, T*N)
    values, returns = np.concatenate(gathered(pair), axis=1)
    spread = returns.var()
    return float(1 - (returns - values).var() / spread) if spread else math.nan


class RewardScale:
    """Divide rewards by the running std of the discounted return G <- gamma G + r (no mean)."""

    def __init__(self, num_envs: int, gamma: float):
        self.gamma, self.G, self.stats = gamma, np.zeros(num_envs), RunningMeanStd()

    def __call__(self, rewards: np.ndarray, dones: np.ndarray) -> np.ndarray:
        """Rewards and dones (T, N) -> scaled rewards (T, N), clipped to +-10."""
        returns = np.empty_like(rewards)
        for t in range(len(rewards)):
            returns[t] = self.G = self.gamma * self.G + rewards[t]
            self.G = self.G * (1.0 - dones[t])
        self.stats.update(np.concatenate(gathered(returns.reshape(-1))))
        return (rewards / np.sqrt(self.stats.var + 1e-8)).clip(-10, 10)


def outcome_loss(agent, code, mb, P):
    """Ours: the utility's hidden layer has to tell what the chosen action led to, a scalar loss.

    Predicted are mb["q"] (B,) = r + gamma V(s'), and mb["over"] (B,), whether the episode ended.
    PPO's signal about an action is one advantage, weighted by how probable the action is anyway,
    and fades once the policy has made up its mind. What an action leads to is the same fact however
    the policy changes, and unseen actions are judged by the hidden units that learned it.
    """
    taken = mb["available"].gather(1, mb["choice"][:, None])[:, 0]  # (B, K) -> (B,) rows of P
    q, over = agent.predict_outcome(code, taken, P).unbind(1)  # 2 x (B,)
    error = 0.5 * (q - mb["q"]).square().mean()
    return error + F.binary_cross_entropy_with_logits(over, mb["over"])


def ppo_loss(agent, mb, P, ent_coef: float, args: Args):
    """The clipped loss of one minibatch; returns (loss, dict of its parts)."""
    code, value = agent.encode(mb["state"])
    logprob, entropy = agent.logprob_entropy(code, mb["available"], mb, P)
    logratio = logprob - mb["logprob"]
    ratio = logratio.exp()
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    pg_loss = -torch.min(ratio * mb["advantage"], clipped * mb["advantage"]).mean()
    v_error = (value - mb["return"]).square()
    if args.clip_vloss:  # on the raw value scale (published code)
        v_near = mb["value"] + (value - mb["value"]).clamp(-args.clip_coef, args.clip_coef)
        v_error = torch.max(v_error, (v_near - mb["return"]).square())
    v_loss = 0.5 * v_error.mean()
    entropy = entropy.mean()
    loss = pg_loss + args.vf_coef * v_loss - ent_coef * entropy
    if hasattr(agent, "outcome"):
        loss = loss + args.outcome_coef * outcome_loss(agent, code, mb, P)
    with torch.no_grad():
        clip_fraction = ((ratio - 1).abs() > args.clip_coef).float().mean()
        approx_kl = (ratio - 1 - logratio).mean()  # E[r - 1 - log r], r under the old policy
    parts = dict(pg_loss=pg_loss, v_loss=v_loss, entropy=entropy)
    parts |= dict(clip_fraction=clip_fraction, approx_kl=approx_kl)
    return loss, {k: v.detach() for k, v in parts.items()}


def update(agent, optimizer, batch, ent_coef, args: Args, generator, device):
    """PPO's epochs over one rollout; returns the mean of each loss part over all minibatches."""
    ids = agent.train_ids  # (n,): only these were on offer, so only their rows are projected
    row = torch.zeros(len(agent.table), dtype=torch.int64, device=device)
    row[ids] = torch.arange(len(ids), device=device)
    skip = ("raw", "reward", "done", "choice" if args.method != "utility" else "")
    b = {k: v.flatten(0, 1).to(device) for k, v in batch.items() if k not in skip}  # (T*N, ...)
    b["available"] = row[b["available"]]  # (T*N, K): global ids -> rows of project_actions(ids)
    # Normalised once over the whole rollout: every epoch sees the same values (published code).
    # Under torchrun all processes together make one rollout and one minibatch: with shares of equal
    # size, the mean of their gradients is the gradient of the whole.
    adv = b["advantage"]
    joint = torch.cat(gathered(adv.cpu()))
    b["advantage"] = (adv - joint.mean()) / (joint.std() + 1e-5)
    size = len(adv) // args.num_minibatches
    micro = args.micro_batch or size
    totals: dict[str, torch.Tensor] = {}
    for _ in range(args.update_epochs):
        permutation = torch.randperm(len(adv), generator=generator, device=device)
        for start in range(0, len(adv), size):
            optimizer.zero_grad()
            # The parameters changed, so the table is projected again: (n, W), cheap. Its gradient
            # is collected in a leaf and goes through the projection once, after all micro-batches.
            P = agent.project_actions(ids)
            leaf = P.detach().requires_grad_() if P is not None and P.requires_grad else P
            for mb_inds in permutation[start : start + size].split(micro):
                # index_select copies whole rows, ten times as fast for frames as v[mb_inds]
                mb = {k: v.index_select(0, mb_inds) for k, v in b.items()}
                loss, parts = ppo_loss(agent, mb, leaf, ent_coef, args)
                share = len(mb_inds) / size  # means of micro-batches -> mean of the minibatch
                (loss * share).backward()
                for key, part in parts.items():
                    totals[key] = totals.get(key, 0) + part * share
            if leaf is not P:
                P.backward(leaf.grad)
            average_gradients(agent.parameters())
            nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
            optimizer.step()
    count = args.update_epochs * args.num_minibatches
    ranks = gathered({k: v.item() / count for k, v in totals.items()})
    return {k: sum(means[k] for means in ranks) / WORLD_SIZE for k in totals}


# ---- Algorithm 2: acting with new actions ----


@torch.no_grad()
def evaluate(
    agent, preprocess, args, pool, episodes, seed, num_available=None, greedy=False, tally=None
):
    """Score of the frozen policy on `episodes` episodes with actions of `pool`.

    Actions are sampled, as published (greedy is an extra). Every environment plays the same number
    of episodes: stopping at "the first so many to finish" would favour short ones.
    Returns dict(score, stderr, episodes, return, length). `tally` (2, A), if given, counts how
    often each action was chosen and how often it was on offer.
    """
    module = importlib.import_module(MODULES[args.env])
    num_available = num_available or args.eval_available or args.num_available
    num_envs = min(episodes, 40 if episodes >= 1000 else 32)  # published: 40 x 125, 32 x 20
    num_envs = -(-num_envs // WORLD_SIZE)  # torchrun: each process plays its part
    episodes = episodes // WORLD_SIZE + (RANK < episodes % WORLD_SIZE)
    seed += RANK * num_envs  # CREATE, Stacking: environment i of them all starts from seed + i
    quota = np.full(num_envs, episodes // num_envs)
    quota[: episodes % num_envs] += 1
    device = agent.table.device
    generator = torch.Generator(device).manual_seed(seed)
    envs = make_envs(args, pool, num_envs, min(num_available, len(pool)), seed)
    obs, _ = envs.reset(seed=seed)
    P = agent.project_actions() if args.method == "utility" else None
    played, results = np.zeros(num_envs, dtype=int), []
    while (played < quota).any():
        state, available = preprocess(obs["state"]), torch.as_tensor(obs["available"])
        action, *_ = agent.act(state.to(device), available.to(device), P, generator, greedy)
        if tally is not None:
            counted = torch.as_tensor(played < quota)
            taken = available.gather(1, action["choice"][:, None].cpu())  # (N, K), (N, 1) -> (N, 1)
            for row, ids in enumerate((taken, available)):
                tally[row] += np.bincount(ids[counted].flatten(), minlength=tally.shape[1])
        obs, _, terminated, truncated, infos = envs.step(to_env(action))
        done = terminated | truncated
        for i in np.flatnonzero(done & (played < quota)):
            final = infos["final_info"]
            episode = final["episode"]
            results.append((final[module.METRIC][i], episode["r"][i], episode["l"][i]))
        played += done
    envs.close()
    results = [r for part in gathered(results) for r in part]
    score, returns, lengths = np.array(results, dtype=np.float64).T  # each (episodes,)
    return {
        "score": score.mean(),
        "stderr": score.std() / math.sqrt(len(score)),
        "episodes": len(score),
        "return": returns.mean(),
        "length": lengths.mean(),
    }


# ---- what a run leaves behind ----

COLUMNS = (
    "step seconds sps train_score valid_score episode_score episode_return episode_length "
    "pg_loss v_loss entropy clip_fraction approx_kl explained_variance learning_rate"
).split()


def write_atomically(path: Path, write) -> None:
    """Call write(temporary path) and rename: a reader never sees half a file (rank 0 only)."""
    if RANK:
        return
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def method_name(args: Args) -> str:
    """The method's name in results/published_results.csv, so that the two files join.

    What the paper does not have gets a name of its own: _bilinear, ours_<name of an .npz file>.
    """
    plain = args.method != "utility" or args.utility == "mlp"
    return utility_name(args) + ("" if plain else "_bilinear")


def utility_name(args: Args) -> str:
    """`method_name`, whatever the form of the utility."""
    if args.adapt:
        policy = "ours" if args.method == "utility" else "discrete"
        return f"{policy}_finetuned" if args.finetune else f"{policy}_from_scratch"
    if args.method != "utility":
        name = {"nearest-neighbor": "nearest_neighbor", "continuous": "continuous_output"}
        return name[args.method]
    if not args.subsample:
        return "ours_no_subsampling"
    if args.ent_coef == 0:
        return "ours_no_entropy"
    names = {"hvae-all": "oracle_encoder_all_actions", "vae": "non_hierarchical_vae"}
    if args.representation in names:
        return names[args.representation]
    if args.representation.endswith(".npz"):
        return f"ours_{Path(args.representation).stem}"
    if args.representation.startswith("engineered") and args.env != "recsys":
        return args.representation.replace("-", "_")
    if args.utility == "mlp" and not modality_is_default(args):
        return "ours_video" if args.modality == "video" else "ours_alternate_modality"
    return next(iter(variants(args)), "ours")


def modality_is_default(args: Args) -> bool:
    """Whether the encoder sees what the environment's first modality shows."""
    first = importlib.import_module(MODULES[args.env]).MODALITIES[:1]
    return args.modality is None or [args.modality] == [*first]


def variants(args: Args) -> list[str]:
    """The variants of the task or of our policy that these options ask for."""
    corrected = args.aux_conditioned and args.aux_residual
    usual = default_args(args.env, args.recipe, False).aux_residual  # then it is simply ours
    chosen = {
        "ours_full_split": args.split == "full",
        "ours_conditioned_auxiliary": args.aux_conditioned and not args.aux_residual,
        "ours_corrected_auxiliary": corrected and not usual,  # not published
        "ours_no_subgoal_reward": not args.subgoal_reward,
        "ours_no_place": args.placement == "none",
        "ours_2d_place": args.placement == "2d",
    }
    return [name for name, is_chosen in chosen.items() if is_chosen]


def experiment_name(args: Args) -> str:
    """<env>[-task][-full]: names runs and results; -full is the fully observable recommender."""
    parts = args.env, args.task, "full" if args.fully_observable else None
    return "-".join(p for p in parts if p)


def published_scores(args: Args) -> dict[str, float]:
    """Published mean per phase of this method, {} where there is none."""
    path = Path(__file__).parent / "results" / "published_results.csv"
    env = args.env + ("_full" if args.fully_observable else "")
    scores, method = {}, method_name(args).removesuffix("_bilinear")
    # Each variant was published alone and of our policy; analysis is a split without such numbers.
    if variants(args) not in ([], [method]) or args.split not in ("default", "full"):
        return {}
    # So were the baselines, the ablations and the other representations: no two of them at once.
    usual = PRESETS[args.env].representation == args.representation
    apart = [args.method != "utility", not args.subsample, args.ent_coef == 0, not usual]
    if sum([*apart, not modality_is_default(args)]) > 1:
        return {}
    if path.exists():
        for row in csv.DictReader(path.open()):
            same_task = (row["task"] or None) in (args.task, None)
            if row["env"] == env and same_task and row["method"] == method:
                scores[row["phase"]] = float(row["mean"])
    return scores


def save_checkpoint(path: Path, agent, optimizer, generator, preprocess, scale, **plain) -> None:
    """Everything needed to go on bit for bit: tensors and plain types only, no pickled objects."""
    state = {
        "agent": agent.state_dict(),
        "optimizer": optimizer.state_dict(),
        "generator": torch.stack(gathered(generator.get_state())),  # (ranks, bytes)
        "preprocess": preprocess.state(),
        "reward_stats": scale.stats.state(),
    }
    write_atomically(path, lambda temporary: torch.save(state | plain, temporary))


def load_checkpoint(path: Path, device) -> dict:
    """Read a checkpoint without running any code in it; one clear line if that fails."""
    if not path.exists():
        raise FileNotFoundError(f"no checkpoint at {path}")
    try:
        checkpoint = torch.load(path, map_location=device, weights_only=True)
        missing = {"agent", "preprocess", "args"} - set(checkpoint)
    except Exception as e:  # torch raises a dozen kinds for broken or foreign files
        reason = (str(e).strip() or type(e).__name__).splitlines()[0][:100]
        raise ValueError(f"{path} is not a checkpoint of this script ({reason})") from None
    if missing:
        raise ValueError(f"{path} is not a checkpoint of this script (no {sorted(missing)[0]!r})")
    return checkpoint


class MetricsFile:
    """metrics.csv: one row per update, flushed at once; cut back to the checkpoint on resume."""

    def __init__(self, path: Path, last_step: int):
        self.path, rows = path, []
        if last_step and path.exists():
            lines = path.read_text().splitlines()[1:]
            rows = [r for r in lines if r.count(",") == len(COLUMNS) - 1]
            rows = [r for r in rows if int(r.split(",")[0]) <= last_step]
        text = "\n".join([",".join(COLUMNS), *rows]) + "\n"
        write_atomically(path, lambda temporary: temporary.write_text(text))
        self.file = open(os.devnull, "a") if RANK else path.open("a")

    def write(self, row: dict) -> None:
        """Append one row; a missing or not-a-number value is an empty cell."""
        cells = [row.get(c) for c in COLUMNS]
        empty = [c is None or (isinstance(c, float) and math.isnan(c)) for c in cells]
        text = [
            "" if e else f"{c:.6g}" if isinstance(c, float) else str(c)
            for c, e in zip(cells, empty, strict=True)
        ]
        self.file.write(",".join(text) + "\n")
        self.file.flush()


def plot_curve(metrics: Path, path: Path, metric: str, published: dict, ceiling) -> None:
    """Train and validation score over steps, raw (not held at their maximum), as curve.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = [r for r in csv.DictReader(metrics.open()) if r["train_score"]]
    steps = [int(r["step"]) / 1e6 for r in rows]
    figure, axis = plt.subplots(figsize=(6, 4))
    for name, label in (("train_score", "training actions"), ("valid_score", "validation actions")):
        if not rows or not rows[0][name]:
            continue  # adaptation has no validation actions
        axis.plot(steps, [float(r[name]) for r in rows], marker=".", label=label)
    if ceiling is not None:
        axis.axhline(ceiling, color="grey", lw=1, label="ceiling")
    if "test" in published:
        axis.axhline(
            published["test"], color="grey", ls="--", lw=1, label="published, test actions"
        )
    axis.set(xlabel="environment steps (millions)", ylabel=metric, ylim=(0, None))
    axis.legend(frameon=False)
    figure.tight_layout()
    write_atomically(path, lambda temporary: figure.savefig(temporary, format="png", dpi=120))
    plt.close(figure)


@torch.no_grad()
def record_episode(agent, preprocess, args: Args, pool, path: Path) -> None:
    """Play with unseen actions and save an episode as a GIF: the best of 20, by return.

    After adaptation all of them are on offer, as in training.
    """
    module = importlib.import_module(MODULES[args.env])
    names = {"gridworld": "GridWorldEnv", "recsys": "RecSysEnv"}
    make = getattr(module, names.get(args.env, args.env.capitalize() + "Env"))
    K = len(pool) if args.adapt else min(args.eval_available or args.num_available, len(pool))
    env = make(pool, K, render_mode="rgb_array", **task_options(args))
    device, P = agent.table.device, agent.project_actions()
    generator = torch.Generator(device).manual_seed(args.seed)
    best = (-math.inf, 0, [])  # return, seed, actions
    for attempt in range(20):
        seed, actions, done, total = 10_000 + args.seed + attempt, [], False, 0.0
        obs, _ = env.reset(seed=seed)
        while not done:
            state = preprocess(obs["state"][None]).to(device)  # (1, ...)
            available = torch.as_tensor(obs["available"])[None].to(device)  # (1, K)
            action, *_ = agent.act(state, available, P, generator)
            parts = to_env(action)
            actions.append({k: v[0] for k, v in parts.items()} if type(parts) is dict else parts[0])
            obs, reward, terminated, truncated, _ = env.step(actions[-1])
            total, done = total + reward, terminated or truncated
        if total > best[0]:
            best = (total, seed, actions)
    # The same seed and actions again, now with pictures: these take most of the time.
    env.reset(seed=best[1])
    frames = [env.render()]
    for action in best[2]:
        env.step(action)
        frames += env.render_frames()
    env.close()
    module.save_gif(path, frames, fps=env.metadata["render_fps"])


def print_table(results: dict, metric: str) -> None:
    """The last thing on the screen: seen against unseen actions, published score, ceiling."""
    print(f"\n{metric:10} {'ours':>16} {'published':>10} {'ceiling':>8}   ({results['method']})")
    labels = {"train": "seen", "valid": "validation", "test": "unseen"}
    if "test" not in results:
        labels = {"train": "adapted to"}
    for phase, label in labels.items():
        ours, published = results[phase], results["published"].get(phase)
        ceiling = results["ceiling"][phase]
        print(
            f"{label:10} {ours['score']:9.3f} ±{ours['stderr']:.3f}"
            f" {'-' if published is None else format(published, '.3f'):>12}"
            f" {'-' if ceiling is None else format(ceiling, '.3f'):>8}"
        )


# ---- Algorithm 1: the training loop ----


def check_actions_seen(args: Args) -> None:
    """Raise ValueError where options about what the networks see of the actions do not fit."""
    if args.aux_conditioned and (
        args.env not in ("create", "stacking") or args.placement == "none"
    ):
        raise ValueError("aux_conditioned: there is no position to choose here")
    if args.table_noise and args.method != "utility":
        raise ValueError(f"table_noise needs method 'utility', not {args.method!r}")


def check(args: Args) -> None:
    """Refuse impossible settings with one line, before anything is written."""
    positive = "num_available total_timesteps minibatch_size num_envs num_minibatches update_epochs"
    positive += " eval_every valid_episodes eval_episodes threads hidden_size utility_hidden"
    for name in f"{positive} fixed_set_size eval_available lr_decay_steps".split():
        if getattr(args, name) is not None and getattr(args, name) < 1:
            raise ValueError(f"{name} {getattr(args, name)} is not allowed; at least 1")
    if args.minibatch_size * args.num_minibatches % args.num_envs:
        raise ValueError(
            f"minibatch_size {args.minibatch_size} x num_minibatches {args.num_minibatches} is not "
            f"a multiple of num_envs {args.num_envs}"
        )
    if args.num_envs % WORLD_SIZE or args.minibatch_size % WORLD_SIZE:
        raise ValueError(
            f"num_envs {args.num_envs} and minibatch_size {args.minibatch_size} must be multiples "
            f"of torchrun's {WORLD_SIZE} processes"
        )
    for name in ("micro_batch", "seed", "split_seed", "hvae_seed"):
        if not 0 <= getattr(args, name) < 2**63:
            raise ValueError(f"{name} {getattr(args, name)} is not allowed; at least 0, below 2^63")
    if args.threads > 4096:  # ours: far above any machine's
        raise ValueError(f"threads {args.threads} is not allowed; at most 4096")
    for name, value in vars(args).items():
        values = value if isinstance(value, tuple) else (value,)
        if any(isinstance(v, float) and not math.isfinite(v) for v in values):
            raise ValueError(f"{name} {value} is not a finite number")
    if args.conv_gain is not None and args.conv_gain <= 0:
        raise ValueError(f"conv_gain {args.conv_gain} is not above 0 (or None)")
    if not 0 <= args.explore < 1:
        raise ValueError(f"explore {args.explore} is not at least 0 and below 1")
    if min(args.ent_coef, args.outcome_coef) < 0 or args.learning_rate <= 0:
        raise ValueError("ent_coef, outcome_coef must be at least 0 and learning_rate above 0")
    for name in ("gamma", "gae_lambda", "lr_floor", "ent_floor"):
        if not 0 <= getattr(args, name) <= 1:
            raise ValueError(f"{name} {getattr(args, name)} is not in 0..1")
    for name in ("clip_coef", "max_grad_norm", "encoder_rate", "adam_eps"):
        if getattr(args, name) <= 0:
            raise ValueError(f"{name} {getattr(args, name)} is not above 0")
    for name in ("vf_coef", "weight_decay", "aux_ent_scale", "table_noise"):
        if getattr(args, name) < 0:
            raise ValueError(f"{name} {getattr(args, name)} is not at least 0")
    if args.minibatch_size * args.num_minibatches < 2:
        raise ValueError("a rollout of one step has no spread to normalise advantages by")
    modalities = importlib.import_module(MODULES[args.env]).MODALITIES
    if args.modality is not None and args.modality not in modalities:
        allowed = ", ".join(modalities) or "none"
        raise ValueError(f"modality {args.modality!r} is not one of {args.env}'s: {allowed}")
    if args.task is not None and "task" not in TASK_OPTIONS.get(args.env, ()):
        raise ValueError(f"task {args.task!r}: {args.env} has no tasks")
    for name, usual in (("fully_observable", False), ("placement", None), ("subgoal_reward", True)):
        if getattr(args, name) != usual and name not in TASK_OPTIONS.get(args.env, ()):
            raise ValueError(f"{name} is not an option of {args.env}")
    if args.outcome_coef and (args.method, args.utility) == ("utility", "bilinear"):
        raise ValueError("outcome_coef: the bilinear utility has no hidden layer to predict with")
    for name, usual in (("shrink", 1), ("white_is_zero", False), ("norm_features", False)):
        if getattr(args, name) != usual and args.env in ("gridworld", "recsys"):
            raise ValueError(f"{name}: the states of {args.env} are no pictures")
    if args.one_hot and args.env in ("create", "stacking"):
        raise ValueError(f"one_hot: the states of {args.env} are pictures")
    if args.adapt and args.method == "continuous":
        raise ValueError("adapt: method 'continuous' is not one of utility, nearest-neighbor")
    check_actions_seen(args)
    if args.device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device {args.device!r} is not one of auto, cpu, cuda")
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device 'cuda': no CUDA device is available here")


def run_path(args: Args) -> Path:
    """runs/<env>[-task]-<method>-s<seed>, or what --run-name says."""
    name = args.run_name or f"{experiment_name(args)}-{method_name(args)}-s{args.seed}"
    return Path(args.runs_dir) / name


def open_run(args: Args, device) -> tuple[Path, dict | None]:
    """The run's folder, and the checkpoint to go on from; refuses to replace a run unasked."""
    folder = run_path(args)
    if args.resume and (folder / "checkpoint.pt").exists():
        checkpoint = load_checkpoint(folder / "checkpoint.pt", device)
        for name, theirs, ours in difference(args, checkpoint["args"]):  # a run stays what it was
            raise ValueError(f"cannot resume {folder}: {name} is {theirs!r} there, {ours!r} here")
        if "generator" not in checkpoint:
            raise ValueError(f"{folder}/checkpoint.pt is not one to go on from (no 'generator')")
        if (ranks := checkpoint["generator"].shape[0]) != WORLD_SIZE:
            raise ValueError(f"cannot resume {folder}: {ranks} processes there, {WORLD_SIZE} here")
        return folder, checkpoint
    if folder.exists() and any(folder.iterdir()) and not RANK:
        if args.overwrite and not (folder / "args.json").exists():
            raise ValueError(f"{folder} is not a run's folder: --overwrite leaves it alone")
        if not args.overwrite and not args.resume:
            raise ValueError(
                f"{folder} already holds a run; --resume goes on with it, --overwrite replaces it"
            )
    return folder, None


def plain_args(args: Args) -> dict:
    """Args as JSON-like values (tuples become lists)."""
    return json.loads(json.dumps(asdict(args)))


def difference(args: Args, saved: dict) -> list[tuple]:
    """(field, its value there, its value here) of what a run, saved as `plain_args`, has otherwise.

    How a run is carried out may change from one part of it to the next. A field that did not exist
    then has its default.
    """
    free = {"resume", "overwrite", "threads", "device", "tensorboard", "runs_dir", "run_name"}
    theirs, ours = plain_args(Args()) | saved, plain_args(args)
    return [(k, theirs[k], ours[k]) for k in ours if k not in free and theirs[k] != ours[k]]


def seeds(args: Args, *path: int) -> int:
    """An independent seed for each use (a stream of the run's seed), as a 31-bit number."""
    return int(np.random.SeedSequence([args.seed, *path]).generate_state(1)[0] >> 1)


class Run:
    """One training run: pools, table, agent, optimiser, normalisers, files."""

    def __init__(self, args: Args):
        check(args)
        self.args, self.module = args, importlib.import_module(MODULES[args.env])
        has_cuda = torch.cuda.is_available()
        self.device = torch.device(
            ("cuda" if has_cuda else "cpu") if args.device == "auto" else args.device
        )
        if WORLD_SIZE > 1 and self.device.type == "cuda":  # one GPU for each process
            wanted = int(os.environ.get("LOCAL_WORLD_SIZE", WORLD_SIZE))
            if (count := torch.cuda.device_count()) < wanted:  # on all ranks: rank 0 says it
                raise ValueError(f"torchrun has more processes than GPUs ({count}); --device cpu")
            self.device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
            torch.cuda.set_device(self.device)
        self.pools, self.pool, self.num_available = action_pools(args)
        if args.finetune is not None and not args.resume:  # `build` reads it; here: is it there?
            load_checkpoint(Path(args.finetune) / "best.pt", "cpu")
        name = "num_available" if args.eval_available is None else "eval_available"
        K, least = getattr(args, name), min(map(len, self.pools.values()))
        if not args.adapt and K > least:
            why = "the smallest pool's size; --eval-available is the number on offer at the tests"
            raise ValueError(f"{name} {K} is not in 1..{least}, {why}")
        self.batch_size = args.minibatch_size * args.num_minibatches  # T * N
        self.num_steps = self.batch_size // args.num_envs  # T
        self.num_updates = args.total_timesteps // self.batch_size
        if self.num_updates < 1:
            raise ValueError(
                f"total_timesteps {args.total_timesteps} is less than one rollout of "
                f"{self.batch_size} (minibatch_size x num_minibatches)"
            )
        self.phases = ("train",) if args.adapt else ("train", "valid", "test")
        self.num_envs = args.num_envs // WORLD_SIZE  # of this process
        # Cheap things first: a wrong option shows before hours go into an encoder, and the folder
        # is made, or an old one thrown away, when nothing can be refused any more.
        self.envs = make_envs(
            args, self.pool, self.num_envs, self.num_available, seeds(args, 1, 0, RANK)
        )
        try:
            # Rank 0 first: the others find the representation that it makes.
            for turn in (0, 1):
                problem = None
                if turn == min(RANK, 1):
                    try:
                        self.folder, checkpoint = open_run(args, self.device)
                        table = load_table(args, self.pools["train"])
                    except (ValueError, OSError) as e:
                        problem = e
                for e in filter(None, gathered(problem)):  # then all of them stop
                    raise e
            self.build(table, checkpoint)
        except BaseException:
            self.envs.close()  # else their processes complain when this one ends
            raise
        if not RANK:
            if args.overwrite and checkpoint is None and self.folder.exists():
                shutil.rmtree(self.folder)
            self.folder.mkdir(parents=True, exist_ok=True)
        gathered(None)  # the folder is there
        # Python looks for cycles of dead objects again and again, and most of what it looks through
        # are 300,000 objects of libraries that live as long as the program. Frozen, they are
        # skipped: CREATE's rollouts, whose physics makes such cycles, are 1.2 times as fast
        # (benchmarks/throughput.py image). Those of an earlier run in this process come back
        # first, so that what died of them is cleared away.
        gc.unfreeze()
        gc.collect()
        gc.freeze()

    def build(self, table, checkpoint) -> None:
        """Create (or restore) everything that learns."""
        args = self.args
        spaces = self.envs.single_observation_space, self.envs.single_action_space
        torch.set_num_threads(args.threads)
        first_states = self.envs.reset(seed=seeds(args, 1, 0, RANK))[0]["state"]
        if args.one_hot:  # the same ids on all ranks, or their networks would differ
            first_states = np.concatenate(gathered(first_states))
        self.preprocess = Preprocess(spaces[0]["state"], args, first_states)
        parts = self.preprocess.space, spaces[1], table, self.pool, args, Workers(args.threads)
        self.agent = Agent(*parts).to(self.device)
        groups = {  # what sets each apart from the others
            "encoder": {"rate": args.encoder_rate},
            "utility": {"weight_decay": args.weight_decay},
            "other": {},
        }
        for name, parameter in self.agent.named_parameters():
            part = name.replace("action_project", "utility").split(".")[0].split("_")[0]
            group = groups[part if part in groups else "other"]
            group.setdefault("params", []).append(parameter)
        self.optimizer = torch.optim.AdamW(
            [{"rate": 1.0} | group for group in groups.values() if "params" in group],
            lr=args.learning_rate,
            eps=args.adam_eps,
            weight_decay=0.0,  # AdamW without decay is Adam
            fused=True,
        )
        self.generator = torch.Generator(self.device).manual_seed(seeds(args, 2, RANK))
        self.scale = RewardScale(self.num_envs, args.gamma)
        self.update_index, self.seconds, self.best_score = 0, 0.0, -math.inf
        if args.finetune and not checkpoint:
            self.start_from(Path(args.finetune))
        if checkpoint:
            self.agent.load_state_dict(checkpoint["agent"])
            self.optimizer.load_state_dict(checkpoint["optimizer"])
            noise = checkpoint["generator"][RANK].cpu()
            if noise.shape != self.generator.get_state().shape:
                raise ValueError(
                    f"cannot resume {self.folder}: made on another kind of device than "
                    f"{self.device.type}; --device names the one it was"
                )
            self.generator.set_state(noise)
            self.preprocess.load(checkpoint["preprocess"])
            self.scale.stats.load(checkpoint["reward_stats"])
            self.update_index = checkpoint["update_index"]
            self.seconds, self.best_score = checkpoint["seconds"], checkpoint["best_score"]

    def start_from(self, folder: Path) -> None:
        """C.2: take over the policy of a finished run, with a fresh optimiser.

        The discrete policy's outputs are training actions, so that head starts anew, and with it
        the stop head (published code). The statistics of the states stand still from here on.
        The running scale of the rewards starts anew too (appendix: silent).
        Raises ValueError when the run was trained with other networks, another table, another split
        (what is new here may not have been new there) or states that enter the networks otherwise.
        """
        best = load_checkpoint(folder / "best.pt", self.device)
        same = "split split_seed fully_observable placement norm_obs one_hot shrink white_is_zero"
        for name, there, here in difference(self.args, best["args"]):
            if name in f"{same} norm_features".split():
                problem = f"{name} is {there!r} there, {here!r} here"
                raise ValueError(f"cannot fine-tune {folder}: {problem}")
        theirs, own = best["agent"], self.agent.state_dict()
        discrete = self.args.method == "nearest-neighbor"
        anew = ("train_ids", "head.", "fc_stop.") if discrete else ("train_ids",)
        for name in sorted(set(own) | set(theirs)):
            missing = name not in own or name not in theirs
            if missing or (own[name].shape != theirs[name].shape and not name.startswith(anew)):
                raise ValueError(f"cannot fine-tune {folder}: its networks differ ({name})")
            if name.startswith(anew):
                theirs[name] = own[name]
        if not torch.equal(theirs["table"], own["table"]):
            raise ValueError(f"cannot fine-tune {folder}: its representations are other ones")
        self.agent.load_state_dict(theirs)
        self.preprocess.load(best["preprocess"])

    def save(self, name: str) -> None:
        """Write checkpoint.pt or best.pt."""
        save_checkpoint(
            self.folder / name,
            self.agent,
            self.optimizer,
            self.generator,
            self.preprocess,
            self.scale,
            update_index=self.update_index,
            seconds=self.seconds,
            best_score=self.best_score,
            args=plain_args(self.args),
        )

    def score(self, phase: str, episodes: int, seed: int) -> dict:
        """Evaluate on the actions of one phase; see section 4 of the protocol for K.

        Methods trained on one fixed set are scored on that set in the "train" phase.
        """
        fixed = phase == "train" and self.num_available == len(self.pool)
        pool = self.pool if phase == "train" else self.pools[phase]
        K = len(pool) if fixed else None
        return evaluate(self.agent, self.preprocess, self.args, pool, episodes, seed, K)


def add_targets(run: Run, batch: dict, obs: dict) -> None:
    """Add what PPO learns from, all (T, N): advantages and returns, and what outcome_loss predicts.

    `obs` is what follows the rollout. Rewards are scaled, for training only.
    """
    args = run.args
    rewards, dones = batch["reward"].double().numpy(), batch["done"].numpy()  # 2 x (T, N)
    if args.norm_reward and not run.agent.encoder.is_image:
        rewards = run.scale(rewards, dones)
    values = batch["value"].cpu().double().numpy()
    with torch.no_grad():
        next_value = run.agent.encode(run.preprocess(obs["state"]).to(run.device))[1]
    next_value = next_value.cpu().double().numpy()  # (N,)
    advantages = gae(rewards, values, dones, next_value, args.gamma, args.gae_lambda)
    targets = {"advantage": advantages, "return": advantages + values}
    if hasattr(run.agent, "outcome"):
        after = np.concatenate([values[1:], next_value[None]])  # V(s'), (T, N)
        targets |= {"q": rewards + args.gamma * (1.0 - dones) * after, "over": dones}
    batch |= {k: torch.as_tensor(v, dtype=torch.float32) for k, v in targets.items()}


def train(args: Args) -> dict:
    """Algorithm 1 and the final test; returns what results.json holds."""
    run = Run(args)
    write_atomically(
        run.folder / "args.json", lambda t: t.write_text(json.dumps(plain_args(args), indent=1))
    )
    metrics = MetricsFile(run.folder / "metrics.csv", run.update_index * run.batch_size)
    writer = None
    if args.tensorboard and not RANK:
        from torch.utils.tensorboard import SummaryWriter  # 1.5 s of import, so only here

        writer = SummaryWriter(run.folder, purge_step=run.update_index * run.batch_size)
    eval_every = max(1, args.eval_every // run.batch_size)  # in updates
    lr_updates = max(1, (args.lr_decay_steps or args.total_timesteps) // run.batch_size)
    # Episodes start afresh at every checkpoint, killed or not, so a resumed run repeats exactly.
    obs, _ = run.envs.reset(seed=seeds(args, 1, run.update_index, RANK))
    bar = tqdm(
        total=run.num_updates * run.batch_size,
        initial=run.update_index * run.batch_size,
        unit="step",
        unit_scale=True,
        desc=run.folder.name,
        disable=True if RANK else None,  # None: silent when not a terminal
    )
    start = time.perf_counter() - run.seconds
    while run.update_index < run.num_updates:
        began = time.perf_counter()
        fraction = 1 - min(1.0, run.update_index / lr_updates)
        lr = args.learning_rate * (args.lr_floor + (1 - args.lr_floor) * fraction)
        for param_group in run.optimizer.param_groups:
            param_group["lr"] = lr * param_group["rate"]

        # Collect, with a random subset of the training actions in every episode.
        run.agent.blur(args.table_noise, seeds(args, 5, run.update_index))
        batch, obs, episodes = rollout(
            run.envs, obs, run.agent, run.preprocess, run.num_steps, run.generator, run.device,
            run.module.METRIC,
        )  # fmt: skip

        add_targets(run, batch, obs)

        # Learn, then let the normaliser catch up with what was seen.
        ent_coef = args.ent_coef * (args.ent_floor + (1 - args.ent_floor) * fraction)
        losses = update(run.agent, run.optimizer, batch, ent_coef, args, run.generator, run.device)
        run.agent.blur(0, None)  # tests and checkpoints know the table as it is
        # The losses are those before each step; what the last step made shows in the weights.
        finite = all(p.isfinite().all() for p in run.agent.parameters())
        if not (finite and all(map(math.isfinite, losses.values()))):
            raise ValueError(
                f"after {run.update_index * run.batch_size} steps the loss is no number any more; "
                f"learning_rate {args.learning_rate} is too high for these settings"
            )
        if run.preprocess.normalizes and not args.finetune:
            raw = batch["raw"].flatten(0, 1).numpy()  # (T*N, ...)
            run.preprocess.stats.update(np.concatenate(gathered(raw)))
        run.update_index += 1
        step = run.update_index * run.batch_size
        bar.update(run.batch_size)

        episodes = [e for part in gathered(episodes) for e in part]
        scores, returns, lengths = (
            np.array(episodes, float).T if episodes else np.full((3, 1), np.nan)
        )
        row = losses | {
            "step": step,
            "sps": run.batch_size / (time.perf_counter() - began),
            "episode_score": float(scores.mean()),
            "episode_return": float(returns.mean()),
            "episode_length": float(lengths.mean()),
            "explained_variance": explained_variance(batch["value"], batch["return"]),
            "learning_rate": lr,
        }
        at_end = run.update_index == run.num_updates
        if run.update_index % eval_every == 0 or at_end:
            for k, phase in enumerate(run.phases[:2]):
                seed = seeds(args, 3, run.update_index, k)
                row[f"{phase}_score"] = float(run.score(phase, args.valid_episodes, seed)["score"])
            # Model selection, on validation actions only [adaptation: on what it adapts to].
            selection_score = row[f"{run.phases[:2][-1]}_score"]
            line = {phase: f"{row[f'{phase}_score']:.3f}" for phase in run.phases[:2]}
            bar.set_postfix(line)
            if bar.disable and not RANK:  # in a file or a notebook: one plain line per evaluation
                print(f"step {step:,}: {', '.join(map(' '.join, line.items()))}", flush=True)
        row["seconds"] = run.seconds = time.perf_counter() - start
        metrics.write(row)
        if writer:
            for key, value in row.items():
                writer.add_scalar(key, value, step)
        if "train_score" in row:
            if selection_score > run.best_score:
                run.best_score = selection_score
                run.save("best.pt")
            run.save("checkpoint.pt")
            obs, _ = run.envs.reset(seed=seeds(args, 1, run.update_index, RANK))
            run.scale.G[:] = 0.0
    bar.close()
    run.envs.close()
    if writer:
        writer.close()
    return finish(run)


def finish(run: Run) -> dict:
    """Load the best checkpoint by validation score and test it once on the unseen actions."""
    args, folder = run.args, run.folder
    gathered(None)  # rank 0 has written best.pt
    best = load_checkpoint(folder / "best.pt", run.device)
    run.agent.load_state_dict(best["agent"])
    run.preprocess.load(best["preprocess"])
    results = {
        phase: run.score(phase, args.eval_episodes, seeds(args, 4, k))
        for k, phase in enumerate(run.phases)
    }
    if RANK:
        return results
    launcher = f"torchrun --nproc_per_node={WORLD_SIZE}" if WORLD_SIZE > 1 else "python"
    seen, unseen = CEILINGS.get(experiment_name(args), (None, None))
    K = args.eval_available or args.num_available
    if args.env == "recsys":  # its ceilings are those of 500 products on offer
        unseen = unseen if K == 500 else None
        seen = seen if K == 500 and run.num_available < len(run.pool) else None
    if args.env == "gridworld" and K < 50:  # and that of 50 skills; more only help
        seen, unseen = seen if run.num_available == len(run.pool) else None, None
    results |= {
        "metric": run.module.METRIC,
        "method": method_name(args),
        "published": published_scores(args),
        "ceiling": {"train": seen, "valid": unseen, "test": unseen},
        "steps": run.num_updates * run.batch_size,
        "best_step": best["update_index"] * run.batch_size,
        "hours": run.seconds / 3600,
        "seed": args.seed,
        "command": f"{launcher} {' '.join([Path(sys.argv[0]).name, *sys.argv[1:]])}",
    }
    write_atomically(folder / "results.json", lambda t: t.write_text(json.dumps(results, indent=1)))
    plot_curve(
        folder / "metrics.csv", folder / "curve.png", run.module.METRIC, results["published"],
        seen if args.adapt else unseen,
    )  # fmt: skip
    pool = run.pool if args.adapt else run.pools["test"]
    record_episode(run.agent, run.preprocess, args, pool, folder / "episode.gif")
    print_table(results, run.module.METRIC)
    print(f"curve, episode, metrics and checkpoints: {folder}/")
    return results


# ---- command line ----


@dataclass
class EvaluateArgs:
    """Score a finished run's best checkpoint on any of its action pools."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""
    actions: Literal["train", "valid", "test"] = "test"
    """Which actions are on offer."""
    num_available: int | None = None
    """K (default: that of the run's own tests)."""
    episodes: int = 5000
    """Episodes to play."""
    seed: int = 0
    """Seed of environments and action sampling."""
    greedy: bool = False
    """Take the most probable action, and the mean position, instead of sampling."""
    min_angle_gap: float | None = None
    """CREATE: only tools at least so many degrees from every training tool of their class."""
    min_embedding_distance: str | None = None
    """Only actions whose representation has at least this squared distance from that of every
    training action; q0.5: at least this quantile of the pool."""
    unseen_ratio: float | None = None
    """Offer a mixture: this share of the pool's actions, the rest training actions."""
    save: bool = False
    """Write the score to evaluations.csv in the run's folder as well."""


EVALUATION_KEYS = (
    "actions num_available min_angle_gap min_embedding_distance unseen_ratio greedy episodes seed"
).split()


def restrict_pool(options: EvaluateArgs, args: Args, table, pool, train_ids) -> np.ndarray:
    """The analyses of A.3: which actions of `pool` (n,) are on offer, sorted ids.

    An action of both pools (CREATE's no-op) always stays. Raises ValueError for a bad value.
    """
    module = importlib.import_module(MODULES[args.env])
    chosen = (options.min_angle_gap, options.min_embedding_distance, options.unseen_ratio)
    if all(choice is None for choice in chosen):
        return pool
    always, keep = np.isin(pool, train_ids), np.ones(len(pool), bool)
    if always.all():
        raise ValueError(
            f"min_angle_gap, min_embedding_distance and unseen_ratio choose among unseen actions; "
            f"the run was trained with all {len(pool)} of the {options.actions} actions"
        )
    if options.min_angle_gap is not None:
        if not hasattr(module, "angle_gaps"):
            raise ValueError(f"min_angle_gap: {args.env} has no angles")
        keep &= module.angle_gaps(pool, train_ids) >= options.min_angle_gap
    if options.min_embedding_distance is not None:
        squared = torch.cdist(table[pool], table[train_ids]).square()  # (n, D), (m, D) -> (n, m)
        nearest = squared.amin(1).numpy()  # (n,)
        text = options.min_embedding_distance
        try:
            least = float(text.removeprefix("q"))
            # Published: absolute distances, which depend on the scale of the encoder's table.
            least = float(np.quantile(nearest[~always], least)) if text[0] == "q" else least
        except (ValueError, IndexError):
            raise ValueError(
                f"min_embedding_distance {text!r} is neither a number nor q with a quantile in 0..1"
            ) from None
        keep &= nearest >= least
    pool, shared = pool[keep & ~always], pool[always]
    ratio = options.unseen_ratio
    if ratio is not None:
        if not 0 <= ratio <= 1:
            raise ValueError(f"unseen_ratio {ratio} is not in 0..1")
        rng = np.random.default_rng(options.seed)
        seen = np.setdiff1d(train_ids, shared)
        # Both shares come from pools of one size, so that the ratio is that of what is offered.
        size = min(len(pool), len(seen))
        count = round(ratio * size)
        unseen = rng.choice(pool, count, replace=False)
        pool = np.concatenate([unseen, rng.choice(seen, size - count, replace=False)])
    return np.sort(np.concatenate([shared, pool]))


def favourites(tally: np.ndarray, labels: np.ndarray) -> str:
    """What a policy plays, in words: tally (2, A) of `evaluate`, labels (A,).

    The classes chosen most, with their share of what was chosen and of what was on offer: a policy
    that has made up its mind chooses few of them far more often than they are on offer.
    """
    classes, index = np.unique(labels, return_inverse=True)
    chosen, offered = (np.bincount(index, row) / row.sum() for row in tally)  # each (classes,)
    top = np.argsort(-chosen, kind="stable")[:5]
    words = (f"{classes[i]} {chosen[i]:.1%} (on offer {offered[i]:.1%})" for i in top)
    action = tally[0].argmax()
    most = f"most often {action} ({labels[action]}), {tally[0, action] / tally[0].sum():.1%}"
    return f"chosen: {', '.join(words)}; {np.count_nonzero(tally[0])} different actions, {most}"


def evaluate_run(options: EvaluateArgs) -> dict:
    """`python ppo_actiongen.py evaluate RUN ...`"""
    checkpoint = load_checkpoint(Path(options.run) / "best.pt", "cpu")
    saved = {f.name: checkpoint["args"].get(f.name, f.default) for f in fields(Args)}
    saved["utility_gains"] = tuple(saved["utility_gains"])
    args = Args(**saved)
    if args.env not in MODULES:
        raise ValueError(f"{options.run}: its environment {args.env!r} is not one of {[*MODULES]}")
    if not 0 <= options.seed < 2**63:
        raise ValueError(f"seed {options.seed} is not allowed; at least 0, below 2^63")
    pools, pool, on_offer = action_pools(args)
    whole = on_offer == len(pool)  # trained, and scored, with one whole set on offer
    if options.actions != ("test" if args.adapt else "train"):
        pool, whole = pools[options.actions], False
    table, train_ids = (checkpoint["agent"][k].numpy() for k in ("table", "train_ids"))
    pool = restrict_pool(options, args, checkpoint["agent"]["table"], pool, train_ids)
    K = options.num_available
    if K is None:
        K = len(pool) if whole else args.eval_available or args.num_available
    if options.episodes < 1:
        raise ValueError(f"episodes {options.episodes} is not allowed; at least 1")
    if not 1 <= K <= len(pool):
        left = f"the {len(pool)} of the {options.actions} actions that these options leave"
        raise ValueError(f"num_available {K} is not in 1..{len(pool)}, {left}")
    envs = make_envs(args, pool, 1, K, 0)
    spaces = envs.single_observation_space, envs.single_action_space
    preprocess = Preprocess(spaces[0]["state"], args, checkpoint["preprocess"]["ids"].numpy())
    preprocess.load(checkpoint["preprocess"])
    agent = Agent(preprocess.space, spaces[1], table, train_ids, args, Workers(1))
    agent.load_state_dict(checkpoint["agent"])
    tally = np.zeros((2, len(table)), np.int64)
    settings = options.episodes, options.seed, K, options.greedy
    result = evaluate(agent, preprocess, args, pool, *settings, tally)
    print(f"{options.actions} actions, K={K}, {result['episodes']} episodes: ", end="")
    print(f"{result['score']:.4f} ± {result['stderr']:.4f} (pool of {len(pool)})")
    print(favourites(tally, importlib.import_module(MODULES[args.env]).action_labels()))
    if options.save:
        path = Path(options.run) / "evaluations.csv"
        named = asdict(options) | {"num_available": K, "pool_size": len(pool)} | result
        columns = EVALUATION_KEYS + "pool_size score stderr return length".split()
        row = {k: "" if named[k] is None else str(named[k]) for k in columns}
        old = list(csv.DictReader(path.open())) if path.exists() else []
        if any(set(columns) - set(r) for r in old):
            raise ValueError(f"{path} has other columns than {', '.join(columns)}: move it away")
        rows = [r for r in old if any(r[k] != row[k] for k in EVALUATION_KEYS)] + [row]
        text = "\n".join([",".join(columns), *(",".join(r[k] for k in columns) for r in rows)])
        write_atomically(path, lambda temporary: temporary.write_text(text + "\n"))
    return result


def default_args(env: str, recipe: str, quick: bool) -> Args:
    """Table 3's preset, then our recipe's differences, then the laptop budget."""
    if env not in PRESETS:
        raise ValueError(f"environment {env!r} is not one of {', '.join(PRESETS)}, evaluate")
    if recipe not in ("fast", "paper"):
        raise ValueError(f"recipe {recipe!r} is not one of fast, paper")
    args = replace(PRESETS[env], recipe=recipe, quick=quick)
    if recipe == "fast":
        args = replace(args, **FAST.get(env, {}))
    if quick:
        args = replace(args, **QUICK.get(env, {}))
    if quick and recipe == "fast":
        args = replace(args, **FAST_QUICK.get(env, {}))
    if quick and recipe == "paper":  # evaluates too seldom for a short run to choose a checkpoint
        args = replace(args, eval_every=min(args.eval_every, args.total_timesteps // 4))
    return args


def main() -> None:
    """Read the command line; every field of Args is a flag, and explicit flags win over presets."""
    if sys.version_info[:2] != (3, 11):
        print(f"note: made for Python 3.11, this is {sys.version.split()[0]}", file=sys.stderr)
    argv = sys.argv[1:]
    usage = (
        f"usage: ppo_actiongen.py {{{','.join(PRESETS)},evaluate}} [options]; see --help after one"
    )
    if not argv or argv[0].startswith("-"):
        raise SystemExit(usage)
    try:
        if argv[0] == "evaluate":
            if WORLD_SIZE > 1:
                raise ValueError("evaluate is one process: python ppo_actiongen.py evaluate ...")
            evaluate_run(tyro.cli(EvaluateArgs, args=argv[1:]))
            return
        # The recipe decides the defaults that --help shows, so it is looked at first.
        words = [w for a in argv for w in a.split("=")]
        recipe = words[words.index("--recipe") + 1] if "--recipe" in words[:-1] else "fast"
        default = default_args(argv[0], recipe, "--quick" in words)
        if WORLD_SIZE > 1:
            default = replace(default, threads=1)
            # The others may wait for hours while rank 0 trains an encoder.
            backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
            dist.init_process_group(backend, timeout=timedelta(days=3))
        args = tyro.cli(Args, args=argv[1:], default=default)
        if (args.recipe, args.quick) != (default.recipe, default.quick):
            raise ValueError("--recipe and --quick may be given only once")
        train(replace(args, adapt=args.adapt or args.finetune is not None))
    except (ValueError, OSError) as e:
        raise SystemExit(1 if RANK else f"error: {e}") from None
    finally:
        if dist.is_initialized():
            # Ends gloo's threads, if nothing else holds the group: a thread that still frees a
            # tensor while the interpreter ends aborts the process. `torch.distributed.nn` would
            # hold it, as a default argument, if an optimizer were what imports it, after the start.
            dist.destroy_process_group()


if __name__ == "__main__":
    main()
