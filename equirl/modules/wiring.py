"""How networks read and write tensordicts: one set of keys for every method."""

from __future__ import annotations

from typing import Any

from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import ProbabilisticActor

__all__ = ["OBSERVATION_KEYS", "as_actor", "as_critic"]

OBSERVATION_KEYS = ("depth", "holding")


def as_actor(policy: nn.Module, distribution: type, **options: Any) -> ProbabilisticActor:
    """The policy of a network that maps an observation to the parameters ``loc`` and ``scale``.

    Args:
        policy: Maps depth (*batch, 1, S, S) and holding (*batch, 1) to two tensors (*batch, 5).
        distribution: Built of them and of ``options``.
        options: Further arguments of the distribution.
    """
    return ProbabilisticActor(
        TensorDictModule(policy, in_keys=list(OBSERVATION_KEYS), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution,
        distribution_kwargs=options,
        return_log_prob=True,
    )


def as_critic(encoder: nn.Module, heads: nn.Module) -> TensorDictSequential:
    """The critic of an encoder, observation to features, and heads that judge actions by them."""
    return TensorDictSequential(
        TensorDictModule(encoder, in_keys=list(OBSERVATION_KEYS), out_keys=["_features"]),
        TensorDictModule(heads, in_keys=["_features", "action"], out_keys=["state_action_value"]),
    )
