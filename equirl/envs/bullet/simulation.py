"""The simulated cell: bin, bodies and robot, set from and read as a `Scene`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.bullet.loading import load_body, load_collision_shape, load_placeholder
from equirl.envs.bullet.models import robot_model
from equirl.envs.bullet.robot import Robot
from equirl.envs.objects import ObjectSet
from equirl.envs.scene import Scene
from equirl.envs.workspace import Workspace

TIME_STEP = 1 / 120
SOLVER_ITERATIONS = 20
# Contact normals with a smaller vertical part count as lateral, distances below this as touching.
_LATERAL_NORMAL = 0.2
_TOUCHING = 5e-4
# Objects are at rest when they move slower than this (m/s, rad/s) for so many steps.
_REST_SPEED, _REST_SPIN, _REST_STEPS = 0.005, 0.1, 4
_PATIENCE = 240  # steps after which objects count as settled although they move
_OUT_OF_THE_WAY = (0.0, 0.0, 0.45)  # of falling objects: where the robot waits, m
# PyBullet leaks a few kB for every body made and does not free shapes: connect anew after these.
_MAX_LOADS = 250


class Simulation:
    """A PyBullet world of its own; connects at once.

    The same sequence of calls gives the same bits in every process, and `place` leaves no trace of
    what went before it.

    Args:
        bodies: what scenes are made of, by name.
        robot: ``"panda"`` or ``"hand"``.
        workspace: dimensions of the cell.
    """

    def __init__(self, bodies: ObjectSet, robot: str, workspace: Workspace):
        self._bodies = bodies
        self._model = robot_model(robot, workspace)
        self._workspace = workspace
        self._connect()

    def _connect(self) -> None:
        self._client = client = Client()
        client.setGravity(0, 0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=SOLVER_ITERATIONS,
            deterministicOverlappingPairs=1,
            # Always all iterations: stopping at a residual was seen to depend on earlier episodes.
            solverResidualThreshold=0,
            enableFileCaching=0,  # or a shape would be that of an earlier file of the same name
        )
        self._load_bin()
        self._robot = Robot(client, self._model, TIME_STEP, self._workspace.max_aperture)
        self._placeholder = load_placeholder(client)
        self._shapes: dict[tuple[str, float], int] = {}
        self._present: tuple[tuple[str, float], ...] = ()  # name and scale of each object
        self._ids: list[int] = []
        self._loads = 0
        self._areas = np.zeros((0, 3))

    def close(self) -> None:
        """Disconnects; harmless when done before."""
        self._client.close()

    def place(self, scene: Scene) -> None:
        """Puts everything at rest into ``scene``, forgetting all contacts of the past.

        Args:
            scene: a state of bodies of this simulation.

        Raises:
            ValueError: if it has others.
        """
        scene = scene.named(self._bodies)
        self._load(tuple(zip(scene.names, scene.scales, strict=True)))
        # Cached contact points would otherwise warm-start the solver: part all bodies first.
        client = self._client
        for k, body in enumerate(self._ids):
            client.resetBasePositionAndOrientation(body, (5.0, 2.0 * k, 5.0), (0, 0, 0, 1))
            client.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))
        self._robot.place(scene.position, scene.yaw, scene.aperture, scene.grip)
        client.performCollisionDetection()
        for body, pose in zip(self._ids, scene.objects, strict=True):
            client.resetBasePositionAndOrientation(body, pose[:3].tolist(), pose[3:].tolist())
            client.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))
        client.performCollisionDetection()
        self._areas = scene.areas

    def scene(self) -> Scene:
        """Returns the measured state."""
        position, yaw, aperture = self._robot.pose()
        poses = [self._client.getBasePositionAndOrientation(body) for body in self._ids]
        return Scene(
            position=position,
            yaw=yaw,
            aperture=aperture,
            objects=np.array([(*where, *orientation) for where, orientation in poses]),
            grip=self._robot.grip_target,
            names=tuple(name for name, _ in self._present),
            scales=tuple(scale for _, scale in self._present),
            areas=self._areas,
        )

    def settled(self, scene: Scene) -> Scene:
        """Returns ``scene`` with its objects come to rest, the robot out of their way."""
        aside = np.array(_OUT_OF_THE_WAY)
        self.place(replace(scene, position=aside, yaw=0.0, aperture=0.0, grip=0.0))
        still = 0
        for _ in range(_PATIENCE):
            self._client.stepSimulation()
            still = 0 if self._in_motion() else still + 1
            if still == _REST_STEPS:
                break
        return replace(scene, objects=self.scene().objects)

    def dropped(self, scene: Scene) -> Scene:
        """Returns ``scene`` after its objects have fallen, each when those before it lie still."""
        scene = scene.named(self._bodies)
        resting = scene.objects[:0]
        for k, pose in enumerate(scene.objects):
            falling = replace(
                scene,
                objects=np.concatenate((resting, pose[None])),
                names=scene.names[: k + 1],
                scales=scene.scales[: k + 1],
            )
            resting = self.settled(falling).objects
        return replace(scene, objects=resting)

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
        """Returns the index of the object that the fingers squeeze, else None.

        Both touch it laterally, and from opposite sides: pushing with both is not holding.
        """
        for k, body in enumerate(self._ids):
            left, right = (self._lateral_normals(body, finger) for finger in self._robot.fingers)
            if any(a[0] * b[0] + a[1] * b[1] < 0 for a in left for b in right):
                return k
        return None

    def _lateral_normals(self, body: int, finger: int) -> list[tuple[float, float, float]]:
        """Returns the near-horizontal normals at the contacts of a body with a finger."""
        contacts = self._client.getContactPoints(self._robot.body, body, finger)
        normals = [contact[7] for contact in contacts if contact[8] < _TOUCHING]
        return [normal for normal in normals if abs(normal[2]) < _LATERAL_NORMAL]

    def touching(self, first: int, second: int) -> bool:
        """Tells whether two objects, by their indices, touch."""
        contacts = self._client.getContactPoints(self._ids[first], self._ids[second])
        return any(contact[8] < _TOUCHING for contact in contacts)

    def _in_motion(self) -> bool:
        for body in self._ids:
            linear, angular = self._client.getBaseVelocity(body)
            if max(map(abs, linear)) > _REST_SPEED or max(map(abs, angular)) > _REST_SPIN:
                return True
        return False

    def _load(self, wanted: tuple[tuple[str, float], ...]) -> None:
        """Makes the bodies of a scene, unless they are there."""
        if wanted == self._present:
            return
        if self._loads + len(wanted) > _MAX_LOADS:
            self._client.close()
            self._connect()
        for loaded in self._ids:
            self._client.removeBody(loaded)
        self._present, self._ids = (), []
        bodies = {key: self._bodies[key[0]].scaled(key[1]) for key in wanted}
        for key, body in bodies.items():
            if key not in self._shapes:
                self._shapes[key] = load_collision_shape(self._client, body)
        self._ids = [
            load_body(self._client, bodies[key], self._shapes[key], self._placeholder)
            for key in wanted
        ]
        self._present = wanted
        self._loads += len(wanted)

    def _load_bin(self) -> None:
        client, bin_ = self._client, self._workspace.bin
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
