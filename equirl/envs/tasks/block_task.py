"""What the tasks with a cube share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from equirl.envs.objects import Body, cube
from equirl.envs.tasks.base import Task, lying, rejection_sample
from equirl.envs.workspace import WORKSPACE

__all__ = ["BlockTask"]


@dataclass(frozen=True, kw_only=True)
class BlockTask(Task):
    """A task with a cube that lies somewhere in the bin.

    Attributes:
        cube_side: M.
        cube_mass: Kg.
        cube_friction: Lateral friction.
    """

    cube_side: float = 0.05
    cube_mass: float = 0.1
    cube_friction: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("cube_side", "cube_mass")
        self.require_non_negative("cube_friction")
        self.require_below("cube_side", WORKSPACE.max_aperture, "the opening of the gripper (m)")

    @cached_property
    def cube(self) -> Body:
        """The cube."""
        return cube(self.cube_side, self.cube_mass, self.cube_friction)

    @property
    def start_range(self) -> tuple[float, float, float]:
        """Half widths of the ranges of the cube's x, y (m) and yaw (rad)."""
        return (self.start_half_width, self.start_half_width, self.start_yaw)

    def sample_apart(
        self, rng: np.random.Generator, half_width: float, distance: float, what: str
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draws the cube's pose and a point at a distance from it.

        Args:
            rng: The only source of randomness.
            half_width: The point is drawn within +-this, m.
            distance: The least distance of cube and point, m.
            what: What the point is, for the message.

        Returns:
            The cube's pose, shape (7,), and the point's x and y, shape (2,), m.

        Raises:
            PlacementError: If they do not fit.
        """
        drawn = rejection_sample(
            rng,
            (*self.start_range, half_width, half_width),
            lambda points: np.hypot(*(points[:, :2] - points[:, 3:]).T) >= distance,
            self.placement_tries,
            f"{what} within ±{half_width} m, at least {distance} m from a cube within "
            f"±{self.start_half_width} m",
        )
        return lying(self.cube, *drawn[:3]), drawn[3:]
