"""Episodes on seeded scenes, and what it takes to rebuild the present one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

__all__ = ["SceneLog"]


class SceneLog:
    """Begins the episodes of one environment and remembers the actions since its scene began.

    A scene begins with a seed of its own. Environments with a property ``scene_continues`` (see
    `ManipulationEnv`) may play several episodes on one scene; others have a new one each episode.
    A simulator's state cannot be copied exactly, so it is rebuilt: from the seed, by the actions.

    Args:
        env: A single environment (batch size ``()``).
        seeds: Maps the number of an episode to the seed of its scene.
    """

    def __init__(self, env: EnvBase, seeds: Callable[[int], int]):
        self.env = env
        self.seeds = seeds
        self.forget()

    def forget(self) -> None:
        """Makes the next episode begin a new scene."""
        self._first: int | None = None  # number of the scene's first episode
        self._actions: list[list[torch.Tensor]] = []  # of each of its episodes

    def begin(self, episode: int) -> TensorDictBase:
        """Returns the first observation of an episode, on the present scene if that continues.

        Args:
            episode: Its number.
        """
        if self._first is None or not getattr(self.env, "scene_continues", False):
            self.env.set_seed(self.seeds(episode), static_seed=True)
            self._first, self._actions = episode, []
        self._actions.append([])
        return self.env.reset()

    def step(self, taken: TensorDictBase) -> TensorDictBase:
        """Steps the environment with ``taken["action"]`` and remembers it."""
        stepped = self.env.step(taken)
        self._actions[-1].append(taken["action"].clone())
        return stepped

    def state_dict(self) -> dict[str, Any]:
        """Returns the number of the scene's first episode and the actions of each, (T, dim).

        An episode without actions has not begun.
        """
        actions = [torch.stack(taken) for taken in self._actions if taken]
        return {"first": self._first, "actions": actions}

    def load_state_dict(self, state: dict[str, Any]) -> list[TensorDictBase]:
        """Rebuilds the scene.

        Returns:
            The steps of its last episode, as `step` returned them.

        Raises:
            RuntimeError: If the scene does not go on as it did, in another simulator perhaps.
        """
        self.forget()
        steps: list[TensorDictBase] = []
        for number, actions in enumerate(state["actions"]):
            current, steps = self.begin(state["first"] + number), []
            if self._first != state["first"]:
                raise RuntimeError(
                    f"episode {self._first} began a new scene, but went on with that of episode "
                    f"{state['first']} when it was recorded: the simulation has changed since"
                )
            for action in actions:
                steps.append(self.step(current.copy().set("action", action)))
                current = steps[-1]["next"].exclude("reward")
        return steps
