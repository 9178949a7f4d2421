"""Action representations: a hierarchical VAE over sets of action observations (appendix B, D.3.1).

An action is known only by observations of what it does: a set X = {x_1 .. x_n} of trajectories,
videos or pictures. One latent c explains the whole set, one latent z_j each observation. What all
observations share (the action) lands in c; what differs (start cell, camera angle) lands in z.

        c ~ N(0, I)  ->  z_j ~ p(z | c)  ->  x_j ~ p(x | z_j, c, first state of x_j)

    ELBO per observation = mean_j [ log p(x_j | z_j, c) - KL( q(z_j | x_j, c) || p(z_j | c) ) ]
                           - KL( q(c | X) || N(0, I) ) / |X|

The representation of an action is the mean of q(c | X). It is computed for every action, but the
networks are trained on training actions only: unseen actions are encoded without re-training.

    python hvae.py gridworld                     # the default table of Grid World
    python hvae.py gridworld --modality onehot   # B: one-hot states, cross-entropy
    python hvae.py gridworld --no-hierarchical   # B: the plain VAE baseline
    python hvae.py gridworld --train-on all      # the oracle encoder sees every action
    python hvae.py create --split full           # B; also --modality video; or: stacking
    python hvae.py gridworld --recipe paper      # Tables 3-4 to the letter: days on a CPU
    python hvae.py create --recipe quick --help  # the numbers of this recipe
"""

import colorsys
import hashlib
import importlib
import json
import os
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch.distributions import Categorical, Normal, kl_divergence
from tqdm import tqdm

# Intel's MKL, which multiplies PyTorch's matrices, may add up the parts of its threads in the order
# in which they come. In this mode the order is fixed: one seed, one run, bit for bit.
os.environ.setdefault("MKL_CBWR", "AUTO")

# Paper map: Tables 3-4 -> Args, TABLE_3, TABLE_4; D.3.1 -> the networks, in its order, from
# ConvEncoder to ConvDecoder; B -> HVAE, VAE, prepare; Figures 4-6 -> plot_tsne.
# Shapes: A actions in a batch, n observations of each, B = A * n, L states per trajectory (the
# first is given, T = L - 1 are predicted), F numbers per state, C = Z sizes of c and z, H hidden
# width, S side of a picture.

# Name on the command line -> module. Add your own here.
ENVIRONMENTS = dict(
    gridworld="gridworld", recsys="recsys", create="create_env", stacking="stacking_env"
)
# Of relative trajectories: centre and half-width of first states, and the unit of differences. The
# decoder's smallest sigma is exp(-4 / 2) = 0.135 units: less than what tells two actions apart.
UNITS = {
    "gridworld": (39.5, 39.5, 1.0),  # A.1: cells 1..78; one move is 7 sigma
    "create": (0.0, 1.0, 4 / 42),  # ours: 4 of 84 pixels, so that sigma can fall to half a pixel
}
VISUAL = ("image", "video")  # modalities that pass the convolutions
CLASSES = 80  # B: "two 80-dimensional one-hot vectors"
CONV_FEATURES = 32 * 3 * 3  # published code: channels * height * width after the last convolution
LOG_VAR_RANGE = (-4.0, 3.0)  # published code: clamp of the decoder's log-variance
GRADIENT_CLIP = 0.5  # published code: every entry of a gradient is cut to [-0.5, 0.5]
OBSERVATIONS_VERSION = 1  # ours: raise it when an environment records something else


# ---- Tables 3 and 4 ----


@dataclass(kw_only=True)
class Args:
    """Train an action encoder. The numbers depend on environment and recipe: `default_args`."""

    env: Annotated[str, tyro.conf.Positional]  # gridworld, create or stacking
    modality: str  # what is observed (B): xy, onehot | xy, state, video | image
    recipe: Literal["laptop", "quick", "paper"]  # paper: Tables 3-4; quick: a minute or two
    hierarchical: bool = True  # HVAE; --no-hierarchical: the plain VAE baseline (B)
    train_on: Literal["train", "all"] = "train"  # all: the oracle encoder, sees held-out actions
    split: str = "default"  # split of the actions: default, full, ...
    split_seed: int = 0  # seed of the split
    seed: int = 0  # seed of weights, batches and latent samples
    device: str = "auto"  # cpu, cuda, or auto
    runs_dir: str = "runs"  # tables go to <runs_dir>/hvae, recordings to <runs_dir>/observations
    representation_size: int  # Table 3: of c and of z
    batch_size: int  # Table 3: actions in an update
    epochs: int  # Table 3: passes over the training actions, if updates is 0
    updates: int  # number of updates, instead of epochs
    learning_rate: float  # Table 4 (of RAdam, D.1)
    observations: int  # Table 4: recorded of each action; its representation comes from all
    batch_observations: int  # of each action in one update (paper: all)
    set_size: int  # |X| of the ELBO: observations that share the price of c
    q_hidden: int  # Table 4: width of q(c|X)
    hidden: int  # Table 4: default width
    relative: bool  # states relative to the first one, instead of raw
    kl_warmup: float  # share of the updates in which the weight of the KLs climbs to 1


TABLE_3 = {
    "gridworld": dict(representation_size=16, batch_size=128, epochs=10_000),
    "create": dict(representation_size=128, batch_size=128, epochs=10_000),
    "stacking": dict(representation_size=128, batch_size=32, epochs=5_000),
}
TABLE_4 = dict(learning_rate=1e-3, observations=1024, q_hidden=128, hidden=64)
# appendix: an update sees all 1,024 observations of an action; published code: 45 to 672 of them;
# we do as the appendix. In Grid World that takes 11 GB of memory.
PAPER = dict(updates=0, batch_observations=1024, set_size=1024, relative=False, kl_warmup=0.0)
# appendix: width 64, one column for CREATE; published code: this for pictures; we do as the code.
PAPER_VISUAL = dict(batch_size=32, epochs=5_000, hidden=128)

# How the short recipes leave the paper. (Four lines do so further down: search for "paper".)
LAPTOP = dict(
    # Raw cells run to 78: the networks would first have to learn to subtract the start to a tenth
    # of a cell before any skill shows. Differences show it from the first update.
    relative=True,
    # Observations of one action differ little: many small updates teach more than few large ones.
    batch_observations=4,
    # Each update sees 4 of a set of 64, and each of the 4 bears 1/64 of KL(q(c|X)). Not quite the
    # ELBO: c comes from the 4 alone. At 1/4, c kept only 4 of its 16 dimensions in use.
    set_size=64,
    updates=2_750,
)
# Ours, changed together, so what each is worth is not known. Before, z, and with it how the ball
# was launched, was given up: the error stopped near 6.5. Together they brought it below 1.
BALLS = dict(set_size=1024, kl_warmup=0.5, learning_rate=3e-3, batch_observations=8)
PICTURES = BALLS | dict(learning_rate=2e-3, batch_observations=4, batch_size=16)
LAPTOP_OF = {  # an environment or a modality
    "gridworld": dict(updates=1_000),  # with the linear path: see ActionInference
    "onehot": dict(updates=4_000),  # 160 zeros and ones say the same as 2 numbers, learned later
    "create": BALLS | dict(updates=2_500),
    "image": PICTURES | dict(updates=1_500),
    "video": PICTURES | dict(updates=600, observations=128),  # 1,024 of every tool are 28 GB
}
QUICK_OF = {  # as many observations as a minute of recording allows
    "onehot": dict(updates=2_000),
    "create": dict(updates=1_250, observations=128),
    "image": dict(updates=1_000, observations=64),
    "video": dict(updates=200, observations=16),
}


def load_environment(name: str):
    """The module of an environment by its name; ValueError if there is none."""
    if name not in ENVIRONMENTS:
        raise ValueError(f"unknown environment {name!r}; allowed: {', '.join(ENVIRONMENTS)}")
    return importlib.import_module(ENVIRONMENTS[name])


def default_args(env: str = "gridworld", recipe: str = "laptop", modality: str | None = None):
    """Args with all numbers of an environment, a recipe and a modality (None: the paper's)."""
    modalities = load_environment(env).MODALITIES
    if not modalities:
        raise ValueError(f"{env} has no action observations, only engineered representations")
    modality, recipes = modality or modalities[0], ("laptop", "quick", "paper")
    if modality not in modalities:
        raise ValueError(f"unknown modality {modality!r}; allowed: {', '.join(modalities)}")
    if recipe not in recipes:
        raise ValueError(f"unknown recipe {recipe!r}; allowed: {', '.join(recipes)}")
    numbers = TABLE_4 | TABLE_3.get(env, TABLE_3["gridworld"]) | PAPER
    numbers |= PAPER_VISUAL if modality in VISUAL else {}
    if recipe != "paper":
        numbers |= LAPTOP | LAPTOP_OF.get(env, {}) | LAPTOP_OF.get(modality, {})
    if recipe == "quick":
        numbers |= QUICK_OF.get(env, {}) | QUICK_OF.get(modality, {})
    return Args(env=env, modality=modality, recipe=recipe, **numbers)


def check(args: Args) -> None:
    """ValueError for numbers that make no sense and options that change nothing."""
    default = default_args(args.env, args.recipe, args.modality)
    least = dict(seed=0, split_seed=0, updates=0, kl_warmup=0, learning_rate=1e-9, observations=2)
    for name, value in asdict(args).items():
        if not isinstance(value, str | bool) and not value >= least.get(name, 1):
            raise ValueError(f"{name} must be at least {least.get(name, 1)}, got {value}")
    if args.batch_observations > args.observations:
        raise ValueError("batch_observations are more than the observations of each action")
    if args.hidden % 2:
        raise ValueError("hidden must be even: the Bi-LSTM has two halves")
    effect = dict(q_hidden=args.hierarchical, set_size=args.hierarchical)
    effect |= dict(relative=args.modality not in VISUAL, epochs=args.updates == 0)
    for name in effect:  # an ablation that changes nothing would pass for a result
        if not effect[name] and getattr(args, name) != getattr(default, name):
            raise ValueError(f"{name} has no effect with this modality, model and --updates")


# ---- observations as the networks see them (B) ----


def prepare(raw: torch.Tensor, args: Args) -> tuple[torch.Tensor, torch.Tensor]:
    """Raw observations (B, ...) -> what the encoder reads, what is to be reconstructed."""
    # trajectory: (B, L, F), (B, T, F); one-hot: (B, L, 160), (B, T, 2) class numbers;
    # video: (B, L, 1, S, S), (B, T, 1, S, S); picture: twice (B, 1, 1, S, S).
    raw = raw.float()
    if args.modality in VISUAL:
        frames = raw.unsqueeze(-3) / 255 - 0.5  # published code: greys to [-0.5, 0.5]
        return (frames, frames[:, 1:]) if args.modality == "video" else (frames[:, None],) * 2
    first, later = raw[:, :1], raw[:, 1:]  # (B, 1, F), (B, T, F)
    if args.modality == "onehot":
        if args.relative:  # class 40 is "no change", 41 one cell to the right or down
            raw = torch.cat([first, raw.diff(dim=1) + CLASSES // 2], 1)
            later = later - first + CLASSES // 2
        seen = F.one_hot(raw.long(), CLASSES)  # (B, L, 2, 80)
        return seen.flatten(2).float(), later.long()  # (B, L, 160), (B, T, 2)
    if not args.relative:
        return raw, later
    centre, half, unit = UNITS.get(args.env, (0.0, 1.0, 1.0))
    # Read as moves, predicted as places relative to the start.
    inputs = torch.cat([(first - centre) / half, raw.diff(dim=1) / unit], 1)
    return inputs, (later - first) / unit


# ---- D.3.1: the networks, in its order; first what they share ----


class Residual(nn.Module):
    """`layers` linear layers with ReLU between them, then ReLU(out + input)."""

    # appendix: "MLP"; published code: such residual blocks, with the appendix's numbers of layers
    # but for one (ActionInference); we do as the code.
    def __init__(self, width, layers):
        super().__init__()
        pairs = [layer for _ in range(layers) for layer in (nn.ReLU(), nn.Linear(width, width))]
        self.layers = nn.Sequential(*pairs[1:])

    def forward(self, x):
        return F.relu(self.layers(x) + x)


class SumReLU(nn.Module):
    """D.3.1: several vectors "passed through linear layers and then summed up", then ReLU."""

    def __init__(self, inputs, width):
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(size, width) for size in inputs)

    def forward(self, *inputs):
        return F.relu(sum(linear(x) for linear, x in zip(self.linears, inputs, strict=True)))


class GlobalBatchNorm(nn.BatchNorm1d):
    """The "1D batch-norm" of D.3.1: one mean, variance, gain, bias over batch *and* dimensions."""

    # A batch norm per dimension would blow up those dimensions of a latent that carry nothing.
    def __init__(self):
        super().__init__(1, eps=1e-3, momentum=0.01)  # published code

    def forward(self, x):
        return super().forward(x.reshape(-1, 1)).reshape(x.shape)  # as (B * C, 1)


def normal(mean: torch.Tensor, log_var: torch.Tensor) -> Normal:
    """A diagonal Gaussian. Unchecked: should a number become infinite, `fit` says so."""
    return Normal(mean, (0.5 * log_var).exp(), validate_args=False)


def initialise(module: nn.Module) -> None:
    """Linear layers: Xavier-normal with gain sqrt(2), bias 0 (published code)."""
    if isinstance(module, nn.Linear):
        nn.init.xavier_normal_(module.weight, gain=2**0.5)
        nn.init.zeros_(module.bias)


class ConvEncoder(nn.Module):
    """Pictures (B, 1, S, S) -> (B, 288): 7 layers for S = 48, 9 layers for S = 84."""

    # A layer is a 3x3 convolution, batch norm and ReLU; every other one halves the picture:
    # 48 -> 24 -> 12 -> 6 -> 3, or 84 -> 42 -> 21 -> 11 -> 6 -> 3.
    CHANNELS = {48: (8, 8, 16, 16, 16, 16, 32), 84: (8, 8, 16, 16, 16, 16, 32, 32, 32)}

    def __init__(self, side):
        super().__init__()
        if side not in self.CHANNELS:
            raise ValueError(f"pictures must be 48 or 84 pixels wide, got {side}")
        layers, before = [], 1
        for i, after in enumerate(self.CHANNELS[side]):
            layers.append(nn.Conv2d(before, after, 3, stride=2 - i % 2, padding=1))
            layers += [nn.BatchNorm2d(after), nn.ReLU()]
            before = after
        self.layers = nn.Sequential(*layers)

    def forward(self, x):
        return self.layers(x).flatten(1)  # (B, 32, 3, 3) -> (B, 288)


class TrajectoryEncoder(nn.Module):
    """Bi-LSTM Encoder: sequences (B, L, F) -> (B, H), 2 layers, averaged over time."""

    # appendix: to a 64-dimensional vector; published code: 64 per direction, directions averaged;
    # we do as the code in the paper's recipe. Otherwise 32 per direction, concatenated (`compact`):
    # also 64 numbers, from a quarter of the weights, in 0.6 of the time of an update.
    def __init__(self, features, hidden, compact):
        super().__init__()
        self.compact, width = compact, hidden // 2 if compact else hidden
        self.lstm = nn.LSTM(features, width, num_layers=2, bidirectional=True, batch_first=True)

    def forward(self, x):
        h = self.lstm(x)[0].mean(1)  # (B, 2 * width): forward half, backward half
        return h if self.compact else h.unflatten(1, (2, -1)).mean(1)  # (B, H)


class ActionInference(nn.Module):
    """q(c | X): encoded observations (A, n, H) -> Gaussian of c, (A, C)."""

    def __init__(self, hidden, width, size, numbers=0):
        super().__init__()
        self.before = nn.Sequential(  # 4 linear layers, on each observation
            nn.Linear(hidden, width), nn.ReLU(), Residual(width, 2), nn.Linear(width, width)
        )
        # appendix: 3 layers; published code: 4 (a block of 3 and the output); we do as the code.
        self.after = nn.Sequential(Residual(width, 3), nn.Linear(width, 2 * size))
        self.norm = GlobalBatchNorm()  # published code: over mean and log-variance together
        self.linear = nn.Linear(numbers, size) if numbers else None

    def forward(self, h):
        pooled = self.before(h).mean(1)  # (A, n, width) -> (A, width), whatever the order and n
        out = self.after(pooled)  # (A, 2C)
        # Linear path, ours, in two short recipes: the mean of c is a linear map of the averaged
        # observations (of pictures: convolved) plus 0.1 of the networks, which alone may put a
        # training action anywhere. Shape Stacking, nn_class, seeds 0, 1: 0.914, 0.923; without it
        # 0.254, 0.612 (1,000 updates). Grid World, validation after 1.5M steps, seeds and splits 0,
        # 1, 2: 0.877, 0.851, 0.796; without it 0.847, 0.752, 0.699 (2,750 updates, not 1,000).
        if self.linear:
            straight = self.linear(h[..., -self.linear.in_features :].mean(1))  # (A, C)
            out = 0.1 * out + F.pad(straight, (0, straight.shape[1]))
        return normal(*self.norm(out).chunk(2, -1))  # twice (A, C)


class ObservationInference(nn.Module):
    """q(z | x, c): encoded observation (B, H) and c (B, C) -> Gaussian of z, (B, Z).

    The prior p(z | c) is the same network without x; the plain VAE's q(z | x) that without c.
    """

    def __init__(self, inputs, hidden, size):
        super().__init__()
        self.sum = SumReLU(inputs, hidden)
        self.layers = nn.Sequential(
            Residual(hidden, 2), Residual(hidden, 2), nn.Linear(hidden, size), GlobalBatchNorm()
        )
        # appendix: networks output the log-variances of q(z|x,c), p(z|c) and the decoder; published
        # code: learned constants from N(0, 1); we do as the code, which made the results.
        self.log_var = nn.Parameter(torch.randn(size))

    def forward(self, *inputs):
        mean = self.layers(self.sum(*inputs))  # (B, Z)
        return normal(mean, self.log_var.expand_as(mean))


class ObservationDecoder(nn.Module):
    """First state (B, F) and latents -> means, or logits, of the T later states (B, T, F)."""

    def __init__(self, latents, features, hidden, steps):
        super().__init__()
        self.steps, self.sum = steps, SumReLU(latents, hidden)
        if steps:
            self.start = nn.Sequential(nn.Linear(features, hidden), Residual(hidden, 2))
            self.lstm = nn.LSTM(hidden, hidden, batch_first=True)
        self.output = nn.Sequential(Residual(hidden, 2), nn.Linear(hidden, features))

    def forward(self, start, *latents):
        if not self.steps:  # a picture: its features (B, 1, F)
            return self.output(self.sum(*latents))[:, None]
        # The product lets the start gate the effect: beside a wall, a move does nothing.
        combined = self.sum(*latents) * self.start(start)  # (B, H)
        # appendix: this vector drives the LSTM; published code: each predicted state is embedded
        # and fed back in place of the start; we do as the appendix, which also learns sooner.
        steps = combined[:, None].expand(-1, self.steps, -1)  # (B, T, H)
        return self.output(self.lstm(steps)[0])  # (B, T, F)


class ConvDecoder(nn.Module):
    """Features (B, 288) -> picture in [-0.5, 0.5] and, if wanted, mask in [0, 1]: (B, 1, S, S)."""

    # Pairs of a 3x3 and a transposed convolution that doubles the picture, each with batch norm and
    # ReLU: 3 -> 6 -> 12 -> 24 -> 48, or 3 -> 6 -> 11 -> 21 -> 42 -> 84; then one 1x1 convolution.
    STAGES = {  # channels, kernel and padding of the transposed convolutions (published code)
        48: ((32, 2, 0), (32, 2, 0), (16, 2, 0), (16, 2, 0)),
        84: ((32, 2, 0), (32, 3, 1), (16, 3, 1), (16, 2, 0), (16, 2, 0)),
    }

    def __init__(self, side, mask):
        super().__init__()
        layers, width = [], 32
        for after, kernel, padding in self.STAGES[side]:
            layers += [nn.Conv2d(width, width, 3, padding=1), nn.BatchNorm2d(width), nn.ReLU()]
            layers.append(nn.ConvTranspose2d(width, after, kernel, stride=2, padding=padding))
            layers += [nn.BatchNorm2d(after), nn.ReLU()]
            width = after
        layers += [nn.Conv2d(width, 1 + mask, 1), nn.Sigmoid()]
        if mask:  # ours: a picture starts white, as most of a video is. If it starts grey, opening
            # the mask makes everything worse, so it shuts before anything is learned behind it.
            nn.init.constant_(layers[-2].bias[:1], 3.0)
        self.layers = nn.Sequential(*layers)

    def forward(self, features):
        out = self.layers(features.unflatten(1, (32, 3, 3)))  # (B, 288) -> (B, 1 or 2, S, S)
        return out[:, :1] - 0.5, out[:, 1:]


# ---- the two models ----


class ObservationModel(nn.Module):
    """What HVAE and VAE share: encoder, decoder and likelihood of observations."""

    numbers = 0  # in an observation, for the linear path of ActionInference; 0: there is none

    def __init__(self, args, shape, latents):
        super().__init__()
        self.args, hidden, picture = args, args.hidden, args.modality == "image"
        if args.modality in VISUAL:  # shape: (S, S), of videos (L, S, S)
            self.conv = ConvEncoder(shape[-1])
            self.conv_decoder = ConvDecoder(shape[-1], mask=not picture)
            self.to(memory_format=torch.channels_last)  # ours: 1.4 times as fast on a CPU
            features, sigmas = CONV_FEATURES, (1, *shape[-2:])
        else:  # shape: (L, F)
            features = shape[-1] * (CLASSES if args.modality == "onehot" else 1)
            sigmas = (features,)
        if picture:
            # appendix: Bi-LSTM of trajectories only; published code: of all; we do as the appendix.
            self.sequence = nn.Sequential(nn.Flatten(), nn.Linear(features, hidden), nn.ReLU())
        else:
            self.sequence = TrajectoryEncoder(features, hidden, compact=args.recipe != "paper")
        steps = 0 if picture else shape[0] - 1  # T
        self.decoder = ObservationDecoder(latents, features, hidden, steps)
        if args.modality != "onehot":  # one number per feature or pixel
            self.log_var = nn.Parameter(torch.randn(sigmas))
            if args.recipe != "paper":  # ours: at -2, a move of one cell is already 2.7 sigma
                nn.init.constant_(self.log_var, -2.0)

    def encode(self, x):
        """Inputs of `prepare` -> states or features (B, L, F), encoded (B, H)."""
        if self.args.modality in VISUAL:
            x = self.conv(x.flatten(0, 1)).unflatten(0, x.shape[:2])  # (B * L, 1, S, S) -> 288 each
        h = self.sequence(x)
        return x, torch.cat([h, x.flatten(1)], 1) if self.numbers else h

    def decode(self, start, frame, *latents):
        """First states, first frames (of videos), latents -> means, or logits (B, T, 2, 80)."""
        features = self.decoder(start, *latents)  # (B, T, F), or (B, 1, 288) for a picture
        if self.args.modality == "onehot":
            return features.unflatten(-1, (-1, CLASSES))  # (B, T, 160) -> (B, T, 2, 80)
        if self.args.modality not in VISUAL:
            return features
        pictures = self.conv_decoder(features.flatten(0, 1))  # twice (B * T, 1, S, S)
        picture, mask = (some.unflatten(0, features.shape[:2]) for some in pictures)
        # Temporal skip connection: where the mask is shut, the first frame shows through.
        # appendix: mask * picture + frame; published code: mask * picture + (1 - mask) * frame; we
        # do as the code, since the plain sum leaves the range of a pixel.
        video = self.args.modality == "video"
        return mask * picture + (1 - mask) * frame if video else picture

    def forward(self, raw):
        """Raw observations (A, n, ...) -> loss and its parts, each per observation."""
        x, target = prepare(raw.flatten(0, 1), self.args)  # (B, ...)
        states, h = self.encode(x)
        latents, kl_z, kl_c = self.infer(h, raw.shape[1])
        output = self.decode(states[:, 0], x[:, :1], *latents)
        if self.args.modality == "onehot":
            likelihood = Categorical(logits=output, validate_args=False)
            error = (output.argmax(-1) != target).float()  # share of wrong classes
        else:
            likelihood = normal(output, self.log_var.clamp(*LOG_VAR_RANGE))
            error = (output - target) ** 2
        rec = likelihood.log_prob(target).flatten(1).sum(1).mean()  # sum over states and features
        # One c serves the whole set, so each of its observations bears a part of the price of c.
        kl_z, kl_c = kl_z.sum(-1).mean(), kl_c.sum(-1).mean() / self.args.set_size
        # published code: rec * w and KL / w with w = 1 + 0.5^epoch: no effect after a few epochs.
        return dict(loss=kl_z + kl_c - rec, rec=rec, kl_z=kl_z, kl_c=kl_c, error=error.mean())


class HVAE(ObservationModel):
    """c for the action, z for the observation, x decoded from both."""

    def __init__(self, args, shape):
        size, hidden = args.representation_size, args.hidden
        super().__init__(args, shape, latents=(size, size))
        if args.recipe != "paper":
            linear = {"gridworld-xy": shape[0] * shape[1], "stacking-image": CONV_FEATURES}
            self.numbers = linear.get(f"{args.env}-{args.modality}", 0)
        self.q_c = ActionInference(hidden + self.numbers, args.q_hidden, size, self.numbers)
        self.q_z = ObservationInference((hidden + self.numbers, size), hidden, size)
        self.p_z = ObservationInference((size,), hidden, size)
        self.apply(initialise)

    def infer(self, h, n):
        """Encoded observations (B, H) -> latents (z, c), KL of z (B, Z), KL of c (A, C)."""
        q_c = self.q_c(h.unflatten(0, (-1, n)))  # from (A, n, H)
        c = q_c.rsample().repeat_interleave(n, 0)  # one draw per set: (A, C) -> (B, C)
        q_z, p_c = self.q_z(h, c), Normal(0.0, 1.0)
        return (q_z.rsample(), c), kl_divergence(q_z, self.p_z(c)), kl_divergence(q_c, p_c)

    def represent(self, h):
        """The mean of q(c | X), from encoded observations (A, n, H): (A, C)."""
        return self.q_c(h).mean


class VAE(ObservationModel):
    """The non-hierarchical baseline (B): each observation for itself, averaged at the end."""

    # published code: a quarter of the HVAE's updates, another initialisation, and the mean of 62 or
    # 128 observations; we give both models the same, but for the linear path, which the VAE lacks.
    def __init__(self, args, shape):
        size, hidden = args.representation_size, args.hidden
        super().__init__(args, shape, latents=(size,))
        self.q_z = ObservationInference((hidden,), hidden, size)
        self.apply(initialise)

    def infer(self, h, n):
        """Encoded observations (B, H) -> latents (z,), KL of z (B, Z), and no KL of c."""
        q_z = self.q_z(h)
        return (q_z.rsample(),), kl_divergence(q_z, Normal(0.0, 1.0)), torch.zeros_like(h[:1])

    def represent(self, h):
        """The mean over observations of the means of q(z | x): (A, Z)."""
        return self.q_z(h.flatten(0, 1)).mean.unflatten(0, h.shape[:2]).mean(1)  # from (A, n, Z)


# ---- training ----


def write(path: Path, save) -> None:
    """Call save(file) on a temporary file, then rename: nobody ever reads half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        with open(temporary, "wb") as file:
            save(file)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def observe(module, ids: np.ndarray, args: Args) -> np.ndarray:
    """Raw observations (len(ids), n, ...), recorded once for all encoders."""

    def record(some: np.ndarray) -> np.ndarray:
        workers = os.cpu_count() or 1  # always seed 0: encoders differ by seed, not by data
        return module.action_observations(some, args.observations, args.modality, 0, workers)

    def save(file) -> None:
        # Pictures of all actions do not fit in memory, so they come in pieces: (128, n, ...).
        piece = 128 if args.modality in VISUAL else len(ids)
        for i in range(0, len(ids), piece):
            data = record(ids[i : i + piece])
            if i == 0:
                header = dict(descr=data.dtype.str, shape=(len(ids), *data.shape[1:]))
                np.lib.format.write_array_header_1_0(file, header | dict(fortran_order=False))
            file.write(data.tobytes())

    if args.env == "gridworld":
        return record(ids)  # takes a second
    key = hashlib.sha256(fingerprint(module).encode() + ids.tobytes()).hexdigest()[:8]
    name = f"{args.env}-{args.modality}-{args.observations}-s0-v{OBSERVATIONS_VERSION}-{key}.npy"
    path = Path(args.runs_dir) / "observations" / name
    try:
        if not path.exists():
            write(path, save)
    except OSError as e:  # no such folder, no room
        print(f"note: observations stay in memory, cannot keep them in {path.parent}: {e}")
        return record(ids)
    return np.load(path, mmap_mode="r")  # only what is used is in memory (810 shapes: 5.9 GB)


def fit(model, data: np.ndarray, rows: np.ndarray, args: Args) -> list[dict]:
    """Maximise the objective on data[rows]; return the losses of every update."""
    device = next(model.parameters()).device
    # Ours: a free log-variance moves by its rate per update: 10,000 of them to the published -9.
    rates = args.learning_rate, args.learning_rate * (1 if args.recipe == "paper" else 10)
    parameters = model.named_parameters()
    groups = [dict(params=p, lr=rates[name.endswith("log_var")]) for name, p in parameters]
    optimizer = torch.optim.RAdam(groups)  # D.1
    batch = min(args.batch_size, len(rows))
    per_epoch = len(rows) // batch  # an incomplete last batch is left out
    updates = args.updates or args.epochs * per_epoch
    rng, losses, n = np.random.default_rng(args.seed), [], args.batch_observations
    model.train()
    for update in (bar := tqdm(range(updates), "training", unit="update", disable=None)):
        if update % per_epoch == 0:
            order = rng.permutation(rows)
        actions = order[update % per_epoch * batch :][:batch, None]  # (A, 1)
        # n different observations of each: where the n smallest of random numbers are. (A, n)
        picks = rng.random((batch, data.shape[1])).argpartition(n - 1)[:, :n]
        parts = model(torch.from_numpy(data[actions, picks]).to(device))  # (A, n, ...)
        # All of the objective counts once the warm-up is over; the log always shows all of it.
        waived = max(0.0, 1 - (update + 1) / (args.kl_warmup * updates + 1))
        loss = parts["loss"] - waived * (parts["kl_z"] + parts["kl_c"])
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_value_(model.parameters(), GRADIENT_CLIP)
        optimizer.step()
        losses.append({key: value.item() for key, value in parts.items()})
        bar.set_postfix(losses[-1], refresh=False)
        if not np.isfinite(losses[-1]["loss"]):
            raise ValueError(f"the loss is {losses[-1]['loss']} at update {update + 1}")
    return losses


@torch.no_grad()
def embed(model, data: np.ndarray, ids: np.ndarray, args: Args) -> np.ndarray:
    """Tables (3, NUM_ACTIONS, C): from all observations, and from two halves of them."""
    device = next(model.parameters()).device
    model.eval()  # running statistics: a representation does not depend on its neighbours
    num_actions = load_environment(args.env).NUM_ACTIONS
    tables = np.zeros((3, num_actions, args.representation_size), np.float32)
    for action, raw in zip(tqdm(ids, "embedding", delay=2, disable=None), data, strict=True):
        x, _ = prepare(torch.tensor(raw).to(device), args)  # (n, ...)
        h = model.encode(x)[1][None]  # (1, n, H)
        three = [model.represent(some) for some in (h, h[:, ::2], h[:, 1::2])]
        tables[:, action] = torch.cat(three).cpu()
    return tables


def train(args: Args) -> Path:
    """Train an encoder, write its table; return its path, `representation_path(args)`."""
    # Beside the .npz: .pt (weights), .csv (losses), .json (`probe` scores) and -tsne.png.
    check(args)
    module, path = load_environment(args.env), representation_path(args)
    split = module.split_actions(args.split, args.split_seed)
    pool = np.unique(np.concatenate(list(split.values())))
    ids = pool if args.train_on == "all" else split["train"]
    devices = ["cpu"] + ["cuda"] * torch.cuda.is_available()
    device = devices[-1] if args.device == "auto" else args.device
    if device not in devices:
        raise ValueError(f"device {device!r} is not available; allowed: auto, {devices}")
    path.parent.mkdir(parents=True, exist_ok=True)  # now: fails before the training, not after
    data = observe(module, pool, args)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # networks are small: a second thread waits more than it works
    # The caller's random numbers stay as they are, whether a table was there or not.
    with torch.random.fork_rng(range(torch.cuda.device_count())):
        torch.manual_seed(args.seed)
        model = (HVAE if args.hierarchical else VAE)(args, data.shape[2:]).to(device)
        losses = fit(model, data, np.searchsorted(pool, ids), args)
        tables = embed(model, data, pool, args)
    torch.set_num_threads(threads)
    write(path.with_suffix(".pt"), lambda file: torch.save(model.cpu().state_dict(), file))
    rows = [list(row.values()) for row in losses]
    form = dict(fmt="%.6g", delimiter=",", header=",".join(losses[0]), comments="")
    write(path.with_suffix(".csv"), lambda file: np.savetxt(file, rows, **form))
    config = {k: v for k, v in asdict(args).items() if k not in ("device", "runs_dir")}
    save_representation(path, tables[0], ids, config)
    report(path, tables, args)
    return path


# ---- the file of representations ----


def representation_path(args: Args) -> Path:
    """Where `train(args)` writes its table."""
    # With a hash of what differs: who asks for a recipe's table never finds an experiment's.
    model = ("hvae" if args.hierarchical else "vae") + "-all" * (args.train_on == "all")
    name = f"{args.env}-{args.modality}-{model}-{args.split}{args.split_seed}-{args.recipe}"
    default = asdict(default_args(args.env, args.recipe, args.modality))
    named = "hierarchical train_on split split_seed seed device runs_dir".split()
    differs = {k: v for k, v in asdict(args).items() if v != default[k] and k not in named}
    changes = hashlib.sha256(json.dumps(differs, sort_keys=True).encode()).hexdigest()[:8]
    name += f"-s{args.seed}" + f"-{changes}" * bool(differs)
    return Path(args.runs_dir) / "hvae" / f"{name}.npz"


def fingerprint(module) -> str:
    """Hash of an environment's action set: its labels and engineered representations."""
    # In thousandths: the last bits of a sine may differ from machine to machine.
    numbers = np.round(np.asarray(module.engineered_representations(), np.float64) * 1000)
    labels = "\n".join(module.action_labels()).encode()
    return hashlib.sha256(labels + numbers.astype("<i8").tobytes()).hexdigest()[:16]


def save_representation(path, mean: np.ndarray, action_ids: np.ndarray, config: dict) -> Path:
    """Write a table that `load_representation` accepts, whoever made it; return its path.

    mean: (NUM_ACTIONS, D). action_ids: what the encoder was trained on, or []. config: whatever
    JSON can hold; "env" must be in it, "split" and "split_seed" are checked at loading.
    Raises ValueError for an unknown environment, wrong shapes, infinite numbers.
    """
    path, module, ids = Path(path), load_environment(config.get("env")), np.asarray(action_ids)
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused
        mean, number = np.asarray(mean).astype(np.float32), module.NUM_ACTIONS
    if mean.ndim != 2 or len(mean) != number or not np.isfinite(mean).all():
        raise ValueError(f"{path}: mean must be finite and ({number}, D), got {mean.shape}")
    if len(set(ids.tolist())) < len(ids) or not set(ids.tolist()) <= set(range(number)):
        raise ValueError(f"{path}: action_ids must be distinct integers in 0..{number - 1}")
    text = np.array(json.dumps(config | dict(fingerprint=fingerprint(module)), sort_keys=True))
    write(path, lambda file: np.savez(file, mean=mean, action_ids=ids.astype(int), config=text))
    return path


def load_representation(path, env: str, split: str = "default", split_seed: int = 0) -> dict:
    """Read a table; make sure that it belongs to this environment, action set and split.

    Returns mean (NUM_ACTIONS, D) float32, action_ids int64, and config, a dict.
    Raises FileNotFoundError without a file, ValueError if it is damaged or belongs elsewhere.
    """
    module, path = load_environment(env), Path(path)
    path.stat()  # FileNotFoundError
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            mean, ids, config = file["mean"], file["action_ids"], json.loads(str(file["config"]))
        found = config.get("env")
    except Exception as e:  # zip, npy and JSON each have errors of their own for a damaged file
        reason = str(e).split("\n")[0]
        raise ValueError(f"{path} is not a file of representations: {reason}") from None
    if found != env:
        raise ValueError(f"{path} belongs to {found!r}, not to {env!r}")
    if config.get("fingerprint") != fingerprint(module):
        raise ValueError(f"{path} belongs to another action set of {env}: make it again")
    # A table of your own that names no split belongs to every split.
    for key, wanted in (("split", split), ("split_seed", split_seed)):
        if config.get(key, wanted) != wanted:
            raise ValueError(f"{path} has {key} {config[key]!r}, wanted {wanted!r}")
    if config.get("train_on") == "train":  # the split of that name may have changed since
        if not np.array_equal(np.sort(ids), module.split_actions(split, split_seed)["train"]):
            raise ValueError(f"{path} was trained on other actions than split {split!r} has")
    return dict(mean=mean, action_ids=ids, config=config)


# ---- how good is a table? ----

PUBLISHED = {  # scores of the released 10,000-epoch tables: net_r2, move_accuracy, nn_net_match
    "gridworld-xy-hvae": (0.946, 0.604, 0.717),
    "gridworld-xy-hvae-all": (0.970, 0.705, 0.721),
    "gridworld-xy-vae": (0.908, 0.496, 0.496),
    "gridworld-onehot-hvae": (0.942, 0.669, 0.541),
    "gridworld-onehot-vae": (0.368, 0.424, 0.131),
}


def probe(mean, train_ids, held_out_ids, env="gridworld", halves=None) -> dict[str, float]:
    """What a table tells: read-outs fitted on train actions, scored on others."""
    from scipy.spatial.distance import cdist
    from sklearn.linear_model import LogisticRegression, RidgeCV
    from sklearn.metrics import r2_score

    module = load_environment(env)
    spread = mean[train_ids].std(0)
    x = (mean - mean[train_ids].mean(0)) / np.where(spread > 1e-6, spread, 1)
    seen, new = x[train_ids], x[held_out_ids]

    def linear(y: np.ndarray) -> float:  # R^2, mean over the features that vary
        y = y[:, (y[train_ids].std(0) > 1e-6) & (y[held_out_ids].std(0) > 1e-6)]
        predicted = RidgeCV(np.logspace(-4, 4, 17)).fit(seen, y[train_ids]).predict(new)
        return r2_score(y[held_out_ids], predicted.reshape(len(new), -1))

    scores, near = {}, cdist(mean[held_out_ids], mean[train_ids])  # (held out, train)
    if env == "gridworld":
        moves = np.arange(len(mean)) // 4 ** np.arange(5)[:, None] % 4  # A.1: (5, 1024) move ids
        net = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[moves].sum(0)  # (1024, 2)
        scores["net_r2"] = linear(net)  # read-out of the net displacement
        # Logistic read-outs of the five moves, mean; by chance 0.25.
        hits = []
        for move in moves:
            model = LogisticRegression(max_iter=2000).fit(seen, move[train_ids])
            hits.append(model.score(new, move[held_out_ids]))
        scores["move_accuracy"] = np.mean(hits)
        # Share of skills whose nearest train skill has the same net displacement.
        match = net[train_ids][near.argmin(1)] == net[held_out_ids]
        scores["nn_net_match"] = match.all(1).mean()
    # Share of actions whose nearest other held-out action has the same label, as the eye sees it in
    # Figures 4-6; and that for a random other one.
    labels = np.asarray(module.action_labels())[held_out_ids]
    gaps, same = cdist(mean[held_out_ids], mean[held_out_ids]), labels == labels[:, None]
    np.fill_diagonal(gaps, np.inf)
    scores["nn_class"] = same[np.arange(len(same)), gaps.argmin(1)].mean()
    scores["chance_class"] = (same.sum() - len(same)) / (len(same) ** 2 - len(same))
    # Linear read-out of the engineered features.
    scores["engineered_r2"] = linear(np.asarray(module.engineered_representations()))
    if halves is not None:
        # Distance between tables from two halves of the observations, over that to the nearest
        # train action (both RMS): what a table owes to the draw of its observations.
        noise = ((halves[0] - halves[1])[held_out_ids] ** 2).sum(1).mean()
        scores["draw_noise"] = np.sqrt(noise / (near.min(1) ** 2).mean())
    return {key: round(float(value), 4) for key, value in scores.items()}


def report(path: Path, tables: np.ndarray, args: Args) -> None:
    """Scores on the held-out actions: one line, <name>.json, and the t-SNE picture."""
    module = load_environment(args.env)
    split = module.split_actions(args.split, args.split_seed)
    train_ids, name = split["train"], path.stem.split(f"-{args.split}{args.split_seed}-")[0]
    held_out = np.concatenate([split["valid"], split["test"]])
    held_out = np.setdiff1d(held_out, train_ids)  # CREATE's no-op is on both sides
    scores = probe(tables[0], train_ids, held_out, args.env, tables[1:])
    truth = probe(module.engineered_representations(), train_ids, held_out, args.env)
    published = dict(zip(scores, PUBLISHED.get(name, ()), strict=False))
    record = json.dumps(dict(scores=scores, engineered=truth, published=published)) + "\n"
    write(path.with_suffix(".json"), lambda file: file.write(record.encode()))
    title = f"{name}, split {args.split}: {len(held_out)} held-out actions"
    words = ", ".join(f"{key} {value:.3f}" for key, value in scores.items())
    print(f"{title}: {words}" + f" (published: {published})" * bool(published))
    labels, picture = np.asarray(module.action_labels()), path.with_name(f"{path.stem}-tsne.png")
    plot_tsne(tables[0][held_out], labels[held_out], picture, title)


def plot_tsne(mean: np.ndarray, labels: np.ndarray, path: Path, title: str) -> None:
    """Figures 4-6: representations (count, D) by t-SNE, one hue and mark per label."""
    os.environ.pop("MPLBACKEND", None)  # a notebook's, inherited, can end the import
    from matplotlib.figure import Figure
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    perplexity = min(10, (len(mean) - 1) / 3)  # published code: 10
    with threadpool_limits(1):  # a second thread only waits where other programs run: minutes
        places = TSNE(perplexity=perplexity, init="pca", random_state=0).fit_transform(mean)
    figure = Figure(figsize=(6.5, 5), layout="constrained")
    axes, names = figure.subplots(), sorted(set(labels))
    # Hues of the published code; neighbours in the circle of hues also differ in their marks.
    for i, name in enumerate(names):
        colour = colorsys.hls_to_rgb((i / len(names) + 0.7) % 1, 0.6, 0.9)
        look = dict(s=22, color=colour, marker="os^D"[i % 4], linewidths=0.3, edgecolors="#0008")
        axes.scatter(*places[labels == name].T, label=str(name), **look)
    axes.set(xticks=[], yticks=[], frame_on=False)
    axes.set_title(title, fontsize=10)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, fontsize=8)
    write(path, lambda file: figure.savefig(file, dpi=120))


def parse_args(words: list[str]) -> Args:
    """Args of a command line; --help shows the numbers of *its* environment and recipe."""
    # Three words decide the defaults, so it is read twice. "" stands for the paper's modality.
    first = default_args()
    first.modality = ""
    first = tyro.cli(Args, args=[w for w in words if w not in ("-h", "--help")], default=first)
    default = default_args(first.env, first.recipe, first.modality)
    return tyro.cli(Args, args=words, default=default, description=__doc__)


def main(args: Args) -> None:
    """Train what the command line says."""
    print(f"representations: {train(args)}")


if __name__ == "__main__":
    try:
        main(parse_args(sys.argv[1:]))
    except (ValueError, OSError) as e:
        raise SystemExit(f"error: {e}") from None
