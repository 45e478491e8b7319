"""FERM: a CNN whose features are also trained to tell crops of one observation from others.

The framework for efficient robotic manipulation (Zhan et al., 2020) learns from random crops, as
`equirl.modules.rad` does, and adds a contrastive loss on the critic's encoder
(`equirl.objectives.ContrastiveLoss`), first on the demonstrations alone, then with every update.
The encoder ends in 50 features under a layer norm (appendix E, figure 8). The actor sees through
the critic's convolutions: its loss sends no gradient into them.
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from equirl.modules.cnn import CNNEncoder, GaussianPolicy, QHeads, initialise, perceptron
from equirl.modules.layout import CenterCropped
from equirl.modules.wiring import as_actor, as_critic
from equirl.symmetry import ACTION

__all__ = [
    "FERM_FEATURES",
    "FERMEncoder",
    "make_ferm_actor",
    "make_ferm_critic",
    "tie_convolutions",
]

#: Length of what the encoder returns, at any width (appendix E).
FERM_FEATURES = 50
# Width of the last convolution and of the perceptrons, in units of n: 1024 at the paper's 64.
_WIDENING = 16


class FERMEncoder(nn.Module):
    """Seven convolutions, a linear layer to 50 features, and a layer norm (figure 8).

    The convolutions have 16, 32, 64, 128, 256, 256 and 1024 channels at hidden 64, 128 px;
    they are the CNN baseline's with a wider last one.

    Args:
        hidden: The n of the equivariant encoder this is compared with.
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.

    Raises:
        ValueError: The width or the image size is not supported.
    """

    def __init__(self, *, hidden: int = 64, image_size: int = 128):
        super().__init__()
        self.convolutions = CNNEncoder(hidden=hidden, image_size=image_size, last=_WIDENING // 2)
        self.linear = nn.Linear(self.convolutions.out_features, FERM_FEATURES)
        self.norm = nn.LayerNorm(FERM_FEATURES)

    def forward(self, depth: Tensor, holding: Tensor) -> Tensor:
        """Encodes (*batch, 1, S, S) and (*batch, 1) to (*batch, 50)."""
        return self.norm(self.linear(self.convolutions(depth, holding)))


def make_ferm_actor(
    *,
    hidden: int = 64,
    image_size: int = 128,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> ProbabilisticActor:
    """FERM's policy: perceptrons 50-1024-1024-5 for the mean and for the log deviation.

    Its linear layer and layer norm are its own. Its convolutions are copies of the critic's:
    their parameters ask for no gradient, and `tie_convolutions` sets them, once both networks
    are made and after every update. TorchRL's losses would silently leave parameters untrained
    that actor and critic share.

    Args:
        hidden: The n of the equivariant networks it is compared with; 64 in the paper. All
            widths grow with it but the 50.
        image_size: Side of the image after the crop: 16, 32, 64, 128 or 256 pixels; before it,
            see `uncropped`.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Returns:
        An actor with the keys of `make_actor`.

    Raises:
        ValueError: The width or the image size is not supported.
    """
    encoder, width = FERMEncoder(hidden=hidden, image_size=image_size), _WIDENING * hidden
    policy = GaussianPolicy(
        CenterCropped(encoder, image_size),
        loc=perceptron(FERM_FEATURES, width, width, ACTION.dim),
        log_std=perceptron(FERM_FEATURES, width, width, ACTION.dim),
    )
    initialise(policy, device, generator)
    encoder.convolutions.requires_grad_(False)
    return as_actor(policy, TanhNormal)


def make_ferm_critic(
    *,
    hidden: int = 64,
    image_size: int = 128,
    heads: int = 2,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> TensorDictSequential:
    """FERM's critic: one encoder and ``heads`` perceptrons (50 + 5)-1024-1024-1.

    Args:
        hidden: The n of the equivariant networks it is compared with; 64 in the paper. All
            widths grow with it but the 50.
        image_size: Side of the image after the crop: 16, 32, 64, 128 or 256 pixels; before it,
            see `uncropped`.
        heads: Number of estimates, which share the encoder.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Returns:
        Two modules in sequence with the keys of `make_critic`.

    Raises:
        ValueError: The width, the image size or the number of heads is not supported.
    """
    encoder, width = FERMEncoder(hidden=hidden, image_size=image_size), _WIDENING * hidden
    critic = as_critic(
        CenterCropped(encoder, image_size), QHeads(FERM_FEATURES, [width, width], heads)
    )
    initialise(critic, device, generator)
    return critic


def tie_convolutions(actor: nn.Module, critic: nn.Module) -> None:
    """Copies the convolutions of FERM's critic into its actor.

    Raises:
        TypeError: One of them holds no `FERMEncoder`, or more than one.
    """
    _convolutions(actor).load_state_dict(_convolutions(critic).state_dict())


def _convolutions(network: nn.Module) -> CNNEncoder:
    encoders = [module for module in network.modules() if isinstance(module, FERMEncoder)]
    if len(encoders) != 1:
        raise TypeError(
            "expected a network of make_ferm_actor or make_ferm_critic, which holds one "
            f"FERMEncoder, got a {type(network).__name__} that holds {len(encoders)}"
        )
    return encoders[0].convolutions
