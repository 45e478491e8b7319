"""Environments in processes: what they give, and what happens when one fails."""

from __future__ import annotations

import os
import signal
import time
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from equirl.envs import ManipulationEnv, WorkerError, make_env, make_parallel_env
from equirl.envs.factory import make_env as plain_make_env
from equirl.envs.parallel import WatchedParallelEnv

UP = torch.tensor([1.0, 0.0, 0.0, 0.2, 0.0])


def up(td):
    return td.set("action", UP.expand(*td.batch_size, 5).clone())


class Faulty(ManipulationEnv):
    """Stands in for a simulator that hangs or breaks down at its third step."""

    fault = staticmethod(lambda: None)

    def _step(self, tensordict):
        if self._steps == 2:
            self.fault()
        return super()._step(tensordict)


def faulty(fault) -> ManipulationEnv:
    env = plain_make_env("block_picking", image_size=8, robot="hand")
    env.__class__ = Faulty
    env.fault = fault
    return env


def broken() -> ManipulationEnv:
    raise ValueError("no such robot")


def hanging() -> ManipulationEnv:
    time.sleep(1000)


def fail() -> None:
    raise ZeroDivisionError


def good() -> ManipulationEnv:
    return plain_make_env("block_picking", image_size=8, robot="hand")


def watched(*makers, within: float = 2.0) -> WatchedParallelEnv:
    names = [f"env{k}" for k in range(len(makers))]
    return WatchedParallelEnv(names, list(makers), answer_within=within)


def test_workers_have_scenes_of_their_own_that_follow_from_the_seed():
    def run(seed):
        env = make_parallel_env("block_picking", 2, seed=seed, image_size=16, robot="hand")
        try:
            return env.rollout(3, policy=up)
        finally:
            env.close()

    first, again, other = run(3), run(3), run(4)
    assert torch.equal(first["depth"], again["depth"])
    assert not torch.equal(first["depth"], other["depth"])
    assert not torch.equal(first[0]["depth"], first[1]["depth"])
    assert first["next", "depth"].shape == (2, 3, 1, 16, 16)


def test_seeds_set_later_give_what_single_environments_give():
    env = make_parallel_env("block_pushing", 2, image_size=16, robot="hand")
    single = make_env("block_pushing", image_size=16, robot="hand")
    try:
        env.set_seed(5, static_seed=True)
        single.set_seed(5)
        together, alone = env.rollout(4, policy=up), single.rollout(4, policy=up)
    finally:
        env.close()
        single.close()
    for worker in range(2):
        assert torch.equal(together[worker]["next", "depth"], alone["next", "depth"])


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (partial(os._exit, 7), r"env1 \(worker 1 of 2, process \d+, exit code 7\) died"),
        (fail, r"env1 \(worker 1 of 2, process \d+, exit code 1\) died"),
        (partial(time.sleep, 1000), r"env1 \(worker 1 of 2, process \d+\) did not answer within 2"),
        (
            lambda: os.kill(os.getpid(), signal.SIGKILL),
            r"env1 \(worker 1 of 2, process \d+, SIGKILL\) died while it was stepped",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_a_worker_that_fails_is_named_in_time_and_the_data_stay(fault, message):
    env = watched(good, partial(faulty, fault))
    buffer = ReplayBuffer(storage=LazyTensorStorage(100))
    current = env.reset()
    processes = list(env._workers)
    start = time.monotonic()
    with pytest.raises(WorkerError, match=message):
        for _ in range(10):
            stepped = env.step(up(current))
            buffer.extend(stepped.select("depth", "action", ("next", "reward")))
            current = stepped["next"].exclude("reward")
    assert time.monotonic() - start < 10
    assert len(buffer) == 2 * 2  # both steps before, of both workers
    assert torch.equal(buffer[0]["action"], UP)
    assert not any(process.is_alive() for process in processes)
    env.close(raise_if_closed=False)
    assert isinstance(buffer.sample(2), TensorDict)


@pytest.mark.parametrize(
    "call",
    [
        lambda env, td: env.step(up(td)),
        lambda env, td: env.reset(),
        lambda env, td: env.set_seed(3),
        lambda env, td: env.rollout(3, policy=up, break_when_any_done=False),
    ],
)
def test_a_worker_that_died_between_two_calls_is_named(call):
    env = watched(good, good)
    td = env.reset()
    os.kill(env._workers[1].pid, signal.SIGKILL)
    env._workers[1].join()
    with pytest.raises(WorkerError, match=r"^env1 \(worker 1 of 2, process \d+, SIGKILL\) died"):
        call(env, td)
    assert env.is_closed


def test_a_worker_that_stands_still_is_named_when_it_is_seeded_and_does_not_hold_up_the_end():
    env = watched(good, good, within=1.0)
    env.reset()
    os.kill(env._workers[1].pid, signal.SIGSTOP)
    start = time.monotonic()
    with pytest.raises(WorkerError, match=r"^env1 .* did not take a seed within 1 s"):
        env.set_seed(3)
    other = watched(good, good, within=1.0)
    other.reset()
    os.kill(other._workers[0].pid, signal.SIGSTOP)
    other.close()
    assert time.monotonic() - start < 15


def test_closing_after_a_worker_died_is_harmless():
    env = watched(good, good)
    env.reset()
    os.kill(env._workers[0].pid, signal.SIGKILL)
    env._workers[0].join()
    env.close()
    assert env.is_closed


@pytest.mark.parametrize(
    ("maker", "message"),
    [
        (hanging, r"^env1 \(worker 1 of 2, process \d+\) did not start within 2 s"),
        (broken, r"env1 .*died before it could start"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_a_worker_that_does_not_start_is_reported(maker, message):
    env = watched(good, good)
    env.create_env_fn[1] = maker  # the specs are known; the process fails
    with pytest.raises(WorkerError, match=message):
        env.reset()


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="workers must be a positive integer, got 0"):
        make_parallel_env("block_picking", 0)
    with pytest.raises(ValueError, match="image_size must be .* got 3"):
        make_parallel_env("block_picking", 2, image_size=3)
    with pytest.raises(ValueError, match="answer_within must be positive .* got 0"):
        make_parallel_env("block_picking", 2, answer_within=0)
