"""Calls of the compiled kernels: what they are given, checked, and their gradients."""

from __future__ import annotations

import ctypes
import functools
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from equirl.modules.native.library import load
from equirl.modules.native.spectral import SpectralBasis

__all__ = ["BLOCK", "POOLS", "convolve"]

#: Images side by side in memory; a batch is padded to a multiple.
BLOCK = 16

#: How ties are resolved, in the kernels' numbers; the maximum of regular fields is the first.
POOLS = {"first": 1, "shared": 2}


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


def convolve(
    basis: SpectralBasis,
    x: Tensor,
    weights: Tensor,
    bias: Tensor,
    padding: int,
    pool: int,
    activation: bool,
) -> Tensor:
    """A convolution, its activation and pooling; differentiable once, in reverse mode.

    Args:
        basis: What the weights mean.
        x: Blocks of maps (blocks, fields in, H, W, channels, 16 or 1), float32; of one image
            without gradients only.
        weights: Spectral weights (fields out, fields in, size).
        bias: For each field out and, one kind after the other, for its gates.
        padding: Zero padding in pixels.
        pool: One of `POOLS`, or 0 to pool nothing.
        activation: Whether a ReLU follows; gates always do.

    Returns:
        Blocks of maps (blocks, fields out, H', W', channels, 16 or 1).

    Raises:
        ValueError: A shape or dtype is not as above, or trivial input requires a gradient.
    """
    inputs = x.contiguous(), weights.contiguous(), bias.contiguous()
    learning = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)
    _check(basis, *inputs, padding, pool, blocks=(BLOCK,) if learning else (BLOCK, 1))
    if learning:
        return _ConvBlock.apply(*inputs, basis, padding, pool, activation)
    return _forward(*inputs, basis, padding, pool, activation, learning=False)[0]


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
