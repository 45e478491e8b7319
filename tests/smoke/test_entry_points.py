"""Every entry point end to end, as a user calls it."""

import csv
import signal
import time
from pathlib import Path

import pytest

from equirl.envs.tasks import TASKS
from tests.commands import SMOKE, call, start


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """The folder of a finished run, which also logs to wandb and TensorBoard."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    trackers = ["logging.wandb=true", "logging.tensorboard=true"]
    code, out, err = call("train.py", *SMOKE, *trackers, f"output={folder}")
    assert code == 0, err
    assert "episodes succeed" in out and str(folder / "report.md") in out
    return folder


def test_training_leaves_a_folder_worth_opening(finished):
    report = (finished / "report.md").read_text()
    assert "success" in report and "curves.png" in report and "policy.mp4" in report
    assert (finished / "curves.png").read_bytes()[:4] == b"\x89PNG"
    assert (finished / "policy.mp4").stat().st_size > 1000
    for table, rows in (("metrics.csv", 2), ("validation.csv", 2), ("test.csv", 3)):
        with open(finished / table) as file:
            assert len(list(csv.DictReader(file))) >= rows, table
    assert "group: C4" in (finished / "config.yaml").read_text()
    assert list(finished.glob("wandb/offline-run-*"))
    assert list(finished.glob("tensorboard/**/events*"))


@pytest.mark.parametrize("task", sorted(name for name in TASKS if name != "block_picking"))
def test_every_task_trains(here, task, tmp_path):
    options = ["env.options.lift_height=0.12"] if task == "clutter_grasping" else []
    code, out, err = here("train.py", *SMOKE, f"env={task}", *options, f"output={tmp_path / task}")
    assert code == 0, err
    assert "of 3 episodes succeed" in out
    with open(tmp_path / task / "metrics.csv") as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["loss_qvalue"]) > 0 and float(last["loss_actor"]) != 0
    config = (tmp_path / task / "config.yaml").read_text()
    assert f"task: {task}" in config and (not options or "lift_height: 0.12" in config)


def test_an_impossible_scene_ends_in_one_sentence(here, tmp_path):
    arguments = ["env=block_pushing", "env.options.goal_distance=0.9", f"output={tmp_path / 'run'}"]
    code, _, err = here("train.py", *SMOKE, *arguments)
    assert code == 1 and "no place in 20000 tries for a goal" in err and "Traceback" not in err
    arguments = ["env=block_pushing", "env.options.goal_sides=0.1", f"output={tmp_path / 'run'}"]
    code, _, err = here("train.py", *SMOKE, *arguments)
    assert code == 1 and "env.options: BlockPushing has no option goal_sides" in err


def test_evaluation_of_a_finished_run(here, finished, tmp_path):
    film = tmp_path / "film.mp4"
    code, out, err = here("evaluate.py", f"run={finished}", "episodes=2", f"video={film}")
    assert code == 0, err
    assert "of 2 episodes succeed" in out and "95 % confidence interval" in out
    assert film.stat().st_size > 1000


def test_a_killed_run_resumes_to_the_run_never_killed(tmp_path):
    common = [*SMOKE, "steps=200", "evaluation.every=100", "evaluation.video_episodes=0"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    process = start("train.py", *common, f"output={killed}")
    deadline = time.monotonic() + 120
    while not (killed / "checkpoint.pt").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.communicate()
    assert not (killed / "report.md").exists()
    for arguments in ([f"resume={killed}"], [*common, f"output={whole}"]):
        code, _, err = call("train.py", *arguments)
        assert code == 0, err
    for table in ("metrics.csv", "validation.csv", "test.csv"):
        assert (killed / table).read_bytes() == (whole / table).read_bytes(), table


def test_interrupt_stops_with_a_checkpoint_and_resume_goes_on(tmp_path):
    folder = tmp_path / "run"
    process = start("train.py", *SMOKE, "steps=100000", f"output={folder}")
    deadline = time.monotonic() + 120
    while not (folder / "metrics.csv").exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and str(folder) in err and "Traceback" not in err, err
    with open(folder / "metrics.csv") as file:
        step = int(list(csv.DictReader(file))[-1]["step"])
    code, _, err = call("train.py", f"resume={folder}", "seed=3")
    assert code == 1 and "seed=3: a run is resumed with its own configuration" in err
    shorter = [f"steps={step + 20}", "logging.progress=true"]
    code, out, err = call("train.py", f"resume={folder}", *shorter)
    assert code == 0, err
    assert "episodes succeed" in out
    assert "return=" in err and "greedy=" in err and "update=" in err  # the progress bar
    with open(folder / "metrics.csv") as file:
        steps = [int(row["step"]) for row in csv.DictReader(file)]
    assert steps == sorted(set(steps)) and steps[-1] <= step + 20


def test_multirun_over_groups_and_copies(here, tmp_path):
    code, _, err = here(
        "train.py",
        "--multirun",
        *(key for key in SMOKE if not key.startswith("group")),
        "group=c4,d4",
        "augmentation.copies=0,2",
        "steps=6",
        "demos.episodes=1",
        "evaluation.final_episodes=1",
        "evaluation.video_episodes=0",
        f"hydra.sweep.dir={tmp_path}",
    )
    assert code == 0, err
    reports = list(tmp_path.glob("*/report.md"))
    assert len(reports) == 4
    configs = "".join((report.parent / "config.yaml").read_text() for report in reports)
    assert configs.count("group: D4") == 2 and configs.count("copies: 0") == 2
    code, out, err = here("evaluate.py", f"run={reports[0].parent}", "episodes=1")
    assert code == 0 and "of 1 episodes succeed" in out, err
    code, out, err = here("compare.py", str(tmp_path / "comparison"), str(tmp_path))
    assert code == 0 and "| augmentation.copies=2, group=D4 |" in out, err
    assert all(f"| {report.parent.name} |" in out for report in reports)


def test_cnn_baseline(here, tmp_path):
    code, out, err = here("train.py", *SMOKE, "method=cnn", "steps=6", f"output={tmp_path}/cnn")
    assert code == 0, err
    assert "CNN SAC" in (tmp_path / "cnn" / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["group=so3"], "group=so3"),
        (["method=resnet"], "method=resnet: expected one of cnn, drq"),
        (["algorithm=ppo"], "algorithm=ppo: expected one of sac, sacfd"),
        (["env=block_stacking"], "block_stacking"),
        (["env.image_size=100"], "image_size=100 is not supported: expected one of 16, 32, 64"),
        (["colour=red"], "colour"),
        (["device=cuda:7"], "device=cuda:7"),
        (["env.max_steps=3"], "failed 20 episodes in a row"),
        (["--multirun", "output=x"], "a multirun makes a folder for each"),
        (["resume=/nonexistent"], "/nonexistent"),
        (["output=/proc/none"], "/proc/none"),
    ],
)
def test_bad_input_ends_in_a_sentence_that_names_it(here, arguments, named, tmp_path, monkeypatch):
    if arguments[0].startswith("--"):  # flags come before keys
        arguments = [arguments[0], *SMOKE, *arguments[1:]]
    elif not arguments[0].startswith("resume="):
        arguments = [*SMOKE, *arguments]
    monkeypatch.chdir(tmp_path)
    code, _, err = here("train.py", *arguments)
    assert code != 0
    assert named in err and "Traceback" not in err


def test_comparison_of_runs(here, finished, tmp_path):
    groups = [f"D4={finished},{finished}", f"CNN={finished}"]
    code, out, err = here("compare.py", str(tmp_path / "out"), *groups)
    assert code == 0, err
    assert out.count("/3 |") == 3 and "| CNN | finished |" in out
    assert (tmp_path / "out" / "curves.png").read_bytes()[:4] == b"\x89PNG"
    code, _, err = here("compare.py", str(tmp_path / "out"), "D4=/nonexistent")
    assert code != 0 and "/nonexistent is not the folder of a finished run" in err
