"""Replay-buffer transforms of images: how depth is stored, and random windows of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Transform

__all__ = ["QuantizeDepth", "RandomCrop"]


def _with_next(keys: Sequence[str]) -> list[NestedKey]:
    """The keys of an observation, then those of the next one."""
    return [*keys, *(("next", key) for key in keys)]


class QuantizeDepth(Transform):
    """Stores depth images as 16-bit integers: half the memory of float32, error below 3 um.

    Insertion maps [0, ``maximum``] metres to the 65,536 levels of an int16, sampling
    maps back to float32 metres.

    Args:
        maximum: The largest depth stored, in m; observations are clipped there.
        in_keys: The depth images, each also looked up under ``"next"``.

    Raises:
        ValueError: The maximum is not above 0, or, at insertion, a depth is not finite.
    """

    _OFFSET = 2**15
    _LEVELS = 2**16 - 1

    def __init__(self, maximum: float, in_keys: Sequence[str] = ("depth",)):
        if not 0 < maximum < math.inf:
            raise ValueError(f"maximum={maximum!r}: expected a depth above 0, m")
        keys = _with_next(in_keys)
        super().__init__(in_keys=keys, out_keys=keys, in_keys_inv=keys, out_keys_inv=keys)
        self.maximum = maximum

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = tensordict.clone(recurse=False)
        for key in self.in_keys_inv:
            depth = tensordict.get(key)
            if not depth.isfinite().all():
                raise ValueError(f"{key} holds numbers that are not finite: no depths")
            level = (depth * (self._LEVELS / self.maximum)).round()
            level = level.clamp(0, self._LEVELS) - self._OFFSET
            out.set(key, level.to(torch.int16))
        return out

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Restores float32 metres in a sampled batch."""
        for key in self.in_keys:
            level = tensordict.get(key).float() + self._OFFSET
            tensordict.set(key, level * (self.maximum / self._LEVELS))
        return tensordict


class RandomCrop(Transform):
    """A random window of the images of each sampled transition (RAD, FERM; paper, appendix H).

    Observation and next observation of a transition are cropped by the same window, all its
    positions equally likely. Nothing is done at insertion: whole images are stored.

    Args:
        size: Rows and columns of the window, in pixels.
        positives: Also write ``"positive"``, a second window of the first of the observation's
            images, drawn independently of the first: what the contrastive loss of FERM is to
            recognise.
        in_keys: The images, each also looked up under ``"next"``.
        generator: Source of the windows, a CPU generator.

    Raises:
        ValueError: The size is not an integer of 1 or more; at sampling, the images are smaller
            than the window.
    """

    POSITIVE = "positive"

    def __init__(
        self,
        size: int,
        *,
        positives: bool = False,
        in_keys: Sequence[str] = ("depth",),
        generator: torch.Generator | None = None,
    ):
        if not isinstance(size, int) or size < 1:
            raise ValueError(f"size={size!r}: expected an integer of 1 or more")
        keys = _with_next(in_keys)
        super().__init__(in_keys=keys, out_keys=[*keys, self.POSITIVE] if positives else keys)
        self.size = size
        self.positives = positives
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Crops the images of a sampled batch (B,), each (B, C, H, W), to (B, C, size, size)."""
        image = tensordict.get(self.in_keys[0])
        window = self._draw(image)
        for key in self.in_keys:
            tensordict.set(key, self._crop(tensordict.get(key), window))
        if self.positives:
            tensordict.set(self.POSITIVE, self._crop(image, self._draw(image)))
        return tensordict

    def _draw(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """First row and first column of a window for each image, (B,) each."""
        rows, columns = image.shape[-2:]
        if min(rows, columns) < self.size:
            raise ValueError(
                f"images of {rows} x {columns} pixels cannot be cropped to {self.size} x "
                f"{self.size}: expected images at least as large"
            )
        top, left = (
            torch.randint(length - self.size + 1, image.shape[:1], generator=self.generator)
            for length in (rows, columns)
        )
        return top.to(image.device), left.to(image.device)

    def _crop(self, image: Tensor, window: tuple[Tensor, Tensor]) -> Tensor:
        # A view of all windows, (B, C, tops, lefts, size, size), of which one each is copied.
        windows = image.unfold(-2, self.size, 1).unfold(-2, self.size, 1)
        rows = torch.arange(len(image), device=image.device)
        return windows[rows, :, *window]
