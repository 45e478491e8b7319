"""Inverse kinematics, motion and grasping in the simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from equirl.envs import Scene
from equirl.envs.bullet import Simulation
from equirl.envs.bullet.kinematics import panda_joints
from equirl.envs.objects import ObjectSet, cube
from equirl.envs.workspace import Workspace

ROBOTS = ("panda", "hand")
SPACE = Workspace()
ASIDE = [0.12, 0.12, 0.025, 0, 0, 0, 1]


@pytest.fixture(params=ROBOTS)
def simulation(request):
    simulation = Simulation(ObjectSet([cube(0.05, 0.1, 1.0)], "test"), request.param, SPACE)
    yield simulation
    simulation.close()


def test_the_end_effector_is_placed_within_a_tenth_of_a_millimetre(simulation):
    rng = np.random.default_rng(0)
    for _ in range(200):
        position = rng.uniform((-0.15, -0.15, 0.01), (0.15, 0.15, 0.25))
        yaw = rng.uniform(-10, 10)
        simulation.place(Scene(position, yaw, 0.08, [[0, 0, 1, 0, 0, 0, 1]]))
        scene = simulation.scene()
        assert np.abs(scene.position - position).max() < 1e-4
        assert scene.yaw == pytest.approx(yaw, abs=1e-6)


def test_the_tool_points_down_and_the_fingers_separate_along_the_yaw(simulation):
    simulation.place(Scene([0.05, 0.02, 0.15], 0.7, 0.06, [ASIDE]))
    robot = simulation._robot
    left, right = (
        np.array(robot._client.getLinkState(robot.body, k, computeForwardKinematics=1)[4])
        for k in robot.fingers
    )
    apart = left - right
    assert np.linalg.norm(apart) == pytest.approx(0.06, abs=1e-4)
    assert abs(apart[2]) < 1e-5
    assert abs(np.dot(apart[:2], (-np.sin(0.7), np.cos(0.7)))) < 1e-5


def test_a_pose_out_of_reach_is_refused():
    with pytest.raises(ValueError, match=r"cannot reach \[2\. +0\. +0\.2\]"):
        panda_joints(np.array([[2.0, 0.0, 0.2]]), np.zeros(1), SPACE.arm_base_x)


def test_moves_arrive_whatever_the_accumulated_yaw(simulation):
    rng = np.random.default_rng(1)
    simulation.place(Scene([0, 0, 0.2], 0.0, 0.08, [ASIDE]))
    for _ in range(40):
        scene = simulation.scene()
        target = SPACE.clip(scene.position + rng.uniform(-0.05, 0.05, 3))
        target[2] = max(target[2], 0.12)
        yaw, aperture = scene.yaw + rng.uniform(0, np.pi / 4), rng.uniform(0, 0.08)
        simulation.act(target, yaw, aperture)
        reached = simulation.scene()
        assert np.linalg.norm(reached.position - target) < 1e-3
        assert reached.yaw == pytest.approx(yaw, abs=np.radians(1))
        assert reached.aperture == pytest.approx(aperture, abs=1.5e-3)
    assert reached.yaw > 4 * np.pi


@pytest.mark.parametrize(
    ("offset", "yaw", "limit"),
    [((0.0, 0.0), 0.0, 6e-3), ((0.0, 0.012), 0.0, 6e-3), ((0.012, 0.0), 0.0, 6e-3)],
)
def test_a_grasped_cube_neither_slips_nor_flies(simulation, offset, yaw, limit):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        simulation.place(Scene([0, 0, 0.025], yaw, 0.08, [[*offset, 0.025, 0, 0, 0, 1]]))
        simulation.act(np.array([0, 0, 0.025]), yaw, 0.0)
        assert simulation.held() == 0
        for height in (0.075, 0.125, 0.165):
            simulation.act(np.array([0, 0, height]), yaw, 0.0)
        before = in_hand(simulation.scene())
        for _ in range(12):
            scene = simulation.scene()
            move = 0.05 * rng.choice([-1.0, 1.0], 3)
            target = np.clip(scene.position + move, (-0.15, -0.15, 0.125), (0.15, 0.15, 0.25))
            simulation.act(target, scene.yaw + np.pi / 4 * rng.choice([-1, 1]), 0.0)
        assert simulation.held() == 0
        assert np.linalg.norm(in_hand(simulation.scene()) - before) < limit


def in_hand(scene: Scene) -> np.ndarray:
    """Position of the object in the frame of the hand."""
    return Rotation.from_euler("z", -scene.yaw).apply(scene.objects[0, :3] - scene.position)


def test_pressing_on_a_cube_neither_buries_nor_launches_nor_swallows_it(simulation):
    for x in (0.0, 0.012, 0.02):
        simulation.place(Scene([0, 0, 0.2], 0.0, 0.0, [[x, 0.005, 0.025, 0, 0, 0, 1]]))
        heights = []
        for move in (-0.05,) * 5 + (0.05,) * 4:
            scene = simulation.scene()
            target = SPACE.clip(scene.position + np.array([0, 0, move]))
            simulation.act(target, 0.0, 0.0)
            heights.append(simulation.scene().objects[0, 2])
        assert min(heights) > 0.018 and max(heights) < 0.03
        assert heights[-1] == pytest.approx(0.025, abs=1e-3)
        assert simulation.held() is None


def test_a_cube_at_rest_stays_at_rest(simulation):
    pose = [0.05, -0.03, 0.025, *Rotation.from_euler("z", 0.4).as_quat()]
    simulation.place(Scene([0, 0, 0.2], 0.0, 0.08, [pose]))
    for _ in range(5):
        simulation.act(np.array([0, 0, 0.2]), 0.0, 0.08)
    np.testing.assert_allclose(simulation.scene().objects[0], pose, atol=2e-4)


def test_one_finger_alone_does_not_hold(simulation):
    simulation.place(Scene([0, 0, 0.025], 0.0, 0.08, [[0.066, 0, 0.025, 0, 0, 0, 1]]))
    simulation.act(np.array([0.02, 0, 0.025]), 0.0, 0.08)  # pushes with the outside of a finger
    assert simulation.scene().objects[0, 0] > 0.07
    assert simulation.held() is None


def test_pushing_with_both_fingers_does_not_hold(simulation):
    # The fingers separate along x and push along y: both touch the same face.
    simulation.place(Scene([0, -0.06, 0.03], 0.0, 0.04, [[0, 0, 0.025, 0, 0, 0, 1]]))
    touched = []

    def step():
        simulation._client.stepSimulation()
        assert simulation.held() is None
        contacts = simulation._client.getContactPoints(simulation._robot.body)
        touched.append({contact[3] for contact in contacts})

    simulation._robot.move(np.array([0, -0.01, 0.03]), 0.0, step)
    assert set(simulation._robot.fingers) in touched
    assert simulation.scene().objects[0, 1] > 0.01


def test_a_pushed_cube_slides_back_off_the_walls(simulation):
    simulation.place(Scene([0.0, 0, 0.2], 0.0, 0.0, [[0.17, 0, 0.07, 0, 0, 0, 1]]))
    for _ in range(6):
        simulation.act(np.array([0.0, 0, 0.2]), 0.0, 0.0)
    x, _, z = simulation.scene().objects[0, :3]
    assert x < 0.15 and z < 0.05


def test_a_scene_with_another_number_of_objects_is_refused(simulation):
    with pytest.raises(ValueError, match="the scene has 2 objects, the task 1"):
        simulation.place(Scene([0, 0, 0.2], 0.0, 0.08, [ASIDE, ASIDE]))
