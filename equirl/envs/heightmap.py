"""The depth image: an orthographic z-buffer that commutes with the symmetries of the pixel grid.

Row index grows with world x, column index with world y; pixel (i, j) looks straight down at the
point ((i + 0.5 - S/2) side/S, (j + 0.5 - S/2) side/S) from the gripper. Everything is computed
relative to the gripper, pixels on an edge are covered (closed tests), and each expression is a sum
whose terms a quarter turn or a reflection only permutes or negates. A scene turned by +90 degrees
about the gripper (x towards y) gives ``new[i, j] = old[j, S - 1 - i]``, and its reflection in the
plane y = 0 the image with its columns flipped: bit for bit when the vertices are turned exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy import ndarray as Array

from equirl.envs.jit import compiled
from equirl.envs.objects import ObjectSet
from equirl.envs.scene import Area, Scene
from equirl.envs.workspace import Workspace

__all__ = ["Heightmap", "HeightmapSpec", "View"]

# Closed coverage tests allow this much (m), so that no seam opens between two triangles.
_EDGE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class HeightmapSpec:
    """What the picture shows and how (appendix of the paper, observation).

    Attributes:
        size: S, pixels along a side.
        side: Length of a side, m.
        max_depth: Depths are clipped to [0, max_depth], m.
        clearance: Surfaces above the end effector height minus this are clamped to it (m) ...
        min_ceiling: ... unless that is below this height (m).
        finger_length: Side of a drawn finger along the finger axis, m.
        finger_width: Side of a drawn finger across the finger axis, m.
    """

    size: int
    side: float
    max_depth: float = 0.32
    clearance: float = 0.01
    min_ceiling: float = 0.05
    finger_length: float = 0.015
    finger_width: float = 0.020


@dataclass(frozen=True, eq=False)
class View:
    """A scene reduced to what is drawn, free of trigonometry.

    Attributes:
        vertices: Of all bodies, relative to the end effector's x and y, shape (V, 3), m.
        triangles: Rows of three vertex indices, shape (T, 3).
        position: End effector position, shape (3,), m.
        finger_axis: Unit vector along the finger axis in the plane, shape (2,).
        aperture: Distance between the fingers, m.
        areas: One row (x, y, axis x, axis y) a marked square: its centre relative to the end
            effector, m, and the direction of a side, shape (M, 4).
    """

    vertices: np.ndarray
    triangles: np.ndarray
    position: np.ndarray
    finger_axis: np.ndarray
    aperture: float
    areas: np.ndarray


class Heightmap:
    """Draws scenes.

    Args:
        bodies: What scenes are made of, by name.
        spec: What the picture shows.
        workspace: Where the bin is.
        areas: The squares to mark, in the order of `Scene.areas`.
    """

    def __init__(
        self,
        bodies: ObjectSet,
        spec: HeightmapSpec,
        workspace: Workspace,
        areas: tuple[Area, ...] = (),
    ):
        self.spec = spec
        self._bodies = bodies
        bin_ = workspace.bin
        self._bin = np.array([bin_.floor_half_width, bin_.rim_half_width, bin_.rim_height])
        self._areas = np.array([(area.side / 2, area.raise_by) for area in areas]).reshape(-1, 2)
        # The geometry of the last scene; the next one's is mostly the same.
        self._geometry = self._join((), ())

    def draw(self, scene: Scene) -> np.ndarray:
        """Returns the depth below the end effector, shape (S, S), float32, m."""
        return self.draw_view(self.view(scene))

    def view(self, scene: Scene) -> View:
        """Returns what there is to draw of ``scene``."""
        scene = scene.named(self._bodies)
        if self._geometry.key != (scene.names, scene.scales):
            self._geometry = self._join(scene.names, scene.scales)
        local, owner = self._geometry.vertices, self._geometry.owner
        yaws = scene.areas[:, 2]
        centres = scene.areas[:, :2] - scene.position[:2]
        return View(
            vertices=_place(local, owner, scene.objects, scene.position),
            triangles=self._geometry.triangles,
            position=scene.position,
            finger_axis=np.array([np.cos(scene.yaw), np.sin(scene.yaw)]),
            aperture=scene.aperture,
            areas=np.column_stack((centres, np.cos(yaws), np.sin(yaws))),
        )

    def draw_view(self, view: View) -> np.ndarray:
        """Returns the depth below the end effector, shape (S, S), float32, m."""
        spec, position = self.spec, view.position
        depth = np.empty((spec.size, spec.size), np.float32)
        heights = np.empty((spec.size, spec.size))
        pitch = spec.side / spec.size
        ceiling = max(position[2] - spec.clearance, spec.min_ceiling)
        _draw_bin(heights, pitch, position[0], position[1], self._bin)
        _draw_triangles(heights, pitch, view.vertices, view.triangles)
        for (x, y, axis_x, axis_y), (half, raise_by) in zip(view.areas, self._areas, strict=True):
            _raise_square(heights, pitch, x, y, axis_x, axis_y, half, raise_by)
        _finish(heights, depth, position[2], ceiling, spec.max_depth)
        half_length, half_width = spec.finger_length / 2, spec.finger_width / 2
        centre = view.aperture / 2 + half_length
        _draw_fingers(depth, pitch, view.finger_axis, centre, half_length, half_width)
        return depth

    def _join(self, names: tuple[str, ...], scales: tuple[float, ...]) -> _Geometry:
        """Joins the bodies of a scene into one list of triangles."""
        vertices, owner, triangles, start = [np.zeros((0, 3))], [], [np.zeros((0, 3), int)], 0
        for number, (name, scale) in enumerate(zip(names, scales, strict=True)):
            for piece in self._bodies[name].scaled(scale).pieces:
                vertices.append(piece.vertices)
                triangles.append(piece.triangles + start)
                owner += [number] * len(piece.vertices)
                start += len(piece.vertices)
        return _Geometry(
            (names, scales),
            np.concatenate(vertices),
            np.array(owner, dtype=np.int64),
            np.concatenate(triangles).astype(np.int64),
        )


class _Geometry(NamedTuple):
    key: tuple[tuple[str, ...], tuple[float, ...]]
    vertices: np.ndarray  # in the frames of their bodies
    owner: np.ndarray  # the object each vertex belongs to
    triangles: np.ndarray


@compiled
def _place(local: Array, owner: Array, poses: Array, origin: Array) -> Array:
    """Moves body-frame vertices into the world, then relative to ``origin`` in x and y."""
    placed = np.empty_like(local)
    rotations = np.empty((len(poses), 3, 3))
    for k in range(len(poses)):
        x, y, z, w = poses[k, 3], poses[k, 4], poses[k, 5], poses[k, 6]
        rotations[k, 0] = (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w))
        rotations[k, 1] = (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w))
        rotations[k, 2] = (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y))
    for i in range(len(local)):
        k = owner[i]
        for axis in range(3):
            row = rotations[k, axis]
            turned = row[0] * local[i, 0] + row[1] * local[i, 1] + row[2] * local[i, 2]
            offset = poses[k, axis]
            if axis < 2:
                offset = offset - origin[axis]
            placed[i, axis] = turned + offset
    return placed


@compiled
def _draw_bin(
    heights: Array, pitch: float, origin_x: float, origin_y: float, profile: Array
) -> None:
    """Fills ``heights`` (S, S) with the bin: floor, sloping walls, and 0 outside."""
    size = heights.shape[0]
    floor, rim, top = profile
    for i in range(size):
        x = abs(origin_x + (i + 0.5 - size / 2) * pitch)
        for j in range(size):
            y = abs(origin_y + (j + 0.5 - size / 2) * pitch)
            out = max(x, y)
            if out <= floor or out > rim:
                heights[i, j] = 0.0
            else:
                heights[i, j] = top * ((out - floor) / (rim - floor))


@compiled
def _draw_triangles(heights: Array, pitch: float, vertices: Array, triangles: Array) -> None:
    """Raises ``heights`` (S, S) to the triangles seen from above; either winding is seen."""
    size = heights.shape[0]
    for t in range(len(triangles)):
        a, b, c = vertices[triangles[t, 0]], vertices[triangles[t, 1]], vertices[triangles[t, 2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        normal_z = ux * vy - uy * vx
        scale = abs(ux * vy) + abs(uy * vx)
        if abs(normal_z) <= 1e-7 * scale or scale == 0.0:
            continue  # seen edge-on: its neighbours cover its pixels
        slope_x = -(uy * vz - uz * vy) / normal_z
        slope_y = -(uz * vx - ux * vz) / normal_z
        sign = 1.0 if normal_z > 0 else -1.0
        ex, ey = c[0] - b[0], c[1] - b[1]
        tol_ab = -_EDGE_TOLERANCE * (abs(ux) + abs(uy))
        tol_bc = -_EDGE_TOLERANCE * (abs(ex) + abs(ey))
        tol_ca = -_EDGE_TOLERANCE * (abs(vx) + abs(vy))
        # One pixel more on each side: the closed tests decide, not the rounding of the box.
        low_i = int(np.floor(min(a[0], b[0], c[0]) / pitch + size / 2 - 0.5)) - 1
        high_i = int(np.ceil(max(a[0], b[0], c[0]) / pitch + size / 2 - 0.5)) + 1
        low_j = int(np.floor(min(a[1], b[1], c[1]) / pitch + size / 2 - 0.5)) - 1
        high_j = int(np.ceil(max(a[1], b[1], c[1]) / pitch + size / 2 - 0.5)) + 1
        for i in range(max(low_i, 0), min(high_i, size - 1) + 1):
            x = (i + 0.5 - size / 2) * pitch
            for j in range(max(low_j, 0), min(high_j, size - 1) + 1):
                y = (j + 0.5 - size / 2) * pitch
                px, py = x - a[0], y - a[1]
                if sign * (ux * py - uy * px) < tol_ab:
                    continue
                if sign * (vy * px - vx * py) < tol_ca:
                    continue
                if sign * (ex * (y - b[1]) - ey * (x - b[0])) < tol_bc:
                    continue
                height = a[2] + (slope_x * px + slope_y * py)
                if height > heights[i, j]:
                    heights[i, j] = height


@compiled
def _raise_square(
    heights: Array,
    pitch: float,
    centre_x: float,
    centre_y: float,
    axis_x: float,
    axis_y: float,
    half: float,
    raise_by: float,
) -> None:
    """Adds ``raise_by`` to ``heights`` (S, S) in a square whose sides run along the axis."""
    size = heights.shape[0]
    for i in range(size):
        x = (i + 0.5 - size / 2) * pitch - centre_x
        for j in range(size):
            y = (j + 0.5 - size / 2) * pitch - centre_y
            along = abs(x * axis_x + y * axis_y)
            across = abs(y * axis_x - x * axis_y)
            if max(along, across) <= half:
                heights[i, j] += raise_by


@compiled
def _finish(
    heights: Array, depth: Array, position_z: float, ceiling: float, max_depth: float
) -> None:
    """Turns heights into depths below the end effector, clamped and clipped."""
    size = heights.shape[0]
    for i in range(size):
        for j in range(size):
            value = position_z - min(heights[i, j], ceiling)
            depth[i, j] = min(max(value, 0.0), max_depth)


@compiled
def _draw_fingers(
    depth: Array, pitch: float, axis: Array, centre: float, half_length: float, half_width: float
) -> None:
    """Sets ``depth`` (S, S) to 0 under the two fingers."""
    size = depth.shape[0]
    reach = np.hypot(centre + half_length, half_width)
    low = max(int(np.floor(-reach / pitch + size / 2 - 0.5)), 0)
    high = min(int(np.ceil(reach / pitch + size / 2 - 0.5)), size - 1)
    for i in range(low, high + 1):
        x = (i + 0.5 - size / 2) * pitch
        for j in range(low, high + 1):
            y = (j + 0.5 - size / 2) * pitch
            along = abs(x * axis[0] + y * axis[1])
            across = abs(y * axis[0] - x * axis[1])
            if abs(along - centre) <= half_length and across <= half_width:
                depth[i, j] = 0.0
