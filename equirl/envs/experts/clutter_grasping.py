"""Planner for Clutter Grasping: to any object on top, close on arrival, lift, or try another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from equirl.envs.experts.base import CLOSED, OPEN, Expert, nearest_symmetric_yaw
from equirl.envs.scene import Scene

# Open fingers, from above: their distance from the middle, half their side with some room, and
# how far they reach below the centre of an object at a grasp, m.
_FINGER_CENTRE, _FINGER_REACH, _FINGER_DEPTH = 0.0475, 0.013, 0.02


@dataclass
class _Attempt:
    target: int  # index of the object
    yaw: float  # rad
    lowering: float  # m below the object's centre
    last: np.ndarray | None = None  # end effector position when the last action was chosen
    closed: bool = False  # whether the gripper was told to close


class ClutterGraspingExpert(Expert):
    """Draws an object, a yaw and a depth for each attempt.

    The yaw is independent of the object's: the planner is sub-optimal by design, as the paper's.
    With ``grasp="aligned"`` the fingers go down where least is in their way, across the object's
    narrow side if they can.
    """

    _on_top = 0.027  # m: an object is not on top if the centre of a higher one is as near
    _deepest = 0.02  # m, the grasp is lowered by up to this
    _clear = 0.07  # m, height from which the next object is approached
    _reach = 0.05  # m, horizontal distance from which it comes down
    _stuck = 0.004  # m: a move shorter than this was broken off

    def begin(self, rng: np.random.Generator) -> None:
        """Forgets the last episode."""
        self._rng = rng
        self._attempt: _Attempt | None = None

    def plan(self, scene: Scene, held: int | None) -> np.ndarray:
        """Returns the action for a state, shape (5,)."""
        if held is not None:
            return np.array([CLOSED, 0.0, 0.0, 1.0, 0.0])
        if self._attempt is None or self._attempt.closed:
            failed = None if self._attempt is None else self._attempt.target
            self._attempt = self._choose(scene, failed)
        return self._approach(scene, self._attempt)

    def _approach(self, scene: Scene, attempt: _Attempt) -> np.ndarray:
        where = scene.objects[attempt.target, :3] - (0, 0, attempt.lowering)
        above = np.hypot(*(where[:2] - scene.position[:2])) < self._reach
        moved = np.inf if attempt.last is None else np.linalg.norm(scene.position - attempt.last)
        first, attempt.last = attempt.last is None, scene.position
        if moved < self._stuck:  # something is in the way: grasp what is there
            action = np.array([CLOSED, 0.0, 0.0, 0.0, 0.0])
        elif above and not (first and scene.position[2] < self._clear):
            action = self._toward(scene, where, attempt.yaw, gripper=OPEN, arrived=CLOSED)
        else:  # over the others
            where[2] = self._clear
            action = self._toward(scene, where, attempt.yaw, gripper=OPEN, arrived=OPEN)
        attempt.closed = action[0] == CLOSED
        return action

    def _choose(self, scene: Scene, failed: int | None) -> _Attempt:
        """Draws the next attempt; another object than the last, if there is one on top."""
        candidates = self._topmost(scene)
        others = [target for target in candidates if target != failed]
        target = int(self._rng.choice(others or candidates))
        yaw = nearest_symmetric_yaw(self._draw_yaw(scene, target), scene.yaw, np.pi)
        return _Attempt(target, yaw, self._rng.uniform(0, self._deepest))

    def _topmost(self, scene: Scene) -> list[int]:
        """Returns the objects over which there is no other."""
        where = scene.objects[:, :3]
        apart = where[:, None] - where[None]
        over = (np.hypot(apart[..., 0], apart[..., 1]) < self._on_top) & (apart[..., 2] < 0)
        return np.flatnonzero(~over.any(1)).tolist()

    def _draw_yaw(self, scene: Scene, target: int) -> float:
        if self._grasp == "random":
            return self._rng.uniform(-np.pi / 2, np.pi / 2)
        yaws = np.linspace(-np.pi / 2, np.pi / 2, 36, endpoint=False)
        placed = [self._surface(scene, k) for k in range(len(scene.objects))]
        points = np.concatenate(placed) - scene.objects[target, :3]
        along = points[:, :2] @ np.stack((np.cos(yaws), np.sin(yaws)))
        across = points[:, :2] @ np.stack((-np.sin(yaws), np.cos(yaws)))
        under = (np.abs(np.abs(along) - _FINGER_CENTRE) < _FINGER_REACH) & (
            np.abs(across) < _FINGER_REACH
        )
        # What is under the fingers stops them; then, the narrower the better.
        stop = np.where(under, points[:, 2:], -_FINGER_DEPTH).max(0).clip(-_FINGER_DEPTH)
        own = slice(sum(map(len, placed[:target])), sum(map(len, placed[: target + 1])))
        return yaws[np.argmin(stop + 0.1 * np.ptp(along[own], axis=0))]

    def _surface(self, scene: Scene, index: int) -> np.ndarray:
        """Returns points on the surface of an object, shape (P, 3), m."""
        (env,) = self._env
        body = env.task.bodies[scene.names[index]].scaled(scene.scales[index])
        corners = np.concatenate([piece.vertices[piece.triangles] for piece in body.pieces])
        middles = (corners + np.roll(corners, 1, axis=1)) / 2
        points = np.concatenate((corners, middles, corners.mean(1, keepdims=True)), axis=1)
        turn = Rotation.from_quat(scene.objects[index, 3:])
        return turn.apply(points.reshape(-1, 3)) + scene.objects[index, :3]
