"""Colour pictures for people; the policy never sees them."""

from __future__ import annotations

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.bullet.loading import load_picture
from equirl.envs.bullet.models import load_robot, robot_model
from equirl.envs.objects import ObjectSet
from equirl.envs.scene import Area, Scene
from equirl.envs.workspace import Workspace

_TABLE_COLOR = (0.93, 0.93, 0.91, 1.0)
_WALL_COLOR = (0.55, 0.65, 0.75, 1.0)
_AREA_COLOR = (0.35, 0.75, 0.45, 1.0)


class Camera:
    """A second simulation with visual meshes that copies poses and is never stepped.

    The first one stays free of meshes (fast) and does not notice that pictures are taken.

    Args:
        bodies: as for `Simulation`.
        areas: the squares that the task marks, in the order of `Scene.areas`.
        robot: as for `Simulation`.
        workspace: as for `Simulation`.
    """

    def __init__(
        self, bodies: ObjectSet, areas: tuple[Area, ...], robot: str, workspace: Workspace
    ):
        self._bodies = bodies
        self._client = client = Client()
        self._robot = load_robot(client, robot_model(robot, workspace), visual=True)
        self._add_bin(workspace)
        self._areas = [self._add_area(area) for area in areas]
        self._shown: dict[tuple[int, str, float], int] = {}

    def close(self) -> None:
        """Disconnects; harmless when done before."""
        self._client.close()

    def picture(self, joints: np.ndarray, scene: Scene, width: int, height: int) -> np.ndarray:
        """Returns the picture of a state.

        Args:
            joints: values of all joints of the robot, shape (J,).
            scene: as `Simulation.scene` returns it.
            width: pixels.
            height: pixels.

        Returns:
            Red, green, blue, shape (height, width, 3), uint8.
        """
        client = self._client
        for index, value in enumerate(joints):
            client.resetJointState(self._robot, index, value)
        for body, (x, y, yaw) in zip(self._areas, scene.areas.tolist(), strict=True):
            turn = (0, 0, np.sin(yaw / 2), np.cos(yaw / 2))
            client.resetBasePositionAndOrientation(body, (x, y, 5e-4), turn)
        for body, pose in zip(self._show(scene), scene.objects, strict=True):
            client.resetBasePositionAndOrientation(body, pose[:3].tolist(), pose[3:].tolist())
        view = client.computeViewMatrix((0.85, -0.85, 0.75), (-0.14, 0.0, 0.22), (0, 0, 1))
        projection = client.computeProjectionMatrixFOV(45, width / height, 0.05, 5.0)
        pixels = client.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=(0.6, -0.4, 1.2),
            renderer=client.ER_TINY_RENDERER,
            flags=client.ER_NO_SEGMENTATION_MASK,
        )[2]
        return np.asarray(pixels, np.uint8).reshape(height, width, 4)[..., :3].copy()

    def _add_bin(self, workspace: Workspace) -> None:
        client, bin_ = self._client, workspace.bin
        table = client.createVisualShape(
            client.GEOM_BOX, halfExtents=(0.8, 0.6, 0.01), rgbaColor=_TABLE_COLOR
        )
        client.createMultiBody(0, baseVisualShapeIndex=table, basePosition=(-0.2, 0, -0.011))
        inner, rim, top = bin_.floor_half_width, bin_.rim_half_width, bin_.rim_height
        corners = [(inner, -inner, 0), (inner, inner, 0), (rim, rim, top), (rim, -rim, top)]
        wall = client.createVisualShape(
            client.GEOM_MESH,
            vertices=corners,
            indices=[0, 1, 2, 0, 2, 3, 2, 1, 0, 3, 2, 0],  # seen from both sides
            rgbaColor=_WALL_COLOR,
        )
        for quarter in range(4):
            turn = (0, 0, np.sin(quarter * np.pi / 4), np.cos(quarter * np.pi / 4))
            client.createMultiBody(0, baseVisualShapeIndex=wall, baseOrientation=turn)

    def _add_area(self, area: Area) -> int:
        half = area.side / 2
        shape = self._client.createVisualShape(
            self._client.GEOM_BOX, halfExtents=(half, half, 4e-4), rgbaColor=_AREA_COLOR
        )
        return self._client.createMultiBody(0, baseVisualShapeIndex=shape)

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
