"""The worked solutions in exercises/: each applies, is short, and passes its check."""

import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = "*.py", "exercises/*.py", "results/published_results.csv"


@pytest.mark.parametrize("patch", sorted(ROOT.glob("exercises/*.patch")), ids=lambda p: p.stem)
def test_worked_solution_applies_is_short_and_passes_its_check(patch, tmp_path):
    for path in [path for pattern in FILES for path in ROOT.glob(pattern)]:
        copy = tmp_path / path.relative_to(ROOT)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(path, copy)
    run = partial(subprocess.run, cwd=tmp_path, check=True, capture_output=True, text=True)
    run(["git", "init", "-q"])
    run(["git", "add", "."])
    run(["git", "apply", patch])
    changed = [line.split()[:2] for line in run(["git", "diff", "--numstat"]).stdout.splitlines()]
    assert 0 < sum(map(int, sum(changed, []))) <= 40  # lines added and removed
    done = run([sys.executable, "exercises/check.py", patch.name[:2]], check=False)
    assert done.returncode == 0, done.stderr
