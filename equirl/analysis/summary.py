"""The final table of a sweep: success on test scenes with its statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equirl.analysis.labels import task_name
from equirl.analysis.statistics import (
    count_collapses,
    first_reaching,
    interquartile_mean,
    mean_and_error,
    stratified_interval,
)
from equirl.analysis.sweep import Sweep

__all__ = ["ALL_TASKS", "COLUMNS", "SOLVED", "Summary", "summarise"]

ALL_TASKS = "all tasks"

#: The success rate of a validation at which a task counts as solved.
SOLVED = 0.9

#: Headings of the table for readers.
COLUMNS = (
    *("task", "variant", "runs finished", "success", "IQM", "95 % interval"),
    *("steps to 90 %", "collapses", "return", "at step"),
)


@dataclass(frozen=True)
class Summary:
    """A line of the table: a variant on one task, or on all.

    Attributes:
        task: The task's name, or ``"all tasks"``.
        variant: The label.
        runs: Runs that have begun.
        finished: Those of them that are finished; the success is theirs.
        success: Mean success rate on the test scenes; over all tasks, of their means. NaN
            without a finished run, as all below.
        error: Its standard error over runs; over all tasks, from those of the tasks.
        iqm: Interquartile mean over runs, and over tasks.
        low: Lower end of its stratified bootstrap interval.
        high: Upper end.
        reached: Runs whose validation reached 90 %.
        steps_to_90: The median over runs of the first step at which it did, a run that did not
            standing after all others; NaN when half of them or more did not.
        collapses: How often the success of their validations fell from 80 % or more below 40 %.
        discounted_return: Of the behaviour policy, where its curve ends.
        return_error: Its standard error over runs.
        step: Where that is.
    """

    task: str
    variant: str
    runs: int
    finished: int
    success: float
    error: float
    iqm: float
    low: float
    high: float
    reached: int
    steps_to_90: float
    collapses: int
    discounted_return: float
    return_error: float
    step: float

    def cells(self) -> list[str]:
        """The line for readers, under `COLUMNS`."""
        interval = f"{self.low:.1%} to {self.high:.1%}" if self.low == self.low else "-"
        reached = f"{self.reached} of {self.runs} runs"
        if self.steps_to_90 == self.steps_to_90:
            all_of_them = self.reached == self.runs
            reached = f"{self.steps_to_90:.0f}" + ("" if all_of_them else f" ({reached})")
        return [
            *(self.task, self.variant, f"{self.finished} of {self.runs}"),
            _with_error(self.success, self.error, percent=True),
            f"{self.iqm:.1%}" if self.finished else "-",
            interval,
            reached,
            str(self.collapses),
            _with_error(self.discounted_return, self.return_error),
            f"{self.step:.0f}" if self.step == self.step else "-",
        ]


def summarise(sweep: Sweep, *, window: int = 500) -> list[Summary]:
    """The lines of the table: each variant on each task, then on all if there are several.

    A line over all tasks needs equally many finished runs of each, or the tasks that have more of
    them would make it look better or worse than it is.

    Args:
        sweep: Its runs.
        window: Steps that a return is averaged over.
    """
    lines = [
        _on_task(sweep, task, variant, window)
        for task in sweep.tasks
        for variant in sweep.variants
        if (task, variant) in sweep.cells
    ]
    if len(sweep.tasks) > 1:
        for variant in sweep.variants:
            own = [line for line in lines if line.variant == variant]
            even = len(own) == len(sweep.tasks) and len({line.finished for line in own}) == 1
            if even and own[0].finished:
                lines.append(_on_all(sweep, variant, own))
    return lines


def _on_task(sweep: Sweep, task: str, variant: str, window: int) -> Summary:
    tables = sweep.cells[task, variant]
    reached = [
        np.inf if first is None else first
        for each in tables
        for first in [first_reaching(each.validation_steps, each.validation_success, SOLVED)]
    ]
    curve = sweep.returns(task, variant, window)
    name = task_name(task)
    tail = (curve.mean[-1], curve.error[-1], curve.steps[-1]) if curve else (np.nan,) * 3
    collapses = sum(count_collapses(each.validation_success) for each in tables)
    return _line(name, variant, len(tables), [sweep.test(task, variant)], reached, collapses, tail)


def _on_all(sweep: Sweep, variant: str, own: Sequence[Summary]) -> Summary:
    strata = [sweep.test(task, variant) for task in sweep.tasks]
    runs, collapses = sum(each.runs for each in own), sum(each.collapses for each in own)
    line = _line(ALL_TASKS, variant, runs, strata, [], collapses, (np.nan,) * 3)
    mean = float(np.mean([each.success for each in own]))
    error = float(np.sqrt(np.sum([each.error**2 for each in own])) / len(own))
    reached = sum(each.reached for each in own)
    return replace(line, success=mean, error=error, reached=reached)


def _line(
    task: str,
    variant: str,
    runs: int,
    strata: Sequence[Sequence[float]],
    reached: Sequence[float],
    collapses: int,
    tail: Sequence[float],
) -> Summary:
    values = [value for stratum in strata for value in stratum]
    mean, error = map(float, mean_and_error(np.array(values))) if values else (np.nan, np.nan)
    low, high = stratified_interval(strata) or (np.nan, np.nan)
    # Of an even number the later of the middle two, so that infinity is never averaged.
    middle = sorted(reached)[len(reached) // 2] if reached else np.inf
    return Summary(
        task=task,
        variant=variant,
        runs=runs,
        finished=len(values),
        success=mean,
        error=error,
        iqm=interquartile_mean(values) if values else np.nan,
        low=low,
        high=high,
        reached=int(np.isfinite(reached).sum()),
        steps_to_90=float(middle) if np.isfinite(middle) else np.nan,
        collapses=collapses,
        discounted_return=float(tail[0]),
        return_error=float(tail[1]),
        step=float(tail[2]),
    )


def _with_error(mean: float, error: float, *, percent: bool = False) -> str:
    if mean != mean:
        return "-"
    form = ".1%" if percent else ".3f"
    if error != error:
        return format(mean, form)
    return f"{format(mean, form)} ± {format(error, form)}"
