"""Rotated transitions: copies beside each stored one, or a fresh rotation at every sampling."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Transform

from equirl.symmetry import SymmetrySpec, manipulation_spec

__all__ = ["RandomRotation", "RotationAugmentation"]

_QUARTER = math.pi / 2


class _Rotation(Transform):
    """What both kinds of rotation share: how keys turn, where angles come from, the clipping."""

    def __init__(
        self,
        spec: SymmetrySpec | None,
        generator: torch.Generator | None,
        bounds: Mapping[NestedKey, tuple[float, float]] | None,
        quarter_turns: bool,
    ):
        super().__init__()
        self.spec = manipulation_spec() if spec is None else spec
        self.generator = generator
        if bounds is None:
            bounds = {"action": (-1.0, 1.0)} if "action" in self.spec.keys else {}
        self.bounds = dict(bounds)
        self.quarter_turns = quarter_turns

    def _draw(self, *shape: int) -> Tensor:
        """Fresh angles of any shape, in rad."""
        if self.quarter_turns:
            return _QUARTER * torch.randint(4, shape, generator=self.generator)
        return math.tau * torch.rand(shape, generator=self.generator)

    def _turn(self, tensordict: TensorDictBase, angles: Tensor) -> TensorDictBase:
        """Each row of a batch (B,) turned by its angle, and clipped to the bounds."""
        if self.quarter_turns:
            turned = self.spec.quarter_turns(tensordict, (angles / _QUARTER).round().long())
        else:
            turned = self.spec.rotate(tensordict, angles)
        for key, (lowest, highest) in self.bounds.items():
            turned.set(key, turned.get(key).clamp(lowest, highest))
        return turned

    def _check_present(self, tensordict: TensorDictBase) -> None:
        missing = [key for key in self.spec.keys if tensordict.get(key, None) is None]
        if missing:
            raise ValueError(
                f"the symmetry names {missing}, which these transitions do not have: "
                f"{sorted(map(str, tensordict.keys()))}"
            )

    def _check_floats(self, tensordict: TensorDictBase) -> None:
        for key in self.spec.keys:
            dtype = tensordict.get(key).dtype
            if not dtype.is_floating_point:
                raise ValueError(
                    f"{key} is of {dtype} and cannot be turned: expected floats; images get "
                    "them from TorchRL's ToTensorImage, for example"
                )


class RotationAugmentation(_Rotation):
    """Buffer augmentation: n rotated copies of every stored transition (paper, appendix F).

    Each copy is the transition with observation, next observation and action turned by
    its own angle, uniform in [0, 2 pi). The angles are drawn once, at insertion; the
    rotation itself is applied when a copy is sampled. Sampling a stored row uniformly
    and then one of its n + 1 versions uniformly is the same distribution as storing
    every copy, for a fraction 1 / (n + 1) of the memory.

    It is a transform of any TorchRL replay buffer that is filled by ``extend``, one row a
    transition; `docs/custom_pipeline.md` shows one.

    Args:
        copies: Rotated copies a transition, n >= 0.
        spec: How each key transforms; that of planar manipulation when None. Every
            transition must have the keys it names.
        generator: Source of the angles and of the choice among copies.
        bounds: Keys whose turned values are clipped, with lowest and highest value; when
            None, ``action`` to [-1, 1] if the spec names it. An action whose (x, y) lies off
            the unit disc can leave its box when turned, and the paper's system clips it; on
            the disc, where equivariant ``strict`` policies act, nothing is clipped.
        quarter_turns: Whether copies are turned by multiples of 90 degrees only, all four
            equally likely: pixels are then permuted, not interpolated.

    Raises:
        ValueError: ``copies`` is negative; at insertion, a key is missing or the batch has
            several dimensions; at sampling, what is to be turned does not hold floats.
    """

    ANGLES = "augmentation_angles"

    def __init__(
        self,
        copies: int,
        *,
        spec: SymmetrySpec | None = None,
        generator: torch.Generator | None = None,
        bounds: Mapping[NestedKey, tuple[float, float]] | None = None,
        quarter_turns: bool = False,
    ):
        if not isinstance(copies, int) or copies < 0:
            raise ValueError(f"copies={copies!r}: expected an integer of 0 or more")
        super().__init__(spec, generator, bounds, quarter_turns)
        self.copies = copies

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_present(tensordict)
        if tensordict.batch_dims > 1:
            raise ValueError(
                "expected one row a transition, got a batch of size "
                f"{tuple(tensordict.batch_size)}: extend the buffer with data.reshape(-1)"
            )
        out = tensordict.clone(recurse=False)
        angles = torch.zeros(*tensordict.batch_size, self.copies + 1)
        angles[..., 1:] = self._draw(*tensordict.batch_size, self.copies)
        return out.set(self.ANGLES, angles)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Turns each row of a sampled batch (B,) into one of its n + 1 versions."""
        if not self.copies:
            return tensordict.exclude(self.ANGLES)
        self._check_floats(tensordict)
        angles = tensordict.pop(self.ANGLES)
        (batch,) = tensordict.batch_size
        copy = torch.randint(self.copies + 1, (batch,), generator=self.generator)
        rows = copy.nonzero().squeeze(-1).to(angles.device)
        if len(rows) == 0:
            return tensordict
        tensordict[rows] = self._turn(tensordict[rows], angles[rows, copy[rows]])
        return tensordict


class RandomRotation(_Rotation):
    """Online augmentation: each sampled transition is turned once (rotational RAD).

    Observation, next observation and action of a transition turn together by an angle drawn
    at sampling, uniform in [0, 2 pi); the same stored row comes out differently every time.
    Nothing is done at insertion.

    Args:
        spec: How each key transforms; that of planar manipulation when None. Every
            transition must have the keys it names.
        generator: Source of the angles, a CPU generator.
        bounds: As those of `RotationAugmentation`.
        quarter_turns: Whether to turn by multiples of 90 degrees only, all four equally
            likely: pixels are then permuted, not interpolated.

    Raises:
        ValueError: At sampling, a key is missing or does not hold floats.
    """

    def __init__(
        self,
        *,
        spec: SymmetrySpec | None = None,
        generator: torch.Generator | None = None,
        bounds: Mapping[NestedKey, tuple[float, float]] | None = None,
        quarter_turns: bool = False,
    ):
        super().__init__(spec, generator, bounds, quarter_turns)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Turns each row of a sampled batch (B,)."""
        self._check_present(tensordict)
        self._check_floats(tensordict)
        (batch,) = tensordict.batch_size
        device = tensordict.get(next(iter(self.spec.keys))).device
        return self._turn(tensordict, self._draw(batch).to(device))
