"""Clutter Grasping: grasp any object of a heap (appendix of the paper, simulation tasks)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from equirl.envs.objects import MeshFolder, ObjectSet, household_objects
from equirl.envs.scene import Scene
from equirl.envs.tasks.base import WORKSPACE, State, Task

# The robot waits 0.45 m high; the largest objects reach 0.1 m from their centres.
_HIGHEST_DROP = 0.35  # m


@dataclass(frozen=True, kw_only=True)
class ClutterGrasping(Task):
    """Objects of a set lie in the bin; success is holding any of them high enough.

    The object grasped is taken away and the next episode goes on with the others. There is a new
    scene when all are gone, when one has left the workspace, or after a number of episodes.

    Attributes:
        objects: ``"household"``, the folder of a user's meshes, or an `ObjectSet`.
        names: the objects of the set to draw from; empty: all.
        object_count: objects of a new scene, drawn with replacement.
        smallest_scale: the size of each object is drawn from this ...
        largest_scale: ... to this, relative to the set's.
        drop_height: objects are dropped from here, one by one, m.
        start_yaw: yaws are drawn within +-this, rad.
        lift_height: the end effector must be above this, m.
        max_scene_episodes: a scene is given up after so many episodes, of which each reset begins
            one; 0: never.
    """

    margin: float = 0.05
    start_half_width: float = 0.10
    placement_tries: int = 20
    objects: str | Path | ObjectSet = "household"
    names: Sequence[str] = ()
    object_count: int = 5
    smallest_scale: float = 0.8
    largest_scale: float = 1.0
    drop_height: float = 0.20
    start_yaw: float = np.pi / 4
    lift_height: float = 0.15
    max_scene_episodes: int = 7

    drops_objects = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("object_count", "smallest_scale", "largest_scale", "lift_height")
        self.require_positive("drop_height")
        self.require_non_negative("start_yaw", "max_scene_episodes")
        self.require_below("lift_height", WORKSPACE.z_max, "the top of the workspace (m)")
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

    def sample(self, rng: np.random.Generator, home: Scene) -> Scene:
        """Draws kinds, sizes and the poses the objects are dropped from."""
        count = self.object_count
        kinds = list(self.bodies)
        names = tuple(kinds[k] for k in rng.integers(len(kinds), size=count))
        scales = tuple(rng.uniform(self.smallest_scale, self.largest_scale, size=count))
        poses = np.zeros((count, 7))
        poses[:, :2] = rng.uniform(-self.start_half_width, self.start_half_width, size=(count, 2))
        poses[:, 2] = self.drop_height
        yaws = rng.uniform(-self.start_yaw, self.start_yaw, size=count)
        poses[:, 5], poses[:, 6] = np.sin(yaws / 2), np.cos(yaws / 2)
        return replace(home, objects=poses, names=names, scales=scales)

    def succeeded(self, state: State) -> bool:
        """Tells whether an object is held high enough."""
        return state.held is not None and state.scene.position[2] > self.lift_height

    def continued(self, state: State, succeeded: bool, episodes: int) -> Scene | None:
        """Returns what is left of the scene, or None when it is done with."""
        if self.max_scene_episodes and episodes >= self.max_scene_episodes:
            return None
        scene = state.scene
        if succeeded and state.held is not None:
            scene = scene.without(state.held)
        return scene if len(scene.objects) > 0 else None
