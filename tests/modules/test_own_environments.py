"""Networks for environments of the user's own: other images, invariants, keys and actions."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal

from equirl.modules import (
    EquivariantEncoder,
    EquivariantPolicy,
    EquivariantQHeads,
    FieldType,
    RadialTanhNormal,
    make_actor,
    make_critic,
)
from equirl.symmetry import Element, Representation, SymmetryGroup
from tests.equivariance import assert_equivariant, turn_image

SMALL = {"hidden": 8, "image_size": 16, "backend": "dense"}
#: A gripper that is moved in the plane, turned, and moved again: two vectors and a sign.
ACTION = Representation("vector", "sign", "vector")
OWN = {
    "action": ACTION,
    "in_keys": ["pixels", ("robot", "state")],
    "channels": 3,
    "invariants": 2,
}


def observations(*batch, channels=3, invariants=2):
    state = {"pixels": torch.rand(*batch, channels, 16, 16)}
    if invariants:
        state["robot"] = {"state": torch.rand(*batch, invariants)}
    return TensorDict(state, batch_size=batch)


def turn(action, turns, flip):
    """Each vector's y changes sign before the turn, and so does the sign."""
    return ACTION.transform(action, Element(turns * torch.pi / 2, flip))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("mode", ["strict", "paper"])
@pytest.mark.parametrize("group", ["C4", "D4", "SO2", "O2"])
def test_keys_and_shapes(group, mode, batch):
    actor, critic = (make(group, mode=mode, **SMALL, **OWN) for make in (make_actor, make_critic))
    assert set(actor.in_keys) == {"pixels", ("robot", "state")}
    assert set(critic.in_keys) == {"pixels", ("robot", "state"), "action"}
    with set_exploration_type(ExplorationType.RANDOM):
        data = critic(actor(observations(*batch)))
    for key in ("loc", "scale", "action"):
        assert data[key].shape == (*batch, 5)
    assert data["state_action_value"].shape == (*batch, 2)
    expected = RadialTanhNormal if mode == "strict" else TanhNormal
    assert isinstance(actor.get_dist(observations(*batch)), expected)
    if mode == "strict":  # one deviation for each block, and each vector on its disc
        x, y, _, z, w = data["scale"].unbind(-1)
        assert torch.equal(x, y) and torch.equal(z, w) and not torch.equal(x, z)
        for part in (slice(0, 2), slice(3, 5)):
            assert (data["action"][..., part].norm(dim=-1) <= 1).all()


@pytest.mark.parametrize("group", ["C4", "D4", "D2", "SO2", "O2"])
def test_networks_turn_with_their_scene(group):
    generator = torch.Generator().manual_seed(0)
    actor, critic = (
        make(group, generator=generator, **SMALL, **OWN).double()
        for make in (make_actor, make_critic)
    )
    for name, parameter in (*actor.named_parameters(), *critic.named_parameters()):
        if name.endswith("bias"):
            torch.nn.init.normal_(parameter, std=0.1, generator=generator)

    def call(pixels, state, action):
        data = TensorDict({"pixels": pixels, "robot": {"state": state}}, batch_size=3)
        dist = actor.get_dist(data.clone())
        values = critic(data.set("action", action))["state_action_value"]
        return {"loc": dist.loc, "log_prob": dist.log_prob(action), "values": values}

    data = observations(3).double()
    assert_equivariant(
        call,
        group,
        {
            "pixels": data["pixels"],
            "state": data["robot", "state"],
            "action": 0.5 * torch.rand(3, 5, generator=generator, dtype=torch.float64),
        },
        {"pixels": turn_image, "action": turn, "loc": turn},
        case="own action",
    )


def test_every_channel_and_every_invariant_is_seen():
    actor = make_actor("O2", **SMALL, **OWN)
    data = observations(2)
    before = actor(data.clone())["scale"]
    for key, count in (("pixels", 3), (("robot", "state"), 2)):
        for index in range(count):
            changed = data.clone()
            changed[key][:, index] += 0.5
            assert not torch.allclose(actor(changed)["scale"], before, atol=1e-6)


@pytest.mark.parametrize("group", ["D4", "SO2"])
def test_an_image_alone(group):
    own = {"action": Representation("vector"), "in_keys": ["pixels"], "invariants": 0}
    actor, critic = (make(group, **SMALL, **own) for make in (make_actor, make_critic))
    data = critic(actor(observations(2, channels=1, invariants=0)))
    assert data["action"].shape == (2, 2) and data["state_action_value"].shape == (2, 2)
    encoder = actor.module[0].module.encoder
    assert encoder.in_type == FieldType.trivial(SymmetryGroup(group), 1)
    with pytest.raises(ValueError, match=r"and no invariants, got \(2, 1, 16, 16\) and \(2, 1\)"):
        encoder(torch.rand(2, 1, 16, 16), torch.rand(2, 1))


@pytest.mark.parametrize("make", [make_actor, make_critic])
@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"channels": 0}, "channels=0: expected an integer of at least 1"),
        ({"channels": 1.0}, "channels=1.0: expected an integer of at least 1"),
        ({"invariants": -1}, "invariants=-1: expected an integer of at least 0"),
        ({"in_keys": ["depth"]}, "expected keys of an image and of its invariants"),
        ({"in_keys": "depth"}, "in_keys='depth'"),
        ({"in_keys": ["depth", "holding", "time"]}, "expected keys of an image and of its"),
        ({"invariants": 0}, "invariants=0: expected keys of an image alone"),
        ({"action": "vector"}, "action='vector': expected a Representation"),
        ({"action": Representation()}, "expected a Representation of one component or more"),
        ({"mode": "exact"}, "mode='exact': expected one of strict, paper"),
    ],
)
def test_what_does_not_fit_is_named(make, own, message):
    with pytest.raises(ValueError, match=message):
        make("C4", **SMALL, **own)


def test_other_shapes_than_stated_are_refused():
    encoder = EquivariantEncoder("C4", channels=3, invariants=2, **SMALL)
    expected = r"expected an image \(\*batch, 3, 16, 16\) and invariants \(\*batch, 2\)"
    for image, invariants in (
        (torch.rand(2, 1, 16, 16), torch.rand(2, 2)),
        (torch.rand(2, 3, 16, 16), torch.rand(2, 1)),
        (torch.rand(2, 3, 16, 16), None),
    ):
        with pytest.raises(ValueError, match=expected):
            encoder(image, invariants)


def test_parts_take_an_action_too():
    encoder = EquivariantEncoder("O2", **SMALL)
    policy = EquivariantPolicy(encoder, action=ACTION)
    assert policy.out_rep == ACTION and policy.sharing == (2, 1, 2)
    assert EquivariantPolicy(encoder, action=ACTION, mode="paper").sharing == (1,) * 5
    heads = EquivariantQHeads(encoder.out_type, action=ACTION)
    assert heads.in_type.fields[-3:] == ("vector", "sign", "vector")
