"""Sweeps beside other processes, after other versions, with other numbers: what becomes of each."""

import fcntl
import os
import re
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import sweeping
import train as train_script
from omegaconf import OmegaConf

from equirl.analysis.labels import group_variants
from equirl.analysis.runs import Run
from equirl.config import ConfigError, flatten
from equirl.config.schema import is_execution
from equirl.training import train
from equirl.training.folder import claim_folder
from tests.smoke.sweeps import TINY, make_run


@pytest.fixture
def one(here, tmp_path):
    """A finished sweep of one run: its command line, and the run's folder."""
    sweep = ["--multirun", *TINY, "seed=0", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    assert here("train.py", *sweep)[0] == 0
    (folder,) = (tmp_path / "sweep").glob("*seed-0*")
    return sweep, folder


def test_what_another_version_has_left(here, one):
    """A finished run is left alone, though its configuration says what no run can say any more."""
    sweep, folder = one
    path = folder / "config.yaml"
    path.write_text(path.read_text() + "colour: red\n")
    code, out, err = here("train.py", *sweep)
    assert code == 0 and "1 run: 1 finished" in out and "run folder" not in out
    assert "left alone, though" in err and "colour" in err
    (folder / "report.md").unlink()
    code, out, err = here("train.py", *sweep)
    assert code == 1 and "colour" in err and "choose another hydra.sweep.dir" in err


def test_where_a_run_is_computed_makes_no_other_of_it(here, one):
    """Nor is it tested anew, by a sweep or by itself; with another evaluation it is."""
    sweep, folder = one
    before = (folder / "test.csv").stat().st_mtime_ns
    changed = ["threads=2", "checkpoint_every=7", "logging.tensorboard=true", "backend=dense"]
    for command in ([*sweep, *changed], [f"resume={folder}", *changed]):
        code, out, err = here("train.py", *command)
        assert code == 0 and (folder / "test.csv").stat().st_mtime_ns == before, err
    code, _, err = here("train.py", f"resume={folder}", "evaluation.final_episodes=2")
    assert code == 0 and (folder / "test.csv").stat().st_mtime_ns != before, err


def test_figures_call_the_same_keys_neutral():
    """Their list is their own, since they need not know what trains."""
    keys = flatten(make_run([]).config)
    for key in filter(is_execution, keys):
        runs = [Run(Path(value), keys | {key: value}) for value in ("one", "other")]
        assert len(group_variants(runs)) == 1, key


def test_a_run_that_another_process_trains(here, one):
    """It has not failed, whichever command finds it so and when; nor has anything been stopped."""
    sweep, folder = one
    (folder / "report.md").unlink()
    with claim_folder(folder):
        code, out, err = here("train.py", *sweep)
        assert code == 75 and out.count("1 run: 1 running") == 2, err
        code, out, err = here("train.py", f"resume={folder}")
        assert code == 75 and f"error: another run is writing to {folder}" in err
        code, out, err = here("train.py", *sweep, "dry_run=true")  # it is part of what is left
        hours = re.search(r"running, at step 12 of 12 \| ([\d.e-]+) \|", out)
        assert code == 0 and hours and float(hours[1]) > 0, out


def test_a_run_that_begins_elsewhere_meanwhile(here, tmp_path, monkeypatch):
    """Between the look at its folder and its turn: the sweep keeps no failure for it."""
    held = []
    honest = sweeping.Run.prepare

    def prepare(run):
        honest(run)
        held.append(claim_folder(run.folder))
        held[-1].__enter__()

    monkeypatch.setattr(sweeping.Run, "prepare", prepare)
    try:
        code, _, err = here("train.py", "--multirun", *TINY, f"hydra.sweep.dir={tmp_path}")
    finally:
        held[0].__exit__(None, None, None)
    assert code == 75 and "another run is writing to" in err
    assert not list(tmp_path.glob("*/failed.txt"))


def test_a_look_at_a_run_does_not_keep_it_from_beginning(tmp_path, monkeypatch):
    """Nor does it leave anything behind."""
    run = make_run(["a=1"])
    run.folder = tmp_path
    run.prepare()
    run.look()
    assert run.state == "new" and [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
    with claim_folder(tmp_path):
        run.look()
        assert run.state == "running"
    lock = os.open(tmp_path / ".lock", os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_SH)  # as a look has it for a moment
    threading.Timer(0.3, os.close, [lock]).start()
    with claim_folder(tmp_path):
        pass


def test_what_is_not_a_runs_is_not_trained_into(tmp_path):
    """As a single run refuses it; what one leaves before its configuration is no hindrance."""
    run = make_run(["a=1"])
    run.folder = tmp_path
    for name in (".lock", "log.txt", "failed.txt", "config.yaml.partial"):
        (tmp_path / name).touch()
    (tmp_path / "tensorboard").mkdir()
    run.look()
    assert run.state == "new"
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigError, match=r"is not the folder of a run: it holds thesis.tex$"):
        run.look()


@pytest.mark.parametrize(
    ("left", "words"),
    [(b"MemoryError: 9 G\xe2\x82", "MemoryError: 9 G\ufffd"), (b"", "unknown reason")],
)
def test_a_reason_that_was_cut_short(tmp_path, left, words):
    run = make_run(["a=1"])
    run.folder = tmp_path
    run.prepare()
    (tmp_path / "failed.txt").write_bytes(left)
    run.look()
    assert run.state == "failed" and run.last_words == words


@pytest.mark.parametrize("project", ["größe", "a\\b", 'x, "y"'])
def test_texts_reach_a_run_as_they_are(tmp_path, monkeypatch, project):
    """From the sweep to the run's command line, and from there to its configuration."""
    run = make_run(["a=1"])
    run.folder = tmp_path
    run.prepare()
    run.config.logging.wandb_project = project
    given = SimpleNamespace(overrides=SimpleNamespace(task=run.arguments()))
    monkeypatch.setattr(train_script.HydraConfig, "get", lambda: given)
    assert train_script._changed(make_run([]).config).logging.wandb_project == project


def test_a_failure_of_before_is_forgotten_when_the_run_begins(tmp_path):
    """So that nothing tells it of a run that is killed the next time."""
    run = make_run(["a=1"])
    run.folder = tmp_path
    run.prepare()
    (tmp_path / "failed.txt").write_text("planted\n")
    with pytest.raises(ConfigError, match="cuda:77"):  # where there is no such device
        train(replace(run.config, device="cuda:77"), tmp_path)
    assert not (tmp_path / "failed.txt").exists()


def test_the_file_stops_a_sweep_of_one_run_at_a_time(here, tmp_path, monkeypatch):
    """The open run saves itself, and no other begins."""
    import equirl.training

    honest = equirl.training.train

    def stopped(config, folder, should_stop):
        def ask():
            if (folder / "checkpoint.pt").exists():
                (tmp_path / "stop").touch()
            return should_stop()

        return honest(config, folder, ask)

    monkeypatch.setattr(equirl.training, "train", stopped)
    sweep = ["--multirun", *TINY, "checkpoint_every=3", "seed=0,1", f"hydra.sweep.dir={tmp_path}"]
    code, out, err = here("train.py", *sweep)
    assert code == 130 and out.count("run folder") == 1 and "go on with the same command" in err
    monkeypatch.setattr(equirl.training, "train", honest)
    first, _ = sorted(tmp_path.glob("*seed-*"))
    with claim_folder(first):  # it still saves itself: the file is not taken away
        code, _, err = here("train.py", *sweep)
        assert code == 1 and "is still saving itself" in err and (tmp_path / "stop").exists()
    code, out, err = here("train.py", *sweep)
    assert code == 0 and "2 runs: 2 finished" in out and not (tmp_path / "stop").exists(), err


@pytest.mark.parametrize(
    ("launcher", "named"),
    [
        (["hydra.sweeper.max_batch_size=-1"], "hydra.sweeper.max_batch_size=-1: expected"),
        (["hydra/launcher=joblib", "hydra.launcher.n_jobs=0"], "hydra.launcher.n_jobs=0: expected"),
        (["hydra/launcher=ray", "hydra.launcher.cpus_per_run=0"], "cpus_per_run=0: expected"),
        (["hydra/launcher=slurm", "hydra.launcher.array_parallelism=0"], "array_parallelism=0: "),
    ],
)
def test_numbers_that_train_nothing_are_refused(here, launcher, named, tmp_path):
    sweep = ["--multirun", "preset=smoke", f"hydra.sweep.dir={tmp_path / 'sweep'}", "dry_run=true"]
    code, _, err = here("train.py", *sweep, *launcher)
    assert code == 1 and named in err and "Traceback" not in err


@pytest.mark.parametrize(
    ("folder", "told"),
    [
        ("outputs/experiments/fig12/paper", "the same command"),
        ("experiments/mine", "the same command and 'hydra.sweep.dir=\"experiments/mine\"'"),
    ],
)
def test_how_to_go_on(folder, told, tmp_path, monkeypatch):
    """Below a folder that happens to be called experiments, too."""
    root = tmp_path / "experiments"
    root.mkdir()
    monkeypatch.chdir(root)
    hydra = {"runtime": {"choices": {}}, "sweep": {"dir": str(root / folder)}}
    assert sweeping.go_on(OmegaConf.create({"hydra": hydra})) == told


def test_an_experiment_leaves_the_command_line_as_it_was(here):
    here("train.py", "+experiment=fig12", "preset=nonsense")
    assert sys.argv == ["train.py", "+experiment=fig12", "preset=nonsense"]
