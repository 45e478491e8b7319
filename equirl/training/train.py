"""A run from configuration to finished folder."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from equirl.analysis.tables import read_rows, write_table
from equirl.collectors import Episode
from equirl.config import Config, ConfigError, save_config
from equirl.training.environment import make_run_env
from equirl.training.evaluation import Evaluation
from equirl.training.folder import (
    CONFIG,
    CURVES,
    FAILED,
    REPORT,
    TEST,
    VIDEO,
    check_folder,
    claim_folder,
    is_finished,
    stop_on_interrupt,
)
from equirl.training.loop import TrainingRun
from equirl.training.provenance import record_session
from equirl.training.report import write_report
from equirl.training.seeding import Purpose, scene_seed
from equirl.training.video import film_policy

__all__ = ["read_evaluation", "train", "write_evaluation"]

_log = logging.getLogger("equirl")


def train(
    config: Config, folder: str | Path, should_stop: Callable[[], bool] = lambda: False
) -> Evaluation | None:
    """Trains in a folder, or goes on with the run it holds, and reports there.

    Args:
        config: A validated configuration.
        folder: The run's folder; made when missing.
        should_stop: Asked after each step and each episode; True ends the run as Ctrl-C does.

    Returns:
        The trained policy's success on the test scenes, or None when Ctrl-C or ``should_stop``
        stopped the run; calling again then goes on where it stopped. A run that is finished
        already is left alone.

    Raises:
        ConfigError: A device, a tracker, or the memory that this machine does not have.
        FolderInUse: Another run is using the folder.
        FolderError: The folder cannot be written, or holds something else.
        CheckpointError: The folder holds a run of another configuration, or a
            checkpoint cannot be written or read.
        TableError: A table of the run to go on with is damaged.
        DemonstrationError: The expert does not solve the task as configured.
        PlacementError: The task's numbers allow no scene.
        KeyboardInterrupt: At the second Ctrl-C; what the checkpoint holds is safe.
    """
    folder = Path(folder)
    with claim_folder(folder), stop_on_interrupt() as interrupted, _memory_told():
        check_folder(folder, config)
        (folder / FAILED).unlink(missing_ok=True)  # of an earlier attempt: this one may be killed
        if is_finished(folder, config):
            _log.info("this run is finished already")
            return read_evaluation(folder / TEST)
        with closing(TrainingRun(config, folder, lambda: interrupted() or should_stop())) as run:
            run.restore()
            save_config(config, folder / CONFIG)  # only now: it fits what is there
            for name in (TEST, REPORT, CURVES, VIDEO):  # of an earlier end: of another policy
                (folder / name).unlink(missing_ok=True)
            with record_session(config, folder, lambda: run.step) as session:
                evaluation = run.run()
                if evaluation is None:
                    return None
                write_evaluation(evaluation, folder / TEST)
                filmed = config.evaluation.video_episodes > 0 and _film(run, folder / VIDEO)
                video = folder / VIDEO if filmed else None
                run.log.conclude(_test_results(run.step, evaluation), video)
                session.end("finished")  # the report tells how long it took
                write_report(folder, config, evaluation, video=video)
    return evaluation


def _test_results(step: int, evaluation: Evaluation) -> dict[str, float | int]:
    """The test as a row, for trackers; the folder has a row an episode."""
    low, high = evaluation.interval
    return {
        "step": step,
        "episodes": len(evaluation.episodes),
        "success_rate": evaluation.success_rate,
        "low": low,
        "high": high,
        "discounted_return": evaluation.discounted_return,
    }


@contextmanager
def _memory_told() -> Iterator[None]:
    """Turns torch's errors about memory into a sentence."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        text = str(error) or "out of memory"
        asked = re.search(r"allocate (\d+) bytes", text)
        if not (asked or "out of memory" in text or "multiplication overflow" in text):
            raise
        amount = f" (it asked for {int(asked[1]) / 1e9:,.1f} GB at once)" if asked else ""
        raise ConfigError(
            f"this machine's memory does not hold such a run{amount}; smaller ones have less of "
            "method.hidden, method.head_width, env.image_size, algorithm.batch_size, "
            "replay.capacity, augmentation.copies, or a smaller group"
        ) from error


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


def write_evaluation(evaluation: Evaluation, path: Path) -> None:
    """Writes one row an episode of an evaluation."""
    rows = [
        {
            "seed": seed,
            "success": int(episode.success),
            "length": episode.length,
            "return": episode.undiscounted_return,
            "discounted_return": episode.discounted_return,
        }
        for seed, episode in zip(evaluation.seeds, evaluation.episodes, strict=True)
    ]
    write_table(path, rows)


def read_evaluation(path: Path) -> Evaluation:
    """Reads what `write_evaluation` wrote.

    Raises:
        TableError: The file is damaged.
    """
    rows = read_rows(path)
    return Evaluation(
        seeds=tuple(int(row["seed"]) for row in rows),
        episodes=tuple(
            Episode(
                length=int(row["length"]),
                success=row["success"] == 1,
                undiscounted_return=row["return"],
                discounted_return=row["discounted_return"],
            )
            for row in rows
        ),
    )
