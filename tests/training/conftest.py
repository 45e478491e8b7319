"""Small configurations for training tests."""

import pytest

from equirl.config import to_config
from equirl.envs import make_env

SMALL = {
    "env": {"task": "block_picking", "image_size": 16, "max_steps": 12, "robot": "hand"},
    "method": {"name": "equivariant", "hidden": 8},
    "algorithm": {"name": "sac", "batch_size": 4},
    "augmentation": {"name": "buffer", "copies": 4},
    "demos": {"episodes": 1},
    "evaluation": {"every": 10, "episodes": 1, "final_episodes": 2, "video_episodes": 0},
    "logging": {"progress": False},
    "group": "C4",
    "steps": 24,
    "checkpoint_every": 10,
    "threads": 1,
}


def merged(base: dict, changes: dict) -> dict:
    out = dict(base)
    for key, value in changes.items():
        out[key] = merged(base.get(key, {}), value) if isinstance(value, dict) else value
    return out


@pytest.fixture
def small_config():
    """A function of the changes to a configuration that trains in a second."""
    return lambda **changes: to_config(merged(SMALL, changes))


@pytest.fixture
def env():
    """Episodes of at most ten steps, on pictures of 16 pixels."""
    env = make_env("block_picking", image_size=16, robot="hand", max_steps=10)
    yield env
    env.close()
