"""The symmetry is measured while a run trains, on request, and the run is the same without."""

import math

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from equirl.analysis import read_table
from equirl.data import QuantizeDepth, make_replay_buffer
from equirl.modules import make_actor
from equirl.symmetry import random_observations
from equirl.training import CHECKPOINT, load_checkpoint, replay_observations
from equirl.training.equivariance import symmetry_errors
from tests.training.runs import assert_same, run
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
    ends = ("grid", "grid_max", "between", "between_max", "back")
    assert list(table) == ["step", *(f"{name}_{end}" for name in names for end in ends)]
    for name in names:  # C4, in single precision
        errors = zip(table[f"{name}_grid"], table[f"{name}_grid_max"], strict=True)
        assert all(0 < mean <= largest < 1e-3 for mean, largest in errors), name
        for end in ends[2:]:  # C4 has nothing else
            assert np.isnan(table[f"{name}_{end}"]).all()
    assert not (tmp_path / "without" / "symmetry.csv").exists()


def test_a_resumed_run_writes_the_same_rows(tmp_path, small_config):
    config = small_config(**MEASURED, algorithm={"averaging": 0.9}, method={"name": "cnn"})
    run(config, tmp_path / "whole")
    run(config, tmp_path / "parts", stop_after=13)
    with open(tmp_path / "parts" / "symmetry.csv", "a") as file:
        file.write("20" + 25 * ",1" + "\n24,1")  # later rows, of a run that was killed
    run(config, tmp_path / "parts")
    for table in ("metrics.csv", "validation.csv", "symmetry.csv"):
        assert (tmp_path / "parts" / table).read_bytes() == (
            tmp_path / "whole" / table
        ).read_bytes()
    table = read_table(tmp_path / "whole" / "symmetry.csv")
    assert min(table["mean_grid"]) > 1e-4  # no symmetry


@pytest.mark.parametrize(("group", "grid", "between"), [("C8", 3, 4), ("SO2", 3, 4), ("C3", 0, 2)])
def test_what_is_exact_and_what_is_interpolated_are_apart(group, grid, between):
    seen = random_observations(3, 16)
    network = make_actor(group, hidden=8, image_size=16).double()
    errors = symmetry_errors([network], group, seen)
    if grid:
        assert errors["mean_grid"] <= errors["mean_grid_max"] < 1e-9
    else:
        assert math.isnan(errors["mean_grid"]) and math.isnan(errors["mean_grid_max"])
    assert 1e-6 < errors["mean_between"] < errors["mean_between_max"]
    assert errors["mean_back"] > 1e-6
    # A network of no symmetry whose action errs by 2 at half a turn, by root 2 at quarter turns.
    action = torch.tensor([0.0, 1, 0, 0, 0])
    plain = TensorDictModule(lambda depth: action.expand(len(depth), 5), ["depth"], ["action"])
    errors = symmetry_errors([plain], group, seen)
    if grid:
        assert errors["action_grid"] == pytest.approx((2 + 2 + 2) / 3 / 5)
        assert errors["action_grid_max"] == 2
    assert errors["action_back"] == 0
    angles = [k * math.tau / (grid + between + 1) for k in range(1, grid + between + 1)]
    angles = [a for a in angles if not math.isclose(math.sin(2 * a), 0, abs_tol=1e-9)]
    assert len(angles) == between
    expected = [1 - math.cos(a) + abs(math.sin(a)) for a in angles]
    assert errors["action_between"] == pytest.approx(np.mean(expected) / 5)


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
