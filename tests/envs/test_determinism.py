"""An episode is a function of its seed and its actions, bit for bit."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import numpy as np
import pytest
import torch

from equirl.envs import make_env, make_expert
from equirl.envs.tasks import TASKS


def digest(env, seed: int, episodes: int = 1) -> str:
    """Hashes episodes: the expert's until they end, then random moves, 12 steps each."""
    env.set_seed(seed)
    expert, rng, bits = make_expert(env), np.random.default_rng(seed), hashlib.sha256()
    for _ in range(episodes):
        td, expert_acts = env.reset(), True
        for _ in range(12):
            td = td.clone()
            if expert_acts:
                expert(td)
            else:
                td["action"] = torch.tensor(rng.uniform(-1, 1, 5), dtype=torch.float32)
            td = env.step(td)["next"]
            expert_acts = expert_acts and not td["done"].item()
            bits.update(td["depth"].numpy().tobytes())
            bits.update(env.get_scene().objects.tobytes())
    return bits.hexdigest()


def disturb(env, rng: np.random.Generator) -> None:
    """Leaves the environment somewhere in the middle of some episode."""
    env.set_seed(int(rng.integers(1000)))
    td, expert = env.reset(), make_expert(env)
    for _ in range(rng.integers(8)):
        td["action"] = torch.tensor(rng.uniform(-1, 1, 5), dtype=torch.float32)
        if rng.random() < 0.6:
            expert(td)
        td = env.step(td)["next"]


def check_independence(task: str, robot: str, rounds: int) -> None:
    first, second = (make_env(task, image_size=16, robot=robot) for _ in range(2))
    expected = [digest(first, seed, episodes=2) for seed in range(2)]
    assert expected[0] != expected[1]
    rng = np.random.default_rng(0)
    for _ in range(rounds):
        env = (first, second)[rng.integers(2)]
        disturb(env, rng)
        seed = int(rng.integers(2))
        assert digest(env, seed, episodes=2) == expected[seed]
    first.close()
    second.close()


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_does_not_depend_on_what_came_before_it(task):
    check_independence(task, "panda", 8)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["panda", "hand"])
@pytest.mark.parametrize("task", TASKS)
def test_no_episode_of_many_depends_on_what_came_before_it(task, robot):
    check_independence(task, robot, 40)


@pytest.mark.parametrize("task", TASKS)
def test_eight_interleaved_environments_do_not_disturb_each_other(task):
    envs = [make_env(task, image_size=16, seed=7, robot="hand") for _ in range(8)]
    states = [env.reset() for env in envs]
    rng = np.random.default_rng(0)
    for _ in range(6):
        action = torch.tensor(rng.uniform(-1, 1, 5), dtype=torch.float32)
        states = [
            env.step(td.clone().set("action", action))["next"]
            for env, td in zip(envs, states, strict=True)
        ]
        scenes = [env.get_scene() for env in envs]
        assert all(torch.equal(td["depth"], states[0]["depth"]) for td in states)
        assert all(scene == scenes[0] for scene in scenes)
    for env in envs:
        env.close()


@pytest.mark.parametrize("task", TASKS)
def test_a_restored_scene_plays_on_alike_in_any_environment(task):
    first, second = (make_env(task, image_size=16, robot="hand") for _ in range(2))
    first.reset()
    scene = first.get_scene()
    disturb(second, np.random.default_rng(1))
    depths = []
    for env in (first, second, second):
        td, rng = env.set_scene(scene), np.random.default_rng(0)
        for _ in range(6):
            action = torch.tensor(rng.uniform(-1, 1, 5), dtype=torch.float32)
            td = env.step(td.clone().set("action", action))["next"]
        depths.append(td["depth"])
    assert torch.equal(depths[0], depths[1]) and torch.equal(depths[1], depths[2])
    first.close()
    second.close()


def test_episodes_after_the_first_follow_from_the_seed_too():
    env = make_env("block_picking", image_size=16, robot="hand")

    def starts():
        env.set_seed(11)
        return [env.reset()["depth"] for _ in range(3)]

    first, second = starts(), starts()
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert not torch.equal(first[0], first[1])
    env.close()


def test_constructor_seed_is_the_seed_of_set_seed():
    env = make_env("block_picking", image_size=16, seed=4, robot="hand")
    start = env.reset()["depth"]
    env.set_seed(4)
    assert torch.equal(env.reset()["depth"], start)
    env.close()


def test_no_global_generator_is_used():
    env = make_env("block_picking", image_size=16, robot="hand")
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    td = env.reset()
    env.step(make_expert(env)(td))
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)
    env.close()


def test_another_process_gives_the_same_bits():
    here = {}
    for task in TASKS:
        env = make_env(task, image_size=16)
        here[task] = digest(env, 2, episodes=2)
        env.close()
    code = (
        "import importlib.util as u; from equirl.envs import make_env;"
        f"s = u.spec_from_file_location('d', {__file__!r}); m = u.module_from_spec(s);"
        "s.loader.exec_module(m);"
        f"[print(t, m.digest(make_env(t, image_size=16), 2, episodes=2)) for t in {list(TASKS)!r}]"
    )
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    for task, value in here.items():
        assert f"{task} {value}" in out.stdout
