"""The one statement of the symmetry: how every tensordict key transforms."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from equirl.symmetry.groups import Element
from equirl.symmetry.representations import Representation, ScalarField

__all__ = [
    "ACTION",
    "ACTION_PAPER",
    "MODES",
    "SymmetrySpec",
    "action_representation",
    "check_mode",
    "manipulation_spec",
]

#: The action (gripper, x, y, z, theta): a reflection reverses the sense of theta.
ACTION = Representation("trivial", "vector", "trivial", "sign")
#: The action as the paper's networks declare it (appendix A): theta an invariant.
ACTION_PAPER = Representation("trivial", "vector", "trivial", "trivial")


#: How the networks of each mode take an action to transform.
MODES = {"strict": ACTION, "paper": ACTION_PAPER}


def check_mode(mode: str) -> None:
    """Checks the name of a mode.

    Raises:
        ValueError: It is neither ``"strict"`` nor ``"paper"``.
    """
    if mode not in MODES:
        raise ValueError(f"mode={mode!r}: expected one of {', '.join(MODES)}")


def action_representation(mode: str) -> Representation:
    """The action's representation in the networks of a mode.

    Args:
        mode: ``"strict"`` (the physical action) or ``"paper"`` (appendix A).

    Raises:
        ValueError: Any other mode.
    """
    check_mode(mode)
    return MODES[mode]


class SymmetrySpec:
    """Declares how tensordict keys transform; keys it does not name are invariant.

    Args:
        keys: For each key, a `Representation` (last dimension) or a
            `ScalarField` (last two dimensions). The entry under
            ``("next", key)`` transforms like ``key``.

    Example:
        >>> spec = SymmetrySpec({"pixels": ScalarField(), "action": Representation("vector")})
    """

    def __init__(self, keys: Mapping[NestedKey, Representation | ScalarField]):
        self.keys = dict(keys)

    def transform(self, tensordict: TensorDictBase, element: Element) -> TensorDictBase:
        """Applies one group element to every declared key; returns a new tensordict."""
        out = tensordict.clone(recurse=False)
        for key, rule, value in self._present(tensordict):
            out.set(key, rule.transform(value, element))
        return out

    def rotate(self, tensordict: TensorDictBase, angles: Tensor) -> TensorDictBase:
        """Rotates each row of a tensordict of batch size (B,) by its own angle.

        Args:
            tensordict: Images of shape (B, C, S, S), vectors of shape (B, dim).
            angles: Shape (B,), in rad.

        Returns:
            A new tensordict; undeclared keys are shared with the input.
        """
        out = tensordict.clone(recurse=False)
        images: dict[tuple, list[tuple[NestedKey, Tensor]]] = {}
        for key, rule, value in self._present(tensordict):
            if isinstance(rule, ScalarField):
                images.setdefault((rule, value.shape[-1], value.dtype), []).append((key, value))
            else:
                out.set(key, rule.rotate(value, angles))
        # Images of one size turn together: where to look is worked out once for all of them.
        for (rule, *_), entries in images.items():
            keys, values = zip(*entries, strict=True)
            turned = rule.rotate(torch.cat(values, 1), angles)
            parts = turned.split([value.shape[1] for value in values], 1)
            for key, part in zip(keys, parts, strict=True):
                out.set(key, part)
        return out

    def quarter_turns(self, tensordict: TensorDictBase, turns: Tensor) -> TensorDictBase:
        """Rotates each row of a tensordict of batch size (B,) by its own number of quarter turns.

        Exact: pixels are permuted and vectors swap components, as `transform` does for one
        element; `rotate` by ``turns * pi / 2`` is the same up to rounding.

        Args:
            tensordict: Images of shape (B, C, S, S), vectors of shape (B, dim).
            turns: Shape (B,), integers of either sign.

        Returns:
            A new tensordict; undeclared keys are shared with the input.

        Raises:
            ValueError: The turns are not integers, or images are not square.
        """
        out = tensordict.clone(recurse=False)
        for key, rule, value in self._present(tensordict):
            out.set(key, rule.quarter_turns(value, turns))
        return out

    def _present(
        self, tensordict: TensorDictBase
    ) -> list[tuple[NestedKey, Representation | ScalarField, Tensor]]:
        present = []
        for key, rule in self.keys.items():
            nested = ("next", key) if isinstance(key, str) else ("next", *key)
            for candidate in (key, nested):
                value = tensordict.get(candidate, None)
                if value is not None:
                    present.append((candidate, rule, value))
        return present


def manipulation_spec() -> SymmetrySpec:
    """The symmetry of planar manipulation: what turning the scene does to each key."""
    return SymmetrySpec({"depth": ScalarField(), "action": ACTION})
