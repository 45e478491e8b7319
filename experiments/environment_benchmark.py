"""Tables of the environments: speed beside PyBullet alone and the earlier way, profile, workers.

Speeds of one environment are by processor time, so that what else runs on the machine counts
little; those of several, by the clock on the wall.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import active_children
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
from bullet_alone import count_simulated, simulate
from earlier_way import EarlierWay
from measuring import free_memory, mebibytes, print_header, print_row, ratio
from torchrl.envs import EnvBase

from equirl.envs import ManipulationEnv, Scene, make_env, make_expert, make_parallel_env
from equirl.envs.bullet import Simulation, models
from equirl.envs.bullet.client import Client
from equirl.envs.bullet.robot import Robot
from equirl.envs.heightmap import Heightmap
from equirl.envs.tasks import TASKS

ROBOTS = ("panda", "hand")
_TURNS = 5  # ours plays an episode so many times for once the earlier way
#: Every reset draws a new scene, also in the task that goes on with what is left.
_NEW_SCENES: dict[str, dict[str, Any]] = {"clutter_grasping": {"max_scene_episodes": 1}}

#: What takes the time of a step: methods, and PyBullet's functions by name.
_METHODS = (
    (Simulation, "held", "contacts"),
    (Simulation, "touching", "contacts"),
    (Robot, "pose", "poses"),
    (Simulation, "scene", "poses"),
    (models, "panda_joints", "kinematics"),
    (models, "hand_joints", "kinematics"),
    (Heightmap, "draw", "heightmap"),
    (ManipulationEnv, "_observe", "TorchRL"),
    (ManipulationEnv, "_step", "rest"),
    (ManipulationEnv, "step", "TorchRL"),
)
_FUNCTIONS = {
    "stepSimulation": "simulation",
    "getContactPoints": "contacts",
    "setJointMotorControlArray": "motors",
    "setJointMotorControl2": "motors",
    "getJointStates": "poses",
}
_PARTS = (
    "simulation",
    "motors",
    "contacts",
    "poses",
    "kinematics",
    "heightmap",
    "TorchRL",
    "rest",
)


def environment(arguments: argparse.Namespace) -> None:
    """Steps a second, observation included, beside the earlier way; and resets."""
    rounds = max(1, arguments.repeats // 3)
    print(
        f"{arguments.image} x {arguments.image}; an expert acts, its own time in the second column "
        f"alone. The earlier way plays the same scenes and the same actions, in turns, {rounds} "
        f"rounds; ratios are medians of a round's (smallest to largest). PyBullet alone makes as "
        "many simulation steps of the same scenes, the robot at rest, and nothing else: no motors, "
        "no picture, no tensors. Resets draw new scenes.\n"
    )
    alone = ("PyBullet alone", "times its time")
    speeds = ("steps/s", "with the expert", "earlier way", "times as fast", "its camera left out")
    print_header("task", "robot", *speeds, *alone, "reset ms", "95 % below")
    for task in TASKS:
        played = _play_rounds(task, rounds, arguments)
        move, see = (np.array(seconds) for seconds in played.pop("earlier way"))
        for robot, seconds in played.items():
            step, expert, simulated = (np.array(part) for part in seconds)
            resets = _resets(task, robot, arguments)
            print_row(
                task,
                robot,
                *(f"{1 / np.median(each):.0f}" for each in (step, step + expert)),
                f"{1 / np.median(move + see):.1f}",
                *(ratio(each, step) for each in (move + see, move)),
                f"{1 / np.median(simulated):.0f}",
                ratio(step, simulated),
                *(f"{1e3 * np.quantile(resets, level):.1f}" for level in (0.5, 0.95)),
            )


def profile(arguments: argparse.Namespace) -> None:
    """Where the time of a step goes, in per cent; measuring it is in there too."""
    print(
        f"{arguments.image} x {arguments.image}, {arguments.steps} steps. Contacts: how hard the "
        "arm presses, what is held and what touches; poses: reading joints and objects; TorchRL: "
        "tensors, specs and what wraps a step; rest: Python of ours. The expert is beside them.\n"
    )
    shares = (f"{part} %" for part in _PARTS)
    print_header("task", "robot", "simulation steps", "ms a step", *shares, "expert ms")
    for task in TASKS:
        for robot in ROBOTS:
            watch = _Stopwatch()
            with _watched(watch):
                steps, expert = _play_watched(watch, task, robot, arguments)
            whole = sum(watch.seconds.values())
            print_row(
                task,
                robot,
                f"{watch.calls['simulation'] / steps:.1f}",
                f"{1e3 * whole / steps:.2f}",
                *(f"{100 * watch.seconds[part] / whole:.0f}" for part in _PARTS),
                f"{1e3 * expert / steps:.2f}",
            )


def scaling(arguments: argparse.Namespace) -> None:
    """Environments in processes of their own; what workers and many resets take of memory."""
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    print(
        f"{arguments.image} x {arguments.image}, {arguments.steps} steps of random actions in all, "
        f"resets included, on {cores} cores with a load average of {load:.2f}. Memory is what a "
        "worker has for itself (USS).\n"
    )
    measured = ("start-up s", "steps/s", "times one's", "MiB a worker")
    print_header("task", "environments", *measured)
    for task in TASKS:
        alone: float | None = None
        for workers in (0, *arguments.workers):
            start_up, speed, memory = _parallel(task, workers, arguments)
            alone = alone or speed
            name = f"{workers} workers" if workers else "1 in process"
            print_row(task, name, f"{start_up:.2f}", f"{speed:.0f}", f"{speed / alone:.2f}", memory)
    print()
    print_header("task", f"growth of RSS in {arguments.steps} resets, MiB")
    for task in TASKS:
        print_row(task, f"{_growth(task, arguments):.1f}")


class _Played(NamedTuple):
    steps: int
    step: float  # s, of all steps
    expert: float  # s
    actions: list[np.ndarray]
    simulated: int  # simulation steps


def _play_rounds(task: str, rounds: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns lists of seconds a step, one number a round, for each robot and the earlier way.

    For our robots those of the steps, of the expert and of PyBullet alone, for the earlier way
    those of moving and of seeing.
    """
    source = make_env(task, image_size=16)
    envs = {robot: make_env(task, image_size=arguments.image, robot=robot) for robot in ROBOTS}
    earlier = EarlierWay(source.task, arguments.image, arguments.camera)
    seconds: dict[str, Any] = {robot: ([], [], []) for robot in ROBOTS}
    seconds["earlier way"] = ([], [])
    for number, scene in zip(range(-1, rounds), _scenes(source), strict=False):
        played: dict[str, list[_Played]] = {robot: [] for robot in ROBOTS}
        alone = dict.fromkeys(ROBOTS, 0.0)
        for _ in range(_TURNS if number >= 0 else 1):
            for robot, env in envs.items():
                played[robot].append(_play(env, scene))
                alone[robot] += simulate(env, scene, played[robot][-1].simulated)
        if number < 0:  # compiled and loaded now
            _replay(earlier, scene, played["panda"][0].actions[:1])
            continue
        for robot, turns in played.items():
            steps = sum(turn.steps for turn in turns)
            seconds[robot][0].append(sum(turn.step for turn in turns) / steps)
            seconds[robot][1].append(sum(turn.expert for turn in turns) / steps)
            seconds[robot][2].append(alone[robot] / steps)
        replayed = _replay(earlier, scene, played["panda"][0].actions)
        for mine, part in zip(seconds["earlier way"], replayed, strict=True):
            mine.append(part)
    for env in (source, *envs.values()):
        env.close()
    earlier.close()
    return seconds


def _scenes(env: ManipulationEnv) -> Iterator[Scene]:
    """Yields the scenes that an expert meets, episode after episode."""
    expert = make_expert(env)
    while True:
        state = env.reset()
        yield env.get_scene()
        while not state["done"].item():
            state = env.step(expert(state))["next"]


def _play(env: ManipulationEnv, scene: Scene) -> _Played:
    """Plays an episode with an expert."""
    expert, state = make_expert(env), env.set_scene(scene)
    stepping = planning = 0.0
    count = count_simulated(env)
    actions: list[np.ndarray] = []
    while not state["done"].item():
        start = time.process_time()
        state = expert(state)
        planned = time.process_time()
        actions.append(state["action"].numpy())
        begin = time.process_time()
        state = env.step(state)["next"]
        stepping += time.process_time() - begin
        planning += planned - start
    return _Played(len(actions), stepping, planning, actions, next(count))


def _replay(earlier: EarlierWay, scene: Scene, actions: list[np.ndarray]) -> tuple[float, float]:
    """Returns the earlier way's seconds a step for moving and for seeing."""
    earlier.place(scene)
    moving = seeing = 0.0
    for action in actions:
        start = time.process_time()
        earlier.act(action)
        moved = time.process_time()
        earlier.observe()
        seeing += time.process_time() - moved
        moving += moved - start
    return moving / len(actions), seeing / len(actions)


def _resets(task: str, robot: str, arguments: argparse.Namespace) -> list[float]:
    """Returns seconds of resets to new scenes."""
    env = make_env(task, image_size=arguments.image, robot=robot, **_NEW_SCENES.get(task, {}))
    env.reset()  # connects and loads
    seconds = []
    for _ in range(max(10, arguments.steps // 10)):
        start = time.process_time()
        env.reset()
        seconds.append(time.process_time() - start)
    env.close()
    return seconds


class _Stopwatch:
    """Adds up the time that parts take, without that of parts inside them, while it runs."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.calls: Counter[str] = Counter()
        self.runs = False
        self._inside = [0.0]

    def timed(self, function: Callable, part: str) -> Callable:
        def call(*arguments: Any, **options: Any) -> Any:
            if not self.runs:
                return function(*arguments, **options)
            self._inside.append(0.0)
            start = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                spent = time.process_time() - start
                self.seconds[part] += spent - self._inside.pop()
                self.calls[part] += 1
                self._inside[-1] += spent

        return call


@contextmanager
def _watched(watch: _Stopwatch) -> Iterator[None]:
    """Times the parts of every environment that is made and used within."""
    attribute = Client.__getattr__

    def lookup(client: Client, name: str) -> Any:
        value = attribute(client, name)
        if name in _FUNCTIONS:  # the client keeps what it finds here
            value = client.__dict__[name] = watch.timed(value, _FUNCTIONS[name])
        return value

    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(Client, "__getattr__", lookup))
        for owner, name, part in _METHODS:
            timed = watch.timed(getattr(owner, name), part)
            stack.enter_context(mock.patch.object(owner, name, timed))
        yield


def _play_watched(
    watch: _Stopwatch, task: str, robot: str, arguments: argparse.Namespace
) -> tuple[int, float]:
    """Returns how many steps were watched, and the seconds that the expert took beside them."""
    env = make_env(task, image_size=arguments.image, robot=robot)
    expert, state, planning = make_expert(env), env.reset(), 0.0
    for _ in range(3):
        state = env.step(expert(state))["next"]  # compiles
    for _ in range(arguments.steps):
        if state["done"].item():
            state = env.reset()
        start = time.process_time()
        state = expert(state)
        planning += time.process_time() - start
        watch.runs = True
        state = env.step(state)["next"]
        watch.runs = False
    env.close()
    return arguments.steps, planning


def _parallel(task: str, workers: int, arguments: argparse.Namespace) -> tuple[float, float, str]:
    """Returns start-up time (s), steps a second and memory a worker (MiB); 0: in this process."""
    torch.manual_seed(0)  # of the random actions
    start = time.perf_counter()
    make: Callable[..., EnvBase] = partial(make_parallel_env, task, workers)
    env = (make if workers else partial(make_env, task))(image_size=arguments.image)
    state = env.reset()
    start_up = time.perf_counter() - start
    for _ in range(3):
        _, state = env.step_and_maybe_reset(env.rand_action(state))
    count = max(1, arguments.steps // max(workers, 1))
    start = time.perf_counter()
    for _ in range(count):
        _, state = env.step_and_maybe_reset(env.rand_action(state))
    seconds = time.perf_counter() - start
    memory = "-"
    if workers:
        private = [mebibytes(f"{each.pid}/smaps_rollup", "Private") for each in active_children()]
        memory = f"{statistics.median(private):.0f}"
    env.close()
    return start_up, count * max(workers, 1) / seconds, memory


def _growth(task: str, arguments: argparse.Namespace) -> float:
    """Returns by how many MiB this process grows with many resets."""
    env = make_env(task, image_size=arguments.image, **_NEW_SCENES.get(task, {}))
    sizes = []
    for resets in (max(1, arguments.steps // 10), arguments.steps):  # the first are not counted
        for _ in range(resets):
            env.reset()
        free_memory()
        sizes.append(mebibytes("self/smaps_rollup", "Rss"))
    env.close()
    return sizes[1] - sizes[0]
