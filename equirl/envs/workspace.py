"""The numbers of the cell: workspace, bin, step sizes (paper, appendix on simulation)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["WORKSPACE", "Bin", "Workspace"]


@dataclass(frozen=True)
class Bin:
    """A square frustum: its floor is the workspace, its walls rise outwards (metres).

    Attributes:
        floor_half_width: Half the side of the floor, at height 0.
        rim_half_width: Half the side of the opening.
        rim_height: Height of the opening above the floor.
        floor_friction: Lateral friction of the floor.
        wall_friction: Lateral friction of the walls; none, so that objects slide back.
    """

    floor_half_width: float = 0.15
    rim_half_width: float = 0.225
    rim_height: float = 0.10
    floor_friction: float = 0.5
    wall_friction: float = 0.0


@dataclass(frozen=True)
class Workspace:
    """Where the end effector may go and how far one action takes it.

    The simulation's origin is the centre of the workspace in x and y, on the floor of the bin. A
    scene turned about the origin then has exactly turned coordinates, which is what makes the
    images of turned scenes bit-equal. In the frame of the paper, whose workspace is centred at
    x = 0.45 m, the arm stands at x = -0.10 m; here that is ``arm_base_x``.

    Attributes:
        half_width: The end effector stays within +-half_width in x and y (m).
        z_min: Lowest end effector height (m).
        z_max: Greatest end effector height (m).
        home_height: End effector height at the start of an episode, at x = y = yaw = 0 (m).
        position_step: Displacement along an axis for an action component of 1 (m).
        yaw_step: Rotation for an action component of 1 (rad).
        max_aperture: Distance between the open fingers (m).
        arm_base_x: X of the arm's base (m).
        bin: The bin.
    """

    half_width: float = 0.15
    z_min: float = 0.01
    z_max: float = 0.25
    home_height: float = 0.20
    position_step: float = 0.05
    yaw_step: float = np.pi / 4
    max_aperture: float = 0.08
    arm_base_x: float = -0.55
    bin: Bin = field(default_factory=Bin)

    def __str__(self) -> str:
        return (
            f"the workspace (x and y within ±{self.half_width} m, "
            f"z from {self.z_min} to {self.z_max} m)"
        )

    def clip(self, position: np.ndarray) -> np.ndarray:
        """Returns the point of the workspace nearest to ``position`` (shape (3,), m)."""
        width = self.half_width
        return np.clip(position, (-width, -width, self.z_min), (width, width, self.z_max))

    def contains(self, position: np.ndarray, margin: float = 0.0) -> bool:
        """Tells whether ``position`` (shape (3,), m) lies inside, walls moved out by ``margin``."""
        x, y, z = position
        return bool(
            max(abs(x), abs(y)) <= self.half_width + margin
            and self.z_min - margin <= z <= self.z_max + margin
        )


#: The cell of the paper: environments have it, and numbers of tasks are measured against it.
WORKSPACE = Workspace()
