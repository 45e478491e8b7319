"""The folder of a run: what is in it, who may write to it."""

from __future__ import annotations

import fcntl
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from equirl.config import Config, flatten, load_config, save_config

from .checkpoint import check_same_config

__all__ = [
    "CHECKPOINT",
    "CONFIG",
    "FolderError",
    "claim_folder",
    "load_run_config",
    "prepare_folder",
    "stop_on_interrupt",
]

CONFIG = "config.yaml"
CHECKPOINT = "checkpoint.pt"


class FolderError(RuntimeError):
    """A folder that a run cannot use; the message says why."""


def prepare_folder(folder: Path, config: Config) -> None:
    """Makes the run's folder and writes the configuration into it.

    Raises:
        FolderError: The folder cannot be made or written.
        CheckpointError: It holds the checkpoint of a run of another configuration.
    """
    if (folder / CONFIG).exists() and (folder / CHECKPOINT).exists():
        check_same_config(flatten(config), flatten(load_run_config(folder)), folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_config(config, folder / CONFIG)
    except OSError as error:
        raise FolderError(f"cannot write to the run's folder {folder}: {error}") from error


def load_run_config(folder: Path) -> Config:
    """The configuration a run's folder was made with.

    Raises:
        ConfigError: There is none, or it is not valid.
    """
    return load_config(folder / CONFIG)


@contextmanager
def claim_folder(folder: Path) -> Iterator[None]:
    """Keeps a second process from training into the same folder.

    The claim ends with the process, however that ends.

    Raises:
        FolderError: Another run is using the folder.
    """
    with open(folder / ".lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise FolderError(f"another run is writing to {folder}") from None
        yield


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Turns the first Ctrl-C (or a termination request) into a question with answer yes.

    A second Ctrl-C interrupts at once, as usual.
    """
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    previous = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
