"""Losses on top of torchrl.objectives."""

from .sac import SACLoss

__all__ = ["SACLoss"]
