"""Activations: what they compute, and that every element of a group commutes with them."""

import math

import pytest
import torch
from torch.func import functional_call

from equirl.modules import FieldReLU, FieldType, GatedNonlinearity
from equirl.modules.nonlinearity import OPEN, make_activation
from equirl.symmetry import Element, SymmetryGroup

C4, D4, SO2, O2 = map(SymmetryGroup, ("C4", "D4", "SO2", "O2"))


def randomised(fields):
    activation = GatedNonlinearity(fields).double()
    torch.nn.init.normal_(activation.bias)
    return activation


def test_gates_by_hand():
    """One gate for each field, its sigmoid 1/2 at 0 and 3/4 at log 3; the bias adds to it."""
    activation = GatedNonlinearity(FieldType(O2, ("sign", "vector")))
    assert activation.in_type.fields == ("sign", "vector", "trivial", "trivial")
    assert activation.out_type.fields == ("sign", "vector")
    x = torch.tensor([-2.0, 3.0, 4.0, 0.0, math.log(3)])
    torch.nn.init.zeros_(activation.bias)
    torch.testing.assert_close(activation(x), torch.tensor([-1.0, 2.25, 3.0]))
    with torch.no_grad():
        activation.bias.copy_(torch.tensor([math.log(3), -math.log(3)]))
    torch.testing.assert_close(activation(x), torch.tensor([-1.5, 1.5, 2.0]))


@pytest.mark.parametrize("group", [SO2, O2], ids=str)
def test_gates_start_nearly_open(group):
    """Seven half open ones, one after the other, would let less than a hundredth through."""
    fields = FieldType.hidden(group, 2)
    activation, values = GatedNonlinearity(fields), torch.randn(3, fields.size)
    x = torch.cat([values, torch.zeros(3, len(fields.fields))], -1)
    torch.testing.assert_close(activation(x), values * torch.tensor(OPEN).sigmoid())
    assert torch.tensor(OPEN).sigmoid() ** 7 > 0.3


@pytest.mark.parametrize("element", [Element(0.7), Element(-2.0, True), Element(math.pi / 2)])
def test_every_element_commutes_with_gates(element):
    activation = randomised(FieldType.hidden(O2, 3))
    x = torch.randn(5, activation.in_type.size, dtype=torch.float64)
    turned = activation(activation.in_type.transform(x, element))
    expected = activation.out_type.transform(activation(x), element)
    torch.testing.assert_close(turned, expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("activation", [randomised(FieldType.hidden(O2, 2)), FieldReLU])
def test_any_dimension_may_hold_the_channels(activation):
    if activation is FieldReLU:
        activation = FieldReLU(FieldType.regular(D4, 2))
    images = torch.randn(2, activation.in_type.size, 4, 6, dtype=torch.float64)
    last = activation(images.movedim(1, -1).clone())
    assert last.shape == (2, 4, 6, activation.out_type.size)
    assert torch.equal(activation(images, dim=1), last.movedim(-1, 1))


def test_gradients_of_gates_are_derivatives():
    activation = randomised(FieldType.hidden(O2, 2))
    x = torch.randn(2, activation.in_type.size, dtype=torch.float64, requires_grad=True)

    def call(x, bias):
        return functional_call(activation, {"bias": bias}, (x,))

    assert torch.autograd.gradcheck(call, (x, activation.bias))


def test_a_relu_is_pointwise_and_for_permuted_channels_only():
    relu = FieldReLU(FieldType.regular(C4, 1) + FieldType.trivial(C4, 1))
    x = torch.tensor([-1.0, 2, -3, 4, -5])
    assert relu(x).tolist() == [0, 2, 0, 4, 0]
    assert x.tolist() == [-1, 2, -3, 4, -5]  # it is left alone
    assert relu.in_type == relu.out_type
    for fields in (FieldType.hidden(SO2, 1), FieldType(D4, ("regular", "sign"))):
        with pytest.raises(ValueError, match="a ReLU commutes with regular and trivial fields"):
            FieldReLU(fields)


def test_gates_of_regular_fields_are_refused():
    with pytest.raises(ValueError, match="irreducible fields"):
        GatedNonlinearity(FieldType.regular(D4, 2))


def test_other_channels_are_refused():
    for activation in (
        FieldReLU(FieldType.regular(D4, 1)),
        GatedNonlinearity(FieldType.hidden(SO2, 1)),
    ):
        with pytest.raises(ValueError, match="expected (8|11) channels in dimension 1 for"):
            activation(torch.zeros(2, 9, 4, 4), dim=1)


def test_the_group_chooses_the_activation():
    assert isinstance(make_activation(FieldType.hidden(D4, 2)), FieldReLU)
    assert isinstance(make_activation(FieldType.hidden(SO2, 2)), GatedNonlinearity)
