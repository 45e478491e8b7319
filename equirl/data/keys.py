"""The keys of a stored transition, the same for demonstrations and rollouts."""

from tensordict.utils import NestedKey

__all__ = ["TRANSITION_KEYS"]

#: depth (1, S, S) float32 metres; holding (1,) float32; action (5,); expert (1,) bool.
TRANSITION_KEYS: tuple[NestedKey, ...] = (
    "depth",
    "holding",
    "action",
    "expert",
    ("next", "depth"),
    ("next", "holding"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
    ("next", "truncated"),
)
