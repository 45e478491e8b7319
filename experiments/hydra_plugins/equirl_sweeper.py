"""Hydra's sweeper of ``experiments/train.py``: all combinations, checked first, finished or not.

Hydra's own trains what is finished again, finds a bad combination when its turn comes, and ends
with the first failure. This one hands its launcher what is left to do, whichever launcher it is.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import planning
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf
from run_processes import IN_USE, STOP, RunInProcess
from sweeping import Run, as_config, give_folders, go_on

from equirl.config import ConfigError, TrainJob, explain, to_config

#: How often a launcher is asked, when it gives up without having been stopped.
_LAUNCHES = 3

#: Seconds that runs have to save themselves before it is asked again.
_PATIENCE = 60


class RunsSweeper(BasicSweeper):
    """Trains what is left of a sweep.

    Args:
        max_batch_size: Runs handed to the launcher at a time; None: all.
        params: Values of keys, ``{"seed": "0,1"}``, which the command line replaces.
    """

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Takes what Hydra hands over; the launcher waits for the runs."""
        self.hydra_context, self.config, self.task_function = hydra_context, config, task_function

    def sweep(self, arguments: list[str]) -> None:
        """Checks every combination, then trains those that are not finished.

        Raises:
            ConfigError: A combination cannot be trained, or the launcher's numbers make no sense;
                none was begun.
            SystemExit: Not all are finished; some failed, were stopped, or another process trains
                them.
        """
        assert self.config is not None
        self._check_numbers()
        runs = self._runs(arguments)
        self._check(runs)
        pending = [run for run in runs if run.state not in ("finished", "running")]
        parallel = self._parallel(len(pending))
        print(f"sweep folder: {os.path.relpath(self._folder)}", flush=True)
        if self.config.dry_run:
            planning.print_plan(runs, parallel=parallel, threads=self._threads(parallel))
            return
        print(planning.count_states(runs), flush=True)
        complaint = ""
        if pending:
            self._check_stopped(runs)
            complaint = self._train(pending, self._threads(parallel))
        self._conclude(runs, pending, complaint)

    def _check_numbers(self) -> None:
        """Refuses numbers of runs or cores that nothing could be trained with."""
        assert self.config is not None
        settings = self.config.hydra.launcher
        numbers = {"sweeper.max_batch_size": self.max_batch_size}
        for name in ("array_parallelism", "cpus_per_task", "cpus_per_run"):
            numbers[f"launcher.{name}"] = settings.get(name)
        for key, number in numbers.items():
            if number is not None and not (isinstance(number, int) and number >= 1):
                raise ConfigError(f"hydra.{key}={number}: expected a whole number, 1 or more")
        if settings.get("n_jobs") == 0:
            raise ConfigError(
                "hydra.launcher.n_jobs=0: expected 1 or more, or -1 for as many as there are cores"
            )

    def _runs(self, arguments: list[str]) -> list[Run]:
        """All combinations, each with its configuration and its folder."""
        assert self.config is not None and self.hydra_context is not None
        loader = self.hydra_context.config_loader
        given = [f"{key}={value}" for key, value in self.params.items()] + arguments
        parsed = OverridesParser.create(config_loader=loader).parse_overrides(given)
        (combinations,) = self.split_arguments(parsed, None)
        common = set.intersection(*map(set, combinations))
        runs, wrong = [], []
        for overrides in combinations:
            label = " ".join(text for text in overrides if text not in common)
            try:
                values = loader.load_sweep_config(self.config, list(overrides))
                OmegaConf.set_struct(values, False)
                values.pop("hydra")
                job = to_config(values, TrainJob)
                if job.output or job.resume:
                    raise ConfigError(
                        "output= and resume= name one run; a multirun makes a folder for each"
                    )
                runs.append(Run(list(overrides), as_config(job), label=label))
            except Exception as error:  # Hydra's and OmegaConf's have no common base
                wrong.append(f"{label}: {explain(error, TrainJob)}" if label else str(error))
        if wrong:
            raise _refusal(wrong)
        presets = {text for run in runs for text in run.overrides if text.startswith("preset=")}
        told = "experiment" in self.config.hydra.runtime.choices and len(presets) < 2
        in_path = ["preset"] if told else []
        give_folders(runs, self._folder, first=list(self.params), in_path=in_path)
        return runs

    def _check(self, runs: Sequence[Run]) -> None:
        """Refuses what this machine or the folders do not allow; reads how far each run is."""
        wrong = []
        for run in runs:
            try:
                run.look()
                if run.remark:
                    print(f"{run}: {run.remark}", file=sys.stderr, flush=True)
                if not self._launcher_is("SlurmLauncher"):  # whose machines are others
                    _ = run.config.torch_device
                    processors = os.cpu_count() or 1
                    if run.config.threads > processors:
                        raise ConfigError(
                            f"threads={run.config.threads}: this machine has {processors} "
                            "processors"
                        )
            except ConfigError as error:
                wrong.append(f"{run}: {error}")
        if wrong:
            raise _refusal(wrong)

    def _check_stopped(self, runs: Sequence[Run]) -> None:
        """Refuses to take the file away that runs of an earlier command are to find yet."""
        stop = self._folder / STOP
        running = [run for run in runs if run.state == "running"]
        if running and stop.exists():
            raise ConfigError(
                f"an earlier command is being stopped by {stop}, and {running[0]} is still saving "
                "itself; try again when it has ended, or remove the file"
            )

    def _train(self, pending: Sequence[Run], threads: int) -> str:
        """Lets the launcher train; returns what it complained of."""
        assert self.config is not None
        stop = self._folder / STOP
        self._folder.mkdir(parents=True, exist_ok=True)
        stop.unlink(missing_ok=True)
        OmegaConf.save(self.config, self._folder / "multirun.yaml")
        for run in pending:
            run.prepare()
        in_process = not self._launcher_is("BasicLauncher")
        arguments = {str(run.folder): run.arguments(threads) for run in pending}
        function: Any = self.task_function
        if in_process:
            function = RunInProcess(self._folder, arguments, threads)
            _let_workers_import()
        launcher = self._launcher(function)
        complaint = ""
        for _ in range(_LAUNCHES):
            with _stopping(stop, in_process, self._launcher_is("SlurmLauncher")):
                complaint = self._launch(launcher, pending, arguments)
            if not complaint or stop.exists() or self._launcher_is("SlurmLauncher"):
                break  # a scheduler still has the other jobs, and would get them twice
            pending = [run for run in pending if _is_left(run)]
            if not pending:
                break
        return complaint

    def _launch(
        self, launcher: Launcher, pending: Sequence[Run], arguments: dict[str, list[str]]
    ) -> str:
        """Hands the launcher its jobs; returns what it complained of."""
        size, complaint = self.max_batch_size or len(pending), ""
        for first in range(0, len(pending), size):
            jobs = [
                [
                    f"resume={json.dumps(str(run.folder))}",
                    *arguments[str(run.folder)],
                    f"hydra.sweep.dir={json.dumps(str(self._folder))}",
                    f"hydra.sweep.subdir={json.dumps(run.folder.name)}",
                    "hydra.mode=MULTIRUN",
                ]
                for run in pending[first : first + size]
            ]
            try:
                launcher.launch(jobs, initial_job_idx=first)
            except Exception as error:  # a worker that was killed, a job that was cancelled
                complaint = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        return complaint

    def _launcher(self, function: TaskFunction) -> Launcher:
        assert self.config is not None and self.hydra_context is not None
        try:
            return Plugins.instance().instantiate_launcher(
                hydra_context=self.hydra_context, task_function=function, config=self.config
            )
        except (ImportError, RuntimeError) as error:  # not installed, or without its library
            extra = "ray" if self._launcher_is("RayLauncher") else "launchers"
            raise ConfigError(
                f"hydra/launcher={self._choice}: {error}; pip install 'equirl[{extra}]' brings it"
            ) from None

    def _conclude(self, runs: Sequence[Run], pending: Sequence[Run], complaint: str) -> None:
        """Tells how the sweep ended; the exit code says whether all is done.

        It is 0 if all runs are finished, 1 if some failed, 130 if some were stopped, and 75 if
        what is not finished is trained by other processes.
        """
        for run in runs:
            run.look()
        print(planning.count_states(runs), flush=True)
        failed = [f"{run}: {run.last_words}" for run in pending if run.state == "failed"]
        if failed:
            count = f"{len(failed)} {'runs' if len(failed) > 1 else 'run'} failed:"
            print("\n".join([count, *failed]), file=sys.stderr, flush=True)
        if complaint:
            print(f"{self._choice} ended early: {complaint}", file=sys.stderr, flush=True)
        if all(run.state == "finished" for run in runs):
            return
        print(f"go on with {go_on(self.config)}", file=sys.stderr, flush=True)
        if failed or complaint:
            sys.exit(1)
        left = any(run.state not in ("finished", "running") for run in runs)
        sys.exit(130 if left else IN_USE)

    @property
    def _folder(self) -> Path:
        """The sweep's, absolute: a worker may be elsewhere."""
        assert self.config is not None
        return Path(self.config.hydra.sweep.dir).resolve()

    @property
    def _choice(self) -> str:
        assert self.config is not None
        return self.config.hydra.runtime.choices["hydra/launcher"]

    def _launcher_is(self, name: str) -> bool:
        assert self.config is not None
        return self.config.hydra.launcher._target_.endswith(f".{name}")

    def _parallel(self, runs: int) -> int:
        """How many runs the launcher trains at a time."""
        assert self.config is not None
        settings = self.config.hydra.launcher
        if self._launcher_is("BasicLauncher"):
            return 1
        cores = len(os.sched_getaffinity(0))
        asked = settings.get("n_jobs") or settings.get("array_parallelism") or runs
        if self._launcher_is("RayLauncher") and settings.address == "local":
            asked = cores // settings.cpus_per_run
        if asked < 0:  # joblib's: -1 all cores, -2 all but one
            asked = cores + 1 + asked
        return max(1, min(asked, runs, self.max_batch_size or runs))

    def _threads(self, parallel: int) -> int:
        """Threads of each run that does not ask for a number; 0: left to the run."""
        assert self.config is not None
        settings = self.config.hydra.launcher
        if self._launcher_is("BasicLauncher"):
            return 0
        reserved = settings.get("cpus_per_task") or settings.get("cpus_per_run")
        return reserved or max(1, len(os.sched_getaffinity(0)) // parallel)


def _refusal(wrong: Sequence[str]) -> ConfigError:
    """Says why nothing is trained: the first run that cannot be, and how many more there are."""
    more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
    return ConfigError(f"no run was begun, since one cannot be trained: {wrong[0]}{more}")


def _is_left(run: Run) -> bool:
    """Whether a run is still to be trained, once what trained it has had time to save it."""
    for _ in range(_PATIENCE):
        run.look()
        if run.state != "running":
            break
        time.sleep(1)
    return run.state in ("new", "begun")


def _let_workers_import() -> None:
    """Shows other processes, on this machine or another, where this code is."""
    experiments = Path(__file__).parents[1]
    before = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    paths = [str(experiments), str(experiments.parent), *before]
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(path for path in paths if path))


@contextmanager
def _stopping(stop: Path, in_process: bool, elsewhere: bool) -> Iterator[None]:
    """Hands the first Ctrl-C, or a termination request, on to runs in processes of their own.

    Args:
        stop: The file that tells them.
        in_process: Whether there are such; a run in this process takes the signal itself.
        elsewhere: Whether they are a scheduler's, who goes on without us.
    """
    if not in_process:
        yield
        return

    def ask(number: int, frame: FrameType | None) -> None:
        for each in previous:
            signal.signal(each, insist)
        if elsewhere:
            os.write(2, f"\nthe jobs go on; they stop when there is a file {stop}\n".encode())
            os._exit(130)
        stop.touch()
        os.write(2, b"\nstopping soon, nothing is lost; once more leaves the runs to it\n")

    def insist(number: int, frame: FrameType | None) -> None:
        os._exit(130)

    previous = {n: signal.signal(n, ask) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
