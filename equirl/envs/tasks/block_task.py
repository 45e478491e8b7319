"""What the tasks with a cube share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from equirl.envs.objects import Body, cube
from equirl.envs.tasks.base import Task, lying


@dataclass(frozen=True, kw_only=True)
class BlockTask(Task):
    """A task with a cube that lies somewhere in the bin.

    Attributes:
        cube_side: m.
        cube_mass: kg.
        cube_friction: lateral friction.
        start_yaw: the cube's yaw is drawn within +-this, rad.
    """

    cube_side: float = 0.05
    cube_mass: float = 0.1
    cube_friction: float = 1.0
    start_yaw: float = np.pi / 4

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("cube_side", "cube_mass")
        self.require_non_negative("cube_friction", "start_yaw")

    @cached_property
    def cube(self) -> Body:
        """The cube."""
        return cube(self.cube_side, self.cube_mass, self.cube_friction)

    def sample_cube(self, rng: np.random.Generator) -> np.ndarray:
        """Draws the cube's pose, shape (7,)."""
        x, y = rng.uniform(-self.start_half_width, self.start_half_width, size=2)
        return lying(self.cube, x, y, rng.uniform(-self.start_yaw, self.start_yaw))
