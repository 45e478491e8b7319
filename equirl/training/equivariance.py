"""How exactly the networks of a run have the symmetry: on what, and the rows of its log."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from equirl.data import QuantizeDepth
from equirl.modules import shared_filters
from equirl.symmetry import SymmetryGroup, equivariance_report

__all__ = ["replay_observations", "symmetry_errors"]

#: The columns of the log, for what the report calls its quantities.
_COLUMNS = {
    "mean": "mean",
    "sigma": "sigma",
    "log-probability": "log_prob",
    "action": "action",
    "Q": "q",
}


def replay_observations(rows: TensorDictBase, max_depth: float, count: int) -> TensorDict:
    """Observations and actions of a replay buffer, as they were seen and not as augmented.

    Args:
        rows: Transitions as stored, of batch size (N,).
        max_depth: Largest depth observed, m, which sets the storage's resolution.
        count: How many, evenly spaced among the rows; all if there are fewer.

    Returns:
        ``depth``, ``holding`` and ``action`` of batch size (min(count, N),).
    """
    picked = torch.linspace(0, len(rows) - 1, min(count, len(rows))).round().long()
    chosen = rows.select("depth", "holding", "action", ("next", "depth"))[picked]
    return QuantizeDepth(max_depth)(chosen).exclude("next")


def symmetry_errors(
    networks: Sequence[TensorDictModuleBase], group: str, observations: TensorDictBase
) -> dict[str, float]:
    """Mean and largest error of each quantity over the elements of a group but the identity.

    Of SO(2) and O(2) the elements are the eighth turns, with and without reflection.

    Args:
        networks: Policies and critics, of different quantities.
        group: The group's name.
        observations: What the networks read.

    Returns:
        ``mean``, ``mean_max``, ``sigma``, and so on, as in ``symmetry.csv``.
    """
    errors, elements = {}, SymmetryGroup(group).some_elements(8)
    for network in networks:
        with shared_filters():
            report = equivariance_report(
                network, group, observations, elements=elements, layers=False
            )
        for name in report.names("end to end"):
            column = _COLUMNS[name]
            errors[column], errors[f"{column}_max"] = report.error(name)
    return errors
