"""Statistics of runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

__all__ = [
    "count_collapses",
    "first_reaching",
    "interquartile_mean",
    "mean_and_error",
    "moving_return",
    "stratified_interval",
    "wilson_interval",
]


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


def moving_return(
    steps: np.ndarray, returns: np.ndarray, window: int = 500, at: np.ndarray | None = None
) -> np.ndarray:
    """Mean return of the episodes that ended in the previous ``window`` steps.

    The statistic of the paper's learning curves (appendix F).

    Args:
        steps: Training step at which each episode ended, ascending, shape (E,).
        returns: Each episode's discounted return, shape (E,).
        window: Steps to look back.
        at: Steps to look back from, shape (S,); the episodes' ends when None.

    Returns:
        Shape (S,), or (E,): the mean over the window that ends there, NaN where no episode
        ended in it.
    """
    at = steps if at is None else at
    sums = np.concatenate([[0.0], np.cumsum(returns)])
    first = np.searchsorted(steps, at - window, side="right")
    last = np.searchsorted(steps, at, side="right")
    counts = last - first
    means = (sums[last] - sums[first]) / np.maximum(counts, 1)
    return np.where(counts > 0, means, np.nan)


def mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over runs and its standard error, the deviation over sqrt(n), of n - 1 degrees.

    Args:
        values: One row a run, shape (n, ...), n at least 1.

    Returns:
        Mean and error, each of shape (...); the error is NaN for a single run.
    """
    values = np.asarray(values, dtype=float)
    count = len(values)
    if count < 2:
        return values.mean(axis=0), np.full(values.shape[1:], np.nan)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(count)


def interquartile_mean(values: Sequence[float] | np.ndarray) -> float:
    """Mean of the middle half (IQM): a quarter of the values is cut off at either end.

    Of n values floor(n / 4) are left out at either end, as in rliable (Agarwal et al., 2021).

    Args:
        values: Those of all runs, of one task or of several; at least one.
    """
    from scipy.stats import trim_mean

    return float(trim_mean(np.asarray(values, dtype=float), 0.25, axis=None))


def stratified_interval(
    strata: Sequence[Sequence[float]], *, resamples: int = 5000, seed: int = 0
) -> tuple[float, float] | None:
    """Stratified bootstrap interval of the interquartile mean at 95 % confidence.

    Runs are drawn anew with replacement within each stratum (a task), the interquartile mean
    is taken of all of them together, and the interval goes from the 2.5th to the 97.5th
    percentile: the method of Agarwal et al. (2021). Strata may hold different numbers of runs,
    as those of a sweep that still runs do.

    Args:
        strata: The values of the runs of each task.
        resamples: Bootstrap samples.
        seed: Of their drawing; the same values have the same interval.

    Returns:
        Lower and upper bound; None where a stratum has a single run, which says nothing about
        the spread, or there are no strata.
    """
    if not strata or min(map(len, strata)) < 2:
        return None
    from scipy.stats import bootstrap, trim_mean

    def statistic(*samples: np.ndarray, axis: int) -> np.ndarray:
        return trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)

    low, high = bootstrap(
        tuple(np.asarray(values, dtype=float) for values in strata),
        statistic,
        method="percentile",
        confidence_level=0.95,
        n_resamples=resamples,
        random_state=np.random.default_rng(seed),
    ).confidence_interval
    return float(low), float(high)


def first_reaching(steps: Iterable[float], values: Iterable[float], level: float) -> float | None:
    """The first of the steps at which the value is ``level`` or more; None if there is none."""
    pairs = zip(steps, values, strict=True)
    return next((step for step, value in pairs if value >= level), None)


def count_collapses(values: Iterable[float], high: float = 0.8, low: float = 0.4) -> int:
    """How often a curve that had ``high`` or more fell below ``low``.

    Args:
        values: Success rates of validations, in the order of their steps.
        high: A curve is up from this rate on, 0 to 1.
        low: A curve that was up and is below this has collapsed.

    Returns:
        A number; a curve has to be up again before it can collapse again.
    """
    count, up = 0, False
    for value in values:
        if value >= high:
            up = True
        elif value < low and up:
            count, up = count + 1, False
    return count
