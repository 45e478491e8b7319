"""The configuration of a run: typed, validated, and the same with or without Hydra."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

__all__ = ["Config", "ConfigError", "load_config", "register", "save_config", "to_config"]


class ConfigError(ValueError):
    """A key or value that no run can have; the message names it."""


@dataclass
class EnvConfig:
    """The task and what the robot sees of it."""

    task: str = MISSING
    image_size: int = 128  # pixels a side; networks take 16, 32, 64, 128 and 256
    robot: str = "panda"  # "panda" or "hand", a free-flying gripper
    max_steps: int = 50
    options: dict[str, Any] = field(default_factory=dict)  # numbers of the task, equirl/envs/tasks


@dataclass
class MethodConfig:
    """The networks."""

    name: str = MISSING  # "equivariant" or "cnn"
    hidden: int = 64  # width n of the encoder (appendix A); the CNN scales with it
    head_width: int = 0  # fields of an equivariant critic head; 0: hidden, as in the paper


@dataclass
class AlgorithmConfig:
    """Soft actor-critic (appendix D)."""

    name: str = MISSING  # "sac"
    learning_rate: float = 1e-3
    batch_size: int = 64
    discount: float = 0.99  # of the learner
    tau: float = 1e-2  # share of the critic that moves into its target each update
    alpha: float = 1e-2  # initial temperature
    target_entropy: float = -5.0
    averaging: float = 0.0  # decay of the average of the actor that is evaluated; 0: none


@dataclass
class AugmentationConfig:
    """Rotated copies of the replayed transitions (appendix F)."""

    name: str = MISSING  # "buffer" or "none"
    copies: int = 4


@dataclass
class DemosConfig:
    """Expert demonstrations stored before training."""

    episodes: int = 20
    grasp: str = "random"  # of Clutter Grasping's expert: "random", as in the paper, or "aligned"


@dataclass
class ReplayConfig:
    """The replay buffer."""

    capacity: int = 100_000  # transitions, copies counted
    start: int = 100  # transitions stored, copies counted, before updates begin


@dataclass
class EvaluationConfig:
    """Greedy evaluation on scenes that training never sees."""

    every: int = 200  # training steps between evaluations; 0: only after training
    episodes: int = 20  # validation scenes an evaluation
    final_episodes: int = 100  # test scenes after training
    discount: float = 0.99  # of the returns reported, the paper's
    video_episodes: int = 3  # episodes of the learned policy filmed after training; 0: no video


@dataclass
class LoggingConfig:
    """Where metrics go beside the CSV files of the run's folder."""

    progress: bool = True
    tensorboard: bool = False
    wandb: bool = False
    wandb_mode: str = "offline"  # or "online"
    wandb_project: str = "equirl"


@dataclass
class Config:
    """A training run."""

    env: EnvConfig = field(default_factory=EnvConfig)
    method: MethodConfig = field(default_factory=MethodConfig)
    algorithm: AlgorithmConfig = field(default_factory=AlgorithmConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    logging: LoggingConfig = field(default_factory=LoggingConfig)
    mode: str = "strict"  # "strict" or "paper": the mathematics, independent of sizes
    group: str = "D4"  # C<n> or D<n>
    steps: int = 10_000  # environment steps, one update each
    checkpoint_every: int = 500  # steps
    seed: int = 0
    device: str = "auto"  # "auto", "cpu" or "cuda:<i>"
    threads: int = 0  # CPU threads of torch; 0: all cores
    backend: str = "auto"  # of equivariant encoders: "native", "dense" or "auto", the faster one

    @property
    def torch_device(self) -> str:
        """The device, ``"auto"`` resolved; a ConfigError if this machine has none such."""
        return _available_device(self.device)

    @property
    def copies(self) -> int:
        """Augmented copies of each stored transition."""
        return self.augmentation.copies if self.augmentation.name == "buffer" else 0


@dataclass
class TrainJob(Config):
    """What the command line of ``experiments/train.py`` takes: a run and its folder."""

    output: str = ""  # the run's folder; a new one under outputs/ when empty
    resume: str = ""  # folder of an interrupted run to go on with


@dataclass
class EvaluateJob:
    """What the command line of ``experiments/evaluate.py`` takes."""

    run: str = MISSING  # the folder of a run
    episodes: int = 100
    first: int = 0  # number of the first test scene
    device: str = "auto"
    backend: str = "auto"
    video: str = ""  # MP4 file to film the first episodes into
    video_episodes: int = 3


@dataclass
class WatchJob:
    """What the command line of ``experiments/watch.py`` takes."""

    env: EnvConfig = field(default_factory=EnvConfig)
    policy: str = "expert"  # or "random", or the folder of a run, whose environment is then used
    episodes: int = 3
    sheet_episodes: int = 3  # the first ones, shown on the contact sheet
    seed: int = 0
    output: str = ""  # a folder for film and sheet; outputs/watch/<task> when empty
    fps: int = 4  # steps a second
    size: int = 384  # pixels a side of each of the film's two pictures


def validate(config: Config) -> Config:
    """Checks every value that has a range.

    Raises:
        ConfigError: Names the first key whose value no run can have, and what it takes.
    """
    from equirl.modules.backend import BACKENDS
    from equirl.modules.layout import check_sizes
    from equirl.symmetry import SymmetryGroup

    def at_least(key: str, value: float, lowest: float) -> None:
        if not value >= lowest:
            raise ConfigError(f"{key}={value}: expected {lowest} or more")

    def within(key: str, value: float, low: float, high: float) -> None:
        if not low < value <= high:
            raise ConfigError(f"{key}={value}: expected a number above {low}, at most {high}")

    try:
        config.group = SymmetryGroup(config.group).name
    except ValueError as error:
        raise ConfigError(f"group={config.group}: {error}") from None
    _choice("mode", config.mode, "strict", "paper")
    _validate_env(config.env)
    _choice("method", config.method.name, "equivariant", "cnn")
    _choice("algorithm", config.algorithm.name, "sac")
    _choice("augmentation", config.augmentation.name, "buffer", "none")
    _choice("demos.grasp", config.demos.grasp, "random", "aligned")
    _choice("logging.wandb_mode", config.logging.wandb_mode, "offline", "online")
    _choice("backend", config.backend, *BACKENDS)
    try:
        check_sizes(config.method.hidden, config.env.image_size)
    except ValueError as error:
        raise ConfigError(f"method.hidden or env.image_size: {error}") from None
    at_least("method.head_width", config.method.head_width, 0)
    at_least("algorithm.batch_size", config.algorithm.batch_size, 1)
    at_least("augmentation.copies", config.augmentation.copies, 0)
    at_least("demos.episodes", config.demos.episodes, 0)
    at_least("replay.start", config.replay.start, 1)
    at_least("replay.capacity", config.replay.capacity, config.copies + 1)
    if config.replay.start > config.replay.capacity - config.replay.capacity % (config.copies + 1):
        raise ConfigError(
            f"replay.start={config.replay.start}: the buffer of {config.replay.capacity} "
            "transitions never holds so many"
        )
    if not math.isfinite(config.algorithm.target_entropy):
        raise ConfigError(
            f"algorithm.target_entropy={config.algorithm.target_entropy}: expected a finite number"
        )
    at_least("evaluation.every", config.evaluation.every, 0)
    at_least("evaluation.episodes", config.evaluation.episodes, 1)
    at_least("evaluation.final_episodes", config.evaluation.final_episodes, 1)
    at_least("evaluation.video_episodes", config.evaluation.video_episodes, 0)
    at_least("steps", config.steps, 1)
    at_least("checkpoint_every", config.checkpoint_every, 1)
    at_least("seed", config.seed, 0)
    at_least("threads", config.threads, 0)
    within("algorithm.learning_rate", config.algorithm.learning_rate, 0, 1)
    within("algorithm.discount", config.algorithm.discount, 0, 1)
    within("evaluation.discount", config.evaluation.discount, 0, 1)
    within("algorithm.tau", config.algorithm.tau, 0, 1)
    if not 0 <= config.algorithm.averaging < 1:
        raise ConfigError(
            f"algorithm.averaging={config.algorithm.averaging}: expected 0 or more, below 1"
        )
    within("algorithm.alpha", config.algorithm.alpha, 0, 1e6)
    return config


def _choice(key: str, value: object, *allowed: object) -> None:
    if value not in allowed:
        raise ConfigError(f"{key}={value}: expected one of {', '.join(map(str, allowed))}")


def _validate_env(env: EnvConfig) -> None:
    from equirl.envs.tasks import TASKS, make_task

    _choice("env.task", env.task, *TASKS)
    try:
        make_task(env.task, **env.options)
    except (ValueError, ImportError) as error:
        raise ConfigError(f"env.options: {error}") from None
    _choice("env.robot", env.robot, "panda", "hand")
    if env.max_steps < 1:
        raise ConfigError(f"env.max_steps={env.max_steps}: expected 1 or more")


def _validate_watch(job: WatchJob) -> WatchJob:
    _validate_env(job.env)
    for key, value in (("env.image_size", job.env.image_size), ("size", job.size)):
        if value < 2 or value % 2:
            raise ConfigError(f"{key}={value}: expected an even number, 2 or more")
    for key, lowest in (("episodes", 1), ("sheet_episodes", 1), ("seed", 0), ("fps", 1)):
        if getattr(job, key) < lowest:
            raise ConfigError(f"{key}={getattr(job, key)}: expected {lowest} or more")
    return job


def _validate_evaluation(job: EvaluateJob) -> EvaluateJob:
    from equirl.modules.backend import BACKENDS

    for key, lowest in (("episodes", 1), ("first", 0), ("video_episodes", 1)):
        if getattr(job, key) < lowest:
            raise ConfigError(f"{key}={getattr(job, key)}: expected {lowest} or more")
    _choice("backend", job.backend, *BACKENDS)
    return job


def _available_device(device: str) -> str:
    import torch

    if device == "auto":
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    try:
        parsed = torch.device(device)
    except RuntimeError:
        parsed = None
    if parsed is None or parsed.type not in ("cpu", "cuda"):
        raise ConfigError(f"device={device}: expected auto, cpu or cuda:<i>")
    if parsed.type == "cuda" and (parsed.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"device={device}: this machine has {torch.cuda.device_count()} GPUs")
    return device


def to_config(values: Any, schema: type[Config] = Config) -> Any:
    """Turns a mapping (or an OmegaConf node) into a validated configuration.

    Raises:
        ConfigError: An unknown key, a value of the wrong type or out of range; named.
    """
    try:
        merged = OmegaConf.merge(OmegaConf.structured(schema), values)
        config = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0] + f" (key {error.full_key})") from None
    if isinstance(config, EvaluateJob):
        return _validate_evaluation(config)
    if isinstance(config, WatchJob):
        return _validate_watch(config)
    assert isinstance(config, Config)
    return validate(config)


def save_config(config: Config, path: Path) -> None:
    """Writes the configuration as YAML."""
    write_atomically(path, OmegaConf.to_yaml(OmegaConf.structured(config)))


def write_atomically(path: Path, text: str) -> None:
    """Replaces a file's text; an interruption leaves the old text or the new."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    os.replace(partial, path)


def load_config(path: Path) -> Config:
    """Reads a configuration that :func:`save_config` wrote.

    Raises:
        ConfigError: The file is not one.
    """
    try:
        values = OmegaConf.load(path)
    except FileNotFoundError:
        raise ConfigError(f"{path} not found: not the folder of a run") from None
    except (OSError, YAMLError) as error:
        raise ConfigError(f"{path} is not a readable configuration: {error}") from None
    return to_config(values)


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """The configuration as ``{"env.task": ...}``, for comparing and logging."""
    flat: dict[str, Any] = {}
    for entry in fields(config):
        value = getattr(config, entry.name)
        key = prefix + entry.name
        flat |= flatten(value, key + ".") if is_dataclass(value) else {key: value}
    return flat


def register() -> None:
    """Makes the schema known to Hydra, so that every key of a YAML file is validated."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    for name, schema in (("train_schema", TrainJob), ("watch_schema", WatchJob)):
        node = OmegaConf.structured(schema)
        OmegaConf.set_struct(node.env.options, False)  # the task itself checks their names
        store.store(name=name, node=node)
    store.store(name="evaluate_schema", node=EvaluateJob)
