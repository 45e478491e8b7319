"""The methods, by name: what each builds its networks with, and what it asks of training."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from traceback import extract_tb
from typing import NamedTuple

from tensordict.nn import TensorDictSequential
from torchrl.modules import ProbabilisticActor

from equirl.modules.actor import make_actor
from equirl.modules.cnn import make_cnn_actor, make_cnn_critic
from equirl.modules.critic import make_critic
from equirl.modules.ferm import make_ferm_actor, make_ferm_critic
from equirl.modules.rad import make_rad_actor, make_rad_critic

__all__ = ["METHODS", "Method"]


class Method(NamedTuple):
    """The networks of a method, and what its training adds to soft actor-critic.

    Attributes:
        make_actor: Takes ``hidden``, ``image_size``, ``device`` and ``generator``.
        make_critic: The same, and ``heads``.
        equivariant: Whether both take ``group``, ``mode`` and ``backend`` too, and the critic
            ``head_width``.
        shifts: Whether the losses are averages over shifted copies of the observations.
        crops: Whether the networks see less than the camera, whose images have the side
            `uncropped` of ``image_size``: random crops in training, the centre when acting.
        contrastive: Whether the critic's encoder is also trained to tell crops apart, first on
            the demonstrations alone, and the actor's convolutions are tied to the critic's.
    """

    make_actor: Callable[..., ProbabilisticActor]
    make_critic: Callable[..., TensorDictSequential]
    equivariant: bool
    shifts: bool = False
    crops: bool = False
    contrastive: bool = False


class _Methods(dict[str, Method]):
    """Methods by name; those that are defined elsewhere by ``"package.module:NAME"``."""

    def __missing__(self, name: str) -> Method:
        """Imports a method.

        Raises:
            ValueError: There is none of that name, or its module ends in an error, which the
                message places; `dict.get` does not import and gives None.
        """
        module, colon, attribute = name.partition(":")
        if not colon or name.startswith("."):  # relative to nothing
            raise ValueError(
                f"expected one of {', '.join(self)} or 'package.module:NAME', got {name!r}"
            )
        try:
            method = getattr(import_module(module), attribute)
        except Exception as error:  # whatever the user's code raises
            told = f"{type(error).__name__}: {error}{_place(error)}"
            raise ValueError(f"method {name!r} cannot be imported: {told}") from error
        if not isinstance(method, Method):
            raise ValueError(f"a method must be an {__name__}.Method, got {method!r}")
        return method


METHODS = _Methods(
    equivariant=Method(make_actor, make_critic, equivariant=True),
    cnn=Method(make_cnn_actor, make_cnn_critic, equivariant=False),
    drq=Method(make_cnn_actor, make_cnn_critic, equivariant=False, shifts=True),
    rad=Method(make_rad_actor, make_rad_critic, equivariant=False, crops=True),
    ferm=Method(make_ferm_actor, make_ferm_critic, equivariant=False, crops=True, contrastive=True),
)


def _place(error: Exception) -> str:
    """Where the module that was being imported had come to; nothing where none had begun."""
    frames = [each for each in extract_tb(error.__traceback__) if each.name == "<module>"]
    return f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
