"""What a task has to say; the environment knows no task by name."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from equirl.envs.objects import Body
from equirl.envs.scene import Scene


class Task(ABC):
    """A task: which bodies there are, where they start, what success is.

    Attributes:
        bodies: the bodies, in the order of `Scene.objects`; they collide and are drawn.
        view: length of a side of the depth image, m.
        margin: an object that is not held and leaves the workspace by more than this (m) ends the
            episode.
    """

    bodies: tuple[Body, ...]
    view: float
    margin: float

    @abstractmethod
    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Draws the poses at the start of an episode.

        Args:
            rng: the only source of randomness.

        Returns:
            One row (x, y, z, qx, qy, qz, qw) a body, shape (N, 7), m.
        """

    @abstractmethod
    def succeeded(self, scene: Scene, held: int | None) -> bool:
        """Judges the state at the end of a step.

        Args:
            scene: the measured state.
            held: index of the object that both fingers touch laterally, or None.
        """
