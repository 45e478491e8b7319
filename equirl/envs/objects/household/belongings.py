"""Things from the hall and the nursery: boot, camera, toy car, toy duck. Lengths in cm."""

from __future__ import annotations

from equirl.envs.objects.household.solids import (
    Pieces,
    block,
    hull,
    laid,
    plate,
    ring,
    slab,
    turned,
)

__all__ = ["boot", "camera", "car", "duck"]


def boot(length: float, width: float, height: float, shaft: float, heel: float) -> Pieces:
    """A boot standing upright, its toe at +x.

    Args:
        length: Of the sole.
        width: Of the sole.
        height: Of the whole.
        shaft: Diameter of the shaft along x.
        heel: Height of the heel.
    """
    half = width / 2
    sole = [
        (0.45 * length, 0.85 * half),
        (0.75 * length, half),
        (0.93 * length, 0.7 * half),
        (length, 0.3 * half),
    ]
    ankle = heel + 0.5
    middle = 0.2 + shaft / 2
    foot = hull(
        ring((middle, 0, 0.6 * heel), (shaft / 2, 0, 0), (0, 0.8 * half, 0), sides=8),
        ring((middle, 0, 0.45 * height), (shaft / 2, 0, 0), (0, 0.7 * half, 0), sides=8),
        [(0.72 * length, side * 0.92 * half, ankle) for side in (-1, 1)],
        [(0.97 * length, side * 0.4 * half, ankle) for side in (-1, 1)],
        [(0.95 * length, side * 0.35 * half, ankle + 0.14 * height) for side in (-1, 1)],
        [(0.75 * length, side * 0.55 * half, ankle + 0.24 * height) for side in (-1, 1)],
    )
    leg = [(0.4 * height, shaft / 2, 0.72 * half), (height, 1.08 * shaft / 2, 0.85 * half)]
    cuff = [(0.86 * height, 1.2 * shaft / 2, 0.97 * half), (height, 1.2 * shaft / 2, 0.97 * half)]
    return [
        plate(sole, 0, ankle),
        block((0.1, 0.32 * length), 0.8 * half, (0, ankle), chamfer=0.3),
        foot,
        turned("z", leg, centre=(middle, 0.0), sides=8),
        turned("z", cuff, centre=(middle, 0.0), sides=8),
    ]


def camera(
    width: float, height: float, depth: float, lens_radius: float, lens: float, prism: float
) -> Pieces:
    """A camera standing upright, its lens towards +x; ``prism`` is the hump's height, or 0."""
    middle, top = (0.0, 0.48 * height), height + prism
    start = depth / 2
    pieces = [
        block((-start, start), width / 2, (0, height), chamfer=0.25 * depth),
        turned("x", [(0, lens_radius), (start + lens, 0.92 * lens_radius)], centre=middle),
    ]
    if prism:
        outline = [(-1.3, height - 0.1), (1.3, height - 0.1), (0.8, top), (-0.8, top)]
        pieces.append(hull(*([(x, y, z) for y, z in outline] for x in (-0.8 * start, 0.8 * start))))
    else:
        button = turned("z", [(height - 0.1, 0.7), (height + 0.4, 0.6)], sides=8)
        pieces.append(button)
    return pieces


def car(
    length: float,
    width: float,
    wheel: float,
    belt: float,
    roof: float,
    cabin: tuple[float, float, float, float],
    nose: float,
) -> Pieces:
    """A toy car on its wheels, driving towards +x.

    Args:
        length: Of the whole.
        width: Of the whole.
        wheel: Radius of a wheel; the two of an axle are one roller.
        belt: Height of the body.
        roof: Height of the roof.
        cabin: Where the cabin starts and ends at the belt and, between these, at the roof: rear
            below, rear above, front above, front below, as fractions of the length from the back.
        nose: Height of the bonnet's front.
    """
    half, floor = width / 2, 0.9 * wheel
    rear, roof_rear, roof_front, front = (part * length for part in cabin)
    body = [
        (0, floor + 0.2),
        (0.25, floor),
        (length - 0.25, floor),
        (length, floor + 0.3),
        (length, nose),
        (front, belt),
        (0, 0.97 * belt),
    ]
    window = [(x, side * 0.84 * half, belt - 0.1) for x in (rear, front) for side in (-1, 1)]
    top = [(x, side * 0.66 * half, roof) for x in (roof_rear, roof_front) for side in (-1, 1)]
    axles = [
        turned("y", [(-half, wheel), (half, wheel)], centre=(part * length, wheel))
        for part in (0.2, 0.79)
    ]
    return [slab(body, 0.88 * half), hull(window, top), *axles]


def duck(
    length: float, width: float, body: float, head_radius: float, height: float, beak: float
) -> Pieces:
    """A bath duck, its beak towards +x.

    Args:
        length: Of the body with its tail.
        width: Of the body.
        body: Height of the body.
        head_radius: Of the head.
        height: Of the whole.
        beak: Length of the beak.
    """
    half, up = width / 2, body / 2
    sections = [  # x and z of the middle, half width, half height
        (0.04 * length, 1.5 * up, 0.3 * half, 0.1 * up),
        (0.22 * length, 0.95 * up, 0.75 * half, 0.72 * up),
        (0.5 * length, up, half, up),
        (0.8 * length, up, 0.85 * half, 0.85 * up),
        (0.98 * length, 1.05 * up, 0.4 * half, 0.45 * up),
    ]
    trunk = [ring((x, 0, z), (0, y, 0), (0, 0, h)) for x, z, y, h in sections]
    base = [(x * length, side * 0.6 * half, -0.05) for x in (0.3, 0.8) for side in (-1, 1)]
    tail = [(0, side * 0.2 * half, 1.9 * up) for side in (-1, 1)]
    middle, centre = 0.66 * length, height - head_radius
    head = turned(
        "z",
        [
            (centre - 0.95 * head_radius, 0.55 * head_radius),
            (centre - 0.45 * head_radius, 0.92 * head_radius),
            (centre + 0.2 * head_radius, head_radius),
            (centre + 0.7 * head_radius, 0.75 * head_radius),
            (height, 0.3 * head_radius),
        ],
        centre=(middle, 0.0),
        sides=8,
    )
    front = middle + 0.85 * head_radius
    bill = hull(
        [(front, side * 0.6 * head_radius, centre + z) for side in (-1, 1) for z in (-0.55, 0.35)],
        [
            (front + beak, side * 0.45 * head_radius, centre + z)
            for side in (-1, 1)
            for z in (-0.35, -0.05)
        ],
    )
    return laid([hull(*trunk, tail, base), head, bill])
