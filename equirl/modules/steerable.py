"""Steerable layers: linear maps and convolutions that commute with a symmetry group."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from equirl.modules.bases import KernelBasis
from equirl.modules.blocks import Block, field_blocks, initial_weights
from equirl.modules.device import resolve_device
from equirl.modules.fields import FieldType
from equirl.modules.filters import expanded_filter

__all__ = ["SteerableConv", "SteerableLinear"]


class _Steerable(nn.Module):
    """Weights of an equivariant map, and their expansion to a dense filter.

    Every equivariant filter is a combination of constant basis filters. The weights are
    laid out as escnn's ``R2Conv`` lays them out: one block per pair of field kinds, in
    the order of their names, each of shape (out fields, in fields, K). The basis is a
    constant of this module alone, rounded from float64 to the dtype of the weights. It is
    neither parameter nor buffer: the state dict holds the weights and biases, in either
    mode, and a functional swap of parameters (a target network's) leaves it alone.

    Args:
        in_type: Fields of the input.
        out_type: Fields of the output.
        kernel_size: Side of the filter in pixels.
        bias: Whether to learn a shift of each field's invariant part.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Raises:
        ValueError: The fields belong to different groups, or no map but zero commutes.
    """

    def __init__(
        self,
        in_type: FieldType,
        out_type: FieldType,
        kernel_size: int,
        bias: bool = True,
        device: torch.device | str | None = None,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        if in_type.group != out_type.group:
            raise ValueError(
                f"input and output fields of one group expected, got {in_type} and {out_type}"
            )
        self.in_type, self.out_type, self.kernel_size = in_type, out_type, kernel_size
        bases = field_blocks(in_type, out_type, kernel_size)
        if not bases:
            raise ValueError(f"only the zero map from {in_type} to {out_type} is equivariant")
        self._blocks = tuple(bases)
        with torch.device("cpu"):  # where the generator is
            self.weights = nn.Parameter(initial_weights(bases, generator))
            shifts = out_type.bias_count if bias else 0
            self.bias = nn.Parameter(torch.zeros(shifts)) if shifts else None
            self._make_constants(bases)
        self.to(resolve_device(device))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> nn.Module:
        before = self.weights.dtype, self.weights.device
        super()._apply(fn, recurse)
        if (self.weights.dtype, self.weights.device) != before:
            # Anew from float64: casting rounded constants would keep their error.
            self._make_constants(field_blocks(self.in_type, self.out_type, self.kernel_size))
        return self

    def _make_constants(self, bases: dict[Block, KernelBasis]) -> None:
        """Brings the constants to the dtype and device of the weights."""
        like = self.weights.detach()
        # Axes as the expansion wants them: (K, out channels, pixels, in channels).
        self._bases = tuple(
            torch.tensor(bases[block].elements).permute(0, 1, 3, 2).to(like).contiguous()
            for block in self._blocks
        )
        index, factor = self.out_type.bias_layout()
        self._bias_index = torch.tensor(index, device=like.device)
        self._bias_factor = torch.tensor(factor, dtype=torch.float64).to(like)
        self._in_order = _restoring_order(self.in_type, like.device)
        self._out_order = _restoring_order(self.out_type, like.device)

    def filter(self) -> Tensor:
        """The dense filter, of shape (out size, in size, k, k) and channels-last in memory."""
        return expanded_filter(self, self.weights, self._expand)

    def expanded_bias(self) -> Tensor | None:
        """The bias of every channel, of shape (out size,)."""
        if self.bias is None:
            return None
        return self.bias[self._bias_index] * self._bias_factor

    def _expand(self, weights: Tensor) -> Tensor:
        filters, start = {}, 0
        for block, basis in zip(self._blocks, self._bases, strict=True):
            coefficients = weights[start : start + block.size].view(-1, block.dim)
            start += block.size
            _, out, pixels, into = basis.shape
            filter = (coefficients @ basis.flatten(1)).view(
                block.fields_out, block.fields_in, out, pixels, into
            )
            # To (out fields, out channels, pixels, in fields, in channels): the order in
            # memory in which convolutions run fastest. This is the only copy.
            filters[block.into, block.out] = filter.permute(0, 2, 3, 1, 4).reshape(
                block.fields_out * out, pixels, block.fields_in * into
            )
        filter = next(iter(filters.values())) if self._is_single else self._assemble(filters)
        k = self.kernel_size
        return filter.view(self.out_type.size, k, k, self.in_type.size).permute(0, 3, 1, 2)

    @property
    def _is_single(self) -> bool:
        return len(self.in_type.kinds) == 1 and len(self.out_type.kinds) == 1

    def _assemble(self, filters: dict[tuple[str, str], Tensor]) -> Tensor:
        # Fields of one kind side by side first, then every channel to its place.
        some, rows = next(iter(filters.values())), []
        for out in self.out_type.kinds:
            row = []
            for into in self.in_type.kinds:
                filter = filters.get((into, out))
                if filter is None:  # only the zero map is equivariant
                    sizes = self.out_type.kind_size(out), self.in_type.kind_size(into)
                    filter = some.new_zeros(sizes[0], self.kernel_size**2, sizes[1])
                row.append(filter)
            rows.append(torch.cat(row, -1))
        assembled = torch.cat(rows, 0)
        if self._out_order is not None:
            assembled = assembled.index_select(0, self._out_order)
        if self._in_order is not None:
            assembled = assembled.index_select(2, self._in_order)
        return assembled

    def extra_repr(self) -> str:
        """The fields and the size of the filter."""
        return f"{self.in_type} -> {self.out_type}, kernel_size={self.kernel_size}"


class SteerableConv(_Steerable):
    """A planar convolution that commutes with a group, in plain torch.

    Same kernels, weights and initialisation as escnn's ``R2Conv``; the filter is expanded
    from the weights in every pass, unless inside
    `shared_filters`.

    Args:
        in_type: Fields of the input.
        out_type: Fields of the output.
        kernel_size: Side of the filter in pixels.
        padding: Zero padding in pixels.
        **kwargs: ``bias``, ``device`` and ``generator``, as for `SteerableLinear`.
    """

    def __init__(
        self,
        in_type: FieldType,
        out_type: FieldType,
        kernel_size: int = 3,
        padding: int = 0,
        **kwargs: Any,
    ):
        super().__init__(in_type, out_type, kernel_size, **kwargs)
        self.padding = padding

    def forward(self, x: Tensor) -> Tensor:
        """Convolves ``x`` of shape (B, in size, H, W); returns (B, out size, H', W')."""
        return F.conv2d(x, self.filter(), self.expanded_bias(), padding=self.padding)


class SteerableLinear(_Steerable):
    """An equivariant linear map between vectors of fields: a 1 x 1 convolution of one pixel.

    Args:
        in_type: Fields of the input.
        out_type: Fields of the output.
        bias: Whether to learn a shift of each field's invariant part.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.
    """

    def __init__(self, in_type: FieldType, out_type: FieldType, **kwargs: Any):
        super().__init__(in_type, out_type, kernel_size=1, **kwargs)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``x`` of shape (..., in size) to (..., out size)."""
        return F.linear(x, self.filter().flatten(1), self.expanded_bias())


def _restoring_order(fields: FieldType, device: torch.device) -> Tensor | None:
    """Takes channels grouped by kind of field back to their own order; None if they are in it."""
    channels: dict[str, list[int]] = {kind: [] for kind in fields.kinds}
    start = 0
    for field in fields.fields:
        channels[field] += range(start, start + fields.dim(field))
        start += fields.dim(field)
    grouped = torch.tensor([channel for kind in channels.values() for channel in kind])
    order = grouped.argsort()
    return None if torch.equal(order, grouped.sort().values) else order.to(device)
