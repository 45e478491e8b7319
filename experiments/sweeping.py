"""The runs of a sweep: their folders, how far each has come, and why one failed.

What stands in the folders is all there is to know about a sweep; whatever trains its runs, and
however that ended, the next command finds out here what is left to do.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from entry_point import mendable
from hydra.core.utils import JobReturn
from omegaconf import DictConfig
from run_processes import quoted, report_failure

from equirl.analysis.runs import CONFIG, FAILED, LOCK, METRICS, REPORT, TEST
from equirl.config import (
    Config,
    ConfigError,
    TrainJob,
    flatten,
    is_free,
    load_config,
    save_config,
)
from equirl.config.schema import is_execution

#: Below which those of conf/experiment name their sweeps' folders themselves.
_EXPERIMENTS = ("outputs", "experiments")

#: Seconds that runs have to save themselves before a launcher is asked again.
_PATIENCE = 60

#: Longest name of a folder; file systems end at 255 bytes.
_LONGEST = 200


@dataclass
class Run:
    """One run of a sweep.

    Attributes:
        overrides: What the command line and the experiment say of it, ``["seed=0", ...]``.
        config: Its configuration.
        folder: Where it is trained.
        state: ``"new"``, ``"begun"``, ``"finished"``, ``"failed"`` or ``"running"``, in another
            process.
        step: Training steps in its checkpoint.
        has_begun: Whether there is anything to go on with.
        reason: Why it failed.
        remark: What is odd about its folder, though nothing is to be done.
        label: What tells it from the other runs of its sweep.
    """

    overrides: list[str]
    config: Config
    folder: Path = field(default_factory=Path)
    state: str = "new"
    step: int = 0
    has_begun: bool = False
    reason: str = ""
    remark: str = ""
    label: str = ""

    def look(self) -> None:
        """Reads from the folder how far the run has come.

        Raises:
            ConfigError: The folder holds something else.
        """
        from equirl.analysis.status import is_locked
        from equirl.training.folder import CHECKPOINT, find_foreign

        self.state, self.step, self.has_begun = "new", 0, False
        self.reason = self.remark = ""
        there = {path.name for path in self.folder.iterdir()} if self.folder.is_dir() else set()
        if CONFIG not in there:
            if foreign := find_foreign(there):
                raise ConfigError(f"{self.folder} is not the folder of a run: it holds {foreign}")
            return
        if is_locked(self.folder / LOCK):
            self.state = "running"
        self.has_begun = bool(there & {CHECKPOINT, METRICS, TEST})
        if self.has_begun:
            self.step = _read_step(self.folder / CHECKPOINT)
            done = self.step == self.config.steps and {REPORT, TEST} <= there
            stored = self._stored(done)
            self._compare(stored)
            if self.step > self.config.steps:
                raise ConfigError(
                    f"{self.folder} is at step {self.step}, beyond steps={self.config.steps}"
                )
            if done and not self._changes(stored):
                self.state = "finished"
            elif self.state != "running":
                self.state = "begun"
        if FAILED in there and self.state not in ("finished", "running"):
            self.state, self.reason = "failed", _read_reason(self.folder / FAILED)

    def prepare(self) -> None:
        """Makes the folder, with the configuration in it that the run starts from.

        Why it failed before is forgotten: this time it may not be reached.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / FAILED).unlink(missing_ok=True)
        if not self.has_begun:
            save_config(self.config, self.folder / CONFIG)

    def arguments(self, threads: int = 0) -> list[str]:
        """What to say beside ``resume=`` so that the folder's run goes on as this one.

        Args:
            threads: Of a run that does not ask for a number.
        """
        stored = flatten(load_config(self.folder / CONFIG))
        wanted = flatten(self.config)
        wanted["threads"] = wanted["threads"] or threads
        return [
            f"{key}={quoted(value) if isinstance(value, str) else json.dumps(value)}"
            for key, value in wanted.items()
            if is_free(key) and stored.get(key) != value
        ]

    def keep_error(self, job: JobReturn) -> None:
        """Keeps in the folder what a launcher's job ended of, where that was not the training."""
        from equirl.training.privacy import without_paths

        try:
            _ = job.return_value
        except Exception as error:  # Hydra's way to hand it on
            text = "".join(traceback.format_exception(error))
            report_failure(
                self.folder, without_paths(text) if self.config.logging.private else text
            )

    @property
    def last_words(self) -> str:
        """Why it failed, in one line."""
        return self.reason.splitlines()[-1] if self.reason else "unknown reason"

    def __str__(self) -> str:
        return self.label or self.folder.name or " ".join(self.overrides)

    def describe(self) -> str:
        """How far it has come, in words."""
        at = f"at step {self.step} of {self.config.steps}"
        return {
            "begun": f"begun, {at}",
            "failed": f"failed, {at}: {self.last_words}",
            "running": f"running, {at}",
        }.get(self.state, self.state)

    def _stored(self, done: bool) -> dict[str, object]:
        """The configuration in its folder; of a finished run that of another version will do."""
        try:
            return flatten(load_config(self.folder / CONFIG))
        except ConfigError as error:
            if not done:
                raise
            self.remark = f"finished and left alone, though {error}"
            return flatten(self.config)

    def _compare(self, stored: dict[str, object]) -> None:
        different = [
            f"{key} is {stored.get(key)} there and {value} here"
            for key, value in flatten(self.config).items()
            if not is_free(key) and stored.get(key) != value
        ]
        if different:
            raise ConfigError(f"{self.folder} is of another configuration: {'; '.join(different)}")

    def _changes(self, stored: dict[str, object]) -> bool:
        """Whether what a finished run leaves would be another with this configuration."""
        return any(
            stored.get(key) != value
            for key, value in flatten(self.config).items()
            if not is_execution(key)
        )


def as_config(job: TrainJob) -> Config:
    """The run that a command line asks for."""
    return Config(**{name: getattr(job, name) for name in Config.__dataclass_fields__})


def give_folders(
    runs: Sequence[Run], sweep: Path, *, first: Sequence[str] = (), in_path: Sequence[str] = ()
) -> None:
    """Gives each run a folder of its own, named after the keys that the command line gives.

    The same run has the same folder in every sweep over these keys, however few of its values
    are asked for.

    Args:
        runs: All runs of the sweep.
        sweep: The sweep's folder.
        first: Keys to begin the names with, so that what is cut from a long one is the rest.
        in_path: Keys that the sweep's own path already tells.

    Raises:
        ConfigError: Two runs are the same.
    """
    seen: dict[str, Run] = {}
    for run in runs:
        values = {k: v for k, v in flatten(run.config).items() if not is_execution(k)}
        twin = seen.setdefault(json.dumps(values, sort_keys=True, default=str), run)
        if twin is not run:
            raise ConfigError(f"no run was begun, since two are the same: {twin}, {run}")
    raw = ["_".join(_told(run, first, in_path)) for run in runs]
    names = [_file_name(name) for name in raw]
    counts = Counter(names)
    for run, name in zip(runs, names, strict=True):
        if counts[name] > 1:
            name = _with_digest(name, "\n".join(run.overrides))
        run.folder = sweep / name


def wait_until_saved(runs: Sequence[Run]) -> None:
    """Looks at runs until what trained them has had time to save them."""
    for _ in range(_PATIENCE):
        for run in runs:
            run.look()
        runs = [run for run in runs if run.state == "running"]
        if not runs:
            break
        time.sleep(1)


def go_on(config: DictConfig) -> str:
    """How a sweep is gone on with.

    Args:
        config: The sweep's, with Hydra's own keys.
    """
    folder = os.path.relpath(config.hydra.sweep.dir)
    if "experiment" in config.hydra.runtime.choices or Path(folder).parts[:2] == _EXPERIMENTS:
        return "the same command"
    return f"the same command and 'hydra.sweep.dir=\"{folder}\"'"


@contextmanager
def recorded(folder: Path, *, private: bool) -> Iterator[None]:
    """Lets a sweep survive a run that fails: tells the reason and keeps it in the run's folder.

    Args:
        folder: The run's.
        private: Whether no absolute path may be kept.
    """
    from equirl.training.folder import FolderInUse
    from equirl.training.privacy import without_paths

    try:
        yield
    except FolderInUse as error:  # another process trains it: it has not failed
        print(f"error: {error}", file=sys.stderr, flush=True)
    except Exception as error:
        if isinstance(error, mendable()):
            text = str(error)
        else:
            traceback.print_exc()
            text = "".join(traceback.format_exception(error))
        report_failure(folder, without_paths(text) if private else text)


def _told(run: Run, first: Sequence[str], in_path: Sequence[str]) -> list[str]:
    """What of the command line makes the name of a folder, in its order there.

    Of a key the value that it has come to, however it was spelt: C4 of ``group=c4``.
    """
    values = flatten(run.config)
    for key, options in list(values.items()):
        if isinstance(options, dict):
            values |= {f"{key}.{name}": value for name, value in options.items()}
    told = set()
    for text in run.overrides:
        key, _, value = text.lstrip("+").partition("=")
        if key in in_path or is_execution(key) or key in ("experiment", "dry_run"):
            continue
        if key in values:
            value = values[key] if isinstance(values[key], str) else json.dumps(values[key])
        told.add((key not in first, f"{key}-{value}"))
    return [text for _, text in sorted(told)]


def _file_name(text: str) -> str:
    """A name without characters that a path or a command line would take amiss."""
    name = re.sub(r"[^\w.,+-]", "-", text, flags=re.ASCII)
    return name if name == text and 0 < len(name) <= _LONGEST else _with_digest(name, text)


def _with_digest(name: str, text: str) -> str:
    if not name:
        return "run"
    digest = hashlib.blake2b(text.encode(), digest_size=4).hexdigest()
    return f"{name[: _LONGEST - 9]}_{digest}"


def _read_reason(path: Path) -> str:
    """What a failed run left, as far as it can be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:  # it is gone since, or was never a file
        return ""


def _read_step(checkpoint: Path) -> int:
    """The step of a checkpoint; 0 of one that is missing or damaged: the run will say so."""
    import torch

    try:  # only what is looked at is read, however large the file
        return torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)["step"]
    except Exception:  # torch raises many kinds for a damaged file
        return 0
