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
PAGES = {path: path.read_text() for path in (ROOT / "README.md", ROOT / "results/README.md")}
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


def test_tables_equal_the_csv_files_and_the_policies_play():
    subprocess.run([sys.executable, "benchmarks/report.py", "--check"], cwd=ROOT, check=True)
    for folder in (ROOT / "results" / "policies").iterdir():
        options = ppo_actiongen.EvaluateArgs(str(folder), episodes=2)
        assert ppo_actiongen.evaluate_run(options)["episodes"] == 2


def test_every_figure_and_flag_it_names_is_known():
    import paper

    tables = re.findall(r"^\| [^|\n]+ \| ((?:`[\w-]+`(?:, )?)+) \|$", TEXT, re.M)
    assert {name for row in tables for name in re.findall(r"`([\w-]+)`", row)} <= {*paper.TABLE}
    classes = (ppo_actiongen.Args, ppo_actiongen.EvaluateArgs, hvae.Args, paper.Args)
    known = {f.name.replace("_", "-") for c in classes for f in fields(c)} | {"play", "help"}
    for line in re.findall(r"`(?:python |create |stacking |evaluate |--)[^`]*`", TEXT):
        for flag in re.findall(r"(?<=\s|`)--(?:no-)?([\w-]+)", line):
            assert flag in known, flag


def run_example(start: str, name: str, folder: Path, *flags: str) -> None:
    """Save the README's Python example that begins with these words to a file, and run it."""
    (text,) = (t for t in re.findall(r"```python\n(.*?)```", TEXT, re.S) if t.startswith(start))
    (folder / name).write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, name, *flags], cwd=folder, env=environment, check=True)


def test_example_of_an_own_environment_learns_unseen_actions(tmp_path):
    words = "--total-timesteps 20480 --eval-episodes 300".split()
    run_example('"""Turn a dial', "dial.py", tmp_path, *words)
    (run,) = (tmp_path / "runs").iterdir()
    # by chance 0.23: 4 moves of 0.4 in 2 pi
    assert json.loads((run / "results.json").read_text())["test"]["score"] > 0.6
    assert (run / "episode.gif").exists()
    test = ["evaluate", str(run), "--episodes", "300"]
    run_example('"""Turn a dial', "dial.py", tmp_path, *test)
    command = [sys.executable, ROOT / "ppo_actiongen.py", *test]  # which knows no dial
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.startswith("error: ") and "'dial'" in done.stderr


def test_example_of_an_own_action_encoder_is_accepted_by_the_policy(tmp_path):
    run_example('"""Another action encoder', "encode.py", tmp_path)
    words = "gridworld --representation endpoints.npz --minibatch-size 64"
    words += " --total-timesteps 512 --eval-episodes 8 --valid-episodes 8"
    subprocess.check_call([sys.executable, ROOT / "ppo_actiongen.py", *words.split()], cwd=tmp_path)
    (found,) = (tmp_path / "runs").glob("gridworld*/results.json")
    assert json.loads(found.read_text())["test"]["episodes"] == 8
