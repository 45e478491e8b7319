"""PyBullet: the simulation behind `equirl.envs`, and the only importer of that library."""

from equirl.envs.bullet.camera import Camera
from equirl.envs.bullet.models import ROBOTS
from equirl.envs.bullet.simulation import Simulation

__all__ = ["ROBOTS", "Camera", "Simulation"]
