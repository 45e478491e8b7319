"""The configuration schema."""

import pytest

from equirl.config import Config, ConfigError, flatten, load_config, save_config, to_config

GOOD = {
    "env": {"task": "block_picking"},
    "method": {"name": "equivariant"},
    "algorithm": {"name": "sac"},
    "augmentation": {"name": "buffer"},
}


def test_defaults_are_the_papers_and_survive_a_file(tmp_path):
    config = to_config(GOOD)
    assert (config.algorithm.learning_rate, config.algorithm.batch_size) == (1e-3, 64)
    assert (config.replay.capacity, config.augmentation.copies, config.steps) == (
        100_000,
        4,
        10_000,
    )
    save_config(config, tmp_path / "config.yaml")
    assert load_config(tmp_path / "config.yaml") == config


def test_copies_are_those_of_the_augmentation_in_use():
    assert to_config(GOOD).copies == 4
    assert to_config(GOOD | {"augmentation": {"name": "none"}}).copies == 0


def test_group_is_normalised():
    assert to_config(GOOD | {"group": "d8"}).group == "D8"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sede": 1}, "sede"),
        ({"seed": "one"}, "seed"),
        ({"seed": -1}, "seed=-1: expected 0 or more"),
        ({"group": "SO2"}, "group=SO2.*not available yet"),
        ({"mode": "exact"}, "mode=exact: expected one of strict, paper"),
        ({"method": {"name": "ferm"}}, "method=ferm: expected one of equivariant, cnn"),
        ({"algorithm": {"name": "sacfd"}}, "algorithm=sacfd: expected one of sac"),
        ({"augmentation": {"name": "online"}}, "augmentation=online"),
        ({"env": {"task": "block_picking", "image_size": 48}}, "image_size=48.*16, 32, 64"),
        ({"env": {"task": "block_picking", "robot": "ur5"}}, "robot=ur5: expected one of panda"),
        ({"method": {"name": "equivariant", "hidden": 12}}, "hidden=12: expected a multiple of 8"),
        ({"algorithm": {"name": "sac", "tau": 0.0}}, "algorithm.tau=0.0"),
        ({"replay": {"capacity": 3}}, "replay.capacity=3: expected 5 or more"),
        ({"device": "tpu"}, "device=tpu: expected auto, cpu or cuda"),
        ({"device": "cuda:99"}, "device=cuda:99: this machine has"),
        ({"steps": 0}, "steps=0"),
    ],
)
def test_impossible_values_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        to_config(GOOD | changes)


def test_a_folder_without_a_run_is_named(tmp_path):
    with pytest.raises(ConfigError, match="not the folder of a run"):
        load_config(tmp_path / "config.yaml")


def test_flatten_names_every_leaf():
    flat = flatten(to_config(GOOD))
    assert flat["env.task"] == "block_picking" and flat["seed"] == 0
    assert len(flat) > len(Config.__dataclass_fields__)
