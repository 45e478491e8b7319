"""What the planners share: way-points turned into actions."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from equirl.envs.manipulation import ManipulationEnv
from equirl.envs.scene import Scene

OPEN, HALF_OPEN, CLOSED = 1.0, 0.0, -1.0
# A gripper narrower than this (m) has not come to grasp: the diagonal of the 5 cm cube is 0.071 m.
NARROW = 0.072


class Expert(TensorDictModuleBase):
    """A policy that reads the state of its environment and writes ``action``.

    Args:
        env: the environment it acts in.
        horizontal_clip: ``"norm"`` or ``"box"``, see `equirl.envs.make_expert`.
        grasp: ``"random"`` or ``"aligned"``, see `equirl.envs.make_expert`.
    """

    def __init__(self, env: ManipulationEnv, horizontal_clip: str, grasp: str):
        super().__init__()
        self.in_keys = ["depth", "holding"]
        self.out_keys = ["action"]
        # In a list, or torch would register the environment as a sub-module.
        self._env = [env]
        self._horizontal_clip = horizontal_clip
        self._grasp = grasp
        self._episode: int | None = None

    @abstractmethod
    def plan(self, scene: Scene, held: int | None) -> np.ndarray:
        """Returns the action for a state, shape (5,)."""

    def begin(self, rng: np.random.Generator) -> None:
        """Forgets the last episode; ``rng`` serves all draws of the new one."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` (5,) for the present state of the environment."""
        (env,) = self._env
        if self._episode != env.episodes_begun:
            self._episode = env.episodes_begun
            self.begin(np.random.default_rng(env.episode_seed))
        action = self.plan(env.get_scene(), env.held_object())
        return tensordict.set("action", torch.tensor(action, dtype=torch.float32))

    def _toward(
        self, scene: Scene, position: np.ndarray, yaw: float, gripper: float, arrived: float
    ) -> np.ndarray:
        """Returns the action that goes to a way-point as far as one action can.

        Args:
            scene: the present state.
            position: the way-point, shape (3,), m.
            yaw: yaw at the way-point, rad.
            gripper: gripper component on the way.
            arrived: gripper component of the action that lands on the way-point.

        Returns:
            The action, shape (5,).
        """
        (env,) = self._env
        space = env.workspace
        full = np.empty(4)
        full[:3] = (space.clip(position) - scene.position) / space.position_step
        full[3] = (yaw - scene.yaw) / space.yaw_step
        clipped = np.clip(full, -1, 1)
        if self._horizontal_clip == "norm":
            # A hair inside the disc, so that rounding to float32 stays within it.
            clipped[:2] = full[:2] / max(1.0, np.hypot(*full[:2]) * (1 + 1e-6))
        lands = np.allclose(clipped, full, atol=1e-2)
        return np.array([arrived if lands else gripper, *clipped])


def nearest_symmetric_yaw(yaw: float, reference: float, period: float) -> float:
    """Returns the angle nearest to ``reference`` among ``yaw`` + k ``period`` (rad)."""
    return yaw + period * np.round((reference - yaw) / period)


def box_yaw(quaternion: np.ndarray) -> float:
    """Returns the yaw (rad) of the most horizontal body axis of a box (qx, qy, qz, qw)."""
    axes = Rotation.from_quat(quaternion).as_matrix().T
    axis = axes[np.argmin(np.abs(axes[:, 2]))]
    return float(np.arctan2(axis[1], axis[0]))
