"""The entry points as a user calls them, in processes of their own."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np

ROOT = Path(__file__).parents[1]
#: The smallest run there is.
SMOKE = ["preset=smoke", "group=c4", "env.robot=hand", "logging.progress=false", "threads=1"]
_started: list[subprocess.Popen] = []


def start(script: str, *arguments: str, **options: Any) -> subprocess.Popen:
    """Starts a script of ``experiments``, in a folder of no interest unless ``cwd`` says so.

    Ctrl-C reaches it also where the tests run in a shell's background, which ignores it.
    """
    command = [sys.executable, str(ROOT / "experiments" / script), *arguments]
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"}
    environment |= {"HOME": "/nonexistent"}  # no wandb login, no caches to rely on
    settings = {"cwd": tempfile.gettempdir(), "env": environment | options.pop("env", {})}
    settings["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **{**settings, **options},
    )
    _started.append(process)
    return process


def end_all() -> None:
    """Ends what a test has left running."""
    while _started:
        process = _started.pop()
        process.kill()
        with process:
            pass  # closes its pipes


def finish(process: subprocess.Popen) -> tuple[int, str, str]:
    """Waits for the end; returns the exit code, the output and the complaints."""
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def frames_of(film: Path, side: int) -> np.ndarray:
    """The frames of a film, shape (T, side, 2 side, 3)."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", film, "-f", "rawvideo"]
    done = subprocess.run([*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, side, 2 * side, 3)


def call(script: str, *arguments: str, **options: Any) -> tuple[int, str, str]:
    """Runs a script to its end."""
    return finish(start(script, *arguments, **options))
