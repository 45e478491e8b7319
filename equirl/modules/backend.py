"""The choice of the implementation that an equivariant encoder runs on."""

from __future__ import annotations

import functools
import logging
import platform
from typing import Literal

import torch

from equirl.modules.native.library import NativeUnavailable, load
from equirl.symmetry import SymmetryGroup

__all__ = ["BACKENDS", "NativeUnavailable", "resolve_backend"]

#: ``"native"``: the compiled kernels; ``"dense"``: torch's own; ``"auto"``: the faster one.
BACKENDS = ("auto", "native", "dense")

#: Processors on which the native kernels were measured, with every instruction set, to be
#: faster than torch's.
NATIVE_IS_FASTER_ON = ("x86_64", "AMD64")

_logger = logging.getLogger("equirl")


def resolve_backend(
    name: str, group: SymmetryGroup, device: torch.device | str = "cpu"
) -> Literal["native", "dense"]:
    """The backend a name stands for on this machine.

    ``"auto"`` is native where the kernels serve the group and the device, are there and are
    faster, else dense. What it has chosen is logged once a process and reason under
    ``equirl``: as a warning when the kernels would be faster but are missing, otherwise as
    information.

    Args:
        name: One of `BACKENDS`.
        group: The symmetry group; the kernels serve those that contain the quarter turns.
        device: Where the network is; the kernels run on the CPU.

    Raises:
        ValueError: The name is none of them, or ``"native"`` was asked for a group or device
            that the kernels do not serve.
        NativeUnavailable: ``"native"`` was asked for and cannot be used; a RuntimeError.
    """
    if name not in BACKENDS:
        raise ValueError(f"backend={name!r}: expected one of {', '.join(BACKENDS)}")
    if name == "dense":
        return "dense"
    if name == "auto":
        return _faster_backend(None if group.has_quarter_turns else group.name, str(device))
    if not group.has_quarter_turns:
        raise ValueError(
            f"backend={name!r} serves groups that contain the quarter turns, not {group.name}"
        )
    if torch.device(device).type != "cpu":
        raise ValueError(f"backend={name!r} serves the CPU, not {device}")
    try:
        load()
    except NativeUnavailable as error:
        raise NativeUnavailable(f"backend={name!r} cannot be used: {error}") from None
    return "native"


@functools.cache
def _faster_backend(unserved_group: str | None, device: str) -> Literal["native", "dense"]:
    reason = None
    if torch.device(device).type != "cpu":
        reason = f"on {device}"
    elif unserved_group:
        reason = f"since {unserved_group} lacks the quarter turns that the native kernels need"
    elif platform.machine() not in NATIVE_IS_FASTER_ON:
        reason = f"since the native kernels were never measured on {platform.machine()}"
    if reason:
        _logger.info("backend: dense, %s", reason)
        return "dense"
    try:
        instruction_set = load().instruction_set
    except NativeUnavailable as error:
        _logger.warning("backend: dense, the slower one on this processor: %s", error)
        return "dense"
    _logger.info("backend: native, with %s kernels", instruction_set)
    return "native"
