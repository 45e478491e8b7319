"""Statistics of runs."""

import numpy as np
import pytest

from equirl.analysis import moving_return, wilson_interval


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
