"""The simulated cell: bin, bodies and robot, set from and read as a `Scene`."""

from __future__ import annotations

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.bullet.models import robot_model
from equirl.envs.bullet.robot import Robot
from equirl.envs.objects import Body
from equirl.envs.scene import Scene
from equirl.envs.workspace import Workspace

TIME_STEP = 1 / 120
SOLVER_ITERATIONS = 20
# Contact normals with a smaller vertical part count as lateral, distances below this as touching.
_LATERAL_NORMAL = 0.2
_TOUCHING = 5e-4


class Simulation:
    """A PyBullet world of its own; connects at once.

    The same sequence of calls gives the same bits in every process, and `place` leaves no trace of
    what went before it.

    Args:
        bodies: what to load, in the order of `Scene.objects`.
        robot: ``"panda"`` or ``"hand"``.
        workspace: dimensions of the cell.
    """

    def __init__(self, bodies: tuple[Body, ...], robot: str, workspace: Workspace):
        self._client = client = Client()
        client.setGravity(0, 0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=SOLVER_ITERATIONS,
            deterministicOverlappingPairs=1,
            # Always all iterations: stopping at a residual was seen to depend on earlier episodes.
            solverResidualThreshold=0,
        )
        self._load_bin(workspace)
        model = robot_model(robot, workspace)
        self._robot = Robot(client, model, TIME_STEP, workspace.max_aperture)
        self._bodies = [self._load_body(body) for body in bodies]

    def close(self) -> None:
        """Disconnects; harmless when done before."""
        self._client.close()

    def place(self, scene: Scene) -> None:
        """Puts everything at rest into ``scene``, forgetting all contacts of the past.

        Raises:
            ValueError: if the scene has another number of objects than was loaded.
        """
        if len(scene.objects) != len(self._bodies):
            raise ValueError(
                f"the scene has {len(scene.objects)} objects, the task has {len(self._bodies)}"
            )
        # Cached contact points would otherwise warm-start the solver: part all bodies first.
        client = self._client
        for k, body in enumerate(self._bodies):
            client.resetBasePositionAndOrientation(body, (5.0, 2.0 * k, 5.0), (0, 0, 0, 1))
            client.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))
        self._robot.place(scene.position, scene.yaw, scene.aperture, scene.grip)
        client.performCollisionDetection()
        for body, pose in zip(self._bodies, scene.objects, strict=True):
            client.resetBasePositionAndOrientation(body, pose[:3].tolist(), pose[3:].tolist())
            client.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))
        client.performCollisionDetection()

    def scene(self) -> Scene:
        """Returns the measured state."""
        position, yaw, aperture = self._robot.pose()
        poses = [self._client.getBasePositionAndOrientation(body) for body in self._bodies]
        objects = [(*where, *orientation) for where, orientation in poses]
        return Scene(position, yaw, aperture, np.array(objects), self._robot.grip_target)

    def joint_values(self) -> np.ndarray:
        """Returns the values of all joints of the robot."""
        return self._robot.joint_values()

    def act(self, position: np.ndarray, yaw: float, aperture: float) -> None:
        """Moves the end effector, then the gripper.

        Args:
            position: where to, shape (3,), m.
            yaw: final yaw, rad.
            aperture: final aperture, m.
        """
        self._robot.move(position, yaw, self._client.stepSimulation)
        self._robot.grip(aperture, self._client.stepSimulation)

    def held(self) -> int | None:
        """Returns the index of the object that both fingers touch laterally, else None."""
        left, right = self._robot.fingers
        for k, body in enumerate(self._bodies):
            touching = {
                contact[3]
                for contact in self._client.getContactPoints(self._robot.body, body)
                if contact[8] < _TOUCHING and abs(contact[7][2]) < _LATERAL_NORMAL
            }
            if left in touching and right in touching:
                return k
        return None

    def _load_bin(self, workspace: Workspace) -> None:
        client, bin_ = self._client, workspace.bin
        depth = 0.25
        half = (1.0, 1.0, depth / 2)
        shape = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        floor = client.createMultiBody(0, shape, basePosition=(0, 0, -depth / 2))
        client.changeDynamics(floor, -1, lateralFriction=bin_.floor_friction)
        # A wall is a wedge, mitred at the corners; four turned copies.
        inner, rim, outer = bin_.floor_half_width, bin_.rim_half_width, bin_.rim_half_width + 0.005
        section = ((inner, 0.0), (rim, bin_.rim_height), (outer, bin_.rim_height), (outer, -0.05))
        corners = [(r, side * r, z) for r, z in section for side in (-1, 1)]
        shape = client.createCollisionShape(client.GEOM_MESH, vertices=corners)
        for quarter in range(4):
            turn = (0, 0, np.sin(quarter * np.pi / 4), np.cos(quarter * np.pi / 4))
            wall = client.createMultiBody(0, shape, baseOrientation=turn)
            client.changeDynamics(wall, -1, lateralFriction=bin_.wall_friction)

    def _load_body(self, body: Body) -> int:
        client = self._client
        if body.shape.half_extents is not None:
            geometry = {"halfExtents": body.shape.half_extents.tolist()}
            shape = client.createCollisionShape(client.GEOM_BOX, **geometry)
        else:
            corners = body.shape.vertices.tolist()
            shape = client.createCollisionShape(client.GEOM_MESH, vertices=corners)
        loaded = client.createMultiBody(body.mass, shape)
        client.changeDynamics(loaded, -1, lateralFriction=body.friction)
        return loaded
