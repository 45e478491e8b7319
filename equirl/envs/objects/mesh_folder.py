"""A user's folder of meshes as an object set."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from pathlib import Path

import numpy as np

from equirl.envs.objects.bodies import Body, Color, ConvexPolyhedron
from equirl.envs.objects.convex_pieces import (
    LONGEST_SIDE,
    SHORTEST_SIDE,
    MeshError,
    PieceCache,
    Pieces,
    box_sides,
    convex_pieces,
    require_libraries,
    sides_text,
)
from equirl.envs.objects.object_set import FRICTION, MASS, MESH_ROLLING, ObjectSet

__all__ = ["NATURAL_SIDE", "SUFFIXES", "MeshFolder"]

SUFFIXES = (".obj", ".stl")

NATURAL_SIDE = 0.09  # m; the longest side given to a mesh of unknown units

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
        path: The folder; folders in it are not looked into.
        mass: Of each body, kg.
        friction: Lateral friction coefficient.
        rolling_friction: Torsional friction against rolling, m.
        max_grasp_width: The widest middle side allowed, m; the gripper opens 0.08 m.
        scale: Metres per unit of the files. With None, each mesh is scaled by itself, as the units
            of mesh files are unknown: to a longest side of 9 cm, or less when the middle side would
            exceed ``max_grasp_width``.
        max_pieces: The most convex pieces per body; fewer are faster to simulate, and close hollows
            and holes sooner.
        cache: Folder of the divided meshes; with None ``$XDG_CACHE_HOME/equirl/meshes``, or
            ``~/.cache/equirl/meshes``. May be shared by processes and deleted at any time.
        skip_refused: Leave out, with a warning in the log, meshes that cannot be used.

    Raises:
        MeshError: If the folder has no meshes, or some cannot be used; it names them all.
        ImportError: If trimesh or coacd is not installed.
        ValueError: If an argument is out of its range.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        mass: float = MASS,
        friction: float = FRICTION,
        rolling_friction: float = MESH_ROLLING,
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
        require_libraries()
        folder = Path(path).expanduser()
        files = _mesh_files(folder)
        store = PieceCache(_default_cache() if cache is None else Path(cache).expanduser())

        def load(file: Path) -> Pieces | MeshError:
            try:
                pieces = convex_pieces(file, max_pieces, store)
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


def _default_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
    return root / "equirl" / "meshes"


def _mesh_files(folder: Path) -> list[Path]:
    """Returns the mesh files of ``folder`` by name; hidden files are none.

    Raises:
        MeshError: If there is no such folder, no mesh in it, or two of one name.
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
        MeshError: Otherwise, with the reason for each.
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
        MeshError: If the gripper could not grasp them.
    """
    given = box_sides(np.concatenate(pieces))
    factor = min(NATURAL_SIDE / given[2], max_grasp_width / given[1]) if scale is None else scale
    shortest, middle, longest = factor * given
    slack = 1 + 1e-6  # coacd and the scaling round
    faults = []
    if longest > LONGEST_SIDE * slack:
        faults.append(f"its longest side must be at most {100 * LONGEST_SIDE:g} cm")
    if middle > max_grasp_width * slack:
        widest = f"max_grasp_width = {100 * max_grasp_width:g} cm"
        faults.append(f"its middle side must be at most {widest}")
    if shortest * slack < SHORTEST_SIDE:
        faults.append(f"its shortest side must be at least {100 * SHORTEST_SIDE:g} cm")
    if faults:
        how = "scaled to fit, it" if scale is None else f"with scale={scale:g} it"
        raise MeshError(
            f"{how} is {sides_text(100 * factor * given)} cm "
            f"({sides_text(given)} in the file's units); {', '.join(faults)}"
        )
    return [piece * factor for piece in pieces]
