"""Replay buffers and the transforms between insertion and sampling."""

from equirl.data.keys import TRANSITION_KEYS
from equirl.data.replay import load_replay_state, make_replay_buffer, replay_state
from equirl.data.transforms import QuantizeDepth, RotationAugmentation

__all__ = [
    "TRANSITION_KEYS",
    "QuantizeDepth",
    "RotationAugmentation",
    "load_replay_state",
    "make_replay_buffer",
    "replay_state",
]
