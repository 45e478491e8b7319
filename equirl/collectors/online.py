"""The training collector: one environment step of the behaviour policy at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from equirl.collectors.rollout import Episode, SceneRollout

__all__ = ["OnlineCollector"]


class OnlineCollector:
    """Steps one environment with a stochastic policy and hands out single transitions.

    It is none of TorchRL's collectors, which step ahead of the learner and cannot say where they
    are: here acting and learning alternate, and an open episode can be rebuilt exactly from the
    seed of its scene and the actions since (see `SceneRollout`).

    Args:
        env: A single environment (batch size ``()``).
        policy: The behaviour policy; sampled, not greedy.
        seeds: Maps the number of an episode to the seed of its scene.
        discount: For the discounted return reported for each episode.
        device: Where the policy lives; the environment stays on the CPU.

    Attributes:
        episode: Number of the next or open episode, from 0.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase,
        seeds: Callable[[int], int],
        *,
        discount: float = 0.99,
        device: torch.device | str = "cpu",
    ):
        self.policy = policy
        self.discount = discount
        self.device = device
        self.episode = 0
        self._rollout = SceneRollout(env, seeds, expert=False)

    def act(self) -> torch.Tensor:
        """Chooses the next action, shape (dim,); begins an episode when none is open."""
        observation = self._rollout.observation
        if observation is None:
            observation = self._rollout.begin(self.episode)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            return self.policy(observation.copy().to(self.device))["action"].cpu()

    def step(self, action: torch.Tensor) -> tuple[TensorDict, Episode | None]:
        """Takes an action.

        Args:
            action: What `act` returned.

        Returns:
            The transition, of batch size (1,) and the keys of `TRANSITION_KEYS`, and the
            episode's summary if it ended.
        """
        transition = self._rollout.step(action).unsqueeze(0)
        if self._rollout.observation is not None:
            return transition, None
        self.episode += 1
        return transition, Episode.of(self._rollout.rewards, self.discount)

    def state_dict(self) -> dict[str, Any]:
        """The number of the next or open episode, and what rebuilds its scene."""
        return {"episode": self.episode, "scene": self._rollout.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Rebuilds the scene, and the open episode, from its seed and the actions taken."""
        self.episode = state["episode"]
        self._rollout.load_state_dict(state["scene"])
