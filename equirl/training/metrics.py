"""Metrics of a run: CSV tables always, TensorBoard and wandb on request."""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from equirl.analysis import read_table
from equirl.config import Config, ConfigError, flatten, write_atomically

__all__ = ["Averages", "MetricsLog"]

Row = Mapping[str, float | int]


class MetricsLog:
    """Appends rows to ``<table>.csv`` in the run's folder and forwards them to trackers.

    Every row begins with ``step``. Wall-clock readings go to a table of their own
    (``timing``), so that all other tables are a function of configuration and seed.

    Args:
        folder: The run's folder.
        config: Says which trackers are wanted, and is shown there.
    """

    TABLES = ("metrics", "validation", "symmetry", "timing", "pretraining")

    def __init__(self, folder: Path, config: Config):
        self.folder = folder
        self.trackers = _trackers(folder, config)

    def rewind(self, step: int, pretraining: int = 0) -> None:
        """Drops the rows after ``step``, which a resumed run will write again.

        Args:
            step: Training steps done.
            pretraining: The same for the table of pre-training, which has steps of its own.

        Raises:
            TableError: A table is damaged; it is left as it is.
        """
        for table in self.TABLES:
            path = self.folder / f"{table}.csv"
            if not path.exists():
                continue
            steps = read_table(path, ["step"]).get("step", [])  # a damaged table is refused here
            lines = [line for line in path.read_text().splitlines(True) if line.endswith("\n")]
            last = pretraining if table == "pretraining" else step
            kept = [line for line, at in zip(lines[1:], steps, strict=False) if at <= last]
            write_atomically(path, "".join(lines[:1] + kept))

    def write(self, table: str, row: Row) -> None:
        """Appends one row; its first key must be ``step``."""
        path = self.folder / f"{table}.csv"
        new = not path.exists() or path.stat().st_size == 0
        with open(path, "a", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(row), lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerow(row)
        for tracker in self.trackers:
            for name, value in row.items():
                if name != "step":
                    tracker.log_scalar(f"{table}/{name}", value, step=int(row["step"]))

    def close(self) -> None:
        """Finishes the trackers, so that another run in this process starts its own."""
        for tracker in self.trackers:
            finish = getattr(tracker.experiment, "finish", None) or tracker.experiment.close
            finish()


class Averages:
    """Means of metrics over the updates since the last reading.

    Args:
        names: What there is to average.
    """

    def __init__(self, names: Iterable[str]):
        self._sums = dict.fromkeys(names, 0.0)
        self._count = 0

    def add(self, metrics: Mapping[str, float]) -> None:
        """Takes one update into the means."""
        self._count += 1
        for name in self._sums:
            self._sums[name] += metrics[name]

    def read(self) -> dict[str, float]:
        """The means, 0 without updates; starts anew."""
        means = {name: total / max(self._count, 1) for name, total in self._sums.items()}
        self.load_state_dict({"sums": dict.fromkeys(self._sums, 0.0), "count": 0})
        return means

    def state_dict(self) -> dict[str, Any]:
        """Sums and their count."""
        return {"sums": dict(self._sums), "count": self._count}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self._sums, self._count = dict(state["sums"]), state["count"]


def _trackers(folder: Path, config: Config) -> list[Any]:
    trackers: list[Any] = []
    for key, package in (("tensorboard", "tensorboard"), ("wandb", "wandb")):
        if getattr(config.logging, key) and importlib.util.find_spec(package) is None:
            raise ConfigError(
                f"logging.{key}=true: the package {package} is not installed; "
                "it comes with pip install 'equirl[tracking]'"
            )
    if config.logging.tensorboard:
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        trackers.append(TensorboardLogger("tensorboard", log_dir=str(folder)))
    if config.logging.wandb:
        import wandb
        from torchrl.record.loggers.wandb import WandbLogger

        try:
            tracker = WandbLogger(
                exp_name=folder.name,
                offline=config.logging.wandb_mode == "offline",
                save_dir=str(folder),
                project=config.logging.wandb_project,
                config=flatten(config),
                settings=wandb.Settings(silent=True),
            )
        except wandb.Error as error:  # without an account, say
            raise ConfigError(f"logging.wandb=true: {error}") from error
        trackers.append(tracker)
    return trackers
