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

__all__ = ["CheckpointError", "check_same_config", "load_checkpoint", "save_checkpoint"]

_FORMAT = 5


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be written or read; the message says why."""


def save_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Writes ``state`` to ``path``, replacing what is there only once all is on disk.

    Raises:
        CheckpointError: The disk is full or the folder cannot be written; the previous
            checkpoint is untouched.
    """
    partial = path.with_suffix(".partial")
    try:
        with open(partial, "wb") as file:
            torch.save({"format": _FORMAT, **state}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except (OSError, RuntimeError) as error:
        partial.unlink(missing_ok=True)
        kept = "the previous checkpoint is kept" if path.exists() else "there is none yet"
        full = "" if isinstance(error, OSError) else " (is the disk full?)"  # torch's own words
        raise CheckpointError(f"cannot write {path}: {error}{full}; {kept}") from error


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Reads a checkpoint onto the CPU, without executing code from it.

    Raises:
        CheckpointError: The file is missing, damaged, or of another format.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # checks sums that torch does not
        if damaged:
            raise zipfile.BadZipFile(f"its part {damaged} is damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise CheckpointError(f"no checkpoint at {path}") from None
    except Exception as error:  # torch raises many kinds for a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{path} is not a readable checkpoint: {reason}") from error
    if not isinstance(state, dict) or state.get("format") != _FORMAT:
        raise CheckpointError(f"{path} is not a checkpoint of format {_FORMAT}")
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
