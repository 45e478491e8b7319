"""What a task has to say; the environment knows no task by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np

from equirl.envs.expert import Expert
from equirl.envs.objects import Body, ObjectSet
from equirl.envs.scene import Area, Scene, yaw_quaternion

__all__ = ["PlacementError", "State", "Task", "lying", "rejection_sample"]

_BATCH = 256  # points drawn at a time


class PlacementError(RuntimeError):
    """No scene could be made of the task's numbers; the message says after how many tries."""


@dataclass(frozen=True)
class State:
    """What is judged at the end of a step.

    Attributes:
        scene: The measured poses.
        held: Index of the object that the fingers squeeze, or None.
        touching: Tells whether the objects of two indices touch each other.
    """

    scene: Scene
    held: int | None
    touching: Callable[[int, int], bool]


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """A task: which bodies there are, where they start, what success is, who can show it.

    The fields of a task are its numbers (m, kg, rad), checked at construction.

    Attributes:
        view: Length of a side of the depth image, m.
        margin: An object that is not held and leaves the workspace by more than this (m) ends the
            episode.
        start_half_width: Positions are drawn within +-this of the centre, m.
        start_yaw: Yaws are drawn within +-this, rad.
        placement_tries: Draws of a scene before `PlacementError`.
        max_scene_episodes: A scene is given up after so many episodes, of which each reset begins
            one: with 1, each draws a new scene. 0: when `continued` says so.
    """

    view: float = 0.30
    margin: float = 0.0
    start_half_width: float = 0.09
    start_yaw: float = np.pi / 4
    placement_tries: int = 20_000
    max_scene_episodes: int = 0

    #: Options that the paper's own implementation runs with, for ``mode=paper``.
    paper_options: ClassVar[Mapping[str, Any]] = {}
    #: Whether objects are dropped where `sample` puts them, one by one, and come to rest.
    drops_objects: ClassVar[bool] = False
    #: The areas marked in the depth image, in the order of `Scene.areas`.
    areas: ClassVar[tuple[Area, ...]] = ()

    def __post_init__(self) -> None:
        self.require_positive("view", "placement_tries")
        self.require_non_negative("margin", "start_half_width", "start_yaw", "max_scene_episodes")

    @property
    @abstractmethod
    def bodies(self) -> ObjectSet:
        """The bodies that scenes are made of."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, home: Scene) -> Scene:
        """Draws a new scene.

        Args:
            rng: The only source of randomness.
            home: The robot at the start of an episode, without objects.

        Returns:
            ``home`` with objects and areas.

        Raises:
            PlacementError: If they do not fit.
        """

    @abstractmethod
    def succeeded(self, state: State) -> bool:
        """Judges the state at the end of a step."""

    @property
    def expert(self) -> type[Expert] | None:
        """The task's scripted planner, if it has one."""
        return None

    def continued(self, state: State, succeeded: bool) -> Scene | None:
        """Returns what the next episode of the same scene starts with.

        It is not asked when an object was lost, or after `max_scene_episodes`.

        Args:
            state: The end of the last episode.
            succeeded: Whether that was a success.

        Returns:
            The scene (its gripper is sent home), or None for a new scene: the default.
        """
        return None

    def require_below(self, name: str, limit: float, what: str) -> None:
        """Refuses the value of a field of ``limit`` or more; ``what`` says what that is."""
        self.require(name, self._number(name) < limit, f"less than {limit:g}, {what}")

    def require(self, name: str, valid: bool, expected: str) -> None:
        """Refuses the value of a field unless ``valid``."""
        if not valid:
            raise ValueError(f"{name} must be {expected}, got {getattr(self, name)!r}")

    def require_positive(self, *names: str) -> None:
        """Refuses fields that are not positive, finite numbers of the type of their default."""
        for name in names:
            self.require(name, self._number(name) > 0, f"{self._kind(name)} above 0")

    def require_non_negative(self, *names: str) -> None:
        """Refuses fields that are not finite numbers, 0 or more, of the type of their default."""
        for name in names:
            self.require(name, self._number(name) >= 0, f"{self._kind(name)}, 0 or more")

    def _kind(self, name: str) -> str:
        (default,) = (each.default for each in fields(self) if each.name == name)
        return "an integer" if isinstance(default, int) else "a finite number"

    def _number(self, name: str) -> float:
        """Returns the value of a field, or -inf when it is no number of the right kind."""
        value = getattr(self, name)
        allowed = Integral if self._kind(name) == "an integer" else Real
        right = isinstance(value, allowed) and not isinstance(value, bool)
        return value if right and np.isfinite(value) else -np.inf


def rejection_sample(
    rng: np.random.Generator,
    half_widths: Sequence[float],
    accept: Callable[[np.ndarray], np.ndarray],
    tries: int,
    what: str,
) -> np.ndarray:
    """Returns the first of uniformly drawn points that is accepted.

    Args:
        rng: The only source of randomness.
        half_widths: Coordinate k is drawn within +-``half_widths[k]``, D of them.
        accept: Tells of points (N, D) which are accepted, (N,).
        tries: How many are drawn at most.
        what: What is looked for, for the message.

    Returns:
        The point, shape (D,).

    Raises:
        PlacementError: If none of ``tries`` points is accepted.
    """
    wide = np.asarray(half_widths)
    for start in range(0, tries, _BATCH):
        points = rng.uniform(-wide, wide, size=(min(_BATCH, tries - start), len(wide)))
        accepted = np.flatnonzero(accept(points))
        if len(accepted):
            return points[accepted[0]]
    raise PlacementError(f"no place in {tries} tries for {what}")


def lying(body: Body, x: float, y: float, yaw: float) -> np.ndarray:
    """Returns the pose (7,) of ``body`` on the floor, upright, at (x, y) m and ``yaw`` rad."""
    lowest = body.vertices[:, 2].min()
    return np.array([x, y, -lowest, *yaw_quaternion(yaw)])
