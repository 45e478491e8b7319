"""What the experts earn: the ceilings of learning curves, measured once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["CEILINGS", "DISCOUNT", "expert_ceiling"]

#: Of the returns below, the paper's.
DISCOUNT = 0.99

#: Mean discounted return of each task's expert by the run's ``mode``: 200 episodes each, failed
#: ones counted, by `python experiments/ceilings.py --episodes 200`. Standard errors are 0.011 for
#: clutter (97.5 % of its episodes succeed, all of the others') and at most 0.001 elsewhere.
CEILINGS = {
    ("block_picking", "strict"): 0.941,
    ("block_picking", "paper"): 0.941,
    ("clutter_grasping", "strict"): 0.893,
    ("clutter_grasping", "paper"): 0.891,
    ("block_pushing", "strict"): 0.939,
    ("block_pushing", "paper"): 0.946,
    ("block_in_bowl", "strict"): 0.910,
    ("block_in_bowl", "paper"): 0.922,
}

#: What else the numbers depend on, with the values they were measured at.
_MEASURED = {"env.robot": "panda", "env.max_steps": 50, "evaluation.discount": DISCOUNT}


def expert_ceiling(keys: Mapping[str, Any]) -> float | None:
    """What the expert of a run earns on average, if it was measured.

    Args:
        keys: The run's configuration, see `equirl.analysis.runs.Run`.

    Returns:
        The mean discounted return; None for a task, an expert, a robot, a discount or a length of
        episodes (the paper's is 50 steps) that the table does not have.
    """
    own = any(name.startswith(("env.options.", "demos.options.")) for name in keys)
    same = all(keys.get(name, value) == value for name, value in _MEASURED.items())
    if own or not same:
        return None
    return CEILINGS.get((str(keys.get("env.task")), str(keys.get("mode"))))
