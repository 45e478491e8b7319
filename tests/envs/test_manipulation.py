"""The environment as a TorchRL user meets it."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.envs import ParallelEnv
from torchrl.envs.utils import check_env_specs

from equirl.envs import ManipulationEnv, Scene, make_env, make_expert
from equirl.envs.tasks import TASKS
from equirl.symmetry import Element, ScalarField
from equirl.symmetry.audit_transforms import transform_scene

REST = [0, 0, 0, 1]
UP = (1.0, 0.0, 0.0, 1.0, 0.0)


@pytest.fixture
def env(make):
    return make("block_picking", image_size=32, seed=0)


@pytest.mark.parametrize("robot", ["panda", "hand"])
def test_specs(make, robot):
    env = make("block_picking", image_size=32, robot=robot)
    check_env_specs(env)
    td = env.reset()
    assert td["depth"].shape == (1, 32, 32) and td["depth"].dtype == torch.float32
    assert td["holding"].shape == (1,) and td["holding"].dtype == torch.float32
    assert env.action_spec.shape == (5,)


def test_rollout_of_random_actions_stays_within_the_specs(env):
    rollout = env.rollout(30, auto_cast_to_device=True)
    assert rollout["depth"].min() >= 0 and rollout["depth"].max() <= np.float32(0.32)
    assert env.observation_spec.is_in(rollout[0].select("depth", "holding"))


def test_an_episode_starts_at_home_with_the_cube_in_its_range(env):
    for seed in range(30):
        env.set_seed(seed)
        td = env.reset()
        scene = env.get_scene()
        np.testing.assert_allclose(scene.position, (0, 0, 0.2), atol=1e-6)
        assert abs(scene.yaw) < 1e-9 and scene.aperture == pytest.approx(0.08)
        assert np.abs(scene.objects[0, :2]).max() <= 0.09
        assert scene.objects[0, 2] == pytest.approx(0.025)
        assert not td["done"] and td["holding"] == 0


def test_actions_move_by_the_documented_steps(env, act):
    td = env.set_scene(Scene([0, 0, 0.15], 0.0, 0.08, [[0.1, 0.1, 0.025, *REST]]))
    act(env, td, 0.0, 0.5, -1.0, 1.0, 0.4)
    scene = env.get_scene()
    np.testing.assert_allclose(scene.position, (0.025, -0.05, 0.20), atol=1e-3)
    assert scene.yaw == pytest.approx(0.4 * np.pi / 4, abs=0.01)
    assert scene.aperture == pytest.approx(0.04, abs=1.5e-3)


def test_targets_are_clipped_to_the_workspace(env, act):
    td = env.set_scene(Scene([0.14, -0.14, 0.24], 0.0, 0.08, [[0, 0, 0.025, *REST]]))
    act(env, td, 1.0, 1.0, -1.0, 1.0, 0.0)
    np.testing.assert_allclose(env.get_scene().position, (0.15, -0.15, 0.25), atol=1e-3)


@pytest.mark.parametrize(
    "action",
    [
        (1.1, 0, 0, 0, 0),
        (0, 0, -1.001, 0, 0),
        (0, float("nan"), 0, 0, 0),
        (0, 0, 0, 0, float("inf")),
        (0, 0, 0),
    ],
)
def test_impossible_actions_are_refused_with_their_values(env, action):
    td = env.reset()
    with pytest.raises(ValueError, match=r"five numbers .* in \[-1, 1\], got \["):
        env._step(td.set("action", torch.tensor(action, dtype=torch.float32)))


def test_actions_may_exceed_one_by_rounding(env, act):
    act(env, env.reset(), 1 + 5e-7, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("limit", "flag"), [("truncate", "truncated"), ("terminate", "terminated")]
)
def test_the_time_limit_is_what_was_asked_for(make, limit, flag, act):
    env = make("block_picking", image_size=16, max_steps=3, time_limit=limit, robot="hand")
    for _ in range(2):  # the count starts anew with the episode
        td = env.reset()
        for step in range(3):
            td = act(env, td, *UP)
            assert td["done"].item() == (step == 2)
        other = {"truncated": "terminated", "terminated": "truncated"}[flag]
        assert td[flag].item() and not td[other].item() and td["reward"].item() == 0


def test_success_terminates_with_reward_one_and_beats_the_time_limit(make):
    env = make("block_picking", image_size=16, max_steps=7)
    expert, td = make_expert(env), env.reset()
    for step in range(7):
        td = env.step(expert(td.clone()))["next"]
        assert td["reward"].item() == (step == 6)
    assert td["terminated"].item() and not td["truncated"].item() and td["holding"].item() == 1
    assert env.get_scene().position[2] > 0.15


def test_a_held_cube_below_the_height_is_no_success(env, act):
    td = env.set_scene(Scene([0, 0, 0.025], 0.0, 0.08, [[0, 0, 0.025, *REST]]))
    td = act(env, td, -1.0, 0, 0, 0, 0)
    assert td["holding"].item() == 1 and not td["done"].item()
    td = act(env, td, -1.0, 0, 0, 1.0, 0)
    assert td["holding"].item() == 1 and not td["done"].item()
    td = act(env, td, 1.0, 0, 0, 0, 0)
    assert td["holding"].item() == 0


def test_a_cube_outside_the_workspace_terminates_without_reward(env, act):
    outside = [0.22, 0.22, 0.11, *REST]  # on the rim, from where it does not slide back at once
    td = env.set_scene(Scene([0, 0, 0.2], 0.0, 0.08, [outside]))
    td = act(env, td, *UP)
    assert not env.workspace.contains(env.get_scene().objects[0, :3])
    assert td["terminated"].item() and td["reward"].item() == 0 and not td["truncated"].item()


@pytest.mark.parametrize("where", [(0.16, 0, 0.05), (0, -0.16, 0.05), (0, 0, 0.26), (0, 0, 0.0)])
def test_the_workspace_is_bounded_in_x_y_and_z(env, where):
    assert not env.workspace.contains(where)
    assert env.workspace.contains(where, margin=0.011)


def test_a_cube_pushed_out_terminates(env, act):
    # Across the motion the hand is slim enough to reach the wall.
    td = env.set_scene(Scene([0.05, 0.0, 0.02], np.pi / 2, 0.0, [[0.09, 0, 0.025, *REST]]))
    for _ in range(6):
        td = act(env, td, -1.0, 1.0, 0, 0, 0)
        if td["done"].item():
            break
    assert td["terminated"].item() and td["reward"].item() == 0
    assert env.get_scene().objects[0, 0] > 0.15


def test_scenes_are_restored(env, act):
    rng = np.random.default_rng(0)
    td = env.reset()
    for _ in range(4):
        td = act(env, td, *rng.uniform(-1, 1, 5))
    scene = env.get_scene()
    env.reset()
    restored = env.set_scene(scene)
    again = env.get_scene()
    np.testing.assert_allclose(again.position, scene.position, atol=1e-6)
    np.testing.assert_allclose(again.objects, scene.objects, atol=1e-9)
    assert (again.yaw, again.aperture) == pytest.approx((scene.yaw, scene.aperture), abs=1e-6)
    assert (restored["depth"] - td["depth"]).abs().gt(1e-5).float().mean() < 1e-2


def test_a_held_cube_is_still_held_in_the_restored_scene(env):
    td, expert = env.reset(), make_expert(env)
    for _ in range(5):
        td = env.step(expert(td.clone()))["next"]
    assert td["holding"].item() == 1
    scene = env.get_scene()
    env.reset()
    td = env.set_scene(scene)
    assert td["holding"].item() == 1
    for _ in range(2):
        td = env.step(expert(td.clone()))["next"]
    assert td["reward"].item() == 1


def test_a_gripper_outside_the_workspace_is_refused(env):
    with pytest.raises(ValueError, match=r"\[0.3, 0.0, 0.2\] \(m\) is outside"):
        env.set_scene(Scene([0.3, 0, 0.2], 0.0, 0.08, [[0, 0, 0.025, *REST]]))


@pytest.mark.parametrize("robot", ["panda", "hand"])
def test_simulated_images_turn_with_the_scene(make, robot):
    env = make("block_picking", image_size=64, robot=robot)
    for seed in range(5):
        env.set_seed(seed)
        env.reset()
        scene = env.get_scene()
        image = env.set_scene(scene)["depth"]
        for element in (Element(np.pi / 2), Element(0.0, reflected=True)):
            moved = Scene.from_dict(transform_scene(scene.as_dict(), element))
            seen = env.set_scene(moved)["depth"]
            error = (seen - ScalarField().transform(image, element)).abs()
            assert error.gt(1e-6).float().mean() < 2e-3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "block_stacking"}, "unknown task 'block_stacking'; expected .*block_picking"),
        ({"image_size": 65}, "image_size must be an even positive integer, got 65"),
        ({"image_size": 0}, "image_size must be .* got 0"),
        ({"seed": -1}, "seed must be a non-negative integer, got -1"),
        ({"robot": "ur5"}, "robot must be 'panda' or 'hand', got 'ur5'"),
        ({"max_steps": 0}, "max_steps must be a positive integer, got 0"),
        ({"time_limit": "none"}, "time_limit must be 'truncate' or 'terminate', got 'none'"),
    ],
)
def test_arguments_are_validated(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_env(**{"task": "block_picking", **arguments})


def test_closing_twice_is_harmless_and_a_closed_environment_says_so(env):
    env.reset()
    env.close()
    env.close()
    with pytest.raises(RuntimeError, match="closed; make a new one"):
        env.reset()


def resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_a_thousand_resets_leak_nothing(task):
    env = make_env(task, image_size=16, robot="hand")
    for seed in range(120):  # what is cached is cached by then
        env.set_seed(seed)
        env.reset()
    before = resident_megabytes()
    for seed in range(1000):
        env.set_seed(seed)
        env.reset()
    assert resident_megabytes() - before < 5
    env.close()


def test_many_environments_can_be_opened_and_closed():
    for _ in range(40):
        env = make_env("block_picking", image_size=8, robot="hand")
        env.reset()
        env.close()


def test_pictures_do_not_change_the_simulation(env, act):
    def run(take_pictures):
        env.set_seed(5)
        td, depths = env.reset(), []
        rng = np.random.default_rng(0)
        for _ in range(3):
            if take_pictures:
                picture = env.render(80, 60)
                assert picture.shape == (60, 80, 3) and picture.dtype == np.uint8
                assert picture.std() > 10  # shows something
            td = act(env, td, *rng.uniform(-1, 1, 5))
            depths.append(td["depth"])
        return torch.stack(depths)

    assert torch.equal(run(False), run(True))


def test_workers_give_what_one_environment_gives():
    make = functools.partial(make_env, "block_picking", image_size=16, robot="hand")
    vector = ParallelEnv(2, make, mp_start_method="fork")
    try:
        vector.set_seed(3, static_seed=True)
        rollout = vector.rollout(4, policy=_up)
    finally:
        vector.close()
    single = make(seed=0)
    single.set_seed(3)
    alone = single.rollout(4, policy=_up)
    single.close()
    for worker in range(2):
        assert torch.equal(rollout[worker]["depth"], alone["depth"])


@pytest.mark.slow
def test_spawned_workers():
    make = functools.partial(make_env, "block_picking", image_size=16, robot="hand")
    vector = ParallelEnv(2, make, mp_start_method="spawn")
    try:
        assert vector.rollout(3, policy=_up)["depth"].shape == (2, 3, 1, 16, 16)
    finally:
        vector.close()


def _up(td):
    return td.set("action", torch.tensor(UP).expand(*td.batch_size, 5).clone())


def test_is_a_torchrl_environment(env):
    assert isinstance(env, ManipulationEnv) and env.batch_size == torch.Size([])
