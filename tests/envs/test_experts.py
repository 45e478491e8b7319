"""The scripted planners solve their tasks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs import StepCounter, TransformedEnv

from equirl.envs import Scene, make_expert
from equirl.envs.tasks import TASKS


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


#: Mean length of an expert episode in the paper's implementation; ours may take 10 % more.
LENGTHS = {
    "block_picking": 7.0,
    "clutter_grasping": 9.1,
    "block_pushing": 8.9,
    "block_in_bowl": 12.1,
}
SUCCESS = {"clutter_grasping": 0.97}  # 0.99 in the other tasks


def check(make, task: str, robot: str, clip: str, episodes: int, slack: float = 0.0) -> None:
    env = make(task, image_size=8, robot=robot)
    expert = make_expert(env, horizontal_clip=clip)
    results = [run(env, expert, HELD_OUT + index) for index in range(episodes)]
    rewards = [reward for reward, *_ in results]
    assert np.mean(rewards) >= SUCCESS.get(task, 0.99) - slack
    if task in LENGTHS:  # the paper's
        assert np.mean([length for _, length, _ in results]) <= (1.1 + slack) * LENGTHS[task]
    actions = torch.cat([actions for *_, actions in results])
    assert actions.abs().max() <= 1
    if clip == "norm":
        assert actions[:, 1:3].norm(dim=-1).max() <= 1


HELD_OUT = 10**6


@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if task().expert])
def test_episodes_are_solved(make, task):
    # Ten heaps say little about lengths: most take 7 steps, a few take 30.
    check(make, task, "panda", "norm", 10, slack=0.5 if task == "clutter_grasping" else 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(("robot", "clip"), [("panda", "norm"), ("panda", "box"), ("hand", "norm")])
def test_two_hundred_episodes_are_solved(make, task, robot, clip):
    check(make, task, robot, clip, 200, slack=0.0 if robot == "panda" else 0.05)


@pytest.mark.slow
def test_a_planner_that_looks_where_its_fingers_go_takes_fewer_steps(make):
    env = make("clutter_grasping", image_size=8)
    lengths = {
        grasp: np.mean([run(env, make_expert(env, grasp=grasp), seed)[1] for seed in range(100)])
        for grasp in ("random", "aligned")
    }
    assert lengths["aligned"] < lengths["random"]


def test_the_planner_for_clutter_plays_the_same_episode_again(make):
    env = make("clutter_grasping", image_size=8, robot="hand")
    first, again = (run(env, make_expert(env), 3)[2] for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first[:1], run(env, make_expert(env), 4)[2][:1])


def test_a_heap_is_emptied_episode_by_episode(make):
    env = make("clutter_grasping", image_size=8, robot="hand", seed=1)
    expert, left = make_expert(env), []
    td = env.reset()
    while True:
        left.append(len(env.get_scene().objects))
        for _ in range(50):
            td = env.step(expert(td.clone()))["next"]
            if td["done"].item():
                break
        assert td["reward"].item() == 1
        if not env.scene_continues:
            break
        td = env.reset()
    assert left == [5, 4, 3, 2, 1]


def test_the_norm_clip_keeps_the_direction_and_the_box_clip_does_not(make):
    env = make("block_picking", image_size=8, robot="hand")
    td = env.set_scene(Scene([0, 0, 0.2], 0.0, 0.08, [[0.12, 0.06, 0.025, 0, 0, 0, 1]]))
    norm = make_expert(env)(td.clone())["action"][1:3]
    box = make_expert(env, horizontal_clip="box")(td.clone())["action"][1:3]
    torch.testing.assert_close(norm, torch.tensor([2.0, 1.0]) / 5**0.5, atol=1e-4, rtol=0)
    torch.testing.assert_close(box, torch.tensor([1.0, 1.0]))


@pytest.mark.parametrize("yaw", [0.6, -0.7, 2.0, 40.0])
def test_it_never_turns_by_more_than_the_cube_asks(make, yaw):
    env = make("block_picking", image_size=8, robot="hand")
    td = env.set_scene(Scene([0, 0, 0.2], yaw, 0.08, [[0, 0, 0.025, 0, 0, 0, 1]]))
    turn = make_expert(env)(td)["action"][4].item() * np.pi / 4
    assert abs(turn) <= np.pi / 4 + 1e-6
    assert np.sin(2 * (yaw + turn)) == pytest.approx(0, abs=1e-4)


def test_it_recovers_from_a_closed_gripper_beside_the_cube(make):
    env = make("block_picking", image_size=8)
    td = env.set_scene(Scene([-0.08, 0, 0.03], 0.0, 0.0, [[0.05, 0, 0.025, 0, 0, 0, 1]]))
    expert = make_expert(env)
    for _ in range(15):
        td = env.step(expert(td.clone()))["next"]
        if td["done"].item():
            break
    assert td["reward"].item() == 1


def test_it_accepts_a_transformed_environment_and_serves_as_a_rollout_policy(make):
    env = TransformedEnv(make("block_picking", image_size=8, robot="hand"), StepCounter())
    rollout = env.rollout(20, policy=make_expert(env))
    assert rollout["next", "reward"][-1].item() == 1


def test_bad_arguments_are_refused(make):
    env = make("block_picking", image_size=8)
    with pytest.raises(ValueError, match="'norm' or 'box', got 'disc'"):
        make_expert(env, horizontal_clip="disc")
    with pytest.raises(ValueError, match="BlockPickingExpert has no option grasp"):
        make_expert(env, grasp="aligned")
    clutter = make("clutter_grasping", image_size=8)
    with pytest.raises(ValueError, match="'random' or 'aligned', got 'best'"):
        make_expert(clutter, grasp="best")
    with pytest.raises(ValueError, match="ManipulationEnv, got str"):
        make_expert("block_picking")
