"""Demonstrations as files: robomimic's HDF5 layout, written and read with h5py alone."""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from equirl.data.episodes import DatasetError, check_environment, check_episode, check_image_size
from equirl.data.keys import TRANSITION_KEYS

__all__ = ["read_demonstrations", "read_environment", "write_demonstrations"]

#: robomimic numbers the kinds of environments; 2 is Gym, what comes nearest to ours.
_GYM = 2
_VERSION = "equirl_version"  # in env_args: the file is ours and means what it says
_ENDS = ("terminated", "truncated")  # ours, what kind of end `dones` is
_COLUMNS = {"rewards": "reward", "dones": "done", **{name: name for name in _ENDS}}


def write_demonstrations(
    path: str | Path,
    episodes: Sequence[TensorDictBase],
    *,
    environment: Mapping[str, Any] | None = None,
    attributes: Sequence[Mapping[str, int]] = (),
    overwrite: bool = False,
) -> None:
    """Writes episodes as one HDF5 file, whole or not at all; equal episodes make equal bytes.

    The layout is that of robomimic (its documentation, "Dataset Structure"), with ``terminated``
    and ``truncated`` beside ``dones``.

    Args:
        path: The file; its folder is made when missing.
        episodes: Each of shape [T], with the keys of `TRANSITION_KEYS`.
        environment: What the episodes were recorded in: ``task`` and any other words and numbers.
        attributes: Of each episode, integers to keep beside it, as the seed of its scene.
        overwrite: Whether to replace a file that is there.

    Raises:
        DatasetError: There is no episode, one is not of that form or holds numbers that cannot
            be; the file exists, or cannot be written.
    """
    path = Path(path)
    if path.is_dir() or (path.exists() and not overwrite):
        raise DatasetError(f"{path} exists already")
    if not episodes:
        raise DatasetError("there is no episode to write, expected one or more")
    size: int | None = None
    for number, episode in enumerate(episodes):
        check_episode(episode, f"episode {number}")
        size = check_image_size(episode, size, f"episode {number}")
    # In memory first: then all that can fail halfway is the copy of these bytes to the disk.
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(len(episode) for episode in episodes)
        data.attrs["env_args"] = _env_args(dict(environment or {}))
        for number, episode in enumerate(episodes):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = len(episode)
            for name, value in dict(attributes[number] if attributes else {}).items():
                demo.attrs[name] = value
            _write_episode(demo, episode)
    _replace(path, image.getbuffer())


def read_demonstrations(
    path: str | Path,
    *,
    episodes: int | None = None,
    environment: Mapping[str, Any] | None = None,
    filter: str = "",
    failed: bool = False,
) -> list[TensorDict]:
    """Reads episodes that `write_demonstrations` or others wrote, without executing code.

    Files of others need ``actions``, ``rewards``, ``dones``, ``obs/depth`` and ``obs/holding``. An
    episode ends with its first ``dones`` there; ``next_obs`` may be left out when ``obs`` goes one
    row further.

    Args:
        path: The file.
        episodes: How many are wanted, in the order of their numbers; all when None.
        environment: What they must have been recorded in. ``image_size`` is compared with the
            pictures, the other keys with what a file of ours says about itself.
        filter: Name of a list of episodes in the file's ``mask`` group; all when empty.
        failed: Whether to return episodes without success, too: whose last reward is not positive.

    Returns:
        Episodes of shape [T] with the keys of `TRANSITION_KEYS`, ``expert`` True: of our own
        files, bit for bit what was written.

    Raises:
        DatasetError: There is no such file, it is damaged or not of this layout, holds another
            task or other images, or fewer episodes than wanted.
    """
    wanted = dict(environment or {})
    size = wanted.pop("image_size", None)
    found: list[TensorDict] = []
    failures = 0
    with _opened(Path(path)) as file:
        data = _group(file, "data")
        check_environment(_environment(data), wanted)
        for name in _names(file, data, filter):
            if len(found) == episodes:
                break
            episode = _read_episode(_group(data, name), name)
            check_episode(episode, name)
            size = check_image_size(episode, size, name)
            if failed or episode["next", "reward"][-1] > 0:
                found.append(episode)
            else:
                failures += 1
        if len(found) < (episodes or 1):
            without = f" and {failures} without success" if failures else ""
            raise DatasetError(
                f"holds {len(found)} successful demonstrations{without}, expected {episodes or 1}"
            )
    return found


def read_environment(path: str | Path) -> dict[str, Any]:
    """What a file of ours says about where it was recorded; nothing of a file of others.

    Returns:
        ``task`` and what else `write_demonstrations` was given.

    Raises:
        DatasetError: As for `read_demonstrations`.
    """
    with _opened(Path(path)) as file:
        return _environment(_group(file, "data"))


def _env_args(environment: dict[str, Any]) -> str:
    task = environment.pop("task", None)
    about = {"env_name": task, "type": _GYM, "env_kwargs": environment, _VERSION: version("equirl")}
    return json.dumps(about, indent=4, default=str)


def _write_episode(demo: h5py.Group, episode: TensorDictBase) -> None:
    summed = {"fletcher32": True}  # shows later damage, as gzip does of itself
    demo.create_dataset("actions", data=episode["action"].numpy(force=True), **summed)
    for name, key in _COLUMNS.items():
        values = episode["next", key][:, 0].numpy(force=True)
        # Flags as robomimic has them: HDF5 knows no booleans.
        values = values.astype(np.uint8) if values.dtype == bool else values
        demo.create_dataset(name, data=values, **summed)
    for group, seen in (("obs", episode), ("next_obs", episode["next"])):
        images = seen["depth"].movedim(1, -1).numpy(force=True)
        packed = {"chunks": (1, *images.shape[1:]), "compression": "gzip", "shuffle": True}
        demo.create_dataset(f"{group}/depth", data=images, **packed)
        demo.create_dataset(f"{group}/holding", data=seen["holding"].numpy(force=True), **summed)


def _replace(path: Path, content: memoryview) -> None:
    """Puts a file in place once all of it is on the disk."""
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(partial, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise DatasetError(f"cannot write {path}: {error}") from error


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """Opens a file to read; what is wrong with it becomes a sentence that begins with its name."""
    if not path.exists():
        raise DatasetError(f"{path}: no such file")
    if path.is_dir():
        raise DatasetError(f"{path} is a folder, expected a file of demonstrations")
    try:
        if not os.access(path, os.R_OK):
            raise DatasetError("may not be read")
        if not h5py.is_hdf5(path):
            raise DatasetError("not an HDF5 file, expected demonstrations in robomimic's layout")
        with h5py.File(path, "r") as file:
            yield file
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from None
    except (OSError, RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
        # h5py raises many kinds for damaged files and for parts that are of another kind.
        raise DatasetError(f"{path} is not readable: {error}") from error


def _group(parent: h5py.Group, name: str) -> h5py.Group:
    found = parent.get(name)
    if not isinstance(found, h5py.Group):
        where = f"{parent.name}/{name}".replace("//", "/")
        raise DatasetError(f"not robomimic's layout: there is no group {where}")
    return found


def _environment(data: h5py.Group) -> dict[str, Any]:
    text = data.attrs.get("env_args", "{}")
    try:
        known = json.loads(text)
    except (TypeError, ValueError):
        raise DatasetError(f"not robomimic's layout: env_args is not JSON, got {text!r}") from None
    if not isinstance(known, dict) or _VERSION not in known:
        return {}  # words of others mean other things
    stated = {"task": known["env_name"], **known["env_kwargs"]}
    return {key: value for key, value in stated.items() if value is not None}


def _names(file: h5py.File, data: h5py.Group, filter: str) -> list[str]:
    """The names of the episodes, in the order of their numbers."""
    numbers = {name: re.fullmatch(r"demo_(\d+)", name) for name in data}
    known = {name: int(match[1]) for name, match in numbers.items() if match}
    if not known:
        raise DatasetError("not robomimic's layout: there is no group /data/demo_0")
    names = list(known)
    if filter:
        masks = file.get("mask", {})
        if filter not in masks:
            raise DatasetError(f"no filter {filter!r}, expected one of {sorted(masks)}")
        names = [name.decode() for name in masks[filter][()].astype("S").tolist()]
        lost = sorted(set(names) - set(known))
        if lost:
            raise DatasetError(f"the filter {filter!r} names {lost[0]}, which is not there")
    return sorted(names, key=known.__getitem__)


def _read_episode(demo: h5py.Group, name: str) -> TensorDict:
    action = _actions(demo, name)
    reward = _column(demo, "rewards", name, len(action))
    ends = _ends(demo, name, reward)
    steps = len(ends["done"])
    seen, after = _observations(demo, name, steps)
    values = {
        **seen,
        "action": action.astype(np.float32),
        "expert": np.ones((steps, 1), bool),
        **{("next", key): rows for key, rows in after.items()},
        ("next", "reward"): reward.astype(np.float32),
        **{("next", key): flags for key, flags in ends.items()},
    }
    episode = TensorDict(batch_size=[steps])
    for key in TRANSITION_KEYS:
        episode.set(key, torch.from_numpy(values[key][:steps].copy()))
    return episode


def _actions(demo: h5py.Group, name: str) -> np.ndarray:
    action = _numbers(demo, "actions", name)
    if action.ndim != 2 or not len(action) or action.shape[1] != 5:
        expected = "(steps, 5): gripper, x, y, z, theta"
        raise DatasetError(f"{name}/actions has shape {action.shape}, expected {expected}")
    stated = demo.attrs.get("num_samples", len(action))
    if stated != len(action):
        raise DatasetError(f"{name} has num_samples={stated}, but {len(action)} actions")
    return action


def _ends(demo: h5py.Group, name: str, reward: np.ndarray) -> dict[str, np.ndarray]:
    """The flags of an episode, (T, 1) each: those stored, or what ``dones`` and rewards tell.

    Others go on recording for a while after the task is done; the episode ends where it is.
    """
    done = _column(demo, "dones", name, len(reward)) != 0
    if any(key in demo for key in _ENDS):
        return {"done": done} | {key: _column(demo, key, name, len(reward)) != 0 for key in _ENDS}
    reward = reward[: int(done.argmax()) + 1] if done.any() else reward
    early = np.flatnonzero(reward[:-1] > 0)
    if len(early):
        raise DatasetError(
            f"{name} goes on after the reward of its step {early[0] + 1}, but success ends an "
            "episode: expected dones to mark it"
        )
    last = np.zeros(reward.shape, bool)
    last[-1] = True
    return {"done": last, "terminated": last & (reward > 0), "truncated": last & (reward <= 0)}


def _observations(
    demo: h5py.Group, name: str, steps: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What was seen before and after each step: images (T, 1, S, S) and flags (T, 1)."""
    seen = {key: _observation(demo, f"obs/{key}", name, steps) for key in ("depth", "holding")}
    if "next_obs" in demo:
        return seen, {key: _observation(demo, f"next_obs/{key}", name, steps) for key in seen}
    for key, rows in seen.items():
        if len(rows) == steps:
            raise DatasetError(
                f"{name} has no next_obs, and obs/{key} ends before what the last action led to: "
                f"expected next_obs, or {steps + 1} rows of obs"
            )
    return seen, {key: rows[1:] for key, rows in seen.items()}


def _observation(demo: h5py.Group, key: str, name: str, steps: int) -> np.ndarray:
    """Images (N, 1, S, S), or flags (N, 1), float32; N is ``steps`` or more."""
    values = _numbers(demo, key, name)
    images = key.endswith("depth")
    if values.ndim == (4 if images else 2) and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != (3 if images else 1) or len(values) < steps:
        expected = f"({steps}, size, size, 1)" if images else f"({steps}, 1)"
        raise DatasetError(f"{name}/{key} has shape {values.shape}, expected {expected}")
    if images and values.dtype.kind != "f":
        raise DatasetError(f"{name}/{key} holds {values.dtype}, expected floats, metres")
    return values.astype(np.float32)[:, None]


def _column(demo: h5py.Group, key: str, name: str, steps: int) -> np.ndarray:
    values = _numbers(demo, key, name)
    if values.shape not in ((steps,), (steps, 1)):
        raise DatasetError(f"{name}/{key} has shape {values.shape}, expected ({steps},)")
    return values.reshape(steps, 1)


def _numbers(demo: h5py.Group, key: str, name: str) -> np.ndarray:
    found = demo.get(key)
    if not isinstance(found, h5py.Dataset):
        raise DatasetError(f"not robomimic's layout: there is no dataset {name}/{key}")
    if found.dtype.kind not in "fiub":
        raise DatasetError(f"{name}/{key} holds {found.dtype}, expected numbers")
    return found[()]
