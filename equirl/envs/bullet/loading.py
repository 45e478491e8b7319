"""Bodies into PyBullet: to collide, or to be seen."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.objects import Body, ConvexPolyhedron, ObjectSet

__all__ = ["BodyLoader", "load_picture"]


class BodyLoader:
    """Makes bodies in a world; keeps what it writes for that until it is closed.

    Args:
        client: Where to.
        bodies: The bodies, by name.
    """

    def __init__(self, client: Client, bodies: ObjectSet):
        self._client = client
        self._bodies = bodies
        self._folder = tempfile.TemporaryDirectory(prefix="equirl_")
        #: A visual shape for bodies: without one they would be drawn from their collision shape.
        self.placeholder = -1

    def close(self) -> None:
        """Removes the files; harmless when done before."""
        self._folder.cleanup()

    def begin_world(self) -> None:
        """Prepares a world that has just been made."""
        self.placeholder = self._client.createVisualShape(
            self._client.GEOM_BOX, halfExtents=(1e-3, 1e-3, 1e-3)
        )

    def load(self, name: str, scale: float, pose: np.ndarray) -> int:
        """Returns the id of a new body at rest.

        Args:
            name: Which.
            scale: Its size relative to the body of that name; its mass is the same.
            pose: (x, y, z, qx, qy, qz, qw), m, shape (7,).
        """
        client, body = self._client, self._bodies[name]
        loaded = client.createMultiBody(
            body.mass,
            self._shape(body, scale),
            self.placeholder,
            basePosition=pose[:3].tolist(),
            baseOrientation=pose[3:].tolist(),
        )
        client.changeDynamics(
            loaded,
            -1,
            lateralFriction=body.friction,
            rollingFriction=body.rolling_friction,
            spinningFriction=body.rolling_friction,
            # PyBullet takes that of the bounding box.
            localInertiaDiagonal=(scale**2 * body.inertia).tolist(),
        )
        return loaded

    def _shape(self, body: Body, scale: float) -> int:
        first = body.pieces[0]
        if len(body.pieces) == 1 and first.half_extents is not None:
            half = (scale * first.half_extents).tolist()
            return self._client.createCollisionShape(self._client.GEOM_BOX, halfExtents=half)
        # Numbered: a user's mesh may have any name.
        return self.load_shape(str(list(self._bodies).index(body.name)), body.pieces, scale)

    def load_shape(
        self, label: str, pieces: tuple[ConvexPolyhedron, ...], scale: float = 1.0
    ) -> int:
        """Returns the id of the collision shape of convex pieces.

        PyBullet makes a convex hull of each object of a file. It takes no list of hulls, and leaks
        memory when it is given the corners of one.

        Args:
            label: Names the pieces: others must have another.
            pieces: The pieces.
            scale: Enlarges them about the origin.
        """
        path = Path(self._folder.name) / f"{label}.obj"
        if not path.exists():
            path.write_text(_wavefront(pieces))
        return self._client.createCollisionShape(
            self._client.GEOM_MESH, fileName=str(path), meshScale=[scale] * 3
        )


def load_picture(client: Client, body: Body) -> int:
    """Returns the id of a new body that is only seen, its faces shaded flat."""
    corners = np.concatenate([piece.vertices[piece.triangles] for piece in body.pieces])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    shape = client.createVisualShape(
        client.GEOM_MESH,
        vertices=corners.reshape(-1, 3).tolist(),
        indices=list(range(3 * len(corners))),
        normals=np.repeat(normals, 3, axis=0).tolist(),
        rgbaColor=body.color,
    )
    return client.createMultiBody(0, baseVisualShapeIndex=shape)


def _wavefront(pieces: tuple[ConvexPolyhedron, ...]) -> str:
    """Returns an OBJ file with one object a piece."""
    lines, start = [], 1
    for number, piece in enumerate(pieces):
        lines.append(f"o piece{number}")
        lines += ["v {!r} {!r} {!r}".format(*vertex) for vertex in piece.vertices.tolist()]
        lines += ["f {} {} {}".format(*row) for row in (piece.triangles + start).tolist()]
        start += len(piece.vertices)
    return "\n".join(lines) + "\n"
