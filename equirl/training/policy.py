"""Trained policies: in the folder of their run, or in a small file of their own."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from torchrl.modules import ProbabilisticActor

from equirl.config import Config, ConfigError, to_config
from equirl.training.checkpoint import CheckpointError, read_state, write_state
from equirl.training.folder import load_run_config
from equirl.training.learner import load_learner
from equirl.training.networks import make_networks
from equirl.training.privacy import private_value

__all__ = ["POLICY_SUFFIX", "load_policy", "save_policy"]

#: Of the names of policies' files.
POLICY_SUFFIX = ".pt"

_FORMAT = "policy 1"


def save_policy(folder: str | Path, path: str | Path) -> None:
    """Writes the trained policy of a run to a file for `load_policy`.

    It holds the policy's parameters and the run's configuration, 0.3 MB for the laptop preset:
    neither critic nor optimiser nor replay buffer, so that no run can go on from it. The path of
    the demonstrations is shortened unless the run has ``logging.private=false``.

    Args:
        folder: The run's folder.
        path: The file; a name in ``.pt``. The file of another policy is replaced.

    Raises:
        ConfigError: The folder is not that of a run, or the file has another name or is there
            and no policy's.
        CheckpointError: The folder holds no readable checkpoint, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix != POLICY_SUFFIX:
        raise ConfigError(f"{path}: expected a name in {POLICY_SUFFIX}")
    if path.exists() and not _is_policy(path):
        raise ConfigError(f"{path}: it exists and is not the file of a policy; choose another name")
    _, state, learner = load_learner(folder, "cpu", "auto")
    policy = learner.policy.state_dict()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CheckpointError(f"cannot write {path}: {error}") from None
    config = load_run_config(Path(folder))
    run = asdict(config)
    if config.logging.private:
        run["demos"] = private_value(run["demos"])
    write_state({"format": _FORMAT, "run": run, "step": state["step"], "policy": policy}, path)


def load_policy(
    place: str | Path, device: str | None = None, backend: str | None = None
) -> tuple[Config, ProbabilisticActor]:
    """The trained policy of a run, with the run's configuration.

    It draws actions unless called under ``set_exploration_type(ExplorationType.DETERMINISTIC)``.
    No code is read from a file; a task or a method that is defined elsewhere is imported by its
    name in the configuration, ``"package.module:NAME"``.

    Args:
        place: The run's folder, or a file that `save_policy` wrote.
        device: Where to put the policy. When None: of a folder, where it was trained; of a file,
            ``"auto"``. The returned configuration has it.
        backend: What an equivariant encoder runs on; likewise.

    Returns:
        Configuration and actor; the latter reads ``depth`` (*batch, 1, S, S) and ``holding``
        (*batch, 1) and writes ``action`` (*batch, 5).

    Raises:
        ConfigError: There is nothing, the folder is not that of a run, the configuration is not
            valid, or the device or backend is not there.
        CheckpointError: It holds no readable checkpoint of that configuration, or the file is
            none of a policy.
    """
    place = Path(place)
    if not place.exists():
        raise ConfigError(
            f"{place} not found; expected the folder of a run or the file of a policy"
        )
    if not place.is_file():
        config, _, learner = load_learner(place, device, backend)
        return config, learner.policy
    run, policy = _read(place)
    config = replace(_as_config(run, place), device=device or "auto", backend=backend or "auto")
    actor, _ = make_networks(config)
    try:
        actor.load_state_dict(policy)
    except RuntimeError as error:  # torch's, of other names or shapes
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(f"{place} is not of its own configuration: {reason}") from None
    return config, actor


def _is_policy(path: Path) -> bool:
    try:
        return read_state(path).get("format") == _FORMAT
    except CheckpointError:
        return False


def _read(place: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Configuration and parameters in a file.

    Raises:
        CheckpointError: It is none of a policy.
    """
    try:
        state = read_state(place)
    except CheckpointError as error:
        raise CheckpointError(f"{error}; expected the file of a policy") from None
    found = state.get("format", "none")
    if found != _FORMAT:
        hint = "; expected the run's folder" if isinstance(found, int) else ""
        raise CheckpointError(
            f"{place} is not the file of a policy, of format {_FORMAT!r}; it has {found!r}{hint}"
        )
    for name in ("run", "policy"):
        if not isinstance(state.get(name), dict):
            got = type(state.get(name)).__name__
            raise CheckpointError(f"{place}: {name!r} must be a dictionary, got {got}")
    return state["run"], state["policy"]


def _as_config(values: dict[str, Any], place: Path) -> Config:
    try:
        return to_config(values)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from None
