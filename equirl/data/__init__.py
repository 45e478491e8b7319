"""Replay buffers and the transforms between insertion and sampling."""

from .keys import TRANSITION_KEYS
from .replay import load_replay_state, make_replay_buffer, replay_state
from .transforms import QuantizeDepth, RotationAugmentation

__all__ = [
    "TRANSITION_KEYS",
    "QuantizeDepth",
    "RotationAugmentation",
    "load_replay_state",
    "make_replay_buffer",
    "replay_state",
]
