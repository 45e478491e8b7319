"""Rigid bodies: one description for the physics and for the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull


@dataclass(frozen=True, eq=False)
class ConvexPolyhedron:
    """A convex polyhedron.

    Attributes:
        vertices: corner points in the body's frame, shape (V, 3), m.
        triangles: rows of three vertex indices covering the surface, shape (T, 3).
        half_extents: half sides (3,), m, when it is a box about the body's origin along the
            body's axes: boxes collide faster and more stably than general hulls. Else None.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    half_extents: np.ndarray | None = None

    @classmethod
    def hull(cls, points: np.ndarray) -> ConvexPolyhedron:
        """Returns the convex hull of ``points`` (shape (P, 3), m)."""
        points = np.asarray(points, dtype=np.float64)
        hull = ConvexHull(points)
        index = np.full(len(points), -1)
        index[hull.vertices] = np.arange(len(hull.vertices))
        return cls(points[hull.vertices], index[hull.simplices])

    @classmethod
    def box(cls, half_extents: np.ndarray) -> ConvexPolyhedron:
        """Returns the box with ``half_extents`` (shape (3,), m) about the origin."""
        half = np.asarray(half_extents, dtype=np.float64)
        signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij")).reshape(3, -1).T
        hull = cls.hull(signs * half)
        return cls(hull.vertices, hull.triangles, half)


@dataclass(frozen=True, eq=False)
class Body:
    """A convex rigid body.

    Attributes:
        shape: its geometry.
        mass: kg.
        friction: lateral friction coefficient.
        color: red, green, blue, alpha in [0, 1], for `ManipulationEnv.render` only.
    """

    shape: ConvexPolyhedron
    mass: float
    friction: float
    color: tuple[float, float, float, float] = (0.85, 0.25, 0.2, 1.0)


def cube(side: float, mass: float, friction: float) -> Body:
    """Returns a cube of ``side`` (m), ``mass`` (kg) and lateral ``friction``."""
    return Body(ConvexPolyhedron.box(np.full(3, side / 2)), mass, friction)
