"""How the audit turns and reflects images, actions and scenes: raw arrays, by its own arithmetic.

No code is shared with what the audit checks, nor with the representations that networks and replay
buffers are built from. Scenes and actions are moved by any element, images by those that map a
square pixel grid onto itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from equirl.symmetry.groups import Element

__all__ = ["displace_objects", "transform_action", "transform_image", "transform_scene"]


def transform_image(image: np.ndarray, element: Element) -> np.ndarray:
    """Moves the pixels of (..., S, S), whose rows grow with x and columns with y.

    Raises:
        ValueError: If the element turns by other than quarter turns.
    """
    if element.quarter_turns is None:
        raise ValueError(
            "pixels are moved by quarter turns, and reflections, alone, got a turn by "
            f"{math.degrees(element.angle):g}°"
        )
    if element.reflected:
        image = np.flip(image, axis=-1)
    return np.rot90(image, element.quarter_turns, axes=(-2, -1))


def transform_action(action: np.ndarray, element: Element, keep_theta: bool = False) -> np.ndarray:
    """Moves (x, y) of an action (5,) and reverses theta under reflection unless ``keep_theta``."""
    moved = action.copy()
    moved[1:3] = _plane(element) @ action[1:3]
    if element.reflected and not keep_theta:
        moved[4] = -action[4]
    return moved


def transform_scene(values: Mapping[str, Any], element: Element) -> dict[str, Any]:
    """Moves everything in a scene's dictionary about the vertical through the origin.

    The mirror image of an object is a pose of the same object only if its shape has the mirror
    plane y = 0.
    """
    plane, sign, angle = _plane(element), -1.0 if element.reflected else 1.0, element.angle
    position = np.array(values["position"], dtype=np.float64)
    position[:2] = plane @ position[:2]
    objects = _rows(values["objects"], 7)
    objects[:, :2] = objects[:, :2] @ plane.T
    x, y, z, w = objects[:, 3:].T * np.array([[sign], [1.0], [sign], [1.0]])
    sin, cos = math.sin(angle / 2), math.cos(angle / 2)
    turned = (cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z)
    objects[:, 3:] = np.stack(turned, axis=1)
    areas = _rows(values.get("areas", ()), 3)
    areas[:, :2] = areas[:, :2] @ plane.T
    areas[:, 2] = sign * areas[:, 2] + angle
    moved = {"position": position, "objects": objects, "areas": areas}
    lists = {key: array.tolist() for key, array in moved.items()}
    return {**values, **lists, "yaw": sign * values["yaw"] + angle}


def displace_objects(
    values: Mapping[str, Any], distance: float, rng: np.random.Generator
) -> dict[str, Any]:
    """Moves each object of a scene's dictionary by ``distance`` (m) in a horizontal direction."""
    objects = _rows(values["objects"], 7)
    angles = rng.uniform(0, math.tau, len(objects))
    objects[:, :2] += distance * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return {**values, "objects": objects.tolist()}


def _rows(values: Any, width: int) -> np.ndarray:
    """Returns ``values`` as an array (n, width) of its own, also where n is 0."""
    return np.array(values, dtype=np.float64).reshape(-1, width)


def _plane(element: Element) -> np.ndarray:
    """The element's matrix on (x, y); with quarter turns, its entries are 0, 1 and -1."""
    cos, sin = element.cos_sin
    turn = np.array([[cos, -sin], [sin, cos]])
    return turn @ np.diag([1, -1]) if element.reflected else turn
