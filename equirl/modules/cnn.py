"""The plain convolutional baseline: the equivariant networks' skeleton without the symmetry."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from equirl.modules.actor import LOG_STD_RANGE
from equirl.modules.device import resolve_device
from equirl.modules.layout import check_sizes, convolve, skeleton, stack_observation
from equirl.modules.wiring import as_actor, as_critic
from equirl.symmetry import ACTION

__all__ = ["CNNEncoder", "make_cnn_actor", "make_cnn_critic"]


class CNNEncoder(nn.Module):
    """Seven convolutions: 16, 32, 64, 128, 256, 256 and 128 channels at hidden 64, 128 px.

    Widths scale with ``hidden`` like the equivariant encoder's, so that both methods keep
    comparable numbers of parameters at every size.

    Args:
        hidden: The n of the equivariant encoder this is compared with; the output has
            2 n channels.
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.

    Raises:
        ValueError: The width or the image size is not supported.
    """

    def __init__(self, *, hidden: int = 64, image_size: int = 128):
        super().__init__()
        check_sizes(hidden, image_size)
        self.image_size, self.out_features = image_size, 2 * hidden
        rows = skeleton(image_size, 2 * hidden, tail=(2, 2, 1))
        self.layers, self.pools = nn.ModuleList(), tuple(row.pool for row in rows)
        channels = 2
        for row in rows:
            self.layers.append(nn.Conv2d(channels, row.width, 3, padding=row.padding))
            channels = row.width

    def forward(self, depth: Tensor, holding: Tensor) -> Tensor:
        """Encodes (*batch, 1, S, S) and (*batch, 1) to (*batch, 2 * hidden)."""
        x = stack_observation(depth, holding, 1, 1, self.image_size)
        x = convolve(self.layers, self.pools, x)
        return x.reshape(*depth.shape[:-3], self.out_features)


class _CNNPolicy(nn.Module):
    def __init__(self, encoder: CNNEncoder):
        super().__init__()
        self.encoder = encoder
        self.loc = nn.Linear(encoder.out_features, ACTION.dim)
        self.log_std = nn.Linear(encoder.out_features, ACTION.dim)

    def forward(self, depth: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        features = self.encoder(depth, holding)
        return self.loc(features), self.log_std(features).clamp(*LOG_STD_RANGE).exp()


class _QHeads(nn.Module):
    def __init__(self, features: int, heads: int):
        super().__init__()
        self.heads = nn.ModuleList(
            nn.Sequential(
                nn.Linear(features + ACTION.dim, features), nn.ReLU(), nn.Linear(features, 1)
            )
            for _ in range(heads)
        )

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        x = torch.cat([features, action], -1)
        return torch.cat([head(x) for head in self.heads], -1)


def _initialise(
    module: nn.Module, device: torch.device | str | None, generator: torch.Generator | None
) -> None:
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    module.to(resolve_device(device)).to(memory_format=torch.channels_last)


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
    policy = _CNNPolicy(CNNEncoder(hidden=hidden, image_size=image_size))
    _initialise(policy, device, generator)
    return as_actor(policy, TanhNormal)


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
        ValueError: The width or the image size is not supported.
    """
    encoder = CNNEncoder(hidden=hidden, image_size=image_size)
    critic = as_critic(encoder, _QHeads(encoder.out_features, heads))
    _initialise(critic, device, generator)
    return critic
