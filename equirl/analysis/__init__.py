"""From the folders of runs to statistics, curves and reports."""

from equirl.analysis.runs import Run, read_runs
from equirl.analysis.statistics import (
    count_collapses,
    first_reaching,
    interquartile_mean,
    mean_and_error,
    moving_return,
    stratified_interval,
    wilson_interval,
)
from equirl.analysis.summary import Summary, summarise
from equirl.analysis.sweep import FIGURES, Curve, Figure, RunTables, Sweep, collect
from equirl.analysis.sweep_curves import draw_sweep, plot_sweep
from equirl.analysis.tables import TableError, read_table, write_table

__all__ = [
    "FIGURES",
    "Curve",
    "Figure",
    "Run",
    "RunTables",
    "Summary",
    "Sweep",
    "TableError",
    "collect",
    "count_collapses",
    "draw_sweep",
    "first_reaching",
    "interquartile_mean",
    "mean_and_error",
    "moving_return",
    "plot_sweep",
    "read_runs",
    "read_table",
    "stratified_interval",
    "summarise",
    "wilson_interval",
    "write_table",
]
