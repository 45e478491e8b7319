"""Learning curves of runs as pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from equirl.analysis.pictures import COLOURS, plain, pyplot, save
from equirl.analysis.statistics import moving_return
from equirl.analysis.tables import read_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_run", "plot_runs"]

_LEGEND_LETTERS = 125  # in a row below two panels


def plot_run(folder: Path, path: Path) -> None:
    """Draws one run: behaviour return, greedy success, losses, entropy and temperature.

    Args:
        folder: The run's folder, with ``metrics.csv`` and ``validation.csv``.
        path: The PNG file to write.
    """
    plt = pyplot()
    metrics = read_table(folder / "metrics.csv")
    figure, axes = plt.subplots(2, 2, figsize=(9, 5.6), layout="constrained", sharex=True)
    _draw_success(axes[0, 0], [folder], "validation", COLOURS[0])
    _draw_return(axes[0, 1], [folder], "behaviour policy", COLOURS[1])
    if metrics:
        steps = metrics["step"]
        axes[1, 0].plot(steps, metrics["loss_qvalue"], color=COLOURS[2], lw=1)
        scale = "log" if max(metrics["loss_qvalue"]) > 0 else "linear"  # 0 before any update
        axes[1, 0].set(title="critic loss", yscale=scale, xlabel="environment steps")
        axes[1, 1].plot(steps, metrics["entropy"], color=COLOURS[3], lw=1)
        axes[1, 1].set(title="policy entropy (nats)", xlabel="environment steps")
    save(figure, path)


def plot_runs(groups: Mapping[str, Sequence[Path]], path: Path, *, title: str = "") -> None:
    """Draws groups of runs over one another: greedy success and behaviour return.

    Args:
        groups: Run folders under the label they share in the legend; every run is a
            thin line, their mean a thick one.
        path: The PNG file to write.
        title: Above the figure.
    """
    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for colour, (label, folders) in zip(cycle(COLOURS), groups.items(), strict=False):
        _draw_success(left, folders, plain(label), colour, interval=len(groups) <= 3)
        _draw_return(right, folders, plain(label), colour)
    handles, labels = left.get_legend_handles_labels()
    if labels:  # none without validations
        widest = max(map(len, labels)) + 7  # letters, with the line before them
        columns = max(1, min(len(labels), _LEGEND_LETTERS // widest))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    figure.suptitle(plain(title))
    save(figure, path)


def _draw_success(
    axes: Axes, folders: Sequence[Path], label: str, colour: str, interval: bool = True
) -> None:
    tables = [table for folder in folders if (table := read_table(folder / "validation.csv"))]
    for table in tables:
        axes.plot(table["step"], table["success_rate"], color=colour, lw=1, alpha=0.4)
        if len(tables) == 1 and interval:  # many would hide one another
            axes.fill_between(table["step"], table["low"], table["high"], color=colour, alpha=0.15)
    if tables:
        steps = sorted(set.intersection(*(set(table["step"]) for table in tables)))
        rates = [np.interp(steps, table["step"], table["success_rate"]) for table in tables]
        axes.plot(steps, np.mean(rates, axis=0), color=colour, lw=2, label=label)
    axes.set(title="greedy success, held-out scenes", ylim=(-0.03, 1.03))
    axes.set_xlabel("environment steps")


def _draw_return(axes: Axes, folders: Sequence[Path], label: str, colour: str) -> None:
    for folder in folders:
        table = read_table(folder / "metrics.csv")
        if table:
            steps = np.asarray(table["step"])
            returns = moving_return(steps, np.asarray(table["discounted_return"]))
            axes.plot(steps, returns, color=colour, lw=1.4, alpha=0.8, label=label)
            label = ""
    axes.set(title="discounted return, previous 500 steps", ylim=(-0.03, 1.03))
    axes.set_xlabel("environment steps")
