"""An episode is a function of its seed and its actions, bit for bit."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import numpy as np
import pytest
import torch

from equirl.envs import make_env, make_expert


def digest(env, seed: int) -> str:
    """Hashes an episode: the expert's grasp and lift, then random moves with the cube."""
    env.set_seed(seed)
    expert, rng, td = make_expert(env), np.random.default_rng(seed), env.reset()
    bits = hashlib.sha256()
    for step in range(11):
        td = td.clone()
        if step < 7:
            expert(td)
        else:
            td["action"] = torch.tensor(rng.uniform(-1, 1, 5), dtype=torch.float32)
        td = env.step(td)["next"]
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


@pytest.mark.parametrize("robot", ["panda", "hand"])
def test_an_episode_does_not_depend_on_what_came_before_it(robot):
    first, second = (make_env("block_picking", image_size=16, robot=robot) for _ in range(2))
    expected = [digest(first, seed) for seed in range(3)]
    assert len(set(expected)) == 3
    rng = np.random.default_rng(0)
    for _ in range(25):
        env = (first, second)[rng.integers(2)]
        disturb(env, rng)
        seed = int(rng.integers(3))
        assert digest(env, seed) == expected[seed]
    first.close()
    second.close()


def test_interleaved_environments_do_not_disturb_each_other():
    envs = [make_env("block_picking", image_size=16, seed=7, robot="hand") for _ in range(3)]
    states = [env.reset() for env in envs]
    rng = np.random.default_rng(0)
    for _ in range(6):
        action = torch.tensor(rng.uniform(-1, 1, 5), dtype=torch.float32)
        states = [
            env.step(td.clone().set("action", action))["next"]
            for env, td in zip(envs, states, strict=True)
        ]
        assert all(torch.equal(td["depth"], states[0]["depth"]) for td in states)
    for env in envs:
        env.close()


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
    env = make_env("block_picking", image_size=16)
    here = digest(env, 2)
    env.close()
    code = (
        "import importlib.util as u; from equirl.envs import make_env;"
        f"s = u.spec_from_file_location('d', {__file__!r}); m = u.module_from_spec(s);"
        "s.loader.exec_module(m);"
        "print('digest', m.digest(make_env('block_picking', image_size=16), 2))"
    )
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert f"digest {here}" in out.stdout
