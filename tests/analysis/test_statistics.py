"""Statistics of runs."""

import numpy as np
import pytest

from equirl import analysis
from equirl.analysis import moving_return, wilson_interval
from equirl.analysis.statistics import (
    count_collapses,
    first_reaching,
    interquartile_mean,
    mean_and_error,
    stratified_interval,
)


def test_wilson_interval_equals_the_closed_form():
    successes, trials, z = 93, 100, 1.959964
    p = successes / trials
    centre = (p + z**2 / (2 * trials)) / (1 + z**2 / trials)
    spread = z / (1 + z**2 / trials) * np.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2))
    assert wilson_interval(93, 100) == pytest.approx((centre - spread, centre + spread), abs=1e-6)


def test_wilson_interval_stays_inside_at_the_ends():
    assert wilson_interval(0, 20)[0] == 0 and wilson_interval(20, 20)[1] == 1
    assert wilson_interval(20, 20)[0] > 0.8


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 5), (0, 0)])
def test_wilson_interval_refuses_impossible_counts(successes, trials):
    with pytest.raises(ValueError, match=f"got {successes} of {trials}"):
        wilson_interval(successes, trials)


def test_moving_return_averages_the_window_only():
    steps, returns = np.array([100, 300, 500, 700, 1200]), np.array([0.0, 1.0, 0.5, 1.0, 0.0])
    expected = [0, 0.5, 0.5, (1 + 0.5 + 1) / 3, 0.0]
    np.testing.assert_allclose(moving_return(steps, returns, window=500), expected)


def test_moving_return_at_steps_of_its_own():
    steps, returns = np.array([100, 300, 500]), np.array([0.0, 1.0, 0.5])
    found = moving_return(steps, returns, window=200, at=np.array([50, 100, 299, 300, 301, 900]))
    np.testing.assert_allclose(found, [np.nan, 0, 0, 1, 1, np.nan])


def test_standard_error_is_that_of_the_mean():
    mean, error = mean_and_error(np.array([[0.1, 1.0], [0.2, 1.0], [0.6, 1.0]]))
    # Deviations -0.2, -0.1 and 0.3 from 0.3: variance (0.04 + 0.01 + 0.09) / 2 = 0.07.
    np.testing.assert_allclose(mean, [0.3, 1.0])
    np.testing.assert_allclose(error, [np.sqrt(0.07 / 3), 0.0])
    single, unknown = mean_and_error(np.array([[0.5]]))
    assert single[0] == 0.5 and np.isnan(unknown[0])


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.0, 0.4, 0.6, 1.0], 0.5),  # one of four at either end is left out
        ([0.0, 0.1, 0.9], 1 / 3),  # none of three
        ([5, 0, 1, 2, 3, 4, 90, -90], 2.5),
        ([0.7], 0.7),
    ],
)
def test_interquartile_mean_by_hand(values, expected):
    assert interquartile_mean(values) == pytest.approx(expected)


#: Success of four runs on three tasks.
SCORES = np.array([[0.10, 0.55, 0.92], [0.20, 0.60, 0.95], [0.35, 0.40, 0.99], [0.05, 0.75, 0.90]])


def test_the_interval_is_that_of_rliable():
    """The numbers are those of rliable 1.2.0, 20,000 resamples of two seeds."""
    assert interquartile_mean(SCORES) == pytest.approx(0.5916667, abs=1e-6)
    low, high = stratified_interval(list(SCORES.T), resamples=20000)
    assert low == pytest.approx(0.5, abs=0.01) and high == pytest.approx(0.671, abs=0.01)


def test_the_interval_is_drawn_within_tasks_by_a_seed():
    tasks = [[0.0] * 4, [0.5] * 4, [1.0] * 4]
    assert stratified_interval(tasks) == (0.5, 0.5)  # across tasks they would spread
    assert stratified_interval([[0.0, 0.5, 1.0]]) == stratified_interval([[0.0, 0.5, 1.0]])
    unequal = stratified_interval([[0.0, 0.2], [0.7, 0.9, 1.0]])
    assert unequal is not None and 0 < unequal[0] < unequal[1] < 1
    assert stratified_interval([[0.1, 0.2], [0.7]]) is None and stratified_interval([]) is None


def test_the_interval_covers_the_true_mean_about_as_often_as_it_says():
    """Of 12 runs a percentile interval at 95 % covers in 85 to 97 % of the experiments."""
    generator = np.random.default_rng(0)
    covered = [
        low <= 0.5 <= high
        for _ in range(200)
        for low, high in [
            stratified_interval(generator.normal(0.5, 0.1, (2, 6)).tolist(), resamples=400)
        ]
    ]
    assert 0.85 <= np.mean(covered) <= 0.97


def test_what_a_sweep_is_read_and_drawn_with_is_public():
    """And so in the reference, which is made of what the package lists."""
    names = {"read_runs", "collect", "summarise", "draw_sweep", "plot_sweep"}
    assert names | {"interquartile_mean", "stratified_interval"} <= set(analysis.__all__)


@pytest.mark.parametrize(
    ("values", "count"),
    [
        ([], 0),
        ([0.0, 0.39, 0.79, 0.0], 0),  # never up
        ([0.8, 0.4, 0.8], 0),
        ([0.8, 0.6, 0.39, 0.1, 0.3], 1),
        ([0.8, 0.1, 0.79, 0.1], 1),  # not back in between
        ([1.0, 0.0, 1.0, 0.0, 1.0], 2),
    ],
)
def test_collapses(values, count):
    assert count_collapses(values) == count


def test_first_reaching():
    assert first_reaching([100, 200, 300], [0.5, 0.9, 1.0], 0.9) == 200
    assert first_reaching([100, 200], [0.5, 0.89], 0.9) is None
    assert first_reaching([], [], 0.9) is None
