"""Simulated manipulation as TorchRL environments, with scripted experts."""

from equirl.envs.action import Action
from equirl.envs.bullet import ROBOTS
from equirl.envs.factory import make_env, make_expert
from equirl.envs.manipulation import ManipulationEnv
from equirl.envs.parallel import WorkerError, make_parallel_env
from equirl.envs.scene import Scene
from equirl.envs.tasks import PlacementError

__all__ = [
    "ROBOTS",
    "Action",
    "ManipulationEnv",
    "PlacementError",
    "Scene",
    "WorkerError",
    "make_env",
    "make_expert",
    "make_parallel_env",
]
