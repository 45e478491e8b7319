"""The equivariant encoder: from an image and invariants to steerable features."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from equirl.modules.backend import resolve_backend
from equirl.modules.device import resolve_device
from equirl.modules.fields import FieldType
from equirl.modules.layout import check_sizes, skeleton, stack_observation
from equirl.modules.native import layer as native
from equirl.modules.nonlinearity import make_activation
from equirl.modules.pooling import make_pixel_pool
from equirl.modules.steerable import SteerableConv
from equirl.symmetry import SymmetryGroup

__all__ = ["EquivariantEncoder"]


class EquivariantEncoder(nn.Module):
    """Seven steerable convolutions that shrink a 128-pixel image to one pixel.

    Paper, appendix A and figure 7: every layer is a 3 x 3 convolution with an activation, and
    a maximum over 2 x 2 pixels after the first four and the sixth. With a finite group the
    hidden fields are regular, the activation is a ReLU and the maximum pointwise; with SO(2) and
    O(2) the fields are irreps to frequency 3, each with a gate, and the maximum is by norm.

    Args:
        group: The symmetry group or its name.
        hidden: Number of hidden fields of the output, the paper's n.
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.
        channels: Channels of the image, which the group does not mix.
        invariants: Number of invariant numbers that are seen beside the image.
        mode: In ``"paper"`` the first of tied norms is the maximum, see `NormMaxPool`.
        backend: ``"native"``, kernels for CPUs that use the symmetry; ``"dense"``, torch's own
            convolutions; ``"auto"``, the faster one. They share the parameters and differ by
            rounding only. What the kernels do not serve (float64, gradients for the image,
            ``vmap``, forward-mode differentiation, tracing, ``export``) runs dense on
            either, and hooks on the single layers are not called by the kernels.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights; torch's global one if None.

    Attributes:
        in_type: Trivial fields: the image's channels, then the invariants.
        out_type: ``hidden`` hidden fields, see `FieldType.hidden`.
        backend: ``"native"`` or ``"dense"``.

    Raises:
        ValueError: The group, a size, the mode or the backend is not supported.
        NativeUnavailable: ``backend="native"`` cannot be had; a RuntimeError.
    """

    def __init__(
        self,
        group: SymmetryGroup | str,
        *,
        hidden: int = 64,
        image_size: int = 128,
        channels: int = 1,
        invariants: int = 1,
        mode: str = "strict",
        backend: str = "auto",
        device: torch.device | str | None = None,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_sizes(hidden, image_size)
        for name, count, least in (("channels", channels, 1), ("invariants", invariants, 0)):
            if not isinstance(count, int) or count < least:
                raise ValueError(f"{name}={count!r}: expected an integer of at least {least}")
        group, self.image_size = SymmetryGroup(group), image_size
        self.channels, self.invariants = channels, invariants
        self.backend = resolve_backend(backend, group, resolve_device(device))
        self.in_type = FieldType.trivial(group, channels + invariants)
        self.out_type = FieldType.hidden(group, hidden)
        self.layers, self.activations, self.pools = (
            nn.ModuleList(),
            nn.ModuleList(),
            nn.ModuleList(),
        )
        fields = self.in_type
        for row in skeleton(image_size, hidden):
            out = FieldType.hidden(group, row.width)
            activation = make_activation(out)
            self.layers.append(
                SteerableConv(fields, activation.in_type, padding=row.padding, generator=generator)
            )
            self.activations.append(activation)
            self.pools.append(make_pixel_pool(out, mode) if row.pool else nn.Identity())
            fields = out
        self.to(resolve_device(device))

    def forward(self, image: Tensor, invariants: Tensor | None = None) -> Tensor:
        """Encodes observations.

        Args:
            image: Shape (*batch, channels, S, S); depths in metres.
            invariants: Shape (*batch, invariants), None where there are none.

        Returns:
            Hidden fields of shape (*batch, out_type.size).
        """
        x = stack_observation(image, invariants, self.channels, self.invariants, self.image_size)
        if self.backend == "native" and native.runs([*self.layers, *self.activations], x):
            x = native.encode(self.layers, self.activations, self.pools, x)
        else:
            x = self._dense(x)
        return x.reshape(*image.shape[:-3], self.out_type.size)

    def _dense(self, x: Tensor) -> Tensor:
        for layer, activation, pool in zip(self.layers, self.activations, self.pools, strict=True):
            x = layer(x)
            if self.out_type.is_permuted:  # the two commute: a quarter of the work
                x = activation(pool(x), dim=1)
            else:
                x = pool(activation(x, dim=1))
        return x
