"""A launcher through Ray, on one machine or a running cluster.

Hydra's own pins a cloudpickle that does not go with the rest (below 3), and brings what serves AWS
alone; this one needs Ray and nothing else.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf


class RayLauncher(Launcher):
    """Runs each job as a task of Ray's.

    Args:
        address: ``"local"`` starts Ray on this machine for as long as the sweep lasts; else the
            address of a running cluster, ``"auto"`` for that of this machine.
        cpus_per_run: Cores reserved for each.
        gpus_per_run: GPUs, or shares of one.
    """

    def __init__(self, address: str = "local", cpus_per_run: int = 1, gpus_per_run: float = 0):
        self.address = address
        self.resources = {"num_cpus": cpus_per_run, "num_gpus": gpus_per_run}

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Takes what Hydra hands over.

        Raises:
            ImportError: Ray is missing: the sweep ends before it begins.
        """
        import ray  # noqa: F401  not in the constructor, whose errors Hydra replaces

        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Trains all, and waits.

        Raises:
            RayError: Of the first worker that was killed, once all others have ended.
        """
        import ray

        options: dict[str, Any] = {}
        if self.address == "local":
            cores = max(len(os.sched_getaffinity(0)), int(self.resources["num_cpus"]))
            options = {"num_cpus": cores, "include_dashboard": False}
        path = {"PYTHONPATH": os.environ.get("PYTHONPATH", "")}
        ray.init(
            address=self.address,
            runtime_env={"env_vars": path},
            logging_level=logging.ERROR,
            **options,
        )
        try:
            task = ray.remote(max_retries=0, **self.resources)(_call)
            running = [
                task.remote(self.task_function, self._values(list(overrides)))
                for overrides in job_overrides
            ]
            returns, dead = [], None
            for overrides, reference in zip(job_overrides, running, strict=True):
                returns.append(JobReturn(overrides=list(overrides)))
                try:
                    returns[-1].return_value = ray.get(reference)
                    returns[-1].status = JobStatus.COMPLETED
                except ray.exceptions.RayError as error:
                    returns[-1].return_value, returns[-1].status = error, JobStatus.FAILED
                    dead = dead or error
        finally:
            ray.shutdown()
        if dead:
            raise dead
        return returns

    def _values(self, overrides: list[str]) -> dict[str, Any]:
        """What is composed of the overrides, as plain values that any process can read."""
        composed = self.hydra_context.config_loader.load_sweep_config(self.config, overrides)
        OmegaConf.set_struct(composed, False)
        composed.pop("hydra")
        return OmegaConf.to_container(composed)  # type: ignore[return-value]


def _call(function: TaskFunction, values: dict[str, Any]) -> Any:
    return function(OmegaConf.create(values))
