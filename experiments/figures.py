"""Draws a sweep as the paper's figures do, with a table of its statistics; runs may still train.

python experiments/figures.py sweep=outputs/experiments/fig12/laptop figure=12
python experiments/figures.py sweep=outputs/sweep smoothing=1000 output=figures

Writes ``figure_<name>.png``, ``table.md`` and ``table.csv``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from entry_point import entry_point

from equirl.config import ConfigError, FiguresJob

if TYPE_CHECKING:
    from equirl.analysis.summary import Summary
    from equirl.analysis.sweep import Figure, Sweep


@entry_point("figures", FiguresJob)
def main(job: FiguresJob) -> None:
    """Draws, and prints the table."""
    from equirl.analysis import collect, plot_sweep, read_runs, summarise, write_table
    from equirl.analysis.labels import listed

    figure = _figure(job.figure)
    folder = Path(job.sweep)
    runs = read_runs(folder)
    if not runs:
        raise ConfigError(f"sweep={folder}: expected the folder of a sweep or of a run, with runs")
    sweep = collect(runs, figure)
    if not sweep.cells:
        remarks = listed(sweep.remarks, 3, "; ")
        raise ConfigError(f"sweep={folder}: nothing to draw yet; {remarks}")
    lines = summarise(sweep, window=job.smoothing)
    output = Path(job.output) if job.output else folder
    picture = output / f"figure_{job.figure or 'sweep'}.png"
    title = job.title or (figure.title if figure else folder.resolve().name)
    page = _page(title, picture.name, lines, sweep, job.smoothing)
    try:
        output.mkdir(parents=True, exist_ok=True)
        plot_sweep(sweep, picture, title=title, window=job.smoothing)
        (output / "table.md").write_text(page)
        write_table(output / "table.csv", [vars(line) for line in lines])
    except OSError as error:
        sys.exit(f"error: cannot write output={output}: {error}")
    print(page)
    print(f"figure: {picture}\ntables: {output / 'table.md'}, {output / 'table.csv'}")


def _figure(name: str) -> Figure | None:
    from equirl.analysis.sweep import FIGURES

    if name and name not in FIGURES:
        raise ConfigError(f"figure={name}: expected one of {', '.join(FIGURES)}")
    return FIGURES.get(name)


def _page(title: str, picture: str, lines: list[Summary], sweep: Sweep, window: int) -> str:
    """The table in Markdown, with what it counts and what is missing."""
    from equirl.analysis.summary import COLUMNS
    from equirl.analysis.tables import markdown_table

    remarks = [f"- {remark}" for remark in sweep.remarks]
    return "\n".join(
        [
            f"# {title}",
            "",
            f"![{title}]({picture})",
            "",
            markdown_table(COLUMNS, (line.cells() for line in lines)),
            "",
            "Success: of the greedy policy on test scenes after training, mean ± standard error "
            "over finished runs; IQM: mean of the middle half of the runs (of all tasks), with its "
            "stratified bootstrap interval. Steps to 90 %: median over runs of the first "
            "validation that reached it. Return: of the behaviour policy, discounted, over the "
            f"previous {window} steps, mean ± standard error where its curve ends.",
            "",
            *(["Missing, unfinished or damaged:", "", *remarks, ""] if remarks else []),
        ]
    )


if __name__ == "__main__":
    main()
