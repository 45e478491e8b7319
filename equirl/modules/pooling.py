"""Pooling of regular fields to invariants."""

from __future__ import annotations

from torch import Tensor, nn

from equirl.modules.fields import FieldType

__all__ = ["GroupMaxPool"]


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
        """Maps ``x`` of shape (..., fields * group order) to (..., fields)."""
        # amax shares the gradient evenly among tied maxima, as the symmetry demands;
        # max would give it to the first.
        return x.unflatten(-1, (-1, self.in_type.group.order)).amax(-1)
