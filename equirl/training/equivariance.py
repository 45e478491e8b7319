"""How exactly the networks of a run have the symmetry: on what, and the rows of its log."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from equirl.data import QuantizeDepth
from equirl.modules import shared_filters
from equirl.symmetry import SymmetryGroup, equivariance_report
from equirl.symmetry.report_result import BETWEEN, ON_GRID

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
    """Mean and largest error of each quantity under a group, on the pixel grid and between.

    On the grid are the elements that map it onto itself, but the identity: what errs there is the
    network. Between are the other elements, of SO(2) and O(2) the other eighth turns, with and
    without reflection: there the picture is interpolated as well, and how much that does by itself
    is told by turning it there and back.

    Args:
        networks: Policies and critics, of different quantities.
        group: The group's name.
        observations: What the networks read.

    Returns:
        For ``mean``, ``sigma`` and so on: ``mean_grid`` and ``mean_grid_max``, ``mean_between``
        and ``mean_between_max``, and ``mean_back``, as in ``symmetry.csv``; nan where the group has
        no such elements.
    """
    errors, elements = {}, SymmetryGroup(group).some_elements(8)
    for network in networks:
        with shared_filters():
            report = equivariance_report(
                network, group, observations, elements=elements, layers=False
            )
        for name in report.names("end to end"):
            column = _COLUMNS[name]
            for place, kinds in (("grid", ON_GRID), ("between", BETWEEN)):
                mean, largest = report.error(name, kind=kinds)
                errors[f"{column}_{place}"], errors[f"{column}_{place}_max"] = mean, largest
            errors[f"{column}_back"] = report.there_and_back(name)
    return errors
