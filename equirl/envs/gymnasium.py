"""The environments for Gymnasium and what is built on it.

Importing this module registers one environment a task, so that both of these work:

    import equirl.envs.gymnasium
    env = gymnasium.make("equirl/BlockPicking-v0", image_size=64)

    env = gymnasium.make("equirl.envs.gymnasium:equirl/BlockPicking-v0", image_size=64)

TorchRL makes ``spawn`` the way this process starts others. Where the main script cannot be imported
anew, or workers should start in a moment, ask for forked ones:
``gymnasium.make_vec(..., vectorization_mode="async", vector_kwargs={"context": "fork"})``.
"""

from __future__ import annotations

from typing import Any, ClassVar, SupportsFloat

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from tensordict import TensorDict, TensorDictBase
from torchrl.data import TensorSpec

from equirl.envs.factory import make_env
from equirl.envs.tasks import TASKS

__all__ = ["GymnasiumEnv", "register"]

Observation = dict[str, np.ndarray]


class GymnasiumEnv(gymnasium.Env[Observation, np.ndarray]):
    """A `ManipulationEnv` by Gymnasium's rules, bit for bit the same simulation.

    Observations are a dictionary of ``depth`` (1, S, S) float32, metres below the end effector,
    and ``holding`` (1,) float32, 0 or 1. Actions are (5,) in [-1, 1], order (gripper, x, y, z,
    theta). The reward is 1 on success, which terminates the episode, else 0. Every ``info`` has

    * ``is_success``: whether this step succeeded;
    * ``scene_continues``: whether the next reset goes on with the objects as they are now; only
      Clutter Grasping plays several episodes on one scene.

    The environment ends an episode after ``max_steps`` by itself; it needs no ``TimeLimit``.

    Args:
        task: As for `equirl.envs.make_env`.
        seed: What the first reset without a seed is seeded with. None, as Gymnasium's users
            expect: drawn from ``np_random``, so that each environment differs; ``np_random_seed``
            tells it afterwards, for a repetition.
        render_mode: ``"rgb_array"`` if `render` is to return pictures, or None.
        options: Further arguments of `equirl.envs.make_env`: ``image_size``, ``robot``,
            ``max_steps``, ``time_limit`` and the numbers of the task.

    Attributes:
        env: The `ManipulationEnv`, for experts, scenes and pictures of any size.

    Raises:
        ValueError: If an argument is not one of these.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 4}

    def __init__(
        self,
        task: str,
        *,
        seed: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ):
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}")
        self.env = make_env(task, seed=0 if seed is None else seed, **options)
        self.render_mode = render_mode
        self.observation_space: Space[Any] = Dict(
            {key: _box(self.env.observation_spec[key]) for key in ("depth", "holding")}
        )
        self.action_space = _box(self.env.action_spec)
        self._first_seed = seed
        self._seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Starts over as ``ManipulationEnv.set_seed(seed)`` does. Without it, the episodes
                go on in the order that the last seed determines.
            options: None are known; ignored.

        Returns:
            The observation and the info.

        Raises:
            RuntimeError: If the environment is closed.
        """
        if seed is None and not self._seeded:
            seed = self._first_seed
            if seed is None:
                seed = int(self.np_random.integers(2**63))
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed, static_seed=True)
            self._seeded = True
        return _observation(self.env.reset()), self._info(success=False)

    def step(
        self, action: np.ndarray
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Acts once.

        Args:
            action: Shape (5,), order (gripper, x, y, z, theta), in [-1, 1].

        Returns:
            The observation, the reward, whether the episode is terminated, whether it is
            truncated, and the info.

        Raises:
            ValueError: If the action has another shape or leaves [-1, 1].
            RuntimeError: Before the first reset.
        """
        values = torch.tensor(np.asarray(action, dtype=np.float32))
        after = self.env.step(TensorDict({"action": values}))["next"]
        reward = after["reward"].item()
        ends = after["terminated"].item(), after["truncated"].item()
        return _observation(after), reward, *ends, self._info(success=reward > 0)

    def _info(self, success: bool) -> dict[str, Any]:
        return {"is_success": success, "scene_continues": self.env.scene_continues}

    def render(self) -> np.ndarray | None:
        """Returns a picture of the cell, shape (height, width, 3), uint8.

        None, with a warning, if the environment was made without a ``render_mode``.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() needs an environment made with render_mode="rgb_array"')
            return None
        return self.env.render()

    def close(self) -> None:
        """Disconnects from the simulator; harmless when done before."""
        self.env.close(raise_if_closed=False)


def register() -> None:
    """Registers ``equirl/BlockPicking-v0`` and so on, one a task; harmless when done before.

    There is no ``max_episode_steps``: the environments count by themselves, up to ``max_steps``.
    """
    for name, task in TASKS.items():
        identifier = f"equirl/{task.__name__}-v0"
        if identifier not in gymnasium.registry:
            entry_point = f"{__name__}:{GymnasiumEnv.__name__}"
            gymnasium.register(identifier, entry_point=entry_point, kwargs={"task": name})


def _box(spec: TensorSpec) -> Box:
    return Box(spec.space.low.numpy(), spec.space.high.numpy(), dtype=np.float32)


def _observation(tensordict: TensorDictBase) -> Observation:
    return {key: tensordict[key].numpy() for key in ("depth", "holding")}


register()  # Gymnasium finds environments by importing the module that registers them
