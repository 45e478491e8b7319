"""What the numbers of an action mean."""

import numpy as np
import pytest

from equirl.envs import Action
from equirl.envs.action import CLOSED, HALF_OPEN, OPEN
from equirl.envs.workspace import Workspace

SPACE = Workspace()


def test_the_order_and_the_units_are_the_documented_ones():
    action = Action(*np.array([-0.5, 0.2, -0.4, 1.0, -1.0]).tolist())
    np.testing.assert_allclose(action.displacement(SPACE), (0.01, -0.02, 0.05))
    assert action.turn(SPACE) == pytest.approx(-np.pi / 4)
    assert action.aperture(SPACE) == pytest.approx(0.02)


def test_the_action_of_a_motion_makes_that_motion():
    way = np.array([0.12, -0.01, 0.03])
    action = Action.moving(way, 0.3, OPEN, SPACE)
    np.testing.assert_allclose(action.displacement(SPACE), way)
    assert action.turn(SPACE) == pytest.approx(0.3)
    assert action.x == pytest.approx(2.4)  # more than one action can


@pytest.mark.parametrize(("gripper", "aperture"), [(OPEN, 0.08), (HALF_OPEN, 0.04), (CLOSED, 0)])
def test_an_action_of_the_gripper_alone_moves_nothing_else(gripper, aperture):
    action = Action(gripper)
    assert action.aperture(SPACE) == aperture
    assert not action.displacement(SPACE).any() and action.turn(SPACE) == 0
