"""Scenes as plain values."""

from __future__ import annotations

import json

import pytest
from scipy.spatial.transform import Rotation

from equirl.envs import Scene


def example() -> Scene:
    quaternion = Rotation.from_euler("zx", (0.3, 0.2)).as_quat()
    return Scene([0.05, -0.02, 0.2], 0.4, 0.06, [[0.03, 0.07, 0.025, *quaternion]], grip=0.0)


def test_a_scene_survives_json_bit_for_bit():
    scene = example()
    assert Scene.from_dict(json.loads(json.dumps(scene.as_dict()))) == scene


def test_scenes_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        example().position[0] = 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": [0, 0]}, r"position must be three finite numbers .*\[0, 0\]"),
        ({"objects": [[0, 0, 0]]}, r"objects must be finite rows .*\(1, 3\)"),
        ({"objects": [[0, 0, 0, 0, 0, 0, 2.0]]}, "norm 1, got norms"),
        ({"yaw": float("nan")}, "yaw must be finite, got nan"),
    ],
)
def test_impossible_scenes_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Scene.from_dict({**example().as_dict(), **change})
