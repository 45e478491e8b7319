"""Collectors of experience."""

from .demonstrations import DemonstrationCollector, DemonstrationError
from .online import Episode, OnlineCollector

__all__ = ["DemonstrationCollector", "DemonstrationError", "Episode", "OnlineCollector"]
