"""Things to eat: apple, banana, carrot, croissant, donut, egg, pear. Lengths in cm."""

from __future__ import annotations

import numpy as np

from equirl.envs.objects.household.solids import (
    Pieces,
    both_sides,
    chain,
    hull,
    laid,
    prism,
    ring,
    turned,
)

__all__ = ["apple", "banana", "carrot", "croissant", "donut", "egg", "pear"]


def apple(radius: float, height: float, widest: float, stem: float, leaf: float = 0.0) -> Pieces:
    """An apple with its stem up, widest at the fraction ``widest`` of its height."""
    flesh = turned(
        "z",
        [
            (0, 0.5 * radius),
            (0.4 * widest * height, 0.82 * radius),
            (widest * height, radius),
            ((0.4 + 0.6 * widest) * height, 0.88 * radius),
            (height, 0.52 * radius),
        ],
    )
    pieces = [flesh, turned("z", [(height - 0.1, 0.3), (height + stem, 0.4)], sides=8)]
    if leaf:
        x, y, z = 0.5 * leaf, 0.3 * leaf, height + 0.5 * stem
        outline = np.array([(0, 0, z), (x, y, z + 0.3), (x, -y, z + 0.3), (leaf, 0, z)])
        pieces.append(hull(outline, outline + np.array([0, 0, 0.25])))
    return pieces


def banana(bend_radius: float, half_angle: float, thickness: float, tip: float) -> Pieces:
    """A banana lying on its side, its chord along y, its ends towards -x."""
    # Where along the half, how thick, and how far off the ground: it rests on middle and tips.
    sections = [(0.0, 1.0, 0.0), (0.42, 1.0, 0.0), (0.84, 0.75, 0.06), (1.0, tip, 0.0)]
    rings = [
        _arc_ring(bend_radius, part * half_angle, size * thickness, size * thickness, gap)
        for part, size, gap in sections
    ]
    middle = hull(rings[0], rings[1], rings[1] * (1, -1, 1))
    return [middle, *both_sides(chain(rings[1:]))]


def carrot(length: float, radius: float, blunt: float, leaves: float) -> Pieces:
    """A carrot lying along x, its tip at +x."""
    root = turned(
        "x",
        [
            (0, 0.6 * radius),
            (0.05 * length, radius),
            (0.5 * length, (0.6 + 0.3 * blunt) * radius),
            (0.93 * length, (0.12 + 0.4 * blunt) * radius),
            (length, 0.1 * radius),
        ],
        sides=8,
    )
    stalk = turned("x", [(0.1, 0.35), (-leaves, 0.5)], sides=8)
    spread = [(0.2, 0.1), (-0.6 * leaves, 0.5), (-0.9 * leaves, 1.3), (-0.5 * leaves, 1.2)]
    return laid([root, stalk, *both_sides([prism(spread, -0.3, 0.3)])])


def croissant(bend_radius: float, half_angle: float, thickness: float, flat: float) -> Pieces:
    """A croissant lying flat, its chord along y, its horns towards -x, in ridged segments."""

    def section(part: float, size: float, gap: float) -> np.ndarray:
        width = size * thickness
        return _arc_ring(bend_radius, part * half_angle, width, flat * width, gap)

    # It rests on the middle and the horns.
    middle = hull(section(-0.2, 0.97, 0.05), section(0, 1, 0), section(0.2, 0.97, 0.05))
    sides = [
        hull(section(0.16, 0.92, 0.05), section(0.52, 0.76, 0.05)),
        hull(section(0.46, 0.67, 0.05), section(0.8, 0.49, 0.05)),
        hull(section(0.74, 0.41, 0.02), section(1.0, 0.2, 0)),
    ]
    return [middle, *both_sides(sides)]


def donut(radius: float, tube: float, height: float) -> Pieces:
    """A donut lying flat; ``radius`` is that of the circle in the middle of its tube."""
    angles = np.linspace(0, np.pi, 5)
    rings = []
    for angle in angles:
        outward = np.array([np.cos(angle), np.sin(angle), 0])
        rings.append(ring(radius * outward, tube * outward, (0, 0, height / 2), sides=8))
    return both_sides(chain(rings))


def egg(length: float, radius: float, taper: float) -> Pieces:
    """An egg lying along x, its pointed end at +x."""
    angles = np.linspace(np.pi, 0, 8)[1:-1]
    positions = np.array([-0.985, *np.cos(angles)[1:-1], 0.985])
    profile = [
        (x * length / 2, radius * np.sqrt(1 - x * x) * (1 - taper * x) * (1 - taper * taper))
        for x in positions
    ]
    return laid([turned("x", profile)])


def pear(radius: float, length: float, neck_radius: float, stem: float) -> Pieces:
    """A pear lying along x, its stem at +x."""
    bulb = [
        (0, 0.45 * radius),
        (0.12 * length, 0.87 * radius),
        (0.3 * length, radius),
        (0.46 * length, 0.9 * radius),
        (0.62 * length, neck_radius),
    ]
    neck = [
        (0.5 * length, 1.15 * neck_radius),
        (0.85 * length, 0.92 * neck_radius),
        (0.95 * length, 0.7 * neck_radius),
        (length, 0.35 * neck_radius),
    ]
    stalk = [(length - 0.2, 0.25), (length + stem, 0.35)]
    return laid([turned("x", bulb), turned("x", neck), turned("x", stalk, sides=8)])


def _arc_ring(
    bend_radius: float, angle: float, width: float, height: float, gap: float
) -> np.ndarray:
    """Returns a cross-section of a tube bent about (-bend_radius, 0), ``gap`` above the ground."""
    outward = np.array([np.cos(angle), np.sin(angle), 0.0])
    centre = bend_radius * outward + np.array([-bend_radius, 0, gap + height / 2])
    return ring(centre, width / 2 * outward, (0, 0, height / 2), sides=8)
