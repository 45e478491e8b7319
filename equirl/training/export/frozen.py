"""A trained policy as a plain torch module, its steerable filters expanded for good."""

from __future__ import annotations

import copy
from typing import Any, cast

import torch
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from equirl.modules import EquivariantEncoder, SteerableConv, SteerableLinear

__all__ = ["FrozenPolicy"]


class FrozenPolicy(nn.Module):
    """What an actor does, in torch's own convolutions and linear maps.

    Only the steerable maps are replaced; every other module of the network is kept as it is. The
    actor is copied, not changed. It runs on the CPU.

    Args:
        actor: Made by `equirl.modules.make_actor`, of any keys and any action, or by one of the
            methods of `equirl.modules.METHODS`.
        dtype: Of the parameters; filters are expanded in it.

    Example:
        >>> from equirl.modules import make_actor
        >>> actor = make_actor("D4", hidden=8, image_size=16)
        >>> action, loc, scale = FrozenPolicy(actor)(torch.rand(2, 1, 16, 16), torch.zeros(2, 1))
        >>> action.shape
        torch.Size([2, 5])
    """

    def __init__(self, actor: ProbabilisticActor, dtype: torch.dtype = torch.float32):
        super().__init__()
        network, head = cast(Any, actor.module[0]), cast(Any, actor.module[-1])
        self.network = copy.deepcopy(network.module).to("cpu", dtype)
        self._distribution = head.distribution_class
        self._options = dict(head.distribution_kwargs)
        for module in list(self.network.modules()):
            if isinstance(module, EquivariantEncoder):
                module.backend = "dense"
            for name, child in module.named_children():
                if isinstance(child, SteerableConv | SteerableLinear):
                    setattr(module, name, _plain(child))
        for parameter in self.parameters():
            parameter.data = parameter.data.contiguous()
        self.requires_grad_(False).eval()

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The greedy action, and the Gaussian it is the squashed mean of.

        Args:
            inputs: What the actor reads, in the order of its ``in_keys``: for a policy of
                manipulation, depth (B, 1, S, S), m, and holding (B, 1), 0 or 1.

        Returns:
            Action, mean and standard deviation, each (B, number of the action's components).
        """
        loc, scale = self.network(*inputs)
        return self._distribution(loc, scale, **self._options).deterministic_sample, loc, scale


def _plain(layer: SteerableConv | SteerableLinear) -> nn.Module:
    """Torch's layer with the dense filter of a steerable one."""
    weight, bias = layer.filter().detach(), layer.expanded_bias()
    out, into = weight.shape[:2]
    plain: nn.Conv2d | nn.Linear
    if isinstance(layer, SteerableConv):
        size = layer.kernel_size
        plain = nn.Conv2d(into, out, size, padding=layer.padding, bias=bias is not None)
    else:
        plain, weight = nn.Linear(into, out, bias=bias is not None), weight.flatten(1)
    plain.weight = nn.Parameter(weight)
    if bias is not None:
        plain.bias = nn.Parameter(bias.detach())
    return plain
