"""Constants of a module: on its device and in its precision, but neither parameters nor buffers."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from torch import Tensor, nn

__all__ = ["WithConstants"]


class WithConstants(nn.Module):
    """A module some of whose tensors follow from its fields alone.

    They move and change precision with the module, but are not in its state dict, and a
    functional swap of parameters and buffers (a target network's) leaves them alone.

    Attributes:
        constant_names: The attributes that hold these tensors.
    """

    constant_names: ClassVar[tuple[str, ...]]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> nn.Module:
        if not hasattr(self, "_originals"):
            self._originals = {name: getattr(self, name) for name in self.constant_names}
        super()._apply(fn, recurse)
        for name, value in self._originals.items():
            # From the first values: `fn` may leave none behind (`to_empty`) or round them.
            setattr(self, name, value.to(fn(value)))
        return self
