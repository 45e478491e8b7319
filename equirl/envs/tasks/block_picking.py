"""Block Picking: grasp a cube and lift it (appendix of the paper, simulation tasks)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from equirl.envs.objects import cube
from equirl.envs.scene import Scene
from equirl.envs.tasks.base import Task


class BlockPicking(Task):
    """A cube of 5 cm lies in the bin; success is holding it with the gripper above 0.15 m."""

    view = 0.30
    margin = 0.0
    cube_side = 0.05
    start_half_width = 0.09
    lift_height = 0.15

    def __init__(self) -> None:
        self.bodies = (cube(self.cube_side, mass=0.1, friction=1.0),)

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Draws the cube's x, y and yaw."""
        x, y = rng.uniform(-self.start_half_width, self.start_half_width, size=2)
        orientation = Rotation.from_euler("z", rng.uniform(-np.pi / 4, np.pi / 4)).as_quat()
        return np.array([[x, y, self.cube_side / 2, *orientation]])

    def succeeded(self, scene: Scene, held: int | None) -> bool:
        """Tells whether the cube is held high enough."""
        return held is not None and scene.position[2] > self.lift_height
