"""The kinds of household objects and the numbers of their variants, in cm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from equirl.envs.objects.household import belongings, containers, food, tools
from equirl.envs.objects.household.solids import Pieces

__all__ = ["KINDS", "Kind"]


@dataclass(frozen=True)
class Kind:
    """A kind of object.

    Attributes:
        generate: Makes the pieces of an object from the numbers of a variant, cm.
        hue: Of its colours, in [0, 1).
        saturation: Of its colours, in [0, 1].
        variants: Keyword arguments of ``generate``, one row a variant.
    """

    generate: Callable[..., Pieces]
    hue: float
    saturation: float
    variants: tuple[dict[str, Any], ...]


KINDS: dict[str, Kind] = {
    "apple": Kind(
        food.apple,
        hue=0.99,
        saturation=0.75,
        variants=(
            dict(radius=2.9, height=5.2, widest=0.6, stem=1.0, leaf=2.0),
            dict(radius=2.95, height=4.6, widest=0.5, stem=1.4),
            dict(radius=2.75, height=5.8, widest=0.66, stem=0.9),
            dict(radius=2.6, height=4.9, widest=0.56, stem=1.2, leaf=2.6),
        ),
    ),
    "banana": Kind(
        food.banana,
        hue=0.15,
        saturation=0.75,
        variants=(
            dict(bend_radius=7.0, half_angle=0.85, thickness=3.2, tip=0.35),
            dict(bend_radius=9.5, half_angle=0.7, thickness=3.0, tip=0.3),
            dict(bend_radius=5.5, half_angle=0.95, thickness=3.3, tip=0.4),
            dict(bend_radius=6.0, half_angle=1.05, thickness=2.7, tip=0.35),
        ),
    ),
    "boot": Kind(
        belongings.boot,
        hue=0.07,
        saturation=0.6,
        variants=(
            dict(length=7.4, width=4.0, height=7.4, shaft=4.3, heel=0.9),
            dict(length=6.9, width=3.9, height=7.6, shaft=4.1, heel=0.8),
            dict(length=7.5, width=4.0, height=5.6, shaft=4.2, heel=0.7),
            dict(length=7.3, width=3.6, height=6.9, shaft=3.8, heel=1.5),
        ),
    ),
    "bottle": Kind(
        containers.bottle,
        hue=0.38,
        saturation=0.6,
        variants=(
            dict(length=13.0, radius=1.95, body=6.5, shoulder=1.8, neck_radius=0.7),
            dict(length=11.0, radius=1.9, body=7.6, shoulder=1.6, neck_radius=0.9, waist=0.78),
            dict(length=10.0, radius=2.1, body=6.2, shoulder=0.8, neck_radius=0.95),
            dict(length=14.0, radius=1.8, body=6.0, shoulder=4.2, neck_radius=0.6),
        ),
    ),
    "camera": Kind(
        belongings.camera,
        hue=0.6,
        saturation=0.15,
        variants=(
            dict(width=8.2, height=4.8, depth=2.8, lens_radius=1.9, lens=2.2, prism=0.9),
            dict(width=7.4, height=5.0, depth=2.6, lens_radius=1.5, lens=1.4, prism=0.0),
            dict(width=7.8, height=4.6, depth=3.0, lens_radius=2.0, lens=3.2, prism=1.2),
            dict(width=7.0, height=5.6, depth=3.4, lens_radius=1.7, lens=1.8, prism=0.7),
        ),
    ),
    "can": Kind(
        containers.can,
        hue=0.57,
        saturation=0.65,
        variants=(
            dict(radius=2.65, height=8.0, top_radius=2.1),
            dict(radius=2.65, height=7.0, top_radius=2.65, rim=0.15),
            dict(radius=3.0, height=3.9, top_radius=3.0, rim=0.15),
            dict(radius=2.3, height=7.9, top_radius=1.1, nozzle=1.2),
        ),
    ),
    "car": Kind(
        belongings.car,
        hue=0.02,
        saturation=0.8,
        variants=(
            dict(
                length=8.7,
                width=4.1,
                wheel=0.95,
                belt=2.5,
                roof=3.9,
                cabin=(0.1, 0.25, 0.55, 0.72),
                nose=2.1,
            ),
            dict(
                length=8.4,
                width=4.0,
                wheel=0.9,
                belt=3.0,
                roof=4.9,
                cabin=(0.01, 0.03, 0.78, 0.9),
                nose=2.5,
            ),
            dict(
                length=8.9,
                width=4.0,
                wheel=1.1,
                belt=2.6,
                roof=4.4,
                cabin=(0.45, 0.48, 0.66, 0.76),
                nose=2.4,
            ),
            dict(
                length=9.0,
                width=4.2,
                wheel=1.05,
                belt=2.2,
                roof=3.3,
                cabin=(0.3, 0.4, 0.5, 0.64),
                nose=1.4,
            ),
        ),
    ),
    "carrot": Kind(
        food.carrot,
        hue=0.075,
        saturation=0.9,
        variants=(
            dict(length=11.0, radius=1.6, blunt=0.2, leaves=2.0),
            dict(length=7.6, radius=1.9, blunt=0.6, leaves=1.8),
            dict(length=13.0, radius=1.4, blunt=0.1, leaves=1.6),
            dict(length=8.4, radius=1.6, blunt=0.8, leaves=2.2),
        ),
    ),
    "carton": Kind(
        containers.carton,
        hue=0.55,
        saturation=0.3,
        variants=(
            dict(depth=4.6, width=4.6, height=6.4, roof=1.8, fin=0.9),
            dict(depth=5.0, width=5.0, height=4.4, roof=1.8, fin=0.9),
            dict(depth=4.4, width=5.0, height=6.4, roof=2.4, fin=0.6, cap=0.8),
            dict(depth=3.8, width=5.0, height=7.6, roof=0.0, fin=0.0, straw=1.4),
        ),
    ),
    "croissant": Kind(
        food.croissant,
        hue=0.1,
        saturation=0.65,
        variants=(
            dict(bend_radius=4.2, half_angle=1.35, thickness=3.6, flat=0.95),
            dict(bend_radius=5.0, half_angle=1.05, thickness=3.2, flat=1.0),
            dict(bend_radius=3.7, half_angle=1.55, thickness=3.1, flat=1.0),
            dict(bend_radius=5.8, half_angle=0.9, thickness=3.8, flat=0.85),
        ),
    ),
    "donut": Kind(
        food.donut,
        hue=0.9,
        saturation=0.45,
        variants=(
            dict(radius=2.1, tube=1.1, height=2.2),
            dict(radius=2.25, tube=0.85, height=1.8),
            dict(radius=1.9, tube=1.3, height=2.6),
            dict(radius=2.05, tube=1.05, height=2.9),
        ),
    ),
    "duck": Kind(
        belongings.duck,
        hue=0.14,
        saturation=0.85,
        variants=(
            dict(length=6.9, width=4.7, body=3.6, head_radius=1.6, height=5.9, beak=1.1),
            dict(length=7.6, width=4.6, body=3.2, head_radius=1.35, height=5.6, beak=1.3),
            dict(length=6.4, width=5.0, body=4.2, head_radius=1.95, height=6.9, beak=1.0),
            dict(length=7.2, width=4.7, body=3.6, head_radius=1.5, height=5.3, beak=0.9),
        ),
    ),
    "egg": Kind(
        food.egg,
        hue=0.09,
        saturation=0.25,
        variants=(
            dict(length=6.6, radius=2.55, taper=0.12),
            dict(length=6.2, radius=2.6, taper=0.2),
            dict(length=7.6, radius=2.4, taper=0.05),
            dict(length=6.8, radius=2.5, taper=0.26),
        ),
    ),
    "flashlight": Kind(
        tools.flashlight,
        hue=0.72,
        saturation=0.45,
        variants=(
            dict(length=12.0, radius=1.4, head_radius=2.0, head=3.4, flare=0.5),
            dict(length=13.5, radius=1.3, head_radius=1.8, head=2.4, flare=0.3),
            dict(length=10.0, radius=1.5, head_radius=2.3, head=3.0, flare=0.8),
            dict(length=9.0, radius=1.6, head_radius=1.95, head=2.6, flare=0.2),
        ),
    ),
    "hammer": Kind(
        tools.hammer,
        hue=0.08,
        saturation=0.5,
        variants=(
            dict(length=15.0, handle_radius=0.8, head_width=6.4, head_radius=1.2, face=0.7),
            dict(
                length=14.0, handle_radius=0.8, head_width=5.2, head_radius=1.2, face=0.85, sides=4
            ),
            dict(
                length=16.8, handle_radius=0.85, head_width=6.8, head_radius=1.3, face=0.75, sides=8
            ),
            dict(
                length=12.5, handle_radius=0.7, head_width=5.6, head_radius=1.3, face=0.9, rim=0.25
            ),
        ),
    ),
    "mug": Kind(
        containers.mug,
        hue=0.62,
        saturation=0.55,
        variants=(
            dict(radius=2.9, base_radius=2.9, height=6.8, reach=2.4),
            dict(radius=2.9, base_radius=2.2, height=7.9, reach=2.4),
            dict(radius=2.95, base_radius=2.6, height=5.4, reach=2.6),
            dict(radius=2.45, base_radius=2.65, height=7.2, reach=2.6),
        ),
    ),
    "pear": Kind(
        food.pear,
        hue=0.22,
        saturation=0.65,
        variants=(
            dict(radius=2.6, length=8.0, neck_radius=1.5, stem=1.2),
            dict(radius=2.75, length=7.0, neck_radius=1.4, stem=1.6),
            dict(radius=2.4, length=8.6, neck_radius=1.3, stem=1.0),
            dict(radius=2.75, length=8.0, neck_radius=1.9, stem=0.9),
        ),
    ),
    "screwdriver": Kind(
        tools.screwdriver,
        hue=0.0,
        saturation=0.7,
        variants=(
            dict(length=14.0, handle=7.0, radius=1.3, shaft=0.4, blade=1.0),
            dict(length=9.0, handle=5.6, radius=1.6, shaft=0.5, blade=1.2),
            dict(length=13.0, handle=6.6, radius=0.85, shaft=0.3, blade=0.7),
            dict(length=15.0, handle=7.6, radius=1.2, shaft=0.45, blade=1.3),
        ),
    ),
    "wrench": Kind(
        tools.wrench,
        hue=0.58,
        saturation=0.12,
        variants=(
            dict(length=14.5, width=1.9, thickness=1.45, jaw=2.0, small_jaw=1.6),
            dict(length=13.0, width=1.8, thickness=1.5, jaw=1.7, ring_radius=1.7),
            dict(length=11.5, width=1.5, thickness=1.6, jaw=1.7, small_jaw=1.7),
            dict(length=16.5, width=1.4, thickness=1.6, jaw=2.1, ring_radius=1.3),
        ),
    ),
}
