"""Several environments at once, each in a process of its own, watched."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from signal import Signals
from typing import Any

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, ParallelEnv

from equirl.envs.factory import make_env

__all__ = ["WatchedParallelEnv", "WorkerError", "make_parallel_env"]

_NAP = 5e-5  # s between two looks at the workers: they need the cores more than we do
_GRACE = 0.3  # s for the consequences of a process's end to arrive


class WorkerError(RuntimeError):
    """Workers died or hung; the message names them. The environment is closed."""


class WatchedParallelEnv(ParallelEnv):
    """A TorchRL `ParallelEnv` whose workers answer in bounded time, or are named and ended.

    What was collected before stays with the caller: an error ends the workers, not the run.

    Args:
        names: What each worker is called in messages; as many workers.
        create_env_fn: Makes each worker's environment.
        answer_within: S that the workers may take to start, and each to reset, step or end. With
            ``mp_start_method="spawn"`` allow for the imports of all of them.
        mp_start_method: How processes start: ``"fork"`` takes a fraction of a second, ``"spawn"``
            and ``"forkserver"`` import everything again but are safe beside CUDA.
        options: Further arguments of `ParallelEnv`.

    Raises:
        ValueError: If ``answer_within`` is not positive.
        WorkerError: When a worker dies or hangs, also while starting.
    """

    def __init__(
        self,
        names: Iterable[str],
        create_env_fn: Sequence[Callable[[], EnvBase]],
        *,
        answer_within: float = 60.0,
        mp_start_method: str = "fork",
        **options: Any,
    ):
        if not answer_within > 0:
            raise ValueError(f"answer_within must be positive (s), got {answer_within!r}")
        self.names = list(names)
        self.answer_within = answer_within
        super().__init__(
            len(create_env_fn),
            list(create_env_fn),
            mp_start_method=mp_start_method,
            shutdown_timeout=min(answer_within, 10.0),
            **options,
        )

    def _start_workers(self) -> None:
        # What is frozen the workers do not look through when they collect garbage at their end,
        # which makes ending them twenty times faster.
        gc.collect()
        gc.freeze()
        try:
            with self._bounded("start"):
                super()._start_workers()
        finally:
            gc.unfreeze()

    def set_seed(self, seed: int | None = None, static_seed: bool | None = False) -> int | None:
        """Seeds each worker, see `ParallelEnv.set_seed`."""
        self._require_workers()
        if self.is_closed:
            self.start()
        with self._bounded("take a seed"):
            return super().set_seed(seed, static_seed)

    def _reset(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        self._require_workers()
        return super()._reset(*args, **kwargs)

    def _step(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        self._require_workers()
        return super()._step(*args, **kwargs)

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Steps all workers and resets those that are done, see `EnvBase`."""
        self._require_workers()
        return super().step_and_maybe_reset(tensordict)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Ends the workers, also when some have ended already."""
        if self._dead():
            self._end_workers()
            return
        super().close(raise_if_closed=raise_if_closed)

    def _dead(self) -> set[int]:
        """Returns the workers whose processes have ended although nobody told them to."""
        if self.is_closed:
            return set()
        return {k for k, process in enumerate(self._workers) if not process.is_alive()}

    def _require_workers(self) -> None:
        dead = self._dead()
        if dead:
            self._give_up(dead, died="while nothing was asked of it")

    def _wait_for_workers(self, workers_range: Iterable[int]) -> None:
        """Returns when all of ``workers_range`` have done what they were told."""
        pending = set(workers_range)
        flags, place = self._shm_done_flags, self._worker_indices
        deadline = time.monotonic() + self.answer_within
        while True:
            done = {worker for worker in pending if flags[place[worker]]}
            for worker in done:
                flags[place[worker]] = 0
            pending -= done
            if not pending:
                return
            dead = pending & self._dead()
            if dead:
                self._give_up(dead, died="while it was stepped or reset")
            if time.monotonic() > deadline:
                self._give_up(pending, hung="answer")
            time.sleep(_NAP)

    def _cleanup_failed_worker_startup(self) -> None:
        """Leaves that to `_bounded`, which knows what failed."""

    @contextmanager
    def _bounded(self, what: str) -> Iterator[None]:
        """Bounds the time that workers take to ``what`` where TorchRL would wait for ever.

        It waits for one worker after the other, to read its pipe. Late, they are ended in turn
        until the wait is over: the one it waited for is the one that hangs.
        """
        over, hung = threading.Event(), set[int]()

        def watch() -> None:
            if over.wait(self.answer_within):
                return
            for worker, process in enumerate(self._workers):
                process.kill()
                if over.wait(_GRACE):
                    hung.add(worker)
                    return

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        except BaseException as error:
            over.set()
            watcher.join()
            time.sleep(_GRACE)  # for a process to end whose pipe has
            dead = {k for k, process in enumerate(self._workers) if not process.is_alive()}
            if hung:
                self._give_up(hung, hung=what, cause=error)
            if dead and isinstance(error, Exception):
                self._give_up(dead, died=f"before it could {what}", cause=error)
            self._end_workers()
            raise
        finally:
            over.set()

    def _give_up(
        self,
        workers: set[int],
        *,
        died: str = "",
        hung: str = "",
        cause: BaseException | None = None,
    ) -> None:
        """Ends all workers and says which of them died when, or hung at what."""
        told = []
        for worker in sorted(workers):
            process = self._workers[worker]
            what = f"{self.names[worker]} (worker {worker} of {len(self.names)}"
            code = f", {_exit(process.exitcode)}" if died else ""
            told.append(f"{what}, process {process.pid}{code})")
        self._end_workers()
        fault = f"died {died}" if died else f"did not {hung} within {self.answer_within:g} s"
        raise WorkerError(f"{'; '.join(told)} {fault}") from cause

    def _end_workers(self) -> None:
        for process in self._workers:
            process.kill()
        for process in self._workers:
            process.join(timeout=5)
        for channel in self.parent_channels:
            channel.close()
        self.is_closed = True


def _exit(code: int | None) -> str:
    """Returns how a process ended, in words."""
    return Signals(-code).name if code is not None and code < 0 else f"exit code {code}"


def make_parallel_env(
    task: str,
    workers: int,
    *,
    seed: int = 0,
    answer_within: float = 60.0,
    mp_start_method: str = "fork",
    **options: Any,
) -> WatchedParallelEnv:
    """Returns ``workers`` environments of a task that step together, each with its own scenes.

    Args:
        task: As for `make_env`.
        workers: How many processes.
        seed: Root of the seeds of all workers.
        answer_within: As for `WatchedParallelEnv`.
        mp_start_method: As for `WatchedParallelEnv`.
        options: As for `make_env`.

    Raises:
        ValueError: If an argument is not one of these.
    """
    if not isinstance(workers, int) or workers < 1:
        raise ValueError(f"workers must be a positive integer, got {workers!r}")
    make_env(task, seed=seed, **options)  # its errors belong here, not into the workers
    seeds = np.random.SeedSequence(seed).generate_state(workers, np.uint64)
    makers = [partial(make_env, task, seed=int(each), **options) for each in seeds]
    return WatchedParallelEnv(
        [f"{task}[{k}]" for k in range(workers)],
        makers,
        answer_within=answer_within,
        mp_start_method=mp_start_method,
    )
