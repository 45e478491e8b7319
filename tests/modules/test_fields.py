"""Field types transform as hand-written matrices say."""

import math

import pytest
import torch

from equirl.modules import FieldType, GroupMaxPool
from equirl.symmetry import ACTION, Element, SymmetryGroup

C2, C4, D2, D4 = map(SymmetryGroup, ("C2", "C4", "D2", "D4"))
QUARTER, FLIP = Element(math.pi / 2), Element(0.0, reflected=True)


def test_a_regular_field_is_a_function_on_the_group():
    field = FieldType.regular(C4, 1)
    assert field.transform(torch.arange(4.0), QUARTER).tolist() == [3, 0, 1, 2]
    # The reflection takes r^k to f r^k = r^-k f: position 4 - k becomes 8 - k.
    field, one = FieldType.regular(D4, 1), torch.eye(8)
    assert field.transform(one[1], FLIP).argmax() == 7
    assert field.transform(one[4], QUARTER).argmax() == 5


@pytest.mark.parametrize("group", [C2, C4, D2, D4], ids=str)
def test_transform_is_a_homomorphism(group):
    field = FieldType.regular(group, 2) + FieldType.of(group, ACTION)
    x = torch.randn(3, field.size, dtype=torch.float64)
    for g in group.elements:
        for h in group.elements:
            twice = field.transform(field.transform(x, h), g)
            torch.testing.assert_close(field.transform(x, g @ h), twice)


@pytest.mark.parametrize("group", [C2, C4, D2, D4], ids=str)
def test_the_action_is_restricted_not_changed(group):
    field, action = FieldType.of(group, ACTION), torch.randn(6, 5, dtype=torch.float64)
    assert field.size == 5
    for g in group.elements:
        expected = ACTION.transform(action, g)
        torch.testing.assert_close(field.transform(action, g), expected, atol=1e-12, rtol=0)


def test_restrictions_merge_and_split_blocks():
    assert FieldType.of(C4, ACTION).fields == ("trivial", "vector", "trivial", "trivial")
    assert FieldType.of(C2, ACTION).kinds == ("trivial", "vector_x")
    assert FieldType.of(D2, ACTION).kinds == ("trivial", "vector_x", "vector_y", "sign")


def test_only_invariant_parts_have_a_bias():
    field = FieldType.regular(D4, 1) + FieldType.of(D4, ACTION)
    index, factor = field.bias_layout()
    assert field.bias_count == 3
    assert index == [0] * 8 + [1, 0, 0, 2, 0]
    assert factor == [8**-0.5] * 8 + [1.0, 0.0, 0.0, 1.0, 0.0]


def test_str_counts_the_fields():
    assert str(FieldType.regular(C4, 2) + FieldType.trivial(C4, 1)) == "C4[2 regular + 1 trivial]"


def test_wrong_sizes_elements_and_groups_are_refused():
    with pytest.raises(ValueError, match="8 channels"):
        FieldType.regular(D4, 1).transform(torch.zeros(7), FLIP)
    with pytest.raises(ValueError, match="not an element"):
        FieldType.regular(C4, 1).transform(torch.zeros(4), FLIP)
    with pytest.raises(ValueError, match="cannot add"):
        FieldType.regular(C4, 1) + FieldType.regular(D4, 1)


def test_pooling_takes_the_maximum_of_each_field():
    pool = GroupMaxPool(FieldType.regular(C4, 2))
    x = torch.tensor([[0.0, 3, 1, 2, -4, -3, -5, -3]])
    assert pool(x).tolist() == [[3, -3]]
    assert pool.out_type == FieldType.trivial(C4, 2)


def test_pooling_shares_the_gradient_of_a_tie():
    x = torch.tensor([1.0, 2, 2, 0], requires_grad=True)
    GroupMaxPool(FieldType.regular(C4, 1))(x).sum().backward()
    assert x.grad.tolist() == [0, 0.5, 0.5, 0]


def test_pooling_refuses_other_fields():
    with pytest.raises(ValueError, match="only regular fields"):
        GroupMaxPool(FieldType.trivial(C4, 2))
