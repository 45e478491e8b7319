"""The replay buffer: TorchRL's, over storage that keeps transitions compact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler, Sampler
from torchrl.envs import Compose, Transform

from equirl.data.priorities import Priorities
from equirl.data.protection import ProtectingWriter
from equirl.data.rotations import RotationAugmentation
from equirl.data.symmetric import SymmetricSampler
from equirl.data.transforms import QuantizeDepth

__all__ = ["load_replay_state", "make_replay_buffer", "replay_state"]


def make_replay_buffer(
    capacity: int = 100_000,
    *,
    copies: int = 4,
    batch_size: int = 64,
    max_depth: float = 0.32,
    device: torch.device | str = "cpu",
    generator: torch.Generator | None = None,
    quarter_turns: bool = False,
    augmentations: Sequence[Transform] = (),
    priorities: Priorities | None = None,
    symmetric: bool = False,
) -> TensorDictReplayBuffer:
    """A replay buffer with rotational buffer augmentation (paper, appendices D and F).

    Once `protect_demonstrations` was called, what it held then is never overwritten.

    Args:
        capacity: Transitions held, augmented copies counted.
        copies: Rotated copies of each transition; 0 switches the augmentation off.
        batch_size: Transitions a call of ``sample()`` returns.
        max_depth: Largest depth observed, in m; it sets the storage's resolution.
        device: Where sampled batches live; the storage stays in main memory.
        generator: Source of all of the buffer's randomness (which rows, which copies,
            which angles), a CPU generator; torch's global one when None.
        quarter_turns: Whether the copies are turned by multiples of 90 degrees only.
        augmentations: Transforms of a sampled batch, in order, after the rotated copies: a
            `RandomRotation`, then a `RandomCrop`, for example.
        priorities: How to prioritise transitions; all alike when None. The caller updates them.
        symmetric: Whether half of each batch comes from the protected demonstrations.

    Returns:
        A buffer to ``extend`` with tensordicts of the keys in
        `TRANSITION_KEYS`; always ``extend``, since ``add`` bypasses
        transforms.

    Raises:
        ValueError: A number is out of range, the capacity cannot hold one transition with
            its copies, or sampling is to be both symmetric and prioritised.
    """
    if symmetric and priorities is not None:
        raise ValueError(
            f"symmetric=True and priorities={priorities}: expected one way to choose rows"
        )
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
    writer = ProtectingWriter()
    sampler: Sampler = SymmetricSampler(writer) if symmetric else RandomSampler()
    if priorities is not None:
        sampler = priorities.sampler(rows)
    copied = RotationAugmentation(copies, generator=generator, quarter_turns=quarter_turns)
    # Insertion runs the transforms backwards: draw angles, then quantise.
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(rows),
        sampler=sampler,
        writer=writer,
        transform=Compose(QuantizeDepth(max_depth), copied, *augmentations),
        batch_size=batch_size,
        # Without one the prioritised sampler would draw from numpy's.
        generator=torch.default_generator if generator is None else generator,
    )
    if torch.device(device).type != "cpu":
        buffer.append_transform(lambda batch: batch.to(device))
    return buffer


def replay_state(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """What a checkpoint keeps of a buffer: the filled rows as stored, writer and sampler.

    A copy, of plain tensors and numbers. TorchRL's own state dict holds the whole capacity,
    filled or not.
    """
    # A clone: a slice would drag the whole storage into the file.
    rows = buffer.storage[: len(buffer)].clone().to_dict() if len(buffer) else {}
    return {
        "rows": rows,
        "size": len(buffer),
        "writer": buffer.writer.state_dict(),
        "sampler": buffer.sampler.state_dict(),
    }


def load_replay_state(buffer: TensorDictReplayBuffer, state: dict[str, Any]) -> None:
    """Fills an empty buffer, made with the same arguments, with what `replay_state` kept.

    It then samples the same, given a generator in the same state.
    """
    if state["size"]:
        rows = TensorDict(state["rows"], batch_size=[state["size"]])
        buffer.storage.set(torch.arange(state["size"]), rows)
    buffer.writer.load_state_dict(state["writer"])
    buffer.sampler.load_state_dict(state["sampler"])
