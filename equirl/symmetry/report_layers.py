"""Layer by layer: features of moved observations, against the features moved."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from equirl.symmetry.audit_transforms import field_matrix, transform_fields, transform_image
from equirl.symmetry.groups import Element, SymmetryGroup
from equirl.symmetry.report_outputs import ActionLaw, as_array, moved_inputs, summary

__all__ = ["each_layer", "find_layers"]

_IDENTITY = Element(0.0)


def each_layer(
    network: Any,
    layers: dict[str, Any],
    inputs: TensorDict,
    elements: Sequence[Element],
    law: ActionLaw,
) -> Iterator[tuple[str, int, np.ndarray]]:
    """Errors after each layer under each element of its group, as `summary` has them."""
    groups = {layer.out_type.group for layer in layers.values()}
    with _recorded(network, layers) as outputs:
        network(inputs.copy())
        before = dict(outputs)
        for index, element in enumerate(elements):
            if not any(element in group for group in groups):
                continue
            outputs.clear()
            network(moved_inputs(inputs, element, law))
            for name, values in before.items():
                for value, after in zip(values, outputs[name], strict=True):
                    expected = _moved_features(value, element, layers[name].out_type)
                    if expected is not None:
                        yield name, index, summary(expected - after, value)


def _moved_features(value: np.ndarray, element: Element, fields: Any) -> np.ndarray | None:
    """Features (B, C) or (B, C, H, W), moved; None where that is not exact."""
    if element not in fields.group:
        return None
    if value.ndim != 4:
        return transform_fields(value, fields.fields, element, fields.group)
    if value.shape[-2:] != (1, 1):
        if not element.preserves_grid:
            return None
        value = transform_image(value, element)
    channels_last = np.moveaxis(value, 1, -1)
    return np.moveaxis(transform_fields(channels_last, fields.fields, element, fields.group), -1, 1)


def find_layers(network: nn.Module) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The steerable layers under short names, and the names of those of unknown fields."""
    found = {
        path: module
        for path, module in network.named_modules()
        # TensorDict's wrappers have the attributes of what they wrap.
        if not isinstance(module, TensorDictModuleBase)
        and hasattr(module, "in_type")
        and hasattr(module, "out_type")
    }
    # The paths into what TensorDict wraps say nothing: "module.0.module.encoder.layers.0".
    short = {path: re.sub(r"^(module(\.\d+)?(\.|$))+", "", path) for path in found}
    names = {path: short[path] or type(found[path]).__name__ for path in found}
    if len(set(names.values())) < len(names):
        names = {path: path for path in found}
    known = {names[path]: module for path, module in found.items() if _is_known(module.out_type)}
    return known, tuple(name for name in names.values() if name not in known)


def _is_known(fields: Any) -> bool:
    group = getattr(fields, "group", None)
    if not isinstance(group, SymmetryGroup):
        return False
    try:
        return all(len(field_matrix(field, _IDENTITY, group)) for field in set(fields.fields))
    except ValueError:
        return False


@contextmanager
def _recorded(
    network: nn.Module, layers: dict[str, nn.Module]
) -> Iterator[dict[str, list[np.ndarray]]]:
    """Within it, the outputs of each layer are gathered, call by call.

    Kernels that compute many layers at once call none: what has a ``backend`` runs dense.
    """
    outputs: dict[str, list[np.ndarray]] = {}

    def watch(name: str) -> Callable[[nn.Module, Any, Any], None]:
        def record(module: nn.Module, args: Any, output: Any) -> None:
            if isinstance(output, Tensor):
                outputs.setdefault(name, []).append(as_array(output))

        return record

    hooks = [layer.register_forward_hook(watch(name)) for name, layer in layers.items()]
    native: list[Any] = [m for m in network.modules() if vars(m).get("backend") == "native"]
    try:
        for module in native:
            module.backend = "dense"
        yield outputs
    finally:
        for module in native:
            module.backend = "native"
        for hook in hooks:
            hook.remove()
