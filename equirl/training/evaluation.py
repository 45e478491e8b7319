"""Greedy evaluation of a policy on scenes of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from equirl.analysis.statistics import wilson_interval
from equirl.modules import shared_filters

__all__ = ["EpisodeResult", "Evaluation", "evaluate", "play"]


@dataclass(frozen=True)
class EpisodeResult:
    """One greedy episode."""

    seed: int
    success: bool
    length: int
    discounted: float


@dataclass(frozen=True)
class Evaluation:
    """The outcome of a policy over a set of scenes."""

    episodes: tuple[EpisodeResult, ...]

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
    def discounted(self) -> float:
        """Mean discounted return."""
        return sum(episode.discounted for episode in self.episodes) / len(self.episodes)

    def __str__(self) -> str:
        low, high = self.interval
        return (
            f"{self.successes} of {len(self.episodes)} episodes succeed "
            f"({self.success_rate:.0%}, 95 % confidence interval {low:.0%} to {high:.0%})"
        )


def play(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seed: int,
    *,
    discount: float = 0.99,
    device: torch.device | str = "cpu",
    on_step: Callable[[torch.Tensor], None] | None = None,
) -> EpisodeResult:
    """Plays one greedy episode.

    Args:
        env: A single environment.
        policy: Acts deterministically; no random number is drawn.
        seed: The scene.
        discount: For the discounted return.
        device: Where the policy lives.
        on_step: Called with each observation's depth image, the first included.
    """
    env.set_seed(seed, static_seed=True)
    current = env.reset()
    rewards: list[float] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        while True:
            if on_step:
                on_step(current["depth"])
            action = policy(current.copy().to(device))["action"].cpu()
            stepped = env.step(current.set("action", action))
            rewards.append(stepped["next", "reward"].item())
            current = step_mdp(stepped)
            if stepped["next", "done"].item():
                break
    if on_step:
        on_step(current["depth"])
    return EpisodeResult(
        seed=seed,
        success=rewards[-1] > 0,
        length=len(rewards),
        discounted=sum(reward * discount**t for t, reward in enumerate(rewards)),
    )


def evaluate(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seeds: Sequence[int],
    *,
    discount: float = 0.99,
    device: torch.device | str = "cpu",
    on_episode: Callable[[EpisodeResult], None] | None = None,
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
    results = []
    with shared_filters():
        for seed in seeds:
            results.append(play(env, policy, seed, discount=discount, device=device))
            if on_episode:
                on_episode(results[-1])
    return Evaluation(tuple(results))
