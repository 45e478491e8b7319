"""The equivariant encoder: from an image and the holding flag to regular fields."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from equirl.modules.backend import resolve_backend
from equirl.modules.device import resolve_device
from equirl.modules.fields import FieldType
from equirl.modules.layout import check_sizes, convolve, skeleton, stack_observation
from equirl.modules.native import layer as native
from equirl.modules.steerable import SteerableConv
from equirl.symmetry import SymmetryGroup

__all__ = ["EquivariantEncoder"]


class EquivariantEncoder(nn.Module):
    """Seven steerable convolutions that shrink a 128-pixel image to one pixel.

    Paper, appendix A and figure 7: every layer is a 3 x 3 convolution between regular
    fields with a ReLU, and a 2 x 2 maximum after the first four and the sixth.

    Args:
        group: The symmetry group or its name.
        hidden: Number of regular fields of the output, the paper's n.
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.
        backend: ``"native"``, kernels for CPUs that use the symmetry; ``"dense"``, torch's own
            convolutions; ``"auto"``, the faster one. They share the parameters and differ by
            rounding only. What the kernels do not serve (float64, gradients for the image,
            ``vmap``, forward-mode differentiation, tracing, ``export``) runs dense on
            either, and hooks on the single layers are not called by the kernels.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights; torch's global one if None.

    Attributes:
        in_type: Two trivial fields, depth and flag.
        out_type: ``hidden`` regular fields.
        backend: ``"native"`` or ``"dense"``.

    Raises:
        ValueError: The group, the width, the image size or the backend is not supported.
        NativeUnavailable: ``backend="native"`` cannot be had; a RuntimeError.
    """

    def __init__(
        self,
        group: SymmetryGroup | str,
        *,
        hidden: int = 64,
        image_size: int = 128,
        backend: str = "auto",
        device: torch.device | str | None = None,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_sizes(hidden, image_size)
        group, self.image_size = SymmetryGroup(group), image_size
        self.backend = resolve_backend(backend, group, resolve_device(device))
        self.in_type = FieldType.trivial(group, 2)
        self.out_type = FieldType.regular(group, hidden)
        rows = skeleton(image_size, hidden)
        self.layers, self.pools = nn.ModuleList(), tuple(row.pool for row in rows)
        fields = self.in_type
        for row in rows:
            out = FieldType.regular(group, row.width)
            layer = SteerableConv(fields, out, padding=row.padding, generator=generator)
            self.layers.append(layer)
            fields = out
        self.to(resolve_device(device))

    def forward(self, depth: Tensor, holding: Tensor) -> Tensor:
        """Encodes observations.

        Args:
            depth: Shape (*batch, 1, S, S), in metres.
            holding: Shape (*batch, 1).

        Returns:
            Regular fields of shape (*batch, hidden * group order).
        """
        x = stack_observation(depth, holding, self.image_size)
        layers = cast(list[SteerableConv], list(self.layers))
        if self.backend == "native" and native.runs(layers, x):
            x = native.encode(layers, self.pools, x)
        else:
            x = convolve(layers, self.pools, x)
        return x.reshape(*depth.shape[:-3], self.out_type.size)
