"""Field types: how the channels of a feature map transform under a symmetry group."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from equirl.symmetry import Element, Irrep, Representation, SymmetryGroup

__all__ = [
    "REGULAR",
    "SIGN",
    "TRIVIAL",
    "VECTOR",
    "VECTOR_2",
    "VECTOR_3",
    "VECTOR_X",
    "VECTOR_Y",
    "Channels",
    "FieldType",
    "element_key",
]

# Kinds of fields: regular ones, the irreps of O(2) to frequency 3 (a vector of frequency k turns by
# k times the angle), and what a half turn leaves of a vector.
REGULAR = "regular"
TRIVIAL, SIGN, VECTOR = Irrep.TRIVIAL.value, Irrep.SIGN.value, Irrep.VECTOR.value
VECTOR_2, VECTOR_3 = "vector_2", "vector_3"
VECTOR_X, VECTOR_Y = "vector_x", "vector_y"

_FREQUENCIES = {VECTOR: 1, VECTOR_2: 2, VECTOR_3: 3}


class Channels(NamedTuple):
    """The channels of irreducible fields.

    Args:
        field_of: For each channel the index of its field.
        first: For each field the index of its first channel.
        second: For each field the index of its second channel; of its only one else.
        has_second: For each field whether it has a second channel.
    """

    field_of: Tensor
    first: Tensor
    second: Tensor
    has_second: Tensor


@dataclasses.dataclass(frozen=True)
class FieldType:
    """A stack of fields of one group, in the order of the channels.

    A *regular* field of a finite group has one channel per group element, permuted by the
    group; the other fields are irreducible: the blocks of a `Representation`, restricted to
    the group, and for SO(2) and O(2) vectors of frequency 2 and 3. Where a restriction
    splits or merges blocks the fields say so: a half turn acts on x and y alike, so for
    n = 2 a vector is two one-dimensional fields, and without reflections a sign field is a
    trivial one.

    Args:
        group: The symmetry group.
        fields: One name per field. Use the constructors below instead.

    Attributes:
        size: Number of channels.
        kinds: The different fields, in the order of their first appearance.

    Raises:
        ValueError: The group has no such field; a vector of frequency k is irreducible for
            more than 2 k rotations only.
    """

    group: SymmetryGroup
    fields: tuple[str, ...]
    size: int = dataclasses.field(init=False, repr=False, compare=False)
    kinds: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # Now, for torch.compile does not enter the lock of a cached property.
        object.__setattr__(self, "kinds", tuple(dict.fromkeys(self.fields)))
        possible = self._possible()
        for kind in self.kinds:
            if kind not in possible:
                raise ValueError(
                    f"{self.group.name} has no field {kind!r}: expected one of "
                    f"{', '.join(possible)}"
                )
        object.__setattr__(self, "size", sum(self.dim(name) for name in self.fields))

    def _possible(self) -> list[str]:
        """The names of the fields that the group has."""
        group = self.group
        names = [REGULAR, TRIVIAL] if group.is_finite else [TRIVIAL]
        names += [SIGN] if group.reflections else []
        if group.is_finite and group.rotations == 2:
            return [*names, VECTOR_X, *([VECTOR_Y] if group.reflections else [])]
        return names + [
            name
            for name, frequency in _FREQUENCIES.items()
            if not group.is_finite or group.rotations > 2 * frequency
        ]

    @classmethod
    def regular(cls, group: SymmetryGroup, count: int) -> FieldType:
        """``count`` regular fields of a finite group."""
        return cls(group, (REGULAR,) * count)

    @classmethod
    def hidden(cls, group: SymmetryGroup, count: int) -> FieldType:
        """``count`` times the field F that hidden layers are made of (appendix A).

        The regular field of a finite group; of SO(2) and O(2) the irreps to frequency 3, side
        by side: 7 channels, with O(2)'s sign field 8.
        """
        if group.is_finite:
            return cls.regular(group, count)
        signs = (SIGN,) if group.reflections else ()
        return cls(group, (TRIVIAL, *signs, VECTOR, VECTOR_2, VECTOR_3) * count)

    @classmethod
    def trivial(cls, group: SymmetryGroup, count: int) -> FieldType:
        """``count`` invariant channels."""
        return cls(group, (TRIVIAL,) * count)

    @classmethod
    def of(cls, group: SymmetryGroup, representation: Representation) -> FieldType:
        """The blocks of a representation, restricted to the group."""
        fields: list[str] = []
        for irrep in representation.irreps:
            if irrep is Irrep.VECTOR and group.is_finite and group.rotations == 2:
                fields += [VECTOR_X, VECTOR_Y if group.reflections else VECTOR_X]
            elif irrep is Irrep.SIGN and not group.reflections:
                fields.append(TRIVIAL)
            else:
                fields.append(irrep.value)
        return cls(group, tuple(fields))

    def __add__(self, other: FieldType) -> FieldType:
        """The fields of both, side by side.

        Raises:
            ValueError: The groups differ.
        """
        if self.group != other.group:
            raise ValueError(f"cannot add fields of {self.group} and {other.group}")
        return FieldType(self.group, self.fields + other.fields)

    def check(self, x: Tensor, dim: int = -1) -> None:
        """Checks that dimension ``dim`` of ``x`` holds these fields' channels.

        Raises:
            ValueError: It does not.
        """
        if not -x.ndim <= dim < x.ndim or x.shape[dim] != self.size:
            raise ValueError(
                f"expected {self.size} channels in dimension {dim} for {self}, got {tuple(x.shape)}"
            )

    def dim(self, field: str) -> int:
        """Number of channels of one field."""
        if field == REGULAR:
            return self.group.order
        return 2 if field in _FREQUENCIES else 1

    def kind_size(self, kind: str) -> int:
        """Number of channels of all fields of one kind."""
        return self.fields.count(kind) * self.dim(kind)

    @property
    def is_regular(self) -> bool:
        """Whether every field is regular."""
        return all(field == REGULAR for field in self.fields)

    @property
    def is_permuted(self) -> bool:
        """Whether the group permutes the channels, so that pointwise maps commute with it."""
        return all(field in (REGULAR, TRIVIAL) for field in self.fields)

    def channels(self) -> Channels:
        """Which channels make up each irreducible field.

        Raises:
            ValueError: A field is regular.
        """
        if REGULAR in self.fields:
            raise ValueError(f"expected irreducible fields, got {self}")
        dims = torch.tensor([self.dim(field) for field in self.fields])
        first = dims.cumsum(0) - dims
        field_of = torch.arange(len(dims)).repeat_interleave(dims)
        return Channels(field_of, first, first + (dims == 2), dims == 2)

    def bias_layout(self) -> tuple[list[int], list[float]]:
        """Which bias each channel receives, and its weight.

        Only the invariant part of a field may be shifted: one bias per regular field,
        along its normalised constant vector, and one per trivial field.

        Returns:
            For each channel the index of its bias and the factor, 0 where none applies.
        """
        index, factor, count = [], [], 0
        for field in self.fields:
            has_bias = field in (REGULAR, TRIVIAL)
            index += [count if has_bias else 0] * self.dim(field)
            factor += [self.dim(field) ** -0.5 if has_bias else 0.0] * self.dim(field)
            count += has_bias
        return index, factor

    @property
    def bias_count(self) -> int:
        """Number of biases: one per field that contains the trivial representation."""
        return sum(field in (REGULAR, TRIVIAL) for field in self.fields)

    def transform(self, x: Tensor, element: Element) -> Tensor:
        """Applies a group element to the channels of ``x`` of shape (..., size).

        Raises:
            ValueError: The element is not in the group, or the size is not this type's.
        """
        self.check(x)
        if element not in self.group:
            raise ValueError(f"{element} is not an element of {self.group}")
        source = self._source_elements(element) if REGULAR in self.fields else []
        parts, start = [], 0
        for field in self.fields:
            part = x[..., start : start + self.dim(field)]
            start += self.dim(field)
            parts.append(self._transform_field(part, field, element, source))
        return torch.cat(parts, -1)

    def _transform_field(
        self, x: Tensor, field: str, element: Element, source: list[int]
    ) -> Tensor:
        if field == REGULAR:
            return x[..., source]
        if field == VECTOR_X:
            return x * round(element.cos_sin[0])
        if field == VECTOR_Y:
            return x * round(element.cos_sin[0]) * (-1 if element.reflected else 1)
        if field in _FREQUENCIES:
            element = Element(element.angle * _FREQUENCIES[field], element.reflected)
            return Representation(Irrep.VECTOR).transform(x, element)
        return Representation(field).transform(x, element)

    def _source_elements(self, element: Element) -> list[int]:
        # A regular field is a function on the group; g moves its value at h to g h.
        positions = {element_key(h): index for index, h in enumerate(self.group.elements)}
        return [positions[element_key(element.inverse() @ h)] for h in self.group.elements]

    def __str__(self) -> str:
        runs: list[list] = []
        for field in self.fields:
            if runs and runs[-1][1] == field:
                runs[-1][0] += 1
            else:
                runs.append([1, field])
        return f"{self.group.name}[{' + '.join(f'{count} {field}' for count, field in runs)}]"


def element_key(element: Element) -> tuple[int, bool]:
    """The same for angles that differ by rounding or by full turns: the same element."""
    return round(element.angle / math.tau * 1e6) % 1_000_000, element.reflected
