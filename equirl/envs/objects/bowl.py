"""A bowl with an octagonal plan, from convex pieces."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from equirl.envs.objects.bodies import Body, ConvexPolyhedron

__all__ = ["bowl"]

_WALL = 0.007  # thickness of the wall, m; a finger moves 4 mm at most in a simulation step
# Outline of the outside, from the foot to the rim: (distance of the flats from the axis, height),
# in units of half the width and of the height. The wall is steep below the rim, so that a gripper
# can pinch it, and slanted above the foot, so that a cube slides to the middle.
_PROFILE = ((0.50, 0.10), (0.90, 0.48), (1.00, 1.00))
_FOOT = (0.45, 0.50)  # half widths of the foot at its bottom and its top
_FOOT_TOP = 0.16  # height of the floor inside


def bowl(width: float, height: float, mass: float, friction: float) -> Body:
    """Returns a bowl that opens upwards.

    Only its foot stands on the ground, which keeps contacts few: one convex foot and two rings of
    eight slabs. It is symmetric under quarter turns and reflections, bit for bit.

    Args:
        width: Between opposite flats of the rim, m.
        height: M.
        mass: Kg.
        friction: Lateral friction coefficient.
    """
    half = width / 2
    foot = np.concatenate(
        [_octagon(half * _FOOT[0], 0.0), _octagon(half * _FOOT[1], height * _FOOT_TOP)]
    )
    pieces = [ConvexPolyhedron.hull(foot)]
    levels = [(half * r, height * z) for r, z in _PROFILE]
    for (r0, z0), (r1, z1) in pairwise(levels):
        section = ((r0, z0), (r1, z1), (r0 - _WALL, z0), (r1 - _WALL, z1))
        rings = [_octagon(r, z) for r, z in section]
        for k in range(8):
            corners = [ring[j] for ring in rings for j in (k, (k + 1) % 8)]
            pieces.append(ConvexPolyhedron.hull(np.array(corners)))
    return Body.centred(pieces, mass, friction, name="bowl", color=(0.25, 0.5, 0.75, 1.0))


def _octagon(inradius: float, z: float) -> np.ndarray:
    """Returns the corners of a regular octagon with flats across x and y, shape (8, 3), m."""
    a, b = inradius, inradius * (np.sqrt(2) - 1)
    plan = [(a, -b), (a, b), (b, a), (-b, a), (-a, b), (-a, -b), (-b, -a), (b, -a)]
    return np.array([(x, y, z) for x, y in plan])
