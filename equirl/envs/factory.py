"""`make_env` and `make_expert`: an environment and its planner from plain, validated arguments."""

from __future__ import annotations

from numbers import Integral
from typing import Any

from torchrl.envs import EnvBase

from equirl.envs.bullet import ROBOTS
from equirl.envs.expert import Expert
from equirl.envs.manipulation import ManipulationEnv
from equirl.envs.tasks import Task, make_task
from equirl.envs.workspace import WORKSPACE

__all__ = ["make_env", "make_expert"]


def make_env(
    task: str | type[Task],
    *,
    image_size: int = 128,
    seed: int = 0,
    robot: str = "panda",
    max_steps: int = 50,
    time_limit: str = "truncate",
    **options: Any,
) -> ManipulationEnv:
    """Returns an environment of the paper's simulation.

    ``functools.partial(make_env, ...)`` can be pickled and sent to worker processes.

    Args:
        task: A name in `equirl.envs.tasks.TASKS`, or one of your own: its class, or
            ``"package.module:Class"``.
        image_size: Pixels along a side of the depth image, even.
        seed: Seed of the first episode, as given to ``set_seed``.
        robot: A name in `equirl.envs.ROBOTS`: ``"panda"``, the arm, as in the paper; ``"hand"``,
            its hand alone, free: faster, and its motion commutes with turns of the scene.
        max_steps: Length of an episode without success.
        time_limit: What the last of ``max_steps`` steps is: ``"truncate"`` (its value is
            bootstrapped) or ``"terminate"`` (as the paper's own implementation stores it).
        options: Numbers of the task, for example ``lift_height=0.12``; see the classes in
            `equirl.envs.tasks.TASKS`.

    Raises:
        ValueError: If an argument is not one of these.
    """
    _require(
        _is_int(image_size) and image_size > 0 and image_size % 2 == 0,
        "image_size",
        image_size,
        "an even positive integer",
    )
    _require(_is_int(seed) and seed >= 0, "seed", seed, "a non-negative integer")
    _require_one_of("robot", robot, tuple(ROBOTS))
    _require(_is_int(max_steps) and max_steps > 0, "max_steps", max_steps, "a positive integer")
    _require_one_of("time_limit", time_limit, ("truncate", "terminate"))
    return ManipulationEnv(
        make_task(task, **options),
        image_size=image_size,
        seed=seed,
        robot=robot,
        max_steps=max_steps,
        time_limit=time_limit,
        workspace=WORKSPACE,
    )


def make_expert(env: EnvBase, **options: str) -> Expert:
    """Returns the planner for the task of ``env``.

    Args:
        env: The `ManipulationEnv` it reads and acts in, wrapped in transforms or not.
        options: ``horizontal_clip``, how a displacement in x and y is limited to one action:
            ``"norm"``, the default, keeps its direction, so that (x, y) lies in the unit disc;
            ``"box"`` clips each component, as in the paper. And what the planner of the task
            offers (its ``CHOICES``): that of Clutter Grasping ``grasp``, which is ``"random"``,
            whatever the object's orientation, as in the paper, or ``"aligned"``, where least is
            in the way of the fingers.

    Raises:
        ValueError: If there is no planner for the task, or on another option or value.
    """
    base = getattr(env, "base_env", env)
    if not isinstance(base, ManipulationEnv):
        raise ValueError(f"experts act in a ManipulationEnv, got {type(base).__name__}")
    if base.task.expert is None:
        raise ValueError(f"{type(base.task).__name__} has no expert: its property 'expert' is None")
    return base.task.expert(base, **options)


def _is_int(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _require_one_of(name: str, value: object, allowed: tuple[str, ...]) -> None:
    _require(value in allowed, name, value, " or ".join(map(repr, allowed)))


def _require(valid: bool, name: str, value: object, expected: str) -> None:
    if not valid:
        raise ValueError(f"{name} must be {expected}, got {value!r}")
