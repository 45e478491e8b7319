"""Colour pictures for people; the policy never sees them."""

from __future__ import annotations

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.bullet.models import load_robot, robot_model
from equirl.envs.objects import Body
from equirl.envs.workspace import Workspace

_TABLE_COLOR = (0.93, 0.93, 0.91, 1.0)
_WALL_COLOR = (0.55, 0.65, 0.75, 1.0)


class Camera:
    """A second simulation with visual meshes that copies poses and is never stepped.

    The first one stays free of meshes (fast) and does not notice that pictures are taken.

    Args:
        bodies: as for `Simulation`.
        robot: as for `Simulation`.
        workspace: as for `Simulation`.
    """

    def __init__(self, bodies: tuple[Body, ...], robot: str, workspace: Workspace):
        self._client = client = Client()
        self._robot = load_robot(client, robot_model(robot, workspace), visual=True)
        self._add_bin(workspace)
        self._bodies = [self._add_body(body) for body in bodies]

    def close(self) -> None:
        """Disconnects; harmless when done before."""
        self._client.close()

    def picture(
        self, joints: np.ndarray, objects: np.ndarray, width: int, height: int
    ) -> np.ndarray:
        """Returns the picture of a state.

        Args:
            joints: values of all joints of the robot, shape (J,).
            objects: poses (x, y, z, qx, qy, qz, qw), shape (N, 7).
            width: pixels.
            height: pixels.

        Returns:
            Red, green, blue, shape (height, width, 3), uint8.
        """
        client = self._client
        for index, value in enumerate(joints):
            client.resetJointState(self._robot, index, value)
        for body, pose in zip(self._bodies, objects, strict=True):
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

    def _add_body(self, body: Body) -> int:
        client = self._client
        vertices, triangles = body.shape.vertices, body.shape.triangles
        # Own corners for each triangle, in outward order, so that faces are shaded flat.
        outward = _outward(vertices, triangles)
        corners = vertices[outward].reshape(-1, 3)
        normals = np.cross(corners[1::3] - corners[0::3], corners[2::3] - corners[0::3])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        shape = client.createVisualShape(
            client.GEOM_MESH,
            vertices=corners.tolist(),
            indices=list(range(len(corners))),
            normals=np.repeat(normals, 3, axis=0).tolist(),
            rgbaColor=body.color,
        )
        return client.createMultiBody(0, baseVisualShapeIndex=shape)


def _outward(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Orders triangles (T, 3) counter-clockwise as seen from outside."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - vertices.mean(0)) < 0
    ordered = triangles.copy()
    ordered[inward] = ordered[inward][:, ::-1]
    return ordered
