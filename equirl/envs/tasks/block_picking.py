"""Block Picking: grasp a cube and lift it (appendix of the paper, simulation tasks)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from equirl.envs.action import CLOSED, OPEN, Action
from equirl.envs.expert import NARROW, Expert, box_yaw, nearest_symmetric_yaw
from equirl.envs.objects import ObjectSet
from equirl.envs.scene import Scene
from equirl.envs.tasks.base import lying
from equirl.envs.tasks.block_task import BlockTask
from equirl.envs.tasks.lift_task import LiftTask

__all__ = ["BlockPicking", "BlockPickingExpert"]


@dataclass(frozen=True, kw_only=True)
class BlockPicking(LiftTask, BlockTask):
    """A cube lies in the bin; success is holding it with the gripper high enough."""

    @cached_property
    def bodies(self) -> ObjectSet:
        """The cube."""
        return ObjectSet([self.cube], "Block Picking")

    @property
    def expert(self) -> type[Expert]:
        """Its planner."""
        return BlockPickingExpert

    def sample(self, rng: np.random.Generator, home: Scene) -> Scene:
        """Draws the cube's x, y and yaw."""
        wide = np.array(self.start_range)
        pose = lying(self.cube, *rng.uniform(-wide, wide))
        return replace(home, objects=pose[None])


class BlockPickingExpert(Expert):
    """Stateless: the way-point follows from the state, so a failed grasp is tried again."""

    def plan(self, scene: Scene, held: int | None) -> Action:
        """Returns the action for a state."""
        cube = scene.objects[0]
        if held is not None:
            return Action(CLOSED, z=1.0)
        if scene.aperture < NARROW:
            return Action(OPEN, z=1.0)
        # A quarter turn leaves the cube as it is (and a half turn the gripper).
        yaw = nearest_symmetric_yaw(box_yaw(cube[3:]), scene.yaw, np.pi / 2)
        return self.toward(scene, cube[:3], yaw, gripper=OPEN, arrived=CLOSED)
