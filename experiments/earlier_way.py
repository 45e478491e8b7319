"""A model of how earlier simulations of these tasks spend their time, to measure ours against.

It plays scenes and actions of `equirl.envs` the way those systems did: the whole Panda with its
meshes; many small simulation steps an action, under a soft position controller that is watched
from Python; PyBullet's inverse kinematics; a depth image merged from two pictures of PyBullet's
software renderer. It is written from that description alone and shares no code with any of them.

Measured on a slow machine, an expert acting, such a system took 201 to 228 simulation steps an
action and 0.64 to 1.14 s, of them 0.58 to 0.74 s for the depth image. Tolerances that were not
known are chosen for about that many steps. What is left out favours the earlier way: drawing the
fingers, the holding flag, judging the task, and loading all objects anew at each reset; and the
objects here, with fewer faces, make its simulation of bowl and clutter cheaper than it was.
"""

from __future__ import annotations

import tempfile

import numpy as np
from scipy.ndimage import distance_transform_edt

from equirl.envs.bullet.client import Client, panda_urdf
from equirl.envs.bullet.kinematics import panda_joints
from equirl.envs.heightmap import HeightmapSpec
from equirl.envs.objects import Body, ConvexPolyhedron
from equirl.envs.scene import Scene
from equirl.envs.tasks import Task
from equirl.envs.workspace import Workspace

ARM_STEPS, FINGER_STEPS = 300, 100  # simulation steps at most, of one action
_ARM, _FINGERS, _TOOL = list(range(7)), [9, 10], 11  # joints of the Panda's description
_ARM_FORCE, _FINGER_FORCE, _POSITION_GAIN = 240.0, 10.0, 0.02
_ARRIVED, _STUCK = 2e-3, 5e-5  # from the target, in a step: rad, or m for the fingers
_EYES = ((0.0, -0.5, 1.0), (0.0, 0.5, 1.0))  # m; the cameras look at the origin
_FIELD_OF_VIEW, _NEAR, _FAR = 42.0, 0.1, 2.0  # degrees; m


class EarlierWay:
    """The cell of a task, simulated and seen the earlier way.

    Args:
        task: What is in it.
        image_size: S, pixels along a side of the depth image.
        camera_size: Pixels along a side of the two pictures it is merged from.
    """

    def __init__(self, task: Task, image_size: int = 128, camera_size: int = 512):
        self._task, self._space = task, Workspace()
        self._spec = HeightmapSpec(image_size, task.view)
        self._camera_size = camera_size
        self._client = client = Client()
        client.setGravity(0, 0, -9.81)
        client.setPhysicsEngineParameter(fixedTimeStep=1 / 240, numSolverIterations=50)
        self._objects: list[int] = []
        self._add_bin()
        base = (self._space.arm_base_x, 0, 0)
        self._robot = client.loadURDF(str(panda_urdf()), basePosition=base, useFixedBase=True)
        joint = client.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0)
        gear = client.createConstraint(self._robot, 9, self._robot, 10, *joint)
        client.changeConstraint(gear, gearRatio=-1, erp=0.1, maxForce=50)

    def close(self) -> None:
        """Disconnects; harmless when done before."""
        self._client.close()

    def place(self, scene: Scene) -> None:
        """Puts the robot and new objects where a scene of the task has them."""
        client, scene = self._client, scene.named(self._task.bodies)
        for body in self._objects:
            client.removeBody(body)
        self._objects = []
        for name, scale, pose in zip(scene.names, scene.scales, scene.objects, strict=True):
            self._objects.append(self._add_object(self._task.bodies[name].scaled(scale), pose))
        yaws, base_x = np.array([scene.yaw]), self._space.arm_base_x
        (joints,) = panda_joints(scene.position[None], yaws, base_x)
        for index, value in zip(_ARM, joints, strict=True):
            client.resetJointState(self._robot, index, value)
        for finger in _FINGERS:
            client.resetJointState(self._robot, finger, scene.aperture / 2)
        self._drive(_ARM, joints, _ARM_FORCE)
        self._drive(_FINGERS, np.full(2, scene.grip / 2), _FINGER_FORCE)

    def act(self, action: np.ndarray) -> int:
        """Moves the arm, then the fingers, by an ``action`` (5,); returns the simulation steps."""
        position, yaw = self.pose()
        gripper, *displacement, theta = action.tolist()
        position = self._space.clip(position + self._space.position_step * np.array(displacement))
        yaw += self._space.yaw_step * theta
        joints = self._client.calculateInverseKinematics(
            self._robot,
            _TOOL,
            position.tolist(),
            self._client.getQuaternionFromEuler((np.pi, 0, yaw + np.pi / 2)),
            maxNumIterations=100,
            residualThreshold=1e-5,
        )
        steps = self._until_there(_ARM, np.array(joints[:7]), _ARM_FORCE, ARM_STEPS)
        opening = np.full(2, self._space.max_aperture * (gripper + 1) / 4)
        return steps + self._until_there(_FINGERS, opening, _FINGER_FORCE, FINGER_STEPS)

    def observe(self) -> np.ndarray:
        """Returns the depth below the end effector, shape (S, S), m, from two pictures."""
        size, (position, _) = self._spec.size, self.pose()
        points = np.concatenate([self._cloud(eye) for eye in _EYES], axis=1)
        cells = ((points[:2] - position[:2, None]) / self._spec.side + 0.5) * size
        ceiling = max(position[2] - self._spec.clearance, self._spec.min_ceiling)
        seen = (cells >= 0).all(0) & (cells < size).all(0) & (points[2] <= ceiling)
        heights = np.full((size, size), -np.inf)
        np.maximum.at(heights, tuple(cells[:, seen].astype(int)), points[2, seen])
        nearest = distance_transform_edt(
            np.isinf(heights), return_distances=False, return_indices=True
        )
        return np.clip(position[2] - heights[tuple(nearest)], 0, self._spec.max_depth)

    def pose(self) -> tuple[np.ndarray, float]:
        """Returns the measured position (3,) of the end effector, m, and its yaw, rad."""
        state = self._client.getLinkState(self._robot, _TOOL, computeForwardKinematics=1)
        rotation = self._client.getMatrixFromQuaternion(state[5])
        return np.array(state[4]), float(np.arctan2(rotation[4], rotation[1]))

    def object_positions(self) -> np.ndarray:
        """Returns where the objects are, shape (N, 3), m."""
        poses = [self._client.getBasePositionAndOrientation(body) for body in self._objects]
        return np.array([position for position, _ in poses])

    def _until_there(self, joints: list[int], target: np.ndarray, force: float, most: int) -> int:
        """Simulates until joints are at their ``target`` or stuck; returns the steps it took."""
        self._drive(joints, target, force)
        last = np.full(len(joints), np.inf)
        for step in range(most):
            states = self._client.getJointStates(self._robot, joints)
            values = np.array([state[0] for state in states])
            stuck = np.allclose(values, last, rtol=0, atol=_STUCK)
            if np.allclose(values, target, rtol=0, atol=_ARRIVED) or stuck:
                return step
            last = values
            self._client.stepSimulation()
        return most

    def _drive(self, joints: list[int], target: np.ndarray, force: float) -> None:
        self._client.setJointMotorControlArray(
            self._robot,
            joints,
            self._client.POSITION_CONTROL,
            targetPositions=target.tolist(),
            forces=[force] * len(joints),
            positionGains=[_POSITION_GAIN] * len(joints),
            velocityGains=[1.0] * len(joints),
        )

    def _cloud(self, eye: tuple[float, float, float]) -> np.ndarray:
        """Returns what a camera sees, one row of points a coordinate, shape (3, N), m."""
        client, size = self._client, self._camera_size
        view = client.computeViewMatrix(eye, (0, 0, 0), (1, 0, 0))
        lens = client.computeProjectionMatrixFOV(_FIELD_OF_VIEW, 1.0, _NEAR, _FAR)
        depth = client.getCameraImage(size, size, view, lens, renderer=client.ER_TINY_RENDERER)[3]
        ahead = _FAR * _NEAR / (_FAR - (_FAR - _NEAR) * np.asarray(depth).reshape(size, size))
        across = ((2 * np.arange(size) + 1) / size - 1) * np.tan(np.radians(_FIELD_OF_VIEW / 2))
        seen = np.stack((across * ahead, -across[:, None] * ahead, -ahead)).reshape(3, -1)
        axes = np.array(view).reshape(4, 4)[:3, :3]
        return axes @ seen + np.array(eye)[:, None]

    def _add_object(self, body: Body, pose: np.ndarray) -> int:
        client = self._client
        loaded = client.createMultiBody(
            body.mass,
            self._collision_shape(body),
            self._visual_shape(body.pieces),
            basePosition=pose[:3].tolist(),
            baseOrientation=pose[3:].tolist(),
        )
        client.changeDynamics(
            loaded,
            -1,
            lateralFriction=body.friction,
            rollingFriction=body.rolling_friction,
            spinningFriction=body.rolling_friction,
            localInertiaDiagonal=body.inertia.tolist(),
        )
        return loaded

    def _collision_shape(self, body: Body) -> int:
        """The cube is a box, the bowl of convex pieces; an object of a heap is one convex hull."""
        client, first = self._client, body.pieces[0]
        if first.half_extents is not None and len(body.pieces) == 1:
            return client.createCollisionShape(client.GEOM_BOX, halfExtents=first.half_extents)
        if self._task.drops_objects:
            vertices = ConvexPolyhedron.hull(body.vertices).vertices.tolist()
            return client.createCollisionShape(client.GEOM_MESH, vertices=vertices)
        lines = []
        for number, piece in enumerate(body.pieces):
            lines += [f"o {number}", *("v {} {} {}".format(*row) for row in piece.vertices)]
            faces = piece.triangles - len(piece.vertices)  # counted from the last vertex
            lines += ["f {} {} {}".format(*row) for row in faces]
        with tempfile.NamedTemporaryFile("w", suffix=".obj") as file:
            file.write("\n".join(lines) + "\n")
            file.flush()
            return client.createCollisionShape(client.GEOM_MESH, fileName=file.name)

    def _visual_shape(self, pieces: tuple[ConvexPolyhedron, ...]) -> int:
        corners = np.concatenate([piece.vertices[piece.triangles] for piece in pieces])
        corners = corners.reshape(-1, 3).tolist()
        return self._client.createVisualShape(
            self._client.GEOM_MESH, vertices=corners, indices=list(range(len(corners)))
        )

    def _add_bin(self) -> None:
        """A tray of nine links, as earlier ones were: the floor and two rings of sloping walls."""
        client, bin_ = self._client, self._space.bin
        inner, rim, top = bin_.floor_half_width, bin_.rim_half_width, bin_.rim_height
        half = (inner + rim) / 2, top / 2
        walls, turns, visuals = [], [], []
        for (r0, z0), (r1, z1) in (((inner, 0.0), half), (half, (rim, top))):
            section = ((r0, z0), (r1, z1), (r1, -0.05), (r0, -0.05))
            wall = ConvexPolyhedron.hull([(r, k * r, z) for r, z in section for k in (-1, 1)])
            for quarter in range(4):
                corners = wall.vertices.tolist()
                walls.append(client.createCollisionShape(client.GEOM_MESH, vertices=corners))
                visuals.append(self._visual_shape((wall,)))
                turns.append(client.getQuaternionFromEuler((0, 0, quarter * np.pi / 2)))
        floor = client.createCollisionShape(client.GEOM_BOX, halfExtents=(1.0, 1.0, 0.1))
        origins, upright = [(0, 0, 0)] * 8, [(0, 0, 0, 1)] * 8
        client.createMultiBody(
            0,
            floor,
            basePosition=(0, 0, -0.1),
            linkMasses=[0] * 8,
            linkCollisionShapeIndices=walls,
            linkVisualShapeIndices=visuals,
            linkPositions=[(0, 0, 0.1)] * 8,
            linkOrientations=turns,
            linkInertialFramePositions=origins,
            linkInertialFrameOrientations=upright,
            linkParentIndices=[0] * 8,
            linkJointTypes=[client.JOINT_FIXED] * 8,
            linkJointAxis=origins,
        )
