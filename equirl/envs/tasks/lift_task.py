"""What the tasks of lifting an object share."""

from __future__ import annotations

from dataclasses import dataclass

from equirl.envs.tasks.base import State, Task
from equirl.envs.workspace import WORKSPACE

__all__ = ["LiftTask"]


@dataclass(frozen=True, kw_only=True)
class LiftTask(Task):
    """A task whose success is holding any object with the gripper high enough.

    Attributes:
        lift_height: The end effector must be above this, m.
    """

    lift_height: float = 0.15

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("lift_height")
        self.require_below("lift_height", WORKSPACE.z_max, "the top of the workspace (m)")

    def succeeded(self, state: State) -> bool:
        """Tells whether an object is held high enough."""
        return state.held is not None and state.scene.position[2] > self.lift_height
