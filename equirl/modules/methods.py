"""The methods, by name: what each builds its actor and critic with."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from tensordict.nn import TensorDictSequential
from torchrl.modules import ProbabilisticActor

from equirl.modules.actor import make_actor
from equirl.modules.cnn import make_cnn_actor, make_cnn_critic
from equirl.modules.critic import make_critic

__all__ = ["METHODS", "Method"]


class Method(NamedTuple):
    """The networks of a method.

    Attributes:
        make_actor: Takes ``hidden``, ``image_size``, ``device`` and ``generator``.
        make_critic: The same.
        equivariant: Whether both take ``group``, ``mode`` and ``backend`` too, and the critic
            ``head_width``.
    """

    make_actor: Callable[..., ProbabilisticActor]
    make_critic: Callable[..., TensorDictSequential]
    equivariant: bool


METHODS = {
    "equivariant": Method(make_actor, make_critic, equivariant=True),
    "cnn": Method(make_cnn_actor, make_cnn_critic, equivariant=False),
}
