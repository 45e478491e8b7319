"""What the audit compares, and how the numbers are shown."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["FLAGS", "QUANTITIES", "Quantity", "shown"]


@dataclass(frozen=True)
class Quantity:
    """Something that is compared.

    Attributes:
        key: A key of the environment's tensordict, or an entry of the scene behind it.
        error: What the numbers are.
        unit: What they are shown in; they are stored in m, rad or as a share.
        scale: From the stored unit to the shown one.
        tolerance: An excess over the noise that is no finding, after a step, in the stored unit; a
            tenth of it when nothing has moved yet.
    """

    key: str
    error: str
    unit: str
    scale: float
    tolerance: float

    @property
    def title(self) -> str:
        """What the tables call it."""
        return f"{self.key}, {self.error}, {self.unit}"

    def shown(self, value: float) -> str:
        """Returns ``value``, which is in the stored unit, as the tables have it."""
        return shown(self.scale * value)


#: What is compared, in the order of the table. The tolerances are chosen: that of ``position`` lies
#: between the errors of a step that were measured with the free hand, 0.001 mm, and with the arm,
#: 0.06 mm.
QUANTITIES = {
    quantity.key: quantity
    for quantity in (
        Quantity("depth", "differing pixels", "%", 1e2, 5e-3),
        Quantity("depth_mean", "mean difference", "mm", 1e3, math.inf),
        Quantity("depth_max", "largest difference", "mm", 1e3, math.inf),
        Quantity("holding", "differs", "%", 1e2, 2e-2),
        Quantity("reward", "differs", "%", 1e2, 2e-2),
        Quantity("terminated", "differs", "%", 1e2, 2e-2),
        Quantity("truncated", "differs", "%", 1e2, 2e-2),
        Quantity("position", "distance", "mm", 1e3, 2e-5),
        Quantity("yaw", "difference", "mrad", 1e3, 1e-4),
        Quantity("aperture", "difference", "mm", 1e3, 2e-5),
        Quantity("objects", "distance of the worst", "mm", 1e3, 1e-4),
    )
}
#: The keys of which two plays differ or do not.
FLAGS = ("holding", "reward", "terminated", "truncated")


def shown(value: float) -> str:
    """Returns an error as the tables have it: two digits, a bound if small, "-" for nan."""
    if math.isnan(value):
        return "-"
    return "<0.001" if 0 < value < 1e-3 else f"{float(f'{value:.2g}'):g}"
