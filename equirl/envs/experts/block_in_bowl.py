"""Planner for Block in Bowl: grasp the cube from above, carry it over the bowl, let go."""

from __future__ import annotations

import numpy as np

from equirl.envs.experts.base import CLOSED, NARROW, OPEN, Expert, box_yaw, nearest_symmetric_yaw
from equirl.envs.scene import Scene


class BlockInBowlExpert(Expert):
    """Stateless: the way-point follows from the state, so what fails is tried again."""

    _above = 0.10  # m over the cube, and over the bowl
    _near = 0.012  # m, what counts as being at a way-point
    _over_bowl = 0.03  # m, where the cube would fall into it

    def plan(self, scene: Scene, held: int | None) -> np.ndarray:
        """Returns the action for a state, shape (5,)."""
        cube, bowl = scene.objects
        if held == 0:
            return self._carry(scene, bowl)
        inside = np.hypot(*(cube[:2] - bowl[:2])) < self._over_bowl
        if scene.aperture < NARROW or inside:
            return np.array([OPEN, 0.0, 0.0, 1.0, 0.0])
        yaw = nearest_symmetric_yaw(box_yaw(cube[3:]), scene.yaw, np.pi / 2)
        apart = np.hypot(*(scene.position[:2] - cube[:2]))
        if apart < self._near and abs(scene.yaw - yaw) < 0.1:
            return self._toward(scene, cube[:3], yaw, gripper=OPEN, arrived=CLOSED)
        above = cube[:3] + (0, 0, self._above)
        return self._toward(scene, above, yaw, gripper=OPEN, arrived=OPEN)

    def _carry(self, scene: Scene, bowl: np.ndarray) -> np.ndarray:
        above = bowl[:3] + (0, 0, self._above)
        low = scene.position[2] < above[2] - self._near
        if low and np.hypot(*(scene.position[:2] - above[:2])) > self._over_bowl:
            above[:2] = scene.position[:2]  # first up, then across
            return self._toward(scene, above, scene.yaw, gripper=CLOSED, arrived=CLOSED)
        return self._toward(scene, above, scene.yaw, gripper=CLOSED, arrived=OPEN)
