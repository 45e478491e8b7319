"""What all encoders share: sizes, layers, and how an observation enters."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = [
    "IMAGE_SIZES",
    "CenterCropped",
    "Layer",
    "check_sizes",
    "convolve",
    "pyramid",
    "skeleton",
    "stack_observation",
    "uncropped",
]

#: The image sizes the encoders are defined for.
IMAGE_SIZES = (16, 32, 64, 128, 256)


def check_sizes(hidden: int, image_size: int) -> None:
    """Checks the width and the image size of an encoder.

    Raises:
        ValueError: The image size is not one of `IMAGE_SIZES`, or the width cannot be
            halved as often as the layers ask for.
    """
    if image_size not in IMAGE_SIZES:
        raise ValueError(
            f"image_size={image_size!r} is not supported: expected one of "
            f"{', '.join(map(str, IMAGE_SIZES))} pixels"
        )
    divisor = 16 if image_size == 256 else 8
    if not isinstance(hidden, int) or hidden <= 0 or hidden % divisor:
        raise ValueError(
            f"hidden={hidden!r} is not supported at image_size={image_size}: expected a positive "
            f"multiple of {divisor}, for example {divisor}, {2 * divisor} or 64 (the paper's)"
        )


def uncropped(image_size: int) -> int:
    """Side of the observation of which the crop methods take a crop of ``image_size`` pixels.

    142 for 128 (appendix D), in proportion for other sizes, and rounded up to an even number,
    so that the margins of the crop at the centre are whole pixels: 18 for 16, 36 for 32, 72 for
    64, 284 for 256.
    """
    return 2 * math.ceil(image_size * 142 / 256)


def pyramid(image_size: int) -> list[float]:
    """Widths of the layers that halve the image down to 8 x 8, in units of ``hidden``.

    The paper's four layers take 128 pixels to 8 (appendix A, figure 7); smaller images skip
    the first of them, larger ones start with a narrower layer.
    """
    halvings = int(math.log2(image_size // 8))
    return [2.0**-step for step in reversed(range(halvings))]


class Layer(NamedTuple):
    """A 3 x 3 convolution with its activation, and what follows it."""

    width: int
    padding: int
    pool: bool  # whether 2 x 2 pixels are pooled then


def skeleton(
    image_size: int, hidden: int, tail: tuple[float, float, float] = (2, 1, 1)
) -> list[Layer]:
    """The layers that shrink an image to one pixel (appendix A, figure 7).

    Args:
        image_size: Side of the image, one of `IMAGE_SIZES`.
        hidden: Width of the layer that leaves 8 x 8 pixels.
        tail: Widths of the last three layers, in units of ``hidden``.
    """
    rows = [Layer(int(width * hidden), 1, True) for width in pyramid(image_size)]
    last = [(1, False), (0, True), (0, False)]
    return rows + [Layer(int(n * hidden), *rest) for n, rest in zip(tail, last, strict=True)]


def convolve(layers: Iterable[nn.Module], pools: Iterable[bool], x: Tensor) -> Tensor:
    """Runs the convolutions of a `skeleton`, (N, channels, S, S) to (N, channels, 1, 1)."""
    for convolution, pool in zip(layers, pools, strict=True):
        x = convolution(x)
        if pool:  # before the ReLU, with which it commutes: a quarter of the work
            x = F.max_pool2d(x, 2)
        x = F.relu(x, inplace=True)
    return x


def stack_observation(
    image: Tensor, invariants: Tensor | None, channels: int, count: int, image_size: int
) -> Tensor:
    """What a network sees: the image's channels, and the invariants tiled.

    Args:
        image: Shape (*batch, channels, S, S); a depth image in metres, as the paper feeds it.
        invariants: Shape (*batch, count), such as the holding flag, 0 or 1; None if count is 0.
        channels: Number of channels expected of the image.
        count: Number of invariants expected.
        image_size: The S expected.

    Returns:
        Shape (N, channels + count, S, S) with N the product of the batch dimensions,
        channels-last in memory, the layout convolutions are fastest in.

    Raises:
        ValueError: The shapes are not these.
    """
    batch = image.shape[:-3]
    got = None if invariants is None else tuple(invariants.shape)
    if image.shape[-3:] != (channels, image_size, image_size) or got != (
        (*batch, count) if count else None
    ):
        also = f" and invariants (*batch, {count})" if count else " and no invariants"
        raise ValueError(
            f"expected an image (*batch, {channels}, {image_size}, {image_size}){also}, "
            f"got {tuple(image.shape)} and {got}"
        )
    image = image.reshape(math.prod(batch), channels, image_size, image_size).movedim(1, -1)
    if invariants is None:
        return image.contiguous().movedim(-1, 1)
    tiled = invariants.to(image.dtype).reshape(-1, 1, 1, count)
    return torch.cat([image, tiled.expand(*image.shape[:-1], count)], -1).movedim(-1, 1)


class CenterCropped(nn.Module):
    """An encoder that sees the centre of an image that is larger than its own.

    The crop methods learn from crops and act on what the camera gives: this accepts either.
    The pixel grid's rotations and reflections commute with it.

    Args:
        encoder: Maps an image (*batch, channels, S, S), and what else it is given, to features.
        image_size: That S; images may have this side, or that of `uncropped`.
    """

    def __init__(self, encoder: nn.Module, image_size: int):
        super().__init__()
        self.encoder = encoder
        self.image_size, self.uncropped_size = image_size, uncropped(image_size)

    def forward(self, image: Tensor, *others: Tensor | None) -> Tensor:
        """Encodes the centre of an image of shape (*batch, channels, size, size).

        Raises:
            ValueError: The size is neither that of the encoder nor the uncropped one.
        """
        seen, full = self.image_size, self.uncropped_size
        if image.shape[-2:] == (full, full):
            margin = (full - seen) // 2
            image = image[..., margin : margin + seen, margin : margin + seen]
        elif image.shape[-2:] != (seen, seen):
            raise ValueError(
                f"expected an image of {full} x {full} pixels, of which the centre is seen, or one "
                f"cropped to {seen} x {seen}, got the shape {tuple(image.shape)}"
            )
        return self.encoder(image, *others)

    def extra_repr(self) -> str:
        """The sides of the images before and after the crop."""
        return f"{self.uncropped_size} -> {self.image_size} px"
