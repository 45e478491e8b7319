"""The trained policies of the repository still do what their page says."""

import re
from pathlib import Path

import pytest

from equirl.envs.tasks import TASKS
from equirl.training import load_policy

FOLDER = Path(__file__).parents[2] / "experiments" / "results" / "policies"


def test_there_is_one_for_each_task():
    assert {path.stem for path in FOLDER.glob("*.pt")} == set(TASKS)
    assert all(path.stat().st_size < 5e6 for path in FOLDER.glob("*.pt"))


@pytest.mark.parametrize("task", TASKS)
def test_it_solves_its_task(here, task):
    """Ten of the hundred scenes: rounding of another processor may cost one or the other."""
    config, _ = load_policy(FOLDER / f"{task}.pt")
    assert (config.env.task, config.group, config.mode) == (task, "D4", "strict")
    code, out, err = here("evaluate.py", f"run={FOLDER / task}.pt", "episodes=10", "backend=dense")
    assert code == 0, err
    (solved,) = re.findall(r"^(\d+) of 10 episodes succeed", out, re.MULTILINE)
    assert int(solved) >= 8
