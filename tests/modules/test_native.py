"""The native kernels compute what the dense convolutions and escnn compute."""

import copy
import warnings

import pytest
import torch
import torch.nn.functional as F
from escnn_reference import escnn_convolution
from tensordict import TensorDict
from torch.autograd import forward_ad
from torch.func import functional_call, stack_module_state, vmap

from equirl.modules import (
    EquivariantEncoder,
    FieldType,
    NativeUnavailable,
    SteerableConv,
    shared_filters,
)
from equirl.modules.native import calls as kernels
from equirl.modules.native import layer as native
from equirl.modules.native import library
from equirl.modules.native.spectral import spectral_basis
from equirl.symmetry import SymmetryGroup
from tests.equivariance import assert_equivariant, turn_fields, turn_image

slow = pytest.mark.slow
GROUPS = ("C4", "D4", "C8", "D8")
ALL_GROUPS = (*GROUPS, "SO2", "O2")
#: For every instruction set, from the least.
CAPABILITIES = {"baseline": "DEFAULT", "AVX2": "AVX2", "AVX-512": "AVX512"}

try:
    library.load()
except library.NativeUnavailable as error:
    pytest.skip(str(error), allow_module_level=True)


@pytest.fixture(params=CAPABILITIES)
def instruction_set(request, monkeypatch):
    """Runs a test on the kernels of one instruction set."""
    names = list(CAPABILITIES)
    if names.index(request.param) > names.index(library.best_instruction_set()):
        pytest.skip(f"this processor has no {request.param}")
    handle = library._open(library.library_path(request.param))
    monkeypatch.setattr(kernels, "load", lambda: library.Library(request.param, handle))
    kernels._functions.cache_clear()
    yield request.param
    kernels._functions.cache_clear()


def make_layer(group, fields_in, fields_out, padding, kind="regular", seed=0):
    torch.manual_seed(seed)
    group = SymmetryGroup(group)
    in_type = getattr(FieldType, kind)(group, fields_in)
    conv = SteerableConv(in_type, FieldType.regular(group, fields_out), padding=padding)
    for parameter in conv.parameters():
        torch.nn.init.normal_(parameter)
    return conv


def through_kernels(conv, x, pool=False, relu=False, block=kernels.BLOCK):
    """The layer on images in the usual layout and order of channels."""
    channels = 1
    if conv.in_type.is_regular:
        order = native.channel_order(conv.in_type)
        channels = spectral_basis(conv.in_type.group, "hidden").space.channels
        x = x if order is None else x[:, order.argsort()]
    y = native.conv_block(conv, native.to_blocks(x, channels, block), pool=pool, relu=relu)
    y = native.from_blocks(y, len(x))
    order = native.channel_order(conv.out_type)
    return y if order is None else y[:, order]


def assert_close(actual, expected, tolerance=1e-5):
    error = (actual.double() - expected.double()).abs().max()
    assert error <= tolerance * expected.abs().max(), (
        f"relative error {error / expected.abs().max()}"
    )


#: Fields in, fields out, side, padding: every combination the encoders use at width 8, and
#: shapes that fill no register tile.
SHAPES = [
    ("trivial", 2, 2, 16, 1),
    ("regular", 1, 2, 16, 1),
    ("regular", 4, 8, 16, 1),
    ("regular", 8, 16, 8, 1),
    ("regular", 16, 8, 8, 0),
    ("regular", 8, 8, 3, 0),
    ("regular", 3, 5, 5, 2),
    ("trivial", 3, 1, 10, 0),
]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("group", GROUPS)
def test_a_layer_and_its_gradients_equal_escnn(group, shape):
    kind, fields_in, fields_out, side, padding = shape
    conv = make_layer(group, fields_in, fields_out, padding, kind)
    theirs = escnn_convolution(conv)
    x = torch.randn(5, conv.in_type.size, side, side, requires_grad=kind == "regular")
    y, expected = through_kernels(conv, x), theirs(theirs.in_type(x)).tensor
    assert_close(y, expected)
    gradient = torch.randn_like(y)
    inputs = [x] if x.requires_grad else []
    ours = torch.autograd.grad(y, [*inputs, conv.weights, conv.bias], gradient)
    escnns = torch.autograd.grad(expected, [*inputs, theirs.weights, theirs.bias], gradient)
    for mine, its in zip(ours, escnns, strict=True):
        assert_close(mine, its)


def decided(pre, pool, margin=1e-4):
    """Where rounding cannot change which pixel is the maximum, nor the sign of the output."""
    if not pool:
        return pre.abs() > margin
    windows = pre.unfold(2, 2, 2).unfold(3, 2, 2).flatten(4).sort(-1).values
    return (windows[..., 3].abs() > margin) & (windows[..., 3] - windows[..., 2] > margin)


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("pool", [False, True])
@pytest.mark.parametrize("shape", [SHAPES[0], SHAPES[2], SHAPES[4]], ids=str)
@pytest.mark.parametrize("group", ["C4", "D4", pytest.param("D8", marks=slow)])
def test_fused_maximum_and_relu(instruction_set, group, shape, pool, relu):
    kind, fields_in, fields_out, side, padding = shape
    conv = make_layer(group, fields_in, fields_out, padding, kind)
    x = torch.randn(17, conv.in_type.size, side, side, requires_grad=kind == "regular")
    y = through_kernels(conv, x, pool, relu)

    exact, z = copy.deepcopy(conv).double(), x.detach().double().requires_grad_()
    pre = exact(z)
    expected = F.max_pool2d(pre, 2) if pool else pre
    expected = F.relu(expected) if relu else expected
    assert_close(y, expected)
    gradient = torch.randn_like(y) * decided(pre, pool)
    y.backward(gradient)
    expected.backward(gradient.double())
    assert_close(conv.weights.grad, exact.weights.grad)
    assert_close(conv.bias.grad, exact.bias.grad)
    if x.requires_grad:
        assert_close(x.grad, z.grad)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("group", GROUPS)
def test_one_image_at_a_time(instruction_set, group, shape):
    kind, fields_in, fields_out, side, padding = shape
    conv = make_layer(group, fields_in, fields_out, padding, kind)
    x = torch.randn(2, conv.in_type.size, side, side)
    with torch.no_grad():
        expected = copy.deepcopy(conv).double()(x.double())
        assert_close(through_kernels(conv, x, block=1), expected)
        if expected.shape[-1] % 2 == 0:  # as the maximum asks
            expected = F.relu(F.max_pool2d(expected, 2))
            assert_close(through_kernels(conv, x, pool=True, relu=True, block=1), expected)


def make_encoder(group, hidden=8, image_size=32, backend="native"):
    generator = torch.Generator().manual_seed(0)
    encoder = EquivariantEncoder(
        group, hidden=hidden, image_size=image_size, backend=backend, generator=generator
    )
    for layer in encoder.layers:
        torch.nn.init.normal_(layer.bias, 0, 0.1, generator=generator)
    return encoder


def images(batch, size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    depth = 0.3 * torch.rand(batch, 1, size, size, generator=generator)
    return depth, torch.rand(batch, 1, generator=generator).round()


@pytest.fixture
def calls(monkeypatch):
    """Counts the calls of the kernels."""
    count, encode = [], native.encode
    monkeypatch.setattr(native, "encode", lambda *args: count.append(1) or encode(*args))
    return count


@pytest.mark.parametrize(
    ("hidden", "size"),
    [
        (8, 16),
        (8, 64),
        pytest.param(8, 128, marks=slow),
        pytest.param(16, 256, marks=slow),
        pytest.param(64, 128, marks=slow),
    ],
)
@pytest.mark.parametrize("group", ALL_GROUPS)
@pytest.mark.parametrize("batch", [1, 5])
def test_an_encoder_equals_the_dense_one(group, hidden, size, batch, calls):
    fast, dense = make_encoder(group, hidden, size), make_encoder(group, hidden, size, "dense")
    observation = images(batch, size)
    with torch.no_grad():
        assert_close(fast(*observation), dense(*observation), 1e-4)
    assert fast.backend == "native" and len(calls) == 1


@pytest.mark.parametrize("group", ["D4", "O2"])
def test_gradients_of_an_encoder(group):
    fast, dense = make_encoder(group), make_encoder(group, backend="dense").double()
    observation = images(6, 32)
    fast(*observation).square().sum().backward()
    dense(*(x.double() for x in observation)).square().sum().backward()
    for mine, its in zip(fast.parameters(), dense.parameters(), strict=True):
        assert_close(mine.grad, its.grad, 1e-4)


@pytest.mark.parametrize("group", ALL_GROUPS)
def test_features_turn_with_the_image(group):
    encoder, (depth, holding) = make_encoder(group), images(4, 32)
    with torch.no_grad():
        scale = encoder(depth, holding).abs().max().item()
        assert_equivariant(
            lambda **inputs: {"features": encoder(**inputs)},
            group,
            {"image": depth, "invariants": holding},
            {"image": turn_image, "features": turn_fields(encoder.out_type)},
            case="native encoder",
            tolerance=1e-4 * scale,
        )


@pytest.mark.parametrize("group", ["D4", "SO2"])
def test_bit_for_bit_the_same_on_any_number_of_threads(instruction_set, group):
    encoder, observation = make_encoder(group), images(40, 32)

    def run(threads):
        torch.set_num_threads(threads)
        encoder.zero_grad()
        features = encoder(*observation)
        features.square().sum().backward()
        return [features.detach(), *(p.grad.clone() for p in encoder.parameters())]

    try:
        first, again, parallel = run(1), run(1), run(3)
    finally:
        torch.set_num_threads(1)
    for a, b, c in zip(first, again, parallel, strict=True):
        assert torch.equal(a, b) and torch.equal(a, c)


@pytest.mark.parametrize("group", ["D4", "O2"])
def test_an_image_does_not_depend_on_its_batch(group):
    encoder, (depth, holding) = make_encoder(group), images(37, 32)
    features = encoder(depth, holding)
    assert torch.equal(features[20:], encoder(depth[20:], holding[20:]))
    batched = encoder(depth[:36].view(4, 9, 1, 32, 32), holding[:36].view(4, 9, 1))
    assert torch.equal(batched.flatten(0, 1), features[:36])


@pytest.mark.parametrize("group", ["D4", "SO2"])
def test_what_the_kernels_do_not_serve_runs_dense(calls, group):
    encoder, (depth, holding) = make_encoder(group), images(4, 32)
    expected = encoder(depth, holding)
    assert len(calls) == 1
    precise = copy.deepcopy(encoder).double()(depth.double(), holding.double())
    assert precise.dtype == torch.float64
    seen = depth.clone().requires_grad_()
    (saliency,) = torch.autograd.grad(encoder(seen, holding).sum(), seen)
    assert saliency.abs().sum() > 0
    with torch.autocast("cpu", torch.bfloat16):
        encoder(depth, holding)
    with warnings.catch_warnings(), forward_ad.dual_level():
        warnings.simplefilter("ignore")  # both load what is deprecated, and still in use
        tangent = forward_ad.make_dual(depth, torch.ones_like(depth))
        assert forward_ad.unpack_dual(encoder(tangent, holding)).tangent is not None
        traced = torch.jit.trace(encoder, (depth, holding))(depth, holding)
    parameters, _ = stack_module_state([encoder, copy.deepcopy(encoder)])
    stacked = vmap(lambda p: functional_call(encoder, p, (depth, holding)))(parameters)
    exported = torch.export.export(encoder, (depth, holding)).module()(depth, holding)
    assert len(calls) == 1
    for other in (stacked[1], exported, traced):
        assert_close(other, expected, 1e-4)


@pytest.mark.parametrize("batch", [2, 20])
@pytest.mark.parametrize("group", ["D4", "O2"])
def test_parameters_swapped_in_by_tensordict(calls, group, batch):
    """As TorchRL's losses do: not parameters any more, in attributes of the modules."""
    encoder, other, observation = make_encoder(group), make_encoder(group), images(batch, 32)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.normal_(0, 0.1)
    features = other(*observation)
    features.square().sum().backward()
    swapped = TensorDict.from_module(other).data.clone().requires_grad_()
    with swapped.to_module(encoder):
        again = encoder(*observation)
    assert torch.equal(again, features) and len(calls) == 2
    again.square().sum().backward()
    for name, parameter in other.named_parameters():
        assert torch.equal(swapped[tuple(name.split("."))].grad, parameter.grad)

    def run(parameters):
        with parameters.to_module(encoder):
            return encoder(*observation)

    both = torch.stack([swapped.data, swapped.data])
    assert_close(vmap(run)(both)[1], features, 1e-4)
    assert len(calls) == 2


@pytest.mark.parametrize("batch", [1, 3, 5])
@pytest.mark.parametrize("frozen", ["weights", "bias"])
@pytest.mark.parametrize("group", ["D4", "O2"])
def test_frozen_parameters(group, batch, frozen):
    encoder, observation = make_encoder(group), images(batch, 32)
    encoder(*observation).square().sum().backward()
    expected = {name: p.grad.clone() for name, p in encoder.named_parameters()}
    encoder.zero_grad()
    for name, parameter in encoder.named_parameters():
        parameter.requires_grad_(frozen not in name)
    encoder(*observation).square().sum().backward()
    for name, parameter in encoder.named_parameters():
        if frozen in name:
            assert parameter.grad is None
        else:
            assert torch.equal(parameter.grad, expected[name])


@pytest.mark.parametrize("group", ["C8", "O2"])
@pytest.mark.parametrize("context", [torch.inference_mode, lambda: torch.device("meta")])
def test_what_is_made_at_first_use_serves_everywhere(context, group):
    caches = spectral_basis, native.channel_order
    for cache in caches:
        cache.cache_clear()
    try:
        encoder, observation = make_encoder(group), images(4, 32)
        with context():
            encoder(*observation)
        encoder(*observation).sum().backward()
        assert all(torch.isfinite(p.grad).all() for p in encoder.parameters())
    finally:
        for cache in caches:
            cache.cache_clear()


def test_spectral_weights_are_shared_like_filters(calls):
    encoder, observation = make_encoder("D4"), images(4, 32)

    def gradients():
        encoder.zero_grad()
        (encoder(*observation).square().sum() + encoder(*observation).sum()).backward()
        return [p.grad.clone() for p in encoder.parameters()]

    plain = gradients()
    with shared_filters():
        shared = gradients()
        dense = encoder.layers[0](torch.randn(1, 2, 8, 8))  # has its own form
    assert torch.isfinite(dense).all() and len(calls) == 4
    for a, b in zip(plain, shared, strict=True):
        assert_close(a, b)


@pytest.mark.parametrize("block", [1, kernels.BLOCK])
@pytest.mark.parametrize("pool", [False, True])
def test_not_a_number_is_passed_on(instruction_set, pool, block):
    conv = make_layer("D4", 2, 2, 1).requires_grad_(block == kernels.BLOCK)
    x = torch.randn(4, 16, 8, 8)
    x[1, 3, 2, 2] = float("nan")
    y = through_kernels(conv, x, pool, relu=True, block=block)
    assert y[1].isnan().any() and torch.isfinite(y[[0, 2, 3]]).all()


def test_second_derivatives_are_refused_not_wrong():
    encoder = make_encoder("D4")
    loss = encoder(*images(4, 32)).square().sum()
    (gradient,) = torch.autograd.grad(loss, encoder.layers[1].weights, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.square().sum().backward()


@pytest.mark.parametrize(
    "layer",
    [
        lambda: SteerableConv(*[FieldType.regular(SymmetryGroup("C3"), 1)] * 2),
        lambda: SteerableConv(*[FieldType.regular(SymmetryGroup("D4"), 1)] * 2, kernel_size=5),
        lambda: SteerableConv(*[FieldType.trivial(SymmetryGroup("D4"), 1)] * 2),
        lambda: make_layer("D4", 1, 1, 3),
    ],
)
def test_other_layers_are_refused(layer):
    with pytest.raises(ValueError, match="native kernels serve 3 x 3 convolutions"):
        native.conv_block(layer(), torch.zeros(1, 1, 8, 8, 8, 16))


@pytest.mark.parametrize(
    ("shape", "options", "message"),
    [
        ((1, 2, 7, 8, 8, 16), {"pool": True}, r"\(7, 8\) pixels .* expected even"),
        ((1, 3, 8, 8, 8, 16), {}, r"expected maps \(blocks, 2, H, W, 8, 16\), got \(1, 3,"),
        ((1, 2, 8, 8, 8, 1), {}, r"expected maps \(blocks, 2, H, W, 8, 16\)"),
        ((1, 2, 8, 8, 4, 16), {}, "expected maps"),
        ((2, 16, 8, 8), {}, "expected maps"),
    ],
)
def test_maps_of_another_shape_are_refused(shape, options, message):
    with pytest.raises(ValueError, match=message):
        native.conv_block(make_layer("D4", 2, 2, 1), torch.zeros(shape), **options)


def test_values_the_kernels_cannot_read_are_refused():
    x = torch.zeros(1, 2, 8, 8, 8, 16)
    with pytest.raises(ValueError, match="maps in float32 on the CPU, got torch.float64"):
        native.conv_block(make_layer("D4", 2, 2, 1), x.double())
    with pytest.raises(ValueError, match="expected at least 1"):
        native.conv_block(make_layer("D4", 2, 2, 0), x[:, :, :2])
    trivial = torch.zeros(1, 2, 8, 8, 1, 16, requires_grad=True)
    with pytest.raises(ValueError, match="no gradient for trivial input"):
        native.conv_block(make_layer("D4", 2, 2, 1, "trivial"), trivial)
    conv = make_layer("D4", 2, 2, 1)
    conv.bias = torch.nn.Parameter(torch.zeros(1))
    with pytest.raises(ValueError, match="expected 2 biases, got 1"):
        native.conv_block(conv, x)


def test_groups_and_devices_that_are_not_served():
    with pytest.raises(ValueError, match="quarter turns, not C6"):
        EquivariantEncoder("C6", hidden=8, image_size=16, backend="native")
    assert EquivariantEncoder("C6", hidden=8, image_size=16).backend == "dense"
    with pytest.raises(ValueError, match="serves the CPU, not meta"):
        EquivariantEncoder("D4", hidden=8, image_size=16, backend="native", device="meta")


def test_a_network_without_its_library_says_so(monkeypatch):
    encoder, observation = make_encoder("D4"), images(4, 32)

    def missing():
        raise NativeUnavailable("not built")

    monkeypatch.setattr(kernels, "load", missing)
    kernels._functions.cache_clear()
    with pytest.raises(NativeUnavailable, match="not built"):
        encoder(*observation)


@pytest.mark.parametrize("mirror", [False, True])
def test_an_expanded_pair_has_the_filter_of_its_weights(mirror):
    """The spectral weights of cosets, put together, are the dense filter of the larger group."""
    conv = make_layer("D8" if mirror else "C8", 2, 3, 1)
    basis = spectral_basis(conv.in_type.group, "hidden")
    spectral = basis.expand(conv.weights.detach(), 3, 2)
    assert spectral.shape == (6, 4, basis.size)
    small = make_layer("D4" if mirror else "C4", 4, 6, 1)
    inverse = torch.linalg.inv(spectral_basis(small.in_type.group, "hidden").expansion.double())
    small.weights.data = (spectral.double() @ inverse).float().flatten()
    channels = torch.tensor(basis.channels)
    order = conv.in_type.group.order
    out = (torch.arange(3)[:, None] * order + channels).flatten()
    into = (torch.arange(2)[:, None] * order + channels).flatten()
    assert_close(small.filter(), conv.filter()[out][:, into])
