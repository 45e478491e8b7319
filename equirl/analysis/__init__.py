"""From the folders of runs to statistics, curves and reports."""

from .statistics import moving_return, wilson_interval
from .tables import read_table

__all__ = ["moving_return", "read_table", "wilson_interval"]
