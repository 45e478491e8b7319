"""Losses on top of TorchRL's."""

from equirl.objectives.contrastive import ContrastiveLoss
from equirl.objectives.drq import DrQfDLoss, DrQLoss, random_shift
from equirl.objectives.equivariance import EquivarianceLoss
from equirl.objectives.sac import SACLoss
from equirl.objectives.sacfd import SACfDLoss, demonstration_loss

__all__ = [
    "ContrastiveLoss",
    "DrQLoss",
    "DrQfDLoss",
    "EquivarianceLoss",
    "SACLoss",
    "SACfDLoss",
    "demonstration_loss",
    "random_shift",
]
