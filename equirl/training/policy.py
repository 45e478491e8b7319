"""Trained policies: in the folder of their run, or in a small file of their own."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from torchrl.modules import ProbabilisticActor

from equirl.config import Config, ConfigError, to_config
from equirl.training.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from equirl.training.folder import load_run_config
from equirl.training.learner import load_learner
from equirl.training.networks import make_networks

__all__ = ["POLICY_SUFFIX", "load_policy", "save_policy"]

#: Of the names of policies' files.
POLICY_SUFFIX = ".pt"


def save_policy(folder: str | Path, path: str | Path) -> None:
    """Writes the trained policy of a run to a file for `load_policy`.

    It holds the policy's parameters and the run's configuration, less than a hundredth of a
    checkpoint: neither critic nor optimiser nor replay buffer, so that no run can go on from it.

    Args:
        folder: The run's folder.
        path: The file; a name in ``.pt``.

    Raises:
        ConfigError: The folder is not that of a run, or the file has another name.
        CheckpointError: It holds no readable checkpoint, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix != POLICY_SUFFIX:
        raise ConfigError(f"{path}: expected a name in {POLICY_SUFFIX}")
    _, state, learner = load_learner(folder, "cpu", "auto")
    policy = learner.policy.state_dict()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CheckpointError(f"cannot write {path}: {error}") from None
    config = asdict(load_run_config(Path(folder)))
    save_checkpoint({"run": config, "step": state["step"], "policy": policy}, path)


def load_policy(
    place: str | Path, device: str | None = None, backend: str | None = None
) -> tuple[Config, ProbabilisticActor]:
    """The trained policy of a run, with the run's configuration.

    Args:
        place: The run's folder, or a file that `save_policy` wrote.
        device: Where to put the policy; as the run's configuration has it when None.
        backend: What an equivariant encoder runs on; likewise.

    Raises:
        ConfigError: The folder is not that of a run, or the device or backend is not there.
        CheckpointError: It holds no readable checkpoint of that configuration, or the file is
            none of a policy.
    """
    place = Path(place)
    if not place.is_file():
        config, _, learner = load_learner(place, device, backend)
        return config, learner.policy
    state = load_checkpoint(place)
    if "policy" not in state:
        raise CheckpointError(f"{place} is not the file of a policy; expected the run's folder")
    config = _read_config(state["run"], place)
    config = replace(config, device=device or config.device, backend=backend or config.backend)
    actor, _ = make_networks(config)
    try:
        actor.load_state_dict(state["policy"])
    except RuntimeError as error:  # torch's, of other names or shapes
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(f"{place} is not of its own configuration: {reason}") from None
    return config, actor


def _read_config(values: dict[str, Any], place: Path) -> Config:
    try:
        return to_config(values)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from None
