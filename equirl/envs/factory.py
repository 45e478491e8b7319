"""`make_env`: an environment from plain, validated arguments."""

from __future__ import annotations

from numbers import Integral
from typing import Any, Literal

from equirl.envs.manipulation import ManipulationEnv
from equirl.envs.tasks import make_task
from equirl.envs.workspace import Workspace


def make_env(
    task: str,
    *,
    image_size: int = 128,
    seed: int = 0,
    robot: Literal["panda", "hand"] = "panda",
    max_steps: int = 50,
    time_limit: Literal["truncate", "terminate"] = "truncate",
    **options: Any,
) -> ManipulationEnv:
    """Returns an environment of the paper's simulation.

    ``functools.partial(make_env, ...)`` can be pickled and sent to worker processes.

    Args:
        task: ``"block_picking"``, ``"clutter_grasping"``, ``"block_pushing"`` or
            ``"block_in_bowl"``.
        image_size: pixels along a side of the depth image, even.
        seed: seed of the first episode, as given to ``set_seed``.
        robot: ``"panda"``: the arm, as in the paper; ``"hand"``: its hand alone, free: faster,
            and its motion commutes with turns of the scene.
        max_steps: length of an episode without success.
        time_limit: what the last of ``max_steps`` steps is: ``"truncate"`` (its value is
            bootstrapped) or ``"terminate"`` (as the paper's own implementation stores it).
        options: numbers of the task, for example ``lift_height=0.12``; see the classes in
            `equirl.envs.tasks`.

    Raises:
        ValueError: if an argument is not one of these.
    """
    _require(
        _is_int(image_size) and image_size > 0 and image_size % 2 == 0,
        "image_size",
        image_size,
        "an even positive integer",
    )
    _require(_is_int(seed) and seed >= 0, "seed", seed, "a non-negative integer")
    _require(robot in ("panda", "hand"), "robot", robot, "'panda' or 'hand'")
    _require(_is_int(max_steps) and max_steps > 0, "max_steps", max_steps, "a positive integer")
    _require(
        time_limit in ("truncate", "terminate"),
        "time_limit",
        time_limit,
        "'truncate' or 'terminate'",
    )
    return ManipulationEnv(
        make_task(task, **options),
        image_size=image_size,
        seed=seed,
        robot=robot,
        max_steps=max_steps,
        time_limit=time_limit,
        workspace=Workspace(),
    )


def _is_int(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _require(valid: bool, name: str, value: object, expected: str) -> None:
    if not valid:
        raise ValueError(f"{name} must be {expected}, got {value!r}")
