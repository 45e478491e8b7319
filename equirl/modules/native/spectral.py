"""Steerable filters in spectral form: the weights the native kernels multiply with.

A 3 x 3 equivariant filter spans six of the nine pixel functions only. The fields split into
irreducible parts (regular ones by a Fourier transform), and products of pixel functions with
parts of the input split again, so that an output part depends on input *rows* of its own kind
alone. The weights of these independent maps are the spectral weights; they are as many as the
steerable ones. A finite group whose rotations contain the quarter turns is seen as its C4 or D4
subgroup: a regular field is then several fields of the subgroup, one per coset.

Which rows there are, in the order of the kernels, is stated in rows.py; this module finds by
least squares, in float64, how spectral weights follow from steerable ones.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from equirl.modules.blocks import Block, block_filters, field_blocks
from equirl.modules.fields import TRIVIAL, FieldType, element_key
from equirl.modules.native.rows import Space, corner_weights, unit_filters, without_noise
from equirl.modules.nonlinearity import make_activation
from equirl.symmetry import Element, SymmetryGroup

__all__ = ["SpectralBasis", "plain_tensors", "spectral_basis"]

_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class SpectralBasis:
    """How the kernels see the steerable filters from one kind of field to hidden ones.

    Args:
        space: The group the kernels work with: C4, D4, SO(2) or O(2).
        cosets: Fields of that group that make up one hidden field; 1 if it is not a subgroup.
        hidden: Whether the input fields are hidden ones; trivial otherwise.
        size: Number of spectral weights of a pair of the kernels' fields.
        edge: Weight of the corners in the pixel functions of even frequency.
        axis: Weight of the corners in the pixel functions x and y.
        blocks: The blocks of the steerable weights of one pair of fields.
        expansion: Shape (K, cosets out * cosets in * size), float32: from the K steerable
            weights of a pair of fields to spectral ones.
        transposition: Shape (size, size), float32: spectral weights of a pair to those of
            the transposed filter; None for trivial input.
        channels: For each channel of a hidden field as the kernels order them, its index
            in the group's own order.
    """

    space: Space
    cosets: int
    hidden: bool
    size: int
    edge: float
    axis: float
    blocks: tuple[Block, ...]
    expansion: Tensor
    transposition: Tensor | None
    channels: tuple[int, ...]

    def expand(self, weights: Tensor, fields_out: int, fields_in: int) -> Tensor:
        """Steerable weights, flat, to spectral ones.

        Args:
            weights: Of a layer from so many fields to so many hidden fields with their gates.
            fields_out: Hidden fields of the output.
            fields_in: Hidden or trivial fields of the input.

        Returns:
            Shape (cosets * fields out, fields in, size), where fields in counts the
            kernels' fields.
        """
        pairs = self._pairs(weights, fields_out, fields_in) @ self.expansion
        cosets_in = self.cosets if self.hidden else 1
        if self.cosets == 1:
            return pairs.view(fields_out, fields_in, self.size)
        pairs = pairs.view(fields_out, fields_in, self.cosets, cosets_in, self.size)
        return pairs.transpose(1, 2).reshape(
            fields_out * self.cosets, fields_in * cosets_in, self.size
        )

    def _pairs(self, weights: Tensor, fields_out: int, fields_in: int) -> Tensor:
        """The weights of each pair of fields, side by side."""
        if len(self.blocks) == 1 and self.blocks[0].fields_out == 1:
            return weights.view(fields_out * fields_in, -1)
        parts, start = [], 0
        for block in self.blocks:
            size = block.size * fields_out * fields_in
            part = weights[start : start + size].view(-1, fields_in, block.dim)
            start += size
            copies = part[:fields_out].unsqueeze(1)
            if block.fields_out > 1:  # after the fields' own trivial parts, the gates of each
                gates = part[fields_out:].view(fields_out, -1, fields_in, block.dim)
                copies = torch.cat([copies, gates], 1)
            parts.append(copies.transpose(1, 2).reshape(fields_out * fields_in, -1))
        return torch.cat(parts, 1)

    def transpose(self, weights: Tensor) -> Tensor:
        """Spectral weights (out, in, size) to those of the transposed convolution."""
        assert self.transposition is not None
        return (weights @ self.transposition).transpose(0, 1).contiguous()


@contextlib.contextmanager
def plain_tensors() -> Iterator[None]:
    """For constants that outlive the call: on the CPU, and fit for training.

    Made in inference mode or under another default device, they would stay of that kind.
    """
    with torch.inference_mode(False), torch.device("cpu"):
        yield


@functools.cache
def spectral_basis(group: SymmetryGroup, in_field: str) -> SpectralBasis | None:
    """The spectral form of 3 x 3 filters from a kind of field to hidden fields.

    Args:
        group: The symmetry group.
        in_field: ``"hidden"`` or ``"trivial"``.

    Returns:
        The basis, or None where there is none: the group lacks the quarter turns, the
        input is of another kind, or the filters leave the span of the six functions.
    """
    if not group.has_quarter_turns or in_field not in ("hidden", TRIVIAL):
        return None
    hidden = in_field == "hidden"
    field = FieldType.hidden(group, 1)
    in_type = field if hidden else FieldType.trivial(group, 1)
    out_type = make_activation(field).in_type
    filters = block_filters(in_type, out_type, 3)
    corners = corner_weights(filters.reshape(-1, 9))
    if corners is None:
        return None
    space, cosets, channels = _seen_as(group)
    if group.is_finite:
        out_channels, copies_in = channels, cosets if hidden else 1
    else:  # the trivial part, its gate and all others, the other parts
        out_channels, copies_in = [0, *range(field.size, out_type.size), *range(1, field.size)], 1
    filters = filters[:, out_channels]
    if hidden:
        filters = filters[:, :, channels]
    units = unit_filters(space, hidden, True, *corners)
    # (K, cosets out, cosets in, one filter of the kernels' group)
    pairs = filters.reshape(len(filters), cosets, units.shape[1], copies_in, units.shape[2], 9)
    pairs = pairs.transpose(0, 1, 3, 2, 4, 5)
    flat = units.reshape(len(units), -1)
    expansion = _solve(flat, pairs.reshape(-1, flat.shape[1]))
    if expansion is None:
        return None
    transposition = None
    if hidden:
        flipped = units.transpose(0, 2, 1, 3)[..., ::-1]
        adjoint = unit_filters(space, True, False, *corners) if space.gates else units
        solved = _solve(adjoint.reshape(len(adjoint), -1), flipped.reshape(len(units), -1))
        assert solved is not None
        transposition = _constant(solved)
    return SpectralBasis(
        space=space,
        cosets=cosets,
        hidden=hidden,
        size=len(units),
        edge=corners[0],
        axis=corners[1],
        blocks=tuple(field_blocks(in_type, out_type, 3)),
        expansion=_constant(expansion.reshape(len(filters), -1)),
        transposition=transposition,
        channels=tuple(channels),
    )


def _seen_as(group: SymmetryGroup) -> tuple[Space, int, list[int]]:
    """The kernels' group, how many of its fields make up one, and their channels."""
    if not group.is_finite:
        return Space[group.name], 1, list(range(FieldType.hidden(group, 1).size))
    subgroup = SymmetryGroup("D4" if group.reflections else "C4")
    return Space[subgroup.name], group.rotations // 4, _coset_channels(group, subgroup)


def _constant(values: np.ndarray) -> Tensor:
    with plain_tensors():
        return torch.tensor(values, dtype=torch.float32)


def _coset_channels(group: SymmetryGroup, subgroup: SymmetryGroup) -> list[int]:
    """Channels of a regular field, coset by coset of the subgroup."""
    index = {element_key(element): i for i, element in enumerate(group.elements)}
    turns = [Element(math.tau * j / group.rotations) for j in range(group.rotations // 4)]
    return [index[element_key(h @ turn)] for turn in turns for h in subgroup.elements]


def _solve(units: np.ndarray, filters: np.ndarray) -> np.ndarray | None:
    """Coefficients of filters in terms of units; None if they are not in their span."""
    coefficients = without_noise(np.linalg.lstsq(units.T, filters.T, rcond=None)[0].T)
    error = np.abs(coefficients @ units - filters).max()
    return coefficients if error < _TOLERANCE * np.abs(filters).max() else None
