"""Demonstrations are never overwritten: a writer that goes round the other rows only."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.writers import TensorDictRoundRobinWriter

__all__ = ["ProtectingWriter", "protect_demonstrations"]


class ProtectingWriter(TensorDictRoundRobinWriter):
    """Round robin over all rows but the first few, which stay as they are once protected.

    Attributes:
        protected: Number of protected rows.
    """

    _FILE = "protected.json"
    _cursor: int  # the row to write next

    def __init__(self) -> None:
        super().__init__()
        self.protected = 0

    def protect(self, rows: int) -> None:
        """Protects the first rows, which must have been written.

        Args:
            rows: How many; it replaces the number protected before.

        Raises:
            ValueError: More than are filled, or so many that a full buffer could take nothing
                more.
        """
        filled, capacity = len(self._storage), self._storage.max_size
        if not 0 <= rows <= filled:
            raise ValueError(f"cannot protect {rows} rows: expected 0 to {filled}, those filled")
        if rows == capacity:
            raise ValueError(
                f"cannot protect {rows} transitions in a buffer of {capacity}: no row would be "
                "left for others; expected a larger capacity or fewer demonstrations"
            )
        self.protected = rows
        self._pass_protected()

    def add(self, data: Any) -> int | torch.Tensor:
        """Writes one row."""
        index = super().add(data)
        self._pass_protected()
        return index

    def extend(self, data: TensorDictBase) -> torch.Tensor:
        """Writes a batch of rows and returns where, (rows,).

        Raises:
            ValueError: It has more rows than the buffer may overwrite.
        """
        capacity = self._storage.max_size
        if len(data) > capacity - self.protected:
            raise ValueError(
                f"cannot store {len(data)} transitions at once: of {capacity} rows "
                f"{self.protected} are protected, expected {capacity - self.protected} or fewer"
            )
        until_end = capacity - self._cursor
        index = []
        for part in (data[:until_end], data[until_end:]):
            if len(part):
                index.append(super().extend(part))
                self._pass_protected()
        return torch.cat(index)

    def _pass_protected(self) -> None:
        """Moves a cursor that has passed the end on to the first row not protected."""
        self._cursor = max(self._cursor, self.protected)

    def state_dict(self) -> dict[str, Any]:
        """The cursor and the number of protected rows."""
        return {**super().state_dict(), "_protected": self.protected}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        super().load_state_dict(state_dict)
        self.protected = state_dict["_protected"]

    def dumps(self, path: str | Path) -> None:
        """Writes the state to a folder, for the buffer's own ``dumps``."""
        super().dumps(path)
        (Path(path) / self._FILE).write_text(json.dumps(self.protected))

    def loads(self, path: str | Path) -> None:
        """Reads what `dumps` wrote."""
        super().loads(path)
        self.protected = json.loads((Path(path) / self._FILE).read_text())

    def _empty(self, empty_write_count: bool = True) -> None:
        super()._empty(empty_write_count)
        self.protected = 0


def protect_demonstrations(buffer: TensorDictReplayBuffer) -> None:
    """Protects all that a buffer of `make_replay_buffer` holds so far from being overwritten.

    Raises:
        ValueError: The buffer is full: nothing else could be stored, and demonstrations may have
            been overwritten already.
    """
    buffer.writer.protect(len(buffer))
