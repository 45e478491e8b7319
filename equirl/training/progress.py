"""Progress bars of a run, on the terminal."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from equirl.collectors import Episode

__all__ = ["Progress"]

_RECENT = 20  # training episodes that are averaged for display


class Progress:
    """Shows how a run is getting on.

    Args:
        visible: Whether to show anything.
    """

    def __init__(self, visible: bool):
        self.visible = visible
        self.greedy = "-"  # success of the last validation
        self._recent: deque[Episode] = deque(maxlen=_RECENT)

    @contextmanager
    def bar(self, **options: Any) -> Iterator[tqdm]:
        """A bar to ``update``; ``options`` are those of tqdm."""
        pace = 0.1 if sys.stderr.isatty() else 30.0  # seconds between two looks of it
        with tqdm(dynamic_ncols=True, disable=not self.visible, mininterval=pace, **options) as bar:
            yield bar

    def note(self, episode: Episode) -> None:
        """Takes a training episode into the averages shown."""
        self._recent.append(episode)

    def advance(self, bar: tqdm, update_seconds: float) -> None:
        """Moves the training bar by one step."""
        if self._recent:
            count = len(self._recent)
            bar.set_postfix(
                {
                    "return": f"{sum(e.discounted_return for e in self._recent) / count:.2f}",
                    "success": f"{sum(e.success for e in self._recent) / count:.0%}",
                    "greedy": self.greedy,
                    "update": f"{update_seconds * 1e3:.0f}ms",
                },
                refresh=False,
            )
        bar.update(1)
