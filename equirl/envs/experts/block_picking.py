"""Planner for Block Picking: to the cube, close on arrival, lift."""

from __future__ import annotations

import numpy as np

from equirl.envs.experts.base import CLOSED, NARROW, OPEN, Expert, box_yaw, nearest_symmetric_yaw
from equirl.envs.scene import Scene


class BlockPickingExpert(Expert):
    """Stateless: the way-point follows from the state, so a failed grasp is tried again."""

    def plan(self, scene: Scene, held: int | None) -> np.ndarray:
        """Returns the action for a state, shape (5,)."""
        cube = scene.objects[0]
        if held is not None:
            return np.array([CLOSED, 0.0, 0.0, 1.0, 0.0])
        if scene.aperture < NARROW:
            return np.array([OPEN, 0.0, 0.0, 1.0, 0.0])
        # A quarter turn leaves the cube as it is (and a half turn the gripper).
        yaw = nearest_symmetric_yaw(box_yaw(cube[3:]), scene.yaw, np.pi / 2)
        return self._toward(scene, cube[:3], yaw, gripper=OPEN, arrived=CLOSED)
