"""A run from configuration to finished folder."""

from __future__ import annotations

import csv
from contextlib import closing
from pathlib import Path

from equirl.config import Config
from equirl.training.environment import make_run_env
from equirl.training.evaluation import Evaluation
from equirl.training.folder import (
    CURVES,
    REPORT,
    TEST,
    VIDEO,
    claim_folder,
    prepare_folder,
    stop_on_interrupt,
)
from equirl.training.loop import TrainingRun
from equirl.training.report import write_report
from equirl.training.seeding import Purpose, scene_seed
from equirl.training.video import film_policy

__all__ = ["train", "write_episodes"]


def train(config: Config, folder: Path) -> Evaluation | None:
    """Trains in a folder, or goes on with the run it holds, and reports there.

    Args:
        config: A validated configuration.
        folder: The run's folder; made when missing.

    Returns:
        The trained policy's success on the test scenes, or None when Ctrl-C stopped the
        run; calling again then goes on where it stopped.

    Raises:
        ConfigError: A device or a tracker that this machine does not have.
        FolderError: The folder cannot be written, holds something else, or another run
            is using it.
        CheckpointError: The folder holds a run of another configuration, or a
            checkpoint cannot be written or read.
        DemonstrationError: The expert does not solve the task as configured.
    """
    with claim_folder(folder):
        prepare_folder(folder, config)
        with stop_on_interrupt() as should_stop:
            run = TrainingRun(config, folder, should_stop)
            for name in (TEST, REPORT, CURVES, VIDEO):  # of an earlier end: of another policy
                (folder / name).unlink(missing_ok=True)
            evaluation = run.run()
        if evaluation is None:
            return None
        write_episodes(evaluation, folder / TEST)
        write_report(folder, config, evaluation)
        if config.evaluation.video_episodes and _film(run, folder / VIDEO):
            write_report(folder, config, evaluation, video=folder / VIDEO)
    return evaluation


def _film(run: TrainingRun, path: Path) -> bool:
    """Films the trained policy; a failure costs the film only."""
    config = run.config
    seeds = [
        scene_seed(config.seed, Purpose.TEST, index)
        for index in range(config.evaluation.video_episodes)
    ]
    try:
        with closing(make_run_env(config)) as env:
            film_policy(env, run.learner.policy, seeds, path, device=config.torch_device)
    except (OSError, RuntimeError) as error:
        print(f"no video: {error}")
        path.unlink(missing_ok=True)
        return False
    return True


def write_episodes(evaluation: Evaluation, path: Path) -> None:
    """Writes one row an episode of an evaluation."""
    with open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("seed", "success", "length", "discounted_return"))
        for seed, episode in zip(evaluation.seeds, evaluation.episodes, strict=True):
            row = (seed, int(episode.success), episode.length, episode.discounted_return)
            writer.writerow(row)
