"""The report moves pictures and fields by arithmetic of its own, which is right."""

import itertools
import math

import numpy as np
import pytest
import torch

from equirl.modules import FieldType
from equirl.symmetry import Element, ScalarField, SymmetryGroup
from equirl.symmetry.audit_transforms import (
    field_matrix,
    interpolate_image,
    transform_deviations,
    transform_fields,
)
from tests.symmetry.report_networks import FIELDS, FLIP, HALF, QUARTER, SEEN


def test_a_regular_field_is_a_function_on_the_group():
    group = SymmetryGroup("C4")
    moved = transform_fields(np.array([1.0, 2, 3, 4]), ["regular"], QUARTER, group)
    assert moved.tolist() == [4, 1, 2, 3]  # the value at h is now at g h
    group = SymmetryGroup("D2")  # (g f)(h) = f(g^-1 h): a reflection exchanges h and g h
    values = np.array([1.0, 2, 3, 4])  # at 0, half a turn, flip, flip and half a turn
    assert transform_fields(values, ["regular"], FLIP, group).tolist() == [3, 4, 1, 2]
    turned_flip = Element(math.pi, reflected=True)
    assert transform_fields(values, ["regular"], turned_flip, group).tolist() == [4, 3, 2, 1]


@pytest.mark.parametrize("name", ["C4", "D4", "C3", "D3", "D8"])
def test_fields_obey_the_group_law_and_agree_with_those_of_the_networks(name):
    group = SymmetryGroup(name)
    for field, (g, h) in itertools.product(FIELDS, itertools.product(group.elements, repeat=2)):
        both = field_matrix(field, g, group) @ field_matrix(field, h, group)
        np.testing.assert_allclose(field_matrix(field, g @ h, group), both, atol=1e-12)
    last = "sign" if group.reflections else "trivial"
    fields = ("trivial", "regular", "regular", "vector", "vector", last)
    values = torch.randn(5, 2 * group.order + 6, dtype=torch.float64)
    for element in group.elements:
        theirs = FieldType(group, fields).transform(values, element)
        ours = transform_fields(values.numpy(), fields, element, group)
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_irreducible_fields_by_hand():
    group, eighth = SymmetryGroup("O2"), Element(math.pi / 4, reflected=True)
    values = np.array([1.0, 2, 3, 4, 5, 6])
    moved = transform_fields(values, ["vector_2", "sign", "vector", "trivial"], eighth, group)
    root = math.sqrt(0.5)  # vector_2: (1, -2) by a right angle; vector: (4, -5) by half of one
    np.testing.assert_allclose(moved, [2, 1, -3, root * 9, root * -1, 6])
    turned = transform_fields(np.ones(2), ["vector_x", "vector_y"], HALF, SymmetryGroup("D2"))
    assert turned.tolist() == [-1, -1]
    turned = transform_fields(np.ones(2), ["vector_x", "vector_y"], FLIP, SymmetryGroup("D2"))
    assert turned.tolist() == [1, -1]
    matrices = transform_deviations(np.array([1.0, 2, 3]), ["vector", "sign"], QUARTER, group)
    np.testing.assert_allclose(matrices, [2, 0, 0, 1, 3], atol=1e-15)
    with pytest.raises(ValueError, match="regular of a finite group, got 'regular'"):
        field_matrix("regular", FLIP, group)
    with pytest.raises(ValueError, match=r"expected 3 channels, got an array of shape \(6,\)"):
        transform_fields(values, ["vector", "sign"], FLIP, group)


@pytest.mark.parametrize("element", [Element(0.4), Element(-2.1, reflected=True), Element(math.pi)])
def test_a_picture_of_a_plane_is_the_plane_turned(element):
    """Bilinear interpolation is exact for planes; rows are x, columns y."""
    size = 32
    x, y = np.meshgrid(np.arange(size) - 15.5, np.arange(size) - 15.5, indexing="ij")
    moved = interpolate_image((0.3 * x - 0.7 * y)[None, None], element)[0, 0]
    direction = field_matrix("vector", element, SymmetryGroup("O2")) @ [0.3, -0.7]
    inside = np.hypot(x, y) < 15  # elsewhere the border was replicated
    np.testing.assert_allclose(moved[inside], (direction[0] * x + direction[1] * y)[inside])
    picture = SEEN["depth"].double()
    theirs = ScalarField().transform(picture, element)
    np.testing.assert_allclose(interpolate_image(picture.numpy(), element), theirs, atol=1e-9)
