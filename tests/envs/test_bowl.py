"""The bowl: stands, contains, can be pinched, and nothing passes through its wall."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from equirl.envs import Scene
from equirl.envs.bullet import Simulation
from equirl.envs.tasks.block_in_bowl import BlockInBowl, tilt
from equirl.envs.workspace import Workspace

TASK = BlockInBowl()
SPACE = Workspace()
HEIGHT = -TASK.bowl.vertices[:, 2].min()  # of the centre of a bowl that stands
BOWL = [0, 0, HEIGHT, 0, 0, 0, 1]
ASIDE, ASIDE_ACROSS = ([-0.13, y, 0.025, 0, 0, 0, 1] for y in (-0.13, 0.13))


@pytest.fixture(scope="module")
def simulation():
    simulation = Simulation(TASK.bodies, "panda", SPACE)
    yield simulation
    simulation.close()


def wait(simulation, steps: int = 240) -> None:
    for _ in range(steps):
        simulation._client.stepSimulation()


def test_its_size_is_the_papers_and_it_is_symmetric():
    np.testing.assert_allclose(TASK.bowl.extents, (0.16, 0.16, 0.07), atol=1e-9)
    corners = {tuple(v) for v in np.round(TASK.bowl.vertices, 12) + 0.0}
    turned = {(-y + 0.0, x, z) for x, y, z in corners}
    assert {tuple(np.round(v, 12) + 0.0) for v in turned} == corners
    assert TASK.bowl.has_mirror_symmetry


def test_it_rests_where_it_is_put_with_few_contacts(simulation):
    simulation.place(Scene([0, 0, 0.2], 0.0, 0.08, [ASIDE, BOWL]))
    wait(simulation)
    start = simulation.scene().objects[1]
    assert np.abs(start - BOWL).max() < 2e-3
    wait(simulation, 600)
    end = simulation.scene().objects[1]
    np.testing.assert_allclose(end[:3], start[:3], atol=2e-4)
    assert tilt(end[3:]) < 0.005
    contacts = simulation._client.getContactPoints(simulation._ids[1])
    assert 1 <= len(contacts) <= 8  # the foot's alone


def test_a_nudged_bowl_comes_back_upright(simulation):
    leaning = Rotation.from_euler("x", 0.15).as_quat()
    simulation.place(Scene([0, 0, 0.2], 0.0, 0.08, [ASIDE, [0, 0, HEIGHT + 0.01, *leaning]]))
    wait(simulation)
    assert tilt(simulation.scene().objects[1, 3:]) < 0.01


@pytest.mark.parametrize("offset", [(0, 0), (0.02, 0.01), (-0.04, 0.0), (0.03, -0.03)])
def test_a_cube_let_go_above_it_slides_to_its_middle(simulation, offset):
    simulation.place(Scene([0, 0, 0.25], 0.0, 0.08, [[*offset, 0.12, 0, 0, 0, 1], BOWL]))
    wait(simulation)
    cube, bowl = simulation.scene().objects
    assert np.hypot(*(cube[:2] - bowl[:2])) < TASK.reach
    assert tilt(bowl[3:]) < TASK.max_tilt and simulation.touching(0, 1)
    assert cube[2] > 0.012 + 0.02  # on the floor of the bowl, not through it


@pytest.mark.parametrize("angle", [0.0, np.pi / 4, -np.pi / 2])
def test_its_rim_can_be_pinched_and_lifted(simulation, angle):
    rim = 0.0765 * np.array([np.cos(angle), np.sin(angle)])
    simulation.place(Scene([*rim, 0.15], angle, 0.08, [ASIDE, BOWL]))
    for height in (0.10, 0.062):
        simulation.act(np.array([*rim, height]), angle, 0.08)
    simulation.act(np.array([*rim, 0.062]), angle, 0.0)
    assert 0.004 < simulation.scene().aperture < 0.02  # the wall is between the fingers
    for _ in range(3):
        simulation.act(simulation.scene().position + np.array([0, 0, 0.04]), angle, 0.0)
    assert simulation.scene().objects[1, 2] > HEIGHT + 0.06
    assert simulation.held() == 1


@pytest.mark.parametrize("angle", [0.0, np.pi / 8, np.pi / 4])
def test_fingers_do_not_pass_through_its_wall(simulation, angle):
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    # From inside: the gripper drags the bowl along and stays within it.
    simulation.place(Scene([0, 0, 0.15], angle, 0.0, [ASIDE, BOWL]))
    for height in (0.10, 0.05):
        simulation.act(np.array([0, 0, height]), angle, 0.0)
    for _ in range(5):
        simulation.act(SPACE.clip(simulation.scene().position + 0.05 * direction), angle, 0.0)
        scene = simulation.scene()
        assert np.hypot(*(scene.position - scene.objects[1, :3])[:2]) < 0.065
    # From outside: it pushes the bowl away.
    start = -0.13 * direction
    simulation.place(Scene([*start[:2], 0.03], angle, 0.0, [ASIDE_ACROSS, BOWL]))
    for _ in range(5):
        simulation.act(SPACE.clip(simulation.scene().position + 0.05 * direction), angle, 0.0)
        scene = simulation.scene()
        assert (scene.objects[1, :3] - scene.position) @ direction > 0.05


@pytest.mark.parametrize(("start", "move"), [(-0.02, -0.05), (-0.125, 0.05)])
def test_a_cube_pressed_against_its_wall_stays_on_its_side(simulation, start, move):
    inside = move < 0
    where = np.array([start, 0.0, 0.055])
    simulation.place(Scene(where, 0.0, 0.05, [[*where, 0, 0, 0, 1], BOWL], grip=0.0))
    simulation.act(where, 0.0, 0.0)
    for _ in range(3):
        assert simulation.held() == 0
        simulation.act(SPACE.clip(simulation.scene().position + np.array([move, 0, 0])), 0.0, 0.0)
        cube, bowl = simulation.scene().objects
        apart = bowl[0] - cube[0]
        assert 0 < apart < 0.06 if inside else apart > 0.08
    assert abs(bowl[0]) > 0.08  # it was pushed indeed
