"""Action representations: a hierarchical VAE over sets of action observations (appendix B, D.3.1).

The policy sees every action, known or new, as a vector. This file computes that vector from what
the action was seen to do: a set X = {x_1 .. x_n} of trajectories, videos or pictures. One latent c
explains what the set shares (the action), a latent z_j what is special to x_j (a ball's launch, a
camera angle). The first state s_j of x_j is not predicted but given to the decoder (a picture has
none). The model, and its bound from the main paper, with c ~ q(c | X) and z_j ~ q(z_j | x_j, c):

        c ~ N(0, I)  ->  z_j ~ p(z | c)  ->  x_j ~ p(x | z_j, c, s_j)
    ELBO per observation = mean_j [ log p(x_j | z_j, c, s_j) - KL(q(z_j | x_j, c) || p(z_j | c)) ]
                           - KL(q(c | X) || N(0, I)) / |X|

Only `--recipe paper` divides the last term by |X|; the recipes quick and fast by more: a weaker KL
(a beta-VAE, beta < 1), so that more dimensions of c carry information. The representation of an
action is the mean of q(c | X). A split has three parts: train, valid, test. The networks learn from
the first and CREATE's no-op; with `--train-on all`, the oracle encoder, from all three.
In the end every action of the three and the no-op get a row of a table; ids in no part keep zeros.

    python hvae.py gridworld                     # recipe fast, the default
    python hvae.py gridworld --no-hierarchical   # appendix B: the plain VAE baseline
    python hvae.py gridworld --train-on all      # the oracle encoder: trained on all parts
    python hvae.py create --modality video       # appendix B; or its Full Split: --split full
    python hvae.py gridworld --recipe paper      # Tables 3-4, days on a CPU; --help: its numbers
    python hvae.py my_env.py                     # an environment of your own, in a file

Your file defines NUM_ACTIONS, MODALITIES (the first is the default); if needed SPLITS (names),
NO_OP (an id), UNITS (a dict, see `prepare`); and

    split_actions(split, seed) -> {"train": ids, "valid": ids, "test": ids}
    action_labels() -> (NUM_ACTIONS,), engineered_representations() -> (NUM_ACTIONS, D): classes and
        known facts, for scores and pictures; the encoder never sees them
    action_observations(ids, count, modality, seed, workers) -> array (len(ids), count, ...)

An observation is (L, F), L states of F numbers each. Of modality "onehot" it is (L, 2), a cell's x
and y as whole numbers 0-79, at most 39 from the first and previous state's (see `prepare`). Of
"image" it is (S, S), of "video" (L, S, S), greys 0-255, S 48 or 84. Draw an action's random numbers
from (seed, id) alone: a call, or one of its `workers` processes, gets only some of the ids.
Marks: "appendix", that of Generalization to New Actions in RL (ICML 2020); [code], the authors'
program; [here], our choice, and why. Where several are named, the file does the last.
"""

import hashlib
import importlib
import io
import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import torch.nn as nn
import tyro
from torch.distributions import Categorical, Normal, kl_divergence
from tqdm import tqdm

# Paper map (sections of the appendix): D.2 (Tables 3-4) -> Args, HYPERPARAMETERS; D.3.1 -> the
# networks, in its order; its loss -> ObservationModel.forward; B -> prepare, VAE; D.1 -> fit;
# Figures 4-6 -> plot_tsne. Table 4's "MLP hidden layers 3": D.3.1 gives each MLP its own depth.
# Shapes: A actions in a batch, N recorded observations of each, n in an update, B = A * n; L states
# per observation, the first given, T = L - 1 predicted (a picture is 1 state, predicted); F numbers
# of a state: as recorded or, in networks, 160 if one-hot, 288 of a frame; C numbers in c, Z in z; H
# hidden; E in an encoded observation: H, or H + L * F with --linear-path; S side of a picture.

# Name on the command line -> module. (The Recommender has no encoder: for `load_representation`.)
ENVIRONMENTS = dict(
    gridworld="gridworld", recsys="recsys", create="create_env", stacking="stacking_env"
)
VISUAL = ("image", "video")  # modalities that pass the convolutions; all others are trajectories
CLASSES = 80  # appendix B: "two 80-dimensional one-hot vectors"
RECIPES = ("quick", "fast", "paper")


@dataclass(kw_only=True)
class Args:
    """Train an action encoder. The numbers depend on the first three: `default_args`."""

    env: Annotated[str, tyro.conf.Positional]  # gridworld, create, stacking, or a file: my_env.py
    modality: str  # create: state (default, [code]'s: 6 numbers), xy (as in B), video
    recipe: Literal[RECIPES]  # which column of HYPERPARAMETERS gives the numbers
    hierarchical: bool = True  # HVAE; --no-hierarchical: the plain VAE baseline
    train_on: Literal["train", "all"] = "train"  # all: the oracle encoder, on all parts
    linear_path: bool = False  # the mean of c (VAE: of z) has a linear part (not the paper's)
    split: str = "default"  # name of the split of the actions: default, full, ...
    split_seed: int = 0  # seed of the split
    seed: int = 0  # seed of weights, batches and latent samples
    device: Literal["auto", "cpu", "cuda"] = "auto"  # auto: a GPU if there is one
    runs_dir: str = "runs"  # tables go to <runs_dir>/hvae, recordings to <runs_dir>/observations
    representation_size: int  # size of c and of z
    batch_size: int  # actions in an update
    epochs: int  # passes over the training actions, or 0: updates says how long
    updates: int  # number of updates, or 0: epochs says how long
    learning_rate: float  # of RAdam (D.1)
    hidden: int  # default width of the networks
    q_hidden: int  # width of q(c|X)
    observations: int  # recorded of each action; its representation comes from all of them
    batch_observations: int  # observations of each action in an update
    kl_c_divisor: int  # divides KL(q(c|X) || N(0, I)); in the ELBO: batch_observations
    relative: bool  # trajectories: moves are read, offsets from the first state predicted
    kl_warmup: float = 0.0  # share of the updates in which the weight of the KLs climbs to 1
    compact_lstm: bool  # a Bi-LSTM of half the width, directions concatenated (none in pictures)
    log_var_start: float | None  # initial log-variance of the decoder (None: from N(0, 1))
    log_var_rate: float  # factor on the learning rate of log-variances that are free parameters


# ---- Tables 3 and 4 ----

# Args explains the rows. "paper" has the tables' numbers (pictures, videos: see below); "fast", the
# default, takes minutes on a CPU, more for pictures; "quick" is shorter, or the same. [here] Both
# are tuned by hand, by the scores of `probe` on all held-out actions (D.2.1: on validation's).
# fmt: off
HYPERPARAMETERS = {  # of Grid World and files of your own; columns: quick, fast, paper
    "representation_size": (16,    16,    16),      # Table 3
    "batch_size":          (128,   128,   128),     # Table 3
    "epochs":              (0,     0,     10_000),  # Table 3
    "updates":             (2_000, 2_000, 0),
    "learning_rate":       (1e-3,  1e-3,  1e-3),    # Table 4
    "hidden":              (64,    64,    64),      # Table 4
    "q_hidden":            (128,   128,   128),     # Table 4
    "observations":        (64,    64,    1024),    # Table 4; 64: more gave no better policy
    # Skills' observations differ only in the start: 4 show it, many small updates beat few large.
    # appendix: 1,024 (recorded or used?); [code] 45 to 672; [here] "paper": all, 52 of pictures.
    "batch_observations":  (4,     4,     1024),
    # With the ELBO's |X|, here 4, c uses only 5 of its 16 dimensions; with 64, 10 (exercises/).
    "kl_c_divisor":        (64,    64,    1024),
    # Grid World's raw cells run from 1 to 78, a move changes them by 1: the networks would first
    # have to learn to subtract. Differences show the skill from the first update.
    "relative":            (True,  True,  False),
    # A Bi-LSTM of half the width has 0.26 to 0.35 of the weights, 0.6 of the time of an update.
    "compact_lstm":        (True,  True,  False),
    # RAdam moves a parameter by the learning rate per update at most: 2,000 times 1e-3 is 2, but a
    # log-variance has to fall from 0 to the clamp at -4 (ObservationModel.forward). So the
    # decoder's starts lower; it and those of z learn 10 times as fast (neither was tried alone).
    "log_var_start":       (-2.0,  -2.0,  None),
    "log_var_rate":        (10.0,  10.0,  1.0),
}
# In place of rows above: the entry of the modality or, if there is none, of the environment.
EXCEPTIONS = {
    "onehot": {"updates": (2_000, 4_000, 0)},  # it takes longer to learn what 160 numbers mean
    # With other numbers in these rows the model ignored z (how the ball had been launched): the
    # squared error, in units of `step` (see prepare), stayed near 6.5; now < 1.
    "create": {
        "representation_size": (128,   128,   128),     # Table 3
        "learning_rate":       (3e-3,  3e-3,  1e-3),
        "batch_observations":  (8,     8,     1024),
        "kl_c_divisor":        (1024,  1024,  1024),    # as if an update had Table 4's 1,024
        "kl_warmup":           (0.5,   0.5,   0.0),
        "updates":             (1_250, 2_500, 0),
        "observations":        (128,   1024,  1024),    # quick: a minute of recording
    },
    "image": {
        "representation_size": (128,   128,   128),     # Table 3
        "batch_size":          (16,    16,    32),      # Table 3
        "observations":        (64,    1024,  1024),
        "epochs":              (0,     0,     5_000),   # Table 3
        "hidden":              (128,   128,   128),     # appendix: 64; [code] and [here] 128
        "learning_rate":       (2e-3,  2e-3,  1e-3),
        "batch_observations":  (4,     4,     52),      # [code]; needs 4.8 GB, 1,024 about 94
        "kl_c_divisor":        (1024,  1024,  52),      # fast: as in CREATE
        "kl_warmup":           (0.5,   0.5,   0.0),
        "updates":             (1_000, 1_500, 0),
        # Not the paper's. Without it c collapses: nn_class (see probe) is 0.28 to 0.84, not 0.91.
        "linear_path":         (True,  True,  False),
    },
}
# appendix: Table 3 has one column for all of CREATE; [code] its videos have the numbers of Shape
# Stacking's pictures, but 45 observations in an update; [here] as the code, but 52.
EXCEPTIONS["video"] = EXCEPTIONS["image"] | {
        "updates":             (200,   600,   0),
        "observations":        (16,    128,   1024),    # 1,024 of every tool: 35 GB
        "linear_path":         (False, False, False),   # not tried here
}
# fmt: on


class UserError(Exception):
    """An expected mistake of the user, told in one sentence; other errors keep their traceback."""


def choose(what: str, value: str, allowed) -> None:
    """UserError unless `value` is one of the allowed names."""
    if value not in allowed:
        raise UserError(f"unknown {what} {value!r}; allowed: {', '.join(map(str, allowed))}")


def load_environment(name: str):
    """The module of an environment, by its name or by the path of a file of one's own."""
    if name in ENVIRONMENTS:
        try:
            return importlib.import_module(ENVIRONMENTS[name])
        except ModuleNotFoundError as error:  # stacking_env says in a sentence what is missing
            raise UserError(str(error)) from error
    path = Path(name).resolve()
    if path.suffix != ".py" or not path.is_file():
        raise UserError(f"unknown environment {name!r}; allowed: {', '.join(ENVIRONMENTS)}, *.py")
    # Worker processes must be able to import this file by its name, so its folder goes on sys.path.
    if path.stem not in sys.modules:
        sys.path.insert(0, str(path.parent))
    module = importlib.import_module(path.stem)
    if Path(module.__spec__.origin).resolve() != path:
        raise UserError(f"Python has another module called {path.stem!r}: rename {name}")
    return module


def environment_name(name: str) -> str:
    """What an environment is called in the names of files: "my_env" for ./folder/my_env.py."""
    return Path(name).stem


def default_args(env: str, recipe: str = "fast", modality: str | None = None) -> Args:
    """Args with all numbers of an environment, a recipe and a modality (None: its first)."""
    module = load_environment(env)
    if not module.MODALITIES:
        raise UserError(f"{env} has no action observations, only engineered representations")
    modality = modality or module.MODALITIES[0]
    choose("modality", modality, module.MODALITIES)
    table = HYPERPARAMETERS | EXCEPTIONS.get(modality, EXCEPTIONS.get(env, {}))
    numbers = {name: row[RECIPES.index(recipe)] for name, row in table.items()}
    return Args(env=env, modality=modality, recipe=recipe, **numbers)


# ---- observations as the networks see them (appendix B) ----


def prepare(raw, args):
    """Raw observations (B, ...) -> what the encoder reads, what is to be reconstructed."""
    # Pictures (B, 1, 1, S, S) twice; videos (B, L, 1, S, S), (B, T, 1, S, S); trajectories
    # (B, L, F), (B, T, F); one-hot (B, L, 160), and class numbers (B, T, 2).
    raw = raw.float()
    if args.modality in VISUAL:
        frames = raw.unsqueeze(-3) / 255 - 0.5  # [code] greys to [-0.5, 0.5]
        if args.modality == "video":
            return frames, frames[:, 1:]
        return frames[:, None], frames[:, None]

    # Relative trajectories are read as a first state and moves, which tell directly what each step
    # did; they are predicted as places relative to the first state, so that errors do not add up.
    first = raw[:, :1]  # (B, 1, F)
    later = raw[:, 1:]  # (B, T, F)
    moves = raw.diff(dim=1)  # (B, T, F)
    if args.modality == "onehot":
        # The input has 80 zeros and ones for x and for y, the target one class number for each.
        if args.relative:
            # Later states become offsets + 40 (class 40: no change): from the state before in the
            # input, from the first state in the target.
            raw = torch.cat([first, moves + CLASSES // 2], 1)
            later = later - first + CLASSES // 2
        one_hot = nn.functional.one_hot(raw.long(), CLASSES)  # (B, L, 2, 80)
        return one_hot.flatten(2).float(), later.long()
    if not args.relative:
        return raw, later  # recipe paper: the numbers as they were recorded [code]
    # UNITS, a dict: first states become (x - centre) / half_width; all else is divided by `step`.
    # Choose `step` so that actions differ by more than 0.135 of it: the decoder's log-variance is
    # clamped at -4 (ObservationModel.forward), its sigma at exp(-4 / 2) = 0.135.
    units = getattr(load_environment(args.env), "UNITS", dict(centre=0, half_width=1, step=1))
    start = (first - units["centre"]) / units["half_width"]
    return torch.cat([start, moves / units["step"]], 1), (later - first) / units["step"]


# ---- D.3.1: the networks, in its order; first what they share ----


class Residual(nn.Module):
    """`layers` linear layers with ReLU between them, then ReLU(out + input)."""

    # appendix: "MLP"; [code] such residual blocks; [here] as the code, which made the results.
    def __init__(self, width, layers):
        super().__init__()
        stack = [nn.Linear(width, width)]
        for _ in range(layers - 1):
            stack += [nn.ReLU(), nn.Linear(width, width)]
        self.layers = nn.Sequential(*stack)

    def forward(self, x):
        return torch.relu(self.layers(x) + x)


class SumReLU(nn.Module):
    """D.3.1: several vectors "passed through linear layers and then summed up", then ReLU."""

    def __init__(self, inputs, width):
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(size, width) for size in inputs)

    def forward(self, *inputs):
        return torch.relu(sum(linear(x) for linear, x in zip(self.linears, inputs, strict=True)))


class GlobalBatchNorm(nn.BatchNorm1d):
    """One mean, variance, gain and bias over batch *and* dimensions."""

    # D.3.1: "1D batch-norm"; [code] this one, its eps and momentum. A norm per dimension would
    # blow up the means of an unused dimension of c to variance 1, which costs KL.
    def __init__(self):
        super().__init__(num_features=1, eps=0.001, momentum=0.01)

    def forward(self, x):
        return super().forward(x.reshape(-1, 1)).reshape(x.shape)  # all numbers in one column


def normal(mean, log_var):
    # A diagonal Gaussian. PyTorch looks for no NaN here, to save time; `check_table` does later.
    return Normal(mean, (0.5 * log_var).exp(), validate_args=False)


def initialise(module):
    # [code] Linear layers: Xavier-normal with gain sqrt(2), bias 0.
    if isinstance(module, nn.Linear):
        nn.init.xavier_normal_(module.weight, gain=2**0.5)
        nn.init.zeros_(module.bias)


# Keys: side of a picture. Videos: 84 in appendix B; 48 in A.3, D.3.1, [code] and [here].
ENCODER_LAYERS = {48: 7, 84: 9}
ENCODER_CHANNELS = (8, 8, 16, 16, 16, 16, 32, 32, 32)  # [code] after each layer
DECODER_SIDES = {48: (6, 12, 24, 48), 84: (6, 11, 21, 42, 84)}  # [code] after each stage


def conv_encoder(side):
    """Convolutional Encoder: pictures (any, 1, S, S) -> (any, 288)."""
    choose("side of a picture", side, ENCODER_LAYERS)
    # A layer is a 3x3 convolution, batch norm and ReLU. Every other one halves the picture:
    # 48 -> 24 -> 12 -> 6 -> 3, or 84 -> 42 -> 21 -> 11 -> 6 -> 3.
    layers = []
    before = 1
    for i, after in enumerate(ENCODER_CHANNELS[: ENCODER_LAYERS[side]]):
        stride = 2 - i % 2  # 2, 1, 2, 1, ...
        layers += [nn.Conv2d(before, after, 3, stride, 1), nn.BatchNorm2d(after), nn.ReLU()]
        before = after
    return nn.Sequential(*layers, nn.Flatten())  # (B, 32, 3, 3) -> (B, 288)


class TrajectoryEncoder(nn.Module):
    """Bi-LSTM Encoder: sequences (B, L, F) -> (B, H), 2 layers, averaged over time [code]."""

    # appendix: to a 64-dimensional vector; [code] H per direction, directions averaged; [here] as
    # the code, or `compact`: H / 2 per direction, concatenated, which makes H, too.
    def __init__(self, features, hidden, compact):
        super().__init__()
        self.hidden = hidden
        width = hidden // 2 if compact else hidden
        self.lstm = nn.LSTM(features, width, num_layers=2, bidirectional=True, batch_first=True)

    def forward(self, x):
        h = self.lstm(x)[0].mean(1)  # (B, 2 * width): forward half, backward half
        return h.unflatten(1, (-1, self.hidden)).mean(1)  # (B, 2 or, compact, 1, H) -> (B, H)


class ActionInference(nn.Module):
    """Action Inference Network: encoded observations (A, n, E) -> q(c | X), Gaussian (A, C)."""

    def __init__(self, inputs, hidden, size):
        super().__init__()
        self.before = nn.Sequential(  # 4 linear layers, on each observation
            nn.Linear(inputs, hidden), nn.ReLU(), Residual(hidden, 2), nn.Linear(hidden, hidden)
        )
        # appendix: 3 layers; [code] 4 (a block of 3 and the output); [here] as the code.
        self.after = nn.Sequential(Residual(hidden, 3), nn.Linear(hidden, 2 * size))
        self.norm = GlobalBatchNorm()  # [code] one for mean and log-variance together

    def forward(self, h):
        # A mean ignores the order and takes any number: few in training, at the end all recorded.
        pooled = self.before(h).mean(1)  # (A, n, hidden) -> (A, hidden)
        return normal(*self.norm(self.after(pooled)).chunk(2, -1))  # (A, 2C) -> twice (A, C)


class ObservationInference(nn.Module):
    """Observation Inference Network: encoded x (B, E), c (B, C) -> q(z | x, c), Gaussian (B, Z)."""

    # Without x it is p(z | c) [code], without c the VAE's q(z | x). The batch norm: [code].
    def __init__(self, inputs, hidden, size):
        super().__init__()
        self.sum = SumReLU(inputs, hidden)
        self.layers = nn.Sequential(
            Residual(hidden, 2), Residual(hidden, 2), nn.Linear(hidden, size), GlobalBatchNorm()
        )
        # appendix: networks output the log-variances of q(z|x,c) and the decoder; [code] these and
        # that of p(z|c) are free parameters, first ~ N(0, 1); [here] too (decoder: log_var_start).
        self.log_var = nn.Parameter(torch.randn(size))

    def forward(self, *inputs):
        mean = self.layers(self.sum(*inputs))  # (B, Z)
        return normal(mean, self.log_var.expand_as(mean))


class ObservationDecoder(nn.Module):
    """Observation Decoder: first state (B, F), latents -> (B, T, F), the means of later states."""

    # One-hot: their logits. Frames: their features. A picture has no steps: latents -> (B, 1, F).
    def __init__(self, latents, features, hidden, steps):
        super().__init__()
        self.steps = steps
        self.sum = SumReLU(latents, hidden)
        if steps:
            self.start = nn.Sequential(nn.Linear(features, hidden), Residual(hidden, 2))  # 3 layers
            self.lstm = nn.LSTM(hidden, hidden, batch_first=True)
        self.output = nn.Sequential(Residual(hidden, 2), nn.Linear(hidden, features))  # 3 layers

    def forward(self, start, *latents):
        effect = self.sum(*latents)  # (B, H)
        if not self.steps:
            return self.output(effect)[:, None]
        # By this product the start can cancel the effect: beside a wall, a move does nothing.
        gated = effect * self.start(start)  # (B, H)
        # appendix: at which steps does the LSTM read it?; [code] a new product at each, with the
        # prediction of the step before; [here] one for all steps: simpler, no worse in one trial.
        sequence = gated[:, None].expand(-1, self.steps, -1)  # (B, T, H)
        return self.output(self.lstm(sequence)[0])  # (B, T, F)


def conv_decoder(side, mask):
    """Convolutional Decoder: (any, 288) -> greys (any, 1, S, S), (any, 2, S, S) with a mask."""
    # A stage is a 3x3 convolution, then a transposed one that doubles the picture, both with batch
    # norm and ReLU. The last layer is a 1x1 convolution; the sigmoid brings all into [0, 1].
    layers = [nn.Unflatten(1, (32, 3, 3))]
    before = 32
    for size in DECODER_SIDES[side]:
        after = 32 if size <= 12 else 16  # [code]
        # With stride 2, kernel 2 and padding 0 make 2n of n; kernel 3 and padding 1 make 2n - 1.
        odd = size % 2
        layers += [nn.Conv2d(before, before, 3, 1, 1), nn.BatchNorm2d(before), nn.ReLU()]
        double = nn.ConvTranspose2d(before, after, 2 + odd, 2, odd)  # kernel, stride, padding
        layers += [double, nn.BatchNorm2d(after), nn.ReLU()]
        before = after
    last = nn.Conv2d(before, 2 if mask else 1, 1)
    if mask:
        # Channel 0: the frame, 1: its mask (see decode). An untrained, grey frame is worse than the
        # first: its mask would go to 0, and with it its gradient. [here] White, as backgrounds.
        nn.init.constant_(last.bias[:1], 3.0)  # sigmoid(3) = .95
    return nn.Sequential(*layers, last, nn.Sigmoid())


# ---- appendix B: the two models; first what they share ----


class ObservationModel(nn.Module):
    """Encoder, decoder, likelihood; HVAE and VAE add `posterior`, `represent` and `infer`."""

    def __init__(self, args, shape, latents):
        # shape: of one raw observation, (L, F), (L, S, S) or (S, S). latents: their sizes.
        super().__init__()
        self.args = args
        features = shape[-1]  # F, of trajectories; other modalities correct these numbers below
        steps = shape[0] - 1  # T
        log_vars = features  # of the decoder: one per number or pixel, the same at all steps
        if args.modality == "onehot":
            features = CLASSES * shape[-1]
        if args.modality in VISUAL:
            features = 32 * 3 * 3  # [code] channels * height * width after the last convolution
            log_vars = (1, *shape[-2:])
            self.conv = conv_encoder(shape[-1])
            self.conv_decoder = conv_decoder(shape[-1], args.modality == "video")
            self.to(memory_format=torch.channels_last)  # [here] 1.4 times as fast on a CPU
        if args.modality == "image":
            # appendix: Bi-LSTM for trajectories; [code] pictures, too; [here] none: no sequence.
            steps = 0
            self.sequence = nn.Sequential(nn.Flatten(), nn.Linear(features, args.hidden), nn.ReLU())
        else:
            self.sequence = TrajectoryEncoder(features, args.hidden, args.compact_lstm)
        self.decoder = ObservationDecoder(latents, features, args.hidden, steps)
        if args.modality != "onehot":
            self.log_var = nn.Parameter(torch.randn(log_vars))
            if args.log_var_start is not None:
                nn.init.constant_(self.log_var, args.log_var_start)
        # What the inference networks read: H encoding numbers and, with --linear-path, the
        # inputs of the Bi-LSTM (or, of a picture, the features after the convolutions).
        self.encoded_size = args.hidden  # E
        self.path = None
        if args.linear_path:
            self.encoded_size += features * (steps + 1)
            self.path = nn.Linear(self.encoded_size, args.representation_size)

    def encode(self, x):
        # What `prepare` returns first -> start (B, F) (of a picture not used); encoded x (B, E).
        if self.args.modality in VISUAL:
            features = self.conv(x.flatten(0, 1))  # (B * L, 1, S, S) -> (B * L, 288)
            x = features.unflatten(0, x.shape[:2])  # (B, L, 288)
        h = self.sequence(x)
        if self.path:
            h = torch.cat([h, x.flatten(1)], 1)
        return x[:, 0], h

    def add_linear_path(self, q, h):
        # [here] The mean of c (VAE: of z) = Linear(h) + 0.1 * q.mean; the HVAE's h is averaged over
        # the set. Why this keeps c from collapsing is not known: found by trying.
        if self.path:
            q = Normal(self.path(h) + 0.1 * q.mean, q.stddev, validate_args=False)
        return q

    def decode(self, start, frame, *latents):
        # start: what the decoder conditions on; frame: the first picture itself, used only by the
        # skip connection of videos. Returns means, or logits, of what follows.
        features = self.decoder(start, *latents)  # (B, T, F), or (B, 1, 288) for a picture
        if self.args.modality == "onehot":
            return features.unflatten(-1, (-1, CLASSES))  # (B, T, 160) -> (B, T, 2, 80)
        if self.args.modality not in VISUAL:
            return features
        pixels = self.conv_decoder(features.flatten(0, 1))  # (B * T, 1 or 2, S, S)
        pixels = pixels.unflatten(0, features.shape[:2])  # (B, T, 1 or 2, S, S)
        picture = pixels[:, :, :1] - 0.5
        if self.args.modality == "image":
            return picture
        # Temporal skip connection: where the mask is 0, the first frame shows through. appendix:
        # mask * picture + frame; [code] as below; [here] as the code: a sum can leave [-0.5, 0.5].
        mask = pixels[:, :, 1:]
        return mask * picture + (1 - mask) * frame

    def forward(self, raw):
        # Raw observations (A, n, ...) -> the three terms of the objective.
        x, target = prepare(raw.flatten(0, 1), self.args)  # (B, ...), B = A * n
        start, h = self.encode(x)
        latents, kl_z, kl_c = self.infer(h.unflatten(0, raw.shape[:2]))
        output = self.decode(start, x[:, :1], *latents)
        if self.args.modality == "onehot":
            likelihood = Categorical(logits=output, validate_args=False)
        else:
            likelihood = normal(output, self.log_var.clamp(-4.0, 3.0))  # [code] the clamp
        # Sums over all that belongs to one observation (or c), then means over the batch. [code]
        # also has rec * w, KL / w, w = 1 + 0.5^epoch; [here] left out: w is 1 after a few epochs.
        rec = likelihood.log_prob(target).flatten(1).sum(1).mean()
        kl_z = kl_z.sum(-1).mean()
        kl_c = kl_c.sum(-1).mean() / self.args.kl_c_divisor
        return dict(rec=rec, kl_z=kl_z, kl_c=kl_c)


class HVAE(ObservationModel):
    """c for the action, z for the observation, x decoded from both."""

    def __init__(self, args, shape):
        size = args.representation_size
        super().__init__(args, shape, latents=(size, size))
        self.q_c = ActionInference(self.encoded_size, args.q_hidden, size)
        self.q_z = ObservationInference((self.encoded_size, size), args.hidden, size)
        self.p_z = ObservationInference((size,), args.hidden, size)
        self.apply(initialise)

    def posterior(self, h):  # q(c | X): encoded observations (A, n or N, E) -> Gaussian (A, C)
        return self.add_linear_path(self.q_c(h), h.mean(1))

    def represent(self, h):  # (A, N, E) -> representations (A, C)
        return self.posterior(h).mean

    def infer(self, h):
        # Encoded observations (A, n, E) -> latents (z, c), KL of z (B, Z), KL of c (A, C). One
        # sample of c for a set, one of z for each of its n observations.
        action = self.posterior(h)
        c = action.rsample().repeat_interleave(h.shape[1], 0)  # (A, C) -> (B, C)
        observation = self.q_z(h.flatten(0, 1), c)
        kl_z = kl_divergence(observation, self.p_z(c))
        kl_c = kl_divergence(action, Normal(0.0, 1.0))
        return (observation.rsample(), c), kl_z, kl_c


class VAE(ObservationModel):
    """The non-hierarchical baseline: encodes observations one by one, averages at the end."""

    # [code] A quarter of the HVAE's updates (CREATE: an eighth), another initialisation, 62 or 128
    # observations for a representation; [here] as the HVAE. No c: kl_c_divisor has no effect.
    def __init__(self, args, shape):
        size = args.representation_size
        super().__init__(args, shape, latents=(size,))
        self.q_z = ObservationInference((self.encoded_size,), args.hidden, size)
        self.apply(initialise)

    def posterior(self, h):  # q(z | x): encoded observations (A, n or N, E) -> (A, n or N, Z)
        return self.add_linear_path(self.q_z(h), h)

    def represent(self, h):  # (A, N, E) -> (A, N, Z) -> representations (A, Z)
        return self.posterior(h).mean.mean(1)

    def infer(self, h):
        # Encoded observations (A, n, E) -> latents (z,), KL of z (A, n, Z), and no KL of c.
        observation = self.posterior(h)
        kl_z = kl_divergence(observation, Normal(0.0, 1.0))
        return (observation.rsample().flatten(0, 1),), kl_z, torch.zeros(1)


# ---- training ----


def write(path: Path, save) -> None:
    """Write the file that save(file) makes: all of it or, if something fails, nothing."""
    memory = io.BytesIO()
    save(memory)
    write_pieces(path, [memory.getvalue()])


def write_pieces(path, pieces):
    """Write pieces of bytes to a temporary file, renamed in the end: nobody reads half a file."""
    temporary = path.with_name(f".{os.urandom(8).hex()}-{path.name}")
    try:
        for piece in pieces:  # may be a generator: its own errors are not caught
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                with open(temporary, "ab") as file:
                    file.write(piece)
            except OSError as error:
                raise UserError(f"cannot write {path} (is the disk full?): {error}") from error
        temporary.replace(path)
    finally:
        if temporary.exists():
            temporary.unlink()


def short_hash(data):
    return hashlib.sha256(repr(data).encode()).hexdigest()[:8]  # eight hexadecimal digits


def source_hash(*files):
    # Have files changed in any way? Then recordings are made anew; an old table prints a note.
    return short_hash([Path(file).read_bytes() for file in files])


def observe(module, ids, args):
    """Raw observations (len(ids), N, ...), recorded once per N, ids, modality."""
    N = args.observations
    kind = f"{environment_name(args.env)}-{args.modality}-{N}"
    source = source_hash(module.__file__)
    path = Path(args.runs_dir) / "observations" / f"{kind}-{source}-{short_hash(ids.tolist())}.npy"
    workers = os.cpu_count() or 1

    def pieces():
        # Not all pictures fit in memory: first the header of a .npy file, then 128 actions at a
        # time. Always seed 0: encoders differ by their seed, not by their data.
        for i in tqdm(range(0, len(ids), 128), "recording", disable=None):
            data = module.action_observations(ids[i : i + 128], N, args.modality, 0, workers)
            if i == 0:
                shape = (len(ids), *data.shape[1:])
                header = io.BytesIO()
                description = dict(descr=data.dtype.str, fortran_order=False, shape=shape)
                np.lib.format.write_array_header_1_0(header, description)
                yield header.getvalue()
            yield data.tobytes()

    print(f"recordings: {path} (delete it to record anew)", flush=True)
    if not path.exists():
        for old in path.parent.glob(f"{kind}-*.npy"):
            if source not in old.name:  # by another version of the environment's file
                old.unlink(missing_ok=True)  # another process may have deleted it just now
        write_pieces(path, pieces())
    return np.load(path, mmap_mode="r")  # only what is used is in memory (810 shapes: 5.9 GB)


def fit(model, data, rows, args):
    """Maximise the objective on data[rows]; return its terms in every update, a list of dicts."""
    groups = []
    for name, parameter in model.named_parameters():
        factor = args.log_var_rate if name.endswith("log_var") else 1.0
        groups.append(dict(params=parameter, lr=args.learning_rate * factor))
    optimizer = torch.optim.RAdam(groups)  # D.1
    n = args.batch_observations
    batch = min(args.batch_size, len(rows))
    updates = args.updates or args.epochs * (len(rows) // batch)
    rng = np.random.default_rng(args.seed)
    losses = []
    queue = []  # training actions that are still to come in this epoch
    model.train()
    for update in tqdm(range(1, updates + 1), "training", disable=None):  # None: not in a pipe
        # An epoch is a pass over the training actions in a new order, without a last small batch.
        if len(queue) < batch:
            queue = rng.permutation(rows)
        actions = queue[:batch, None]  # (A, 1)
        queue = queue[batch:]
        # Of each action n different observations: the positions of the n smallest random numbers.
        picks = rng.random((batch, data.shape[1])).argpartition(n - 1)[:, :n]  # (A, n)
        parts = model(torch.from_numpy(data[actions, picks]).to(args.device))  # (A, n, ...)
        # Minus the objective. A warm-up of the KLs: latents are used before they cost much.
        kl_weight = min(1.0, update / (args.kl_warmup * updates + 1))  # climbs to 1; kl_warmup 0: 1
        parts["loss"] = kl_weight * (parts["kl_z"] + parts["kl_c"]) - parts["rec"]
        optimizer.zero_grad()
        parts["loss"].backward()
        nn.utils.clip_grad_value_(model.parameters(), 0.5)  # [code] entry by entry
        optimizer.step()
        losses.append({key: round(value.item(), 5) for key, value in parts.items()})
        if update % 100 == 0:
            tqdm.write(f"update {update} of {updates}: {losses[-1]}")
    return losses


@torch.no_grad()
def embed(model, data, ids, args):
    """The table (NUM_ACTIONS, C): each action's representation, from all of its observations."""
    model.eval()  # running statistics: a representation does not depend on its neighbours
    table = np.zeros((load_environment(args.env).NUM_ACTIONS, args.representation_size), np.float32)
    for action, raw in zip(tqdm(ids, "encoding", disable=None), data, strict=True):
        x, _ = prepare(torch.tensor(raw, device=args.device), args)  # (N, ...)
        _, h = model.encode(x)  # (N, E)
        table[action] = model.represent(h[None])[0].cpu()
    return table


def train(args: Args) -> Path:
    """Train an encoder, write its table; return its path, `representation_path(args)`."""
    # Beside it: .pt (weights), .csv (losses), .json (scores of `probe`), -tsne.png. Or UserError.
    module = load_environment(args.env)
    choose("split", args.split, getattr(module, "SPLITS", ("default",)))
    if args.batch_observations > args.observations:
        raise UserError(f"an update cannot use more than the {args.observations} observations")
    if (args.updates > 0) == (args.epochs > 0):
        raise UserError("either updates or epochs must be above 0, and the other one 0")
    split = module.split_actions(args.split, args.split_seed)
    parts = np.concatenate(list(split.values())).astype(int)  # an empty list would make it float
    if len(np.unique(parts)) < len(parts):
        raise UserError(f"the parts of split {args.split!r} overlap")
    # CREATE's no-op, always available, is in no part of a split, but an action like others (A.3).
    no_op = getattr(module, "NO_OP", parts[:0])  # or none
    action_pool = np.union1d(no_op, parts)
    train_ids = np.union1d(no_op, parts if args.train_on == "all" else split["train"])
    data = observe(module, action_pool, args)
    if args.device == "auto":
        args = replace(args, device="cuda" if torch.cuda.is_available() else "cpu")
    with torch.random.fork_rng():  # the caller's random numbers stay as they are
        torch.manual_seed(args.seed)
        architecture = HVAE if args.hierarchical else VAE
        model = architecture(args, data.shape[2:]).to(args.device)
        losses = fit(model, data, np.searchsorted(action_pool, train_ids), args)  # ids -> rows
        table = embed(model, data, action_pool, args)
    path = representation_path(args)
    head = ",".join(losses[0])
    rows = [list(row.values()) for row in losses]
    csv = path.with_suffix(".csv")
    write(csv, lambda file: np.savetxt(file, rows, "%g", ",", header=head, comments=""))
    write(path.with_suffix(".pt"), lambda file: torch.save(model.cpu().state_dict(), file))
    save_representation(path, table, train_ids, vars(args))
    report(path, table, split, args)
    return path


def representation_path(args: Args) -> Path:
    """Where `train(args)` writes its table; a hash of the options makes it one file for each."""
    env = environment_name(args.env)
    key = short_hash(vars(args) | dict(env=env, device=None, runs_dir=None))
    model = "hvae" if args.hierarchical else "vae"
    name = f"{env}-{args.modality}-{model}-{args.train_on}-{args.recipe}"
    return Path(args.runs_dir) / "hvae" / f"{name}-s{args.seed}-{key}.npz"


def check_table(path, mean, module):
    """UserError unless a table has a row of finite numbers for every action."""
    if mean.ndim != 2 or len(mean) != module.NUM_ACTIONS or not np.isfinite(mean).all():
        raise UserError(
            f"{path}: {mean.shape}, must be ({module.NUM_ACTIONS}, D), finite (training diverged?)"
        )


def action_set(module):
    # Do row numbers still mean the same actions? A hash of labels and engineered representations.
    features = np.round(module.engineered_representations(), 3) + 0.0  # last bits vary; -0 is 0
    return short_hash([*map(str, module.action_labels()), features.tolist()])


def save_representation(path, mean, action_ids, config: dict) -> Path:
    """Write a table that `load_representation` accepts, whoever made it; return its path."""
    # mean: (NUM_ACTIONS, D), finite. action_ids: those the encoder was trained on, or []. config:
    # for JSON, with "env"; "split", "split_seed" are checked at loading. UserError: bad mean, env.
    path = Path(path)
    module = load_environment(str(config.get("env")))  # without one: unknown environment 'None'
    mean = np.asarray(mean, np.float32)
    check_table(path, mean, module)
    config = config | dict(
        action_set=action_set(module), source=source_hash(module.__file__, __file__)
    )
    arrays = dict(mean=mean, action_ids=np.array(action_ids, int), config=json.dumps(config))
    write(path, lambda file: np.savez(file, **arrays))
    return path


def load_representation(path, env: str, split: str = "default", split_seed: int = 0) -> dict:
    """Read a table; make sure that it belongs to this environment, action set and split."""
    # Returns mean (NUM_ACTIONS, D) float32, action_ids int64, and config, a dict; else UserError.
    module = load_environment(env)
    try:
        with np.load(path) as file:
            mean = file["mean"]
            action_ids = file["action_ids"]
            config = dict(json.loads(str(file["config"])))
            config["env"] = environment_name(config["env"])
    except Exception as error:  # archives, arrays and JSON each have errors of their own
        raise UserError(f"{path} is missing or no file of representations") from error
    wanted = dict(env=environment_name(env), action_set=action_set(module))
    wanted.update(split=split, split_seed=split_seed)
    for key, value in wanted.items():
        if config.get(key, value) != value:  # a table that names no split belongs to every split
            raise UserError(f"{path} has {key} {config[key]!r}, wanted {value!r}: make it again")
    check_table(path, mean, module)
    if config.get("source") != source_hash(module.__file__, __file__):
        print(f"note: {path} is of another hvae.py or {module.__name__}.py; delete it to renew it")
    return dict(mean=mean, action_ids=action_ids, config=config)


def probe(mean, train_ids, held_out_ids, env) -> dict[str, float]:
    """How well a table tells known facts of held-out actions (by fits on training actions)."""
    from sklearn.linear_model import LogisticRegression, RidgeCV
    from sklearn.neighbors import KNeighborsClassifier, NearestNeighbors
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    def score(model, y):  # R^2 of a regression, or share of right answers of a classifier
        return model.fit(mean[train_ids], y[train_ids]).score(mean[held_out_ids], y[held_out_ids])

    module = load_environment(env)
    features = module.engineered_representations()
    ridge = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-4, 4, 17)))
    # Of Grid World's skills: a linear read-out of the net displacement; logistic ones of the five
    # moves, by chance 0.25; the share whose nearest training skill has the same displacement.
    # The same of the representations released with [code]: 0.946, 0.604, 0.717 (HVAE); 0.970,
    # 0.705, 0.721 (oracle encoder); 0.908, 0.496, 0.496 (VAE).
    scores = {}
    if environment_name(env) == "gridworld":
        net = features[:, :2]  # net displacement, -5..5, as in [code]; B has the five moves only
        logistic = make_pipeline(StandardScaler(), LogisticRegression(max_iter=2000))
        scores["net_r2"] = score(ridge, net)
        scores["move_accuracy"] = np.mean([score(logistic, m) for m in module.SKILL_MOVES.T])
        scores["nn_net_match"] = score(KNeighborsClassifier(1), net @ [100, 1])  # class per (x, y)
    # Everywhere: the share of held-out actions with the label of the nearest other held-out one, as
    # the eye sees it in Figures 4-6. By chance: the share of pairs with equal labels.
    labels = np.asarray(module.action_labels())[held_out_ids]
    others = NearestNeighbors(n_neighbors=1).fit(mean[held_out_ids])
    nearest = others.kneighbors(return_distance=False)[:, 0]
    scores["nn_class"] = np.mean(labels[nearest] == labels)
    varies = (features[train_ids].std(0) > 1e-6) & (features[held_out_ids].std(0) > 1e-6)
    if varies.any():  # a linear read-out of the features that differ among actions
        scores["engineered_r2"] = score(ridge, features[:, varies])
    return {key: round(float(value), 4) for key, value in scores.items()}


def report(path, table, split, args):
    """Scores on the held-out actions: one line, <name>.json, and the t-SNE picture."""
    held_out = np.concatenate([split["valid"], split["test"]]).astype(int)  # the oracle saw them
    if len(held_out) < 3:
        print("fewer than 3 held-out actions: no scores, no picture")
        return
    scores = probe(table, split["train"], held_out, args.env)
    print(f"{len(held_out)} held-out actions: {scores}")
    write(path.with_suffix(".json"), lambda file: file.write(json.dumps(scores).encode()))
    labels = np.asarray(load_environment(args.env).action_labels())
    plot_tsne(table[held_out], labels[held_out], path.with_name(f"{path.stem}-tsne.png"))


def plot_tsne(mean, labels, path):
    """Figures 4-6: representations (count, D) by t-SNE, one colour per label."""
    os.environ.pop("MPLBACKEND", None)  # a notebook sets it to one that may not be installed here
    from matplotlib.figure import Figure
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    tsne = TSNE(perplexity=min(10, len(mean) - 1), init="pca", random_state=0)  # [code] 10
    with threadpool_limits(1):  # several threads took 40 s, not 4, on two busy cores
        places = tsne.fit_transform(mean)  # (count, 2)
    names, classes = np.unique(labels, return_inverse=True)
    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.subplots()
    points = axes.scatter(*places.T, s=22, c=classes, cmap="gist_rainbow")
    axes.set(xticks=[], yticks=[], frame_on=False, title=path.stem)
    figure.legend(points.legend_elements(num=None)[0], names, loc="outside right")
    write(path, lambda file: figure.savefig(file, dpi=120))


def parse_args(words: list[str]) -> Args:
    """Args of a command line; --help shows the numbers of *its* environment and recipe."""
    # Twice: first only for env, recipe and modality ("": not given), then with their defaults.
    first = replace(default_args("gridworld"), modality="")
    first = tyro.cli(Args, args=[w for w in words if w not in ("-h", "--help")], default=first)
    default = default_args(first.env, first.recipe, first.modality)
    return tyro.cli(Args, args=words, default=default, description=__doc__)


def main(words: list[str]) -> None:
    """Train what the command line says; a mistake of the user ends it with one sentence."""
    torch.set_num_threads(1)  # networks are small: a second thread waits more than it works
    try:
        print(f"representations: {train(parse_args(words))}")
    except UserError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main(sys.argv[1:])
