"""The laws of the groups, and that elements act as hand-written matrices say."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equirl.symmetry import Element, SymmetryGroup

GROUPS = ("C2", "C3", "C4", "C8", "D2", "D3", "D4", "D8")
CONTINUOUS = ("SO2", "O2")
elements = st.builds(Element, st.floats(-10, 10), st.booleans())
names = st.one_of(
    st.builds("{}{}".format, st.sampled_from("CD"), st.integers(2, 12)), st.sampled_from(CONTINUOUS)
)


@st.composite
def groups_and_elements(draw, count):
    """A group and some of its elements, by angles up to many turns."""
    group = SymmetryGroup(draw(names))
    if group.is_finite:
        turns = st.integers(-50, 50).map(lambda k: math.tau * k / group.rotations)
    else:
        turns = st.floats(-100, 100)
    flips = st.booleans() if group.reflections else st.just(False)
    return group, *(Element(draw(turns), draw(flips)) for _ in range(count))


def matrix(element):
    """Rotation x -> y after the reflection y -> -y, written out."""
    c, s = math.cos(element.angle), math.sin(element.angle)
    return np.array([[c, -s], [s, c]]) @ np.diag([1, -1 if element.reflected else 1])


@given(elements, elements)
def test_composition_is_the_product_of_matrices(g, h):
    np.testing.assert_allclose(matrix(g @ h), matrix(g) @ matrix(h), atol=1e-12)


@given(elements)
def test_inverse_undoes(g):
    for product in (g @ g.inverse(), g.inverse() @ g):
        np.testing.assert_allclose(matrix(product), np.eye(2), atol=1e-12)


@given(groups_and_elements(3))
def test_the_laws_of_a_group(drawn):
    group, g, h, k = drawn
    identity = Element(0.0)
    assert all(element in group for element in (g, h, k, g @ h, g.inverse(), identity))
    for left, right in (
        ((g @ h) @ k, g @ (h @ k)),
        (g @ identity, g),
        (identity @ g, g),
        (g @ g.inverse(), identity),
        (g.inverse() @ g, identity),
        ((g @ h).inverse(), h.inverse() @ g.inverse()),
    ):
        assert left.reflected == right.reflected
        np.testing.assert_allclose(matrix(left), matrix(right), atol=1e-11)


@given(groups_and_elements(1), st.floats(0.01, 0.99))
def test_membership(drawn, part):
    group, g = drawn
    between = Element(g.angle + part * math.tau / (group.rotations if group.is_finite else 1))
    assert (between in group) == (not group.is_finite)
    assert (Element(g.angle, True) in group) == group.reflections


@given(elements)
def test_cos_sin_is_the_angle(g):
    np.testing.assert_allclose(g.cos_sin, (math.cos(g.angle), math.sin(g.angle)), atol=1e-12)


@pytest.mark.parametrize("turns", range(-5, 6))
def test_quarter_turns_are_exact(turns):
    element = Element(turns * math.pi / 2)
    assert element.quarter_turns == turns % 4
    assert element.preserves_grid
    assert set(map(abs, element.cos_sin)) == {0.0, 1.0}


@pytest.mark.parametrize("angle", [0.1, math.pi / 4, math.pi / 2 + 1e-6])
def test_other_angles_do_not_preserve_the_grid(angle):
    assert Element(angle).quarter_turns is None
    assert not Element(angle).preserves_grid


@pytest.mark.parametrize("name", GROUPS)
def test_group_is_closed_and_counts_its_elements(name):
    group = SymmetryGroup(name)
    matrices = [matrix(g) for g in group.elements]
    assert len(matrices) == group.order == int(name[1:]) * (2 if name[0] == "D" else 1)
    np.testing.assert_allclose(matrices[0], np.eye(2), atol=1e-15)
    for g in group.elements:
        for h in group.elements:
            product = matrix(g @ h)
            assert sum(np.allclose(product, m, atol=1e-9) for m in matrices) == 1


@pytest.mark.parametrize(
    ("name", "count"),
    [
        *[("C2", 2), ("C3", 1), ("C4", 4), ("C8", 4), ("SO2", 4)],
        *[("D2", 4), ("D3", 2), ("D4", 8), ("D8", 8), ("O2", 8)],
    ],
)
def test_grid_elements_are_those_shared_with_d4(name, count):
    group = SymmetryGroup(name)
    assert len(set(group.grid_elements)) == count
    assert all(g in group and g.preserves_grid for g in group.grid_elements)
    assert group.has_quarter_turns == (Element(math.pi / 2) in group)


@pytest.mark.parametrize("name", GROUPS)
def test_all_elements_of_a_finite_group_are_some(name):
    group = SymmetryGroup(name)
    assert group.is_finite
    assert group.some_elements() == group.some_elements(3) == group.elements


@pytest.mark.parametrize("rotations", [1, 5, 8])
@pytest.mark.parametrize("name", CONTINUOUS)
def test_some_elements_of_a_continuous_group_are_a_subgroup(name, rotations):
    group = SymmetryGroup(name)
    some = group.some_elements(rotations)
    assert len(some) == rotations * (2 if name == "O2" else 1)
    assert len(group.some_elements()) == 32 * (2 if name == "O2" else 1)
    assert some[0] == Element(0.0) and all(element in group for element in some)
    matrices = [matrix(g) for g in some]
    for g in matrices:
        for h in matrices:
            assert sum(np.allclose(g @ h, m, atol=1e-9) for m in matrices) == 1


@pytest.mark.parametrize("attribute", ["order", "elements", "rotations"])
@pytest.mark.parametrize("name", CONTINUOUS)
def test_a_continuous_group_cannot_be_counted(name, attribute):
    group = SymmetryGroup(name)
    assert not group.is_finite and group.has_quarter_turns
    assert group.reflections == (name == "O2")
    with pytest.raises(ValueError, match=f"^{name} has infinitely many elements"):
        getattr(group, attribute)


def test_names_are_case_insensitive_and_groups_compare_by_name():
    assert SymmetryGroup(" d4 ") == SymmetryGroup("D4") == SymmetryGroup(SymmetryGroup("D4"))
    assert len({SymmetryGroup("d4"), SymmetryGroup("D4"), SymmetryGroup("C4")}) == 2
    assert repr(SymmetryGroup("d4")) == "SymmetryGroup('D4')"
    assert SymmetryGroup("so2") == SymmetryGroup("SO2") != SymmetryGroup("O2")
    assert [SymmetryGroup(name).name for name in ("so2", " o2")] == ["SO2", "O2"]


@pytest.mark.parametrize(
    "name", ["C1", "D0", "SO3", "O", "O1", "SO2x", "E4", "4", "", "C4x", "C-4"]
)
def test_other_names_are_refused_with_the_value(name):
    with pytest.raises(ValueError, match="unknown symmetry group") as error:
        SymmetryGroup(name)
    assert repr(name) in str(error.value)
