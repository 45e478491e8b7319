"""Colour pictures for people; the policy never sees them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.bullet.floor import Floor, Viewpoint
from equirl.envs.bullet.loading import load_picture
from equirl.envs.bullet.models import ROBOTS, RobotLoader
from equirl.envs.objects import Body, ConvexPolyhedron, ObjectSet
from equirl.envs.objects.bodies import Color
from equirl.envs.scene import Area, Scene, yaw_quaternion
from equirl.envs.workspace import Workspace

__all__ = ["Camera"]

_WALL_COLOR: Color = (0.55, 0.65, 0.75, 1.0)
_FINGER_COLOR: Color = (0.25, 0.26, 0.30, 1.0)
_WALL_THICKNESS = 0.008  # m
_CELL = Viewpoint(eye=(0.56, -0.52, 0.82), target=(-0.06, 0.01, 0.13), angle=43.0)


class Camera:
    """A second simulation with visual meshes that copies poses and is never stepped.

    The first one stays free of meshes (fast) and does not notice that pictures are taken.

    Args:
        bodies: As for `Simulation`.
        areas: The squares that the task marks, in the order of `Scene.areas`.
        robot: As for `Simulation`; None: neither robot nor walls are shown.
        workspace: As for `Simulation`.
        view: Where pictures are taken from.
    """

    def __init__(
        self,
        bodies: ObjectSet,
        areas: tuple[Area, ...],
        robot: str | None,
        workspace: Workspace,
        view: Viewpoint = _CELL,
    ):
        self._bodies = bodies
        self._client = Client()
        self._floor = Floor(areas, workspace)
        self._background = lru_cache(maxsize=2)(self._floor.background)
        self._shown: dict[tuple[int, str, float], int] = {}
        self._view = view
        self._robot: int | None = None
        if robot is not None:
            loader = RobotLoader(self._client, ROBOTS[robot](workspace), visual=True)
            self._robot = loader.load()
            loader.close()
            self._color_fingers(self._robot)
            self._add_walls(workspace)

    def close(self) -> None:
        """Disconnects; harmless when done before."""
        self._client.close()

    def picture(self, joints: np.ndarray, scene: Scene, width: int, height: int) -> np.ndarray:
        """Returns the picture of a state.

        Args:
            joints: Values of all joints of the robot, shape (J,).
            scene: As `Simulation.scene` returns it.
            width: Pixels.
            height: Pixels.

        Returns:
            Red, green, blue, shape (height, width, 3), uint8.
        """
        client = self._client
        if self._robot is not None:
            for index, value in enumerate(joints):
                client.resetJointState(self._robot, index, value)
        for body, pose in zip(self._show(scene), scene.objects, strict=True):
            client.resetBasePositionAndOrientation(body, pose[:3].tolist(), pose[3:].tolist())
        fine = (2 * width, 2 * height)  # and then averaged: edges are not ragged
        pixels, empty = self._render(*fine)
        texture = self._floor.texture(scene, self._bodies, hand=self._robot is not None)
        floor = self._background(self._view, *fine).colors(texture)
        np.copyto(pixels, floor, where=empty[..., None])
        return _halved(pixels)

    def _render(self, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns colours (height, width, 3) and which pixels show no mesh (height, width)."""
        client, view = self._client, self._view
        turned = client.computeViewMatrix(view.eye, view.target, (0, 0, 1))
        projection = client.computeProjectionMatrixFOV(view.angle, width / height, 0.05, 5.0)
        _, _, pixels, depth, _ = client.getCameraImage(
            width,
            height,
            turned,
            projection,
            lightDirection=(0.6, -0.4, 1.2),
            renderer=client.ER_TINY_RENDERER,
            flags=client.ER_NO_SEGMENTATION_MASK,
        )
        colors = np.asarray(pixels, np.uint8).reshape(height, width, 4)[..., :3].copy()
        return colors, np.asarray(depth).reshape(height, width) >= 1.0

    def _color_fingers(self, robot: int) -> None:
        for index in range(self._client.getNumJoints(robot)):
            link = self._client.getJointInfo(robot, index)[12].decode()
            if link.endswith("finger"):
                self._client.changeVisualShape(robot, index, rgbaColor=_FINGER_COLOR)

    def _add_walls(self, workspace: Workspace) -> None:
        bin_, thick = workspace.bin, _WALL_THICKNESS
        ends = [(bin_.floor_half_width, 0.0), (bin_.rim_half_width, bin_.rim_height)]
        section = [*ends, *((x + thick, z) for x, z in ends)]
        corners = np.array([(x, y, z) for x, z in section for y in (-x, x)])
        wall = Body((ConvexPolyhedron.hull(corners),), mass=0, friction=0, color=_WALL_COLOR)
        for quarter in range(4):
            turn = yaw_quaternion(quarter * np.pi / 2)
            body = load_picture(self._client, wall)
            self._client.resetBasePositionAndOrientation(body, (0, 0, 0), turn.tolist())

    def _show(self, scene: Scene) -> list[int]:
        """Makes the pictures of a scene's objects, unless they are there; returns their ids."""
        keys = list(zip(range(len(scene.objects)), scene.names, scene.scales, strict=True))
        for key in self._shown.keys() - set(keys):
            self._client.removeBody(self._shown.pop(key))
        for key in keys:
            if key not in self._shown:
                _, name, scale = key
                self._shown[key] = load_picture(self._client, self._bodies[name].scaled(scale))
        return [self._shown[key] for key in keys]


def _halved(pixels: np.ndarray) -> np.ndarray:
    """Returns the means of squares of four pixels: (2 H, 2 W, 3) to (H, W, 3), uint8."""
    wide = pixels.astype(np.uint16)
    rows = wide[::2] + wide[1::2]
    return ((rows[:, ::2] + rows[:, 1::2] + 2) // 4).astype(np.uint8)
