"""A run stopped and resumed is the run never stopped, bit for bit."""

import shutil

import pytest
import torch

from equirl.training import CHECKPOINT, CheckpointError, load_checkpoint
from equirl.training.checkpoint import save_checkpoint
from tests.training.runs import assert_same_run, run


@pytest.mark.parametrize(
    ("stops", "changes"),
    [
        ((7,), {}),
        ((10, 17), {"algorithm": {"averaging": 0.9}}),
        (
            (13,),
            {
                "mode": "paper",
                "env": {"robot": "panda"},
                "replay": {"capacity": 75, "start": 40},  # 15 rows: the buffer wraps
            },
        ),
        ((5,), {"method": {"name": "cnn"}, "augmentation": {"name": "none"}}),
        # Stopped in the first and in a later episode of one heap, and between two.
        ((3, 8, 13), {"env": {"task": "clutter_grasping", "max_steps": 8}}),
    ],
)
def test_interrupted_run_equals_uninterrupted(tmp_path, small_config, stops, changes):
    config = small_config(**changes)
    run(config, tmp_path / "whole")
    for stop in stops:
        stopped = run(config, tmp_path / "parts", stop_after=stop)
        assert stopped.step == stop
    run(config, tmp_path / "parts")
    assert_same_run(tmp_path / "whole", tmp_path / "parts")


def test_n_steps_and_n_more_equal_2n(tmp_path, small_config):
    run(small_config(), tmp_path / "whole")
    run(small_config(steps=12), tmp_path / "parts")
    run(small_config(), tmp_path / "parts")
    assert_same_run(tmp_path / "whole", tmp_path / "parts")


def test_killed_run_goes_on_from_its_checkpoint_and_rewrites_rows(tmp_path, small_config):
    """A process killed after step 19 leaves the checkpoint of step 10 and later rows."""
    config = small_config()
    run(config, tmp_path / "whole")
    folder = tmp_path / "killed"
    run(config, folder, stop_after=10)
    kept = tmp_path / "kept.pt"
    shutil.copy(folder / CHECKPOINT, kept)
    run(config, folder, stop_after=19)
    shutil.copy(kept, folder / CHECKPOINT)
    with open(folder / "metrics.csv", "a") as file:
        file.write("23,9,1")  # a row the kill cut short
    run(config, folder)
    assert_same_run(tmp_path / "whole", folder)


def test_other_seed_other_run(tmp_path, small_config):
    run(small_config(), tmp_path / "a")
    run(small_config(seed=1), tmp_path / "b")
    assert (tmp_path / "a/metrics.csv").read_text() != (tmp_path / "b/metrics.csv").read_text()


def test_checkpoint_of_another_configuration_is_refused(tmp_path, small_config):
    run(small_config(), tmp_path / "a", stop_after=3)
    with pytest.raises(CheckpointError, match=r"group is C4 there and D4 here"):
        run(small_config(group="D4"), tmp_path / "a")


def test_damaged_checkpoint_is_named(tmp_path, small_config):
    run(small_config(), tmp_path / "a", stop_after=3)
    path = tmp_path / "a" / CHECKPOINT
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        run(small_config(), tmp_path / "a")


def test_checkpoints_load_without_executing_code(tmp_path):
    class Payload:
        def __reduce__(self):
            return print, ("executed",)

    path = tmp_path / "evil.pt"
    torch.save({"format": 3, "payload": Payload()}, path)
    with pytest.raises(CheckpointError):
        load_checkpoint(path)


def test_a_failed_write_keeps_the_previous_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / CHECKPOINT
    save_checkpoint({"step": 1}, path)

    def full(state, file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(CheckpointError, match=r"No space left.*previous file is kept"):
        save_checkpoint({"step": 2}, path)
    assert load_checkpoint(path)["step"] == 1
    assert [file.name for file in tmp_path.iterdir()] == [CHECKPOINT]
