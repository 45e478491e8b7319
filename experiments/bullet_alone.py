"""PyBullet by itself: the simulation steps of an episode, and what they take and nothing else."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

from equirl.envs import ManipulationEnv, Scene

__all__ = ["count_simulated", "simulate"]


def count_simulated(env: ManipulationEnv) -> Iterator[int]:
    """Counts the simulation steps from now on; the next number tells how many there were."""
    client, count = env._connected()._client, itertools.count()
    plain = getattr(client.stepSimulation, "plain", client.stepSimulation)

    def step() -> None:
        next(count)
        plain()

    step.plain = plain  # type: ignore[attr-defined]
    client.__dict__["stepSimulation"] = step  # where the client keeps what it has found
    return count


def simulate(env: ManipulationEnv, scene: Scene, steps: int) -> float:
    """Returns the seconds that PyBullet alone takes for simulation steps of a scene."""
    env.set_scene(scene)
    step = env._connected()._client.stepSimulation.plain
    start = time.process_time()
    for _ in range(steps):
        step()
    return time.process_time() - start
