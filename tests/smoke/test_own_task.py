"""The how-to of docs/adding_a_task.md, followed to the letter."""

import os
import re
import shutil
import subprocess
import sys

import pytest

from tests.commands import ROOT, SMOKE

PAGE = (ROOT / "docs" / "adding_a_task.md").read_text()
CODE = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1]
LINE = re.search(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[1]


def test_a_task_in_a_file_of_ones_own(here, tmp_path, monkeypatch):
    (tmp_path / "my_tasks.py").write_text(CODE)
    monkeypatch.syspath_prepend(tmp_path)
    task, run = "env.task=my_tasks:BlockReaching", tmp_path / "run"

    def script(name: str, *arguments: str) -> str:
        code, out, err = here(name, *arguments)
        assert code == 0, err
        return out

    watched = script(
        "watch.py", task, "env.image_size=16", "size=32", f"output={tmp_path / 'watch'}"
    )
    assert watched.count("success after") == 3
    script("train.py", *SMOKE, task, "env.options.reach=0.03", f"output={run}")
    assert "reach: 0.03" in (run / "config.yaml").read_text()
    assert "of 2 episodes succeed" in script("evaluate.py", f"run={run}", "episodes=2")


@pytest.mark.parametrize("fault", ["env.task=my_tasks:Reaching", "env.options.reach=-1"])
def test_its_faults_are_told_in_a_sentence(here, fault, tmp_path, monkeypatch):
    (tmp_path / "my_tasks.py").write_text(CODE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    code, _, err = here("train.py", *SMOKE, "env.task=my_tasks:BlockReaching", fault)
    assert code == 1 and "Traceback" not in err
    assert ("my_tasks:Reaching" if "Reaching" in fault else "reach must be") in err


def test_one_file_and_one_line_give_it_a_name(tmp_path):
    ignored = shutil.ignore_patterns("__pycache__", "results", "*.nb?")
    for part in ("equirl", "conf", "experiments"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=ignored)
    (tmp_path / "equirl/envs/tasks/block_reaching.py").write_text(CODE)
    (tmp_path / "conf/env/block_reaching.yaml").write_text(LINE)

    def python(*arguments: str) -> str:
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        command = [sys.executable, *arguments]
        options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
        done = subprocess.run(command, timeout=300, **options)
        assert done.returncode == 0, done.stderr
        return done.stdout

    run = [*SMOKE, "env=block_reaching", f"output={tmp_path / 'run'}"]
    assert "of 3 episodes succeed" in python("experiments/train.py", *run)
    identifier = "equirl.envs.gymnasium:equirl/BlockReaching-v0"
    python("-W", "ignore", "-c", f"import gymnasium; gymnasium.make('{identifier}')")
