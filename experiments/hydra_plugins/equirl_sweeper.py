"""Hydra's sweeper of ``experiments/train.py``: all combinations, checked first, finished or not.

Hydra's own trains what is finished again, finds a bad combination when its turn comes, and ends
with the first failure. This one hands its launcher what is left to do, whichever launcher it is.
"""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import planning
from entry_point import is_mistake
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf
from run_processes import IN_USE, STOP, RunInProcess, let_workers_import, on_interrupt, quoted
from sweeping import Run, as_config, give_folders, go_on, wait_until_saved

from equirl.analysis.runs import LOCK, SWEEP
from equirl.config import ConfigError, TrainJob, explain, to_config

#: How often a launcher is asked, when it gives up without having been stopped.
_LAUNCHES = 3


class RunsSweeper(BasicSweeper):
    """Trains what is left of a sweep.

    Args:
        max_batch_size: Runs handed to the launcher at a time; None: all.
        params: Values of keys, ``{"seed": "0,1"}``, which the command line replaces.
    """

    config: DictConfig
    hydra_context: HydraContext

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
            self._check_stopped()
            complaint = self._train(pending, self._threads(parallel))
        self._conclude(runs, pending, complaint)

    def _check_numbers(self) -> None:
        """Refuses numbers of runs or cores that nothing could be trained with."""
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
        loader = self.hydra_context.config_loader
        given = [f"{key}={value}" for key, value in self.params.items()] + arguments
        parsed = OverridesParser.create(config_loader=loader).parse_overrides(given)
        for each in parsed:
            several = each.is_sweep_override() or isinstance(each.value(), list)
            if each.key_or_group == "experiment" and several:
                raise ConfigError(f"{each.input_line}: one experiment a command")
        (combinations,) = self.split_arguments(parsed, None)
        if not combinations:
            raise ConfigError(f"the sweep has no runs: {' '.join(given)}")
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
            except Exception as error:
                if not is_mistake(error):
                    raise
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
            except ConfigError as error:
                wrong.append(f"{run}: {error}; choose another hydra.sweep.dir")
                continue
            if run.remark:
                print(f"{run}: {run.remark}", file=sys.stderr, flush=True)
            try:
                if not self._is_elsewhere:
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

    def _check_stopped(self) -> None:
        """Refuses to take the file away that runs of other commands are to find yet."""
        from equirl.analysis.status import is_locked

        stop = self._folder / STOP
        running = [path.parent.name for path in self._folder.glob(f"*/{LOCK}") if is_locked(path)]
        if running and stop.exists():
            raise ConfigError(
                f"what runs here is being stopped by {stop}, and {running[0]} is still saving "
                "itself; try again when it has ended, or remove the file"
            )

    def _train(self, pending: Sequence[Run], threads: int) -> str:
        """Lets the launcher train; returns what it complained of."""
        stop = self._folder / STOP
        self._folder.mkdir(parents=True, exist_ok=True)
        stop.unlink(missing_ok=True)
        OmegaConf.save(self.config, self._folder / SWEEP)
        for run in pending:
            run.prepare()
        arguments = {str(run.folder): run.arguments(threads) for run in pending}
        if self._launcher_is("BasicLauncher"):
            return self._launch(self._launcher(self.task_function), pending, arguments)
        let_workers_import()
        scheduled = self._launcher_is("SlurmLauncher")
        own = self._folder / f".{STOP}-{secrets.token_hex(4)}"  # other commands' runs go on
        function = RunInProcess([stop, own], arguments, threads)
        launcher = self._launcher(function)
        complaint = ""
        with on_interrupt(lambda: _leave(stop) if scheduled else _ask(own)):
            for _ in range(_LAUNCHES):
                complaint = self._launch(launcher, pending, arguments)
                if not complaint:
                    own.unlink(missing_ok=True)  # no run that is to find it is left
                if not complaint or scheduled:
                    break  # a scheduler still has the other jobs, and would get them twice
                wait_until_saved(pending)
                if function.should_stop():
                    return ""  # of workers that were ended, too
                pending = [run for run in pending if run.state in ("new", "begun")]
                if not pending:
                    break
        return complaint

    def _launch(
        self, launcher: Launcher, pending: Sequence[Run], arguments: dict[str, list[str]]
    ) -> str:
        """Hands the launcher its jobs; returns what it complained of."""
        size, complaint = self.max_batch_size or len(pending), ""
        for first in range(0, len(pending), size):
            batch = pending[first : first + size]
            jobs = [
                [
                    f"resume={quoted(run.folder)}",
                    *arguments[str(run.folder)],
                    f"hydra.sweep.dir={quoted(self._folder)}",
                    f"hydra.sweep.subdir={quoted(run.folder.name)}",
                    "hydra.mode=MULTIRUN",
                ]
                for run in batch
            ]
            try:
                returns = launcher.launch(jobs, initial_job_idx=first)
            except SystemExit as stopped:  # a run in this process, which has said so
                if stopped.code != 130:
                    raise
                return ""
            except Exception as error:  # a worker that was killed, a job that was cancelled
                complaint = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
            else:
                for run, job in zip(batch, returns, strict=True):
                    run.keep_error(job)
        return complaint

    def _launcher(self, function: TaskFunction) -> Launcher:
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
        return Path(self.config.hydra.sweep.dir).resolve()

    @property
    def _choice(self) -> str:
        return self.config.hydra.runtime.choices["hydra/launcher"]

    def _launcher_is(self, name: str) -> bool:
        return self.config.hydra.launcher._target_.endswith(f".{name}")

    @property
    def _is_elsewhere(self) -> bool:
        """Whether runs are trained on other machines, of which nothing is known here."""
        address = self.config.hydra.launcher.get("address", "local")  # of Ray's cluster
        return self._launcher_is("SlurmLauncher") or address != "local"

    def _parallel(self, runs: int) -> int:
        """How many runs the launcher trains at a time."""
        settings = self.config.hydra.launcher
        if self._launcher_is("BasicLauncher"):
            return 1
        cores = len(os.sched_getaffinity(0))
        asked = settings.get("n_jobs") or settings.get("array_parallelism") or runs
        if self._launcher_is("RayLauncher") and not self._is_elsewhere:
            asked = cores // settings.cpus_per_run
        if asked < 0:  # joblib's: -1 all cores, -2 all but one
            asked = cores + 1 + asked
        return max(1, min(asked, runs, self.max_batch_size or runs))

    def _threads(self, parallel: int) -> int:
        """Threads of each run that does not ask for a number; 0: left to the run."""
        settings = self.config.hydra.launcher
        if self._launcher_is("BasicLauncher"):
            return 0
        reserved = settings.get("cpus_per_task") or settings.get("cpus_per_run")
        return reserved or max(1, len(os.sched_getaffinity(0)) // parallel)


def _refusal(wrong: Sequence[str]) -> ConfigError:
    """Says why nothing is trained: the first run that cannot be, and how many more there are."""
    more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
    return ConfigError(f"no run was begun, since one cannot be trained: {wrong[0]}{more}")


def _ask(stop: Path) -> None:
    """Tells the runs of this command to save themselves."""
    try:
        stop.touch()
        words = "stopping soon, nothing is lost; once more leaves the runs to it"
    except OSError as error:
        words = f"cannot stop the runs: {error}; once more leaves them to themselves"
    os.write(2, f"\n{words}\n".encode())  # past buffers that the interrupted code may hold


def _leave(stop: Path) -> NoReturn:
    """Ends this command alone."""
    os.write(2, f"\nthe jobs go on; they stop when there is a file {stop}\n".encode())
    os._exit(130)
