"""Exact quarter turns of stored copies, and rotation of every sampled transition."""

import math

import pytest
import torch
from tensordict import TensorDict

from equirl.data import RandomRotation, RotationAugmentation, make_replay_buffer
from equirl.symmetry import Element, Representation, ScalarField, SymmetrySpec, manipulation_spec
from tests.transitions import transitions

IMAGES = ("depth", ("next", "depth"))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def turned_by(sampled, stored):
    """The number of quarter turns, 0 to 3, that makes one transition of another; the least error.

    The depths stored are rounded, the actions are not.
    """
    errors = []
    for turns in range(4):
        expected = manipulation_spec().transform(stored, Element(turns * math.pi / 2))
        if not torch.equal(sampled["action"], expected["action"]):
            errors.append(math.inf)
            continue
        errors.append(max((sampled[key] - expected[key]).abs().max().item() for key in IMAGES))
    return min(range(4), key=errors.__getitem__), min(errors)


@pytest.mark.parametrize("size", [16, 18])
@pytest.mark.parametrize("online", [False, True])
def test_quarter_turns_are_exact_and_equally_likely(size, online):
    stored = transitions(30, image_size=size)
    source = generator()
    buffer = make_replay_buffer(
        1000,
        copies=0 if online else 3,
        quarter_turns=not online,
        augmentations=[RandomRotation(quarter_turns=True, generator=source)] if online else [],
        batch_size=600,
        generator=source,
    )
    buffer.extend(stored)
    versions = buffer.storage[:][RotationAugmentation.ANGLES] / (math.pi / 2)
    assert ((versions % 1 == 0) & (versions < 4)).all()
    counts = [0] * 4
    for row in buffer.sample():
        turns, error = turned_by(row, stored[int(row["index"])])
        assert error < 5e-6  # that of 16-bit storage
        assert online or turns in versions[int(row["index"])]
        counts[turns] += 1
        torch.testing.assert_close(row["holding"], stored[int(row["index"])]["holding"])
    # Of four versions one is never turned, and a quarter of the others.
    first = 0.25 if online else 0.25 + 0.75 * 0.25
    expected = torch.tensor([first, *3 * [(1 - first) / 3]])
    assert (torch.tensor(counts) / 600 - expected).abs().max() < 0.06


def test_online_rotation_turns_each_transition_by_a_fresh_angle():
    stored, source = transitions(20), generator()
    buffer = make_replay_buffer(
        1000,
        copies=0,
        augmentations=[RandomRotation(generator=source)],
        batch_size=800,
        generator=source,
    )
    buffer.extend(stored)
    batch = buffer.sample()
    before = stored[batch["index"]]
    heading = [
        torch.view_as_complex(rows["action"][:, 1:3].contiguous()) for rows in (batch, before)
    ]
    angles = (heading[0] / heading[1]).angle()
    expected = manipulation_spec().rotate(before, angles)
    torch.testing.assert_close(batch["action"], expected["action"])
    for key in IMAGES:
        torch.testing.assert_close(batch[key], expected[key], atol=2e-5, rtol=0)
    fraction = (angles % math.tau) / math.tau
    assert abs(fraction.mean() - 0.5) < 0.04 and abs(fraction.var() - 1 / 12) < 0.01
    same_row = angles[batch["index"] == batch["index"][0]]
    assert len(same_row) > 10 and len(same_row.unique()) == len(same_row)
    assert torch.equal(buffer.storage[:20]["action"], stored["action"])


def test_online_rotation_has_the_rules_and_bounds_it_is_given():
    spec = SymmetrySpec({"velocity": Representation("vector")})
    data = TensorDict({"velocity": torch.tensor([[3.0, 4.0]]).expand(64, 2)}, [64])
    free = RandomRotation(spec=spec, generator=generator())(data.clone())
    torch.testing.assert_close(free["velocity"].norm(dim=-1), torch.full((64,), 5.0))
    bounded = RandomRotation(spec=spec, bounds={"velocity": (-3.0, 2.0)}, generator=generator())
    expected = free["velocity"].clamp(-3, 2)
    assert torch.equal(bounded(data.clone())["velocity"], expected)
    again = RandomRotation(spec=spec, generator=generator())(data.clone())
    assert torch.equal(again["velocity"], free["velocity"])  # the generator decides


def test_online_rotation_tells_what_it_cannot_turn():
    rotation = RandomRotation(spec=SymmetrySpec({"pixels": ScalarField()}), generator=generator())
    with pytest.raises(ValueError, match=r"names \['pixels'\], which .* do not have: \['move'\]"):
        rotation(TensorDict({"move": torch.rand(3, 2)}, [3]))
    with pytest.raises(ValueError, match=r"pixels is of torch.uint8 .* ToTensorImage"):
        rotation(TensorDict({"pixels": torch.zeros(3, 1, 4, 4, dtype=torch.uint8)}, [3]))


@pytest.mark.parametrize("size", [18, 72, 142])
@pytest.mark.parametrize("quarter_turns", [False, True])
def test_sizes_that_are_no_powers_of_two(size, quarter_turns):
    stored = transitions(3, image_size=size)
    buffer = make_replay_buffer(
        100, copies=2, quarter_turns=quarter_turns, batch_size=4, generator=generator()
    )
    buffer.extend(stored)
    angles = buffer.storage[:][RotationAugmentation.ANGLES]
    for row in buffer.sample():
        index = int(row["index"])
        versions = manipulation_spec().rotate(stored[3 * [index]], angles[index])
        errors = (versions["action"] - row["action"]).abs().amax(-1)
        assert errors.min() < 1e-6
        for key in IMAGES:
            torch.testing.assert_close(row[key], versions[errors.argmin()][key], atol=1e-4, rtol=0)
