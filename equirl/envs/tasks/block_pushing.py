"""Block Pushing: push a cube to a goal area (appendix of the paper, simulation tasks)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from equirl.envs.action import HALF_OPEN, Action
from equirl.envs.expert import Expert, nearest_symmetric_yaw
from equirl.envs.objects import ObjectSet
from equirl.envs.scene import Area, Scene
from equirl.envs.tasks.base import State
from equirl.envs.tasks.block_task import BlockTask

__all__ = ["BlockPushing", "BlockPushingExpert"]


@dataclass(frozen=True, kw_only=True)
class BlockPushing(BlockTask):
    """A cube lies in the bin beside a goal area; success is the cube in it, not held.

    Attributes:
        goal_side: Side of the goal area, m.
        goal_raise: Height added to the goal area in the depth image, m.
        goal_half_width: The goal's centre is drawn within +-this of the bin's, m.
        goal_distance: Least distance from the cube's centre to the goal's at the start, m.
        reach: Greatest distance of the two centres, in x and y, that is a success, m.
        max_height: The cube's centre must be below this, m.
    """

    view: float = 0.45
    margin: float = 0.05
    goal_side: float = 0.09
    goal_raise: float = 0.02
    goal_half_width: float = 0.085
    goal_distance: float = 0.09
    reach: float = 0.05
    max_height: float = 0.03

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("goal_side", "reach", "max_height")
        self.require_non_negative("goal_raise", "goal_half_width", "goal_distance")
        lying = self.cube_side / 2
        self.require(
            "max_height",
            self.max_height > lying,
            f"above {lying:g}, the height of a lying cube's centre (m)",
        )

    @cached_property
    def bodies(self) -> ObjectSet:
        """The cube."""
        return ObjectSet([self.cube], "Block Pushing")

    @cached_property
    def areas(self) -> tuple[Area, ...]:  # type: ignore[override]
        """The goal."""
        return (Area(self.goal_side, self.goal_raise),)

    @property
    def expert(self) -> type[Expert]:
        """Its planner."""
        return BlockPushingExpert

    def sample(self, rng: np.random.Generator, home: Scene) -> Scene:
        """Draws the cube's x, y and yaw and the goal's x and y."""
        cube, goal = self.sample_apart(rng, self.goal_half_width, self.goal_distance, "a goal")
        return replace(home, objects=cube[None], areas=np.array([[*goal, 0.0]]))

    def succeeded(self, state: State) -> bool:
        """Tells whether the cube lies in the goal area and is not held."""
        (cube,), (goal,) = state.scene.objects, state.scene.areas
        near = np.hypot(*(cube[:2] - goal[:2])) < self.reach
        return bool(near and cube[2] < self.max_height and state.held is None)


class BlockPushingExpert(Expert):
    """Stateless: pushes along the line from the cube to the goal, and again until it is there."""

    # The paper's implementation has the first four (m).
    _travel_height = 0.11  # the fingers clear the cube
    _push_height = 0.03
    _behind = 0.08  # from the cube's centre, where the push begins
    _short = 0.035  # of the goal, where it ends
    _lane = 0.02  # m to either side of the line, where a push may go on; chosen: in the cube's face

    def plan(self, scene: Scene, held: int | None) -> Action:
        """Returns the action for a state."""
        (cube,), (goal,) = scene.objects, scene.areas
        line = goal[:2] - cube[:2]
        direction = line / max(np.hypot(*line), 1e-9)
        # Both fingers push: they separate across the line.
        yaw = np.arctan2(direction[1], direction[0]) + np.pi / 2
        yaw = nearest_symmetric_yaw(yaw, scene.yaw, np.pi)
        height = scene.position[2]
        behind = np.array([*(cube[:2] - self._behind * direction), height])
        start = self.env.workspace.clip(behind)[:2]
        offset = scene.position[:2] - cube[:2]
        along, across = offset @ direction, offset @ (-direction[1], direction[0])
        low = height < (self._travel_height + self._push_height) / 2
        if low and along < 0 and abs(across) < self._lane:
            target = (*(goal[:2] - self._short * direction), self._push_height)
        elif low:
            target = (*scene.position[:2], self._travel_height)
        elif self.is_over(scene, start, yaw):
            target = (*start, self._push_height)
        else:
            target = (*start, self._travel_height)
        return self.toward(scene, np.array(target), yaw, gripper=HALF_OPEN, arrived=HALF_OPEN)
