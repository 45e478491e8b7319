"""Replay-buffer transforms: what happens to transitions between insertion and sampling."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import Transform

from equirl.symmetry import SymmetrySpec, manipulation_spec

__all__ = ["QuantizeDepth", "RotationAugmentation"]


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
        nested = [*in_keys, *(("next", key) for key in in_keys)]
        super().__init__(in_keys=nested, out_keys=nested, in_keys_inv=nested, out_keys_inv=nested)
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


class RotationAugmentation(Transform):
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
            the disc, where ``strict`` actions live, nothing is clipped.

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
    ):
        if not isinstance(copies, int) or copies < 0:
            raise ValueError(f"copies={copies!r}: expected an integer of 0 or more")
        super().__init__()
        self.copies = copies
        self.spec = manipulation_spec() if spec is None else spec
        self.generator = generator
        if bounds is None:
            bounds = {"action": (-1.0, 1.0)} if "action" in self.spec.keys else {}
        self.bounds = dict(bounds)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        missing = [key for key in self.spec.keys if tensordict.get(key, None) is None]
        if missing:
            raise ValueError(
                f"the symmetry names {missing}, which these transitions do not have: "
                f"{sorted(map(str, tensordict.keys()))}"
            )
        if tensordict.batch_dims > 1:
            raise ValueError(
                "expected one row a transition, got a batch of size "
                f"{tuple(tensordict.batch_size)}: extend the buffer with data.reshape(-1)"
            )
        out = tensordict.clone(recurse=False)
        angles = torch.zeros(*tensordict.batch_size, self.copies + 1)
        drawn = torch.rand(*tensordict.batch_size, self.copies, generator=self.generator)
        angles[..., 1:] = math.tau * drawn
        return out.set(self.ANGLES, angles)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Turns each row of a sampled batch (B,) into one of its n + 1 versions."""
        if not self.copies:
            return tensordict.exclude(self.ANGLES)
        for key in self.spec.keys:
            dtype = tensordict.get(key).dtype
            if not dtype.is_floating_point:
                raise ValueError(
                    f"{key} is of {dtype} and cannot be turned: expected floats; images get "
                    "them from TorchRL's ToTensorImage, for example"
                )
        angles = tensordict.pop(self.ANGLES)
        (batch,) = tensordict.batch_size
        copy = torch.randint(self.copies + 1, (batch,), generator=self.generator)
        rows = copy.nonzero().squeeze(-1).to(angles.device)
        if len(rows) == 0:
            return tensordict
        turned = self.spec.rotate(tensordict[rows], angles[rows, copy[rows]])
        for key, (lowest, highest) in self.bounds.items():
            turned.set(key, turned.get(key).clamp(lowest, highest))
        tensordict[rows] = turned
        return tensordict
