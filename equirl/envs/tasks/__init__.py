"""The tasks, by name."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from equirl.envs.tasks.base import PlacementError, State, Task
from equirl.envs.tasks.block_in_bowl import BlockInBowl
from equirl.envs.tasks.block_picking import BlockPicking
from equirl.envs.tasks.block_pushing import BlockPushing
from equirl.envs.tasks.clutter_grasping import ClutterGrasping

TASKS: dict[str, type[Task]] = {
    "block_picking": BlockPicking,
    "clutter_grasping": ClutterGrasping,
    "block_pushing": BlockPushing,
    "block_in_bowl": BlockInBowl,
}

__all__ = [
    "TASKS",
    "BlockInBowl",
    "BlockPicking",
    "BlockPushing",
    "ClutterGrasping",
    "PlacementError",
    "State",
    "Task",
    "make_task",
]


def make_task(name: str, **options: Any) -> Task:
    """Returns the task called ``name``.

    Args:
        name: a key of `TASKS`.
        options: numbers of the task, by the names of its attributes.

    Raises:
        ValueError: if there is none, or it has no such option or not such a value; the message
            lists the names.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; known tasks: {', '.join(sorted(TASKS))}")
    known = sorted(each.name for each in fields(TASKS[name]))
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ValueError(
            f"{name} has no option {', '.join(unknown)}; its options: {', '.join(known)}"
        )
    return TASKS[name](**options)
