"""The environments as a Gymnasium user meets them."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import equirl.envs.gymnasium
from equirl.envs import ManipulationEnv, make_env, make_expert
from equirl.envs.gymnasium import GymnasiumEnv, register
from equirl.envs.tasks import TASKS

IDENTIFIERS = {name: f"equirl/{task.__name__}-v0" for name, task in TASKS.items()}
SMALL = {"image_size": 16, "robot": "hand"}


@pytest.fixture
def env():
    with GymnasiumEnv("block_picking", **SMALL, max_steps=3) as env:
        yield env


def actions(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 5)).astype(np.float32)


def same(one, other) -> bool:
    return all(np.array_equal(one[key], other[key]) for key in ("depth", "holding"))


def test_the_identifiers_are_the_documented_ones():
    assert set(IDENTIFIERS.values()) >= {
        "equirl/BlockPicking-v0",
        "equirl/ClutterGrasping-v0",
        "equirl/BlockPushing-v0",
        "equirl/BlockInBowl-v0",
    }


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_has_no_complaint(task):
    env = gymnasium.make(IDENTIFIERS[task], **SMALL)
    assert isinstance(env.unwrapped, GymnasiumEnv) and env.unwrapped.spec.id == IDENTIFIERS[task]
    assert isinstance(env.unwrapped.env, ManipulationEnv)
    check_env(env.unwrapped)
    env.close()


def test_gymnasium_has_no_complaint_about_the_arm():
    env = gymnasium.make("equirl/BlockPicking-v0", image_size=16, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_the_same_seed_gives_what_the_torchrl_environment_gives(task):
    env, other = GymnasiumEnv(task, **SMALL), make_env(task, **SMALL, seed=99)
    other.set_seed(7)
    for episode in range(2):
        observation, info = env.reset(seed=7 if episode == 0 else None)
        current = other.reset()
        assert same(observation, current) and info["is_success"] is False
        for action in actions(4):
            observation, reward, terminated, truncated, info = env.step(action)
            after = other.step(current.set("action", torch.tensor(action)))["next"]
            assert same(observation, after)
            assert (reward, terminated, truncated) == tuple(
                after[key].item() for key in ("reward", "terminated", "truncated")
            )
            assert info["scene_continues"] is other.scene_continues
            current = after.exclude("reward")
            if terminated:
                break
    env.close()
    other.close()


def test_spaces_are_the_documented_ones(env):
    depth, holding = env.observation_space["depth"], env.observation_space["holding"]
    assert (depth.shape, depth.dtype, depth.low.min()) == ((1, 16, 16), np.float32, 0)
    assert depth.high.min() == depth.high.max() == np.float32(0.32)
    assert (holding.shape, holding.dtype, holding.low, holding.high) == ((1,), np.float32, 0, 1)
    assert env.action_space.shape == (5,) and env.action_space.dtype == np.float32
    assert (env.action_space.low == -1).all() and (env.action_space.high == 1).all()


def test_without_a_seed_environments_differ_and_tell_their_seed():
    starts = []
    for _ in range(2):
        with GymnasiumEnv("block_picking", **SMALL) as env:
            starts.append(env.reset()[0])
            again, _ = env.reset(seed=env.np_random_seed)
            assert same(starts[-1], again)
    assert not same(*starts)


def test_the_seed_of_the_constructor_serves_the_first_reset_alone():
    with GymnasiumEnv("block_picking", **SMALL, seed=5) as env:
        first, _ = env.reset()
        second, _ = env.reset()
        assert env.np_random_seed == 5 and not same(first, second)
        again, _ = env.reset(seed=5)
        assert same(first, again)
        again, _ = env.reset()
        assert same(second, again)
    with GymnasiumEnv("block_picking", **SMALL, seed=5) as env:
        env.reset(seed=6)
        after, _ = env.reset()
        assert not same(first, after)


def test_success_is_told_and_terminates():
    with GymnasiumEnv("block_picking", **SMALL, seed=0) as env:
        observation, _ = env.reset()
        expert = make_expert(env.env)
        terminated, successes = False, []
        while not terminated:
            action = expert(env.env.fake_tensordict())["action"].numpy()
            observation, reward, terminated, truncated, info = env.step(action)
            successes.append(info["is_success"])
        assert successes == [False] * (len(successes) - 1) + [True]
        assert (reward, truncated, observation["holding"]) == (1.0, False, 1.0)
        assert type(reward) is float and type(terminated) is type(truncated) is bool


@pytest.mark.parametrize(
    ("limit", "ends"), [("truncate", (False, True)), ("terminate", (True, False))]
)
def test_the_time_limit_is_the_environments_own(limit, ends):
    env = gymnasium.make("equirl/BlockPicking-v0", **SMALL, max_steps=60, time_limit=limit)
    env.reset(seed=0)
    up = np.array([1, 0, 0, 1, 0], np.float32)
    for step in range(60):
        _, reward, *flags, _ = env.step(up)
        assert tuple(flags) == (ends if step == 59 else (False, False)) and reward == 0
    env.close()


@pytest.mark.parametrize("action", [[0, 0, 1.1, 0, 0], [0, 0, 0], [0, 0, 0, 0, float("nan")]])
def test_impossible_actions_are_refused_with_their_values(env, action):
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"five numbers .* in \[-1, 1\], got \["):
        env.step(np.array(action))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render_mode": "ascii"}, r"render_mode must be None or one of \['rgb_array'\], got 'as"),
        ({"task": "block_stacking"}, "unknown task 'block_stacking'; expected .*block_picking"),
        ({"image_size": 65}, "image_size must be an even positive integer, got 65"),
        ({"seed": -1}, "seed must be a non-negative integer, got -1"),
        ({"colour": "red"}, "BlockPicking has no option colour"),
    ],
)
def test_arguments_are_validated(arguments, message):
    with pytest.raises(ValueError, match=message):
        GymnasiumEnv(**{"task": "block_picking", **arguments})


def test_pictures():
    env = gymnasium.make("equirl/BlockPicking-v0", **SMALL, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (480, 640, 3) and picture.dtype == np.uint8 and picture.std() > 10
    env.close()


def test_pictures_have_to_be_asked_for_when_the_environment_is_made(env):
    env.reset()
    with pytest.warns(UserWarning, match='made with render_mode="rgb_array"'):
        assert env.render() is None


def test_closing_twice_is_harmless_and_a_closed_environment_says_so(env):
    env.close()
    env.close()
    with pytest.raises(RuntimeError, match="closed; make a new one"):
        env.reset()


def test_a_specification_can_be_stored_and_made_again():
    env = gymnasium.make("equirl/BlockPicking-v0", **SMALL, lift_height=0.12)
    text = env.spec.to_json()
    env.close()
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text))
    assert again.unwrapped.env.task.lift_height == 0.12
    again.close()


def test_registering_again_changes_nothing():
    before = dict(gymnasium.registry)
    register()
    assert dict(gymnasium.registry) == before
    gymnasium.register_envs(equirl.envs.gymnasium)


def test_the_identifier_can_name_the_module_that_registers_it():
    code = (
        "import gymnasium;"
        "env = gymnasium.make('equirl.envs.gymnasium:equirl/BlockPicking-v0', image_size=16);"
        "import sys;"
        "loaded = {'escnn', 'hydra', 'pybullet'} & set(sys.modules); assert not loaded, loaded;"
        "env.reset(seed=0); env.close()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def check_vector(vector) -> None:
    """Compares two environments that were made as one with each of them alone."""
    singles = [GymnasiumEnv("block_picking", **SMALL, max_steps=3) for _ in range(2)]
    try:
        observation, _ = vector.reset(seed=[3, 4])
        starts = [env.reset(seed=seed)[0] for env, seed in zip(singles, (3, 4), strict=True)]
        assert observation["depth"].shape == (2, 1, 16, 16)
        assert np.array_equal(observation["depth"], np.stack([each["depth"] for each in starts]))
        for step, action in enumerate(actions(3)):
            observation, _, _, truncated, info = vector.step(np.stack([action, -action]))
            alone = [env.step(sign * action)[0] for env, sign in zip(singles, (1, -1), strict=True)]
            assert np.array_equal(observation["depth"], np.stack([each["depth"] for each in alone]))
            assert info["is_success"].shape == (2,) and truncated.tolist() == [step == 2] * 2
        observation, *_ = vector.step(np.zeros((2, 5), np.float32))  # begins the next episodes
        alone = [env.reset()[0] for env in singles]
        assert np.array_equal(observation["depth"], np.stack([each["depth"] for each in alone]))
    finally:
        vector.close()
        for env in singles:
            env.close()


def test_several_environments_as_one():
    options = {"num_envs": 2, "vectorization_mode": "sync", "max_steps": 3}
    check_vector(gymnasium.make_vec("equirl/BlockPicking-v0", **options, **SMALL))


@pytest.mark.slow
@pytest.mark.parametrize("context", [None, "fork"])
def test_several_environments_in_workers(context):
    options = {"num_envs": 2, "vectorization_mode": "async", "max_steps": 3}
    workers = {"vector_kwargs": {"context": context}}
    check_vector(gymnasium.make_vec("equirl/BlockPicking-v0", **options, **workers, **SMALL))
