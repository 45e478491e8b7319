"""Bases of equivariant kernels, from escnn: the only place that imports it.

escnn knows which linear maps between fields commute with a group. It is asked once,
at construction, and its answer kept as constant float64 arrays; no escnn object
outlives the call, so networks stay plain torch.
"""

from __future__ import annotations

import functools
import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

from equirl.modules.coupling import fixed_couplings
from equirl.modules.fields import (
    REGULAR,
    SIGN,
    TRIVIAL,
    VECTOR,
    VECTOR_2,
    VECTOR_3,
    VECTOR_X,
    VECTOR_Y,
)
from equirl.symmetry import SymmetryGroup

with warnings.catch_warnings():
    # py3nj serves SO(3) only and needs a Fortran compiler; planar groups do not use it.
    warnings.filterwarnings("ignore", message="`py3nj` package not found")
    # Byte-compiling escnn's docstrings, once per installation.
    warnings.filterwarnings("ignore", message="invalid escape sequence")
    from escnn import group as escnn_group
    from escnn import kernels
    from escnn.nn.modules.conv.r2convolution import compute_basis_params
    from escnn.nn.modules.conv.rd_convolution import get_grid_coords

__all__ = ["KernelBasis", "field_label", "kernel_basis"]


@dataclass(frozen=True, eq=False)
class KernelBasis:
    """A basis of the equivariant kernels from one field to another.

    Args:
        elements: Shape (K, out channels, in channels, kernel_size ** 2), float64,
            read-only. Pixels in the order of a flattened filter.
        in_irreps: For each element the irreducible part of the input field it reads.
        out_positions: For each element the irreducible part of the output it writes.
    """

    elements: np.ndarray
    in_irreps: tuple[tuple[int, ...], ...]
    out_positions: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.elements)


@functools.cache
def kernel_basis(
    group: SymmetryGroup, in_field: str, out_field: str, kernel_size: int
) -> KernelBasis | None:
    """The equivariant kernels between two fields, elements ordered as in escnn.

    Args:
        group: The symmetry group.
        in_field: Name of the input field, see `FieldType`.
        out_field: Name of the output field.
        kernel_size: Side of the filter in pixels.

    Returns:
        The basis, or None when only the zero kernel is equivariant.
    """
    in_rep, out_rep = _representation(group, in_field), _representation(group, out_field)
    accept, rings, widths, max_frequency = compute_basis_params(kernel_size)
    try:
        with _Float64(), torch.device("cpu"), fixed_couplings(in_rep.group):
            profile = kernels.GaussianRadialProfile(rings, widths)
            axis = 0.0 if group.reflections else math.pi / 2  # escnn's own choice for R2Conv
            basis = kernels.SteerableKernelBasis(
                kernels.CircularShellsBasis(max_frequency, profile, axis=axis),
                in_rep,
                out_rep,
                _FreshBasis,
                sg_id=_subgroup_id(group),
            )
            points = torch.tensor(get_grid_coords(2, kernel_size, 1), dtype=torch.float64)
            sampled = basis.sample(points).permute(1, 2, 3, 0).numpy()
            attributes = list(basis)
    except kernels.EmptyBasisException:
        return None
    elements = _normalise(sampled, [attribute["shape"][0] for attribute in attributes])
    # Frequencies a ring cannot resolve, and elements that vanish on the grid, are dropped.
    nonzero = (elements**2).sum((1, 2, 3)) > 1e-2
    keep = [i for i, attribute in enumerate(attributes) if accept(attribute) and nonzero[i]]
    if not keep:
        return None
    elements = np.ascontiguousarray(elements[keep])
    elements.setflags(write=False)
    return KernelBasis(
        elements,
        tuple(attributes[i]["in_irrep"] for i in keep),
        tuple(attributes[i]["out_irrep_idx"] for i in keep),
    )


def field_label(group: SymmetryGroup, field: str) -> str:
    """escnn's name of a field; blocks of weights are stored in the order of these names."""
    return _representation(group, field).name


def _normalise(elements: np.ndarray, sizes: list[int]) -> np.ndarray:
    # escnn's normalisation: a unit mean square per output channel of the irreducible part.
    norms = np.sqrt((elements**2).sum((1, 2, 3)) / np.array(sizes))
    norms[norms < 1e-6] = 1.0
    return elements / norms[:, None, None, None]


def _subgroup_id(group: SymmetryGroup) -> tuple[float | None, int]:
    # In O(2): the reflection across the image's vertical axis, which flips the columns.
    axis = math.pi if group.reflections else None
    return axis, group.rotations if group.is_finite else -1


def _representation(group: SymmetryGroup, field: str) -> Any:
    fiber, _, _ = escnn_group.o2_group(6).subgroup(_subgroup_id(group))
    if field == REGULAR:
        return fiber.regular_representation
    irreps: dict[str, tuple[int, ...]]
    if group.reflections:
        irreps = {
            TRIVIAL: (0, 0),
            SIGN: (1, 0),
            VECTOR: (1, 1),
            VECTOR_2: (1, 2),
            VECTOR_3: (1, 3),
            VECTOR_X: (0, 1),
            VECTOR_Y: (1, 1),
        }
    else:
        irreps = {TRIVIAL: (0,), VECTOR: (1,), VECTOR_2: (2,), VECTOR_3: (3,), VECTOR_X: (1,)}
    return fiber.irrep(*irreps[field])


class _FreshBasis(kernels.RestrictedWignerEckartBasis):
    """escnn's solution for irreducible fields, kept out of its process-wide cache.

    That cache would hand float32 coefficients to us, and our float64 ones to others.
    """

    @classmethod
    def _generator(cls, basis: Any, psi_in: Any, psi_out: Any, **kwargs: Any) -> _FreshBasis:
        return cls(basis, in_irrep=psi_in, out_irrep=psi_out, **kwargs)


class _Float64(TorchFunctionMode):
    """Within it, tensors asked for in float32 are made in float64.

    escnn holds its coefficients in float64 numpy arrays but converts them to float32
    on the way; equivariance below 1e-9 needs them unrounded.
    """

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if kwargs.get("dtype") is torch.float32 or func is torch.eye:
            kwargs["dtype"] = torch.float64
        return func(*args, **kwargs)
