"""The plain convolutional baseline: the equivariant networks' skeleton without the symmetry."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from equirl.modules.actor import LOG_STD_RANGE
from equirl.modules.device import resolve_device
from equirl.modules.layout import check_sizes, convolve, skeleton, stack_observation
from equirl.modules.wiring import as_actor, as_critic
from equirl.symmetry import ACTION

__all__ = [
    "CNNEncoder",
    "GaussianPolicy",
    "QHeads",
    "as_cnn_actor",
    "as_cnn_critic",
    "initialise",
    "make_cnn_actor",
    "make_cnn_critic",
    "perceptron",
]


class CNNEncoder(nn.Module):
    """Seven convolutions: 16, 32, 64, 128, 256, 256 and 128 channels at hidden 64, 128 px.

    Widths scale with ``hidden`` like the equivariant encoder's, so that both methods keep
    comparable numbers of parameters at every size.

    Args:
        hidden: The n of the equivariant encoder this is compared with.
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.
        last: Channels of the last convolution, in units of 2 n.

    Attributes:
        out_features: Length of the output, 2 n ``last``.

    Raises:
        ValueError: The width or the image size is not supported.
    """

    def __init__(self, *, hidden: int = 64, image_size: int = 128, last: int = 1):
        super().__init__()
        check_sizes(hidden, image_size)
        self.image_size, self.out_features = image_size, 2 * hidden * last
        rows = skeleton(image_size, 2 * hidden, tail=(2, 2, last))
        self.layers, self.pools = nn.ModuleList(), tuple(row.pool for row in rows)
        channels = 2
        for row in rows:
            self.layers.append(nn.Conv2d(channels, row.width, 3, padding=row.padding))
            channels = row.width

    def forward(self, depth: Tensor, holding: Tensor) -> Tensor:
        """Encodes (*batch, 1, S, S) and (*batch, 1) to (*batch, out_features)."""
        x = stack_observation(depth, holding, 1, 1, self.image_size)
        x = convolve(self.layers, self.pools, x)
        return x.reshape(*depth.shape[:-3], self.out_features)


class GaussianPolicy(nn.Module):
    """An encoder, and what reads the Gaussian of the action off its features.

    Args:
        encoder: Maps an observation to features.
        loc: Maps features to the action's mean, before the squash.
        log_std: Maps them to the logarithm of its standard deviation, which is clamped.
    """

    def __init__(self, encoder: nn.Module, loc: nn.Module, log_std: nn.Module):
        super().__init__()
        self.encoder, self.loc, self.log_std = encoder, loc, log_std

    def forward(self, depth: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        """Maps (*batch, 1, S, S) and (*batch, 1) to mean and deviation, both (*batch, 5)."""
        features = self.encoder(depth, holding)
        return self.loc(features), self.log_std(features).clamp(*LOG_STD_RANGE).exp()


class QHeads(nn.Module):
    """Perceptrons that judge an action, each from the features and the action side by side.

    Args:
        features: Length of the features.
        hidden: Widths of each perceptron's hidden layers.
        heads: Number of perceptrons.

    Raises:
        ValueError: There would be no head.
    """

    def __init__(self, features: int, hidden: Sequence[int], heads: int):
        super().__init__()
        if not isinstance(heads, int) or heads < 1:
            raise ValueError(f"heads={heads!r}: expected a positive integer")
        self.heads = nn.ModuleList(
            perceptron(features + ACTION.dim, *hidden, 1) for _ in range(heads)
        )

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Maps features (*batch, size) and actions (*batch, 5) to values (*batch, heads)."""
        x = torch.cat([features, action], -1)
        return torch.cat([head(x) for head in self.heads], -1)


def perceptron(*widths: int) -> nn.Sequential:
    """Linear layers between the widths, with ReLUs between the layers."""
    layers: list[nn.Module] = []
    for into, out in pairwise(widths):
        layers += [nn.Linear(into, out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def initialise(
    module: nn.Module, device: torch.device | str | None, generator: torch.Generator | None
) -> None:
    """Xavier weights and zero biases for all convolutions and linear layers; to its device.

    Args:
        module: The network.
        device: Where the parameters are to live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the weights, on the CPU; torch's global one if None.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    module.to(resolve_device(device)).to(memory_format=torch.channels_last)


def as_cnn_actor(
    encoder: nn.Module,
    features: int,
    *,
    device: torch.device | str | None,
    generator: torch.Generator | None,
) -> ProbabilisticActor:
    """The baseline's policy on an encoder of that many features, freshly initialised."""
    loc, log_std = nn.Linear(features, ACTION.dim), nn.Linear(features, ACTION.dim)
    policy = GaussianPolicy(encoder, loc, log_std)
    initialise(policy, device, generator)
    return as_actor(policy, TanhNormal)


def as_cnn_critic(
    encoder: nn.Module,
    features: int,
    *,
    heads: int,
    device: torch.device | str | None,
    generator: torch.Generator | None,
) -> TensorDictSequential:
    """The baseline's critic on an encoder of that many features, freshly initialised."""
    critic = as_critic(encoder, QHeads(features, [features], heads))
    initialise(critic, device, generator)
    return critic


def make_cnn_actor(
    *,
    hidden: int = 64,
    image_size: int = 128,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> ProbabilisticActor:
    """The baseline's policy: linear mean and log standard deviation, squashed elementwise.

    Args:
        hidden: The n of the equivariant networks it is compared with; 64 in the paper.
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Returns:
        An actor with the keys of `make_actor`.

    Raises:
        ValueError: The width or the image size is not supported.
    """
    encoder = CNNEncoder(hidden=hidden, image_size=image_size)
    return as_cnn_actor(encoder, encoder.out_features, device=device, generator=generator)


def make_cnn_critic(
    *,
    hidden: int = 64,
    image_size: int = 128,
    heads: int = 2,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> TensorDictSequential:
    """The baseline's critic: one encoder and ``heads`` perceptrons (128 + 5)-128-1.

    Args:
        hidden: The n of the equivariant networks it is compared with; 64 in the paper.
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.
        heads: Number of estimates, which share the encoder.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Returns:
        Two modules in sequence with the keys of `make_critic`.

    Raises:
        ValueError: The width, the image size or the number of heads is not supported.
    """
    encoder = CNNEncoder(hidden=hidden, image_size=image_size)
    features = encoder.out_features
    return as_cnn_critic(encoder, features, heads=heads, device=device, generator=generator)
