"""A stopwatch over the parts of a training step."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

__all__ = ["Stopwatch"]


class Stopwatch:
    """Sums wall-clock seconds and calls under names; survives a resume.

    Args:
        names: Those to report from the start, measured yet or not.
    """

    def __init__(self, names: Iterable[str] = ()) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(names, 0.0)
        self.calls: dict[str, int] = dict.fromkeys(names, 0)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Times the body of a ``with`` statement."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[name] = self.seconds.get(name, 0.0) + elapsed
            self.calls[name] = self.calls.get(name, 0) + 1

    def mean(self, name: str) -> float:
        """Mean seconds a call, 0 before the first."""
        return self.seconds.get(name, 0.0) / max(self.calls.get(name, 0), 1)

    @property
    def total(self) -> float:
        """Seconds under all names."""
        return sum(self.seconds.values())

    def summary(self) -> dict[str, float]:
        """Total minutes, and milliseconds a call of each part."""
        parts = {f"{name}_ms": 1e3 * self.mean(name) for name in sorted(self.seconds)}
        return {"minutes": self.total / 60} | parts

    def state_dict(self) -> dict[str, dict[str, float]]:
        """Sums and counts."""
        return {"seconds": dict(self.seconds), "calls": dict(self.calls)}

    def load_state_dict(self, state: dict[str, dict[str, float]]) -> None:
        """Restores what `state_dict` returned."""
        self.seconds = dict(state["seconds"])
        self.calls = {name: int(count) for name, count in state["calls"].items()}
