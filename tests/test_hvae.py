"""The HVAE against torch's distributions, the published layer sizes, and wrong files."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import Categorical, Normal, kl_divergence

import create_env
import gridworld
import hvae
from hvae import HVAE, VAE, default_args

TRAIN = gridworld.split_actions()["train"]
HELD_OUT = np.setdiff1d(np.arange(1024), TRAIN)
SHAPES = {"xy": (6, 2), "onehot": (6, 2), "video": (3, 48, 48), "image": (84, 84)}


def arguments(modality="xy", recipe="laptop", **changes):  # Grid World's numbers
    return replace(default_args("gridworld", recipe), modality=modality, **changes)


def small(modality, model=HVAE):  # and raw observations: 3 actions, 2 of each
    torch.manual_seed(0)
    if modality in ("xy", "onehot"):
        raw = gridworld.action_observations(TRAIN[:3], 2, modality, 0, 1)
    else:
        raw = np.random.default_rng(0).integers(0, 256, (3, 2, *SHAPES[modality]), np.uint8)
    return model(arguments(modality), SHAPES[modality]), torch.from_numpy(raw)


@pytest.mark.parametrize("modality", ["xy", "onehot", "image"])
def test_loss_equals_the_elbo_written_observation_by_observation(modality, monkeypatch):
    model, raw = small(modality)
    model.eval()
    monkeypatch.setattr(Normal, "rsample", lambda self: self.mean)
    parts, rec, kl_z, kl_c = model(raw), 0.0, 0.0, 0.0
    for observations in raw:
        inputs, targets = hvae.prepare(observations, model.args)
        states, h = model.encode(inputs)
        q_c = model.q_c(h[None])
        kl_c += kl_divergence(q_c, Normal(torch.zeros(16), torch.ones(16))).sum()
        for j in range(2):
            q_z, target = model.q_z(h[j : j + 1], q_c.mean), targets[j : j + 1]
            kl_z += kl_divergence(q_z, model.p_z(q_c.mean)).sum()
            output = model.decode(states[j : j + 1, 0], None, q_z.mean, q_c.mean)
            if modality == "onehot":
                rec += Categorical(logits=output).log_prob(target).sum()
            else:
                sigma = (model.log_var.clamp(-4, 3) / 2).exp()
                rec += Normal(output, sigma).log_prob(target).sum()
    # 6 observations; one c is shared by the set of 64 behind a representation
    expected = dict(rec=rec / 6, kl_z=kl_z / 6, kl_c=kl_c / 3 / 64)
    torch.testing.assert_close({key: parts[key] for key in expected}, expected)
    torch.testing.assert_close(parts["loss"], parts["kl_z"] + parts["kl_c"] - parts["rec"])


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
    ("xy", (6, 2), dict(recipe="laptop", env="create"), 239_978, 239_978 - 132_484),
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
    assert hvae.ConvDecoder(side, mask=False)(x.flatten(1))[0].shape == (2, 1, side, side)


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


def test_batch_norm_is_global_and_the_linear_path_a_map_of_averaged_observations():
    x = torch.randn(50, 8) * torch.arange(1, 9) + 3
    expected = (x - x.mean()) / (x.var(correction=0) + 1e-3).sqrt()
    torch.testing.assert_close(hvae.GlobalBatchNorm()(x), expected, rtol=1e-4, atol=1e-5)
    model, raw = small("xy")
    with torch.no_grad():
        model.q_c.after[-1].weight.zero_()  # the networks' share
        inputs, _ = hvae.prepare(raw.flatten(0, 1), model.args)
        mean = model.eval().represent(model.encode(inputs)[1].unflatten(0, (3, 2)))
        average = inputs.flatten(1).unflatten(0, (3, 2)).mean(1)  # (3, 12)
        expected = model.q_c.linear(average) / (1 + 1e-3) ** 0.5  # a new batch norm
    torch.testing.assert_close(mean, expected)
    picture = HVAE(arguments("image", env="stacking"), (84, 84))
    assert picture.q_c.linear.in_features == 288 and small("onehot")[0].q_c.linear is None


def test_targets_and_inputs_undone_are_the_states():
    raw = torch.from_numpy(gridworld.action_observations(np.arange(1024), 9, "xy", 0, 1))
    raw = raw.flatten(0, 1).float()  # (B, 6, 2)
    assert torch.equal(hvae.prepare(raw, arguments(relative=False))[1], raw[:, 1:])
    inputs, target = hvae.prepare(raw, arguments())
    inputs[:, 0] = 39.5 + 39.5 * inputs[:, 0]
    torch.testing.assert_close(inputs.cumsum(1), raw)
    assert torch.equal(target + raw[:, :1], raw[:, 1:])
    code, target = hvae.prepare(raw, arguments("onehot"))  # class 40: no change
    cells = code.unflatten(2, (2, 80)).argmax(-1).float()
    cells[:, 1:] -= 40
    assert (code.sum(-1) == 2).all() and torch.equal(cells.cumsum(1), raw)
    assert torch.equal(target - 40 + raw[:, :1], raw[:, 1:])


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
    args, model, warm = arguments(updates=8, batch_size=2), Recorder(), Recorder()
    assert len(hvae.fit(model, data, rows, args)) == 8 and model.weights == [1] * 8
    for raw in model.seen:
        assert raw.shape == (2, 4) and len(raw.unique()) == 8
        assert all(len(row.unique()) == 1 and row[0] in rows for row in raw // 7)
    assert len((torch.cat(model.seen[:2]) // 7).unique()) == 4  # an epoch: 2 batches of 2 out of 5
    hvae.fit(warm, data, rows, replace(args, kl_warmup=0.5))
    np.testing.assert_allclose(warm.weights, [0.2, 0.4, 0.6, 0.8, 1, 1, 1, 1], rtol=1e-6)
    with pytest.raises(ValueError, match="the loss is nan at update 1"):
        warm.w.data.fill_(np.nan)
        hvae.fit(warm, data, rows, args)


def test_short_training_learns_unseen_skills_and_never_sees_them(tmp_path, monkeypatch):
    fit = hvae.fit

    def checked_fit(model, data, rows, args):
        expected = gridworld.action_observations(TRAIN, 64, "xy", 0, 1)
        np.testing.assert_array_equal(data[rows], expected)
        losses = fit(model, data, rows, args)
        assert losses[-1]["error"] < 1.0 < losses[0]["error"]  # displacements vary by 1.5
        return losses

    monkeypatch.setattr(hvae, "fit", checked_fit)
    args = replace(default_args(), updates=150, observations=64, runs_dir=str(tmp_path))
    path = hvae.train(args)
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["scores"]["net_r2"] > 0.7 and record["scores"]["move_accuracy"] > 0.35
    assert record["published"] == dict(net_r2=0.946, move_accuracy=0.604, nn_net_match=0.717)
    # The weights reproduce the table, from all observations and from halves of them.
    model, table = HVAE(args, (6, 2)), hvae.load_representation(path, "gridworld")
    model.load_state_dict(torch.load(path.with_suffix(".pt"), weights_only=True))
    raw, ids = gridworld.action_observations(np.array([5]), 64, "xy", 0, 1), np.array([5])
    again, half = (hvae.embed(model, some, ids, args) for some in (raw, raw[:, 1::2]))
    np.testing.assert_allclose(again[0, 5], table["mean"][5], atol=1e-5)
    np.testing.assert_allclose(half[0, 5], again[2, 5], atol=1e-5)
    assert np.array_equal(table["action_ids"], TRAIN) and table["mean"].shape == (1024, 16)


def test_same_seed_same_bytes_and_the_callers_generator_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(hvae, "plot_tsne", lambda *args: None)  # takes a second
    torch.manual_seed(5)
    before, files = (torch.get_rng_state(), torch.get_num_threads()), {}
    for run, seed in (("a", 0), ("b", 0), ("c", 1)):
        args = replace(default_args(), updates=3, observations=8, runs_dir=str(tmp_path / run))
        path = hvae.train(replace(args, seed=seed))
        files[run] = [path.with_suffix(end).read_bytes() for end in (".npz", ".pt", ".json")]
    assert files["a"] == files["b"]
    assert all(a != c for a, c in zip(files["a"], files["c"], strict=True))
    assert torch.equal(before[0], torch.get_rng_state()) and before[1] == torch.get_num_threads()


def test_oracle_encoder_and_plain_vae_train_on_what_they_say(tmp_path):
    base = dict(updates=2, observations=8, runs_dir=str(tmp_path))
    path = hvae.train(replace(default_args(), train_on="all", **base))
    assert hvae.load_representation(path, "gridworld")["action_ids"].tolist() == list(range(1024))
    flat = replace(default_args(modality="onehot"), hierarchical=False, split_seed=3, **base)
    table = hvae.load_representation(hvae.train(flat), "gridworld", split_seed=3)
    assert np.array_equal(table["action_ids"], gridworld.split_actions("default", 3)["train"])
    assert table["config"]["hierarchical"] is False and table["config"]["updates"] == 2


@pytest.mark.parametrize("env, modality", [("create", "xy"), ("create", "state"),
                                           ("create", "video"), ("stacking", "image")])  # fmt: skip
def test_every_modality_trains_and_embeds(env, modality):
    args = replace(default_args(env, modality=modality), updates=1, batch_observations=2)
    module, ids = hvae.load_environment(env), np.array([1, 2, 5, 7])
    data = module.action_observations(ids, 2, modality, 0, 1)
    for model in (HVAE(args, data.shape[2:]), VAE(args, data.shape[2:])):
        assert np.isfinite(list(hvae.fit(model, data, np.array([0, 2]), args)[0].values())).all()
        tables = hvae.embed(model, data, ids, args)
        assert tables.shape == (3, module.NUM_ACTIONS, 128) and tables[:, ids].any(-1).all()


def test_observations_are_recorded_once_or_stay_in_memory(tmp_path, monkeypatch, capsys):
    calls, record, ids = [], create_env.action_observations, np.arange(12)
    count = lambda *args: calls.append(args) or record(*args)  # noqa: E731
    monkeypatch.setattr(create_env, "action_observations", count)
    split = dict(train=ids[:6], valid=ids[6:9], test=ids[9:])
    monkeypatch.setattr(create_env, "split_actions", lambda name, seed: split)
    args = replace(default_args("create"), observations=4, batch_observations=2, updates=2)
    args, folder = replace(args, runs_dir=str(tmp_path)), tmp_path / "observations"
    first, second = (hvae.observe(create_env, ids, replace(args, seed=s)) for s in (0, 3))
    assert isinstance(second, np.memmap) and len(calls) == 1 and np.array_equal(first, second)
    assert np.array_equal(first, record(ids, 4, "xy", 0, 1))
    hvae.observe(create_env, ids[1:], args)  # other actions, another file
    assert len(list(folder.glob("create-xy-4-s0-v1-*.npy"))) == len(list(folder.iterdir())) == 2
    table = hvae.train(args).read_bytes()
    folder.rename(tmp_path / "moved")
    folder.write_text("a file, not a folder")
    assert hvae.train(args).read_bytes() == table
    assert "note: observations stay in memory" in capsys.readouterr().out


@pytest.mark.parametrize("env, modality, size, batch_size, epochs, hidden", [
    ("gridworld", "xy", 16, 128, 10_000, 64),
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


def test_only_the_recipes_own_table_has_its_name():
    def name(recipe="laptop", **changes):
        return hvae.representation_path(replace(default_args(recipe=recipe), **changes)).name

    assert name() == name(updates=1_000) == name(device="cpu", runs_dir="elsewhere")
    assert name(train_on="all") == "gridworld-xy-hvae-all-default0-laptop-s0.npz"
    changes = [{}, dict(updates=1), dict(learning_rate=0.5), dict(hierarchical=False)]
    changes += [dict(seed=1), dict(split_seed=1), dict(recipe="quick"), dict(recipe="paper")]
    assert len({name(**change) for change in changes}) == len(changes)


@pytest.mark.parametrize("words, changes", [
    ("unknown environment 'chess'; allowed: gridworld", dict(env="chess")),
    ("recsys has no action observations", dict(env="recsys")),
    ("unknown modality 'smell'; allowed: xy, onehot", dict(modality="smell")),
    ("unknown recipe 'slow'", dict(recipe="slow")), ("odd", dict(split="odd")),
    ("device 'tpu' is not available", dict(device="tpu")), ("even", dict(hidden=63)),
    ("batch_size must be at least 1", dict(batch_size=0)), ("no effect", dict(epochs=5)),
    ("batch_observations are more than", dict(observations=3)),
    ("q_hidden has no effect", dict(hierarchical=False, q_hidden=7)),
])  # fmt: skip
def test_bad_choices_are_refused_before_anything_is_written(tmp_path, words, changes):
    with pytest.raises(ValueError, match=words) as error:
        hvae.train(replace(default_args(), **dict(runs_dir=str(tmp_path)) | changes))
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


def test_probe_of_ground_truth_and_of_noise():
    truth = hvae.probe(gridworld.engineered_representations(), TRAIN, HELD_OUT)
    assert min(truth["net_r2"], truth["move_accuracy"], truth["engineered_r2"]) > 0.999
    noise = np.random.default_rng(0).normal(size=(1024, 16))
    scores = hvae.probe(noise, TRAIN, HELD_OUT)
    assert scores["net_r2"] < 0.05 and 0.2 < scores["move_accuracy"] < 0.3
    assert scores["nn_net_match"] < 0.1 and abs(scores["nn_class"] - scores["chance_class"]) < 0.06
    path = gridworld.action_observations(np.arange(1024), 99, "xy", 0, 1).astype(float)
    scores = hvae.probe(np.median(path[:, :, 5] - path[:, :, 0], 1), TRAIN, HELD_OUT)  # net
    assert scores["nn_net_match"] > 0.98 and scores["nn_class"] > 0.9
    # 2 from the nearest training skill, 0.5 between the halves
    table = np.zeros((1024, 16))
    table[:, 0], table[HELD_OUT, 1] = np.arange(1024) % 3, 2.0
    halves = np.stack([table, table])
    halves[1, HELD_OUT, 5] += 0.5
    assert hvae.probe(table, TRAIN, HELD_OUT, halves=halves)["draw_noise"] == 0.25


def saved(folder, **changes):
    config = dict(env="gridworld", split="default", split_seed=0, train_on="train")
    table = dict(mean=np.ones((1024, 16)), action_ids=TRAIN, config=config)
    return hvae.save_representation(folder / "table.npz", **table | changes)


def test_saved_table_comes_back_and_an_own_one_needs_no_split(tmp_path):
    own, load = gridworld.engineered_representations(), hvae.load_representation
    loaded = load(saved(tmp_path, mean=own.astype(np.float64)), "gridworld")
    assert loaded["mean"].dtype == np.float32 and np.array_equal(loaded["mean"], own)
    assert np.array_equal(loaded["action_ids"], TRAIN) and loaded["config"]["split_seed"] == 0
    assert [p.name for p in tmp_path.iterdir()] == ["table.npz"]  # no temporary file is left
    path = saved(tmp_path, mean=own, action_ids=[], config=dict(env="gridworld"))
    assert np.array_equal(load(path, "gridworld", "default", 7)["mean"], own)


def test_wrong_or_damaged_tables_are_refused(tmp_path):
    for words, change in (
        (r"mean must be finite and \(1024, D\), got \(9, 16\)", dict(mean=np.zeros((9, 16)))),
        ("mean must be finite", dict(mean=np.full((1024, 16), 1e300))),  # too large for float32
        ("distinct", dict(action_ids=[1, 1])),
        (r"distinct integers in 0\.\.1023", dict(action_ids=[1.7, 2000])),
        ("unknown environment", dict(config=dict(split="default"))),
    ):
        with pytest.raises(ValueError, match=words):
            saved(tmp_path, **change)
    assert not list(tmp_path.iterdir())
    path, load = saved(tmp_path), hvae.load_representation
    half, arrays = path.read_bytes()[:-1000], dict(np.load(path))
    for words, changes, split in (
        ("not a file of representations", dict(config=np.array("3")), ()),
        ("not a file of representations", dict(mean=np.array([{}], dtype=object)), ()),  # a pickle
        ("another action set", dict(config=np.array('{"env": "gridworld"}')), ()),
        ("belongs to 'create', not to", dict(config=np.array('{"env": "create"}')), ()),
        ("other actions than split", dict(action_ids=TRAIN[:-1]), ()),
        ("split_seed 0, wanted 1", {}, ("default", 1)),
        ("split 'default', wanted 'full'", {}, ("full",)),
    ):
        np.savez(path, **arrays | changes)
        with pytest.raises(ValueError, match=words) as error:
            load(path, "gridworld", *split)
        assert "\n" not in str(error.value)
    path.write_bytes(half)
    with pytest.raises(ValueError, match="table.npz is not a file of representations"):
        load(path, "gridworld")
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.npz", "gridworld")


def test_command_line_makes_every_file_or_one_line_of_error(tmp_path, capsys):
    def run(*words):  # with a notebook's display, which may not exist here
        command = [sys.executable, hvae.__file__, *map(str, words), "--runs-dir", str(tmp_path)]
        environment = os.environ | dict(MPLBACKEND="module://matplotlib_inline.backend_inline")
        return subprocess.run(command, capture_output=True, text=True, env=environment)

    done = run("gridworld", "--modality", "smell")
    assert done.returncode == 1 and done.stderr.startswith("error: unknown modality")
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
    done = run("gridworld", "--updates", 5, "--observations", 8)
    assert done.returncode == 0 and not done.stderr, done.stderr  # no progress bar in a pipe
    assert "'net_r2': 0.946" in done.stdout and done.stdout.count("\n") == 2  # scores, path
    assert len({p.suffix for p in (tmp_path / "hvae").iterdir()}) == 5  # .npz .pt .csv .json .png
    with pytest.raises(SystemExit):
        hvae.parse_args(["create", "--recipe", "quick", "--help"])
    text = capsys.readouterr().out  # the numbers of this environment and recipe
    assert "(default: 1250)" in text and "(default: 128)" in text and "None" not in text


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_recipe_laptop_equals_the_published_table(tmp_path, seed):
    path = hvae.train(replace(default_args(), seed=seed, runs_dir=str(tmp_path)))
    scores = json.loads(path.with_suffix(".json").read_text())["scores"]
    assert scores["net_r2"] >= 0.946 and scores["move_accuracy"] >= 0.6
    assert scores["nn_net_match"] >= 0.7
