"""Representations multiply as the group does, and images turn as vectors do."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from equirl.symmetry import (
    ACTION,
    ACTION_PAPER,
    Element,
    Irrep,
    Representation,
    ScalarField,
    SymmetryGroup,
    action_representation,
    manipulation_spec,
)

elements = st.builds(Element, st.floats(-7, 7), st.booleans())
representations = st.lists(st.sampled_from(Irrep), min_size=1, max_size=5).map(
    lambda irreps: Representation(*irreps)
)
D4 = SymmetryGroup("D4").elements


def vectors(representation, seed=0, rows=3):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(rows, representation.dim, dtype=torch.float64, generator=generator)


@given(representations, elements, elements)
def test_transform_is_a_homomorphism(representation, g, h):
    x = vectors(representation)
    twice = representation.transform(representation.transform(x, h), g)
    # Angles within 1e-12 of a quarter turn are taken for it.
    torch.testing.assert_close(representation.transform(x, g @ h), twice, atol=2e-11, rtol=0)


@given(representations, elements)
def test_inverse_undoes_and_lengths_are_kept(representation, g):
    x = vectors(representation)
    turned = representation.transform(x, g)
    back = representation.transform(turned, g.inverse())
    torch.testing.assert_close(back, x, atol=1e-12, rtol=0)
    torch.testing.assert_close(turned.norm(dim=-1), x.norm(dim=-1))


@given(representations, st.lists(st.floats(-7, 7), min_size=3, max_size=3))
def test_rotate_is_transform_row_by_row(representation, angles):
    x = vectors(representation)
    rows = [representation.transform(row, Element(a)) for row, a in zip(x, angles, strict=True)]
    rotated = representation.rotate(x, torch.tensor(angles, dtype=torch.float64))
    torch.testing.assert_close(rotated, torch.stack(rows), atol=1e-9, rtol=0)


def test_the_action_by_hand():
    action = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5])
    quarter, flip = Element(math.pi / 2), Element(0.0, reflected=True)
    assert ACTION.transform(action, quarter).tolist() == pytest.approx([0.1, -0.3, 0.2, 0.4, 0.5])
    assert ACTION.transform(action, flip).tolist() == pytest.approx([0.1, 0.2, -0.3, 0.4, -0.5])
    assert ACTION_PAPER.transform(action, flip)[-1] == action[-1]


def test_blocks_cover_the_components_in_order():
    assert [(irrep.value, part.start, part.stop) for irrep, part in ACTION.blocks] == [
        ("trivial", 0, 1),
        ("vector", 1, 3),
        ("trivial", 3, 4),
        ("sign", 4, 5),
    ]


@pytest.mark.parametrize("g", D4, ids=str)
def test_image_moves_a_pixel_as_the_vector_to_it(g):
    size = 6
    image = torch.zeros(size, size)
    image[1, 4] = 1.0  # x = 1 + 1/2 - S/2, y = 4 + 1/2 - S/2: rows grow with x, columns with y
    where = torch.tensor([1.0, 4.0], dtype=torch.float64) + 0.5 - size / 2
    row, column = (Representation("vector").transform(where, g) - 0.5 + size / 2).round().int()
    turned = ScalarField().transform(image, g)
    assert turned[row, column] == 1.0
    assert turned.sum() == 1.0


@pytest.mark.parametrize("g", D4, ids=str)
@pytest.mark.parametrize("h", D4[1::3], ids=str)
def test_grid_elements_compose_exactly_on_images(g, h):
    image, field = torch.rand(2, 3, 8, 8), ScalarField()
    assert torch.equal(field.transform(field.transform(image, h), g), field.transform(image, g @ h))
    assert torch.equal(field.transform(field.transform(image, g), g.inverse()), image)


def test_a_quarter_turn_is_rot90_and_a_reflection_flips_the_columns():
    image, field = torch.rand(4, 4), ScalarField()
    assert torch.equal(field.transform(image, Element(math.pi / 2)), torch.rot90(image, 1, (0, 1)))
    assert torch.equal(field.transform(image, Element(0.0, True)), image.flip(1))


def test_interpolated_rotation_agrees_with_the_exact_one():
    image, field = torch.rand(4, 1, 16, 16, dtype=torch.float64), ScalarField()
    angles = torch.arange(4, dtype=torch.float64) * math.pi / 2
    exact = [
        field.transform(row, Element(a)) for row, a in zip(image, angles.tolist(), strict=True)
    ]
    torch.testing.assert_close(field.rotate(image, angles), torch.stack(exact), atol=1e-9, rtol=0)


def test_interpolated_rotation_has_the_same_sense_as_the_vectors():
    size, angle = 33, 0.7
    image = torch.zeros(1, 1, size, size, dtype=torch.float64)
    image[..., 16, 26] = 1.0  # 10 pixels along +y from the centre
    turned = ScalarField().rotate(image, torch.tensor([angle], dtype=torch.float64))[0, 0]
    grid = torch.arange(size, dtype=torch.float64) - 16
    centroid = torch.stack([(turned.sum(1) * grid).sum(), (turned.sum(0) * grid).sum()])
    expected = Representation("vector").transform(
        torch.tensor([0.0, 10.0], dtype=torch.float64), Element(angle)
    )
    torch.testing.assert_close(centroid / turned.sum(), expected, atol=0.5, rtol=0)


def test_the_spec_transforms_next_entries_and_leaves_the_rest():
    from tensordict import TensorDict

    data = TensorDict(
        {
            "depth": torch.rand(2, 1, 4, 4),
            "action": torch.rand(2, 5),
            "holding": torch.rand(2, 1),
            "next": {"depth": torch.rand(2, 1, 4, 4)},
        },
        batch_size=2,
    )
    g = Element(math.pi / 2, reflected=True)
    out = manipulation_spec().transform(data, g)
    assert torch.equal(out["action"], ACTION.transform(data["action"], g))
    assert torch.equal(out["depth"], ScalarField().transform(data["depth"], g))
    assert torch.equal(out["next", "depth"], ScalarField().transform(data["next", "depth"], g))
    assert torch.equal(out["holding"], data["holding"])


def test_wrong_sizes_and_modes_are_refused():
    with pytest.raises(ValueError, match="last dimension of 5"):
        ACTION.transform(torch.zeros(4), Element(0.0))
    with pytest.raises(ValueError, match="'exact'"):
        action_representation("exact")


def test_images_that_are_not_square_are_refused_and_every_float_dtype_turns():
    field, angles = ScalarField(), torch.tensor([0.3, 1.2])
    with pytest.raises(ValueError, match=r"square images .* got \(2, 1, 6, 8\)"):
        field.rotate(torch.rand(2, 1, 6, 8), angles)
    image = torch.rand(2, 1, 8, 8)
    turned = field.rotate(image.bfloat16(), angles)
    assert turned.dtype == torch.bfloat16
    torch.testing.assert_close(turned.float(), field.rotate(image, angles), atol=0.05, rtol=0)


TURNS = torch.tensor([0, 1, 2, 3, -1, 6, 1])


def rows_to_turn(dtype=torch.float32, size=6):
    from tensordict import TensorDict

    rows = len(TURNS)
    generator = torch.Generator().manual_seed(2)

    def normal(*shape):
        return torch.randn(rows, *shape, generator=generator, dtype=dtype)

    data = {"depth": normal(1, size, size), "action": normal(5), "holding": normal(1)}
    return TensorDict({**data, "next": {"depth": normal(1, size, size)}}, rows)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_quarter_turns_are_those_of_the_group_bit_for_bit(dtype):
    data = rows_to_turn(dtype)
    turned = manipulation_spec().quarter_turns(data, TURNS)
    for before, after, turns in zip(data, turned, TURNS.tolist(), strict=True):
        expected = manipulation_spec().transform(before, Element(turns * math.pi / 2))
        x, y = before["action"][1:3]
        by_hand = ((x, y), (-y, x), (-x, -y), (y, -x))[turns % 4]
        assert torch.equal(after["action"][1:3], torch.stack(by_hand))
        assert torch.equal(after["action"], expected["action"])
        for key in ("depth", ("next", "depth")):
            assert torch.equal(after[key], before[key].rot90(turns, (1, 2)))
            assert torch.equal(after[key], expected[key])
        assert torch.equal(after["holding"], before["holding"])


@pytest.mark.parametrize("size", [7, 16, 18])
def test_quarter_turns_are_rotations_by_their_angles_up_to_rounding(size):
    data, spec = rows_to_turn(torch.float64, size), manipulation_spec()
    rotated = spec.rotate(data, TURNS.double() * math.pi / 2)
    turned = spec.quarter_turns(data, TURNS)
    for key in ("depth", ("next", "depth"), "action"):
        torch.testing.assert_close(turned[key], rotated[key], atol=1e-9, rtol=0)


def test_quarter_turns_of_bytes_and_what_they_refuse():
    image = torch.randint(256, (2, 3, 4, 4), dtype=torch.uint8)
    turned = ScalarField().quarter_turns(image, torch.tensor([1, 0], dtype=torch.int8))
    assert torch.equal(turned, torch.stack([image[0].rot90(1, (1, 2)), image[1]]))
    with pytest.raises(ValueError, match=r"square images .* got \(2, 1, 6, 8\)"):
        ScalarField().quarter_turns(torch.rand(2, 1, 6, 8), torch.tensor([0, 2]))
    for rule, value in ((ScalarField(), image), (ACTION, torch.zeros(2, 5))):
        with pytest.raises(ValueError, match=r"integers, .* got torch.float32"):
            rule.quarter_turns(value, torch.tensor([0.5, 1.0]))
