"""Trains an agent; the command line is Hydra's.

python experiments/train.py env=block_picking group=d4 preset=laptop seed=0
python experiments/train.py --multirun group=c4,d4 augmentation.copies=0,4
python experiments/train.py resume=outputs/my_run
"""

from __future__ import annotations

import sys
from datetime import datetime
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from equirl.config import Config, ConfigError, TrainJob, register, to_config

register()


@hydra.main(version_base="1.3", config_path="../conf", config_name="config")
def main(values: DictConfig) -> None:
    """Runs one training job; a problem the user can mend ends in one sentence."""
    from equirl.training import CheckpointError, FolderError, train

    try:
        config, folder = _job(values)
        print(f"run folder: {folder}", flush=True)
        outcome = train(config, folder)
    except (ConfigError, FolderError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    if outcome is None:
        sys.exit(f"stopped; go on with: python experiments/train.py resume={folder}")
    print(outcome)
    print(f"report: {folder / 'report.md'}")


def _job(values: DictConfig) -> tuple[Config, Path]:
    """The run and its folder, from the composed command line."""
    from equirl.training import load_run_config

    job = to_config(values, TrainJob)
    hydra_config = HydraConfig.get()
    if job.resume:
        others = [text for text in hydra_config.overrides.task if not text.startswith("resume=")]
        if others:
            raise ConfigError(f"resume= takes no other keys, got {' '.join(others)}")
        return load_run_config(Path(job.resume)), Path(job.resume)
    config = Config(**{name: getattr(job, name) for name in Config.__dataclass_fields__})
    if job.output:
        folder = Path(job.output)
    elif hydra_config.mode == RunMode.MULTIRUN:
        folder = Path(hydra_config.runtime.output_dir)
    else:
        folder = Path("outputs", config.env.task, f"{datetime.now():%Y-%m-%d_%H-%M-%S}")
    return config, folder


if __name__ == "__main__":
    main()
