"""Tools: flashlight, hammer, screwdriver, wrench. Lengths in cm."""

from __future__ import annotations

from equirl.envs.objects.household.solids import (
    Pieces,
    block,
    both_sides,
    hull,
    laid,
    prism,
    turned,
)

__all__ = ["flashlight", "hammer", "screwdriver", "wrench"]


def flashlight(
    length: float, radius: float, head_radius: float, head: float, flare: float
) -> Pieces:
    """A flashlight lying along x, its light at +x, the switch on top."""
    start = length - head
    switch = 0.55 * start
    return laid(
        [
            turned("x", [(0.5, radius), (start + 0.3, radius)]),
            turned("x", [(0, 0.95 * radius), (0.2, radius + 0.15), (1.4, radius + 0.15)]),
            turned(
                "x", [(start, radius), (start + flare * head, head_radius), (length, head_radius)]
            ),
            block((switch, switch + 1.6), 0.45, (0.8 * radius, radius + 0.35)),
        ]
    )


def hammer(
    length: float,
    handle_radius: float,
    head_width: float,
    head_radius: float,
    face: float,
    sides: int = 12,
    rim: float = 0.0,
) -> Pieces:
    """A two-faced hammer lying flat, its handle along x, its head along y at +x.

    Args:
        length: Of the whole.
        handle_radius: Of the handle where it meets the head; it thickens towards its end.
        head_width: Length of the head, along y.
        head_radius: Of the head.
        face: Radius of its faces as a fraction of ``head_radius``.
        sides: Corners of the head's cross-section.
        rim: How much thicker the ends of the head are.
    """
    centre = (length - head_radius, 0.0)
    half = head_width / 2
    bevel = 0.18 * head_width
    profile = [(half - bevel, head_radius), (half, face * head_radius)]
    outline = [(-y, r) for y, r in reversed(profile)] + profile
    pieces = [
        turned(
            "x",
            [
                (0, 1.05 * handle_radius),
                (0.3, 1.3 * handle_radius),
                (0.45 * length, 1.1 * handle_radius),
            ],
        ),
        turned("x", [(0.4 * length, handle_radius), (centre[0], 0.85 * handle_radius)], sides=8),
        turned("y", outline, centre=centre, sides=sides),
    ]
    if rim:
        ends = [(half - bevel, head_radius + rim), (half, head_radius + rim)]
        pieces += both_sides([turned("y", ends, centre=centre, sides=sides)])
    return laid(pieces)


def screwdriver(length: float, handle: float, radius: float, shaft: float, blade: float) -> Pieces:
    """A flat screwdriver lying along x, its blade at +x."""
    tip = length - 1.6
    end = [(length, side * 0.5 * blade, z) for side in (-1, 1) for z in (-0.12, 0.12)]
    shoulder = [(tip, side * 0.55 * blade, z) for side in (-1, 1) for z in (-0.3, 0.3)]
    return laid(
        [
            turned(
                "x",
                [
                    (0, 0.7 * radius),
                    (0.35, radius),
                    (0.7 * handle, radius),
                    (0.85 * handle, 0.7 * radius),
                ],
            ),
            turned(
                "x",
                [
                    (0.8 * handle, 0.7 * radius),
                    (handle - 0.2, 0.95 * radius),
                    (handle, 0.8 * radius),
                ],
            ),
            turned("x", [(handle - 0.2, shaft), (tip, shaft)], sides=8),
            hull(shoulder, end),
        ]
    )


def wrench(
    length: float,
    width: float,
    thickness: float,
    jaw: float,
    small_jaw: float = 0.0,
    ring_radius: float = 0.0,
) -> Pieces:
    """An open-end wrench lying flat along x.

    Args:
        length: Of the whole.
        width: Of the handle.
        thickness: Height of the flat.
        jaw: Half width of the jaw at +x.
        small_jaw: Half width of the jaw at -x, if there is one ...
        ring_radius: ... or the radius of a round end.
    """
    half = length / 2
    back = half - (1.1 * small_jaw or ring_radius)
    # The ends are a little higher than the handle, and clear of the ground: fewer contacts.
    raised = (0.05, thickness)
    pieces = [block((-back, half - 1.1 * jaw), width / 2, (0, thickness - 0.15))]
    pieces += _prongs(half, jaw, raised, 1)
    if small_jaw:
        return pieces + _prongs(half, small_jaw, raised, -1)
    rim = [(z, ring_radius) for z in raised]
    return [*pieces, turned("z", rim, centre=(-back, 0.0))]


def _prongs(end: float, half: float, z: tuple[float, float], side: int) -> Pieces:
    """The two prongs of a jaw, over the interval ``z``; it opens at ``end``, towards ``side`` x."""
    outline = [(2.2, 0.2), (1.6, 1.0), (0.4, 1.0), (0.0, 0.75), (0.0, 0.45)]  # in units of half
    return both_sides([prism([(side * (end - x * half), y * half) for x, y in outline], *z)])
