"""How tensors transform under rotations and reflections of the plane.

A vector-valued quantity is described by a `Representation`, a direct sum of
the irreducible blocks below; an image by `ScalarField`. Both are restrictions
of representations of O(2), so one declaration serves every subgroup.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
import torch.nn.functional as F
from torch import Tensor

from equirl.symmetry.groups import Element

__all__ = ["Irrep", "Representation", "ScalarField"]

_COSINES, _SINES = (1, 0, -1, 0), (0, 1, 0, -1)  #: of 0 to 3 quarter turns


def _quarters(turns: Tensor) -> Tensor:
    """Whole numbers of quarter turns as 0, 1, 2 or 3.

    Raises:
        ValueError: They are not integers.
    """
    if turns.dtype.is_floating_point or turns.dtype is torch.bool:
        raise ValueError(f"expected integers, numbers of quarter turns, got {turns.dtype}")
    return turns.long() % 4


class Irrep(Enum):
    """The irreducible representations of O(2) that physical quantities here use."""

    TRIVIAL = "trivial"  #: unchanged by every element
    SIGN = "sign"  #: changes sign under a reflection (a rotation angle about the vertical)
    VECTOR = "vector"  #: rho_1, a vector (x, y) in the plane

    @property
    def dim(self) -> int:
        """Number of components."""
        return 2 if self is Irrep.VECTOR else 1


class Representation:
    """A direct sum of irreducible blocks acting on a tensor's last dimension.

    Args:
        irreps: The blocks in the order of the tensor's components.

    Example:
        >>> Representation("trivial", "vector", "sign").dim
        4
    """

    def __init__(self, *irreps: Irrep | str):
        self.irreps = tuple(Irrep(irrep) for irrep in irreps)

    @property
    def dim(self) -> int:
        """Number of components of all blocks."""
        return sum(irrep.dim for irrep in self.irreps)

    @property
    def blocks(self) -> tuple[tuple[Irrep, slice], ...]:
        """Each block with the components it acts on."""
        blocks, start = [], 0
        for irrep in self.irreps:
            blocks.append((irrep, slice(start, start + irrep.dim)))
            start += irrep.dim
        return tuple(blocks)

    def transform(self, x: Tensor, element: Element) -> Tensor:
        """Applies one group element to ``x`` of shape (..., dim)."""
        cos, sin = element.cos_sin
        return self._apply(x, x.new_tensor(cos), x.new_tensor(sin), element.reflected)

    def rotate(self, x: Tensor, angles: Tensor) -> Tensor:
        """Rotates ``x`` of shape (B, dim) by ``angles`` of shape (B,), in rad."""
        return self._apply(x, angles.cos().to(x), angles.sin().to(x), reflected=False)

    def quarter_turns(self, x: Tensor, turns: Tensor) -> Tensor:
        """Rotates ``x`` of shape (B, dim) by ``turns`` quarter turns, without rounding.

        Args:
            x: Shape (B, dim).
            turns: Shape (B,), integers of either sign.

        Raises:
            ValueError: The turns are not integers.
        """
        turns = _quarters(turns)
        cos, sin = (x.new_tensor(values)[turns] for values in (_COSINES, _SINES))
        return self._apply(x, cos, sin, reflected=False)

    def _apply(self, x: Tensor, cos: Tensor, sin: Tensor, reflected: bool) -> Tensor:
        if x.shape[-1] != self.dim:
            raise ValueError(
                f"expected a last dimension of {self.dim} for {self}, got shape {tuple(x.shape)}"
            )
        out = x.clone()
        for irrep, components in self.blocks:
            if irrep is Irrep.SIGN and reflected:
                out[..., components] = -x[..., components]
            elif irrep is Irrep.VECTOR:
                first, second = x[..., components].unbind(-1)
                if reflected:
                    second = -second
                turned = (cos * first - sin * second, sin * first + cos * second)
                out[..., components] = torch.stack(turned, -1)
        return out

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Representation) and self.irreps == other.irreps

    def __hash__(self) -> int:
        return hash(self.irreps)

    def __repr__(self) -> str:
        return f"Representation({', '.join(repr(irrep.value) for irrep in self.irreps)})"


@dataclass(frozen=True)
class ScalarField:
    """A square image (..., S, S) whose rows grow with +x and columns with +y.

    The centre of rotation is the image's centre, a corner of four pixels when S is
    even. Elements that preserve the grid permute pixels exactly; other angles are
    interpolated bilinearly and the border is replicated, as in the paper's buffer
    augmentation (appendix F).
    """

    def transform(self, image: Tensor, element: Element) -> Tensor:
        """Applies one group element to ``image`` of shape (..., S, S)."""
        if element.reflected:
            image = image.flip(-1)
        if element.quarter_turns is not None:
            return image.rot90(element.quarter_turns, (-2, -1))
        flat = image.reshape(-1, 1, *image.shape[-2:])
        angles = flat.new_full((len(flat),), element.angle)
        return self.rotate(flat, angles).reshape(image.shape)

    def rotate(self, image: Tensor, angles: Tensor) -> Tensor:
        """Rotates ``image`` of shape (B, C, S, S) by ``angles`` of shape (B,), in rad.

        Raises:
            ValueError: The images are not square.
        """
        size = self._size(image)
        centres = (2 * torch.arange(size, device=image.device) + 1 - size).to(image) / size
        row, column = centres[:, None], centres
        cos, sin = (part.to(image)[:, None, None] for part in (angles.cos(), angles.sin()))
        # The inverse rotation: each output pixel asks for the input point it came from.
        grid = torch.stack([cos * column - sin * row, sin * column + cos * row], -1)
        return F.grid_sample(image, grid, padding_mode="border", align_corners=False)

    def quarter_turns(self, image: Tensor, turns: Tensor) -> Tensor:
        """Rotates each image by its own number of quarter turns: a permutation of its pixels.

        Args:
            image: Shape (B, C, S, S), of any dtype.
            turns: Shape (B,), integers of either sign.

        Raises:
            ValueError: The images are not square, or the turns are not integers.
        """
        self._size(image)
        turns = _quarters(turns)
        out = image.clone()
        for quarters in (1, 2, 3):
            chosen = turns == quarters
            out[chosen] = image[chosen].rot90(quarters, (-2, -1))
        return out

    @staticmethod
    def _size(image: Tensor) -> int:
        """Number of rows and columns S of square images."""
        rows, columns = image.shape[-2:]
        if rows != columns:
            raise ValueError(f"expected square images (B, C, S, S), got {tuple(image.shape)}")
        return columns
