"""Demonstrations stay, and half of each batch may come from them."""

import pytest
import torch

from equirl.data import make_replay_buffer, protect_demonstrations
from tests.transitions import transitions


def filled(demonstrations, *, capacity=10, batch_size=6, seed=0, **arguments):
    buffer = make_replay_buffer(
        capacity,
        copies=0,
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
        **arguments,
    )
    buffer.extend(marked(0, demonstrations))
    protect_demonstrations(buffer)
    return buffer


def marked(first, count):
    """Transitions numbered by their reward."""
    data = transitions(count)
    data["next", "reward"] = torch.arange(first, first + count).float().unsqueeze(-1)
    return data


def held(buffer):
    return buffer.storage[: len(buffer)]["next", "reward"].flatten().int().tolist()


def test_round_robin_goes_on_over_the_other_rows():
    buffer = filled(4)
    assert buffer.extend(marked(4, 3)).tolist() == [4, 5, 6]
    # Passes the end and goes on behind the demonstrations.
    assert buffer.extend(marked(7, 5)).tolist() == [7, 8, 9, 4, 5]
    assert held(buffer) == [0, 1, 2, 3, 10, 11, 6, 7, 8, 9]
    for first in range(12, 30):
        buffer.extend(marked(first, 1))
    assert held(buffer) == [0, 1, 2, 3, 28, 29, 24, 25, 26, 27]
    assert len(buffer) == 10 and buffer.write_count == 4 + 3 + 5 + 18


def test_without_protection_everything_is_overwritten_in_turn():
    buffer = make_replay_buffer(4, copies=0)
    for first in (0, 3, 6):
        buffer.extend(marked(first, 3))
    assert held(buffer) == [8, 5, 6, 7]


def test_protection_after_a_wrap_moves_the_cursor_on():
    buffer = filled(4)
    buffer.extend(marked(4, 6))
    buffer.extend(marked(10, 1))  # the next row is the sixth
    buffer.writer.protect(8)
    assert buffer.extend(marked(20, 2)).tolist() == [8, 9]
    assert buffer.extend(marked(22, 1)).tolist() == [8]


def test_protection_that_leaves_no_room_is_refused():
    with pytest.raises(ValueError, match="protect 10 transitions in a buffer of 10: no row"):
        filled(10)
    buffer = filled(4)
    with pytest.raises(ValueError, match="protect 5 rows: expected 0 to 4"):
        buffer.writer.protect(5)
    with pytest.raises(ValueError, match="store 7 .* 4 are protected, expected 6 or fewer"):
        buffer.extend(marked(4, 7))
    assert held(buffer) == [0, 1, 2, 3]


def test_protection_survives_the_files_of_torchrl_and_ends_with_emptying(tmp_path):
    buffer, other = filled(4), make_replay_buffer(10, copies=0)
    buffer.extend(marked(4, 6))
    buffer.dumps(tmp_path)
    other.loads(tmp_path)
    assert other.extend(marked(10, 5)).tolist() == [4, 5, 6, 7, 8]
    assert other.extend(marked(15, 2)).tolist() == [9, 4]
    other.empty()
    assert other.extend(marked(0, 10)).tolist() == list(range(10))


@pytest.mark.parametrize(("batch_size", "demonstrations"), [(6, 3), (7, 3), (64, 32), (1, 0)])
def test_half_of_each_batch_is_demonstrations(batch_size, demonstrations):
    buffer = filled(4, batch_size=batch_size, symmetric=True)
    assert (buffer.sample()["index"] < 4).all()  # there is nothing else yet
    buffer.extend(marked(4, 1))
    for first in range(5, 15):
        batch = buffer.sample()
        assert len(batch) == batch_size
        assert (batch["index"] < 4).sum() == demonstrations
        assert torch.equal(batch["next", "reward"], buffer[batch["index"]]["next", "reward"])
        buffer.extend(marked(first, 1))


def test_each_half_is_uniform_and_the_generator_decides():
    buffer = filled(4, batch_size=8000, symmetric=True)
    buffer.extend(marked(4, 6))
    index = buffer.sample()["index"]
    counts = torch.bincount(index, minlength=10)
    expected = torch.tensor([1000.0] * 4 + [4000 / 6] * 6)
    assert ((counts - expected).pow(2) / expected).sum() < 26.1  # chi-square of 8, 0.1 %
    twin = filled(4, batch_size=8000, symmetric=True)
    twin.extend(marked(4, 6))
    torch.rand(5)
    assert torch.equal(twin.sample()["index"], index)


def test_symmetric_sampling_needs_demonstrations_and_excludes_priorities():
    from equirl.data import Priorities

    buffer = make_replay_buffer(10, copies=0, batch_size=4, symmetric=True)
    buffer.extend(marked(0, 3))
    with pytest.raises(RuntimeError, match="3 transitions found no demonstrations"):
        buffer.sample()
    with pytest.raises(ValueError, match="symmetric=True and priorities=.*: expected one way"):
        make_replay_buffer(10, copies=0, symmetric=True, priorities=Priorities())
