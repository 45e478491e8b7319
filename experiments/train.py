"""Trains an agent; the command line is Hydra's.

python experiments/train.py env=block_picking group=d4 preset=laptop seed=0
python experiments/train.py --multirun group=c4,d4 augmentation.copies=0,4
python experiments/train.py resume=outputs/my_run
"""

from __future__ import annotations

import logging
import os
import sys
from datetime import datetime
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from equirl.config import Config, ConfigError, TrainJob, is_free, load_config, register, to_config

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL logs to the standard output
# Threads that wait for one another soon sleep: where other work keeps a core busy, spinning
# makes two threads ten times slower than one.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
register()
_log = logging.StreamHandler()  # for the package's own messages, to the standard error
_failed: list[str] = []  # jobs of a multirun, each with its reason


@hydra.main(version_base="1.3", config_path="../conf", config_name="config")
def main(values: DictConfig) -> None:
    """Runs one training job; a problem the user can mend ends in one sentence."""
    from equirl.collectors import DemonstrationError
    from equirl.envs import PlacementError
    from equirl.training import CheckpointError, FolderError, train

    logging.getLogger("equirl").addHandler(_log)
    logging.getLogger("equirl").setLevel(logging.INFO)
    mendable = (ConfigError, FolderError, CheckpointError, DemonstrationError, PlacementError)
    multirun = HydraConfig.get().mode == RunMode.MULTIRUN
    folder = None
    try:
        config, folder = _job(values, multirun)
        print(f"run folder: {folder}", flush=True)
        outcome = train(config, folder)
    except mendable as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        if not multirun:
            sys.exit(1)
        _failed.append(f"{' '.join(HydraConfig.get().overrides.task)}: {error}")
        return  # the other jobs of the sweep go on
    except KeyboardInterrupt:
        outcome = None
    if outcome is None:
        hint = f"; go on with: python experiments/train.py 'resume=\"{folder}\"'" if folder else ""
        print(f"stopped{hint}", file=sys.stderr)
        sys.exit(130)
    print(outcome)
    print(f"report: {folder / 'report.md'}")


def _job(values: DictConfig, multirun: bool) -> tuple[Config, Path]:
    """The run and its folder, from the composed command line."""
    job = to_config(values, TrainJob)
    if multirun and (job.output or job.resume):
        raise ConfigError("output= and resume= name one run; a multirun makes a folder for each")
    if job.resume:
        return _resumed(Path(job.resume)), Path(job.resume)
    config = Config(**{name: getattr(job, name) for name in Config.__dataclass_fields__})
    if job.output:
        folder = Path(job.output)
    elif multirun:
        folder = Path(HydraConfig.get().runtime.output_dir)
    else:
        name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_seed{config.seed}"
        folder = Path("outputs", config.env.task, name)
    return config, folder


def _resumed(folder: Path) -> Config:
    """The configuration of an interrupted run, with what may be changed on the way."""
    changes = [text for text in HydraConfig.get().overrides.task if not text.startswith("resume=")]
    for text in changes:
        if not is_free(text.partition("=")[0]):
            free = ", ".join(key for key in Config.__dataclass_fields__ if is_free(key))
            raise ConfigError(
                f"{text}: a run is resumed with its own configuration; only {free} may change"
            )
    config = load_config(folder / "config.yaml")
    return to_config(OmegaConf.merge(OmegaConf.structured(config), OmegaConf.from_dotlist(changes)))


if __name__ == "__main__":
    main()
    if _failed:
        sys.exit("\n".join([f"{len(_failed)} jobs failed:", *_failed]))
