"""Where networks run."""

from __future__ import annotations

import torch

__all__ = ["resolve_device"]


def resolve_device(device: torch.device | str | None) -> torch.device:
    """``"auto"`` is the first GPU if there is one; None is torch's default device.

    Raises:
        ValueError: The device is none that networks run on, or this machine does not have it.
    """
    if device is None:
        return torch.get_default_device()
    if device == "auto":
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    try:
        resolved = torch.device(device)
    except RuntimeError:
        raise ValueError(f"device={device}: expected auto, cpu or cuda:<i>") from None
    if resolved.type == "cuda" and (resolved.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"device={device}: this machine has {torch.cuda.device_count()} GPUs")
    return resolved
