"""Block in Bowl: put a cube into a bowl (appendix of the paper, simulation tasks)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from equirl.envs.action import CLOSED, OPEN, Action
from equirl.envs.expert import NARROW, NEAR, Expert, box_yaw, nearest_symmetric_yaw
from equirl.envs.objects import Body, ObjectSet, bowl
from equirl.envs.scene import Scene
from equirl.envs.tasks.base import State, lying
from equirl.envs.tasks.block_task import BlockTask

__all__ = ["BlockInBowl", "BlockInBowlExpert", "tilt"]


@dataclass(frozen=True, kw_only=True)
class BlockInBowl(BlockTask):
    """A cube and a bowl lie in the bin; success is the cube in the upright bowl, released.

    Attributes:
        bowl_width: Width of the bowl between opposite flats of its rim, m.
        bowl_height: M.
        bowl_mass: Kg.
        bowl_friction: Lateral friction.
        bowl_half_width: The bowl's centre is drawn within +-this of the bin's, m.
        bowl_distance: Least distance of the centres of cube and bowl at the start, m.
        reach: Greatest distance of the two centres, in x and y, that is a success, m.
        max_tilt: Greatest angle between the bowl's axis and the vertical, rad.
        require_release: Whether a cube that is still held is no success yet.
    """

    view: float = 0.45
    margin: float = 0.05
    bowl_width: float = 0.16
    bowl_height: float = 0.07
    bowl_mass: float = 0.1
    bowl_friction: float = 1.0
    bowl_half_width: float = 0.065
    bowl_distance: float = 0.17
    reach: float = 0.03
    max_tilt: float = np.pi / 9
    require_release: bool = True

    paper_options: ClassVar[Mapping[str, Any]] = {"require_release": False}

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("bowl_width", "bowl_height", "bowl_mass", "reach", "max_tilt")
        self.require_non_negative("bowl_friction", "bowl_half_width", "bowl_distance")
        self.require("require_release", isinstance(self.require_release, bool), "True or False")
        side, rim = self.cube_side, self.bowl_width / np.cos(np.pi / 8)
        self.require(
            "bowl_width",
            self.bowl_width > 2 * side,
            f"above {2 * side:g}, two sides of the cube (m)",
        )
        apart = (np.sqrt(2) * side + rim) / 2
        self.require(
            "bowl_distance",
            self.bowl_distance > apart,
            f"above {apart:.3f}, or cube and bowl would overlap (m)",
        )

    @cached_property
    def bowl(self) -> Body:
        """The bowl."""
        return bowl(self.bowl_width, self.bowl_height, self.bowl_mass, self.bowl_friction)

    @cached_property
    def bodies(self) -> ObjectSet:
        """The cube and the bowl."""
        return ObjectSet([self.cube, self.bowl], "Block in Bowl")

    @property
    def expert(self) -> type[Expert]:
        """Its planner."""
        return BlockInBowlExpert

    def sample(self, rng: np.random.Generator, home: Scene) -> Scene:
        """Draws the cube's x, y and yaw and the bowl's x and y."""
        cube, where = self.sample_apart(rng, self.bowl_half_width, self.bowl_distance, "a bowl")
        return replace(home, objects=np.stack((cube, lying(self.bowl, *where, yaw=0.0))))

    def succeeded(self, state: State) -> bool:
        """Tells whether the cube lies in the upright bowl and, if asked for, is released."""
        cube, bowl = state.scene.objects
        if self.require_release and state.held == 0:
            return False
        inside = np.hypot(*(cube[:2] - bowl[:2])) < self.reach
        return bool(inside and tilt(bowl[3:]) < self.max_tilt and state.touching(0, 1))


class BlockInBowlExpert(Expert):
    """Stateless: the way-point follows from the state, so what fails is tried again."""

    _above = 0.10  # m over the cube, and over the bowl, as in the paper's implementation

    @property
    def _reach(self) -> float:
        """Within this of the bowl's centre, in x and y, the cube is in it, or falls into it, m."""
        return self.env.task.reach  # type: ignore[attr-defined]  # of a `BlockInBowl`

    def plan(self, scene: Scene, held: int | None) -> Action:
        """Returns the action for a state."""
        cube, bowl = scene.objects
        if held == 0:
            return self._carry(scene, bowl)
        inside = np.hypot(*(cube[:2] - bowl[:2])) < self._reach
        if scene.aperture < NARROW or inside:
            return Action(OPEN, z=1.0)
        yaw = nearest_symmetric_yaw(box_yaw(cube[3:]), scene.yaw, np.pi / 2)
        if self.is_over(scene, cube[:2], yaw):
            return self.toward(scene, cube[:3], yaw, gripper=OPEN, arrived=CLOSED)
        above = cube[:3] + (0, 0, self._above)
        return self.toward(scene, above, yaw, gripper=OPEN, arrived=OPEN)

    def _carry(self, scene: Scene, bowl: np.ndarray) -> Action:
        above = bowl[:3] + (0, 0, self._above)
        low = scene.position[2] < above[2] - NEAR
        if low and np.hypot(*(scene.position[:2] - above[:2])) > self._reach:
            above[:2] = scene.position[:2]  # first up, then across
            return self.toward(scene, above, scene.yaw, gripper=CLOSED, arrived=CLOSED)
        return self.toward(scene, above, scene.yaw, gripper=CLOSED, arrived=OPEN)


def tilt(quaternion: np.ndarray) -> float:
    """Returns the angle (rad) between a body's z axis and the vertical."""
    x, y, _, _ = quaternion
    return float(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)))
