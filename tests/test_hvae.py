"""The HVAE against torch's distributions, the published layer sizes, and damaged files."""

import ctypes
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Categorical, Independent, Normal, kl_divergence

import gridworld
import hvae
from hvae import HVAE, VAE, Args, Format

ROOT = Path(__file__).resolve().parent.parent
TRAIN = gridworld.split_actions()["train"]
HELD_OUT = np.setdiff1d(np.arange(1024), TRAIN)
KINDS = {  # format and a raw batch (3 actions, 2 observations) of each kind of modality
    "xy": (Format("trajectory", 6, 2, True, 39.5, 39.5), (6, 2)),
    "raw": (Format("trajectory", 6, 2), (6, 2)),
    "onehot": (Format("onehot", 6, 160, True), (6, 2)),
    "video": (Format("video", 3, 48), (3, 48, 48)),
    "image": (Format("image", 1, 84), (84, 84)),
}


def arguments(**changes):
    """Resolved Args of Grid World with D.3.1's encoder; `changes` may set any field, also against
    the environment."""
    args = hvae.resolve(Args(recipe=changes.pop("recipe", "lstm")))
    for name, value in changes.items():
        setattr(args, name, value)
    return args


def batch(kind, actions=3, n=2, seed=0):
    fmt, shape = KINDS[kind]
    high = 255 if fmt.visual else 78
    rng = np.random.default_rng(seed)
    if fmt.visual:
        raw = rng.integers(0, high, (actions, n, *shape))
    else:  # skills, so that relative classes stay in range
        return fmt, torch.from_numpy(gridworld.action_observations(TRAIN[:actions], n, "xy", seed))
    return fmt, torch.from_numpy(raw.astype(np.uint8))


def small(kind, model=HVAE, **changes):
    torch.manual_seed(0)
    fmt, raw = batch(kind)
    return model(fmt, arguments(**changes)), raw


# ---- the objective ----


def gaussians(seed):
    rng = torch.Generator().manual_seed(seed)
    return [torch.randn(5, 7, generator=rng) for _ in range(4)]


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_divergences_and_density_equal_torch_distributions(seed):
    mean, log_var, mean_p, log_var_p = gaussians(seed)
    q, p = Normal(mean, (log_var / 2).exp()), Normal(mean_p, (log_var_p / 2).exp())
    torch.testing.assert_close(
        hvae.gaussian_kl((mean, log_var), (mean_p, log_var_p)), kl_divergence(q, p).sum(-1)
    )
    prior = Normal(torch.zeros(5, 7), torch.ones(5, 7))
    torch.testing.assert_close(hvae.standard_kl(mean, log_var), kl_divergence(q, prior).sum(-1))
    torch.testing.assert_close(hvae.gaussian_log_prob(mean_p, mean, log_var), q.log_prob(mean_p))


def test_sample_has_the_mean_and_variance_it_is_given():
    torch.manual_seed(0)
    draws = hvae.sample(torch.full((200_000,), 2.0), torch.full((200_000,), np.log(9.0)))
    assert abs(draws.mean() - 2) < 0.03 and abs(draws.std() - 3) < 0.03


@pytest.mark.parametrize("kind", ["xy", "onehot", "image"])
def test_loss_equals_the_elbo_written_observation_by_observation(kind, monkeypatch):
    """The loss of a batch against loops over actions and observations, without sampling noise."""
    model, raw = small(kind)
    model.eval()
    monkeypatch.setattr(hvae, "sample", lambda mean, log_var: mean)
    with torch.no_grad():
        parts = model(raw)
        rec = kl_z = kl_c = 0.0
        for observations in raw:
            inputs, starts, targets = hvae.prepare(observations, model.format)
            h = model.encoder(inputs)
            c, c_log_var = model.q_c(h[None])
            q_c = Independent(Normal(c[0], (c_log_var[0] / 2).exp()), 1)
            prior = Independent(Normal(torch.zeros(16), torch.ones(16)), 1)
            kl_c += kl_divergence(q_c, prior)
            for j in range(len(observations)):
                z, z_log_var = model.q_z(h[j : j + 1], c)
                p, p_log_var = model.p_z(c)
                q_z = Normal(z, (z_log_var / 2).exp())
                kl_z += kl_divergence(q_z, Normal(p, (p_log_var / 2).exp())).sum()
                output = model.decode(starts[j : j + 1], z, c)
                if kind == "onehot":
                    rec += Categorical(logits=output).log_prob(targets[j : j + 1]).sum()
                else:
                    sigma = (model.log_var.clamp(-4, 3) / 2).exp()
                    rec += Normal(output, sigma).log_prob(targets[j : j + 1]).sum()
    # 6 observations; one c is shared by the set of 64 behind a representation
    torch.testing.assert_close(parts["rec"], rec / 6)
    torch.testing.assert_close(parts["kl_z"], kl_z / 6)
    torch.testing.assert_close(parts["kl_c"], kl_c / 3 / 64)
    torch.testing.assert_close(parts["loss"], parts["kl_z"] + parts["kl_c"] - parts["rec"])


def test_global_batch_norm_has_one_mean_and_variance():
    x = torch.randn(50, 8) * torch.arange(1, 9) + 3
    expected = (x - x.mean()) / (x.var(correction=0) + 1e-3).sqrt()
    torch.testing.assert_close(hvae.GlobalBatchNorm()(x), expected, rtol=1e-4, atol=1e-5)


# ---- the networks of D.3.1 ----

PAPER = dict(recipe="paper")
PICTURES = dict(recipe="paper", representation_size=128, hidden=128)
CREATE = dict(recipe="paper", representation_size=128)
# A picture is not passed through the Bi-LSTM (823,296) but one linear layer (288 -> 128), and its
# decoder has no mask channel (16 + 1).
NO_LSTM = -823_296 + 289 * 128 - 17


@pytest.mark.parametrize(
    "fmt, changes, hierarchical, flat",
    [
        (Format("trajectory", 6, 2), PAPER, 339_818, 207_334),
        (Format("onehot", 6, 160), PAPER, 441_254 - 160, 308_770 - 160),  # no unused sigmas
        (Format("trajectory", 7, 6), CREATE, 414_738, 224_462),
        (Format("trajectory", 7, 2), CREATE, 412_170, 221_894),
        (Format("video", 7, 48), PICTURES, 1_549_968, 1_269_132),
        (Format("image", 1, 84), PICTURES, 1_382_336 + NO_LSTM, 1_101_500 + NO_LSTM),
        (Format("trajectory", 6, 2, True), {}, 239_978, 207_334 - 339_818 + 239_978),
    ],
)
def test_number_of_parameters_is_that_of_the_published_networks(fmt, changes, hierarchical, flat):
    for model, expected in ((HVAE, hierarchical), (VAE, flat)):
        assert sum(p.numel() for p in model(fmt, arguments(**changes)).parameters()) == expected


@pytest.mark.parametrize("size, sides", [(48, [24, 24, 12, 12, 6, 6, 3]),
                                         (84, [42, 42, 21, 21, 11, 11, 6, 6, 3])])  # fmt: skip
def test_convolutions_have_the_number_of_layers_of_the_appendix(size, sides):
    encoder, x, seen = hvae.ConvEncoder(size), torch.randn(2, 1, size, size), []
    for layer in encoder.layers:
        x = layer(x)
        seen += [x.shape[-1]] if isinstance(layer, torch.nn.Conv2d) else []
    assert seen == sides
    picture, mask = hvae.ConvDecoder(size, mask=True)(x.flatten(1))
    assert picture.shape == mask.shape == (2, 1, size, size)
    assert picture.abs().max() <= 0.5 and 0 <= mask.min() and mask.max() <= 1
    with pytest.raises(ValueError, match="48 or 84"):
        hvae.ConvEncoder(64)


def test_shut_mask_shows_the_first_frame_and_open_mask_the_picture():
    model, raw = small("video")
    _, start, target = hvae.prepare(raw.flatten(0, 1), model.format)
    latents = torch.randn(6, 16), torch.randn(6, 16)
    last = model.conv_decoder.layers[-2]  # the 1x1 convolution: channel 1 is the mask
    with torch.no_grad():
        last.weight[1] = 0
        last.bias[1] = -50
        shut = model.decode(start, *latents)
        last.bias[1] = 50
        last.weight[0] = 0
        last.bias[0] = 50
        opened = model.decode(start, *latents)
    assert shut.shape == target.shape
    torch.testing.assert_close(shut, start[:, None].expand_as(shut))
    torch.testing.assert_close(opened, torch.full_like(opened, 0.5))


def test_new_decoder_of_videos_paints_white_behind_a_half_open_mask():
    """Grey paper would shut the mask before anything is learned behind it."""
    features = torch.randn(8, hvae.CONV_FEATURES)
    picture, mask = hvae.ConvDecoder(48, mask=True)(features)
    assert picture.mean() > 0.4 and 0.3 < mask.mean() < 0.7
    assert abs(hvae.ConvDecoder(84, mask=False)(features)[0].mean()) < 0.2


def test_linear_path_of_a_video_sees_its_frames_in_coarse_pixels():
    model, raw = small("video", linear_path=True)
    x = hvae.prepare(raw.flatten(0, 1), model.format)[0]  # (6, 3, 1, 48, 48)
    numbers = model.encoder(x)[:, -3 * 12 * 12 :]
    expected = 0.5 - x[:, 1, 0, 4:8, 40:44].mean((1, 2))  # second frame, second row, column 11
    torch.testing.assert_close(numbers[:, 144 + 12 + 10], expected)


def test_video_looks_at_every_frame_once():
    model, raw = small("video")
    model.train()
    model(raw)
    counts = [v for k, v in model.state_dict().items() if k.endswith("num_batches_tracked")]
    assert len(counts) > 5 and all(count == 1 for count in counts)


@pytest.mark.parametrize("model", [HVAE, VAE])
@pytest.mark.parametrize("kind", list(KINDS))
def test_gradient_reaches_every_parameter(kind, model):
    model, raw = small(kind, model)
    model(raw)["loss"].backward()
    idle = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().any()]
    assert not idle


@pytest.mark.parametrize("encoder", ["lstm", "mlp", "linear path"])
@pytest.mark.parametrize("kind", list(KINDS))
def test_representation_ignores_order_and_company_and_repeats(kind, encoder):
    changes = dict(encoder=encoder)
    if encoder == "linear path":
        if kind == "image":
            return  # refused, see below
        changes = dict(encoder="mlp", linear_path=True)
    for model_class in (HVAE, VAE) if encoder != "linear path" else (HVAE,):
        model, raw = small(kind, model_class, **changes)
        model.eval()
        with torch.no_grad():
            mean, log_var = model.represent(raw)
            again, _ = model.represent(raw)
            shuffled, _ = model.represent(raw.flip(1))
            alone, _ = model.represent(raw[1:2])
        assert mean.shape == log_var.shape == (3, 16) and torch.equal(mean, again)
        torch.testing.assert_close(mean, shuffled, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(mean[1:2], alone, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["xy", "onehot"])
def test_linear_path_is_a_linear_map_of_the_averaged_observations(kind):
    model, raw = small(kind, linear_path=True)
    plain, _ = small(kind)
    assert plain.q_c.linear is None and plain.encoder.numbers == 0
    model.eval()
    with torch.no_grad():
        model.q_c.norm.norm.bias.fill_(0.25)
        last = model.q_c.after[-1]
        both = model.represent(raw)[0]
        last.weight.zero_()
        last.bias.zero_()
        mean, log_var = model.represent(raw)
        inputs = hvae.prepare(raw.flatten(0, 1), model.format)[0].flatten(1)  # (A * n, numbers)
        average = inputs.unflatten(0, raw.shape[:2]).mean(1)  # (A, numbers)
        weight, bias = model.q_c.linear.weight, model.q_c.linear.bias
        scale = 1 / np.sqrt(1 + hvae.BN_EPS)  # of a batch norm that has seen nothing yet
    assert not torch.allclose(both, mean)  # the networks have their share
    torch.testing.assert_close(mean, (average @ weight.T + bias) * scale + 0.25)
    assert torch.equal(log_var, torch.full_like(log_var, 0.25))  # it is the networks' alone


MEMORY = """
import resource, sys, torch, hvae
if sys.argv[1] == "keep":
    hvae.keep_memory()
def new_pages(times):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(times):
        torch.ones(10_000_000)  # 40 MB: 9,765 pages of 4 kB
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
new_pages(20)  # the library takes some turns to find places
print(new_pages(10))
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="not glibc")
def test_kept_memory_is_used_again():
    """Without it, all pages of ten arrays, each freed before the next, are new."""

    def new_pages(word: str) -> int:
        command = [sys.executable, "-c", MEMORY, word]
        return int(subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout)

    assert new_pages("keep") < 30_000 and new_pages("default") > 90_000


# ---- observations in and out ----


@given(ids=st.lists(st.integers(0, 1023), min_size=1, max_size=4), seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_targets_undone_are_the_later_states(ids, seed):
    """Through `prepare` and back through `undo`, relative or raw, numbers or classes."""
    raw = torch.from_numpy(gridworld.action_observations(np.unique(ids), 3, "xy", seed)).flatten(
        0, 1
    )
    for modality in ("xy", "onehot"):
        for relative in (True, False):
            fmt = Format.of("gridworld", modality, raw.shape, relative)
            inputs, start, target = hvae.prepare(raw, fmt)
            assert inputs.shape == (len(raw), 6, fmt.features) and start.shape == inputs[:, 0].shape
            if modality == "onehot":
                assert (inputs.sum(-1) == 2).all()
                target = torch.nn.functional.one_hot(target, 80)
            states = hvae.undo(target.numpy(), raw[:, 0].numpy().astype(float), fmt)
            np.testing.assert_allclose(states, raw[:, 1:], atol=1e-4)


@given(stored=st.integers(1, 2000), data=st.data())
def test_picked_observations_are_distinct(stored, data):
    n = data.draw(st.integers(1, stored))
    picks = hvae.pick(np.random.default_rng(stored), stored, 5, n)
    assert picks.shape == (5, n) and picks.min() >= 0 and picks.max() < stored
    assert all(len(set(row)) == n for row in picks.tolist())


def test_every_observation_is_picked_equally_often():
    picks = hvae.pick(np.random.default_rng(0), 50, 40_000, 4)
    counts = np.bincount(picks.ravel(), minlength=50)
    assert abs(counts - 3200).max() < 5 * 3200**0.5


# ---- training ----


def test_weight_of_the_kls_climbs_to_one(monkeypatch):
    """The prior p(z | c) is learned through the KL alone: its gradient shows the weight."""
    raw, seen = batch("xy")[1].numpy(), {}
    for warmup in (0.0, 0.5):
        torch.manual_seed(0)
        args = arguments(updates=4, kl_warmup=warmup, batch_observations=2)
        model, grads = HVAE(KINDS["xy"][0], args), seen.setdefault(warmup, [])
        keep = lambda _, limit, m=model, g=grads: g.append(m.p_z.log_var.grad.clone())  # noqa: E731
        monkeypatch.setattr(hvae.nn.utils, "clip_grad_value_", keep)
        row = hvae.fit(model, raw, args)[-1]
        assert np.isclose(row["loss"], row["kl_z"] + row["kl_c"] - row["rec"])  # the whole ELBO
    torch.testing.assert_close(seen[0.5][0], seen[0.0][0] / 3)  # weights 1/3, 2/3, 1, 1
    assert len(seen[0.5]) == 4


def test_short_training_learns_unseen_skills_and_never_sees_them(tmp_path, monkeypatch):
    asked, fit = [], hvae.fit
    record = gridworld.action_observations

    def recording(ids, *rest):
        asked.extend(ids)
        return record(ids, *rest)

    def checked_fit(model, data, args):
        assert sorted(asked) == TRAIN.tolist()  # nothing else was even recorded so far
        rows = fit(model, data, args)
        assert rows[-1]["error"] < 1.0 < rows[0]["error"] + 0.5  # displacements vary by 1.5
        return rows

    monkeypatch.setattr(gridworld, "action_observations", recording)
    monkeypatch.setattr(hvae, "fit", checked_fit)
    args = Args(encoder="mlp", updates=200, runs_dir=str(tmp_path), threads=1, plots=False)
    path = hvae.train(args)
    assert path == hvae.representation_path(args)
    scores = json.loads(path.with_suffix(".json").read_text())["scores"]
    assert scores["net_r2"] > 0.7 and scores["move_accuracy"] > 0.35
    assert {p.suffix for p in path.parent.iterdir()} == {".npz", ".pt", ".csv", ".json"}
    table = hvae.load_representation(path, "gridworld")
    assert table["mean"].shape == (1024, 16) and np.array_equal(table["action_ids"], TRAIN)
    weights = torch.load(path.with_suffix(".pt"))
    built = arguments(encoder="mlp", linear_path=True)
    model = HVAE(Format.of("gridworld", "xy", (6, 2), True), built)
    model.load_state_dict(weights)
    model.eval()
    raw = torch.from_numpy(gridworld.action_observations([5], 64, "xy"))
    with torch.no_grad():
        mean = model.represent(raw)[0][0]
    np.testing.assert_allclose(mean, table["mean"][5], atol=1e-4)


def test_same_seed_same_bytes_and_the_callers_generators_are_left_alone(tmp_path):
    torch.manual_seed(5)
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    files = {}
    for run, seed in (("a", 0), ("b", 0), ("c", 1)):
        args = Args(updates=6, seed=seed, runs_dir=str(tmp_path / run), threads=1, plots=False)
        args.observations = 64
        path = hvae.train(args)
        files[run] = [path.with_suffix(end).read_bytes() for end in (".npz", ".pt", ".json")]
    assert files["a"] == files["b"]
    assert all(a != c for a, c in zip(files["a"], files["c"], strict=True))
    assert torch.equal(before, torch.get_rng_state())
    assert np.array_equal(numpy_before, np.random.get_state()[1])  # noqa: NPY002


def test_oracle_encoder_and_plain_vae_train_on_what_they_say(tmp_path):
    base = dict(updates=2, observations=8, runs_dir=str(tmp_path), threads=1, plots=False)
    oracle = hvae.load_representation(hvae.train(Args(train_on="all", **base)), "gridworld")
    assert oracle["action_ids"].tolist() == list(range(1024))
    path = hvae.train(Args(hierarchical=False, modality="onehot", split_seed=3, **base))
    assert path.name == "gridworld-onehot-vae-default3-laptop-updates=2-observations=8-s0.npz"
    flat = hvae.load_representation(path, "gridworld", split_seed=3)
    assert np.array_equal(flat["action_ids"], gridworld.split_actions("default", 3)["train"])


@pytest.mark.parametrize("changes, words", [
    (dict(env="chess"), "unknown environment 'chess'; allowed: gridworld"),
    (dict(env="recsys"), "recsys has no action observations"),
    (dict(modality="smell"), "unknown modality 'smell' for gridworld; allowed: xy, onehot"),
    (dict(recipe="slow"), "unknown recipe 'slow' for gridworld"),
    (dict(train_on="test"), "unknown train_on 'test'"),
    (dict(encoder="cnn"), "unknown encoder 'cnn'"),
    (dict(env="stacking", linear_path=True), "linear_path: .* modality 'image'"),
    (dict(hierarchical=False, linear_path=True), "linear_path: the plain VAE has no c"),
    (dict(device="tpu"), "device 'tpu' is not available; allowed: auto, cpu"),
    (dict(split="odd"), "odd"),
    (dict(updates=0), "updates must be at least 1, got 0"),
    (dict(batch_size=-1), "batch_size must be at least 1, got -1"),
    (dict(encoder="lstm", hidden=63), "hidden 63: .* must be even"),
    (dict(kl_warmup=-0.2), "kl_warmup must be between 0 and 1, got -0.2"),
    (dict(log_var_lr=-10.0), "log_var_lr must be a positive number, got -10.0"),
    (dict(learning_rate=np.nan), "learning_rate must be a positive number, got nan"),
    (dict(seed=-1), "seed must be 0 or more, got -1"),
    (dict(epochs=2, updates=3), "epochs and updates: give one"),
    (dict(epochs=10_000, updates=3), "epochs and updates: give one"),
    (dict(decoder_log_var=9.0), "decoder_log_var must be between -4 and 3, got 9.0"),
    (dict(decoder_log_var=float("nan")), "decoder_log_var must be between"),
    (dict(observations=8, batch_observations=9), "batch_observations 9 is more than the 8"),
    (dict(hierarchical=False, q_hidden=7), "q_hidden has no effect here: .* plain VAE"),
    (dict(modality="onehot", decoder_log_var=-1.0), "decoder_log_var has no effect here"),
    (dict(env="stacking", encoder="mlp"), "encoder has no effect here: modality image"),
    (dict(compact=False), "compact has no effect here: .* encoder mlp"),
    (dict(runs_dir="/dev/null/runs"), "cannot write to /dev/null/runs/hvae: Not a directory"),
])  # fmt: skip
def test_bad_choices_are_refused_before_anything_is_written(tmp_path, changes, words):
    with pytest.raises(ValueError, match=words) as error:
        hvae.train(Args(**dict(runs_dir=str(tmp_path)) | changes))
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("device", ["cuda:99", "cudaX"])
def test_gpu_that_is_not_there_is_refused_before_anything_is_written(tmp_path, monkeypatch, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with pytest.raises(ValueError, match=f"device '{device}' is not available"):
        hvae.train(Args(device=device, runs_dir=str(tmp_path)))
    assert not list(tmp_path.iterdir())


def test_only_the_recipes_own_table_has_its_name():
    def name(**changes):
        return hvae.representation_path(Args(**changes)).name

    assert name() == name(updates=1_000) == name(threads=2, plots=False, device="cpu")
    assert name() == "gridworld-xy-hvae-default-laptop-s0.npz"
    changes = [{}, dict(updates=1), dict(epochs=2), dict(linear_path=False), dict(encoder="lstm")]
    changes += [dict(learning_rate=0.5), dict(representation_size=4), dict(recipe="lstm")]
    assert len({name(**change) for change in changes}) == len(changes)
    assert name(updates=1) == "gridworld-xy-hvae-default-laptop-updates=1-s0.npz"
    table_3 = (
        "gridworld-xy-hvae-default-laptop-epochs=10000-s0.npz"  # 40 times the recipe's updates
    )
    assert name(epochs=10_000) == table_3


def test_plain_vae_without_a_linear_path_learns_longer():
    ours, vae = (hvae.resolve(Args(hierarchical=h)) for h in (True, False))
    assert (ours.linear_path, ours.updates) == (True, 1_000)
    assert (vae.linear_path, vae.updates) == (False, 6_000)
    assert hvae.resolve(Args(hierarchical=False, updates=3)).updates == 3
    same = {k: v for k, v in vars(hvae.resolve(Args(hierarchical=False, recipe="mlp"))).items()}
    named = {k: v for k, v in vars(vae).items() if k not in ("recipe", "linear_path")}
    assert named.items() <= same.items()


def test_tables_3_and_4():
    paper = hvae.resolve(Args(recipe="paper"))
    assert (paper.representation_size, paper.batch_size, paper.epochs) == (16, 128, 10_000)
    assert (paper.learning_rate, paper.observations, paper.q_hidden) == (0.001, 1024, 128)
    assert paper.hidden == 64 and paper.batch_observations == 1024 and paper.updates is None
    assert not paper.relative and not paper.compact and paper.log_var_lr == 1
    assert hvae.TABLE_3["create"] == dict(representation_size=128, batch_size=128, epochs=10_000)
    assert hvae.TABLE_3["stacking"] == dict(representation_size=128, batch_size=32, epochs=5_000)


@pytest.mark.parametrize("hierarchical", [True, False])
@pytest.mark.parametrize(
    "env, modality, size",
    [
        ("gridworld", "onehot", 16),
        ("create", "xy", 128),
        ("create", "state", 128),
        ("create", "video", 128),
        ("stacking", "image", 128),
    ],
)
def test_every_modality_trains_and_is_drawn(tmp_path, env, modality, size, hierarchical):
    """Real observations of four actions: one update, reconstructions in raw units, a picture."""
    module = hvae.load_environment(env)
    args = Args(env=env, modality=modality, hierarchical=hierarchical)
    args = hvae.resolve(dataclasses.replace(args, updates=1, batch_observations=2))
    raw = module.action_observations(np.arange(4), 2, modality, seed=0, workers=1)
    fmt = Format.of(env, modality, raw.shape, args.relative)
    model = (HVAE if hierarchical else VAE)(fmt, args)
    rows = hvae.fit(model, raw, args)
    assert len(rows) == 1 and np.isfinite(list(rows[0].values())).all()
    model.eval()
    with torch.no_grad():
        assert model.represent(torch.from_numpy(raw))[0].shape == (4, size)
        output = model.reconstruct(torch.from_numpy(raw)).numpy()
    states = hvae.undo(output[0], raw[0, :, 0].astype(float), fmt)
    assert states.shape == (raw[0, :, None] if modality == "image" else raw[0, :, 1:]).shape
    hvae.plot_reconstructions(model, raw, ["a"] * 4, tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 5_000


# ---- probe ----


def test_probe_of_ground_truth_and_of_noise():
    truth = hvae.probe(gridworld.engineered_representations(), TRAIN, HELD_OUT)
    assert truth["net_r2"] > 0.999 and truth["move_accuracy"] > 0.999
    noise = np.random.default_rng(0).normal(size=(1024, 16))
    scores = hvae.probe(noise, TRAIN, HELD_OUT)
    assert scores["net_r2"] < 0.05 and 0.2 < scores["move_accuracy"] < 0.3
    assert scores["nn_net_match"] < 0.1
    moves = gridworld.SKILL_MOVES
    net = gridworld.MOVE_DELTAS[moves].sum(1).astype(float)
    assert hvae.probe(net, TRAIN, HELD_OUT)["nn_net_match"] > 0.98


def test_probe_of_other_environments():
    module = hvae.load_environment("stacking")
    split, truth = module.split_actions(), module.engineered_representations()
    held_out = np.concatenate([split["valid"], split["test"]])
    scores = hvae.probe(truth, split["train"], held_out, "stacking")
    assert (
        scores["engineered_r2"] > 0.99 and scores["nn_class"] > 0.9 > 0.2 > scores["chance_class"]
    )
    noise = np.random.default_rng(0).normal(size=(810, 128))
    scores = hvae.probe(noise, split["train"], held_out, "stacking")
    assert scores["engineered_r2"] < 0.1 and abs(scores["nn_class"] - scores["chance_class"]) < 0.06


def test_probe_reads_angles_as_circles_and_nothing_but_the_feature():
    """Within-class scores: 1 for the feature itself, nothing for knowing the class alone."""
    module = hvae.load_environment("create")
    found = hvae.features("create")
    kinds = np.array([tool.kind for tool in module.TOOLS])
    circle, group = found["angle"]
    assert set(group) == {"", "Ramp", "Trampoline", "Cannon", "Fan", "Funnel", "Bucket"}
    np.testing.assert_allclose((circle**2).sum(1), 1)
    angle = np.array([tool.angle for tool in module.TOOLS])
    flat = (kinds == "Ramp") & (angle == 0)  # a ramp of 0 and one of 180 degrees are the same
    steep, half = (kinds == "Ramp") & (angle == 90), np.array([0, 1])
    np.testing.assert_allclose(circle[flat], np.tile(half, (flat.sum(), 1)), atol=1e-9)
    np.testing.assert_allclose(circle[steep], np.tile(-half, (steep.sum(), 1)), atol=1e-9)
    split = module.split_actions()
    held_out = hvae.held_out_labels(hvae.resolve(Args(env="create")))[0]
    assert len(held_out) == 1013 and module.NO_OP not in held_out
    noise = 1e-3 * np.random.default_rng(0).normal(size=(len(kinds), 2))
    scores = hvae.probe(circle + noise, split["train"], held_out, "create")
    assert scores["angle_r2"] > 0.99 and scores["size_r2"] < 0.05
    only_class = (kinds[:, None] == np.unique(kinds)).astype(float)
    only_class += 1e-3 * np.random.default_rng(1).normal(size=only_class.shape)
    scores = hvae.probe(only_class, split["train"], held_out, "create")
    assert scores["nn_class"] > 0.8 and scores["train_class"] > 0.8
    for name in ("angle", "size", "elasticity", "force"):
        assert scores[f"{name}_r2"] < 0.1


@pytest.mark.parametrize("env", ["create", "stacking"])
def test_probe_of_classes_that_were_never_trained_on(env):
    args = hvae.resolve(Args(env=env, split="full"))
    rows = hvae.probe_rows(hvae.load_environment(env).engineered_representations(), args)
    scores = {row["score"]: row["value"] for row in rows}
    assert all(row["value"] == row["engineered"] or np.isnan(row["value"]) for row in rows)
    assert (
        scores["nn_class"] == 1 and scores["engineered_r2"] > 0.99 and "train_class" not in scores
    )
    assert scores["size_r2" if env == "create" else "scale_r2"] > 0.99


# ---- the file of representations ----


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """A valid file and the arguments it was saved with."""
    rng = np.random.default_rng(0)
    arrays = dict(mean=rng.normal(size=(1024, 16)), log_var=rng.normal(size=(1024, 16)))
    config = dict(split="default", split_seed=0, train_on="train")
    arguments = dict(env="gridworld", action_ids=TRAIN, config=config, **arrays)
    path = tmp_path_factory.mktemp("table") / "table.npz"
    return hvae.save_representation(path, **arguments), arguments


def test_saved_table_comes_back(table):
    path, saved = table
    loaded = hvae.load_representation(path, "gridworld")
    assert loaded["mean"].dtype == np.float32
    np.testing.assert_array_equal(loaded["mean"], saved["mean"].astype(np.float32))
    assert loaded["config"]["environment"] == "gridworld"
    assert [p.name for p in path.parent.iterdir()] == ["table.npz"]  # no temporary file is left


def test_own_table_needs_no_split(tmp_path):
    path = tmp_path / "own.npz"
    own = gridworld.engineered_representations()
    hvae.save_representation(path, "gridworld", own, np.zeros_like(own), [])
    np.testing.assert_array_equal(hvae.load_representation(path, "gridworld")["mean"], own)


@pytest.mark.parametrize("change, words", [
    (dict(mean=np.zeros((1000, 16))), r"mean must have shape \(1024, D\), got \(1000, 16\)"),
    (dict(log_var=np.zeros((1024, 8))), r"log_var must have shape \(1024, 16\)"),
    (dict(mean=np.full((1024, 16), np.nan)), "mean must be finite"),
    (dict(action_ids=[1, 1]), "distinct"),
    (dict(action_ids=[2000]), r"0\.\.1023"),
    (dict(action_ids=[1.7, 2.2]), "distinct integers"),
    (dict(env="chess"), "unknown environment"),
])  # fmt: skip
def test_saving_nonsense_is_refused(tmp_path, table, change, words):
    with pytest.raises(ValueError, match=words):
        hvae.save_representation(tmp_path / "x.npz", **(table[1] | change))
    assert not list(tmp_path.iterdir())


def rewrite(source, target, **changes):
    """Copy a table with arrays replaced (None: left out)."""
    with np.load(source) as file:
        arrays = {key: file[key] for key in file.files}
    arrays |= changes
    np.savez(target, **{key: value for key, value in arrays.items() if value is not None})
    return target


@pytest.mark.parametrize("changes, words", [
    (dict(mean=None), "not a file of representations"),
    (dict(config=None), "not a file of representations"),
    (dict(config=np.array("{")), "not a file of representations"),
    (dict(config=np.array("3")), "not a file of representations"),
    (dict(mean=np.array([{}], dtype=object)), "not a file of representations"),
    (dict(mean=np.zeros((9, 16), np.float32)), r"\(1024, D\)"),
    (dict(mean=np.zeros((1024, 16), int)), "floating-point"),
    (dict(log_var=np.full((1024, 16), np.inf)), "finite"),
    (dict(mean=np.full((1024, 16), 1e300)), "finite"),  # too large for float32
    (dict(action_ids=np.zeros(3)), "distinct integers"),
    (dict(action_ids=TRAIN[:-1]), "other actions than split"),
])  # fmt: skip
def test_loading_a_wrong_table_is_refused(tmp_path, table, changes, words):
    path = rewrite(table[0], tmp_path / "wrong.npz", **changes)
    with pytest.raises(ValueError, match=words) as error:
        hvae.load_representation(path, "gridworld")
    assert "\n" not in str(error.value)


def test_loading_for_another_purpose_is_refused(tmp_path, table, monkeypatch):
    path = table[0]
    with pytest.raises(FileNotFoundError, match="no representations at"):
        hvae.load_representation(tmp_path / "none.npz", "gridworld")
    with pytest.raises(ValueError, match="belongs to 'gridworld', not to 'recsys'"):
        hvae.load_representation(path, "recsys")
    with pytest.raises(ValueError, match="split_seed 0, wanted 1"):
        hvae.load_representation(path, "gridworld", split_seed=1)
    with pytest.raises(ValueError, match="split 'default', wanted 'full'"):
        hvae.load_representation(path, "gridworld", split="full")
    monkeypatch.setattr(gridworld, "action_labels", lambda: np.array(["other"] * 1024))
    with pytest.raises(ValueError, match="another action set"):
        hvae.load_representation(path, "gridworld")


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_damaged_file_never_gives_other_numbers(table, tmp_path_factory, data):
    """Cut anywhere, or any byte changed: the same table comes back, or one ValueError."""
    raw = bytearray(table[0].read_bytes())
    position = data.draw(st.integers(0, len(raw) - 1))
    if data.draw(st.booleans()):
        raw = raw[:position]
    else:
        raw[position] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.mktemp("damaged") / "x.npz"
    path.write_bytes(raw)
    try:
        loaded = hvae.load_representation(path, "gridworld")
    except ValueError as error:
        assert "\n" not in str(error)
    else:
        np.testing.assert_array_equal(loaded["mean"], table[1]["mean"].astype(np.float32))


# ---- the command line ----


def run(*words, cwd=ROOT):
    command = [sys.executable, str(ROOT / "hvae.py"), *map(str, words)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


def test_command_line_makes_every_file(tmp_path):
    done = run("gridworld", "--updates", 20, "--observations", 64, "--threads", 1,
               "--runs-dir", tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    stem = "gridworld-xy-hvae-default-laptop-updates=20-observations=64-s0"
    endings = (".npz", ".pt", ".csv", "-probe.csv", ".json", "-tsne.png", "-reconstructions.png")
    assert {p.name for p in (tmp_path / "hvae").iterdir()} == {stem + end for end in endings}
    assert "net_r2" in done.stdout and "published" in done.stdout and " 0.946" in done.stdout
    lines = (tmp_path / "hvae" / f"{stem}.csv").read_text().splitlines()
    assert lines[0] == "update,seconds,loss,rec,kl_z,kl_c,error" and len(lines) == 2


def test_command_line_errors_are_one_line(tmp_path):
    for words in (["chess"], ["gridworld", "--modality", "smell"], ["gridworld", "--split", "odd"]):
        done = run(*words, "--runs-dir", tmp_path)
        assert done.returncode == 1 and done.stderr.startswith("error: ")
        assert done.stderr.count("\n") == 1


def test_help_reads_like_the_tables():
    text = run("--help").stdout
    for words in ("Table 3", "Table 4", "--no-hierarchical", "--recipe", "--train-on"):
        assert words in text


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("recipe", ["laptop", "quick", "lstm"])
def test_recipe_equals_the_published_table(tmp_path, recipe, seed):
    """Probe scores of the released 10,000-epoch table, on a fresh encoder (minutes)."""
    args = Args(recipe=recipe, seed=seed, runs_dir=str(tmp_path), plots=False)
    path = hvae.train(args)
    scores = json.loads(path.with_suffix(".json").read_text())["scores"]
    assert scores["net_r2"] >= 0.946 and scores["move_accuracy"] >= 0.6
    assert scores["nn_net_match"] >= 0.7
