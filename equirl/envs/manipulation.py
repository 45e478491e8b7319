"""The decision process as a TorchRL environment (appendix of the paper, simulation set-up)."""

from __future__ import annotations

from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from equirl.envs.action import Action
from equirl.envs.bullet import Camera, Simulation
from equirl.envs.heightmap import Heightmap, HeightmapSpec
from equirl.envs.scene import Scene
from equirl.envs.tasks import PlacementError, State, Task
from equirl.envs.workspace import Workspace

__all__ = ["ManipulationEnv"]

# Actions may exceed 1 by this much, which is rounding; they are clipped.
_ACTION_TOLERANCE = 1e-6
# A measured scene can be set again, so the gripper may be outside by this (m). Chosen: the worst
# ends of moves that were measured were 1 to 4 mm off.
_OVERSHOOT = 5e-3


class ManipulationEnv(EnvBase):
    """Top-down manipulation in a bin; one scene, no batch dimension.

    A step moves the end effector, then the gripper, then observes, then judges.

    Keys: ``depth`` (1, S, S) float32, metres below the end effector; ``holding`` (1,) float32, 0
    or 1; ``action`` (5,) float32 in [-1, 1], order (gripper, x, y, z, theta); ``reward`` (1,)
    float32, 1 on success, which terminates the episode, else 0. An object that leaves the
    workspace without being held terminates it too.

    Episode i after ``set_seed(s)`` is a function of s, i and the actions since, bit for bit,
    whatever was simulated before. Some tasks play several episodes on one scene: the next reset
    then goes on with what the last episode left (`scene_continues`). An environment connects to
    PyBullet at its first reset, so that it can be built in one process and used in another.

    Use `equirl.envs.make_env`, which validates its arguments.

    Attributes:
        episodes_begun: How many there were since construction.

    Args:
        task: What is to be done.
        image_size: S, pixels.
        seed: As for `set_seed`.
        robot: One of `equirl.envs.ROBOTS`.
        max_steps: Length of an episode without success.
        time_limit: ``"truncate"``: the last step is truncated, its value is bootstrapped;
            ``"terminate"``: it is terminal.
        workspace: Dimensions of the cell.
    """

    batch_locked = True

    def __init__(
        self,
        task: Task,
        *,
        image_size: int,
        seed: int,
        robot: str,
        max_steps: int,
        time_limit: str,
        workspace: Workspace,
    ):
        super().__init__(device=None, batch_size=torch.Size([]))
        self.task = task
        self.workspace = workspace
        self.max_steps = max_steps
        self.time_limit = time_limit
        self.robot = robot
        spec = HeightmapSpec(image_size, task.view)
        self._heightmap = Heightmap(task.bodies, spec, workspace, task.areas)
        self._simulation: Simulation | None = None
        self._camera: Camera | None = None
        self._disconnected = False
        self._state: State | None = None
        self._steps = 0
        self.episodes_begun = 0
        self._make_specs(image_size)
        self._set_seed(seed)

    def _make_specs(self, size: int) -> None:
        depth = Bounded(0.0, self._heightmap.spec.max_depth, shape=(1, size, size))
        holding = Bounded(0.0, 1.0, shape=(1,))
        self.observation_spec = Composite(depth=depth, holding=holding)
        self.action_spec = Bounded(-1.0, 1.0, shape=(5,))
        self.reward_spec = Unbounded(shape=(1,))
        flags = ("done", "terminated", "truncated")
        self.full_done_spec = Composite(
            {flag: Binary(1, shape=(1,), dtype=torch.bool) for flag in flags}
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None and seed < 0:
            raise ValueError(f"seed must be a non-negative integer, got {seed}")
        self._seed_sequence = np.random.SeedSequence(seed)
        self._forget_scene()

    def _forget_scene(self) -> None:
        self._scene_seed: np.random.SeedSequence | None = None
        self._scene_episodes = 0

    @property
    def scene_continues(self) -> bool:
        """Whether the next reset goes on with the present scene instead of drawing a new one."""
        return self._remaining() is not None

    @property
    def episode_seed(self) -> np.random.SeedSequence:
        """A seed of the present episode, for policies that draw numbers (experts).

        After `set_scene` it is the same for every scene.
        """
        if self._scene_seed is None:
            return np.random.SeedSequence(0)
        key = (*self._scene_seed.spawn_key, self._scene_episodes)
        return np.random.SeedSequence(self._scene_seed.entropy, spawn_key=key)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        remaining = self._remaining()
        self._state, scene = None, None  # a reset that fails leaves nothing to step on
        if remaining is not None:
            scene = self._sent_home(self._connected().settled(remaining))
        if scene is None or self._misplaced(scene):
            # One generator a scene: nothing drawn in one changes the next ones.
            (child,) = self._seed_sequence.spawn(1)
            scene = self._new_scene(np.random.default_rng(child))
            self._scene_seed, self._scene_episodes = child, 0
        self._scene_episodes += 1
        return self._begin(scene)

    def _remaining(self) -> Scene | None:
        """Returns what is left for the next episode of the present scene, if there is one."""
        state = self._state
        if state is None or self._scene_seed is None:
            return None
        limit = self.task.max_scene_episodes
        if (limit and self._scene_episodes >= limit) or self._lost_object(state.scene, state.held):
            return None
        return self.task.continued(state, self.task.succeeded(state))

    def _new_scene(self, rng: np.random.Generator) -> Scene:
        task, home = self.task, self._sent_home(None)
        fault = ""
        for _ in range(task.placement_tries):
            scene = task.sample(rng, home).named(task.bodies)
            if task.drops_objects:
                scene = self._connected().settled(scene, one_by_one=True)
            fault = self._misplaced(scene)
            if not fault:
                return scene
        raise PlacementError(f"no scene in {task.placement_tries} tries; in the last, {fault}")

    def _misplaced(self, scene: Scene) -> str:
        """Returns why no episode can start from ``scene``, or nothing."""
        space, margin = self.workspace, self.task.margin
        for name, pose in zip(scene.names, scene.objects, strict=True):
            if not space.contains(pose[:3], margin):
                where = np.round(pose[:3], 3).tolist()
                return f"{name} was at {where} m, more than {margin} m outside {space}"
        for x, y, _ in scene.areas:
            if max(abs(x), abs(y)) > space.half_width:
                return f"an area was at ({x:.3f}, {y:.3f}) m, outside {space}"
        return ""

    def _sent_home(self, scene: Scene | None) -> Scene:
        """Returns ``scene`` with the robot where episodes start; without objects if None."""
        space = self.workspace
        position = np.array([0.0, 0.0, space.home_height])
        home = Scene(position, 0.0, space.max_aperture, np.zeros((0, 7)))
        if scene is None:
            return home
        robot = {name: getattr(home, name) for name in ("position", "yaw", "aperture", "grip")}
        return replace(scene, **robot)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action", None)
        if action is None:
            raise ValueError(f"a step needs the key 'action', got {sorted(tensordict.keys())}")
        position, yaw, aperture = self._target(self.get_scene(), action)
        self._connected().act(position, yaw, aperture)
        self._steps += 1
        state = self._measure()
        success = self.task.succeeded(state)
        out_of_time = self._steps >= self.max_steps
        terminated = success or self._lost_object(state.scene, state.held)
        if self.time_limit == "terminate":
            terminated = terminated or out_of_time
        step = self._observe(state, terminated, out_of_time and not terminated)
        step.set("reward", torch.tensor([float(success)]))
        return step

    def _measure(self) -> State:
        simulation = self._connected()
        self._state = State(simulation.scene(), simulation.held(), simulation.touching)
        return self._state

    def _target(self, scene: Scene, action: torch.Tensor) -> tuple[np.ndarray, float, float]:
        """Returns the target position (m), yaw (rad) and aperture (m) of ``action`` (5,)."""
        values = action.detach().cpu().numpy().astype(np.float64)
        if values.shape != (5,) or not (np.abs(values) <= 1 + _ACTION_TOLERANCE).all():
            raise ValueError(
                "an action is five numbers (gripper, x, y, z, theta) in [-1, 1], "
                f"got {values.tolist()}"
            )
        wanted, space = Action(*np.clip(values, -1, 1).tolist()), self.workspace
        position = space.clip(scene.position + wanted.displacement(space))
        return position, scene.yaw + wanted.turn(space), wanted.aperture(space)

    def _lost_object(self, scene: Scene, held: int | None) -> bool:
        return any(
            k != held and not self.workspace.contains(pose[:3], self.task.margin)
            for k, pose in enumerate(scene.objects)
        )

    def _observe(
        self, state: State, terminated: bool = False, truncated: bool = False
    ) -> TensorDict:
        depth = torch.from_numpy(self._heightmap.draw(state.scene))[None]
        values = {
            "depth": depth,
            "holding": torch.tensor([float(state.held is not None)]),
            "done": torch.tensor([terminated or truncated]),
            "terminated": torch.tensor([terminated]),
            "truncated": torch.tensor([truncated]),
        }
        return TensorDict(values, batch_size=())

    def _connected(self) -> Simulation:
        if self._simulation is None:
            if self._disconnected:
                raise RuntimeError("this environment is closed; make a new one")
            self._simulation = Simulation(self.task.bodies, self.robot, self.workspace)
            self.is_closed = False  # so that EnvBase disconnects when this is collected
        return self._simulation

    def _begin(self, scene: Scene) -> TensorDictBase:
        self._connected().place(scene)
        self._steps = 0
        self.episodes_begun += 1
        return self._observe(self._measure())

    def get_scene(self) -> Scene:
        """Returns the measured state as a plain value (velocities are not part of it).

        Raises:
            RuntimeError: Before the first reset.
        """
        return self._present().scene

    def held_object(self) -> int | None:
        """Returns the index in `Scene.objects` of the object in the gripper, or None."""
        return self._present().held

    def _present(self) -> State:
        if self._state is None:
            raise RuntimeError("the environment has no scene yet; reset it first")
        return self._state

    def set_scene(self, scene: Scene) -> TensorDictBase:
        """Starts an episode, at rest, from ``scene``; the next reset draws a new one.

        Args:
            scene: Poses of the gripper and of objects of the task, and the task's areas.

        Returns:
            What `reset` returns, ready for an action and `step`.

        Raises:
            ValueError: If the scene has objects or areas that the task does not have, or the
                gripper is outside the workspace.
        """
        if not self.workspace.contains(scene.position, margin=_OVERSHOOT):
            raise ValueError(
                f"the end effector at {scene.position.tolist()} (m) is outside {self.workspace}"
            )
        wanted = len(self.task.areas)
        if len(scene.areas) != wanted:
            raise ValueError(f"the scene has {len(scene.areas)} areas, the task has {wanted}")
        scene = scene.named(self.task.bodies)
        expected = tuple(self.task.bodies)
        if not self.task.drops_objects and scene.names != expected:
            raise ValueError(f"the scene has the objects {scene.names}, the task has {expected}")
        if not scene.names:
            raise ValueError("the scene has no object")
        self._forget_scene()
        return self._begin(scene)

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        """Returns a colour picture of the cell, shape (height, width, 3), uint8.

        Needs no display. The first call loads the robot's meshes; what is simulated, and how fast,
        does not change.

        Raises:
            ValueError: If a side is no positive integer.
        """
        for name, value in (("width", width), ("height", height)):
            if not isinstance(value, Integral) or value < 1:
                raise ValueError(f"{name} must be a positive integer (pixels), got {value!r}")
        simulation = self._connected()
        if self._camera is None:
            task = self.task
            self._camera = Camera(task.bodies, task.areas, self.robot, self.workspace)
        return self._camera.picture(simulation.joint_values(), self.get_scene(), width, height)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Disconnects from PyBullet; harmless when done before."""
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        self._disconnected = True
        super().close(raise_if_closed=raise_if_closed)
