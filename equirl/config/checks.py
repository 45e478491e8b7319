"""What the values of a run's keys must fulfil together."""

from __future__ import annotations

from typing import TYPE_CHECKING

from equirl.config.declare import ConfigError

if TYPE_CHECKING:
    from equirl.config.schema import Config, EnvConfig
    from equirl.envs.tasks import Task

__all__ = ["check_together", "make_run_task"]


def check_together(config: Config) -> str:
    """Checks the values of a run's keys against each other and against what there is.

    Returns:
        The group's name in capitals.

    Raises:
        ConfigError: They do not fit together; the message names the first that does not.
    """
    from equirl.symmetry import SymmetryGroup

    try:
        group = SymmetryGroup(config.group).name
    except ValueError as error:
        raise ConfigError(f"group={config.group}: {error}") from None
    _check_method(config)
    _check_expert(config)
    _check_replay(config)
    _check_demonstrations(config)
    return group


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


def _check_method(config: Config) -> None:
    """That there is such a method, and networks of it for the sizes asked."""
    from equirl.modules.layout import check_sizes
    from equirl.modules.methods import METHODS

    name, size, batch = config.method.name, config.env.image_size, config.algorithm.batch_size
    try:
        method = METHODS[name]
    except ValueError as error:
        raise ConfigError(f"method={name}: {error}") from None
    try:
        check_sizes(config.method.hidden, size)
    except ValueError as error:
        crops = (
            f". With method={name} env.image_size is the side of the crop: the environment shows "
            "more by itself, 142 pixels for 128"
        )
        more = crops if method.crops else ""
        raise ConfigError(f"method.hidden or env.image_size: {error}{more}") from None
    if method.shifts and 2 * config.shift >= size:
        raise ConfigError(
            f"method.shift={config.shift}: expected less than half of env.image_size={size}"
        )
    if method.contrastive and batch < 2:
        raise ConfigError(
            f"algorithm.batch_size={batch}: method={name} tells the observations of a batch "
            "apart, expected 2 or more"
        )


def _check_expert(config: Config) -> None:
    """That the task has an expert, if one is to demonstrate, and that it has the options asked."""
    task, demos = make_run_task(config.env), config.demos
    if not demos.episodes or demos.file:
        return
    if task.expert is None:
        raise ConfigError(
            f"demos.episodes={demos.episodes}: {config.env.task} has no expert; expected 0, or "
            "demos.file"
        )
    try:
        task.expert.resolve(demos.options)
    except ValueError as error:
        raise ConfigError(f"demos.options: {error}") from None


def _check_replay(config: Config) -> None:
    """That the buffer can hold what updates wait for, and a whole demonstration."""
    capacity, versions = config.replay.capacity, config.copies + 1
    if capacity < versions:
        raise ConfigError(f"replay.capacity={capacity}: expected {versions} or more")
    if config.replay.start > capacity - capacity % versions:
        raise ConfigError(
            f"replay.start={config.replay.start}: the buffer of {capacity} transitions never "
            "holds so many"
        )
    longest = config.env.max_steps
    if config.demos.episodes and capacity // versions < longest:
        raise ConfigError(
            f"replay.capacity={capacity}: a demonstration is stored whole, expected room for "
            f"{longest} transitions with their copies, {longest * versions}"
        )


def _check_demonstrations(config: Config) -> None:
    """That what needs demonstrations has them, and has them from one place."""
    demos = config.demos
    if config.sampling == "symmetric" and not demos.episodes:
        raise ConfigError(
            "replay.sampling=symmetric: half of each batch is demonstrations, expected "
            f"demos.episodes above 0, got {demos.episodes}"
        )
    if config.sampling == "symmetric" and config.algorithm.batch_size < 2:
        raise ConfigError(
            f"algorithm.batch_size={config.algorithm.batch_size}: replay.sampling=symmetric takes "
            "half of a batch from the demonstrations, expected 2 or more"
        )
    if demos.file and not demos.episodes:
        raise ConfigError(f"demos.file={demos.file}: expected demos.episodes above 0, got 0")
    if demos.file and demos.options:
        raise ConfigError(
            f"demos.options={demos.options}: expected none, the demonstrations of "
            f"demos.file={demos.file} are what they are"
        )
