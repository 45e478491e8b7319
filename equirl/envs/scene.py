"""A scene as a plain value: what has to be known to put a simulation into a state at rest."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

__all__ = ["Area", "Scene", "yaw_quaternion"]


@dataclass(frozen=True)
class Area:
    """A square marked in the depth image, by adding to the height of what lies in it.

    Attributes:
        side: M.
        raise_by: Height added, m.
    """

    side: float
    raise_by: float


@dataclass(frozen=True, eq=False)
class Scene:
    """Poses of the gripper and of the objects, and marked areas; everything is at rest.

    Lengths in metres, angles in radians, in the frame of `equirl.envs.workspace.Workspace` (origin
    at the centre of the floor of the bin, z up).

    Attributes:
        position: End effector position, shape (3,).
        yaw: Angle from world x to the finger axis, about world z; unbounded.
        aperture: Distance between the fingers.
        objects: One row (x, y, z, qx, qy, qz, qw) an object, shape (N, 7).
        grip: Aperture the gripper is driven to; smaller than `aperture` when it squeezes an object.
            Defaults to `aperture`.
        names: What each object is, N names of the task's bodies. Empty: its first N, in order.
        scales: Size of each object relative to the task's body, N numbers. Empty: all 1.
        areas: One row (x, y, yaw) for the centre of each area the task marks, shape (M, 3).
    """

    position: np.ndarray
    yaw: float
    aperture: float
    objects: np.ndarray
    grip: float = None  # type: ignore[assignment]  # replaced by the aperture
    names: tuple[str, ...] = ()
    scales: tuple[float, ...] = ()
    areas: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        position = _frozen(self.position)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ValueError(f"position must be three finite numbers (m), got {self.position!r}")
        objects = _rows("objects", self.objects, 7, "(x, y, z, qx, qy, qz, qw)")
        areas = _rows("areas", self.areas, 3, "(x, y, yaw)")
        norms = np.linalg.norm(objects[:, 3:], axis=1)
        if np.any(np.abs(norms - 1) > 1e-3):
            raise ValueError(f"object quaternions must have norm 1, got norms {norms}")
        grip = self.aperture if self.grip is None else self.grip
        for name, value in (("yaw", self.yaw), ("aperture", self.aperture), ("grip", grip)):
            if not np.isfinite(value):
                raise ValueError(f"{name} must be finite, got {value!r}")
            object.__setattr__(self, name, float(value))
        scales = tuple(map(float, self.scales)) or (1.0,) * len(objects)
        for name, values in (("names", self.names or scales), ("scales", scales)):
            if len(values) != len(objects):
                raise ValueError(f"{len(objects)} objects but {len(values)} {name}: {values}")
        if not all(0 < scale < np.inf for scale in scales):
            raise ValueError(f"scales must be positive, got {scales}")
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "objects", objects)
        object.__setattr__(self, "areas", areas)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "scales", scales)

    def __eq__(self, other: object) -> bool:
        """Bit-equality of all values."""
        if not isinstance(other, Scene):
            return NotImplemented
        return all(
            np.array_equal(getattr(self, each.name), getattr(other, each.name))
            for each in fields(self)
        )

    def named(self, known: Collection[str]) -> Scene:
        """Returns the scene with the name of each object.

        Args:
            known: The names there are; an object without one takes its place in this order.

        Raises:
            ValueError: If a name is unknown, or unnamed objects are more than names.
        """
        for name in self.names:
            if name not in known:
                raise ValueError(f"the scene has an unknown object {name!r}; known: {known!r}")
        if self.names:
            return self
        if len(self.objects) > len(known):
            raise ValueError(f"the scene has {len(self.objects)} objects, the task {len(known)}")
        return replace(self, names=tuple(known)[: len(self.objects)])

    def without(self, index: int) -> Scene:
        """Returns the scene without one of its objects."""
        kept = [k for k in range(len(self.objects)) if k != index]
        return replace(
            self,
            objects=self.objects[kept],
            names=tuple(self.names[k] for k in kept) if self.names else (),
            scales=tuple(self.scales[k] for k in kept),
        )

    def as_dict(self) -> dict[str, Any]:
        """Returns the scene as a dictionary of lists and floats, ready for JSON."""
        return {
            key: value.tolist() if isinstance(value, np.ndarray) else value
            for key, value in asdict(self).items()
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Scene:
        """Inverse of `as_dict`, bit for bit."""
        return cls(**values)


def yaw_quaternion(yaw: float | np.ndarray) -> np.ndarray:
    """Returns the orientations (..., 4) of upright bodies of ``yaw`` (...), rad; see `Scene`."""
    half = np.asarray(yaw) / 2
    zero = np.zeros_like(half)
    return np.stack((zero, zero, np.sin(half), np.cos(half)), axis=-1)


def _frozen(values: Any) -> np.ndarray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _rows(name: str, values: Any, width: int, meaning: str) -> np.ndarray:
    rows = _frozen(values)
    if rows.size == 0:
        rows = _frozen(np.zeros((0, width)))
    if rows.ndim != 2 or rows.shape[1] != width or not np.isfinite(rows).all():
        raise ValueError(
            f"{name} must be finite rows {meaning}, got an array of shape {rows.shape}: {values!r}"
        )
    return rows
