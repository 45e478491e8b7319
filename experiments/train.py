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
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from run_processes import IN_USE, STOP, is_private

from equirl.analysis.runs import CONFIG, REPORT
from equirl.config import Config, ConfigError, TrainJob, is_free, load_config, to_config


@entry_point("config", TrainJob)
def main(job: TrainJob) -> None:
    """Runs one training job; of a sweep, one whose folder the sweep has prepared."""
    from planning import print_plan
    from sweeping import Run, as_config

    from equirl.training.folder import FolderInUse

    if is_multirun():
        _train_for_sweep(Path(job.resume))
        return
    if job.resume:
        folder = Path(job.resume)
        config = _changed(load_config(folder / CONFIG))
    else:
        folder = _new_folder(job)
        config = as_config(job)
    if job.dry_run:
        run = Run([], config, folder)
        try:
            run.look()
        except ConfigError as error:
            raise ConfigError(f"{error}; choose another output" if job.output else error) from None
        print_plan([run])
        return
    try:
        _train(config, folder)
    except FolderInUse as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        sys.exit(IN_USE)


def _train_for_sweep(folder: Path) -> None:
    """Trains in this process what the sweep has prepared; it goes on whatever happens here."""
    from sweeping import recorded

    hydra = HydraConfig.get()
    with recorded(folder, private=is_private(folder, hydra.overrides.task)):
        config = _changed(load_config(folder / CONFIG))
        _train(config, folder, Path(hydra.sweep.dir, STOP).exists)


def _train(config: Config, folder: Path, should_stop: Callable[[], bool] = lambda: False) -> None:
    from equirl.training import train

    if is_multirun():  # which hands on absolute paths
        folder = Path(os.path.relpath(folder))
    print(f"run folder: {folder}", flush=True)
    try:
        outcome = None if should_stop() else train(config, folder, should_stop)
    except KeyboardInterrupt:
        outcome = None
    if outcome is None:
        again = f"; go on with python experiments/train.py 'resume=\"{folder}\"'"
        stop("stopped" if is_multirun() else f"stopped{again}")
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
    values = OmegaConf.structured(config)
    for change in OverridesParser.create().parse_overrides(changes):
        OmegaConf.update(values, change.key_or_group, change.value(), merge=True)
    return to_config(values)


if __name__ == "__main__":
    main()
