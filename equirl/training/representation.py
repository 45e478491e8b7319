"""FERM's part of the learner: an encoder that is trained to know an observation by its crops."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SoftUpdate

from equirl.config import Config
from equirl.modules import tie_convolutions
from equirl.objectives import ContrastiveLoss

__all__ = ["RepresentationLearner"]


class RepresentationLearner:
    """Contrastive steps on the critic's encoder (FERM, Zhan et al. 2020; appendix E).

    Each step is one of Adam on the contrastive loss, in which the momentum encoder then moves. The
    actor's convolutions are the critic's, before training and after every update of that.

    Args:
        config: The run's configuration.
        actor: The policy, whose convolutions are tied.
        critic: The critic, whose encoder learns.
        generator: Source of the initial similarity.

    Attributes:
        steps: Contrastive steps so far.
    """

    def __init__(
        self,
        config: Config,
        actor: ProbabilisticActor,
        critic: TensorDictSequential,
        generator: torch.Generator,
    ):
        self.actor, self.critic = actor, critic
        self.loss = ContrastiveLoss(critic.module[0], generator=generator).to(config.torch_device)
        self.key_update = SoftUpdate(self.loss, tau=config.method.momentum)
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=config.algorithm.learning_rate, fused=True
        )
        self.steps = 0
        tie_convolutions(actor, critic)

    @property
    def metric_names(self) -> tuple[str, ...]:
        """What `update` reports."""
        return tuple(self.loss.out_keys)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One contrastive step; then the actor's convolutions are the critic's again.

        Args:
            batch: Observations of batch size (B,) and the other crop of each, ``positive``.

        Returns:
            The loss, and the share of observations that are told from the others of the batch.
        """
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.loss(batch)
        losses["loss_contrastive"].backward()
        self.optimizer.step()
        self.key_update.step()
        self.steps += 1
        tie_convolutions(self.actor, self.critic)
        return {name: losses[name].item() for name in self.metric_names}

    def state_dict(self) -> dict[str, Any]:
        """Encoders, similarity, optimiser and the number of steps."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "steps": self.steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.steps = state["steps"]
