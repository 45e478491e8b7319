"""Lists runs and sweeps: how far they are, how well they do, and what is left.

python experiments/runs.py
python experiments/runs.py outputs/experiments/fig12/laptop --watch 30
python experiments/runs.py outputs/sweep --html outputs/sweep/report.html

Nothing is loaded, locked or written but, on request, a page that opens without a network.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from command_line import at_least

from equirl.analysis.labels import group_variants, listed, shortened, task_name
from equirl.analysis.runs import Run, find_sweeps, planned_runs, read_runs
from equirl.analysis.status import Status, Totals, read_status, total

_HEADINGS = ("run", "what", "state", "step", "return", "success", "steps/min", "left")


def main(arguments: list[str] | None = None) -> None:
    """Prints the list, once or again and again, or writes the page."""
    parser = argparse.ArgumentParser(
        description=str(__doc__),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folders", nargs="*", type=Path, default=[Path("outputs")])
    parser.add_argument("--watch", type=at_least(1), metavar="SECONDS", help="list again and again")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page about one sweep")
    parser.add_argument("--figure", default="", help="the figure of the paper, for the page")
    parser.add_argument(
        "--embed",
        type=at_least(0),
        default=300,
        metavar="KILOBYTES",
        help="videos up to this size are put into the page (300); larger ones are linked",
    )
    given = parser.parse_args(arguments)
    if given.html and (given.watch or len(given.folders) > 1):
        parser.error("--html: expected one folder, and no --watch")
    try:
        if given.html:
            _write_page(given.folders[0], given.html, given.figure, given.embed * 1000)
            return
        _show(given.folders)
        while given.watch:
            time.sleep(given.watch)
            _show(given.folders, again=True)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # a reader such as head has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is still held
        sys.exit(141)


def _show(folders: Sequence[Path], *, again: bool = False) -> None:
    """Prints the list; where it was watched before it may have become empty."""
    text = "\n".join(listing(folders))
    if again and sys.stdout.isatty():
        print("\033[2J\033[H", end="")  # clears the screen
    if not text and not again:
        sys.exit(_nothing(folders))
    print(text, flush=True)


def listing(folders: Sequence[Path]) -> Iterator[str]:
    """The lines of the list: a table for each folder that holds runs, and its totals."""
    for root in folders:
        for folder, runs in find_sweeps(root):
            statuses = [read_status(run) for run in runs]
            yield f"{folder}: {_counted(len(runs), 'run')}"
            yield from _columns([_HEADINGS, *_rows(statuses)])
            if len(runs) > 1:
                yield describe_totals(total(statuses, planned_runs(folder)))
            yield ""


def describe_totals(totals: Totals) -> str:
    """How far a sweep is, in a line."""
    there = sum(totals.counts.values())
    parts = [", ".join(f"{count} {state}" for state, count in totals.counts.items())]
    if totals.planned > there:
        parts.append(f"{totals.planned - there} of {totals.planned} to come")
    if totals.steps:
        parts.append(f"{totals.step:,} of {totals.steps:,} steps made")
    if totals.minutes_left:
        if totals.parallel:
            left = duration(totals.minutes_left / totals.parallel)
            parts.append(f"{left} left, {_counted(totals.parallel, 'run')} at a time")
        else:
            parts.append(f"{duration(totals.minutes_left)} of training left, nothing runs")
    return "; ".join(parts)


def duration(minutes: float | None) -> str:
    """Minutes in words: ``"50 s"``, ``"12 min"``, ``"3 h 20 min"``."""
    if minutes is None:
        return "-"
    if minutes < 1:
        return f"{minutes * 60:.0f} s"
    whole = round(minutes)
    return f"{whole} min" if whole < 60 else f"{whole // 60} h {whole % 60:02d} min"


def _rows(statuses: Sequence[Status]) -> Iterator[list[str]]:
    labels = _labels([status.run for status in statuses])
    for status in statuses:
        run = status.run
        reason = f": {status.reason}" if status.reason else ""
        left = duration(status.minutes_left) if status.state == "running" else "-"
        yield [
            run.name,
            labels[run.folder],
            status.state + reason,
            f"{status.step}/{run.steps}" if run.steps else "-",
            _number(status.last_return, ".2f"),
            _number(status.success, ".0%"),
            _number(status.speed, ".0f"),
            left,
        ]


def _labels(runs: Sequence[Run], always: Sequence[str] = ()) -> dict[Path, str]:
    """What differs among runs: task, variant, seed; the task also where it is the same."""
    known = [run for run in runs if run.keys]
    labels = dict.fromkeys((run.folder for run in runs), "-")
    variants = group_variants(known, always)
    for variant, members in variants.items():
        for run in members:
            parts = [task_name(run.task), variant, f"seed {run.keys.get('seed')}"]
            labels[run.folder] = ", ".join(part for part in parts if part)
    return labels


def _columns(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Aligned columns; what is too long for the terminal loses its middle."""
    wide = shutil.get_terminal_size((160, 24)).columns
    most = max(20, wide // 3)
    short = [[shortened(row[0], most), row[1], shortened(row[2], most), *row[3:]] for row in rows]
    widths = [max(len(row[column]) for row in short) for column in range(len(_HEADINGS))]
    for row in short:
        texts = [
            cell.ljust(width) if column < 3 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        yield "  " + "  ".join(texts).rstrip()


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _nothing(folders: Sequence[Path]) -> str:
    return f"no runs below {', '.join(map(str, folders))}"


def _write_page(folder: Path, path: Path, figure: str, largest_video: int) -> None:
    from equirl.analysis.page import sweep_page
    from equirl.analysis.sweep import FIGURES

    if figure and figure not in FIGURES:
        sys.exit(f"error: --figure {figure}: expected one of {', '.join(FIGURES)}")
    runs = read_runs(folder)
    if not runs:
        sweeps = [str(path) for path, _ in find_sweeps(folder)]
        below = f"{folder} is no sweep; --html takes one of {listed(sweeps, 10)}"
        sys.exit(f"error: {below if sweeps else _nothing([folder])}")
    paper = FIGURES.get(figure)
    statuses = [read_status(run) for run in runs]
    summary = describe_totals(total(statuses, planned_runs(folder)))
    page = sweep_page(
        folder,
        statuses,
        _labels(runs, [paper.key] if paper else []),
        summary=summary,
        figure=paper,
        base=path.parent,
        largest_video=largest_video,
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page)
    except OSError as error:
        sys.exit(f"error: cannot write {path}: {error}")
    print(f"page: {path} ({len(page.encode()) / 1e6:.1f} MB)", flush=True)


if __name__ == "__main__":
    main()
