"""Pooling that commutes with a symmetry group: over pixels, and of fields to invariants."""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from equirl.modules.constants import WithConstants
from equirl.modules.fields import FieldType
from equirl.symmetry import check_mode

__all__ = [
    "FieldMaxPool",
    "GroupMaxPool",
    "NormMaxPool",
    "NormPool",
    "make_invariant_pool",
    "make_pixel_pool",
]

#: Added to squared norms, whose roots would have no derivative at zero.
EPSILON = 1e-12


def _epsilon(x: Tensor) -> float:
    return max(EPSILON, torch.finfo(x.dtype).tiny)


def _check_even(x: Tensor) -> None:
    if x.ndim != 4 or x.shape[-2] % 2 or x.shape[-1] % 2:
        raise ValueError(f"expected maps (B, C, H, W) of even H and W, got {tuple(x.shape)}")


class FieldMaxPool(nn.Module):
    """The maximum of every channel over 2 x 2 pixels: for regular fields.

    Args:
        fields: Regular or trivial fields, of input and output.

    Raises:
        ValueError: A field is of another kind, whose channels a group mixes.
    """

    def __init__(self, fields: FieldType):
        super().__init__()
        if not fields.is_permuted:
            raise ValueError(f"a maximum commutes with regular and trivial fields, got {fields}")
        self.in_type = self.out_type = fields

    def forward(self, x: Tensor) -> Tensor:
        """Maps (B, size, H, W) to (B, size, H / 2, W / 2).

        Raises:
            ValueError: The height or the width is odd, or the channels are not these.
        """
        _check_even(x)
        self.in_type.check(x, 1)
        return F.max_pool2d(x, 2)


class _Norms(WithConstants):
    """Squared norms of fields of one or two channels."""

    constant_names: ClassVar[tuple[str, ...]] = ("_field_of", "_first", "_second", "_has_second")

    def __init__(self, fields: FieldType):
        super().__init__()
        with torch.device("cpu"):
            self._field_of, self._first, self._second, self._has_second = fields.channels()

    def _squared_norms(self, x: Tensor, dim: int) -> Tensor:
        shape = [1] * x.ndim
        shape[dim] = -1
        second = x.index_select(dim, self._second) * self._has_second.to(x.dtype).view(shape)
        return x.index_select(dim, self._first).square() + second.square()


class NormMaxPool(_Norms):
    r"""Of each field the vector of largest norm among 2 x 2 pixels.

    Where several are largest, as where a symmetric object is under the gripper, taking one of
    them breaks the symmetry (the paper's network takes the first), and rounding decides which.
    By default the vectors are therefore averaged with weights that grow steeply with their
    norms and share ties evenly, :math:`w_i \propto (|v_i|^2 + \epsilon)^2`: continuous, and
    exactly equivariant for every input.

    Args:
        fields: Irreducible fields, of input and output.
        ties: ``"shared"``, as above; ``"first"``: the first of the largest, row by row.

    Raises:
        ValueError: A field is regular, or ties are resolved in neither way.
    """

    def __init__(self, fields: FieldType, ties: str = "shared"):
        if ties not in ("shared", "first"):
            raise ValueError(f"ties={ties!r}: expected shared or first")
        super().__init__(fields)
        self.in_type = self.out_type = fields
        self.ties = ties

    def forward(self, x: Tensor) -> Tensor:
        """Maps (B, size, H, W) to (B, size, H / 2, W / 2).

        Raises:
            ValueError: The height or the width is odd, or the channels are not these.
        """
        _check_even(x)
        self.in_type.check(x, 1)
        pixels = [x[..., i::2, j::2] for i in (0, 1) for j in (0, 1)]
        norms = [self._squared_norms(pixel, 1) for pixel in pixels]
        if self.ties == "first":
            best, largest = pixels[0], norms[0]
            for pixel, norm in zip(pixels[1:], norms[1:], strict=True):
                better = (norm > largest) | norm.isnan()  # not a number wins
                best = torch.where(better.index_select(1, self._field_of), pixel, best)
                largest = torch.where(better, norm, largest)
            return best
        # Relative to the largest norm, which cancels: the fourth power of a norm may overflow.
        largest = torch.stack(norms).detach().amax(0) + _epsilon(x)
        weights = [((norm + _epsilon(x)) / largest).square() for norm in norms]
        total = sum(weights[1:], weights[0])
        shares = [(weight / total).index_select(1, self._field_of) for weight in weights]
        parts = [share * pixel for share, pixel in zip(shares, pixels, strict=True)]
        return sum(parts[1:], parts[0])


class GroupMaxPool(nn.Module):
    """The maximum of each regular field over the group: one invariant per field.

    Args:
        in_type: Regular fields.

    Raises:
        ValueError: A field is not regular.
    """

    def __init__(self, in_type: FieldType):
        super().__init__()
        if not in_type.is_regular:
            raise ValueError(f"only regular fields can be pooled over the group, got {in_type}")
        self.in_type = in_type
        self.out_type = FieldType.trivial(in_type.group, len(in_type.fields))

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``x`` of shape (..., fields * group order) to (..., fields).

        Raises:
            ValueError: The channels are not these.
        """
        self.in_type.check(x)
        # amax shares the gradient evenly among tied maxima, as the symmetry demands;
        # max would give it to the first.
        return x.unflatten(-1, (-1, self.in_type.group.order)).amax(-1)


class NormPool(_Norms):
    r"""The norm of each field, :math:`\sqrt{|v|^2 + \epsilon}`: one invariant per field.

    Args:
        in_type: Irreducible fields.

    Raises:
        ValueError: A field is regular.
    """

    def __init__(self, in_type: FieldType):
        super().__init__(in_type)
        self.in_type = in_type
        self.out_type = FieldType.trivial(in_type.group, len(in_type.fields))

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``x`` of shape (..., size) to (..., fields).

        Raises:
            ValueError: The channels are not these.
        """
        self.in_type.check(x)
        return (self._squared_norms(x, -1) + _epsilon(x)).sqrt()


def make_pixel_pool(fields: FieldType, mode: str = "strict") -> FieldMaxPool | NormMaxPool:
    """The pooling of hidden fields over 2 x 2 pixels; ``"paper"`` takes the first of ties.

    Raises:
        ValueError: The mode is neither ``"strict"`` nor ``"paper"``.
    """
    check_mode(mode)
    if fields.is_permuted:
        return FieldMaxPool(fields)
    return NormMaxPool(fields, ties="first" if mode == "paper" else "shared")


def make_invariant_pool(fields: FieldType) -> GroupMaxPool | NormPool:
    """The pooling of hidden fields to invariants: over the group, or norms."""
    return GroupMaxPool(fields) if fields.is_regular else NormPool(fields)
