"""Convex pieces of mesh files: read, divided by coacd, and kept in a cache."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import uuid
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from equirl.envs.objects.bodies import ConvexPolyhedron

if TYPE_CHECKING:
    from trimesh import Trimesh

__all__ = [
    "LONGEST_SIDE",
    "SHORTEST_SIDE",
    "MeshError",
    "PieceCache",
    "Pieces",
    "box_sides",
    "convex_pieces",
    "require_libraries",
    "sides_text",
]

LONGEST_SIDE = 0.20  # m
SHORTEST_SIDE = 0.008  # m; what is thinner slips between the fingertips and the table

# What is cached depends on these; change the format with the code that makes the pieces.
_FORMAT = 1
_DECOMPOSITION = {
    "threshold": 0.05,
    "preprocess_resolution": 50,
    # Half of the default search: as good on household objects, and twice as fast.
    "mcts_nodes": 10,
    "mcts_iterations": 60,
    "decimate": True,
    "max_ch_vertex": 32,
    "seed": 0,
}
_PATIENCE = 600.0  # s for one mesh; on badly tangled surfaces coacd does not come to an end

# coacd aborts its process on some meshes, so it gets one of its own.
_PROGRAM = """
import json, sys
import coacd, numpy
coacd.set_log_level("off")
parts, pieces = numpy.load(sys.argv[1]), []
for k, options in enumerate(json.loads(sys.argv[3])):
    mesh = coacd.Mesh(parts[f"vertices_{k}"], parts[f"triangles_{k}"])
    pieces += [points for points, _ in coacd.run_coacd(mesh, **options)]
numpy.savez(sys.argv[2], *pieces)
"""

_logger = logging.getLogger("equirl")

Pieces = list[np.ndarray]  # the corners of each convex piece, shape (V, 3)


class MeshError(ValueError):
    """Meshes that cannot become bodies, each with the reason."""


def require_libraries() -> None:
    """Raises ImportError if a library that is needed here is not installed."""
    try:
        import coacd  # noqa: F401
        import trimesh  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "MeshFolder needs trimesh and coacd: pip install 'equirl[meshes]'"
        ) from error


def convex_pieces(file: Path, max_pieces: int, cache: PieceCache) -> Pieces:
    """Returns the convex pieces of the mesh in ``file``, in its units.

    Raises:
        MeshError: If the file is no mesh of a solid.
    """
    try:
        data = file.read_bytes()
    except OSError as error:
        raise MeshError(f"cannot be read: {error}") from error
    suffix = file.suffix.lower()
    made_by = {
        "format": _FORMAT,
        "suffix": suffix,
        "options": _DECOMPOSITION | {"max_pieces": max_pieces},
        "libraries": [version("trimesh"), version("coacd")],
    }
    key = hashlib.sha256(json.dumps(made_by, sort_keys=True).encode() + data).hexdigest()

    def divide() -> Pieces:
        _logger.info("dividing %s into convex pieces", file)
        mesh, size = _read_mesh(data, suffix)
        if not mesh.is_watertight:
            _logger.warning("%s is not a closed surface; it is given walls", file)
        return [piece * size for piece in _decompose(_solids(mesh, max_pieces))]

    return cache.get(key, divide)


def box_sides(points: np.ndarray) -> np.ndarray:
    """Returns the sides of the smallest box about ``points`` (P, 3), shape (3,), ascending."""
    from trimesh.bounds import oriented_bounds

    # Coarser steps between the directions tried miss the best box of round bodies.
    return np.sort(oriented_bounds(points, angle_digits=3)[1])


def sides_text(sides: np.ndarray) -> str:
    """Returns ``sides`` as errors show them."""
    return " x ".join(f"{side:.3g}" for side in sides)


# Reading --------------------------------------------------------------------------------------


def _read_mesh(data: bytes, suffix: str) -> tuple[Trimesh, float]:
    """Returns the mesh in ``data``, of longest side 1 about the origin, and its longest side.

    Raises:
        MeshError: If it is no mesh, or so flat that no size of it could be grasped.
    """
    import trimesh

    if not data:
        raise MeshError("the file is empty")
    kind = suffix[1:].upper()
    try:
        read = trimesh.load_mesh(
            io.BytesIO(data), file_type=suffix[1:], process=False, skip_materials=True
        )
        vertices, triangles = np.array(read.vertices, float), np.array(read.faces, int)
    except Exception as error:  # whatever the parser stumbles over
        raise MeshError(f"cannot be read as {kind}: {error!r}") from error
    if not len(triangles):
        raise MeshError(f"no triangles in its {len(data)} bytes; is it a complete {kind} file?")
    vertices = vertices[np.unique(triangles)]
    wrong = ~np.isfinite(vertices).all(axis=1)
    if wrong.any():
        raise MeshError(
            f"{wrong.sum()} of {len(vertices)} vertices are not finite, "
            f"for example {vertices[wrong][0].tolist()}"
        )
    _require_thickness(vertices)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = float((high - low).max())
    vertices = (np.array(read.vertices, float) - (low + high) / 2) / size
    return _merged(trimesh.Trimesh(vertices, triangles, process=False)), size


def _require_thickness(vertices: np.ndarray) -> None:
    """Refuses vertices (V, 3) that could not pass the limits at any scale."""
    axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
    sides = np.sort(np.ptp(vertices @ axes.T, axis=0))
    least = SHORTEST_SIDE / LONGEST_SIDE
    if sides[0] <= least * sides[2]:
        raise MeshError(
            f"too flat at any scale: it is {sides_text(sides)} along its main axes, in the file's "
            f"units; expected its shortest side to be at least {least:.0%} of the longest"
        )


def _merged(mesh: Trimesh) -> Trimesh:
    """Returns ``mesh`` with one vertex per place and without triangles that have no area."""
    mesh.merge_vertices()
    a, b, c = mesh.faces.T
    mesh.update_faces((a != b) & (b != c) & (c != a))
    mesh.update_faces(mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


# Dividing -------------------------------------------------------------------------------------


def _solids(mesh: Trimesh, max_pieces: int) -> list[tuple[Trimesh, int]]:
    """Returns the parts to be divided one by one, each with the most pieces it may have.

    Parts that overlap must be divided apart: coacd would replace them by a voxel surface, which is
    slow and coarse. Parts that are not solids by themselves (open surfaces, the inner surfaces of
    hollows) stay together.
    """
    parts = mesh.split(only_watertight=False, repair=False)
    solid = all(p.is_watertight and p.is_winding_consistent and p.volume > 0 for p in parts)
    convex = [part.is_convex for part in parts]
    left, hollow = max_pieces - sum(convex), len(parts) - sum(convex)
    if not solid or left < hollow:
        return [(mesh, max_pieces)]
    return [(part, 1 if c else left // hollow) for part, c in zip(parts, convex, strict=True)]


def _decompose(parts: Sequence[tuple[Trimesh, int]]) -> Pieces:
    """Returns the convex pieces of ``parts``, each given with the most pieces it may have.

    Raises:
        MeshError: If coacd fails.
    """
    pieces: Pieces = []
    left = []
    for mesh, most in parts:
        # One piece is the hull, which coacd would only round, unless it has too many corners.
        hull = _corners(mesh.vertices)
        if most == 1 and 0 < len(hull) <= _DECOMPOSITION["max_ch_vertex"]:
            pieces.append(hull)
        else:
            left.append((mesh, most))
    pieces += filter(len, map(_corners, _run_coacd(left) if left else []))
    if not pieces:
        raise MeshError("coacd found no solid pieces in it")
    return pieces


def _corners(points: np.ndarray) -> np.ndarray:
    """Returns the corners of the convex hull of ``points`` (P, 3), none if it has no volume."""
    try:
        return ConvexPolyhedron.hull(points).vertices
    except ValueError:
        return np.empty((0, 3))


def _run_coacd(parts: Sequence[tuple[Trimesh, int]]) -> Pieces:
    """Returns the pieces coacd divides ``parts`` into, each with the most pieces it may have."""
    arrays: dict[str, Any] = {}
    for k, (mesh, _) in enumerate(parts):
        arrays |= {f"vertices_{k}": mesh.vertices, f"triangles_{k}": mesh.faces}
    options = [_DECOMPOSITION | {"max_convex_hull": most} for _, most in parts]
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder, "parts.npz"), Path(folder, "pieces.npz")
        np.savez(source, **arrays)
        try:
            done = subprocess.run(
                [sys.executable, "-P", "-c", _PROGRAM, source, result, json.dumps(options)],
                # With more threads the result could depend on their timing.
                env=os.environ | {"OMP_NUM_THREADS": "1"},
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=_PATIENCE,
            )
        except subprocess.TimeoutExpired:
            raise MeshError(
                f"coacd did not divide its {sum(len(mesh.faces) for mesh, _ in parts)} triangles "
                f"within {_PATIENCE:g} s; simplify it, or repair surfaces that intersect"
            ) from None
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["nothing said"])[-1]
            raise MeshError(f"coacd failed (exit code {done.returncode}): {said[-160:]}")
        return _read_pieces(result)


def _read_pieces(file: Path) -> Pieces:
    """Returns the pieces in ``file``; raises one of many errors if it is not whole."""
    with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as stored:
        pieces = [
            np.asarray(stored[f"arr_{k}"], dtype=np.float64) for k in range(len(stored.files))
        ]
    if any(p.ndim != 2 or p.shape[1] != 3 or not np.isfinite(p).all() for p in pieces):
        raise ValueError(f"{file} does not hold finite points of shape (V, 3)")
    return pieces


# Keeping --------------------------------------------------------------------------------------


class PieceCache:
    """Pieces by key, in a folder that other threads and processes may use at the same time."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._first_failure = threading.Lock()  # taken by it, and never given back

    def get(self, key: str, make: Callable[[], Pieces]) -> Pieces:
        """Returns the pieces stored under ``key``, or else those of ``make``, which it stores."""
        file = self._folder / f"{key}.npz"
        try:
            pieces = _read_pieces(file)
            if pieces:
                return pieces
        except (FileNotFoundError, NotADirectoryError):
            pass
        except Exception as error:  # a damaged archive can raise nearly anything
            _logger.warning("%s is made anew, as it cannot be read: %r", file, error)
        pieces = make()
        self._write(file, pieces)
        return pieces

    def _write(self, file: Path, pieces: Pieces) -> None:
        """Stores ``pieces`` so that readers see all of the file or none."""
        temporary = self._folder / f".{uuid.uuid4().hex}"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                with open(temporary, "xb") as stream:
                    np.savez(stream, *pieces)
                os.replace(temporary, file)
            finally:
                temporary.unlink(missing_ok=True)
        except OSError as error:
            if self._first_failure.acquire(blocking=False):
                _logger.warning("divided meshes are not kept for the next time: %s", error)
