"""The training collector: one environment step of the behaviour policy at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from equirl.collectors.scene_log import SceneLog
from equirl.data import TRANSITION_KEYS

__all__ = ["Episode", "OnlineCollector"]


@dataclass(frozen=True)
class Episode:
    """Summary of a finished episode."""

    index: int
    length: int
    undiscounted: float  # return
    discounted: float  # discounted return
    success: bool


class OnlineCollector:
    """Steps one environment with a stochastic policy and hands out single transitions.

    Every scene starts from a seed of its own, so an open episode is the number of the scene's
    first one and the actions taken since: that is all its state dict holds, and loading one
    rebuilds the episode in the simulator by replaying them.

    Args:
        env: A single environment (batch size ``()``).
        policy: The behaviour policy; sampled, not greedy.
        seeds: Maps the number of an episode to the seed of its scene.
        discount: For the discounted return reported for each episode.
        device: Where the policy lives; the environment stays on the CPU.
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
        self.env = env
        self.policy = policy
        self.discount = discount
        self.device = device
        self.episode = 0
        self._scenes = SceneLog(env, seeds)
        self._rewards: list[float] = []
        self._current: TensorDictBase | None = None

    def act(self) -> TensorDictBase:
        """Chooses the next action; begins an episode when none is open.

        Returns:
            The current step, with keys of the observation and ``action``.
        """
        if self._current is None:
            self._current = self._scenes.begin(self.episode)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            return self.policy(self._current.copy().to(self.device))

    def step(self, acted: TensorDictBase) -> tuple[TensorDict, Episode | None]:
        """Takes the chosen action.

        Args:
            acted: What `act` returned.

        Returns:
            The transition, of batch size (1,) and the keys of
            `TRANSITION_KEYS`, and the episode's summary if it ended.
        """
        assert self._current is not None
        taken = self._current.copy().set("action", acted["action"].detach().cpu())
        stepped = self._scenes.step(taken)
        self._note(stepped)
        transition = stepped.copy().set("expert", torch.zeros(1, dtype=torch.bool))
        transition = transition.select(*TRANSITION_KEYS).unsqueeze(0)
        summary = self._close() if stepped["next", "done"].item() else None
        return transition, summary

    def state_dict(self) -> dict[str, Any]:
        """The number of the next or open episode, and what rebuilds its scene."""
        return {
            "episode": self.episode,
            "open": len(self._rewards) > 0,
            "scene": self._scenes.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Rebuilds the scene, and the open episode, from its seed and the actions taken."""
        self.episode = state["episode"]
        self._rewards, self._current = [], None
        steps = self._scenes.load_state_dict(state["scene"])
        if state["open"]:
            for stepped in steps:
                self._note(stepped)

    def _note(self, stepped: TensorDictBase) -> None:
        self._rewards.append(stepped["next", "reward"].item())
        self._current = step_mdp(stepped)

    def _close(self) -> Episode:
        rewards = self._rewards
        summary = Episode(
            index=self.episode,
            length=len(rewards),
            undiscounted=sum(rewards),
            discounted=sum(r * self.discount**t for t, r in enumerate(rewards)),
            success=rewards[-1] > 0,
        )
        self.episode += 1
        self._rewards, self._current = [], None
        return summary
