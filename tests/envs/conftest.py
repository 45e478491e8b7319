"""What the tests of the environments share."""

from contextlib import ExitStack

import pytest
import torch

from equirl.envs import make_env


@pytest.fixture
def make():
    """The function `make_env`; what it makes is closed after the test."""
    with ExitStack() as opened:

        def made(task, **options):
            env = make_env(task, **options)
            opened.callback(env.close, raise_if_closed=False)
            return env

        yield made


@pytest.fixture(scope="session")
def act():
    """A function that plays an action of five numbers; it returns what comes next."""

    def played(env, td, *action):
        td = td.clone().set("action", torch.tensor(action, dtype=torch.float32))
        return env.step(td)["next"]

    return played
