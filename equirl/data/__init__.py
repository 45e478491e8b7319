"""Replay buffers and the transforms between insertion and sampling."""

from equirl.data.episodes import DatasetError, project_onto_disc
from equirl.data.keys import TRANSITION_KEYS
from equirl.data.priorities import CompactPrioritizedSampler, Priorities
from equirl.data.protection import ProtectingWriter, protect_demonstrations
from equirl.data.replay import load_replay_state, make_replay_buffer, replay_state
from equirl.data.robomimic import read_demonstrations, read_environment, write_demonstrations
from equirl.data.rotations import RandomRotation, RotationAugmentation
from equirl.data.symmetric import SymmetricSampler
from equirl.data.transforms import QuantizeDepth, RandomCrop

__all__ = [
    "TRANSITION_KEYS",
    "CompactPrioritizedSampler",
    "DatasetError",
    "Priorities",
    "ProtectingWriter",
    "QuantizeDepth",
    "RandomCrop",
    "RandomRotation",
    "RotationAugmentation",
    "SymmetricSampler",
    "load_replay_state",
    "make_replay_buffer",
    "project_onto_disc",
    "protect_demonstrations",
    "read_demonstrations",
    "read_environment",
    "replay_state",
    "write_demonstrations",
]
