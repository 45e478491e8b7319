"""What the five numbers of an action mean."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from equirl.envs.workspace import Workspace

__all__ = ["CLOSED", "HALF_OPEN", "OPEN", "Action"]

#: Values of the gripper component.
OPEN, HALF_OPEN, CLOSED = 1.0, 0.0, -1.0


class Action(NamedTuple):
    """An action, in the order of the key ``action``; each number is in [-1, 1].

    ``Action(*values)`` names the numbers of an array (5,); ``Action(CLOSED, z=1.0)`` closes the
    gripper and lifts it as far as one action can.

    Attributes:
        gripper: What the fingers are driven to: -1 is closed, 1 is open.
        x: Displacement along world x, in steps of the workspace.
        y: Along world y.
        z: Upwards.
        theta: Rotation about the vertical, from x to y, in steps of the workspace.
    """

    gripper: float
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    theta: float = 0.0

    @classmethod
    def moving(
        cls, displacement: np.ndarray, turn: float, gripper: float, space: Workspace
    ) -> Action:
        """Returns the action of a displacement (3,), m, and a turn, rad, however far they are."""
        x, y, z = displacement / space.position_step
        return cls(gripper, x, y, z, turn / space.yaw_step)

    def displacement(self, space: Workspace) -> np.ndarray:
        """Returns how far the end effector is sent, before clipping to ``space``; (3,), m."""
        return space.position_step * np.array([self.x, self.y, self.z])

    def turn(self, space: Workspace) -> float:
        """Returns how far the end effector is turned about the vertical, rad."""
        return space.yaw_step * self.theta

    def aperture(self, space: Workspace) -> float:
        """Returns the distance between the fingers that they are driven to, m."""
        return space.max_aperture * (self.gripper + 1) / 2
