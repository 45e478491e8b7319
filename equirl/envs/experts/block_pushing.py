"""Planner for Block Pushing: behind the cube, down, push to the goal."""

from __future__ import annotations

import numpy as np

from equirl.envs.experts.base import HALF_OPEN, Expert, nearest_symmetric_yaw
from equirl.envs.scene import Scene


class BlockPushingExpert(Expert):
    """Stateless: pushes along the line from the cube to the goal, and again until it is there."""

    _travel_height = 0.11  # m: the fingers clear the cube
    _push_height = 0.03  # m
    _behind = 0.08  # m from the cube's centre, where the push begins
    _short = 0.035  # m short of the goal, where it ends
    _near = 0.012  # m, what counts as being at a way-point
    _lane = 0.02  # m to either side of the line, where a push may go on

    def plan(self, scene: Scene, held: int | None) -> np.ndarray:
        """Returns the action for a state, shape (5,)."""
        (cube,), (goal,) = scene.objects, scene.areas
        line = goal[:2] - cube[:2]
        direction = line / max(np.hypot(*line), 1e-9)
        # Both fingers push: they separate across the line.
        yaw = np.arctan2(direction[1], direction[0]) + np.pi / 2
        yaw = nearest_symmetric_yaw(yaw, scene.yaw, np.pi)
        height = scene.position[2]
        (env,) = self._env
        start = env.workspace.clip(np.array([*(cube[:2] - self._behind * direction), height]))[:2]
        offset = scene.position[:2] - cube[:2]
        along, across = offset @ direction, offset @ (-direction[1], direction[0])
        low = height < (self._travel_height + self._push_height) / 2
        if low and along < 0 and abs(across) < self._lane:
            target = (*(goal[:2] - self._short * direction), self._push_height)
        elif low:
            target = (*scene.position[:2], self._travel_height)
        elif np.hypot(*(scene.position[:2] - start)) < self._near and abs(scene.yaw - yaw) < 0.1:
            target = (*start, self._push_height)
        else:
            target = (*start, self._travel_height)
        return self._toward(scene, np.array(target), yaw, gripper=HALF_OPEN, arrived=HALF_OPEN)
