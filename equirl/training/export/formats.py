"""The two file formats of a policy: how each is written, loaded, and asked for its certificate.

A ``.pt2`` file is a program of ``torch.export`` and needs torch alone, an ``.onnx`` file any ONNX
runtime. The number of images is left open in both.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.export import ExportedProgram

from equirl.training.export.frozen import FrozenPolicy

__all__ = [
    "CERTIFICATE",
    "FORMATS",
    "INPUTS",
    "OUTPUTS",
    "ExportError",
    "Format",
    "Outputs",
    "Policy",
    "format_of",
    "load_exported",
    "missing_packages",
    "read_certificate",
    "trace",
]

INPUTS, OUTPUTS = ("depth", "holding"), ("action", "loc", "scale")

#: Under which name a file holds its certificate.
CERTIFICATE = "certificate.json"

#: By the names in `OUTPUTS`, arrays of shape (B, 5).
Outputs = dict[str, np.ndarray]
#: Takes depth (B, 1, S, S), m, and holding (B, 1), float32.
Policy = Callable[[np.ndarray, np.ndarray], Outputs]


class ExportError(RuntimeError):
    """A policy that cannot be exported, or a file that is not one; the message says why."""


class Format(NamedTuple):
    """How files of a format are treated.

    Attributes:
        suffix: Of their names.
        packages: What writing them needs beside torch.
        convert: Brings a program into the form that is saved.
        save: Takes what was converted, a path and the certificate's text.
        load: Takes a path and a number of threads, 0 for the library's choice.
        certificate: Takes a path; returns the certificate's text.
    """

    suffix: str
    packages: tuple[str, ...]
    convert: Callable[[ExportedProgram], Any]
    save: Callable[[Any, Path, str], None]
    load: Callable[[Path, int], Policy]
    certificate: Callable[[Path], str]


def trace(policy: FrozenPolicy, image_size: int) -> ExportedProgram:
    """The policy as a program for any number of images of shape (1, S, S)."""
    example = torch.rand(3, 1, image_size, image_size), torch.zeros(3, 1)
    batch = torch.export.Dim("batch", min=1)
    shapes = tuple({0: batch} for _ in INPUTS)
    program = torch.export.export(policy, example, dynamic_shapes=(shapes,))
    for node in program.graph.nodes:  # they name folders of this machine
        node.meta.pop("stack_trace", None)
    return program


def format_of(path: str | Path) -> Format:
    """The format that a file's name asks for.

    Raises:
        ExportError: It ends like none of them.
    """
    for known in FORMATS.values():
        if Path(path).suffix == known.suffix:
            return known
    suffixes = " or ".join(known.suffix for known in FORMATS.values())
    raise ExportError(f"{path}: expected the name of a file that ends in {suffixes}")


def load_exported(path: str | Path, threads: int = 0) -> Policy:
    """A policy from its file, on arrays.

    Args:
        path: An ``.onnx`` or a ``.pt2`` file.
        threads: Of the ONNX runtime, 0 for all cores; a ``.pt2`` file runs on torch's.

    Raises:
        ExportError: The file is missing, damaged or of another kind, or a package is missing.
    """
    with _told(path) as format:
        return format.load(Path(path), threads)


def read_certificate(path: str | Path) -> dict[str, Any]:
    """What was measured on an exported policy, and what it takes and gives; `summary` prints it.

    Args:
        path: An ``.onnx`` or a ``.pt2`` file.

    Raises:
        ExportError: The file is missing or damaged, holds no certificate, or a package is missing.
    """
    with _told(path) as format:
        certificate = json.loads(format.certificate(Path(path)))
        if not isinstance(certificate, dict) or certificate.get("format") != 1:
            raise ValueError("its certificate is not of format 1")
        for where in _lacking(certificate, _NEEDED):
            raise ValueError(f"its certificate lacks {where}")
        return certificate


#: What `check_exported` and `summary` take from a certificate, measurements apart, and its kind.
_NEEDED: dict[str, Any] = {
    **dict.fromkeys(("equirl", "torch", "task", "method"), str),
    **dict.fromkeys(("group", "mode"), str | None),
    **dict.fromkeys(("seed", "steps"), int),
    "image": {"pixels": int, "side_m": int | float, "max_depth_m": int | float},
    "tolerance": dict.fromkeys(OUTPUTS, int | float),
    "symmetry": {"physical": {"exact_on_grid": dict.fromkeys(OUTPUTS, bool)}},
}


def _lacking(values: dict[str, Any], needed: dict[str, Any]) -> Iterator[str]:
    """The paths of what is missing or of another kind."""
    for key, kind in needed.items():
        value = values.get(key, ...)
        if not isinstance(value, dict if isinstance(kind, dict) else kind):
            yield key
        elif isinstance(kind, dict):
            yield from (f"{key}.{inner}" for inner in _lacking(value, kind))


@contextlib.contextmanager
def _told(path: str | Path) -> Iterator[Format]:
    """Trouble with a file becomes an ExportError; libraries raise many kinds for a damaged one."""
    format = format_of(path)
    if not Path(path).is_file():
        raise ExportError(f"{path} not found: expected an exported policy")
    try:
        yield format
    except ExportError:
        raise
    except ImportError as error:
        raise ExportError(f"{path}: {error}; it comes with pip install 'equirl[export]'") from None
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ExportError(f"{path} is not a readable exported policy: {reason}") from error


def _save_torch(program: ExportedProgram, path: Path, certificate: str) -> None:
    torch.export.save(program, str(path), extra_files={CERTIFICATE: certificate})


def _load_torch(path: Path, threads: int) -> Policy:
    module = torch.export.load(str(path)).module()

    def policy(depth: np.ndarray, holding: np.ndarray) -> Outputs:
        with torch.no_grad():
            out = module(torch.from_numpy(depth), torch.from_numpy(holding))
        return {name: value.numpy() for name, value in zip(OUTPUTS, out, strict=True)}

    return policy


def _torch_certificate(path: Path) -> str:
    texts = {CERTIFICATE: ""}
    torch.export.load(str(path), extra_files=texts)
    return texts[CERTIFICATE]


def _to_onnx(program: ExportedProgram) -> Any:
    with _quiet():
        # Unoptimised: an epsilon below 1e-8 would be taken for zero and dropped. Runtimes optimise.
        onnx = torch.onnx.export(
            program, input_names=INPUTS, output_names=OUTPUTS, verbose=False, optimize=False
        )
    shape = onnx.model.graph.inputs[0].shape if onnx is not None else None
    assert onnx is not None and shape is not None
    onnx.rename_axes({str(shape[0]): "batch"})
    for node in onnx.model.graph:
        node.metadata_props.clear()
    return onnx


def _save_onnx(onnx: Any, path: Path, certificate: str) -> None:
    onnx.model.metadata_props[CERTIFICATE] = certificate
    onnx.save(str(path))


def _session(path: Path, threads: int = 0) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def _load_onnx(path: Path, threads: int) -> Policy:
    session = _session(path, threads)

    def policy(depth: np.ndarray, holding: np.ndarray) -> Outputs:
        out = session.run(list(OUTPUTS), {"depth": depth, "holding": holding})
        return dict(zip(OUTPUTS, out, strict=True))

    return policy


def _onnx_certificate(path: Path) -> str:
    return _session(path).get_modelmeta().custom_metadata_map[CERTIFICATE]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Drops the exporter's lines about torchvision, which nothing here uses."""
    log = logging.getLogger("torch.onnx._internal.exporter._registration")

    def keep(record: logging.LogRecord) -> bool:
        return not str(record.msg).startswith("torchvision is not installed")

    log.addFilter(keep)
    try:
        yield
    finally:
        log.removeFilter(keep)


#: The formats by name, as ``experiments/export.py`` takes them.
FORMATS = {
    "torch_export": Format(
        ".pt2", (), lambda program: program, _save_torch, _load_torch, _torch_certificate
    ),
    "onnx": Format(
        ".onnx",
        ("onnx", "onnxscript", "onnxruntime"),
        _to_onnx,
        _save_onnx,
        _load_onnx,
        _onnx_certificate,
    ),
}


def missing_packages(format: Format) -> list[str]:
    """What writing files of a format needs and this machine lacks."""
    return [name for name in format.packages if importlib.util.find_spec(name) is None]
