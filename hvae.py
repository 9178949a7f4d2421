"""Action representations: a hierarchical VAE over sets of action observations (appendix B, D.3.1).

An action is known only by observations of what it does: a set X = {x_1 .. x_n} of trajectories,
videos or pictures. The model explains the whole set by one action latent c, and each observation by
its own latent z_j, so that what is common to the set (the action) lands in c and what differs from
one observation to the next (start cell, camera angle) lands in z:

        c ~ N(0, I)  ->  z_j ~ p(z | c)  ->  x_j ~ p(x | z_j, c, first state of x_j)

    ELBO per observation = mean_j [ log p(x_j | z_j, c) - KL( q(z_j | x_j, c) || p(z_j | c) ) ]
                           - KL( q(c | X) || N(0, I) ) / n

The representation of an action is the mean of q(c | X). It is computed for every action, but the
networks are trained on training actions only: unseen actions are encoded without any re-training.

    python hvae.py gridworld                       # the default table of the Grid World experiments
    python hvae.py gridworld --modality onehot     # B: one-hot states, cross-entropy
    python hvae.py gridworld --no-hierarchical     # B: the plain VAE baseline
    python hvae.py gridworld --train-on all        # C: the oracle encoder, has seen every action
    python hvae.py create --split full ; python hvae.py stacking
    python hvae.py gridworld --recipe paper        # Tables 3-4 to the letter: days on a CPU

Paper map: Convolutional Encoder -> ConvEncoder; Bi-LSTM Encoder -> TrajectoryEncoder; Action
Inference Network -> ActionInference; Observation Inference Network -> ObservationInference (and
Prior); Observation Decoder -> TrajectoryDecoder, ImageDecoder; Convolutional Decoder -> ConvDecoder;
Figures 4-6 -> plot_tsne; Tables 3-4 -> Args, TABLE_3, RECIPES.

Shapes: A actions in a batch, n observations of each, B = A * n, L states per trajectory (the first
is given, T = L - 1 are predicted), F numbers per state, C and Z sizes of c and z, H hidden width.
"""

import csv
import hashlib
import importlib
import json
import os
import time
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from tqdm import tqdm

ENVIRONMENTS = {  # command-line name -> module that offers the action observations
    "gridworld": "gridworld",
    "recsys": "recsys",
    "create": "create_env",
    "stacking": "stacking_env",
}
KINDS = {  # what a modality looks like to the networks (appendix B)
    "xy": "trajectory",
    "state": "trajectory",
    "onehot": "onehot",
    "video": "video",
    "image": "image",
}
ONEHOT_CLASSES = 80  # B: "two 80-dimensional one-hot vectors", the play grid is 80x80
LOG_VAR_RANGE = (-4.0, 3.0)  # published code: clamp of the decoder's log variance
BN_EPS, BN_MOMENTUM = 1e-3, 0.01  # Neural Statistician, which D.1 names as the base
GRADIENT_CLIP = 0.5  # published code: every gradient entry is cut to [-0.5, 0.5]
PERPLEXITY = 10  # published t-SNE setting


# ---- Tables 3 and 4 ----


@dataclass
class Args:
    """Train an action encoder and write one representation per action (None = from the recipe)."""

    env: Annotated[str, tyro.conf.Positional] = "gridworld"
    """environment: gridworld, create or stacking"""
    modality: str | None = None
    """what is observed: xy, onehot | xy, state, video | image (None = the paper's default)"""
    hierarchical: bool = True
    """HVAE, or with --no-hierarchical the plain VAE baseline (appendix B)"""
    train_on: Literal["train", "all"] = "train"
    """actions the encoder is trained on; all = the oracle encoder"""
    split: str = "default"
    """action split of the environment (default, full, ...)"""
    split_seed: int = 0
    """seed of the split"""
    seed: int = 0
    """seed of the weights, the batches and the latent samples"""
    recipe: Literal["laptop", "quick", "paper"] = "laptop"
    """paper: Tables 3-4 as written; laptop: equal probe scores in minutes; quick: in one minute"""
    device: str = "auto"
    """cpu, cuda, or auto"""
    runs_dir: str = "runs"
    """results are written to <runs_dir>/hvae"""
    representation_size: int | None = None
    """size of c and of z: 16 grid, 128 CREATE and Stacking (Table 3)"""
    batch_size: int | None = None
    """actions per update: 128 grid and CREATE, 32 Stacking (Table 3)"""
    epochs: int | None = None
    """passes over the training actions: 10,000 grid and CREATE, 5,000 Stacking (Table 3)"""
    updates: int | None = None
    """number of updates, replaces epochs when given"""
    learning_rate: float | None = None
    """learning rate of RAdam: 0.001 (Table 4)"""
    observations: int | None = None
    """action observations recorded per action: 1,024 (Table 4)"""
    batch_observations: int | None = None
    """observations of each action in one update (paper: all of them)"""
    table_observations: int | None = None
    """observations of each action that its representation is computed from (paper: all)"""
    q_hidden: int | None = None
    """hidden size of the action inference network q(c|X): 128 (Table 4)"""
    hidden: int | None = None
    """hidden size of everything else: 64 (Table 4); 128 for images and video (published code)"""
    encoder: Literal["lstm", "mlp"] | None = None
    """observation encoder of trajectories: lstm (D.3.1), or mlp (beyond the paper)"""
    relative: bool | None = None
    """states relative to the first state (laptop, quick) or raw (paper)"""
    compact: bool | None = None
    """Bi-LSTM halves of width H/2, concatenated, instead of width H, averaged"""
    log_var_lr: float | None = None
    """learning rate of the free log-variances, as a multiple of the others'"""
    decoder_log_var: float | None = None
    """start of the decoder's log-variance; None: drawn from N(0, 1), as published"""
    workers: int = 0
    """processes that collect observations (0 = one per core); does not change the result"""
    threads: int = 2
    """CPU threads of torch; results repeat bit for bit only for equal thread counts"""
    plots: bool = True
    """draw the t-SNE and reconstruction pictures"""


TABLE_3 = {
    "gridworld": dict(representation_size=16, batch_size=128, epochs=10_000),
    "create": dict(representation_size=128, batch_size=128, epochs=10_000),
    "stacking": dict(representation_size=128, batch_size=32, epochs=5_000),
}
TABLE_4 = dict(learning_rate=1e-3, observations=1024, q_hidden=128, hidden=64)
VISUAL = dict(batch_size=32, epochs=5_000, hidden=128)  # published code, also for CREATE video

# Every way in which the short recipes differ from the paper; each line stands alone, so that it can
# be switched back from the command line to see what it is worth.
RECIPES = {
    "paper": dict(
        batch_observations=1024,
        table_observations=1024,
        relative=False,
        compact=False,
        log_var_lr=1.0,
        encoder="lstm",
    ),
    "laptop": dict(
        # raw cells run to 78: the networks would first have to learn to subtract the start to a
        # tenth of a cell before any skill is visible. Displacements show it from update 1.
        relative=True,
        # the observations of one skill differ in little but the start: more updates teach more
        # than more observations (1 would leave nothing to pool over).
        batch_observations=4,
        # a free log-variance moves about lr per update: from its start to -9 takes 10,000 updates.
        log_var_lr=10.0,
        # start where one move is already 2.7 sigma.
        decoder_log_var=-2.0,
        # two halves of 32, concatenated, also make D.3.1's "64-dimensional encoded vector", at a
        # third of the arithmetic of two averaged 64s.
        compact=True,
        encoder="lstm",
        # pooling over 64 instead of 1,024 moves a representation by a few hundredths of its spread.
        table_observations=64,
        updates=4_000,
    ),
}
RECIPES["quick"] = dict(RECIPES["laptop"], updates=2_000)


def load_environment(env: str) -> ModuleType:
    """The module of an environment by its command-line name; ValueError if there is none."""
    if env not in ENVIRONMENTS:
        raise ValueError(f"unknown environment {env!r}; allowed: {', '.join(ENVIRONMENTS)}")
    return importlib.import_module(ENVIRONMENTS[env])


def resolve(args: Args) -> Args:
    """A copy of `args` with every None filled in from the tables and the recipe.

    Raises ValueError for an unknown environment, modality, recipe or a count below 1.
    """
    module = load_environment(args.env)
    if not module.MODALITIES:
        raise ValueError(
            f"{args.env} has no action observations: its representations are the engineered ones"
        )
    modality = args.modality or module.MODALITIES[0]
    for name, value, allowed in (
        ("modality", modality, module.MODALITIES),
        ("recipe", args.recipe, RECIPES),
        ("train_on", args.train_on, ("train", "all")),
        ("encoder", args.encoder, (None, "lstm", "mlp")),
    ):
        if value not in allowed:
            allowed = ", ".join(str(a) for a in allowed if a is not None)
            raise ValueError(f"unknown {name} {value!r} for {args.env}; allowed: {allowed}")
    preset = TABLE_4 | TABLE_3.get(args.env, TABLE_3["gridworld"])
    preset |= VISUAL if KINDS[modality] in ("image", "video") else {}
    preset |= RECIPES[args.recipe] | RECIPES.get(f"{args.recipe}-{args.env}-{modality}", {})
    given = {k: v for k, v in asdict(args).items() if v is not None}
    if "epochs" in given and "updates" not in given:
        preset["updates"] = None  # asked for in passes: the recipe's number of updates steps back
    args = replace(args, **(preset | given | {"modality": modality}))
    args.batch_observations = min(args.batch_observations, args.observations)
    args.table_observations = min(args.table_observations, args.observations)
    for name in (
        "representation_size",
        "batch_size",
        "epochs",
        "updates",
        "observations",
        "batch_observations",
        "table_observations",
        "q_hidden",
        "hidden",
        "threads",
    ):
        if (value := getattr(args, name)) is not None and value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    return args


# ---- observations as the networks see them (appendix B) ----


@dataclass(frozen=True)
class Format:
    """How raw observations become network inputs and reconstruction targets."""

    kind: str  # "trajectory" | "onehot" | "video" | "image"
    length: int  # L: states or frames, the first included; 1 for an image
    features: int  # F: numbers per state; side length for pictures
    relative: bool = False
    centre: float = 0.0  # the first state is shown to the networks as (x - centre) / half
    half: float = 1.0
    unit: float = 1.0  # displacements are measured in this many raw units

    def __post_init__(self):
        assert self.kind in set(KINDS.values())


# Smallest scale of the decoder is sigma = exp(-4 / 2) = 0.135 units, so the unit must be large
# enough for what tells actions apart to be several sigma.
UNITS = {
    "gridworld": dict(centre=39.5, half=39.5, unit=1.0),  # cells 1..78; one move = 7 sigma
    "create": dict(centre=0.0, half=1.0, unit=4 / 42),  # ours: 4 of 84 pixels, sigma >= 0.5 pixel
}


def make_format(env: str, modality: str, shape: tuple[int, ...], relative: bool) -> Format:
    """Format of one action's observations of shape (n, ...)."""
    kind = KINDS[modality]
    if kind == "image":  # (n, S, S)
        return Format(kind, 1, shape[2])
    if kind == "video":  # (n, L, S, S)
        return Format(kind, shape[1], shape[3])
    features = shape[2] * (ONEHOT_CLASSES if kind == "onehot" else 1)  # (n, L, F)
    return Format(kind, shape[1], features, relative, **UNITS.get(env, {}))


def prepare(raw: torch.Tensor, fmt: Format) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Raw observations (B, ...) -> what the encoder sees, the first state, what to reconstruct.

    trajectory: (B, L, F), (B, F), (B, T, F);   one-hot: (B, L, F), (B, F), (B, T, 2) class numbers
    video: (B, L, 1, S, S), (B, 1, S, S), (B, T, 1, S, S);   image: all three (B, 1, 1, S, S)
    """
    raw = raw.float()
    if fmt.kind == "image":
        picture = raw[:, None, None] / 255 - 0.5  # published code: grey values to [-0.5, 0.5]
        return picture, picture, picture
    if fmt.kind == "video":
        frames = raw[:, :, None] / 255 - 0.5
        return frames, frames[:, 0], frames[:, 1:]
    first, later = raw[:, :1], raw[:, 1:]
    if fmt.kind == "onehot":
        # "relative" for classes: the start is class 40, a move to the right class 41, ...
        shift = ONEHOT_CLASSES // 2 - first if fmt.relative else 0
        classes = torch.cat([first, later + shift], 1).long().clamp(0, ONEHOT_CLASSES - 1)
        inputs = F.one_hot(classes, ONEHOT_CLASSES).flatten(2).float()  # (B, L, 160)
        return inputs, inputs[:, 0], classes[:, 1:]
    if not fmt.relative:
        return raw, raw[:, 0], later
    moved = (later - first) / fmt.unit  # (B, T, F)
    start = (first - fmt.centre) / fmt.half  # (B, 1, F)
    return torch.cat([start, moved], 1), start[:, 0], moved


# ---- building blocks ----


class Residual(nn.Module):
    """`layers` linear layers of equal width with ReLU between them, then ReLU(out + input).

    appendix: "MLP"; published code: these residual blocks, with the layer counts of the appendix.
    """

    def __init__(self, width: int, layers: int):
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        out = self.linears[0](x)
        for linear in self.linears[1:]:
            out = linear(F.relu(out))
        return F.relu(out + x)


class GlobalBatchNorm(nn.Module):
    """The "1D batch-norm" of D.3.1: one mean, variance, gain and bias over batch *and* dimensions.

    It sets the overall scale of the latents but keeps the ratio of informative to idle dimensions,
    which a per-dimension batch norm would blow up to equal size.
    """

    def __init__(self):
        super().__init__()
        self.norm = nn.BatchNorm1d(1, eps=BN_EPS, momentum=BN_MOMENTUM)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.norm(x.reshape(-1, 1)).reshape(x.shape)


def initialise(module: nn.Module) -> None:
    """Xavier-normal linear layers with gain sqrt(2) and zero bias (published code, HVAE)."""
    if isinstance(module, nn.Linear):
        nn.init.xavier_normal_(module.weight, gain=2**0.5)
        nn.init.zeros_(module.bias)


def free_log_var(*shape: int) -> nn.Parameter:
    """A learned log-variance that no network computes, started at N(0, 1).

    appendix: the networks output the log-variances of q(z|x,c), p(z|c) and of the decoder; published
    code: each is one learned constant per dimension, only q(c|X) has a computed one; we do as the
    code, with which the published tables were made.
    """
    return nn.Parameter(torch.randn(shape))


# ---- D.3.1 Convolutional Encoder ----


class ConvEncoder(nn.Module):
    """Pictures (B, 1, S, S) -> feature vectors (B, 288); 7 layers for S = 48, 9 for S = 84.

    Each layer: 3x3 convolution, batch norm, ReLU; every other layer halves the picture:
    48 -> 24 -> 12 -> 6 -> 3, or 84 -> 42 -> 21 -> 11 -> 6 -> 3 (channels: published code).
    """

    CHANNELS = {48: (8, 8, 16, 16, 16, 16, 32), 84: (8, 8, 16, 16, 16, 16, 32, 32, 32)}

    def __init__(self, size: int):
        super().__init__()
        if size not in self.CHANNELS:
            raise ValueError(f"pictures must be 48 or 84 pixels wide, got {size}")
        layers, before = [], 1
        for i, channels in enumerate(self.CHANNELS[size]):
            layers += [
                nn.Conv2d(before, channels, 3, stride=2 - i % 2, padding=1),
                nn.BatchNorm2d(channels),
                nn.ReLU(),
            ]
            before = channels
        self.layers = nn.Sequential(*layers)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x).flatten(1)  # (B, 32 * 3 * 3)


CONV_FEATURES = 32 * 3 * 3


# ---- D.3.1 Bi-LSTM Encoder ----


class TrajectoryEncoder(nn.Module):
    """Sequences (B, L, F) -> vectors (B, H): a 2-layer Bi-LSTM, averaged over time.

    appendix: a 64-dimensional vector, silent on how; published code: 64 per direction, directions
    averaged (compact=False); compact=True: 32 per direction, concatenated (see RECIPES).
    """

    def __init__(self, features: int, hidden: int, compact: bool):
        super().__init__()
        self.compact, width = compact, hidden // 2 if compact else hidden
        self.lstm = nn.LSTM(features, width, num_layers=2, bidirectional=True, batch_first=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        h = self.lstm(x)[0].mean(1)  # (B, 2 * width), forward half then backward half
        return h if self.compact else h.unflatten(1, (2, -1)).mean(1)  # (B, H)


class MLPEncoder(nn.Module):
    """Beyond the paper: the L * F numbers of a short trajectory through an MLP -> (B, H)."""

    def __init__(self, inputs: int, hidden: int):
        super().__init__()
        wide = 2 * hidden
        self.layers = nn.Sequential(
            nn.Flatten(), nn.Linear(inputs, wide), nn.ReLU(), Residual(wide, 2),
            nn.Linear(wide, hidden), nn.ReLU(),
        )  # fmt: skip

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x)


class ObservationEncoder(nn.Module):
    """Inputs of `prepare` -> (B, H), by the encoder that suits the modality."""

    def __init__(self, fmt: Format, args: Args):
        super().__init__()
        visual = fmt.kind in ("image", "video")
        features = CONV_FEATURES if visual else fmt.features
        self.conv = ConvEncoder(fmt.features) if visual else None
        if fmt.kind == "image":
            # published code: pictures pass the Bi-LSTM as sequences of length 1; the appendix has
            # it for trajectories only, so do we.
            self.sequence = nn.Sequential(nn.Flatten(), nn.Linear(features, args.hidden), nn.ReLU())
        elif args.encoder == "mlp":
            self.sequence = MLPEncoder(fmt.length * features, args.hidden)
        else:
            self.sequence = TrajectoryEncoder(features, args.hidden, args.compact)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.conv is not None:
            frames = self.conv(x.flatten(0, 1))  # (B, L, 1, S, S) -> (B * L, 288)
            x = frames.unflatten(0, x.shape[:2])  # (B, L, 288)
        return self.sequence(x)


# ---- D.3.1 Action Inference Network ----


class ActionInference(nn.Module):
    """q(c | X): encoded observations (A, n, H) -> mean and log-variance of c, each (A, C)."""

    def __init__(self, hidden: int, width: int, size: int):
        super().__init__()
        self.before = nn.Sequential(  # 4 linear layers on each observation
            nn.Linear(hidden, width), nn.ReLU(), Residual(width, 2), nn.Linear(width, width)
        )
        self.after = nn.Sequential(  # 4 linear layers on the pooled vector, then batch norm
            Residual(width, 3), nn.Linear(width, 2 * size), GlobalBatchNorm()
        )

    def forward(self, h: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        # The mean makes the result independent of the order (and scale-free in the number) of the
        # observations: a set in, one Gaussian out.
        pooled = self.before(h).mean(1)  # (A, n, width) -> (A, width)
        mean, log_var = self.after(pooled).chunk(2, -1)
        return mean, log_var


# ---- D.3.1 Observation Inference Network, and the learned prior ----


class ObservationInference(nn.Module):
    """Gaussian over z (B, Z) from one or two vectors: linear each, sum, ReLU, two 2-layer MLPs, linear.

    q(z | x, c) reads the encoded observation and c; the prior p(z | c) reads c alone; the plain
    VAE's q(z | x) the encoded observation alone. The same network, with its own weights, each time.
    """

    def __init__(self, inputs: tuple[int, ...], hidden: int, size: int):
        super().__init__()
        self.inputs = nn.ModuleList(nn.Linear(width, hidden) for width in inputs)
        self.layers = nn.Sequential(
            Residual(hidden, 2), Residual(hidden, 2), nn.Linear(hidden, size), GlobalBatchNorm()
        )
        self.log_var = free_log_var(size)

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        summed = sum(linear(x) for linear, x in zip(self.inputs, inputs, strict=True))
        mean = self.layers(F.relu(summed))
        return mean, self.log_var.expand_as(mean)


class Prior(ObservationInference):
    """p(z | c): what an observation of this action should look like before it is seen."""


# ---- D.3.1 Observation Decoder ----


class TrajectoryDecoder(nn.Module):
    """Latents and the first state (B, F) -> T later states (B, T, F) (means, or logits)."""

    def __init__(self, latents: tuple[int, ...], features: int, hidden: int, steps: int):
        super().__init__()
        self.steps = steps
        self.latents = nn.ModuleList(nn.Linear(size, hidden) for size in latents)
        self.start = nn.Sequential(nn.Linear(features, hidden), Residual(hidden, 2))
        self.lstm = nn.LSTM(hidden, hidden, batch_first=True)
        self.output = nn.Sequential(Residual(hidden, 2), nn.Linear(hidden, features))

    def forward(self, start: torch.Tensor, *latents: torch.Tensor) -> torch.Tensor:
        what = F.relu(sum(linear(x) for linear, x in zip(self.latents, latents, strict=True)))
        # The element-wise product lets the start gate the effect (a wall stops a move).
        combined = what * self.start(start)  # (B, H)
        # appendix: this one vector drives the LSTM, step after step; published code: each predicted
        # state is embedded and fed back; we do as the appendix (also learns sooner).
        sequence = combined[:, None].expand(-1, self.steps, -1)  # (B, T, H)
        return self.output(self.lstm(sequence)[0])  # (B, T, F)


class ImageDecoder(nn.Module):
    """Latents -> the 288 features of one picture (B, 1, 288); a picture has no first state."""

    def __init__(self, latents: tuple[int, ...], features: int, hidden: int):
        super().__init__()
        self.latents = nn.ModuleList(nn.Linear(size, hidden) for size in latents)
        self.output = nn.Sequential(Residual(hidden, 2), nn.Linear(hidden, features))

    def forward(self, start: torch.Tensor, *latents: torch.Tensor) -> torch.Tensor:
        what = F.relu(sum(linear(x) for linear, x in zip(self.latents, latents, strict=True)))
        return self.output(what)[:, None]  # (B, 1, 288)


# ---- D.3.1 Convolutional Decoder ----


class ConvDecoder(nn.Module):
    """Features (B, 288) -> picture in [-0.5, 0.5] and mask in [0, 1], each (B, 1, S, S).

    Pairs of a 3x3 convolution and a transposed one that (about) doubles the picture, each with
    batch norm and ReLU: 3 -> 6 -> 12 -> 24 -> 48, or 3 -> 6 -> 11 -> 21 -> 42 -> 84; then 1x1.
    """

    # (channels out of the transposed convolution, its kernel, its padding); published code
    STAGES = {
        48: ((32, 2, 0), (32, 2, 0), (16, 2, 0), (16, 2, 0)),
        84: ((32, 2, 0), (32, 3, 1), (16, 3, 1), (16, 2, 0), (16, 2, 0)),
    }

    def __init__(self, size: int, mask: bool):
        super().__init__()
        layers, width = [], 32
        for channels, kernel, padding in self.STAGES[size]:
            up = nn.ConvTranspose2d(width, channels, kernel, stride=2, padding=padding)
            for layer, out in ((nn.Conv2d(width, width, 3, padding=1), width), (up, channels)):
                layers += [layer, nn.BatchNorm2d(out), nn.ReLU()]
            width = channels
        self.layers = nn.Sequential(*layers, nn.Conv2d(width, 1 + mask, 1), nn.Sigmoid())

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = self.layers(features.unflatten(1, (32, 3, 3)))  # (B, 1 or 2, S, S)
        return out[:, :1] - 0.5, out[:, 1:]


# ---- likelihoods and divergences ----


def gaussian_log_prob(x: torch.Tensor, mean: torch.Tensor, log_var: torch.Tensor) -> torch.Tensor:
    """log N(x; mean, exp(log_var)), element by element."""
    return -0.5 * (np.log(2 * np.pi) + log_var + (x - mean) ** 2 * torch.exp(-log_var))


def gaussian_kl(
    mean: torch.Tensor, log_var: torch.Tensor, mean_p: torch.Tensor, log_var_p: torch.Tensor
) -> torch.Tensor:
    """KL( N(mean, exp(log_var)) || N(mean_p, exp(log_var_p)) ), summed over the last axis."""
    spread = (log_var.exp() + (mean - mean_p) ** 2) * torch.exp(-log_var_p)
    return 0.5 * (log_var_p - log_var - 1 + spread).sum(-1)


def standard_kl(mean: torch.Tensor, log_var: torch.Tensor) -> torch.Tensor:
    """KL( N(mean, exp(log_var)) || N(0, I) ), summed over the last axis."""
    return 0.5 * (mean**2 + log_var.exp() - 1 - log_var).sum(-1)


def sample(mean: torch.Tensor, log_var: torch.Tensor) -> torch.Tensor:
    """Reparameterised sample: gradients flow into mean and log_var."""
    return mean + torch.randn_like(mean) * torch.exp(0.5 * log_var)


# ---- the two models ----


class ObservationModel(nn.Module):
    """What the HVAE and the plain VAE share: encoder, decoder, likelihood of an observation."""

    def __init__(self, fmt: Format, args: Args, latents: tuple[int, ...]):
        super().__init__()
        self.format, visual = fmt, fmt.kind in ("image", "video")
        features = CONV_FEATURES if visual else fmt.features
        self.encoder = ObservationEncoder(fmt, args)
        if fmt.kind == "image":
            self.decoder = ImageDecoder(latents, features, args.hidden)
        else:
            self.decoder = TrajectoryDecoder(latents, features, args.hidden, fmt.length - 1)
        if visual:
            self.conv_decoder = ConvDecoder(fmt.features, mask=fmt.kind == "video")
            self.log_var = free_log_var(1, fmt.features, fmt.features)  # one per pixel
        elif fmt.kind == "trajectory":
            self.log_var = free_log_var(features)  # one per feature, for all steps and actions

    def decode(self, start: torch.Tensor, *latents: torch.Tensor) -> torch.Tensor:
        """Latents and first states -> reconstruction, in the shape `prepare` gives for targets
        (one-hot: logits (B, T, 2, 80))."""
        if self.format.kind == "trajectory":
            return self.decoder(start, *latents)  # (B, T, F)
        if self.format.kind == "onehot":
            return self.decoder(start, *latents).unflatten(-1, (-1, ONEHOT_CLASSES))
        if self.format.kind == "image":
            features = self.decoder(start, *latents)  # (B, 1, 288)
        else:  # the first frame enters as its convolutional features
            features = self.decoder(self.encoder.conv(start), *latents)  # (B, T, 288)
        picture, mask = self.conv_decoder(features.flatten(0, 1))  # (B * T, 1, S, S)
        picture = picture.unflatten(0, features.shape[:2])  # (B, T, 1, S, S)
        if self.format.kind == "image":
            return picture
        # Temporal skip connection: a pixel that the mask closes is copied from the first frame.
        # appendix: mask * picture + frame; published code: + (1 - mask) * frame; we do as the code
        # because the plain sum leaves the range of the pixels.
        mask = mask.unflatten(0, features.shape[:2])
        return mask * picture + (1 - mask) * start[:, None]

    def log_likelihood(self, target: torch.Tensor, output: torch.Tensor) -> torch.Tensor:
        """log p(x | latents), summed over states and features: (B,)."""
        if self.format.kind == "onehot":
            log_prob = output.log_softmax(-1).gather(-1, target[..., None])  # (B, T, 2, 1)
        else:
            log_prob = gaussian_log_prob(target, output, self.log_var.clamp(*LOG_VAR_RANGE))
        return log_prob.flatten(1).sum(1)

    def summary(self, raw, target, output, kl_z, kl_c) -> dict[str, torch.Tensor]:
        """Mean parts of the loss per observation. raw: (A, n, ...); kl_z: (B,); kl_c: (A,)."""
        rec = self.log_likelihood(target, output).mean()
        # One c serves n observations, so an observation bears 1/n of its cost.
        kl_z, kl_c = kl_z.mean(), kl_c.mean() / raw.shape[1]
        if self.format.kind == "onehot":
            error = (output.argmax(-1) != target).float().mean()  # share of wrong coordinates
        else:
            error = F.mse_loss(output, target)
        # published code: rec is weighted by w = 1 + 0.5^epoch and the KLs by 1/w; after 28 updates
        # this is 1, so it is left out.
        return dict(loss=kl_z + kl_c - rec, rec=rec, kl_z=kl_z, kl_c=kl_c, error=error)


class HVAE(ObservationModel):
    """The hierarchical model: c for the action, z for the observation, x decoded from both."""

    def __init__(self, fmt: Format, args: Args):
        size, hidden = args.representation_size, args.hidden
        super().__init__(fmt, args, latents=(size, size))
        self.q_c = ActionInference(hidden, args.q_hidden, size)
        self.q_z = ObservationInference((hidden, size), hidden, size)
        self.p_z = Prior((size,), hidden, size)
        self.apply(initialise)

    def forward(self, raw: torch.Tensor) -> dict[str, torch.Tensor]:
        """Raw observations (A, n, ...) -> {"loss", "rec", "kl_z", "kl_c", "error"}, scalars."""
        actions, n = raw.shape[:2]
        inputs, start, target = prepare(raw.flatten(0, 1), self.format)  # (B, ...)
        h = self.encoder(inputs)  # (B, H)
        c_mean, c_log_var = self.q_c(h.unflatten(0, (actions, n)))  # (A, C)
        c = sample(c_mean, c_log_var).repeat_interleave(n, 0)  # one c per set: (B, C)
        z_mean, z_log_var = self.q_z(h, c)  # (B, Z)
        output = self.decode(start, sample(z_mean, z_log_var), c)
        kl_z = gaussian_kl(z_mean, z_log_var, *self.p_z(c))
        return self.summary(raw, target, output, kl_z, standard_kl(c_mean, c_log_var))

    def represent(self, raw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log-variance of q(c | X), each (A, C): the mean is the representation."""
        h = self.encoder(prepare(raw.flatten(0, 1), self.format)[0])
        return self.q_c(h.unflatten(0, raw.shape[:2]))

    def reconstruct(self, raw: torch.Tensor) -> torch.Tensor:
        """Reconstructions from the means of c and z, no sampling."""
        inputs, start, _ = prepare(raw.flatten(0, 1), self.format)
        h = self.encoder(inputs)
        c = self.q_c(h.unflatten(0, raw.shape[:2]))[0].repeat_interleave(raw.shape[1], 0)
        return self.decode(start, self.q_z(h, c)[0], c)


class VAE(ObservationModel):
    """The non-hierarchical baseline (appendix B): each observation for itself, then the mean.

    Same encoder, decoder, batches and number of updates as the HVAE. published code: a quarter of
    the updates and another initialisation; we give both models the same, so that only the hierarchy
    differs.
    """

    def __init__(self, fmt: Format, args: Args):
        super().__init__(fmt, args, latents=(args.representation_size,))
        self.q_z = ObservationInference((args.hidden,), args.hidden, args.representation_size)
        self.apply(initialise)

    def forward(self, raw: torch.Tensor) -> dict[str, torch.Tensor]:
        """Raw observations (A, n, ...) -> {"loss", "rec", "kl_z", "kl_c", "error"}, scalars."""
        inputs, start, target = prepare(raw.flatten(0, 1), self.format)  # (B, ...)
        z_mean, z_log_var = self.q_z(self.encoder(inputs))  # (B, Z)
        output = self.decode(start, sample(z_mean, z_log_var))
        kl_z = standard_kl(z_mean, z_log_var)
        return self.summary(raw, target, output, kl_z, torch.zeros(1, device=raw.device))

    def represent(self, raw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log-variance, over an action's observations, of the means of q(z | x)."""
        z = self.q_z(self.encoder(prepare(raw.flatten(0, 1), self.format)[0]))[0]
        z = z.unflatten(0, raw.shape[:2])  # (A, n, Z)
        return z.mean(1), z.var(1, correction=0).clamp_min(1e-8).log()

    def reconstruct(self, raw: torch.Tensor) -> torch.Tensor:
        """Reconstructions from the mean of z, no sampling."""
        inputs, start, _ = prepare(raw.flatten(0, 1), self.format)
        return self.decode(start, self.q_z(self.encoder(inputs))[0])


# ---- training ----


def draw(rng: np.random.Generator, stored: int, actions: int, n: int) -> np.ndarray:
    """n different positions below `stored` for each action: (actions, n).

    An arithmetic progression with random start and step: distinct without sorting `stored` keys
    per action. Observations are i.i.d., so every set of positions is an equally good sample.
    """
    first = rng.integers(stored, size=(actions, 1))
    step = rng.integers(1, max(stored // n, 1) + 1, size=(actions, 1))
    return (first + step * np.arange(n)) % stored


def fit(model: ObservationModel, data: np.ndarray, args: Args, log: Path) -> None:
    """Maximise the ELBO on data (actions, stored, ...), raw observations of training actions."""
    device = next(model.parameters()).device
    free = [p for name, p in model.named_parameters() if name.endswith("log_var")]
    rest = [p for name, p in model.named_parameters() if not name.endswith("log_var")]
    optimiser = torch.optim.RAdam(  # D.1
        [dict(params=rest), dict(params=free, lr=args.learning_rate * args.log_var_lr)],
        lr=args.learning_rate,
        foreach=True,
    )
    batch = min(args.batch_size, len(data))
    per_epoch = len(data) // batch  # an incomplete last batch is dropped
    updates = args.updates or args.epochs * per_epoch
    rng, start, order = np.random.default_rng(args.seed), time.perf_counter(), None
    tensor = torch.from_numpy(data)
    model.train()
    rows, totals = [], {}
    with tqdm(total=updates, desc="hvae", unit="update", mininterval=0.5) as bar:
        for update in range(updates):
            if update % per_epoch == 0:
                order = rng.permutation(len(data))
            ids = order[update % per_epoch * batch :][:batch]
            picks = draw(rng, data.shape[1], batch, args.batch_observations)
            raw = tensor[torch.from_numpy(ids)[:, None], torch.from_numpy(picks)]  # (A, n, ...)
            parts = model(raw.to(device))
            optimiser.zero_grad()
            parts["loss"].backward()
            nn.utils.clip_grad_value_(model.parameters(), GRADIENT_CLIP)
            optimiser.step()
            for name, value in parts.items():
                totals[name] = totals.get(name, 0.0) + value.detach()
            every = max(1, min(100, updates))
            if (update + 1) % every == 0:
                means = {name: float(value) / every for name, value in totals.items()}
                seconds = round(time.perf_counter() - start, 2)
                rows.append(dict(update=update + 1, seconds=seconds, **means))
                bar.set_postfix(loss=f"{means['loss']:.2f}", error=f"{means['error']:.3g}")
                totals = {}
                if not np.isfinite(means["loss"]):
                    raise ValueError(
                        f"training diverged at update {update + 1}: loss is not finite"
                    )
            bar.update()
    write_atomically(log, lambda file: write_csv(file, rows))


@torch.no_grad()
def embed(model: ObservationModel, module: ModuleType, args: Args) -> tuple[np.ndarray, np.ndarray]:
    """Representations of every action, seen or not: mean and log-variance, (NUM_ACTIONS, C)."""
    device = next(model.parameters()).device
    model.eval()
    means, log_vars = [], []
    for ids in np.array_split(np.arange(module.NUM_ACTIONS), -(-module.NUM_ACTIONS // 256)):
        raw = observe(module, ids, args.table_observations, args)
        for part in np.array_split(raw, -(-raw.size // 4_000_000)):  # ours: bounds the memory
            mean, log_var = model.represent(torch.from_numpy(part).to(device))
            means.append(mean.cpu().numpy())
            log_vars.append(log_var.cpu().numpy())
    return np.concatenate(means), np.concatenate(log_vars)


def observe(module: ModuleType, ids: np.ndarray, n: int, args: Args) -> np.ndarray:
    """Raw observations (len(ids), n, ...). Seed 0 always: encoders differ by `seed`, not by data."""
    workers = args.workers or os.cpu_count() or 1
    return module.action_observations(ids, n, args.modality, seed=0, workers=workers)


# ---- the representations file ----


def fingerprint(module: ModuleType) -> str:
    """Hash of an environment's action set: count, labels and engineered representations."""
    digest = hashlib.sha256(str(module.NUM_ACTIONS).encode())
    digest.update("\n".join(str(label) for label in module.action_labels()).encode())
    # Thousandths: the last bits of a sine or cosine may differ from machine to machine.
    numbers = np.round(np.asarray(module.engineered_representations(), np.float64) * 1000)
    digest.update(numbers.astype("<i8").tobytes())
    return digest.hexdigest()[:16]


def write_atomically(path: Path, write) -> None:
    """Call write(temporary path in the same folder), then rename: readers never see half a file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_csv(path: Path, rows: list[dict]) -> None:
    """Rows with equal keys as a CSV file with a header."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0] if rows else ["update"])
        writer.writeheader()
        writer.writerows(rows)


def representation_path(args: Args) -> Path:
    """Where `train(args)` writes its table.

    <runs_dir>/hvae/<env>-<modality>-<hvae|vae>[-all]-<split>-<recipe>-s<seed>.npz
    (a split seed other than 0 follows the name of the split, an encoder asked for that of the recipe)
    """
    modality = resolve(args).modality
    parts = [args.env, modality, "hvae" if args.hierarchical else "vae"]
    parts += ["all"] if args.train_on == "all" else []
    parts += [f"{args.split}{args.split_seed or ''}"]
    parts += [args.recipe + (f"_{args.encoder}" if args.encoder else ""), f"s{args.seed}"]
    return Path(args.runs_dir) / "hvae" / ("-".join(parts) + ".npz")


def save_representation(
    path: str | Path,
    env: str,
    mean: np.ndarray,
    log_var: np.ndarray,
    action_ids: np.ndarray,
    config: dict | None = None,
) -> Path:
    """Write a table of representations that `load_representation` accepts; any encoder may make it.

    Args:
        path: file name, .npz.
        env: name of the environment, a key of ENVIRONMENTS.
        mean: (NUM_ACTIONS, D), one row per action id: what the policy reads.
        log_var: (NUM_ACTIONS, D), its uncertainty.
        action_ids: ids of the actions that the encoder was trained on.
        config: anything JSON can hold. "split" and "split_seed", if given, must match at loading;
            environment and fingerprint of the action set are added here.

    Raises:
        ValueError: unknown environment, wrong shapes or values that are not finite.
    """
    module = load_environment(env)
    arrays = dict(
        mean=np.asarray(mean, np.float32),
        log_var=np.asarray(log_var, np.float32),
        action_ids=np.asarray(action_ids, np.int64),
    )
    check_arrays(arrays, module.NUM_ACTIONS, str(path))
    config = dict(config or {}, environment=env, fingerprint=fingerprint(module))
    config = np.array(json.dumps(config, sort_keys=True))

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            np.savez(file, **arrays, config=config)

    write_atomically(Path(path), write)
    return Path(path)


def check_arrays(arrays: dict[str, np.ndarray], num_actions: int, name: str) -> None:
    """Raise ValueError unless the arrays are a table for `num_actions` actions."""
    mean, log_var, ids = arrays["mean"], arrays["log_var"], arrays["action_ids"]
    if mean.ndim != 2 or len(mean) != num_actions or mean.shape[1] < 1:
        raise ValueError(f"{name}: mean must be ({num_actions}, D), got {mean.shape}")
    if log_var.shape != mean.shape:
        raise ValueError(f"{name}: log_var must be {mean.shape} like mean, got {log_var.shape}")
    if not (np.isfinite(mean).all() and np.isfinite(log_var).all()):
        raise ValueError(f"{name}: contains values that are not finite")
    if ids.ndim != 1 or ids.dtype.kind not in "iu" or len(np.unique(ids)) != len(ids):
        raise ValueError(f"{name}: action_ids must be distinct integers in one row")
    if len(ids) and not (0 <= ids.min() and ids.max() < num_actions):
        raise ValueError(f"{name}: action_ids must lie in 0..{num_actions - 1}")


def load_representation(
    path: str | Path, env: str, split: str = "default", split_seed: int = 0
) -> dict[str, np.ndarray | dict]:
    """Read a table written by `save_representation` and make sure that it belongs here.

    Returns:
        mean and log_var (NUM_ACTIONS, D) float32, action_ids (int64), config (dict).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or was made for another environment, action set or split.
    """
    module, path = load_environment(env), Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no representations at {path}")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ("mean", "log_var", "action_ids")}
            config = json.loads(str(file["config"]))
    except Exception as e:  # zip, npy and JSON each have their own errors for a damaged file
        raise ValueError(f"{path} is no representations file: {type(e).__name__}: {e}") from None
    if not isinstance(config, dict) or arrays["mean"].dtype.kind != "f":
        raise ValueError(f"{path} is no representations file: config or mean has the wrong type")
    if config.get("environment") != env:
        raise ValueError(
            f"{path} was made for environment {config.get('environment')!r}, not {env!r}"
        )
    check_arrays(arrays, module.NUM_ACTIONS, str(path))
    if config.get("fingerprint") != fingerprint(module):
        raise ValueError(f"{path} was made for another action set of {env}: train it again")
    for name, wanted in (("split", split), ("split_seed", split_seed)):
        if config.get(name, wanted) != wanted:
            raise ValueError(f"{path} was made for {name} {config[name]!r}, not {wanted!r}")
    if config.get("train_on") == "train":  # the split itself may have been redrawn since
        train_ids = module.split_actions(split, split_seed)["train"]
        if not np.array_equal(np.sort(arrays["action_ids"]), train_ids):
            raise ValueError(f"{path} was trained on other actions than split {split!r} has now")
    return dict(
        mean=arrays["mean"].astype(np.float32),
        log_var=arrays["log_var"].astype(np.float32),
        action_ids=arrays["action_ids"].astype(np.int64),
        config=config,
    )


# ---- how good is a table? ----

PUBLISHED = {  # probe scores of the released 10,000-epoch tables, ours to compare with
    "gridworld-xy-hvae": dict(net_r2=0.946, move_accuracy_mean=0.604, nn_net_match=0.717),
    "gridworld-xy-hvae-all": dict(net_r2=0.970, move_accuracy_mean=0.705, nn_net_match=0.721),
    "gridworld-xy-vae": dict(net_r2=0.908, move_accuracy_mean=0.496, nn_net_match=0.496),
    "gridworld-onehot-hvae": dict(net_r2=0.942, move_accuracy_mean=0.669, nn_net_match=0.541),
    "gridworld-onehot-vae": dict(net_r2=0.368, move_accuracy_mean=0.424, nn_net_match=0.131),
}


def linear_r2(x: np.ndarray, y: np.ndarray, x_new: np.ndarray, y_new: np.ndarray) -> np.ndarray:
    """R^2 on (x_new, y_new) of a ridge read-out fitted on (x, y), one per column of y."""
    from sklearn.linear_model import RidgeCV

    centre, spread = x.mean(0), x.std(0) + 1e-8
    model = RidgeCV(np.logspace(-4, 4, 17)).fit((x - centre) / spread, y)
    predicted = model.predict((x_new - centre) / spread).reshape(y_new.shape)
    return 1 - ((y_new - predicted) ** 2).sum(0) / ((y_new - y_new.mean(0)) ** 2).sum(0)


def nearest(x: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Index of the nearest row of `others` (Euclid) for each row of x."""
    x, others = x.astype(np.float64), others.astype(np.float64)
    return ((others**2).sum(1) - 2 * x @ others.T).argmin(1)


def probe(
    mean: np.ndarray, train_ids: np.ndarray, held_out_ids: np.ndarray, env: str = "gridworld"
) -> dict:
    """What can be read from the representations: fitted on train actions, scored on held-out ones.

    gridworld: net_r2 (linear read-out of the net displacement), move_accuracy (logistic read-out of
    each of the five moves, chance 0.25) and its mean, nn_net_match (share of held-out skills whose
    nearest train skill has the same net displacement).
    Other environments: engineered_r2 (linear read-out of the engineered features, mean over those
    that vary), nn_class (share of held-out actions whose nearest other held-out action has the same
    label, as in Figures 5 and 6) and chance_class (the same for a random other action).
    """
    x, x_new = np.asarray(mean)[train_ids], np.asarray(mean)[held_out_ids]
    if env == "gridworld":
        from sklearn.linear_model import LogisticRegression

        moves = np.arange(len(mean))[:, None] // 4 ** np.arange(5) % 4  # facts of A.1: base 4
        net = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[moves].sum(1)  # (1024, 2)
        centre, spread = x.mean(0), x.std(0) + 1e-8
        accuracy = []
        for t in range(5):
            model = LogisticRegression(max_iter=1000).fit(
                (x - centre) / spread, moves[train_ids, t]
            )
            accuracy.append(model.score((x_new - centre) / spread, moves[held_out_ids, t]))
        match = net[np.asarray(train_ids)[nearest(x_new, x)]] == net[held_out_ids]
        r2 = linear_r2(x, net[train_ids], x_new, net[held_out_ids])
        return dict(
            net_r2=round(float(r2.mean()), 4),
            move_accuracy=[round(float(a), 4) for a in accuracy],
            move_accuracy_mean=round(float(np.mean(accuracy)), 4),
            nn_net_match=round(float(match.all(1).mean()), 4),
        )
    module = load_environment(env)
    truth, labels = module.engineered_representations(), module.action_labels()[held_out_ids]
    vary = (truth[train_ids].std(0) > 1e-6) & (truth[held_out_ids].std(0) > 1e-6)
    r2 = linear_r2(x, truth[train_ids][:, vary], x_new, truth[held_out_ids][:, vary])
    gap = ((x_new[:, None].astype(np.float64) - x_new) ** 2).sum(-1)  # (held out, held out)
    np.fill_diagonal(gap, np.inf)
    counts = np.unique(labels, return_counts=True)[1]
    return dict(
        engineered_r2=round(float(r2.mean()), 4),
        nn_class=round(float((labels[gap.argmin(1)] == labels).mean()), 4),
        chance_class=round(
            float((counts * (counts - 1)).sum() / len(labels) / (len(labels) - 1)), 4
        ),
    )


# ---- pictures ----


def plot_tsne(mean: np.ndarray, labels: np.ndarray, path: Path, title: str) -> None:
    """Figures 4-6: two-dimensional t-SNE of held-out actions (count, D), coloured by label."""
    from matplotlib.figure import Figure
    from sklearn.manifold import TSNE

    perplexity = min(PERPLEXITY, (len(mean) - 1) / 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        spots = TSNE(perplexity=perplexity, random_state=0, init="pca").fit_transform(mean)
    figure = Figure(figsize=(6, 5), layout="constrained")
    axes = figure.subplots()
    names = sorted(set(labels))
    for i, name in enumerate(names):
        colour = colorsys_hls(i / len(names))
        axes.scatter(*spots[labels == name].T, s=14, color=colour, label=str(name))
    axes.set(xticks=[], yticks=[], title=title)
    axes.spines[:].set_visible(False)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, fontsize=8)
    write_atomically(path, lambda file: figure.savefig(file, dpi=120))


def colorsys_hls(share: float) -> tuple[float, float, float]:
    """Evenly spaced hues of one lightness (published plotting settings)."""
    import colorsys

    return colorsys.hls_to_rgb((share + 0.7) % 1, 0.6, 0.9)


def undo(output: np.ndarray, first: np.ndarray, fmt: Format) -> np.ndarray:
    """Network output -> raw units. output (B, T, ...); first: raw first states (B, 2 or F)."""
    if fmt.kind == "onehot":
        cells = output.argmax(-1).astype(float)  # (B, T, 2)
        return cells + first[:, None] - ONEHOT_CLASSES // 2 if fmt.relative else cells
    if fmt.kind == "trajectory":
        return first[:, None] + output * fmt.unit if fmt.relative else output
    return output[:, :, 0] + 0.5  # pictures: (B, T, S, S) in [0, 1]


@torch.no_grad()
def plot_reconstructions(model, raw: np.ndarray, names: list[str], path: Path) -> None:
    """Held-out actions: what was observed beside what the model makes of it. raw: (8, n, ...)."""
    from matplotlib.figure import Figure

    fmt, device = model.format, next(model.parameters()).device
    model.eval()
    output = model.reconstruct(torch.from_numpy(raw).to(device)).cpu().numpy()  # (8 * n, T, ...)
    output = output.reshape(raw.shape[:2] + output.shape[1:])
    figure = Figure(figsize=(14, 5), layout="constrained")
    if fmt.kind in ("image", "video"):
        rows = figure.subplots(2, len(raw))
        for i, name in enumerate(names):
            true = raw[i, :1] / 255
            true = true if fmt.kind == "image" else true[0, 1:]  # (T, S, S)
            made = undo(output[i, :1], None, fmt)[0]  # (T, S, S)
            for axes, frames in zip(rows[:, i], (true, made), strict=True):
                axes.imshow(np.concatenate(frames[:: max(1, len(frames) // 3)]), cmap="gray")
                axes.set(xticks=[], yticks=[])
            rows[0, i].set_title(name, fontsize=8)
    else:
        rows = figure.subplots(2, len(raw))
        for i, name in enumerate(names):
            true = raw[i].astype(float)  # (n, L, F)
            made = np.concatenate([true[:, :1], undo(output[i], true[:, 0], fmt)], 1)
            for axes, paths in zip(rows[:, i], (true, made), strict=True):
                for states in paths:
                    x, y = (states - states[0])[:, :2].T if fmt.kind != "video" else states.T
                    axes.plot(x, y, "o-", markersize=3, alpha=0.6)
                axes.set_aspect("equal", "datalim")
                axes.invert_yaxis()
                axes.tick_params(labelsize=6)
            rows[1, i].set(xlim=rows[0, i].get_xlim(), ylim=rows[0, i].get_ylim())
            rows[0, i].set_title(name, fontsize=8)
    rows[0, 0].set_ylabel("observed")
    rows[1, 0].set_ylabel("reconstructed")
    write_atomically(path, lambda file: figure.savefig(file, dpi=100))


# ---- putting it together ----


def build(fmt: Format, args: Args) -> ObservationModel:
    """The model that `args` (resolved) asks for, with weights drawn from torch's generator."""
    model = (HVAE if args.hierarchical else VAE)(fmt, args)
    if args.decoder_log_var is not None and fmt.kind != "onehot":
        nn.init.constant_(model.log_var, args.decoder_log_var)
    return model


def train(args: Args) -> Path:
    """Train an encoder and write <name>.npz (see `representation_path`) with its company beside it:
    .pt (weights), .csv (losses), .json (probe scores), -tsne.png, -reconstructions.png.

    Returns the path of the .npz, which is written last: where it exists, the run was finished.
    Raises ValueError for a choice that the environment does not have.
    """
    path, args, module = representation_path(args), resolve(args), load_environment(args.env)
    splits = module.split_actions(args.split, args.split_seed)
    held_out = np.sort(np.concatenate([splits["valid"], splits["test"]]))
    ids = np.arange(module.NUM_ACTIONS) if args.train_on == "all" else splits["train"]
    device = args.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    threads = torch.get_num_threads()
    torch.set_num_threads(args.threads)
    try:
        with torch.random.fork_rng():  # the caller's random numbers stay as they are
            torch.manual_seed(args.seed)
            data = observe(module, ids, args.observations, args)  # training actions only
            fmt = make_format(args.env, args.modality, data.shape[1:], args.relative)
            model = build(fmt, args).to(device)
            fit(model, data, args, path.with_suffix(".csv"))
            mean, log_var = embed(model, module, args)
    finally:
        torch.set_num_threads(threads)
    weights = {name: value.cpu() for name, value in model.state_dict().items()}
    write_atomically(path.with_suffix(".pt"), lambda file: torch.save(weights, file))
    report(model, module, mean, splits["train"], held_out, path, args)
    settings = {k: v for k, v in asdict(args).items() if k not in ("env", "runs_dir", "plots")}
    return save_representation(path, args.env, mean, log_var, ids, settings)


def report(model, module, mean, train_ids, held_out, path: Path, args: Args) -> None:
    """Probe scores to the screen and <name>.json, pictures beside it."""
    scores = probe(mean, train_ids, held_out, args.env)
    all_ = "-all" if args.train_on == "all" else ""
    name = f"{args.env}-{args.modality}-{'hvae' if args.hierarchical else 'vae'}{all_}"
    published = PUBLISHED.get(name, {})
    record = dict(scores=scores, published=published)
    write_atomically(path.with_suffix(".json"), lambda file: file.write_text(json.dumps(record)))
    print(f"{name}: read-outs of {len(held_out)} held-out actions")
    for key, value in scores.items():
        print(f"  {key:20} {value!s:42} published {published.get(key, '-')}")
    if not args.plots:
        return
    labels = np.asarray(module.action_labels())
    plot_tsne(mean[held_out], labels[held_out], Path(f"{path.with_suffix('')}-tsne.png"), name)
    some = held_out[np.linspace(0, len(held_out) - 1, 8).astype(int)]
    raw = observe(module, some, 8, args)
    titles = [f"{labels[i]} ({i})" for i in some]
    picture = Path(f"{path.with_suffix('')}-reconstructions.png")
    plot_reconstructions(model, raw, titles, picture)


def main() -> None:
    """Command line: train, print the probe scores, say where the table is."""
    args = tyro.cli(Args, description=__doc__)
    try:
        print(f"representations: {train(args)}")
    except (ValueError, FileNotFoundError) as e:
        raise SystemExit(f"error: {e}") from None


if __name__ == "__main__":
    main()
