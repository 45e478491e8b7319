"""Does a network have the symmetry? Its outputs are compared with those for a moved picture.

Pictures, actions and features are moved by `audit_transforms`, which shares no code with the
networks but the group's elements.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase, set_interaction_type
from torch import nn

from equirl.symmetry.audit_transforms import ACTION_FIELDS
from equirl.symmetry.groups import Element, SymmetryGroup
from equirl.symmetry.report_layers import each_layer, find_layers, layer_elements
from equirl.symmetry.report_outputs import ActionLaw, end_to_end, network_inputs
from equirl.symmetry.report_result import EquivarianceReport, kind_of
from equirl.symmetry.representations import Representation

__all__ = ["equivariance_report"]

_BATCH = 16  # observations at a time: the features of all layers are held at once


def equivariance_report(
    network: TensorDictModuleBase,
    group: SymmetryGroup | str,
    observations: TensorDictBase,
    *,
    elements: Sequence[Element] | None = None,
    action: Representation | Sequence[str] = ACTION_FIELDS,
    keep_theta: bool = False,
    layers: bool = True,
    seed: int = 0,
    progress: Callable[[float], object] | None = None,
) -> EquivarianceReport:
    """Measures how far a policy or a critic is from commuting with a group.

    For each element g and observation s, what the network gives for g s is compared with what it
    gives for s, moved by g. End to end: of a policy the Gaussian's ``mean``, the deviations
    ``sigma`` as a matrix in (x, y), the ``log-probability`` of g a given g s against that of a
    given s, for a drawn from the policy, and the greedy ``action``; of a critic the values ``Q``.
    What a policy does not write is left out, and a policy that writes its action alone will do.

    Also after each steerable layer, which is any module with ``in_type`` and ``out_type``: its
    output for g s against that for s, its channels moved by the law of its fields and its pixels by
    g. An error shows after the layer that makes it and after those that follow. This is done for
    elements of the layer's group: all that map the pixel grid onto itself, and four others, under
    which layers are compared only where one pixel is left. It runs on the dense backend.

    The network is left as it was, and so are the random generators. It is measured in the mode that
    it is in: call its ``eval()`` first where that matters.

    Args:
        network: A policy, which writes ``action``, or a critic, which reads ``action`` and writes
            ``state_action_value`` (B, heads).
        group: The group or its name.
        observations: What the network reads, of any batch size: keys of shape (..., C, S, S) are
            pictures, whose rows grow with x and columns with y, all others invariants. A critic's
            ``action`` is random, within the unit disc in (x, y), if there is none.
        elements: Which to measure; those of the group if None, of SO(2) and O(2) some.
        action: How an action transforms: a representation, or the names of its blocks:
            ``"trivial"``, ``"vector"`` for (x, y), or ``"sign"`` for what changes its sign under
            reflections. That of manipulation if left out.
        keep_theta: Whether theta, and any sign, is to be an invariant, as in the paper's networks.
        layers: Whether to measure the layers, too.
        seed: Of the actions that are drawn here.
        progress: Told, after each piece of work, what share of the whole it was.

    Returns:
        The errors, with tables of them.

    Raises:
        ValueError: The network is neither, the observations are not what it reads, its action has
            another size than ``action``, or there is nothing to measure.

    Example:
        >>> from equirl.modules import make_actor
        >>> from equirl.symmetry import random_observations
        >>> actor = make_actor("D4", hidden=8, image_size=16)
        >>> report = equivariance_report(actor, "D4", random_observations(4, 16))
        >>> report.error("mean")[1] < 1e-5
        True
    """
    group = SymmetryGroup(group)
    elements = group.some_elements() if elements is None else tuple(elements)
    if not elements:
        raise ValueError("expected at least one element to measure, got none")
    if isinstance(action, Representation):
        action = [irrep.value for irrep in action.irreps]
    fields = tuple("trivial" if keep_theta and name == "sign" else name for name in action)
    law = ActionLaw(fields, group)
    inputs = network_inputs(network, observations, law, seed)
    watched, unmeasured = find_layers(network) if layers else ({}, ())
    compared = layer_elements(watched, elements)
    measured: dict[tuple[str, str, Element], list[np.ndarray]] = defaultdict(list)
    batches = inputs.split(_BATCH)
    with _untouched(network, seed):
        for batch in batches:
            for level, element, errors in chain(
                (("end to end", *found) for found in end_to_end(network, batch, elements, law)),
                (("layer", *found) for found in each_layer(network, watched, batch, compared, law)),
            ):
                for name, error in errors.items():
                    measured[level, name, element].append(error)
                if progress:
                    progress(1 / len(batches) / (len(elements) + len(compared)))
    records = []
    for (level, name, element), parts in measured.items():
        mean, largest, interpolated, size = np.concatenate(parts, axis=1)
        records.append(
            {
                "level": level,
                "name": name,
                "fields": _kinds(watched[name].out_type) if level == "layer" else "",
                "kind": str(kind_of(element, group)),
                "angle": math.degrees(element.angle) % 360,
                "reflected": element.reflected,
                "mean": mean.mean(),
                "max": largest.max(),
                "interpolated": interpolated.mean(),
                "size": size.mean(),
            }
        )
    rows = {column: np.array([record[column] for record in records]) for column in records[0]}
    return EquivarianceReport(group, elements, len(inputs), fields, unmeasured, rows)


def _kinds(fields: Any) -> str:
    """Returns ``"D4[6 trivial + 1 vector + 1 sign]"``."""
    counts = Counter(fields.fields)
    kinds = " + ".join(f"{count} {field}" for field, count in counts.items())
    return f"{fields.group.name}[{kinds}]"


@contextmanager
def _untouched(network: nn.Module, seed: int) -> Iterator[None]:
    """Within it, the network is greedy and random numbers are of ``seed``; all is restored."""
    buffers = [(buffer, buffer.clone()) for buffer in network.buffers()]
    devices = range(torch.cuda.device_count())
    with (
        torch.no_grad(),
        torch.random.fork_rng(devices=devices),
        set_interaction_type(InteractionType.DETERMINISTIC),
    ):
        torch.manual_seed(seed)
        try:
            yield
        finally:
            for buffer, value in buffers:  # of batch normalisation, say
                buffer.copy_(value)
