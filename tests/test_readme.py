"""Both READMEs against the repository: names exist, commands are accepted, tables equal the CSV."""

import importlib
import json
import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

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
    for path in set(re.findall(r"python (?:-m )?([\w/]+\.py)", TEXT)) - {"dial.py"}:
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


def save_example(start: str, path: Path) -> None:
    """Save the README's Python example that begins with these words."""
    (text,) = (t for t in re.findall(r"```python\n(.*?)```", TEXT, re.S) if t.startswith(start))
    path.write_text(text, encoding="utf-8")


def run(folder: Path, words: str) -> str:
    """What the policy script prints, started in this folder."""
    command = [sys.executable, ROOT / "ppo_actiongen.py", *words.split()]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def test_example_of_an_own_environment_learns_unseen_actions(tmp_path):
    save_example('"""Turn a dial', tmp_path / "dial.py")
    run(tmp_path, "dial.py --total-timesteps 20480 --eval-episodes 300")
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name == "dial-total_timesteps-20480-eval_episodes-300-s0"
    # by chance 0.23: 4 moves of 0.4 in 2 pi
    assert json.loads((folder / "results.json").read_text())["test"]["score"] > 0.6
    assert (folder / "episode.gif").exists()
    assert "success" in run(ROOT, f"evaluate {folder} --episodes 20")  # found from everywhere


def test_example_of_an_own_action_encoder_is_accepted_by_the_policy(tmp_path):
    save_example('"""Another action encoder', tmp_path / "encode.py")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "encode.py"], cwd=tmp_path, env=environment, check=True)
    words = "--representation endpoints.npz --minibatch-size 64 --total-timesteps 512"
    run(tmp_path, f"gridworld {words} --eval-episodes 8 --valid-episodes 8")
    (found,) = (tmp_path / "runs").glob("gridworld*/results.json")
    assert json.loads(found.read_text())["test"]["episodes"] == 8
