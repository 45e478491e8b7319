"""Prioritized replay, with a bonus for demonstrations, over TorchRL's sampler."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler

__all__ = ["CompactPrioritizedSampler", "Priorities"]


class CompactPrioritizedSampler(PrioritizedSampler):
    """TorchRL's sampler with a state of plain tensors and numbers, of the filled rows only.

    TorchRL's own holds two trees of the whole capacity, objects that cannot be read back
    without executing code.
    """

    def state_dict(self) -> dict[str, Any]:
        """The priorities of the filled rows, the largest error so far with its row, and beta."""
        priorities = torch.as_tensor(self._sum_tree[torch.arange(self.max_size)])
        largest, row = self._max_priority
        return {
            "priorities": priorities[priorities > 0].clone(),  # 0 is that of a row never written
            "largest": None if largest is None else (float(largest), int(row)),
            "beta": self.beta,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned, bit for bit."""
        self._empty()
        priorities = state_dict["priorities"]
        if len(priorities):
            rows = torch.arange(len(priorities))
            self._sum_tree[rows] = priorities
            self._min_tree[rows] = priorities
        if state_dict["largest"] is not None:
            largest, row = state_dict["largest"]
            self._max_priority = (torch.tensor(largest), torch.tensor(row))
        self.beta = state_dict["beta"]


@dataclass(frozen=True)
class Priorities:
    """Prioritized experience replay (Schaul et al., 2016), demonstrations preferred.

    A row's priority is ``(td_error + bonus * expert + epsilon) ** exponent``, and rows are
    sampled in proportion to it. Each batch carries the importance weights ``priority_weight``
    (B,), which undo the preference: ``(p / min p) ** -beta`` with the smallest priority of the
    buffer, that is ``(rows * probability) ** -beta`` over its largest value; beta grows
    linearly from its first value to 1. New rows get the largest priority so far (1 before any),
    so that they are soon seen.

    A stored row is a transition together with its n rotated versions (`RotationAugmentation`):
    the priority belongs to the transition, and all its versions share it. If a batch holds a
    row several times, as the same version or as others, the largest of the priorities counts.

    Args:
        exponent: 0 samples uniformly, 1 in proportion to the error.
        bonus: What a demonstration's error is raised by.
        epsilon: What every error is raised by, lest a row be never sampled.
        beta: The first exponent of the importance weights, 0 to 1.
        steps: Environment steps over which beta grows to 1.

    Raises:
        ValueError: A number is out of range.
    """

    exponent: float = 0.6
    bonus: float = 1.0
    epsilon: float = 1e-6
    beta: float = 0.4
    steps: int = 10_000

    def __post_init__(self) -> None:
        for name, valid, expected in (
            ("exponent", 0 <= self.exponent <= 1, "a number from 0 to 1"),
            ("bonus", 0 <= self.bonus < math.inf, "a number of 0 or more"),
            ("epsilon", 1e-30 < self.epsilon < math.inf, "a number above 1e-30"),
            ("beta", 0 <= self.beta <= 1, "a number from 0 to 1"),
            ("steps", isinstance(self.steps, int) and self.steps >= 1, "an integer of 1 or more"),
        ):
            if not valid:
                raise ValueError(f"{name}={getattr(self, name)!r}: expected {expected}")

    def sampler(self, rows: int) -> CompactPrioritizedSampler:
        """A sampler for a buffer of ``rows`` rows, its weights those of step 0."""
        return CompactPrioritizedSampler(rows, self.exponent, self.beta, self.epsilon)

    def update(self, buffer: TensorDictReplayBuffer, batch: TensorDictBase) -> None:
        """Sets the priorities of the rows of a sampled batch, before anything else is stored.

        Args:
            buffer: The buffer it was sampled from.
            batch: With ``index`` and ``td_error`` (B,), the latter as the loss has left it, and
                ``expert`` (B, 1).

        Raises:
            ValueError: An error is negative or not finite.
        """
        error = batch.get("td_error").detach().cpu()
        wrong = error[~((error >= 0) & error.isfinite())]
        if len(wrong):
            raise ValueError(f"td_error holds {wrong[0]}: expected finite numbers of 0 or more")
        raised = error + self.bonus * batch.get("expert").squeeze(-1).cpu()
        rows, position = batch.get("index").cpu().unique(return_inverse=True)
        largest = torch.zeros(len(rows)).scatter_reduce(0, position, raised, "amax")
        buffer.update_priority(rows, largest)  # the sampler adds epsilon and takes the power

    def anneal(self, buffer: TensorDictReplayBuffer, step: int) -> None:
        """Sets beta to that of an environment step."""
        buffer.sampler.beta = self.beta + (1 - self.beta) * min(step / self.steps, 1.0)
