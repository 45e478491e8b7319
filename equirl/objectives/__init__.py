"""Losses on top of torchrl.objectives."""

from equirl.objectives.sac import SACLoss

__all__ = ["SACLoss"]
