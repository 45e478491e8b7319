"""Random observations, to measure a network on pictures that nothing was trained on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral

import numpy as np
import torch
from tensordict import TensorDict

__all__ = ["random_actions", "random_observations"]

_BUMP = 1 / 12  # width of what there is to see in a landscape, of the picture's side
_BOX = 1 / 4  # side of a box, of the picture's


def random_observations(
    count: int, image_size: int, *, max_depth: float = 0.32, seed: int = 0
) -> TensorDict:
    """Landscapes, boxes and symmetric scenes, by turns, each in the whole range of depths.

    * Smooth landscapes, white noise under a Gaussian: no direction is preferred, and what there is
      to see is wider than a pixel, so that a turned picture is the same landscape up to a little
      interpolation.
    * Three boxes on a flat floor: edges, and wide areas of one depth.
    * Squares within one another about the middle, which look the same under every element of D4.
      Mirrored pixels see the same there, so that a network which breaks ties by order errs.

    Args:
        count: How many, at least 1; a third of each kind, from 3 on.
        image_size: S, pixels, at least 1.
        max_depth: The largest depth, m.
        seed: The same gives the same observations.

    Returns:
        ``depth`` (count, 1, S, S), m, and ``holding`` (count, 1), 0 or 1; float32.

    Raises:
        ValueError: ``count`` or ``image_size`` is not an integer of 1 or more.

    Example:
        >>> random_observations(4, 32)["depth"].shape
        torch.Size([4, 1, 32, 32])
    """
    for name, number in (("count", count), ("image_size", image_size)):
        if not isinstance(number, Integral) or isinstance(number, bool) or number < 1:
            raise ValueError(f"{name}={number!r}: expected an integer of 1 or more")
    rng = np.random.default_rng(seed)
    kinds = (_landscape, _boxes, _squares)
    scenes = np.stack([kinds[i % len(kinds)](image_size, rng) for i in range(count)])[:, None]
    lowest, highest = (bound(scenes, axis=(-2, -1), keepdims=True) for bound in (np.min, np.max))
    depth = max_depth * (scenes - lowest) / np.maximum(highest - lowest, 1e-9)
    holding = rng.integers(0, 2, (count, 1))
    values = {"depth": depth, "holding": holding}
    return TensorDict({key: torch.from_numpy(v).float() for key, v in values.items()}, [count])


def _landscape(size: int, rng: np.random.Generator) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(rng.standard_normal((size, size)), _BUMP * size, mode="nearest")


def _boxes(size: int, rng: np.random.Generator) -> np.ndarray:
    scene, side = np.ones((size, size)), math.ceil(_BOX * size)
    for height in rng.uniform(0, 0.8, 3):
        row, column = rng.integers(0, size - side + 1, 2)
        scene[row : row + side, column : column + side] = height
    return scene


def _squares(size: int, rng: np.random.Generator) -> np.ndarray:
    scene = np.ones((size, size))
    for margin in np.sort(rng.integers(1, max(size // 2, 2), 3)):  # from the picture's border
        scene[margin : size - margin, margin : size - margin] = rng.uniform()
    return scene


def random_actions(count: int, fields: Sequence[str], seed: int = 0) -> torch.Tensor:
    """Actions (count, dim), float32: invariants uniform in [-1, 1], vectors in the unit disc.

    Args:
        count: How many.
        fields: The kind of each block: ``"vector"`` has two components, all others have one.
        seed: The same gives the same actions.
    """
    rng = np.random.default_rng(seed)
    blocks = []
    for field in fields:
        if field == "vector":
            length, angle = np.sqrt(rng.uniform(size=count)), rng.uniform(0, math.tau, count)
            blocks += [length * np.cos(angle), length * np.sin(angle)]
        else:
            blocks.append(rng.uniform(-1, 1, count))
    return torch.from_numpy(np.stack(blocks, axis=-1)).float()
