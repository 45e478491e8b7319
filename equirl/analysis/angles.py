"""Errors of equivariance against the angle, as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from equirl.analysis.pictures import COLOURS, pyplot, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_errors"]

_UNITS = {"log-probability": "log-probability (nats)"}


def plot_errors(records: Sequence[Mapping[str, Any]], path: Path | str, *, title: str = "") -> None:
    """Draws mean errors against the angle: a column a quantity, a row a kind of observations.

    Turns are solid lines, reflections dashed ones. Elements that map the pixel grid onto itself are
    points: there nothing is interpolated. Dotted is what interpolation does by itself: the change
    when the picture is turned there and back.

    Args:
        records: Of one or more equivariance reports (`EquivarianceReport.records`). Of layers none
            is drawn. Where they have ``training``, it tells lines apart by colour, and
            ``observations`` tells rows of panels apart.
        path: The PNG file to write.
        title: Above the figure.

    Raises:
        ValueError: There is no record of a quantity.
    """
    rows = [row for row in records if row["level"] == "end to end"]
    if not rows:
        raise ValueError("expected records of quantities end to end, got none")
    names = list(dict.fromkeys(row["name"] for row in rows))
    kinds = list(dict.fromkeys(row.get("observations", "") for row in rows))
    stages = list(dict.fromkeys(row.get("training", "") for row in rows))
    colours = COLOURS if len(stages) == 1 else ("#8d8d8d", *COLOURS)
    plt = pyplot()
    size = (1.2 + 2.5 * len(names), 1.1 + 2.2 * len(kinds))
    figure, axes = plt.subplots(
        len(kinds), len(names), figsize=size, layout="constrained", squeeze=False, sharex=True,
        sharey="col",
    )  # fmt: skip
    for i, kind in enumerate(kinds):
        for j, name in enumerate(names):
            for colour, stage in zip(cycle(colours), stages, strict=False):
                chosen = _choose(rows, name=name, observations=kind, training=stage)
                _draw(axes[i, j], chosen, stage, colour)
            axes[i, j].set(yscale="log", xlim=(-5, 365), xticks=range(0, 361, 90))
            axes[i, j].minorticks_off()
            axes[i, j].grid(axis="y", color="#e8e8e8", lw=0.6)
        label = f"{kind} observations\nmean absolute error" if kind else "mean absolute error"
        axes[i, 0].set_ylabel(label)
    for j, name in enumerate(names):
        axes[0, j].set_title(_UNITS.get(name, name))
        axes[-1, j].set_xlabel("angle (degrees)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    handles += axes[0, 0].plot([], [], "ko", ms=3.5)
    labels.append("no interpolation")
    columns = (len(labels) + 1) // 2 if len(names) < 4 else len(labels)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    figure.suptitle(title)
    save(figure, Path(path))


def _choose(rows: Sequence[Mapping[str, Any]], **labels: str) -> list[Mapping[str, Any]]:
    return [row for row in rows if all(row.get(key, "") == labels[key] for key in labels)]


def _draw(axes: Axes, rows: Sequence[Mapping[str, Any]], stage: str, colour: str) -> None:
    """Draws the lines of one quantity; each label stands in the legend."""
    suffix = f", {stage}" if stage else ""
    for reflected, style, what in ((False, "-", "turns"), (True, "--", "reflections")):
        line = [dict(row) for row in rows if row["reflected"] == reflected]
        if not line:
            continue
        line.sort(key=itemgetter("angle"))
        line.append({**line[0], "angle": line[0]["angle"] + 360})
        angles = np.array([row["angle"] for row in line])
        errors = np.array([row["mean"] for row in line])
        exact = np.isnan([row["interpolated"] for row in line])
        between = np.where(exact, np.nan, errors)
        axes.plot(angles, between, style, color=colour, lw=1.4, label=f"{what}{suffix}")
        shown = exact & (errors > 0)  # the identity has no error to show on this axis
        face = "white" if reflected else colour
        axes.plot(angles[shown], errors[shown], "o", ms=3.5, color=colour, mfc=face)
    turns = sorted((row for row in rows if not row["reflected"]), key=itemgetter("angle"))
    changes = np.array([(row["angle"], row["interpolated"]) for row in turns]).reshape(-1, 2)
    axes.plot(*changes.T, ":", color=colour, lw=1, label=f"there and back{suffix}")
