"""Action representations: a hierarchical VAE over sets of action observations (appendix B, D.3.1).

An action is known only by observations of what it does: a set X = {x_1 .. x_n} of trajectories,
videos or pictures. One latent c explains the whole set, one latent z_j each observation: what all
observations share (the action) lands in c, what differs (start cell, camera angle) in z.

        c ~ N(0, I)  ->  z_j ~ p(z | c)  ->  x_j ~ p(x | z_j, c, first state of x_j)

    ELBO per observation = mean_j [ log p(x_j | z_j, c) - KL( q(z_j | x_j, c) || p(z_j | c) ) ]
                           - KL( q(c | X) || N(0, I) ) / |X|

The representation of an action is the mean of q(c | X). It is computed for every action, but the
networks are trained on training actions only: unseen actions are encoded without re-training.

    python hvae.py gridworld                       # the default table of the Grid World experiments
    python hvae.py gridworld --modality onehot     # B: one-hot states, cross-entropy
    python hvae.py gridworld --no-hierarchical     # B: the plain VAE baseline
    python hvae.py gridworld --train-on all        # C: the oracle encoder, has seen every action
    python hvae.py create --split full             # B, also --modality video; or: stacking
    python hvae.py gridworld --recipe paper        # Tables 3-4 to the letter: days on a CPU

Paper map: Convolutional Encoder -> ConvEncoder; Bi-LSTM Encoder -> TrajectoryEncoder; Action
Inference Network -> ActionInference; Observation Inference Network -> ObservationInference (and
Prior); Observation Decoder -> TrajectoryDecoder, ImageDecoder; Convolutional Decoder ->
ConvDecoder; Figures 4-6 -> plot_tsne; Tables 3-4 -> Args, TABLE_3, TABLE_4, RECIPES.

Shapes: A actions in a batch, n observations of each, B = A * n, L states per trajectory (the first
is given, T = L - 1 are predicted), F numbers per state, C = Z sizes of c and z, H hidden width,
S side of a picture.
"""

import colorsys
import csv
import ctypes
import hashlib
import importlib
import json
import os
import sys
import time
from collections.abc import Callable, Container
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from tqdm import tqdm

# Intel's MKL, which multiplies PyTorch's matrices, may add the parts of its threads up in the order
# in which they come. With this mode it always does in the same one, and is as fast; it is read at
# the first product (a value from outside wins).
os.environ.setdefault("MKL_CBWR", "AUTO")

ENVIRONMENTS = {  # name on the command line -> module
    "gridworld": "gridworld",
    "recsys": "recsys",
    "create": "create_env",
    "stacking": "stacking_env",
}
KINDS = {  # modality -> what it is to the networks (appendix B)
    "xy": "trajectory",
    "state": "trajectory",
    "onehot": "onehot",
    "video": "video",
    "image": "image",
}
CLASSES = 80  # B: "two 80-dimensional one-hot vectors" for the 80x80 grid
CONV_FEATURES = 32 * 3 * 3  # published code: channels * height * width after the last convolution
LOG_VAR_RANGE = (-4.0, 3.0)  # published code: clamp of the decoder's log-variance
BN_EPS, BN_MOMENTUM = 1e-3, 0.01  # published code: batch norm of latents
COARSE = 4  # ours: pixels a side of what the linear path sees of a video
NETWORK_SHARE = 0.1  # ours: of the networks in c when there is a linear path
GRADIENT_CLIP = 0.5  # published code: every entry of a gradient is cut to [-0.5, 0.5]
PERPLEXITY = 10  # published code: t-SNE
MARKS = "os^D"  # ours: t-SNE


# ---- Tables 3 and 4 ----


@dataclass
class Args:
    """Train an action encoder and write one representation per action.

    None stands for the value of the environment or the recipe."""

    env: Annotated[str, tyro.conf.Positional] = "gridworld"  # gridworld, create or stacking
    modality: str | None = None  # what is observed (B): xy, onehot | xy, state, video | image
    hierarchical: bool = True  # HVAE; --no-hierarchical: the plain VAE baseline (B)
    train_on: Literal["train", "all"] = "train"  # all actions of the split: the oracle encoder (C)
    split: str = "default"  # split of the actions: default, full, ...
    split_seed: int = 0  # seed of the split
    seed: int = 0  # seed of weights, batches and latent samples
    # paper: Tables 3-4; quick: a minute or two (Grid World's laptop table takes no longer anyway);
    # Grid World in minutes with D.3.1's encoder: lstm, with all moves at once: mlp
    recipe: Literal["laptop", "quick", "lstm", "mlp", "paper"] = "laptop"
    device: str = "auto"  # cpu, cuda, or auto
    runs_dir: str = "runs"  # results go to <runs_dir>/hvae
    representation_size: int | None = None  # Table 3: of c and of z: 16 grid, 128 others
    batch_size: int | None = None  # Table 3: actions per update: 128 grid, CREATE; 32 Stacking
    epochs: int | None = None  # Table 3: passes over the actions: 10,000; 5,000 Stacking
    updates: int | None = None  # number of updates, instead of epochs
    learning_rate: float | None = None  # Table 4: 0.001 (RAdam)
    observations: int | None = None  # Table 4: recorded of each action: 1,024
    batch_observations: int | None = None  # of each action in one update (paper: all)
    table_observations: int | None = None  # of each action for its representation (paper: all)
    set_size: int | None = None  # observations that share KL(q(c|X)); paper: those of an update
    q_hidden: int | None = None  # Table 4: width of q(c|X): 128
    hidden: int | None = None  # Table 4: default width: 64 (published code: pictures, video 128)
    encoder: Literal["lstm", "mlp"] | None = None  # of trajectories: D.3.1's, or beyond the paper
    linear_path: bool | None = None  # c is a linear map of the observations, and 0.1 of networks
    relative: bool | None = None  # states relative to the first one, instead of raw
    compact: bool | None = None  # Bi-LSTM with half the width per direction, concatenated
    log_var_lr: float | None = None  # free log-variances: multiple of the learning rate
    decoder_log_var: float | None = None  # the decoder's at the start; paper: from N(0, 1)
    # share of the updates in which the weight of the KLs climbs to 1
    kl_warmup: float | None = None
    workers: int = 0  # processes that record observations, 0: one per core; same result
    threads: int = 1  # CPU threads of torch; a second one waits more than it works
    plots: bool = True  # draw the t-SNE and reconstruction pictures


# The options that a recipe decides unless they are given.
OVERRIDES = [f.name for f in fields(Args) if f.default is None and f.name != "modality"]

TABLE_3 = {
    "gridworld": dict(representation_size=16, batch_size=128, epochs=10_000),
    "create": dict(representation_size=128, batch_size=128, epochs=10_000),
    "stacking": dict(representation_size=128, batch_size=32, epochs=5_000),
}
TABLE_4 = dict(learning_rate=1e-3, observations=1024, q_hidden=128, hidden=64)
VISUAL = dict(batch_size=32, epochs=5_000, hidden=128)  # published code, for CREATE video too

# How recipe `lstm` leaves the paper. Each line stands alone: what it is worth can be seen by
# switching it back on the command line (only decoder_log_var has no such word). Further down is
# what the other short recipes have otherwise.
RECIPES = {
    "paper": dict(  # 128 x 1,024 trajectories in one update take 11 GB of memory
        batch_observations=1024,
        table_observations=1024,
        encoder="lstm",
        relative=False,
        compact=False,
        log_var_lr=1.0,
        kl_warmup=0.0,
    ),
    "laptop": dict(
        encoder="lstm",
        # Raw cells run to 78: the networks would first have to learn to subtract the start to a
        # tenth of a cell before any skill shows. Differences show it from the first update.
        relative=True,
        # Observations of one skill differ in little but the start, so many small updates teach
        # more than few large ones; a single observation would leave nothing to pool over.
        batch_observations=4,
        # A representation is pooled over a set of 64 observations: enough to average out starts.
        table_observations=64,
        # Each update sees 4 of that set, and each bears 1/64 of KL(q(c|X)), as if X were all 64:
        # |X| of the ELBO above. Not quite the ELBO: c comes from the 4 alone, which it then has to
        # explain. At 1/4, c kept only 4 of its 16 dimensions in use.
        set_size=64,
        # A free log-variance moves by about lr per update: 10,000 updates from its start to -9.
        log_var_lr=10.0,
        # ... and starts where one move of one cell is already 2.7 sigma.
        decoder_log_var=-2.0,
        # Two halves of 32, concatenated, are also D.3.1's "64-dimensional encoded vector", with a
        # quarter of the weights of two averaged 64s.
        compact=True,
        kl_warmup=0.0,  # cells are few and sure: the Bi-LSTM needs no head start for z
        updates=2_750,
    ),
}
RECIPES["lstm"] = RECIPES["laptop"]  # to this the rows of SPECIAL do not apply: D.3.1's Bi-LSTM
# ours: an update with the MLP encoder takes two thirds of the time of one with the Bi-LSTM.
RECIPES["quick"] = RECIPES["laptop"] | dict(encoder="mlp", updates=1_500)  # own environments

CREATE = dict(
    # Balls meet a tool in many ways: more observations in an update say more about it.
    batch_observations=8,
    observations=128,
    table_observations=128,
    # Ours. These values were changed together, so what each is worth is not known. The set size is
    # Table 4's number. Before, KL(z) fell to about 1.5 and the error stopped near 6.5: z, and
    # with it how the ball was launched, was given up. Together they brought the error below 1.
    set_size=1024,
    kl_warmup=0.5,
    learning_rate=3e-3,
)

PICTURES = dict(  # what holds for CREATE's trajectories holds for them
    observations=64,
    batch_size=16,
    set_size=1024,
    kl_warmup=0.5,
    learning_rate=2e-3,
)

# Ours. In the time there is, networks learn where the ball no longer is, not where it goes, and
# need no c for that: a linear map of the averaged frames says more about a tool they have not seen.
# Table 4's rate: at that of the trajectories, 0.003, an earlier form of the map lost half of the
# classes while training (`nn_class`), since nothing needs it to stay what it was.
VIDEO = dict(batch_size=16, batch_observations=4, linear_path=True, learning_rate=1e-3)

# Ours. Where a skill ends is learned early; in which order it moves takes thousands of updates
# more, and the MLP encoder (beyond the paper), which has all moves before it at once, makes 1.4
# times as many in a second as the Bi-LSTM (benchmarks/throughput.py hvae). These values were
# changed together, so what each is worth is not known; recipe `lstm` is what there was before.
SKILLS = dict(encoder="mlp", set_size=1024, kl_warmup=0.5)
RECIPES["mlp"] = RECIPES["laptop"] | SKILLS | dict(updates=6_000)

ONE_HOT = dict(set_size=64, kl_warmup=0.0, linear_path=False)

SPECIAL = {  # recipe and environment or modality -> what else is different there
    # With the linear path, a thousand updates say more about a held-out skill than six thousand
    # without it. With 4,500 they say all there is, but skills that end in the same place drift
    # apart again (nn_net_match 0.77, then 0.41).
    "laptop gridworld": SKILLS | dict(updates=1_000, linear_path=True),
    "quick gridworld": SKILLS | dict(updates=1_000, linear_path=True),
    "laptop create": CREATE | dict(updates=2_500),
    "quick create": CREATE | dict(updates=1_500),
    # 160 zeros and ones per state say the same as 2 numbers, and are learned later.
    "laptop onehot": ONE_HOT | dict(updates=4_000, encoder="lstm"),
    "quick onehot": ONE_HOT | dict(updates=2_500, encoder="mlp"),
    # Pictures cost a hundred times as much as grid trajectories.
    "laptop image": PICTURES | dict(updates=1_500),
    "quick image": PICTURES | dict(updates=1_000),
    "laptop video": VIDEO | dict(observations=32, updates=600),
    "quick video": VIDEO | dict(observations=16, updates=200),
}


def load_environment(env: str) -> ModuleType:
    """The module of an environment by its command-line name; ValueError if there is none."""
    if env not in ENVIRONMENTS:
        raise ValueError(f"unknown environment {env!r}; allowed: {', '.join(ENVIRONMENTS)}")
    return importlib.import_module(ENVIRONMENTS[env])


def resolve(args: Args) -> Args:
    """A copy of `args` with every None filled in from the tables and the recipe.

    Raises ValueError for an unknown environment, modality or other choice, a number out of range,
    and an option without effect. Call it once, on what the user gave.
    """
    module = load_environment(args.env)
    if not module.MODALITIES:
        raise ValueError(f"{args.env} has no action observations, only engineered representations")
    modality = args.modality or module.MODALITIES[0]
    for name, value, allowed in (
        ("modality", modality, module.MODALITIES),
        ("recipe", args.recipe, RECIPES),
        ("train_on", args.train_on, ("train", "all")),
        ("encoder", args.encoder or "lstm", ("lstm", "mlp")),
    ):
        if value not in allowed:
            raise ValueError(
                f"unknown {name} {value!r} for {args.env}; allowed: {', '.join(allowed)}"
            )
    if modality not in KINDS:  # of an environment that is not ours
        raise ValueError(f"modality {modality!r} has no network here; known: {', '.join(KINDS)}")
    preset = TABLE_4 | TABLE_3.get(args.env, TABLE_3["gridworld"])
    preset |= VISUAL if KINDS[modality] in ("image", "video") else {}
    preset |= RECIPES[args.recipe]
    for special in (f"{args.recipe} {args.env}", f"{args.recipe} {modality}"):
        preset |= SPECIAL.get(special, {})
    if preset.get("linear_path") and not args.hierarchical:  # no c, no path to it
        preset |= dict(linear_path=False)
        if modality != "video":  # ... so learn longer
            longer = "quick" if args.recipe == "quick" else "mlp"
            preset |= dict(updates=RECIPES[longer]["updates"])
    if args.epochs and args.updates:
        raise ValueError("epochs and updates: give one of them")
    if args.epochs:
        preset.pop("updates", None)  # asked for in epochs: the recipe's number steps back
    given = {key: value for key, value in asdict(args).items() if value is not None}
    args = replace(args, **(preset | given | dict(modality=modality)))
    for name in ("batch_observations", "table_observations"):  # of few, a recipe takes all
        if name not in given:
            setattr(args, name, min(getattr(args, name), args.observations))
    check(args, given)
    return args


COUNTS = ("representation_size", "batch_size", "epochs", "updates", "observations", "threads")
COUNTS += ("batch_observations", "table_observations", "set_size", "q_hidden", "hidden")


def check(args: Args, given: Container[str]) -> None:
    """Refuse resolved settings that are out of range or, if the user gave them, without effect."""
    modality = args.modality
    for name in COUNTS:
        if (value := getattr(args, name)) is not None and value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    for name in ("seed", "split_seed", "workers"):
        if not 0 <= getattr(args, name) < 2**63:
            raise ValueError(f"{name} must be 0 or more, got {getattr(args, name)}")
    if not 0 <= args.kl_warmup <= 1:
        raise ValueError(f"kl_warmup must be between 0 and 1, got {args.kl_warmup}")
    for name in ("learning_rate", "log_var_lr"):
        if not 0 < getattr(args, name) < np.inf:
            raise ValueError(f"{name} must be a positive number, got {getattr(args, name)}")
    low, high = LOG_VAR_RANGE
    if args.decoder_log_var is not None and not low <= args.decoder_log_var <= high:
        raise ValueError(  # outside, the clamp lets no gradient through: it would stay there
            f"decoder_log_var must be between {low:g} and {high:g}, got {args.decoder_log_var}"
        )
    picture, flat = KINDS[modality] == "image", KINDS[modality] in ("image", "video")
    for name, unused in dict(
        q_hidden=not args.hierarchical,
        set_size=not args.hierarchical,
        decoder_log_var=KINDS[modality] == "onehot",
        encoder=picture,
        compact=picture or args.encoder == "mlp",
        relative=flat,
    ).items():  # an ablation that changes nothing would pass for a result
        if unused and name in given:
            model = f"{'HVAE' if args.hierarchical else 'plain VAE'}, encoder {args.encoder}"
            raise ValueError(f"{name} has no effect here: modality {modality}, {model}")
    if args.linear_path and not args.hierarchical:
        raise ValueError("linear_path: the plain VAE has no c that a path could lead to")
    lstm = args.encoder == "lstm" and KINDS[modality] != "image"
    if args.compact and lstm and args.hidden % 2:
        raise ValueError(f"hidden {args.hidden}: the Bi-LSTM has two halves, so it must be even")
    if args.linear_path and KINDS[modality] == "image":
        raise ValueError(
            f"linear_path: a linear map of the pixels of modality {modality!r} says "
            "nothing; allowed: trajectories, video"
        )
    if args.batch_observations > args.observations:
        raise ValueError(
            f"batch_observations {args.batch_observations} is more than the "
            f"{args.observations} observations of each action"
        )


# ---- observations as the networks see them (appendix B) ----

# The decoder's smallest sigma is exp(-4 / 2) = 0.135 units: a unit must be so small that what
# tells actions apart is several sigma. centre and half bring the first state to about [-1, 1].
UNITS = {
    # cells 1..78; one move = 7 sigma
    "gridworld": dict(centre=39.5, half=39.5, unit=1.0, y_down=True),
    # ours: 4 of 84 pixels, so that sigma can fall to half a pixel
    "create": dict(centre=0.0, half=1.0, unit=4 / 42),  # 42 pixels are 1
}


@dataclass(frozen=True)
class Format:
    """How raw observations become network inputs and reconstruction targets."""

    kind: str  # a value of KINDS
    length: int  # L: states or frames with the first one; 1 for a picture
    features: int  # F: numbers per state; S for pictures
    relative: bool = False
    centre: float = 0.0
    half: float = 1.0
    unit: float = 1.0
    y_down: bool = False  # only for `plot_reconstructions`

    @property
    def visual(self) -> bool:
        return self.kind in ("image", "video")

    @classmethod
    def of(cls, env: str, modality: str, shape: tuple[int, ...], relative: bool) -> "Format":
        """Format of observations of shape (..., S, S), (..., L, S, S) or (..., L, F)."""
        kind = KINDS[modality]
        if kind in ("image", "video"):
            return cls(kind, shape[-3] if kind == "video" else 1, shape[-1])
        features = shape[-1] * (CLASSES if kind == "onehot" else 1)
        return cls(kind, shape[-2], features, relative, **UNITS.get(env, {}))


def prepare(raw: torch.Tensor, fmt: Format) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Raw observations (B, ...) -> what the encoder reads, the first state, what to reconstruct.

    trajectory: (B, L, F), (B, F), (B, T, F);   one-hot: (B, L, F), (B, F), (B, T, 2) class numbers;
    video: (B, L, 1, S, S), (B, 1, S, S), (B, T, 1, S, S);   picture: three times (B, 1, 1, S, S).
    """
    raw = raw.float()
    if fmt.visual:
        frames = raw.unsqueeze(-3) / 255 - 0.5  # published code: greys to [-0.5, 0.5]
        if fmt.kind == "video":
            return frames, frames[:, 0], frames[:, 1:]
        return frames[:, None], frames[:, None], frames[:, None]
    first, later = raw[:, :1], raw[:, 1:]
    if fmt.kind == "onehot":
        seen, target = raw, later
        if fmt.relative:  # class 40 is "no change", 41 one cell to the right or down
            seen = torch.cat([first, raw.diff(dim=1) + CLASSES // 2], 1)
            target = later - first + CLASSES // 2
        inputs = F.one_hot(seen.long(), CLASSES).flatten(2).float()  # (B, L, 160)
        return inputs, inputs[:, 0], target.long()
    if not fmt.relative:
        return raw, first[:, 0], later
    start = (first - fmt.centre) / fmt.half  # (B, 1, F)
    steps = raw.diff(dim=1) / fmt.unit  # (B, T, F): read as moves, predicted as places
    return torch.cat([start, steps], 1), start[:, 0], (later - first) / fmt.unit


def undo(output: np.ndarray, first: np.ndarray, fmt: Format) -> np.ndarray:
    """Output of a decoder (B, T, ...) -> raw units; first: raw first states (B, F)."""
    if fmt.visual:
        return (output[:, :, 0] + 0.5) * 255  # (B, T, S, S)
    if fmt.kind == "onehot":
        cells = output.argmax(-1).astype(float)  # (B, T, 2)
        return cells + first[:, None] - CLASSES // 2 if fmt.relative else cells
    return first[:, None] + output * fmt.unit if fmt.relative else output


# ---- building blocks ----


class Residual(nn.Module):
    """`layers` linear layers with ReLU between them, then ReLU(out + input).

    appendix: "MLP"; published code: such residual blocks, with the appendix's numbers of layers but
    for one (ActionInference); we do as the code.
    """

    def __init__(self, width: int, layers: int):
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        out = self.linears[0](x)
        for linear in self.linears[1:]:
            out = linear(F.relu(out))
        return F.relu(out + x)


class SumReLU(nn.Module):
    """D.3.1: several vectors "passed through linear layers, summed", then ReLU."""

    def __init__(self, inputs: tuple[int, ...], width: int):
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(size, width) for size in inputs)

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        return F.relu(sum(linear(x) for linear, x in zip(self.linears, inputs, strict=True)))


class GlobalBatchNorm(nn.Module):
    """The "1D batch-norm" of D.3.1: one mean, variance, gain and bias over batch *and* dimensions.

    It fixes the overall scale of the latents and keeps the proportions of their dimensions, where
    a batch norm per dimension would blow up those that carry nothing.
    """

    def __init__(self):
        super().__init__()
        self.norm = nn.BatchNorm1d(1, eps=BN_EPS, momentum=BN_MOMENTUM)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.norm(x.reshape(-1, 1)).reshape(x.shape)


def free_log_var(*shape: int) -> nn.Parameter:
    """A learned log-variance that no network computes, from N(0, 1).

    appendix: networks output the log-variances of q(z|x,c), p(z|c) and the decoder; published code:
    learned constants, only that of q(c|X) is an output; we do as the code, which made the results.
    """
    return nn.Parameter(torch.randn(shape))


def initialise(module: nn.Module) -> None:
    """Linear layers: Xavier-normal with gain sqrt(2), bias 0 (published code)."""
    if isinstance(module, nn.Linear):
        nn.init.xavier_normal_(module.weight, gain=2**0.5)
        nn.init.zeros_(module.bias)


# ---- D.3.1 Convolutional Encoder ----


class ConvEncoder(nn.Module):
    """Pictures (B, 1, S, S) -> (B, 288): 7 layers for S = 48, 9 layers for S = 84.

    A layer is a 3x3 convolution, batch norm and ReLU; every other one halves the picture:
    48 -> 24 -> 12 -> 6 -> 3, or 84 -> 42 -> 21 -> 11 -> 6 -> 3.
    """

    CHANNELS = {48: (8, 8, 16, 16, 16, 16, 32), 84: (8, 8, 16, 16, 16, 16, 32, 32, 32)}

    def __init__(self, size: int):
        super().__init__()
        if size not in self.CHANNELS:
            raise ValueError(f"pictures must be 48 or 84 pixels wide, got {size}")
        layers, before = [], 1
        for i, after in enumerate(self.CHANNELS[size]):
            layers.append(nn.Conv2d(before, after, 3, stride=2 - i % 2, padding=1))
            layers += [nn.BatchNorm2d(after), nn.ReLU()]
            before = after
        # The channels of a pixel side by side in memory: 8 or 16 numbers are one vector register.
        self.layers = nn.Sequential(*layers).to(memory_format=torch.channels_last)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x).flatten(1)  # (B, 32, 3, 3) -> (B, 288)


# ---- D.3.1 Bi-LSTM Encoder ----


class TrajectoryEncoder(nn.Module):
    """Sequences (B, L, F) -> (B, H): a 2-layer Bi-LSTM, averaged over time.

    appendix: to a 64-dimensional vector; published code: 64 per direction, directions averaged; we
    do as the code, or with `compact` 32 per direction, concatenated (see RECIPES).
    """

    def __init__(self, features: int, hidden: int, compact: bool):
        super().__init__()
        self.compact, width = compact, hidden // 2 if compact else hidden
        self.lstm = nn.LSTM(features, width, num_layers=2, bidirectional=True, batch_first=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        h = self.lstm(x)[0].mean(1)  # (B, 2 * width): forward half, backward half
        return h if self.compact else h.unflatten(1, (2, -1)).mean(1)  # (B, H)


class ObservationEncoder(nn.Module):
    """Inputs of `prepare` -> (B, H), by the encoders that suit the modality."""

    def __init__(self, fmt: Format, args: Args):
        super().__init__()
        features, hidden = CONV_FEATURES if fmt.visual else fmt.features, args.hidden
        self.conv = ConvEncoder(fmt.features) if fmt.visual else None
        if fmt.kind == "image":
            # appendix: Bi-LSTM for trajectories only; published code: pictures pass it as sequences
            # of length 1; we do as the appendix.
            self.sequence = nn.Sequential(nn.Flatten(), nn.Linear(features, hidden), nn.ReLU())
        elif args.encoder == "lstm":
            self.sequence = TrajectoryEncoder(features, hidden, args.compact)
        else:  # ours, beyond the paper: all numbers of the trajectory at once
            first = nn.Linear(fmt.length * features, 2 * hidden)
            last = nn.Linear(2 * hidden, hidden)
            middle = nn.Sequential(nn.ReLU(), Residual(2 * hidden, 2))
            self.sequence = nn.Sequential(nn.Flatten(), first, middle, last, nn.ReLU())
        # For the linear path of ActionInference, the numbers themselves ride along at the end; of a
        # video its frames in pieces of 4 x 4 pixels: 12 x 12 numbers each.
        self.is_video = fmt.kind == "video"
        each = (fmt.features // COARSE) ** 2 if self.is_video else features
        self.numbers = fmt.length * each if args.linear_path else 0
        self.size = hidden + self.numbers  # H

    def frames(self, x: torch.Tensor) -> torch.Tensor:
        """Pictures (B, L, 1, S, S) -> their features (B, L, 288); states stay as they are."""
        return x if self.conv is None else self.conv(x.flatten(0, 1)).unflatten(0, x.shape[:2])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.summary(x, self.frames(x))

    def summary(self, x: torch.Tensor, frames: torch.Tensor) -> torch.Tensor:
        h = self.sequence(frames)
        if not self.numbers:
            return h  # (B, H)
        if self.is_video:  # (B, L, 1, S, S) -> (B * L, 1, S, S) -> (B, L, 1, S / 4, S / 4)
            dark = 0.5 - x.flatten(0, 1)  # white paper is 0, or it would drown what is drawn on it
            x = F.avg_pool2d(dark, COARSE).unflatten(0, x.shape[:2])
        return torch.cat([h, x.flatten(1)], 1)  # (B, H)


# ---- D.3.1 Action Inference Network ----


class ActionInference(nn.Module):
    """q(c | X): encoded observations (A, n, H) -> mean and log-variance of c, each (A, C).

    With a linear path (ours), the mean of c is a linear map of the averaged observations plus 0.1
    of what the networks say. Networks are free to give every training skill a place of its own, and
    what they do between those places is anyone's guess; a linear map that tells the training
    skills' moves apart has no choice but to do the same with skills it has not seen. The 0.1 also
    is the networks' share in the log-variance, which stays close to one value for all of it.
    """

    def __init__(self, hidden: int, width: int, size: int, numbers: int = 0):
        super().__init__()
        self.numbers = numbers  # the last columns of H: the observations as they are
        self.linear = nn.Linear(numbers, size) if numbers else None
        self.before = nn.Sequential(  # 4 linear layers, on each observation
            nn.Linear(hidden, width), nn.ReLU(), Residual(width, 2), nn.Linear(width, width)
        )
        # appendix: 3 layers; published code: 4 (a block of 3 and the output); we do as the code.
        self.after = nn.Sequential(Residual(width, 3), nn.Linear(width, 2 * size))
        self.norm = GlobalBatchNorm()  # published code: over mean and log-variance together

    def forward(self, h: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        pooled = self.before(h).mean(1)  # (A, n, width) -> (A, width), whatever the order and n
        out = self.after(pooled)  # (A, 2C)
        if self.linear is not None:
            straight = self.linear(h[..., -self.numbers :].mean(1))  # (A, n, numbers) -> (A, C)
            out = NETWORK_SHARE * out + F.pad(straight, (0, straight.shape[1]))  # mean half only
        return self.norm(out).chunk(2, -1)


# ---- D.3.1 Observation Inference Network, and the prior it is held against ----


class ObservationInference(nn.Module):
    """q(z | x, c): encoded observation (B, H) and c (B, C) -> mean and log-variance of z, (B, Z).

    The plain VAE's q(z | x) is the same network without c.
    """

    def __init__(self, inputs: tuple[int, ...], hidden: int, size: int):
        super().__init__()
        self.sum = SumReLU(inputs, hidden)
        self.layers = nn.Sequential(
            Residual(hidden, 2), Residual(hidden, 2), nn.Linear(hidden, size), GlobalBatchNorm()
        )
        self.log_var = free_log_var(size)

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.layers(self.sum(*inputs))
        return mean, self.log_var.expand_as(mean)


class Prior(ObservationInference):
    """p(z | c): the same network fed with c (B, C) alone; what an unseen one may be like."""


# ---- D.3.1 Observation Decoder ----


class TrajectoryDecoder(nn.Module):
    """The first state (B, F) and latents -> means, or logits, of the T later states (B, T, F)."""

    def __init__(self, latents: tuple[int, ...], features: int, hidden: int, steps: int):
        super().__init__()
        self.steps = steps
        self.sum = SumReLU(latents, hidden)
        self.start = nn.Sequential(nn.Linear(features, hidden), Residual(hidden, 2))
        self.lstm = nn.LSTM(hidden, hidden, batch_first=True)
        self.output = nn.Sequential(Residual(hidden, 2), nn.Linear(hidden, features))

    def forward(self, start: torch.Tensor, *latents: torch.Tensor) -> torch.Tensor:
        # The product lets the start gate the effect: beside a wall, a move does nothing.
        combined = self.sum(*latents) * self.start(start)  # (B, H)
        # appendix: this vector drives the LSTM; published code: each predicted state is embedded
        # and fed back in place of the start; we do as the appendix, which also learns sooner.
        steps = combined[:, None].expand(-1, self.steps, -1)  # (B, T, H)
        return self.output(self.lstm(steps)[0])  # (B, T, F)


class ImageDecoder(nn.Module):
    """Latents -> convolutional features of a picture (B, 1, 288); there is no first state."""

    def __init__(self, latents: tuple[int, ...], features: int, hidden: int):
        super().__init__()
        self.sum = SumReLU(latents, hidden)
        self.output = nn.Sequential(Residual(hidden, 2), nn.Linear(hidden, features))

    def forward(self, start: torch.Tensor, *latents: torch.Tensor) -> torch.Tensor:
        return self.output(self.sum(*latents))[:, None]


# ---- D.3.1 Convolutional Decoder ----


class ConvDecoder(nn.Module):
    """Features (B, 288) -> picture in [-0.5, 0.5] and, if wanted, mask in [0, 1]: (B, 1, S, S).

    Pairs of a 3x3 and a transposed convolution that doubles the picture, each with batch norm and
    ReLU: 3 -> 6 -> 12 -> 24 -> 48, or 3 -> 6 -> 11 -> 21 -> 42 -> 84; then one 1x1 convolution.
    """

    STAGES = {  # channels, kernel and padding of the transposed convolutions (published code)
        48: ((32, 2, 0), (32, 2, 0), (16, 2, 0), (16, 2, 0)),
        84: ((32, 2, 0), (32, 3, 1), (16, 3, 1), (16, 2, 0), (16, 2, 0)),
    }

    def __init__(self, size: int, mask: bool):
        super().__init__()
        layers, width = [], 32
        for after, kernel, padding in self.STAGES[size]:
            layers += [nn.Conv2d(width, width, 3, padding=1), nn.BatchNorm2d(width), nn.ReLU()]
            layers.append(nn.ConvTranspose2d(width, after, kernel, stride=2, padding=padding))
            layers += [nn.BatchNorm2d(after), nn.ReLU()]
            width = after
        layers += [nn.Conv2d(width, 1 + mask, 1), nn.Sigmoid()]
        if mask:  # ours: a picture starts white, as most of a video is. If it starts grey, opening
            # the mask makes everything worse, so it shuts before anything is learned behind it.
            nn.init.constant_(layers[-2].bias[:1], 3.0)
        self.layers = nn.Sequential(*layers).to(memory_format=torch.channels_last)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        small = features.unflatten(1, (32, 3, 3))  # (B, 288) -> (B, 32, 3, 3)
        out = self.layers(small.contiguous(memory_format=torch.channels_last))  # (B, 1 or 2, S, S)
        return out[:, :1] - 0.5, out[:, 1:]


# ---- the objective ----


def gaussian_log_prob(x: torch.Tensor, mean: torch.Tensor, log_var: torch.Tensor) -> torch.Tensor:
    """log N(x; mean, exp(log_var)), element by element."""
    return -0.5 * (np.log(2 * np.pi) + log_var + (x - mean) ** 2 * torch.exp(-log_var))


def gaussian_kl(q: tuple, p: tuple) -> torch.Tensor:
    """KL(q || p) of diagonal Gaussians (mean, log_var), summed over the last axis."""
    (mean, log_var), (mean_p, log_var_p) = q, p
    ratio = (log_var.exp() + (mean - mean_p) ** 2) * torch.exp(-log_var_p)
    return 0.5 * (log_var_p - log_var - 1 + ratio).sum(-1)


def standard_kl(mean: torch.Tensor, log_var: torch.Tensor) -> torch.Tensor:
    """KL(N(mean, exp(log_var)) || N(0, I)), summed over the last axis."""
    return 0.5 * (mean**2 + log_var.exp() - 1 - log_var).sum(-1)


def sample(mean: torch.Tensor, log_var: torch.Tensor) -> torch.Tensor:
    """A draw from N(mean, exp(log_var)) that lets gradients through to both."""
    return mean + torch.randn_like(mean) * torch.exp(0.5 * log_var)


# ---- the two models ----


class ObservationModel(nn.Module):
    """What HVAE and VAE share: the encoder, the decoder and the likelihood of an observation."""

    def __init__(self, fmt: Format, args: Args, latents: tuple[int, ...]):
        super().__init__()
        self.format, self.set_size = fmt, args.set_size or args.batch_observations
        self.encoder = ObservationEncoder(fmt, args)
        features = CONV_FEATURES if fmt.visual else fmt.features
        if fmt.kind == "image":
            self.decoder = ImageDecoder(latents, features, args.hidden)
        else:
            self.decoder = TrajectoryDecoder(latents, features, args.hidden, fmt.length - 1)
        if fmt.visual:
            self.conv_decoder = ConvDecoder(fmt.features, mask=fmt.kind == "video")
            # Few channels, many pixels: with the channels of a pixel side by side in memory
            # (B, S, S, channels), a CPU needs 0.6 of the time, for the same numbers.
            self.to(memory_format=torch.channels_last)
        if fmt.kind != "onehot":  # one number per feature or pixel, for all steps and actions
            self.log_var = free_log_var(
                *([1, fmt.features, fmt.features] if fmt.visual else [features])
            )
            if args.decoder_log_var is not None:
                nn.init.constant_(self.log_var, args.decoder_log_var)

    def forward(self, raw: torch.Tensor) -> dict[str, torch.Tensor]:
        """Raw observations (A, n, ...) -> means per observation: {"loss", "rec", "kl_z", "kl_c",
        "error"}; error is the squared error, or the share of wrong classes."""
        inputs, start, target = prepare(raw.flatten(0, 1), self.format)  # (B, ...)
        frames = self.encoder.frames(inputs)
        latents, kl_z, kl_c = self.infer(self.encoder.summary(inputs, frames), raw.shape[1], sample)
        output = self.decode(start, *latents, first=frames[:, 0])
        rec = self.log_likelihood(target, output).mean()
        # One c serves the whole set, so each of its observations bears a part of the price of c.
        kl_z, kl_c = kl_z.mean(), kl_c.mean() / self.set_size
        if self.format.kind == "onehot":
            error = (output.detach().argmax(-1) != target).float().mean()
        else:
            error = F.mse_loss(output.detach(), target)
        # published code: rec * w and KL / w with w = 1 + 0.5^epoch: no effect after a few epochs.
        return dict(loss=kl_z + kl_c - rec, rec=rec, kl_z=kl_z, kl_c=kl_c, error=error)

    def log_likelihood(self, target: torch.Tensor, output: torch.Tensor) -> torch.Tensor:
        """log p(x | latents), summed over states and features: (B,)."""
        if self.format.kind == "onehot":
            log_prob = output.log_softmax(-1).gather(-1, target[..., None])  # (B, T, 2, 1)
        else:
            log_prob = gaussian_log_prob(target, output, self.log_var.clamp(*LOG_VAR_RANGE))
        return log_prob.flatten(1).sum(1)

    def decode(self, start, *latents, first=None) -> torch.Tensor:
        """Latents and first states -> means in the shape of targets, or logits (B, T, 2, 80)."""
        if self.format.kind == "video":  # the first frame enters as its convolutional features
            first = self.encoder.conv(start) if first is None else first  # (B, 288)
            features = self.decoder(first, *latents)  # (B, T, 288)
        else:
            features = self.decoder(start, *latents)  # (B, T, F), or (B, 1, 288) for a picture
        if self.format.kind == "trajectory":
            return features
        if self.format.kind == "onehot":
            return features.unflatten(-1, (-1, CLASSES))
        picture, mask = self.conv_decoder(features.flatten(0, 1))  # (B * T, 1, S, S)
        picture = picture.unflatten(0, features.shape[:2])  # (B, T, 1, S, S)
        if self.format.kind == "image":
            return picture
        # Temporal skip connection: where the mask is shut, the first frame shows through.
        # appendix: mask * picture + frame; published code: mask * picture + (1 - mask) * frame; we
        # do as the code, since the plain sum leaves the range of a pixel.
        mask = mask.unflatten(0, features.shape[:2])
        return mask * picture + (1 - mask) * start[:, None]

    def reconstruct(self, raw: torch.Tensor) -> torch.Tensor:
        """Raw observations (A, n, ...) -> `decode` of the means of the latents, (A, n, T, ...)."""
        inputs, start, _ = prepare(raw.flatten(0, 1), self.format)
        latents = self.infer(self.encoder(inputs), raw.shape[1], lambda mean, log_var: mean)[0]
        return self.decode(start, *latents).unflatten(0, raw.shape[:2])


class HVAE(ObservationModel):
    """The hierarchical model: c for the action, z for the observation, x decoded from both."""

    def __init__(self, fmt: Format, args: Args):
        size, hidden = args.representation_size, args.hidden
        super().__init__(fmt, args, latents=(size, size))
        self.q_c = ActionInference(self.encoder.size, args.q_hidden, size, self.encoder.numbers)
        self.q_z = ObservationInference((self.encoder.size, size), hidden, size)
        self.p_z = Prior((size,), hidden, size)
        self.apply(initialise)

    def infer(self, h: torch.Tensor, n: int, draw: Callable) -> tuple:
        """Encoded observations (B, H) -> latents (z, c), KL of z (B,), KL of c (A,)."""
        q_c = self.q_c(h.unflatten(0, (-1, n)))  # (A, n, H) -> mean, log_var (A, C)
        c = draw(*q_c).repeat_interleave(n, 0)  # one draw per set: (B, C)
        q_z = self.q_z(h, c)
        return (draw(*q_z), c), gaussian_kl(q_z, self.p_z(c)), standard_kl(*q_c)

    def represent(self, raw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean (the representation) and log-variance of q(c | X) for raw (A, n, ...): (A, C)."""
        h = self.encoder(prepare(raw.flatten(0, 1), self.format)[0])
        return self.q_c(h.unflatten(0, raw.shape[:2]))


class VAE(ObservationModel):
    """The non-hierarchical baseline (appendix B): each observation for itself, averaged at the end.

    published code: a quarter of the HVAE's updates and another initialisation; we give both models
    the same batches, updates and initialisation, so that only the hierarchy differs. (Where the
    HVAE's recipe in Grid World has a linear path, which the VAE cannot have, that gets more
    updates: `resolve`.)
    """

    def __init__(self, fmt: Format, args: Args):
        size, hidden = args.representation_size, args.hidden
        super().__init__(fmt, args, latents=(size,))
        self.q_z = ObservationInference((hidden,), hidden, size)
        self.apply(initialise)

    def infer(self, h: torch.Tensor, n: int, draw: Callable) -> tuple:
        """Encoded observations (B, H) -> latents (z,), KL of z (B,), and no KL of c."""
        q_z = self.q_z(h)
        return (draw(*q_z),), standard_kl(*q_z), torch.zeros(1, device=h.device)

    def represent(self, raw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log-variance, over the observations of an action, of the means of q(z | x)."""
        z = self.q_z(self.encoder(prepare(raw.flatten(0, 1), self.format)[0]))[0]
        z = z.unflatten(0, raw.shape[:2])  # (A, n, Z)
        return z.mean(1), z.var(1, correction=0).clamp_min(1e-8).log()


# ---- training ----


def keep_memory() -> None:
    """Have the C library keep the memory of freed arrays for the next ones (glibc; else nothing).

    By default, what lies in a large array goes back to the system as soon as the array is freed,
    and the next one gets new pages, which the system clears one by one. An update on pictures makes
    dozens of arrays of 30 MB. What that costs depends on the machine and its load
    (benchmarks/throughput.py hvae: the plain form hands memory back).
    """
    M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, most = -1, -3, 2**31 - 1  # malloc.h; the largest C int
    with suppress(AttributeError, OSError, TypeError):  # another system's library has no mallopt
        libc = ctypes.CDLL(None)
        libc.mallopt(M_TRIM_THRESHOLD, most)
        # Older versions take no more than 32 MB.
        libc.mallopt(M_MMAP_THRESHOLD, most) or libc.mallopt(M_MMAP_THRESHOLD, 2**25)


def observe(module: ModuleType, ids: np.ndarray, n: int, args: Args) -> np.ndarray:
    """Raw observations (len(ids), n, ...). Always seed 0: encoders differ by seed, not by data."""
    workers = args.workers or os.cpu_count() or 1
    return module.action_observations(ids, n, args.modality, 0, workers)


def pick(rng: np.random.Generator, stored: int, actions: int, n: int) -> np.ndarray:
    """n different positions below `stored` for each action: (actions, n).

    An arithmetic progression with random start and step: distinct without shuffling `stored` keys.
    Observations are i.i.d., so any choice of positions that ignores them is a fair sample.
    """
    first = rng.integers(stored, size=(actions, 1))
    step = rng.integers(1, stored // n + 1, size=(actions, 1))
    return (first + step * np.arange(n)) % stored


def fit(model: ObservationModel, data: np.ndarray, args: Args) -> list[dict]:
    """Maximise the objective on raw observations of the training actions: (actions, stored, ...).

    Returns one row of mean losses per 100 updates. Raises ValueError if the loss becomes infinite.
    """
    device = next(model.parameters()).device
    free = [p for name, p in model.named_parameters() if name.endswith("log_var")]
    rest = [p for name, p in model.named_parameters() if not name.endswith("log_var")]
    groups = [dict(params=rest), dict(params=free, lr=args.learning_rate * args.log_var_lr)]
    optimiser = torch.optim.RAdam(groups, lr=args.learning_rate, foreach=True)  # D.1
    batch = min(args.batch_size, len(data))
    per_epoch = len(data) // batch  # an incomplete last batch is left out
    updates = args.updates or args.epochs * per_epoch
    rng, start, rows, totals = np.random.default_rng(args.seed), time.perf_counter(), [], {}
    data = torch.from_numpy(data)
    model.train()
    often = 0.5 if sys.stderr.isatty() else 30  # seconds; in a log every look is one more line
    for update in (bar := tqdm(range(updates), "training", unit="update", mininterval=often)):
        if update % per_epoch == 0:
            order = rng.permutation(len(data))
        ids = order[update % per_epoch * batch :][:batch, None]  # (A, 1)
        raw = data[ids, pick(rng, data.shape[1], batch, args.batch_observations)]  # (A, n, ...)
        parts = model(raw.to(device))
        # All of the objective counts once the warm-up is over; the log always shows all of it.
        waived = max(0.0, 1 - (update + 1) / (args.kl_warmup * updates + 1))
        loss = parts["loss"] - waived * (parts["kl_z"] + parts["kl_c"])
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_value_(model.parameters(), GRADIENT_CLIP)
        optimiser.step()
        totals = {key: totals.get(key, 0.0) + value.detach() for key, value in parts.items()}
        if (update + 1) % 100 == 0 or update + 1 == updates:
            means = {key: float(value) / (update % 100 + 1) for key, value in totals.items()}
            if not np.isfinite(means["loss"]):
                raise ValueError(f"the loss is {means['loss']} at update {update + 1}")
            seconds = round(time.perf_counter() - start, 2)
            rows.append(dict(update=update + 1, seconds=seconds) | means)
            words = dict(loss=f"{means['loss']:.2f}", error=f"{means['error']:.3g}")
            bar.set_postfix(words, refresh=False)
            totals = {}
    return rows


@torch.no_grad()
def embed(
    model: ObservationModel, module: ModuleType, ids: np.ndarray, args: Args
) -> tuple[np.ndarray, np.ndarray]:
    """Representations of the actions `ids`, seen or not: mean and log-variance, (NUM_ACTIONS, C).

    Rows of other actions (CREATE has tools outside of every split) hold the prior, N(0, I).
    """
    device = next(model.parameters()).device
    model.eval()  # running statistics: a representation does not depend on its neighbours
    tables = np.zeros((2, module.NUM_ACTIONS, args.representation_size), np.float32)
    chunk = len(ids)
    if model.format.visual:  # pictures of all actions would not fit in memory
        chunk = min(128, max(1, 40_000 // args.table_observations))
    for some in np.array_split(ids, -(-len(ids) // chunk)):
        raw = observe(module, some, args.table_observations, args)
        parts = min(len(some), -(-raw.size // 4_000_000))
        for part in np.array_split(np.arange(len(some)), parts):
            table = model.represent(torch.from_numpy(raw[part]).to(device))
            tables[:, some[part]] = torch.stack(table).cpu().numpy()
    return tables[0], tables[1]


def train(args: Args) -> Path:
    """Train an encoder, write its table to `representation_path(args)` and return that path.

    Beside the .npz: .pt (weights), .csv (losses), .json and -probe.csv (what it tells about
    held-out actions), -tsne.png and -reconstructions.png. The .npz comes last: where it
    exists, the run was finished.
    Raises ValueError for a choice that the environment does not have.
    """
    path, args, module = representation_path(args), resolve(args), load_environment(args.env)
    split = module.split_actions(args.split, args.split_seed)
    pool = np.unique(np.concatenate(list(split.values())))
    ids = pool if args.train_on == "all" else split["train"]
    cuda = torch.cuda.is_available()
    device = ("cuda" if cuda else "cpu") if args.device == "auto" else args.device
    try:
        if device != "cpu" and not (cuda and device.startswith("cuda")):
            raise RuntimeError
        torch.empty(0, device=device)  # cuda:7 where there is no eighth
    except (RuntimeError, AssertionError):
        raise ValueError(
            f"device {device!r} is not available; allowed: auto, cpu, cuda (with a GPU)"
        ) from None
    try:  # now, not after the training: can files with the longest of the names be written?
        path.parent.mkdir(parents=True, exist_ok=True)
        longest = path.with_name(f".{os.getpid()}-{path.stem}-reconstructions.png")
        longest.touch()
        longest.unlink()
    except OSError as e:
        raise ValueError(f"cannot write to {path.parent}: {e.strerror}") from None
    threads = torch.get_num_threads()
    torch.set_num_threads(args.threads)
    keep_memory()
    try:
        gpus = [] if device == "cpu" else [torch.device(device).index or 0]
        with torch.random.fork_rng(gpus):  # the caller's random numbers stay as they are
            torch.manual_seed(args.seed)
            data = observe(module, ids, args.observations, args)  # training actions only
            fmt = Format.of(args.env, args.modality, data.shape, args.relative)
            model = (HVAE if args.hierarchical else VAE)(fmt, args).to(device)
            rows = fit(model, data, args)
        save_training(model, rows, path)  # now: what embed reads may be too much for the machine
        mean, log_var = embed(model, module, pool, args)
    finally:
        torch.set_num_threads(threads)
    report(model, module, mean, path, args)
    return save_representation(path, args.env, mean, log_var, ids, settings(args))


def save_training(model: ObservationModel, rows: list[dict], path: Path) -> None:
    """Write the losses (.csv) and the weights (.pt) beside where the table will be."""
    write_atomically(path.with_suffix(".csv"), lambda file: write_csv(file, rows))
    weights = {name: value.cpu() for name, value in model.state_dict().items()}

    def save(temporary: Path) -> None:
        with open(temporary, "wb") as file:  # an open file: torch.save would note a path's name
            torch.save(weights, file)

    write_atomically(path.with_suffix(".pt"), save)


def settings(args: Args) -> dict:
    """What of `args` is written into the table: all that decides its content.

    But for the device: a GPU draws other random numbers, and so makes another table as good.
    """
    omit = ("env", "runs_dir", "plots", "workers", "device")
    return {key: value for key, value in asdict(args).items() if key not in omit}


# ---- the file of representations ----


def fingerprint(module: ModuleType) -> str:
    """Hash of an environment's action set: number, labels and engineered representations."""
    digest = hashlib.sha256(str(module.NUM_ACTIONS).encode())
    digest.update("\n".join(str(label) for label in module.action_labels()).encode())
    # In thousandths: the last bits of a sine may differ from machine to machine.
    numbers = np.round(np.asarray(module.engineered_representations(), np.float64) * 1000)
    digest.update(numbers.astype("<i8").tobytes())
    return digest.hexdigest()[:16]


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call write(temporary file in the same folder), then rename: nobody ever reads half a file."""
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
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def representation_path(args: Args) -> Path:
    """Where `train(args)` writes its table:

    <runs_dir>/hvae/<env>-<modality>-<hvae|vae>[-all]-<split>-<recipe>-s<seed>.npz; a split seed
    other than 0 follows the split, and what differs from the recipe follows the recipe, as in
    laptop-updates=9: a policy that asks for a recipe's table never finds an experiment's.
    """
    full = resolve(args)
    choices = {k: v for k, v in settings(args).items() if v is not None and k in OVERRIDES}
    recipe = settings(resolve(replace(args, **dict.fromkeys(OVERRIDES))))
    # Epochs count only where there is no number of updates: named then, even if they are Table 3's.
    counts = {"epochs"} if full.updates is None and recipe["updates"] is not None else set()
    changed = [
        f"{k}={v}" for k, v in choices.items() if getattr(full, k) != recipe[k] or k in counts
    ]
    parts = [args.env, full.modality, "hvae" if args.hierarchical else "vae"]
    parts += ["all"] * (args.train_on == "all")
    parts += [f"{args.split}{args.split_seed or ''}", args.recipe, *changed, f"s{args.seed}"]
    return Path(args.runs_dir) / "hvae" / ("-".join(parts) + ".npz")


def check_table(table: dict[str, np.ndarray], num_actions: int, name: str) -> None:
    """Raise ValueError unless the arrays are a table for `num_actions` actions."""
    mean, log_var, ids = table["mean"], table["log_var"], table["action_ids"]
    if mean.ndim != 2 or len(mean) != num_actions or mean.shape[1] < 1:
        raise ValueError(f"{name}: mean must have shape ({num_actions}, D), got {mean.shape}")
    if log_var.shape != mean.shape:
        raise ValueError(f"{name}: log_var must have shape {mean.shape}, got {log_var.shape}")
    for key in ("mean", "log_var"):
        if table[key].dtype.kind != "f" or not np.isfinite(table[key]).all():
            raise ValueError(f"{name}: {key} must be finite floating-point numbers")
    if ids.ndim != 1 or ids.dtype.kind not in "iu" or len(set(ids.tolist())) < len(ids):
        raise ValueError(f"{name}: action_ids must be a row of distinct integers")
    if len(ids) and not (0 <= ids.min() and ids.max() < num_actions):
        raise ValueError(f"{name}: action_ids must lie in 0..{num_actions - 1}")


def save_representation(
    path: str | Path,
    env: str,
    mean: np.ndarray,
    log_var: np.ndarray,
    action_ids: np.ndarray,
    config: dict | None = None,
) -> Path:
    """Write a table that `load_representation` accepts, whoever made it.

    Args:
        path: name of the .npz file.
        env: a key of ENVIRONMENTS.
        mean: (NUM_ACTIONS, D), row i is what the policy is told about action i.
        log_var: (NUM_ACTIONS, D), log-variance of that.
        action_ids: the actions that the encoder was trained on.
        config: whatever JSON can hold; "split" and "split_seed", where given, are checked at
            loading. The environment and the fingerprint of its action set are added.

    Raises ValueError for an unknown environment, wrong shapes, or numbers that are not finite.
    """
    module, path = load_environment(env), Path(path)
    table = dict(mean=np.asarray(mean, np.float32), log_var=np.asarray(log_var, np.float32))
    table["action_ids"] = np.asarray(action_ids)
    if not table["action_ids"].size or table["action_ids"].dtype.kind in "iu":  # 1.7 is no id
        table["action_ids"] = table["action_ids"].astype(np.int64)
    check_table(table, module.NUM_ACTIONS, str(path))
    config = dict(config or {}, environment=env, fingerprint=fingerprint(module))
    table["config"] = np.array(json.dumps(config, sort_keys=True))

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:  # an open file: savez would add .npz to a name
            np.savez(file, **table)

    write_atomically(path, write)
    return path


def load_representation(
    path: str | Path, env: str, split: str = "default", split_seed: int = 0
) -> dict:
    """Read a table and make sure that it belongs to this environment, action set and split.

    Returns mean and log_var (NUM_ACTIONS, D) float32, action_ids int64, and config, a dict.
    Raises FileNotFoundError without a file; ValueError if it is damaged or belongs elsewhere.
    """
    module, path = load_environment(env), Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no representations at {path}")
    try:
        with np.load(path, allow_pickle=False) as file:
            table = {key: file[key] for key in ("mean", "log_var", "action_ids")}
            config = dict(json.loads(str(file["config"])))
    except Exception as e:  # zip, npy and JSON each have errors of their own for a damaged file
        reason = str(e).split("\n")[0]
        raise ValueError(f"{path} is not a file of representations: {reason}") from None
    if config.get("environment") != env:
        raise ValueError(f"{path} belongs to {config.get('environment')!r}, not to {env!r}")
    for key in ("mean", "log_var"):  # first: a float64 may be finite and a float32 not
        if table[key].dtype.kind == "f":
            with np.errstate(over="ignore"):
                table[key] = table[key].astype(np.float32)
    check_table(table, module.NUM_ACTIONS, str(path))
    if config.get("fingerprint") != fingerprint(module):
        raise ValueError(f"{path} belongs to another action set of {env}: train it again")
    for key, wanted in (("split", split), ("split_seed", split_seed)):
        if config.get(key, wanted) != wanted:
            raise ValueError(f"{path} has {key} {config[key]!r}, wanted {wanted!r}")
    if config.get("train_on") == "train":  # the split of that name may have changed since
        now = module.split_actions(split, split_seed)["train"]
        if not np.array_equal(np.sort(table["action_ids"]), now):
            raise ValueError(f"{path} was trained on other actions than split {split!r} has")
    mean, log_var = table["mean"].astype(np.float32), table["log_var"].astype(np.float32)
    ids = table["action_ids"].astype(np.int64)
    return dict(mean=mean, log_var=log_var, action_ids=ids, config=config)


# ---- how good is a table? ----

PUBLISHED = {  # scores of the released 10,000-epoch tables: net_r2, move_accuracy, nn_net_match
    "gridworld-xy-hvae": (0.946, 0.604, 0.717),
    "gridworld-xy-hvae-all": (0.970, 0.705, 0.721),
    "gridworld-xy-vae": (0.908, 0.496, 0.496),
    "gridworld-onehot-hvae": (0.942, 0.669, 0.541),
    "gridworld-onehot-vae": (0.368, 0.424, 0.131),
}


def features(env: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What the actions of an environment differ in: name -> (values (NUM_ACTIONS, k), group).

    A group (NUM_ACTIONS,) is a class of actions whose values one linear read-out may share; rows
    with group "" do not have the feature. Angles are points on a circle: (sin, cos) of the angle
    times 360 / turn, where a class looks the same again after `turn` degrees.
    """
    module = load_environment(env)
    if env == "create":
        kinds = np.array([tool.kind for tool in module.TOOLS])
        turn = np.array([module.TURN.get(kind, 0) for kind in kinds])
        angle = np.array([tool.angle for tool in module.TOOLS])
        columns = {name: [getattr(tool, name) for tool in module.TOOLS]
                   for name in ("size", "elasticity", "force", "max_angle", "mass")}  # fmt: skip
    elif env == "stacking":
        families = [module.FAMILIES[shape.family] for shape in module.SHAPES]
        kinds = np.array([family.name for family in families])
        # no shape looks the same again before a quarter turn; round ones have one angle only
        turn = np.array([180 * max(f.turn, 0.5) if f.angles > 1 else 0 for f in families])
        angle = np.degrees([shape.angle for shape in module.SHAPES])
        columns = {"scale": [shape.scale for shape in module.SHAPES]}
    else:
        return {}
    columns = {name: np.array(column, float)[:, None] for name, column in columns.items()}
    has = {name: kinds[column[:, 0] != 0] for name, column in columns.items()}
    found = {name: (column, np.where(np.isin(kinds, has[name]), kinds, ""))
             for name, column in columns.items()}  # fmt: skip
    phase = 2 * np.pi * angle / np.maximum(turn, 1)
    circle = np.stack([np.sin(phase), np.cos(phase)], 1)
    if env == "stacking":
        # Half of six scales are too few for a read-out per class: one for all of them. And the
        # cameras stand all around a shape, so only the side on which the sun falls tells an angle.
        every = np.full(len(kinds), "all shapes")
        return {
            "angle": (circle, np.where(turn > 0, kinds, "")),
            "scale": (*columns.values(), every),
        }
    corners = (turn > 0) & (turn < 180)  # polygons look the same again after 60 to 120 degrees
    found["corner"] = (circle, np.where(corners, kinds, ""))
    return {"angle": (circle, np.where(turn >= 180, kinds, ""))} | found


def probe(
    mean: np.ndarray, train_ids: np.ndarray, held_out_ids: np.ndarray, env: str = "gridworld"
) -> dict[str, float]:
    """What a table tells: read-outs fitted on train actions, scored on held-out ones.

    gridworld: net_r2 (linear read-out of the net displacement), move_accuracy (logistic read-outs
    of the five moves, mean; chance 0.25), move_1 .. move_5 (each of them), nn_net_match (share of
    held-out skills whose nearest train skill has the same net displacement).
    others: nn_class (share of held-out actions whose nearest other held-out action has the same
    label, as seen in Figures 5-6), chance_class (the same for a random other held-out action),
    train_class (the same for the nearest train action), engineered_r2 (one linear read-out for
    all actions of those engineered features that vary, mean), and of each of `features` its
    <name>_r2: linear read-outs, one per class, of what the feature is within the class. R^2 is
    that of all classes together, around each class's own held-out mean: telling the class earns
    nothing. Where held-out classes were not trained on (split full), these read-outs are fitted on
    a random half of the held-out actions and scored on the other half.
    """
    from sklearn.linear_model import LogisticRegression, RidgeCV
    from sklearn.metrics import r2_score

    labels, every = np.asarray(load_environment(env).action_labels()), held_out_ids
    full = np.isin(labels[held_out_ids], labels[train_ids]).mean() < 0.5
    if full:
        order = np.random.default_rng(0).permutation(held_out_ids)
        train_ids, held_out_ids = order[: len(order) // 2], order[len(order) // 2 :]
    spread = mean[train_ids].std(0)
    x = (mean - mean[train_ids].mean(0)) / np.where(spread > 1e-6, spread, 1)
    penalties = np.logspace(-4, 4, 17)

    def linear(y: np.ndarray) -> float:
        keep = (y[train_ids].std(0) > 1e-6) & (y[held_out_ids].std(0) > 1e-6)
        model = RidgeCV(penalties).fit(x[train_ids], y[train_ids][:, keep])
        predicted = model.predict(x[held_out_ids]).reshape(-1, keep.sum())
        return r2_score(y[held_out_ids][:, keep], predicted)

    def within_classes(y: np.ndarray, group: np.ndarray) -> float:
        """R^2 of one read-out per class of `group`: knowing the class alone is worth nothing."""
        missed = total = 0.0
        for name in set(group[held_out_ids]) - {""}:
            seen, new = (ids[group[ids] == name] for ids in (train_ids, held_out_ids))
            if len(np.unique(y[seen].round(6), axis=0)) < 3:
                continue  # two values do not say what a third would look like
            predicted = RidgeCV(penalties).fit(x[seen], y[seen]).predict(x[new])
            missed += ((y[new] - predicted.reshape(y[new].shape)) ** 2).sum()
            total += ((y[new] - y[new].mean(0)) ** 2).sum()
        return 1 - missed / total if total else np.nan

    def nearest(rows: np.ndarray, others: np.ndarray, skip_self: bool) -> np.ndarray:
        gaps = np.stack([((others - row) ** 2).sum(1) for row in rows])
        if skip_self:
            np.fill_diagonal(gaps, np.inf)
        return gaps.argmin(1)

    if env != "gridworld":
        same = labels[every][nearest(mean[every], mean[every], True)] == labels[every]
        counts, total = np.unique(labels[every], return_counts=True)[1], len(every)
        scores = dict(nn_class=same.mean())
        scores |= dict(chance_class=(counts * (counts - 1)).sum() / (total * (total - 1)))
        if not full:
            among = labels[train_ids][nearest(mean[held_out_ids], mean[train_ids], False)]
            scores |= dict(train_class=(among == labels[held_out_ids]).mean())
        scores |= dict(engineered_r2=linear(load_environment(env).engineered_representations()))
        scores |= {f"{name}_r2": within_classes(*what) for name, what in features(env).items()}
        return {key: round(float(value), 4) for key, value in scores.items()}
    moves = np.arange(len(mean))[:, None] // 4 ** np.arange(5) % 4  # A.1: (1024, 5) move ids
    net = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[moves].sum(1)  # (1024, 2)
    accuracy = {}
    for t in range(5):
        model = LogisticRegression(max_iter=2000).fit(x[train_ids], moves[train_ids, t])
        accuracy[f"move_{t + 1}"] = model.score(x[held_out_ids], moves[held_out_ids, t])
    match = net[train_ids][nearest(mean[held_out_ids], mean[train_ids], False)] == net[held_out_ids]
    scores = dict(net_r2=linear(net), move_accuracy=np.mean(list(accuracy.values())))
    scores |= dict(nn_net_match=match.all(1).mean()) | accuracy
    return {key: round(float(value), 4) for key, value in scores.items()}


def probe_rows(mean: np.ndarray, args: Args) -> list[dict]:
    """`probe` of a table on the held-out actions of its split, beside two yardsticks.

    One row per score: score, value, engineered (the same read-outs from the ground truth: what
    could be reached; an angle is one number there, which no linear read-out bends into a circle)
    and published (the released tables, where there are any). args: resolved.
    """
    module, held_out = load_environment(args.env), held_out_labels(args)[0]
    split = module.split_actions(args.split, args.split_seed)
    scores, truth = (
        probe(table, split["train"], held_out, args.env)
        for table in (mean, module.engineered_representations())
    )
    published = dict(zip(scores, PUBLISHED.get(title(args), ()), strict=False))
    return [
        dict(score=key, value=value, engineered=truth[key], published=published.get(key, ""))
        for key, value in scores.items()
    ]


def held_out_labels(args: Args) -> tuple[np.ndarray, np.ndarray]:
    """Ids of the validation and test actions of a split, without those of training; their labels.

    (CREATE's no-op is on both sides.)
    """
    module = load_environment(args.env)
    split = module.split_actions(args.split, args.split_seed)
    ids = np.setdiff1d(np.concatenate([split["valid"], split["test"]]), split["train"])
    return ids, np.asarray(module.action_labels())[ids]


def title(args: Args) -> str:
    """<env>-<modality>-<hvae|vae>[-all]; args: resolved."""
    name = f"{args.env}-{args.modality}-{'hvae' if args.hierarchical else 'vae'}"
    return name + ("-all" if args.train_on == "all" else "")


def report(model, module, mean: np.ndarray, path: Path, args: Args) -> None:
    """Probe scores to the screen, <name>.json and <name>-probe.csv, pictures beside them."""
    held_out, labels = held_out_labels(args)
    name, rows = title(args), probe_rows(mean, args)
    print(f"{name}: what it tells about {len(held_out)} held-out actions")
    print(f"  {'':14}   value  engineered  published")
    for row in rows:
        numbers = f"{row['value']:7.3f}  {row['engineered']:10.3f}"
        print(f"  {row['score']:14} {numbers}  {row['published'] or '-'}")
    # JSON knows no NaN: null where no held-out action has the feature
    scores = {row["score"]: None if np.isnan(row["value"]) else row["value"] for row in rows}
    published = {row["score"]: row["published"] for row in rows if row["published"] != ""}
    record = json.dumps(dict(scores=scores, published=published))
    write_atomically(path.with_suffix(".json"), lambda file: file.write_text(record + "\n"))
    stem = str(path.with_suffix(""))
    write_atomically(Path(f"{stem}-probe.csv"), lambda file: write_csv(file, rows))
    if args.plots:
        caption = f"{name}: {len(held_out)} held-out actions, split {args.split}"
        plot_tsne(mean[held_out], labels, Path(f"{stem}-tsne.png"), caption)
        some = np.linspace(0, len(held_out) - 1, 8).astype(int)
        titles = [f"{labels[i]} ({held_out[i]})" for i in some]
        raw = observe(module, held_out[some], 8, args)
        plot_reconstructions(model, raw, titles, Path(f"{stem}-reconstructions.png"))


# ---- pictures ----


def tsne(mean: np.ndarray) -> np.ndarray:
    """Representations (count, D) -> places in a plane (count, 2)."""
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    perplexity = min(PERPLEXITY, (len(mean) - 1) / 3)
    with threadpool_limits(1):  # a second thread only waits where other programs run: minutes
        return TSNE(perplexity=perplexity, init="pca", random_state=0).fit_transform(mean)


def plot_tsne(mean: np.ndarray, labels: np.ndarray, path: Path, title: str) -> None:
    """Figures 4-6: representations (count, D) laid out by t-SNE, one hue and mark per label."""
    from matplotlib.figure import Figure

    places = tsne(mean)
    figure = Figure(figsize=(6.5, 5), layout="constrained")
    axes, names = figure.subplots(), sorted(set(labels))
    # Hues of the published code; neighbours in the circle of hues also differ in their marks.
    for i, name in enumerate(names):
        colour = colorsys.hls_to_rgb((i / len(names) + 0.7) % 1, 0.6, 0.9)
        mark = MARKS[i % len(MARKS)] if len(names) > 6 else "o"
        look = dict(s=22, color=colour, marker=mark, linewidths=0.3, edgecolors="#00000080")
        axes.scatter(*places[labels == name].T, label=str(name), **look)
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, fontsize=10)
    axes.spines[:].set_visible(False)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, fontsize=8)
    write_atomically(path, lambda file: figure.savefig(file, dpi=120))


@torch.no_grad()
def plot_reconstructions(model, raw: np.ndarray, titles: list[str], path: Path) -> None:
    """Observations raw (A, n, ...) above what the model makes of them, one column per action."""
    from matplotlib.figure import Figure

    fmt, device = model.format, next(model.parameters()).device
    model.eval()
    output = model.reconstruct(torch.from_numpy(np.ascontiguousarray(raw)).to(device)).cpu().numpy()
    figure = Figure(figsize=(14, 3.8), layout="constrained")
    rows = figure.subplots(2, len(raw))
    for true, made, column, title in zip(raw, output, rows.T, titles, strict=True):
        first = true[:, 0].astype(float)  # (n, F), or a picture or frame that `undo` ignores
        made = undo(made, first, fmt)
        if fmt.visual:  # one observation, three frames of a video below each other
            true = true[:1] if fmt.kind == "image" else true[0, [1, 3, -1]]
            made = made[0] if fmt.kind == "image" else made[0, [0, 2, -1]]
            for axes, frames in zip(column, (true, made), strict=True):
                axes.imshow(np.concatenate(list(frames)), cmap="gray", vmin=0, vmax=255)
                axes.set(xticks=[], yticks=[])
        else:  # all observations on top of each other, moved to a common start
            ball = slice(2, 4) if fmt.features == 6 else slice(0, 2)  # CREATE's 6-D: tool, ball, v
            made = np.concatenate([first[:, None], made], 1)  # (n, L, F)
            moved = [(paths - first[:, None])[..., ball] for paths in (true, made)]  # (n, L, 2)
            middle = (moved[0].max((0, 1)) + moved[0].min((0, 1))) / 2
            reach = 0.6 * np.ptp(moved[0], (0, 1)).max() + 1e-6
            for axes, paths in zip(column, moved, strict=True):
                axes.plot(*paths.transpose(2, 1, 0), "o-", ms=3, alpha=0.5)  # x, y: (L, n)
                axes.set(xlim=middle[0] + reach * np.array([-1, 1]), aspect="equal")
                axes.set(ylim=middle[1] + reach * np.array([1, -1] if fmt.y_down else [-1, 1]))
                axes.tick_params(labelsize=6)
        column[0].set_title(title, fontsize=8)
    rows[0, 0].set_ylabel("observed")
    rows[1, 0].set_ylabel("reconstructed")
    write_atomically(path, lambda file: figure.savefig(file, dpi=100))


def main() -> None:
    """Train what the command line says."""
    args = tyro.cli(Args, description=__doc__)
    try:
        print(f"representations: {train(args)}")
    except (ValueError, OSError, MemoryError, ImportError) as e:
        raise SystemExit(f"error: {e}") from None
    except RuntimeError as e:  # too little memory has an error of its own only on a GPU
        if not isinstance(e, torch.OutOfMemoryError) and "allocate memory" not in str(e):
            raise
        raise SystemExit(f"error: {str(e).splitlines()[0]}") from None


if __name__ == "__main__":
    main()
