"""The tasks: a file of this folder each, which says all there is to say about one."""

from __future__ import annotations

import pkgutil
from dataclasses import fields
from importlib import import_module
from inspect import getmembers, isabstract, isclass
from typing import Any

from equirl.envs.tasks.base import PlacementError, State, Task, lying, rejection_sample
from equirl.envs.tasks.block_task import BlockTask
from equirl.envs.tasks.lift_task import LiftTask

__all__ = [
    "TASKS",
    "BlockTask",
    "LiftTask",
    "PlacementError",
    "State",
    "Task",
    "find_task",
    "lying",
    "make_task",
    "rejection_sample",
]


def _task_of(module: str) -> type[Task] | None:
    """Returns the task a module defines; None if it holds what tasks share.

    Raises:
        ImportError: If it defines several.
    """
    tasks = [
        each
        for _, each in getmembers(import_module(module), isclass)
        if issubclass(each, Task) and each.__module__ == module and not isabstract(each)
    ]
    if len(tasks) > 1:
        names = ", ".join(task.__name__ for task in tasks)
        raise ImportError(f"{module} defines the tasks {names}; expected one a file")
    return tasks[0] if tasks else None


#: The tasks of this folder, by the names of their files.
TASKS: dict[str, type[Task]] = {
    entry.name: task
    for entry in pkgutil.iter_modules(__path__)
    if (task := _task_of(f"{__name__}.{entry.name}"))
}


def find_task(name: str | type[Task]) -> type[Task]:
    """Returns the class of a task.

    Args:
        name: One of `TASKS`, ``"package.module:Class"`` for a task defined elsewhere, or the class
            itself.

    Raises:
        ValueError: If there is no such task, or its module ends in an error.
    """
    task: Any = TASKS.get(name, name) if isinstance(name, str) else name
    if isinstance(task, str):
        module, colon, attribute = task.partition(":")
        if not colon or task.startswith("."):  # relative to nothing
            raise ValueError(
                f"unknown task {name!r}; expected {', '.join(TASKS)} or 'package.module:Class'"
            )
        try:
            task = getattr(import_module(module), attribute)
        except Exception as error:  # whatever the user's code raises
            told = f"{type(error).__name__}: {error}"
            raise ValueError(f"task {name!r} cannot be imported: {told}") from error
    if not (isclass(task) and issubclass(task, Task)):
        raise ValueError(f"a task must be a subclass of {Task.__module__}.Task, got {task!r}")
    return task


def make_task(task: str | type[Task], **options: Any) -> Task:
    """Returns a task with numbers of one's own.

    Args:
        task: As for `find_task`.
        options: Numbers of the task, by the names of its attributes.

    Raises:
        ValueError: If there is none, or it has no such option or not such a value; the message
            lists the names.
    """
    kind = find_task(task)
    known = sorted(each.name for each in fields(kind))
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ValueError(
            f"{kind.__name__} has no option {', '.join(unknown)}; its options: {', '.join(known)}"
        )
    return kind(**options)
