"""Episodes on seeded scenes, transition by transition, and what rebuilds the present one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from equirl.data import TRANSITION_KEYS

__all__ = ["Episode", "SceneRollout"]


@dataclass(frozen=True)
class Episode:
    """Summary of a finished episode.

    Attributes:
        length: Steps.
        success: Whether its last reward is positive.
        undiscounted_return: Sum of the rewards.
        discounted_return: Sum of discount^t times the reward of step t, from t = 0.
    """

    length: int
    success: bool
    undiscounted_return: float
    discounted_return: float

    @classmethod
    def of(cls, rewards: Sequence[float], discount: float) -> Episode:
        """The summary of an episode with these rewards."""
        return cls(
            length=len(rewards),
            success=rewards[-1] > 0,
            undiscounted_return=sum(rewards),
            discounted_return=sum(reward * discount**t for t, reward in enumerate(rewards)),
        )


class SceneRollout:
    """Plays the episodes of one environment and remembers the actions since its scene began.

    A scene begins with a seed of its own. Environments with a property ``scene_continues`` (see
    `ManipulationEnv`) may play several episodes on one scene; others have a new one each episode.
    A simulator's state cannot be copied exactly, so it is rebuilt: from the seed, by the actions.

    Args:
        env: A single environment (batch size ``()``).
        seeds: Maps the number of an episode to the seed of its scene.
        expert: What the key ``expert`` of every transition says.

    Attributes:
        observation: What to act on; None between episodes.
        rewards: Those of the present episode, or of the last one.
    """

    def __init__(self, env: EnvBase, seeds: Callable[[int], int], *, expert: bool):
        self.env = env
        self.seeds = seeds
        self._label = torch.tensor([expert])
        self.forget()

    def forget(self) -> None:
        """Makes the next episode begin a new scene."""
        self.observation: TensorDictBase | None = None
        self.rewards: list[float] = []
        self._first: int | None = None  # number of the scene's first episode
        self._actions: list[list[torch.Tensor]] = []  # of each of its episodes

    def begin(self, episode: int) -> TensorDictBase:
        """Begins an episode, on the present scene if that continues.

        Args:
            episode: Its number.

        Returns:
            The first observation.
        """
        if self._first is None or not getattr(self.env, "scene_continues", False):
            self.env.set_seed(self.seeds(episode), static_seed=True)
            self._first, self._actions = episode, []
        self._actions.append([])
        self.rewards = []
        self.observation = self.env.reset()
        return self.observation

    def step(self, action: torch.Tensor) -> TensorDict:
        """Acts in the present episode.

        Args:
            action: Shape (dim,).

        Returns:
            The transition, of batch size () and the keys of `TRANSITION_KEYS`.
        """
        assert self.observation is not None
        stepped = self.env.step(self.observation.copy().set("action", action))
        self._actions[-1].append(action.clone())
        self.rewards.append(stepped["next", "reward"].item())
        self.observation = None if stepped["next", "done"].item() else step_mdp(stepped)
        return stepped.copy().set("expert", self._label).select(*TRANSITION_KEYS)

    def state_dict(self) -> dict[str, Any]:
        """The number of the scene's first episode and the actions of each, (T, dim).

        An episode without actions has not begun.
        """
        actions = [torch.stack(taken) for taken in self._actions if taken]
        return {"first": self._first, "actions": actions}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Rebuilds the scene and the episode that was open, if one was.

        Raises:
            RuntimeError: If the scene does not go on as it did, in another simulator perhaps.
        """
        self.forget()
        for number, actions in enumerate(state["actions"]):
            self.begin(state["first"] + number)
            if self._first != state["first"]:
                raise RuntimeError(
                    f"episode {self._first} began a new scene, but went on with that of episode "
                    f"{state['first']} when it was recorded: the simulation has changed since"
                )
            for action in actions:
                self.step(action)
