"""The HVAE against torch's distributions, the published layer sizes, and wrong files."""

import json
import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Categorical, Normal, kl_divergence

import create_env
import gridworld
import hvae
from hvae import HVAE, VAE, default_args

TRAIN = gridworld.split_actions()["train"]
HELD_OUT = np.setdiff1d(np.arange(1024), TRAIN)
SHAPES = {"xy": (6, 2), "onehot": (6, 2), "video": (3, 48, 48), "image": (84, 84)}


def arguments(modality="xy", recipe="laptop", **changes):
    """Args with Grid World's numbers, also for what Grid World has not."""
    return replace(default_args("gridworld", recipe), modality=modality, **changes)


def small(modality, model=HVAE):
    """A model and raw observations (3 actions, 2 of each, ...)."""
    torch.manual_seed(0)
    if modality in ("xy", "onehot"):
        raw = gridworld.action_observations(TRAIN[:3], 2, modality, 0, 1)
    else:
        raw = np.random.default_rng(0).integers(0, 256, (3, 2, *SHAPES[modality]), np.uint8)
    return model(arguments(modality), SHAPES[modality]), torch.from_numpy(raw)


# ---- the objective and the networks of D.3.1 ----


@pytest.mark.parametrize("modality", ["xy", "onehot", "image"])
def test_loss_equals_the_elbo_written_observation_by_observation(modality, monkeypatch):
    """The loss of a batch against loops over actions and observations, without sampling noise."""
    model, raw = small(modality)
    model.eval()
    monkeypatch.setattr(Normal, "rsample", lambda self: self.mean)
    with torch.no_grad():
        parts = model(raw)
        rec = kl_z = kl_c = 0.0
        for observations in raw:
            inputs, targets = hvae.prepare(observations, model.args)
            states, h = model.encode(inputs)
            q_c = model.q_c(h[None])
            kl_c += kl_divergence(q_c, Normal(torch.zeros(16), torch.ones(16))).sum()
            for j in range(len(observations)):
                q_z, p_z = model.q_z(h[j : j + 1], q_c.mean), model.p_z(q_c.mean)
                kl_z += kl_divergence(q_z, p_z).sum()
                output = model.decode(states[j : j + 1, 0], None, q_z.mean, q_c.mean)
                if modality == "onehot":
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


# A picture is not passed through the Bi-LSTM (823,296) but one linear layer (288 -> 128), and its
# decoder has no mask channel (16 + 1).
NO_LSTM = -823_296 + 289 * 128 - 17
BIG, VISUAL = dict(representation_size=128), dict(representation_size=128, hidden=128)


@pytest.mark.parametrize("modality, shape, changes, hierarchical, flat", [
    ("xy", (6, 2), {}, 339_818, 207_334),
    ("onehot", (6, 2), {}, 441_254 - 160, 308_770 - 160),  # no unused sigmas
    ("state", (7, 6), BIG, 414_738, 224_462),
    ("xy", (7, 2), BIG, 412_170, 221_894),
    ("video", (7, 48, 48), VISUAL, 1_549_968, 1_269_132),
    ("image", (84, 84), VISUAL, 1_382_336 + NO_LSTM, 1_101_500 + NO_LSTM),
    ("xy", (6, 2), dict(recipe="laptop"), 239_978, 207_334 - 339_818 + 239_978),
])  # fmt: skip
def test_number_of_parameters_is_the_published_one(modality, shape, changes, hierarchical, flat):
    args = arguments(modality, **dict(recipe="paper") | changes)
    for model, expected in ((HVAE, hierarchical), (VAE, flat)):
        assert sum(p.numel() for p in model(args, shape).parameters()) == expected


@pytest.mark.parametrize("side, sides", [(48, [24, 24, 12, 12, 6, 6, 3]),
                                         (84, [42, 42, 21, 21, 11, 11, 6, 6, 3])])  # fmt: skip
def test_convolutions_have_the_number_of_layers_of_the_appendix(side, sides):
    encoder, x, seen = hvae.ConvEncoder(side), torch.randn(2, 1, side, side), []
    for layer in encoder.layers:
        x = layer(x)
        seen += [x.shape[-1]] if isinstance(layer, torch.nn.Conv2d) else []
    assert seen == sides
    picture, mask = hvae.ConvDecoder(side, mask=True)(x.flatten(1))
    assert picture.shape == mask.shape == (2, 1, side, side)
    assert picture.abs().max() <= 0.5 and 0 <= mask.min() and mask.max() <= 1
    with pytest.raises(ValueError, match="48 or 84"):
        hvae.ConvEncoder(64)


def test_shut_mask_shows_the_first_frame_and_open_mask_the_picture():
    model, raw = small("video")
    x, target = hvae.prepare(raw.flatten(0, 1), model.args)
    start, latents = model.encode(x)[0][:, 0], (torch.randn(6, 16), torch.randn(6, 16))
    last = model.conv_decoder.layers[-2]  # the 1x1 convolution: channel 1 is the mask
    with torch.no_grad():
        last.weight.zero_()
        last.bias[:] = torch.tensor([50, -50])
        shut = model.decode(start, x[:, :1], *latents)
        last.bias[1] = 50
        opened = model.decode(start, x[:, :1], *latents)
    torch.testing.assert_close(shut, x[:, :1].expand_as(target))
    torch.testing.assert_close(opened, torch.full_like(target, 0.5))


@pytest.mark.parametrize("model", [HVAE, VAE])
@pytest.mark.parametrize("modality", list(SHAPES))
def test_gradient_reaches_every_parameter_and_order_does_not_matter(modality, model):
    model, raw = small(modality, model)
    model(raw)["loss"].backward()
    idle = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().any()]
    assert not idle
    model.eval()
    with torch.no_grad():
        h = model.encode(hvae.prepare(raw.flatten(0, 1), model.args)[0])[1].unflatten(0, (3, 2))
        mean, again, shuffled = (model.represent(some) for some in (h, h, h.flip(1)))
    assert mean.shape == (3, 16) and torch.equal(mean, again)
    torch.testing.assert_close(mean, shuffled, rtol=1e-4, atol=1e-5)


# ---- observations in, training ----


@given(ids=st.lists(st.integers(0, 1023), min_size=1, max_size=4), seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_targets_and_inputs_undone_are_the_states(ids, seed):
    raw = torch.from_numpy(gridworld.action_observations(np.unique(ids), 3, "xy", seed, 1))
    raw = raw.flatten(0, 1).float()  # (B, 6, 2)
    first = raw[:, :1]
    for modality, shift in (("xy", 0), ("onehot", 40)):  # class 40: no change
        for relative in (True, False):
            inputs, target = hvae.prepare(raw, arguments(modality, relative=relative))
            assert torch.equal(target + (first - shift if relative else 0), raw[:, 1:])
            if modality == "onehot":
                assert (inputs.sum(-1) == 2).all()
                inputs = inputs.unflatten(2, (2, 80)).argmax(-1).float()
            if relative:
                start = inputs[:, :1] if modality == "onehot" else 39.5 + 39.5 * inputs[:, :1]
                inputs = torch.cat([start, inputs[:, 1:] - shift], 1).cumsum(1)
            torch.testing.assert_close(inputs, raw)


class Recorder(torch.nn.Module):
    """A model that keeps its batches; its parameter's gradient is the weight of the KLs."""

    def __init__(self):
        super().__init__()
        self.w, self.seen, self.weights = torch.nn.Parameter(torch.ones(())), [], []
        self.w.register_hook(lambda grad: self.weights.append(grad.item()))

    def forward(self, raw):
        self.seen.append(raw)
        return dict(loss=self.w, rec=self.w * 0, kl_z=self.w, kl_c=self.w * 0)


def test_batches_hold_distinct_observations_of_training_actions_and_kls_warm_up():
    data, rows = np.arange(10 * 7).reshape(10, 7), np.array([1, 2, 4, 8, 9])  # 7 of each action
    args, model = arguments(updates=8, batch_size=2, batch_observations=3), Recorder()
    assert len(hvae.fit(model, data, rows, args)) == 8 and model.weights == [1] * 8
    for raw in model.seen:
        assert raw.shape == (2, 3) and len(raw.unique()) == 6
        assert all(len(row.unique()) == 1 for row in raw // 7)  # one action per row
        assert set((raw // 7).flatten().tolist()) <= set(rows.tolist())
    assert len((torch.cat(model.seen[:2]) // 7).unique()) == 4  # an epoch: 2 batches of 2 out of 5
    model = Recorder()
    hvae.fit(model, data, rows, replace(args, kl_warmup=0.5))
    np.testing.assert_allclose(model.weights, [0.2, 0.4, 0.6, 0.8, 1, 1, 1, 1], rtol=1e-6)
    model, raw = small("xy")
    with pytest.raises(ValueError, match="the loss is .* at update"):
        hvae.fit(model, raw.numpy(), np.arange(3), replace(args, updates=50, learning_rate=1e30,
                                                           batch_observations=2))  # fmt: skip


def test_short_training_learns_unseen_skills_and_never_sees_them(tmp_path, monkeypatch):
    fit = hvae.fit

    def checked_fit(model, data, rows, args):
        expected = gridworld.action_observations(TRAIN, 64, "xy", 0, 1)
        np.testing.assert_array_equal(data[rows], expected)
        losses = fit(model, data, rows, args)
        assert losses[-1]["error"] < 1.0 < losses[0]["error"]  # displacements vary by 1.5
        return losses

    monkeypatch.setattr(hvae, "fit", checked_fit)
    args = replace(default_args(), updates=200, observations=64, runs_dir=str(tmp_path))
    path = hvae.train(args)
    assert path == hvae.representation_path(args)
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["scores"]["net_r2"] > 0.7 and record["scores"]["move_accuracy"] > 0.35
    assert record["published"] == dict(net_r2=0.946, move_accuracy=0.604, nn_net_match=0.717)
    endings = (".npz", ".pt", ".csv", ".json", "-tsne.png")
    assert {p.name for p in path.parent.iterdir()} == {path.stem + end for end in endings}
    lines = path.with_suffix(".csv").read_text().splitlines()
    assert lines[0] == "loss,rec,kl_z,kl_c,error" and len(lines) == 201
    # The weights reproduce the table, from all observations and from halves of them.
    table = hvae.load_representation(path, "gridworld")
    assert table["mean"].shape == (1024, 16) and np.array_equal(table["action_ids"], TRAIN)
    model = HVAE(args, (6, 2))
    model.load_state_dict(torch.load(path.with_suffix(".pt"), weights_only=True))
    raw, ids = gridworld.action_observations(np.array([5]), 64, "xy", 0, 1), np.array([5])
    again, half = (hvae.embed(model, some, ids, args) for some in (raw, raw[:, 1::2]))
    np.testing.assert_allclose(again[0, 5], table["mean"][5], atol=1e-5)
    np.testing.assert_allclose(half[0, 5], again[2, 5], atol=1e-5)
    assert not again[:, :5].any()  # not asked for


def test_same_seed_same_bytes_and_the_callers_generator_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(hvae, "plot_tsne", lambda *args: None)  # takes a second
    torch.manual_seed(5)
    before, files = (torch.get_rng_state(), torch.get_num_threads()), {}
    for run, seed in (("a", 0), ("b", 0), ("c", 1)):
        args = replace(default_args(), updates=3, observations=8, seed=seed)
        path = hvae.train(replace(args, runs_dir=str(tmp_path / run)))
        files[run] = [path.with_suffix(end).read_bytes() for end in (".npz", ".pt", ".json")]
    assert files["a"] == files["b"]
    assert all(a != c for a, c in zip(files["a"], files["c"], strict=True))
    assert torch.equal(before[0], torch.get_rng_state()) and before[1] == torch.get_num_threads()


def test_oracle_encoder_and_plain_vae_train_on_what_they_say(tmp_path):
    base = dict(updates=2, observations=8, runs_dir=str(tmp_path))
    path = hvae.train(replace(default_args(), train_on="all", **base))
    assert hvae.load_representation(path, "gridworld")["action_ids"].tolist() == list(range(1024))
    flat = replace(default_args(modality="onehot"), hierarchical=False, split_seed=3, **base)
    path = hvae.train(flat)
    assert path.name.startswith("gridworld-onehot-vae-default3-laptop-s0-")
    table = hvae.load_representation(path, "gridworld", split_seed=3)
    assert np.array_equal(table["action_ids"], gridworld.split_actions("default", 3)["train"])
    assert table["config"]["hierarchical"] is False and table["config"]["updates"] == 2


@pytest.mark.parametrize("model", [HVAE, VAE])
@pytest.mark.parametrize("env, modality", [("create", "xy"), ("create", "state"),
                                           ("create", "video"), ("stacking", "image")])  # fmt: skip
def test_every_modality_trains_and_embeds(env, modality, model):
    """Real observations of four actions: one update, one table."""
    args = default_args(env, modality=modality)
    args = replace(args, updates=1, batch_observations=2, observations=2)
    module, ids = hvae.load_environment(env), np.array([1, 2, 5, 7])
    data = module.action_observations(ids, 2, modality, 0, 1)
    model = model(args, data.shape[2:])
    assert np.isfinite(list(hvae.fit(model, data, np.array([0, 2]), args)[0].values())).all()
    tables = hvae.embed(model, data, ids, args)
    assert tables.shape == (3, module.NUM_ACTIONS, 128) and tables[:, ids].any(-1).all()


@pytest.fixture
def few_tools(monkeypatch):
    """CREATE with 12 tools; a list of the requests for observations."""
    calls, record, ids = [], create_env.action_observations, np.arange(12)
    count = lambda *args: calls.append(args) or record(*args)  # noqa: E731
    monkeypatch.setattr(create_env, "action_observations", count)
    split = dict(train=ids[:6], valid=ids[6:9], test=ids[9:])
    monkeypatch.setattr(create_env, "split_actions", lambda name, seed: split)
    return calls


def test_observations_are_recorded_once_or_stay_in_memory(tmp_path, few_tools, capsys):
    args, ids = replace(default_args("create"), observations=4, batch_observations=2), np.arange(12)
    args = replace(args, runs_dir=str(tmp_path), updates=2)
    first, second = (hvae.observe(create_env, ids, replace(args, seed=s)) for s in (0, 3))
    expected = create_env.action_observations(ids, 4, "xy", 0, 1)
    assert isinstance(second, np.memmap) and len(few_tools) == 2
    assert np.array_equal(first, expected) and np.array_equal(second, expected)
    folder = tmp_path / "observations"
    hvae.observe(create_env, ids[1:], args)  # other actions, another file
    assert len(list(folder.glob("create-xy-4-s0-v1-*.npy"))) == len(list(folder.iterdir())) == 2
    path = hvae.train(args)
    table = hvae.load_representation(path, "create")["mean"]
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    folder.write_text("a file, not a folder")
    capsys.readouterr()
    hvae.train(args)
    assert capsys.readouterr().out.startswith("note: observations stay in memory")
    assert np.array_equal(hvae.load_representation(path, "create")["mean"], table)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hvae", "observations"]


# ---- recipes, names, bad choices ----


@pytest.mark.parametrize("env, modality, size, batch_size, epochs, hidden", [
    ("gridworld", "xy", 16, 128, 10_000, 64),
    ("gridworld", "onehot", 16, 128, 10_000, 64),
    ("create", "xy", 128, 128, 10_000, 64),
    ("create", "video", 128, 32, 5_000, 128),  # published code
    ("stacking", "image", 128, 32, 5_000, 128),
])  # fmt: skip
def test_recipe_paper_is_tables_3_and_4(env, modality, size, batch_size, epochs, hidden):
    table = dict(representation_size=size, batch_size=batch_size, epochs=epochs, hidden=hidden)
    table |= dict(learning_rate=0.001, observations=1024, batch_observations=1024, updates=0)
    table |= dict(set_size=1024, q_hidden=128, relative=False, kl_warmup=0.0)
    assert table.items() <= vars(default_args(env, "paper", modality)).items()
    if modality != "video":  # 28 GB
        assert default_args(env, "laptop", modality).observations == 1024
    assert len(fields(hvae.Args)) == 22


def test_only_the_recipes_own_table_has_its_name():
    def name(recipe="laptop", **changes):
        return hvae.representation_path(replace(default_args(recipe=recipe), **changes)).name

    assert name() == name(updates=2_750) == name(device="cpu", runs_dir="elsewhere")
    assert name() == "gridworld-xy-hvae-default0-laptop-s0.npz"
    assert name(train_on="all") == "gridworld-xy-hvae-all-default0-laptop-s0.npz"
    changes = [{}, dict(updates=1), dict(learning_rate=0.5), dict(representation_size=4)]
    changes += [dict(seed=1), dict(split_seed=1), dict(recipe="quick"), dict(recipe="paper")]
    assert len({name(**change) for change in changes}) == len(changes)


@pytest.mark.parametrize("changes, words", [
    (dict(env="chess"), "unknown environment 'chess'; allowed: gridworld"),
    (dict(env="recsys"), "recsys has no action observations"),
    (dict(modality="smell"), "unknown modality 'smell'; allowed: xy, onehot"),
    (dict(recipe="slow"), "unknown recipe 'slow'"),
    (dict(device="tpu"), "device 'tpu' is not available; allowed: auto, cpu"),
    (dict(split="odd"), "odd"),
    (dict(batch_size=0), "batch_size must be at least 1, got 0"),
    (dict(hidden=63), "hidden must be even"),
    (dict(observations=3), "batch_observations are more than"),
    (dict(epochs=5), "epochs has no effect"),
    (dict(hierarchical=False, q_hidden=7), "q_hidden has no effect"),
    (dict(env="stacking", modality="image", relative=False), "relative has no effect"),
])  # fmt: skip
def test_bad_choices_are_refused_before_anything_is_written(tmp_path, changes, words):
    with pytest.raises(ValueError, match=words) as error:
        hvae.train(replace(default_args(), **dict(runs_dir=str(tmp_path)) | changes))
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


# ---- probe ----


def test_probe_of_ground_truth_and_of_noise():
    truth = hvae.probe(gridworld.engineered_representations(), TRAIN, HELD_OUT)
    assert min(truth["net_r2"], truth["move_accuracy"], truth["engineered_r2"]) > 0.999
    noise = np.random.default_rng(0).normal(size=(1024, 16))
    scores = hvae.probe(noise, TRAIN, HELD_OUT)
    assert scores["net_r2"] < 0.05 and 0.2 < scores["move_accuracy"] < 0.3
    assert scores["nn_net_match"] < 0.1 and abs(scores["nn_class"] - scores["chance_class"]) < 0.06
    moves = np.arange(1024)[:, None] // 4 ** np.arange(5) % 4
    net = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[moves].sum(1).astype(float)
    scores = hvae.probe(net, TRAIN, HELD_OUT)
    assert scores["nn_net_match"] > 0.98 and scores["nn_class"] > 0.9
    # 2 from the nearest training skill, 0.5 between the halves
    table = np.zeros((1024, 16))
    table[:, 0], table[HELD_OUT, 1] = np.arange(1024) % 3, 2.0
    halves = np.stack([table, table])
    halves[1, HELD_OUT, 5] += 0.5
    assert hvae.probe(table, TRAIN, HELD_OUT, halves=halves)["draw_noise"] == 0.25


# ---- the file of representations ----


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """A valid file and the arguments it was saved with."""
    config = dict(env="gridworld", split="default", split_seed=0, train_on="train")
    mean = np.random.default_rng(0).normal(size=(1024, 16))
    saved = dict(mean=mean, action_ids=TRAIN, config=config)
    return hvae.save_representation(tmp_path_factory.mktemp("table") / "table.npz", **saved), saved


def test_saved_table_comes_back_and_an_own_one_needs_no_split(table, tmp_path):
    path, saved = table
    loaded = hvae.load_representation(path, "gridworld")
    assert np.array_equal(loaded["mean"], saved["mean"].astype(np.float32))
    assert np.array_equal(loaded["action_ids"], TRAIN)
    assert saved["config"].items() <= loaded["config"].items()
    assert [p.name for p in path.parent.iterdir()] == ["table.npz"]  # no temporary file is left
    own = gridworld.engineered_representations()
    path = hvae.save_representation(tmp_path / "own.npz", own, [], dict(env="gridworld"))
    assert np.array_equal(hvae.load_representation(path, "gridworld", "default", 7)["mean"], own)


def test_saving_nonsense_is_refused(tmp_path, table):
    for change, words in (
        (dict(mean=np.zeros((9, 16))), r"mean must be finite and \(1024, D\), got \(9, 16\)"),
        (dict(mean=np.full((1024, 16), 1e300)), "mean must be finite"),  # too large for float32
        (dict(action_ids=[1, 1]), "distinct"),
        (dict(action_ids=[1.7, 2000]), r"distinct integers in 0\.\.1023"),
        (dict(config=dict(split="default")), "unknown environment"),
    ):
        with pytest.raises(ValueError, match=words):
            hvae.save_representation(tmp_path / "x.npz", **(table[1] | change))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("changes, words", [
    (dict(mean=None), "not a file of representations"),
    (dict(config=np.array("3")), "not a file of representations"),
    (dict(mean=np.array([{}], dtype=object)), "not a file of representations"),  # a pickle
    (dict(config=np.array('{"env": "gridworld"}')), "another action set"),
    (dict(config=np.array('{"env": "create"}')), "belongs to 'create', not to 'gridworld'"),
    (dict(action_ids=TRAIN[:-1]), "other actions than split"),
])  # fmt: skip
def test_loading_a_wrong_table_is_refused(tmp_path, table, changes, words):
    with np.load(table[0]) as file:
        arrays = {key: file[key] for key in file.files} | changes
    path = tmp_path / "wrong.npz"
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(ValueError, match=words) as error:
        hvae.load_representation(path, "gridworld")
    assert "\n" not in str(error.value)


def test_loading_for_another_split_or_half_a_file_is_refused(tmp_path, table):
    half = tmp_path / "half.npz"
    half.write_bytes(table[0].read_bytes()[:-1000])
    for path, split, words in (
        (half, (), "half.npz is not a file of representations"),
        (table[0], ("default", 1), "split_seed 0, wanted 1"),
        (table[0], ("full",), "split 'default', wanted 'full'"),
    ):
        with pytest.raises(ValueError, match=words):
            hvae.load_representation(path, "gridworld", *split)
    with pytest.raises(FileNotFoundError):
        hvae.load_representation(tmp_path / "none.npz", "gridworld")


# ---- the command line ----


def run(*words):
    """The script with a display setting that leads nowhere."""
    command = [sys.executable, str(Path(hvae.__file__)), *map(str, words)]
    environment = os.environ | dict(MPLBACKEND="module://nowhere")
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def test_command_line_makes_every_file_or_one_line_of_error(tmp_path):
    done = run("gridworld", "--modality", "smell", "--runs-dir", tmp_path)
    assert done.returncode == 1 and done.stderr.startswith("error: unknown modality")
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
    done = run("gridworld", "--updates", 5, "--observations", 8, "--runs-dir", tmp_path)
    assert done.returncode == 0 and not done.stderr, done.stderr  # no progress bar in a pipe
    assert "'net_r2': 0.946" in done.stdout and done.stdout.count("\n") == 2  # scores, path
    assert len(list((tmp_path / "hvae").glob("gridworld-xy-hvae-default0-laptop-s0-*"))) == 5


def test_help_shows_the_numbers_of_an_environment_and_a_recipe(capsys):
    with pytest.raises(SystemExit):
        hvae.parse_args(["create", "--recipe", "quick", "--help"])
    text = capsys.readouterr().out
    for words in ("Table 3", "Table 4", "--no-hierarchical", "(default: 1250)", "(default: 128)"):
        assert words in text
    assert "None" not in text


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_recipe_laptop_equals_the_published_table(tmp_path, seed):
    """Probe scores of the released 10,000-epoch table, on a fresh encoder (minutes)."""
    path = hvae.train(replace(default_args(), seed=seed, runs_dir=str(tmp_path)))
    scores = json.loads(path.with_suffix(".json").read_text())["scores"]
    assert scores["net_r2"] >= 0.946 and scores["move_accuracy"] >= 0.6
    assert scores["nn_net_match"] >= 0.7
