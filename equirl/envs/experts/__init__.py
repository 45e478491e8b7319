"""Scripted planners that solve the tasks from the simulator's state."""

from __future__ import annotations

from typing import Literal

from equirl.envs.experts.base import Expert
from equirl.envs.experts.block_in_bowl import BlockInBowlExpert
from equirl.envs.experts.block_picking import BlockPickingExpert
from equirl.envs.experts.block_pushing import BlockPushingExpert
from equirl.envs.experts.clutter_grasping import ClutterGraspingExpert
from equirl.envs.manipulation import ManipulationEnv
from equirl.envs.tasks import BlockInBowl, BlockPicking, BlockPushing, ClutterGrasping, Task

EXPERTS: dict[type[Task], type[Expert]] = {
    BlockPicking: BlockPickingExpert,
    ClutterGrasping: ClutterGraspingExpert,
    BlockPushing: BlockPushingExpert,
    BlockInBowl: BlockInBowlExpert,
}

__all__ = [
    "BlockInBowlExpert",
    "BlockPickingExpert",
    "BlockPushingExpert",
    "ClutterGraspingExpert",
    "Expert",
    "make_expert",
]


def make_expert(
    env: ManipulationEnv,
    *,
    horizontal_clip: Literal["norm", "box"] = "norm",
    grasp: Literal["random", "aligned"] = "random",
) -> Expert:
    """Returns the planner for the task of ``env``.

    Args:
        env: the environment it reads and acts in.
        horizontal_clip: how a displacement in x and y is limited to one action: ``"norm"`` keeps
            its direction, so that (x, y) lies in the unit disc; ``"box"`` clips each component, as
            in the paper.
        grasp: how Clutter Grasping's planner turns the gripper: ``"random"``, whatever the
            object's orientation, as in the paper, or ``"aligned"``, where least is in the way of
            the fingers. The cubes of the other tasks are always grasped along their sides.

    Raises:
        ValueError: if there is no planner for the task, or on another value of an option.
    """
    if horizontal_clip not in ("norm", "box"):
        raise ValueError(f"horizontal_clip must be 'norm' or 'box', got {horizontal_clip!r}")
    if grasp not in ("random", "aligned"):
        raise ValueError(f"grasp must be 'random' or 'aligned', got {grasp!r}")
    # Wrapped environments (transforms) lead to their base.
    base = getattr(env, "base_env", env)
    if not isinstance(base, ManipulationEnv):
        raise ValueError(f"experts act in a ManipulationEnv, got {type(base).__name__}")
    expert = EXPERTS.get(type(base.task))
    if expert is None:
        known = ", ".join(task.__name__ for task in EXPERTS)
        raise ValueError(f"no expert for {type(base.task).__name__}; there are some for: {known}")
    return expert(base, horizontal_clip, grasp)
