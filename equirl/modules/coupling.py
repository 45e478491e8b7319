"""Clebsch-Gordan coefficients of dihedral groups and O(2), the same on every machine.

escnn solves for them numerically, for O(2) with random elements, and keeps the result in a cache on
disk: their signs, and with them the meaning of every weight, differ from one installation to the
next, and the first network of D8 takes many seconds. Here the signs are fixed, nothing is random,
and no cache is needed. (For C_n and SO(2) escnn has closed forms.)
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np

__all__ = ["clebsch_gordan", "fixed_couplings"]

_TOLERANCE = 1e-9
_lock = threading.RLock()


def clebsch_gordan(first: Any, second: Any, product: Any) -> np.ndarray:
    """How an irrep occurs in the tensor product of two others, of a multiplicity-free group.

    Args:
        first: escnn's irrep of D_n or O(2), of dimension a.
        second: Another, of dimension b.
        product: A third, of dimension c.

    Returns:
        Shape (a, b, m, c), with m = 1 if ``product`` occurs and 0 if not: the map from the
        product to vectors of orthonormal columns that commutes with the group, its first
        entry that is not zero positive.
    """
    a, b, c = first.size, second.size, product.size
    equations = []
    for element in _generators(first.group):
        pair, single = np.kron(first(element), second(element)), product(element)
        equations.append(np.kron(pair, np.eye(c)) - np.kron(np.eye(a * b), single.T))
    _, scales, rows = np.linalg.svd(np.concatenate(equations))
    null = rows[scales < _TOLERANCE]
    if not len(null):
        return np.zeros((a, b, 0, c))
    if len(null) > 1:
        raise ValueError(
            f"{product.name} occurs more than once in {first.name} times {second.name}"
        )
    entries = null[0][np.abs(null[0]) > _TOLERANCE]
    return (np.sign(entries[0]) * np.sqrt(c) * null[0]).reshape(a, b, 1, c)


def _generators(group: Any) -> list[Any]:
    try:
        return list(group.generators)
    except ValueError:  # O(2): a rotation whose powers are dense, and a reflection
        return [group.element((0, 1.0)), group.element((1, 0.0))]


@contextlib.contextmanager
def fixed_couplings(group: Any) -> Iterator[None]:
    """Within it escnn's object for D_n or O(2) gives these coefficients; others are left alone."""
    if type(group).__name__ not in ("DihedralGroup", "O2"):
        yield
        return

    @functools.cache
    def coefficients(first: tuple, second: tuple, product: tuple) -> np.ndarray:
        return clebsch_gordan(group.irrep(*first), group.irrep(*second), group.irrep(*product))

    @functools.cache
    def decomposition(first: tuple, second: tuple) -> list[tuple[tuple, int]]:
        irreps = [irrep.id for irrep in group.irreps()]
        return [(j, 1) for j in irreps if coefficients(first, second, j).shape[2]]

    ours = {
        "_clebsh_gordan_coeff": lambda *irreps: coefficients(*map(group.get_irrep_id, irreps)),
        "_tensor_product_irreps": lambda *irreps: decomposition(*map(group.get_irrep_id, irreps)),
    }
    with _lock:  # escnn has one object for each group
        before = {name: vars(group).get(name) for name in ours}
        vars(group).update(ours)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    delattr(group, name)
                else:  # in a context of the same group
                    setattr(group, name, value)
