"""Checkpoints: one file that holds all a run needs to go on exactly where it was.

A checkpoint is a nested dictionary of tensors and plain values, written whole or not
at all and read without executing code.
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any

import torch

from equirl.config import is_free

__all__ = [
    "CheckpointError",
    "check_same_config",
    "load_checkpoint",
    "read_state",
    "save_checkpoint",
    "write_state",
]

_FORMAT = 5


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be written or read; the message says why."""


def save_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Writes ``state`` to ``path``, replacing what is there only once all is on disk.

    Raises:
        CheckpointError: The disk is full or the folder cannot be written; the previous
            checkpoint is untouched.
    """
    write_state({"format": _FORMAT, **state}, path)


def write_state(state: dict[str, Any], path: Path) -> None:
    """Writes tensors and plain values, as `save_checkpoint` does, without its format.

    Raises:
        CheckpointError: The disk is full or the folder cannot be written; what was there before
            is untouched.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        with open(partial, "wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except (OSError, RuntimeError) as error:
        partial.unlink(missing_ok=True)
        kept = "the previous file is kept" if path.exists() else "there is none yet"
        full = "" if isinstance(error, OSError) else " (is the disk full?)"  # torch's own words
        raise CheckpointError(f"cannot write {path}: {error}{full}; {kept}") from error


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Reads a checkpoint onto the CPU, without executing code from it.

    Raises:
        CheckpointError: The file is missing, damaged, or of another format.
    """
    state = read_state(path)
    if state.get("format") != _FORMAT:
        found = state.get("format", "none")
        raise CheckpointError(f"{path} is not a checkpoint of format {_FORMAT}; it has {found!r}")
    return state


def read_state(path: Path) -> dict[str, Any]:
    """Reads what `write_state` wrote onto the CPU, without executing code from it.

    Raises:
        CheckpointError: The file is missing or damaged, or holds no dictionary.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # checks sums that torch does not
        if damaged:
            raise zipfile.BadZipFile(f"its part {damaged} is damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise TypeError(f"it holds a {type(state).__name__}, expected a dictionary")
    except FileNotFoundError:
        raise CheckpointError(f"no checkpoint at {path}") from None
    except Exception as error:  # torch raises many kinds for a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{path} is not a readable checkpoint: {reason}") from error
    return state


def check_same_config(config: dict[str, Any], stored: dict[str, Any], where: Path) -> None:
    """Checks that a run may go on from what another configuration has left.

    Args:
        config: The run's configuration, flat (``{"env.task": ...}``).
        stored: The configuration found, flat.
        where: Where it was found, for the message.

    Raises:
        CheckpointError: They differ; the message names each key and both values.
    """
    different = [
        f"{key} is {stored.get(key)} there and {value} here"
        for key, value in config.items()
        if stored.get(key) != value and not is_free(key)
    ]
    if different:
        raise CheckpointError(
            f"{where} is of another configuration: {'; '.join(different)}. "
            "Choose another output folder, or resume the run with its own configuration."
        )
