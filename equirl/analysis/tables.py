"""Tables: CSV files in the folder of a run, and Markdown for pages."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

__all__ = [
    "TableError",
    "markdown_row",
    "markdown_table",
    "read_rows",
    "read_table",
    "write_table",
]


class TableError(ValueError):
    """A file that is no table of numbers; the message names it and the line."""


def read_table(path: Path, needed: Sequence[str] = ()) -> dict[str, list[float]]:
    """Reads a CSV table of numbers as columns; a missing or empty file has none.

    A last line cut short by a killed run is left out.

    Args:
        path: The file.
        needed: Columns that a table with rows must have.

    Raises:
        TableError: The file is not such a table, or cannot be read.
    """
    rows = read_rows(path)
    missing = [name for name in needed if rows and name not in rows[0]]
    if missing:
        raise TableError(f"{path}, line 1: expected a header with {', '.join(missing)}")
    return {name: [row[name] for row in rows] for name in rows[0]} if rows else {}


def read_rows(path: Path) -> list[dict[str, float]]:
    """Reads what `read_table` reads, as rows.

    Raises:
        TableError: The file is not such a table, or cannot be read.
    """
    try:
        text = path.read_text()
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise TableError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise TableError(f"{path} is no table: {error}") from None
    header, *lines = [line for line in text.splitlines(True) if line.endswith("\n")] or [""]
    names = header.strip().split(",")
    rows = []
    for number, line in enumerate(lines, start=2):
        try:
            values = [_number(cell) for cell in line.split(",")]
            rows.append(dict(zip(names, values, strict=True)))
        except ValueError:
            expected = f"numbers for the columns {header.strip()}"
            raise TableError(
                f"{path}, line {number}: expected {expected}, got {line.strip()[:80]!r}"
            ) from None
    return rows


def _number(cell: str) -> float:
    try:
        return int(cell)  # seeds have more digits than a float holds
    except ValueError:
        return float(cell)


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
    texts = (str(cell).replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(texts)} |"
