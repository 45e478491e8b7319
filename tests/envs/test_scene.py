"""Scenes as plain, transformable values."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from equirl.envs import Scene


def example() -> Scene:
    quaternion = Rotation.from_euler("zx", (0.3, 0.2)).as_quat()
    return Scene([0.05, -0.02, 0.2], 0.4, 0.06, [[0.03, 0.07, 0.025, *quaternion]], grip=0.0)


def test_a_scene_survives_json_bit_for_bit():
    scene = example()
    assert Scene.from_dict(json.loads(json.dumps(scene.as_dict()))) == scene


def test_four_quarter_turns_restore_the_positions_exactly():
    scene = turned = example()
    for _ in range(4):
        turned = turned.turned(np.pi / 2)
    np.testing.assert_array_equal(turned.position, scene.position)
    np.testing.assert_array_equal(turned.objects[:, :3], scene.objects[:, :3])
    np.testing.assert_allclose(np.abs(turned.objects[:, 3:] @ scene.objects[0, 3:]), 1)
    assert turned.yaw == pytest.approx(scene.yaw + 2 * np.pi)


def test_turns_compose_and_reflection_is_an_involution():
    scene = example()
    composed, direct = scene.turned(0.3).turned(0.5), scene.turned(0.8)
    np.testing.assert_allclose(composed.position, direct.position)
    np.testing.assert_allclose(composed.objects, direct.objects)
    assert scene.reflected().reflected() == scene
    # Reflect, turn, reflect is the turn back.
    back = scene.reflected().turned(0.3).reflected()
    np.testing.assert_allclose(back.objects, scene.turned(-0.3).objects)


def test_reflected_rotation_is_the_conjugated_matrix():
    scene, mirror = example(), np.diag([1.0, -1.0, 1.0])
    matrix = Rotation.from_quat(scene.objects[0, 3:]).as_matrix()
    reflected = Rotation.from_quat(scene.reflected().objects[0, 3:]).as_matrix()
    np.testing.assert_allclose(reflected, mirror @ matrix @ mirror, atol=1e-12)


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
