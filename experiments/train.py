"""Trains an agent, or a sweep of them; the command line is Hydra's.

python experiments/train.py env=block_picking group=d4 preset=laptop seed=0
python experiments/train.py --multirun group=c4,d4 augmentation.copies=0,4
python experiments/train.py +experiment=fig12 preset=laptop dry_run=true
python experiments/train.py resume=outputs/my_run
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from entry_point import entry_point, is_multirun, stop
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from run_processes import IN_USE, STOP

from equirl.config import Config, ConfigError, TrainJob, is_free, load_config, to_config


@entry_point("config", TrainJob)
def main(job: TrainJob) -> None:
    """Runs one training job; of a sweep, one whose folder the sweep has prepared."""
    from planning import print_plan
    from sweeping import Run, as_config, recorded

    from equirl.training import CONFIG
    from equirl.training.folder import FolderInUse

    if job.resume:
        folder = Path(job.resume)
        config = _changed(load_config(folder / CONFIG))
    else:
        folder = _new_folder(job)
        config = as_config(job)
    if job.dry_run:
        run = Run([], config, folder)
        run.look()
        print_plan([run])
    elif is_multirun():
        with recorded(folder, private=config.logging.private):
            _train(config, folder, Path(HydraConfig.get().sweep.dir, STOP).exists)
    else:
        try:
            _train(config, folder)
        except FolderInUse as error:
            print(f"error: {error}", file=sys.stderr, flush=True)
            sys.exit(IN_USE)


def _train(config: Config, folder: Path, should_stop: Callable[[], bool] = lambda: False) -> None:
    from sweeping import go_on

    from equirl.training import REPORT, train

    if is_multirun():  # which hands on absolute paths
        folder = Path(os.path.relpath(folder))
    print(f"run folder: {folder}", flush=True)
    try:
        outcome = None if should_stop() else train(config, folder, should_stop)
    except KeyboardInterrupt:
        outcome = None
    if outcome is None:
        again = f"python experiments/train.py 'resume=\"{folder}\"'"
        stop(f"stopped; go on with {go_on() if is_multirun() else again}")
    print(outcome)
    print(f"report: {folder / REPORT}")


def _new_folder(job: TrainJob) -> Path:
    if job.output:
        return Path(job.output)
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_seed{job.seed}"
    return Path("outputs", job.env.task.replace(":", "."), name)


def _changed(config: Config) -> Config:
    """The configuration of an interrupted run, with what may be changed on the way."""
    changes = [
        text
        for text in HydraConfig.get().overrides.task
        if not text.startswith(("resume=", "dry_run="))
    ]
    for text in changes:
        if not is_free(text.partition("=")[0]):
            free = ", ".join(key for key in Config.__dataclass_fields__ if is_free(key))
            raise ConfigError(
                f"{text}: a run is resumed with its own configuration; only {free} may change"
            )
    return to_config(OmegaConf.merge(OmegaConf.structured(config), OmegaConf.from_dotlist(changes)))


if __name__ == "__main__":
    main()
