"""How far two policies differ, and how far a policy is from turning with the scene.

Everything is measured on arrays, with the arithmetic of `equirl.symmetry.audit_transforms`, which
networks and replay buffers share nothing with.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from equirl.symmetry import Element
from equirl.symmetry.audit_transforms import transform_action, transform_image
from equirl.training.export.formats import OUTPUTS, Outputs, Policy

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
    """Observations to measure on: the stored ones, and images drawn at random.

    Of those drawn a third is noise, in which each pixel is on its own; a third a floor with boxes
    on it; and a third looks the same from every side, where a network that breaks ties by order
    errs.

    Args:
        count: How many.
        image_size: S, pixels along a side.
        max_depth: The greatest depth, m.
        stored: Observations of the task, which come first.
    """
    rng = np.random.default_rng(0)
    drawn = [_draw(number % 3, image_size, rng) for number in range(count)]
    depth = max_depth * np.array(drawn, np.float32)[:, None]
    holding = rng.integers(0, 2, (count, 1)).astype(np.float32)
    if stored is not None:
        depth = np.concatenate([stored.depth, depth])[:count]
        holding = np.concatenate([stored.holding, holding])[:count]
    return Observations(depth, holding)


def _draw(kind: int, size: int, rng: np.random.Generator) -> np.ndarray:
    """Draws an image (size, size) of numbers in [0, 1]."""
    if kind == 0:
        return rng.uniform(size=(size, size))
    image = np.full((size, size), rng.uniform(0.3, 1))
    if kind == 1:
        for _ in range(3):
            row, column = rng.integers(0, size - size // 4, 2)
            image[row : row + size // 4, column : column + size // 4] = rng.uniform()
    else:
        border = rng.integers(0, size // 2)
        image[border : size - border, border : size - border] = rng.uniform()
    return image


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
    before: Outputs,
    elements: Sequence[Element],
    rules: Sequence[str] = (PHYSICAL,),
) -> dict[str, list[dict[str, float | str]]]:
    """How far the answers to turned observations are from the turned answers.

    Args:
        policy: What is measured.
        observations: To be turned.
        before: Its answers to them as they are.
        elements: Turns that map pixels onto pixels.
        rules: `PHYSICAL`, `PAPER` or both.

    Returns:
        For each rule a row an element: its name, the largest absolute error of each output, and
        ``unturned``, the error of the action that the answer left as it was would have.
    """
    rows: dict[str, list[dict[str, float | str]]] = {rule: [] for rule in rules}
    for element in elements:
        turned = np.ascontiguousarray(transform_image(observations.depth, element))
        after = answers(policy, Observations(turned, observations.holding))
        for rule in rules:
            expected = _turn(before, element, rule)
            errors = differences(after, expected)
            rows[rule].append(
                {
                    "element": element_name(element),
                    **{name: error.largest for name, error in errors.items()},
                    "unturned": differences(before, expected)["action"].largest,
                }
            )
    return rows


def _turn(outputs: Outputs, element: Element, rule: str) -> Outputs:
    keep_theta = rule == PAPER
    moved = {
        name: np.stack([transform_action(row, element, keep_theta) for row in outputs[name]])
        for name in ("action", "loc")
    }
    scale = outputs["scale"].copy()
    if rule == PHYSICAL and (element.quarter_turns or 0) % 2:  # the axes of x and y change places
        scale[:, [1, 2]] = scale[:, [2, 1]]
    return {**moved, "scale": scale}


def element_name(element: Element) -> str:
    """An element in words: a turn, and whether y was reversed before."""
    turn = f"{math.degrees(element.angle):g}°"
    if not element.reflected:
        return turn
    return f"y reversed, {turn}" if element.quarter_turns else "y reversed"
