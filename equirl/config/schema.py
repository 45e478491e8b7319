"""The keys of a run: each with its type, default and range, and what it means."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

from omegaconf import MISSING

from equirl.config.declare import ConfigError, at_least, checked, keys_of, one_of, within

if TYPE_CHECKING:
    from equirl.envs.tasks import Task
    from equirl.modules.methods import Method

__all__ = [
    "BACKENDS_SOURCE",
    "AlgorithmConfig",
    "AugmentationConfig",
    "Config",
    "DemosConfig",
    "EnvConfig",
    "EvaluationConfig",
    "LoggingConfig",
    "MethodConfig",
    "ReplayConfig",
    "is_free",
    "make_run_task",
]

# Where the rooms list what there is to choose from.
_MODES = "equirl.symmetry.spec:MODES"
BACKENDS_SOURCE = "equirl.modules.backend:BACKENDS"
_METHODS = "equirl.modules.methods:METHODS"
_ROBOTS = "equirl.envs:ROBOTS"


@dataclass
class EnvConfig:
    """The task and what the robot sees of it."""

    task: str = MISSING  # a file of equirl/envs/tasks, or "package.module:Class"
    image_size: int = within(128, 1, 4096)  # pixels a side; networks take 16, 32, 64, 128, 256
    robot: str = one_of("panda", source=_ROBOTS)  # or "hand", flying freely
    max_steps: int = at_least(50, 1)  # of an episode without success
    options: dict[str, Any] = field(default_factory=dict)  # numbers of the task, see its file


@dataclass
class MethodConfig:
    """The networks."""

    name: str = one_of(MISSING, source=_METHODS)
    hidden: int = at_least(64, 1)  # width n of the encoder (appendix A); the CNN scales with it
    head_width: int = at_least(0, 0)  # fields of an equivariant critic head; 0: hidden (the paper)
    # Of drq: shifted copies of a state, pixels of a shift.
    target_views: int = at_least(2, 1)  # K, averaged in a target
    loss_views: int = at_least(2, 1)  # M, averaged in the losses
    shift: int = at_least(0, 0)  # to either side; 0: a 32nd of the image, 4 at 128 pixels
    # Of ferm: contrastive learning of the encoder.
    pretraining: int = at_least(1600, 0)  # steps on the demonstrations before training
    momentum: float = within(0.05, 0, 1)  # share of the encoder that moves into its key copy


@dataclass
class AlgorithmConfig:
    """Soft actor-critic (appendix D), with demonstrations in its losses or not (appendix G.2)."""

    name: str = one_of(MISSING, "sac", "sacfd")
    learning_rate: float = within(1e-3, 0, 1)  # of Adam, for all parameters
    batch_size: int = at_least(64, 1)  # transitions an update
    discount: float = within(0.99, 0, 1)  # of the learner
    tau: float = within(1e-2, 0, 1)  # share of the critic that moves into its target each update
    alpha: float = within(1e-2, 0, 1e6)  # initial temperature
    target_entropy: float = checked(-5.0, math.isfinite, "a finite number")
    averaging: float = checked(0.0, lambda x: 0 <= x < 1, "0 or more, below 1")  # see Learner
    demonstration_weight: float = at_least(1.0, 0)  # of sacfd's term, the paper's 1/2 (a - a_e)^2
    updates: int = at_least(1, 1)  # of the networks each environment step
    critics: int = at_least(2, 1)  # heads; of more than two, targets take a random pair (REDQ)


@dataclass
class AugmentationConfig:
    """What is made of the symmetry beside the networks (appendix F)."""

    name: str = one_of(MISSING, "buffer", "online", "auxiliary", "none")
    copies: int = at_least(4, 0)  # of buffer: rotated copies of each stored transition
    quarter_turns: bool = False  # turn by multiples of 90 degrees only, exact on pixels
    weight: float = at_least(1.0, 0)  # of auxiliary: factor of the equivariance loss


@dataclass
class DemosConfig:
    """Expert demonstrations stored before training."""

    episodes: int = at_least(20, 0)
    file: str = ""  # a dataset they are read from, its first episodes; collected when empty
    options: dict[str, Any] = field(default_factory=dict)  # CHOICES of the task's expert


@dataclass
class ReplayConfig:
    """The replay buffer."""

    capacity: int = at_least(100_000, 1)  # transitions, copies counted
    start: int = at_least(100, 1)  # transitions stored, copies counted, before updates begin
    # How transitions are drawn: symmetric takes half of a batch from the demonstrations; auto is
    # prioritized for sacfd, uniform for sac. All but uniform never overwrite demonstrations.
    sampling: str = one_of("auto", "uniform", "prioritized", "symmetric")
    # Of prioritized: (td error + bonus of an expert's + 1e-6)^exponent.
    exponent: float = checked(0.6, lambda x: 0 <= x <= 1, "0 to 1")
    expert_bonus: float = at_least(1.0, 0)
    beta: float = checked(0.4, lambda x: 0 <= x <= 1, "0 to 1")  # exponent of importance weights
    beta_steps: int = at_least(10_000, 1)  # environment steps, of the run, while beta grows to 1
    # Whether importance weights enter the critic's loss; auto drops them in mode=paper.
    importance_weights: str = one_of("auto", "apply", "drop")


@dataclass
class EvaluationConfig:
    """Greedy evaluation on scenes that training never sees."""

    every: int = at_least(200, 0)  # training steps between evaluations; 0: only after training
    episodes: int = at_least(20, 1)  # validation scenes an evaluation
    final_episodes: int = at_least(100, 1)  # test scenes after training
    discount: float = within(0.99, 0, 1)  # of the returns reported, the paper's
    video_episodes: int = at_least(3, 0)  # filmed after training; 0: no video
    equivariance: bool = False  # of policy and critic, measured each time into symmetry.csv


@dataclass
class LoggingConfig:
    """Where metrics go beside the CSV files of the run's folder."""

    progress: bool = True  # a bar on the standard error
    tensorboard: bool = False
    wandb: bool = False
    wandb_mode: str = one_of("offline", "online")
    wandb_project: str = "equirl"


@dataclass
class Config:
    """A training run."""

    env: EnvConfig = keys_of(EnvConfig)
    method: MethodConfig = keys_of(MethodConfig)
    algorithm: AlgorithmConfig = keys_of(AlgorithmConfig)
    augmentation: AugmentationConfig = keys_of(AugmentationConfig)
    demos: DemosConfig = keys_of(DemosConfig)
    replay: ReplayConfig = keys_of(ReplayConfig)
    evaluation: EvaluationConfig = keys_of(EvaluationConfig, free=True)
    logging: LoggingConfig = keys_of(LoggingConfig, free=True)
    mode: str = one_of("strict", source=_MODES)  # the mathematics, independent of sizes
    group: str = "D4"  # C<n> or D<n>, n from 2 to 1000, SO2 or O2
    steps: int = at_least(10_000, 1, free=True)  # environment steps
    checkpoint_every: int = at_least(500, 1, free=True)  # steps
    seed: int = at_least(0, 0)  # of networks, scenes, actions and replay
    device: str = field(default="auto", metadata={"free": True})  # "auto", "cpu" or "cuda:<i>"
    threads: int = at_least(0, 0, free=True)  # CPU threads of torch; 0: all cores
    backend: str = one_of("auto", source=BACKENDS_SOURCE, free=True)  # of equivariant encoders

    @property
    def torch_device(self) -> str:
        """The device, ``"auto"`` resolved.

        Raises:
            ConfigError: This machine has none such.
        """
        from equirl.modules.device import resolve_device

        try:
            device = resolve_device(self.device)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        if device.type not in ("cpu", "cuda"):
            raise ConfigError(f"device={self.device}: expected auto, cpu or cuda:<i>")
        return str(device)

    @property
    def copies(self) -> int:
        """Augmented copies of each stored transition."""
        return self.augmentation.copies if self.augmentation.name == "buffer" else 0

    @property
    def sampling(self) -> str:
        """How transitions are drawn: ``"uniform"``, ``"prioritized"`` or ``"symmetric"``."""
        if self.replay.sampling != "auto":
            return self.replay.sampling
        return "prioritized" if self.algorithm.name == "sacfd" else "uniform"

    @property
    def importance_weights(self) -> bool:
        """Whether importance weights enter the critic's loss."""
        asked = self.replay.importance_weights
        return asked == "apply" or (asked == "auto" and self.mode == "strict")

    @property
    def observed_size(self) -> int:
        """Pixels a side of what the environment shows; methods that crop see less of it."""
        from equirl.modules.layout import uncropped

        size = self.env.image_size
        return uncropped(size) if self._crops else size

    @property
    def _crops(self) -> bool:
        return self._method is not None and self._method.crops

    @property
    def _method(self) -> Method | None:
        """What makes up the method; None if there is no such one."""
        from equirl.modules.methods import METHODS

        return METHODS.get(self.method.name)

    @property
    def shift(self) -> int:
        """Pixels by which DrQ shifts images, to either side."""
        return self.method.shift or max(1, round(self.env.image_size / 32))

    def validated(self) -> Config:
        """This configuration with the group's name in capitals, if its values fit together.

        Raises:
            ConfigError: They do not; the message names the first that does not.
        """
        from equirl.modules.layout import check_sizes
        from equirl.symmetry import SymmetryGroup

        try:
            group = SymmetryGroup(self.group).name
        except ValueError as error:
            raise ConfigError(f"group={self.group}: {error}") from None
        _check_expert(self.env, self.demos)
        try:
            check_sizes(self.method.hidden, self.env.image_size)
        except ValueError as error:
            crops = (
                f". With method={self.method.name} env.image_size is the side of the crop: the "
                "environment shows more by itself, 142 pixels for 128"
            )
            more = crops if self._crops else ""
            raise ConfigError(f"method.hidden or env.image_size: {error}{more}") from None
        self._check_method()
        capacity, versions = self.replay.capacity, self.copies + 1
        if capacity < versions:
            raise ConfigError(f"replay.capacity={capacity}: expected {versions} or more")
        if self.replay.start > capacity - capacity % versions:
            raise ConfigError(
                f"replay.start={self.replay.start}: the buffer of {capacity} transitions never "
                "holds so many"
            )
        self._check_demonstrations()
        return replace(self, group=group)

    def _check_method(self) -> None:
        """Checks numbers of a method against those of others."""
        method, batch = self._method, self.algorithm.batch_size
        if method and method.shifts and 2 * self.shift >= self.env.image_size:
            raise ConfigError(
                f"method.shift={self.shift}: expected less than half of "
                f"env.image_size={self.env.image_size}"
            )
        if method and method.contrastive and batch < 2:
            raise ConfigError(
                f"algorithm.batch_size={batch}: method={self.method.name} tells the observations "
                "of a batch apart, expected 2 or more"
            )

    def _check_demonstrations(self) -> None:
        """Checks that what needs demonstrations has them, and has them from one place."""
        demonstrations = self.demos.episodes
        if self.sampling == "symmetric" and not demonstrations:
            raise ConfigError(
                "replay.sampling=symmetric: half of each batch is demonstrations, expected "
                f"demos.episodes above 0, got {demonstrations}"
            )
        if self.sampling == "symmetric" and self.algorithm.batch_size < 2:
            raise ConfigError("replay.sampling=symmetric: expected algorithm.batch_size above 1")
        rows, longest = self.replay.capacity // (self.copies + 1), self.env.max_steps
        if demonstrations and rows < longest:
            raise ConfigError(
                f"replay.capacity={self.replay.capacity}: a demonstration is stored whole, "
                f"expected room for {longest} transitions with their copies, "
                f"{longest * (self.copies + 1)}"
            )
        if self.demos.file and not demonstrations:
            raise ConfigError(
                f"demos.file={self.demos.file}: expected demos.episodes above 0, got 0"
            )
        if self.demos.file and self.demos.options:
            raise ConfigError(
                f"demos.options={self.demos.options}: expected none, the demonstrations of "
                f"demos.file={self.demos.file} are what they are"
            )


def make_run_task(env: EnvConfig) -> Task:
    """The task of an environment's keys.

    Raises:
        ConfigError: There is no such task, or it refuses its options.
    """
    from equirl.envs.tasks import find_task, make_task

    if env.image_size % 2:
        raise ConfigError(f"env.image_size={env.image_size}: expected an even number")
    try:
        kind = find_task(env.task)
    except ValueError as error:
        raise ConfigError(f"env.task: {error}") from None
    try:
        return make_task(kind, **env.options)
    except (ValueError, ImportError) as error:
        raise ConfigError(f"env.options: {error}") from None


def _check_expert(env: EnvConfig, demos: DemosConfig) -> None:
    task = make_run_task(env)
    if not demos.episodes or demos.file:
        return
    if task.expert is None:
        raise ConfigError(
            f"demos.episodes={demos.episodes}: {env.task} has no expert; expected 0, or demos.file"
        )
    try:
        task.expert.resolve(demos.options)
    except ValueError as error:
        raise ConfigError(f"demos.options: {error}") from None


def is_free(key: str) -> bool:
    """Whether a run may be resumed with another value: the key does not touch what is learned.

    Args:
        key: A key of `Config`, ``"env.task"``, or a group of them, ``"env"``.
    """
    known = {entry.name: entry.metadata.get("free", False) for entry in fields(Config)}
    return known.get(key.partition(".")[0], False)
