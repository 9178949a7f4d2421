"""The matrix and the report: commands, folders, tables; one tiny experiment for real."""

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))

import paper  # noqa: E402
import report  # noqa: E402

import ppo_actiongen  # noqa: E402

# All that a method may differ in from its recipe.
METHOD = "task method representation modality split subgoal_reward fully_observable placement adapt"
METHOD += " finetune ent_coef subsample aux_conditioned bilinear seed split_seed"


def jobs_of(*figures, **options):
    return paper.plan(paper.Args(figures, **options))


@pytest.fixture(scope="module")
def trained():
    """Every training of the fast recipe, two seeds."""
    return [job for job in jobs_of("all", seeds=(0, 3)) if job.kind == "train"]


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
    run = "evaluate runs/create-push-oracle_encoder_all_actions-split-analysis-s0"
    assert f"python ppo_actiongen.py {run} --num-available 50 --min-angle-gap 15 --save" in lines


@pytest.mark.parametrize("recipe", ["paper", "fast"])
def test_a_recipe_is_itself_but_for_the_methods_own_flags(recipe, trained):
    every = trained if recipe == "fast" else jobs_of("all", recipe="paper", seeds=(3,))
    every = [job for job in every if job.kind == "train" and job.seed == 3]
    assert {job.args.env for job in every} == {"gridworld", "recsys", "create", "stacking"}
    for job in every:
        usual = asdict(ppo_actiongen.default_args(job.args.env, recipe, job.args.quick))
        if job.args.env == "recsys" and "bilinear" not in job.row:
            usual["hidden_size"] = 64  # Table 4: the paper's methods keep it, in every recipe
        differs = {k for k, v in asdict(job.args).items() if v != usual[k]}
        assert differs <= set(METHOD.split()) and job.args.seed == 3, job.command
        # CREATE and Stacking: one split for all seeds, as published
        assert job.args.split_seed == 3 * (job.args.env in ("gridworld", "recsys"))


def test_published_methods_have_rows_equal_runs_share_a_folder_and_needs_come_first(trained):
    made, settings = set(), {}
    for i, job in enumerate(trained):
        env = job.args.env + "_full" * job.args.fully_observable
        made.add((env, job.args.task or "", job.row.split("/")[-1]))
        settings.setdefault(job.folder, set()).add(repr(job.args))
        for need in job.needs:
            assert need in trained[:i] and need.seed == job.seed and str(need.folder) in job.words
    rows = paper.read(ROOT / "results/published_results.csv")
    assert {(r["env"], r["task"], r["method"]) for r in rows} <= made
    assert {method for *_, method in made} <= set(report.METHODS)
    assert all(len(found) == 1 for found in settings.values()) and len(settings) < len(trained)
    more = jobs_of("recsys", budget=0.1) + jobs_of("recsys", recipe="paper")
    assert not {job.folder for job in more} & set(settings)
    for figure, only in (("chess", ()), ("gridworld", ("theirs",))):
        with pytest.raises(ValueError, match="'chess'|theirs"):
            jobs_of(figure, only=only)


def write(path, rows):
    """A CSV file of dictionaries, with all the columns that paper.py writes."""
    columns = [*paper.COLUMNS, *paper.CURVES[-4:]]
    paper.merge(path, columns, columns, [dict(env="gridworld", stderr=0.01) | r for r in rows])


def test_merging_replaces_a_row_and_sorts_numbers_by_size(tmp_path):
    for score in (0.5, 0.75):
        new = [dict(seed=10, score=score), dict(seed=9, score=1.0)]
        paper.merge(tmp_path / "t.csv", ["seed", "score"], ["seed"], new)
        made = [tuple(row.values()) for row in paper.read(tmp_path / "t.csv")]
        assert made == [("9", "1"), ("10", str(score))]


def test_a_table_shows_every_budget_and_one_line_on_what_is_not_learned(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    assert {report.section(name, True) for name in [*paper.TABLE, "main", "fig14"]} == {""}
    rows = [("ours", 0.7, 10**7), ("ours", 0.9, 10**7), ("engineered", 0.5, 10**7)]
    rows += [("ours", 0.2, 10**6), ("continuous_output", 0.004, 10**7), ("mine", 0.3, 10**6)]
    rows = [dict(method=m, score=s, steps=n, seed=i) for i, (m, s, n) in enumerate(rows)]
    write(tmp_path / "gridworld.csv", [r | {"phase": p} for r in rows for p in ("train", "test")])
    page = tmp_path / "README.md"
    page.write_text("a\n<!-- begin:gridworld -->\nold\n<!-- end:gridworld -->\nb\n")
    with pytest.raises(SystemExit, match="disagrees"):
        report.main(check=True)
    report.main()
    report.main(check=True)
    text = page.read_text()
    assert "|Ours|10M|2|0.800±0.100 (0.904)|0.800±0.100 (0.703)|1.000|\n" in text
    assert "(random play: 0.003): Continuous output.\n" in text
    assert "|Ours|1M|1|0.200" in text and "|mine|1M|1|0.300" in text
    assert text.endswith("![gridworld](gridworld.png)\n<!-- end:gridworld -->\nb\n")
    assert {p[2] for p, _ in report.group(paper.read(tmp_path / "gridworld.csv"))} == {10**7}


def test_figure_9_is_drawn_and_published_analyses_are_found(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    write(tmp_path / "fig9.csv", [dict(method="ours", phase="zero-shot", steps=9, score=0.6)])
    same = dict(method="ours_finetuned", steps=9)
    rows = [same | dict(step=step, episode_score=0.1 * step) for step in range(1, 9)]
    write(tmp_path / "fig9_curves.csv", rows)
    assert "(fig9.png)" in report.section("fig9", True).replace("{folder}", "")
    place = ("create", "push", 9)
    assert report.published("table1", place, "ours_full_split", "test")[0] == 0.1721
    assert report.published("analysis-angle", place, "ours", "min-angle-gap=15")[0] == 0.283
    assert report.published("analysis-embedding", place, "ours", "d=q0.9")[0] == 0.2795


def test_a_tiny_experiment_runs_once_and_is_told_from_another(tmp_path, monkeypatch, capsys):
    table = {"ours": "gridworld --representation engineered"}
    table |= {"ours/greedy": "evaluate {ours} --episodes 8 --num-available 20 --greedy"}
    monkeypatch.setitem(paper.TABLE, "tiny", table)
    monkeypatch.chdir(ROOT)
    extra = "--total-timesteps 256 --num-envs 4 --minibatch-size 32 --valid-episodes 4"
    extra += " --eval-episodes 4"
    same = dict(extra=extra, runs_dir=str(tmp_path / "runs"), results_dir=str(tmp_path))
    args = paper.Args(("tiny",), seeds=(0,), **same)
    paper.main(args)
    rows = paper.read(tmp_path / "tiny.csv")
    assert [r["phase"] for r in rows] == ["greedy", "test", "train", "valid"]
    assert {(r["steps"], r["method"], r["recipe"]) for r in rows} == {("256", "ours", "fast")}
    assert 0 < len(paper.read(tmp_path / "tiny_curves.csv")) <= 50
    capsys.readouterr()
    paper.main(args)
    assert capsys.readouterr().out.startswith("0 of 2 commands to run\n")
    (saved,) = (tmp_path / "runs").glob("*/args.json")
    saved.write_text(json.dumps(json.loads(saved.read_text()) | {"ent_coef": 9}))
    with pytest.raises(ValueError, match="another ent_coef"):
        paper.main(args)
