"""What a checkpoint keeps of a buffer restores it exactly, whatever its sampler."""

import io

import pytest
import torch

from equirl.data import (
    Priorities,
    RandomCrop,
    RandomRotation,
    load_replay_state,
    make_replay_buffer,
    protect_demonstrations,
    replay_state,
)
from tests.transitions import transitions

PRIORITIES = Priorities(steps=100)
KINDS = {
    "uniform": {},
    "symmetric": {"symmetric": True},
    "prioritised": {"priorities": PRIORITIES},
}


def make(kind, seed):
    source = torch.Generator().manual_seed(seed)
    buffer = make_replay_buffer(
        60,
        copies=2,
        batch_size=16,
        generator=source,
        augmentations=[
            RandomRotation(generator=source),
            RandomCrop(14, positives=True, generator=source),
        ],
        **KINDS[kind],
    )
    return buffer, source


def learn(buffer, kind, batch, step):
    """What training does with a batch, as far as the buffer sees it."""
    if kind == "prioritised":
        # Falling, so that the largest priority stays one of the first.
        error = 10 * batch["action"].sum(-1).abs() / (1 + step)
        PRIORITIES.update(buffer, batch.set("td_error", error))
        PRIORITIES.anneal(buffer, step)


def used(kind, seed=1, steps=26):
    """A buffer of 20 rows, 5 of them protected; after 26 steps its cursor has wrapped."""
    buffer, source = make(kind, seed)
    demonstrations = transitions(5)
    demonstrations["expert"][:] = True
    buffer.extend(demonstrations)
    protect_demonstrations(buffer)
    for step in range(steps):
        buffer.extend(transitions(1, seed=step))
        learn(buffer, kind, buffer.sample(), step)
    return buffer, source


def through_a_file(state):
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("steps", [3, 26])
def test_a_restored_buffer_goes_on_bit_for_bit(kind, steps):
    buffer, source = used(kind, steps=steps)
    state = through_a_file({"buffer": replay_state(buffer), "rng": source.get_state()})
    other, other_source = make(kind, seed=5)
    load_replay_state(other, state["buffer"])
    other_source.set_state(state["rng"])
    for step in range(30, 60):
        batches = [each.sample() for each in (buffer, other)]
        assert (batches[0] == batches[1]).all()
        for each, batch in zip((buffer, other), batches, strict=True):
            learn(each, kind, batch, step)
            each.extend(transitions(1, seed=step))
    assert len(buffer) == len(other)
    assert (buffer.storage[: len(buffer)] == other.storage[: len(other)]).all()
    assert (other.storage[:5]["expert"]).all()


def leaves(state):
    for value in state.values():
        yield from leaves(value) if isinstance(value, dict) else (value,)


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_is_a_copy_of_plain_values_of_the_filled_rows(kind):
    buffer, _ = used(kind, steps=3)
    state = replay_state(buffer)
    kept = through_a_file(state)
    for step in range(30):
        buffer.extend(transitions(1, seed=100 + step))
        learn(buffer, kind, buffer.sample(), step)
    for before, after in zip(leaves(kept), leaves(state), strict=True):
        if isinstance(before, torch.Tensor):
            assert torch.equal(before, after) and len(after) == 8
            assert after.untyped_storage().nbytes() == after.nbytes  # nothing dragged along
        else:
            assert before == after


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_buffer_is_restored_empty(kind):
    buffer, _ = make(kind, seed=0)
    other, _ = make(kind, seed=0)
    load_replay_state(other, through_a_file(replay_state(buffer)))
    assert len(other) == 0
    for each in (buffer, other):
        each.extend(transitions(4))
        protect_demonstrations(each)
    assert (buffer.sample() == other.sample()).all()
