"""Pictures for people."""

from dataclasses import replace

import numpy as np
import pytest


@pytest.fixture
def env(make):
    return make("block_pushing", image_size=16, robot="hand")


def green(picture: np.ndarray) -> np.ndarray:
    """Where a picture shows the goal area."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (green > red + 30) & (green > blue + 30)


def test_a_picture_shows_where_the_marked_area_is(env):
    env.set_seed(0)
    env.reset()
    scene = replace(env.get_scene(), objects=[[-0.1, 0.1, 0.025, 0, 0, 0, 1]])
    centres = []
    for x, y in ((0.1, -0.1), (0.1, 0.1), (-0.1, -0.1)):
        env.set_scene(replace(scene, areas=[[x, y, 0.3]]))
        seen = green(env.render(120, 90))
        assert seen.shape == (90, 120) and seen.sum() > 50
        centres.append(np.argwhere(seen).mean(0))
    (near_row, near_column), (_, right_column), (_, left_column) = centres
    assert near_row > 50  # seen from the front right: this corner is the nearest
    assert left_column + 10 < near_column < right_column - 10


def test_a_shadow_tells_where_the_gripper_is(env):
    env.set_seed(0)
    env.reset()
    scene = replace(env.get_scene(), objects=[[-0.1, 0.1, 0.025, 0, 0, 0, 1]])
    pictures = {}
    for x in (-0.1, 0.1):
        moved = replace(scene, position=[x, -0.05, 0.25], areas=[[-0.1, -0.1, 0]])
        env.set_scene(moved)
        pictures[x] = env.render(200, 200).astype(int).sum(-1)
    floor = (slice(150, 165), slice(95, 105))  # before the near corner, under the second gripper
    assert pictures[0.1][floor].mean() < pictures[-0.1][floor].mean() - 15


def test_pictures_are_the_same_each_time(env):
    env.set_seed(1)
    env.reset()
    first = env.render(64, 48)
    env.render(48, 48)
    np.testing.assert_array_equal(env.render(64, 48), first)
