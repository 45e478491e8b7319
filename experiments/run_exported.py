"""Runs an exported policy with onnxruntime and numpy alone, as a robot's computer would.

    python experiments/run_exported.py policy.onnx

Neither torch nor equirl is needed, so this file can be copied to where they are not. It draws what
the camera sees of a block beside the gripper, asks the policy what to do, turns the picture, and
asks again: the action of an equivariant policy turns with it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

try:
    import numpy as np
    import onnxruntime
except ImportError as error:
    sys.exit(f"error: {error}; this example needs: pip install numpy onnxruntime")

Policy = Callable[[np.ndarray, bool], np.ndarray]


def main(given: list[str] | None = None) -> None:
    """Prints the actions for a scene, for the scene turned, and how far they are apart."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("file", type=Path)
    policy, certificate = load(parser.parse_args(given).file)
    built_in = certificate["group"] and f"group {certificate['group']}, mode {certificate['mode']}"
    print(
        f"{certificate['method']} policy of {certificate['task']}, "
        f"{built_in or 'no symmetry built in'}"
    )
    measured = certificate["symmetry"]["physical"]
    print(certified(measured))
    meanings = certificate["outputs"]["action"]["components"]
    depth = block(certificate["image"])
    action = policy(depth, False)
    print(f"{'scene as it is':<24}", shown(action, meanings))
    for element in measured["errors"]:
        if element["on_grid"]:
            turns, reflected = round(element["degrees"] / 90), element["reflected"]
            picture = np.rot90(depth[:, ::-1] if reflected else depth, turns)
            after = policy(picture, False)
            error = np.abs(after - turned(action, turns, reflected)).max()
            name = f"turned: {element['element']}"
            print(f"{name:<24}", shown(after, meanings), f" off by {error:.1e}")


def certified(measured: dict[str, Any]) -> str:
    """Returns what the certificate says of the action, in a sentence."""
    exact, between = measured["exact_on_grid"]["action"], measured["between"]
    text = f"{'exact' if exact else 'not exact'} at the turns that map pixels onto pixels"
    if between:
        error = between["action"]
        text += (
            f"; between them the action errs by {error['mean']:.1e} in the mean, "
            f"{error['largest']:.1e} at most (turning the picture there and back: "
            f"{error['there_and_back']:.1e})"
        )
    return text


def load(path: Path) -> tuple[Policy, dict[str, Any]]:
    """Returns the policy of a file, and its certificate; ends the program if it is not one."""
    if not path.is_file():
        sys.exit(f"error: {path} not found: expected a policy in .onnx")
    try:
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    except Exception as error:  # it has one kind for each way in which a file can be damaged
        sys.exit(f"error: {path} is not a readable policy: {str(error).splitlines()[0]}")
    text = session.get_modelmeta().custom_metadata_map.get("certificate.json")
    if text is None:
        sys.exit(f"error: {path} holds no certificate: expected a policy from export.py")

    def policy(depth: np.ndarray, holding: bool) -> np.ndarray:
        """Maps a depth image (S, S), m, to an action (5,)."""
        inputs = {
            "depth": np.ascontiguousarray(depth[None, None], np.float32),
            "holding": np.array([[holding]], np.float32),
        }
        return session.run(["action"], inputs)[0][0]

    return policy, json.loads(text)


def block(image: dict[str, Any]) -> np.ndarray:
    """Returns the depth image (S, S), m, of a block of 5 cm below and beside the gripper.

    The floor is 20 cm below the end effector; the block's centre is 7 cm along x and 3 cm along y.
    """
    size, side = image["pixels"], image["side_m"]
    centres = (np.arange(size) + 0.5 - size / 2) * side / size
    x, y = centres[:, None], centres[None, :]  # rows grow with x, columns with y
    on_top = (abs(x - 0.07) < 0.025) & (abs(y - 0.03) < 0.025)
    return np.where(on_top, 0.15, 0.20)


def turned(action: np.ndarray, turns: int, reflected: bool) -> np.ndarray:
    """Returns an action (5,) after y was reversed, or not, and then quarter turns of the scene."""
    gripper, x, y, z, theta = action
    if reflected:
        y, theta = -y, -theta
    for _ in range(turns):
        x, y = -y, x
    return np.array([gripper, x, y, z, theta])


def shown(action: np.ndarray, meanings: dict[str, Any]) -> str:
    """Returns an action (5,) in words, in the units of the certificate."""
    gripper, x, y, z, theta = (
        m["low"] + (number + 1) / 2 * (m["high"] - m["low"])
        for number, m in zip(action, meanings.values(), strict=True)
    )
    return (
        f"move ({1000 * x:+6.1f}, {1000 * y:+6.1f}, {1000 * z:+6.1f}) mm, "
        f"turn {math.degrees(theta):+6.1f} degrees, fingers {1000 * gripper:4.1f} mm apart"
    )


if __name__ == "__main__":
    main()
