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

from equirl.envs.action import Action
from equirl.envs.scene import Scene

if TYPE_CHECKING:
    from equirl.envs.manipulation import ManipulationEnv

__all__ = ["NARROW", "NEAR", "Expert", "box_yaw", "nearest_symmetric_yaw"]

# A gripper narrower than this (m) has not come to grasp: the diagonal of the 5 cm cube is 0.071 m.
NARROW = 0.072
# Within this (m, rad) the gripper counts as being at a way-point. Chosen: over the 5 cm cube, each
# finger of the open gripper has 15 mm to spare.
NEAR, _NEAR_YAW = 0.012, 0.1


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
    def plan(self, scene: Scene, held: int | None) -> Action:
        """Returns the action for a state."""

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

    def is_over(self, scene: Scene, place: np.ndarray, yaw: float) -> bool:
        """Tells whether the gripper is over a way-point (x, y), m, with its ``yaw``, rad."""
        apart = np.hypot(*(scene.position[:2] - place))
        return bool(apart < NEAR and abs(scene.yaw - yaw) < _NEAR_YAW)

    def toward(
        self, scene: Scene, position: np.ndarray, yaw: float, gripper: float, arrived: float
    ) -> Action:
        """Returns the action that goes to a way-point as far as one action can.

        Args:
            scene: The present state.
            position: The way-point, shape (3,), m.
            yaw: Yaw at the way-point, rad.
            gripper: Gripper component on the way.
            arrived: Gripper component of the action that lands on the way-point.
        """
        space = self.env.workspace
        way = space.clip(position) - scene.position
        full = np.array(Action.moving(way, yaw - scene.yaw, gripper, space)[1:])
        clipped = np.clip(full, -1, 1)
        if self.options["horizontal_clip"] == "norm":
            # A hair inside the disc, so that rounding to float32 stays within it.
            clipped[:2] = full[:2] / max(1.0, np.hypot(*full[:2]) * (1 + 1e-6))
        lands = np.allclose(clipped, full, atol=1e-2)
        return Action(arrived if lands else gripper, *clipped.tolist())


def nearest_symmetric_yaw(yaw: float, reference: float, period: float) -> float:
    """Returns the angle nearest to ``reference`` among ``yaw`` + k ``period`` (rad)."""
    return yaw + period * np.round((reference - yaw) / period)


def box_yaw(quaternion: np.ndarray) -> float:
    """Returns the yaw (rad) of the most horizontal body axis of a box (qx, qy, qz, qw)."""
    axes = Rotation.from_quat(quaternion).as_matrix().T
    axis = axes[np.argmin(np.abs(axes[:, 2]))]
    return float(np.arctan2(axis[1], axis[0]))
