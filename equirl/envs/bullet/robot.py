"""A robot in the simulation: smooth moves of the end effector, and the gripper."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from equirl.envs.bullet.client import Client
from equirl.envs.bullet.models import RobotLoader

__all__ = [
    "ARM_FORCE",
    "FINGER_FRICTION",
    "FINGER_SPEED",
    "FORCE_LIMIT",
    "GRIPPER_FORCE",
    "MAX_GRIP_STEPS",
    "MIN_GRIP_STEPS",
    "MOVE_STEPS",
    "Robot",
]

# The paper's implementation has these forces and this friction.
ARM_FORCE = 240.0  # N or N m
GRIPPER_FORCE = 10.0  # N, each finger
FINGER_FRICTION = 1.0
FINGER_SPEED = 0.2  # m/s, the limit in the Panda's description
# Simulation steps of one move: 0.2 s. Measured: moves of 0.1 s fling away what they push.
MOVE_STEPS = 24
# Measured: without these the arm was seen up to 2 mm short of where it was sent.
MIN_GRIP_STEPS = 4
MAX_GRIP_STEPS = 40  # chosen: closing takes 24 at full speed
# Strong as it is, the arm would press a cube through the floor. When the contacts push harder than
# this, it takes a little of the move back and tries again, a few times: what can give way does.
# Chosen, all three.
FORCE_LIMIT = 40.0  # N
_RETREAT_STEPS = 4
_ATTEMPTS = 5
# Chosen: the fingers are where they should be within this (m), or stand still when both were slower
# than this (m/s) for so many steps.
_ARRIVED, _STILL_SPEED, _STILL_STEPS = 5e-4, 2e-3, 3
# Of the motors of the arm. Chosen; the paper's implementation has a position gain of 0.02 and takes
# some 200 steps a move.
_POSITION_GAIN, _VELOCITY_GAIN = 0.3, 1.0
_FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")


class Robot:
    """Drives one robot.

    Args:
        client: The simulation it is loaded into.
        loader: Loads it, and knows which robot it is.
        time_step: Length of a simulation step, s.
        max_aperture: Aperture of the open gripper, m.
    """

    def __init__(self, client: Client, loader: RobotLoader, time_step: float, max_aperture: float):
        self._client = client
        self._model = model = loader.model
        self._time_step = time_step
        self.body = loader.load()
        index = {
            client.getJointInfo(self.body, i)[1].decode(): i
            for i in range(client.getNumJoints(self.body))
        }
        self._arm = [index[name] for name in model.joint_names]
        self.fingers = tuple(index[name] for name in _FINGER_JOINTS)
        self._tool = index["panda_grasptarget_hand"]
        self.grip_target = max_aperture
        for finger in self.fingers:
            client.changeDynamics(self.body, finger, lateralFriction=FINGER_FRICTION)
        self._couple_fingers()
        # Half a cosine: starts and ends at rest, so that a held object does not slip.
        phase = np.pi * np.arange(1, MOVE_STEPS + 1) / MOVE_STEPS
        self._profile = (1 - np.cos(phase)) / 2

    def _couple_fingers(self) -> None:
        """Makes the fingers move symmetrically; alone they and the object drift together."""
        left, right = self.fingers
        gear = self._client.createConstraint(
            self.body,
            left,
            self.body,
            right,
            jointType=self._client.JOINT_GEAR,
            jointAxis=(1, 0, 0),
            parentFramePosition=(0, 0, 0),
            childFramePosition=(0, 0, 0),
        )
        # The numbers are those of the paper's implementation.
        self._client.changeConstraint(gear, gearRatio=-1, erp=0.1, maxForce=50)

    def pose(self) -> tuple[np.ndarray, float, float]:
        """Returns the measured position (3,) in m, yaw in rad (unbounded) and aperture in m."""
        client = self._client
        state = client.getLinkState(self.body, self._tool, computeForwardKinematics=1)
        values = [s[0] for s in client.getJointStates(self.body, [*self._arm, *self.fingers])]
        yaw = self._model.yaw(np.array(values[: len(self._arm)]))
        return np.array(state[4]), yaw, values[-2] + values[-1]

    def joint_values(self) -> np.ndarray:
        """Returns the values of all joints, the fixed ones included."""
        indices = range(self._client.getNumJoints(self.body))
        return np.array([state[0] for state in self._client.getJointStates(self.body, indices)])

    def place(self, position: np.ndarray, yaw: float, aperture: float, grip: float) -> None:
        """Puts the robot at rest into a pose, without passing through what lies between."""
        joints = self._model.joints(position[None], np.array([yaw]))[0]
        for index, value in zip(self._arm, joints, strict=True):
            self._client.resetJointState(self.body, index, value, 0.0)
        for finger in self.fingers:
            self._client.resetJointState(self.body, finger, aperture / 2, 0.0)
        # Motor targets survive a reset of the joints: all of them are sent again.
        self._drive_arm(joints, np.zeros_like(joints))
        self.drive_gripper(grip)

    def move(self, position: np.ndarray, yaw: float, step: Callable[[], None]) -> None:
        """Moves the end effector in a straight line, smoothly, in `MOVE_STEPS` steps.

        Stops short when it meets a resistance of more than `FORCE_LIMIT` that does not give way.

        Args:
            position: Where to, shape (3,), m.
            yaw: Final yaw, rad.
            step: Advances the simulation by one step.
        """
        start, start_yaw, _ = self.pose()
        positions = start + self._profile[:, None] * (position - start)
        yaws = start_yaw + self._profile * (yaw - start_yaw)
        joints = self._model.joints(positions, yaws)
        # Velocity feed-forward by differences; the last command is at rest.
        velocities = np.zeros_like(joints)
        velocities[:-2:2] = (joints[2::2] - joints[:-2:2]) / (2 * self._time_step)
        # A command every second step; the motors track the velocity in between.
        i, attempts = 0, 0
        while i < MOVE_STEPS and attempts < _ATTEMPTS:
            if i % 2 == 0:
                self._drive_arm(joints[i + 1], velocities[i])
            step()
            i += 1
            if self._resistance() > FORCE_LIMIT:
                attempts += 1
                i = max(i - 1 - _RETREAT_STEPS, 0) // 2 * 2
                self._drive_arm(joints[i], np.zeros_like(joints[0]))
                for _ in range(_RETREAT_STEPS):
                    step()

    def _resistance(self) -> float:
        """Returns the norm of the net normal force of all contacts on the robot, N."""
        x = y = z = 0.0
        for contact in self._client.getContactPoints(self.body):
            force, normal = contact[9], contact[7]
            x += force * normal[0]
            y += force * normal[1]
            z += force * normal[2]
        return (x * x + y * y + z * z) ** 0.5

    def grip(self, aperture: float, step: Callable[[], None]) -> None:
        """Drives the fingers to ``aperture`` (m) until they are there or are stopped."""
        self.drive_gripper(aperture)
        still = 0
        for count in range(MAX_GRIP_STEPS):
            states = self._client.getJointStates(self.body, self.fingers)
            there = abs(states[0][0] + states[1][0] - aperture) < _ARRIVED
            if there and count >= MIN_GRIP_STEPS:
                return
            step()
            states = self._client.getJointStates(self.body, self.fingers)
            still = still + 1 if max(abs(s[1]) for s in states) < _STILL_SPEED else 0
            if still >= _STILL_STEPS and count + 1 >= MIN_GRIP_STEPS:
                return

    def drive_gripper(self, aperture: float) -> None:
        """Sets the aperture (m) the finger motors drive to."""
        self.grip_target = float(aperture)
        for finger in self.fingers:
            self._client.setJointMotorControl2(
                self.body,
                finger,
                self._client.POSITION_CONTROL,
                targetPosition=aperture / 2,
                force=GRIPPER_FORCE,
                maxVelocity=FINGER_SPEED,
            )

    def _drive_arm(self, joints: np.ndarray, velocities: np.ndarray) -> None:
        count = len(self._arm)
        self._client.setJointMotorControlArray(
            self.body,
            self._arm,
            self._client.POSITION_CONTROL,
            targetPositions=joints.tolist(),
            targetVelocities=velocities.tolist(),
            forces=[ARM_FORCE] * count,
            positionGains=[_POSITION_GAIN] * count,
            velocityGains=[_VELOCITY_GAIN] * count,
        )
