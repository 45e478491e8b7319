"""Trained policies, from the folder of their run and from a file of their own."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from equirl.config import ConfigError, save_config
from equirl.training import CheckpointError, TrainingRun, load_policy, save_policy
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
    config = small_config(steps=6, **changes)
    expected = act(trained(config, tmp_path / "run"))
    file = tmp_path / "new" / "policy.pt"
    save_policy(tmp_path / "run", file)
    for place in (str(tmp_path / "run"), file, str(file)):
        loaded_config, policy = load_policy(place)
        assert loaded_config == config
        for name, value in act(policy).items():
            assert torch.equal(value, expected[name])
    assert set(torch.load(file, weights_only=True)) == {"format", "run", "step", "policy"}


def test_a_file_is_loaded_where_it_is_asked(tmp_path, small_config):
    trained(small_config(steps=2), tmp_path / "run")
    save_policy(tmp_path / "run", tmp_path / "policy.pt")
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
    with pytest.raises(CheckpointError, match="not the file of a policy; expected the run's"):
        load_policy(folder / "checkpoint.pt")
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_policy(folder / "config.yaml")
    with pytest.raises(ConfigError, match="none.pt"):
        load_policy(tmp_path / "none.pt")


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
    with pytest.raises(CheckpointError, match="not a checkpoint of format"):
        load_policy(file)


def test_no_run_goes_on_from_the_file_of_a_policy(tmp_path, small_config):
    config = small_config(steps=2)
    trained(config, tmp_path / "run")
    save_policy(tmp_path / "run", tmp_path / "policy.pt")
    (tmp_path / "policy.pt").replace(tmp_path / "run" / "checkpoint.pt")
    training = TrainingRun(replace(config, steps=4), tmp_path / "run")
    with closing(training), pytest.raises(CheckpointError, match="lacks 'config'"):
        training.restore()
