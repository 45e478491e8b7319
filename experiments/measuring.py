"""What the benchmarks measure and print with."""

from __future__ import annotations

import ctypes
import gc
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from equirl.analysis.tables import markdown_row, markdown_table
from equirl.config import Config, to_config

Name = TypeVar("Name")


def take_turns(
    calls: Mapping[Name, Callable[[], object]], repeats: int, warm_up: int = 1
) -> dict[Name, list[float]]:
    """Returns the seconds of each call in each round, the calls taking turns within it.

    Whatever else slows the machine down slows all of a round, so that the ratios of one
    round's times hold where the times themselves do not.
    """
    seconds: dict[Name, list[float]] = {name: [] for name in calls}
    for _ in range(warm_up + repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    return {name: times[warm_up:] for name, times in seconds.items()}


def milliseconds(seconds: Iterable[float]) -> str:
    """Returns the median, in milliseconds."""
    return f"{1e3 * statistics.median(seconds):.1f}"


def ratio(slower: Iterable[float], faster: Iterable[float]) -> str:
    """Returns the median of the rounds' ratios, and their range."""
    ratios = [a / b for a, b in zip(slower, faster, strict=True)]
    return f"{statistics.median(ratios):.3g} ({min(ratios):.3g} to {max(ratios):.3g})"


def mebibytes(file: str, field: str) -> float:
    """Returns memory of a process, the sum of the fields whose names begin with ``field``.

    Args:
        file: Where in ``/proc``: ``"self/status"``, ``"<process>/smaps_rollup"``.
        field: The beginning of a name, ``"VmRSS"``.
    """
    lines = Path("/proc", file).read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(field)) / 2**10


def free_memory() -> None:
    """Gives what is no longer used back to the system, where it would hide what is used next."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


def print_header(*columns: str) -> None:
    """Begins a table in Markdown."""
    print(markdown_table(columns, []), flush=True)


def print_row(*cells: object) -> None:
    """Adds a row to the table; each is printed when it is there, into a file too."""
    print(markdown_row(cells), flush=True)


def run_config(
    group: str, image: int, hidden: int, *, head_width: int = 0, backend: str = "auto"
) -> Config:
    """Returns the configuration of a run on the CPU, the rest as in the paper."""
    return to_config(
        {
            "env": {"task": "block_picking", "image_size": image},
            "method": {"name": "equivariant", "hidden": hidden, "head_width": head_width},
            "algorithm": {"name": "sac"},
            "augmentation": {"name": "buffer"},
            "group": group,
            "backend": backend,
            "device": "cpu",
        }
    )
