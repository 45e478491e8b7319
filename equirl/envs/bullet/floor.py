"""The floor in pictures for people: a grid, the marked areas, and shadows that tell heights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from equirl.envs.objects import ObjectSet
from equirl.envs.scene import Area, Scene
from equirl.envs.workspace import Workspace

__all__ = ["Background", "Floor", "Viewpoint"]

_FLOOR_COLOR = (0.80, 0.77, 0.70)
_LINE_COLOR = (0.72, 0.69, 0.62)
_AREA_COLOR = (0.35, 0.75, 0.45)
_TABLE_COLOR = (0.91, 0.91, 0.89)
_FAR = (0.8, 1.8)  # m from the origin, where the table fades to white
_PITCH = 1e-3  # side of a pixel of the texture, m
_LINE_WIDTH = 1.6e-3  # m
_HAND = (0.10, 0.03)  # half sides of the shadow of the hand, along the finger axis and across, m
_HAND_HEIGHT = 0.06  # of the hand above the end effector, m
_DARKNESS = 0.45  # share of the light that a shadow takes
_BLUR = 0.25  # width of a shadow's edge, in heights of what casts it
_SHARPEST = 0.006  # least width of a shadow's edge, m


@dataclass(frozen=True)
class Viewpoint:
    """Where a picture is taken from.

    Attributes:
        eye: M.
        target: A point in the middle of the picture, m.
        angle: Between its lower and its upper edge, degrees.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    angle: float

    def ground(self, width: int, height: int) -> np.ndarray:
        """Returns the point (x, y), m, of the plane z = 0 that each pixel shows.

        Returns:
            Shape (height, width, 2); infinite above the horizon.
        """
        eye = np.array(self.eye)
        ahead = np.array(self.target) - eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, (0, 0, 1))
        right /= np.linalg.norm(right)
        up = np.cross(right, ahead)
        scale = 2 * np.tan(np.radians(self.angle) / 2) / height
        across = (np.arange(width) + 0.5 - width / 2) * scale
        upward = (height / 2 - 0.5 - np.arange(height)) * scale
        rays = ahead + across[None, :, None] * right + upward[:, None, None] * up
        with np.errstate(divide="ignore", invalid="ignore"):
            points = eye[:2] - eye[2] * rays[..., :2] / rays[..., 2:]
        return np.where(rays[..., 2:] < 0, points, np.inf)


@dataclass(frozen=True, eq=False)
class Background:
    """A picture of the floor alone.

    Attributes:
        table: Colours of the table, shape (height, width, 3), uint8.
        inside: Which pixels show the bin's floor, shape (height, width).
        texel: The texture's pixels that these show, as indices into its rows, shape (P,).
    """

    table: np.ndarray
    inside: np.ndarray
    texel: np.ndarray

    def colors(self, texture: np.ndarray) -> np.ndarray:
        """Returns the picture with ``texture`` (N, N, 3), shape (height, width, 3), uint8."""
        picture = self.table.copy()
        picture[self.inside] = texture.reshape(-1, 3)[self.texel]
        return picture


class Floor:
    """Paints the floor.

    A square of the grid is as wide as one action moves the gripper. Light falls straight down.

    Args:
        areas: The squares to mark, in the order of `Scene.areas`.
        workspace: Where the bin is.
    """

    def __init__(self, areas: tuple[Area, ...], workspace: Workspace):
        self._areas = areas
        self._half = half = workspace.bin.floor_half_width
        self._count = count = round(2 * half / _PITCH)
        self._along = along = (np.arange(count) + 0.5) * (2 * half / count) - half
        step = workspace.position_step
        lined = np.abs(along - step * np.round(along / step)) < _LINE_WIDTH / 2
        lines = lined[:, None] | lined
        self._bare = np.where(lines[..., None], _LINE_COLOR, _FLOOR_COLOR)

    def background(self, view: Viewpoint, width: int, height: int) -> Background:
        """Returns what `texture` is to be looked up with for a picture of this size, pixels."""
        ground = view.ground(width, height)
        near, far = _FAR
        haze = np.clip((np.hypot(*np.moveaxis(ground, -1, 0)) - near) / (far - near), 0, 1)
        table = _TABLE_COLOR + haze[..., None] * (1 - np.array(_TABLE_COLOR))
        inside = (np.abs(ground) < self._half).all(-1)
        rows = np.floor((ground[inside] + self._half) * (self._count / (2 * self._half)))
        row, column = rows.astype(np.intp).clip(0, self._count - 1).T
        return Background(_as_bytes(table), inside, row * self._count + column)

    def texture(self, scene: Scene, bodies: ObjectSet, hand: bool = True) -> np.ndarray:
        """Returns the bin's floor from above, shape (N, N, 3), uint8; indices grow with x and y.

        Args:
            scene: What lies on it and hangs over it.
            bodies: What scenes are made of, by name.
            hand: Whether the robot's hand casts a shadow.
        """
        colors = self._bare.copy()
        for area, (x, y, yaw) in zip(self._areas, scene.areas.tolist(), strict=True):
            half = area.side / 2
            where, distance = self._distance(_rectangle(x, y, yaw, half, half), 0.0)
            colors[where][distance < 0] = _AREA_COLOR
        shadow = np.zeros((self._count, self._count))
        for name, scale, pose in zip(scene.names, scene.scales, scene.objects, strict=True):
            turn = Rotation.from_quat(pose[3:]).as_matrix().T * scale
            for piece in bodies[name].pieces:
                vertices = piece.vertices @ turn + pose[:3]
                self._shade(shadow, vertices[:, :2], vertices[:, 2].min())
        if hand:
            x, y, z = scene.position.tolist()
            self._shade(shadow, _rectangle(x, y, scene.yaw, *_HAND), z + _HAND_HEIGHT)
        # Shadows of pieces side by side add up at the seam.
        return _as_bytes(colors * (1 - _DARKNESS * np.minimum(shadow, 1))[..., None])

    def _shade(self, shadow: np.ndarray, points: np.ndarray, height: float) -> None:
        """Adds to ``shadow`` (N, N) that of the hull of ``points`` (P, 2), ``height`` m above."""
        width = max(_SHARPEST, _BLUR * height)
        where, distance = self._distance(points, width)
        shadow[where] += np.clip(0.5 - distance / width, 0, 1)

    def _distance(
        self, points: np.ndarray, margin: float
    ) -> tuple[tuple[slice, slice], np.ndarray]:
        """Measures how far the floor is from the hull of ``points`` (P, 2).

        Returns:
            The part of the texture within ``margin`` (m) of their bounding box, and there the
            distance (m); it is negative inside, and falls short beyond corners.
        """
        reach = np.stack((points.min(0) - margin, points.max(0) + margin))
        rows, columns = (slice(*each) for each in np.searchsorted(self._along, reach.T))
        x, y = self._along[rows, None], self._along[columns]
        distance = np.full(np.broadcast_shapes(x.shape, y.shape), -np.inf)
        for a, b, c in ConvexHull(points).equations.tolist():
            np.maximum(distance, a * x + b * y + c, out=distance)
        return (rows, columns), distance


def _rectangle(x: float, y: float, yaw: float, along: float, across: float) -> np.ndarray:
    """Returns the corners of a rectangle of half sides ``along`` and ``across`` yaw, (4, 2), m."""
    axis = np.array([np.cos(yaw), np.sin(yaw)])
    normal = np.array([-axis[1], axis[0]])
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return np.array([(x, y) + a * along * axis + b * across * normal for a, b in signs])


def _as_bytes(colors: np.ndarray) -> np.ndarray:
    """Returns colours in [0, 1] as uint8."""
    return (colors * 255 + 0.5).astype(np.uint8)
