"""Block Pushing: push a cube to a goal area (appendix of the paper, simulation tasks)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from equirl.envs.objects import ObjectSet
from equirl.envs.scene import Area, Scene
from equirl.envs.tasks.base import State
from equirl.envs.tasks.block_task import BlockTask


@dataclass(frozen=True, kw_only=True)
class BlockPushing(BlockTask):
    """A cube lies in the bin beside a goal area; success is the cube in it, not held.

    Attributes:
        goal_side: side of the goal area, m.
        goal_raise: height added to the goal area in the depth image, m.
        goal_half_width: the goal's centre is drawn within +-this of the bin's, m.
        goal_distance: least distance from the cube's centre to the goal's at the start, m.
        reach: greatest distance of the two centres, in x and y, that is a success, m.
        max_height: the cube's centre must be below this, m.
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

    def sample(self, rng: np.random.Generator, home: Scene) -> Scene:
        """Draws the cube's x, y and yaw and the goal's x and y."""
        cube, goal = self.sample_apart(rng, self.goal_half_width, self.goal_distance, "a goal")
        return replace(home, objects=cube[None], areas=np.array([[*goal, 0.0]]))

    def succeeded(self, state: State) -> bool:
        """Tells whether the cube lies in the goal area and is not held."""
        (cube,), (goal,) = state.scene.objects, state.scene.areas
        near = np.hypot(*(cube[:2] - goal[:2])) < self.reach
        return bool(near and cube[2] < self.max_height and state.held is None)
