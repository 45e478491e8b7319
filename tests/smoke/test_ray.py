"""Sweeps through Ray: through one that does all in this process, and the real one if it is here."""

import importlib.util
import os
import pickle
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import pytest
import run_processes

import equirl.training  # noqa: F401  TorchRL, too, looks for Ray when it is loaded
from tests.smoke.sweeps import TINY

REAL = importlib.util.find_spec("ray") is not None

#: In the place of the training: says what it was given, and fails.
TRAINING = """
import os, sys
print(os.environ["OMP_NUM_THREADS"], *sys.argv[1:])
sys.exit("error: planted")
"""


class RayError(Exception):
    """What Ray raises for a worker that has died."""


@pytest.fixture
def ray(monkeypatch, tmp_path):
    """What the launcher uses of Ray: tasks are pickled, and run when their result is asked for."""
    fake = ModuleType("ray")
    fake.__spec__ = ModuleSpec("ray", None)
    fake.calls, fake.dying = [], []
    fake.exceptions = SimpleNamespace(RayError=RayError)
    fake.init = lambda **options: fake.calls.append(("init", options))
    fake.shutdown = lambda: fake.calls.append(("shutdown", {}))

    def remote(**options):
        fake.calls.append(("remote", options))
        return lambda function: SimpleNamespace(remote=lambda *given: task(function, *given))

    def task(function, run, values):
        fake.calls.append(("task", values))
        return pickle.dumps((function, (run, values)))

    def get(reference):
        if fake.dying:
            raise fake.dying.pop()
        function, given = pickle.loads(reference)
        return function(*given)

    fake.remote, fake.get = remote, get
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))  # is added to, and put back
    monkeypatch.setattr(run_processes, "SCRIPT", tmp_path / "training.py")
    run_processes.SCRIPT.write_text(TRAINING)
    return fake


def launch(here, folder, *arguments: str) -> tuple[str, str]:
    """Trains two runs through Ray, both of which fail; returns output and complaints."""
    keys = [key for key in TINY if key != "threads=1"]
    sweep = ["--multirun", *keys, "seed=0,1", f"hydra.sweep.dir={folder}", "hydra/launcher=ray"]
    code, out, err = here("train.py", *sweep, *arguments)
    assert code == 1 and "2 runs: 2 failed" in out, err
    assert "seed=0: planted" in err and "seed=1: planted" in err
    return out, err


def test_each_run_is_a_task_with_its_folder_and_its_threads(here, tmp_path, ray):
    folder = tmp_path / "sweep"
    out, err = launch(
        here, folder, "hydra.launcher.cpus_per_run=2", "hydra.launcher.gpus_per_run=0.5"
    )
    assert "ended early" not in err
    assert [name for name, _ in ray.calls] == ["init", "remote", "task", "task", "shutdown"]
    started, asked, *values = (options for _, options in ray.calls[:4])
    assert not any("hydra" in each for each in values)  # which is this process's own
    assert started["address"] == "local" and started["num_cpus"] >= 2
    assert str(run_processes.__file__).rpartition("/")[0] in str(started["runtime_env"])
    assert asked == {"max_retries": 0, "num_cpus": 2, "num_gpus": 0.5}
    for seed in (0, 1):
        (log,) = folder.glob(f"*seed-{seed}*/log.txt")
        threads, run, *more = log.read_text().splitlines()[0].split()
        assert threads == "2" and f"{log.parent}" in run and "threads=2" in more


def test_a_running_cluster_is_joined_as_it_is(here, tmp_path, ray):
    launch(here, tmp_path / "sweep", "hydra.launcher.address=auto")
    started = ray.calls[0][1]
    assert started["address"] == "auto" and not started.keys() & {"num_cpus", "include_dashboard"}


def test_what_a_dead_worker_left_is_trained_by_another(here, tmp_path, ray):
    """The others are waited for, Ray is shut down, and then begun with again."""
    ray.dying.append(RayError("the worker died"))
    out, err = launch(here, tmp_path / "sweep")
    first, second = ["task", "task", "shutdown"], ["task", "shutdown"]
    begin = ["init", "remote"]
    assert [name for name, _ in ray.calls] == [*begin, *first, *begin, *second]
    assert out.count("seed-0_steps-12: begins") == out.count("seed-1_steps-12: begins") == 1


def test_without_ray_it_is_told_what_brings_it(here, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    sweep = ["--multirun", *TINY, "seed=0,1", f"hydra.sweep.dir={tmp_path}", "hydra/launcher=ray"]
    code, _, err = here("train.py", *sweep)
    assert code == 1 and "pip install 'equirl[ray]' brings it" in err


@pytest.mark.skipif(not REAL, reason="Ray is part of the set-up of `make test-all` alone")
def test_ray_on_one_machine(here, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))  # where Ray keeps a token of its own
    folder = tmp_path / "sweep"
    sweep = ["--multirun", *TINY, "seed=0", "env.max_steps=15,3", f"hydra.sweep.dir={folder}"]
    code, out, err = here("train.py", *sweep, "hydra/launcher=ray")
    assert code == 1 and "2 runs: 1 finished, 1 failed" in out, err
    assert "env.max_steps=3: BlockPickingExpert failed 20 episodes in a row" in err
