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
    print(
        f"{certificate['method']} policy of {certificate['task']}, "
        f"group {certificate['group']}, mode {certificate['mode']}; certified to turn exactly: "
        f"{'yes' if certificate['exact'] else 'no'}"
    )
    depth = block(certificate["image"])
    action = policy(depth, False)
    print("scene as it is       ", shown(action))
    for turns in (1, 2, 3):
        after = policy(np.rot90(depth, turns), False)
        error = np.abs(after - turned(action, turns)).max()
        print(f"turned by {90 * turns:3d} degrees", shown(after), f" off by {error:.1e}")


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


def turned(action: np.ndarray, turns: int) -> np.ndarray:
    """Returns an action (5,) after quarter turns of the scene: x and y turn, the rest stays."""
    gripper, x, y, z, theta = action
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns]
    return np.array([gripper, cos * x - sin * y, sin * x + cos * y, z, theta])


def shown(action: np.ndarray) -> str:
    """Returns an action (5,) in words."""
    x, y, z = 1000 * 0.05 * action[1:4]
    opening, turn = 1000 * 0.08 * (action[0] + 1) / 2, math.degrees(math.pi / 4 * action[4])
    return (
        f"move ({x:+6.1f}, {y:+6.1f}, {z:+6.1f}) mm, turn {turn:+6.1f} degrees, "
        f"fingers {opening:4.1f} mm apart"
    )


if __name__ == "__main__":
    main()
