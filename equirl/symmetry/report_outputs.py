"""End to end: what a network gives for moved observations, against what it should give."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from equirl.symmetry.audit_transforms import (
    field_matrix,
    interpolate_image,
    transform_deviations,
    transform_fields,
)
from equirl.symmetry.groups import Element, SymmetryGroup
from equirl.symmetry.report_observations import random_actions
from equirl.symmetry.representations import Representation

__all__ = [
    "QUANTITIES",
    "ActionLaw",
    "Errors",
    "as_array",
    "end_to_end",
    "moved_inputs",
    "network_inputs",
    "summary",
]

_IDENTITY = Element(0.0)
#: What is compared end to end, in the order of the tables.
QUANTITIES = ("mean", "sigma", "log-probability", "action", "Q")
#: The outputs of a policy and of a critic that they are.
_OUTPUTS = {"mean": "loc", "sigma": "scale", "action": "action", "Q": "state_action_value"}
_ACTIONS = ("loc", "scale", "action")
#: Of each quantity, or layer, what `summary` returns.
Errors = dict[str, np.ndarray]


@dataclass(frozen=True)
class ActionLaw:
    """How actions are to transform, by this file's own arithmetic.

    Attributes:
        fields: The kind of each block, as `field_matrix` takes it.
        group: Whose elements move them.
    """

    fields: tuple[str, ...]
    group: SymmetryGroup

    @property
    def dim(self) -> int:
        """Number of components."""
        return sum(len(field_matrix(field, _IDENTITY, self.group)) for field in self.fields)

    def check(self, what: str, shape: Sequence[int]) -> None:
        """Checks that ``what``, of this shape without the batch, has as many components.

        Raises:
            ValueError: It has not.
        """
        if tuple(shape) != (self.dim,):
            raise ValueError(
                f"action={' + '.join(self.fields)}: expected {what} of {self.dim} components, got "
                f"shape {tuple(shape)}; say in action= how each block of it transforms"
            )

    def move(self, action: np.ndarray, element: Element) -> np.ndarray:
        """Moves actions (..., dim)."""
        return transform_fields(action, self.fields, element, self.group)

    def move_deviations(self, deviations: np.ndarray, element: Element) -> np.ndarray:
        """Moves deviations (..., dim), as matrices."""
        return transform_deviations(deviations, self.fields, element, self.group)


def end_to_end(
    network: Any, inputs: TensorDict, elements: Sequence[Element], law: ActionLaw
) -> Iterator[tuple[Element, Errors]]:
    """For each element the errors of all quantities.

    Raises:
        ValueError: The network fails on the inputs, or its action is not of the law.
    """
    actions = None
    try:
        if hasattr(network, "get_dist") and "action" in network.out_keys:
            actions = as_array(network.get_dist(inputs.copy()).sample())
        before = _outputs(network, inputs, actions, law)
    except RuntimeError as error:
        shapes = ", ".join(f"{key} {tuple(inputs[key].shape)}" for key in inputs.keys(True, True))
        raise ValueError(
            f"the network fails on observations of shapes {shapes}, with action="
            f"{' + '.join(law.fields)}: {error}"
        ) from error
    for element in elements:
        moved_actions = None if actions is None else law.move(actions, element)
        after = _outputs(network, moved_inputs(inputs, element, law), moved_actions, law)
        again = None
        if not element.preserves_grid:
            again = _outputs(network, _there_and_back(inputs, element), actions, law)
        errors = {}
        for name, value in before.items():
            expected = _expected(name, value, element, law)
            error = expected - _expected(name, after[name], _IDENTITY, law)
            change = None if again is None else value - again[name]
            errors[name] = summary(error, value, change)
        yield element, errors


def _outputs(
    network: Any, inputs: TensorDict, actions: np.ndarray | None, law: ActionLaw
) -> dict[str, np.ndarray]:
    """What the network gives, and the log-probability of ``actions``, by the names of tables."""
    outputs = network(inputs.copy())
    found = {}
    for name, key in _OUTPUTS.items():
        if key in network.out_keys:
            found[name] = as_array(outputs.get(key))
            if key in _ACTIONS:
                law.check(f"the network's {key}", found[name].shape[1:])
    if actions is not None:
        given = torch.from_numpy(actions).to(outputs.get("action"))
        log_probability = network.build_dist_from_params(outputs).log_prob(given)
        found["log-probability"] = as_array(log_probability)
    return {name: found[name] for name in QUANTITIES if name in found}


def _expected(name: str, value: np.ndarray, element: Element, law: ActionLaw) -> np.ndarray:
    """What a quantity should be after the element moved everything."""
    if name == "sigma":
        return law.move_deviations(value, element)
    return law.move(value, element) if name in ("mean", "action") else value


def moved_inputs(inputs: TensorDict, element: Element, law: ActionLaw) -> TensorDict:
    """What the network reads, moved."""

    def move(key: NestedKey, value: np.ndarray) -> np.ndarray:
        if key == "action":
            return law.move(value, element)
        return interpolate_image(value, element) if value.ndim == 4 else value

    return _mapped(inputs, move)


def _there_and_back(inputs: TensorDict, element: Element) -> TensorDict:
    """The same as before, but for two interpolations of the pictures."""

    def move(key: NestedKey, value: np.ndarray) -> np.ndarray:
        if value.ndim != 4:
            return value
        return interpolate_image(interpolate_image(value, element), element.inverse())

    return _mapped(inputs, move)


def _mapped(inputs: TensorDict, move: Callable[[NestedKey, np.ndarray], np.ndarray]) -> TensorDict:
    out = inputs.copy()
    for key in inputs.keys(True, True):
        value = inputs.get(key)
        moved = np.ascontiguousarray(move(key, value.cpu().numpy()))
        out.set(key, torch.from_numpy(moved).to(value))
    return out


def network_inputs(
    network: Any, observations: TensorDictBase, law: ActionLaw, seed: int
) -> TensorDict:
    """What the network reads, in one batch dimension, where and in which floats it computes.

    Raises:
        ValueError: The network is neither policy nor critic, the observations are not for it, or
            it takes other actions.
    """
    written = getattr(network, "out_keys", ())
    if not set(written) & set(_OUTPUTS.values()):
        raise ValueError(
            "expected a policy, which writes action, or a critic, which writes "
            f"state_action_value, got {type(network).__name__} with out_keys {list(written)}"
        )
    count = observations.batch_size.numel()
    if count < 1:
        raise ValueError("expected at least one observation, got none")
    inputs = TensorDict({}, batch_size=[count])
    for key in network.in_keys:
        value = observations.get(key, None)
        if value is None and key == "action":
            value = random_actions(count, law.fields, seed)
        elif value is None:
            present = ", ".join(map(str, observations.keys(True, True)))
            raise ValueError(f"the network reads {key!r}, got observations with {present}")
        else:
            value = value.reshape(count, *value.shape[observations.batch_dims :])
        if value.ndim == 4 and value.shape[-1] != value.shape[-2]:
            raise ValueError(f"expected square pictures, got {key} of shape {tuple(value.shape)}")
        if key == "action":
            law.check("the observations' action", value.shape[1:])
            for head in network.modules():
                taken = getattr(head, "in_rep", None)
                if isinstance(taken, Representation):
                    law.check("the network's action", (taken.dim,))
        inputs.set(key, value)
    parameter = next(network.parameters(), torch.zeros(()))
    inputs = inputs.to(parameter.device)
    return inputs.apply(lambda x: x.to(parameter.dtype) if x.is_floating_point() else x)


def summary(error: np.ndarray, value: np.ndarray, change: np.ndarray | None = None) -> np.ndarray:
    """For each of B observations: mean and largest error, mean change, mean size; (4, B)."""
    change = np.full(len(value), math.nan) if change is None else change
    error, value, change = (np.abs(x).reshape(len(x), -1) for x in (error, value, change))
    return np.stack([error.mean(1), error.max(1), change.mean(1), value.mean(1)])


def as_array(tensor: Tensor) -> np.ndarray:
    """A copy, since layers may go on in place, in double precision."""
    return np.array(tensor.detach().cpu(), dtype=np.float64)
