"""The README against the repository: names exist, commands are accepted, tables equal the CSV."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text()


def test_every_name_of_the_paper_map_exists():
    sys.path.insert(0, str(ROOT / "benchmarks"))
    rows = re.findall(r"^\| [^|]+ \| `([\w/]+\.py)` \| ((?:`\w+`(?:, )?)+) \|$", TEXT, re.M)
    assert len(rows) > 8
    for file, names in rows:
        if file == "stacking_env.py":
            continue  # its own tests run only where pybullet is installed
        module = importlib.import_module(Path(file).stem)
        for name in re.findall(r"`(\w+)`", names):
            assert hasattr(module, name), f"{file} has no {name}"


def test_every_script_and_picture_it_names_exists():
    for path in re.findall(r"python (?:-m )?([\w/]+\.py)", TEXT):
        assert (ROOT / path).exists(), path
    for path in re.findall(r"!\[[^]]*\]\(([^)]+)\)", TEXT):
        assert (ROOT / path).exists(), path


def test_tables_equal_the_csv_files():
    check = [sys.executable, "benchmarks/report.py", "--check"]
    result = subprocess.run(check, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_every_command_line_flag_it_names_is_known():
    import ppo_actiongen

    sys.path.insert(0, str(ROOT / "benchmarks"))
    import paper

    known = {f.name.replace("_", "-") for f in ppo_actiongen.fields(ppo_actiongen.Args)}
    known |= {f.name.replace("_", "-") for f in ppo_actiongen.fields(ppo_actiongen.EvaluateArgs)}
    known |= {f.name.replace("_", "-") for f in ppo_actiongen.fields(paper.Args)}
    for line in re.findall(r"`(?:python ppo_actiongen\.py|--)[^`]*`", TEXT):
        for flag in re.findall(r"--(?:no-)?([\w-]+)", line):
            assert flag in known, flag
