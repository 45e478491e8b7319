"""How networks read and write tensordicts: one set of keys for every method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import nn
from torchrl.modules import ProbabilisticActor

from equirl.symmetry import Representation, action_representation, check_mode

__all__ = ["OBSERVATION_KEYS", "as_actor", "as_critic", "check_keys", "resolve_action"]

#: The observation of the manipulation environments.
OBSERVATION_KEYS = ("depth", "holding")


def check_keys(in_keys: Sequence[NestedKey], invariants: int) -> None:
    """Checks the keys of an image and of a vector of that many invariants.

    Raises:
        ValueError: There are more or fewer keys than these.
    """
    if isinstance(in_keys, str) or len(in_keys) != 1 + (invariants != 0):
        wanted = "of an image and of its invariants" if invariants else "of an image alone"
        raise ValueError(f"in_keys={in_keys!r}, invariants={invariants!r}: expected keys {wanted}")


def resolve_action(action: Representation | None, mode: str) -> Representation:
    """How an action transforms: as stated, or, if None, as the manipulation action of a mode.

    Raises:
        ValueError: It is no representation, an empty one, or the mode does not exist.
    """
    check_mode(mode)
    if action is None:
        return action_representation(mode)
    if not isinstance(action, Representation) or not action.dim:
        raise ValueError(
            f"action={action!r}: expected a Representation of one component or more, for example "
            'Representation("vector")'
        )
    return action


def as_actor(
    policy: nn.Module,
    distribution: type,
    in_keys: Sequence[NestedKey] = OBSERVATION_KEYS,
    **options: Any,
) -> ProbabilisticActor:
    """The policy of a network that maps an observation to the parameters ``loc`` and ``scale``.

    Args:
        policy: Maps an observation to two tensors of the action's shape.
        distribution: Built of them and of ``options``.
        in_keys: The observation's keys, in the order of the network's arguments.
        options: Further arguments of the distribution.
    """
    return ProbabilisticActor(
        TensorDictModule(policy, in_keys=list(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution,
        distribution_kwargs=options,
        return_log_prob=True,
    )


def as_critic(
    encoder: nn.Module, heads: nn.Module, in_keys: Sequence[NestedKey] = OBSERVATION_KEYS
) -> TensorDictSequential:
    """The critic of an encoder, observation to features, and heads that judge actions by them."""
    return TensorDictSequential(
        TensorDictModule(encoder, in_keys=list(in_keys), out_keys=["_features"]),
        TensorDictModule(heads, in_keys=["_features", "action"], out_keys=["state_action_value"]),
    )
