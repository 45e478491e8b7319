"""A user's folder of meshes as an object set."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from equirl.envs.objects.bodies import Body, Color, ConvexPolyhedron
from equirl.envs.objects.object_set import ObjectSet

if TYPE_CHECKING:
    from trimesh import Trimesh

SUFFIXES = (".obj", ".stl")

NATURAL_SIDE = 0.09  # m; the longest side given to a mesh of unknown units
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

_COLORS: tuple[Color, ...] = (
    (0.90, 0.45, 0.36, 1.0),  # coral
    (0.36, 0.61, 0.84, 1.0),  # sky
    (0.95, 0.77, 0.36, 1.0),  # honey
    (0.48, 0.74, 0.52, 1.0),  # leaf
    (0.67, 0.53, 0.80, 1.0),  # lilac
    (0.40, 0.75, 0.74, 1.0),  # teal
    (0.92, 0.62, 0.72, 1.0),  # rose
    (0.72, 0.60, 0.48, 1.0),  # clay
)

_logger = logging.getLogger("equirl")

Pieces = list[np.ndarray]  # the corners of each convex piece, shape (V, 3)


class MeshError(ValueError):
    """Meshes that cannot become bodies, each with the reason."""


class MeshFolder(ObjectSet):
    """The OBJ and STL files of a folder as bodies, named after the files without suffix.

    Every mesh is divided into convex pieces by coacd, once: the pieces are kept in a cache. The
    mesh's axes are kept, z up, and the centre of mass becomes the origin. Nothing makes the bodies
    mirror-symmetric; where a task needs that, choose by `Body.has_mirror_symmetry`.

    Parts of a mesh that are closed surfaces are divided each for itself, so parts may overlap; the
    mass there counts twice. Open surfaces are closed by coacd first, which is logged: it gives them
    walls of about 4 % of the mesh's size.

    A body can be grasped when, of its sides, the longest is at most 20 cm, the middle one at most
    ``max_grasp_width`` and the shortest at least 0.8 cm. These are the sides of the smallest box
    about the body in any orientation: objects lie as they fall, and how a mesh stands in its file
    should not matter.

    Args:
        path: the folder; folders in it are not looked into.
        mass: of each body, kg.
        friction: lateral friction coefficient.
        rolling_friction: torsional friction against rolling, m.
        max_grasp_width: the widest middle side allowed, m; the gripper opens 0.08 m.
        scale: metres per unit of the files. With None, each mesh is scaled by itself, as the units
            of mesh files are unknown: to a longest side of 9 cm, or less when the middle side would
            exceed ``max_grasp_width``.
        max_pieces: the most convex pieces per body; fewer are faster to simulate, and close hollows
            and holes sooner.
        cache: folder of the divided meshes; with None ``$XDG_CACHE_HOME/equirl/meshes``, or
            ``~/.cache/equirl/meshes``. May be shared by processes and deleted at any time.
        skip_refused: leave out, with a warning in the log, meshes that cannot be used.

    Raises:
        MeshError: if the folder has no meshes, or some cannot be used; it names them all.
        ImportError: if trimesh or coacd is not installed.
        ValueError: if an argument is out of its range.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        mass: float = 0.15,
        friction: float = 0.6,
        rolling_friction: float = 0.001,
        max_grasp_width: float = 0.07,
        scale: float | None = None,
        max_pieces: int = 16,
        cache: str | os.PathLike[str] | None = None,
        skip_refused: bool = False,
    ):
        _check("mass", mass, mass > 0, "above 0 kg")
        _check("friction", friction, friction >= 0, "0 or more")
        _check("rolling_friction", rolling_friction, rolling_friction >= 0, "0 m or more")
        wide = max_grasp_width >= SHORTEST_SIDE
        _check("max_grasp_width", max_grasp_width, wide, f"at least {SHORTEST_SIDE} m")
        _check("scale", 1.0 if scale is None else scale, scale is None or scale > 0, "above 0")
        whole = isinstance(max_pieces, int) and max_pieces >= 1
        _check("max_pieces", max_pieces, whole, "whole, 1 or more")
        _require_libraries()
        folder = Path(path).expanduser()
        files = _mesh_files(folder)
        store = _Cache(_default_cache() if cache is None else Path(cache).expanduser())

        def load(file: Path) -> Pieces | MeshError:
            try:
                pieces = _pieces(file, max_pieces, store)
                return _scaled(pieces, scale, max_grasp_width)
            except MeshError as error:
                return error

        # The work is done by processes of their own; more than a few would contend for memory.
        with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
            loaded = dict(zip(files, pool.map(load, files), strict=True))
        _report(folder, loaded, skip_refused)
        bodies = [
            Body.centred(
                map(ConvexPolyhedron.hull, pieces),
                mass=mass,
                friction=friction,
                name=file.stem,
                rolling_friction=rolling_friction,
                color=color,
            )
            for (file, pieces), color in zip(loaded.items(), cycle(_COLORS), strict=False)
            if not isinstance(pieces, MeshError)
        ]
        super().__init__(bodies, f"the meshes in {folder}")


def _check(name: str, value: float, valid: bool, expected: str) -> None:
    if not (valid and np.isfinite(value)):
        raise ValueError(f"{name} must be a finite number, {expected}, got {value!r}")


def _require_libraries() -> None:
    try:
        import coacd  # noqa: F401
        import trimesh  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "MeshFolder needs trimesh and coacd: pip install 'equirl[meshes]'"
        ) from error


def _default_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
    return root / "equirl" / "meshes"


def _mesh_files(folder: Path) -> list[Path]:
    """Returns the mesh files of ``folder`` by name; hidden files are none.

    Raises:
        MeshError: if there is no such folder, no mesh in it, or two of one name.
    """
    expected = f"expected a folder of {' and '.join(SUFFIXES)} files"
    if not folder.exists():
        raise MeshError(f"{folder} does not exist; {expected}")
    if not folder.is_dir():
        raise MeshError(f"{folder} is not a folder; {expected}")
    files = sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in SUFFIXES and not file.name.startswith(".") and file.is_file()
    )
    if not files:
        raise MeshError(f"{folder} has no meshes; {expected} (folders in it are not looked into)")
    stems = [file.stem for file in files]
    twice = [file.name for file in files if stems.count(file.stem) > 1]
    if twice:
        raise MeshError(f"{folder}: objects are named by file, but not apart: {', '.join(twice)}")
    return files


def _report(folder: Path, loaded: Mapping[Path, Pieces | MeshError], skip: bool) -> None:
    """Logs the refused files if they are to be skipped and others remain.

    Raises:
        MeshError: otherwise, with the reason for each.
    """
    refused = {file: error for file, error in loaded.items() if isinstance(error, MeshError)}
    if len(refused) == len(loaded) or (refused and not skip):
        reasons = "".join(f"\n  {file.name}: {error}" for file, error in refused.items())
        hint = "" if skip else " (skip_refused=True leaves them out)"
        raise MeshError(
            f"{folder}: {len(refused)} of {len(loaded)} meshes cannot be used{hint}:{reasons}"
        )
    for file, error in refused.items():
        _logger.warning("left out %s: %s", file, error)


def _scaled(pieces: Pieces, scale: float | None, max_grasp_width: float) -> Pieces:
    """Returns ``pieces`` (in the file's units) in metres.

    Raises:
        MeshError: if the gripper could not grasp them.
    """
    sides = _sides(np.concatenate(pieces))
    factor = min(NATURAL_SIDE / sides[2], max_grasp_width / sides[1]) if scale is None else scale
    shortest, middle, longest = factor * sides
    slack = 1 + 1e-6  # coacd and the scaling round
    faults = [
        (
            longest > LONGEST_SIDE * slack,
            f"its longest side must be at most {100 * LONGEST_SIDE:g}",
        ),
        (
            middle > max_grasp_width * slack,
            f"its middle side must be at most max_grasp_width = {100 * max_grasp_width:g}",
        ),
        (
            shortest * slack < SHORTEST_SIDE,
            f"its shortest side must be at least {100 * SHORTEST_SIDE:g}",
        ),
    ]
    found = [fault for wrong, fault in faults if wrong]
    if found:
        how = "scaled to fit, it" if scale is None else f"with scale={scale:g} it"
        raise MeshError(
            f"{how} is {_text(100 * factor * sides)} cm ({_text(sides)} in the file's units); "
            f"{' cm, '.join(found)} cm"
        )
    return [piece * factor for piece in pieces]


def _sides(points: np.ndarray) -> np.ndarray:
    """Returns the sides of the smallest box about ``points`` (P, 3), shape (3,), ascending."""
    from trimesh.bounds import oriented_bounds

    # Coarser steps between the directions tried miss the best box of round bodies.
    return np.sort(oriented_bounds(points, angle_digits=3)[1])


def _text(sides: np.ndarray) -> str:
    return " x ".join(f"{side:.3g}" for side in sides)


def _pieces(file: Path, max_pieces: int, cache: _Cache) -> Pieces:
    """Returns the convex pieces of the mesh in ``file``, in its units.

    Raises:
        MeshError: if the file is no mesh of a solid.
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


def _read_mesh(data: bytes, suffix: str) -> tuple[Trimesh, float]:
    """Returns the mesh in ``data``, of longest side 1 about the origin, and its longest side.

    Raises:
        MeshError: if it is no mesh, or so flat that no size of it could be grasped.
    """
    import trimesh

    if not data:
        raise MeshError("the file is empty")
    try:
        read = trimesh.load_mesh(
            io.BytesIO(data), file_type=suffix[1:], process=False, skip_materials=True
        )
        vertices, triangles = np.array(read.vertices, float), np.array(read.faces, int)
    except Exception as error:  # whatever the parser stumbles over
        raise MeshError(f"cannot be read as {suffix[1:].upper()}: {error!r}") from error
    if not len(triangles):
        kind = suffix[1:].upper()
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
            f"too flat at any scale: it is {_text(sides)} along its main axes, in the file's "
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
        MeshError: if coacd fails.
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


class _Cache:
    """Pieces by key, in a folder that other processes may use at the same time."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._writable = True

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
            if self._writable:
                _logger.warning("divided meshes are not kept for the next time: %s", error)
            self._writable = False
