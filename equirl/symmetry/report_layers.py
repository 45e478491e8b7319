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
from equirl.symmetry.report_outputs import ActionLaw, Errors, as_array, moved_inputs, summary

__all__ = ["each_layer", "find_layers", "layer_elements"]

_IDENTITY = Element(0.0)
_OTHERS = 4  # elements that do not map the pixel grid, on which layers are compared


def each_layer(
    network: Any,
    layers: dict[str, Any],
    inputs: TensorDict,
    elements: Sequence[Element],
    law: ActionLaw,
) -> Iterator[tuple[Element, Errors]]:
    """For each element the errors after the layers of whose group it is.

    A layer that is called more than once has the errors of all calls side by side.
    """
    with _recorded(network, layers) as outputs:
        network(inputs.copy())
        before = dict(outputs)
        for element in elements:
            outputs.clear()
            network(moved_inputs(inputs, element, law))
            errors = {}
            for name, values in before.items():
                moved = [_moved_features(v, element, layers[name].out_type) for v in values]
                calls = zip(moved, outputs[name], values, strict=True)
                parts = [summary(m - after, value) for m, after, value in calls if m is not None]
                if parts:
                    errors[name] = np.concatenate(parts, axis=1)
            yield element, errors


def layer_elements(layers: dict[str, Any], elements: Sequence[Element]) -> list[Element]:
    """Those under which layers are compared: all that map the pixel grid, then a few others.

    Single layers run dense, which is slow, and under the others there is little to compare.
    """
    groups = {layer.out_type.group for layer in layers.values()}
    moving = [g for g in elements if g.reflected or g.quarter_turns != 0]
    own = [g for g in moving if any(g in group for group in groups)]
    others = [g for g in own if not g.preserves_grid]
    kept = {round(i) for i in np.linspace(0, len(others) - 1, _OTHERS)} if others else set()
    return [g for g in own if g.preserves_grid] + [others[i] for i in sorted(kept)]


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
    names = {path: _short_name(path, found) for path in found}
    if len(set(names.values())) < len(names):
        names = {path: path for path in found}
    known = {names[path]: module for path, module in found.items() if _is_known(module.out_type)}
    return known, tuple(name for name in names.values() if name not in known)


def _short_name(path: str, layers: dict[str, Any]) -> str:
    """``"encoder.layers.0"`` for ``"module.0.module.encoder.layers.0"``.

    The path into what TensorDict wraps says nothing. If what is wrapped there is a layer itself,
    its class gives the name: ``"heads.hidden"`` of ``EquivariantQHeads``.
    """
    rest = re.sub(r"^(module(\.\d+)?(\.|$))+", "", path)
    root = path.removesuffix(rest).rstrip(".")
    if root not in layers:
        return rest
    kind = type(layers[root]).__name__
    last_word = re.search(r"[A-Z]?[a-z0-9_]+$", kind)
    return f"{(last_word[0] if last_word else kind).lower()}.{rest}".rstrip(".")


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
