"""Small configurations for training tests."""

import pytest
import torch

from equirl.config import to_config
from equirl.envs import make_env
from equirl.training import export_actor, make_networks

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

#: Of which policies `export` makes files.
POLICIES = {
    "C2": {"group": "C2"},
    "C4": {"group": "C4"},
    "C8": {"group": "C8"},
    "D4": {"group": "D4"},
    "D8": {"group": "D8"},
    "SO2": {"group": "SO2", "backend": "dense"},
    "O2": {"group": "O2", "backend": "dense"},
    "D4 paper": {"group": "D4", "mode": "paper"},
    "SO2 paper": {"group": "SO2", "mode": "paper", "backend": "dense"},
    "O2 paper": {"group": "O2", "mode": "paper", "backend": "dense"},
    "CNN": {"method": {"name": "cnn"}},
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


@pytest.fixture
def export(small_config, tmp_path):
    """Exports an untrained policy: its actor, its certificate and its file."""

    def call(suffix: str, case: str = "D4", **options):
        torch.manual_seed(0)
        config = small_config(device="cpu", **POLICIES[case])
        actor, _ = make_networks(config)
        path = tmp_path / f"policy{suffix}"
        return actor, export_actor(config, actor, path, steps=7, **options), path

    return call
