"""Worked solutions apply, are short and pass their checks, which say what is wrong with others."""

import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SCRIPTS = "ppo_actiongen.py", "gridworld.py"
SOLUTIONS = sorted(ROOT.glob("exercises/solutions/*.patch"))

# Changes of the worked solutions: words of the check's answer; texts and what replaces them.
CHANGES = {
    "02": [
        ("ok", {"project(self.table[available])": "project(self.table)[available]"}),
        ("the same logits", {"cat([states, actions]": "cat([actions, states]"}),
    ],
    "03": [("rewards 0.1, 0, 0.024", {"(1 - LAMBDA_GOAL) * moves": "0.9 * moves"})],
    "05": [
        ("no other layers", {"            if args.outcome_coef:": "            if True:"}),
        ("hidden layer to learn", {"(hidden @ agent": "(hidden.detach() @ agent"}),
    ],
    "06": [
        ("log-probabilities of 0.9 pi", {"explorer.log_prob": "policy.log_prob"}),
        ("draws where pi is below", {"explorer.sample": "policy.sample"}),
        ("entropy of pi", {"policy.entropy()": "explorer.entropy()"}),
        ("the policy as it was", {"agent.eval()": "agent.train()"}),
    ],
    "07": [
        ("0.5 standard deviations", {"table[agent.train_ids].std(0)": "table.std(0)"}),
        (
            "position head",
            {'self.noisy_table[action["action_id"]]': 'self.table[action["action_id"]]'},
        ),
        ("the policy as it was", {"agent.noisy_table = agent.table  #": "#"}),
        (
            "ratios of 1",
            {"    action, logprob, _": "    agent.noisy_table *= 2\n    action, logprob, _"},
        ),
        (  # another way: `act` has an argument
            "ok",
            {
                "agent.noisy_table = agent.table  #": "#",
                "action=None):": "action=None, clean=False):\n        self.clean = clean\n",
                "self.noisy_table[": "(self.table if self.clean else self.noisy_table)[",
                "r(self.noisy_table,": "r(self.table if self.clean else self.noisy_table,",
                "def play_step(envs, obs, agent": "def play_step(envs, obs, agent, clean=False",
                "act(state, available)": "act(state, available, clean=clean)",
                " _, obs, infos = play_step(": " _, obs, infos = play_step(clean=True, ",
                "clean=True, envs, obs, agent": "envs, obs, agent, True",
            },
        ),
    ],
    "08": [("a mean", {"[available].mean(1)": "[available].sum(1)"})],
    "09": [
        ("no -1 taken", {"distance.masked_fill(available < 0, torch.inf)": "distance"}),
        ("probability 0", {"logits.masked_fill(available < 0, -torch.inf)": "logits"}),
        ("truncated when", {"(moves >= MAX_MOVES or nothing_left)": "(moves >= MAX_MOVES)"}),
    ],
}


@pytest.fixture
def check(monkeypatch):
    """exercises/check.py as a module; afterwards the scripts are again those of the repository."""
    monkeypatch.syspath_prepend(ROOT / "exercises")
    for name in ("gridworld", "ppo_actiongen"):
        monkeypatch.setitem(sys.modules, name, importlib.import_module(name))
    return importlib.import_module("check")


def test_reference_of_the_checks_is_the_policy_script():
    texts = [(ROOT / f / "ppo_actiongen.py").read_bytes() for f in ("", "exercises/reference")]
    assert texts[0] == texts[1], "cp ppo_actiongen.py exercises/reference/"


@pytest.mark.filterwarnings("ignore:.*Overriding environment")
@pytest.mark.parametrize("patch", SOLUTIONS, ids=lambda patch: patch.stem)
def test_solution_is_short_and_passes_and_wrong_ones_are_refused(patch, check, tmp_path):
    number = patch.stem[:2]
    solved = tmp_path / "solved"
    solved.mkdir()
    for script in SCRIPTS:
        shutil.copy(ROOT / script, solved)
    subprocess.run(["patch", "-p1", "-i", patch], cwd=solved, check=True, capture_output=True)
    lines = patch.read_text(encoding="utf-8").splitlines()
    assert sum(line.startswith("+") for line in lines) <= 25

    folders = [ROOT, solved]
    answers = ["not begun", "ok"]
    for answer, replacements in CHANGES[number]:
        folder = tmp_path / str(len(folders))
        folder.mkdir()
        for script in SCRIPTS:
            text = (solved / script).read_text(encoding="utf-8")
            for old, new in replacements.items():
                text = text.replace(old, new)
            (folder / script).write_text(text, encoding="utf-8")
        folders.append(folder)
        answers.append(answer)
    for folder, answer in zip(folders, answers, strict=True):
        seen = check.grade(number, folder)
        assert answer in seen and (seen == "ok") == (answer == "ok")


def test_check_takes_numbers_and_files_and_says_where_a_script_fails(tmp_path):
    (tmp_path / "anna.py").write_text("import no_such_module", encoding="utf-8")
    command = [sys.executable, ROOT / "exercises/check.py", "3", "same", "anna.py", ROOT]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    failed = "ModuleNotFoundError: No module named 'no_such_module' (anna.py, line 1)"
    lines = done.stdout.splitlines()
    assert lines[:2] == [f"anna.py: exercise {number}: {failed}" for number in ("03", "same")]
    assert lines[2].startswith(f"{ROOT}: exercise 03: not begun: ")
    assert lines[3:] == [f"{ROOT}: exercise same: ok"]


def test_check_has_help_and_names_what_it_does_not_know(check, capsys):
    check.main(["--help"])
    assert capsys.readouterr().out.startswith("Does a solution do")
    with pytest.raises(SystemExit, match="^error: berta.py is neither a file nor one of 02, 03,"):
        check.main(["6", "berta.py"])
