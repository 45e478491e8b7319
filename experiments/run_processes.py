"""A run in a process of its own, watched: what kills it kills neither sweep nor watcher.

Launchers that train several runs at a time call this in their workers, which therefore load
neither torch nor the simulator.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from types import FrameType
from typing import Any

from hydra.core.override_parser.types import Quote, QuotedString

from equirl.analysis.runs import CONFIG, FAILED, LOG

#: In the folder of a sweep: where this file is, runs save themselves and end, and none begins.
STOP = "stop"

#: Exit code of a run that another process is training, and of a sweep that waits for such.
IN_USE = os.EX_TEMPFAIL

#: What is run.
SCRIPT = Path(__file__).with_name("train.py")

_PAUSE = 0.2  # seconds between two looks at a run

#: Whatever has threads of its own takes no more than the run may.
_THREADS = ("OMP", "MKL", "OPENBLAS", "NUMBA")


def let_workers_import() -> None:
    """Shows other processes, on this machine or another, where this code is."""
    experiments = Path(__file__).parent
    before = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    paths = [str(experiments), str(experiments.parent), *before]
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(path for path in paths if path))


class RunInProcess:
    """What a worker of a launcher calls: trains the run that ``resume`` names.

    Args:
        stops: Files; where one of them is, runs save themselves and end, and none begins.
        arguments: Of each run by its folder, beside ``resume=``.
        threads: Of a run that does not ask for a number; 0: as many as the worker has cores.
    """

    def __init__(
        self, stops: Sequence[Path], arguments: Mapping[str, Sequence[str]], threads: int = 0
    ):
        self.stops, self.arguments, self.threads = list(stops), dict(arguments), threads

    def __call__(self, values: Mapping[str, Any]) -> str:
        """Returns how it ended, in words."""
        folder = Path(values["resume"])
        if self.should_stop():
            return "stopped"
        print(f"{folder.name}: begins", flush=True)
        threads = self.threads or len(os.sched_getaffinity(0))
        outcome = run_in_process(
            folder, self.arguments[str(folder)], threads=threads, should_stop=self.should_stop
        )
        print(f"{folder.name}: {outcome}", flush=True)
        return outcome

    def should_stop(self) -> bool:
        """Whether one of the files is there."""
        return any(path.exists() for path in self.stops)


def run_in_process(
    folder: Path,
    arguments: Sequence[str],
    *,
    threads: int,
    should_stop: Callable[[], bool] = lambda: False,
) -> str:
    """Trains in a new process until that ends; its words go to the folder's log.

    Args:
        folder: Of a run, with its configuration.
        arguments: Of the command line, beside ``resume=``.
        threads: Of the run, unless its arguments or its configuration name another number.
        should_stop: Asked all the time; True lets the run save itself and end.

    Returns:
        ``"finished"``, ``"stopped"``, ``"another process trains it"``, or ``"failed: "`` and
        why, which is kept in the folder.
    """
    try:
        return _run(folder, arguments, threads, should_stop)
    except (OSError, _Failure) as error:  # the first: of no log, no memory for a process
        reason = str(error)
    if "/" in reason and is_private(folder, arguments):
        from equirl.training.privacy import without_paths  # with torch, this once

        reason = without_paths(reason)
    report_failure(folder, reason, silent=True)
    return f"failed: {reason}"


class _Failure(Exception):
    """Why a run failed."""


def _run(
    folder: Path, arguments: Sequence[str], threads: int, should_stop: Callable[[], bool]
) -> str:
    """Trains until the process ends; how it ended, if it has not failed.

    Raises:
        _Failure: It has.
        OSError: The process cannot be started, or its log not be written.
    """
    (folder / FAILED).unlink(missing_ok=True)  # of an earlier attempt
    command = [sys.executable, str(SCRIPT), f"resume={quoted(folder)}", *arguments]
    environment = {f"{library}_NUM_THREADS": str(threads) for library in _THREADS}
    with open(folder / LOG, "ab") as log:
        begin = log.tell()
        process = subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **environment},
            start_new_session=True,  # Ctrl-C is for the sweep, which asks its runs
            preexec_fn=_follow_parent,
        )
        stopped = _watch(process, should_stop)
    code = process.returncode
    if code == 0:
        return "finished"
    if code == IN_USE:
        return "another process trains it"
    if code == 130 or (stopped and code == -signal.SIGTERM):
        return "stopped"
    with open(folder / LOG, "rb") as log:
        log.seek(begin)
        raise _Failure(_reason(code, log.read().decode(errors="replace")))


def quoted(text: str | Path) -> str:
    """A text as a value on Hydra's command line, whatever characters it is made of."""
    return QuotedString(str(text), Quote.double).with_quotes()


def report_failure(folder: Path, reason: str, *, silent: bool = False) -> None:
    """Keeps in a run's folder why it failed; a run that succeeds later takes it away."""
    if not silent:
        print(f"error: {reason.strip().splitlines()[-1]}", file=sys.stderr, flush=True)
    try:
        (folder / FAILED).write_text(reason.strip() + "\n")
    except OSError as error:  # the full disk, say, that it failed of
        print(f"cannot write {folder / FAILED}: {error}", file=sys.stderr, flush=True)


def _watch(process: subprocess.Popen[bytes], should_stop: Callable[[], bool]) -> bool:
    """Waits for the end; whether it was asked for. Signals that came take effect after it."""
    parent, asked = os.getppid(), False

    def ask() -> None:  # once: a second time would interrupt what the first has begun
        nonlocal asked
        if not asked and process.poll() is None:
            asked = True
            process.terminate()

    with _postponed() as received:
        try:
            while process.poll() is None:
                # The last: who launched it was killed.
                if received or should_stop() or os.getppid() != parent:
                    ask()
                time.sleep(_PAUSE)
        finally:
            ask()
            process.wait()
    for number in dict.fromkeys(received):
        signal.raise_signal(number)  # submitit queues the job again and ends the process
    return asked


@contextmanager
def _postponed() -> Iterator[list[int]]:
    """Notes signals that end or requeue the job, so that the run can save itself before.

    The handlers do no more than that: one that waited for the run could meet the watcher in the
    midst of asking how it is, and wait for that for ever.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    previous: dict[int, Any] = {n: signal.getsignal(n) for n in (signal.SIGUSR1, signal.SIGUSR2)}
    previous = {number: handler for number, handler in previous.items() if callable(handler)}

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    for number in previous:
        signal.signal(number, note)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # In a worker, which the sweep tells otherwise. Where the sweep is, it has a handler.
        previous[signal.SIGINT] = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _follow_parent() -> None:
    """In the new process: ends with its parent, and leaves the scheduler's signals to that."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG, of Linux
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # see on_interrupt
    for number in (signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def on_interrupt(ask: Callable[[], None]) -> Iterator[None]:
    """Calls ``ask`` at the first Ctrl-C or termination request; a second one ends the process.

    A terminal's Ctrl-C is for all processes that were started from it. An idle worker would die of
    it, for which joblib kills all others with the runs that they watch. Workers started in this
    context inherit that the signal is blocked, and a thread waits for it here.
    """
    asked, over = False, threading.Event()

    def take(number: int, frame: FrameType | None = None) -> None:
        nonlocal asked
        if asked:
            os._exit(130)
        asked = True
        ask()

    def wait() -> None:
        while not over.is_set():
            if signal.sigtimedwait({signal.SIGINT}, _PAUSE):
                take(signal.SIGINT)

    thread = threading.Thread(target=wait, daemon=True)
    # Of SIGINT, too: a library may have threads in which it is not blocked.
    previous = {n: signal.signal(n, take) for n in (signal.SIGINT, signal.SIGTERM)}
    resource_tracker.ensure_running()  # which unblocks it, when joblib's first worker is started
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        thread.start()
        yield
    finally:
        over.set()
        thread.join()
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in previous.items():
            signal.signal(number, handler)


def is_private(folder: Path, arguments: Sequence[str]) -> bool:
    """Whether no path may be kept of what a run says; where nothing says so, none is.

    Args:
        folder: Of the run.
        arguments: Of the command line.
    """
    from equirl.config import ConfigError, load_config

    for text in arguments:
        if text.startswith("logging.private="):
            return text != "logging.private=false"
    try:
        return load_config(folder / CONFIG).logging.private
    except ConfigError:
        return True


def _reason(code: int, said: str) -> str:
    """Why a process failed, from its exit code and its last words."""
    if code < 0:
        known = {number.value: number.name for number in signal.Signals}
        name = known.get(-code, f"signal {-code}")
        hint = ", as when the memory is full" if name == "SIGKILL" else ""
        return f"killed by {name}{hint}"
    lines = [line for line in said.splitlines() if line.strip()]
    for number, line in reversed(list(enumerate(lines))):
        if line.startswith("error: "):
            return line.removeprefix("error: ")
        # What goes wrong in tidying up afterwards is not what the process ended of.
        ignored = lines[number - 1].startswith("Exception ignored in")
        if line.startswith("Traceback (") and not ignored:
            break
    return (lines or [f"exit code {code}"])[-1]
