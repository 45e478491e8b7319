"""Replay buffer and its transforms."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Transform

from equirl.data import (
    TRANSITION_KEYS,
    QuantizeDepth,
    RotationAugmentation,
    load_replay_state,
    make_replay_buffer,
    replay_state,
)
from equirl.symmetry import Representation, ScalarField, SymmetrySpec, manipulation_spec
from tests.transitions import transitions


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_without_copies_what_is_sampled_is_what_was_stored():
    stored = transitions(40)
    buffer = make_replay_buffer(1000, copies=0, batch_size=64, generator=generator())
    buffer.extend(stored)
    batch = buffer.sample()
    expected = stored[batch["index"]]
    for key in TRANSITION_KEYS:
        assert batch[key].dtype == expected[key].dtype
        torch.testing.assert_close(batch[key], expected[key], atol=1e-5, rtol=0)


def test_paper_setting_fits_in_memory_with_small_depth_error():
    buffer = make_replay_buffer(100_000, copies=4, generator=generator())
    stored = transitions(3, image_size=128)
    buffer.extend(stored)
    rows = buffer.storage[:3]
    bytes_a_row = sum(leaf.nbytes for leaf in rows.values(True, True)) / 3
    assert buffer.storage.max_size == 20_000
    assert bytes_a_row * buffer.storage.max_size <= 1.5e9
    packed = QuantizeDepth(0.32)
    error = (packed.forward(packed.inv(stored.clone()))["depth"] - stored["depth"]).abs().max()
    assert error < 2e-4


def test_copies_turn_observation_next_observation_and_action_together():
    stored = transitions(30)
    buffer = make_replay_buffer(1000, copies=3, batch_size=512, generator=generator())
    buffer.extend(stored)
    angles = buffer.storage[:][RotationAugmentation.ANGLES]
    batch = buffer.sample()
    seen = set()
    for row in batch:
        index = int(row["index"])
        versions = [
            manipulation_spec().rotate(stored[index : index + 1], angle.reshape(1))[0]
            for angle in angles[index]
        ]
        errors = [(version["action"] - row["action"]).abs().max().item() for version in versions]
        version = min(range(4), key=errors.__getitem__)
        seen.add(version)
        torch.testing.assert_close(row["action"], versions[version]["action"])
        for key in ("depth", ("next", "depth")):
            torch.testing.assert_close(row[key], versions[version][key], atol=2e-5, rtol=0)
        for key in ("holding", ("next", "holding"), ("next", "reward")):
            torch.testing.assert_close(row[key], stored[index][key])
    assert seen == {0, 1, 2, 3}


def test_versions_are_drawn_uniformly_and_angles_cover_the_circle():
    buffer = make_replay_buffer(50_000, copies=4, batch_size=5000, generator=generator())
    buffer.extend(transitions(2000, image_size=2))
    angles = buffer.storage[:][RotationAugmentation.ANGLES]
    assert (angles[:, 0] == 0).all()
    drawn = angles[:, 1:] / math.tau
    assert drawn.min() >= 0 and drawn.max() < 1
    assert abs(drawn.mean() - 0.5) < 0.02 and abs(drawn.var() - 1 / 12) < 0.005
    batch = buffer.sample()
    stored = transitions(2000, image_size=2)[batch["index"]]
    unturned = (batch["action"] == stored["action"]).all(-1).float().mean()
    assert abs(unturned - 1 / 5) < 0.03


def test_sampling_does_not_alter_what_is_stored():
    buffer = make_replay_buffer(1000, copies=4, batch_size=64, generator=generator())
    buffer.extend(transitions(10))
    before = buffer.storage[:].clone()
    for _ in range(5):
        buffer.sample()
    assert (buffer.storage[:] == before).all()


def test_actions_off_the_disc_are_clipped_to_their_box():
    stored = transitions(50)
    stored["action"] = torch.ones(50, 5)
    buffer = make_replay_buffer(1000, copies=4, batch_size=256, generator=generator())
    buffer.extend(stored)
    action = buffer.sample()["action"]
    assert action.abs().max() == 1
    assert (action[:, 1:3].norm(dim=-1) < 1.3).any()  # some were cut


def test_another_spec_and_bounds():
    spec = SymmetrySpec({"velocity": Representation("vector")})
    augment = RotationAugmentation(1, spec=spec, bounds={}, generator=generator())
    data = TensorDict({"velocity": torch.tensor([[3.0, 4.0]]).expand(64, 2)}, [64])
    turned = augment.forward(augment.inv(data.clone()))
    torch.testing.assert_close(turned["velocity"].norm(dim=-1), torch.full((64,), 5.0))
    assert (turned["velocity"] != data["velocity"]).any(-1).float().mean() > 0.2


def test_same_generator_same_batches():
    batches = []
    for _ in range(2):
        buffer = make_replay_buffer(1000, copies=4, batch_size=16, generator=generator(3))
        buffer.extend(transitions(20))
        torch.rand(7)  # the global generator plays no part
        batches.append(buffer.sample())
    assert (batches[0] == batches[1]).all()


def test_state_restores_rows_cursor_and_draws():
    source = generator(1)
    buffer = make_replay_buffer(50, copies=4, batch_size=16, generator=source)
    for seed in range(7):  # 14 transitions into 10 rows: the cursor has wrapped
        buffer.extend(transitions(2, seed=seed))
    state, rng = replay_state(buffer), source.get_state()
    other_source = generator(2)
    other = make_replay_buffer(50, copies=4, batch_size=16, generator=other_source)
    load_replay_state(other, state)
    other_source.set_state(rng)
    for _ in range(2):
        assert (buffer.sample() == other.sample()).all()
        buffer.extend(transitions(1, seed=9))
        other.extend(transitions(1, seed=9))
    assert (buffer.storage[:] == other.storage[:]).all()


class Recorder(Transform):
    """Notes in ``seen`` the depths that reach it, and adds 1 m."""

    def __init__(self, seen):
        super().__init__()
        self.seen = seen

    def forward(self, tensordict):
        self.seen.append(tensordict["depth"].clone())
        return tensordict.set("depth", tensordict["depth"] + 1)


def test_augmentations_follow_the_rotated_copies_in_their_order():
    seen = []
    plain, buffer = (
        make_replay_buffer(1000, batch_size=16, generator=generator(), augmentations=augmentations)
        for augmentations in ([], [Recorder(seen), Recorder(seen)])
    )
    for each in (plain, buffer):
        each.extend(transitions(20))
    assert seen == []  # nothing happens at insertion
    turned, batch = plain.sample()["depth"], buffer.sample()["depth"]
    assert torch.equal(seen[0], turned)
    assert torch.equal(seen[1], turned + 1) and torch.equal(batch, turned + 1 + 1)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="copies=-1: expected an integer of 0 or more"):
        RotationAugmentation(-1)
    for arguments in ({"copies": -1}, {"batch_size": 0}, {"capacity": 2.5}, {"max_depth": 0.0}):
        with pytest.raises(ValueError, match="expected"):
            make_replay_buffer(**arguments)
    buffer = make_replay_buffer(10, copies=0)
    data = transitions(2)
    data["depth"][0, 0, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="depth holds numbers that are not finite"):
        buffer.extend(data)
    with pytest.raises(ValueError, match="capacity 3 cannot hold .* 4 copies"):
        make_replay_buffer(3, copies=4)


def images_and_moves(rows: int = 20) -> TensorDict:
    """Transitions of an environment that has nothing to do with manipulation."""
    data = {
        "pixels": torch.rand(rows, 2, 16, 16),
        "move": torch.rand(rows, 2),
        "speed": torch.rand(rows),
    }
    return TensorDict({**data, "next": TensorDict({"pixels": data["pixels"] + 1}, [rows])}, [rows])


def foreign_buffer(keys=("pixels", "move"), copies=4) -> ReplayBuffer:
    rules = {"pixels": ScalarField(), "move": Representation("vector")}
    return ReplayBuffer(
        storage=LazyTensorStorage(100),
        transform=RotationAugmentation(
            copies, spec=SymmetrySpec({key: rules[key] for key in keys}), generator=generator()
        ),
        batch_size=64,
    )


def test_transitions_of_other_environments_in_a_buffer_of_torchrl():
    stored, buffer = images_and_moves(), foreign_buffer()
    buffer.extend(stored)
    batch = buffer.sample()
    assert set(batch.keys()) == {"pixels", "move", "speed", "next"}
    lengths = stored["move"].norm(dim=-1)
    for row in batch:  # nothing is clipped: there is no `action`
        index = (stored["speed"] == row["speed"]).nonzero().item()
        torch.testing.assert_close(row["move"].norm(), lengths[index])
        torch.testing.assert_close(row["next", "pixels"], row["pixels"] + 1)
    unturned = (batch["speed"][:, None] == stored["speed"]).long().argmax(-1)
    assert 0 < (batch["move"] == stored["move"][unturned]).all(-1).float().mean() < 0.5


def test_what_cannot_be_turned_is_told():
    data = images_and_moves()
    with pytest.raises(ValueError, match=r"names \['move'\], which .* do not have: .*'pixels'"):
        foreign_buffer().extend(data.exclude("move"))
    with pytest.raises(ValueError, match=r"size \(4, 5\): extend the buffer with data.reshape"):
        foreign_buffer().extend(data.reshape(4, 5))
    data["pixels"] = (255 * data["pixels"]).byte()
    data["next", "pixels"] = data["pixels"]
    buffer = foreign_buffer()
    buffer.extend(data)
    with pytest.raises(ValueError, match=r"pixels is of torch.uint8 .* ToTensorImage"):
        buffer.sample()
    foreign_buffer(keys=("move",)).extend(data)  # images that stay may be bytes
    unturned = foreign_buffer(copies=0)
    unturned.extend(data)
    assert unturned.sample()["pixels"].dtype == torch.uint8
