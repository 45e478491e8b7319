"""Turn the scene and the policy turns with it, to rounding, for every grid element."""

import math

import pytest
import torch
from tensordict import TensorDict

from equirl.modules import EquivariantEncoder, FieldType, SteerableConv, make_actor, make_critic
from equirl.modules.cnn import make_cnn_actor
from equirl.symmetry import ACTION, Element, SymmetryGroup
from tests.equivariance import (
    assert_equivariant,
    turn_action,
    turn_action_of_the_paper,
    turn_fields,
    turn_image,
)
from tests.property.scenes import (
    CONTINUOUS,
    GROUPS,
    SCENES,
    actions,
    make,
    prepared,
    scenes,
    slow,
)

TURN_ACTION = {"strict": turn_action, "paper": turn_action_of_the_paper}


def network_of(group, mode, scene, size=16):
    """A function of an observation and an action: the distribution and both values."""
    actor, critic = (
        make(each, group, scene, size, mode=mode) for each in (make_actor, make_critic)
    )

    def call(depth, holding, action):
        data = TensorDict(depth=depth, holding=holding, batch_size=len(depth))
        dist = actor.get_dist(data.clone())
        out = actor(data.clone()).select("loc", "scale")
        if mode == "strict":  # squashed component by component, the paper's do not turn
            out["greedy"] = dist.deterministic_sample
            out["log_prob"] = dist.log_prob(0.57 * action)  # (x, y) inside the disc
        out["values"] = critic(data.set("action", action))["state_action_value"]
        assert out["values"].shape == (len(depth), 2)
        return dict(out)

    return call


def assert_networks_turn(group, mode, scene, inputs, size=16):
    outputs = ("loc", "greedy") if mode == "strict" else ("loc",)
    assert_equivariant(
        network_of(group, mode, scene, size),
        group,
        inputs,
        {"depth": turn_image, **dict.fromkeys(("action", *outputs), TURN_ACTION[mode])},
        case=f"{mode}, {scene}",
    )


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("group", GROUPS)
def test_strict_networks(group, scene):
    """The distribution and both values, under the physical action."""
    assert_networks_turn(group, "strict", scene, {**scenes(scene, 16), "action": actions()})


def scenes_of_the_paper(group):
    """Of SO(2) and O(2) those without ties, of which its networks take the first: see below."""
    return ("random", "nothing") if group in CONTINUOUS else SCENES


@pytest.mark.parametrize("group", GROUPS)
def test_paper_networks_under_their_declared_representation(group):
    for scene in scenes_of_the_paper(group):
        assert_networks_turn(group, "paper", scene, {**scenes(scene, 16), "action": actions()})


@slow
@pytest.mark.parametrize("size", [16, 32, 64, 128, 256])
@pytest.mark.parametrize("mode", TURN_ACTION)
@pytest.mark.parametrize("group", GROUPS)
def test_networks_of_every_image_size(group, mode, size):
    *kinds, nothing = SCENES if mode == "strict" else scenes_of_the_paper(group)
    for case, chosen in (("all scenes", kinds), (nothing, [nothing])):
        data = torch.cat([scenes(kind, size, batch=2)[1:] for kind in chosen])
        inputs = {**data, "action": actions(batch=len(data))}
        assert_networks_turn(group, mode, case, inputs, size)


@pytest.mark.parametrize("mode", TURN_ACTION)
@pytest.mark.parametrize("group", GROUPS)
def test_heads_on_zero_features(group, mode):
    """Where values depend on the action alone, and norms have no direction."""
    critic = make(make_critic, group, "nothing", mode=mode)
    features = torch.zeros(3, critic[0].module.out_type.size, dtype=torch.float64)
    assert_equivariant(
        lambda action: {"values": critic[1].module(features, action)},
        group,
        {"action": actions()},
        {"action": TURN_ACTION[mode]},
        case=f"{mode} heads",
        tolerance=1e-12,
    )
    assert torch.isfinite(critic[1].module(features, 0 * actions())).all()


@pytest.mark.parametrize("group", ["D4", "O2"])
def test_what_the_paper_mode_gets_wrong_physically(group):
    """Reflected scenes want the opposite theta; a turned Gaussian has its deviations turned."""
    actor, data = make(make_actor, group, mode="paper"), scenes("random", 16)
    critic = make(make_critic, group, mode="paper")
    before = actor(data.clone())
    mirrored = data.clone().set("depth", turn_image(data["depth"], 0, True))
    error = actor(mirrored)["loc"] - turn_action(before["loc"], 0, True)
    assert error[:, :4].abs().max() < 1e-9
    torch.testing.assert_close(error[:, 4], 2 * before["loc"][:, 4], atol=1e-9, rtol=0)
    assert error[:, 4].abs().min() > 1e-4
    action = torch.full((3, 5), 0.5, dtype=torch.float64)
    values = critic(data.clone().set("action", action))["state_action_value"]
    mirrored["action"] = turn_action(action, 0, True)
    assert (critic(mirrored)["state_action_value"] - values).abs().max() > 1e-5
    turned = data.clone().set("depth", turn_image(data["depth"], 1, False))
    action = torch.tensor([0.0, 0.5, -0.1, 0.0, 0.0], dtype=torch.float64).expand(3, 5)
    change = actor.get_dist(turned).log_prob(turn_action(action, 1, False))
    change = change - actor.get_dist(data.clone()).log_prob(action)
    assert change.abs().min() > 1e-4


@pytest.mark.parametrize("scene", SCENES[1:-1])
@pytest.mark.parametrize("group", CONTINUOUS)
def test_what_the_paper_mode_gets_wrong_on_symmetric_scenes(group, scene):
    """A scene that looks the same from all sides prefers none; the first of ties has a side."""
    data = scenes(scene, 16)
    sideways = {
        mode: make(make_actor, group, mode=mode)(data.clone())["loc"][:, 1:3]
        for mode in TURN_ACTION
    }
    assert sideways["strict"].abs().max() < 1e-12
    assert sideways["paper"].abs().max() > 1e-3
    with pytest.raises(AssertionError, match="loc under 90° errs by"):
        assert_networks_turn(group, "paper", scene, {**data, "action": actions()})


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("scene", SCENES)
def test_encoder_turns_its_hidden_fields(group, scene):
    encoder = make(EquivariantEncoder, group, scene)
    data = scenes(scene, 16)
    assert_equivariant(
        lambda **inputs: {"features": encoder(**inputs)},
        group,
        {"image": data["depth"], "invariants": data["holding"]},
        {"image": turn_image, "features": turn_fields(encoder.out_type)},
        case=f"encoder, {scene}",
    )


@pytest.mark.parametrize("group", GROUPS)
def test_convolution_of_mixed_fields(group):
    symmetry = SymmetryGroup(group)
    fields = FieldType.of(symmetry, ACTION) + FieldType.hidden(symmetry, 1)
    generator = torch.Generator().manual_seed(0)
    layer = SteerableConv(fields, fields, padding=1, generator=generator).double()
    layer.bias.data.normal_(generator=generator)
    x = torch.randn(2, fields.size, 6, 6, dtype=torch.float64, generator=generator)

    def turn(x, *element):
        channels = turn_fields(fields)(x.movedim(1, -1), *element).movedim(-1, 1)
        return turn_image(channels, *element)

    assert_equivariant(
        lambda x: {"y": layer(x)}, group, {"x": x}, {"x": turn, "y": turn}, case="convolution"
    )


def test_the_test_would_notice():
    """The baseline has no symmetry: the same assertion fails, and says where."""
    actor = prepared(make_cnn_actor(hidden=8, image_size=16))
    with pytest.raises(AssertionError, match=r"CNN: loc under 90° errs by [\d.]+, more"):
        assert_equivariant(
            lambda **inputs: dict(actor(TensorDict(inputs, 3)).select("loc")),
            "C4",
            dict(scenes("random", 16)),
            {"depth": turn_image, "loc": turn_action},
            case="CNN",
            tolerance=1e-4,
        )


@pytest.mark.parametrize("group", ["C8", "D8", "SO2", "O2"])
def test_error_at_other_angles_is_bounded_not_zero(group, record_property):
    """45 degrees do not map pixels onto pixels: the error is reported, and is not chance."""
    actor = make(make_actor, group, size=32)
    grid = (torch.arange(32, dtype=torch.float64) - 15.5) / 16
    x, y = grid[:, None], grid[None, :]

    def scene(angle):  # a smooth bump beside the gripper, turned analytically
        cx, cy = 0.4 * math.cos(angle), 0.4 * math.sin(angle)
        depth = 0.2 - 0.1 * torch.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 0.08)
        return actor(
            TensorDict(
                depth=depth[None, None],
                holding=torch.zeros(1, 1, dtype=torch.float64),
                batch_size=1,
            )
        )["loc"]

    before, after = scene(0.0), scene(math.pi / 4)
    error = (after - ACTION.transform(before, Element(math.pi / 4))).norm() / before.norm()
    record_property("relative_error", error.item())
    assert 1e-9 < error < 0.5
