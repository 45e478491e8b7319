"""Seeds: one integer a run, from it a stream for every purpose, none shared."""

from __future__ import annotations

import hashlib
from enum import IntEnum

import torch

__all__ = ["Purpose", "scene_seed", "seed_everything", "torch_generator"]

_PURPOSE_SHIFT = 56  # the purpose fills the bits above: seeds of two purposes cannot meet


class Purpose(IntEnum):
    """What a random stream is for."""

    NETWORKS = 1
    REPLAY = 2
    POLICY = 3
    DEMONSTRATIONS = 4
    TRAINING = 5
    VALIDATION = 6
    TEST = 7
    LOSSES = 8


def scene_seed(run_seed: int, purpose: Purpose, index: int = 0) -> int:
    """The seed of the ``index``-th scene, or stream, of a purpose.

    The purpose is part of the number, so the scenes of training, validation, test and
    demonstrations are disjoint for every run seed.

    Args:
        run_seed: The run's seed, 0 or more.
        purpose: What the seed is for.
        index: Number of the episode, 0 or more.

    Returns:
        An integer below 2**60, a function of the arguments alone.
    """
    digest = hashlib.blake2b(f"{run_seed}/{int(purpose)}/{index}".encode(), digest_size=8)
    noise = int.from_bytes(digest.digest(), "little") % 2**_PURPOSE_SHIFT
    return (int(purpose) << _PURPOSE_SHIFT) | noise


def torch_generator(run_seed: int, purpose: Purpose) -> torch.Generator:
    """A CPU generator for one purpose of a run."""
    return torch.Generator().manual_seed(scene_seed(run_seed, purpose))


def seed_everything(run_seed: int) -> None:
    """Seeds torch's global generator, which serves the sampling of actions only."""
    torch.manual_seed(scene_seed(run_seed, Purpose.POLICY))
