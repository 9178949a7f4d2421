"""The run matrix and the report: names, commands, merging of tables."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))

import paper  # noqa: E402
import report  # noqa: E402
import throughput  # noqa: E402

import ppo_actiongen  # noqa: E402


def test_dry_run_lists_every_experiment():
    command = [sys.executable, "benchmarks/paper.py", "--dry-run", "all", "--seeds", "0"]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    total = sum(len(methods) for methods in paper.EXPERIMENTS.values())
    assert out.stdout.count("python ppo_actiongen.py") == total
    assert f"of {total} to run" in out.stdout


def test_every_command_of_the_matrix_is_understood():
    import tyro

    for job in paper.jobs_of(paper.Args(("all",), seeds=(3,))):
        env = job.words[0]
        default = ppo_actiongen.default_args(env, "fast", False)
        args = tyro.cli(ppo_actiongen.Args, args=job.words[1:], default=default)
        ppo_actiongen.check(args)
        assert args.seed == args.split_seed == 3
        if not job.experiment.endswith("-recipe") and job.method != "ours_mlp_encoder":
            assert ppo_actiongen.method_name(args) == job.method, job.command


@pytest.mark.parametrize(
    "args, word",
    [
        (paper.Args(("chess",)), "'chess'"),
        (paper.Args(("gridworld",), methods=("theirs",)), "'theirs'"),
    ],
)
def test_unknown_names_are_refused(args, word):
    with pytest.raises(ValueError, match=word):
        paper.jobs_of(args)


def test_merging_replaces_rows_of_the_same_key_and_keeps_the_rest(tmp_path):
    path, columns = tmp_path / "t.csv", ["method", "seed", "score"]
    first = [dict(method="a", seed=s, score=0.5) for s in (0, 1)]
    paper.merge(path, columns, first, ("method", "seed"))
    paper.merge(path, columns, [dict(method="a", seed=1, score=0.75)], ("method", "seed"))
    rows = list(csv.DictReader(path.open()))
    assert rows == [
        {"method": "a", "seed": "0", "score": "0.5"},
        {"method": "a", "seed": "1", "score": "0.75"},
    ]
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]


def test_every_method_of_the_matrix_has_a_label():
    methods = {m for name, e in paper.EXPERIMENTS.items() for m in e if "-recipe" not in name}
    assert methods <= set(report.METHODS)
    assert set(paper.EXPERIMENTS["gridworld-recipe"]) == set(report.RECIPE)


def test_published_scores_are_found():
    assert report.published("gridworld")["ours", "test"][0] == pytest.approx(0.703, abs=1e-3)
    assert report.published("recsys-full")["ours", "test"][0] == pytest.approx(0.420, abs=1e-3)


def test_throughput_refuses_unknown_groups(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["throughput.py", "chess"])
    with pytest.raises(SystemExit, match="'chess'"):
        throughput.main()
    assert {"gridworld", "recsys", "create", "stacking", "hvae", "utility", "learner"} <= set(
        throughput.GROUPS
    )
