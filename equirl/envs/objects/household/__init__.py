"""Seventy-six household objects, generated from the numbers in `kinds`."""

from __future__ import annotations

import colorsys
from functools import lru_cache

from equirl.envs.objects.bodies import Body
from equirl.envs.objects.household.kinds import KINDS, Kind
from equirl.envs.objects.object_set import FRICTION, HOUSEHOLD_ROLLING, MASS, ObjectSet

__all__ = ["KINDS", "Kind", "household_objects"]

_METRES = 0.01  # of a centimetre


@lru_cache(maxsize=1)
def household_objects() -> ObjectSet:
    """Returns the set of 76 objects: 19 kinds with 4 variants each, ``mug_0`` to ``mug_3``.

    Each object rests stably on its +z side up and equals its own reflection in y = 0 of its frame.
    """
    bodies = [
        _body(name, kind, variant)
        for name, kind in KINDS.items()
        for variant in range(len(kind.variants))
    ]
    return ObjectSet(bodies, "the household objects")


def _body(name: str, kind: Kind, variant: int) -> Body:
    pieces = [piece.scaled(_METRES) for piece in kind.generate(**kind.variants[variant])]
    red, green, blue = colorsys.hsv_to_rgb(kind.hue, kind.saturation, 0.95 - 0.09 * variant)
    return Body.centred(
        pieces,
        mass=MASS,
        friction=FRICTION,
        name=f"{name}_{variant}",
        rolling_friction=HOUSEHOLD_ROLLING,
        color=(red, green, blue, 1.0),
    )
