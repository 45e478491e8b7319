"""How far two policies differ, and how far a policy is from turning with the scene.

Two policies are compared on arrays; how a policy turns is measured by the equivariance report,
whose arithmetic networks and replay buffers share nothing with.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from equirl.symmetry import Element, SymmetryGroup, equivariance_report, random_observations
from equirl.symmetry.audit_transforms import ACTION_FIELDS
from equirl.training.export.formats import INPUTS, OUTPUTS, Outputs, Policy

__all__ = [
    "PAPER",
    "PHYSICAL",
    "Difference",
    "Observations",
    "allowed",
    "answers",
    "batch_sizes",
    "differences",
    "element_name",
    "make_observations",
    "remembered",
    "tolerances",
    "turning_errors",
]

#: What one way of computing in float32 may differ from another by: so many times as much as the
#: policy's dense filters in float32 differ from float64 ones, on the same observations, ...
ROUNDING_FACTOR = 10.0
#: ... or this, of numbers up to 1: float32 keeps seven digits.
SMALLEST_ROUNDING = 1e-6
#: No larger error is called rounding, of numbers up to 1. Of an action it is 0.05 mm or 0.045°.
LARGEST_ROUNDING = 1e-3

#: How actions and deviations turn: as in the world, or as the paper's networks declare it.
PHYSICAL, PAPER = "physical", "paper"
_THETA_KEPT = ("trivial", "vector", "trivial", "trivial")
_LAWS: dict[str, dict[str, tuple[str, ...]]] = {
    PHYSICAL: dict.fromkeys(OUTPUTS, ACTION_FIELDS),
    PAPER: {"action": _THETA_KEPT, "loc": _THETA_KEPT, "scale": ("trivial",) * 5},
}
#: What the equivariance report calls the outputs, and its columns that certificates have.
_QUANTITIES = {"action": "action", "loc": "mean", "scale": "sigma"}
_COLUMNS = {"mean": "mean", "largest": "max", "size": "size", "there_and_back": "interpolated"}


class Observations(NamedTuple):
    """What a policy sees; float32 arrays.

    Attributes:
        depth: Shape (N, 1, S, S), m.
        holding: Shape (N, 1), 0 or 1.
    """

    depth: np.ndarray
    holding: np.ndarray


def make_observations(
    count: int, image_size: int, max_depth: float, stored: Observations | None = None
) -> Observations:
    """Observations to measure on: the stored ones, and those of `random_observations`.

    Args:
        count: How many.
        image_size: S, pixels along a side.
        max_depth: The greatest depth, m.
        stored: Observations of the task, which come first.
    """
    drawn = random_observations(count, image_size, max_depth=max_depth)
    seen = Observations(drawn["depth"].numpy(), drawn["holding"].numpy())
    if stored is None:
        return seen
    return Observations(*(np.concatenate(both)[:count] for both in zip(stored, seen, strict=True)))


def batch_sizes(count: int) -> list[int]:
    """In what portions so many observations are given to a policy: 1, 2, 3, then 64 at most."""
    sizes = [1, 2, 3] if count >= 6 else [1] * count
    while sum(sizes) < count:
        sizes.append(min(64, count - sum(sizes)))
    return sizes


def answers(policy: Policy, observations: Observations) -> Outputs:
    """What a policy gives for all observations, each `OUTPUTS` of shape (N, 5)."""
    parts = [policy(*portion) for portion in _portions(observations)]
    return {name: np.concatenate([part[name] for part in parts]) for name in OUTPUTS}


def _portions(observations: Observations) -> Iterator[Observations]:
    start = 0
    for size in batch_sizes(len(observations.depth)):
        yield Observations(*(array[start : start + size] for array in observations))
        start += size


class Difference(NamedTuple):
    """How far an output differs from another, the largest of an observation's five errors.

    Attributes:
        median: Over the observations.
        largest: Over the observations.
    """

    median: float
    largest: float


def differences(some: Outputs, others: Outputs) -> dict[str, Difference]:
    """How far each output differs."""
    errors = {name: np.abs(some[name] - others[name]).max(-1) for name in OUTPUTS}
    return {name: Difference(float(np.median(e)), float(e.max())) for name, e in errors.items()}


def allowed(rounding: dict[str, Difference], outputs: Outputs) -> dict[str, Difference]:
    """What outputs may differ by if they are computed in another order.

    Where rounding decides between ties it may be much, but in few observations: hence the median.

    Args:
        rounding: How far outputs in float32 are from those in float64.
        outputs: The outputs, for their size.
    """
    bounds = {}
    for name, (median, largest) in rounding.items():
        least = SMALLEST_ROUNDING * max(1.0, float(np.abs(outputs[name]).max()))
        bounds[name] = Difference(*(ROUNDING_FACTOR * max(x, least) for x in (median, largest)))
    return bounds


def tolerances(bounds: dict[str, Difference], outputs: Outputs) -> dict[str, float]:
    """Up to which error each output is said to turn exactly."""
    sizes = {name: max(1.0, float(np.abs(outputs[name]).max())) for name in OUTPUTS}
    return {name: min(bounds[name].largest, LARGEST_ROUNDING * sizes[name]) for name in OUTPUTS}


def turning_errors(
    policy: Policy,
    observations: Observations,
    group: SymmetryGroup,
    elements: Sequence[Element],
    rule: str = PHYSICAL,
) -> list[dict[str, Any]]:
    """How far the answers to turned observations are from the turned answers.

    Args:
        policy: What is measured.
        observations: To be turned; by interpolation where pixels do not fall onto pixels.
        group: Whose elements are taken.
        elements: By which to turn, at least one.
        rule: `PHYSICAL` or `PAPER`.

    Returns:
        A row an element: its name, ``degrees``, whether it is ``reflected`` and ``on_grid``, and
        for each output the ``mean`` and the ``largest`` absolute error, the mean ``size`` of what
        was to be turned, and ``there_and_back``, the mean change when the picture is turned there
        and back, None where that is exact.
    """
    seen = {name: torch.from_numpy(array) for name, array in observations._asdict().items()}
    inputs = TensorDict(seen, batch_size=[len(observations.depth)])
    rows: list[dict[str, Any]] = [
        {
            "element": element_name(element),
            "degrees": math.degrees(element.angle),
            "reflected": element.reflected,
            "on_grid": element.preserves_grid,
        }
        for element in elements
    ]
    laws = _LAWS[rule]
    for fields in dict.fromkeys(laws.values()):
        names = [name for name in OUTPUTS if laws[name] == fields]
        report = equivariance_report(
            _as_module(policy, names), group, inputs, elements=elements, action=fields, layers=False
        )
        for name in names:
            found = report.select(name=_QUANTITIES[name])
            for number, row in enumerate(rows):
                row[name] = {key: float(found[c][number]) for key, c in _COLUMNS.items()}
                if row["on_grid"]:
                    row[name]["there_and_back"] = None
    return rows


def remembered(policy: Policy) -> Policy:
    """The same policy, asked only once about the same observations."""
    known: dict[int, Outputs] = {}

    def function(depth: np.ndarray, holding: np.ndarray) -> Outputs:
        key = hash((depth.tobytes(), holding.tobytes()))
        if key not in known:
            known[key] = policy(depth, holding)
        return known[key]

    return function


def _as_module(policy: Policy, names: Sequence[str]) -> TensorDictModule:
    def function(depth: Tensor, holding: Tensor) -> tuple[Tensor, ...]:
        out = policy(depth.numpy(), holding.numpy())
        return tuple(torch.from_numpy(out[name]) for name in names)

    return TensorDictModule(function, in_keys=list(INPUTS), out_keys=list(names))


def element_name(element: Element) -> str:
    """An element in words: a turn, and whether y was reversed before."""
    turn = f"{math.degrees(element.angle):g}°"
    if not element.reflected:
        return turn
    return "y reversed" if element.angle == 0 else f"y reversed, {turn}"
