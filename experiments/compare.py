"""Compares finished runs: learning curves and a table with success over seeds.

    python experiments/compare.py results/ "D4=outputs/d4_0,outputs/d4_1" "CNN=outputs/cnn_0"

The first argument is the folder to write to; each further one names a group of runs and
their folders. Writes ``curves.png``, ``runs.csv`` and ``table.md``.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from equirl.analysis import read_table, wilson_interval
from equirl.analysis.curves import plot_runs


def main() -> None:
    """Writes curves and tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("groups", nargs="+", metavar="LABEL=FOLDER[,FOLDER...]")
    parser.add_argument("--title", default="")
    arguments = parser.parse_args()
    groups: dict[str, list[Path]] = {}
    for text in arguments.groups:
        label, _, folders = text.partition("=")
        groups[label] = [Path(folder) for folder in folders.split(",") if folder]
        for folder in groups[label]:
            if not (folder / "test.csv").exists():
                parser.error(f"{folder} is not the folder of a finished run")
    arguments.output.mkdir(parents=True, exist_ok=True)
    plot_runs(groups, arguments.output / "curves.png", title=arguments.title)
    rows = [summary(label, folder) for label, folders in groups.items() for folder in folders]
    with open(arguments.output / "runs.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    names = list(rows[0])
    lines = [f"| {' | '.join(names)} |", f"| {' | '.join('---' for _ in names)} |"]
    lines += [f"| {' | '.join(str(value) for value in row.values())} |" for row in rows]
    (arguments.output / "table.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def summary(label: str, folder: Path) -> dict[str, str | int]:
    """One line of the table."""
    test = read_table(folder / "test.csv")
    timing = read_table(folder / "timing.csv")
    validation = read_table(folder / "validation.csv") or {"step": [], "success_rate": []}
    successes, episodes = int(sum(test["success"])), len(test["success"])
    low, high = wilson_interval(successes, episodes)
    pairs = zip(validation["step"], validation["success_rate"], strict=True)
    first = next((step for step, rate in pairs if rate >= 0.9), None)
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
