"""The native kernels of SO(2) and O(2): convolution, gates and norm max-pooling in one call."""

import copy

import pytest
import torch

from equirl.modules import FieldType, GatedNonlinearity, NormMaxPool, SteerableConv
from equirl.modules.native import layer as native
from equirl.modules.native.calls import BLOCK
from equirl.modules.native.spectral import spectral_basis
from equirl.symmetry import SymmetryGroup
from tests.modules.test_native import assert_close, instruction_set  # noqa: F401 (a fixture)

slow = pytest.mark.slow
GROUPS = ("SO2", "O2")

#: Hidden input or not, fields in, fields out, side, padding.
SHAPES = [
    (False, 2, 2, 16, 1),
    (True, 1, 2, 16, 1),
    (True, 4, 8, 8, 1),
    (True, 8, 4, 8, 0),
    (True, 16, 8, 3, 0),
    (True, 3, 5, 5, 2),
    (False, 3, 1, 10, 0),
]


def make_layer(group, hidden, fields_in, fields_out, padding):
    torch.manual_seed(0)
    group = SymmetryGroup(group)
    into = (FieldType.hidden if hidden else FieldType.trivial)(group, fields_in)
    gates = GatedNonlinearity(FieldType.hidden(group, fields_out))
    conv = SteerableConv(into, gates.in_type, padding=padding)
    for parameter in (*conv.parameters(), gates.bias):
        torch.nn.init.normal_(parameter)
    return conv, gates


def through_kernels(conv, gates, x, ties=None, block=BLOCK):
    """The layer on images in the usual layout."""
    hidden = conv.in_type.fields[-1] != "trivial"
    channels = FieldType.hidden(conv.in_type.group, 1).size if hidden else 1
    blocks = native.to_blocks(x, channels, block)
    return native.from_blocks(native.gated_block(conv, gates, blocks, ties), len(x))


def by_torch(conv, gates, x, ties):
    """The same in float64."""
    y = gates(conv(x), dim=1)
    return y if ties is None else NormMaxPool(gates.out_type, ties).double()(y)


def ways_to_pool(side):
    return (None, "shared", "first") if side % 2 == 0 else (None,)


CASES = [(shape, ties) for shape in SHAPES for ties in ways_to_pool(shape[3] - 2 + 2 * shape[4])]


@pytest.mark.parametrize(("shape", "ties"), CASES, ids=str)
@pytest.mark.parametrize("group", GROUPS)
def test_a_layer_and_its_gradients_equal_torch_in_float64(
    instruction_set,  # noqa: F811
    group,
    shape,
    ties,
):
    hidden, fields_in, fields_out, side, padding = shape
    conv, gates = make_layer(group, hidden, fields_in, fields_out, padding)
    x = torch.randn(17, conv.in_type.size, side, side, requires_grad=hidden)
    y = through_kernels(conv, gates, x, ties)
    exact, exact_gates = copy.deepcopy(conv).double(), copy.deepcopy(gates).double()
    z = x.detach().double().requires_grad_()
    expected = by_torch(exact, exact_gates, z, ties)
    assert_close(y, expected)
    gradient = torch.randn_like(y)
    y.backward(gradient)
    expected.backward(gradient.double())
    # Where norms are equal up to rounding, float32 may take another vector than float64.
    tolerance = 1e-3 if ties == "first" else 1e-5
    pairs = [(conv.weights, exact.weights), (conv.bias, exact.bias), (gates.bias, exact_gates.bias)]
    for mine, its in [*pairs, *([(x, z)] if hidden else [])]:
        assert_close(mine.grad, its.grad, tolerance)


@pytest.mark.parametrize(("shape", "ties"), CASES, ids=str)
@pytest.mark.parametrize("group", GROUPS)
def test_one_image_at_a_time(instruction_set, group, shape, ties):  # noqa: F811
    hidden, fields_in, fields_out, side, padding = shape
    conv, gates = make_layer(group, hidden, fields_in, fields_out, padding)
    x = torch.randn(2, conv.in_type.size, side, side)
    with torch.no_grad():
        expected = by_torch(
            copy.deepcopy(conv).double(), copy.deepcopy(gates).double(), x.double(), ties
        )
        assert_close(through_kernels(conv, gates, x, ties, block=1), expected)


@pytest.mark.parametrize("ties", ["shared", "first"])
@pytest.mark.parametrize("group", GROUPS)
def test_zero_windows_are_zero_with_finite_gradients(group, ties):
    conv, gates = make_layer(group, True, 2, 2, 1)
    torch.nn.init.zeros_(conv.bias)
    x = torch.zeros(3, conv.in_type.size, 8, 8, requires_grad=True)
    y = through_kernels(conv, gates, x, ties)
    assert torch.equal(y, torch.zeros_like(y))
    y.sum().backward()
    for gradient in (x.grad, conv.weights.grad, conv.bias.grad, gates.bias.grad):
        assert torch.isfinite(gradient).all()
    assert x.grad.abs().max() > 0


@pytest.mark.parametrize("size", [1e-8, 1.0, 1e6, 1e12])
def test_large_and_small_numbers(instruction_set, size):  # noqa: F811
    conv, gates = make_layer("O2", True, 2, 2, 1)
    x = size * torch.randn(3, conv.in_type.size, 8, 8)
    expected = by_torch(
        copy.deepcopy(conv).double(), copy.deepcopy(gates).double(), x.double(), "shared"
    )
    assert_close(through_kernels(conv, gates, x, "shared"), expected)


@pytest.mark.parametrize("block", [1, BLOCK])
@pytest.mark.parametrize("ties", [None, "shared", "first"])
def test_not_a_number_is_passed_on(instruction_set, ties, block):  # noqa: F811
    conv, gates = make_layer("SO2", True, 2, 2, 1)
    x = torch.randn(4, conv.in_type.size, 8, 8)
    x[1, 3, 2, 2] = float("nan")
    with torch.no_grad():
        y = through_kernels(conv, gates, x, ties, block)
    assert y[1].isnan().any() and torch.isfinite(y[[0, 2, 3]]).all()


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("kind", ["trivial", "hidden"])
def test_spectral_weights_are_as_many_as_the_steerable_ones(group, kind):
    basis = spectral_basis(SymmetryGroup(group), kind)
    weights = {"SO2": {"trivial": 14, "hidden": 60}, "O2": {"trivial": 14, "hidden": 45}}
    assert (
        basis.expansion.shape == (weights[group][kind], weights[group][kind]) == (basis.size,) * 2
    )
    assert torch.linalg.matrix_rank(basis.expansion.double()) == basis.size


def test_what_is_not_served_is_refused():
    group = SymmetryGroup("O2")
    conv, gates = make_layer("O2", True, 2, 2, 1)
    x = torch.randn(1, 2, 8, 8, 8, BLOCK)
    native.gated_block(conv, gates, x)
    with pytest.raises(ValueError, match="ReLU commutes with regular fields"):
        plain = SteerableConv(FieldType.hidden(group, 2), FieldType.hidden(group, 2), padding=1)
        native.conv_block(plain, x)
    with pytest.raises(ValueError, match="expected fields with their gates"):
        native.gated_block(plain, gates, x)
    wide = SteerableConv(conv.in_type, conv.out_type, kernel_size=5)
    with pytest.raises(ValueError, match="3 x 3 convolutions"):
        native.gated_block(wide, gates, x)
    with pytest.raises(ValueError, match="expected maps"):
        native.gated_block(conv, gates, x[:, :, :, :, :7])
    with pytest.raises(ValueError, match="even and at least 2"):
        native.gated_block(conv, gates, x[:, :, :7].contiguous(), "shared")
