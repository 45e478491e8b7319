"""The replay buffer of a run, from its configuration."""

from __future__ import annotations

import torch
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Transform

from equirl.config import Config
from equirl.data import Priorities, RandomCrop, RandomRotation, make_replay_buffer
from equirl.modules import METHODS

__all__ = ["make_priorities", "make_run_buffer"]


def make_priorities(config: Config) -> Priorities | None:
    """The priorities of a run's transitions; None if they are drawn without."""
    if config.sampling != "prioritized":
        return None
    replay = config.replay
    return Priorities(
        exponent=replay.exponent,
        bonus=replay.expert_bonus,
        beta=replay.beta,
        steps=replay.beta_steps,
    )


def make_run_buffer(
    config: Config, max_depth: float, generator: torch.Generator
) -> TensorDictReplayBuffer:
    """Builds the buffer with the transforms of augmentation and method.

    Args:
        config: The run's configuration.
        max_depth: Largest depth observed, m.
        generator: Source of all of the buffer's randomness.
    """
    augmentation, method = config.augmentation, METHODS[config.method.name]
    at_sampling: list[Transform] = []
    if augmentation.name == "online":
        turning = RandomRotation(quarter_turns=augmentation.quarter_turns, generator=generator)
        at_sampling.append(turning)
    if method.crops:  # of what is turned already: less of the replicated border is left
        size, positives = config.env.image_size, method.contrastive
        at_sampling.append(RandomCrop(size, positives=positives, generator=generator))
    return make_replay_buffer(
        config.replay.capacity,
        copies=config.copies,
        quarter_turns=augmentation.quarter_turns,
        augmentations=at_sampling,
        priorities=make_priorities(config),
        symmetric=config.sampling == "symmetric",
        batch_size=config.algorithm.batch_size,
        max_depth=max_depth,
        device=config.torch_device,
        generator=generator,
    )
