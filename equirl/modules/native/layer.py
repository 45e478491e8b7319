"""Convolution, activation and pooling of steerable layers in one native call."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd import forward_ad

from equirl.modules.fields import TRIVIAL, FieldType
from equirl.modules.filters import expanded_filter
from equirl.modules.native.calls import BLOCK, POOLS, convolve
from equirl.modules.native.spectral import SpectralBasis, plain_tensors, spectral_basis
from equirl.modules.nonlinearity import GatedNonlinearity
from equirl.modules.pooling import FieldMaxPool, NormMaxPool
from equirl.modules.steerable import SteerableConv

__all__ = [
    "channel_order",
    "conv_block",
    "encode",
    "from_blocks",
    "gated_block",
    "runs",
    "to_blocks",
]

#: Without gradients, sixteen lanes are faster than one image after the other from here on.
SMALLEST_BATCH = 4


def _basis_of(conv: SteerableConv, fields: FieldType) -> SpectralBasis:
    """The basis of a layer whose activation gives hidden fields."""
    basis, into = None, conv.in_type
    hidden = FieldType.hidden(into.group, _count(fields))
    if conv.kernel_size == 3 and conv.padding <= 2 and fields == hidden:
        if into.kinds == (TRIVIAL,):
            basis = spectral_basis(into.group, TRIVIAL)
        elif into == FieldType.hidden(into.group, _count(into)):
            basis = spectral_basis(into.group, "hidden")
    if basis is None:
        raise ValueError(
            "the native kernels serve 3 x 3 convolutions from hidden or trivial to hidden "
            f"fields of groups with quarter turns, padding at most 2; got {conv}, "
            f"padding={conv.padding}"
        )
    return basis


def _count(fields: FieldType) -> int:
    """Number of hidden fields, if these are such."""
    return len(fields.fields) // len(FieldType.hidden(fields.group, 1).fields)


def runs(layers: Iterable[nn.Module], x: Tensor) -> bool:
    """Whether the kernels can take a batch of images (B, C, H, W) through supported layers.

    They compute in float32 on the CPU, without a gradient for the images, outside of
    ``vmap``, ``torch.func``, forward-mode differentiation, tracing and compilation.
    """
    if (
        x.requires_grad
        or torch.compiler.is_compiling()
        or torch.jit.is_tracing()
        or torch.is_autocast_enabled("cpu")
        or forward_ad._current_level >= 0
    ):
        return False
    return len(x) > 0 and all(
        t.dtype is torch.float32 and t.device.type == "cpu" and _has_memory(t)
        for t in (x, *_parameters(layers))
    )


def _parameters(layers: Iterable[nn.Module]) -> list[Tensor]:
    # As attributes: tensors swapped in functionally need not be parameters.
    found = (getattr(layer, name, None) for layer in layers for name in ("weights", "bias"))
    return [tensor for tensor in found if tensor is not None]


def _has_memory(tensor: Tensor) -> bool:
    try:
        return tensor.data_ptr() != 0
    except RuntimeError:  # inside vmap or another transform
        return False


def encode(
    layers: Iterable[nn.Module],
    activations: Iterable[nn.Module],
    pools: Iterable[nn.Module],
    x: Tensor,
) -> Tensor:
    """Takes images through convolutions, each with an activation and a pooling or not.

    Args:
        layers: Supported layers in sequence, the first of trivial fields.
        activations: What follows each: a `FieldReLU`, or a `GatedNonlinearity`.
        pools: What follows that: a `FieldMaxPool`, a `NormMaxPool`, or the identity.
        x: Images (B, C, H, W) that `runs` accepts.

    Returns:
        Shape (B, out channels, H', W'), channels in the order of the last layer's fields.
    """
    rows = list(zip(layers, activations, pools, strict=True))
    parameters = _parameters(module for row in rows for module in row)
    learning = torch.is_grad_enabled() and any(p.requires_grad for p in parameters)
    batch, block = len(x), BLOCK if learning or len(x) >= SMALLEST_BATCH else 1
    x = to_blocks(x, block=block)
    for layer, activation, pool in rows:
        assert isinstance(layer, SteerableConv)
        if isinstance(activation, GatedNonlinearity):
            ties = pool.ties if isinstance(pool, NormMaxPool) else None
            x, out_type = gated_block(layer, activation, x, ties=ties), activation.out_type
        else:
            x = conv_block(layer, x, pool=isinstance(pool, FieldMaxPool), relu=True)
            out_type = layer.out_type
    order = channel_order(out_type)
    x = from_blocks(x, batch)
    return x if order is None else x.index_select(1, order)


@functools.cache
def channel_order(fields: FieldType) -> Tensor | None:
    """Takes hidden channels from the kernels' order to their own; None if they agree.

    The kernels keep the channels of a regular field coset by coset of C4 or D4.
    """
    basis = spectral_basis(fields.group, "hidden")
    assert basis is not None
    if basis.cosets == 1:
        return None
    with plain_tensors():
        inverse = torch.tensor(basis.channels).argsort()
        starts = torch.arange(0, fields.size, fields.group.order)
        return (starts[:, None] + inverse).flatten()


def to_blocks(x: Tensor, channels: int = 1, block: int = BLOCK) -> Tensor:
    """Arranges feature maps as the kernels want them.

    Args:
        x: Shape (B, fields * channels, H, W).
        channels: Channels of a field.
        block: Images side by side: 16, or 1 for a few images without gradients.

    Returns:
        Shape (ceil(B / block), fields, H, W, channels, block), filled up with zeros.
    """
    missing = -len(x) % block
    if missing:
        x = F.pad(x, (0, 0, 0, 0, 0, 0, 0, missing))
    x = x.unflatten(1, (-1, channels)).unflatten(0, (-1, block))
    return x.permute(0, 2, 4, 5, 3, 1).contiguous()


def from_blocks(x: Tensor, batch: int) -> Tensor:
    """The inverse of `to_blocks` for a batch of that many maps."""
    return x.permute(0, 5, 1, 4, 2, 3).flatten(2, 3).flatten(0, 1)[:batch]


def conv_block(conv: SteerableConv, x: Tensor, pool: bool = False, relu: bool = False) -> Tensor:
    """A steerable convolution, then optionally a 2 x 2 maximum, then optionally a ReLU.

    Differentiable once in reverse mode, with respect to the input if its fields are regular,
    the weights and the bias, for blocks of 16. The result does not depend on the number of
    threads.

    Args:
        conv: The layer, to regular fields; its parameters are read, possibly swapped in
            functionally.
        x: Blocks of maps (blocks, fields, H, W, channels, 16 or 1), float32, see
            `to_blocks`: trivial fields of one channel, or regular fields of the
            subgroup in the kernels' order, see `channel_order`.
        pool: Whether to take the maximum; the convolution's height and width must be even.
        relu: Whether to apply the ReLU.

    Returns:
        Blocks of maps (blocks, fields out, H', W', channels, 16 or 1), regular fields of the
        subgroup in the kernels' order.

    Raises:
        ValueError: The kernels do not serve the layer, a shape or dtype is not as above, or
            trivial input requires a gradient.
    """
    basis = _basis_of(conv, conv.out_type)
    if basis.space.gates:
        raise ValueError(f"a ReLU commutes with regular fields, got {conv}")
    fields = len(conv.out_type.fields)
    shifts = conv.weights.new_zeros(fields) if conv.bias is None else conv.bias
    bias = (shifts * conv.in_type.group.order**-0.5).repeat_interleave(basis.cosets)
    return _run(conv, basis, fields, bias, x, POOLS["first"] if pool else 0, relu)


def gated_block(
    conv: SteerableConv, gates: GatedNonlinearity, x: Tensor, ties: str | None = None
) -> Tensor:
    """A steerable convolution of SO(2) or O(2), then gates, then optionally a norm max-pool.

    As `conv_block`, also in what can be differentiated, here the gates' bias as well.

    Args:
        conv: The layer; to hidden fields followed by their gates.
        gates: What follows it.
        x: Blocks of maps, see `conv_block`: trivial fields, or hidden ones.
        ties: ``"shared"`` or ``"first"``, see `NormMaxPool`; None to pool nothing.

    Returns:
        Blocks of maps (blocks, hidden fields, H', W', channels, 16 or 1).

    Raises:
        ValueError: As `conv_block`.
    """
    basis = _basis_of(conv, gates.out_type)
    if conv.out_type != gates.in_type or not basis.space.gates:
        raise ValueError(f"expected fields with their gates, got {conv}")
    fields, kinds = _count(gates.out_type), basis.space.gates
    shifts = conv.weights.new_zeros(fields * (1 + kinds)) if conv.bias is None else conv.bias
    # [copy of the trivial part][field], as the kernels want them: the parts' own, then the gates.
    opening = shifts[fields:] + gates.bias
    bias = torch.cat([shifts[:fields], opening.view(fields, kinds).T.flatten()])
    return _run(conv, basis, fields, bias, x, 0 if ties is None else POOLS[ties], True)


def _run(
    conv: SteerableConv,
    basis: SpectralBasis,
    fields_out: int,
    bias: Tensor,
    x: Tensor,
    pool: int,
    activation: bool,
) -> Tensor:
    fields_in = conv.in_type.size if not basis.hidden else _count(conv.in_type)
    weights = expanded_filter(
        conv, conv.weights, lambda w: basis.expand(w, fields_out, fields_in), form="spectral"
    )
    return convolve(basis, x, weights, bias, conv.padding, pool, activation)
