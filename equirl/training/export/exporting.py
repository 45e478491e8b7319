"""Exports the policy of a run, measures what the file does, and refuses a file that differs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from equirl.config import Config
from equirl.training.equivariance import replay_observations
from equirl.training.export.certificate import describe_policy, image_of, measure
from equirl.training.export.formats import (
    OUTPUTS,
    ExportError,
    Format,
    Outputs,
    Policy,
    format_of,
    load_exported,
    missing_packages,
    read_certificate,
    trace,
)
from equirl.training.export.frozen import FrozenPolicy
from equirl.training.export.measures import (
    Observations,
    allowed,
    answers,
    batch_sizes,
    differences,
    make_observations,
    tolerances,
)
from equirl.training.learner import load_learner

__all__ = ["as_function", "check_exported", "export_actor", "export_policy"]


def export_policy(
    folder: str | Path, path: str | Path, *, observations: int = 64
) -> dict[str, Any]:
    """Writes the policy of a run to a file of its own.

    Args:
        folder: The run's folder.
        path: The file; its name ends in ``.pt2`` (``torch.export``) or ``.onnx``.
        observations: How many observations to measure on; half are from the run's replay buffer.

    Returns:
        The certificate, see `read_certificate`.

    Raises:
        ConfigError: The folder is not that of a run.
        CheckpointError: It holds no readable checkpoint.
        ExportError: The name ends otherwise, a package is missing, the file cannot be written, or
            it does not do what the policy does.
    """
    _check_writable(Path(path))
    config, state, learner = load_learner(folder, "cpu", "auto")
    return export_actor(
        config,
        learner.policy,
        path,
        steps=state["step"],
        stored=_stored(config, state, observations // 2),
        observations=observations,
    )


def export_actor(
    config: Config,
    actor: ProbabilisticActor,
    path: str | Path,
    *,
    steps: int = 0,
    stored: Observations | None = None,
    observations: int = 64,
) -> dict[str, Any]:
    """Writes a policy to a file, which is there only if it does what the policy does.

    Args:
        config: Of the policy's run.
        actor: The policy, on the CPU.
        path: As for `export_policy`.
        steps: Training steps it has behind it.
        stored: Observations of the task to measure on; the rest is drawn.
        observations: How many observations to measure on.

    Returns:
        The certificate, see `read_certificate`.

    Raises:
        ExportError: As for `export_policy`.
    """
    path = Path(path)
    _check_writable(path)
    format = format_of(path)
    image = image_of(config)
    seen = make_observations(observations, image.size, image.max_depth, stored)
    converted = format.convert(trace(FrozenPolicy(actor), image.size))
    original = _Original(actor, seen)
    partial = _partial(path)
    try:
        _save(format, converted, partial, {})
        exported = load_exported(partial)
        compared = original.compare(exported, f"{path} is not written")
        about = describe_policy(config, actor, steps)
        found = measure(exported, seen, original.tolerance, about["group"], about["mode"])
        _save(format, converted, partial, about | compared | found)
        # The file with the certificate is another one than was measured.
        original.compare(load_exported(partial), f"{path} is not written")
        certificate = read_certificate(partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return certificate


def check_exported(
    path: str | Path, folder: str | Path | None = None, *, observations: int = 64
) -> dict[str, Any]:
    """Measures an exported policy again.

    Args:
        path: The file.
        folder: The folder of its run, to compare it with the policy there; else only its symmetry
            is measured.
        observations: How many observations to measure on.

    Returns:
        The certificate, with the new measurements in place of the old.

    Raises:
        ConfigError: The folder is not that of a run.
        CheckpointError: It holds no readable checkpoint.
        ExportError: The file is not an exported policy, is not what its certificate says, or does
            not do what the run's policy does.
    """
    about, exported = read_certificate(path), load_exported(path)
    image, stored = about["image"], None
    if folder is not None:
        config, state, learner = load_learner(folder, "cpu", "auto")
        if config.observed_size != image["pixels"]:
            raise ExportError(
                f"{path} takes images of {image['pixels']} pixels a side, the policy of {folder} "
                f"images of {config.observed_size}"
            )
        stored = _stored(config, state, observations // 2)
    seen = make_observations(observations, image["pixels"], image["max_depth_m"], stored)
    again = measure(exported, seen, about["tolerance"], about["group"], about["mode"])
    for rule, found in again["symmetry"].items():
        claimed = about["symmetry"].get(rule, {}).get("exact_on_grid", {})
        for name in OUTPUTS:
            if claimed.get(name) and not found["exact_on_grid"][name]:
                worst = max(row[name]["largest"] for row in found["errors"] if row["on_grid"])
                raise ExportError(
                    f"{path} is not what its certificate says: {name} is said to turn exactly "
                    f"({rule}) and errs by {worst:.1e}"
                )
    compared: dict[str, Any] = {}
    if folder is not None:
        original = _Original(learner.policy, seen)
        compared = original.compare(exported, f"{path} is not the policy of {folder}")
    old = {key: about[key] for key in about if key not in ("batches", "rounding", "difference")}
    return old | compared | again


def as_function(actor: ProbabilisticActor) -> Policy:
    """An actor on the CPU, acting greedily, as a function of arrays."""

    def policy(depth: np.ndarray, holding: np.ndarray) -> Outputs:
        values = {"depth": torch.from_numpy(depth), "holding": torch.from_numpy(holding)}
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            out = actor(TensorDict(values, batch_size=[len(depth)]))
        return {name: out[name].numpy() for name in OUTPUTS}

    return policy


class _Original:
    """What an actor gives for observations, and how closely float32 can be asked to agree.

    Args:
        actor: On the CPU.
        seen: The observations.

    Attributes:
        tolerance: Up to which error each output is said to turn exactly.
    """

    def __init__(self, actor: ProbabilisticActor, seen: Observations):
        self._seen, self._outputs = seen, answers(as_function(actor), seen)
        single, double = (answers(_plain(actor, t), seen) for t in (torch.float32, torch.float64))
        self._rounding = differences(single, double)
        self._bounds = allowed(self._rounding, self._outputs)
        self.tolerance = tolerances(self._bounds, self._outputs)

    def compare(self, exported: Policy, refusal: str) -> dict[str, Any]:
        """How far the dense filters are from float64, and the file from the actor.

        Raises:
            ExportError: The file differs by more than float32 explains.
        """
        found = differences(answers(exported, self._seen), self._outputs)
        for name, bound in self._bounds.items():
            for kind, error, most in zip(bound._fields, found[name], bound, strict=True):
                if not error <= most:  # which is so for NaN, too
                    raise ExportError(
                        f"{refusal}: its {name} differs by {error:.2g} ({kind} of "
                        f"{len(self._seen.depth)} observations), and rounding explains {most:.2g}"
                    )
        both = {"rounding": self._rounding, "difference": found}
        largest = {key: {name: e.largest for name, e in x.items()} for key, x in both.items()}
        return {"batches": sorted(set(batch_sizes(len(self._seen.depth)))), **largest}


def _plain(actor: ProbabilisticActor, dtype: torch.dtype) -> Policy:
    policy = FrozenPolicy(actor, dtype)

    def function(depth: np.ndarray, holding: np.ndarray) -> Outputs:
        out = policy(*(torch.from_numpy(array).to(dtype) for array in (depth, holding)))
        return {name: value.numpy() for name, value in zip(OUTPUTS, out, strict=True)}

    return function


def _save(format: Format, converted: Any, path: Path, certificate: dict[str, Any]) -> None:
    try:
        format.save(converted, path, json.dumps(certificate, indent=1))
    except (OSError, RuntimeError) as error:  # torch's own, when the disk is full
        raise ExportError(f"cannot write {path}: {error}") from error


def _check_writable(path: Path) -> None:
    """Refuses a file that cannot be written before anything takes time."""
    missing = missing_packages(format_of(path))
    if missing:
        raise ExportError(
            f"{path} needs packages that are not installed ({', '.join(missing)}); "
            "they come with pip install 'equirl[export]'"
        )
    partial = _partial(path)
    try:
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.touch()
        partial.unlink()
    except OSError as error:
        raise ExportError(f"cannot write {path}: {error}") from error


def _partial(path: Path) -> Path:
    return path.with_name(f"{path.stem}.partial{path.suffix}")


def _stored(config: Config, state: dict[str, Any], count: int) -> Observations | None:
    """So many observations of the replay buffer in a run's checkpoint, if there are any."""
    buffer = state["buffer"]
    if not buffer["size"] or not count:
        return None
    rows = TensorDict(buffer["rows"], batch_size=[buffer["size"]])
    seen = replay_observations(rows, image_of(config).max_depth, count)
    return Observations(seen["depth"].numpy(), seen["holding"].numpy())
