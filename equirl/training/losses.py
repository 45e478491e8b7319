"""The loss of a run, from its configuration."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictSequential
from torchrl.modules import ProbabilisticActor

from equirl.config import Config
from equirl.modules import METHODS
from equirl.objectives import DrQfDLoss, DrQLoss, EquivarianceLoss, SACfDLoss, SACLoss

__all__ = ["make_auxiliary_loss", "make_loss"]


def make_loss(
    config: Config,
    actor: ProbabilisticActor,
    critic: TensorDictSequential,
    generator: torch.Generator,
) -> SACLoss:
    """Builds the losses of the configured algorithm, averaged over shifts if the method asks so.

    Args:
        config: The run's configuration.
        actor: The policy.
        critic: The critic.
        generator: Source of the losses' own randomness.
    """
    algorithm, method = config.algorithm, config.method
    options: dict[str, Any] = {
        "alpha_init": algorithm.alpha,
        "target_entropy": algorithm.target_entropy,
        "gamma": algorithm.discount,
        "importance_weights": config.importance_weights,
        "generator": generator,
    }
    demonstrated, shifts = algorithm.name == "sacfd", METHODS[method.name].shifts
    if demonstrated:
        options |= {"demonstration_weight": algorithm.demonstration_weight}
    if shifts:
        options |= {
            "target_views": method.target_views,
            "loss_views": method.loss_views,
            "shift": config.shift,
        }
    kinds = {
        (False, False): SACLoss,
        (True, False): SACfDLoss,
        (False, True): DrQLoss,
        (True, True): DrQfDLoss,
    }
    return kinds[demonstrated, shifts](actor, critic, **options)


def make_auxiliary_loss(
    config: Config,
    actor: ProbabilisticActor,
    critic: TensorDictSequential,
    generator: torch.Generator,
) -> EquivarianceLoss | None:
    """Builds the equivariance loss if the augmentation is that, on the same networks."""
    if config.augmentation.name != "auxiliary":
        return None
    return EquivarianceLoss(
        actor,
        critic,
        weight=config.augmentation.weight,
        quarter_turns=config.augmentation.quarter_turns,
        generator=generator,
    )
