"""Random observations, to measure a network on pictures that nothing was trained on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict

__all__ = ["random_actions", "random_observations"]

_BUMP = 1 / 12  # width of what there is to see, of the picture's side


def random_observations(
    count: int, image_size: int, *, max_depth: float = 0.32, seed: int = 0
) -> TensorDict:
    """Smooth random landscapes, each stretched over the whole range of depths.

    White noise under a Gaussian: no direction is preferred, and what there is to see is wider than
    a pixel, so that a turned picture is the same landscape up to a little interpolation.

    Args:
        count: How many, at least 1.
        image_size: S, pixels.
        max_depth: The largest depth, m.
        seed: The same gives the same observations.

    Returns:
        ``depth`` (count, 1, S, S), m, and ``holding`` (count, 1), 0 or 1; float32.

    Raises:
        ValueError: A number is below 1.

    Example:
        >>> random_observations(4, 32)["depth"].shape
        torch.Size([4, 1, 32, 32])
    """
    for name, number in (("count", count), ("image_size", image_size)):
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number!r}")
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((count, 1, image_size, image_size))
    width = _BUMP * image_size
    smooth = gaussian_filter(noise, (0, 0, width, width), mode="nearest")
    lowest, highest = (bound(smooth, axis=(-2, -1), keepdims=True) for bound in (np.min, np.max))
    depth = max_depth * (smooth - lowest) / np.maximum(highest - lowest, 1e-9)
    holding = rng.integers(0, 2, (count, 1))
    values = {"depth": depth, "holding": holding}
    return TensorDict({key: torch.from_numpy(v).float() for key, v in values.items()}, [count])


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
