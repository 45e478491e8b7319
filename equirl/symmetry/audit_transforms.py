"""How audit and report turn images, actions, features and scenes: raw arrays, own arithmetic.

No code but the group's elements is shared with what they check, nor with the representations that
networks and replay buffers are built from. Everything is moved by any element; images exactly by
those that map a square pixel grid onto itself, and by interpolation, on request, by the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from equirl.symmetry.groups import Element, SymmetryGroup

__all__ = [
    "ACTION_FIELDS",
    "displace_objects",
    "field_matrix",
    "interpolate_image",
    "transform_action",
    "transform_deviations",
    "transform_fields",
    "transform_image",
    "transform_scene",
]

#: How an action of manipulation transforms: gripper, (x, y), z, theta.
ACTION_FIELDS = ("trivial", "vector", "trivial", "sign")
_O2 = SymmetryGroup("O2")


def transform_image(image: np.ndarray, element: Element) -> np.ndarray:
    """Moves the pixels of (..., S, S), whose rows grow with x and columns with y.

    Raises:
        ValueError: If the element turns by other than quarter turns.
    """
    if element.quarter_turns is None:
        raise ValueError(
            "pixels are moved by quarter turns, and reflections, alone, got a turn by "
            f"{math.degrees(element.angle):g}°"
        )
    if element.reflected:
        image = np.flip(image, axis=-1)
    return np.rot90(image, element.quarter_turns, axes=(-2, -1))


def interpolate_image(image: np.ndarray, element: Element) -> np.ndarray:
    """Moves the pixels of (..., S, S) by any element.

    Exactly where the element allows it; else each new pixel is interpolated bilinearly at the point
    it comes from, and beyond the border the nearest pixel stands.
    """
    if element.preserves_grid:
        return transform_image(image, element)
    from scipy.ndimage import affine_transform

    if element.reflected:
        image = np.flip(image, axis=-1)
    cos, sin = element.cos_sin
    back = np.array([[cos, sin], [-sin, cos]])
    middle = (image.shape[-1] - 1) / 2 * np.ones(2)
    layers = image.reshape(-1, *image.shape[-2:])
    options: dict[str, Any] = {"offset": middle - back @ middle, "order": 1, "mode": "nearest"}
    moved = np.stack([affine_transform(layer, back, **options) for layer in layers])
    return moved.reshape(image.shape)


def transform_action(action: np.ndarray, element: Element, keep_theta: bool = False) -> np.ndarray:
    """Moves actions (..., 5), theta left as it is if ``keep_theta``; of the same dtype."""
    fields = [*ACTION_FIELDS[:-1], "trivial" if keep_theta else "sign"]
    return transform_fields(action, fields, element, _O2).astype(action.dtype)


def transform_deviations(
    deviations: np.ndarray, fields: Sequence[str], element: Element, group: SymmetryGroup
) -> np.ndarray:
    """Moves the standard deviations (..., C) of fields whose channels are independent.

    Returns:
        For each field, side by side, its matrix R diag(s) R^T row by row: of a vector four
        numbers, of an invariant the deviation itself.
    """
    parts, start = [], 0
    for field in fields:
        matrix = field_matrix(field, element, group)
        part = deviations[..., start : start + len(matrix)]
        start += len(matrix)
        moved = np.einsum("ik,...k,jk->...ij", matrix, part, matrix)
        parts.append(moved.reshape(*part.shape[:-1], -1))
    return np.concatenate(parts, axis=-1)


def transform_fields(
    values: np.ndarray, fields: Sequence[str], element: Element, group: SymmetryGroup
) -> np.ndarray:
    """Moves the channels (..., C) of fields side by side.

    Args:
        values: Their channels, in the order of ``fields``.
        fields: The kind of each, as `field_matrix` takes it.
        element: What moves them.
        group: Whose fields they are.

    Raises:
        ValueError: The fields have another number of channels, or one is of an unknown kind.
    """
    blocks = {field: field_matrix(field, element, group) for field in set(fields)}
    size = sum(len(blocks[field]) for field in fields)
    if values.shape[-1] != size:
        raise ValueError(f"expected {size} channels, got an array of shape {values.shape}")
    matrix, start = np.zeros((size, size)), 0
    for field in fields:
        stop = start + len(blocks[field])
        matrix[start:stop, start:stop] = blocks[field]
        start = stop
    return (values.reshape(-1, size) @ matrix.T).reshape(values.shape)


def field_matrix(field: str, element: Element, group: SymmetryGroup) -> np.ndarray:
    """The matrix of an element on one field.

    Args:
        field: ``"trivial"``; ``"sign"``, which changes under reflection; ``"vector"``, (x, y);
            ``"vector_2"`` and so on, turned by so many times the angle; ``"vector_x"`` and
            ``"vector_y"``, what a half turn leaves of a vector; ``"regular"``, a function on the
            group, its rotations first, then the reflected elements.
        element: For a regular field, one of the group.
        group: Whose field it is.

    Raises:
        ValueError: Another field, or a regular one of a group without end.
    """
    plane = _plane(element)
    if field == "regular" and group.is_finite:
        return _permutation(element, group.rotations, 2 if group.reflections else 1)
    if field == "trivial":
        return np.eye(1)
    if field == "sign":
        return -np.eye(1) if element.reflected else np.eye(1)
    if field == "vector_x":
        return plane[:1, :1]
    if field == "vector_y":
        return plane[1:, 1:]
    name, _, frequency = field.partition("_")
    if name == "vector" and (frequency or "1").isdecimal():
        return _plane(Element(int(frequency or 1) * element.angle, element.reflected))
    raise ValueError(
        "expected a field trivial, sign, vector, vector_2 (or another frequency), vector_x, "
        f"vector_y, or regular of a finite group, got {field!r}"
    )


def _permutation(element: Element, rotations: int, flips: int) -> np.ndarray:
    """What an element does to a function on a finite group: (g f)(h) = f(g^-1 h).

    With h = k turns after the reflection or none, and g = a turns after s: g^-1 h is k - a turns
    after h's reflection if g has none, else a - k turns after the reflection that h has not.
    """
    turns = round(element.angle * rotations / math.tau)
    matrix = np.zeros((flips * rotations, flips * rotations))
    for flip in range(flips):
        for k in range(rotations):
            source = (turns - k if element.reflected else k - turns) % rotations
            matrix[flip * rotations + k, (flip ^ element.reflected) * rotations + source] = 1
    return matrix


def transform_scene(values: Mapping[str, Any], element: Element) -> dict[str, Any]:
    """Moves everything in a scene's dictionary about the vertical through the origin.

    The mirror image of an object is a pose of the same object only if its shape has the mirror
    plane y = 0.
    """
    plane, sign, angle = _plane(element), -1.0 if element.reflected else 1.0, element.angle
    position = np.array(values["position"], dtype=np.float64)
    position[:2] = plane @ position[:2]
    objects = _rows(values["objects"], 7)
    objects[:, :2] = objects[:, :2] @ plane.T
    x, y, z, w = objects[:, 3:].T * np.array([[sign], [1.0], [sign], [1.0]])
    sin, cos = math.sin(angle / 2), math.cos(angle / 2)
    turned = (cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z)
    objects[:, 3:] = np.stack(turned, axis=1)
    areas = _rows(values.get("areas", ()), 3)
    areas[:, :2] = areas[:, :2] @ plane.T
    areas[:, 2] = sign * areas[:, 2] + angle
    moved = {"position": position, "objects": objects, "areas": areas}
    lists = {key: array.tolist() for key, array in moved.items()}
    return {**values, **lists, "yaw": sign * values["yaw"] + angle}


def displace_objects(
    values: Mapping[str, Any], distance: float, rng: np.random.Generator
) -> dict[str, Any]:
    """Moves each object of a scene's dictionary by ``distance`` (m) in a horizontal direction."""
    objects = _rows(values["objects"], 7)
    angles = rng.uniform(0, math.tau, len(objects))
    objects[:, :2] += distance * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return {**values, "objects": objects.tolist()}


def _rows(values: Any, width: int) -> np.ndarray:
    """Returns ``values`` as an array (n, width) of its own, also where n is 0."""
    return np.array(values, dtype=np.float64).reshape(-1, width)


def _plane(element: Element) -> np.ndarray:
    """The element's matrix on (x, y); with quarter turns, its entries are 0, 1 and -1."""
    cos, sin = element.cos_sin
    turn = np.array([[cos, -sin], [sin, cos]])
    return turn @ np.diag([1, -1]) if element.reflected else turn
