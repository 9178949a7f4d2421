"""Both READMEs against the repository: names exist, commands are accepted, tables equal the CSV."""

import csv
import importlib
import json
import os
import re
import subprocess
import sys
import textwrap
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import tyro

import gridworld
import hvae
import ppo_actiongen

ROOT = Path(__file__).parent.parent
PAGES = {path: path.read_text("utf-8") for path in (ROOT / "README.md", ROOT / "results/README.md")}
TEXT = "\n".join(PAGES.values())
sys.path.insert(0, str(ROOT / "benchmarks"))


def anchors(text: str) -> set[str]:
    """The names of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def test_every_name_of_the_paper_map_exists():
    rows = re.findall(r"^\| [^|]+ \| `([\w/]+\.py)` \| ((?:`\w+`(?:, )?)+) \|$", TEXT, re.M)
    assert len(rows) > 8
    for file, names in rows:
        module = importlib.import_module(Path(file).stem)
        for name in re.findall(r"`(\w+)`", names):
            assert hasattr(module, name), f"{file} has no {name}"


def test_every_script_picture_and_heading_they_link_to_exists():
    for path in set(re.findall(r"python (?:-m )?([\w/]+\.py)", TEXT)):
        assert (ROOT / path).exists(), path
    for page, text in PAGES.items():
        for path, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", text):
            if not path.startswith("https:"):
                target = (page.parent / path).resolve() if path else page
                assert target.exists(), f"{page}: {path}"
                assert not anchor or anchor in anchors(PAGES[target]), f"{page}: #{anchor}"


def test_tables_equal_the_csv_files_and_the_policies_play(tmp_path):
    odd = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "cp1252"}
    report = [sys.executable, "benchmarks/report.py", "--check"]
    subprocess.run(report, cwd=ROOT, env={**os.environ, **odd}, check=True)
    for folder in (ROOT / "results" / "policies").iterdir():
        gif = tmp_path / f"{folder.name}.gif"
        options = ppo_actiongen.EvaluateArgs(str(folder), episodes=2, gif=str(gif))
        assert ppo_actiongen.evaluate_run(options)["episodes"] == 2
        assert gif.read_bytes()[:3] == b"GIF"


def test_every_figure_and_flag_it_names_is_known():
    import paper

    tables = re.findall(r"^\| [^|\n]+ \| ((?:`[\w-]+`(?:, )?)+) \|$", TEXT, re.M)
    assert {name for row in tables for name in re.findall(r"`([\w-]+)`", row)} <= {*paper.TABLE}
    classes = (ppo_actiongen.Args, ppo_actiongen.EvaluateArgs, hvae.Args, paper.Args)
    known = {f.name.replace("_", "-") for c in classes for f in fields(c)} | {"play", "help"}
    for line in re.findall(r"`(?:python |create |stacking |evaluate |--)[^`]*`", TEXT):
        for flag in re.findall(r"(?<=\s|`)--(?:no-)?([\w-]+)", line):
            assert flag in known, flag


def test_costs_are_those_of_the_csv_files():
    line = r"^\|`(\w+)[^|]*\|([\d.]+)M\|([\d to]+)\|([\d.]+)\|([\w-]+\.csv)\|$"
    rows = re.findall(line, TEXT, re.M)
    assert len(rows) == 9
    for env, millions, minutes, score, name in rows:
        own = {"recsys": "ours_bilinear", "create": "ours_conditioned_auxiliary"}.get(env, "ours")
        method = "ours_linear_path" if "paper" in name else own
        text = (ROOT / "results" / name).read_text(encoding="utf-8")
        found = []
        for row in csv.DictReader(text.splitlines()):
            same = (row["env"], row["method"], row["phase"]) == (env, method, "test")
            same = same and row["split"] == "default" and row["recipe"] != "older"
            if same and float(row["steps"]) / 1e6 == pytest.approx(float(millions), rel=0.003):
                found.append(row)
        times = {round(60 * float(row["hours"])) for row in found}
        assert f"{np.mean([float(r['score']) for r in found]):.3f}" == score, (env, name)
        assert {min(times), max(times)} == {int(x) for x in minutes.split(" to ")}, (env, name)


def test_commands_of_all_rows_are_accepted():
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "results").glob("*.csv")]
    rows = [row for text in texts for row in csv.DictReader(text.splitlines())]
    commands = "\n".join({row.get("command", "") for row in rows})
    for line in re.findall(r"^python ppo_actiongen\.py ([^;&\n]*)", commands, re.M):
        if line.startswith("evaluate "):
            tyro.cli(ppo_actiongen.EvaluateArgs, args=line.split()[1:])
        else:
            ppo_actiongen.check(replace(ppo_actiongen.parse_args(line.split()), finetune=None))
    assert commands.count("python ppo_actiongen.py ") > 200


def run(folder: Path, words: str) -> str:
    """What the policy script prints, started in this folder."""
    command = [sys.executable, ROOT / "ppo_actiongen.py", *words.split()]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def test_example_of_an_own_environment_learns_unseen_actions(tmp_path):
    dial = ROOT / "exercises/dial.py"
    (core,) = re.findall(r"```python\n(def reset.*?)```", TEXT, re.S)
    for function in core.split("\n\n\n"):
        assert textwrap.indent(function, "    ") in dial.read_text(encoding="utf-8")
    words = "--representation engineered --total-timesteps 20480 --eval-episodes 300"
    run(tmp_path, f"{os.path.relpath(dial, tmp_path)} {words}")
    (folder,) = (tmp_path / "runs").iterdir()
    # by chance 0.23: 4 moves of 0.4 in 2 pi
    assert json.loads((folder / "results.json").read_text())["test"]["score"] > 0.6
    assert folder.name.startswith("dial-") and (folder / "episode.gif").exists()
    assert "success" in run(ROOT, f"evaluate {folder} --episodes 20")  # found from everywhere


def test_example_of_an_own_environment_gets_an_encoder(tmp_path):
    args = hvae.default_args(str(ROOT / "exercises/dial.py"), "quick")
    path = hvae.train(replace(args, runs_dir=str(tmp_path)))
    assert json.loads(path.with_suffix(".json").read_text())["engineered_r2"] > 0.9


def test_example_of_an_own_action_encoder_is_accepted_by_the_policy(tmp_path):
    (text,) = (t for t in re.findall(r"```python\n(.*?)```", TEXT, re.S) if "Another action" in t)
    (tmp_path / "encode.py").write_text(text, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "encode.py"], cwd=tmp_path, env=environment, check=True)
    table = hvae.load_representation(tmp_path / "endpoints.npz", "gridworld")
    ids = gridworld.split_actions()
    assert hvae.probe(table["mean"], ids["train"], ids["test"], "gridworld")["move_accuracy"] > 0.99
    words = "--representation endpoints.npz --minibatch-size 64 --total-timesteps 512"
    run(tmp_path, f"gridworld {words} --eval-episodes 8 --valid-episodes 8 --run-name own")
    results = json.loads((tmp_path / "runs/own/results.json").read_text())
    assert results["test"]["episodes"] == 8
