"""Symmetric sampling: half demonstrations, half experience, as in RLPD (Ball et al., 2023)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from equirl.data.protection import ProtectingWriter

__all__ = ["SymmetricSampler"]


class SymmetricSampler(Sampler):
    """Half of each batch from the demonstrations, half from what came after them.

    The demonstrations are the protected rows at the buffer's start, the experience all others;
    each half is drawn uniformly, with replacement, by the buffer's generator. An odd batch has
    one row more of experience. While there is no experience yet, the whole batch is
    demonstrations.

    TorchRL's ``OfflineToOnlineReplayBuffer`` does not serve here: its online half takes neither
    a generator nor transforms at insertion, and it has no state dict.

    Args:
        writer: The buffer's writer, which knows how many rows are protected.
    """

    def __init__(self, writer: ProtectingWriter):
        self.writer = writer

    def sample(self, storage: Storage, batch_size: int) -> tuple[torch.Tensor, dict]:
        """Draws rows, demonstrations first.

        Returns:
            Rows of shape (batch_size,), and nothing else to tell of them.

        Raises:
            RuntimeError: No rows are protected.
        """
        demonstrations, filled = self.writer.protected, len(storage)
        if not demonstrations:
            raise RuntimeError(
                f"symmetric sampling of a buffer of {filled} transitions found no demonstrations "
                "among them: expected protect_demonstrations(buffer) after they were stored"
            )
        half = batch_size // 2 if filled > demonstrations else batch_size
        rows = [
            torch.randint(first, end, (count,), generator=self._rng)
            for first, end, count in (
                (0, demonstrations, half),
                (demonstrations, filled, batch_size - half),
            )
            if count
        ]
        return torch.cat(rows), {}

    def state_dict(self) -> dict[str, Any]:
        """Empty: the writer's state says how many rows are protected."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing to restore."""

    def dumps(self, path: str | Path) -> None:
        """Nothing to write."""

    def loads(self, path: str | Path) -> None:
        """Nothing to read."""

    def _empty(self) -> None:
        pass
