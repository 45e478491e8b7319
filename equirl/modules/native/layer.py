"""Convolution, maximum and ReLU of steerable layers in one native call."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.function import once_differentiable

from equirl.modules.fields import REGULAR, FieldType
from equirl.modules.filters import expanded_filter
from equirl.modules.native.library import load
from equirl.modules.native.spectral import SpectralBasis, plain_tensors, spectral_basis
from equirl.modules.steerable import SteerableConv

__all__ = [
    "BLOCK",
    "channel_order",
    "conv_block",
    "encode",
    "from_blocks",
    "runs",
    "to_blocks",
]

#: Images side by side in memory; a batch is padded to a multiple.
BLOCK = 16

#: Without gradients, sixteen lanes are faster than one image after the other from here on.
SMALLEST_BATCH = 4


class _Layer(ctypes.Structure):
    """What the kernels need to know of a layer; mirrors the struct of kernels.hpp."""

    _fields_ = (
        ("order", ctypes.c_int32),
        ("regular", ctypes.c_int32),
        ("fields_in", ctypes.c_int32),
        ("fields_out", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("width", ctypes.c_int32),
        ("padding", ctypes.c_int32),
        ("pool", ctypes.c_int32),
        ("relu", ctypes.c_int32),
        ("edge", ctypes.c_float),
        ("axis", ctypes.c_float),
    )


def _basis_of(conv: SteerableConv) -> SpectralBasis:
    basis = None
    if conv.kernel_size == 3 and conv.padding <= 2 and conv.out_type.is_regular:
        kinds = conv.in_type.kinds
        basis = spectral_basis(conv.in_type.group, kinds[0]) if len(kinds) == 1 else None
    if basis is None:
        raise ValueError(
            "the native kernels serve 3 x 3 convolutions from regular or trivial to regular "
            f"fields of groups with quarter turns, padding at most 2; got {conv}, "
            f"padding={conv.padding}"
        )
    return basis


def runs(layers: Iterable[SteerableConv], x: Tensor) -> bool:
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


def _parameters(layers: Iterable[SteerableConv]) -> list[Tensor]:
    return [p for layer in layers for p in (layer.weights, layer.bias) if p is not None]


def _has_memory(tensor: Tensor) -> bool:
    try:
        return tensor.data_ptr() != 0
    except RuntimeError:  # inside vmap or another transform
        return False


def encode(layers: Sequence[SteerableConv], pools: Sequence[bool], x: Tensor) -> Tensor:
    """Takes images through convolutions, each followed by a maximum or not, and a ReLU.

    Args:
        layers: Supported layers in sequence, the first of trivial fields.
        pools: For each layer whether a 2 x 2 maximum follows.
        x: Images (B, C, H, W) that `runs` accepts.

    Returns:
        Shape (B, out channels, H', W'), channels in the order of the last layer's fields.
    """
    learning = torch.is_grad_enabled() and any(p.requires_grad for p in _parameters(layers))
    batch, block = len(x), BLOCK if learning or len(x) >= SMALLEST_BATCH else 1
    x = to_blocks(x, block=block)
    for layer, pool in zip(layers, pools, strict=True):
        x = conv_block(layer, x, pool=pool, relu=True)
    order = channel_order(layers[-1].out_type)
    x = from_blocks(x, batch)
    return x if order is None else x.index_select(1, order)


@functools.cache
def channel_order(fields: FieldType) -> Tensor | None:
    """Takes regular channels from the kernels' order to their own; None if they agree.

    The kernels keep the channels of a field coset by coset of C4 or D4.
    """
    basis = spectral_basis(fields.group, REGULAR)
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
        conv: The layer; its parameters are read, possibly swapped in functionally.
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
    basis = _basis_of(conv)
    fields_out, fields_in = len(conv.out_type.fields), len(conv.in_type.fields)
    weights = expanded_filter(
        conv, conv.weights, lambda w: basis.expand(w, fields_out, fields_in), form="spectral"
    )
    shifts = weights.new_zeros(fields_out) if conv.bias is None else conv.bias
    bias = (shifts * conv.in_type.group.order**-0.5).repeat_interleave(basis.cosets)
    inputs = x.contiguous(), weights.contiguous(), bias.contiguous()
    learning = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)
    _check(basis, *inputs, conv.padding, pool, blocks=(BLOCK,) if learning else (BLOCK, 1))
    if learning:
        return _ConvBlock.apply(*inputs, basis, conv.padding, pool, relu)
    return _forward(*inputs, basis, conv.padding, pool, relu, keep_choice=False)[0]


def _check(
    basis: SpectralBasis,
    x: Tensor,
    weights: Tensor,
    bias: Tensor,
    padding: int,
    pool: bool,
    blocks: tuple[int, ...],
) -> None:
    """Refuses what the kernels would read or write out of bounds."""
    fields_out, fields_in, _ = weights.shape
    channels = basis.order if basis.regular else 1
    if x.ndim != 6 or (x.shape[1], x.shape[4]) != (fields_in, channels) or x.shape[5] not in blocks:
        raise ValueError(
            f"expected maps (blocks, {fields_in}, H, W, {channels}, "
            f"{' or '.join(map(str, blocks))}), got {tuple(x.shape)}"
        )
    if x.requires_grad and not basis.regular:
        raise ValueError("the kernels have no gradient for trivial input, but it requires one")
    sides = _convolved(x, padding)
    if min(sides) < 1 or (pool and any(side % 2 for side in sides)):
        wanted = "even and at least 2" if pool else "at least 1"
        raise ValueError(
            f"the convolution of {tuple(x.shape[2:4])} pixels with padding={padding} has "
            f"{sides}: expected {wanted} for pool={pool}"
        )
    if len(bias) != fields_out:
        raise ValueError(f"expected {fields_out} biases, got {len(bias)}")
    for name, tensor in (("maps", x), ("weights", weights), ("bias", bias)):
        if tensor.dtype is not torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"expected {name} in float32 on the CPU, got {tensor.dtype} on {tensor.device}"
            )


def _convolved(x: Tensor, padding: int) -> tuple[int, int]:
    """Height and width of the convolution of maps."""
    return x.shape[2] - 2 + 2 * padding, x.shape[3] - 2 + 2 * padding


def _forward(
    x: Tensor,
    weights: Tensor,
    bias: Tensor,
    basis: SpectralBasis,
    padding: int,
    pool: bool,
    relu: bool,
    keep_choice: bool,
) -> tuple[Tensor, Tensor | None, _Layer]:
    """The output, which pixel was the maximum if that is to be kept, and the layer."""
    blocks, _, height, width, _, block = x.shape
    fields_out, fields_in, _ = weights.shape
    layer = _Layer(
        basis.order, basis.regular, fields_in, fields_out, height, width,
        padding, pool, relu, basis.edge, basis.axis,
    )  # fmt: skip
    high, wide = _convolved(x, padding)
    if pool:
        high, wide = high // 2, wide // 2
    y = x.new_empty(blocks, fields_out, high, wide, basis.order, block)
    choice = torch.empty_like(y, dtype=torch.uint8) if pool and keep_choice else None
    start = [ctypes.byref(layer), blocks]
    start += [tensor.data_ptr() for tensor in (x, weights, bias, y)]
    if block == 1:
        _functions().equirl_forward_one(*start, torch.get_num_threads())
    else:
        _functions().equirl_forward(*start, _address(choice), torch.get_num_threads())
    return y, choice, layer


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


class _ConvBlock(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        x, weights, _, ctx.basis, _, pool, relu = arguments
        y, choice, ctx.layer = _forward(*arguments, keep_choice=True)
        ctx.save_for_backward(x, weights, y if relu and not pool else None, choice)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, weights, y, choice = ctx.saved_tensors
        gradient = gradient.contiguous()
        common = gradient.data_ptr(), _address(y), _address(choice)
        layer, blocks, threads = ctypes.byref(ctx.layer), len(x), torch.get_num_threads()
        dx = dw = db = None
        if ctx.needs_input_grad[0]:
            dx, transposed = torch.empty_like(x), ctx.basis.transpose(weights)
            _functions().equirl_input_gradient(
                layer, blocks, *common, transposed.data_ptr(), dx.data_ptr(), threads
            )
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
            dw, db = torch.empty_like(weights), weights.new_empty(len(weights))
            _functions().equirl_weight_gradient(
                layer, blocks, x.data_ptr(), *common, dw.data_ptr(), db.data_ptr(), threads
            )
        return dx, dw, db, None, None, None, None


@functools.cache
def _functions() -> ctypes.CDLL:
    handle = load().handle
    for name, pointers in (
        ("equirl_forward_one", 4),
        ("equirl_forward", 5),
        ("equirl_input_gradient", 5),
        ("equirl_weight_gradient", 6),
    ):
        function = getattr(handle, name)
        function.restype = None
        function.argtypes = [
            ctypes.POINTER(_Layer),
            ctypes.c_int32,
            *[ctypes.c_void_p] * pointers,
            ctypes.c_int32,
        ]
    return handle
