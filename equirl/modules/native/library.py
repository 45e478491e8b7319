"""Finds and loads the library of native kernels that suits the processor."""

from __future__ import annotations

import ctypes
import functools
import os
import sysconfig
from dataclasses import dataclass
from pathlib import Path

import torch  # before the library, which calls the OpenMP runtime that comes with torch

__all__ = ["Library", "NativeUnavailable", "best_instruction_set", "load"]

#: What the kernels are compiled for, best first, and the file each is in.
INSTRUCTION_SETS = {"AVX-512": "_avx512", "AVX2": "_avx2", "baseline": "_plain"}

#: Number of the functions' signatures and of rows.py's order of rows, the same as in
#: the C++ sources: to be raised in both when either changes.
INTERFACE = 5


class NativeUnavailable(RuntimeError):
    """The native kernels cannot be used; the message says why in one sentence."""


@dataclass(frozen=True, eq=False)
class Library:
    """The loaded kernels.

    Args:
        instruction_set: What they are compiled for: ``"AVX-512"``, ``"AVX2"`` or ``"baseline"``.
        handle: Their C functions, whose argument types are the caller's to declare.
    """

    instruction_set: str
    handle: ctypes.CDLL


def best_instruction_set() -> str:
    """The best of `INSTRUCTION_SETS` that this processor has.

    By torch's account, whose own kernels ask for the same; ``ATEN_CPU_CAPABILITY`` lowers it.
    """
    capability = torch.backends.cpu.get_cpu_capability()
    return {"AVX512": "AVX-512", "AVX2": "AVX2"}.get(capability, "baseline")


@functools.cache
def load() -> Library:
    """Loads the best library that this processor can run and the installation has built.

    Raises:
        NativeUnavailable: None was built, or the system refuses to load it.
    """
    names = list(INSTRUCTION_SETS)
    for name in names[names.index(best_instruction_set()) :]:
        path = library_path(name)
        if path.exists():
            return Library(name, _open(path))
    raise NativeUnavailable(
        "the native kernels were not built when equirl was installed, most likely for want of "
        "a C++ compiler; install g++ and run the installation again"
    )


def library_path(instruction_set: str) -> Path:
    """Where the installation puts the library for an instruction set."""
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    return Path(__file__).with_name(INSTRUCTION_SETS[instruction_set] + suffix)


def _open(path: Path) -> ctypes.CDLL:
    try:
        # All symbols now: a missing one is an error here, not a crash at its first call.
        handle = ctypes.CDLL(str(path), mode=os.RTLD_NOW | os.RTLD_LOCAL)
        if handle.equirl_interface() != INTERFACE:
            raise OSError(f"{path} was built from another version of equirl")
        return handle
    except (OSError, AttributeError) as error:
        raise NativeUnavailable(
            f"the native kernels cannot be loaded ({error}); "
            "run the installation again with g++ as the C++ compiler"
        ) from None
