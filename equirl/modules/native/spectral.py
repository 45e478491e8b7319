"""Steerable filters in spectral form: the weights the native kernels multiply with.

A 3 x 3 equivariant filter between regular fields of D4 (or C4) spans six of the nine
pixel functions only. A Fourier transform over each field splits the fields into
irreducible parts, and products of pixel functions with parts of the input split again, so
that an output part depends on input *rows* of its own kind alone. The weights of these
independent maps are the spectral weights; they are as many as the steerable ones. A
larger group whose rotations contain the quarter turns is seen as its C4 or D4 subgroup: a
regular field is then several fields of the subgroup, one per coset.

This module states which rows there are (the kernels compute them in the same order) and
finds by least squares, in float64, how spectral weights follow from steerable ones.
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

from equirl.modules.bases import kernel_basis
from equirl.modules.fields import REGULAR, TRIVIAL, element_key
from equirl.symmetry import Element, SymmetryGroup

__all__ = ["SpectralBasis", "plain_tensors", "spectral_basis"]

# A term of a row: pixel function, spectral component of the input field, sign.
_Term = tuple[str, int, int]
_Row = list[_Term]

_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class SpectralBasis:
    """How the kernels see the steerable filters from one kind of field to regular ones.

    Args:
        order: Order of the subgroup the kernels work with: 4 (C4) or 8 (D4).
        cosets: Fields of the subgroup that make up one regular field of the group.
        regular: Whether the input fields are regular; trivial otherwise.
        size: Number of spectral weights of a pair of the subgroup's fields.
        edge: Weight of the corners in the pixel function of the edges.
        axis: Weight of the corners in the pixel functions x and y.
        expansion: Shape (K, cosets out * cosets in * size), float32: from the K steerable
            weights of a pair of fields to spectral ones.
        transposition: Shape (size, size), float32: spectral weights of a pair to those of
            the transposed filter; None for trivial input.
        channels: For each channel of a regular field as the kernels order them, its index
            in the group's own order.
    """

    order: int
    cosets: int
    regular: bool
    size: int
    edge: float
    axis: float
    expansion: Tensor
    transposition: Tensor | None
    channels: tuple[int, ...]

    def expand(self, weights: Tensor, fields_out: int, fields_in: int) -> Tensor:
        """Steerable weights, flat, to spectral ones.

        Returns:
            Shape (cosets * fields out, fields in, size), where fields in counts the
            subgroup's fields.
        """
        pairs = weights.view(fields_out * fields_in, -1) @ self.expansion
        cosets_in = self.cosets if self.regular else 1
        if self.cosets == 1:
            return pairs.view(fields_out, fields_in, self.size)
        pairs = pairs.view(fields_out, fields_in, self.cosets, cosets_in, self.size)
        return pairs.transpose(1, 2).reshape(
            fields_out * self.cosets, fields_in * cosets_in, self.size
        )

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
    """The spectral form of 3 x 3 filters from a kind of field to regular fields.

    Args:
        group: The symmetry group.
        in_field: ``"regular"`` or ``"trivial"``.

    Returns:
        The basis, or None where there is none: the group lacks the quarter turns, the
        input is of another kind, or the filters leave the span of the six functions.
    """
    if group.rotations % 4 or in_field not in (REGULAR, TRIVIAL):
        return None
    basis = kernel_basis(group, in_field, REGULAR, 3)
    if basis is None:
        return None
    subgroup = SymmetryGroup("D4" if group.reflections else "C4")
    channels = _coset_channels(group, subgroup)
    regular, cosets = in_field == REGULAR, group.rotations // 4
    order, order_in = subgroup.order, subgroup.order if regular else 1
    filters = basis.elements[:, channels]
    if regular:
        filters = filters[:, :, channels]
    # (K, cosets out, cosets in, one filter of the subgroup)
    pairs = filters.reshape(len(basis), cosets, order, -1, order_in, 9).transpose(0, 1, 3, 2, 4, 5)
    corners = _corner_weights(basis.elements.reshape(-1, 9))
    if corners is None:
        return None
    units = _unit_filters(group.reflections, regular, *corners)
    flat = units.reshape(len(units), -1)
    expansion = _solve(flat, pairs.reshape(-1, flat.shape[1]))
    if expansion is None:
        return None
    transposition = None
    if regular:
        flipped = units.transpose(0, 2, 1, 3)[..., ::-1]
        solved = _solve(flat, flipped.reshape(len(units), -1))
        assert solved is not None
        transposition = _constant(solved)
    return SpectralBasis(
        order=order,
        cosets=cosets,
        regular=regular,
        size=len(units),
        edge=corners[0],
        axis=corners[1],
        expansion=_constant(expansion.reshape(len(basis), -1)),
        transposition=transposition,
        channels=tuple(channels),
    )


def _constant(values: np.ndarray) -> Tensor:
    with plain_tensors():
        return torch.tensor(values, dtype=torch.float32)


def _coset_channels(group: SymmetryGroup, subgroup: SymmetryGroup) -> list[int]:
    """Channels of a regular field, coset by coset of the subgroup."""
    index = {element_key(element): i for i, element in enumerate(group.elements)}
    turns = [Element(math.tau * j / group.rotations) for j in range(group.rotations // 4)]
    return [index[element_key(h @ turn)] for turn in turns for h in subgroup.elements]


def _corner_weights(filters: np.ndarray) -> tuple[float, float] | None:
    """Weights of the corners beside an edge and beside an axis; None if more is spanned."""
    _, scales, functions = np.linalg.svd(np.linalg.qr(filters, mode="r"))
    if scales[6] > _TOLERANCE * scales[0]:
        return None
    missing = functions[6:]
    weights = []
    plain = _pixel_functions(0.0, 0.0)
    for name, corners in (("edge", _pixel_functions(1.0, 0.0)), ("x", _pixel_functions(0.0, 1.0))):
        base, more = missing @ plain[name], missing @ (corners[name] - plain[name])
        weight = -float(base @ more / (more @ more))
        if np.abs(base + weight * more).max() > _TOLERANCE:
            return None
        weights.append(weight)
    return weights[0], weights[1]


def _pixel_functions(edge: float, axis: float) -> dict[str, np.ndarray]:
    """The six functions on the 3 x 3 pixels; x grows with the rows, y with the columns."""
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij")
    corner, centre = np.abs(x * y), (1 - x**2) * (1 - y**2)
    functions = {
        "centre": centre,
        "edge": (1 - centre - corner) + edge * corner,
        "square": (x**2 - y**2),
        "cross": x * y,
        "x": x * (1 - corner + axis * corner),
        "y": y * (1 - corner + axis * corner),
    }
    return {name: function.reshape(9) for name, function in functions.items()}


def _fourier(mirror: bool) -> np.ndarray:
    """Rows: one-dimensional irreps, then pairs of components of each vector."""
    cos, sin = np.array([1, 0, -1, 0]), np.array([0, 1, 0, -1])
    one, sign = np.ones(4), np.array([1, -1, 1, -1])
    if not mirror:
        return np.stack([one, sign, cos, sin])
    even = [np.concatenate([row, row]) for row in (one, sign, cos, sin)]
    odd = [np.concatenate([row, -row]) for row in (one, sign, -sin, cos)]
    return np.stack([even[0], odd[0], even[1], odd[1], even[2], even[3], odd[2], odd[3]])


def _rows(mirror: bool, regular: bool) -> tuple[list[list[_Row]], list[tuple[_Row, _Row]]]:
    """The rows the kernels compute: those of each one-dimensional irrep, and the vectors'."""
    singles: list[list[_Row]]
    if not regular:
        scalars: list[_Row] = [[(name, 0, 1)] for name in ("centre", "edge", "square", "cross")]
        vectors: list[tuple[_Row, _Row]] = [([("x", 0, 1)], [("y", 0, 1)])]
        if mirror:
            return [scalars[:2], [], scalars[2:3], scalars[3:]], vectors
        return [scalars[:2], scalars[2:]], _with_quarter_turns(vectors)
    irreps, starts = (4, (4, 6)) if mirror else (2, (2,))
    square, cross = (2, 3) if mirror else (1, 1)
    singles = []
    for irrep in range(irreps):
        rows: list[_Row] = [
            [("centre", irrep, 1)],
            [("edge", irrep, 1)],
            [("square", irrep ^ square, 1)],
            [("cross", irrep ^ cross, 1)],
        ]
        products = [
            [[("x", a, 1), ("y", a + 1, 1)], [("x", a + 1, 1), ("y", a, -1)],
             [("x", a, 1), ("y", a + 1, -1)], [("x", a + 1, 1), ("y", a, 1)]]
            for a in starts
        ]  # fmt: skip
        if mirror:
            rows += [product[irrep] for product in products]
        else:
            rows += products[0][2 * irrep : 2 * irrep + 2]
        singles.append(rows)
    vectors = []
    for a in starts:
        vectors += [
            ([("centre", a, 1)], [("centre", a + 1, 1)]),
            ([("edge", a, 1)], [("edge", a + 1, 1)]),
            ([("square", a, 1)], [("square", a + 1, -1)]),
            ([("cross", a + 1, 1)], [("cross", a, 1)]),
        ]
    if mirror:
        vectors += [
            ([("x", 0, 1)], [("y", 0, 1)]),
            ([("y", 1, -1)], [("x", 1, 1)]),
            ([("x", 2, 1)], [("y", 2, -1)]),
            ([("y", 3, 1)], [("x", 3, 1)]),
        ]
        return singles, vectors
    vectors += [([("x", 0, 1)], [("y", 0, 1)]), ([("x", 1, 1)], [("y", 1, -1)])]
    return singles, _with_quarter_turns(vectors)


def _with_quarter_turns(vectors: list[tuple[_Row, _Row]]) -> list[tuple[_Row, _Row]]:
    # Without reflections a vector may be turned as well: (a, b) and (-b, a).
    turned = []
    for a, b in vectors:
        turned += [(a, b), ([(name, part, -sign) for name, part, sign in b], a)]
    return turned


def _unit_filters(mirror: bool, regular: bool, edge: float, axis: float) -> np.ndarray:
    """The dense filter of each spectral weight, shape (size, order, channels in, 9)."""
    functions, fourier = _pixel_functions(edge, axis), _fourier(mirror)
    parts_in = fourier if regular else np.ones((1, 1))

    def filter_of(row: _Row) -> np.ndarray:
        terms = [sign * np.outer(parts_in[part], functions[name]) for name, part, sign in row]
        return np.sum(terms, axis=0)

    singles, vectors = _rows(mirror, regular)
    units = [
        np.multiply.outer(fourier[irrep], filter_of(row))
        for irrep, rows in enumerate(singles)
        for row in rows
    ]
    for start in range(len(singles), len(fourier), 2):
        for first, second in vectors:
            units.append(
                np.multiply.outer(fourier[start], filter_of(first))
                + np.multiply.outer(fourier[start + 1], filter_of(second))
            )
    return np.stack(units)


def _solve(units: np.ndarray, filters: np.ndarray) -> np.ndarray | None:
    """Coefficients of filters in terms of units; None if they are not in their span."""
    coefficients = np.linalg.lstsq(units.T, filters.T, rcond=None)[0].T
    error = np.abs(coefficients @ units - filters).max()
    return coefficients if error < _TOLERANCE * np.abs(filters).max() else None
