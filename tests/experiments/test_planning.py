"""The dry run's table: hours a person can read, and how long several at a time take."""

import pytest
from planning import makespan, print_plan

from equirl.training.estimate import Costs, Estimator
from tests.smoke.sweeps import make_run


def test_hours_are_told_without_powers_of_ten(tmp_path, monkeypatch, capsys):
    """Of runs of 800, 12.4, 2.46 and 0.0346 hours."""
    hours = {"0": 800, "1": 12.4, "2": 2.46, "3": 0.0346}
    runs = []
    for seed in hours:
        runs.append(make_run([f"seed={seed}"], seed=int(seed), steps=10))
        runs[-1].folder, runs[-1].label = tmp_path / seed, f"run {seed}"

    def costs(self, config):
        steps = 3600 * hours[str(config.seed)] / config.steps
        return Costs(demonstration=0, pretraining=0, step=steps, evaluation=0)

    monkeypatch.setattr(Estimator, "costs", costs)
    print_plan(runs, parallel=2)
    out = capsys.readouterr().out
    for seed, told in {"0": "800", "1": "12", "2": "2.5", "3": "0.035"}.items():
        assert f"| run {seed} | new | {told} | measured |" in out
    assert "left: 815 hours of runs, 800 with 2 at a time" in out


@pytest.mark.parametrize(
    ("hours", "parallel", "expected"),
    [([3, 1, 2], 1, 6), ([3, 1, 2], 2, 3), ([3, 1, 2, 4], 2, 7), ([3, 1], 4, 3), ([], 2, 0)],
)
def test_a_run_begins_when_a_place_is_free(hours, parallel, expected):
    assert makespan(hours, parallel) == expected
