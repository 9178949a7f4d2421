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
from hvae import HVAE, VAE, UserError, default_args

TRAIN = gridworld.split_actions()["train"]
HELD_OUT = np.setdiff1d(np.arange(1024), TRAIN)
SHAPES = {"xy": (6, 2), "onehot": (6, 2), "video": (3, 48, 48), "image": (84, 84)}


def arguments(modality="xy", **changes):  # Grid World's numbers
    return replace(default_args("gridworld"), **dict(modality=modality, device="cpu") | changes)


def small(modality, model=HVAE, **changes):  # and raw observations: 3 actions, 2 of each
    torch.manual_seed(0)
    if modality in ("xy", "onehot"):
        raw = gridworld.action_observations(TRAIN[:3], 2, modality, 0, 1)
    else:
        raw = np.random.default_rng(0).integers(0, 256, (3, 2, *SHAPES[modality]), np.uint8)
    args = arguments(modality, batch_observations=2, **changes)
    return model(args, SHAPES[modality]), torch.from_numpy(raw)


def tiny(env="gridworld", modality=None, **changes):
    changes = dict(updates=2, observations=8, batch_observations=2, device="cpu") | changes
    return replace(default_args(env, modality=modality), **changes)


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
    expected = dict(rec=rec / 6, kl_z=kl_z / 6, kl_c=kl_c / 3 / 64)  # kl_c_divisor
    torch.testing.assert_close(parts, expected)


# A picture passes a linear layer (288 -> 128), not the Bi-LSTM (823,296), and has no mask (16 + 1).
NO_LSTM = -823_296 + 289 * 128 - 17
BIG, VISUAL = dict(representation_size=128), dict(representation_size=128, hidden=128)


@pytest.mark.parametrize("modality, shape, changes, hierarchical, flat", [
    ("xy", (6, 2), {}, 339_818, 207_334),
    ("onehot", (6, 2), {}, 441_254 - 160, 308_770 - 160),  # no unused sigmas
    ("state", (7, 6), BIG, 414_738, 224_462),
    ("xy", (7, 2), BIG, 412_170, 221_894),
    ("video", (7, 48, 48), VISUAL, 1_549_968, 1_269_132),
    ("image", (84, 84), VISUAL, 1_382_336 + NO_LSTM, 1_101_500 + NO_LSTM),
    ("xy", (6, 2), dict(compact_lstm=True), 239_978, 239_978 - 132_484),
])  # fmt: skip
def test_number_of_parameters_is_the_published_one(modality, shape, changes, hierarchical, flat):
    args = arguments(modality, **dict(compact_lstm=False) | changes)
    for model, expected in ((HVAE, hierarchical), (VAE, flat)):
        assert sum(p.numel() for p in model(args, shape).parameters()) == expected


def test_shut_mask_shows_the_first_frame_and_open_mask_the_picture():
    model, raw = small("video")
    x, target = hvae.prepare(raw.flatten(0, 1), model.args)
    inputs = model.encode(x)[0][:, 0], x[:, :1], torch.randn(6, 16), torch.randn(6, 16)
    last = model.conv_decoder[-2].requires_grad_(False)  # the 1x1 convolution
    last.weight.zero_()
    last.bias[:] = torch.tensor([50, -50])  # picture, mask
    torch.testing.assert_close(model.decode(*inputs), x[:, :1].expand_as(target))
    last.bias[1] = 50
    torch.testing.assert_close(model.decode(*inputs), torch.full_like(target, 0.5))


@pytest.mark.parametrize("model", [HVAE, VAE])
@pytest.mark.parametrize("modality", list(SHAPES))
def test_gradient_reaches_every_parameter_and_order_does_not_matter(modality, model):
    model, raw = small(modality, model, linear_path=modality in ("onehot", "image"))
    parts = model(raw)
    (parts["kl_z"] + parts["kl_c"] - parts["rec"]).backward()
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
    for kind in (HVAE, VAE):
        model, raw = small("xy", kind, linear_path=True)
        x, h = model.eval().encode(hvae.prepare(raw.flatten(0, 1), model.args)[0])
        assert torch.equal(h[:, 64:], x.flatten(1)) and small("xy", kind)[0].path is None
        h, path = h.unflatten(0, (3, 2)), model.path
        both, model.path = model.represent(h), None
        expected = 0.1 * model.represent(h) + path(h.mean(1))
        torch.testing.assert_close(both, expected, rtol=1e-4, atol=1e-5)


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
        return dict(rec=torch.tensor(0.0), kl_z=self.w, kl_c=torch.tensor(0.0))


def test_batches_hold_distinct_observations_of_training_actions_and_kls_warm_up():
    data, rows = np.arange(10 * 7).reshape(10, 7), np.array([1, 2, 4, 8, 9])  # 7 of each action
    args, model, warm = arguments(updates=8, batch_size=2), Recorder(), Recorder()
    assert len(hvae.fit(model, data, rows, args)) == 8 and model.weights == [1] * 8
    for raw in model.seen:
        assert raw.shape == (2, 4) and len(raw.unique()) == 8
        assert all(len(row.unique()) == 1 and row[0] in rows for row in raw // 7)
    assert len((torch.cat(model.seen[:2]) // 7).unique()) == 4  # an epoch: 2 batches of 2 out of 5
    losses = hvae.fit(warm, data, rows, replace(args, kl_warmup=0.5, updates=0, epochs=4))
    assert {*losses[0]} == {"loss", "rec", "kl_z", "kl_c"} and losses[0]["loss"] == 0.2
    np.testing.assert_allclose(warm.weights, [0.2, 0.4, 0.6, 0.8, 1, 1, 1, 1], rtol=1e-6)


def test_short_training_learns_unseen_skills_and_never_sees_them(tmp_path, monkeypatch):
    fit, seen = hvae.fit, []
    spy = lambda model, data, rows, args: seen.append(data[rows]) or fit(model, data, rows, args)  # noqa: E731
    monkeypatch.setattr(hvae, "fit", spy)
    args = arguments(updates=150, observations=64, linear_path=True, runs_dir=str(tmp_path))
    path = hvae.train(args)
    recorded = gridworld.action_observations(np.arange(1024), 64, "xy", 0, 1)
    np.testing.assert_array_equal(seen[0], recorded[TRAIN])
    scores = json.loads(path.with_suffix(".json").read_text())
    assert scores["net_r2"] > 0.7 and scores["move_accuracy"] > 0.35
    # The weights reproduce the table.
    model, table = HVAE(args, (6, 2)), hvae.load_representation(path, "gridworld")
    model.load_state_dict(torch.load(path.with_suffix(".pt"), weights_only=True))
    again = hvae.embed(model, recorded[5:6], np.array([5]), args)
    np.testing.assert_allclose(again[5], table["mean"][5], atol=1e-5)
    assert np.array_equal(table["action_ids"], TRAIN) and table["mean"].shape == (1024, 16)


def test_same_seed_same_table_and_the_callers_generator_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(hvae, "report", lambda *args: None)  # takes a second
    torch.manual_seed(5)
    before, files = (torch.get_rng_state(), torch.get_num_threads()), {}
    for run, seed in (("a", 0), ("b", 0), ("c", 1)):
        path = hvae.train(tiny(seed=seed, runs_dir=str(tmp_path / run)))
        mean = hvae.load_representation(path, "gridworld")["mean"].tobytes()
        files[run] = [mean] + [path.with_suffix(end).read_bytes() for end in (".pt", ".csv")]
    assert files["a"] == files["b"]
    assert all(a != c for a, c in zip(files["a"], files["c"], strict=True))
    assert torch.equal(before[0], torch.get_rng_state()) and before[1] == torch.get_num_threads()


def test_oracle_and_plain_vae_train_on_what_they_say_and_every_number_names_a_table(tmp_path):
    base = tiny(runs_dir=str(tmp_path))
    path = hvae.train(replace(base, train_on="all"))
    assert hvae.load_representation(path, "gridworld")["action_ids"].tolist() == list(range(1024))
    flat = tiny(modality="onehot", hierarchical=False, split_seed=3, runs_dir=str(tmp_path))
    table = hvae.load_representation(hvae.train(flat), "gridworld", split_seed=3)
    assert np.array_equal(table["action_ids"], gridworld.split_actions("default", 3)["train"])
    others = [dict(updates=1), dict(linear_path=True), dict(seed=1), dict(split_seed=1), {}]
    names = {hvae.representation_path(replace(base, **other)) for other in others}
    assert len({path, *names}) == 6 and path.name.startswith("gridworld-xy-hvae-all-fast-s0-")
    assert hvae.representation_path(replace(base, device="cuda")) in names


@pytest.mark.parametrize("name", ["create xy", "create state", "create video", "stacking image"])
def test_every_modality_trains_and_embeds(name):
    args, ids = tiny(*name.split(), updates=1), np.array([1, 2, 5, 7])
    data = hvae.load_environment(args.env).action_observations(ids, 2, args.modality, 0, 1)
    for model in (HVAE(args, data.shape[2:]), VAE(args, data.shape[2:])):
        assert np.isfinite(list(hvae.fit(model, data, np.array([0, 2]), args)[0].values())).all()
        table = hvae.embed(model, data, ids, args)
        assert table.shape[1] == 128 and table[ids].any(1).all() and not table[0].any()


def test_no_op_is_trained_on_no_row_is_zero_and_recordings_are_made_once_per_source(
    tmp_path, monkeypatch, capsys
):
    calls, record, ids = [], create_env.action_observations, np.arange(12)
    count = lambda *args: calls.append(args[0].tolist()) or record(*args)  # noqa: E731
    monkeypatch.setattr(create_env, "action_observations", count)
    split = dict(train=ids[1:6], valid=ids[6:9], test=ids[9:])
    monkeypatch.setattr(create_env, "split_actions", lambda name, seed: split)
    args = tiny("create", observations=4, runs_dir=str(tmp_path))
    table = hvae.load_representation(hvae.train(args), "create")
    assert table["action_ids"].tolist() == [create_env.NO_OP, 1, 2, 3, 4, 5]
    assert table["mean"][ids].any(1).all() and not table["mean"][12:].any()
    again = hvae.observe(create_env, ids, replace(args, seed=3))  # a second encoder
    assert calls == [ids.tolist()] and np.array_equal(again, record(ids, 4, "xy", 0, 1))
    (path,) = (tmp_path / "observations").iterdir()
    assert capsys.readouterr().out.count(f"{path} (delete it to record anew)") == 2
    (tmp_path / "create_env.py").write_text("# other physics", encoding="utf-8")
    monkeypatch.setattr(create_env, "__file__", str(tmp_path / "create_env.py"))
    hvae.observe(create_env, ids, args)
    assert len(calls) == 2 and not path.exists()


def test_recipe_paper_is_tables_3_and_4():
    table = dict(learning_rate=0.001, observations=1024, batch_observations=1024, updates=0)
    table |= dict(kl_c_divisor=1024, q_hidden=128, relative=False, kl_warmup=0.0, linear_path=False)
    for env, modality, size, batch_size, epochs, hidden in (
        ("gridworld", "xy", 16, 128, 10_000, 64), ("create", "xy", 128, 128, 10_000, 64),
        ("create", "video", 128, 32, 5_000, 128), ("stacking", "image", 128, 32, 5_000, 128),
    ):  # fmt: skip
        table |= dict(representation_size=size, batch_size=batch_size, epochs=epochs, hidden=hidden)
        assert table.items() <= vars(default_args(env, "paper", modality)).items()


def test_bad_choices_are_refused_before_anything_is_written(tmp_path, monkeypatch):
    leak = dict(train=np.arange(9), valid=np.arange(8, 20), test=np.arange(20, 30))
    base = tiny(runs_dir=str(tmp_path))
    refused = [
        ("unknown environment 'chess'; allowed: gridworld", lambda: default_args("chess")),
        ("unknown environment './no.py'; allowed: gridworld", lambda: default_args("./no.py")),
        ("recsys has no action observations", lambda: default_args("recsys")),
        ("unknown recipe 'slow'; allowed: quick, fast", lambda: default_args("create", "slow")),
        ("unknown split 'odd'; allowed: default", lambda: hvae.train(replace(base, split="odd"))),
        ("more than the 1 observations", lambda: hvae.train(replace(base, observations=1))),
        ("updates and epochs are both 0", lambda: hvae.train(replace(base, updates=0))),
        ("the parts of split 'default' overlap", lambda: hvae.train(base)),
    ]  # fmt: skip
    for words, call in refused:
        if "overlap" in words:
            monkeypatch.setattr(gridworld, "split_actions", lambda name, seed: leak)
        with pytest.raises(UserError, match=words):
            call()
    assert not list(tmp_path.iterdir())


OWN = """import numpy as np
NUM_ACTIONS, MODALITIES = 40, ("xy",)
UNITS = dict(centre=0.0, half_width=10.0, step=0.5)
action_labels = lambda: np.repeat(["left", "right"], 20)
engineered_representations = lambda: np.linspace(-1, 1, 40)[:, None]
def split_actions(split, seed):
    return dict(train=np.arange(0, 40, 2), valid=np.arange(1, 40, 4), test=np.arange(3, 40, 4))
def action_observations(ids, n, modality, seed, workers):
    start = np.random.default_rng(seed).uniform(-10, 10, (len(ids), n, 1, 1))
    return start + engineered_representations()[ids][:, None, None] * np.arange(4)[:, None]
"""


def test_environment_of_ones_own_is_a_file(tmp_path, monkeypatch):
    file = tmp_path / "own_world.py"
    file.write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    quick = default_args("./own_world.py", "quick")
    assert quick.updates * quick.batch_observations <= 2000 and quick.observations <= 64
    path = hvae.train(replace(quick, updates=30))
    assert path.name.startswith("own_world-xy-hvae-train-quick-s0-")
    assert hvae.load_representation(path, str(file))["mean"].any(1).all()
    module = hvae.load_environment("own_world.py")
    assert module is hvae.load_environment(str(file)) is sys.modules["own_world"]
    inputs, target = hvae.prepare(torch.tensor([[[10.0], [11.0], [13.0]]]), quick)
    assert inputs.flatten().tolist() == [1, 2, 4] and target.flatten().tolist() == [2, 6]
    moved = [replace(quick, env=env) for env in ("own_world.py", str(file))]
    assert hvae.representation_path(moved[0]) == hvae.representation_path(moved[1])
    for name, text in (("slip.py", "1 / 0"), ("json.py", ""), ("time.py", "")):
        (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(ZeroDivisionError):
        hvae.load_environment("slip.py")
    for name in ("json.py", "time.py"):
        with pytest.raises(UserError, match="Python has another module called .*: rename"):
            hvae.load_environment(name)


def test_missing_package_is_one_sentence_and_errors_of_an_environment_keep_their_traceback(
    tmp_path, monkeypatch
):
    def fail(*args):
        raise error

    monkeypatch.setattr(gridworld, "action_observations", fail)
    for error in (ValueError("slip"), RuntimeError("slip")):
        with pytest.raises(type(error), match="^slip$"):
            hvae.train(tiny(runs_dir=str(tmp_path)))
    assert not list((tmp_path / "observations").iterdir())
    error = ModuleNotFoundError("Shape Stacking needs pybullet")
    monkeypatch.setattr(hvae.importlib, "import_module", fail)
    with pytest.raises(UserError, match="^Shape Stacking needs pybullet$"):
        hvae.load_environment("stacking")


@pytest.mark.parametrize("held_out", [[], [3], [3, 5, 7]])
def test_few_held_out_actions_are_no_reason_to_fail(tmp_path, monkeypatch, held_out):
    split = dict(train=np.arange(8, 1024, 5), valid=np.array(held_out, int), test=np.arange(0))
    monkeypatch.setattr(gridworld, "split_actions", lambda name, seed: split)
    path = hvae.train(tiny(runs_dir=str(tmp_path)))
    assert path.with_name(f"{path.stem}-tsne.png").exists() == (len(held_out) == 3)


def test_probe_of_ground_truth_and_of_noise():
    truth = hvae.probe(gridworld.engineered_representations(), TRAIN, HELD_OUT)
    assert min(truth["net_r2"], truth["move_accuracy"], truth["engineered_r2"]) > 0.999
    noise = hvae.probe(np.random.default_rng(0).normal(size=(1024, 16)), TRAIN, HELD_OUT)
    assert noise["net_r2"] < 0.05 and 0.2 < noise["move_accuracy"] < 0.3
    assert noise["nn_net_match"] < 0.1 and abs(noise["nn_class"] - 0.25) < 0.06
    net = hvae.probe(gridworld.engineered_representations()[:, :2], TRAIN, HELD_OUT)
    assert net["nn_net_match"] > 0.98 and net["nn_class"] > 0.9


def saved(folder, **changes):
    config = dict(env="gridworld", split="default", split_seed=0, train_on="train")
    table = dict(mean=np.ones((1024, 16)), action_ids=TRAIN, config=config)
    return hvae.save_representation(folder / "table.npz", **table | changes)


def test_saved_table_comes_back_and_an_own_one_needs_no_split(tmp_path, monkeypatch, capsys):
    own, load = gridworld.engineered_representations(), hvae.load_representation
    loaded = load(saved(tmp_path, mean=own.astype(np.float64)), "gridworld")
    assert loaded["mean"].dtype == np.float32 and np.array_equal(loaded["mean"], own)
    assert np.array_equal(loaded["action_ids"], TRAIN) and loaded["config"]["split_seed"] == 0
    path = saved(tmp_path, mean=own, action_ids=[], config=dict(env="gridworld"))
    assert np.array_equal(load(path, "gridworld", "default", 7)["mean"], own)
    assert [p.name for p in tmp_path.iterdir()] == ["table.npz"]  # no temporary file is left
    # Made with other physics: a note. With another action set: an error.
    monkeypatch.setattr(hvae, "source_hash", lambda module: "another version")
    assert not capsys.readouterr().out and load(path, "gridworld")
    assert capsys.readouterr().out.startswith(f"note: {path} was made with another version of")
    monkeypatch.setattr(gridworld, "action_labels", lambda: np.repeat("skill", 1024))
    with pytest.raises(UserError, match="has action_set"):
        load(path, "gridworld")


def test_wrong_or_damaged_tables_are_refused(tmp_path):
    wrong = np.full((1024, 16), np.nan), np.zeros((9, 16))
    for mean in wrong:
        with pytest.raises(UserError, match=r"mean must be finite and \(1024, D\), got \("):
            saved(tmp_path, mean=mean)
    with pytest.raises(UserError, match="unknown environment"):
        saved(tmp_path, config=dict(split="default"))
    assert not list(tmp_path.iterdir())
    path = saved(tmp_path)
    data, arrays = path.read_bytes(), dict(np.load(path))
    with pytest.raises(UserError, match="has split_seed 0, wanted 1"):
        hvae.load_representation(path, "gridworld", split_seed=1)
    for words, changes in (
        ("no file of representations", dict(config=np.array("3"))),
        ("no file of representations", dict(mean=np.array([{}], dtype=object))),  # a pickle
        ("has env 'other', wanted", dict(config=np.array('{"env": "a/other.py"}'))),
        ("mean must be finite", dict(mean=wrong[1])),
    ):
        np.savez(path, **arrays | changes)
        with pytest.raises(UserError, match=words):
            hvae.load_representation(path, "gridworld")
    for damaged in (data[:-1000], b"", b"text", None):
        path.unlink() if damaged is None else path.write_bytes(damaged)
        with pytest.raises(UserError, match="table.npz is missing or no file of representations"):
            hvae.load_representation(path, "gridworld")


def test_file_that_cannot_be_written_is_one_sentence_and_leaves_nothing(tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path / "table.npz", tmp_path / "file" / "table.npz"):
        with pytest.raises(UserError, match="cannot write .*table.npz .is the disk full"):
            hvae.write(path, lambda file: file.write(b"half") and os.open("no such file", 0))

    class Full:  # torch.save makes a RuntimeError of its OSError
        def write(self, data):
            raise OSError("the disk is full")

    with pytest.raises(UserError, match="cannot write"):
        hvae.write(tmp_path / "table.npz", lambda file: torch.save(torch.ones(9), Full()))
    with pytest.raises(ZeroDivisionError):  # a programming error stays one
        hvae.write(tmp_path / "table.npz", lambda file: 1 / 0)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_command_line_makes_every_file_or_one_line_of_error(tmp_path):
    def run(*words):  # on a console without any character outside ASCII, with odd threads
        command = [sys.executable, hvae.__file__, *words, "--runs-dir", str(tmp_path)]
        environment = os.environ | dict(PYTHONIOENCODING="ascii", OMP_NUM_THREADS="4,2")
        return subprocess.run(command, capture_output=True, text=True, env=environment)

    done = run("gridworld", "--modality", "smell")
    assert done.stderr == "error: unknown modality 'smell'; allowed: xy, onehot\n"
    assert done.returncode == 1 and not list(tmp_path.iterdir())
    done = run("gridworld", "--updates", "20", "--observations", "8")
    assert done.returncode == 0 and not done.stderr, done.stderr  # no progress bar in a pipe
    assert done.stdout.count("update ") == 10 and "'net_r2'" in done.stdout
    assert len({p.suffix for p in (tmp_path / "hvae").iterdir()}) == 5  # .npz .pt .csv .json .png
    done = run("create", "--recipe", "quick", "--help")  # the numbers of this recipe
    assert done.returncode == 0 and "(default: 1250)" in done.stdout, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_recipe_fast_equals_the_published_table(tmp_path, seed):
    path = hvae.train(replace(default_args("gridworld"), seed=seed, runs_dir=str(tmp_path)))
    scores = json.loads(path.with_suffix(".json").read_text())
    assert scores["net_r2"] >= 0.946 and scores["move_accuracy"] >= 0.6
    assert scores["nn_net_match"] >= 0.7
