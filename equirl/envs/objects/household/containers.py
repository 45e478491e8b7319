"""Things that hold something: bottle, can, carton, mug. Lengths in cm."""

from __future__ import annotations

import numpy as np

from equirl.envs.objects.household.solids import (
    Pieces,
    block,
    both_sides,
    hull,
    slab,
    turned,
)

__all__ = ["bottle", "can", "carton", "mug"]


def bottle(
    length: float,
    radius: float,
    body: float,
    shoulder: float,
    neck_radius: float,
    waist: float = 1.0,
) -> Pieces:
    """A bottle with a cap, lying along x; ``waist`` < 1 narrows the middle of its body."""
    neck = body + shoulder
    base = [(0, 0.88 * radius), (0.35, radius)]
    top = [(body, radius), (neck, neck_radius)]
    cap = neck_radius + 0.25
    if waist == 1.0:
        trunk = [turned("x", base + top)]
    else:
        middle = [(0.5 * body, waist * radius)]
        trunk = [
            turned("x", [*base, (0.3 * body, radius), *middle]),
            turned("x", [*middle, (0.7 * body, radius), *top]),
        ]
    return [
        *trunk,
        turned("x", [(neck - 0.2, neck_radius), (length - 1.0, neck_radius)], sides=8),
        turned("x", [(length - 1.3, cap), (length, 0.9 * cap)], sides=8),
    ]


def can(
    radius: float, height: float, top_radius: float, rim: float = 0.0, nozzle: float = 0.0
) -> Pieces:
    """A tin can standing upright, with rims at both ends or a spray nozzle on its dome."""
    if rim:
        return [
            turned("z", [(0.2, radius), (height - 0.2, radius)]),
            turned("z", [(0, radius + rim), (0.5, radius + rim)]),
            turned("z", [(height - 0.5, radius + rim), (height, radius + rim)]),
        ]
    shoulder = height - 0.45 * radius
    pieces = [
        turned("z", [(0, 0.88 * radius), (0.4, radius), (shoulder, radius), (height, top_radius)])
    ]
    if nozzle:
        return [*pieces, turned("z", [(height - 0.1, 0.8), (height + nozzle, 0.7)], sides=8)]
    lid = top_radius + 0.15
    return [*pieces, turned("z", [(height - 0.05, lid), (height + 0.25, lid)])]


def carton(
    depth: float,
    width: float,
    height: float,
    roof: float,
    fin: float,
    cap: float = 0.0,
    straw: float = 0.0,
) -> Pieces:
    """A drink carton standing upright, its gable along y; without a roof, a brick with a straw."""
    x, y = depth / 2, width / 2
    corners = [(side * x, sign * y, z) for side in (-1, 1) for sign in (-1, 1) for z in (0, height)]
    ridge = height + roof
    pieces = [hull(corners, [(0, -y, ridge), (0, y, ridge)])] if roof else [hull(corners)]
    if fin:
        pieces.append(block((-0.2, 0.2), y, (ridge - 0.2, ridge + fin)))
    if cap:
        middle = (0.55 * x, 0.0)
        pieces.append(
            turned("z", [(height, cap), (height + 0.75 * roof, cap)], centre=middle, sides=8)
        )
    if straw:
        bend = height + straw
        pieces.append(block((-x + 0.5, -x + 1.0), 0.25, (height - 0.1, bend)))
        pieces.append(slab([(-x + 0.5, bend), (-x + 0.8, bend - 0.5), (0.4, bend + 0.3)], 0.25))
    return pieces


def mug(
    radius: float, base_radius: float, height: float, reach: float, thickness: float = 0.7
) -> Pieces:
    """An open mug standing upright; its handle reaches ``reach`` beyond it along +x."""
    wall, sectors = 0.4, 6
    foot = 0.15  # only the base touches the ground: fewer contacts
    walls = []
    angles = np.linspace(0, np.pi, sectors + 1)
    for start, middle, end in zip(angles[:-2:2], angles[1:-1:2], angles[2::2], strict=True):
        corners = [
            ((r - inset) * np.cos(angle), (r - inset) * np.sin(angle), z)
            for r, z in ((base_radius, foot), (radius, height))
            for angle, inset in ((start, 0), (middle, 0), (end, 0), (start, wall), (end, wall))
        ]
        walls.append(hull(corners))
    base = turned("z", [(0, base_radius - 0.3), (0.7, base_radius - 0.3)], sides=8)
    return [base, *both_sides(walls), *_handle(radius, base_radius, height, reach, thickness)]


def _handle(
    radius: float, base_radius: float, height: float, reach: float, thickness: float
) -> Pieces:
    """A loop of three straight pieces in the plane y = 0."""
    top, bottom = 0.88 * height, 0.22 * height

    def outside(z: float) -> float:
        return base_radius + (radius - base_radius) * z / height

    outer = [
        (outside(top) - 0.2, top),
        (outside(top) + reach, top - 0.4),
        (outside(bottom) + 0.8 * reach, bottom + 0.6),
        (outside(bottom) - 0.2, bottom),
    ]
    inner = [
        (outer[0][0], top - thickness),
        (outer[1][0] - thickness, top - 0.4 - thickness),
        (outer[2][0] - thickness, bottom + 0.6 + thickness),
        (outer[3][0], bottom + thickness),
    ]
    return [
        slab([outer[k], outer[k + 1], inner[k + 1], inner[k]], 0.65 * thickness) for k in range(3)
    ]
