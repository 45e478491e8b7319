"""The configuration of a run: typed, validated, and the same with or without Hydra."""

from equirl.config.declare import ConfigError, flatten
from equirl.config.jobs import (
    DemonstrationsJob,
    EvaluateJob,
    ExportJob,
    FiguresJob,
    ReportJob,
    TrainJob,
    WatchJob,
)
from equirl.config.reading import (
    explain,
    load_config,
    register,
    save_config,
    to_config,
    write_atomically,
)
from equirl.config.schema import Config, is_free

__all__ = [
    "Config",
    "ConfigError",
    "DemonstrationsJob",
    "EvaluateJob",
    "ExportJob",
    "FiguresJob",
    "ReportJob",
    "TrainJob",
    "WatchJob",
    "explain",
    "flatten",
    "is_free",
    "load_config",
    "register",
    "save_config",
    "to_config",
    "write_atomically",
]
