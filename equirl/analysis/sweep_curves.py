"""The paper's plot of a sweep: mean curves with their errors, and success with its intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from equirl.analysis.ceilings import expert_ceiling
from equirl.analysis.labels import shortened, task_name
from equirl.analysis.pictures import COLOURS, DASHES, plain, pyplot, save
from equirl.analysis.summary import ALL_TASKS, Summary, summarise
from equirl.analysis.sweep import Curve, Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = ["draw_sweep", "plot_sweep"]

_CEILING: dict[str, Any] = {"color": "#5b6770", "lw": 1, "ls": (0, (5, 3))}

_LABEL_LETTERS = 90  # of a variant, in the legend
_LEGEND_LETTERS = 46  # as wide as a panel
_TITLE_LETTERS = 11  # an inch


def plot_sweep(sweep: Sweep, path: Path, *, title: str = "", window: int = 500) -> None:
    """Writes what `draw_sweep` draws.

    Args:
        sweep: With at least one run.
        path: The PNG file to write.
        title: Above the figure.
        window: Steps that a return is averaged over.

    Raises:
        OSError: The file cannot be written.
    """
    save(draw_sweep(sweep, title=title, window=window), path, palette=True)


def draw_sweep(sweep: Sweep, *, title: str = "", window: int = 500) -> Figure:
    """Draws a column a task: behaviour return above, greedy success below; at the right, IQM.

    Lines are means over runs where all of them have data, thin ones single runs that are
    further than others; shading is the standard error, the dashed line what the expert earns.
    Several variants are numbered, in the legend and at the rows of the IQM.

    Args:
        sweep: With at least one run.
        title: Above the figure.
        window: Steps that a return is averaged over.

    Returns:
        The figure, which stays open until `matplotlib.pyplot.close`.
    """
    tasks, styles = sweep.tasks, _styles(sweep.variants)
    final = _final(summarise(sweep, window=window), len(tasks))
    single = len(tasks) == 1
    widths = [1.0] * (2 if single else len(tasks)) + [0.8] * bool(final)
    entries = _entries(sweep, styles, sum(widths))
    columns = _columns([label for label, _ in entries], sum(widths))
    wide = 3.1 * sum(widths) + 0.8
    heading = ", ".join(filter(None, [title, task_name(tasks[0]) if single else ""]))
    lines = wrap(heading, int(_TITLE_LETTERS * wide), max_lines=3, placeholder=" …")
    height = max(2.9 if single else 5.2, 0.24 * len(styles)) + 0.2 * -(-len(entries) // columns)
    figure = pyplot().figure(figsize=(wide, height + 0.17 * len(lines)), layout="constrained")
    grid = figure.add_gridspec(1 if single else 2, len(widths), width_ratios=widths)
    for column, task in enumerate(tasks):
        above = figure.add_subplot(grid[0, column])
        below = figure.add_subplot(grid[0, 1] if single else grid[1, column])
        for variant, style in styles.items():
            _draw(above, sweep.returns(task, variant, window), style)
            _draw_ahead(above, sweep.ahead(task, variant, window), style)
            _draw(below, sweep.success(task, variant), style, marker=True)
            _draw_ahead(below, sweep.success_ahead(task, variant), style)
        _draw_ceilings(above, sweep, task)
        for axes in (above, below):
            axes.set_xlim(0, _last_step(sweep, task))
        if not single:
            above.set_title(plain(shortened(task_name(task), 34)))
        _finish(above, below, f"return, previous {window} steps", first=column == 0, single=single)
    if final:
        _draw_intervals(figure.add_subplot(grid[:, -1]), final, styles)
    figure.legend(
        [handle for _, handle in entries],
        [plain(label) for label, _ in entries],
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        handlelength=2.6,  # of each dash pattern a whole one
    )
    figure.suptitle(plain("\n".join(lines)))
    return figure


def _styles(variants: Sequence[str]) -> dict[str, dict[str, Any]]:
    """A colour for each variant; further rounds of the colours are dashed and dotted."""
    count = len(COLOURS)
    return {
        variant: {"color": COLOURS[n % count], "ls": DASHES[n // count % len(DASHES)]}
        for n, variant in enumerate(variants)
    }


def _entries(
    sweep: Sweep, styles: Mapping[str, dict[str, Any]], width: float
) -> list[tuple[str, Line2D]]:
    """The legend below so many panels: labels that fit, and their lines."""
    from matplotlib.lines import Line2D

    longest = min(_LABEL_LETTERS, int(_LEGEND_LETTERS * width) - 25)
    entries = []
    for number, (variant, style) in enumerate(styles.items(), start=1):
        label = f"{shortened(variant, longest)} ({_seeds(sweep, variant)})"
        told = f"{number}: {label}" if len(styles) > 1 else label
        entries.append((told, Line2D([], [], lw=1.8, **style)))
    if any(_ceilings(sweep, task) for task in sweep.tasks):
        entries.append(("expert", Line2D([], [], **_CEILING)))
    return entries


def _final(lines: Sequence[Summary], tasks: int) -> list[Summary]:
    """The lines whose success is drawn: over all tasks, or on the only one."""
    return [line for line in lines if line.finished and (tasks == 1 or line.task == ALL_TASKS)]


def _draw(axes: Axes, curve: Curve | None, style: dict[str, Any], marker: bool = False) -> None:
    if curve is None:
        return
    few = marker and len(curve.steps) <= 12
    axes.plot(curve.steps, curve.mean, lw=1.8, marker="o" if few else None, ms=3, **style)
    if curve.runs > 1:
        low, high = curve.mean - curve.error, curve.mean + curve.error
        axes.fill_between(curve.steps, low, high, color=style["color"], alpha=0.18, lw=0)


def _draw_ahead(
    axes: Axes, curves: Iterable[tuple[np.ndarray, np.ndarray]], style: dict[str, Any]
) -> None:
    """Single runs that are further than the others of their variant."""
    for steps, values in curves:
        axes.plot(steps, values, lw=0.7, alpha=0.6, **style)


def _ceilings(sweep: Sweep, task: str) -> list[float]:
    """What the experts of a task's runs earn: one number, or one a mode."""
    cells = [tables for (own, _), tables in sweep.cells.items() if own == task]
    found = {expert_ceiling(each.run.keys) for tables in cells for each in tables}
    return sorted(ceiling for ceiling in found if ceiling is not None)


def _draw_ceilings(axes: Axes, sweep: Sweep, task: str) -> None:
    for ceiling in _ceilings(sweep, task):
        axes.axhline(ceiling, **_CEILING)


def _finish(above: Axes, below: Axes, returns: str, *, first: bool, single: bool) -> None:
    """Names and limits the axes of a task: by titles side by side, else by the first column."""
    success = "greedy success, held-out scenes"
    for axes, name in ((above, returns), (below, success)):
        axes.set_ylim(-0.03, 1.03)
        axes.grid(alpha=0.25, lw=0.5)
        axes.locator_params(axis="x", nbins=5)
        if single:
            axes.set_title(name)
        elif first:
            axes.set_ylabel(name)
        if single or axes is below:
            axes.set_xlabel("environment steps")


def _draw_intervals(
    axes: Axes, final: Sequence[Summary], styles: Mapping[str, dict[str, Any]]
) -> None:
    """A bar from end to end of each interval, its interquartile mean as a stroke."""
    places = {variant: -row for row, variant in enumerate(styles)}
    for variant in set(styles) - {line.variant for line in final}:
        axes.text(0.5, places[variant], "unfinished", ha="center", va="center", color="#5b6770")
    for line in final:
        place, colour = places[line.variant], styles[line.variant]["color"]
        low, high = (line.low, line.high) if line.low == line.low else (line.iqm, line.iqm)
        axes.barh(place, high - low, 0.5, left=low, color=colour, alpha=0.35)
        axes.plot([line.iqm] * 2, [place - 0.25, place + 0.25], color=colour, lw=2.5)
        axes.text(high + 0.03, place, f"{line.iqm:.0%}", va="center", fontsize=8)
    rows = max(len(styles), 5)  # a few bars are no wider than many
    middle = (1 - len(styles)) / 2
    axes.set(xlim=(-0.06, 1.26), ylim=(middle - rows / 2, middle + rows / 2))
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1])  # right of them there is room for the numbers
    numbers = [str(number) if len(styles) > 1 else "" for number in range(1, len(styles) + 1)]
    axes.set_yticks(list(places.values()), numbers)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", alpha=0.25, lw=0.5)
    axes.spines["left"].set_visible(False)
    axes.set_title("success on test scenes")
    axes.set_xlabel("IQM, 95 % interval")


def _last_step(sweep: Sweep, task: str) -> float:
    """Where the curves of a task end, once they do."""
    cells = [tables for (own, _), tables in sweep.cells.items() if own == task]
    return 1.02 * max(max(each.end, each.run.steps) for tables in cells for each in tables)


def _seeds(sweep: Sweep, variant: str) -> str:
    """How many runs a line is the mean of."""
    counts = {len(tables) for (_, own), tables in sweep.cells.items() if own == variant}
    low, high = min(counts), max(counts)
    if low == high:
        return f"{low} seed{'s' if low > 1 else ''}"
    return f"{low} to {high} seeds"


def _columns(labels: Sequence[str], width: float) -> int:
    """Columns of a legend that fit below so many panels; even rows."""
    longest = max(map(len, labels)) + 12
    most = max(1, min(len(labels), int(_LEGEND_LETTERS * width / longest)))
    rows = -(-len(labels) // most)
    return -(-len(labels) // rows)
