"""The laws of the groups, and that elements act as hand-written matrices say."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from equirl.symmetry import Element, SymmetryGroup

GROUPS = ("C2", "C3", "C4", "C8", "D2", "D3", "D4", "D8")
elements = st.builds(Element, st.floats(-10, 10), st.booleans())


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
    [("C2", 2), ("C3", 1), ("C4", 4), ("C8", 4), ("D2", 4), ("D3", 2), ("D4", 8), ("D8", 8)],
)
def test_grid_elements_are_those_shared_with_d4(name, count):
    assert len(SymmetryGroup(name).grid_elements) == count


def test_names_are_case_insensitive_and_groups_compare_by_name():
    assert SymmetryGroup(" d4 ") == SymmetryGroup("D4") == SymmetryGroup(SymmetryGroup("D4"))
    assert len({SymmetryGroup("d4"), SymmetryGroup("D4"), SymmetryGroup("C4")}) == 2
    assert repr(SymmetryGroup("d4")) == "SymmetryGroup('D4')"


@pytest.mark.parametrize("name", ["C1", "D0", "SO2", "O2", "E4", "4", "", "C4x", "C-4"])
def test_other_names_are_refused_with_the_value(name):
    with pytest.raises(ValueError, match="unknown symmetry group") as error:
        SymmetryGroup(name)
    assert repr(name) in str(error.value)
