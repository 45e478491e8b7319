"""The rotation of transitions agrees with turning the simulated scene."""

import math

import pytest
import torch

from equirl.envs import Scene, make_env
from equirl.symmetry import Element, manipulation_spec
from equirl.symmetry.audit_transforms import transform_scene

ACTION = torch.tensor([0.6, 0.5, -0.4, -0.7, 0.3])


def transition(env, scene, action):
    current = env.set_scene(scene)
    return env.step(current.set("action", action))


def moved(scene, element):
    """Where each pose of a scene goes, by the audit's own arithmetic."""
    return Scene.from_dict(transform_scene(scene.as_dict(), element))


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_quarter_turns_of_a_scene(turns):
    env = make_env("block_picking", image_size=64, robot="hand", seed=3)
    env.reset()
    scene = env.get_scene()
    element = Element(turns * math.pi / 2)
    spec = manipulation_spec()
    original = transition(env, scene, ACTION)
    expected = spec.transform(original, element)
    turned = transition(env, moved(scene, element), expected["action"])
    env.close()
    for key in ("depth", ("next", "depth")):
        differing = (expected[key] - turned[key]).abs() > 2e-4
        assert differing.float().mean() < 2e-3, key  # silhouette pixels only
    assert (original["depth"] - turned["depth"]).abs().max() > 1e-2  # it did turn


def test_reflection_of_a_scene():
    env = make_env("block_picking", image_size=64, robot="hand", seed=4)
    env.reset()
    scene = env.get_scene()
    original = transition(env, scene, ACTION)
    expected = manipulation_spec().transform(original, Element(0.0, reflected=True))
    mirrored = transition(env, moved(scene, Element(0.0, reflected=True)), expected["action"])
    env.close()
    for key in ("depth", ("next", "depth")):
        differing = (expected[key] - mirrored[key]).abs() > 2e-4
        assert differing.float().mean() < 2e-3, key


def test_any_angle_up_to_interpolation():
    env = make_env("block_picking", image_size=64, robot="hand", seed=5)
    env.reset()
    scene = env.get_scene()
    angle = 0.7
    original = transition(env, scene, ACTION)
    rotated = manipulation_spec().rotate(original.unsqueeze(0), torch.tensor([angle]))[0]
    turned = transition(env, moved(scene, Element(angle)), rotated["action"])
    env.close()
    centre = slice(16, 48)  # the corners of a turned image come from beyond its border
    for key in ("depth", ("next", "depth")):
        error = (rotated[key] - turned[key])[:, centre, centre].abs()
        assert error.median() < 1e-3 and (error > 0.01).float().mean() < 0.06, key
