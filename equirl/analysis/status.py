"""How far runs are: from the ends of their files, while they are written or later."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from equirl.analysis.runs import FAILED, LOCK, METRICS, TEST, TIMING, VALIDATION, Run

__all__ = ["STATES", "Status", "Totals", "is_locked", "read_status", "total"]

#: What a run can be, in the order of a summary.
STATES = ("running", "finished", "failed", "stopped", "waiting")

_TAIL = 1 << 16  # bytes at the end of a table: more than 500 steps, and than two validations


@dataclass(frozen=True)
class Status:
    """How far a run is.

    Attributes:
        run: The run.
        state: ``"running"`` (a process holds its lock), ``"finished"``, ``"failed"``,
            ``"stopped"`` or, if nothing was trained yet, ``"waiting"``.
        reason: Why it failed, or why its folder cannot be read; empty otherwise.
        step: Environment steps made, as far as its tables tell.
        last_return: Mean discounted return of the episodes that ended in the last 500 of them.
        success: Greedy success, in the last validation; on the test scenes, once finished.
        speed: Steps a minute, between the last two validations; evaluation counts, too.
    """

    run: Run
    state: str
    reason: str = ""
    step: int = 0
    last_return: float | None = None
    success: float | None = None
    speed: float | None = None

    @property
    def minutes_left(self) -> float | None:
        """Until the last step at the present speed; None when that cannot be told."""
        if self.state == "finished":
            return 0.0
        if not self.speed or not self.run.steps:
            return None
        return max(self.run.steps - self.step, 0) / self.speed


@dataclass(frozen=True)
class Totals:
    """How far a sweep is.

    Attributes:
        counts: Runs in each state, in the order of `STATES`; those without any left out.
        planned: Runs that its last command makes, at least those there are.
        step: Steps made.
        steps: Steps to make, by the runs that have begun.
        minutes_left: Of all planned runs, one after the other, at the speed of those there are;
            while some run, without those that have failed, which their command passes by. None
            when none has a speed.
        parallel: Runs at present.
    """

    counts: dict[str, int]
    planned: int
    step: int
    steps: int
    minutes_left: float | None
    parallel: int


def read_status(run: Run) -> Status:
    """Looks how far a run is, without disturbing it."""
    metrics = _last_rows(run.folder / METRICS)
    timing = _last_rows(run.folder / TIMING)
    validation = _last_rows(run.folder / VALIDATION)
    step = max((row["step"] for rows in (metrics, timing) for row in rows[-1:]), default=0.0)
    finished, running = run.is_finished, is_locked(run.folder / LOCK)
    recent = [
        row["discounted_return"]
        for row in metrics
        if row["step"] > step - 500 and "discounted_return" in row
    ]
    success = validation[-1].get("success_rate") if validation else None
    reason = run.damage
    if running:
        state = "running"
    elif finished:
        state, step = "finished", max(step, run.steps)
        rows = _last_rows(run.folder / TEST, tail=None)
        played = [row["success"] for row in rows if "success" in row]
        success = sum(played) / len(played) if played else success
    elif (run.folder / FAILED).exists() or run.damage:
        state, reason = "failed", _reason(run.folder / FAILED) or run.damage
    else:
        state = "stopped" if step else "waiting"
    return Status(
        run,
        state,
        reason,
        int(step),
        sum(recent) / len(recent) if recent else None,
        success,
        _speed(timing),
    )


def total(statuses: Sequence[Status], planned: int | None = None) -> Totals:
    """Sums up a sweep.

    Args:
        statuses: Of its runs.
        planned: Runs that its command makes, if that is known.
    """
    known = [status.state for status in statuses]
    begun = [status for status in statuses if status.run.steps]
    running = known.count("running")
    lost = known.count("failed") if running else 0
    tried = [status for status in begun if not (lost and status.state == "failed")]
    steps = sum(status.run.steps for status in begun)
    planned = max(planned or 0, len(statuses))
    speeds = [status.speed for status in begun if status.speed]
    mean = sum(speeds) / len(speeds) if speeds else None
    left = None
    if mean and begun:
        own = [max(each.run.steps - each.step, 0) / (each.speed or mean) for each in tried]
        left = sum(own) + (planned - lost - len(tried)) * (steps / len(begun)) / mean
    return Totals(
        {state: known.count(state) for state in STATES if state in known},
        planned,
        sum(status.step for status in begun),
        steps,
        left,
        running,
    )


def is_locked(path: Path) -> bool:
    """Whether a process trains in a folder: it holds the lock as long as it lives.

    A shared lock is asked for, and given back at once: a run that is there notices nothing, and
    one that begins at this moment tries again.

    Args:
        path: The folder's file ``.lock``, which need not exist.
    """
    try:
        lock = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    finally:
        os.close(lock)
    return False


def _reason(path: Path) -> str:
    """The last line of what a failed run left: of a traceback, the error."""
    try:
        lines = path.read_text(errors="replace").split("\n")
    except OSError:
        return ""
    return next((line.strip() for line in reversed(lines) if line.strip()), "unknown reason")


def _speed(timing: Sequence[dict[str, float]]) -> float | None:
    """Steps a minute between the last two rows, or up to the only one."""
    rows = [row for row in timing if "minutes" in row][-2:]
    if not rows:
        return None
    first = rows[0] if len(rows) > 1 else {"step": 0.0, "minutes": 0.0}
    minutes = rows[-1]["minutes"] - first["minutes"]
    return (rows[-1]["step"] - first["step"]) / minutes if minutes > 0 else None


def _last_rows(path: Path, tail: int | None = _TAIL) -> list[dict[str, float]]:
    """The whole rows in the last bytes of a table, or all; one that is no table has none."""
    try:
        with open(path, "rb") as file:
            names = file.readline().decode(errors="replace").strip().split(",")
            begin = file.tell()
            cut = begin if tail is None else max(begin, os.fstat(file.fileno()).st_size - tail)
            file.seek(cut)
            lines = file.read().decode(errors="replace").split("\n")[:-1]
    except OSError:
        return []
    rows = []
    for line in lines[1:] if cut > begin else lines:
        try:
            values = [float(cell) for cell in line.split(",")]
            rows.append(dict(zip(names, values, strict=True)))
        except ValueError:  # told by what reads whole tables
            continue
    return rows if not names or "step" in names or path.name == TEST else []
