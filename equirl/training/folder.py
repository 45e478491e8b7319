"""The folder of a run: what is in it, who may write to it."""

from __future__ import annotations

import fcntl
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from equirl.analysis.runs import CONFIG, FAILED, LOCK, LOG, METRICS, REPORT, TEST, VIDEO
from equirl.config import Config, ConfigError, flatten, load_config
from equirl.config.schema import is_execution
from equirl.training.checkpoint import check_same_config, load_checkpoint

__all__ = [
    "CHANGES",
    "CHECKPOINT",
    "CONFIG",
    "CURVES",
    "FAILED",
    "FILES",
    "LOCK",
    "LOG",
    "METRICS",
    "RECORD",
    "REPORT",
    "TENSORBOARD",
    "TEST",
    "VIDEO",
    "WANDB",
    "FolderError",
    "FolderInUse",
    "check_folder",
    "claim_folder",
    "find_foreign",
    "is_finished",
    "load_run_config",
    "stop_on_interrupt",
]

CHECKPOINT, CURVES = "checkpoint.pt", "curves.png"
RECORD, CHANGES = "run.json", "changes.patch"
TENSORBOARD, WANDB = "tensorboard", "wandb"

#: What a run leaves in its folder.
FILES = {
    CONFIG: "the resolved configuration",
    METRICS: "a row a training episode",
    "validation.csv": "success of the greedy policy on the validation scenes, while training",
    TEST: "a row a test scene, after training",
    "symmetry.csv": "errors under the group, on the pixel grid and between, while training",
    "pretraining.csv": "contrastive loss and accuracy before training, of methods that have it",
    "timing.csv": "minutes so far, and milliseconds a call of each part of a step",
    CHECKPOINT: "networks, optimiser, replay buffer: all a resume needs",
    CURVES: "learning curves",
    VIDEO: "the learned policy at work",
    RECORD: "versions, code, machine, seeds, and when the run was trained",
    CHANGES: "how the code differed from its commit",
    FAILED: "why it failed when it was trained last",
    LOG: "what it said, when a launcher ran it",
    TENSORBOARD: "the tables for TensorBoard",
    WANDB: "the tables for wandb",
    REPORT: "this page",
}

#: Seconds within which a lock is given back that somebody took to see whether a run is there.
_LOOK = 1.0


class FolderError(RuntimeError):
    """A folder that a run cannot use; the message says why."""


class FolderInUse(FolderError):
    """A folder that another process is training in: later it can be used."""


def check_folder(folder: Path, config: Config) -> None:
    """Checks that a run may write into a folder.

    Raises:
        FolderError: The folder holds files of something else.
        CheckpointError: It holds the checkpoint of a run of another configuration.
    """
    others = {path.name for path in folder.iterdir()}
    if CONFIG not in others:
        if foreign := find_foreign(others):
            raise FolderError(
                f"{folder} is not empty and not the folder of a run (it holds {foreign}); "
                "choose another"
            )
        return
    try:
        stored = load_run_config(folder)
    except ConfigError as error:
        raise FolderError(
            f"{folder} is not the folder of a run ({error}); choose another"
        ) from None
    if others & {CHECKPOINT, METRICS, TEST}:  # it has begun
        check_same_config(flatten(config), flatten(stored), folder)
    if TEST in others and CHECKPOINT not in others:
        raise FolderError(
            f"{folder} holds the results of a run whose {CHECKPOINT} is gone; choose another folder"
        )


def find_foreign(names: Collection[str]) -> str:
    """The first file, by name, that is none of a run that has no configuration yet.

    Args:
        names: Of what a folder holds.

    Returns:
        Its name; empty if there is none.
    """
    early = {LOCK, LOG, FAILED, TENSORBOARD, WANDB}  # trackers begin before it is written
    return min((n for n in names if n not in early and ".partial" not in n), default="")


def is_finished(folder: Path, config: Config) -> bool:
    """Whether the folder holds the end of just this run, wherever and however it was computed.

    Raises:
        CheckpointError: Its checkpoint is damaged.
    """
    if not all((folder / name).exists() for name in (CONFIG, CHECKPOINT, TEST, REPORT)):
        return False
    stored = flatten(load_run_config(folder))
    if any(
        stored[key] != value and not is_execution(key) for key, value in flatten(config).items()
    ):
        return False
    state = load_checkpoint(folder / CHECKPOINT)
    check_same_config(flatten(config), state["config"], folder / CHECKPOINT)
    return state["step"] == config.steps


def load_run_config(folder: Path) -> Config:
    """The configuration a run's folder was made with.

    Raises:
        ConfigError: There is none, or it is not valid.
    """
    return load_config(folder / CONFIG)


@contextmanager
def claim_folder(folder: Path) -> Iterator[None]:
    """Makes the folder and keeps a second process from training into it.

    The claim ends with the process, however that ends. Trouble with the disk inside the
    context becomes a FolderError too.

    Raises:
        FolderInUse: Another run is using the folder.
        FolderError: It cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder):
            yield
    except OSError as error:
        raise FolderError(
            f"cannot write to the run's folder {folder}: {error}; what its checkpoint holds is safe"
        ) from error


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    deadline = time.monotonic() + _LOOK
    with open(folder / LOCK, "w") as lock:
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise FolderInUse(f"another run is writing to {folder}") from None
                time.sleep(_LOOK / 20)
        yield


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Turns the first Ctrl-C (or a termination request) into a question with answer yes.

    A second one interrupts at once, as usual. Outside the main thread, where signals
    cannot be handled, the answer is always no.

    Raises:
        KeyboardInterrupt: At the second one.
    """
    asked = insisted = False
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        print(
            "\nstopping soon, nothing is lost; once more stops at once", file=sys.stderr, flush=True
        )
        for each in numbers:
            signal.signal(each, insist)

    def insist(number: int, frame: FrameType | None) -> None:
        nonlocal insisted
        insisted = True
        raise KeyboardInterrupt

    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield lambda: asked
    except Exception as error:
        if insisted:  # libraries turn the interrupt into errors of theirs
            raise KeyboardInterrupt from error
        raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
