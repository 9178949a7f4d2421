"""The run matrix and the report: names, commands, merging of tables, pictures."""

import csv
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import tyro

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))

import paper  # noqa: E402
import report  # noqa: E402
import throughput  # noqa: E402

import hvae  # noqa: E402
import ppo_actiongen  # noqa: E402

FIGURES = [f"fig{n}" for n in (4, 5, 6, 8, 9, 10, 11, 12, 13, 14)]  # 1-3, 7: pictures of worlds
ANALYSES = [f"analysis-{name}" for name in ("angle", "embedding", "unseen-ratio", "set-size")]


def runs_of(*names, **options):
    """All runs of some experiments, once each."""
    plans = paper.plan(paper.Args(names, **options))
    return list({run.folder: run for p in plans for run in p.runs}.values())


# ---- what is listed ----


def test_dry_run_lists_every_figure_and_analysis_and_each_command_once(tmp_path):
    command = [sys.executable, "benchmarks/paper.py", "--dry-run", "all", "--seeds", "0"]
    command += ["--runs-dir", str(tmp_path)]  # nothing is finished there
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    for name in (*FIGURES, *ANALYSES, "table-main", "table-full-split", *paper.RECIPES):
        assert f"\n{name}: " in out.stdout, name
    for name, experiment in paper.EXPERIMENTS.items():
        assert experiment.runs or experiment.encoders, name
    lines = [line.split("  ")[-1] for line in out.stdout.splitlines() if " h  python " in line]
    plans = paper.plan(paper.Args(("all",), seeds=(0,), runs_dir=str(tmp_path)))
    wanted = {job.key for p in plans for job in p.everything}
    assert len(lines) == len(wanted) and f"{len(wanted)} of {len(wanted)} to run" in out.stdout
    for method in ("ours", "ours_conditioned_auxiliary", "ours_no_subgoal_reward"):
        flags = paper.RUNS["create-push"][method]
        assert (
            sum(line.startswith(f"python ppo_actiongen.py {flags} --seed") for line in lines) == 1
        )


def test_every_training_command_is_understood_and_named_after_its_method():
    for run in runs_of("all", seeds=(3,)):
        default = ppo_actiongen.default_args(run.words[0], "fast", False)
        args = tyro.cli(ppo_actiongen.Args, args=run.words[1:], default=default)
        args.adapt |= args.finetune is not None  # as `main` does
        ppo_actiongen.check(args)
        assert args.seed == 3 and args.split_seed == (0 if run.method == "ours_one_split" else 3)
        if not run.env.endswith(("-recipe", "-steady")) and run.method not in (
            "ours_mlp_encoder",
            "ours_wide",
            "ours_outcome",
            "ours_predicts",
            "ours_clip",
            "ours_fast",
            "ours_fast_64",
            "ours_fast_plain",
            "ours_fast_small",
            "ours_narrow",
            "ours_paper_recipe",
            "engineered_fast",
            "ours_early",
            "ours_placed",
            "ours_one_split",
            "ours_steady",
            "ours_steady_20",
            "ours_steady_entropy",
            "ours_analysis",
            "ours_analysis_narrow",
            "ours_gains",
        ):
            assert ppo_actiongen.method_name(args) == run.method, run.command


def test_every_evaluation_is_understood():
    for p in paper.plan(paper.Args(("all",), seeds=(0,))):
        for test in p.tests:
            options = tyro.cli(ppo_actiongen.EvaluateArgs, args=test.words[1:])
            assert options.save and options.actions == "test" and options.run in test.command


def test_sizes_of_test_sets():
    for env, size in paper.TEST_ACTIONS.items():
        module = importlib.import_module(ppo_actiongen.MODULES[env])
        assert len(module.split_actions("default", 1)["test"]) == size


def test_folders_are_named_after_the_run_not_the_figure():
    names = {run.folder.name for run in runs_of("gridworld", seeds=(0,), budget=0.2)}
    assert "gridworld-ours-fast-2000000-s0" in names
    assert "gridworld-ours_no_subsampling-fast-400000-s0" in names
    main, curves, recsys = runs_of("table-main"), runs_of("fig14"), runs_of("recsys-full")
    assert [run.folder for run in main] == [run.folder for run in curves]
    assert [run.folder for run in recsys] == [run.folder for run in runs_of("fig12")]
    assert {run.folder for run in runs_of("fig10", methods=("ours",))} <= {r.folder for r in main}


def test_fine_tuning_starts_from_the_run_of_the_same_seed_and_brings_it_along():
    runs = runs_of("fig9", methods=("ours_finetuned", "discrete_finetuned"), seeds=(2,))
    tuned = [run for run in runs if run.start]
    assert len(runs) == 2 * len(tuned) == 20
    for run in tuned:
        start = {"ours_finetuned": "ours", "discrete_finetuned": "nearest_neighbor"}[run.method]
        assert run.start in runs and (run.start.method, run.start.seed) == (start, 2)
        assert run.words[run.words.index("--finetune") + 1] == str(run.start.folder)


@pytest.mark.parametrize("representation", ["hvae", "hvae-all", "vae"])
def test_a_runs_encoder_is_the_one_it_would_train_itself(representation, monkeypatch, tmp_path):
    args = paper.Args(("create-push",), runs_dir=str(tmp_path), hvae_recipe="quick")
    run = paper.make_run("create-push", "ours_video", 5, args)
    run.words += ["--representation", representation]
    default = ppo_actiongen.default_args("create", "fast", False)
    run_args = tyro.cli(ppo_actiongen.Args, args=run.words[1:], default=default)
    run_args.runs_dir, made = str(tmp_path), []

    def stop(hvae_args):
        made.append(hvae.representation_path(hvae_args))
        raise KeyboardInterrupt

    monkeypatch.setattr(hvae, "train", stop)
    with pytest.raises(KeyboardInterrupt):
        ppo_actiongen.load_table(run_args, None)
    encoder = paper.encoder_of(run, args)
    assert made == [encoder.path]
    run.words += ["--representation", "engineered"]
    assert paper.encoder_of(run, args) is None


@pytest.mark.parametrize(
    "args, word",
    [
        (paper.Args(("chess",)), "'chess'"),
        (paper.Args(("gridworld",), methods=("theirs",)), "'theirs'"),
    ],
)
def test_unknown_names_are_refused(args, word):
    with pytest.raises(ValueError, match=word):
        paper.plan(args)


# ---- tables ----


def test_a_finished_run_of_another_command_is_not_collected(tmp_path):
    args = paper.Args(("gridworld",), methods=("engineered",), seeds=(0,), runs_dir=str(tmp_path))
    ((run,),) = (plan.runs for plan in paper.plan(args))
    paper.check_finished(run)  # nothing there yet
    run.folder.mkdir()
    saved = ppo_actiongen.plain_args(paper.args_of(run))
    del saved["explore"]  # made before there was such an option
    (run.folder / "args.json").write_text(json.dumps(saved))
    (run.folder / "results.json").write_text("{}")
    paper.check_finished(run)
    other = paper.Args(**vars(args) | {"extra": "--ent-coef 0.9"})
    ((same_folder,),) = (plan.runs for plan in paper.plan(other))
    assert same_folder.folder == run.folder
    with pytest.raises(ValueError, match="was made with ent_coef 0.05, this command has 0.9"):
        paper.run_all(paper.plan(other), other)


def test_the_papers_recipe_has_its_own_methods_widths_and_results():
    args = paper.Args(("gridworld",), recipe="paper", seeds=(0,))
    (plan,) = paper.plan(args)
    assert {run.method for run in plan.runs} == set(paper.RUNS["gridworld"]) - paper.BEYOND - set(
        paper.ADAPT
    )
    for run in plan.runs:
        run_args = paper.args_of(run)
        assert (run_args.hidden_size, run_args.utility_hidden, run_args.recipe) == (
            64,
            None,
            "paper",
        )
    assert (args.results, paper.Args(("gridworld",)).results) == (
        Path("results-paper"),
        Path("results"),
    )
    assert paper.Args(("fig4",), hvae_recipe="quick", results_dir="x").results == Path("x")
    with pytest.raises(ValueError, match="is about the fast recipe"):
        paper.plan(paper.Args(("create-recipe",), recipe="paper"))


def test_hours_hold_evaluations_and_the_encoders_recipe():
    args = paper.Args(("gridworld",), methods=("ours",), seeds=(0,))
    (plan,) = paper.plan(args)
    (run,), (encoder,) = plan.runs, plan.encoders
    assert run.hours > run.steps / run.rate / 3600
    args.hvae_recipe = "paper"
    ((days,),) = (plan.encoders for plan in paper.plan(args))
    assert days.hours > 24 > 1 > encoder.hours


def test_merging_replaces_rows_of_the_same_key_and_keeps_the_rest(tmp_path):
    path, columns = tmp_path / "t.csv", ["method", "seed", "score"]
    first = [dict(method="a", seed=s, score=0.5) for s in (0, 1)]
    paper.merge(path, columns, first, ("method", "seed"))
    paper.merge(path, columns, [dict(method="a", seed=1, score=0.75)], ("method", "seed"))
    paper.merge(path, columns, [dict(method="a", seed=0, score=0.25)], ("method", "seed"))
    rows = sorted(csv.DictReader(path.open()), key=lambda row: row["seed"])
    assert rows == [
        {"method": "a", "seed": "0", "score": "0.25"},
        {"method": "a", "seed": "1", "score": "0.75"},
    ]
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]


def test_an_evaluation_is_found_by_its_options(tmp_path):
    args = paper.Args(("analysis-angle",), seeds=(0,), runs_dir=str(tmp_path))
    first, second, *_ = paper.plan(args)[0].tests  # 15 and 12 degrees
    first.run.folder.mkdir(parents=True)
    (first.run.folder / "evaluations.csv").write_text(
        "actions,num_available,min_angle_gap,min_embedding_distance,unseen_ratio,greedy,episodes,"
        "seed,pool_size,score,stderr,return,length\n"
        "test,50,15.0,,,True,5000,0,463,0.1,0.01,1,9\n"
        "test,50,15.0,,,False,5000,0,463,0.25,0.01,1,9\n"
    )
    assert first.row()["score"] == "0.25"
    assert first.finished and not second.finished


def test_a_finished_adaptation_has_one_phase_and_a_curve(tmp_path):
    args = paper.Args(("fig9",), runs_dir=str(tmp_path), budget=0.01)
    run = paper.make_run("gridworld", "ours_from_scratch", 0, args)
    run.folder.mkdir(parents=True)
    score = {"score": 0.5, "stderr": 0.01, "episodes": 100}
    results = {"train": score, "published": {}, "steps": 250, "hours": 0.1}
    (run.folder / "results.json").write_text(json.dumps(results))
    names = "task representation modality split seed".split()
    (run.folder / "args.json").write_text(json.dumps(dict.fromkeys(names) | {"seed": 0}))
    metrics = ["step,train_score,valid_score,episode_score"]
    metrics += [f"{i},,,{i / 300 if i % 2 else ''}" for i in range(1, 251)]
    (run.folder / "metrics.csv").write_text("\n".join(metrics) + "\n")
    paper.collect_run(run, tmp_path)
    rows = list(csv.DictReader((tmp_path / "gridworld.csv").open()))
    assert [(r["phase"], r["score"], r["published"]) for r in rows] == [("train", "0.5", "")]
    curve = list(csv.DictReader((tmp_path / "fig9_curves.csv").open()))
    assert len(curve) == 100 and curve[-1]["step"] == "250"
    assert [float(r["episode_score"]) for r in curve] == sorted(
        float(r["episode_score"]) for r in curve
    )
    assert not (tmp_path / "gridworld_curves.csv").exists()
    run.words += ["--valid-episodes", "9"]  # another command, the same seed: no second one
    paper.collect_run(run, tmp_path)
    (row,) = csv.DictReader((tmp_path / "gridworld.csv").open())
    assert row["command"] == run.command != rows[0]["command"]


def test_pictures_of_another_folder_leave_the_readme_alone(tmp_path, monkeypatch):
    readme = ROOT / "results/README.md"
    text = readme.read_text()
    same = dict(env="gridworld", method="ours", seed=0, steps=9, hours=1, score=0.5)
    write(tmp_path / "gridworld.csv", [same | {"phase": p} for p in ("train", "valid", "test")])
    monkeypatch.setattr(sys, "argv", ["report.py", str(tmp_path)])
    monkeypatch.setattr(report, "RESULTS", report.RESULTS)  # main changes it
    report.main()
    assert (tmp_path / "gridworld.png").exists() and text == readme.read_text()
    monkeypatch.setattr(sys, "argv", ["report.py", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit, match="nowhere"):
        report.main()


@pytest.mark.parametrize("path", sorted((ROOT / "results").glob("*.csv")), ids=lambda p: p.stem)
def test_no_result_is_counted_twice(path):
    rows = list(csv.DictReader(path.open()))
    if "command" not in rows[0] or "seed" not in rows[0]:
        return  # curves, published numbers, places of a t-SNE picture
    same = "env method seed steps phase".split()
    same += [name for name in paper.OPTIONS if name != "episodes"]
    keys = [tuple(row.get(name) for name in same) for row in rows]
    assert len(set(keys)) == len(keys)


# ---- the report ----


def test_the_budget_with_most_seeds_is_shown_then_the_largest(tmp_path, monkeypatch):
    budgets = [("a", 0, 9), ("a", 0, 5), ("a", 1, 5), ("b", 0, 5), ("b", 0, 9)]
    rows = [f"gridworld,{m},{seed},test,{steps}" for m, seed, steps in budgets]
    text = "env,method,seed,phase,steps\n" + "\n".join(rows)
    (tmp_path / "gridworld.csv").write_text(text)
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    shown = report.scores("gridworld")
    assert [(r["seed"], r["steps"]) for r in shown["a", "test"]] == [("0", "5"), ("1", "5")]
    assert [(r["seed"], r["steps"]) for r in shown["b", "test"]] == [("0", "9")]
    assert shown["c", "test"] == []
    assert [r["steps"] for r in report.longest("gridworld")["a", "test"]] == ["9"]
    both = report.scores("gridworld", ["a", "b"])  # compared: the largest budget of both
    assert {r["steps"] for rows in both.values() for r in rows} == {"5"}
    assert len(both["a", "test"]) == 2
    assert report.scores("gridworld", ["a", "c"]) == report.scores("gridworld")  # none in common
    # With equally many seeds, the budget that most methods have: longer runs of one do not compare.
    rows = [f"stacking,{m},0,test,{steps}" for m, steps in (("a", 4), ("a", 9), ("b", 4))]
    (tmp_path / "stacking.csv").write_text("env,method,seed,phase,steps\n" + "\n".join(rows))
    assert [r["steps"] for r in report.scores("stacking")["a", "test"]] == ["4"]
    assert [r["steps"] for r in report.longest("stacking")["a", "test"]] == ["9"]


def test_every_method_has_a_label():
    for env, methods in paper.RUNS.items():
        labels = report.RECIPE[env] if env in paper.RECIPES else report.METHODS
        assert set(methods) <= set(labels)
    assert set(report.RECIPE) == set(report.RECIPE_NOTE) == set(paper.RECIPES)


def test_published_scores_are_found():
    assert report.published("gridworld")["ours", "test"][0] == pytest.approx(0.703, abs=1e-3)
    assert report.published("recsys-full")["ours", "test"][0] == pytest.approx(0.420, abs=1e-3)
    assert report.published("create-push")["ours", "test"][0] == pytest.approx(0.797, abs=1e-3)
    assert report.published("stacking")["ours_no_place", "test"][0] == pytest.approx(
        1.412, abs=1e-3
    )
    for env, methods in paper.RUNS.items():  # every published method of a drawn environment is run
        if env != "create-push-steady":  # the same task again: its main methods
            assert {method for method, _ in report.published(env)} <= set(methods), env
    steady = report.published("create-push-steady")
    assert steady == report.published("create-push") and ("ours_no_entropy", "test") in steady
    known = report.published_analysis("analysis-angle", "create-push", "ours_analysis")
    assert known[15.0] == pytest.approx((0.283, 0.0637))
    for name, x in (("angle", 5), ("embedding", 10), ("unseen-ratio", 5), ("set-size", 11)):
        method = "ours" if name == "set-size" else "ours_analysis"
        known = report.published_analysis(f"analysis-{name}", "create-push", method)
        assert len(known) == x
        assert known == report.published_analysis(f"analysis-{name}", "create-push-steady", method)


def write(path, rows):
    """A CSV of dictionaries."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def adaptation_rows(tmp_path, scores):
    """fig9's tables with one variant whose two seeds average to `scores`."""
    same = {"env": "gridworld", "task": ""}
    write(tmp_path / "fig9.csv", [same | dict(method="ours", seed=0, steps=9, score=0.6)])
    write(
        tmp_path / "fig9_curves.csv",
        [
            same
            | dict(method="ours_from_scratch", seed=s, steps=n)
            | dict(step=(i + 1) * 10**6, episode_score=v + d)
            for n, s, d in ((3, 0, 0.1), (3, 1, -0.1), (9, 0, 0.5))  # the last one: another budget
            for i, v in enumerate(scores)
        ],
    )


def test_steps_to_reach_the_zero_shot_line_are_those_of_the_seed_average(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    jump = [0.3, 0.7, 0.5, 0.5]  # one point above the line is chance
    adaptation_rows(tmp_path, [*jump, 0.61, 0.61, 0.61, 0.61, 0.61, 0.3])
    assert "| Grid World | 0.600 | 5,000,000 | - | - | - | 2 |" in report.section("fig9")
    adaptation_rows(tmp_path, [*jump, 0.59, 0.59, 0.59, 0.59, 0.59])
    assert "not reached in 9,000,000" in report.section("fig9")
    assert [path.exists() for path in report.draw("fig9")] == [True]


def test_experiments_without_results_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    for name in paper.EXPERIMENTS:
        assert report.section(name) == "" and report.draw(name) == []
    # The main run alone is not yet a comparison with its variant.
    same = dict(env="stacking", method="ours", seed=0, steps=9, hours=1, score=1.0)
    write(tmp_path / "stacking.csv", [same | {"phase": p} for p in ("train", "valid", "test")])
    assert report.section("fig13") == "" and "Ours" in report.section("stacking")


def test_throughput_refuses_unknown_groups(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["throughput.py", "chess"])
    with pytest.raises(SystemExit, match="'chess'"):
        throughput.main()
    assert {"gridworld", "recsys", "create", "stacking", "hvae", "utility", "learner"} <= set(
        throughput.GROUPS
    )


@pytest.mark.parametrize("recipe", ["paper", "fast"])
@pytest.mark.parametrize("env", ["gridworld", "recsys", "create", "stacking"])
def test_throughput_can_act_and_learn_in_every_environment(env, recipe):
    few = dict(num_envs=2, minibatch_size=2, num_minibatches=2, num_available=5, threads=1)
    run, rollout, update = throughput._learner(env, recipe=recipe, **few)
    before = [p.clone() for p in run.agent.parameters()]
    update(rollout())
    run.envs.close()
    after = run.agent.parameters()
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


# ---- for real, at tiny budgets ----

TINY = "--total-timesteps 256 --num-envs 4 --minibatch-size 32 --valid-episodes 4 "  # 2 rollouts
TINY += "--eval-episodes 4 --representation engineered"
FEW = {  # one command of each kind where an experiment has dozens of runs
    "table-main": ("ours", "nearest_neighbor"),
    "fig14": ("ours", "nearest_neighbor"),
    "fig8": ("ours",),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", paper.EXPERIMENTS)
def test_every_experiment_runs_and_is_drawn(name, tmp_path, monkeypatch):
    words = [name, "--seeds", "0", f"--extra={TINY}"]
    words += ["--runs-dir", str(tmp_path / "runs"), "--results-dir", str(tmp_path / "results")]
    words += ["--extra-test=--episodes 4", "--hvae-recipe", "quick"]
    words += ["--extra-encoder=--updates 2 --observations 4 --table-observations 4"]
    words += ["--methods", *FEW[name]] if name in FEW else []
    command = [sys.executable, "benchmarks/paper.py", *words]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert out.returncode == 0, out.stdout + out.stderr
    tables = [p.stem for p in (tmp_path / "results").glob("*.csv")]
    args = tyro.cli(paper.Args, args=words)
    (plan,) = paper.plan(args)
    assert all(job.finished for job in plan.everything)
    for run in plan.runs:
        file = f"{paper.file_of(run.env)}.csv"
        rows = list(csv.DictReader((tmp_path / "results" / file).open()))
        phases = {r["phase"] for r in rows if r["command"] == run.command}
        assert phases == ({"train"} if run.method in paper.ADAPT else {"train", "valid", "test"})
    if plan.tests:
        rows = list(csv.DictReader((tmp_path / "results" / f"{name}.csv").open()))
        assert {r["command"] for r in rows} == {test.command for test in plan.tests}
        assert all(0 <= float(r["score"]) < 20 for r in rows)
    assert bool(plan.panels) == ("encoders" in tables)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "runs").rglob("*") if p.is_file()}
    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert again.returncode == 0  # ... and nothing is run twice
    assert before == {p: p.stat().st_mtime_ns for p in before}
    for published in ROOT.glob("results/published_*.csv"):
        (tmp_path / "results" / published.name).write_text(published.read_text())
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    if name not in paper.RECIPES:
        pictures = report.draw(name)
        assert pictures and all(picture.stat().st_size > 5_000 for picture in pictures)
    assert "|---|" in report.section(name) or name == "fig14"
