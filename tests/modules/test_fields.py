"""Field types transform as hand-written matrices say."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from equirl.modules import FieldType, SteerableLinear
from equirl.symmetry import ACTION, Element, Representation, SymmetryGroup

C2, C4, D2, D4, SO2, O2 = map(SymmetryGroup, ("C2", "C4", "D2", "D4", "SO2", "O2"))
QUARTER, FLIP = Element(math.pi / 2), Element(0.0, reflected=True)


@st.composite
def fields_and_elements(draw):
    """Fields of any group, with every kind that the group has, and two of its elements."""
    name = st.builds("{}{}".format, st.sampled_from("CD"), st.integers(2, 12))
    group = SymmetryGroup(draw(st.one_of(name, st.sampled_from(["SO2", "O2"]))))
    irreps = st.lists(st.sampled_from(["trivial", "sign", "vector"]), min_size=1, max_size=4)
    fields = FieldType.of(group, Representation(*draw(irreps))) + FieldType.hidden(group, 2)
    if group.is_finite:
        turns = st.integers(-30, 30).map(lambda k: math.tau * k / group.rotations)
    else:
        turns = st.floats(-10, 10)
    flips = st.booleans() if group.reflections else st.just(False)
    return fields, *(Element(draw(turns), draw(flips)) for _ in range(2))


def matrix(fields, element):
    """What an element does to the channels."""
    return fields.transform(torch.eye(fields.size, dtype=torch.float64), element).T


def test_a_regular_field_is_a_function_on_the_group():
    field = FieldType.regular(C4, 1)
    assert field.transform(torch.arange(4.0), QUARTER).tolist() == [3, 0, 1, 2]
    # The reflection takes r^k to f r^k = r^-k f: position 4 - k becomes 8 - k.
    field, one = FieldType.regular(D4, 1), torch.eye(8)
    assert field.transform(one[1], FLIP).argmax() == 7
    assert field.transform(one[4], QUARTER).argmax() == 5


@given(fields_and_elements())
def test_transform_is_an_orthogonal_representation(drawn):
    fields, g, h = drawn
    of_g, identity = matrix(fields, g), torch.eye(fields.size, dtype=torch.float64)
    # Angles within 1e-12 of a quarter turn are taken for it.
    close = {"atol": 1e-10, "rtol": 0}
    torch.testing.assert_close(of_g @ matrix(fields, h), matrix(fields, g @ h), **close)
    torch.testing.assert_close(of_g @ of_g.T, identity, **close)
    torch.testing.assert_close(matrix(fields, g.inverse()), of_g.T, **close)
    assert torch.equal(matrix(fields, Element(0.0)), identity)


@pytest.mark.parametrize("reflected", [False, True])
@pytest.mark.parametrize("kind", ["vector", "vector_2", "vector_3"])
def test_a_vector_of_frequency_k_turns_by_k_times_the_angle(kind, reflected):
    k, angle = {"vector": 1, "vector_2": 2, "vector_3": 3}[kind], 0.7
    c, s = math.cos(k * angle), math.sin(k * angle)
    expected = np.array([[c, -s], [s, c]]) @ np.diag([1, -1 if reflected else 1])
    np.testing.assert_allclose(
        matrix(FieldType(O2, (kind,)), Element(angle, reflected)), expected, atol=1e-12
    )


def test_hidden_fields():
    assert FieldType.hidden(D4, 2) == FieldType.regular(D4, 2)
    assert FieldType.hidden(SO2, 1).fields == ("trivial", "vector", "vector_2", "vector_3")
    assert FieldType.hidden(O2, 1).fields == ("trivial", "sign", "vector", "vector_2", "vector_3")
    assert (FieldType.hidden(SO2, 3).size, FieldType.hidden(O2, 3).size) == (21, 24)
    assert FieldType.hidden(SO2, 2).fields == FieldType.hidden(SO2, 1).fields * 2
    assert FieldType.hidden(D4, 1).is_permuted and not FieldType.hidden(O2, 1).is_permuted
    assert not FieldType.hidden(O2, 1).is_regular and FieldType.trivial(O2, 2).is_permuted


def test_channels_of_irreducible_fields():
    channels = FieldType(O2, ("sign", "vector", "trivial", "vector_3")).channels()
    assert channels.field_of.tolist() == [0, 1, 1, 2, 3, 3]
    assert channels.first.tolist() == [0, 1, 3, 4]
    assert channels.second.tolist() == [0, 2, 3, 5]
    assert channels.has_second.tolist() == [False, True, False, True]
    with pytest.raises(ValueError, match=r"irreducible fields, got C4\[1 trivial \+ 1 regular\]"):
        (FieldType.trivial(C4, 1) + FieldType.regular(C4, 1)).channels()


@pytest.mark.parametrize("group", [C2, C4, D2, D4, SO2, O2], ids=str)
def test_the_action_is_restricted_not_changed(group):
    field, action = FieldType.of(group, ACTION), torch.randn(6, 5, dtype=torch.float64)
    assert field.size == 5
    for g in group.some_elements(7):
        expected = ACTION.transform(action, g)
        torch.testing.assert_close(field.transform(action, g), expected, atol=1e-12, rtol=0)


def test_restrictions_merge_and_split_blocks():
    assert FieldType.of(C4, ACTION).fields == ("trivial", "vector", "trivial", "trivial")
    assert FieldType.of(C2, ACTION).kinds == ("trivial", "vector_x")
    assert FieldType.of(D2, ACTION).kinds == ("trivial", "vector_x", "vector_y", "sign")
    assert FieldType.of(SO2, ACTION).fields == FieldType.of(C4, ACTION).fields
    assert FieldType.of(O2, ACTION).fields == ("trivial", "vector", "trivial", "sign")


def test_only_invariant_parts_have_a_bias():
    field = FieldType.regular(D4, 1) + FieldType.of(D4, ACTION)
    index, factor = field.bias_layout()
    assert field.bias_count == 3
    assert index == [0] * 8 + [1, 0, 0, 2, 0]
    assert factor == [8**-0.5] * 8 + [1.0, 0.0, 0.0, 1.0, 0.0]
    index, factor = FieldType.hidden(O2, 2).bias_layout()
    assert index == [0] * 8 + [1] + [0] * 7
    assert factor == ([1.0] + [0.0] * 7) * 2


def test_str_counts_the_fields():
    assert str(FieldType.regular(C4, 2) + FieldType.trivial(C4, 1)) == "C4[2 regular + 1 trivial]"


def test_wrong_sizes_elements_and_groups_are_refused():
    with pytest.raises(ValueError, match="8 channels"):
        FieldType.regular(D4, 1).transform(torch.zeros(7), FLIP)
    with pytest.raises(ValueError, match="not an element"):
        FieldType.regular(C4, 1).transform(torch.zeros(4), FLIP)
    with pytest.raises(
        ValueError, match="SO2 has no field 'regular': expected one of trivial, vec"
    ):
        FieldType.regular(SO2, 1)
    with pytest.raises(ValueError, match="cannot add"):
        FieldType.regular(C4, 1) + FieldType.regular(D4, 1)


@pytest.mark.parametrize(
    ("group", "field"),
    [
        ("C4", "tirvial"),
        ("C4", "sign"),  # trivial, without reflections
        ("C4", "vector_2"),  # of a right angle it makes a half turn: two one-dimensional irreps
        ("D3", "vector_2"),
        ("C6", "vector_3"),
        ("D2", "vector"),
        ("D4", "vector_x"),
        ("C2", "vector_y"),
        ("O2", "regular"),
    ],
)
def test_fields_that_a_group_does_not_have_are_refused(group, field):
    with pytest.raises(ValueError, match=f"{group} has no field '{field}': expected one of"):
        FieldType(SymmetryGroup(group), ("trivial", field))


def test_vectors_of_higher_frequency_are_fields_of_large_enough_groups():
    fields = FieldType(SymmetryGroup("D8"), ("vector_2", "vector_3"))
    assert SteerableLinear(fields, fields).weights.shape == (2,)
