"""The blocks of an equivariant map, one per pair of field kinds, and their initial weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from equirl.modules.bases import KernelBasis, field_label, kernel_basis
from equirl.modules.fields import FieldType

__all__ = ["Block", "block_filters", "field_blocks", "initial_weights"]


@dataclass(frozen=True)
class Block:
    """The part of an equivariant map from every input field of one kind to every output of one.

    Args:
        into: Kind of the input fields.
        out: Kind of the output fields.
        fields_in: How many input fields are of that kind.
        fields_out: How many output fields are of that kind.
        dim: Number of basis filters of such a pair; each has a weight of its own.
    """

    into: str
    out: str
    fields_in: int
    fields_out: int
    dim: int

    @property
    def size(self) -> int:
        """Number of weights."""
        return self.fields_out * self.fields_in * self.dim


def field_blocks(
    in_type: FieldType, out_type: FieldType, kernel_size: int
) -> dict[Block, KernelBasis]:
    """The blocks that can be non-zero, in escnn's order of the weights, with their bases."""
    group, found = in_type.group, []
    for into in in_type.kinds:
        for out in out_type.kinds:
            basis = kernel_basis(group, into, out, kernel_size)
            if basis is not None:
                counts = in_type.fields.count(into), out_type.fields.count(out)
                found.append((Block(into, out, *counts, len(basis)), basis))
    found.sort(key=lambda item: (field_label(group, item[0].into), field_label(group, item[0].out)))
    return dict(found)


def block_filters(in_type: FieldType, out_type: FieldType, kernel_size: int) -> np.ndarray:
    """The filter of each weight alone, in the order of the weights.

    Returns:
        Shape (weights, out size, in size, kernel_size ** 2), float64.
    """
    starts = [
        np.cumsum([0, *(fields.dim(field) for field in fields.fields)])
        for fields in (out_type, in_type)
    ]
    filters = []
    for block, basis in field_blocks(in_type, out_type, kernel_size).items():
        places = [
            [start[i] for i, field in enumerate(fields.fields) if field == kind]
            for fields, kind, start in zip(
                (out_type, in_type), (block.out, block.into), starts, strict=True
            )
        ]
        for out in places[0]:
            for into in places[1]:
                for element in basis.elements:
                    filter = np.zeros((out_type.size, in_type.size, kernel_size**2))
                    rows, columns, _ = element.shape
                    filter[out : out + rows, into : into + columns] = element
                    filters.append(filter)
    return np.stack(filters)


def initial_weights(
    blocks: dict[Block, KernelBasis], generator: torch.Generator | None = None
) -> Tensor:
    """Draws weights by He's rule, generalised to steerable filters as escnn generalises it.

    Each irreducible part of an output field receives every kind of irreducible part of the
    input with the same total variance: with m kinds, and N basis filters from one kind
    counted over all input fields, the variance of a weight is 1 / (m N).

    Args:
        blocks: The blocks of a map with their bases.
        generator: Source of randomness; torch's global generator if None.

    Returns:
        The weights of all blocks, flattened, each of shape (fields out, fields in, K).
    """
    # For each irreducible part of an output field: kind of input part -> number of filters.
    filters: dict[tuple[str, int], dict[tuple[int, ...], int]] = {}
    for block, basis in blocks.items():
        for irrep, position in zip(basis.in_irreps, basis.out_positions, strict=True):
            counts = filters.setdefault((block.out, position), {})
            counts[irrep] = counts.get(irrep, 0) + block.fields_in
    weights = []
    for block, basis in blocks.items():
        variances = []
        for irrep, position in zip(basis.in_irreps, basis.out_positions, strict=True):
            counts = filters[block.out, position]
            variances.append(1 / (len(counts) * counts[irrep]))
        normal = torch.randn(block.fields_out, block.fields_in, block.dim, generator=generator)
        weights.append((normal * torch.tensor(variances).sqrt()).flatten())
    return torch.cat(weights)
