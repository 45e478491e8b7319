"""SACfD: soft actor-critic that is drawn to the expert's actions (paper, appendix G.2)."""

from __future__ import annotations

import math
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from torch import Tensor

from equirl.objectives.sac import SACLoss

__all__ = ["SACfDLoss", "demonstration_loss"]


def demonstration_loss(action: Tensor, expert_action: Tensor, expert: Tensor) -> Tensor:
    """The mean of 1/2 (a - a_e)^2 over the rows of an expert and the components of an action.

    Equation 1 of appendix G.2, which leaves open how components are put together.

    Args:
        action: Actions a of the policy, (B, dim).
        expert_action: Actions a_e that were taken, (B, dim).
        expert: Whether the expert took them, (B, 1) or (B,), bool.

    Returns:
        A scalar, 0 if no row is an expert's.
    """
    rows = expert.reshape(-1, 1).to(action)
    squared = 0.5 * (action - expert_action).pow(2) * rows
    return squared.sum() / (rows.sum() * action.shape[-1]).clamp(min=1)


class SACfDLoss(SACLoss):
    """The losses of `SACLoss` and, for the actor, a pull towards demonstrated actions.

    With b ~ pi(.|s) the action that ``loss_actor`` judges, a_e the action taken and E the
    expert's transitions of a batch,

    * ``loss_demonstration`` = weight mean_E 1/2 (b - a_e)^2 (appendix G.2, equation 1), over the
      rows of E and the components of an action; 0 if E is empty.

    It is a loss of its own among those returned; their sum is differentiated as before. SACfD
    draws its batches by priority: see `equirl.data.Priorities`.

    Args:
        actor: As in `SACLoss`.
        critic: As in `SACLoss`.
        demonstration_weight: Factor of the term; the paper's is 1, its released system's 2, since
            that leaves out the one half.
        options: Further arguments of `SACLoss`.

    Forward:
        Takes a batch with ``expert`` (B, 1) too.

    Raises:
        ValueError: A number is out of range.
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictSequential,
        *,
        demonstration_weight: float = 1.0,
        **options: Any,
    ):
        if not 0 <= demonstration_weight < math.inf:
            raise ValueError(f"demonstration_weight={demonstration_weight!r}: expected 0 or more")
        super().__init__(actor, critic, **options)
        self.demonstration_weight = demonstration_weight
        self.out_keys: list[str] = [*self.out_keys, "loss_demonstration"]

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss, and beside it ``loss_demonstration`` of the same actions."""
        loss, metadata = super().actor_loss(tensordict)
        term = demonstration_loss(
            metadata["action"], tensordict.get(self.tensor_keys.action), tensordict.get("expert")
        )
        return loss, metadata | {"loss_demonstration": self.demonstration_weight * term}
