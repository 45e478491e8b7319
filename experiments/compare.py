"""Compares finished runs: learning curves and a table with success over seeds.

    python experiments/compare.py results/ "D4=outputs/d4_0,outputs/d4_1" "CNN=outputs/cnn_0"
    python experiments/compare.py results/ outputs/sweeps/2026-01-31_12-00-00

The first argument is the folder to write to; each further one names a group of runs and
their folders, or is the folder of a sweep, its runs then called by what differs among them.
Writes ``curves.png``, ``runs.csv`` and ``table.md``. For means over the seeds of a whole sweep
there is experiments/figures.py.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

from equirl.analysis import TableError, read_table, wilson_interval
from equirl.analysis.curves import plot_runs
from equirl.analysis.labels import differing_keys
from equirl.analysis.runs import read_runs
from equirl.analysis.statistics import first_reaching
from equirl.analysis.summary import SOLVED
from equirl.analysis.tables import markdown_table, write_table

#: The tables that are read, and their columns that are.
NEEDED = {
    "test.csv": ["success", "length"],
    "validation.csv": ["step", "success_rate"],
    "timing.csv": ["step", "minutes", "update_ms"],
    "metrics.csv": ["step", "discounted_return"],
}


def main(arguments: list[str] | None = None) -> None:
    """Writes curves and tables."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("groups", nargs="+", type=group, metavar="LABEL=FOLDER[,FOLDER...]")
    parser.add_argument("--title", default="")
    given = parser.parse_args(arguments)
    groups: dict[str, Sequence[Path]] = {}
    for label, folders in itertools.chain.from_iterable(given.groups):
        groups[label] = [*groups.get(label, ()), *folders]
    rows = [summary(label, folder) for label, folders in groups.items() for folder in folders]
    table = markdown_table(rows[0], (row.values() for row in rows))
    try:
        given.output.mkdir(parents=True, exist_ok=True)
        plot_runs(groups, given.output / "curves.png", title=given.title)
        write_table(given.output / "runs.csv", rows)
        (given.output / "table.md").write_text(table + "\n")
    except OSError as error:
        sys.exit(f"error: cannot write to {given.output}: {error}")
    print(table)


def group(text: str) -> list[tuple[str, list[Path]]]:
    """Labels and the folders of their runs, from an argument of the command line."""
    label, equals, names = text.partition("=")
    if not equals:
        runs = [Path(text), *sorted(table.parent for table in Path(text).glob("*/test.csv"))]
        found = labelled([run for run in runs if is_finished(run)])
        if not found:
            raise argparse.ArgumentTypeError(
                f"expected LABEL=FOLDER[,FOLDER...] or the folder of finished runs, got {text!r}"
            )
        return found
    folders = [Path(name) for name in names.split(",") if name]
    if not label or not folders:
        raise argparse.ArgumentTypeError(f"expected LABEL=FOLDER[,FOLDER...], got {text!r}")
    for folder in folders:
        if not is_finished(folder):
            raise argparse.ArgumentTypeError(f"{folder} is not the folder of a finished run")
    return [(label, folders)]


def labelled(runs: list[Path]) -> list[tuple[str, list[Path]]]:
    """Runs with labels that say in which keys they differ, or their folders' names."""
    configs = [each.keys for run in runs for each in read_runs(run) if each.keys]
    keys = differing_keys(configs)
    if not keys or len(configs) < len(runs):
        return [(run.name, [run]) for run in runs]
    labels = [", ".join(f"{key}={config.get(key)}" for key in keys) for config in configs]
    return [(label, [run]) for label, run in zip(labels, runs, strict=True)]


def is_finished(folder: Path) -> bool:
    """Whether a folder holds what a run ends with.

    Raises:
        argparse.ArgumentTypeError: One of its tables is damaged.
    """
    try:
        tables = {name: read_table(folder / name, columns) for name, columns in NEEDED.items()}
    except TableError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return bool(tables["test.csv"])


def summary(label: str, folder: Path) -> dict[str, str | int]:
    """One line of the table."""
    test = read_table(folder / "test.csv")
    timing = read_table(folder / "timing.csv")
    validation = read_table(folder / "validation.csv") or {"step": [], "success_rate": []}
    successes, episodes = int(sum(test["success"])), len(test["success"])
    low, high = wilson_interval(successes, episodes)
    first = first_reaching(validation["step"], validation["success_rate"], SOLVED)
    minutes = dict(zip(timing["step"], timing["minutes"], strict=True)) if timing else {}
    solved = [n for n, success in zip(test["length"], test["success"], strict=True) if success]
    return {
        "method": label,
        "run": folder.name,
        "success": f"{successes}/{episodes}",
        "95 % interval": f"{low:.0%} to {high:.0%}",
        "mean length of a success": f"{sum(solved) / len(solved):.1f}" if solved else "-",
        "first validation of 90 %": f"{first:.0f}" if first is not None else "-",
        "minutes to it": f"{minutes[first]:.1f}" if first in minutes else "-",
        "minutes": f"{timing['minutes'][-1]:.1f}" if timing else "-",
        "update ms": f"{timing['update_ms'][-1]:.0f}" if timing else "-",
    }


if __name__ == "__main__":
    main()
