"""Metrics of a run: CSV tables always, TensorBoard and wandb on request.

The tables are the truth. A tracker is told what they hold when a run begins or is resumed, then
each new row; a tracker that fails is left behind, and the run goes on.
"""

from __future__ import annotations

import csv
import importlib.util
import logging
import shutil
import subprocess
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from equirl.analysis import read_table
from equirl.analysis.tables import read_rows
from equirl.config import Config, ConfigError, flatten, write_atomically
from equirl.training.folder import TENSORBOARD, WANDB
from equirl.training.privacy import private_value

__all__ = ["Averages", "MetricsLog", "Tracker"]

_log = logging.getLogger("equirl")

Row = Mapping[str, float | int]

#: Seconds that wandb may take at the end to send what is left: without a network it would try on
#: and on. What it has not sent by then is in its folder, for ``wandb sync``.
_PATIENCE = 120


class Tracker(Protocol):
    """Where metrics go beside the tables."""

    name: str

    def begin(self, tables: Mapping[str, Sequence[Row]]) -> None:
        """Takes what the run's tables hold already, each point once however often it is told."""

    def write(self, table: str, row: Row) -> None:
        """Takes one new row."""

    def show(self, film: Path, step: int) -> None:
        """Takes the film of the policy after so many steps."""

    def close(self) -> None:
        """Writes what is left."""


class MetricsLog:
    """Appends rows to ``<table>.csv`` in the run's folder and forwards them to trackers.

    Every row begins with ``step``. Wall-clock readings go to a table of their own
    (``timing``), so that all other tables are a function of configuration and seed.

    Args:
        folder: The run's folder.
        config: Says which trackers are wanted, and is shown there.

    Raises:
        ConfigError: A tracker that this machine does not have, or that refuses to begin.
    """

    TABLES = ("metrics", "validation", "symmetry", "timing", "pretraining")

    def __init__(self, folder: Path, config: Config):
        self.folder = folder
        self.trackers: list[Tracker] = _trackers(folder, config)

    def rewind(self, step: int, pretraining: int = 0) -> None:
        """Drops the rows after ``step``, which a resumed run will write again.

        Trackers are then told the rows that stay.

        Args:
            step: Training steps done.
            pretraining: The same for the table of pre-training, which has steps of its own.

        Raises:
            TableError: A table is damaged; it is left as it is.
        """
        tables = {}
        for table in self.TABLES:
            path = self.folder / f"{table}.csv"
            if not path.exists():
                continue
            steps = read_table(path, ["step"]).get("step", [])  # a damaged table is refused here
            lines = [line for line in path.read_text().splitlines(True) if line.endswith("\n")]
            last = pretraining if table == "pretraining" else step
            kept = [line for line, at in zip(lines[1:], steps, strict=False) if at <= last]
            write_atomically(path, "".join(lines[:1] + kept))
            tables[table] = read_rows(path)
        self._tell(lambda tracker: tracker.begin(tables))

    def write(self, table: str, row: Row) -> None:
        """Appends one row; its first key must be ``step``."""
        path = self.folder / f"{table}.csv"
        new = not path.exists() or path.stat().st_size == 0
        with open(path, "a", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(row), lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerow(row)
        self._tell(lambda tracker: tracker.write(table, row))

    def conclude(self, results: Row, film: Path | None = None) -> None:
        """Tells the trackers how the run ended, under ``test``; the tables have it already.

        Args:
            results: The trained policy on the test scenes, and the ``step`` it was trained to.
            film: An MP4 of it at work.
        """
        self._tell(lambda tracker: tracker.write("test", results))
        if film is not None:
            self._tell(lambda tracker: tracker.show(film, int(results["step"])))

    def close(self) -> None:
        """Finishes the trackers, so that another run in this process starts its own."""
        self._tell(lambda tracker: tracker.close())

    def _tell(self, call: Callable[[Tracker], None]) -> None:
        """Calls each tracker; one that fails is warned about and never called again."""
        for tracker in list(self.trackers):
            try:
                call(tracker)
            except Exception as error:  # whatever kind their libraries raise
                self.trackers.remove(tracker)
                reason = " ".join(str(error).split()) or type(error).__name__
                _log.warning(
                    "%s failed and gets nothing more of this session (%s); the run goes on, its "
                    "CSV tables are complete",
                    tracker.name,
                    reason,
                )
                with suppress(Exception):
                    tracker.close()


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


def _trackers(folder: Path, config: Config) -> list[Tracker]:
    kinds: dict[str, Callable[[Path, Config], Tracker]] = {
        "tensorboard": _TensorBoard,
        "wandb": _Wandb,
    }
    wanted = [name for name in kinds if getattr(config.logging, name)]
    for package in wanted:
        if importlib.util.find_spec(package) is None:
            raise ConfigError(
                f"logging.{package}=true: the package {package} is not installed; "
                "it comes with pip install 'equirl[tracking]'"
            )
    return [kinds[name](folder, config) for name in wanted]


class _TensorBoard:
    """TensorBoard, through TorchRL's logger: scalars, configuration and film.

    Each session writes the whole history anew, then removes the file of the session before. So
    no point is there twice, those that a killed process had not yet written are there too, and
    a run whose TensorBoard was switched on late is shown from its start. Readers that watch the
    folder are told to forget what they have read (what ``purge_step=0`` does).
    """

    name = "TensorBoard"

    def __init__(self, folder: Path, config: Config):
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        self._earlier = list((folder / TENSORBOARD).glob("events.out.tfevents.*"))
        self._logger = TensorboardLogger(TENSORBOARD, log_dir=str(folder))
        self._config = _shown(config)

    def begin(self, tables: Mapping[str, Sequence[Row]]) -> None:
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from torch.utils.tensorboard.summary import hparams

        writer = self._logger.experiment.file_writer
        writer.add_event(Event(step=0, session_log=SessionLog(status=SessionLog.START)))
        lines = (f"| {key} | {value} |" for key, value in self._config.items())
        table = "\n".join(["| key | value |", "| --- | --- |", *lines])
        self._logger.experiment.add_text("configuration", table, 0)
        # TorchRL's `log_hparams` would make a folder for them, which shows as a second run.
        plain = {
            key: value if isinstance(value, bool | int | float) else str(value)
            for key, value in self._config.items()
        }
        for summary in hparams(plain, {"test/success_rate": 0}):
            writer.add_summary(summary)
        for name, rows in tables.items():
            for row in rows:
                self.write(name, row)
        self._logger.experiment.flush()
        for path in self._earlier:
            path.unlink(missing_ok=True)

    def write(self, table: str, row: Row) -> None:
        for name, value in row.items():
            if name != "step":
                self._logger.log_scalar(f"{table}/{name}", value, step=int(row["step"]))

    def show(self, film: Path, step: int) -> None:
        # TorchRL's `log_video` wants moviepy, to make of the frames the GIF that TensorBoard shows.
        from tensorboard.compat.proto.summary_pb2 import Summary

        image = Summary.Image(colorspace=3, encoded_image_string=_as_gif(film))
        value = Summary.Value(tag="policy", image=image)
        self._logger.experiment.file_writer.add_summary(Summary(value=[value]), step)

    def close(self) -> None:
        self._logger.experiment.close()


class _Wandb:
    """wandb, through TorchRL's logger: metrics, configuration and film.

    The run's id is made once and kept in its folder, so that all its sessions are one wandb run.
    wandb knows no resuming offline: each session begins a history of its own. So a session writes
    the whole history anew, then removes what the session before has written. Online the
    server says how far it is with each table, and gets what is behind that.
    """

    name = "wandb"

    def __init__(self, folder: Path, config: Config):
        import wandb
        from torchrl.record.loggers.wandb import WandbLogger

        self._folder = folder / WANDB
        self._offline = config.logging.wandb_mode == "offline"
        self._id = _kept_id(self._folder / "id.txt")
        self._sent: dict[str, float] = {}
        settings: dict[str, Any] = {"silent": True, "finish_timeout": _PATIENCE}
        if config.logging.private:  # neither host and user nor program, paths and output
            settings |= {"x_disable_meta": True, "x_disable_machine_info": True, "host": ""}
            settings |= {"disable_git": True, "disable_code": True, "console": "off"}
        try:
            self._logger = WandbLogger(
                exp_name=folder.name,
                id=self._id,
                offline=self._offline,
                mode=config.logging.wandb_mode,
                save_dir=str(folder),
                project=config.logging.wandb_project,
                config=_shown(config),
                log_env_packages=not config.logging.private,
                # Offline there is nothing to resume, and wandb would warn that it does not.
                resume=None if self._offline else "allow",
                settings=wandb.Settings(**settings),
            )
        except wandb.Error as error:  # without an account, say
            raise ConfigError(f"logging.wandb=true: {error}") from error

    def begin(self, tables: Mapping[str, Sequence[Row]]) -> None:
        summary = dict(self._logger.experiment.summary)  # of the server's run; empty offline
        steps = {key: value for key, value in summary.items() if key.endswith("/step")}
        self._sent = {key.removesuffix("/step"): value for key, value in steps.items()}
        for name, rows in tables.items():
            for row in rows:
                self.write(name, row)
        if self._offline:
            mine = Path(self._logger.experiment.dir).parent.name
            for earlier in self._folder.glob(f"offline-run-*-{self._id}*"):
                if earlier.name != mine:
                    shutil.rmtree(earlier, ignore_errors=True)

    def write(self, table: str, row: Row) -> None:
        # A resumed run writes what it has written before, the same numbers; a test is another.
        if table == "test" or row["step"] > self._sent.get(table, -1):
            values = {f"{table}/{name}": value for name, value in row.items() if name != "step"}
            self._logger.log_metrics(values, step=int(row["step"]))

    def show(self, film: Path, step: int) -> None:
        import wandb

        # The file as it is: TorchRL's `log_video` takes frames, and wants moviepy.
        video = wandb.Video(str(film), format="mp4")
        self._logger.experiment.log({"policy": video, "policy/step": step})

    def close(self) -> None:
        self._logger.experiment.finish()


def _shown(config: Config) -> dict[str, Any]:
    """The configuration as trackers show it, which others than its user may see."""
    flat = flatten(config)
    return private_value(flat) if config.logging.private else flat


def _kept_id(path: Path) -> str:
    """The id in a file, made and written there when it is missing."""
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        write_atomically(path, uuid.uuid4().hex[:12] + "\n")
    return path.read_text().strip()


def _as_gif(film: Path) -> bytes:
    """An MP4 as an animated GIF that repeats."""
    import imageio_ffmpeg

    # Colours of its own: the format's usual ones spoil the picture.
    colors = "split[film][copy];[copy]palettegen[colors];[film][colors]paletteuse"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(film)]
    command += ["-filter_complex", colors, "-f", "gif", "-"]
    return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=True).stdout
