"""Films of a policy: the scene beside what the network sees."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from equirl.envs import ManipulationEnv
from equirl.training.evaluation import play

__all__ = ["COLORS", "EXPONENT", "Frame", "film_policy", "open_film", "record"]

_SIDE = 384  # pixels of each of the two pictures
COLORS = "viridis_r"  # of depths; near is bright
EXPONENT = 0.6  # of depths before they are coloured: near ones, where it matters, differ more


@dataclass(frozen=True, eq=False)
class Frame:
    """A moment of an episode.

    Attributes:
        picture: Of the scene, shape (P, P, 3), uint8; None of a recording, which has none.
        depth: What the network sees, shape (S, S), in metres below the end effector.
        deepest: The floor's depth with the gripper at the top of the workspace, m.
        holding: Whether the gripper holds an object; the network is told.
        reward: What the action before earned; 0 at the start.
        action: What the policy then does, shape (5,); None at the end.
    """

    picture: np.ndarray | None
    depth: np.ndarray
    deepest: float
    holding: bool
    reward: float = 0.0
    action: np.ndarray | None = None


def record(
    env: ManipulationEnv,
    policy: TensorDictModuleBase,
    *,
    seed: int | None = None,
    device: torch.device | str = "cpu",
    side: int = _SIDE,
) -> list[Frame]:
    """Plays a greedy episode.

    Args:
        env: Renders the scene.
        policy: Acts deterministically.
        seed: The scene; when None it is what the next reset of ``env`` gives.
        device: Where the policy lives.
        side: P, pixels of a picture of the scene.

    Returns:
        A frame for the start and one for each step.
    """
    frames: list[Frame] = []

    def shoot(seen: TensorDictBase, action: torch.Tensor | None, reward: float) -> None:
        frames.append(
            Frame(
                picture=env.render(side, side),
                depth=seen["depth"][0].numpy(),
                deepest=env.workspace.z_max,
                holding=bool(seen["holding"].item()),
                reward=reward,
                action=None if action is None else action.numpy(),
            )
        )

    play(env, policy, seed=seed, device=device, on_moment=shoot)
    return frames


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

    Raises:
        OSError: The file cannot be written.
    """
    with open_film(path, fps=fps) as add:
        for seed in seeds:
            for frame in record(env, policy, seed=seed, device=device):
                add(frame)
    return path


@contextmanager
def open_film(path: Path, *, fps: int = 4, side: int = _SIDE) -> Iterator[Callable[[Frame], None]]:
    """Opens an MP4 file and gives the function that adds a frame to it.

    Args:
        path: The file to write.
        fps: Frames a second.
        side: Pixels a side of frames that have no picture of the scene; others are as large as
            their pictures.

    Raises:
        OSError: The file cannot be written.
    """
    import imageio.v2 as imageio
    import imageio_ffmpeg

    path.open("wb").close()  # the encoder is a process of its own and would fail in silence
    writer: Any = imageio.get_writer(path, fps=fps, macro_block_size=None, quality=7)
    with writer:
        yield lambda frame: writer.append_data(_film_picture(frame, side))
    try:
        imageio_ffmpeg.count_frames_and_secs(path)
    except RuntimeError:
        raise OSError(f"{path} could not be written; is the disk full?") from None


def _film_picture(frame: Frame, side: int) -> np.ndarray:
    """The scene beside what the network sees; only this where there is no picture of the scene."""
    if frame.picture is None:
        return _depth_picture(frame, side)
    return np.hstack([frame.picture, _depth_picture(frame, len(frame.picture))])


def _depth_picture(frame: Frame, side: int) -> np.ndarray:
    """The depth image in colours, (side, side, 3); pixels kept sharp."""
    import matplotlib

    share = np.clip(frame.depth / frame.deepest, 0, 1) ** EXPONENT
    colors = (matplotlib.colormaps[COLORS](share)[..., :3] * 255).astype(np.uint8)
    index = np.arange(side) * len(colors) // side
    return colors[index][:, index]
