"""Rigid bodies: one description for the physics and for the picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

__all__ = ["Body", "Color", "ConvexPolyhedron", "cube"]

Color = tuple[float, float, float, float]

_RED: Color = (0.85, 0.25, 0.2, 1.0)


@dataclass(frozen=True, eq=False)
class ConvexPolyhedron:
    """A convex polyhedron.

    Attributes:
        vertices: Corner points, shape (V, 3), m.
        triangles: Rows of three vertex indices covering the surface, shape (T, 3), in
            counter-clockwise order as seen from outside.
        half_extents: Half sides (3,), m, when it is a box about the origin along the axes: boxes
            collide faster and more stably than general hulls. Else None.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    half_extents: np.ndarray | None = None

    @classmethod
    def hull(cls, points: ArrayLike) -> ConvexPolyhedron:
        """Returns the convex hull of ``points`` (shape (P, 3), m).

        Raises:
            ValueError: If the points are not finite or span no volume.
        """
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"expected finite points of shape (P, 3), got shape {points.shape}")
        try:
            hull = ConvexHull(points)
        except QhullError as error:
            raise ValueError(f"{len(points)} points span no volume") from error
        index = np.full(len(points), -1)
        index[hull.vertices] = np.arange(len(hull.vertices))
        vertices, triangles = points[hull.vertices], index[hull.simplices]
        return cls(vertices, _outward(vertices, triangles))

    @classmethod
    def box(cls, half_extents: np.ndarray) -> ConvexPolyhedron:
        """Returns the box with ``half_extents`` (shape (3,), m) about the origin."""
        half = np.asarray(half_extents, dtype=np.float64)
        signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij")).reshape(3, -1).T
        hull = cls.hull(signs * half)
        return replace(hull, half_extents=half)

    def scaled(self, factor: float) -> ConvexPolyhedron:
        """Returns the polyhedron enlarged by ``factor`` about the origin."""
        half = None if self.half_extents is None else self.half_extents * factor
        return ConvexPolyhedron(self.vertices * factor, self.triangles, half)

    def moved(self, offset: np.ndarray) -> ConvexPolyhedron:
        """Returns the polyhedron moved by ``offset`` (shape (3,), m)."""
        offset = np.asarray(offset, dtype=np.float64)
        half = self.half_extents if not offset.any() else None
        return ConvexPolyhedron(self.vertices + offset, self.triangles, half)

    def moments(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Returns volume (m^3), centroid (3,) and second moments (3, 3), integral of x x^T, m^5."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6  # of tetrahedra with the origin
        total = a + b + c
        first = (volumes[:, None] * total).sum(0) / 4
        second = sum(np.einsum("t,ti,tj->ij", volumes, p, p) for p in (a, b, c, total)) / 20
        return float(volumes.sum()), first / volumes.sum(), second


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body made of convex pieces of one density.

    The origin of its frame is its centre of mass. Pieces may touch and overlap; where they
    overlap, mass counts twice.

    Attributes:
        pieces: Its geometry in the body's frame; collides, and is drawn.
        mass: Kg.
        friction: Lateral friction coefficient.
        name: What it is called.
        rolling_friction: Torsional friction against rolling, m; keeps round bodies from rolling
            for ever.
        color: Red, green, blue, alpha in [0, 1], for `ManipulationEnv.render` only.
    """

    pieces: tuple[ConvexPolyhedron, ...]
    mass: float
    friction: float
    name: str = "body"
    rolling_friction: float = 0.0
    color: Color = _RED

    @classmethod
    def centred(
        cls, pieces: Iterable[ConvexPolyhedron], mass: float, friction: float, **options: Any
    ) -> Body:
        """Returns the body of ``pieces``, given in any frame, moved to its centre of mass."""
        pieces = tuple(pieces)
        volumes, centroids, _ = zip(*(piece.moments() for piece in pieces), strict=True)
        # To a nanometre: what is symmetric about a plane stays so, bit for bit.
        centre = np.round(np.average(centroids, axis=0, weights=volumes), 9)
        return cls(tuple(piece.moved(-centre) for piece in pieces), mass, friction, **options)

    def scaled(self, factor: float) -> Body:
        """Returns the body enlarged by ``factor``; its mass stays."""
        if factor == 1.0:
            return self
        return replace(self, pieces=tuple(piece.scaled(factor) for piece in self.pieces))

    @property
    def vertices(self) -> np.ndarray:
        """The corners of all pieces, shape (V, 3), m."""
        return np.concatenate([piece.vertices for piece in self.pieces])

    @property
    def extents(self) -> np.ndarray:
        """Sides of the bounding box along the body's axes, shape (3,), m."""
        return np.ptp(self.vertices, axis=0)

    @cached_property
    def inertia(self) -> np.ndarray:
        """Moments of inertia about the body's axes, shape (3,), kg m^2."""
        volumes, _, seconds = zip(*(piece.moments() for piece in self.pieces), strict=True)
        second = self.mass / sum(volumes) * np.sum([np.diag(s) for s in seconds], axis=0)
        return second.sum() - second

    @property
    def has_mirror_symmetry(self) -> bool:
        """Whether the reflection y -> -y of the body's frame maps the body onto itself."""
        pieces = [np.round(piece.vertices, 7) + 0.0 for piece in self.pieces]
        mirrored = [points * (1, -1, 1) + 0.0 for points in pieces]
        return {_as_set(points) for points in pieces} == {_as_set(points) for points in mirrored}


def cube(side: float, mass: float, friction: float) -> Body:
    """Returns a cube of ``side`` (m), ``mass`` (kg) and lateral ``friction``."""
    return Body((ConvexPolyhedron.box(np.full(3, side / 2)),), mass, friction, name="cube")


def _as_set(points: np.ndarray) -> frozenset[tuple[float, ...]]:
    return frozenset(map(tuple, points.tolist()))


def _outward(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Orders triangles (T, 3) of a convex body counter-clockwise as seen from outside."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - vertices.mean(0)) < 0
    ordered = triangles.copy()
    ordered[inward] = ordered[inward][:, ::-1]
    return ordered
