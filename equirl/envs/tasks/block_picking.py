"""Block Picking: grasp a cube and lift it (appendix of the paper, simulation tasks)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from equirl.envs.expert import CLOSED, NARROW, OPEN, Expert, box_yaw, nearest_symmetric_yaw
from equirl.envs.objects import ObjectSet
from equirl.envs.scene import Scene
from equirl.envs.tasks.base import WORKSPACE, State, lying
from equirl.envs.tasks.block_task import BlockTask

__all__ = ["BlockPicking", "BlockPickingExpert"]


@dataclass(frozen=True, kw_only=True)
class BlockPicking(BlockTask):
    """A cube lies in the bin; success is holding it with the gripper high enough.

    Attributes:
        lift_height: The end effector must be above this, m.
    """

    lift_height: float = 0.15

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("lift_height")
        self.require_below("lift_height", WORKSPACE.z_max, "the top of the workspace (m)")

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

    def succeeded(self, state: State) -> bool:
        """Tells whether the cube is held high enough."""
        return state.held is not None and state.scene.position[2] > self.lift_height


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
        return self.toward(scene, cube[:3], yaw, gripper=OPEN, arrived=CLOSED)
