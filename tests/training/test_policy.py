"""Trained policies, from the folder of their run and from a file of their own."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from equirl.config import ConfigError, save_config
from equirl.training import (
    CheckpointError,
    TrainingRun,
    load_policy,
    make_networks,
    save_policy,
)
from equirl.training.folder import is_finished
from tests.transitions import transitions


def trained(config, folder: Path):
    """The policy of a short run, which leaves its folder."""
    folder.mkdir(exist_ok=True)
    save_config(config, folder / "config.yaml")
    with closing(TrainingRun(config, folder)) as training:
        training.run()
    return training.learner.policy


def act(policy) -> dict[str, torch.Tensor]:
    data = transitions(4, 16).select("depth", "holding")
    with torch.no_grad():
        return policy(data).select("action", "loc", "scale").to_dict()


@pytest.mark.parametrize(
    "changes",
    [
        {"algorithm": {"averaging": 0.0}},
        {"algorithm": {"averaging": 0.9}},
        {"group": "SO2", "backend": "dense"},
        {"method": {"name": "ferm"}, "env": {"options": {"cube_side": 0.04}}},
    ],
    ids=["last", "average", "gates", "ferm"],
)
def test_a_loaded_policy_is_the_trained_one(tmp_path, small_config, changes):
    config = small_config(steps=6, replay={"start": 10}, **changes)
    policy = trained(config, tmp_path / "run")
    fresh, _ = make_networks(config)
    expected = act(policy)
    assert not torch.equal(expected["loc"], act(fresh)["loc"])  # it has learned something
    file = tmp_path / "new" / "policy.pt"
    save_policy(tmp_path / "run", file)
    for place in (str(tmp_path / "run"), file, str(file)):
        loaded_config, policy = load_policy(place, config.device, config.backend)
        assert loaded_config == config
        for name, value in act(policy).items():
            assert torch.equal(value, expected[name])
    assert set(torch.load(file, weights_only=True)) == {"format", "run", "step", "policy"}


def test_a_file_is_loaded_where_it_is_asked(tmp_path, small_config):
    trained(small_config(steps=2, backend="dense"), tmp_path / "run")
    save_policy(tmp_path / "run", tmp_path / "policy.pt")
    config, _ = load_policy(tmp_path / "policy.pt")  # of another machine, maybe
    assert (config.device, config.backend) == ("auto", "auto")
    config, _ = load_policy(tmp_path / "policy.pt", "cpu", "dense")
    assert (config.device, config.backend) == ("cpu", "dense")
    with pytest.raises(ConfigError, match="device"):
        load_policy(tmp_path / "policy.pt", "cuda:7")


def test_what_is_no_policy_is_refused(tmp_path, small_config):
    folder, file = tmp_path / "run", tmp_path / "policy.pt"
    trained(small_config(steps=2), folder)
    with pytest.raises(ConfigError, match=r"policy.pth: expected a name in \.pt"):
        save_policy(folder, tmp_path / "policy.pth")
    with pytest.raises(ConfigError, match="not the folder of a run"):
        save_policy(tmp_path / "none", file)
    with pytest.raises(CheckpointError, match="cannot write"):
        save_policy(folder, folder / "config.yaml" / "policy.pt")
    with pytest.raises(CheckpointError, match="not the file of a policy.* 5; expected the run's"):
        load_policy(folder / "checkpoint.pt")
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_policy(folder / "config.yaml")
    with pytest.raises(ConfigError, match="none.pt not found; expected the folder of a run or"):
        load_policy(tmp_path / "none.pt")


def test_only_files_of_policies_are_replaced(tmp_path, small_config):
    folder, file = tmp_path / "run", tmp_path / "policy.pt"
    trained(small_config(steps=2), folder)
    checkpoint = (folder / "checkpoint.pt").read_bytes()
    (tmp_path / "folder.pt").mkdir()
    for place in (folder / "checkpoint.pt", tmp_path / "folder.pt"):
        with pytest.raises(ConfigError, match=f"{place.name}: it exists and is not the file of a"):
            save_policy(folder, place)
    assert (folder / "checkpoint.pt").read_bytes() == checkpoint
    save_policy(folder, file)
    save_policy(folder, file)
    load_policy(file)


@pytest.mark.parametrize("private", [True, False])
def test_paths_of_a_user_stay_out_of_the_file(tmp_path, small_config, private):
    folder, file = tmp_path / "run", tmp_path / "policy.pt"
    config = small_config(steps=2, logging={"private": private})
    trained(config, folder)
    demonstrations = "/somewhere/secret/demos.hdf5"
    config = replace(config, demos=replace(config.demos, file=demonstrations))
    save_config(config, folder / "config.yaml")
    state = torch.load(folder / "checkpoint.pt", weights_only=True)
    state["config"]["demos.file"] = demonstrations
    torch.save(state, folder / "checkpoint.pt")
    save_policy(folder, file)
    loaded, _ = load_policy(file)
    assert (loaded.demos.file == demonstrations) is not private
    assert (b"/somewhere/secret" in file.read_bytes()) is not private


def test_files_that_do_not_hold_together_are_refused(tmp_path, small_config):
    folder, file = tmp_path / "run", tmp_path / "policy.pt"
    trained(small_config(steps=2), folder)
    save_policy(folder, file)
    state = torch.load(file, weights_only=True)
    torch.save(state | {"run": state["run"] | {"group": "D4"}}, file)
    with pytest.raises(CheckpointError, match="policy.pt is not of its own configuration: .*size"):
        load_policy(file)
    torch.save(state | {"run": state["run"] | {"grup": "D4"}}, file)
    with pytest.raises(ConfigError, match="policy.pt: grup: there is no such key; did you mean"):
        load_policy(file)
    torch.save(state | {"format": 0}, file)
    with pytest.raises(CheckpointError, match="of format 'policy 1'; it has 0"):
        load_policy(file)
    for name, part in {"run": None, "policy": [1]}.items():
        torch.save(state | {name: part}, file)
        with pytest.raises(CheckpointError, match=f"policy.pt: '{name}' must be a dictionary"):
            load_policy(file)
    torch.save([1], file)
    with pytest.raises(CheckpointError, match="it holds a list, expected a dictionary"):
        load_policy(file)


def test_no_run_goes_on_from_the_file_of_a_policy(tmp_path, small_config):
    config, folder = small_config(steps=2), tmp_path / "run"
    trained(config, folder)
    save_policy(folder, tmp_path / "policy.pt")
    (tmp_path / "policy.pt").replace(folder / "checkpoint.pt")
    told = "checkpoint.pt is not a checkpoint of format 5; it has 'policy 1'"
    training = TrainingRun(replace(config, steps=4), folder)
    with closing(training), pytest.raises(CheckpointError, match=told):
        training.restore()
    with pytest.raises(CheckpointError, match=told):
        load_policy(folder)
    for name in ("test.csv", "report.md"):
        (folder / name).touch()
    with pytest.raises(CheckpointError, match=told):
        is_finished(folder, config)
