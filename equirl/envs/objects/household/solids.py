"""Convex pieces of household objects, and how they are put together; all lengths in cm.

A piece equals its own reflection in the plane y = 0, bit for bit, unless it is one of a pair made
by `both_sides`: coordinates are computed for one side only and negated for the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from equirl.envs.objects.bodies import ConvexPolyhedron

__all__ = [
    "Pieces",
    "block",
    "both_sides",
    "chain",
    "hull",
    "laid",
    "plate",
    "prism",
    "ring",
    "slab",
    "turned",
]

Pieces = list[ConvexPolyhedron]

_PLANES = {"x": (1, 2), "y": (0, 2), "z": (0, 1)}  # the two other axes of each axis


def ring(
    centre: Sequence[float] | np.ndarray,
    across: Sequence[float] | np.ndarray,
    up: Sequence[float] | np.ndarray,
    sides: int = 12,
) -> np.ndarray:
    """Returns the corners of a polygon about an ellipse, shape (sides, 3).

    Args:
        centre: Of the ellipse, shape (3,).
        across: One half axis, shape (3,).
        up: The other half axis, shape (3,).
        sides: Number of corners, a multiple of four; the ellipse touches the middle of each side,
            so that a lying cylinder rests on a flat.
    """
    angles = (np.arange(sides // 4) + 0.5) * 2 * np.pi / sides
    quarter = np.stack([np.cos(angles), np.sin(angles)], axis=1) / np.cos(np.pi / sides)
    polygon = np.concatenate([quarter * sign for sign in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
    # Products one by one: a matrix product rounds as the machine likes.
    first, second = polygon[:, :1] * np.asarray(across), polygon[:, 1:] * np.asarray(up)
    return np.asarray(centre) + first + second


def hull(*groups: Sequence[Sequence[float]] | np.ndarray) -> ConvexPolyhedron:
    """Returns the convex hull of all points of ``groups`` (each of shape (P, 3))."""
    return ConvexPolyhedron.hull(np.concatenate([np.asarray(group, float) for group in groups]))


def turned(
    axis: str,
    profile: Sequence[Sequence[float]],
    centre: tuple[float, float] = (0.0, 0.0),
    sides: int = 12,
) -> ConvexPolyhedron:
    """Returns the hull of parallel rings: a body as from a lathe.

    Args:
        axis: ``"x"``, ``"y"`` or ``"z"``.
        profile: Rows (position along the axis, radius) or (position, two radii along the other two
            axes in alphabetical order).
        centre: Where the axis passes, in the other two coordinates.
        sides: Corners of a ring.
    """
    first, second = _PLANES[axis]
    along = "xyz".index(axis)
    rings = []
    for position, *radii in profile:
        middle, across, up = np.zeros((3, 3))
        middle[[along, first, second]] = position, *centre
        across[first], up[second] = radii[0], radii[-1]
        rings.append(ring(middle, across, up, sides))
    return hull(*rings)


def slab(outline: Sequence[Sequence[float]], half_width: float) -> ConvexPolyhedron:
    """Returns the convex ``outline`` (rows x, z) spread over -half_width <= y <= half_width."""
    return hull(*([(x, side * half_width, z) for x, z in outline] for side in (-1, 1)))


def plate(outline: Sequence[Sequence[float]], bottom: float, top: float) -> ConvexPolyhedron:
    """Returns the convex ``outline`` (rows x, y) and its reflection between two heights."""
    both = [(x, side * y) for x, y in outline for side in (-1, 1)]
    return prism(both, bottom, top)


def prism(outline: Sequence[Sequence[float]], bottom: float, top: float) -> ConvexPolyhedron:
    """Returns the convex ``outline`` (rows x, y), as it is, between two heights."""
    return hull(*([(x, y, z) for x, y in outline] for z in (bottom, top)))


def block(
    x: tuple[float, float],
    half_width: float,
    z: tuple[float, float],
    chamfer: float = 0.0,
) -> ConvexPolyhedron:
    """Returns a box over the intervals ``x`` and ``z`` whose upright edges are cut."""
    (back, front), (bottom, top) = x, z
    if not chamfer:
        return plate([(back, half_width), (front, half_width)], bottom, top)
    corners = [
        (back, half_width - chamfer),
        (back + chamfer, half_width),
        (front - chamfer, half_width),
        (front, half_width - chamfer),
    ]
    return plate(corners, bottom, top)


def chain(rings: Sequence[np.ndarray]) -> Pieces:
    """Returns the hull of every two successive rings."""
    return [hull(one, other) for one, other in pairwise(rings)]


def both_sides(pieces: Pieces) -> Pieces:
    """Returns ``pieces`` and their reflections in y = 0."""
    mirrored = [ConvexPolyhedron(p.vertices * (1, -1, 1), p.triangles[:, ::-1]) for p in pieces]
    return [*pieces, *mirrored]


def laid(pieces: Pieces) -> Pieces:
    """Returns ``pieces`` pitched about the y axis into the nearest pose in which they rest.

    That is: standing on an edge or a face of their common outline in x and z with the centre of
    mass above it.
    """
    for _ in range(20):
        pitch = _pitch_of_support(pieces)
        if abs(pitch) < 1e-6:
            return pieces
        pieces = [ConvexPolyhedron(_pitched(p.vertices, pitch), p.triangles) for p in pieces]
    raise ValueError("found no pose in which the pieces rest")


def _pitched(points: np.ndarray, pitch: float) -> np.ndarray:
    x, y, z = points.T
    cosine, sine = np.cos(pitch), np.sin(pitch)
    return np.stack([cosine * x + sine * z, y, cosine * z - sine * x], axis=1)


def _pitch_of_support(pieces: Pieces) -> float:
    """Returns the slope (rad) of the lower outline below the centre of mass."""
    volumes, centroids, _ = zip(*(piece.moments() for piece in pieces), strict=True)
    centre = np.average(centroids, axis=0, weights=volumes)[0]
    points = np.concatenate([piece.vertices[:, [0, 2]] for piece in pieces])
    # The lower hull from left to right (Andrew's monotone chain).
    lower: list[np.ndarray] = []
    for point in points[np.lexsort((points[:, 1], points[:, 0]))]:
        while len(lower) > 1 and _cross(lower[-1] - lower[-2], point - lower[-2]) <= 1e-9:
            lower.pop()
        lower.append(point)
    for left, right in pairwise(lower):
        if left[0] <= centre < right[0]:
            return float(np.arctan2(right[1] - left[1], right[0] - left[0]))
    raise AssertionError("the centre of mass lies within the hull")


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return a[0] * b[1] - a[1] * b[0]
