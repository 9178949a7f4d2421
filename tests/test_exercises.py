"""Worked solutions apply, are short and pass their checks, which say what is wrong with others."""

import csv
import importlib
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import gridworld
import hvae

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.filterwarnings("ignore:.*Overriding environment")
SCRIPTS = "ppo_actiongen.py", "gridworld.py", "recsys.py", "hvae.py"
TEXT = (ROOT / "exercises/README.md").read_text(encoding="utf-8")
SOLUTIONS = sorted(ROOT.glob("exercises/solutions/*.patch"))

# Changes of the worked solutions: words of the check's answer; texts and what replaces them.
CHANGES = {
    "01": [
        ("rounding alone", {"before[:, order]": "before"}),
        ("by the place", {"torch.randperm": "torch.arange"}),
        ("by the place", {".abs()": ""}),
        ("by the place", {"after - before[:, order]": "after.sort()[0] - before.sort()[0]"}),
    ],
    "02": [
        ("ok", {"project(self.table[available])": "project(self.table)[available]"}),
        ("the same logits", {"cat([states, actions]": "cat([actions, states]"}),
    ],
    "03": [("rewards 0.1, 0, 0.024", {"(1 - LAMBDA_GOAL) * moves": "0.9 * moves"})],
    "05": [
        ("no other layers", {"            if args.outcome_coef:": "            if True:"}),
        ("target of the first output", {'args.gamma * (1 - batch["done"])': "args.gamma"}),
        ("hidden layer to learn", {"(hidden @ agent": "(hidden.detach() @ agent"}),
        ("twice the gradient", {"args.outcome_coef * outcome_loss": "outcome_loss"}),
        ("depend on `done`", {'logits(end, mb["done"])': 'logits(end, 0 * mb["done"])'}),
    ],
    "06": [
        ("log-probabilities of 0.9 pi", {"explorer.log_prob": "policy.log_prob"}),
        ("rollout of nearest", {"EXPLORE / policy.probs": "EXPLORE / available"}),
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
                "def play_step(envs, obs, agent": "def play_step(envs, obs, agent, clean=False",
                "act(state, available)": "act(state, available, clean=clean)",
                " _, obs, infos = play_step(": " _, obs, infos = play_step(clean=True, ",
                "clean=True, envs, obs, agent": "envs, obs, agent, True",
            },
        ),
    ],
    "08": [
        ("the same odds", {"[available].mean(1)": "[available].sum(1)"}),
        ("other odds", {"[available].mean(1)": "[available].amax(1)"}),
    ],
    "09": [
        ("no -1 taken", {"distance.masked_fill(available < 0, torch.inf)": "distance"}),
        ("probability 0", {"logits.masked_fill(available < 0, -torch.inf)": "logits"}),
        ("truncated when", {"(moves >= MAX_MOVES or nothing_left)": "(moves >= MAX_MOVES)"}),
        ("not truncated, at", {"not terminated and (": "("}),
        ("observation space", {"-1 if once else 0": "0"}),
        ("a ValueError", {"if self.available[action] < 0": "if False"}),
    ],
    "11": [
        ("after every reset", {"self.clicked = []": "self.clicked = getattr(self, 'clicked', [])"}),
        ("no second click", {"self.clicked.append(product)": "self.clicked = [product]"}),
        ("the same random", {"= bool(self": "= product not in self.clicked and bool(self"}),
        ("`play` to recommend nothing", {"np.where(bought, -np.inf, score)": "score"}),
        ("CTR above 0.5 of oracle", {"score).argmax()": "-score).argmax()"}),
    ],
    "12": [
        ("4 dimensions", {"mean[held_out_ids].std(0)": "mean.std(0)"}),
        ("4 dimensions", {"mean[held_out_ids].std(0)": "mean[held_out_ids].var(0)"}),
    ],
}


@pytest.fixture
def check(monkeypatch):
    """exercises/check.py as a module; afterwards the scripts are again those of the repository."""
    monkeypatch.syspath_prepend(ROOT / "exercises")
    for name in ("gridworld", "ppo_actiongen"):
        monkeypatch.setitem(sys.modules, name, importlib.import_module(name))
    return importlib.import_module("check")


def test_reference_of_the_checks_are_the_scripts_as_given():
    for copy in (ROOT / "exercises/reference").glob("*.py"):
        assert copy.read_bytes() == (ROOT / copy.name).read_bytes(), f"cp {copy.name} {copy.parent}"


def test_an_agent_comes_from_a_run_as_exercise_1_says(monkeypatch):
    monkeypatch.chdir(ROOT)
    (code,) = re.findall(r" ```python\n(.*?)```", TEXT, re.S)
    names = {}
    exec(textwrap.dedent(code), names)
    assert names["logits"].shape == names["available"].shape == (8, 50)


def test_numbers_to_expect_are_those_of_the_results():
    with open(ROOT / "results/exercises.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    texts = re.split(r"^\d+\. ", TEXT, flags=re.M)  # what stands before exercise 1, then each
    assert len(texts) == 13 and all("*Expect*" in text for text in texts[1:10] + texts[11:])
    for row in rows:
        number = int(row["exercise"])
        text = texts[number]
        assert row["shown"] in text, row
        digits = len(row["shown"].partition(".")[2])
        assert f"{float(row['score']):.{digits}f}" == row["shown"], row
    assert {int(row["exercise"]) for row in rows} == {0, *range(2, 10), 11, 12}


def test_exercise_4_takes_means_of_recordings_alone(check, tmp_path):
    recorded = gridworld.action_observations(np.arange(1024), 16, "xy").astype(np.float32)
    moved = (recorded[:, :, -1] - recorded[:, :, 0]).mean(1)
    bytes_ = recorded.astype(np.uint8)
    tables = {
        "ok": moved,
        "net_r2 above": (bytes_[:, :, -1] - bytes_[:, :, 0]).mean(1),
        "two numbers": recorded[:, :, -1].mean(1).repeat(2, axis=1),
        "walls stop": gridworld.engineered_representations()[:, :2],
    }
    for answer, table in tables.items():
        hvae.save_representation(tmp_path / "net.npz", table, [], {"env": "gridworld"})
        for work in (tmp_path, tmp_path / "net.npz"):
            assert answer in check.grade("04", work)
    assert check.grade("04", ROOT).startswith("not begun")


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
        for script in solved.glob("*.py"):
            text = script.read_text(encoding="utf-8")
            for old, new in replacements.items():
                text = text.replace(old, new)
            (folder / script.name).write_text(text, encoding="utf-8")
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


def test_same_refuses_a_grid_world_that_differs_while_its_option_is_off(check, tmp_path):
    text = (ROOT / "gridworld.py").read_text(encoding="utf-8")
    file = tmp_path / "berta.py"
    for constant in ("LAMBDA_SUBGOAL = 0.1", "LAMBDA_GOAL = 0.9"):
        file.write_text(text.replace(constant, constant[:-1] + "5"), encoding="utf-8")
        assert "same rewards" in check.grade("same", file)
