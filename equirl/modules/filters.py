"""Expand every filter once per update instead of once per forward pass.

A steerable convolution's filter is a function of its weights. A soft actor-critic
update evaluates the same weights several times (losses, detached copies); inside
`shared_filters` the expansion is done once per set of weights and reused.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["expanded_filter", "shared_filters"]


@dataclass(frozen=True)
class _Entry:
    weights: Tensor  # keeps the memory alive, so that its address is not given to other weights
    snapshot: Tensor
    filter: Tensor


_Cache = dict[tuple, _Entry]
# Per context, so per thread and per asynchronous task; empty outside shared_filters().
_active: ContextVar[_Cache | None] = ContextVar("equirl_shared_filters", default=None)


@contextlib.contextmanager
def shared_filters(*, apart: bool = False) -> Iterator[None]:
    """Within it, a filter is expanded once per weight tensor and then reused.

    A stored filter serves every pass through the same module with the same memory,
    attached or detached, as long as the values there are unchanged (they are compared,
    which costs far less than an expansion). Parameters swapped in functionally, such as
    a target network's, live elsewhere in memory and have filters of their own. Passes
    that need gradients share one graph: take one backward pass for all of them.
    The filters are dropped at the end of the context; an inner context shares the
    outer one's. Nothing is shared between threads, nor under ``vmap`` or ``export``.

    Args:
        apart: Share nothing with an outer context: for losses with a backward pass of their own.

    Example:
        >>> with shared_filters():
        ...     losses = loss_module(batch)
    """
    if _active.get() is not None and not apart:
        yield
        return
    token = _active.set({})
    try:
        yield
    finally:
        _active.reset(token)


def expanded_filter(
    owner: object, weights: Tensor, expand: Callable[[Tensor], Tensor], form: str = "dense"
) -> Tensor:
    """The filter of a module, from the active cache where there is one.

    Args:
        owner: The module; it stands for the meaning of the weights.
        weights: Its weights, possibly swapped in or detached.
        expand: Computes the filter of the weights.
        form: What ``expand`` makes of them; forms are kept apart.

    Returns:
        The filter; part of the autograd graph if the weights require a gradient and
        gradients are enabled.
    """
    cache = _active.get()
    if cache is None or torch.compiler.is_compiling():
        return expand(weights)
    try:
        address = weights.data_ptr()
    except RuntimeError:  # a tensor without storage: inside vmap or another transform
        return expand(weights)
    inference = torch.is_inference_mode_enabled()
    key = (id(owner), form, address, weights.dtype, weights.device, inference)
    needs_grad = weights.requires_grad and torch.is_grad_enabled()
    entry = cache.get(key)
    if entry is None or not _serves(entry, weights, needs_grad):
        # With its graph even where this pass needs none, so that a later one can use it.
        with torch.set_grad_enabled(weights.requires_grad and not inference):
            entry = _Entry(weights, weights.detach().clone(), expand(weights))
        cache[key] = entry
    return entry.filter if needs_grad else entry.filter.detach()


def _serves(entry: _Entry, weights: Tensor, needs_grad: bool) -> bool:
    # The gradient must reach this very tensor, not another one over the same memory.
    if needs_grad and not (entry.filter.requires_grad and entry.weights is weights):
        return False
    return torch.equal(entry.snapshot, weights.detach())
