"""Compilation of the inner loops."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

__all__ = ["compiled"]


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles ``function`` at its first call and keeps the machine code between processes.

    Numba raises while decorating when it finds no writable directory for its cache (an install and
    a home directory that are both read-only); the function is then compiled in every process.
    """
    try:
        return numba.njit(cache=True)(function)
    except RuntimeError:
        return numba.njit(function)
