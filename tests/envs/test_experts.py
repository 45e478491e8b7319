"""The scripted planners solve their tasks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs import StepCounter, TransformedEnv

from equirl.envs import Scene, make_env, make_expert


def run(env, expert, seed: int):
    """Returns reward, length and actions of an episode."""
    env.set_seed(seed)
    td, actions = env.reset(), []
    while True:
        td = expert(td.clone())
        actions.append(td["action"])
        td = env.step(td)["next"]
        if td["done"].item():
            return td["reward"].item(), len(actions), torch.stack(actions)


def check(robot: str, clip: str, episodes: int, allowed_failures: int) -> None:
    env = make_env("block_picking", image_size=8, robot=robot)
    results = [run(env, make_expert(env, horizontal_clip=clip), seed) for seed in range(episodes)]
    env.close()
    assert sum(reward for reward, *_ in results) >= episodes - allowed_failures
    assert np.mean([length for _, length, _ in results]) <= 7.7
    actions = torch.cat([actions for *_, actions in results])
    assert actions.abs().max() <= 1
    if clip == "norm":
        assert actions[:, 1:3].norm(dim=-1).max() <= 1


@pytest.mark.parametrize("clip", ["norm", "box"])
def test_twenty_episodes_are_solved(clip):
    check("panda", clip, 20, 0)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["panda", "hand"])
@pytest.mark.parametrize("clip", ["norm", "box"])
def test_a_hundred_episodes_are_solved(robot, clip):
    check(robot, clip, 100, 1)


def test_the_norm_clip_keeps_the_direction_and_the_box_clip_does_not():
    env = make_env("block_picking", image_size=8, robot="hand")
    td = env.set_scene(Scene([0, 0, 0.2], 0.0, 0.08, [[0.12, 0.06, 0.025, 0, 0, 0, 1]]))
    norm = make_expert(env)(td.clone())["action"][1:3]
    box = make_expert(env, horizontal_clip="box")(td.clone())["action"][1:3]
    torch.testing.assert_close(norm, torch.tensor([2.0, 1.0]) / 5**0.5, atol=1e-4, rtol=0)
    torch.testing.assert_close(box, torch.tensor([1.0, 1.0]))
    env.close()


@pytest.mark.parametrize("yaw", [0.6, -0.7, 2.0, 40.0])
def test_it_never_turns_by_more_than_the_cube_asks(yaw):
    env = make_env("block_picking", image_size=8, robot="hand")
    td = env.set_scene(Scene([0, 0, 0.2], yaw, 0.08, [[0, 0, 0.025, 0, 0, 0, 1]]))
    turn = make_expert(env)(td)["action"][4].item() * np.pi / 4
    assert abs(turn) <= np.pi / 4 + 1e-6
    assert np.sin(2 * (yaw + turn)) == pytest.approx(0, abs=1e-4)
    env.close()


def test_it_recovers_from_a_closed_gripper_beside_the_cube():
    env = make_env("block_picking", image_size=8)
    td = env.set_scene(Scene([-0.08, 0, 0.03], 0.0, 0.0, [[0.05, 0, 0.025, 0, 0, 0, 1]]))
    expert = make_expert(env)
    for _ in range(15):
        td = env.step(expert(td.clone()))["next"]
        if td["done"].item():
            break
    assert td["reward"].item() == 1
    env.close()


def test_it_accepts_a_transformed_environment_and_serves_as_a_rollout_policy():
    env = TransformedEnv(make_env("block_picking", image_size=8, robot="hand"), StepCounter())
    rollout = env.rollout(20, policy=make_expert(env))
    assert rollout["next", "reward"][-1].item() == 1
    env.close()


def test_bad_arguments_are_refused():
    env = make_env("block_picking", image_size=8)
    with pytest.raises(ValueError, match="'norm' or 'box', got 'disc'"):
        make_expert(env, horizontal_clip="disc")
    with pytest.raises(ValueError, match="ManipulationEnv, got str"):
        make_expert("block_picking")
