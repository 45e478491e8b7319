"""The keys of a run: each with its type, default and range, and what it means."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

from omegaconf import MISSING

from equirl.config.checks import check_together
from equirl.config.declare import ConfigError, at_least, checked, keys_of, mark, one_of, within

if TYPE_CHECKING:
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
    "is_execution",
    "is_free",
]

# Where the rooms list what there is to choose from.
_MODES = "equirl.symmetry.spec:MODES"
BACKENDS_SOURCE = "equirl.modules.backend:BACKENDS"
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

    name: str = MISSING  # of equirl.modules.METHODS, or "package.module:NAME"
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
    private: bool = True  # no name of host or user, no absolute path in run.json and trackers


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
    logging: LoggingConfig = keys_of(LoggingConfig, execution=True)
    mode: str = one_of("strict", source=_MODES)  # the mathematics, independent of sizes
    group: str = "D4"  # C<n> or D<n>, n from 2 to 1000, SO2 or O2
    steps: int = at_least(10_000, 1, free=True)  # environment steps
    checkpoint_every: int = at_least(500, 1, execution=True)  # steps
    seed: int = at_least(0, 0)  # of networks, scenes, actions and replay
    # "auto", "cpu" or "cuda:<i>".
    device: str = field(default="auto", metadata=mark(execution=True))
    threads: int = at_least(0, 0, execution=True)  # CPU threads of torch; 0: all cores
    # Of equivariant encoders.
    backend: str = one_of("auto", source=BACKENDS_SOURCE, execution=True)

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

        size, parts = self.env.image_size, self.method_parts
        return uncropped(size) if parts and parts.crops else size

    @property
    def method_parts(self) -> Method | None:
        """What makes up the method; None if there is no such one."""
        from equirl.modules.methods import METHODS

        try:
            return METHODS[self.method.name]
        except ValueError:
            return None

    @property
    def shift(self) -> int:
        """Pixels by which DrQ shifts images, to either side."""
        return self.method.shift or max(1, round(self.env.image_size / 32))

    def validated(self) -> Config:
        """This configuration with the group's name in capitals, if its values fit together.

        Raises:
            ConfigError: They do not; the message names the first that does not.
        """
        return replace(self, group=check_together(self))


def is_free(key: str) -> bool:
    """Whether a run may be resumed with another value: the key does not touch what is learned.

    Args:
        key: A key of `Config`, ``"env.task"``, or a group of them, ``"env"``.
    """
    return _is_marked(key, "free")


def is_execution(key: str) -> bool:
    """Whether a key says nothing but where and how a run is computed: it is the same with others.

    Args:
        key: As of `is_free`.
    """
    return _is_marked(key, "execution")


def _is_marked(key: str, name: str) -> bool:
    known = {entry.name: entry.metadata.get(name, False) for entry in fields(Config)}
    return known.get(key.partition(".")[0], False)
