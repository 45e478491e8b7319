"""A scene as a plain value: what has to be known to put a simulation into a state at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class Scene:
    """Poses of the gripper and of the objects; everything is at rest.

    Lengths in metres, angles in radians, in the frame of `equirl.envs.workspace.Workspace` (origin
    at the centre of the floor of the bin, z up).

    Attributes:
        position: end effector position, shape (3,).
        yaw: angle from world x to the finger axis, about world z; unbounded.
        aperture: distance between the fingers.
        objects: one row (x, y, z, qx, qy, qz, qw) an object, shape (N, 7), in the task's order.
        grip: aperture the gripper is driven to; smaller than `aperture` when it squeezes an object.
            Defaults to `aperture`.
    """

    position: np.ndarray
    yaw: float
    aperture: float
    objects: np.ndarray
    grip: float = None  # type: ignore[assignment]  # replaced by the aperture

    def __post_init__(self) -> None:
        position = _frozen(self.position)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ValueError(f"position must be three finite numbers (m), got {self.position!r}")
        objects = _frozen(self.objects)
        if objects.size == 0:
            objects = _frozen(np.zeros((0, 7)))
        if objects.ndim != 2 or objects.shape[1] != 7 or not np.isfinite(objects).all():
            raise ValueError(
                "objects must be finite rows (x, y, z, qx, qy, qz, qw), "
                f"got an array of shape {objects.shape}: {self.objects!r}"
            )
        norms = np.linalg.norm(objects[:, 3:], axis=1)
        if np.any(np.abs(norms - 1) > 1e-3):
            raise ValueError(f"object quaternions must have norm 1, got norms {norms}")
        for name in ("yaw", "aperture"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)!r}")
        grip = self.aperture if self.grip is None else self.grip
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "objects", objects)
        object.__setattr__(self, "yaw", float(self.yaw))
        object.__setattr__(self, "aperture", float(self.aperture))
        object.__setattr__(self, "grip", float(grip))

    def __eq__(self, other: object) -> bool:
        """Bit-equality of all values."""
        if not isinstance(other, Scene):
            return NotImplemented
        return (
            np.array_equal(self.position, other.position)
            and np.array_equal(self.objects, other.objects)
            and (self.yaw, self.aperture, self.grip) == (other.yaw, other.aperture, other.grip)
        )

    def turned(self, angle: float) -> Scene:
        """Returns the scene turned by ``angle`` (rad) about the vertical through the origin.

        Multiples of a quarter turn move the positions exactly (no cosine is taken).
        """
        turn = Rotation.from_euler("z", angle)
        return replace(
            self,
            position=_turn_points(self.position[None], angle)[0],
            yaw=self.yaw + angle,
            objects=np.concatenate(
                (
                    _turn_points(self.objects[:, :3], angle),
                    _compose(turn, self.objects[:, 3:]),
                ),
                axis=1,
            ),
        )

    def reflected(self) -> Scene:
        """Returns the scene mirrored in the plane y = 0.

        An object's mirror image is again a pose of that object only if its own shape has the
        mirror plane y = 0 (a box, a body of revolution about its x or z axis).
        """
        mirror = np.array([1.0, -1.0, 1.0])
        objects = self.objects.copy()
        objects[:, :3] *= mirror
        # M R M for M = diag(1, -1, 1): the axis is a pseudo-vector.
        objects[:, 3:] *= np.array([-1.0, 1.0, -1.0, 1.0])
        return replace(self, position=self.position * mirror, yaw=-self.yaw, objects=objects)

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


def _frozen(values: Any) -> np.ndarray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _turn_points(points: np.ndarray, angle: float) -> np.ndarray:
    quarters = round(angle / (np.pi / 2))
    x, y, z = points.T
    if abs(angle - quarters * np.pi / 2) < 1e-12:
        x, y = ((x, y), (-y, x), (-x, -y), (y, -x))[quarters % 4]
    else:
        cos, sin = np.cos(angle), np.sin(angle)
        x, y = cos * x - sin * y, sin * x + cos * y
    return np.stack((x, y, z), axis=1)


def _compose(turn: Rotation, quaternions: np.ndarray) -> np.ndarray:
    if len(quaternions) == 0:
        return np.zeros((0, 4))
    return (turn * Rotation.from_quat(quaternions)).as_quat()
