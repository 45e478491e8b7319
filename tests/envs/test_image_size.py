"""Images of other sizes, such as those that crops are taken of, show the same metres."""

import numpy as np
import pytest

from equirl.envs import make_env

VIEW = 0.45  # m, of Block Pushing


def shown(size: int, seed: int) -> dict[str, tuple[float, np.ndarray]]:
    """Area (m^2) and centre (m, from the gripper) of the cube and of the goal in an image."""
    env = make_env("block_pushing", image_size=size, robot="hand")
    env.set_seed(seed, static_seed=True)
    depth = env.reset()["depth"][0].numpy()
    height = depth.max() - depth  # of the floor 0, the goal 0.02, the cube 0.05
    fingers = depth == 0
    env.close()
    centres = (np.arange(size) + 0.5 - size / 2) * VIEW / size
    found = {}
    for name, low, high in (("goal", 0.015, 0.025), ("cube", 0.045, 0.055)):
        rows, columns = np.nonzero((height > low) & (height < high) & ~fingers)
        # On the floor, and not on the bin's walls.
        inside = np.maximum(abs(centres[rows]), abs(centres[columns])) < 0.145
        centre = np.array([centres[rows[inside]].mean(), centres[columns[inside]].mean()])
        found[name] = inside.sum() * (VIEW / size) ** 2, centre
    return found


@pytest.mark.parametrize("size", [142, 72])
def test_goal_and_cube_keep_their_size_in_metres(size):
    """Neither shrinks where there are more pixels."""
    for seed in (2, 3):
        reference, other = shown(128, seed), shown(size, seed)
        for name in ("goal", "cube"):
            area, centre = other[name]  # an edge along the axes is a whole number of pixels
            expected, place = reference[name]
            assert area == pytest.approx(expected, rel=0.1), (
                name
            )  # an axis-aligned edge is whole pixels
            np.testing.assert_allclose(centre, place, atol=0.002)
    assert reference["goal"][0] == pytest.approx(0.09**2, rel=0.1)
    assert reference["cube"][0] == pytest.approx(0.05**2, rel=0.1)
