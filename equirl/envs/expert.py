"""Scripted planners that solve the tasks from the simulator's state: what they share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from equirl.envs.scene import Scene

if TYPE_CHECKING:
    from equirl.envs.manipulation import ManipulationEnv

__all__ = ["CLOSED", "HALF_OPEN", "NARROW", "OPEN", "Expert", "box_yaw", "nearest_symmetric_yaw"]

OPEN, HALF_OPEN, CLOSED = 1.0, 0.0, -1.0
# A gripper narrower than this (m) has not come to grasp: the diagonal of the 5 cm cube is 0.071 m.
NARROW = 0.072


class Expert(TensorDictModuleBase):
    """A policy that reads the state of its environment and writes ``action``.

    A planner is a class with `plan`, in the file of its task (`Task.expert`); see
    `equirl.envs.make_expert`.

    Args:
        env: The environment it acts in.
        options: A value for any of the names in `CHOICES`.

    Raises:
        ValueError: On another name or value.
    """

    #: What can be chosen, by name: the values, the default first. ``horizontal_clip`` is how a
    #: displacement in x and y is limited to one action: ``"norm"`` keeps its direction, so that
    #: (x, y) lies in the unit disc; ``"box"`` clips each component, as in the paper.
    CHOICES: ClassVar[Mapping[str, tuple[str, ...]]] = {"horizontal_clip": ("norm", "box")}

    def __init__(self, env: ManipulationEnv, **options: str):
        super().__init__()
        self.in_keys = ["depth", "holding"]
        self.out_keys = ["action"]
        self.options = self.resolve(options)
        # In a list, or torch would register the environment as a sub-module.
        self._env = [env]
        self._episode: int | None = None

    @classmethod
    def resolve(cls, options: Mapping[str, str]) -> dict[str, str]:
        """Returns a value for every name in `CHOICES`: the option's, or the default.

        Raises:
            ValueError: On a name or value that is not among them.
        """
        for name, value in options.items():
            if name not in cls.CHOICES:
                raise ValueError(
                    f"{cls.__name__} has no option {name}; its options: {', '.join(cls.CHOICES)}"
                )
            if value not in cls.CHOICES[name]:
                allowed = " or ".join(map(repr, cls.CHOICES[name]))
                raise ValueError(f"{name} must be {allowed}, got {value!r}")
        return {name: values[0] for name, values in cls.CHOICES.items()} | dict(options)

    @property
    def env(self) -> ManipulationEnv:
        """The environment it acts in."""
        return self._env[0]

    @abstractmethod
    def plan(self, scene: Scene, held: int | None) -> np.ndarray:
        """Returns the action for a state, shape (5,)."""

    def begin(self, rng: np.random.Generator) -> None:
        """Forgets the last episode; ``rng`` serves all draws of the new one."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` (5,) for the present state of the environment."""
        env = self.env
        if self._episode != env.episodes_begun:
            self._episode = env.episodes_begun
            self.begin(np.random.default_rng(env.episode_seed))
        action = self.plan(env.get_scene(), env.held_object())
        return tensordict.set("action", torch.tensor(action, dtype=torch.float32))

    def toward(
        self, scene: Scene, position: np.ndarray, yaw: float, gripper: float, arrived: float
    ) -> np.ndarray:
        """Returns the action that goes to a way-point as far as one action can.

        Args:
            scene: The present state.
            position: The way-point, shape (3,), m.
            yaw: Yaw at the way-point, rad.
            gripper: Gripper component on the way.
            arrived: Gripper component of the action that lands on the way-point.

        Returns:
            The action, shape (5,).
        """
        space = self.env.workspace
        full = np.empty(4)
        full[:3] = (space.clip(position) - scene.position) / space.position_step
        full[3] = (yaw - scene.yaw) / space.yaw_step
        clipped = np.clip(full, -1, 1)
        if self.options["horizontal_clip"] == "norm":
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
