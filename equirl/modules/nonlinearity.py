"""Activations that commute with a symmetry group."""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from equirl.modules.constants import WithConstants
from equirl.modules.fields import FieldType

__all__ = ["OPEN", "FieldReLU", "GatedNonlinearity", "make_activation"]


#: The gates' first bias. They start nearly open: half open ones, one after another, would leave of
#: what turns with the image less than a thousandth after the paper's seven layers.
OPEN = 2.0


class FieldReLU(nn.Module):
    """The ReLU of every channel, which commutes with permutations: for regular fields.

    Args:
        fields: Regular or trivial fields, of input and output.
        inplace: Whether the output takes the place of the input in memory.

    Raises:
        ValueError: A field is of another kind, whose channels a group mixes.
    """

    def __init__(self, fields: FieldType, inplace: bool = False):
        super().__init__()
        if not fields.is_permuted:
            raise ValueError(f"a ReLU commutes with regular and trivial fields, got {fields}")
        self.in_type = self.out_type = fields
        self.inplace = inplace

    def forward(self, x: Tensor, dim: int = -1) -> Tensor:
        """The ReLU of ``x``, of ``in_type.size`` channels in dimension ``dim``.

        Raises:
            ValueError: The channels are not these.
        """
        self.in_type.check(x, dim)
        return F.relu(x, inplace=self.inplace)


class GatedNonlinearity(WithConstants):
    r"""Scales each field by an invariant gate: :math:`v\,\sigma(g + b)` (appendix A).

    The input holds the fields and then one gate for each, whatever its dimension. The bias of
    a gate adds to that of the layer before; escnn's module has it, so the paper's networks do
    (there it is subtracted, and drawn at random).

    Args:
        fields: Fields of the output.

    Attributes:
        in_type: The fields, then as many trivial ones, the gates.
        out_type: The fields.
        bias: One for each gate, `OPEN` at first.
    """

    constant_names: ClassVar[tuple[str, ...]] = ("_field_of",)

    def __init__(self, fields: FieldType):
        super().__init__()
        count = len(fields.fields)
        self.in_type = fields + FieldType.trivial(fields.group, count)
        self.out_type = fields
        with torch.device("cpu"):
            self.bias = nn.Parameter(torch.full((count,), OPEN))
            self._field_of = fields.channels().field_of

    def forward(self, x: Tensor, dim: int = -1) -> Tensor:
        """Gates ``x``, of ``in_type.size`` channels in dimension ``dim``.

        Raises:
            ValueError: The channels are not these.
        """
        self.in_type.check(x, dim)
        values, gates = x.split([self.out_type.size, len(self.bias)], dim)
        shape = [1] * x.ndim
        shape[dim] = -1
        gates = torch.sigmoid(gates + self.bias.view(shape))
        return values * gates.index_select(dim, self._field_of)


def make_activation(fields: FieldType) -> FieldReLU | GatedNonlinearity:
    """The activation of hidden fields: a ReLU where the group permutes channels, else gates.

    The ReLU writes over its input, which the layer before has just computed.
    """
    return FieldReLU(fields, inplace=True) if fields.is_permuted else GatedNonlinearity(fields)
