"""From the folders of runs to statistics, curves and reports."""

from equirl.analysis.statistics import moving_return, wilson_interval
from equirl.analysis.tables import TableError, read_table, write_table

__all__ = ["TableError", "moving_return", "read_table", "wilson_interval", "write_table"]
