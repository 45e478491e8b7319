"""Trains an agent; the command line is Hydra's.

python experiments/train.py env=block_picking group=d4 preset=laptop seed=0
python experiments/train.py --multirun group=c4,d4 augmentation.copies=0,4
python experiments/train.py resume=outputs/my_run
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from entry_point import entry_point, is_multirun, stop
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from equirl.config import Config, ConfigError, TrainJob, is_free, load_config, to_config


@entry_point("config", TrainJob)
def main(job: TrainJob) -> None:
    """Runs one training job."""
    from equirl.training import CONFIG, REPORT, train

    if is_multirun() and (job.output or job.resume):
        raise ConfigError("output= and resume= name one run; a multirun makes a folder for each")
    if job.resume:
        folder = Path(job.resume)
        config = _changed(load_config(folder / CONFIG))
    else:
        folder = _new_folder(job)
        config = Config(**{name: getattr(job, name) for name in Config.__dataclass_fields__})
    print(f"run folder: {folder}", flush=True)
    try:
        outcome = train(config, folder)
    except KeyboardInterrupt:
        outcome = None
    if outcome is None:
        if is_multirun():
            sweep = HydraConfig.get().sweep.dir
            again = f"the same command and 'hydra.sweep.dir=\"{sweep}\"'"
        else:
            again = f"python experiments/train.py 'resume=\"{folder}\"'"
        stop(f"stopped; go on with {again}")
    print(outcome)
    print(f"report: {folder / REPORT}")


def _new_folder(job: TrainJob) -> Path:
    if job.output:
        return Path(job.output)
    if is_multirun():
        return Path(HydraConfig.get().runtime.output_dir)
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_seed{job.seed}"
    return Path("outputs", job.env.task.replace(":", "."), name)


def _changed(config: Config) -> Config:
    """The configuration of an interrupted run, with what may be changed on the way."""
    changes = [text for text in HydraConfig.get().overrides.task if not text.startswith("resume=")]
    for text in changes:
        if not is_free(text.partition("=")[0]):
            free = ", ".join(key for key in Config.__dataclass_fields__ if is_free(key))
            raise ConfigError(
                f"{text}: a run is resumed with its own configuration; only {free} may change"
            )
    return to_config(OmegaConf.merge(OmegaConf.structured(config), OmegaConf.from_dotlist(changes)))


if __name__ == "__main__":
    main()
