"""The entry points as a user calls them, in processes of their own."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
#: The smallest run there is.
SMOKE = ["preset=smoke", "group=c4", "env.robot=hand", "logging.progress=false", "threads=1"]


def start(script: str, *arguments: str, **options: Any) -> subprocess.Popen:
    """Starts a script of ``experiments``, in a folder of no interest unless ``cwd`` says so."""
    command = [sys.executable, str(ROOT / "experiments" / script), *arguments]
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"}
    environment |= {"HOME": "/nonexistent"}  # no wandb login, no caches to rely on
    settings = {"cwd": tempfile.gettempdir(), "env": environment | options.pop("env", {})}
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **{**settings, **options},
    )


def finish(process: subprocess.Popen) -> tuple[int, str, str]:
    """Waits for the end; returns the exit code, the output and the complaints."""
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def call(script: str, *arguments: str, **options: Any) -> tuple[int, str, str]:
    """Runs a script to its end."""
    return finish(start(script, *arguments, **options))
