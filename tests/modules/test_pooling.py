"""Pooling over pixels and to invariants: numbers by hand, ties, and what commutes."""

import math

import pytest
import torch

from equirl.modules import FieldMaxPool, FieldType, GroupMaxPool, NormMaxPool, NormPool
from equirl.modules.pooling import make_invariant_pool, make_pixel_pool
from equirl.symmetry import Element, SymmetryGroup
from tests.equivariance import grid_elements, turn_fields, turn_image

C4, D4, SO2, O2 = map(SymmetryGroup, ("C4", "D4", "SO2", "O2"))
ELEMENTS = [Element(0.7), Element(-2.0, True), Element(math.pi / 2)]


def window(*pixels):
    """Maps of 2 x 2 pixels, given row by row as lists of channels."""
    return torch.tensor(pixels, dtype=torch.float64).T.reshape(1, -1, 2, 2)


def random_maps(fields, size=4):
    generator = torch.Generator().manual_seed(0)
    return torch.randn(2, fields.size, size, size, dtype=torch.float64, generator=generator)


def transform(fields, x, element):
    """Turns the channels of maps and leaves the pixels where they are."""
    return fields.transform(x.movedim(1, -1), element).movedim(-1, 1)


def turn(fields, x, turns, flip):
    """Turns channels and pixels."""
    channels = turn_fields(fields)(x.movedim(1, -1), turns, flip).movedim(-1, 1)
    return turn_image(channels, turns, flip)


def test_the_pointwise_maximum():
    pool = FieldMaxPool(FieldType.trivial(C4, 2))
    x = window([1, 5], [3, -2], [2, 0], [-7, 4])
    assert pool(x).flatten().tolist() == [3, 5]
    for fields in (FieldType.hidden(SO2, 1), FieldType(D4, ("sign",))):
        with pytest.raises(ValueError, match="a maximum commutes with regular and trivial fields"):
            FieldMaxPool(fields)


def test_shares_of_norms_by_hand():
    """A share is proportional to the norm's fourth power: 1, 16 and 0 of 17."""
    pool = NormMaxPool(FieldType(O2, ("vector", "sign")))
    x = window([0, 1, -1], [2, 0, 0], [0, 0, 0], [0, 0, 2])
    expected = torch.tensor([2 * 16 / 17, 1 / 17, (-1 + 2 * 16) / 17], dtype=torch.float64)
    torch.testing.assert_close(pool(x).flatten(), expected, atol=1e-9, rtol=0)


def test_ties_are_shared_or_the_first_is_taken():
    fields = FieldType(O2, ("vector",))
    x = window([0, 1], [3, 0], [0, 3], [0, -3])
    first = NormMaxPool(fields, ties="first")
    assert first(x).flatten().tolist() == [3, 0]
    assert first(x.transpose(-1, -2)).flatten().tolist() == [0, 3]  # row by row
    shared = NormMaxPool(fields)(window([3, 0], [0, 3], [0, 0], [0, 0]))
    torch.testing.assert_close(shared.flatten(), torch.tensor([1.5, 1.5]).double())
    assert NormMaxPool(fields)(window([0, 0], *[[0, 0]] * 3)).flatten().tolist() == [0, 0]


def test_steep_shares_come_close_to_the_maximum():
    fields = FieldType.hidden(O2, 2)
    x = random_maps(fields).clamp(-1, 1)
    x[..., ::2, 1::2] = 10
    shared, first = NormMaxPool(fields), NormMaxPool(fields, ties="first")
    assert (first(x) == 10).all()
    torch.testing.assert_close(shared(x), first(x), rtol=0, atol=0.01)


def test_the_shared_maximum_is_continuous_where_the_first_jumps():
    x, y = (
        window([1 + 1e-9, 0], [0, 1], *[[0, 0]] * 2),
        window([1, 0], [0, 1 + 1e-9], *[[0, 0]] * 2),
    )
    fields = FieldType(O2, ("vector",))
    shared, first = NormMaxPool(fields), NormMaxPool(fields, ties="first")
    assert (shared(x) - shared(y)).abs().max() < 1e-8
    assert (first(x) - first(y)).abs().max() > 0.9


@pytest.mark.parametrize("ties", ["shared", "first"])
@pytest.mark.parametrize("element", ELEMENTS, ids=str)
def test_every_element_commutes_with_norm_pooling(element, ties):
    fields = FieldType.hidden(O2, 2)
    x = random_maps(fields)
    for pool, channels in ((NormMaxPool(fields, ties), x), (NormPool(fields), x[..., 0, 0])):
        move = transform if channels.ndim == 4 else FieldType.transform
        expected = pool(channels)
        if pool.out_type == fields:
            expected = move(fields, expected, element)
        actual = pool(move(fields, channels, element))
        torch.testing.assert_close(actual, expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("tied", [False, True])
@pytest.mark.parametrize("group", ["C4", "D4", "C2", "D3", "SO2", "O2"])
def test_strict_pooling_turns_with_maps_even_symmetric_ones(group, tied):
    fields = FieldType.hidden(SymmetryGroup(group), 2)
    x = random_maps(fields, 6)
    if tied:  # invariant under the grid's elements: the middle window is tied
        x = torch.stack([turn(fields, x, *g) for g in grid_elements(group)]).mean(0)
    pool = make_pixel_pool(fields)
    for g in grid_elements(group):
        expected = turn(fields, pool(x), *g)
        torch.testing.assert_close(pool(turn(fields, x, *g)), expected, atol=1e-12, rtol=0)
        if tied:
            torch.testing.assert_close(pool(x), expected, atol=1e-12, rtol=0)


def test_the_first_of_ties_breaks_the_symmetry_of_a_symmetric_map():
    fields = FieldType.hidden(SO2, 2)
    x = random_maps(fields, 6)
    x = torch.stack([turn(fields, x, *g) for g in grid_elements("SO2")]).mean(0)
    y = make_pixel_pool(fields, "paper")(x)
    assert (turn(fields, y, 1, False) - y)[..., 1, 1].abs().max() > 0.1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-6, 1.0, 1e6, 1e15])
def test_gradients_are_finite_for_fields_of_any_size(scale, dtype):
    fields = FieldType.hidden(O2, 2)
    for pool in (NormMaxPool(fields), NormMaxPool(fields, "first"), NormPool(fields)):
        x = random_maps(fields).to(dtype) * scale
        x = (x if isinstance(pool, NormMaxPool) else x[..., 0, 0]).requires_grad_()
        y = pool(x)
        (gradient,) = torch.autograd.grad(y.sum(), x)
        assert torch.isfinite(y).all() and torch.isfinite(gradient).all()
        assert gradient.abs().max() < 10


def test_half_precision_neither_overflows_nor_divides_by_zero():
    fields = FieldType.hidden(O2, 1)
    for scale in (0.0, 1.0, 60.0):
        x = (random_maps(fields) * scale).half()
        y = NormMaxPool(fields)(x)
        torch.testing.assert_close(y, NormMaxPool(fields)(x.double()).half(), atol=1e-2, rtol=1e-2)


@pytest.mark.parametrize("ties", ["shared", "first"])
def test_not_a_number_is_passed_on(ties):
    fields = FieldType(O2, ("vector",))
    x = window([3, 0], [float("nan"), 0], [0, 3], [1, 0])
    assert NormMaxPool(fields, ties)(x).isnan().any()


def test_gradients_are_derivatives():
    fields = FieldType.hidden(O2, 1)
    x = random_maps(fields, 2).requires_grad_()
    for ties in ("shared", "first"):
        assert torch.autograd.gradcheck(NormMaxPool(fields, ties), x)
    assert torch.autograd.gradcheck(NormPool(fields), x[..., 0, 0])


def test_norms_by_hand():
    pool = NormPool(FieldType(O2, ("vector", "trivial", "sign", "vector_3")))
    assert pool.out_type == FieldType.trivial(O2, 4)
    x = torch.tensor([[3.0, 4, -2, 1, 0, 0]], dtype=torch.float64)
    expected = torch.tensor([[5.0, 2, 1, 0]], dtype=torch.float64)
    torch.testing.assert_close(pool(x), expected, atol=1.1e-6, rtol=0)


def test_other_fields_ties_and_sizes_are_refused():
    regular, hidden = FieldType.regular(D4, 2), FieldType.hidden(O2, 1)
    for make in (NormMaxPool, NormPool):
        with pytest.raises(ValueError, match=r"irreducible fields, got D4\[2 regular\]"):
            make(regular)
    with pytest.raises(ValueError, match="ties='last': expected shared or first"):
        NormMaxPool(hidden, ties="last")
    for shape in ((3, 4), (4, 3)):
        for pool in (NormMaxPool(hidden), FieldMaxPool(FieldType.regular(D4, 1))):
            with pytest.raises(ValueError, match="of even H and W, got"):
                pool(torch.zeros(1, 8, *shape))
    for pool in (NormMaxPool(hidden), FieldMaxPool(regular)):
        with pytest.raises(ValueError, match="expected .* channels in dimension 1"):
            pool(torch.zeros(1, 9, 4, 4))
    for pool in (NormPool(hidden), GroupMaxPool(regular)):
        with pytest.raises(ValueError, match="expected .* channels in dimension -1"):
            pool(torch.zeros(2, 9))


def test_the_group_and_the_mode_choose_the_pooling():
    regular, hidden = FieldType.hidden(D4, 2), FieldType.hidden(O2, 2)
    assert isinstance(make_pixel_pool(regular), FieldMaxPool)
    assert isinstance(make_invariant_pool(regular), GroupMaxPool)
    assert isinstance(make_invariant_pool(hidden), NormPool)
    assert [make_pixel_pool(hidden, mode).ties for mode in ("strict", "paper")] == [
        "shared",
        "first",
    ]


def test_pooling_over_the_group_takes_the_maximum_of_each_field():
    pool = GroupMaxPool(FieldType.regular(C4, 2))
    x = torch.tensor([[0.0, 3, 1, 2, -4, -3, -5, -3]])
    assert pool(x).tolist() == [[3, -3]]
    assert pool.out_type == FieldType.trivial(C4, 2)


def test_pooling_over_the_group_shares_the_gradient_of_a_tie():
    x = torch.tensor([1.0, 2, 2, 0], requires_grad=True)
    GroupMaxPool(FieldType.regular(C4, 1))(x).sum().backward()
    assert x.grad.tolist() == [0, 0.5, 0.5, 0]


def test_pooling_over_the_group_refuses_other_fields():
    with pytest.raises(ValueError, match="only regular fields"):
        GroupMaxPool(FieldType.trivial(C4, 2))
