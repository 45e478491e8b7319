"""How sweeps end: launchers that give up, Ctrl-C, errors outside of a run, other commands' runs."""

import os
import signal
from pathlib import Path

import pytest
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra_plugins import equirl_sweeper

from equirl.config import ConfigError
from equirl.training.folder import claim_folder
from tests.smoke.sweeps import TINY
from tests.smoke.test_launchers import wait_for


class Double:
    """In the place of a launcher: each time does the next of what it is to do.

    Attributes:
        acts: What it is to do: functions of the folders of its runs, which may return jobs.
        launched: The names of these folders, each time.
        function: What its workers would call.
    """

    def __init__(self):
        self.acts, self.launched, self.function = [], [], None

    def launch(self, jobs, initial_job_idx):
        folders = [Path(job[0].removeprefix("resume=").strip('"')) for job in jobs]
        self.launched.append([folder.name for folder in folders])
        return self.acts.pop(0)(*folders)


@pytest.fixture
def double(monkeypatch):
    Plugins.instance()  # loads the sweeper once more when it is first asked
    launcher = Double()

    def make(sweeper, function):
        launcher.function = function
        return launcher

    monkeypatch.setattr(equirl_sweeper.RunsSweeper, "_launcher", make)
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))  # is added to, and put back
    return launcher


@pytest.fixture
def sweep(here, tmp_path):
    """Trains in the folder ``sweep``, in processes of their own."""

    def call(*arguments: str) -> tuple[int, str, str]:
        given = ["--multirun", *TINY, *arguments, f"hydra.sweep.dir={tmp_path / 'sweep'}"]
        return here("train.py", *given, "hydra/launcher=joblib")

    return call


def ended(words: str) -> JobReturn:
    return JobReturn(status=JobStatus.COMPLETED, _return_value=words)


def test_what_a_launcher_left_is_given_to_it_again(sweep, double, monkeypatch):
    """Three times, once what it left has saved itself; what failed is not tried again."""
    held = []

    def die(*folders):
        if len(folders) == 2:  # the first time
            (folders[1] / "failed.txt").write_text("planted\n")
            held.append(claim_folder(folders[0]))
            held[0].__enter__()
        raise RuntimeError("a worker\ndied")

    def sleep(seconds):
        held[0].__exit__(None, None, None)

    monkeypatch.setattr("time.sleep", sleep)
    double.acts = [die, die, die]
    code, out, err = sweep("seed=0,1")
    assert code == 1 and "2 runs: 1 failed, 1 new" in out
    assert "1 run failed:\nseed=1: planted" in err
    assert "joblib ended early: RuntimeError: a worker died" in err
    (first, second), *later = double.launched
    assert "seed-0" in first and "seed-1" in second and later == [[first], [first]]


def test_ctrl_c_is_no_failure_of_the_launcher(sweep, double, tmp_path):
    """Nor are runs that it did not reach told of what they failed of yesterday."""

    def fail(folder):
        (folder / "failed.txt").write_text("yesterday\n")
        return [ended("failed: yesterday")]

    def interrupted(folder):
        os.kill(os.getpid(), signal.SIGINT)
        wait_for(double.function.should_stop)
        raise RuntimeError("a worker died of it")

    double.acts = [fail, interrupted]
    assert sweep("seed=0")[0] == 1
    code, out, err = sweep("seed=0")
    assert code == 130 and "1 run: 1 new" in out and "go on with the same command" in err
    assert "failed" not in err and "ended early" not in err and len(double.launched) == 2
    assert not (tmp_path / "sweep" / "stop").exists()  # other commands' runs go on


def test_an_error_outside_of_a_run_is_told_and_kept(sweep, double, tmp_path):
    """Hydra hands it on as a result, which nobody has to look at."""
    error = JobReturn(status=JobStatus.FAILED, _return_value=OSError("no more processes"))
    double.acts = [lambda *_: [error, ended("finished")]]
    code, out, err = sweep("seed=0,1")
    assert code == 1 and "2 runs: 1 failed, 1 new" in out
    assert "1 run failed:\nseed=0: OSError: no more processes" in err
    (kept,) = tmp_path.glob("sweep/*/failed.txt")
    assert kept.read_text().endswith("OSError: no more processes\n")


def test_an_error_before_a_run_trains_is_told_and_kept(here, tmp_path, monkeypatch):
    """Where Hydra's own launcher trains one run after the other."""

    def damaged(path):
        raise ConfigError("no configuration any more")

    monkeypatch.setattr("train.load_config", damaged)
    code, out, err = here(
        "train.py", "--multirun", *TINY, "seed=0,1", f"hydra.sweep.dir={tmp_path}"
    )
    assert code == 1 and "2 runs: 2 failed" in out
    assert "2 runs failed:\nseed=0: no configuration any more" in err


def test_ctrl_c_hides_no_failure_of_before(here, tmp_path, monkeypatch):
    """Of three runs one has failed, one is stopped and one is not reached."""
    import equirl.training

    def trained(config, folder, should_stop):
        if config.seed == 0:
            raise ZeroDivisionError("planted")

    monkeypatch.setattr(equirl.training, "train", trained)
    code, out, err = here(
        "train.py", "--multirun", *TINY, "seed=0,1,2", f"hydra.sweep.dir={tmp_path}"
    )
    assert code == 1 and "3 runs: 1 failed, 2 new" in out and out.count("run folder") == 2
    assert "1 run failed:\nseed=0: ZeroDivisionError: planted" in err
    assert "go on with the same command" in err


def test_the_file_that_stops_others_is_not_taken_away(sweep, tmp_path):
    """Though they train what this command does not."""
    other = tmp_path / "sweep" / "of_another_command"
    with claim_folder(other):
        (tmp_path / "sweep" / "stop").touch()
        code, _, err = sweep("seed=0")
        assert code == 1 and "of_another_command is still saving itself" in err
        assert (tmp_path / "sweep" / "stop").exists()


def test_a_folder_with_something_else_is_refused(sweep, double, tmp_path):
    double.acts = [lambda folder: [ended("stopped")]]
    assert sweep("seed=0")[0] == 130
    (config,) = tmp_path.glob("sweep/*/config.yaml")
    config.rename(config.with_name("notes.txt"))
    code, _, err = sweep("seed=0")
    assert code == 1 and not config.exists()
    assert "it holds notes.txt; choose another hydra.sweep.dir" in err
