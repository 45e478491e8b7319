"""The tasks, by name."""

from __future__ import annotations

from equirl.envs.tasks.base import Task
from equirl.envs.tasks.block_picking import BlockPicking

TASKS: dict[str, type[Task]] = {"block_picking": BlockPicking}

__all__ = ["TASKS", "BlockPicking", "Task", "make_task"]


def make_task(name: str) -> Task:
    """Returns the task called ``name``.

    Raises:
        ValueError: if there is none; the message lists the names.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; known tasks: {', '.join(sorted(TASKS))}")
    return TASKS[name]()
