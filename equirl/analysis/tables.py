"""Tables: CSV files in the folder of a run, and Markdown for pages."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

__all__ = ["markdown_row", "markdown_table", "read_table", "write_table"]


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


def write_table(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Writes rows as a CSV table.

    Args:
        path: The file, written anew.
        rows: At least one; all have the columns of the first.

    Raises:
        ValueError: A row has a column that the first has not.
        OSError: The file cannot be written.
    """
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def markdown_table(columns: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """Returns a table in Markdown."""
    columns = list(columns)
    lines: list[Iterable[object]] = [columns, ["---"] * len(columns), *rows]
    return "\n".join(map(markdown_row, lines))


def markdown_row(cells: Iterable[object]) -> str:
    """Returns a row of a table in Markdown, for tables that are printed as they grow."""
    return f"| {' | '.join(map(str, cells))} |"
