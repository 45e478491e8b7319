"""Actor and critic of a run, from its configuration."""

from __future__ import annotations

from typing import Any

from torch import nn
from torchrl.modules import ProbabilisticActor

from equirl.config import Config, ConfigError
from equirl.modules import METHODS, NativeUnavailable
from equirl.training.seeding import Purpose, torch_generator

__all__ = ["describe_method", "make_networks"]


def make_networks(config: Config) -> tuple[ProbabilisticActor, nn.Module]:
    """Builds actor and critic of the configured method, initialised from the run's seed.

    Raises:
        ConfigError: A device or a backend that this machine does not have.
    """
    method = METHODS[config.method.name]
    size: dict[str, Any] = {
        "hidden": config.method.hidden,
        "image_size": config.env.image_size,
        "generator": torch_generator(config.seed, Purpose.NETWORKS),
        "device": config.torch_device,
    }
    heads: dict[str, Any] = {"heads": config.algorithm.critics}
    if method.equivariant:
        size |= {"group": config.group, "mode": config.mode, "backend": config.backend}
        heads |= {"head_width": config.method.head_width or None}
    try:
        return method.make_actor(**size), method.make_critic(**size, **heads)
    except (ValueError, NativeUnavailable) as error:
        raise ConfigError(str(error)) from None


def describe_method(config: Config) -> str:
    """What is trained, for titles."""
    algorithm = {"sac": "SAC", "sacfd": "SACfD"}[config.algorithm.name]
    if METHODS[config.method.name].equivariant:
        return f"{config.group}-equivariant {algorithm} ({config.mode} mode)"
    name = config.method.name.rpartition(":")[2]  # of one's own, "package.module:NAME"
    name = {"drq": "DrQ"}.get(name, name.upper())
    return f"{name} {algorithm}"
