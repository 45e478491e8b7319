"""Films of a policy: the scene beside what the network sees."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase

from equirl.envs import ManipulationEnv

from .evaluation import play

__all__ = ["film_policy"]

_SIDE = 384  # pixels of each of the two pictures


def film_policy(
    env: ManipulationEnv,
    policy: TensorDictModuleBase,
    seeds: Sequence[int],
    path: Path,
    *,
    fps: int = 4,
    device: torch.device | str = "cpu",
) -> Path:
    """Plays greedy episodes and writes them as one MP4, a frame a step.

    Args:
        env: Renders the scene.
        policy: Acts deterministically.
        seeds: The scenes.
        path: The file to write.
        fps: Frames a second.
        device: Where the policy lives.

    Returns:
        ``path``.
    """
    import imageio.v2 as imageio

    deepest = env.observation_spec["depth"].high.max().item()

    writer: Any = imageio.get_writer(path, fps=fps, macro_block_size=None, quality=7)
    with writer:

        def film(depth: torch.Tensor) -> None:
            writer.append_data(
                np.hstack([env.render(_SIDE, _SIDE), _depth_picture(depth, deepest)])
            )

        for seed in seeds:
            play(env, policy, seed, device=device, on_step=film)
    return path


def _depth_picture(depth: torch.Tensor, deepest: float) -> np.ndarray:
    """A depth image (1, S, S) in metres up to ``deepest`` as an RGB picture, near is bright."""
    import matplotlib

    near = 1 - depth[0].numpy() / deepest
    return _enlarged((matplotlib.colormaps["viridis"](near)[..., :3] * 255).astype(np.uint8))


def _enlarged(picture: np.ndarray) -> np.ndarray:
    """Resizes a square picture (S, S, 3) to the film's size, pixels kept sharp."""
    index = np.arange(_SIDE) * len(picture) // _SIDE
    return picture[index][:, index]
