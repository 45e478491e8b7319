"""Bodies into PyBullet: one collision shape, or one picture, a body."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.objects import Body, ConvexPolyhedron


def load_collision_shape(client: Client, body: Body) -> int:
    """Returns the id of a collision shape: a box, a convex hull or a compound of hulls."""
    first = body.pieces[0]
    if len(body.pieces) == 1:
        if first.half_extents is not None:
            half = first.half_extents.tolist()
            return client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        return client.createCollisionShape(client.GEOM_MESH, vertices=first.vertices.tolist())
    with tempfile.TemporaryDirectory() as folder:
        # PyBullet makes a convex hull of each object of a file; a list of hulls it does not take.
        path = Path(folder) / "body.obj"
        path.write_text(_wavefront(body.pieces))
        return client.createCollisionShape(client.GEOM_MESH, fileName=str(path))


def load_placeholder(client: Client) -> int:
    """Returns the id of a visual shape that stands for a body's in a world without pictures.

    A body without one would read the file of its collision shape again, and draw it.
    """
    return client.createVisualShape(client.GEOM_BOX, halfExtents=(1e-3, 1e-3, 1e-3))


def load_body(client: Client, body: Body, shape: int, placeholder: int) -> int:
    """Returns the id of a new body.

    Args:
        client: where to.
        body: its mass, inertia and friction.
        shape: what `load_collision_shape` returned for it.
        placeholder: what `load_placeholder` returned.
    """
    loaded = client.createMultiBody(body.mass, shape, placeholder)
    client.changeDynamics(
        loaded,
        -1,
        lateralFriction=body.friction,
        rollingFriction=body.rolling_friction,
        spinningFriction=body.rolling_friction,
        # PyBullet takes that of the bounding box.
        localInertiaDiagonal=body.inertia.tolist(),
    )
    return loaded


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
