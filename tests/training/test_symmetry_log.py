"""The symmetry is measured while a run trains, on request, and the run is the same without."""

import torch

from equirl.analysis import read_table
from equirl.data import QuantizeDepth, make_replay_buffer
from equirl.training import CHECKPOINT, load_checkpoint, replay_observations
from tests.training.test_resume import assert_same, run
from tests.transitions import transitions

MEASURED = {"evaluation": {"equivariance": True}}


def test_what_is_learned_does_not_depend_on_it(tmp_path, small_config):
    run(small_config(), tmp_path / "without")
    run(small_config(**MEASURED), tmp_path / "with")
    for table in ("metrics.csv", "validation.csv"):
        assert (tmp_path / "with" / table).read_bytes() == (
            tmp_path / "without" / table
        ).read_bytes()
    states = [load_checkpoint(tmp_path / name / CHECKPOINT) for name in ("without", "with")]
    for state in states:
        del state["clock"], state["config"]
    assert_same(*states)
    table = read_table(tmp_path / "with" / "symmetry.csv")
    assert table["step"] == [10, 20]
    names = ("mean", "sigma", "log_prob", "action", "q")
    assert list(table) == ["step", *(name + end for name in names for end in ("", "_max"))]
    for name in names:  # C4, in single precision
        errors = zip(table[name], table[f"{name}_max"], strict=True)
        assert all(0 < mean <= largest < 1e-3 for mean, largest in errors), name
    assert not (tmp_path / "without" / "symmetry.csv").exists()


def test_a_resumed_run_writes_the_same_rows(tmp_path, small_config):
    config = small_config(**MEASURED, algorithm={"averaging": 0.9}, method={"name": "cnn"})
    run(config, tmp_path / "whole")
    run(config, tmp_path / "parts", stop_after=13)
    with open(tmp_path / "parts" / "symmetry.csv", "a") as file:
        file.write("20,1,1,1,1,1,1,1,1,1,1\n24,1")  # later rows, of a run that was killed
    run(config, tmp_path / "parts")
    for table in ("metrics.csv", "validation.csv", "symmetry.csv"):
        assert (tmp_path / "parts" / table).read_bytes() == (
            tmp_path / "whole" / table
        ).read_bytes()
    assert min(read_table(tmp_path / "whole" / "symmetry.csv")["mean"]) > 1e-4  # no symmetry


def test_replay_observations_are_the_stored_ones_not_turned():
    stored = transitions(10)
    buffer = make_replay_buffer(100, copies=4, batch_size=4)
    buffer.extend(stored)
    rows = buffer.storage[: len(buffer)]
    seen = replay_observations(rows, 0.32, 4)
    assert set(seen.keys()) == {"depth", "holding", "action"} and len(seen) == 4
    picked = stored[[0, 3, 6, 9]]
    assert torch.equal(seen["action"], picked["action"])
    assert (seen["depth"] - picked["depth"]).abs().max() < 3e-6
    assert len(replay_observations(rows, 0.32, 50)) == 10
    assert rows["depth"].dtype == torch.int16  # the buffer itself is as it was
    assert torch.equal(QuantizeDepth(0.32)(rows.clone())["depth"][0], seen["depth"][0])
