"""The how-to of docs/adding_a_task.md, followed to the letter."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CODE = re.search(r"```python\n(.*?)```", (ROOT / "docs/adding_a_task.md").read_text(), re.DOTALL)[1]
LINE = re.search(r"```yaml\n(.*?)```", (ROOT / "docs/adding_a_task.md").read_text(), re.DOTALL)[1]
SMOKE = ["preset=smoke", "group=c4", "env.robot=hand", "logging.progress=false", "threads=1"]


def call(root: Path, *command: str, path: Path) -> str:
    done = subprocess.run(
        [sys.executable, *command],
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_task_in_a_file_of_ones_own(tmp_path):
    (tmp_path / "my_tasks.py").write_text(CODE)
    task, run = "env.task=my_tasks:BlockReaching", tmp_path / "run"

    def script(name: str, *arguments: str) -> str:
        return call(ROOT, f"experiments/{name}.py", *arguments, path=tmp_path)

    watched = script("watch", task, "env.image_size=16", "size=32", f"output={tmp_path / 'watch'}")
    assert watched.count("success after") == 3
    script("train", *SMOKE, task, "env.options.reach=0.03", f"output={run}")
    assert "reach: 0.03" in (run / "config.yaml").read_text()
    assert "of 2 episodes succeed" in script("evaluate", f"run={run}", "episodes=2")


@pytest.mark.parametrize("fault", ["env.task=my_tasks:Reaching", "env.options.reach=-1"])
def test_its_faults_are_told_in_a_sentence(fault, tmp_path):
    (tmp_path / "my_tasks.py").write_text(CODE)
    command = [sys.executable, "experiments/train.py", "env.task=my_tasks:BlockReaching", fault]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert ("my_tasks:Reaching" if "Reaching" in fault else "reach must be") in done.stderr


def test_one_file_and_one_line_give_it_a_name(tmp_path):
    ignored = shutil.ignore_patterns("__pycache__", "results", "*.nb?")
    for part in ("equirl", "conf", "experiments"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=ignored)
    (tmp_path / "equirl/envs/tasks/block_reaching.py").write_text(CODE)
    (tmp_path / "conf/env/block_reaching.yaml").write_text(LINE)
    run = ["experiments/train.py", *SMOKE, "env=block_reaching", f"output={tmp_path / 'run'}"]
    assert "of 3 episodes succeed" in call(tmp_path, *run, path=tmp_path)
    gymnasium = "import gymnasium; gymnasium.make('equirl.envs.gymnasium:equirl/BlockReaching-v0')"
    call(tmp_path, "-W", "ignore", "-c", gymnasium, path=tmp_path)
