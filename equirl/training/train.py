"""A run from configuration to finished folder."""

from __future__ import annotations

import csv
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

from equirl.config import Config

from .evaluation import Evaluation
from .folder import claim_folder, prepare_folder, stop_on_interrupt
from .loop import TrainingRun, make_run_env
from .report import write_report
from .seeding import Purpose, scene_seed
from .video import film_policy

__all__ = ["train"]


def train(config: Config, folder: Path) -> Evaluation | None:
    """Trains in a folder, or goes on with the run it holds, and reports there.

    Args:
        config: A validated configuration.
        folder: The run's folder; made when missing.

    Returns:
        The trained policy's success on the test scenes, or None when Ctrl-C stopped the
        run; calling again then goes on where it stopped.

    Raises:
        FolderError: The folder cannot be written, or another run is using it.
        CheckpointError: The folder holds a run of another configuration, or a
            checkpoint cannot be written or read.
    """
    prepare_folder(folder, config)
    with claim_folder(folder), stop_on_interrupt() as should_stop:
        run = TrainingRun(config, folder, should_stop)
        evaluation = run.run()
        if evaluation is None:
            return None
        write_episodes(evaluation, folder / "test.csv")
        video = None
        if config.evaluation.video_episodes:
            count = config.evaluation.video_episodes
            seeds = [scene_seed(config.seed, Purpose.TEST, index) for index in range(count)]
            with closing(make_run_env(config)) as env:
                video = film_policy(env, run.learner.policy, seeds, folder / "policy.mp4")
        write_report(folder, config, evaluation, video=video)
    return evaluation


def write_episodes(evaluation: Evaluation, path: Path) -> None:
    """Writes one row an episode of an evaluation."""
    with open(path, "w", newline="") as file:
        rows = [{**asdict(e), "success": int(e.success)} for e in evaluation.episodes]
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
