"""What the Hydra command lines share: each mistake of a user's ends in one sentence.

Imported before torch, for whose threads it sets the environment.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn, TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from equirl.config import ConfigError, explain, register, to_config

Job = TypeVar("Job")

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL logs to the standard output
# Threads that wait for one another soon sleep: where other work keeps a core busy, spinning
# makes two threads ten times slower than one.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra hands its errors on; they are told below


def entry_point(name: str, schema: type[Job]) -> Callable[[Callable[[Job], None]], Callable]:
    """Makes a command line of a function that takes a validated job.

    Args:
        name: The file of ``conf`` it starts from.
        schema: The form of its keys, a dataclass of `equirl.config`.
    """

    def decorate(main: Callable[[Job], None]) -> Callable[[], None]:
        composed = False
        failed: list[str] = []  # jobs of a multirun, each with its reason

        def job(values: DictConfig) -> None:
            nonlocal composed
            composed = True
            try:
                with _messages():
                    main(to_config(values, schema))
            except Exception as error:  # and not an interrupt, that must not import anything
                if not isinstance(error, mendable()):
                    raise
                if not is_multirun():
                    sys.exit(f"error: {error}")
                print(f"error: {error}", file=sys.stderr, flush=True)
                failed.append(f"{' '.join(HydraConfig.get().overrides.task)}: {error}")

        def run() -> None:
            nonlocal composed
            composed = False
            failed.clear()
            register()
            conf = Path(__file__).parents[1] / "conf"
            previous = signal.signal(signal.SIGINT, _end)
            given = sys.argv
            if _asks_for_experiment(given[1:]):
                sys.argv = [given[0], "--multirun", *given[1:]]
            try:
                hydra.main(version_base="1.3", config_path=str(conf), config_name=name)(job)()
            except Exception as error:
                if composed or not is_mistake(error):
                    raise
                sys.exit(f"error: {explain(error, schema)}{_missing_launcher(error)}")
            finally:
                sys.argv = given
                if signal.getsignal(signal.SIGINT) is _end:  # else it was stopped for good
                    signal.signal(signal.SIGINT, previous)
            if failed:
                sys.exit("\n".join([f"{len(failed)} jobs failed:", *failed]))

        return run

    return decorate


def _asks_for_experiment(arguments: list[str]) -> bool:
    """Whether this is a sweep by its experiment, which says so in its file.

    Hydra would find out by itself, but not where there is a mistake in what is beside it, and
    then complains of the commas.
    """
    flags = [text for text in arguments if text.startswith("-")]
    return not flags and any(text.startswith("+experiment=") for text in arguments)


def _missing_launcher(error: Exception) -> str:
    """What to install, where a launcher is asked for that is not there."""
    if "hydra/launcher" not in str(error):
        return ""
    return "; joblib, slurm and slurm_local come with pip install 'equirl[launchers]'"


def _end(number: int, frame: FrameType | None) -> None:
    """Ends the process at an interrupt: outside of training there is nothing to be saved.

    An exception would not do: libraries that are being imported swallow it or are torn apart.
    """
    os.write(2, b"\nstopped\n")  # past buffers that the interrupted code may hold
    os._exit(130)


@contextmanager
def _messages() -> Iterator[None]:
    """Shows the package's own messages on the standard error."""
    log, handler = logging.getLogger("equirl"), logging.StreamHandler()
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.disabled = False  # Hydra disables what was there before
    try:
        yield
    finally:
        log.removeHandler(handler)


def stop(message: str) -> NoReturn:
    """Ends the process as an interrupt does; a further one cannot spoil its last words."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    print(message, file=sys.stderr, flush=True)
    sys.exit(130)


def is_multirun() -> bool:
    """Whether the present job is one of a multirun."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def is_mistake(error: Exception) -> bool:
    """Whether an error tells why a configuration cannot be composed.

    Any other is one of our code, or of code that the configuration names, and keeps its traceback.
    """
    kinds = (ConfigError, HydraException, OmegaConfBaseException, YAMLError, OSError)
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    raised_in = frame.f_globals["__name__"]  # Hydra raises a ValueError now and then
    return isinstance(error, kinds) or raised_in.startswith("hydra.")


def mendable() -> tuple[type[Exception], ...]:
    """Returns the errors that say by themselves what the user can do."""
    from equirl.analysis import TableError
    from equirl.collectors import DemonstrationError
    from equirl.data import DatasetError
    from equirl.envs import PlacementError
    from equirl.training import CheckpointError, ExportError, FolderError

    return (
        *(ConfigError, FolderError, CheckpointError, TableError),
        *(DatasetError, DemonstrationError, ExportError, PlacementError),
    )
