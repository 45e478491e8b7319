"""What the command lines of ``experiments/`` take: a dataclass each."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import MISSING

from equirl.config.checks import make_run_task
from equirl.config.declare import ConfigError, at_least, checked, keys_of, one_of
from equirl.config.schema import BACKENDS_SOURCE, Config, EnvConfig

__all__ = [
    "DemonstrationsJob",
    "EvaluateJob",
    "ExportJob",
    "FiguresJob",
    "ReportJob",
    "TrainJob",
    "WatchJob",
]


@dataclass
class TrainJob(Config):
    """What the command line of ``experiments/train.py`` takes: a run and its folder."""

    output: str = ""  # the run's folder; a new one under outputs/ when empty
    resume: str = ""  # folder of an interrupted run to go on with
    dry_run: bool = False  # list the runs with the hours each takes on this machine; train none


@dataclass
class DemonstrationsJob:
    """What the command line of ``experiments/demonstrations.py`` takes."""

    env: EnvConfig = keys_of(EnvConfig)
    expert: dict[str, Any] = field(default_factory=dict)  # CHOICES of the task's expert
    mode: str = one_of("strict", source="equirl.symmetry.spec:MODES")  # of expert and time limit
    episodes: int = at_least(20, 1)
    seed: int = at_least(0, 0)  # the scenes are those of the run of this seed
    output: str = MISSING  # the file, HDF5
    overwrite: bool = False  # a file that is there already

    def validated(self) -> DemonstrationsJob:
        """This job, if its task and expert exist and its file may be written.

        Raises:
            ConfigError: They do not, or it may not.
        """
        path, task = Path(self.output), make_run_task(self.env)
        if task.expert is None:
            raise ConfigError(f"env.task={self.env.task}: it has no expert to demonstrate it")
        try:
            task.expert.resolve(self.expert)
        except ValueError as error:
            raise ConfigError(f"expert: {error}") from None
        if path.is_dir():
            raise ConfigError(f"output={path}: it is a folder, expected the name of a file")
        if path.exists() and not self.overwrite:
            raise ConfigError(
                f"output={path}: it exists already; choose another, or overwrite=true"
            )
        return self


@dataclass
class EvaluateJob:
    """What the command line of ``experiments/evaluate.py`` takes."""

    run: str = MISSING  # the folder of a run, or the file of a policy
    episodes: int = at_least(100, 1)
    first: int = at_least(0, 0)  # number of the first test scene
    device: str = "auto"
    backend: str = one_of("auto", source=BACKENDS_SOURCE)
    video: str = ""  # MP4 file to film the first episodes into
    video_episodes: int = at_least(3, 1)


@dataclass
class ExportJob:
    """What the command line of ``experiments/export.py`` takes."""

    run: str = ""  # the folder of the run whose policy is exported
    format: str = one_of("torch_export", "onnx", "policy")
    output: str = ""  # a .pt2, .onnx or .pt file; in the run's folder when empty
    observations: int = at_least(64, 1)  # to measure on, half of them from the run's replay buffer
    check: str = ""  # an exported file to measure again, and to compare with ``run`` if given

    def validated(self) -> ExportJob:
        """This job, if it says what to do.

        Raises:
            ConfigError: It does not.
        """
        if not self.run and not self.check:
            raise ConfigError("run= is missing: expected the folder of a run, or check=FILE")
        if self.check and self.output:
            raise ConfigError(f"output={self.output}: leave it out, check={self.check} writes none")
        return self


@dataclass
class ReportJob:
    """What the command line of ``experiments/report.py`` takes."""

    run: str = MISSING  # the folder of a run
    group: str = ""  # whose elements are measured beside all angles; the run's own when empty
    observations: int = at_least(16, 1)  # random ones, and as many from the run's replay buffer
    angles: int = at_least(48, 1)  # turns measured, evenly spaced, beside those of the group
    layers: bool = True  # measure each layer, too
    keep_theta: bool = False  # take theta for an invariant of reflections, as mode=paper does
    seed: int = at_least(0, 0)  # of the random observations and of the actions
    device: str = "auto"
    backend: str = one_of("auto", source=BACKENDS_SOURCE)
    output: str = ""  # the folder of page, table and picture; the run's own when empty

    def validated(self) -> ReportJob:
        """This job, if its group exists.

        Raises:
            ConfigError: It does not.
        """
        from equirl.symmetry import SymmetryGroup

        if self.group:
            try:
                SymmetryGroup(self.group)
            except ValueError as error:
                raise ConfigError(f"group={self.group}: {error}") from None
        return self


@dataclass
class WatchJob:
    """What the command line of ``experiments/watch.py`` takes."""

    env: EnvConfig = keys_of(EnvConfig)
    # Or "random"; the folder of a run or the file of a policy, whose environment is then used; a
    # file of demonstrations.
    policy: str = "expert"
    episodes: int = at_least(3, 1)  # filmed; of a file, the first ones
    sheet_episodes: int = at_least(3, 1)  # the first ones, shown on the contact sheet
    seed: int = at_least(0, 0)
    output: str = ""  # a folder for film and sheet; outputs/watch/<task>/<policy> when empty
    fps: int = at_least(4, 1)  # steps a second
    # Pixels a side of each of the film's two pictures; video formats want an even number.
    size: int = checked(384, lambda x: 2 <= x <= 4096 and x % 2 == 0, "an even number, 2 to 4096")

    def validated(self) -> WatchJob:
        """This job, if its task exists and has what is to be watched.

        Raises:
            ConfigError: It has not.
        """
        task = make_run_task(self.env)
        if self.policy == "expert" and task.expert is None:
            raise ConfigError(f"policy=expert: {self.env.task} has no expert; there is random")
        return self


@dataclass
class FiguresJob:
    """What the command line of ``experiments/figures.py`` takes."""

    sweep: str = MISSING  # the folder of a sweep, or of one run
    # Of the paper: groups, 12, 13, 14, 15 or 16, which gives the title and says what is missing.
    figure: str = ""
    smoothing: int = at_least(500, 1)  # steps that a return is averaged over, the paper's
    title: str = ""  # above the figure; the paper's when empty
    output: str = ""  # the folder of picture and tables; the sweep's own when empty
