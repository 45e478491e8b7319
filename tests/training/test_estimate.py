"""How long runs will take: the arithmetic, what is read from folders, what is measured."""

import math
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest

from equirl.analysis import read_table
from equirl.analysis.tables import write_table
from equirl.collectors import OnlineCollector
from equirl.config import save_config
from equirl.envs import ManipulationEnv
from equirl.training import estimate, timing, train
from equirl.training.estimate import Costs, Estimator, remaining_seconds
from equirl.training.learner import Learner

COSTS = Costs(demonstration=5.0, pretraining=0.25, step=2.0, evaluation=3.0)


def test_what_is_left_is_counted_part_by_part(small_config):
    config = small_config(
        steps=100,
        demos={"episodes": 7},
        method={"name": "ferm", "pretraining": 40},
        evaluation={"every": 30, "episodes": 4, "final_episodes": 11},
    )
    whole = 7 * 5.0 + 40 * 0.25 + 100 * 2.0 + (3 * 4 + 11) * 3.0
    assert remaining_seconds(config, COSTS) == pytest.approx(whole)
    # At step 65 the validations at 30 and 60 are done, that at 90 is not.
    assert remaining_seconds(config, COSTS, 65, begun=True) == pytest.approx(35 * 2 + 15 * 3)
    never = replace(config, evaluation=replace(config.evaluation, every=0))
    assert remaining_seconds(never, COSTS, 65, begun=True) == pytest.approx(35 * 2 + 11 * 3)


def test_demonstrations_from_a_file_take_no_episodes(small_config, tmp_path):
    config = small_config(demos={"episodes": 7, "file": str(tmp_path / "demos.hdf5")})
    plain = small_config(demos={"episodes": 0})
    assert remaining_seconds(config, COSTS) == remaining_seconds(plain, COSTS)


#: A run of which all parts are called often enough to be timed.
TIMED = {
    "steps": 40,
    "replay": {"start": 1},
    "evaluation": {"every": 40, "episodes": 2, "final_episodes": 1},
}


@pytest.mark.parametrize("algorithm", ["sac", "sacfd"])
def test_a_runs_own_times_add_up_to_its_clock(small_config, tmp_path, algorithm):
    """Read back from a run, the parts make up the minutes that the run itself took."""
    config = small_config(**TIMED, algorithm={"name": algorithm, "updates": 2})
    train(config, tmp_path)
    estimator = Estimator()
    estimator.read(tmp_path)
    costs = estimator.costs(config)
    assert not costs.measured
    timing = {name: column[-1] for name, column in read_table(tmp_path / "timing.csv").items()}
    # The row is written before the last checkpoint and the one test scene.
    seconds = 60 * timing["minutes"] + timing["checkpoint_ms"] / 1e3
    estimated = remaining_seconds(config, costs) - costs.evaluation
    assert estimated == pytest.approx(seconds, rel=1e-3)


@pytest.mark.parametrize("algorithm", ["sac", "sacfd"])
def test_what_is_measured_is_what_a_run_takes(small_config, tmp_path, monkeypatch, algorithm):
    """On a clock that only acting, steps of the simulator, updates and pre-training move."""
    now = [0.0]

    def lasting(owner, name, seconds):
        call = getattr(owner, name)

        def last(*arguments, **options):
            now[0] += seconds
            return call(*arguments, **options)

        monkeypatch.setattr(owner, name, last)

    lasting(OnlineCollector, "act", 0.05)
    lasting(ManipulationEnv, "_step", 0.1)
    lasting(Learner, "update", 1.0)
    lasting(Learner, "pretrain", 0.5)
    for module in (estimate, timing):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    config = small_config(
        **TIMED,
        algorithm={"name": algorithm, "updates": 2},
        demos={"episodes": 6},  # as many as are measured
        method={"name": "ferm", "pretraining": 5},
    )
    train(config, tmp_path)
    estimator = Estimator()
    measured = estimator.costs(config)
    estimator.read(tmp_path)
    run = estimator.costs(config)
    assert measured.measured and not run.measured
    assert measured.step == pytest.approx(0.05 + 0.1 + 2 * 1.0)
    assert measured.pretraining == pytest.approx(0.5)
    assert measured.demonstration > 0.1
    for part in ("step", "demonstration", "pretraining"):
        assert getattr(measured, part) == pytest.approx(getattr(run, part)), part


def parts_of(costs):
    """The parts that take time; all are seconds."""
    seconds = {name: value for name, value in asdict(costs).items() if name != "measured"}
    assert all(math.isfinite(value) and value >= 0 for value in seconds.values())
    return {name for name, value in seconds.items() if value}


def test_every_part_that_a_run_has_is_measured(small_config):
    """By one estimator, so that what it keeps of a run is nothing that the next one lacks."""
    estimator = Estimator()
    demonstrations = {"demonstration"}
    always = {"step", "evaluation"}
    for changes, parts in (
        ({"demos": {"episodes": 0}}, always),
        ({}, always | demonstrations),
        ({"method": {"name": "ferm"}}, always | demonstrations | {"pretraining"}),
    ):
        costs = estimator.costs(small_config(**changes))
        assert costs.measured and parts_of(costs) == parts, changes


ROW = {
    "step": 10, "minutes": 1, "act_ms": 2, "environment_ms": 30, "replay_ms": 4, "update_ms": 500,
    "checkpoint_ms": 10, "evaluation_ms": 6000, "demonstrations_ms": 70_000, "pretraining_ms": 800,
}  # fmt: skip


@pytest.fixture
def folder_of(tmp_path):
    """Writes what an estimator reads of a run's folder: its configuration and its times."""

    def write(config, **times):
        folder = tmp_path / str(len([*tmp_path.iterdir()]))
        folder.mkdir()
        save_config(config, folder / "config.yaml")
        write_table(folder / "timing.csv", [ROW | times])
        return folder

    return write


def test_parts_are_read_from_the_runs_that_have_them(small_config, folder_of):
    """A run without demonstrations tells how long a step takes, and nothing of the others."""
    whole = small_config(demos={"episodes": 20}, method={"name": "ferm", "pretraining": 40})
    bare = replace(whole, demos=replace(whole.demos, episodes=0))
    filed = replace(whole, demos=replace(whole.demos, file="demos.hdf5"))
    short = replace(whole, method=replace(whole.method, pretraining=0))
    step = 0.002 + 0.030 + 2 * 0.004 + 0.5 + 0.010 / 10
    estimator = Estimator()
    estimator.read(folder_of(bare, demonstrations_ms=0, pretraining_ms=0))
    assert estimator.costs(bare) == Costs(0.0, 0.0, pytest.approx(step), 6.0, measured=False)
    first = estimator.costs(whole)
    assert first.measured and parts_of(first) == parts_of(COSTS)
    assert (first.step, first.evaluation) == (pytest.approx(step), 6.0)
    # Read from a file, they take next to nothing; collected, they do.
    estimator.read(folder_of(filed, demonstrations_ms=1))
    assert estimator.costs(filed) == Costs(0.0, 0.8, pytest.approx(step), 6.0, measured=False)
    second = estimator.costs(whole)
    assert second.measured and second.demonstration == first.demonstration
    estimator.read(folder_of(short, pretraining_ms=0))
    known = Costs(3.5, 0.8, pytest.approx(step), 6.0, measured=False)
    assert estimator.costs(replace(whole, seed=5, steps=9)) == known
    estimator.read(folder_of(bare, demonstrations_ms=0, pretraining_ms=0))
    assert estimator.costs(whole) == known
    for changes in ({"group": "D4"}, {"method": {"name": "cnn"}}):  # other networks
        assert estimator.costs(small_config(**changes)).measured


def test_evaluations_that_measure_the_symmetry_take_times_of_their_own(small_config, folder_of):
    """What their runs tell is nothing of the others, nor the other way round."""
    plain = small_config(demos={"episodes": 0})
    thorough = replace(plain, evaluation=replace(plain.evaluation, equivariance=True))
    estimator = Estimator()
    estimator.read(folder_of(thorough, evaluation_ms=9000, demonstrations_ms=0))
    assert estimator.costs(plain).measured
    estimator.read(folder_of(plain, evaluation_ms=6000, demonstrations_ms=0))
    assert estimator.costs(plain).evaluation == 6.0
    assert estimator.costs(thorough).evaluation == 9.0


def test_a_folder_without_a_run_tells_nothing(small_config, tmp_path):
    estimator = Estimator()
    estimator.read(tmp_path / "missing")
    assert estimator.costs(small_config()).measured


@pytest.mark.parametrize(("row", "seen"), [(0.005, {8, 64}), (0.5, {8, 24})])
def test_slow_updates_are_timed_on_parts_of_a_batch(small_config, monkeypatch, row, seen):
    """On a clock that only updates move: 0.05 s each, and so much for each row of the batch."""
    now, rows = [0.0], []

    def work(self, batch):
        rows.append(len(batch))
        now[0] += 0.05 + row * len(batch)

    monkeypatch.setattr(Learner, "update", work)
    monkeypatch.setattr(Learner, "pretrain", work)
    monkeypatch.setattr(estimate, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    config = small_config(algorithm={"batch_size": 64, "updates": 2}, method={"name": "ferm"})
    costs = Estimator().costs(config)
    assert set(rows) == seen
    assert costs.step == pytest.approx(2 * (0.05 + row * 64))
    assert costs.pretraining == pytest.approx(0.05 + row * 64)
