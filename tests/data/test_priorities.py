"""Prioritized replay against the same numbers worked out with numpy."""

import numpy
import pytest
import torch

from equirl.data import Priorities, make_replay_buffer, protect_demonstrations
from tests.transitions import transitions

ROWS = 12


def buffer_of(priorities, rows=ROWS, *, capacity=ROWS, batch_size=4, seed=0, copies=0):
    buffer = make_replay_buffer(
        capacity * (copies + 1),
        copies=copies,
        batch_size=batch_size,
        priorities=priorities,
        generator=torch.Generator().manual_seed(seed),
    )
    data = transitions(rows)
    data["expert"][: rows // 3] = True
    buffer.extend(data)
    return buffer


def sampled(buffer, rows, errors):
    """A batch as it would be sampled, with the errors that the loss wrote."""
    batch = buffer[torch.as_tensor(rows)]
    batch["index"] = torch.as_tensor(rows)
    return batch.set("td_error", torch.as_tensor(errors, dtype=torch.float32))


def chi_square(index, probabilities):
    counts = numpy.bincount(index.numpy(), minlength=len(probabilities))
    expected = len(index) * probabilities
    return ((counts - expected) ** 2 / expected).sum()


def test_rows_are_drawn_by_priority_and_weighted_against_it():
    priorities = Priorities(exponent=0.7, bonus=0.5, epsilon=0.01, beta=0.3)
    buffer = buffer_of(priorities, batch_size=20_000)
    errors = numpy.random.default_rng(0).uniform(0, 2, ROWS)
    errors[5] = 0.0
    priorities.update(buffer, sampled(buffer, range(ROWS), errors))
    expert = numpy.arange(ROWS) < ROWS // 3
    expected = (errors + 0.5 * expert + 0.01) ** 0.7
    probabilities = expected / expected.sum()
    batch = buffer.sample()
    assert chi_square(batch["index"], probabilities) < 31.3  # of 11, 0.1 %
    weights = (ROWS * probabilities) ** -0.3
    weights = torch.as_tensor(weights / weights.max(), dtype=torch.float32)
    assert batch["priority_weight"].shape == (20_000,)
    torch.testing.assert_close(batch["priority_weight"], weights[batch["index"]])


def test_the_paper_setting_by_hand():
    priorities = Priorities()
    buffer = buffer_of(priorities, batch_size=500)
    # The four demonstrations first: 0.5 + 1 + 1e-6 against 0.2 + 1e-6.
    priorities.update(buffer, sampled(buffer, range(ROWS), [0.5] * 4 + [0.2] * 8))
    batch = buffer.sample()
    expected = torch.where(batch["index"] < 4, 7.5 ** (0.6 * -0.4), 1.0)
    torch.testing.assert_close(batch["priority_weight"], expected, atol=1e-5, rtol=0)


def test_beta_grows_linearly_to_one_and_stays():
    priorities = Priorities(beta=0.4, steps=200)
    buffer = buffer_of(priorities, batch_size=200)
    priorities.update(buffer, sampled(buffer, range(ROWS), [0.5] * 4 + [0.2] * 8))
    for step, beta in ((0, 0.4), (50, 0.55), (200, 1.0), (900, 1.0)):
        priorities.anneal(buffer, step)
        batch = buffer.sample()
        demonstration = batch["priority_weight"][batch["index"] < 4]
        torch.testing.assert_close(
            demonstration, torch.full_like(demonstration, 7.5 ** (-0.6 * beta)), atol=1e-5, rtol=0
        )


def test_new_rows_get_the_largest_priority_so_far():
    priorities = Priorities(exponent=1.0, bonus=0.0)
    buffer = buffer_of(
        priorities, rows=3, batch_size=40_000
    )  # of priority 1, there being no other yet
    priorities.update(buffer, sampled(buffer, [0, 1, 2], [9.0, 0.5, 0.5]))
    priorities.update(buffer, sampled(buffer, [0], [0.5]))
    buffer.extend(transitions(1))
    index = buffer.sample()["index"]
    probabilities = numpy.array([0.5, 0.5, 0.5, 9.0]) / 10.5
    assert chi_square(index, probabilities) < 16.3  # of 3, 0.1 %


def test_an_overwritten_row_gets_the_largest_priority_again():
    priorities = Priorities(exponent=1.0, bonus=0.0)
    buffer = buffer_of(priorities, rows=4, capacity=4, batch_size=40_000)
    buffer.writer.protect(2)
    buffer.extend(transitions(1))  # now the cursor is at the last row
    priorities.update(buffer, sampled(buffer, range(4), [3.0, 0.1, 0.1, 0.1]))
    assert buffer.extend(transitions(1)).tolist() == [3]
    index = buffer.sample()["index"]
    assert chi_square(index, numpy.array([3, 0.1, 0.1, 3]) / 6.2) < 16.3


def test_of_a_row_sampled_twice_the_largest_error_counts_in_any_order():
    priorities = Priorities(exponent=1.0, bonus=0.0, beta=1.0)
    for errors in ([4.0, 1.0, 0.5], [1.0, 4.0, 0.5], [0.5, 1.0, 4.0]):
        buffer = buffer_of(priorities, rows=2, batch_size=200)
        rows = [1 if error != 0.5 else 0 for error in errors]
        priorities.update(buffer, sampled(buffer, rows, errors))
        batch = buffer.sample()
        expected = torch.where(batch["index"] == 1, 0.5 / 4, 1.0)
        torch.testing.assert_close(batch["priority_weight"], expected, atol=1e-5, rtol=0)


def test_versions_of_a_transition_share_its_priority():
    priorities = Priorities(exponent=1.0, bonus=0.0)
    buffer = buffer_of(priorities, rows=2, copies=3, batch_size=1000)
    # As a batch has it: rows, whichever of their versions they came as.
    priorities.update(buffer, sampled(buffer, [0, 1], [0.1, 0.9]))
    batch = buffer.sample()
    first = batch["index"] == 0
    assert abs(first.float().mean() - 0.1) < 0.04
    assert len(batch["priority_weight"][first].unique()) == 1
    for row in (0, 1):
        actions = batch["action"][batch["index"] == row]
        counts = actions.unique(dim=0, return_counts=True)[1]
        assert len(counts) == 4 and counts.min() > len(actions) / 4 / 2


def test_the_generator_decides_and_numpy_does_not():
    indices = []
    for seed in (1, 2):
        numpy.random.seed(seed)
        torch.manual_seed(seed)
        indices.append(buffer_of(Priorities(), batch_size=50, seed=7).sample()["index"])
    assert torch.equal(*indices)
    state = numpy.random.get_state()[1].copy()
    buffer = make_replay_buffer(10, copies=0, batch_size=4, priorities=Priorities())
    buffer.extend(transitions(3))
    buffer.sample()
    assert (numpy.random.get_state()[1] == state).all()


def test_demonstrations_stay_under_priorities():
    buffer = buffer_of(Priorities(), rows=4)
    protect_demonstrations(buffer)
    stored = buffer.storage[:4].clone()
    for seed in range(5):
        buffer.extend(transitions(6, seed=seed))
        buffer.sample()
    assert (buffer.storage[:4] == stored).all()


def test_bad_numbers_are_named():
    for arguments, message in (
        ({"exponent": -0.1}, "exponent=-0.1: expected a number from 0 to 1"),
        ({"bonus": float("nan")}, "bonus=nan: expected"),
        ({"epsilon": 0.0}, "epsilon=0.0: expected a number above 1e-30"),
        ({"beta": 1.5}, "beta=1.5: expected a number from 0 to 1"),
        ({"steps": 0}, "steps=0: expected an integer of 1 or more"),
        ({"steps": 0.5}, "steps=0.5: expected an integer"),
    ):
        with pytest.raises(ValueError, match=message):
            Priorities(**arguments)
    buffer = buffer_of(Priorities())
    for wrong in (float("nan"), float("inf"), -0.5):
        with pytest.raises(ValueError, match=f"td_error holds {wrong}"):
            Priorities().update(buffer, sampled(buffer, [0, 1], [0.1, wrong]))
