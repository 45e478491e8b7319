"""Collectors of experience."""

from equirl.collectors.demonstrations import DemonstrationCollector, DemonstrationError
from equirl.collectors.online import OnlineCollector
from equirl.collectors.rollout import Episode

__all__ = ["DemonstrationCollector", "DemonstrationError", "Episode", "OnlineCollector"]
