"""What the benchmarks measure, print and keep."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import platform
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import torch

from equirl.analysis.tables import markdown_row, markdown_table
from equirl.config import Config, to_config, write_atomically

Name = TypeVar("Name")

#: The tables printed so far: by section, each with its columns and rows.
_SECTIONS: dict[str, list[dict[str, list]]] = {}


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
    """Returns the median, in milliseconds; three digits of what is below ten."""
    median = 1e3 * statistics.median(seconds)
    return f"{median:.1f}" if median >= 10 else f"{median:.3g}"


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


def peak_of(call: Callable[[], object], times: int = 3) -> tuple[float, float]:
    """Returns MiB of this process at the peak of calls, and how much that is above its rest."""
    free_memory()  # of building, which would hide what the calls take
    rest = mebibytes("self/status", "VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    for _ in range(times):
        call()
    highest = mebibytes("self/status", "VmHWM")
    return highest, highest - rest


def begin_section(name: str) -> None:
    """Begins a section of tables, which those printed from now on belong to."""
    _SECTIONS[name] = []
    print(f"## {name}\n", flush=True)


def print_header(*columns: str) -> None:
    """Begins a table in Markdown."""
    if _SECTIONS:
        next(reversed(_SECTIONS.values())).append({"columns": list(columns), "rows": []})
    print(markdown_table(columns, []), flush=True)


def print_row(*cells: object) -> None:
    """Adds a row to the table; each is printed when it is there, into a file too."""
    if _SECTIONS:
        next(reversed(_SECTIONS.values()))[-1]["rows"].append([_value(str(cell)) for cell in cells])
    print(markdown_row(cells), flush=True)


def command_line() -> str:
    """The command this process was started with, to stand above what it has measured."""
    script = Path(sys.argv[0])
    return " ".join(["python", f"{script.parent.name}/{script.name}", *sys.argv[1:]])


def machine() -> dict[str, Any]:
    """What was measured on, how busy it was, and with which versions."""
    model = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return {
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "instruction_set": torch.backends.cpu.get_cpu_capability(),
        "load_average": round(os.getloadavg()[0], 2),
        "threads": torch.get_num_threads(),
        "versions": {name: version(name) for name in ("equirl", "torch", "torchrl", "pybullet")},
    }


def save_results(path: Path, measured_on: Mapping[str, Any]) -> None:
    """Writes all tables printed so far as JSON.

    Numbers are numbers; a median with its range is ``{"median": ..., "lowest": ..., "highest":
    ...}``.

    Args:
        path: The file, replaced whole.
        measured_on: What `machine` returned before the measurements.
    """
    results = {"command": command_line(), "machine": measured_on, "tables": _SECTIONS}
    write_atomically(path, json.dumps(results, indent=1) + "\n")


def run_config(
    group: str,
    image: int,
    hidden: int,
    *,
    method: str = "equivariant",
    batch: int = 64,
    head_width: int = 0,
    backend: str = "auto",
) -> Config:
    """Returns the configuration of a run on the CPU, the rest as in the paper."""
    return to_config(
        {
            "env": {"task": "block_picking", "image_size": image},
            "method": {"name": method, "hidden": hidden, "head_width": head_width},
            "algorithm": {"name": "sac", "batch_size": batch},
            "augmentation": {"name": "buffer"},
            "group": group,
            "backend": backend,
            "device": "cpu",
        }
    )


def _value(cell: str) -> object:
    """A cell as JSON: a number, a median with its range, or the text it is."""
    number = r"(-?\d[\d,]*\.?\d*(?:e[+-]?\d+)?)"
    if found := re.fullmatch(rf"{number} \({number} to {number}\)", cell):
        return dict(zip(("median", "lowest", "highest"), map(_number, found.groups()), strict=True))
    if found := re.fullmatch(rf"{number}(?: MiB| GiB| GB|%)?", cell):
        return _number(found[1])
    return cell


def _number(text: str) -> float | int:
    text = text.replace(",", "")
    return int(text) if text.lstrip("-").isdecimal() else float(text)
