"""The simulated cell: bin, bodies and robot, set from and read as a `Scene`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.bullet.loading import BodyLoader
from equirl.envs.bullet.models import ROBOTS, RobotLoader
from equirl.envs.bullet.robot import Robot
from equirl.envs.objects import ConvexPolyhedron, ObjectSet
from equirl.envs.scene import Scene, yaw_quaternion
from equirl.envs.workspace import Bin, Workspace

__all__ = ["SOLVER_ITERATIONS", "TIME_STEP", "Simulation"]

# Measured: with steps of 1/60 s a grasped cube slips by 20 mm; 10 iterations are marginal, 5 lose
# every grasp.
TIME_STEP = 1 / 120  # s
SOLVER_ITERATIONS = 20
# Contact normals with a smaller vertical part count as lateral, as in the paper's implementation.
_LATERAL_NORMAL = 0.2
# The rest is chosen.
_TOUCHING = 5e-4  # bodies nearer than this touch, m
_OPPOSED = -0.5  # greatest product of the normals of two fingers that squeeze
# Objects are at rest when they move slower than this (m/s, rad/s) for so many steps.
_REST_SPEED, _REST_SPIN, _REST_STEPS = 0.005, 0.1, 4
_PATIENCE = 240  # steps after which objects count as settled although they move: 2 s
# Where the robot waits, out of the way of falling objects, m: they are dropped from below it.
_OUT_OF_THE_WAY = (0.0, 0.0, 0.45)


class Simulation:
    """A PyBullet world of its own; connects at once.

    Each scene begins in a world made anew, so that it plays the same bits in every process and
    whatever was simulated before: what Bullet remembers of earlier pairs and contacts changes the
    order of its sums otherwise.

    Args:
        bodies: What scenes are made of, by name.
        robot: One of `ROBOTS`.
        workspace: Dimensions of the cell.
    """

    def __init__(self, bodies: ObjectSet, robot: str, workspace: Workspace):
        self._bodies = bodies
        self._model = ROBOTS[robot](workspace)
        self._workspace = workspace
        self._wall = _wall(workspace.bin)
        self._client = Client()
        self._loader = BodyLoader(self._client, bodies)
        self._robot_loader = RobotLoader(self._client, self._model)
        self._make_world()

    def _make_world(self) -> None:
        client = self._client
        client.resetSimulation()
        client.setGravity(0, 0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=SOLVER_ITERATIONS,
            deterministicOverlappingPairs=1,
            # Always all iterations: stopping at a residual was seen to depend on earlier episodes.
            solverResidualThreshold=0,
            enableFileCaching=0,  # or a shape would be that of an earlier file of the same name
        )
        self._loader.begin_world()
        self._load_bin()
        self._robot = Robot(client, self._robot_loader, TIME_STEP, self._workspace.max_aperture)
        self._present: list[tuple[str, float]] = []  # name and scale of each object
        self._ids: list[int] = []
        self._areas = np.zeros((0, 3))

    def _add(self, name: str, scale: float, pose: np.ndarray) -> None:
        self._ids.append(self._loader.load(name, scale, pose))
        self._present.append((name, scale))

    def close(self) -> None:
        """Disconnects; harmless when done before."""
        self._client.close()
        self._loader.close()
        self._robot_loader.close()

    def place(self, scene: Scene) -> None:
        """Puts everything at rest into ``scene``, in a world made anew.

        Args:
            scene: A state of bodies of this simulation.

        Raises:
            ValueError: If it has others.
        """
        scene = scene.named(self._bodies)
        self._make_world()
        self._robot.place(scene.position, scene.yaw, scene.aperture, scene.grip)
        for name, scale, pose in zip(scene.names, scene.scales, scene.objects, strict=True):
            self._add(name, scale, pose)
        self._client.performCollisionDetection()
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

    def settled(self, scene: Scene, *, one_by_one: bool = False) -> Scene:
        """Returns ``scene`` with its objects come to rest, the robot out of their way.

        Args:
            scene: Where the objects start; its gripper is kept.
            one_by_one: Let each fall when those before it lie still.
        """
        scene = scene.named(self._bodies)
        self._make_world()
        self._robot.place(np.array(_OUT_OF_THE_WAY), 0.0, 0.0, 0.0)
        for name, scale, pose in zip(scene.names, scene.scales, scene.objects, strict=True):
            self._add(name, scale, pose)
            if one_by_one:
                self._wait()
        if not one_by_one:
            self._wait()
        return replace(scene, objects=self.scene().objects)

    def _wait(self) -> None:
        """Simulates until the objects lie still, or until patience ends."""
        still = 0
        for _ in range(_PATIENCE):
            self._client.stepSimulation()
            still = 0 if self._in_motion() else still + 1
            if still == _REST_STEPS:
                return

    def joint_values(self) -> np.ndarray:
        """Returns the values of all joints of the robot."""
        return self._robot.joint_values()

    def act(self, position: np.ndarray, yaw: float, aperture: float) -> None:
        """Moves the end effector, then the gripper.

        Args:
            position: Where to, shape (3,), m.
            yaw: Final yaw, rad.
            aperture: Final aperture, m.
        """
        self._robot.move(position, yaw, self._client.stepSimulation)
        self._robot.grip(aperture, self._client.stepSimulation)

    def held(self) -> int | None:
        """Returns the index of the object that the fingers squeeze, else None.

        Both touch it laterally, and from opposite sides: pushing with both is not holding.
        """
        for k, body in enumerate(self._ids):
            left, right = (self._lateral_normals(body, finger) for finger in self._robot.fingers)
            if any(np.dot(a, b) < _OPPOSED for a in left for b in right):
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

    def _load_bin(self) -> None:
        client, bin_ = self._client, self._workspace.bin
        depth = 0.25
        half = (1.0, 1.0, depth / 2)
        shape = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        unseen = self._loader.placeholder
        floor = client.createMultiBody(0, shape, unseen, basePosition=(0, 0, -depth / 2))
        client.changeDynamics(floor, -1, lateralFriction=bin_.floor_friction)
        shape = self._loader.load_shape("wall", (self._wall,))
        for quarter in range(4):
            turn = yaw_quaternion(quarter * np.pi / 2).tolist()
            wall = client.createMultiBody(0, shape, unseen, baseOrientation=turn)
            client.changeDynamics(wall, -1, lateralFriction=bin_.wall_friction)


def _wall(bin_: Bin) -> ConvexPolyhedron:
    """Returns the wall beyond +x: a wedge, mitred at the corners."""
    inner, rim, outer = bin_.floor_half_width, bin_.rim_half_width, bin_.rim_half_width + 0.005
    section = ((inner, 0.0), (rim, bin_.rim_height), (outer, bin_.rim_height), (outer, -0.05))
    return ConvexPolyhedron.hull([(r, side * r, z) for r, z in section for side in (-1, 1)])
