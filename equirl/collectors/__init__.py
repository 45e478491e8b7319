"""Collectors of experience."""

from equirl.collectors.demonstrations import DemonstrationCollector

__all__ = ["DemonstrationCollector"]
