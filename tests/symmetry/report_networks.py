"""Networks to report on: small ones of ours, and functions whose errors are known."""

import math

import torch
from tensordict.nn import TensorDictModule

from equirl.symmetry import Element, random_observations

HALF, QUARTER, FLIP = Element(math.pi), Element(math.pi / 2), Element(0.0, reflected=True)
SEEN = random_observations(3, 16)
FIELDS = ("regular", "trivial", "sign", "vector", "vector_2", "vector_3")


def seeded(make, *args, **kwargs):
    size = {"hidden": 8, "image_size": 16, "generator": torch.Generator().manual_seed(0)}
    return make(*args, **size, **kwargs)


def acting(function) -> TensorDictModule:
    """A policy of a function from depth (B, 1, S, S) to actions."""
    return TensorDictModule(function, in_keys=["depth"], out_keys=["action"])


def constant(*action: float) -> TensorDictModule:
    return acting(lambda depth: torch.tensor(action).expand(len(depth), -1))


def judging(function) -> TensorDictModule:
    """A critic of a function from depth and action to values."""
    return TensorDictModule(function, ["depth", "action"], ["state_action_value"])
