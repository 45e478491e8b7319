"""Greedy evaluation of a policy on scenes of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from equirl.analysis.statistics import wilson_interval
from equirl.collectors import Episode
from equirl.modules import shared_filters

__all__ = ["Evaluation", "evaluate", "play"]


@dataclass(frozen=True)
class Evaluation:
    """The outcome of a policy over a set of scenes.

    Attributes:
        seeds: The scenes.
        episodes: The greedy episode on each.
    """

    seeds: tuple[int, ...]
    episodes: tuple[Episode, ...]

    @property
    def successes(self) -> int:
        """Number of episodes that reached the goal."""
        return sum(episode.success for episode in self.episodes)

    @property
    def success_rate(self) -> float:
        """Share of episodes that reached the goal."""
        return self.successes / len(self.episodes)

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval of the success rate (Wilson's)."""
        return wilson_interval(self.successes, len(self.episodes))

    @property
    def discounted_return(self) -> float:
        """Mean discounted return."""
        return sum(episode.discounted_return for episode in self.episodes) / len(self.episodes)

    def __str__(self) -> str:
        low, high = self.interval
        return (
            f"{self.successes} of {len(self.episodes)} episodes succeed "
            f"({100 * self.success_rate:.3g}%, 95 % confidence interval {low:.0%} to {high:.0%})"
        )


def play(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    seed: int | None = None,
    discount: float = 0.99,
    device: torch.device | str = "cpu",
    on_moment: Callable[[TensorDictBase, torch.Tensor | None, float], None] | None = None,
) -> Episode:
    """Plays one greedy episode.

    Args:
        env: A single environment.
        policy: Acts deterministically; no random number is drawn.
        seed: The scene; when None it is what the next reset of ``env`` gives.
        discount: For the discounted return.
        device: Where the policy lives.
        on_moment: Called at each state, before the environment leaves it, with the observation,
            the action (dim,) that follows, None at the end, and the reward that the action
            before has earned.
    """
    if seed is not None:
        env.set_seed(seed, static_seed=True)
    current, done = env.reset(), False
    rewards: list[float] = []
    with (
        torch.no_grad(),
        shared_filters(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
    ):
        while True:
            action = None if done else policy(current.copy().to(device))["action"].cpu()
            if on_moment:
                on_moment(current, action, rewards[-1] if rewards else 0.0)
            if action is None:
                return Episode.of(rewards, discount)
            stepped = env.step(current.set("action", action))
            rewards.append(stepped["next", "reward"].item())
            current, done = step_mdp(stepped), stepped["next", "done"].item()


def evaluate(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seeds: Iterable[int],
    *,
    discount: float = 0.99,
    device: torch.device | str = "cpu",
    on_episode: Callable[[Episode], None] | None = None,
) -> Evaluation:
    """Plays one greedy episode for each seed.

    Args:
        env: A single environment.
        policy: Acts deterministically.
        seeds: The scenes.
        discount: For the discounted returns.
        device: Where the policy lives.
        on_episode: Called after each episode, for progress.
    """
    played, results = [], []
    with shared_filters():
        for seed in seeds:
            played.append(seed)
            results.append(play(env, policy, seed=seed, discount=discount, device=device))
            if on_episode:
                on_episode(results[-1])
    return Evaluation(tuple(played), tuple(results))
