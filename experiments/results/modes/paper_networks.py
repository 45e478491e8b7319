"""The paper's networks as a method of its own, for the environment and training of strict mode.

It tells what the networks of ``mode=paper`` are worth apart from the rest of that mode.
"""

from __future__ import annotations

from typing import Any

from tensordict.nn import TensorDictSequential
from torchrl.modules import ProbabilisticActor

from equirl.modules.actor import make_actor as make_equivariant_actor
from equirl.modules.critic import make_critic as make_equivariant_critic
from equirl.modules.methods import Method


def make_actor(**options: Any) -> ProbabilisticActor:
    """Theta an invariant of reflections, five deviations, x and y each squashed by tanh."""
    return make_equivariant_actor(**options | {"mode": "paper"})


def make_critic(**options: Any) -> TensorDictSequential:
    """Takes theta for an invariant of reflections."""
    return make_equivariant_critic(**options | {"mode": "paper"})


PAPER_NETWORKS = Method(make_actor, make_critic, equivariant=True)
