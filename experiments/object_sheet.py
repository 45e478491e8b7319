"""Draws every object of a set, with its name.

    python experiments/object_sheet.py --output objects.png
    python experiments/object_sheet.py --meshes my_meshes --output my_objects.png

Without ``--meshes`` these are the household objects. All are drawn to one scale, standing as in
their files, on squares of 5 cm.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
from command_line import at_least

from equirl.envs.bullet import Camera
from equirl.envs.bullet.floor import Viewpoint
from equirl.envs.objects import MeshError, MeshFolder, ObjectSet
from equirl.envs.objects.household import household_objects
from equirl.envs.scene import Scene
from equirl.envs.tasks.base import lying
from equirl.envs.workspace import Bin, Workspace

DPI = 100
GAP, CAPTION, FOOT = 0.04, 0.15, 0.15  # inches


def main(arguments: list[str] | None = None) -> None:
    """Reads the objects and writes the sheet."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--meshes", type=Path, help="a folder of OBJ and STL files")
    parser.add_argument("--output", type=Path, required=True, help="the PNG file to write")
    parser.add_argument("--columns", type=at_least(1), default=12, help="objects in a row")
    parser.add_argument("--size", type=at_least(1), default=96, help="pixels a side of a picture")
    given = parser.parse_args(arguments)
    if given.output.suffix.lower() != ".png":
        parser.error(f"argument --output: expected a PNG file, got {given.output}")
    try:
        objects = MeshFolder(given.meshes) if given.meshes else household_objects()
        draw_objects(objects, given.output, given.columns, given.size)
    except (MeshError, ImportError) as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        sys.exit(f"error: cannot write --output {given.output}: {error}")
    print(f"{len(objects)} objects: {given.output}")


def draw_objects(objects: ObjectSet, path: Path, columns: int = 12, size: int = 96) -> None:
    """Writes a PNG file with a picture of each object above its name.

    Args:
        objects: What to draw.
        path: The file.
        columns: Objects in a row.
        size: Pixels a side of each picture.

    Raises:
        OSError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    columns = min(columns, len(objects))
    rows = math.ceil(len(objects) / columns)
    side = size / DPI
    pitch = np.array([side + GAP, side + CAPTION + GAP])
    width, height = pitch * (columns, rows) + (GAP, GAP + FOOT)
    figure = Figure(figsize=(width, height), dpi=DPI)
    for index, (name, picture) in enumerate(zip(objects, portraits(objects, size), strict=True)):
        row, column = divmod(index, columns)
        left, top = pitch * (column, row) + GAP
        place = (left / width, 1 - (top + side) / height, side / width, side / height)
        axes = figure.add_axes(place)
        axes.imshow(picture)
        axes.axis("off")
        axes.text(0.5, -0.02, name, size=7, ha="center", va="top", transform=axes.transAxes)
    note = "All to one scale; the squares of the floor are 5 cm wide."
    figure.text(GAP / width, 0.04 / height, note, size=7, color="#666666")
    figure.savefig(path, dpi=DPI, facecolor="white", pil_kwargs={"optimize": True})


def portraits(objects: ObjectSet, size: int) -> list[np.ndarray]:
    """Returns a picture of each object, shape (size, size, 3), uint8."""
    near = max(max(np.linalg.norm(body.vertices, axis=1)) for body in objects.values())
    view = Viewpoint(
        eye=(2.9 * near, -2.5 * near, 3.6 * near), target=(0, 0, 0.2 * near), angle=19.0
    )
    camera = Camera(objects, (), None, Workspace(bin=Bin(floor_half_width=6 * near)), view)
    pictures = []
    for name, body in objects.items():
        pose = lying(body, 0.0, 0.0, yaw=0.0)
        scene = Scene(np.zeros(3), 0.0, 0.0, pose[None], names=(name,))
        pictures.append(camera.picture(np.zeros(0), scene, size, size))
    camera.close()
    return pictures


if __name__ == "__main__":
    main()
