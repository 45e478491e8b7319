"""The replay buffer: TorchRL's, over storage that keeps transitions compact."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.envs import Compose

from equirl.data.transforms import QuantizeDepth, RotationAugmentation

__all__ = ["load_replay_state", "make_replay_buffer", "replay_state"]


def make_replay_buffer(
    capacity: int = 100_000,
    *,
    copies: int = 4,
    batch_size: int = 64,
    max_depth: float = 0.32,
    device: torch.device | str = "cpu",
    generator: torch.Generator | None = None,
) -> TensorDictReplayBuffer:
    """A replay buffer with rotational buffer augmentation (paper, appendices D and F).

    Args:
        capacity: Transitions held, augmented copies counted.
        copies: Rotated copies of each transition; 0 switches the augmentation off.
        batch_size: Transitions a call of ``sample()`` returns.
        max_depth: Largest depth observed, in m; it sets the storage's resolution.
        device: Where sampled batches live; the storage stays in main memory.
        generator: Source of all of the buffer's randomness (which rows, which copies,
            which angles), a CPU generator.

    Returns:
        A buffer to ``extend`` with tensordicts of the keys in
        `TRANSITION_KEYS`; always ``extend``, since ``add`` bypasses
        transforms.

    Raises:
        ValueError: A number is out of range, or the capacity cannot hold one transition with
            its copies.
    """
    for name, value, lowest in (
        ("capacity", capacity, 1),
        ("copies", copies, 0),
        ("batch_size", batch_size, 1),
    ):
        if not isinstance(value, int) or value < lowest:
            raise ValueError(f"{name}={value!r}: expected an integer of {lowest} or more")
    rows = capacity // (copies + 1)
    if rows < 1:
        raise ValueError(
            f"replay capacity {capacity} cannot hold one transition with its {copies} copies"
        )
    augmentation = RotationAugmentation(copies, generator=generator)
    # Insertion runs the transforms backwards: draw angles, then quantise.
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(rows),
        sampler=RandomSampler(),
        transform=Compose(QuantizeDepth(max_depth), augmentation),
        batch_size=batch_size,
        generator=generator,
    )
    if torch.device(device).type != "cpu":
        buffer.append_transform(lambda batch: batch.to(device))
    return buffer


def replay_state(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """What a checkpoint keeps of a buffer: the filled rows as stored, and the cursor.

    TorchRL's own state dict holds the whole capacity, filled or not.
    """
    # A copy: a slice would drag the whole storage into the file.
    rows = buffer.storage[: len(buffer)].clone().to_dict() if len(buffer) else {}
    return {"rows": rows, "size": len(buffer), "writer": buffer.writer.state_dict()}


def load_replay_state(buffer: TensorDictReplayBuffer, state: dict[str, Any]) -> None:
    """Fills an empty buffer with what `replay_state` kept."""
    if state["size"]:
        rows = TensorDict(state["rows"], batch_size=[state["size"]])
        buffer.storage.set(torch.arange(state["size"]), rows)
    buffer.writer.load_state_dict(state["writer"])
