"""Expert demonstrations as a TorchRL collector."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from equirl.collectors.rollout import SceneRollout

__all__ = ["DemonstrationCollector", "DemonstrationError"]


class DemonstrationError(RuntimeError):
    """The expert does not solve the environment it was given."""


class DemonstrationCollector(BaseCollector):
    """Yields successful episodes of an expert, one TensorDict each; failed ones are discarded.

    An episode has shape [T] and the keys of `equirl.data.TRANSITION_KEYS`, ``expert`` True. It
    is successful when its last reward is positive.

    The demonstrations are a function of ``seed`` alone (given a policy that depends on the
    environment's seed only): the collector seeds each scene, on which an environment may play
    several episodes (see `SceneRollout`), and leaves it in the last attempt's final state.
    Iterating again goes on with further episodes only after `set_seed` or `load_state_dict`.

    Example:
        >>> env = make_env("block_picking", seed=0)
        >>> for episode in DemonstrationCollector(env, episodes=20, seed=1):
        ...     buffer.extend(episode)

    Args:
        env: Where to act; not batched.
        policy: Writes ``action``. Defaults to ``equirl.envs.make_expert(env)``.
        episodes: How many successful episodes to yield in all.
        seed: Root of all randomness.
        seeds: Maps the number of an attempt to the seed of its scene, instead of ``seed``; for
            callers that keep the scenes of several purposes apart.
        replay_buffer: If given, every episode is also written into it by one ``extend``.
        max_failures: Consecutive failed attempts that are given up on.

    Attributes:
        attempted: Episodes tried so far.
        episodes_collected: Successful episodes so far.

    Raises:
        ValueError: On an argument out of range.
        DemonstrationError: While iterating, after ``max_failures`` failed attempts in a row.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: Callable[[TensorDictBase], TensorDictBase] | None = None,
        *,
        episodes: int,
        seed: int = 0,
        seeds: Callable[[int], int] | None = None,
        replay_buffer: ReplayBuffer | None = None,
        max_failures: int = 20,
    ):
        super().__init__()
        if episodes < 0:
            raise ValueError(f"episodes must be at least 0, got {episodes}")
        if max_failures < 1:
            raise ValueError(f"max_failures must be at least 1, got {max_failures}")
        if env.batch_size:
            raise ValueError(f"the environment must not be batched, got {env.batch_size}")
        if policy is None:
            from equirl.envs import make_expert

            policy = make_expert(env)
        self.env = env
        self.policy = policy
        self.replay_buffer = replay_buffer
        self._episodes = episodes
        self._max_failures = max_failures
        self._rollout = SceneRollout(env, seeds or self._scene_seed, expert=True)
        self.closed = False
        self.set_seed(seed)

    def __len__(self) -> int:
        """Number of episodes that are yielded in all."""
        return self._episodes

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yields successful episodes until there are ``episodes`` of them."""
        failures = 0
        while self.episodes_collected < self._episodes:
            if self.closed:
                raise RuntimeError("this collector was shut down; make a new one")
            episode = self._attempt()
            if self._rollout.rewards[-1] <= 0:
                failures += 1
                if failures >= self._max_failures:
                    raise DemonstrationError(
                        f"{type(self.policy).__name__} failed {failures} episodes in a row (found "
                        f"{self.episodes_collected} of {self._episodes} demonstrations in "
                        f"{self.attempted} attempts); is it the expert of this environment?"
                    )
                continue
            failures = 0
            self.episodes_collected += 1
            if self.replay_buffer is not None:
                # Never `add`: it bypasses transforms that expand what is stored. A copy, because
                # buffers write indices into what they are given.
                self.replay_buffer.extend(episode.copy())
            yield episode

    @torch.no_grad()
    def _attempt(self) -> TensorDictBase:
        """Runs the next attempt and returns its transitions, shape [T]."""
        transitions, rollout = [], self._rollout
        rollout.begin(self.attempted)
        self.attempted += 1
        while rollout.observation is not None:
            action = self.policy(rollout.observation.copy())["action"]
            transitions.append(rollout.step(action))
        return torch.stack(transitions)

    def _scene_seed(self, attempt: int) -> int:
        root = np.random.SeedSequence(self._seed, spawn_key=(attempt,))
        return int(root.generate_state(1)[0])

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Starts over from ``seed``: the next iteration yields ``episodes`` episodes again.

        Returns:
            A seed for another collector (the same one if ``static_seed``).
        """
        if seed < 0:
            raise ValueError(f"seed must not be negative, got {seed}")
        self._seed = int(seed)
        self.attempted = 0
        self.episodes_collected = 0
        self._rollout.forget()
        return seed if static_seed else seed + 1

    def state_dict(self) -> OrderedDict:
        """Returns what continues the collection after the episodes yielded so far."""
        return OrderedDict(
            seed=self._seed,
            attempted=self.attempted,
            episodes_collected=self.episodes_collected,
            scene=self._rollout.state_dict(),
        )

    def load_state_dict(self, state_dict: OrderedDict) -> None:
        """Restores `state_dict`."""
        self._seed = state_dict["seed"]
        self.attempted = state_dict["attempted"]
        self.episodes_collected = state_dict["episodes_collected"]
        self._rollout.load_state_dict(state_dict["scene"])

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        """Ends the collection and closes the environment unless ``close_env`` is False."""
        if close_env and not self.closed:
            self.env.close(raise_if_closed=False)
        self.closed = True

    def __repr__(self) -> str:
        """Names the collector, its policy and how far it is."""
        return (
            f"{type(self).__name__}({type(self.policy).__name__}, seed={self._seed}, "
            f"{self.episodes_collected} of {self._episodes} episodes)"
        )
