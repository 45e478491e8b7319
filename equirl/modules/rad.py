"""RAD: the CNN baseline, trained on random crops of what the camera sees.

Reinforcement learning with augmented data (Laskin et al., 2020) leaves soft actor-critic and its
networks as they are and changes the data: the camera sees more than the networks do, 142 x 142
pixels for 128 x 128 (appendix D), and every sampled transition is cropped at a place of its own,
observation and next observation alike (`equirl.data.RandomCrop`). The networks so learn that
what is a few pixels aside is the same scene; when acting they see the centre of the image.
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential
from torchrl.modules import ProbabilisticActor

from equirl.modules.cnn import CNNEncoder, as_cnn_actor, as_cnn_critic
from equirl.modules.layout import CenterCropped

__all__ = ["make_rad_actor", "make_rad_critic"]


def make_rad_actor(
    *,
    hidden: int = 64,
    image_size: int = 128,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> ProbabilisticActor:
    """The policy of `make_cnn_actor`, which also takes images of which it sees the centre.

    Args:
        hidden: The n of the equivariant networks it is compared with; 64 in the paper.
        image_size: Side of the image after the crop: 16, 32, 64, 128 or 256 pixels; before it,
            see `uncropped`.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Returns:
        An actor with the keys of `make_actor`.

    Raises:
        ValueError: The width or the image size is not supported.
    """
    encoder = CNNEncoder(hidden=hidden, image_size=image_size)
    return as_cnn_actor(
        CenterCropped(encoder, image_size),
        encoder.out_features,
        device=device,
        generator=generator,
    )


def make_rad_critic(
    *,
    hidden: int = 64,
    image_size: int = 128,
    heads: int = 2,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> TensorDictSequential:
    """The critic of `make_cnn_critic`, which also takes images of which it sees the centre.

    Args:
        hidden: The n of the equivariant networks it is compared with; 64 in the paper.
        image_size: Side of the image after the crop: 16, 32, 64, 128 or 256 pixels; before it,
            see `uncropped`.
        heads: Number of estimates, which share the encoder.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Returns:
        Two modules in sequence with the keys of `make_critic`.

    Raises:
        ValueError: The width, the image size or the number of heads is not supported.
    """
    encoder = CNNEncoder(hidden=hidden, image_size=image_size)
    return as_cnn_critic(
        CenterCropped(encoder, image_size),
        encoder.out_features,
        heads=heads,
        device=device,
        generator=generator,
    )
