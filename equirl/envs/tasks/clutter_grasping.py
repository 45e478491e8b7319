"""Clutter Grasping: grasp any object of a heap (appendix of the paper, simulation tasks)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from equirl.envs.action import CLOSED, OPEN, Action
from equirl.envs.expert import Expert, nearest_symmetric_yaw
from equirl.envs.heightmap import HeightmapSpec
from equirl.envs.objects import MeshFolder, ObjectSet, household_objects
from equirl.envs.scene import Scene, yaw_quaternion
from equirl.envs.tasks.base import State
from equirl.envs.tasks.lift_task import LiftTask
from equirl.envs.workspace import WORKSPACE

__all__ = ["ClutterGrasping", "ClutterGraspingExpert"]

# The robot waits 0.45 m high; the largest objects reach 0.1 m from their centres.
_HIGHEST_DROP = 0.35  # m
_MOST_OBJECTS = 50  # of the smallest household objects, in two layers


@dataclass(frozen=True, kw_only=True)
class ClutterGrasping(LiftTask):
    """Objects of a set lie in the bin; success is holding any of them high enough.

    The object grasped is taken away and the next episode goes on with the others. There is a new
    scene when all are gone, when one has left the workspace, or after a number of episodes.

    Attributes:
        objects: ``"household"``, the folder of a user's meshes, or an `ObjectSet`.
        names: The objects of the set to draw from; empty: all.
        object_count: Objects of a new scene, drawn with replacement.
        smallest_scale: The size of each object is drawn from this ...
        largest_scale: ... to this, relative to the set's.
        drop_height: Objects are dropped from here, one by one, m.
    """

    margin: float = 0.05
    start_half_width: float = 0.10
    placement_tries: int = 20
    max_scene_episodes: int = 7
    objects: str | Path | ObjectSet = "household"
    names: Sequence[str] = ()
    object_count: int = 5
    smallest_scale: float = 0.8
    largest_scale: float = 1.0
    drop_height: float = 0.20

    drops_objects = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("object_count", "smallest_scale", "largest_scale", "drop_height")
        self.require_below("object_count", _MOST_OBJECTS + 1, "more than the bin holds")
        self.require_below("drop_height", _HIGHEST_DROP, "or objects would touch the robot (m)")
        self.require(
            "largest_scale",
            self.largest_scale >= self.smallest_scale,
            f"a number of at least smallest_scale={self.smallest_scale}",
        )
        named = isinstance(self.names, Sequence) and not isinstance(self.names, str)
        self.require("names", named, "a list of names")
        kinds = (str, Path, ObjectSet)
        self.require("objects", isinstance(self.objects, kinds), "a folder or an ObjectSet")
        try:
            _ = self.bodies  # loads the set: its faults are found here
        except KeyError as error:
            raise ValueError(error.args[0]) from None

    @cached_property
    def bodies(self) -> ObjectSet:
        """The objects that scenes are drawn from."""
        if isinstance(self.objects, ObjectSet):
            bodies = self.objects
        elif self.objects == "household":
            bodies = household_objects()
        else:
            bodies = MeshFolder(self.objects)
        return bodies.subset(self.names) if self.names else bodies

    @property
    def expert(self) -> type[Expert]:
        """Its planner."""
        return ClutterGraspingExpert

    def sample(self, rng: np.random.Generator, home: Scene) -> Scene:
        """Draws kinds, sizes and the poses the objects are dropped from."""
        count = self.object_count
        kinds = list(self.bodies)
        names = tuple(kinds[k] for k in rng.integers(len(kinds), size=count))
        scales = tuple(rng.uniform(self.smallest_scale, self.largest_scale, size=count))
        places = rng.uniform(-self.start_half_width, self.start_half_width, size=(count, 2))
        yaws = rng.uniform(-self.start_yaw, self.start_yaw, size=count)
        heights = np.full(count, self.drop_height)
        poses = np.column_stack((places, heights, yaw_quaternion(yaws)))
        return replace(home, objects=poses, names=names, scales=scales)

    def continued(self, state: State, succeeded: bool) -> Scene | None:
        """Returns what is left of the scene, or None when nothing is."""
        scene = state.scene
        if succeeded and state.held is not None:
            scene = scene.without(state.held)
        return scene if len(scene.objects) > 0 else None


# Open fingers, from above: their distance from the middle, half their side with some room (chosen),
# and how far they reach below the centre of an object at the deepest grasp, m.
_FINGER_CENTRE = WORKSPACE.max_aperture / 2 + HeightmapSpec.finger_length / 2
_FINGER_REACH, _FINGER_DEPTH = 0.013, 0.02


@dataclass
class _Attempt:
    target: int  # index of the object
    yaw: float  # rad
    lowering: float  # m below the object's centre
    last: np.ndarray | None = None  # end effector position when the last action was chosen
    closed: bool = False  # whether the gripper was told to close


class ClutterGraspingExpert(Expert):
    """Draws an object, a yaw and a depth for each attempt.

    The yaw is independent of the object's (``grasp="random"``): the planner is sub-optimal by
    design, as the paper's. With ``grasp="aligned"`` the fingers go down where least is in their
    way, across the object's narrow side if they can.
    """

    CHOICES: ClassVar = {**Expert.CHOICES, "grasp": ("random", "aligned")}

    # The first two are those of the paper's implementation, the others chosen (m).
    _on_top = 0.027  # an object is not on top if the centre of a higher one is as near
    _deepest = 0.02  # the grasp is lowered by up to this
    _clear = 0.07  # height from which the next object is approached
    _reach = 0.05  # horizontal distance from which it comes down: one action covers it
    _stuck = 0.004  # a move shorter than this was broken off

    def begin(self, rng: np.random.Generator) -> None:
        """Forgets the last episode."""
        self._rng = rng
        self._attempt: _Attempt | None = None

    def plan(self, scene: Scene, held: int | None) -> Action:
        """Returns the action for a state."""
        if held is not None:
            return Action(CLOSED, z=1.0)
        if self._attempt is None or self._attempt.closed:
            failed = None if self._attempt is None else self._attempt.target
            self._attempt = self._choose(scene, failed)
        return self._approach(scene, self._attempt)

    def _approach(self, scene: Scene, attempt: _Attempt) -> Action:
        where = scene.objects[attempt.target, :3] - (0, 0, attempt.lowering)
        above = np.hypot(*(where[:2] - scene.position[:2])) < self._reach
        moved = np.inf if attempt.last is None else np.linalg.norm(scene.position - attempt.last)
        first, attempt.last = attempt.last is None, scene.position
        if moved < self._stuck:  # something is in the way: grasp what is there
            action = Action(CLOSED)
        elif above and not (first and scene.position[2] < self._clear):
            action = self.toward(scene, where, attempt.yaw, gripper=OPEN, arrived=CLOSED)
        else:  # over the others
            where[2] = self._clear
            action = self.toward(scene, where, attempt.yaw, gripper=OPEN, arrived=OPEN)
        attempt.closed = action.gripper == CLOSED
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
        if self.options["grasp"] == "random":
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
        body = self.env.task.bodies[scene.names[index]].scaled(scene.scales[index])
        corners = np.concatenate([piece.vertices[piece.triangles] for piece in body.pieces])
        middles = (corners + np.roll(corners, 1, axis=1)) / 2
        points = np.concatenate((corners, middles, corners.mean(1, keepdims=True)), axis=1)
        turn = Rotation.from_quat(scene.objects[index, 3:])
        return turn.apply(points.reshape(-1, 3)) + scene.objects[index, :3]
