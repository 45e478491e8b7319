"""The configuration of a run: typed, validated, and the same with or without Hydra."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeVar, cast

from omegaconf import MISSING, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)
from yaml import YAMLError

__all__ = ["Config", "ConfigError", "load_config", "register", "save_config", "to_config"]


Job = TypeVar("Job")


class ConfigError(ValueError):
    """A key or value that no run can have; the message names it."""


# Where the rooms list what there is to choose from.
_MODES = "equirl.symmetry.spec:MODES"
_BACKENDS = "equirl.modules.backend:BACKENDS"
_ROBOTS = "equirl.envs:ROBOTS"
_METHODS = "equirl.training.networks:METHODS"


def _at_least(default: Any, lowest: float, *, free: bool = False) -> Any:
    """A number from ``lowest`` on."""
    return _checked(default, lambda value: value >= lowest, f"{lowest} or more", free=free)


def _within(default: float, low: float, high: float) -> Any:
    """A number above ``low``, at most ``high``."""
    expected = f"a number above {low:g}, at most {high:g}"
    return _checked(default, lambda value: low < value <= high, expected)


def _one_of(default: str, *allowed: str, source: str = "", free: bool = False) -> Any:
    """One of several words: the default, ``allowed``, or those that ``source`` lists.

    ``source`` is ``"module:name"``, looked up when a value is checked, so that the schema needs
    none of the libraries behind it; a default of ``MISSING`` is left to the files of ``conf``.
    """

    def words() -> list[str]:
        if source:
            return list(resolve_name(source))
        return [word for word in (default, *allowed) if word != MISSING]

    return _checked(
        default,
        lambda value: value in words(),
        lambda: f"one of {', '.join(words())}",
        free=free,
    )


def _checked(
    default: Any,
    valid: Callable[[Any], bool],
    expected: str | Callable[[], str],
    *,
    free: bool = False,
) -> Any:
    metadata = {"valid": valid, "expected": expected, "free": free}
    return field(default=default, metadata=metadata)


def _group(schema: type, *, free: bool = False) -> Any:
    """A group of keys; ``free`` ones may differ when a run is resumed, see `is_free`."""
    return field(default_factory=schema, metadata={"free": free})


@dataclass
class EnvConfig:
    """The task and what the robot sees of it."""

    task: str = MISSING  # a file of equirl/envs/tasks, or "package.module:Class"
    image_size: int = _at_least(128, 2)  # pixels a side; networks take 16, 32, 64, 128 and 256
    robot: str = _one_of("panda", source=_ROBOTS)  # or "hand", flying freely
    max_steps: int = _at_least(50, 1)
    options: dict[str, Any] = field(default_factory=dict)  # numbers of the task, see its file


@dataclass
class MethodConfig:
    """The networks."""

    name: str = _one_of(MISSING, source=_METHODS)
    hidden: int = _at_least(64, 1)  # width n of the encoder (appendix A); the CNN scales with it
    head_width: int = _at_least(0, 0)  # fields of an equivariant critic head; 0: hidden, as there


@dataclass
class AlgorithmConfig:
    """Soft actor-critic (appendix D)."""

    name: str = _one_of(MISSING, "sac")
    learning_rate: float = _within(1e-3, 0, 1)
    batch_size: int = _at_least(64, 1)
    discount: float = _within(0.99, 0, 1)  # of the learner
    tau: float = _within(1e-2, 0, 1)  # share of the critic that moves into its target each update
    alpha: float = _within(1e-2, 0, 1e6)  # initial temperature
    target_entropy: float = _checked(-5.0, math.isfinite, "a finite number")
    # Decay of the average of the actor that is evaluated; 0: none.
    averaging: float = _checked(0.0, lambda value: 0 <= value < 1, "0 or more, below 1")


@dataclass
class AugmentationConfig:
    """Rotated copies of the replayed transitions (appendix F)."""

    name: str = _one_of(MISSING, "buffer", "none")
    copies: int = _at_least(4, 0)


@dataclass
class DemosConfig:
    """Expert demonstrations stored before training."""

    episodes: int = _at_least(20, 0)
    options: dict[str, Any] = field(default_factory=dict)  # CHOICES of the task's expert


@dataclass
class ReplayConfig:
    """The replay buffer."""

    capacity: int = _at_least(100_000, 1)  # transitions, copies counted
    start: int = _at_least(100, 1)  # transitions stored, copies counted, before updates begin


@dataclass
class EvaluationConfig:
    """Greedy evaluation on scenes that training never sees."""

    every: int = _at_least(200, 0)  # training steps between evaluations; 0: only after training
    episodes: int = _at_least(20, 1)  # validation scenes an evaluation
    final_episodes: int = _at_least(100, 1)  # test scenes after training
    discount: float = _within(0.99, 0, 1)  # of the returns reported, the paper's
    video_episodes: int = _at_least(3, 0)  # filmed after training; 0: no video


@dataclass
class LoggingConfig:
    """Where metrics go beside the CSV files of the run's folder."""

    progress: bool = True
    tensorboard: bool = False
    wandb: bool = False
    wandb_mode: str = _one_of("offline", "online")
    wandb_project: str = "equirl"


@dataclass
class Config:
    """A training run."""

    env: EnvConfig = _group(EnvConfig)
    method: MethodConfig = _group(MethodConfig)
    algorithm: AlgorithmConfig = _group(AlgorithmConfig)
    augmentation: AugmentationConfig = _group(AugmentationConfig)
    demos: DemosConfig = _group(DemosConfig)
    replay: ReplayConfig = _group(ReplayConfig)
    evaluation: EvaluationConfig = _group(EvaluationConfig, free=True)
    logging: LoggingConfig = _group(LoggingConfig, free=True)
    mode: str = _one_of("strict", source=_MODES)  # the mathematics, independent of sizes
    group: str = "D4"  # C<n> or D<n>
    steps: int = _at_least(10_000, 1, free=True)  # environment steps, one update each
    checkpoint_every: int = _at_least(500, 1, free=True)  # steps
    seed: int = _at_least(0, 0)
    device: str = field(default="auto", metadata={"free": True})  # "auto", "cpu" or "cuda:<i>"
    threads: int = _at_least(0, 0, free=True)  # CPU threads of torch; 0: all cores
    backend: str = _one_of("auto", source=_BACKENDS, free=True)  # of equivariant encoders

    @property
    def torch_device(self) -> str:
        """The device, ``"auto"`` resolved; a ConfigError if this machine has none such."""
        from equirl.modules.layout import resolve_device

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

    def checked(self) -> Config:
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
        _check_task(self.env, self.demos)
        try:
            check_sizes(self.method.hidden, self.env.image_size)
        except ValueError as error:
            raise ConfigError(f"method.hidden or env.image_size: {error}") from None
        capacity, versions = self.replay.capacity, self.copies + 1
        if capacity < versions:
            raise ConfigError(f"replay.capacity={capacity}: expected {versions} or more")
        if self.replay.start > capacity - capacity % versions:
            raise ConfigError(
                f"replay.start={self.replay.start}: the buffer of {capacity} transitions never "
                "holds so many"
            )
        return replace(self, group=group)


@dataclass
class TrainJob(Config):
    """What the command line of ``experiments/train.py`` takes: a run and its folder."""

    output: str = ""  # the run's folder; a new one under outputs/ when empty
    resume: str = ""  # folder of an interrupted run to go on with


@dataclass
class EvaluateJob:
    """What the command line of ``experiments/evaluate.py`` takes."""

    run: str = MISSING  # the folder of a run
    episodes: int = _at_least(100, 1)
    first: int = _at_least(0, 0)  # number of the first test scene
    device: str = "auto"
    backend: str = _one_of("auto", source=_BACKENDS)
    video: str = ""  # MP4 file to film the first episodes into
    video_episodes: int = _at_least(3, 1)


@dataclass
class WatchJob:
    """What the command line of ``experiments/watch.py`` takes."""

    env: EnvConfig = _group(EnvConfig)
    policy: str = "expert"  # or "random", or the folder of a run, whose environment is then used
    episodes: int = _at_least(3, 1)
    sheet_episodes: int = _at_least(3, 1)  # the first ones, shown on the contact sheet
    seed: int = _at_least(0, 0)
    output: str = ""  # a folder for film and sheet; outputs/watch/<task>/<policy> when empty
    fps: int = _at_least(4, 1)  # steps a second
    # Pixels a side of each of the film's two pictures; video formats want an even number.
    size: int = _checked(384, lambda value: value >= 2 and value % 2 == 0, "2 or more, even")

    def checked(self) -> WatchJob:
        """This job, if its task exists."""
        _check_task(self.env)
        return self


def _check_task(env: EnvConfig, demos: DemosConfig | None = None) -> None:
    from equirl.envs.tasks import find_task, make_task

    if env.image_size % 2:
        raise ConfigError(f"env.image_size={env.image_size}: expected an even number")
    try:
        kind = find_task(env.task)
    except ValueError as error:
        raise ConfigError(f"env.task: {error}") from None
    try:
        task = make_task(kind, **env.options)
    except (ValueError, ImportError) as error:
        raise ConfigError(f"env.options: {error}") from None
    if demos is None or not demos.episodes:
        return
    if task.expert is None:
        raise ConfigError(
            f"demos.episodes={demos.episodes}: {env.task} has no expert; expected demos.episodes=0"
        )
    try:
        task.expert.resolve(demos.options)
    except ValueError as error:
        raise ConfigError(f"demos.options: {error}") from None


def _check_values(config: Any, prefix: str = "") -> None:
    """Checks each value against the range that its field declares."""
    for entry in fields(config):
        value = getattr(config, entry.name)
        if is_dataclass(value):
            _check_values(value, f"{prefix}{entry.name}.")
        elif "valid" in entry.metadata and not entry.metadata["valid"](value):
            key = f"{prefix}{entry.name}".removesuffix(".name")
            expected = entry.metadata["expected"]
            expected = expected() if callable(expected) else expected
            raise ConfigError(f"{key}={value}: expected {expected}")


def is_free(key: str) -> bool:
    """Whether a run may be resumed with another value: the key does not touch what is learned.

    Args:
        key: A key of `Config`, ``"env.task"``, or a group of them, ``"env"``.
    """
    known = {entry.name: entry.metadata.get("free", False) for entry in fields(Config)}
    return known.get(key.partition(".")[0], False)


def to_config(values: Any, schema: type[Job] = Config) -> Job:  # type: ignore[assignment]
    """Turns a mapping (or an OmegaConf node) into a validated configuration.

    Raises:
        ConfigError: An unknown key, a value of the wrong type or out of range; named.
    """
    if OmegaConf.is_config(values):
        # A plain mapping: what Hydra composed may hold keys that were forced upon it (`+key=1`).
        values = OmegaConf.to_container(values, resolve=True)
    try:
        merged = OmegaConf.merge(OmegaConf.structured(schema), values)
        config = cast(Job, OmegaConf.to_object(merged))
    except OmegaConfBaseException as error:
        raise ConfigError(explain(error, schema)) from None
    _check_values(config)
    return config.checked() if hasattr(config, "checked") else config


def explain(error: Exception, schema: type) -> str:
    """Says in one sentence why a configuration cannot be composed.

    Args:
        error: OmegaConf's, or Hydra's about one of OmegaConf's.
        schema: The form of the keys.
    """
    reason = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    if isinstance(reason, OmegaConfBaseException):
        key = reason.full_key or "a key"
        if isinstance(reason, ConfigKeyError | ConfigAttributeError):
            return f"{key}: there is no such key{_suggestion(key, schema)}"
        if isinstance(reason, MissingMandatoryValue):
            return f"{key}= is missing"
        return f"{key}: {str(reason).splitlines()[0]}"
    options = getattr(error, "options", None)  # of Hydra's groups
    name = getattr(error, "missing_cfg_file", None)
    if options and name:
        group, _, choice = name.rpartition("/")
        return f"{group}={choice}: expected one of {', '.join(options)}"
    lines = [line.strip() for line in str(error).splitlines()]
    return " ".join(line for line in lines if line and not line.startswith(("See ", "full_key")))


def _suggestion(key: str, schema: type) -> str:
    known = flatten(schema())
    leaf = key.rpartition(".")[2]
    similar = [name for name in known if name.rpartition(".")[2] == leaf]
    similar = similar or get_close_matches(key, known, n=1) or get_close_matches(leaf, known, n=1)
    return f"; did you mean {' or '.join(similar)}?" if similar else ""


def save_config(config: Config, path: Path) -> None:
    """Writes the configuration as YAML."""
    write_atomically(path, OmegaConf.to_yaml(OmegaConf.structured(config)))


def write_atomically(path: Path, text: str) -> None:
    """Replaces a file's text; an interruption leaves the old text or the new."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    os.replace(partial, path)


def load_config(path: Path) -> Config:
    """Reads a configuration that `save_config` wrote.

    Raises:
        ConfigError: The file is not one.
    """
    try:
        values = OmegaConf.load(path)
        if not OmegaConf.is_dict(values):
            raise ConfigError(f"{path} is not a configuration: expected keys and values")
        return to_config(values)
    except FileNotFoundError:
        raise ConfigError(f"{path} not found: not the folder of a run") from None
    except (OSError, UnicodeError, YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path} is not a readable configuration: {reason}") from None


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
        # The task and its expert check the names of their options themselves.
        OmegaConf.set_struct(node.env.options, False)
        if "demos" in node:
            OmegaConf.set_struct(node.demos.options, False)
        store.store(name=name, node=node)
    store.store(name="evaluate_schema", node=EvaluateJob)
