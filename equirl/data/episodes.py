"""What an episode of demonstrations must be, wherever it comes from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from equirl.data.keys import TRANSITION_KEYS

__all__ = [
    "DatasetError",
    "check_environment",
    "check_episode",
    "check_image_size",
    "project_onto_disc",
]

#: What a number may be, by the last part of its key.
_RANGES = {
    "depth": (0.0, 1.0, "metres below the end effector"),
    "holding": (0.0, 1.0, "0 or 1"),
    "action": (-1.0, 1.0, "numbers in [-1, 1]"),
}
_FLAGS = ("expert", "done", "terminated", "truncated")
# (x, y) is put a hair inside the disc, so that rounding to float32 stays within it.
_HAIR = 1e-6


class DatasetError(RuntimeError):
    """Demonstrations that cannot be written or read; the message says why."""


def check_episode(episode: TensorDictBase, name: str) -> None:
    """Refuses what is no episode: keys, shapes, types, and numbers that cannot be.

    Args:
        episode: Shape [T], with the keys of `TRANSITION_KEYS`.
        name: What the messages call it.

    Raises:
        DatasetError: It is none; the message names the key, what it holds and what was expected.
    """
    if episode.batch_dims != 1 or not len(episode):
        raise DatasetError(
            f"{name} has batch size {tuple(episode.batch_size)}, expected (steps,), one or more"
        )
    steps = len(episode)
    for key in TRANSITION_KEYS:
        label = f"{name}: {key if isinstance(key, str) else '.'.join(map(str, key))}"
        leaf = key if isinstance(key, str) else key[-1]
        value = episode.get(key, None)
        if value is None:
            raise DatasetError(f"{label} is missing")
        dtype = torch.bool if leaf in _FLAGS else torch.float32
        size = value.shape[-1]
        shape = {"depth": (steps, 1, size, size), "action": (steps, 5)}.get(leaf, (steps, 1))
        if tuple(value.shape) != shape or value.dtype != dtype:
            raise DatasetError(
                f"{label} is {value.dtype} of shape {tuple(value.shape)}, expected {dtype} of "
                f"shape {shape}"
            )
        if not value.isfinite().all():
            raise DatasetError(f"{label} holds numbers that are not finite")
        if leaf in _RANGES:
            low, high, meaning = _RANGES[leaf]
            wrong = value[(value < low) | (value > high)]
            if len(wrong):
                raise DatasetError(f"{label} holds {wrong[0].item():g}, expected {meaning}")


def check_image_size(episode: TensorDictBase, size: int | None, name: str) -> int:
    """Refuses images of another size, which is returned.

    Args:
        episode: With ``depth`` and ``next.depth``.
        size: Pixels a side; any, but the same for both, when None.
        name: What the message calls it.

    Raises:
        DatasetError: They have another size.
    """
    expected: int = episode["depth"].shape[-1] if size is None else size
    for key in ("depth", ("next", "depth")):
        found = episode[key].shape[-1]
        if found != expected:
            raise DatasetError(f"{name} has images of {found} pixels a side, expected {expected}")
    return expected


def check_environment(stated: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Checks what a file says about where it was recorded.

    Args:
        stated: What it says; of what it leaves out nothing is asked.
        wanted: What is expected.

    Raises:
        DatasetError: They differ; the message names the first difference.
    """
    there, here = _flat(stated), _flat(json.loads(json.dumps(dict(wanted), default=str)))
    for key, value in here.items():
        if key in there and there[key] != value:
            raise DatasetError(f"recorded with {key}={there[key]!r}, expected {value!r}")


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        inner = value if isinstance(value, dict) else {}
        flat |= {f"{key}.{name}": each for name, each in inner.items()} or {key: value}
    return flat


def project_onto_disc(episodes: Sequence[TensorDictBase]) -> tuple[list[TensorDictBase], int]:
    """Puts actions whose (x, y) lies outside the unit disc onto it; their direction is kept.

    Policies of ``mode=strict`` act on the disc, and cannot imitate what lies outside.

    Args:
        episodes: With the key ``action``, shape (T, 5); they are left as they are.

    Returns:
        The episodes, and how many actions were outside. The others keep their bits.
    """
    projected, count = [], 0
    for episode in episodes:
        action = episode["action"].clone()
        planar = action[..., 1:3].double()
        length = planar.norm(dim=-1, keepdim=True)
        outside = length > 1
        onto = (planar / (length * (1 + _HAIR))).to(action.dtype)
        action[..., 1:3] = torch.where(outside, onto, action[..., 1:3])
        projected.append(episode.clone(recurse=False).set("action", action))
        count += int(outside.sum())
    return projected, count
