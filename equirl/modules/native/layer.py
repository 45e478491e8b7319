"""Convolution, activation and pooling of steerable layers in one native call."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.autograd.function import once_differentiable

from equirl.modules.fields import TRIVIAL, FieldType
from equirl.modules.filters import expanded_filter
from equirl.modules.native.library import load
from equirl.modules.native.spectral import SpectralBasis, plain_tensors, spectral_basis
from equirl.modules.nonlinearity import GatedNonlinearity
from equirl.modules.pooling import FieldMaxPool, NormMaxPool
from equirl.modules.steerable import SteerableConv

__all__ = [
    "BLOCK",
    "channel_order",
    "conv_block",
    "encode",
    "from_blocks",
    "gated_block",
    "runs",
    "to_blocks",
]

#: Images side by side in memory; a batch is padded to a multiple.
BLOCK = 16

#: Without gradients, sixteen lanes are faster than one image after the other from here on.
SMALLEST_BATCH = 4


# How ties are resolved, in the kernels' numbers; the maximum of regular fields is the first.
_POOLS = {"first": 1, "shared": 2}


class _Layer(ctypes.Structure):
    """What the kernels need to know of a layer; mirrors the struct of kernels.hpp."""

    _fields_ = (
        ("group", ctypes.c_int32),
        ("hidden", ctypes.c_int32),
        ("fields_in", ctypes.c_int32),
        ("fields_out", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("width", ctypes.c_int32),
        ("padding", ctypes.c_int32),
        ("pool", ctypes.c_int32),
        ("activation", ctypes.c_int32),
        ("edge", ctypes.c_float),
        ("axis", ctypes.c_float),
    )


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
    return _run(conv, basis, fields, bias, x, _POOLS["first"] if pool else 0, relu)


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
    return _run(conv, basis, fields, bias, x, 0 if ties is None else _POOLS[ties], True)


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
    inputs = x.contiguous(), weights.contiguous(), bias.contiguous()
    learning = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)
    _check(basis, *inputs, conv.padding, pool, blocks=(BLOCK,) if learning else (BLOCK, 1))
    if learning:
        return _ConvBlock.apply(*inputs, basis, conv.padding, pool, activation)
    return _forward(*inputs, basis, conv.padding, pool, activation, learning=False)[0]


def _check(
    basis: SpectralBasis,
    x: Tensor,
    weights: Tensor,
    bias: Tensor,
    padding: int,
    pool: int,
    blocks: tuple[int, ...],
) -> None:
    """Refuses what the kernels would read or write out of bounds."""
    fields_out, fields_in, _ = weights.shape
    channels = basis.space.channels if basis.hidden else 1
    if x.ndim != 6 or (x.shape[1], x.shape[4]) != (fields_in, channels) or x.shape[5] not in blocks:
        raise ValueError(
            f"expected maps (blocks, {fields_in}, H, W, {channels}, "
            f"{' or '.join(map(str, blocks))}), got {tuple(x.shape)}"
        )
    if x.requires_grad and not basis.hidden:
        raise ValueError("the kernels have no gradient for trivial input, but it requires one")
    sides = _convolved(x, padding)
    if min(sides) < 1 or (pool and any(side % 2 for side in sides)):
        wanted = "even and at least 2" if pool else "at least 1"
        raise ValueError(
            f"the convolution of {tuple(x.shape[2:4])} pixels with padding={padding} has "
            f"{sides}: expected {wanted} for pool={bool(pool)}"
        )
    biases = fields_out * (1 + basis.space.gates)
    if len(bias) != biases:
        raise ValueError(f"expected {biases} biases, got {len(bias)}")
    for name, tensor in (("maps", x), ("weights", weights), ("bias", bias)):
        if tensor.dtype is not torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"expected {name} in float32 on the CPU, got {tensor.dtype} on {tensor.device}"
            )


def _convolved(x: Tensor, padding: int) -> tuple[int, int]:
    """Height and width of the convolution of maps."""
    return x.shape[2] - 2 + 2 * padding, x.shape[3] - 2 + 2 * padding


class _Kept(NamedTuple):
    """What a forward pass leaves for the gradients."""

    layer: _Layer
    choice: Tensor | None  # which pixel was the maximum, of regular fields
    raw: Tensor | None  # fields and gates before they are multiplied and pooled


def _forward(
    x: Tensor,
    weights: Tensor,
    bias: Tensor,
    basis: SpectralBasis,
    padding: int,
    pool: int,
    activation: bool,
    learning: bool,
) -> tuple[Tensor, _Kept]:
    """The output, and what the gradients need if they are wanted."""
    blocks, _, height, width, _, block = x.shape
    fields_out, fields_in, _ = weights.shape
    space = basis.space
    layer = _Layer(
        space.value, basis.hidden, fields_in, fields_out, height, width,
        padding, pool, activation, basis.edge, basis.axis,
    )  # fmt: skip
    high, wide = _convolved(x, padding)
    raw = None
    if learning and space.gates:
        channels = space.channels + space.gates
        raw = x.new_empty(blocks, fields_out, high, wide, channels, block)
    if pool:
        high, wide = high // 2, wide // 2
    y = x.new_empty(blocks, fields_out, high, wide, space.channels, block)
    choice = None
    if learning and pool and not space.gates:
        choice = torch.empty_like(y, dtype=torch.uint8)
    start = [ctypes.byref(layer), blocks]
    start += [tensor.data_ptr() for tensor in (x, weights, bias, y)]
    if block == 1:
        _functions().equirl_forward_one(*start, torch.get_num_threads())
    else:
        kept = _address(choice), _address(raw)
        _functions().equirl_forward(*start, *kept, torch.get_num_threads())
    return y, _Kept(layer, choice, raw)


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


class _ConvBlock(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        x, weights, _, ctx.basis, _, pool, activation = arguments
        y, kept = _forward(*arguments, learning=True)
        ctx.layer = kept.layer
        needs_output = activation and not pool and kept.raw is None
        ctx.save_for_backward(x, weights, y if needs_output else None, kept.choice, kept.raw)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, weights, y, choice, raw = ctx.saved_tensors
        gradient = gradient.contiguous()
        layer, blocks, threads = ctypes.byref(ctx.layer), len(x), torch.get_num_threads()
        if raw is not None and ctx.needs_input_grad[0]:
            before = torch.empty_like(raw)
            _functions().equirl_gate_gradient(
                layer, blocks, raw.data_ptr(), gradient.data_ptr(), before.data_ptr(), threads
            )
            gradient, raw = before, None
        common = gradient.data_ptr(), _address(y), _address(choice)
        dx = dw = db = None
        if ctx.needs_input_grad[0]:
            dx, transposed = torch.empty_like(x), ctx.basis.transpose(weights)
            _functions().equirl_input_gradient(
                layer, blocks, *common, transposed.data_ptr(), dx.data_ptr(), threads
            )
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
            dw = torch.empty_like(weights)
            db = weights.new_empty(len(weights) * (1 + ctx.basis.space.gates))
            _functions().equirl_weight_gradient(
                *(layer, blocks, x.data_ptr(), *common, _address(raw)),
                *(dw.data_ptr(), db.data_ptr(), threads),
            )
        return dx, dw, db, None, None, None, None


@functools.cache
def _functions() -> ctypes.CDLL:
    handle = load().handle
    for name, pointers in (
        ("equirl_forward_one", 4),
        ("equirl_forward", 6),
        ("equirl_gate_gradient", 3),
        ("equirl_input_gradient", 5),
        ("equirl_weight_gradient", 7),
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
