"""Reading the tables of a run's folder."""

from __future__ import annotations

import csv
from pathlib import Path

__all__ = ["read_table"]


def read_table(path: Path) -> dict[str, list[float]]:
    """Reads a CSV table of numbers as columns; a missing or empty file has none.

    A last line cut short by a killed run is left out.
    """
    if not path.exists():
        return {}
    with open(path, newline="") as file:
        lines = [line for line in file if line.endswith("\n")]
    rows = list(csv.DictReader(lines))
    return {name: [float(row[name]) for row in rows] for name in rows[0]} if rows else {}
