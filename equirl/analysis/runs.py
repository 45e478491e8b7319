"""Runs and sweeps as folders: read without the libraries that made them, and without touching them.

A sweep is a folder of runs. What the files of a run hold is told in ``docs/training.md``; their
names stand here once more because reading them must not load what writes them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

__all__ = [
    "CONFIG",
    "FAILED",
    "LOCK",
    "LOG",
    "METRICS",
    "REPORT",
    "SWEEP",
    "TEST",
    "TIMING",
    "VALIDATION",
    "VIDEO",
    "Run",
    "find_sweeps",
    "flatten",
    "is_run",
    "natural_order",
    "planned_runs",
    "read_runs",
]

CONFIG, LOCK, LOG, FAILED = "config.yaml", ".lock", "log.txt", "failed.txt"
METRICS, VALIDATION, TIMING, TEST = "metrics.csv", "validation.csv", "timing.csv", "test.csv"
REPORT, VIDEO = "report.md", "policy.mp4"
SWEEP = "multirun.yaml"  # Hydra's, in the folder of a sweep

_NUMBER = re.compile(r"(\d+)")

# libyaml's where it is: ten times as fast.
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class Run:
    """The folder of a run and its configuration.

    Attributes:
        folder: The folder.
        keys: The configuration, flat: ``"env.task"`` and so on; empty while there is none.
        damage: Why the configuration cannot be read; empty when it can.
    """

    folder: Path
    keys: Mapping[str, Any] = field(default_factory=dict)
    damage: str = ""

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def task(self) -> str:
        """The key of its task."""
        return str(self.keys.get("env.task", ""))

    @property
    def steps(self) -> int:
        """Environment steps it is to make, 0 when that is not known."""
        steps = self.keys.get("steps")
        return steps if isinstance(steps, int) else 0

    @property
    def is_finished(self) -> bool:
        """Whether it left what a run ends with; a run that goes on takes that away first."""
        return (self.folder / TEST).exists() and (self.folder / REPORT).exists()


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run, begun or failed before it began."""
    return any((folder / name).exists() for name in (CONFIG, LOCK, FAILED))


def read_runs(folder: Path) -> list[Run]:
    """The run that a folder is, or the runs that a sweep's folder holds, by name."""
    if is_run(folder):
        return [_read_run(folder)]
    if not folder.is_dir():
        return []
    below = [path.name for path in folder.iterdir() if path.is_dir() and _is_shown(path)]
    return [_read_run(folder / name) for name in sorted(below, key=natural_order)]


def find_sweeps(folder: Path) -> Iterator[tuple[Path, list[Run]]]:
    """All runs below a folder, sweep by sweep; single ones by the folder they are in.

    Yields:
        A folder and the runs in it.
    """
    if is_run(folder):
        yield folder.parent, read_runs(folder)
        return
    for path, names, _ in os.walk(folder):
        runs = sorted((name for name in names if _is_shown(Path(path, name))), key=natural_order)
        # Nothing of ours is inside a run, but trackers keep thousands of files there.
        names[:] = sorted(name for name in set(names) - set(runs) if not name.startswith("."))
        if runs:
            yield Path(path), [_read_run(Path(path, name)) for name in runs]


def planned_runs(folder: Path) -> int | None:
    """How many runs the last command of a sweep makes; None where that cannot be told."""
    try:
        hydra = yaml.load((folder / SWEEP).read_text(), _Loader)["hydra"]
        swept = dict(hydra["sweeper"].get("params") or {})
        given = hydra["overrides"]["task"]
        swept |= {key: value for key, _, value in (text.partition("=") for text in given)}
        count = 1
        for value in swept.values():
            count *= _choices(str(value))
        return count
    except (OSError, ValueError, TypeError, LookupError, AttributeError, yaml.YAMLError):
        return None


def _is_shown(folder: Path) -> bool:
    """Whether a folder that nobody named is listed: Hydra's ``.hydra`` looks like a run."""
    return not folder.name.startswith(".") and is_run(folder)


def natural_order(name: str) -> list[tuple[int, str]]:
    """A key for sorting, with numbers in names by value: ``copies-2`` before ``copies-16``."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in _NUMBER.split(name)]


def _choices(text: str) -> int:
    """How many values Hydra's sweeper reads: those between commas that no bracket holds.

    Raises:
        ValueError: It is one of its functions, as in ``range(0,4)``.
    """
    if "(" in text:
        raise ValueError(text)
    depth, quote, count = 0, "", 1
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character in "[{":
            depth += 1
        elif character in "]}":
            depth -= 1
        elif character == "," and not depth:
            count += 1
    return count


def _read_run(folder: Path) -> Run:
    path = folder / CONFIG
    try:
        values = yaml.load(path.read_text(), _Loader)
    except FileNotFoundError:
        return Run(folder)
    except (OSError, UnicodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        return Run(folder, damage=f"{path} is not a readable configuration: {reason}")
    if not isinstance(values, dict):
        return Run(folder, damage=f"{path} is not a configuration: expected keys and values")
    return Run(folder, dict(flatten(values)))


def flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested mappings, under names such as ``"env.task"``.

    Args:
        values: Mappings, and anything else as their values.
        prefix: Of all names.

    Yields:
        A name and its value.
    """
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
