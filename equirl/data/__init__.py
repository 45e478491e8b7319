"""Replay buffers and the transforms between insertion and sampling."""

from equirl.data.keys import TRANSITION_KEYS
from equirl.data.priorities import CompactPrioritizedSampler, Priorities
from equirl.data.protection import ProtectingWriter, protect_demonstrations
from equirl.data.replay import load_replay_state, make_replay_buffer, replay_state
from equirl.data.rotations import RandomRotation, RotationAugmentation
from equirl.data.symmetric import SymmetricSampler
from equirl.data.transforms import QuantizeDepth, RandomCrop

__all__ = [
    "TRANSITION_KEYS",
    "CompactPrioritizedSampler",
    "Priorities",
    "ProtectingWriter",
    "QuantizeDepth",
    "RandomCrop",
    "RandomRotation",
    "RotationAugmentation",
    "SymmetricSampler",
    "load_replay_state",
    "make_replay_buffer",
    "protect_demonstrations",
    "replay_state",
]
