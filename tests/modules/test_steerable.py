"""Our layers against escnn's with the same weights, and as well-behaved torch modules."""

import copy
import math
import pickle

import pytest
import torch
from escnn.nn.init import _generalized_he_init_variances
from escnn_reference import escnn_convolution
from torch.func import functional_call, stack_module_state, vmap

from equirl.modules import FieldType, SteerableConv, SteerableLinear
from equirl.modules.nonlinearity import make_activation
from equirl.symmetry import ACTION, ACTION_PAPER, SymmetryGroup

slow = pytest.mark.slow
ALL_GROUPS = ("C4", "D4", *(pytest.param(g, marks=slow) for g in ("C2", "D2", "C3", "D3")))
ALL_GROUPS += ("C8", "D8", "SO2", "O2")


def randomise(layer):
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.normal_()
    return layer


def field_types(group, name):
    """Fields in and out of the layers there are; for SO(2) and O(2) with the gates."""
    group = SymmetryGroup(group)

    def hidden(count):
        return FieldType.hidden(group, count)

    def gated(count):  # regular fields need no gates
        return make_activation(hidden(count)).in_type

    def trivial(count):
        return FieldType.trivial(group, count)

    action, of_paper = FieldType.of(group, ACTION), FieldType.of(group, ACTION_PAPER)
    return {
        "input": (trivial(2), gated(3)),
        "hidden": (hidden(2), gated(3)),
        "actor": (hidden(3), action + trivial(4)),
        "paper actor": (hidden(3), of_paper + trivial(5)),
        "critic": (hidden(3) + action, gated(2)),
        "value": (trivial(3), trivial(1)),
        "shuffled": (action + hidden(1) + trivial(1), trivial(1) + gated(2)),
    }[name]


@pytest.mark.parametrize("padding", [0, 1])
@pytest.mark.parametrize("types", ["input", "hidden", "shuffled"])
@pytest.mark.parametrize("group", ALL_GROUPS)
def test_convolution_equals_escnn(group, types, padding):
    torch.manual_seed(0)
    ours = randomise(SteerableConv(*field_types(group, types), padding=padding))
    theirs = escnn_convolution(ours)
    x = torch.randn(2, ours.in_type.size, 6, 6)
    expected = theirs(theirs.in_type(x)).tensor
    torch.testing.assert_close(ours(x), expected, atol=1e-5, rtol=1e-5)
    precise = ours.double()(x.double())
    assert precise.dtype == torch.float64
    torch.testing.assert_close(precise, expected.double(), atol=2e-5, rtol=1e-5)


@pytest.mark.parametrize("types", ["hidden", "actor", "paper actor", "critic", "value", "shuffled"])
@pytest.mark.parametrize("group", ALL_GROUPS)
def test_linear_equals_escnn(group, types):
    torch.manual_seed(0)
    ours = randomise(SteerableLinear(*field_types(group, types)))
    theirs = escnn_convolution(ours)
    x = torch.randn(4, ours.in_type.size)
    expected = theirs(theirs.in_type(x[..., None, None])).tensor.flatten(1)
    torch.testing.assert_close(ours(x), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("types", ["hidden", "shuffled"])
@pytest.mark.parametrize("group", ALL_GROUPS)
def test_gradients_equal_escnn(group, types):
    torch.manual_seed(0)
    ours = randomise(SteerableConv(*field_types(group, types), padding=1))
    theirs = escnn_convolution(ours)
    x = torch.randn(2, ours.in_type.size, 5, 5, requires_grad=True)
    mine, its = ours(x), theirs(theirs.in_type(x)).tensor
    towards = torch.randn_like(mine)
    gradients = torch.autograd.grad(mine, [x, ours.weights, ours.bias], towards)
    expected = torch.autograd.grad(its, [x, theirs.weights, theirs.bias], towards)
    for gradient, other in zip(gradients, expected, strict=True):
        assert (gradient - other).abs().max() < 1e-5 * other.abs().max()


@pytest.mark.parametrize("types", ["input", "hidden", "critic", "actor"])
@pytest.mark.parametrize("group", ALL_GROUPS)
def test_initial_variance_is_that_of_escnn(group, types):
    torch.manual_seed(1)
    layers = [SteerableConv(*field_types(group, types)) for _ in range(40)]
    deviations = _generalized_he_init_variances(escnn_convolution(layers[0])._basisexpansion)
    weights = torch.stack([layer.weights.detach() for layer in layers])
    for deviation in deviations.unique():
        z = weights[:, deviations == deviation] / deviation
        tolerance = 5 * math.sqrt(2 / z.numel())
        assert abs(z.var().item() - 1) < tolerance
        assert abs(z.mean().item()) < 5 / math.sqrt(z.numel())


def basis(layer):
    """The layer's filters of one weight each."""
    filters = []
    with torch.no_grad():
        for index in range(layer.weights.numel()):
            layer.weights.zero_()[index] = 1
            filters.append(layer.filter().clone())
    return torch.stack(filters)


def test_float64_is_not_rounded_and_leaves_other_layers_alone():
    types = field_types("D4", "hidden")
    single, double = SteerableConv(*types), SteerableConv(*types)
    before = basis(single)
    exact = basis(double.double())
    assert (before.dtype, exact.dtype) == (torch.float32, torch.float64)
    assert torch.equal(before, exact.float())
    assert not torch.equal(before.double(), exact)
    assert torch.equal(basis(double.float().double()), exact)
    assert torch.equal(basis(single), before)


def test_state_dict_is_parameters_in_either_mode():
    layer = SteerableConv(*field_types("D4", "hidden"))
    training = {key: value.clone() for key, value in layer.train().state_dict().items()}
    assert set(training) == {"weights", "bias"} == set(layer.eval().state_dict())
    other = SteerableConv(*field_types("D4", "hidden")).eval()
    other.load_state_dict(training)
    x = torch.randn(1, 16, 5, 5)
    assert torch.equal(layer(x), other(x))
    with torch.no_grad():  # eval mode is not a frozen snapshot
        other.weights.mul_(2)
    assert not torch.equal(layer(x), other(x))


def test_pickle_and_deepcopy():
    layer, x = SteerableConv(*field_types("D4", "shuffled")), torch.randn(1, 14, 5, 5)
    expected = layer(x)
    for other in (pickle.loads(pickle.dumps(layer)), copy.deepcopy(layer)):
        assert torch.equal(other(x), expected)
        assert other.double()(x.double()).dtype == torch.float64
        assert torch.equal(layer(x), expected)


def test_vmap_over_stacked_parameters():
    layers = [SteerableConv(*field_types("D4", "shuffled")) for _ in range(3)]
    parameters, _ = stack_module_state(layers)
    x = torch.randn(2, 14, 5, 5)
    out = vmap(lambda p: functional_call(layers[0], p, (x,)))(parameters)
    torch.testing.assert_close(out, torch.stack([layer(x) for layer in layers]))


def test_filter_comes_out_channels_last():
    filter = SteerableConv(*field_types("D4", "hidden")).filter()
    assert filter.is_contiguous(memory_format=torch.channels_last)


def test_a_generator_makes_the_weights_reproducible():
    types = field_types("D4", "critic")

    def weights(seed):
        return SteerableLinear(*types, generator=torch.Generator().manual_seed(seed)).weights

    before = torch.get_rng_state()
    assert torch.equal(weights(3), weights(3))
    assert not torch.equal(weights(3), weights(4))
    assert torch.equal(before, torch.get_rng_state())


def test_impossible_maps_are_refused():
    c4, d4 = SymmetryGroup("C4"), SymmetryGroup("D4")
    with pytest.raises(ValueError, match="one group"):
        SteerableConv(FieldType.trivial(c4, 1), FieldType.trivial(d4, 1))
    with pytest.raises(ValueError, match="zero map"):
        SteerableLinear(FieldType.trivial(d4, 1), FieldType(d4, ("sign",)))


def test_repr_names_the_fields():
    assert "D4[2 trivial] -> D4[3 regular]" in repr(SteerableConv(*field_types("D4", "input")))
