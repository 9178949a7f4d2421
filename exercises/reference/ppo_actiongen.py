"""PPO with a policy over changing sets of actions: train, validate, test on unseen actions.

An ordinary policy has one output per action, so it cannot use an action it was not trained with.
This one reads a *representation* c_i of every action, a vector that hvae.py (a hierarchical VAE)
makes from recordings of what the action does. A utility function f_nu gives one number to an action
and an encoded state f_omega(s); softmax turns those of the available actions into probabilities:

    pi(a_i | s) = exp f_nu(c_i, f_omega(s)) / sum of exp f_nu(c_j, f_omega(s)) over available a_j

A new action is then just another vector. The policy must not learn the training actions by heart,
so there are three regularisers (search for "regulariser" to find their lines): *subsampling*, every
episode has its own random subset of the training actions; an *entropy bonus*; and *validation*, the
policy that is kept is the one that does best with actions held out for this choice.

Baselines: `nearest-neighbor` has an output per training action and executes the available action
nearest to the one it drew; `continuous` draws a point in the space of representations and executes
the available action nearest to it; `--representation vae` takes a plain VAE.
Ablations: `--ent-coef 0`, `--no-subsample`. Appendix C: C.1 `--task`; C.2 `--finetune`, `--adapt`;
C.3 `--no-subgoal-reward`; C.4 `--[no-]aux-conditioned`; C.5 `--fully-observable`; C.6
`--placement`, `--split full`; C.7 curve.png of every run. A.3's analyses (how does the score fall
as unseen actions get less like the known ones?): `create --split analysis --representation
hvae-all`, then `evaluate RUN --min-angle-gap 5` and its other options.

    python ppo_actiongen.py gridworld --quick         # minutes; or: recsys, create, stacking
    python ppo_actiongen.py gridworld --recipe paper  # the policy of Tables 3 and 4 (the encoder,
                                                      # too: --hvae-recipe paper)
    python ppo_actiongen.py gridworld --method nearest-neighbor
    python ppo_actiongen.py gridworld --finetune runs/gridworld-s0     # C.2
    python ppo_actiongen.py my_env.py                 # an environment of your own: see README.md
    python ppo_actiongen.py evaluate runs/gridworld-s0 --num-available 20  # see evaluate --help

In the order of this file: hyper-parameters (the policy's rows of Tables 3 and 4, except the length
of episodes and the observation, which the environments fix); torchrun; random numbers; networks
(D.3.2, C.4); the main paper's Algorithm 1, training, and Algorithm 2, acting with unseen actions;
then what surrounds them: which actions are available, checks, the run's folder, the command
`evaluate` (A.3), the command line.

An environment is a module (the smallest: exercises/dial.py). It shows a dictionary: the "state",
and "available", the ids of the K actions to choose from. A step is one action of one environment. A
*score* is one number per episode (success, click-through rate, height), in the info of its last
step under the key `module.METRIC`. "The encoder" is hvae.py's; `agent.encoder`, the *state
encoder*, is f_omega, and its output the *encoding* of s.

Letters in shapes: T actions of each of N environments in a rollout, B rows of a batch, K available,
n training, A all actions, D numbers in a representation, H hidden units.
Two marks: [code] is the authors' released program, mostly followed where the appendix is silent
(where the two disagree, a comment says which one is followed); [here] is a choice of this
repository, with its reason.
"""

import atexit
import csv
import json
import math
import os
import re
import shlex
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
import torch.nn as nn
import torch.nn.functional as F
import tyro
from filelock import FileLock, Timeout
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch.distributions import Beta, Categorical, Distribution, Normal
from tqdm import tqdm

import hvae
from hvae import UserError

Distribution.set_default_validate_args(False)  # the checks cost as much as the draws


# ---- Tables 3 and 4: the hyper-parameters ----


# An option of your own touches at most four places: a line in Args; the layer, if it needs one, in
# Agent.__init__; its use, mostly in Agent.act or ppo_loss; and, to watch it, a number in the
# dictionary that ppo_loss returns, which becomes a column of metrics.csv. (An option of an
# environment: a line in Args, and its name in OPTIONS, far below.) Switched off, it must not make a
# layer: a new layer draws random numbers, and every run would change.
@dataclass
class Args:
    """Train on training actions, select on validation actions, test on unseen ones."""

    # --- experiment ---
    env: tyro.conf.Positional[str] = "gridworld"  # or recsys, create, stacking, FILE.py
    recipe: Literal["fast", "paper"] = "fast"  # of the policy; fast: with FAST, below
    quick: bool = False  # the same protocol in minutes, with fewer steps
    method: Literal["utility", "nearest-neighbor", "continuous"] = "utility"  # or a baseline
    seed: int = 0  # one seed is one run, bit for bit, on one kind of CPU
    adapt: bool = False  # train on the test actions, a fixed set of them (C.2)
    finetune: str | None = None  # --adapt, from that run's policy and representations (C.2)

    # --- environment ---
    split: str = "default"  # how actions are divided into training, validation and test
    split_seed: int = 0  # seed of that division [code: one division for all seeds]
    task: str | None = None  # CREATE: one of its twelve tasks (C.1)
    subgoal_reward: bool = True  # CREATE: reward for the subgoal (off: C.3)
    placement: str | None = None  # Stacking: what it chooses of a place: "none", "1d" or "2d" (C.6)
    fully_observable: bool = False  # Recommender: representations hold the constant mu_i, too (C.5)

    # --- action representations ---
    # hvae-all: an encoder that was trained on all actions (the oracle); vae: appendix B's baseline.
    representation: str = "hvae"  # hvae, hvae-all, vae, engineered[-5d], or a table FILE.npz
    modality: str | None = None  # what the encoder sees: xy, video, ...; None: hvae.py's default
    hvae_recipe: Literal["quick", "fast", "paper"] = "fast"  # how long the encoder is trained

    # --- which actions are available ---
    num_available: int = 50  # K while training (Table 3 "actions per episode")
    eval_available: int | None = None  # K in evaluations; None: num_available
    subsample: bool = True  # a random subset per episode; off: a fixed set, always
    fixed_set_size: int | None = None  # size of the set with --no-subsample, --adapt; None: all

    # --- PPO (Table 4 unless it says otherwise) ---
    # Table 3's "PPO batch size" is the size of a minibatch [code]. So CleanRL's num_steps is
    # minibatch_size * num_minibatches / num_envs here.
    total_timesteps: int = 40_000_000  # steps of the whole training (Table 3)
    num_envs: int = 32  # environments side by side ("parallel processes")
    minibatch_size: int = 4096  # steps in a minibatch (Table 3, "PPO batch size")
    num_minibatches: int = 4  # minibatches in a rollout [code]
    update_epochs: int = 4  # passes over one rollout
    head_epochs: int = 0  # further passes, in which the state encoder is frozen [here]
    learning_rate: float = 1e-3  # of Adam, at the start
    lr_decay_steps: int | None = None  # steps in which the rate and ent_coef fall; None: all
    gamma: float = 0.99  # discount factor of later rewards
    clip_coef: float = 0.1  # clipping range of PPO's probability ratio
    vf_coef: float = 0.5  # weight of the value loss
    clip_vloss: bool = True  # clip the value's changes as well [code]
    ent_coef: float = 0.05  # weight of the entropy bonus (Table 3); 0: w/o entropy
    ent_floor: float = 1.0  # ent_coef falls linearly to this fraction; 1: it stays [here]

    # --- networks ---
    hidden_size: int = 64  # units in every hidden layer (Table 4)
    published_init: bool = True  # first weights of [code]; off: others, see class Agent
    aux_conditioned: bool = False  # the position depends on the chosen action (C.4)
    bilinear: bool = False  # utility c . (M f_omega(s) + m) in place of an MLP [here]
    one_hot: bool = False  # Grid World: the policy sees cells as one-hot vectors [here]
    small_pictures: bool = False  # CREATE: half size, inverted; another CNN: see cnn [here]

    # --- evaluation ---
    eval_every: int = 409_600  # steps between two evaluations
    valid_episodes: int = 640  # episodes of one evaluation while training
    eval_episodes: int = 5000  # episodes of the final test [code]

    # --- run ---
    runs_dir: str = "runs"  # folder of runs and representations
    run_name: str | None = None  # name of the run's folder; None: see run_name_of
    resume: bool = False  # go on from the last checkpoint; same device, same processes: same bits
    device: Literal["auto", "cpu", "cuda"] = "auto"  # auto: a GPU if there is one

    @property
    def module(self):
        """The environment's file, imported."""
        return hvae.load_environment(self.env)


TABLE_3 = {
    "env": ("gridworld", "recsys", "create", "stacking"),
    "ent_coef": (0.05, 0.01, 0.005, 0.01),
    "num_available": (50, 500, 50, 20),
    "total_timesteps": (40_000_000, 40_000_000, 60_000_000, 3_000_000),
    "minibatch_size": (4096, 2048, 3072, 1024),
    # What else differs between the environments (A.2, B, C.6, [code]).
    "representation": ("hvae", "engineered", "hvae", "hvae"),  # A.2: recsys provides them
    "task": (None, None, "push", None),
    "placement": (None, None, None, "1d"),
    # D.2: the rate falls linearly over the training. In CREATE and Stacking over 100M steps [code],
    # more than they train: with LR_FLOOR (below) it ends at .46 and .97 of its start. We follow
    # [code], since the published scores were made with it.
    "lr_decay_steps": (None, None, 100_000_000, 100_000_000),
    "fixed_set_size": (None, 2000, None, None),  # [code]: all 5,000 products cost too much
    "eval_every": (409_600, 163_840, 614_400, 102_400),  # [code]: 25, 20, 50, 25 rollouts
    # As in [code]; but for Stacking 200, not 40, which cannot tell checkpoints apart [here].
    "valid_episodes": (640, 160, 640, 200),
}
# [code] has other numbers for single methods or tests, which we do not use, so that all methods are
# compared alike [here]: the continuous baseline's T = 256; without subsampling in CREATE six
# minibatches; in the Recommender 50 available in validation, with `fully_observable` 25 in tests
# and 80M steps; for C.2 10M steps in Grid World, 5M to 20M in CREATE.

AUX_ENT_SCALE = 0.1  # Table 3 "continuous entropy scaling"
GAE_LAMBDA = 0.95  # [code]
MAX_GRAD_NORM = 0.5  # [code]
LR_FLOOR = 0.1  # [code]: the learning rate falls to this fraction

# The fast recipe: every difference from the recipe `paper`, with its reason; all are [here]. It is
# for a laptop: a quarter of the published steps or fewer, and more updates for each of them.
FAST = {
    "gridworld": dict(
        one_hot=True,  # a cell's kind is a name, not a quantity
        minibatch_size=512,  # eight times as many updates per step: T = 64
        num_available=20,  # favourites are often absent, so the others are tried
        eval_available=50,  # tests keep the number of Table 3
        ent_floor=0.1,  # late in training a random skill mostly ends in the lava
        hidden_size=128,  # 64 units fit fewer skills
        published_init=False,  # with small weights learning starts late: see Agent.__init__
        total_timesteps=10_000_000,
    ),
    "recsys": dict(
        bilinear=True,  # an MLP learns single products by heart
        hidden_size=256,  # 64 units fit the user's taste less well
        gamma=0.0,  # a click changes little of what comes after it
        minibatch_size=512,  # more updates per step: T = 64
        num_available=100,  # a fifth of the cost of the utilities
        eval_available=500,  # tests keep the number of Table 3
        total_timesteps=10_000_000,
    ),
    "create": dict(
        small_pictures=True,  # cheaper; empty places are 0, so that tools are what stands out
        aux_conditioned=True,  # a ramp and a cannon belong in different places
        published_init=False,  # as in Grid World
        lr_decay_steps=None,  # as D.2 says: the rate falls over the run, whatever its length
        hidden_size=256,  # which tool, and where: more to represent
        minibatch_size=128,  # the cost is per picture: many small minibatches cost no more
        num_minibatches=16,  # so a rollout is T = 64 actions of each environment
        update_epochs=1,  # four passes over the same pictures move the policy too far
        head_epochs=3,  # so the layers after f_omega get three passes of their own
        learning_rate=5e-4,  # smaller minibatches are noisier
        ent_coef=0.02,  # with 0.005, as in Table 3, some seeds learn little at this learning rate
        clip_coef=0.2,  # goals are rare, so each of them may teach more
        vf_coef=0.02,  # a goal is worth 10: at 0.5 the convolutions would serve the critic alone
        clip_vloss=False,  # a rollout could move values by clip_coef only: too little near 10
        total_timesteps=4_000_000,
        eval_every=102_400,  # 40 evaluations
    ),
    "stacking": dict(
        published_init=False,  # as in Grid World; and towers start at "go on": see fc_stop
        lr_decay_steps=None,  # as in CREATE
        minibatch_size=32,  # physics is the cost: rollouts of T = 4, many updates for few steps
        clip_vloss=False,  # as in CREATE: heights, too, are large against clip_coef
        total_timesteps=400_000,
        eval_every=20_480,  # 20 evaluations
    ),
}
# --quick: this many steps, at least four evaluations, 500 test episodes, the encoder's quick
# recipe.
QUICK = {"gridworld": 1_500_000, "recsys": 1_000_000, "create": 700_000, "stacking": 60_000}


def default_args(env="gridworld", recipe="fast", quick=False):
    """Table 3, then the fast recipe, then --quick; UserError for an unknown environment.

    An environment of your own may hold DEFAULTS, a dictionary of fields of Args.
    """
    module = hvae.load_environment(env)
    if env in TABLE_3["env"]:  # its column, put over the defaults of Args
        column = TABLE_3["env"].index(env)
        args = Args(**{name: row[column] for name, row in TABLE_3.items()})
    else:
        # The absolute path, so that `evaluate` and --resume find the file from everywhere.
        args = Args(env=str(Path(env).resolve()), **getattr(module, "DEFAULTS", {}))
    # Later lines replace what earlier ones have set; the command line comes last (parse_args).
    args = replace(args, recipe=recipe, quick=quick)
    if recipe == "fast":
        args = replace(args, **FAST.get(env, {}))
    if quick:
        args.total_timesteps = QUICK.get(env, args.total_timesteps // 10)
        args.eval_every = min(args.eval_every, args.total_timesteps // 4)
        args.eval_episodes = 500
        args.hvae_recipe = "quick"
    return args


# ---- torchrun: several processes that train one policy ----

# Started by `torchrun --nproc_per_node=2 ppo_actiongen.py ...`, each process (its number is RANK)
# plays its share of the environments and learns from its share of every minibatch. Gradients are
# averaged, so all processes keep the same weights. Rank 0 alone evaluates and writes the run.
RANK = int(os.environ.get("RANK", 0))
WORLD_SIZE = int(os.environ.get("WORLD_SIZE", 1))


def join_processes():
    """Connect this process to the others, if there are any, until it ends."""
    if WORLD_SIZE > 1:
        # torch.optim imports this module as well. If that is the first import, after the processes
        # have been connected, Python can crash when it ends. So it is imported here, before.
        import torch.distributed.nn.functional as _  # noqa: F401

        dist.init_process_group("gloo")
        atexit.register(dist.destroy_process_group)


def sum_over_all(x):
    """Replace `x` by the sum over all processes."""
    if WORLD_SIZE > 1:
        dist.all_reduce(x)


# ---- random numbers ----

# What random numbers are for. Each use has a stream of its own, so that, for example, a longer
# evaluation does not change the training. (The first weights come from the run's seed itself.)
TRAINING = 1  # training environments
TORCH = 2  # PyTorch's draws while training
VALIDATION = 3  # evaluations while training
TEST = 4  # the final test
COMMAND = 5  # the command `evaluate`


def seeds(n, *stream):
    """`n` seeds. `stream` are integers: the run's seed, the use, perhaps step and rank."""
    return np.random.SeedSequence(stream).generate_state(n).tolist()


# ---- D.3.2: the networks ----


def layer_init(layer, gain=2**0.5):
    """Orthogonal weights of this gain, bias 0 [code]."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def mlp(inputs, H):
    """f_omega of vectors, (B, inputs) -> (B, H). D.3.2: "2-layer MLP with tanh activation"."""
    first = layer_init(nn.Linear(inputs, H))
    second = layer_init(nn.Linear(H, H))
    return nn.Sequential(first, nn.Tanh(), second, nn.Tanh())


def cnn(frames, H, small):
    """f_omega: pictures (B, frames, 84, 84) -> (B, H). D.3.2: "5-layer convolutional network".

    small: pictures (B, frames, 42, 42), three layers, LayerNorm [here].
    """
    # A stride of 2 halves the picture [code]: 84 -> 42 -> 21 -> 11 -> 6 -> 3 pixels a side.
    channels = [frames, 16, 16, 32, 32, 32]
    features = 32 * 3 * 3
    if small:
        # [here] 42 -> 21 -> 11 -> 6. At 6 x 6 the features still show where the balls are.
        channels = [frames, 16, 32, 64]
        features = 64 * 6 * 6
    layers = []
    for before, after in pairwise(channels):
        conv = nn.Conv2d(before, after, 3, stride=2, padding=1)
        # [code] keeps PyTorch's initial weights. They shrink the signal from layer to layer, until
        # all pictures have nearly the same features, and CREATE learns late. So with
        # --small-pictures, and only there, they are larger [here].
        if small:
            layer_init(conv)
        layers += [conv, nn.ReLU()]
    layers.append(nn.Flatten())  # (B, channels, side, side) -> (B, features)
    if small:  # more tools make all features larger, whatever they show: LayerNorm undoes this
        layers.append(nn.LayerNorm(features, elementwise_affine=False))
    return nn.Sequential(*layers, layer_init(nn.Linear(features, H)), nn.ReLU())


def small_inverted(frames):
    """CREATE's pictures (B, frames, 84, 84) -> (B, frames, 42, 42) uint8, tools bright on 0."""
    # The white background becomes 0. At the start of an episode, the stack of frames is padded with
    # black ones; inverted they would be all 255, so they are set to 0.
    is_real = frames.amax((2, 3), keepdim=True) > 0  # (B, frames, 1, 1)
    halved = F.avg_pool2d(frames.float(), 2)  # (B, frames, 42, 42)
    return ((255 - halved) * is_real).byte()


class RunningMeanStd(nn.Module):
    """Mean and standard deviation of all numbers seen so far, one each per element of `shape`."""

    def __init__(self, shape=()):
        super().__init__()
        # Count, sum and sum of squares: from these three the statistics of all numbers follow, and
        # they can be added up over batches and processes. They start as if 1e-4 numbers had been
        # seen, of mean 0 and variance 1 [code].
        prior = [torch.full(shape, x, dtype=torch.float64) for x in (1e-4, 0.0, 1e-4)]
        self.register_buffer("sums", torch.stack(prior))  # (3, *shape)

    def update(self, x):
        """Add a batch (B, *shape), and those of the other processes."""
        x = x.double()
        new = torch.stack([torch.ones_like(x), x, x.square()]).sum(1)  # (3, B, ...) -> (3, ...)
        sum_over_all(new)
        self.sums += new

    def mean_std(self):
        count, total, squares = self.sums
        mean = total / count
        variance = squares / count - mean.square() + 1e-8
        return mean.float(), variance.sqrt().float()


class Agent(nn.Module):
    """The policy and the critic of D.3.2, or the policy of a baseline.

    table (A, D): row i represents the action with id i; never trained here. train_ids (n,): the
    sorted ids of the actions that can be available while training.
    """

    def __init__(self, envs, table, train_ids, args):
        super().__init__()
        self.args = args
        H = args.hidden_size
        D = table.shape[1]
        self.register_buffer("table", torch.tensor(table, dtype=torch.float32))  # (A, D)
        # Not saved: they follow from the options. (A run with --finetune, C.2, has other
        # ids than the run that it starts from.)
        self.register_buffer("train_ids", torch.tensor(train_ids), persistent=False)  # (n,)

        # f_omega and the critic V. With pictures V is one linear layer on f_omega(s); else it is an
        # MLP of its own (D.3.2) that reads s itself [code]. The critic does not see which actions
        # are available: V is the value of a state for an average set of them; a good or a bad set
        # is noise to it.
        state = envs.single_observation_space["state"]
        self.is_image = len(state.shape) == 3
        if self.is_image:
            self.encoder = cnn(state.shape[0], H, args.small_pictures)
            self.critic = layer_init(nn.Linear(H, 1))
        else:
            self.obs_stats = RunningMeanStd(state.shape)
            width = math.prod(state.shape)
            if args.one_hot:
                # Which kinds are there? One reset tells: every grid of Grid World has all.
                first_states = envs.reset()[0]["state"]
                self.register_buffer("cell_ids", torch.as_tensor(first_states).unique())
                width *= len(self.cell_ids)
            self.encoder = mlp(width, H)
            self.critic = nn.Sequential(mlp(width, H), layer_init(nn.Linear(H, 1)))

        # CREATE and Shape Stacking have Dict actions: "choice", "position" and, in Stacking,
        # "stop". Elsewhere an action is the choice alone, and action_parts is empty.
        self.action_parts = getattr(envs.single_action_space, "spaces", {})

        # What chooses among the available actions. [code] starts all three layers of the utility
        # with a gain of 0.01. Gradients shrink on their way through them to about 1e-6, less than
        # Adam's eps (1e-5), so its steps are small and learning starts late. Without
        # `published_init` only the last layer is small [here].
        project_gain, hidden_gain = (0.01, 0.01) if args.published_init else (1.0, 2**0.5)
        has_mlp = args.method == "utility" and not args.bilinear
        is_conditioned = args.aux_conditioned and "position" in self.action_parts
        if has_mlp or is_conditioned:  # in C.4, utility and position share this layer [code]
            self.action_project = layer_init(nn.Linear(D, H), project_gain)
        if has_mlp:
            self.utility_hidden = layer_init(nn.Linear(2 * H, H), hidden_gain)
            self.utility_out = layer_init(nn.Linear(H, 1), 0.01)
        elif args.method == "utility":  # bilinear
            self.utility_query = layer_init(nn.Linear(H, D), 0.01)
        elif args.method == "nearest-neighbor":  # a logit for each training action
            self.head = layer_init(nn.Linear(H, len(train_ids)), 0.01)
        else:  # a Gaussian over representations [code]
            self.head_mean = layer_init(nn.Linear(H, D), 1.0)
            self.head_var = layer_init(nn.Linear(H, D), 1.0)

        # The auxiliary policy f_chi: where to place the action, whether to stop (D.3.2, A.4).
        if "position" in self.action_parts:
            self.fc_alpha = self.position_head()
            self.fc_beta = self.position_head()
        if "stop" in self.action_parts:
            self.fc_stop = layer_init(nn.Linear(H, 2), 0.01)
            # Outputs: 0 go on, 1 stop. Untrained, they are equally likely, and a tower has one
            # shape on average. The fast recipe starts with going on [here].
            if not args.published_init:
                nn.init.constant_(self.fc_stop.bias[0], 4.0)

    def position_head(self):
        """The layers that compute alpha, or beta, of the Beta distribution over positions."""
        H = self.args.hidden_size
        dims = self.action_parts["position"].shape[0]
        if not self.args.aux_conditioned:  # D.3.2: linear, from the state's encoding; gain 1 [code]
            return layer_init(nn.Linear(H, dims), 1.0)
        # C.4: two layers, from the state's encoding and the projected action (B, 2H). If all three
        # layers, action_project, `hidden` and `last`, had a gain of 1, an untrained policy would
        # have a favourite place for each tool. So one of them gets 0.01: with published_init it is
        # action_project [code], without it `last` [here].
        hidden = layer_init(nn.Linear(2 * H, H), 1.0)
        last = layer_init(nn.Linear(H, dims), 1.0 if self.args.published_init else 0.01)
        return nn.Sequential(hidden, nn.ReLU(), last)

    def to_tensors(self, obs):
        """An observation as tensors: states (N, ...) and ids of the available actions (N, K)."""
        state = torch.as_tensor(obs["state"])
        if self.is_image and self.args.small_pictures:
            state = small_inverted(state)
        available = torch.as_tensor(obs["available"])
        return state.to(self.table.device), available.to(self.table.device)

    def encode(self, state):
        """States (B, ...) -> their encodings f_omega(s) (B, H) and values V(s) (B,)."""
        if self.is_image:  # grey levels 0..255 -> 0..1
            encoding = self.encoder(state.float() / 255)
            return encoding, self.critic(encoding).squeeze(1)
        # With one_hot each number, a cell's kind (A.1), becomes a one-hot vector. Without it, every
        # number is brought to mean 0 and standard deviation 1 [code].
        if self.args.one_hot:
            number = torch.searchsorted(self.cell_ids, state)  # ids -> 0, 1, 2, ...
            x = F.one_hot(number, len(self.cell_ids)).flatten(1).float()  # (B, cells * ids)
        else:
            mean, std = self.obs_stats.mean_std()
            x = ((state - mean) / std).clamp(-10, 10).flatten(1)  # [code]; (B, numbers)
        return self.encoder(x), self.critic(x).squeeze(1)

    def utility(self, encoding, available):
        """f_nu (D.3.2): encodings (B, H) and ids of available actions (B, K) -> logits (B, K)."""
        if self.args.bilinear:  # [here] c . (M encoding + m); utility_query has M and m
            query = self.utility_query(encoding)  # (B, D)
            return torch.einsum("bd,bkd->bk", query, self.table[available])

        # How good is it to take the action with representation c in a state with encoding e? D.3.2:
        #
        #     hidden = ReLU(W [e; project(c)] + b),    logit = out(hidden).
        #
        # [e; project(c)] is the concatenation. Half of W's columns, W_e, meet e, the other half,
        # W_c, meet project(c) = P c + p. So what is inside of the ReLU is a sum,
        #
        #     W [e; P c + p] + b  =  (W_e e + b)  +  (W_c P c + W_c p),
        #
        # of a part that is the same for all actions and a part that is the same for all states.
        # Each is computed once; only their sum is formed for every pair. The logits are the same,
        # at a fraction of the cost. (exercises/README.md, 2: write the concatenation.)
        W_e, W_c = self.utility_hidden.weight.chunk(2, dim=1)  # (H, H) each
        project = self.action_project
        state_part = F.linear(encoding, W_e, self.utility_hidden.bias)  # (B, H)
        # For the actions, two linear maps follow each other, P and then W_c. They are one map. Most
        # actions are available in many rows of the batch, so the U different ones are mapped once.
        weight = W_c @ project.weight  # (H, H) @ (H, D) -> (H, D)
        bias = W_c @ project.bias  # (H,)
        ids, row_of = available.unique(return_inverse=True)  # (U,), (B, K): where in ids
        action_part = F.linear(self.table[ids], weight, bias)  # (U, H)

        # The rest of the MLP: ReLU and one linear output. The hidden layers of all pairs do not fit
        # into the processor's cache, so S = `piece` states at a time: 800,000 numbers, 3 MB [here].
        # (index_select(0, rows) is a faster action_part[rows].)
        piece = max(1, 800_000 // (available.shape[1] * encoding.shape[1]))
        logits = []
        for e_part, rows in zip(state_part.split(piece), row_of.split(piece), strict=True):
            c_part = action_part.index_select(0, rows.flatten())  # (S * K, H)
            hidden = e_part[:, None] + c_part.unflatten(0, rows.shape)  # (S, 1, H) + (S, K, H)
            logits.append(F.relu(hidden) @ self.utility_out.weight[0])  # (S, K)
        return torch.cat(logits) + self.utility_out.bias

    def choice_policy(self, encoding, available):
        """The distribution to draw from, by method: over K actions, over n, or a Gaussian."""
        if self.args.method == "nearest-neighbor":  # one of the n training actions
            return Categorical(logits=self.head(encoding))  # (B, n)
        if self.args.method == "continuous":  # a point in the space of representations [code]
            std = F.softplus(self.head_var(encoding)).sqrt()
            return Normal(self.head_mean(encoding), std)  # (B, D)
        return Categorical(logits=self.utility(encoding, available))  # (B, K)

    def index_of(self, drawn, available):
        """Which of the available actions is meant by what was drawn, (B,) in 0..K-1."""
        if self.args.method == "utility":
            return drawn
        # A baseline takes the available action nearest to the training action, or to the point,
        # that was drawn. PPO sees the draw and its probability; the look-up counts as a part of the
        # environment (but C.4's position reads its result). While nearest-neighbor is trained, all
        # training actions are available, so it gets what it drew.
        if self.args.method == "nearest-neighbor":
            drawn = self.table[self.train_ids[drawn]]  # (B,) -> (B, D)
        difference = self.table[available] - drawn[:, None]  # (B, K, D) - (B, 1, D)
        return difference.square().sum(2).argmin(1)

    def act(self, state, available, action=None):
        """Draw an action, or take one that was drawn: CleanRL's `get_action_and_value`.

        Returns action, and log-probability, entropy, value, (B,) each. An action is a dictionary of
        "drawn" (what came out of the distribution), "choice" (which of the K available actions that
        means), "action_id" (its id), and "position" and "stop" where the environment has them.
        """
        # The policy is a product of up to three distributions: which action, where, and whether to
        # stop. So their log-probabilities add up. Their entropies are added up for the bonus, that
        # of the position with a weight of its own (Table 3). In C.4 every action has its own
        # distribution of positions; the bonus counts that of the chosen action alone [code].
        is_new = action is None
        if is_new:
            action = {}
        encoding, value = self.encode(state)

        # Which action.
        policy = self.choice_policy(encoding, available)
        if is_new:
            action["drawn"] = policy.sample()
            action["choice"] = self.index_of(action["drawn"], available)
            action["action_id"] = available.gather(1, action["choice"][:, None]).squeeze(1)
        logprob = policy.log_prob(action["drawn"])
        entropy = policy.entropy()
        if self.args.method == "continuous":
            # D numbers were drawn. [code] adds up their entropies in Grid World and averages them
            # elsewhere; [here] the mean, so that ent_coef means the same for every D.
            # With a tiny standard deviation a sum of log-probabilities can be -inf, and in ppo_loss
            # the difference of two of them NaN; hence the limits [code].
            logprob = logprob.sum(1).clamp(-1e5, 1e5)
            entropy = entropy.mean(1)

        # Where to place it: a Beta distribution for each dimension (D.3.2). With parameters above 1
        # it has a single peak.
        if "position" in self.action_parts:
            x = encoding
            if self.args.aux_conditioned:  # C.4
                chosen = self.action_project(self.table[action["action_id"]])  # (B, H)
                x = torch.cat([encoding, chosen], dim=1)  # (B, 2H)
            place = Beta(1 + F.softplus(self.fc_alpha(x)), 1 + F.softplus(self.fc_beta(x)))
            if is_new:
                action["position"] = 2 * place.sample() - 1  # (B, dims), from [0, 1] to [-1, 1]
            # float32 may round to the border, where the log-density is minus infinity. (It is the
            # density on [0, 1]; on [-1, 1] it is half per dimension, but PPO's ratio is the same.)
            unit = (0.5 + action["position"] / 2).clamp(1e-6, 1 - 1e-6)
            logprob = logprob + place.log_prob(unit).sum(1)
            entropy = entropy + AUX_ENT_SCALE * place.entropy().sum(1)

        # Whether to stop here (A.4: "a binary episode termination action").
        if "stop" in self.action_parts:
            stop = Categorical(logits=self.fc_stop(encoding))
            if is_new:
                action["stop"] = stop.sample()
            logprob = logprob + stop.log_prob(action["stop"])
            entropy = entropy + stop.entropy()
        return action, logprob, entropy, value


# ---- Algorithm 1: training ----

# 1. Train the encoder on training actions, then compute c_i for all actions (hvae.py).
# 2. Repeat: at every reset draw K training actions; play; update by PPO with an entropy bonus;
#    every eval_every steps, at a *checkpoint*, score on validation actions; keep the best policy.
# Algorithm 2 is evaluate(): the kept policy acts with K unseen actions, whose c_i step 1 has
# computed. Nothing is learned there.


@torch.no_grad()
def play_step(envs, obs, agent):
    """Act once in N environments: the transition, the next obs, infos.

    Where an episode ends, the next obs is already the first one of a new episode.
    """
    state, available = agent.to_tensors(obs)
    action, logprob, _, value = agent.act(state, available)
    # The environment wants the number of an available action, 0..K-1, and the other parts.
    executed = action["choice"].cpu().numpy()  # (N,)
    if agent.action_parts:
        executed = {name: action[name].cpu().numpy() for name in agent.action_parts}
    obs, reward, terminated, truncated, infos = envs.step(executed)

    # What was available is kept with the transition: the update needs the probability of the action
    # among just these. Running out of time is an end like any other [code], since the limits are
    # short and part of the task.
    transition = dict(state=state, available=available, logprob=logprob, value=value, **action)
    # (x.to(value): with the dtype and on the device of `value`.)
    transition["reward"] = torch.as_tensor(reward).to(value)
    transition["done"] = torch.as_tensor(terminated | truncated).to(value)  # 1.0 or 0.0
    return transition, obs, infos


def rollout(envs, obs, agent, num_steps):
    """Play T actions in each environment: a batch of (T, N, ...), the next obs, ended episodes."""
    # Episodes do not end with the rollout: the next one goes on where this one stops (but after a
    # checkpoint all start anew: see train).
    transitions = []
    episodes = []
    for _ in range(num_steps):
        transition, obs, infos = play_step(envs, obs, agent)
        transitions.append(transition)
        episodes += ended_episodes(infos, agent.args)
    batch = {name: torch.stack([t[name] for t in transitions]) for name in transitions[0]}
    return batch, obs, episodes


def gae(rewards, values, dones, next_value, gamma, lam=GAE_LAMBDA):
    """Generalised advantage estimation: how much better each step turned out than expected.

    All are (T, N), next_value is (N,). With the surprise delta_t of one step,

        delta_t = r_t + gamma (1 - done_t) V_{t+1} - V_t
        A_t     = delta_t + gamma lam (1 - done_t) A_{t+1}

    done_t says that *this* step ended the episode (CleanRL's is shifted by one step).
    """
    # Backwards, since each advantage contains the next one. After the last step of the rollout the
    # critic says what is still to come.
    advantages = torch.empty_like(rewards)
    next_advantage = 0.0
    for t in reversed(range(len(rewards))):
        alive = 1.0 - dones[t]
        delta = rewards[t] + gamma * alive * next_value - values[t]
        next_advantage = delta + gamma * lam * alive * next_advantage
        advantages[t] = next_advantage
        next_value = values[t]
    return advantages


def running_returns(rewards, dones, G, gamma):
    """Discounted sums of the rewards up to now. `train` divides rewards by the sums' spread.

    G <- gamma G + r at every step, 0 after an episode. Returns all G (T, N), and the last (N,).
    """
    # Why not the true returns, which look ahead? An episode's end may be still to come. All that is
    # needed is a rough size of the returns, and sums up to now have it [code]. (Gymnasium's
    # NormalizeReward uses them, too.)
    returns = torch.empty_like(rewards)
    for t in range(len(rewards)):
        G = gamma * G + rewards[t]
        returns[t] = G
        G = G * (1.0 - dones[t])
    return returns, G


def ppo_loss(agent, mb, ent_coef):
    """PPO's clipped loss of one minibatch, and the numbers of it that go into metrics.csv."""
    # How much likelier is each action now than when it was played? The minibatch itself can be
    # handed over as the action, since play_step has put the action's entries into it.
    args = agent.args
    _, logprob, entropy, value = agent.act(mb["state"], mb["available"], action=mb)
    logratio = logprob - mb["logprob"]
    ratio = logratio.exp()

    # Actions that turned out better than expected become likelier. But nothing is gained by a ratio
    # outside of the clipping range: the rollout says little about a policy that is far away.
    clipped_ratio = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    pg_loss = -torch.min(ratio * mb["advantage"], clipped_ratio * mb["advantage"]).mean()

    # The critic learns the return, which is its own estimate plus the advantage. [code] also
    # limits the value's change since the rollout, by clip_coef, whatever the scale of the values.
    error = (value - mb["return"]).square()
    if args.clip_vloss:
        change = (value - mb["value"]).clamp(-args.clip_coef, args.clip_coef)
        error = torch.max(error, (mb["value"] + change - mb["return"]).square())
    v_loss = 0.5 * error.mean()

    # The regulariser *entropy bonus*: more than one available action stays likely, so f_nu learns
    # what many c_i mean, not only those of a few favourites.
    entropy = entropy.mean()
    loss = pg_loss + args.vf_coef * v_loss - ent_coef * entropy

    numbers = dict(pg_loss=pg_loss, v_loss=v_loss, entropy=entropy)
    numbers["clip_fraction"] = (ratio != clipped_ratio).float().mean()
    numbers["approx_kl"] = (ratio - 1 - logratio).mean()  # how far the policy has moved
    return loss, numbers


def update(agent, optimizer, batch, ent_coef):
    """PPO's passes over one rollout; returns the numbers of the last minibatch."""
    # From here on it does not matter which step and which environment a row came from.
    flat = {name: x.flatten(0, 1) for name, x in batch.items()}  # (T, N, ...) -> (T * N, ...)
    # Advantages are normalised over the whole rollout [code] (of this process).
    advantage = flat["advantage"]
    flat["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-5)
    # Each pass goes through the rollout in a new order, one gradient step per minibatch. So after
    # the first step the policy is no longer the one that played, hence the ratio in ppo_loss.
    for epoch in range(agent.args.update_epochs + agent.args.head_epochs):
        # The last head_epochs passes leave f_omega as it is (no gradient, so Adam skips it): more
        # passes of f_omega move the policy too far, so the layers after it get theirs alone [here].
        agent.encoder.requires_grad_(epoch < agent.args.update_epochs)
        parameters = [p for p in agent.parameters() if p.requires_grad]
        order = torch.randperm(len(flat["value"]), device=agent.table.device)
        for mb_inds in order.split(agent.args.minibatch_size // WORLD_SIZE):
            mb = {name: x.index_select(0, mb_inds) for name, x in flat.items()}
            loss, numbers = ppo_loss(agent, mb, ent_coef)
            optimizer.zero_grad()
            loss.backward()
            if WORLD_SIZE > 1:  # torchrun: the mean of all gradients
                for p in parameters:
                    sum_over_all(p.grad)
                    p.grad /= WORLD_SIZE
            nn.utils.clip_grad_norm_(parameters, MAX_GRAD_NORM)
            optimizer.step()
    return {name: number.item() for name, number in numbers.items()}


def train(args):
    """Algorithm 1, then the test; returns what results.json holds."""
    # A phase says which actions are available: a pool of actions, and how many of it, K. PPO plays
    # in phases["learn"]. The others are for scores only: "train" is the same pool, mostly with the
    # K of a test; "valid" and "test" have pools of their own (see action_phases).
    check(args)
    phases, train_ids = action_phases(args)
    folder = Path(args.runs_dir) / run_name_of(args)
    if RANK == 0:
        claim_folder(folder, args)
    # 1. of Algorithm 1: the table of all c_i, made by the encoder, which is trained if need be.
    table = load_table(args)

    # Environments, networks, optimiser. (Under torchrun, process r has GPU r modulo their number.)
    device = "cpu"
    if args.device != "cpu" and torch.cuda.is_available():
        device = f"cuda:{RANK % torch.cuda.device_count()}"
    N = args.num_envs // WORLD_SIZE
    envs, _ = make_envs(args, phases["learn"], N, (args.seed, TRAINING))
    torch.manual_seed(args.seed)  # the first weights, the same in all processes
    agent = Agent(envs, table, train_ids, args).to(device)
    if args.finetune:
        start_from(agent, Path(args.finetune))
    optimizer = torch.optim.Adam(agent.parameters(), args.learning_rate, eps=1e-5, fused=True)
    reward_stats = RunningMeanStd().to(device)

    # --resume: everything that changes while training comes from the last checkpoint.
    learned = dict(agent=agent, optimizer=optimizer, reward_stats=reward_stats)
    path = folder / "checkpoint.pt"
    step = 0
    seconds = 0.0
    best_score = -math.inf
    log_size = 0  # bytes of metrics.csv at the checkpoint; `Log` cuts off the rest
    if args.resume and path.exists():
        step, seconds, best_score, log_size = load(path, **learned)["progress"]
    log = Log(args, folder, step, log_size) if RANK == 0 else None

    rollout_size = args.minibatch_size * args.num_minibatches  # steps in a rollout
    last_step = args.total_timesteps // rollout_size * rollout_size  # whole rollouts
    eval_steps = max(1, args.eval_every // rollout_size) * rollout_size  # whole rollouts
    decay_steps = args.lr_decay_steps or args.total_timesteps
    # 2. of Algorithm 1. Collect, judge, learn, now and then select.
    while step < last_step:
        started = time.perf_counter()
        if step % eval_steps == 0:
            # At first and after every checkpoint all random numbers and episodes start anew [here].
            # So a run that goes on from a checkpoint equals one that was never interrupted, and
            # evaluations, which use PyTorch's generator as well, do not change the training.
            # Episodes still running are cut off. The last update has used their first part, and in
            # place of the rest the critic's `next_value` (below).
            torch.manual_seed(seeds(1, args.seed, TORCH, step, RANK)[0])
            obs, _ = envs.reset(seed=seeds(N, args.seed, TRAINING, step, RANK))
            G = torch.zeros(N, device=device)  # see running_returns

        # The learning rate falls linearly (D.2), in decay_steps to a tenth [code]. So may the
        # entropy bonus [here]: it is wanted early; late in training a random action costs episodes.
        left = 1 - min(1.0, step / decay_steps)
        learning_rate = args.learning_rate * (LR_FLOOR + (1 - LR_FLOOR) * left)
        ent_coef = args.ent_coef * (args.ent_floor + (1 - args.ent_floor) * left)
        optimizer.param_groups[0]["lr"] = learning_rate

        # Collect. The regulariser *subsampling* works inside of envs.step: when an episode ends,
        # its environment is reset, and `reset` (in the environment's file) draws K new actions out
        # of the pool and shows their ids in obs["available"]. No action is sure to be there
        # (but CREATE's no-op): the policy has to read representations. (--no-subsample: one set.)
        batch, obs, episodes = rollout(envs, obs, agent, rollout_size // args.num_envs)

        # Judge: how much better than expected did each action turn out (gae)? Unless states are
        # pictures, rewards are first divided by the standard deviation of running_returns, then
        # clipped [code]; so values are of the order of 1. With pictures the rewards are used as
        # they are [code]; hence the small vf_coef of CREATE's fast recipe.
        rewards = batch["reward"]
        if not agent.is_image:
            running, G = running_returns(rewards, batch["done"], G, args.gamma)
            reward_stats.update(running.flatten())
            rewards = (rewards / reward_stats.mean_std()[1]).clamp(-10, 10)
        with torch.no_grad():
            _, next_value = agent.encode(agent.to_tensors(obs)[0])  # (N,)
        batch["advantage"] = gae(rewards, batch["value"], batch["done"], next_value, args.gamma)
        batch["return"] = batch["advantage"] + batch["value"]

        # Learn. The statistics of the states are renewed only afterwards [here]: with new ones
        # every probability would change, and the ratio in ppo_loss would not start at 1. While
        # fine-tuning they stay as they were [code]: the layers that were taken over expect this
        # scaling. (Those of the rewards start anew [here]: best.pt does not hold them.)
        numbers = update(agent, optimizer, batch, ent_coef)
        if not (agent.is_image or args.one_hot or args.finetune):
            agent.obs_stats.update(batch["state"].flatten(0, 1))
        if not all(p.isfinite().all() for p in agent.parameters()):
            raise UserError(
                f"infinite or NaN weights: is learning_rate {args.learning_rate} too high?"
            )
        step += rollout_size

        # Select. The regulariser *validation*: of all checkpoints the one is kept that does best
        # with actions that neither policy nor encoder (but hvae-all's) was trained on; as many of
        # them are available as in the test. Test actions do not select: the best of many noisy
        # scores is too high by luck, so the score that is reported has to come from actions that
        # had no part in the choice.
        is_checkpoint = step % eval_steps == 0 or step == last_step
        train_score = valid_score = None
        if is_checkpoint and RANK == 0:
            # The same seeds for both scores: their difference depends less on luck.
            stream = (args.seed, VALIDATION, step)
            train_score = evaluate(agent, phases["train"], args.valid_episodes, stream)["score"]
            valid_score = train_score  # C.2 has no others: the log shows one score twice
            if not args.adapt:
                valid_score = evaluate(agent, phases["valid"], args.valid_episodes, stream)["score"]
            if valid_score > best_score:
                best_score = valid_score
                best = dict(args=vars(args), step=step, agent=agent.state_dict())
                # hvae.write puts the new file in the place of the old one when it is whole: a
                # process that is killed leaves no half file.
                hvae.write(folder / "best.pt", partial(torch.save, best))

        # Record what happened (under torchrun: to the environments of rank 0).
        lasted = time.perf_counter() - started  # with the evaluation, if there was one
        seconds += lasted
        score, total, length = episode_means(episodes)
        row = dict(step=step, seconds=seconds, sps=rollout_size / lasted)
        row.update(train_score=train_score, valid_score=valid_score, learning_rate=learning_rate)
        row.update(episode_score=score, episode_return=total, episode_length=length, **numbers)
        # CleanRL's 1 - var(return - value) / var(return): return - value is the advantage.
        row["explained_variance"] = float(1 - batch["advantage"].var() / batch["return"].var())
        if RANK == 0:
            log_size = log.write(row)
            if is_checkpoint:
                checkpoint = {name: part.state_dict() for name, part in learned.items()}
                checkpoint["args"] = vars(args)
                checkpoint["progress"] = (step, seconds, best_score, log_size)
                hvae.write(path, partial(torch.save, checkpoint))
    envs.close()
    if RANK:
        return {}

    # Test, once (Algorithm 2): the selected policy, frozen, on all parts of the split. The result
    # is its score with test actions, which it has never met. (In C.2 there is only "train", the
    # test actions, which it was adapted to.)
    log.bar.close()
    return finish(folder, agent, phases, step, seconds)


# ---- Algorithm 2: acting with new actions ----


def evaluate(agent, phase, episodes, stream):
    """The frozen policy with actions of a phase, (action_pool, K): means over `episodes` episodes.

    At every reset K actions of the pool become available. Their c_i are rows of the table. Actions
    are drawn from pi, as in training, not the argmax [code]. Nothing is learned here.
    `stream` names the random numbers, see `seeds`. Returns score, its standard error over episodes
    (published error bars are over 5 seeds, 8 in Grid World, instead), return, length, episodes.
    """
    torch.manual_seed(seeds(1, *stream)[0])
    # 40 environments [code]. [code] counts the first 5,000 episodes to end, which favours short
    # ones; [here] of each environment the same number is counted. One that has played its share
    # goes on, not counted any more, until the slowest is done, too.
    N = min(episodes, 40)
    to_play = np.full(N, episodes // N)
    to_play[: episodes % N] += 1
    envs, obs = make_envs(agent.args, phase, N, stream)
    played = []
    while to_play.any():
        _, obs, infos = play_step(envs, obs, agent)
        for episode in ended_episodes(infos, agent.args):
            number = episode[0]
            if to_play[number] > 0:
                to_play[number] -= 1
                played.append(episode)
    envs.close()
    stderr = np.std([score for _, score, *_ in played]) / math.sqrt(episodes)
    score, total, length = episode_means(played)
    means = {"score": score, "return": total, "length": length}
    return dict(means, stderr=float(stderr), episodes=episodes)


def ended_episodes(infos, args):
    """(number of the environment, score, return, length) of every episode that ended just now."""
    # An environment whose episode ends is reset within the same step. What it said at the end is in
    # "final_info"; return and length are added by gymnasium's RecordEpisodeStatistics.
    if "episode" not in infos:
        return []
    metric = args.module.METRIC
    if metric not in infos.get("final_info", {}):
        raise UserError(f"the last info of an episode does not hold the metric {metric!r}")
    scores = infos["final_info"][metric]
    episode = infos["episode"]
    ended = np.flatnonzero(infos["_episode"])
    return [(n, scores[n], episode["r"][n], episode["l"][n]) for n in ended]


def episode_means(episodes):
    """Mean score, return and length of `ended_episodes`; None for each if there are none."""
    if not episodes:
        return None, None, None
    return np.mean(episodes, axis=0)[1:].tolist()


# ---- which actions are available; their representations; checks ----

# Options that an environment's make_vec (see make_envs) takes, by their names in Args.
# (`fully_observable` is none of them: it changes the representations, see load_table.)
OPTIONS = {"create": ("task", "subgoal_reward"), "stacking": ("placement",)}
# How the encoders of --representation differ from hvae.py's defaults.
ENCODERS = {"hvae": {}, "hvae-all": dict(train_on="all"), "vae": dict(hierarchical=False)}


def task_options(args):
    """The options of this environment's make_vec."""
    return {name: getattr(args, name) for name in OPTIONS.get(args.env, ())}


def with_no_op(action_pool, args):
    """The ids that can be available: those of the pool and, in CREATE, the no-op's (A.3).

    No pool contains the no-op. CREATE adds it to every episode, as one of the K [code]. It has a
    representation like all others: of recordings in which nothing happens (see hvae.py).
    """
    no_op = getattr(args.module, "NO_OP", action_pool[:0])  # or none
    return np.union1d(action_pool, no_op)


def make_envs(args, phase, num_envs, stream):
    """Environments for a phase, (action_pool, K available), and their first observation."""
    # make_vec gives every environment a generator of its own, seeded by `stream`, so reset needs no
    # seed. (Training seeds them anew, with RANK, at first and after every checkpoint.) Each
    # reset draws K ids, the no-op among them.
    action_pool, K = phase
    envs = args.module.make_vec(num_envs, action_pool, K, list(stream), **task_options(args))
    envs = RecordEpisodeStatistics(envs)
    obs, _ = envs.reset()
    if not np.isin(obs["available"], with_no_op(action_pool, args)).all():
        raise UserError("a reset makes actions available that are not in its action_pool")
    return envs, obs


def action_phases(args):
    """Phases, name -> (action_pool, K); and all ids (n,) that can be available while training.

    UserError if parts of the split overlap, or if a pool has fewer than K actions.
    """
    split = args.module.split_actions(args.split, args.split_seed)
    ids = np.concatenate(list(split.values()))
    if len(np.unique(ids)) < len(ids):
        raise UserError(f"parts of split {args.split!r} overlap: unseen actions would be seen")

    # "learn": the policy is trained; "train": it is scored on the same actions; "valid": selects
    # the checkpoint; "test": scored once, at the end. K random actions of the pool (CREATE: K - 1
    # and the no-op) are available in an episode: num_available in "learn" (fast Grid World: 20),
    # eval_available elsewhere (50). In C.2 (adapt) there are only "learn" and "train"; their pool
    # is what all other runs call "test".
    action_pool = split["test"] if args.adapt else split["train"]
    learn_K = args.num_available
    eval_K = args.eval_available or learn_K
    train_K = eval_K
    # Three cases learn with a fixed set instead, all of it available all the time, and "train"
    # scores them on it: nearest neighbour, the ablation without subsampling, and C.2 [code]. Where
    # the utilities would cost too much, fixed_set_size makes the set smaller [code]; nearest
    # neighbour, whose outputs are cheap, keeps all of it. (C.2's zero-shot score: `evaluate` the
    # run before --adapt, with --num-available as large as this set. If the pool is larger, each of
    # its episodes has another set.)
    if args.method == "nearest-neighbor" or args.adapt or not args.subsample:
        if args.fixed_set_size and args.method != "nearest-neighbor":
            rng = np.random.default_rng(42)  # [code]: the same actions for all seeds
            size = min(args.fixed_set_size, len(action_pool))
            action_pool = np.sort(rng.choice(action_pool, size, replace=False))
        learn_K = len(with_no_op(action_pool, args))
        train_K = learn_K
    phases = {"learn": (action_pool, learn_K), "train": (action_pool, train_K)}
    if not args.adapt:
        phases.update(valid=(split["valid"], eval_K), test=(split["test"], eval_K))
    for phase in phases.values():
        check_number(phase, args)
    return phases, with_no_op(action_pool, args)


def check_number(phase, args):
    """UserError if a phase, (action_pool, K), has fewer than K actions."""
    action_pool, K = phase
    most = len(with_no_op(action_pool, args))
    if not 1 <= K <= most:
        raise UserError(f"{K} available actions are asked for, but a pool has {most}")


def load_table(args):
    """The representations (A, D); trains the encoder if its table is not there yet."""
    if args.finetune:  # goes on with its table
        return load(Path(args.finetune) / "best.pt")["agent"]["table"].numpy()
    # Representations made by hand: an environment computes them from what it knows of its actions.
    # In Grid World: the moves and their sum [code]; with "engineered-5d" five numbers (appendix B).
    if args.representation.startswith("engineered"):
        options = {}
        if "-" in args.representation:
            options["variant"] = args.representation.partition("-")[2]
        if args.fully_observable:
            options["fully_observable"] = True
        table = args.module.engineered_representations(**options)
        hvae.check_table("engineered_representations", table, args.module)
        return table
    # The encoder is trained on training actions only (but for "hvae-all"). Then it gives every
    # action a representation, the unseen ones, too: the mean of q(c | its recordings). (The VAE
    # has no c: the mean over all its recordings.) One table serves all seeds of the policy, as
    # published: the encoder's seed stays 0.
    path = Path(args.representation)  # FILE.npz; else the name of a kind of encoder
    if path.suffix != ".npz":
        encoder_args = hvae.default_args(args.env, args.hvae_recipe, args.modality)
        changes = dict(split=args.split, split_seed=args.split_seed)
        changes.update(runs_dir=args.runs_dir, device=args.device, **ENCODERS[args.representation])
        encoder_args = replace(encoder_args, **changes)
        path = hvae.representation_path(encoder_args)
        print(f"representations: {path}", flush=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{path}.lock"):  # two runs that start together train the encoder once
            if not path.exists():
                hvae.train(encoder_args)
    # The file has to be of this environment and of this split: another encoder may have seen
    # actions that are unseen here.
    return hvae.load_representation(path, args.env, args.split, args.split_seed)["mean"]


def start_from(agent, folder):
    """C.2: take over the weights of a trained policy."""
    # With another split, the old policy would have been trained with some "new" actions. Another
    # task or kind of representation is taken for a slip. The last three names decide layers.
    theirs = load(folder / "best.pt")
    names = "env task method split split_seed representation hidden_size bilinear aux_conditioned"
    for name in names.split():
        there = getattr(theirs["args"], name)
        if there != getattr(agent.args, name):
            raise UserError(f"{folder} cannot be fine-tuned: its {name} is {there!r}")
    if agent.args.method == "nearest-neighbor":
        # Its outputs are the old actions, so this layer starts anew; the stop head of this baseline
        # does so as well [code], for no known reason.
        for name, untrained in agent.state_dict().items():
            if name.startswith(("head.", "fc_stop.")):
                theirs["agent"][name] = untrained
    agent.load_state_dict(theirs["agent"])  # other layers: an error that names them


def check(args):
    """UserError, before anything is written, for the usual mistakes."""
    # Names that only some environments know; each lists its own.
    names = dict(split="SPLITS", task="TASKS", placement="PLACEMENTS")
    for option, allowed in names.items():
        value = getattr(args, option)
        if value is not None:
            hvae.choose(option, value, getattr(args.module, allowed, ("default",)))
    if args.fully_observable and args.env != "recsys":
        raise UserError("fully_observable: only the Recommender hides something (C.5)")
    if not args.representation.endswith(".npz"):
        variants = [f"engineered-{variant}" for variant in getattr(args.module, "VARIANTS", ())]
        allowed = [*ENCODERS, "engineered", *variants, "FILE.npz"]
        hvae.choose("representation", args.representation, allowed)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device cuda: PyTorch finds no GPU here")
    if args.finetune and not (Path(args.finetune) / "results.json").exists():
        raise UserError(f"{args.finetune} is not the folder of a finished run")
    if min(args.valid_episodes, args.eval_episodes) < 1:
        raise UserError("valid_episodes and eval_episodes must be at least 1")
    # T has to be whole; processes get equal shares of environments and minibatches.
    size = args.minibatch_size * args.num_minibatches
    if size % args.num_envs:
        raise UserError(f"num_envs {args.num_envs} must divide the {size} steps of a rollout")
    if args.num_envs % WORLD_SIZE or args.minibatch_size % WORLD_SIZE:
        raise UserError(f"{WORLD_SIZE} processes must divide num_envs and minibatch_size")
    if size > args.total_timesteps:
        raise UserError(f"total_timesteps {args.total_timesteps}: one rollout takes {size}")


# ---- the run's folder ----

FREE = ("runs_dir", "run_name", "resume", "device")  # may differ at --resume; no part of the name
TESTED = {"train": "seen", "valid": "validation", "test": "unseen"}  # phases and their titles


def run_name_of(args):
    """--run-name, or <env>[-<option>-<value>]*-s<seed> with the options that are not the usual."""
    name = args.run_name
    if name is None:
        usual = vars(default_args(args.env, args.recipe, args.quick))
        usual.update(recipe="fast", quick=False)  # so --recipe paper and --quick are in the name
        words = [hvae.environment_name(args.env)]
        for option, value in vars(args).items():
            if value != usual[option] and option not in ("seed", *FREE):
                words.append(option if value is True else f"{option}-{value}")
        name = "-".join(words)
        if len(name) > 120:
            name = f"{name[:110]}-{hvae.short_hash(name)}"
        name += f"-s{args.seed}"
    # Only characters that every file system takes, and not too many.
    return re.sub(r"^\.|[^A-Za-z0-9._-]", "_", name)[:140]


def claim_folder(folder, args):
    """Make the run's folder, or take it over; nobody else may write there as long as we live.

    UserError if another process does, if there is a checkpoint but no --resume, or if its options
    differ (mostly they give another name, so another folder).
    """
    folder.mkdir(parents=True, exist_ok=True)
    # Two processes in one folder would mix their rows. The operating system frees a lock when its
    # process ends, however it ends. Python would free it with the object `lock`, at the end of this
    # function, so atexit keeps the object. (is_singleton: a notebook can claim it again.)
    lock = FileLock(folder / ".lock", is_singleton=True)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise UserError(f"{folder} is in use by another process") from None
    atexit.register(lock.release)
    path = folder / "checkpoint.pt"
    if path.exists() and not args.resume:
        raise UserError(f"{folder} exists: --resume goes on with it, --run-name keeps both")
    if path.exists():
        for name, there in vars(load(path)["args"]).items():
            if there != getattr(args, name) and name not in FREE:
                raise UserError(f"cannot resume {folder}: its {name} is {there!r}")
    elif args.resume:
        print(f"note: {folder} has no checkpoint, so a new run starts", flush=True)


def load(path, **learned):
    """A checkpoint, its "args" as Args; its states are copied into `learned` (agent=agent, ...).

    UserError if it is missing, damaged, or of other code; then it names the option or layer.
    """
    try:
        # weights_only: numbers and names are read. A file from the internet could not run code.
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        checkpoint["args"] = Args(**checkpoint["args"])
        for name, part in learned.items():
            part.load_state_dict(checkpoint[name])
    except Exception as e:  # for damaged files torch has a dozen kinds of errors
        reason = str(e).strip().split("\n")[-1].strip()
        hint = "the run's folder is expected"
        raise UserError(f"{path} is no checkpoint of this script, {hint}: {reason}") from None
    return checkpoint


def append_row(path, row):
    """A dictionary as the next line of a CSV file; a new file begins with the names."""
    with open(path, "a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, row.keys(), lineterminator="\n")
        if file.tell() == 0:
            writer.writeheader()
        writer.writerow(row)


def write_json(path, content):
    text = json.dumps(content, indent=1)
    hvae.write(path, lambda file: file.write(text.encode()))


class Log:
    """A run's metrics.csv, TensorBoard events and progress bar."""

    # metrics.csv has one row per rollout; train_score and valid_score stand only in the rows of
    # evaluations. TensorBoard shows the same numbers: tensorboard --logdir runs.
    def __init__(self, args, folder, step, size):
        from torch.utils.tensorboard import SummaryWriter  # here, because it takes 1.5 s

        write_json(folder / "args.json", vars(args))
        self.path = folder / "metrics.csv"
        self.path.touch()
        os.truncate(self.path, size)  # rows after the checkpoint are made again
        self.writer = SummaryWriter(folder, purge_step=step + 1)  # drops later events
        print(f"run: {folder}", flush=True)
        # disable=None: no bar but on a terminal.
        total = args.total_timesteps
        self.bar = tqdm(total=total, initial=step, unit="step", unit_scale=True, disable=None)

    def write(self, row):
        """A row for one rollout, scores onto the screen; returns the size of metrics.csv."""
        append_row(self.path, row)
        for name, x in row.items():
            if x is not None:
                self.writer.add_scalar(name, x, row["step"])
        self.bar.update(row["step"] - self.bar.n)
        if row["train_score"] is not None:
            line = "step {step:,}: seen {train_score:.3f}, validation {valid_score:.3f}"
            self.bar.write(line.format(**row))
            self.writer.flush()  # --resume repeats nothing from before the checkpoint that follows
        return self.path.stat().st_size


def finish(folder, agent, phases, step, seconds):
    """Test the best checkpoint; write results.json; then print the scores and draw pictures."""
    # The last policy is forgotten; what is tested is the one that validation has selected.
    args = agent.args
    best = load(folder / "best.pt", agent=agent)
    metric = args.module.METRIC
    results = dict(metric=metric, seed=args.seed, command=shlex.join(sys.orig_argv))
    results.update(steps=step, best_step=best["step"], hours=seconds / 3600)
    for name in TESTED:
        if name in phases:  # C.2 has only "train": the test actions, which are now "seen"
            results[name] = evaluate(agent, phases[name], args.eval_episodes, (args.seed, TEST))
    write_json(folder / "results.json", results)  # first, in case the screen is gone

    print(f"\n{metric}, mean and standard error of {args.eval_episodes} episodes")
    for name, title in TESTED.items():
        if name in results:
            print("{:10} {score:7.3f} +- {stderr:.3f}".format(title, **results[name]))
    try:  # whatever goes wrong with a picture, the results are safe
        plot_curve(folder, metric)
        record_episode(agent, phases["train" if args.adapt else "test"], folder / "episode.gif")
    except Exception as e:
        print(f"note: a picture is missing: {type(e).__name__}: {e}")
    print(f"curve, episode, metrics and checkpoints: {folder}")
    return results


def plot_curve(folder, metric):
    """C.7, Figure 14: scores over steps, as measured ([code] draws the best score so far)."""
    # The distance between the two lines is the generalisation gap (but where training has a fixed
    # set of actions, "train" has another K than "valid": see action_phases).
    os.environ.pop("MPLBACKEND", None)  # a notebook sets it to one that may not be installed here
    from matplotlib.figure import Figure  # not pyplot, which looks for a display

    rows = np.genfromtxt(folder / "metrics.csv", delimiter=",", names=True, encoding="utf-8")
    rows = rows[~np.isnan(rows["train_score"])]
    figure = Figure()
    axes = figure.subplots()
    for column in ("train_score", "valid_score"):
        axes.plot(rows["step"], rows[column], label=column)
    axes.set(xlabel="step", ylabel=metric)
    axes.legend()
    figure.savefig(folder / "curve.png")


def record_episode(agent, phase, path):
    """Play one episode and save it as a GIF, in colour."""
    # The environment's class is the one that its file defines. One such environment is made, in
    # this process, and not reset at the end of the episode, or its last pictures would be lost.
    module = agent.args.module
    classes = [x for x in vars(module).values() if isinstance(x, type) and issubclass(x, gym.Env)]
    own = [x for x in classes if x.__module__ == module.__name__]
    env = own[0](*phase, render_mode="rgb_array", **task_options(agent.args))
    envs = SyncVectorEnv([lambda: env], autoreset_mode=AutoresetMode.DISABLED)
    obs, _ = envs.reset(seed=agent.args.seed)
    frames = env.render_frames()
    done = False
    while not done:
        transition, obs, _ = play_step(envs, obs, agent)
        done = bool(transition["done"])
        frames += env.render_frames()
    envs.close()
    module.save_gif(path, frames, fps=env.metadata["render_fps"])


# ---- python ppo_actiongen.py evaluate RUN: other available actions, and the analyses of A.3 ----


@dataclass
class EvaluateArgs:
    """Test the policy of a run with other available actions; also the analyses of A.3."""

    run: tyro.conf.Positional[str]  # the run's folder
    actions: Literal["train", "valid", "test"] = "test"  # which part of the split to draw from
    num_available: int | None = None  # K; None: as in the run's own test
    min_angle_gap: float | None = None  # CREATE: at least so many degrees from known tools
    min_embedding_distance: float | None = None  # share: .3 leaves out the 30 % nearest to known
    unseen_ratio: float | None = None  # this share of unseen actions, the rest training actions
    episodes: int = 5000  # episodes to play
    save: bool = False  # append the scores to evaluations.csv in the run's folder
    gif: str | None = None  # record one episode in this file, NAME.gif


def restrict_pool(options, module, table, pool, known):
    """Narrow `pool` (m,) as options ask; unseen_ratio mixes in `known` (n,), trained on (A.3)."""
    far, gap = options.min_embedding_distance, options.min_angle_gap
    ratio = options.unseen_ratio
    if (far, gap, ratio) == (None, None, None):
        return pool
    if np.isin(pool, known).any():
        raise UserError("the analyses choose among unseen actions")
    for share in (far, ratio):
        if share is not None and not 0 <= share <= 1:
            raise UserError(f"{share} is no share between 0 and 1")
    if far is not None:
        # Distance to the nearest representation of a training action. [code] has limits on its
        # square, which fit one encoder; a share of the pool fits all of them [here].
        distances = torch.cdist(table[pool].double(), table[known].double())  # (m, n)
        nearest = distances.amin(1).numpy()
        pool = pool[nearest >= np.quantile(nearest, far)]
    if gap is not None:
        # Only tools that differ by so much from the angle of every training tool of their class.
        if not hasattr(module, "angle_gaps"):
            raise UserError("min_angle_gap: only the tools of CREATE have angles")
        pool = pool[module.angle_gaps(pool, known) >= gap]
    if ratio is not None:
        # A mixture as large as the smaller of `pool` and `known`, so that only the share differs
        # between two evaluations. The same mixture for all runs: seed 0 [here]. [code] takes the
        # first actions of both, the unseen ones out of those with a squared distance above 3.
        rng = np.random.default_rng(0)
        size = min(len(pool), len(known))
        num_unseen = round(ratio * size)
        unseen = rng.choice(pool, num_unseen, replace=False)
        pool = np.union1d(unseen, rng.choice(known, size - num_unseen, replace=False))
    return pool


def evaluate_run(options):
    """Score a run's best checkpoint, print it, and write what --save and --gif ask for."""
    if options.episodes < 1:
        raise UserError("episodes must be at least 1")
    if options.gif and not options.gif.endswith(".gif"):
        raise UserError(f"gif {options.gif}: the name has to end in .gif")
    folder = Path(options.run)
    best = load(folder / "best.pt")
    args = best["args"]
    phases, train_ids = action_phases(args)
    # The pool and K of the run's own test, and what the options change of them (A.3: "the rest of
    # the tools"; [here] without the validation part). A policy that was adapted (C.2) knows one
    # fixed set, which is called "train".
    part = "train" if args.adapt else options.actions
    pool, K = phases[part]
    pool = restrict_pool(options, args.module, best["agent"]["table"], pool, phases["learn"][0])
    if options.num_available is not None:
        K = options.num_available
    phase = (pool, K)
    check_number(phase, args)

    # The policy as it was trained, other actions: Algorithm 2 (c_i: rows of the table).
    stream = (args.seed, COMMAND)
    envs, _ = make_envs(args, phase, 1, stream)  # for its spaces, which shape the networks
    agent = Agent(envs, best["agent"]["table"].numpy(), train_ids, args)
    envs.close()
    load(folder / "best.pt", agent=agent)
    result = evaluate(agent, phase, options.episodes, stream)
    most = len(with_no_op(pool, args))
    print(f"{part}: {K} of {most} actions available, {options.episodes} episodes")
    print(args.module.METRIC + " {score:.4f} +- {stderr:.4f}".format(**result))
    if options.save:
        # `best_step` tells which checkpoint was scored: an unfinished run may still find a better.
        row = dict(vars(options), actions=part, num_available=K, pool_size=len(pool), **result)
        row["best_step"] = best["step"]
        append_row(folder / "evaluations.csv", row)
    if options.gif:
        record_episode(agent, phase, Path(options.gif))
        print(f"episode: {options.gif}")
    return result


# ---- the command line ----


def parse_args(words):
    """Args of a command line."""
    # Environment, recipe and quick decide all other defaults, so the line is read twice. An
    # environment of one's own gets its absolute path.
    first = tyro.cli(Args, args=[word for word in words if word not in ("-h", "--help")])
    default = default_args(first.env, first.recipe, first.quick)
    args = tyro.cli(Args, args=words, default=default, description=__doc__)
    return replace(args, env=default.env, adapt=args.adapt or args.finetune is not None)


def main(words):
    """Train what the command line says, or evaluate what was trained."""
    # For layers as small as these, a second thread waits more than it works.
    torch.set_num_threads(1)
    if words[:1] == ["evaluate"]:
        prog = "ppo_actiongen.py evaluate"
        return evaluate_run(tyro.cli(EvaluateArgs, args=words[1:], prog=prog))
    args = parse_args(words or ["--help"])
    join_processes()
    return train(args)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as e:  # a mistake of the user's; one of the program's keeps its traceback
        raise SystemExit(f"error: {e}") from None
