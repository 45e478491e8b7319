"""Statistics of runs."""

from __future__ import annotations

import numpy as np

__all__ = ["moving_return", "wilson_interval"]


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's score interval of a success rate at 95 % confidence (Wilson, 1927).

    Args:
        successes: Number of successes.
        trials: Number of trials, at least 1.

    Returns:
        Lower and upper bound.

    Raises:
        ValueError: No trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"expected 0 <= successes <= trials >= 1, got {successes} of {trials}")
    from scipy.stats import binomtest

    interval = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def moving_return(steps: np.ndarray, returns: np.ndarray, window: int = 500) -> np.ndarray:
    """Mean return of the episodes that ended in the previous ``window`` steps.

    The statistic of the paper's learning curves (appendix F).

    Args:
        steps: Training step at which each episode ended, ascending, shape (E,).
        returns: Each episode's discounted return, shape (E,).
        window: Steps to look back.

    Returns:
        Shape (E,): at each episode's end, the mean over the window before it.
    """
    sums = np.concatenate([[0.0], np.cumsum(returns)])
    first = np.searchsorted(steps, steps - window, side="right")
    last = np.arange(1, len(steps) + 1)
    return (sums[last] - sums[first]) / np.maximum(last - first, 1)
