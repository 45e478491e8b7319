"""The trained policies of the repository still do what their page says."""

import re
from pathlib import Path

import pytest
import torch

from equirl.envs.tasks import TASKS
from equirl.training import load_policy

FOLDER = Path(__file__).parents[2] / "experiments" / "results" / "policies"
#: Steps and successes in 100 scenes by task, as the page has them.
TOLD = {
    task: (int(steps.replace(",", "")), int(success))
    for task, steps, success in re.findall(
        r"^\| `(\w+)\.pt` \| ([\d,]+) \| (\d+) ", (FOLDER / "README.md").read_text(), re.MULTILINE
    )
}


def test_there_is_one_for_each_task():
    assert set(TOLD) == {path.stem for path in FOLDER.glob("*.pt")} == set(TASKS)
    assert all(path.stat().st_size < 5e6 for path in FOLDER.glob("*.pt"))


@pytest.mark.parametrize("task", TASKS)
def test_it_solves_its_task(here, task):
    """Ten of the hundred scenes: rounding of another processor may cost one or the other."""
    config, _ = load_policy(FOLDER / f"{task}.pt")
    assert (config.env.task, config.group, config.mode) == (task, "D4", "strict")
    assert torch.load(FOLDER / f"{task}.pt", weights_only=True)["step"] == TOLD[task][0]
    assert evaluate(here, task, 10, "backend=dense") >= 8


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_it_solves_as_many_scenes_as_told(here, task):
    assert abs(evaluate(here, task, 100) - TOLD[task][1]) <= 3


def evaluate(here, task: str, episodes: int, *options: str) -> int:
    code, out, err = here(
        "evaluate.py", f"run={FOLDER / task}.pt", f"episodes={episodes}", *options
    )
    assert code == 0, err
    (solved,) = re.findall(rf"^(\d+) of {episodes} episodes succeed", out, re.MULTILINE)
    return int(solved)
