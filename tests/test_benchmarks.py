"""The matrix and the report: commands, folders, tables; one tiny experiment for real."""

import json
import re
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))

import paper  # noqa: E402
import report  # noqa: E402

import ppo_actiongen  # noqa: E402
from hvae import UserError  # noqa: E402

# All that a method may differ in from its recipe.
METHOD = "task method representation modality split subgoal_reward fully_observable placement adapt"
METHOD += " finetune ent_coef head_epochs subsample aux_conditioned bilinear seed split_seed"


def test_every_figure_has_rows_and_its_commands_can_be_pasted():
    figures = [f"fig{n}" for n in (4, 5, 6, 8, 9, 10, 11, 12, 13)]  # 1-3, 7: worlds; 14: curves
    figures += [f"analysis-{name}" for name in ("angle", "embedding", "unseen-ratio", "set-size")]
    assert all(paper.TABLE[name] for name in [*figures, "table1", *report.MAIN])
    words = "fig11 fig4 analysis-angle --only push ours --seeds 0 1 --dry-run".split()
    command = [sys.executable, "benchmarks/paper.py", *words]
    lines = subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.splitlines()
    assert len(set(lines)) == len(lines) == 22
    assert "python hvae.py gridworld --split-seed 1" in lines
    assert "python ppo_actiongen.py create --task push --no-aux-conditioned --seed 1" in lines
    run = "evaluate runs/create-split-analysis-representation-hvae-all-s0"
    assert f"python ppo_actiongen.py {run} --num-available 50 --min-angle-gap 15 --save" in lines
    wrong = {"'chess'": dict(figures=("chess",)), "allowed": dict(figures=())}
    wrong |= {"one seed": dict(seeds=()), "'theirs'": dict(only=("theirs",))}
    for message, options in (wrong | {"above 0": dict(budget=0.0)}).items():
        with pytest.raises(UserError, match=message):
            paper.plan(paper.Args(**{"figures": ("fig4",)} | options))


@pytest.mark.parametrize("recipe", ["paper", "fast"])
def test_a_recipe_is_itself_but_for_the_methods_own_flags(recipe):
    commands, folders, made = set(), {}, set()
    for job in paper.plan(paper.Args(("all",), recipe=recipe, seeds=(3,))):
        assert {need.command for need in job.needs} <= commands  # what it needs comes first
        commands.add(job.command)
        if job.kind != "train":
            continue
        usual = asdict(ppo_actiongen.default_args(job.args.env, recipe, job.args.quick))
        if job.args.env == "recsys" and "bilinear" not in job.row:
            usual["hidden_size"] = 64  # Table 4: the paper's methods keep it, in every recipe
        if job.row == "ours_small_steps":
            usual["learning_rate"] = 2.5e-4  # of this row alone
        differs = {k for k, v in asdict(job.args).items() if v != usual[k]}
        assert differs <= set(METHOD.split()) and job.args.seed == 3, job.command
        assert job.args.split_seed == 3 * (job.args.env in ("gridworld", "recsys"))
        folders.setdefault(job.folder, set()).add(repr(job.args))
        env = job.args.env + "_full" * job.args.fully_observable
        made.add((env, job.args.task or "", job.row.split("/")[-1]))
    assert all(len(found) == 1 for found in folders.values())  # equal runs share a folder
    rows = [r for r in paper.read(ROOT / "results/published_results.csv") if r["metric"] != "probe"]
    assert {(r["env"], r["task"], r["method"]) for r in rows} <= made
    assert {method for *_, method in made} <= set(report.METHODS)


def test_a_table_shows_every_budget_and_like_beside_like(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    assert {report.section(name, True) for name in [*paper.TABLE, "main", "fig14"]} == {""}
    rows = [("ours", 0.7, 10**7), ("ours", 0.9, 10**7), ("engineered", 0.5, 10**7)]
    rows += [("ours", 0.2, 10**6), ("mine", 0.3, 10**6)]
    rows = [dict(method=m, score=s, steps=n, seed=i) for i, (m, s, n) in enumerate(rows)]
    same = dict(env="gridworld", recipe="fast")
    rows = [same | row | {"phase": phase} for row in rows for phase in ("train", "test")]
    paper.merge(tmp_path / "gridworld.csv", paper.COLUMNS, paper.KEY, rows)
    page = tmp_path / "README.md"
    old = "±\n<!-- begin:gridworld -->\nold\n<!-- end:gridworld -->\nb\n"
    page.write_text(old, encoding="utf-8")
    with pytest.raises(SystemExit, match="disagrees"):
        report.main(check=True)
    report.main()
    report.main(check=True)
    text = page.read_text(encoding="utf-8")
    assert "|HVAE + utility|10M|2|0.800±0.100 (0.904)|0.800±0.100 (0.703)|1.000|\n" in text
    assert "|HVAE + utility|1M|1|0.200" in text and "|mine|1M|1|0.300" in text
    assert text.endswith("![gridworld](gridworld.png)\n<!-- end:gridworld -->\nb\n")
    # CREATE's fast recipe has the head of C.4. Where the published one lacks it, there is a star.
    same = dict(env="create", task="push", recipe="fast", phase="test", steps=9, score=0.5)
    same["method"] = "ours_conditioned_auxiliary"
    other = {"split": "random", "task": "ladder"}
    rows = [same | change for change in ({}, other, {"recipe": "older"})]
    paper.merge(tmp_path / "create-push.csv", paper.COLUMNS, paper.KEY, rows)
    text = report.section("create-push", False)
    assert "|CREATE push|HVAE + utility, conditioned|0M|1|0.500 (0.861)|\n" in text
    assert "|CREATE ladder, random split|HVAE + utility, conditioned|0M|1|0.500 (0.669*)|" in text
    assert "|CREATE push, older recipe|HVAE + utility, conditioned|0M|1|0.500 (0.861)|\n" in text
    method, place = same["method"], ("create", "push", 9)
    assert report.published("analysis-embedding", place, method, "d=0.5")[0] is None  # other units


TINY = "--representation engineered --total-timesteps 256 --num-envs 4 --minibatch-size 32"
TINY = f"gridworld {TINY} --valid-episodes 4 --eval-episodes 4"
TEST = "evaluate {ours} --episodes 8 --num-available 20"


def test_a_tiny_experiment_runs_once_until_its_checkpoint_changes(tmp_path, monkeypatch, capsys):
    broken = {"x/ours": f"{TINY} --split chess", "x/tuned": f"{TINY} --finetune {{x/ours}}"}
    monkeypatch.setitem(paper.TABLE, "tiny", {"ours": TINY, "few": TEST} | broken)
    monkeypatch.chdir(ROOT)
    folders = dict(runs_dir=str(tmp_path / "runs"), results_dir=str(tmp_path))
    args = paper.Args(("tiny",), seeds=(0,), only=("ours", "few", "tuned"), **folders)
    with pytest.raises(SystemExit, match="2 of 4 commands"):  # nothing starts from what failed
        paper.main(args)
    out = capsys.readouterr().out
    assert "FAILED  python ppo_actiongen.py gridworld" in out and out.count("SKIPPED") == 1
    rows = paper.read(tmp_path / "tiny.csv")
    assert [r["phase"] for r in rows] == ["few", "test", "train", "valid"]
    assert {(r["steps"], r["method"], r["recipe"]) for r in rows} == {("256", "ours", "fast")}
    assert 0 < len(paper.read(tmp_path / "tiny_curves.csv")) <= 50

    args = paper.Args(("tiny",), seeds=(0,), only=("few",), **folders)
    (path,) = (tmp_path / "runs").glob("*/evaluations.csv")
    for last, left in (r"\g<0>", 0), (",1\n", 1):  # a test of another checkpoint does not count
        path.write_text(re.sub(r",\d+\n$", last, path.read_text()))  # the last column: best_step
        paper.main(replace(args, jobs=0))  # starts nothing
        assert len(paper.read(path)) == 1
        paper.main(args)
        assert capsys.readouterr().out.startswith(f"{left} of 2 commands to run\n")
    assert len(paper.read(path)) == 2
    saved = path.with_name("args.json")
    saved.write_text(json.dumps(json.loads(saved.read_text()) | {"ent_coef": 9}))
    with pytest.raises(UserError, match="another ent_coef"):
        paper.main(args)
