"""The configuration schema."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from equirl.config import (
    Config,
    ConfigError,
    TrainJob,
    flatten,
    load_config,
    register,
    save_config,
    to_config,
)

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


@pytest.mark.parametrize(
    ("algorithm", "asked", "sampling"),
    [
        ("sac", "auto", "uniform"),
        ("sacfd", "auto", "prioritized"),
        ("sacfd", "symmetric", "symmetric"),
        ("sac", "prioritized", "prioritized"),
    ],
)
def test_sampling_is_the_algorithms_own_unless_asked_for(algorithm, asked, sampling):
    changes = {"algorithm": {"name": algorithm}, "replay": {"sampling": asked}}
    assert to_config(GOOD | changes).sampling == sampling


@pytest.mark.parametrize(
    ("method", "size", "observed"),
    [("cnn", 128, 128), ("rad", 128, 142), ("ferm", 64, 72), ("rad", 16, 18)],
)
def test_methods_that_crop_are_shown_more_than_they_see(method, size, observed):
    changes = {
        "method": {"name": method},
        "env": {"task": "block_picking", "image_size": size},
    }
    assert to_config(GOOD | changes).observed_size == observed


@pytest.mark.parametrize(
    ("size", "asked", "shift"), [(128, 0, 4), (64, 0, 2), (16, 0, 1), (128, 7, 7)]
)
def test_shifts_keep_their_share_of_the_image(size, asked, shift):
    changes = {
        "method": {"name": "drq", "shift": asked},
        "env": {"task": "block_picking", "image_size": size},
    }
    assert to_config(GOOD | changes).shift == shift


@pytest.mark.parametrize(("given", "kept"), [("d8", "D8"), ("so2", "SO2"), ("O2", "O2")])
def test_group_is_normalised(given, kept):
    assert to_config(GOOD | {"group": given}).group == kept


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sede": 1}, "sede"),
        ({"seed": "one"}, "seed"),
        ({"seed": -1}, "seed=-1: expected 0 or more"),
        ({"group": "SO3"}, "group=SO3: unknown symmetry group .*expected SO2, O2, or C<n> or D<n>"),
        ({"mode": "exact"}, "mode=exact: expected one of strict, paper"),
        ({"method": {"name": "curl"}}, "method=curl: expected one of equivariant, .*rad, ferm"),
        ({"algorithm": {"name": "td3"}}, "algorithm=td3: expected one of sac, sacfd"),
        (
            {"augmentation": {"name": "shift"}},
            "augmentation=shift: expected one of buffer, online, auxiliary, none",
        ),
        ({"replay": {"sampling": "newest"}}, "replay.sampling=newest: expected one of auto, unif"),
        ({"replay": {"beta": 1.5}}, "replay.beta=1.5: expected 0 to 1"),
        ({"replay": {"exponent": 8.0}}, "replay.exponent=8.0: expected 0 to 1"),
        (
            {"replay": {"capacity": 245, "start": 10}},
            "replay.capacity=245: a demonstration is stored whole, .* with their copies, 250",
        ),
        (
            {"method": {"name": "drq", "shift": 64}},
            "method.shift=64: expected less than half of env.image_size=128",
        ),
        (
            {"method": {"name": "ferm"}, "algorithm": {"name": "sac", "batch_size": 1}},
            "algorithm.batch_size=1: method=ferm tells .* expected 2 or more",
        ),
        (
            {"method": {"name": "rad"}, "env": {"task": "block_picking", "image_size": 142}},
            "image_size=142 is not .* the side of the crop: the environment shows more by itself",
        ),
        (
            {"demos": {"file": "a.hdf5", "options": {"grasp": "aligned"}}},
            "demos.options=.*: expected none, the demonstrations of demos.file=a.hdf5 are",
        ),
        (
            {"replay": {"sampling": "symmetric"}, "demos": {"episodes": 0}},
            "replay.sampling=symmetric: half of each batch .* above 0, got 0",
        ),
        (
            {"demos": {"episodes": 0, "file": "a.hdf5"}},
            "demos.file=a.hdf5: expected demos.episodes above 0, got 0",
        ),
        ({"env": {"task": "block_stacking"}}, "env.task: unknown task .*block_picking"),
        ({"env": {"task": "block_picking", "image_size": 48}}, "image_size=48.*16, 32, 64"),
        ({"env": {"task": "block_picking", "robot": "ur5"}}, "robot=ur5: expected one of panda"),
        (
            {"env": {"task": "block_picking", "options": {"lift": 1}}},
            "env.options: BlockPicking has no option lift; its options: .*lift_height",
        ),
        (
            {"env": {"task": "clutter_grasping", "options": {"objects": "/nonexistent"}}},
            "env.options: .*/nonexistent",
        ),
        (
            {"env": {"task": "clutter_grasping"}, "demos": {"options": {"grasp": "best"}}},
            "demos.options: grasp must be 'random' or 'aligned', got 'best'",
        ),
        (
            {"demos": {"options": {"grip": 1}}},
            "demos.options: BlockPickingExpert has no option grip",
        ),
        ({"method": {"name": "equivariant", "hidden": 12}}, "hidden=12.*multiple of 8"),
        ({"algorithm": {"name": "sac", "tau": 0.0}}, "algorithm.tau=0.0"),
        ({"replay": {"capacity": 3}}, "replay.capacity=3: expected 5 or more"),
        ({"replay": {"start": 200_000}}, "replay.start=200000: the buffer of 100000 transitions"),
        ({"algorithm": {"name": "sac", "alpha": float("inf")}}, "algorithm.alpha=inf"),
        ({"algorithm": {"name": "sac", "target_entropy": float("nan")}}, "target_entropy=nan"),
        ({"algorithm": {"name": "sac", "averaging": 1.0}}, "algorithm.averaging=1.0"),
        ({"steps": 0}, "steps=0"),
        ({"backend": "fast"}, "backend=fast: expected one of auto, native, dense"),
    ],
)
def test_impossible_values_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        to_config(GOOD | changes)


@pytest.mark.parametrize("device", ["tpu", "cuda:99", "meta"])
def test_a_missing_device_is_named_where_it_is_used(device):
    config = to_config(GOOD | {"device": device})  # a run can be read where it cannot be trained
    with pytest.raises(ConfigError, match=f"device={device}"):
        _ = config.torch_device


@pytest.mark.parametrize("preset", ["laptop", "paper", "smoke"])
def test_presets_compose_into_valid_configurations(preset):
    register()
    root = Path(__file__).parents[1] / "conf"
    with initialize_config_dir(str(root), version_base="1.3"):
        config = to_config(compose("config", [f"preset={preset}"]), TrainJob)
    if preset == "paper":
        assert (config.mode, config.env.image_size, config.method.hidden) == ("paper", 128, 64)
        learner = config.algorithm
        assert (learner.learning_rate, learner.batch_size, learner.discount) == (1e-3, 64, 0.99)
        assert (learner.tau, learner.alpha, learner.target_entropy) == (1e-2, 1e-2, -5)
        assert (learner.averaging, config.method.head_width) == (0, 0)
        assert (config.steps, config.copies, config.demos.episodes) == (10_000, 4, 20)
    else:
        assert config.mode == "strict"


def test_a_file_that_is_not_yaml_is_named(tmp_path):
    (tmp_path / "config.yaml").write_text("env: [")
    with pytest.raises(ConfigError, match="not a readable configuration"):
        load_config(tmp_path / "config.yaml")


def test_a_folder_without_a_run_is_named(tmp_path):
    with pytest.raises(ConfigError, match="not the folder of a run"):
        load_config(tmp_path / "config.yaml")


def test_flatten_names_every_leaf():
    flat = flatten(to_config(GOOD))
    assert flat["env.task"] == "block_picking" and flat["seed"] == 0
    assert len(flat) > len(Config.__dataclass_fields__)
