"""What a sweep still has to do, with hours on this machine: the dry run."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from sweeping import Run

__all__ = ["count_states", "makespan", "print_plan"]


def count_states(runs: Sequence[Run]) -> str:
    """How many runs are finished, begun, ... in one line."""
    counts = Counter(run.state for run in runs)
    names = ("finished", "running", "begun", "failed", "new")
    shown = ", ".join(f"{counts[name]} {name}" for name in names if counts[name])
    return f"{len(runs)} {'runs' if len(runs) > 1 else 'run'}: {shown}"


def makespan(hours: Sequence[float], parallel: int) -> float:
    """Hours until all are done, when each begins as soon as one of ``parallel`` places is free."""
    places = [0.0] * parallel
    for each in hours:
        heapq.heapreplace(places, places[0] + each)
    return max(places)


def print_plan(runs: Sequence[Run], *, parallel: int = 1, threads: int = 0) -> None:
    """Prints a row a run: what differs, how far it is, and the hours left; then the total.

    Args:
        runs: Of a sweep, looked at.
        parallel: How many are trained at a time.
        threads: Of each run that does not ask for a number; 0: as the run itself takes.
    """
    from equirl.analysis.tables import markdown_row, markdown_table
    from equirl.training.estimate import Estimator, remaining_seconds

    print("timing the parts of each kind of run ...", flush=True)
    estimator = Estimator()
    for run in runs:
        estimator.read(run.folder)
    print(markdown_table(["run", "state", "hours", "from"], []))
    hours = []
    for run in runs:
        config = replace(run.config, threads=run.config.threads or threads)
        left, source = 0.0, ""
        if run.state != "finished":
            costs = estimator.costs(config)
            left = remaining_seconds(config, costs, run.step, begun=run.step > 0) / 3600
            source = "measured" if costs.measured else "like runs"
        hours.append(left)
        print(markdown_row([str(run), run.describe(), _hours(left), source]), flush=True)
    total, last = sum(hours), makespan(hours, parallel)
    print(
        f"\n{count_states(runs)}\n"
        f"left: {_hours(total)} hours of runs, {_hours(last)} with {parallel} at a time"
    )


def _hours(hours: float) -> str:
    """Two digits of a few hours; of many all, with no power of ten."""
    return f"{hours:.0f}" if hours >= 10 else f"{hours:.2g}"
