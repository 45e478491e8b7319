"""The record of a run: with which versions, code, machine and seeds, when, and how it ended.

`run.json` in the run's folder has an entry for each session: each time a process trained there.
It tells nothing that would name a person or a computer unless ``logging.private=false``; nothing
of it is read by training, and a resumed run is the same whatever it says.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

import equirl
from equirl.config import Config, ConfigError, write_atomically
from equirl.modules import METHODS, resolve_backend
from equirl.symmetry import SymmetryGroup
from equirl.training.folder import CHECKPOINT, METRICS, RECORD
from equirl.training.privacy import private_word, without_paths
from equirl.training.repository import describe_repository
from equirl.training.seeding import Purpose, scene_seed

__all__ = ["Session", "read_record", "record_session", "summarize_record", "without_paths"]

_log = logging.getLogger("equirl")

#: What results may depend on.
_PACKAGES = ("torch", "torchrl", "tensordict", "escnn", "pybullet", "numpy", "scipy", "numba")

#: Of the record; to be raised when what stands in it changes.
_FORMAT = 1

#: What is read of the sessions before, and what it is.
_READ: dict[str, type | tuple[type, ...]] = {
    "outcome": (str, type(None)),
    "first_step": int,
    "minutes": (int, float),
    "versions": dict,
    "code": (dict, type(None)),
}


class Session:
    """One process's training in a folder, while it lasts.

    Args:
        record: All of the folder's record; this session is its last entry.
        folder: The run's folder.
        step: Tells how far training is.
    """

    def __init__(self, record: dict[str, Any], folder: Path, step: Callable[[], int]):
        self.record, self.folder, self.step = record, folder, step
        self._start = time.perf_counter()

    def end(self, outcome: str) -> None:
        """Writes down how the session ended: ``"finished"``, ``"stopped"``, or why it failed."""
        session = self.record["sessions"][-1]
        session["outcome"], session["last_step"] = outcome, self.step()
        session["ended"] = _timestamp(time.time())
        session["minutes"] = round((time.perf_counter() - self._start) / 60, 3)
        self.record["minutes"] = round(sum(each["minutes"] for each in self.record["sessions"]), 3)
        _write(self.folder, self.record)


@contextmanager
def record_session(config: Config, folder: Path, step: Callable[[], int]) -> Iterator[Session]:
    """Adds a session to the folder's record, and says how it ended when the context is left.

    A session whose end is not recorded by `Session.end` counts as stopped, or as failed when an
    error leaves the context. When versions or code are others than in the session before, a
    warning says so.

    Args:
        config: The run's configuration.
        folder: The run's folder.
        step: Tells how far training is.

    Raises:
        OSError: The record cannot be written.
    """
    record = _earlier_record(folder)
    sessions = record["sessions"]
    if sessions and sessions[-1]["outcome"] is None:
        _close_killed(sessions[-1], folder)
    streams = {purpose.name.lower(): scene_seed(config.seed, purpose) for purpose in Purpose}
    record["seeds"] = {"run": config.seed, "streams": streams}
    sessions.append(_describe_session(config, folder, sessions, step()))
    if len(sessions) > 1:
        _warn_of_changes(sessions[-2], sessions[-1])
    _write(folder, record)
    session = Session(record, folder, step)
    try:
        yield session
    except BaseException as error:
        reason = "interrupted"
        if not isinstance(error, KeyboardInterrupt):
            reason = f"failed: {type(error).__name__}: {' '.join(str(error).split())}"
        with suppress(OSError):  # of a full disk, which is the error that matters
            session.end(without_paths(reason) if config.logging.private else reason)
        raise
    if sessions[-1]["outcome"] is None:
        session.end("stopped")


def read_record(folder: Path) -> dict[str, Any] | None:
    """The record of a run's folder; None when it has none that can be read."""
    try:
        record = json.loads((folder / RECORD).read_text())
        _check(record)
    except (OSError, ValueError, TypeError, KeyError, IndexError, AttributeError):
        return None
    return record


def _check(record: Any) -> None:
    """Looks at all that is read of a record later; what lacks any of it is refused, anyhow."""
    if record["format"] != _FORMAT:
        raise ValueError(f"expected format {_FORMAT}, got {record['format']!r}")
    for session in record["sessions"]:
        datetime.fromisoformat(session["started"])
        if not all(isinstance(session[key], kinds) for key, kinds in _READ.items()):
            raise TypeError(f"expected {_READ}, got {session}")
        if code := session["code"]:
            _ = code["commit"], hash(code["digest"]), code["changes"]
    summarize_record(record)


def summarize_record(record: Mapping[str, Any]) -> list[str]:
    """The record as a few lines of Markdown."""
    sessions = record["sessions"]
    last = sessions[-1]
    machine, code, computing = last["machine"], last["code"], last["computing"]
    versions = ", ".join(f"{name} {number}" for name, number in last["versions"].items())
    processor = f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gib']} GiB"
    rows = {
        "versions": versions,
        "code": _describe_code(code),
        "machine": ", ".join([processor, *machine["gpus"], machine["system"]]),
        "computed on": f"{computing['device']}, {_count(computing['threads'], 'thread')}, "
        f"{computing['backend']} backend",
        "trained": f"{record['minutes']:.1f} minutes in {_count(len(sessions), 'session')}, from "
        f"{sessions[0]['started']}",
    }
    lines = ["| | |", "| --- | --- |", *(f"| {name} | {text} |" for name, text in rows.items())]
    changes = [
        f"Session {number} went on from step {now['first_step']} with {difference}."
        for number, (before, now) in enumerate(pairwise(sessions), start=2)
        if (difference := _difference(before, now))
    ]
    return [*lines, *([""] if changes else []), *changes]


def _earlier_record(folder: Path) -> dict[str, Any]:
    record = read_record(folder)
    if record is None:
        if (folder / RECORD).exists():
            _log.warning("%s cannot be read; the record of this run begins anew", RECORD)
        record = {"format": _FORMAT, "minutes": 0.0, "sessions": []}
    return record


def _close_killed(session: dict[str, Any], folder: Path) -> None:
    """Ends a session that had no time to do so, at the last sign of it that is found."""
    signs = [(folder / name) for name in (METRICS, CHECKPOINT, "timing.csv")]
    last = max((path.stat().st_mtime for path in signs if path.exists()), default=0.0)
    started = datetime.fromisoformat(session["started"]).timestamp()
    last = max(last, started)
    session["outcome"] = "killed"
    session["ended"], session["minutes"] = _timestamp(last), round((last - started) / 60, 3)


def _describe_session(
    config: Config, folder: Path, earlier: list[dict[str, Any]], step: int
) -> dict[str, Any]:
    private = config.logging.private
    command = [Path(sys.executable).name if private else sys.executable, *sys.argv]
    session: dict[str, Any] = {
        "started": _timestamp(time.time()),
        "ended": None,
        "outcome": None,
        "first_step": step,
        "last_step": step,
        "minutes": 0.0,
        "command": [private_word(word) for word in command] if private else command,
        "versions": _versions(),
        "code": describe_repository(folder, earlier),
        "machine": _describe_machine(),
        "computing": {
            "device": config.torch_device,
            "threads": torch.get_num_threads(),
            "backend": _backend(config),
        },
    }
    if not private:
        session["machine"] |= {"host": platform.node(), "user": _user()}
        session["folder"] = str(folder.absolute())
    return session


def _versions() -> dict[str, str]:
    versions = {"equirl": equirl.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:  # of an extra
            continue
    return versions


def _describe_machine() -> dict[str, Any]:
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (ValueError, OSError):  # not told here
        memory = 0.0
    devices = range(torch.cuda.device_count()) if torch.cuda.is_available() else ()
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(memory, 1),
        "gpus": [torch.cuda.get_device_name(device) for device in devices],
        "system": _system(),
    }


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = ""
    model = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return model[1].strip() if model else platform.processor() or platform.machine()


def _system() -> str:
    kernel = f"{platform.system()} {platform.release()}"
    try:
        return f"{platform.freedesktop_os_release()['PRETTY_NAME']} ({kernel})"
    except (OSError, KeyError):
        return kernel


def _user() -> str:
    import getpass

    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a number without a name
        return str(os.getuid())


def _backend(config: Config) -> str:
    """What the networks really run on, ``"auto"`` resolved."""
    if not METHODS[config.method.name].equivariant:
        return "torch"
    try:
        group = SymmetryGroup(config.group)
        return resolve_backend(config.backend, group, config.torch_device)
    except (ValueError, RuntimeError, ConfigError):  # told by what builds the networks
        return config.backend


def _warn_of_changes(before: dict[str, Any], now: dict[str, Any]) -> None:
    difference = _difference(before, now)
    if difference:
        _log.warning("this run goes on with %s: results may differ from here on", difference)


def _difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """What changed from one session to the next, in words; nothing when nothing did."""
    old, new = before["versions"], now["versions"]
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    changed = [f"{name} {new.get(name, 'gone')} (was {old.get(name, 'absent')})" for name in names]
    was, code = before["code"] or {}, now["code"] or {}
    if any(was.get(key) != code.get(key) for key in ("commit", "digest")):
        changed.append(f"code {_describe_code(code)} (was {_describe_code(was)})")
    return ", ".join(changed)


def _describe_code(code: Mapping[str, Any] | None) -> str:
    if not code:
        return "under no version control"
    text = f"commit {code['commit'][:12]}"
    if code["of"] != "equirl":
        text += f" of {code['of']}"
    if not code["dirty"]:
        return text
    if code["changes"]:
        return f"{text} with changes (`{code['changes']}`)"
    return f"{text} with changes that are not kept"


def _count(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"


def _timestamp(seconds: float) -> str:
    """A moment in UTC, to the second: the zone would tell where."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def _write(folder: Path, record: dict[str, Any]) -> None:
    write_atomically(folder / RECORD, json.dumps(record, indent=1) + "\n")
