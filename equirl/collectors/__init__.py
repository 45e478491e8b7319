"""Collectors of experience."""

from equirl.collectors.demonstrations import DemonstrationCollector, DemonstrationError
from equirl.collectors.online import Episode, OnlineCollector

__all__ = ["DemonstrationCollector", "DemonstrationError", "Episode", "OnlineCollector"]
