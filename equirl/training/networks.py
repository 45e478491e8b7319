"""Actor and critic of each method, from a configuration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import nn
from torchrl.modules import ProbabilisticActor

from equirl.config import Config, ConfigError
from equirl.modules import (
    NativeUnavailable,
    make_actor,
    make_cnn_actor,
    make_cnn_critic,
    make_critic,
)
from equirl.training.seeding import Purpose, torch_generator

__all__ = ["METHODS", "describe_method", "make_networks"]

Networks = tuple[ProbabilisticActor, nn.Module]


def _equivariant(config: Config, **size: Any) -> Networks:
    size |= {"mode": config.mode, "backend": config.backend}
    head_width = config.method.head_width or None
    actor = make_actor(config.group, **size)
    return actor, make_critic(config.group, head_width=head_width, **size)


def _cnn(config: Config, **size: Any) -> Networks:
    return make_cnn_actor(**size), make_cnn_critic(**size)


#: The networks of each method, by its name.
METHODS: dict[str, Callable[..., Networks]] = {"equivariant": _equivariant, "cnn": _cnn}


def make_networks(config: Config) -> Networks:
    """Builds actor and critic of the configured method, initialised from the run's seed.

    Raises:
        ConfigError: A device or a backend that this machine does not have.
    """
    device = config.torch_device
    try:
        return METHODS[config.method.name](
            config,
            hidden=config.method.hidden,
            image_size=config.env.image_size,
            generator=torch_generator(config.seed, Purpose.NETWORKS),
            device=device,
        )
    except (ValueError, NativeUnavailable) as error:
        raise ConfigError(str(error)) from None


def describe_method(config: Config) -> str:
    """What is trained, for titles."""
    if config.method.name == "equivariant":
        return f"{config.group}-equivariant SAC ({config.mode} mode)"
    return f"{config.method.name.upper()} SAC"
