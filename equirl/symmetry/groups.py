"""Planar symmetry groups: rotations about the vertical, with or without reflections.

A group acts on the horizontal plane of the gripper. An element is a reflection
``y -> -y`` (or not) followed by a counter-clockwise rotation, from +x to +y. The
finite groups of the paper (appendix A) are C_n, the rotations by multiples of
``2 pi / n``, and D_n, the same rotations with the reflection; the continuous ones are SO(2),
all rotations, and O(2), the same with the reflection.
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
    """A group of rotations of the plane, with or without reflections.

    Args:
        name: In either case, ``"C<n>"`` (n rotations) or ``"D<n>"`` (n rotations and n
            reflections) with n from 2 to 1000; ``"SO2"`` (all rotations) or ``"O2"`` (all
            rotations and reflections).

    Attributes:
        reflections: Whether the group contains reflections.

    Raises:
        ValueError: The name is not such a group.

    Example:
        >>> group = SymmetryGroup("d4")
        >>> group.name, group.order, len(group.grid_elements)
        ('D4', 8, 8)
        >>> group = SymmetryGroup("SO2")
        >>> group.is_finite, len(group.grid_elements)
        (False, 4)
    """

    def __init__(self, name: str | SymmetryGroup):
        if isinstance(name, SymmetryGroup):
            name = name.name
        text = str(name).strip().upper()
        match = re.fullmatch(r"([CD])(\d+)", text)
        if text in ("SO2", "O2"):
            self._rotations, self.reflections = None, text == "O2"
        elif match is not None and 2 <= int(match[2]) <= _MOST_ROTATIONS:
            self._rotations, self.reflections = int(match[2]), match[1] == "D"
        else:
            raise ValueError(
                f"unknown symmetry group {name!r}: expected SO2, O2, or C<n> or D<n> with n from "
                f"2 to {_MOST_ROTATIONS}, for example C4, C8, D4 or D8"
            )

    @property
    def name(self) -> str:
        """``"C<n>"``, ``"D<n>"``, ``"SO2"`` or ``"O2"``."""
        if not self.is_finite:
            return "O2" if self.reflections else "SO2"
        return f"{'D' if self.reflections else 'C'}{self._rotations}"

    @property
    def is_finite(self) -> bool:
        """Whether the group is one of C_n and D_n; SO(2) and O(2) are continuous."""
        return self._rotations is not None

    @property
    def rotations(self) -> int:
        """Number of rotations of a finite group.

        Raises:
            ValueError: The group is continuous.
        """
        if self._rotations is None:
            raise ValueError(f"{self.name} has infinitely many elements: take some of them")
        return self._rotations

    @property
    def order(self) -> int:
        """Number of elements of a finite group.

        Raises:
            ValueError: The group is continuous.
        """
        return self.rotations * (2 if self.reflections else 1)

    @property
    def elements(self) -> tuple[Element, ...]:
        """All elements of a finite group, rotations first, the identity at index 0.

        Raises:
            ValueError: The group is continuous; `some_elements` and `grid_elements` are not.
        """
        return self._with_rotations(self.rotations)

    def some_elements(self, rotations: int = 32) -> tuple[Element, ...]:
        """All elements of a finite group; of a continuous one those of a large finite subgroup.

        Args:
            rotations: Order of the rotations taken from a continuous group, at least 1.

        Returns:
            The elements, rotations first, the identity at index 0.
        """
        return self._with_rotations(rotations if self._rotations is None else self._rotations)

    def _with_rotations(self, rotations: int) -> tuple[Element, ...]:
        angles = [math.tau * k / rotations for k in range(rotations)]
        flips = (False, True) if self.reflections else (False,)
        return tuple(Element(angle, flip) for flip in flips for angle in angles)

    @property
    def has_quarter_turns(self) -> bool:
        """Whether the group contains the rotation by a right angle."""
        return self._rotations is None or self._rotations % 4 == 0

    @property
    def grid_elements(self) -> tuple[Element, ...]:
        """The elements shared with D4: they map a square pixel grid onto itself."""
        return tuple(g for g in self.some_elements(4) if g.preserves_grid)

    def __contains__(self, element: Element) -> bool:
        if element.reflected and not self.reflections:
            return False
        turns = element.angle * (self._rotations or 0) / math.tau
        return math.isclose(turns, round(turns), abs_tol=1e-9)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SymmetryGroup) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return f"SymmetryGroup({self.name!r})"
