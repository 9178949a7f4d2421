"""The HVAE against torch's distributions, the published layer sizes, and wrong files."""

import io
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
SOURCES = dict(xy="gridworld", onehot="gridworld", state="create", video="create", image="stacking")


def arguments(modality="xy", **changes):  # Grid World's numbers
    return replace(default_args("gridworld"), **dict(modality=modality, device="cpu") | changes)


def small(modality, model=HVAE, **changes):  # and raw observations: 3 actions, 2 of each
    torch.manual_seed(0)
    record = hvae.load_environment(SOURCES[modality]).action_observations
    raw = record(TRAIN[:3], 2, modality, 0, 1)
    args = arguments(modality, batch_observations=2, **changes)
    return model(args, raw.shape[2:]), torch.from_numpy(raw)


def tiny(env="gridworld", modality=None, **changes):
    changes = dict(updates=2, observations=8, batch_observations=2, device="cpu") | changes
    return replace(default_args(env, modality=modality), **changes)


def refused(words, call, *args, **options):
    with pytest.raises(UserError, match=words):
        call(*args, **options)


@pytest.mark.parametrize("modality", ["xy", "onehot", "image"])
def test_loss_equals_the_elbo_written_observation_by_observation(modality, monkeypatch):
    model, raw = small(modality)
    model.eval()
    monkeypatch.setattr(Normal, "rsample", lambda self: self.mean)
    parts, rec, kl_z, kl_c = model(raw), 0.0, 0.0, 0.0
    for observations in raw:
        inputs, targets = hvae.prepare(observations, model.args)
        start, h = model.encode(inputs)
        q_c = model.q_c(h[None])
        kl_c += kl_divergence(q_c, Normal(torch.zeros(16), torch.ones(16))).sum()
        for j in range(2):
            q_z, target = model.q_z(h[j : j + 1], q_c.mean), targets[j : j + 1]
            kl_z += kl_divergence(q_z, model.p_z(q_c.mean)).sum()
            output = model.decode(start[j : j + 1], None, q_z.mean, q_c.mean)
            p_x = Categorical(logits=output)
            if modality != "onehot":
                p_x = Normal(output, (model.log_var.clamp(-4, 3) / 2).exp())
            rec += p_x.log_prob(target).sum()
    expected = dict(rec=rec / 6, kl_z=kl_z / 6, kl_c=kl_c / 3 / 64)  # kl_c_divisor
    torch.testing.assert_close(parts, expected, rtol=1e-4, atol=1e-4)
    w = [*model.parameters()]
    grads = [torch.autograd.grad(x["kl_z"] + x["kl_c"] - x["rec"], w) for x in (parts, expected)]
    torch.testing.assert_close(*grads, rtol=1e-3, atol=1e-3)


# A picture passes a linear layer (288 -> 128), not the Bi-LSTM (823,296), and has no mask (16 + 1).
NO_LSTM = -823_296 + 289 * 128 - 17
BIG, VISUAL = dict(representation_size=128), dict(representation_size=128, hidden=128)


@pytest.mark.parametrize("modality, shape, changes, hierarchical, flat", [
    ("xy", (6, 2), {}, 339_818, 207_334),
    ("onehot", (6, 2), {}, 441_254 - 160, 308_770 - 160),  # no unused log-variances
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
    assert target.min() >= -0.5 and target.max() == 0.5
    inputs = model.encode(x)[0], x[:, :1], torch.randn(6, 16), torch.randn(6, 16)
    last = model.conv_decoder[-2].requires_grad_(False)  # the 1x1 convolution
    last.weight.zero_()
    last.bias[:] = torch.tensor([50, -50])  # picture, mask
    torch.testing.assert_close(model.decode(*inputs), x[:, :1].expand_as(target))
    last.bias[1] = 50
    torch.testing.assert_close(model.decode(*inputs), torch.full_like(target, 0.5))


@pytest.mark.parametrize("model", [HVAE, VAE])
@pytest.mark.parametrize("modality", SOURCES)
def test_gradient_reaches_every_parameter_and_order_does_not_matter(modality, model):
    model, raw = small(modality, model, linear_path=modality in ("onehot", "image"))
    parts = model(raw)
    (parts["kl_z"] + parts["kl_c"] - parts["rec"]).backward()
    idle = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().any()]
    assert not idle
    model.eval()
    with torch.no_grad():
        h = model.encode(hvae.prepare(raw.flatten(0, 1), model.args)[0])[1].unflatten(0, (3, 2))
        more = h.flip(1).repeat(1, 5, 1)
        mean, again, shuffled = (model.represent(some) for some in (h, h, more))
        first, second = (model.infer(h)[0] for _ in range(2))  # samples of (z, c), or (z,)
    assert all((a != b).any() for a, b in zip(first, second, strict=True))
    pair = first[-1].unflatten(0, (3, 2)).unbind(1)
    assert torch.equal(*pair) == isinstance(model, HVAE)  # a set has one c
    assert mean.shape == (3, 16) and torch.equal(mean, again)
    torch.testing.assert_close(mean, shuffled, rtol=1e-4, atol=1e-5)


def test_batch_norm_is_global_and_the_linear_path_a_map_of_averaged_observations():
    x = torch.randn(50, 8) * torch.arange(1, 9) + 3
    expected = (x - x.mean()) / (x.var(correction=0) + 1e-3).sqrt()
    torch.testing.assert_close(hvae.GlobalBatchNorm()(x), expected, rtol=1e-4, atol=1e-5)
    for kind in (HVAE, VAE):
        model, raw = small("xy", kind, linear_path=True)
        x, _ = hvae.prepare(raw.flatten(0, 1), model.args)
        _, h = model.eval().encode(x)
        assert torch.equal(h[:, 64:], x.flatten(1))
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


def test_short_training_learns_and_never_sees_unseen_skills(tmp_path, monkeypatch):
    fit, seen = hvae.fit, []
    spy = lambda model, data, rows, args: seen.append(data[rows]) or fit(model, data, rows, args)  # noqa: E731
    monkeypatch.setattr(hvae, "fit", spy)
    args = arguments(updates=150, observations=64, linear_path=True, runs_dir=str(tmp_path))
    path = hvae.train(args)
    recorded = gridworld.action_observations(np.arange(1024), 64, "xy", 0, 1)
    np.testing.assert_array_equal(seen[0], recorded[TRAIN])
    rec = np.genfromtxt(path.with_suffix(".csv"), delimiter=",", names=True)["rec"]
    assert rec[-20:].mean() > rec[:20].mean()
    # The weights reproduce the table.
    model, table = HVAE(args, (6, 2)), hvae.load_representation(path, "gridworld")
    model.load_state_dict(torch.load(path.with_suffix(".pt"), weights_only=True))
    _, h = model.eval().encode(hvae.prepare(torch.from_numpy(recorded[5]), args)[0])
    again = model.represent(h[None])[0].detach()
    np.testing.assert_allclose(again, table["mean"][5], atol=1e-5)


def test_same_seed_same_files_and_each_model_trains_on_what_it_says(tmp_path, monkeypatch):
    monkeypatch.setattr(hvae, "report", lambda *args: None)  # takes a second
    torch.manual_seed(5)
    before, paths, files, tables = torch.get_rng_state(), [], [], []
    flat = dict(modality="onehot", hierarchical=False, split_seed=3)
    for run, changes in enumerate(({}, {}, dict(seed=1), dict(train_on="all"), flat)):
        path = hvae.train(tiny(runs_dir=str(tmp_path / str(run)), **changes))
        table = hvae.load_representation(path, "gridworld", "default", changes.get("split_seed", 0))
        ends = [path.with_suffix(end).read_bytes() for end in (".pt", ".csv")]
        files.append([table["mean"].tobytes(), *ends])
        tables.append(table["action_ids"].tolist())
        paths.append(hvae.representation_path(tiny(device="cuda", **changes)).name)
        assert paths[-1] == path.name
    assert torch.equal(before, torch.get_rng_state()) and files[0] == files[1]
    assert all(a != c for a, c in zip(files[0], files[2], strict=True))
    other = gridworld.split_actions("default", 3)["train"]
    assert tables == [TRAIN.tolist()] * 3 + [list(range(1024)), other.tolist()]
    assert len(set(paths)) == 4 and paths[0].startswith("gridworld-xy-hvae-train-fast-s0-")


def test_no_op_is_an_action_and_recordings_are_made_once_per_source(tmp_path, monkeypatch):
    calls, record, ids = [], create_env.action_observations, 3 * np.arange(12)
    count = lambda *args: calls.append(args[0].tolist()) or record(*args)  # noqa: E731
    monkeypatch.setattr(create_env, "action_observations", count)
    split = dict(train=ids[1:6], valid=ids[6:9], test=ids[9:])
    monkeypatch.setattr(create_env, "split_actions", lambda name, seed: split)
    args = tiny("create", observations=4, runs_dir=str(tmp_path))
    table = hvae.load_representation(hvae.train(args), "create")
    assert table["action_ids"].tolist() == ids[:6].tolist() and ids[0] == create_env.NO_OP
    assert np.array_equal(np.flatnonzero(table["mean"].any(1)), ids)
    hvae.observe(create_env, ids[:5], args)  # of another split
    again = hvae.observe(create_env, ids, replace(args, seed=3))  # of a second encoder
    assert list(map(len, calls)) == [12, 5] and np.array_equal(again, record(ids, 4, "state", 0, 1))
    (tmp_path / "create_env.py").write_text("# other physics", encoding="utf-8")
    monkeypatch.setattr(create_env, "__file__", str(tmp_path / "create_env.py"))
    hvae.observe(create_env, ids, args)
    assert len(calls) == 3 and len(list((tmp_path / "observations").iterdir())) == 1


def test_recipe_paper_is_tables_3_and_4():
    table = dict(learning_rate=0.001, observations=1024, updates=0)
    table |= dict(q_hidden=128, relative=False, kl_warmup=0.0, linear_path=False)
    for env, modality, size, batch_size, epochs, hidden, X in (  # 52: [code]
        ("gridworld", "xy", 16, 128, 10000, 64, 1024), ("create", "xy", 128, 128, 10000, 64, 1024),
        ("create", "video", 128, 32, 5000, 128, 52), ("stacking", "image", 128, 32, 5000, 128, 52),
    ):  # fmt: skip
        table |= dict(representation_size=size, batch_size=batch_size, epochs=epochs, hidden=hidden)
        table |= dict(batch_observations=X, kl_c_divisor=X)
        assert table.items() <= vars(default_args(env, "paper", modality)).items()


def test_bad_choices_are_refused_before_anything_is_written(tmp_path, monkeypatch):
    refused("unknown environment 'chess'; allowed: gridworld", default_args, "chess")
    refused("unknown environment './no.py'; allowed: gridworld", default_args, "./no.py")
    refused("recsys has no action observations", default_args, "recsys")
    refused("unknown side of a picture 64; allowed: 48, 84", HVAE, arguments("image"), (64, 64))
    base = tiny(runs_dir=str(tmp_path))
    refused("unknown split 'odd'; allowed: default", hvae.train, replace(base, split="odd"))
    refused("more than the 1 observations", hvae.train, replace(base, observations=1))
    for changes in (dict(updates=0), dict(epochs=2)):
        refused("either updates or epochs must", hvae.train, replace(base, **changes))
    leak = dict(train=np.arange(9), valid=np.arange(8, 20), test=np.arange(20, 30))
    monkeypatch.setattr(gridworld, "split_actions", lambda name, seed: leak)
    refused("the parts of split 'default' overlap", hvae.train, base)
    assert not list(tmp_path.iterdir())


OWN = """import numpy as np
NUM_ACTIONS, MODALITIES = 40, ("xy",)
UNITS = dict(centre=0.0, half_width=10.0, step=0.5)
action_labels = lambda: np.repeat(["left", "right"], 20)
engineered_representations = lambda: np.linspace(-1, 1, 40)[:, None]
def split_actions(split, seed):
    return dict(train=np.arange(0, 40, 2), valid=np.arange(1, 40, 4), test=np.arange(3, 40, 4))
def action_observations(ids, n, modality, seed, workers):
    start = [np.random.default_rng([seed, i]).uniform(-10, 10, (n, 1, 1)) for i in ids]
    return start + engineered_representations()[ids][:, None, None] * np.arange(4)[:, None]
"""


def test_environment_of_ones_own_is_a_file(tmp_path, monkeypatch):
    file = tmp_path / "own_world.py"
    file.write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    quick = replace(default_args("./own_world.py", "quick"), updates=30)
    path = hvae.train(quick)
    assert path.name.startswith("own_world-xy-hvae-train-quick-s0-")
    assert hvae.load_representation(path, str(file))["mean"].any(1).all()
    assert path == hvae.representation_path(replace(quick, env=str(file)))
    assert hvae.load_environment("own_world.py") is hvae.load_environment(str(file))
    inputs, target = hvae.prepare(torch.tensor([[[10.0], [11.0], [13.0]]]), quick)
    assert inputs.flatten().tolist() == [1, 2, 4] and target.flatten().tolist() == [2, 6]
    for name in ("json", "time"):
        (tmp_path / f"{name}.py").touch()
        refused(f"Python has another module called '{name}'", hvae.load_environment, f"{name}.py")
    (tmp_path / "slip.py").write_text("import not_installed", encoding="utf-8")
    with pytest.raises(ModuleNotFoundError, match="not_installed"):
        hvae.load_environment("slip.py")


def test_missing_package_is_one_sentence_an_environments_error_is_not(tmp_path, monkeypatch):
    def fail(*args):
        raise error

    monkeypatch.setattr(gridworld, "action_observations", fail)
    for error in ValueError("slip"), RuntimeError("slip"), OSError("slip"):
        with pytest.raises(type(error), match="^slip$"):
            hvae.train(tiny(runs_dir=str(tmp_path)))
    assert not list(tmp_path.iterdir())
    error = ModuleNotFoundError("Shape Stacking needs pybullet")
    monkeypatch.setattr(hvae.importlib, "import_module", fail)
    refused("^Shape Stacking needs pybullet$", hvae.load_environment, "stacking")


def test_probe_of_ground_truth_and_of_noise():
    features = gridworld.engineered_representations()
    tables = features, features[:, :2], np.random.default_rng(0).normal(size=(1024, 16))
    env = gridworld.__file__  # Grid World by the path of its file
    truth, net, noise = (hvae.probe(table, TRAIN, HELD_OUT, env) for table in tables)
    assert min(truth["net_r2"], truth["move_accuracy"], truth["engineered_r2"]) > 0.999
    assert net["nn_net_match"] > 0.98 and net["nn_class"] > 0.9
    assert noise["net_r2"] < 0.05 and 0.2 < noise["move_accuracy"] < 0.3
    assert noise["nn_net_match"] < 0.1 and abs(noise["nn_class"] - 0.25) < 0.06


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
    # Made by another hvae.py (or with other physics): a note. With another action set: an error.
    (tmp_path / "hvae.py").write_text("# another loss", encoding="utf-8")
    monkeypatch.setattr(hvae, "__file__", str(tmp_path / "hvae.py"))
    assert not capsys.readouterr().out and load(path, "gridworld")
    assert capsys.readouterr().out.startswith(f"note: {path} is of another hvae.py or gridworld.py")
    monkeypatch.setattr(gridworld, "action_labels", lambda: np.repeat("skill", 1024))
    refused("has action_set", load, path, "gridworld")


def test_wrong_or_damaged_tables_are_refused(tmp_path):
    load, nine = hvae.load_representation, np.zeros((9, 16))
    refused(r": \(9, 16\), must be \(1024, D\), finite", saved, tmp_path, mean=nine)
    refused("unknown environment", saved, tmp_path, config=dict(split="default"))
    assert not list(tmp_path.iterdir())
    diverges = tiny(learning_rate=1e30, linear_path=True, runs_dir=str(tmp_path))
    refused("training diverged", hvae.train, diverges)
    path = saved(tmp_path)
    data, arrays = path.read_bytes(), dict(np.load(path))
    refused("has split_seed 0, wanted 1", load, path, "gridworld", split_seed=1)
    for words, changes in (
        ("no file of representations", dict(config=np.array("3"))),
        ("no file of representations", dict(mean=np.array([{}], dtype=object))),  # a pickle
        ("has env 'other', wanted", dict(config=np.array('{"env": "a/other.py"}'))),
        ("1024, D", dict(mean=nine)),
    ):
        np.savez(path, **arrays | changes)
        refused(words, load, path, "gridworld")
    for damaged in (data[:-1000], b""):
        path.write_bytes(damaged)
        refused("table.npz is missing or no file of representations", load, path, "gridworld")
    refused("missing", load, tmp_path / "no.npz", "gridworld")


def test_file_that_cannot_be_written_is_one_sentence_and_leaves_nothing(tmp_path, monkeypatch):
    class Full(io.BytesIO):
        def write(self, data):
            raise OSError("no space left")

    def pieces():
        yield b"half"
        raise OSError("not the disk's")

    (tmp_path / "file").touch()
    words, path = "cannot write .*table.npz .is the disk full", tmp_path / "table.npz"
    with pytest.raises(OSError, match="^not the disk's$"):
        hvae.write_pieces(path, pieces())
    refused(words, hvae.write, tmp_path / "file" / "table.npz", lambda file: None)
    monkeypatch.setattr(hvae, "open", lambda *args: Full(), raising=False)
    refused(words, hvae.write, path, lambda file: torch.save(torch.ones(9), file))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_command_line_makes_every_file_or_one_line_of_error(tmp_path):
    def run(*words):  # on a console without any character outside ASCII
        command = [sys.executable, hvae.__file__, *words, "--runs-dir", str(tmp_path)]
        unusual = dict(PYTHONIOENCODING="ascii", OMP_NUM_THREADS="4,2", MPLBACKEND="missing")
        return subprocess.run(command, capture_output=True, text=True, env=os.environ | unusual)

    done = run("gridworld", "--modality", "smell")
    assert done.stderr == "error: unknown modality 'smell'; allowed: xy, onehot\n"
    assert done.returncode == 1
    done = run("gridworld", "--updates", "100", "--observations", "8")
    assert done.returncode == 0 and not done.stderr, done.stderr  # no progress bar in a pipe
    assert done.stdout.count("update ") == 1 and "'net_r2'" in done.stdout
    assert len({p.suffix for p in (tmp_path / "hvae").iterdir()}) == 5  # .npz .pt .csv .json .png
    done = run("create", "--recipe", "quick", "--help")  # the numbers of this recipe
    assert done.returncode == 0 and "1250)" in done.stdout, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_recipe_fast_equals_the_published_table(tmp_path, seed):
    path = hvae.train(arguments(seed=seed, runs_dir=str(tmp_path)))
    scores = json.loads(path.with_suffix(".json").read_text())
    assert scores["net_r2"] >= 0.946 and scores["move_accuracy"] >= 0.6
    assert scores["nn_net_match"] >= 0.7
