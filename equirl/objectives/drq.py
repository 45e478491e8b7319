"""DrQ: Q-learning regularised by averages over shifted images (Kostrikov et al. 2021)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor

from equirl.objectives.sac import SACLoss
from equirl.objectives.sacfd import SACfDLoss

__all__ = ["DrQLoss", "DrQfDLoss", "random_shift"]


def random_shift(images: Tensor, largest: int, generator: torch.Generator | None = None) -> Tensor:
    """Shifts each image by whole pixels, its border replicated.

    What padding by ``largest`` pixels and a random crop of the old size do, for all images at
    once.

    Args:
        images: Shape (N, C, S, S).
        largest: Each image moves by -largest to largest pixels in rows and in columns, each
            displacement as likely.
        generator: Source of the displacements, on the CPU.
    """
    count, *_, size = images.shape
    drawn = torch.randint(-largest, largest + 1, (2, count, 1), generator=generator)
    rows, columns = (torch.arange(size) + drawn).clamp(0, size - 1).to(images.device)
    number = torch.arange(count, device=images.device)[:, None, None]
    shifted = images.movedim(1, -1)[number, rows[:, :, None], columns[:, None, :]]
    return shifted.movedim(-1, 1)


class DrQLoss(SACLoss):
    """The losses of `SACLoss`, averaged over randomly shifted copies of each transition.

    With f_k(s), k = 1, 2, ..., the image of s shifted at random, K = ``target_views`` and
    M = ``loss_views``:

    * the target of a transition is the mean of K: y = r + gamma (1 - terminated) 1/K sum_k V'_k,
      V'_k = min_i Q'_i(f_k(s'), a'_k) - alpha log pi(a'_k|f_k(s')) with a'_k ~ pi(.|f_k(s'))
      (equation 1 of DrQ);
    * each loss is the mean over M copies of the state, ``loss_qvalue`` for one
      sum_i mean 1/M sum_m (Q_i(f_m(s), a) - y)^2 (equation 3).

    The copies of the paper's first equation are drawn anew for the second. What is invariant, such
    as the holding flag, stays as it is; the policy acts on images as they are.

    Args:
        actor: As in `SACLoss`.
        critic: As in `SACLoss`.
        target_views: K, shifted copies of a next state, averaged in its target.
        loss_views: M, shifted copies of a state, averaged in the losses.
        shift: Largest displacement of a copy in rows and in columns, pixels.
        images: Keys of the images, (B, C, S, S), each also looked up under ``"next"``.
        options: Further arguments of `SACLoss`; its ``generator`` draws the shifts.

    Raises:
        ValueError: A number is out of range.
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictSequential,
        *,
        target_views: int = 2,
        loss_views: int = 2,
        shift: int = 4,
        images: Sequence[NestedKey] = ("depth",),
        **options: Any,
    ):
        for name, value, lowest in (
            ("target_views", target_views, 1),
            ("loss_views", loss_views, 1),
            ("shift", shift, 0),
        ):
            if not isinstance(value, int) or value < lowest:
                raise ValueError(f"{name}={value!r}: expected an integer of {lowest} or more")
        super().__init__(actor, critic, **options)
        self.target_views, self.loss_views = target_views, loss_views
        self.shift, self.images = shift, tuple(images)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of a batch, see the class."""
        views = self._shifted(TensorDict.cat([tensordict] * self.loss_views, 0))
        losses = super().forward(views)
        errors = views.get(self.tensor_keys.priority).reshape(self.loss_views, -1)
        tensordict.set(self.tensor_keys.priority, errors.mean(0))
        return losses

    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        """The targets of M copies of a batch, (M B,): those of a transition are the same."""
        transitions = tensordict[: len(tensordict) // self.loss_views].select("next")
        views = TensorDict.cat([transitions] * self.target_views, 0)
        views["next"] = self._shifted(views["next"])
        target = super()._compute_target_v2(views).reshape(self.target_views, -1).mean(0)
        return target.repeat(self.loss_views)

    def _shifted(self, tensordict: TensorDictBase) -> TensorDictBase:
        shifted = tensordict.copy()
        for key in self.images:
            image = random_shift(tensordict.get(key), self.shift, self.generator)
            shifted.set(key, image)
        return shifted


class DrQfDLoss(DrQLoss, SACfDLoss):
    """`DrQLoss` with the demonstration term of `SACfDLoss`, which it averages likewise."""
