"""Joint angles for a pose of the end effector, in closed form.

The end effector always points straight down, so joint 7 of the Panda turns it about the vertical
and does nothing else. Six joints remain for five constraints; holding joints 3 and 5 at zero uses
up the redundancy, keeps the arm in a vertical plane through its base and leaves a planar arm of
two links, solved by the law of cosines. Against an iterative solution this is exact, depends on
the target alone (not on the path that led there) and commutes with the reflection y -> -y.
"""

from __future__ import annotations

import numpy as np

__all__ = ["hand_joints", "panda_joints", "panda_yaw"]

# Panda's dimensions (m), from its description.
_SHOULDER_HEIGHT = 0.333
_UPPER_ARM = (0.316, 0.0825)  # along the link, sideways at the elbow
_FOREARM = (0.384, 0.0825)
_WRIST_OFFSET = 0.088
_WRIST_TO_TOOL = 0.107 + 0.105  # flange, then grasp target
_YAW_OFFSET = -np.pi / 4


def panda_joints(positions: np.ndarray, yaws: np.ndarray, base_x: float) -> np.ndarray:
    """Returns the seven joint angles that put the end effector at given poses.

    Args:
        positions: End effector positions, shape (n, 3), m.
        yaws: Angles of the finger axis, shape (n,), rad, unbounded.
        base_x: X of the arm's base, m (its y and z are 0).

    Returns:
        Joint angles, shape (n, 7), rad.

    Raises:
        ValueError: If a position is out of the arm's reach.
    """
    upper, forearm = np.hypot(*_UPPER_ARM), np.hypot(*_FOREARM)
    x, y, z = positions[:, 0] - base_x, positions[:, 1], positions[:, 2]
    forward = np.hypot(x, y) - _WRIST_OFFSET
    up = z + _WRIST_TO_TOOL - _SHOULDER_HEIGHT
    reach = np.hypot(forward, up)
    cos_shoulder = (upper**2 + reach**2 - forearm**2) / (2 * upper * reach)
    cos_wrist = (forearm**2 + reach**2 - upper**2) / (2 * forearm * reach)
    outside = (np.abs(cos_shoulder) > 1) | (np.abs(cos_wrist) > 1)
    if outside.any():
        raise ValueError(f"the arm cannot reach {positions[outside][0]} (m, workspace frame)")
    # Tilts from the vertical; the elbow points up and back.
    tilt = np.arctan2(forward, up)
    upper_tilt = tilt - np.arccos(cos_shoulder) - np.arctan2(_UPPER_ARM[1], _UPPER_ARM[0])
    forearm_tilt = tilt + np.arccos(cos_wrist) + np.arctan2(_FOREARM[1], _FOREARM[0])
    joints = np.zeros((len(positions), 7))
    joints[:, 0] = np.arctan2(y, x)
    joints[:, 1] = upper_tilt
    joints[:, 3] = upper_tilt - forearm_tilt
    joints[:, 5] = forearm_tilt
    joints[:, 6] = joints[:, 0] - yaws + _YAW_OFFSET
    return joints


def panda_yaw(joints: np.ndarray) -> float:
    """Returns the yaw (rad, unbounded) of seven joint angles with joints 3 and 5 near zero."""
    return float(joints[0] - joints[6] + _YAW_OFFSET)


def hand_joints(positions: np.ndarray, yaws: np.ndarray) -> np.ndarray:
    """Returns the joint values (x, y, z, yaw) of the free hand, shape (n, 4), m and rad."""
    return np.concatenate((positions, yaws[:, None]), axis=1)
