"""Demonstrations: successful episodes only, reproducible, into a buffer if there is one."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import BaseCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from equirl.collectors import DemonstrationCollector
from equirl.envs import make_env, make_expert

KEYS = {
    "depth",
    "holding",
    "action",
    "expert",
    *(("next", k) for k in ("depth", "holding", "reward", "done", "terminated", "truncated")),
}


@pytest.fixture
def env():
    env = make_env("block_picking", image_size=16, robot="hand", max_steps=12)
    yield env
    env.close(raise_if_closed=False)


class SometimesLazy:
    """The expert, but in every second episode it never closes the gripper."""

    def __init__(self, env):
        self.env, self.expert, self.episode, self.steps = env, make_expert(env), 0, 0

    def __call__(self, td):
        if env_is_new(self.env):
            self.episode += 1
        td = self.expert(td)
        if self.episode % 2:
            td["action"] = torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0])
        return td


def env_is_new(env) -> bool:
    return env._steps == 0


def never(env):
    return TensorDictModule(
        lambda depth: torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0]),
        in_keys=["depth"],
        out_keys=["action"],
    )


def test_episodes_have_the_promised_form(env):
    collector = DemonstrationCollector(env, episodes=3, seed=0)
    assert isinstance(collector, BaseCollector) and len(collector) == 3
    episodes = list(collector)
    assert len(episodes) == 3 == collector.episodes_collected == collector.attempted
    for episode in episodes:
        keys = set(episode.keys(include_nested=True, leaves_only=True))
        assert keys == KEYS
        length = len(episode)
        assert episode.batch_size == (length,) and episode["depth"].shape == (length, 1, 16, 16)
        assert episode["expert"].all() and episode["expert"].shape == (length, 1)
        assert episode["expert"].dtype == torch.bool
        assert episode["next", "reward"].flatten().tolist() == [0.0] * (length - 1) + [1.0]
        assert episode["next", "done"].flatten().tolist() == [False] * (length - 1) + [True]
        assert torch.equal(episode["next", "depth"][:-1], episode["depth"][1:])
    assert not torch.equal(episodes[0]["depth"][0], episodes[1]["depth"][0])


def test_the_seed_decides_everything(env):
    first = list(DemonstrationCollector(env, episodes=2, seed=5))
    env.reset()
    second = list(DemonstrationCollector(env, episodes=2, seed=5))
    other = list(DemonstrationCollector(env, episodes=2, seed=6))
    for a, b in zip(first, second, strict=True):
        assert (a == b).all()
    assert not torch.equal(first[0]["depth"][0], other[0]["depth"][0])


def test_failed_episodes_are_discarded_without_shifting_the_others(env):
    collector = DemonstrationCollector(env, SometimesLazy(env), episodes=2, seed=5)
    found = list(collector)
    assert collector.attempted == 4 and len(found) == 2
    all_episodes = list(DemonstrationCollector(env, episodes=4, seed=5))
    assert (found[0] == all_episodes[1]).all() and (found[1] == all_episodes[3]).all()


def test_episodes_are_written_into_the_buffer(env):
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)
    episodes = list(DemonstrationCollector(env, episodes=2, seed=0, replay_buffer=buffer))
    assert len(buffer) == sum(len(episode) for episode in episodes)
    stored = buffer[:]
    assert torch.equal(stored["depth"], torch.cat([episode["depth"] for episode in episodes]))
    assert stored["expert"].all()
    assert "index" not in set(episodes[0].keys())


def test_a_hopeless_policy_is_given_up_on(env):
    collector = DemonstrationCollector(env, never(env), episodes=1, seed=0, max_failures=3)
    with pytest.raises(RuntimeError, match="TensorDictModule failed 3 episodes in a row .*0 of 1"):
        list(collector)


def test_collection_continues_from_its_state_dict(env):
    expected = list(DemonstrationCollector(env, episodes=3, seed=9))
    first = DemonstrationCollector(env, episodes=3, seed=9)
    next(iter(first))
    second = DemonstrationCollector(env, episodes=3, seed=0)
    second.load_state_dict(first.state_dict())
    rest = list(second)
    assert len(rest) == 2
    assert all((a == b).all() for a, b in zip(rest, expected[1:], strict=True))


def test_collection_continues_on_a_scene_that_goes_on():
    def collect(skip: int, state=None):
        env = make_env("clutter_grasping", image_size=16, robot="hand")
        collector = DemonstrationCollector(env, episodes=4, seed=1)
        if state is not None:
            collector.load_state_dict(state)
        episodes = iter(collector)
        found = [next(episodes) for _ in range(skip)] if skip else list(episodes)
        counts = [len(env.get_scene().objects)]
        env.close()
        return found, collector.state_dict(), counts

    expected, _, (left,) = collect(skip=0)
    assert left == 2  # the fourth of five objects is in the gripper: one heap, four episodes
    found, state, _ = collect(skip=2)
    rest, _, _ = collect(skip=0, state=state)
    for a, b in zip([*found, *rest], expected, strict=True):
        assert (a == b).all()


def test_set_seed_starts_over_and_next_ends(env):
    collector = DemonstrationCollector(env, episodes=1, seed=0)
    (first,) = list(collector)
    assert list(collector) == []
    collector.set_seed(0)
    assert (collector.next() == first).all()
    assert collector.next() is None


def test_shutdown_closes_the_environment_unless_told_otherwise(env):
    collector = DemonstrationCollector(env, episodes=1, seed=0)
    collector.shutdown(close_env=False)
    env.reset()
    with pytest.raises(RuntimeError, match="shut down"):
        list(collector)
    other = DemonstrationCollector(env, episodes=1, seed=0)
    other.shutdown()
    other.shutdown()
    with pytest.raises(RuntimeError, match="closed"):
        env.reset()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": -1}, "episodes must be at least 0, got -1"),
        ({"seed": -1}, "seed must not be negative, got -1"),
        ({"max_failures": 0}, "max_failures must be at least 1, got 0"),
    ],
)
def test_arguments_are_validated(env, arguments, message):
    with pytest.raises(ValueError, match=message):
        DemonstrationCollector(env, **{"episodes": 1, "seed": 0, **arguments})
