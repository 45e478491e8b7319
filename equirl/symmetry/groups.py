"""Planar symmetry groups: rotations about the vertical, with or without reflections.

A group acts on the horizontal plane of the gripper. An element is a reflection
``y -> -y`` (or not) followed by a counter-clockwise rotation, from +x to +y. The
finite groups of the paper (appendix A) are C_n, the rotations by multiples of
``2 pi / n``, and D_n, the same rotations with the reflection.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

__all__ = ["Element", "SymmetryGroup"]

_QUARTER = math.pi / 2
_MOST_ROTATIONS = 1000  # a network has a field of this size for every feature


@dataclass(frozen=True)
class Element:
    """One group element: an optional reflection ``y -> -y``, then a rotation.

    Args:
        angle: Rotation about the vertical, counter-clockwise from +x to +y, in rad.
        reflected: Whether ``y -> -y`` is applied before the rotation.
    """

    angle: float
    reflected: bool = False

    @property
    def quarter_turns(self) -> int | None:
        """Number of quarter turns, 0 to 3, or None when the angle is not a multiple of pi/2."""
        turns = round(self.angle / _QUARTER)
        return turns % 4 if math.isclose(self.angle, turns * _QUARTER, abs_tol=1e-12) else None

    @property
    def preserves_grid(self) -> bool:
        """Whether the element maps a square pixel grid onto itself."""
        return self.quarter_turns is not None

    @property
    def cos_sin(self) -> tuple[float, float]:
        """Cosine and sine of the angle; exact at quarter turns."""
        if self.quarter_turns is not None:
            return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[self.quarter_turns]
        return math.cos(self.angle), math.sin(self.angle)

    def __matmul__(self, other: Element) -> Element:
        """Composition: ``(g @ h)`` applies ``h`` first."""
        turned = -other.angle if self.reflected else other.angle
        angle = math.remainder(self.angle + turned, math.tau)
        return Element(angle, self.reflected != other.reflected)

    def inverse(self) -> Element:
        """The element that undoes this one; a reflection undoes itself."""
        return self if self.reflected else Element(-self.angle)


class SymmetryGroup:
    """A finite group of rotations and reflections of the plane, ``C<n>`` or ``D<n>``.

    Args:
        name: ``"C<n>"`` (n rotations) or ``"D<n>"`` (n rotations and n reflections)
            with n from 2 to 1000, in either case.

    Raises:
        ValueError: The name is not such a group.

    Example:
        >>> group = SymmetryGroup("d4")
        >>> group.name, group.order, len(group.grid_elements)
        ('D4', 8, 8)
    """

    def __init__(self, name: str | SymmetryGroup):
        if isinstance(name, SymmetryGroup):
            name = name.name
        match = re.fullmatch(r"([CD])(\d+)", str(name).strip().upper())
        if match is None or not 2 <= int(match[2]) <= _MOST_ROTATIONS:
            raise ValueError(
                f"unknown symmetry group {name!r}: expected C<n> or D<n> with n from 2 to "
                f"{_MOST_ROTATIONS}, for example C4, C8, D4 or D8 (the continuous SO2 and O2 are "
                "not available yet)"
            )
        self.rotations = int(match[2])
        self.reflections = match[1] == "D"

    @property
    def name(self) -> str:
        """``"C<n>"`` or ``"D<n>"``."""
        return f"{'D' if self.reflections else 'C'}{self.rotations}"

    @property
    def order(self) -> int:
        """Number of elements."""
        return self.rotations * (2 if self.reflections else 1)

    @property
    def elements(self) -> tuple[Element, ...]:
        """All elements, rotations first, the identity at index 0."""
        angles = [math.tau * k / self.rotations for k in range(self.rotations)]
        flips = (False, True) if self.reflections else (False,)
        return tuple(Element(angle, flip) for flip in flips for angle in angles)

    @property
    def grid_elements(self) -> tuple[Element, ...]:
        """The elements shared with D4: they map a square pixel grid onto itself."""
        return tuple(g for g in self.elements if g.preserves_grid)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SymmetryGroup) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return f"SymmetryGroup({self.name!r})"
