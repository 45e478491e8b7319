"""Turn the scene and the policy turns with it, to rounding, for every grid element."""

import math

import pytest
import torch
from tensordict import TensorDict

from equirl.modules import (
    EquivariantEncoder,
    FieldType,
    SteerableConv,
    make_actor,
    make_cnn_actor,
    make_critic,
)
from equirl.symmetry import ACTION, Element, SymmetryGroup
from tests.equivariance import (
    assert_equivariant,
    turn_action,
    turn_action_of_the_paper,
    turn_fields,
    turn_image,
)

slow = pytest.mark.slow
GROUPS = ("C4", "D4", "C8", "D8", "C2", "D2", *(pytest.param(g, marks=slow) for g in ("C6", "D3")))
SIZES = (16, pytest.param(32, marks=slow), pytest.param(64, marks=slow))
SIZES += (pytest.param(128, marks=slow), pytest.param(256, marks=slow))
SCENES = ("random", "cube under the gripper", "nothing")


def scenes(kind, size):
    generator = torch.Generator().manual_seed(7)
    depth = torch.zeros(3, 1, size, size, dtype=torch.float64)
    holding = torch.zeros(3, 1, dtype=torch.float64)
    if kind == "random":
        depth = 0.32 * torch.rand(depth.shape, generator=generator, dtype=torch.float64)
        holding[1] = 1.0
    elif kind == "cube under the gripper":  # every window of the pooling meets ties
        depth += 0.19
        centre = slice(size // 2 - size // 8, size // 2 + size // 8)
        depth[..., centre, centre] -= torch.tensor([0.05, 0.02, 0.1])[:, None, None, None]
        holding[1] = 1.0
    else:
        assert kind == "nothing"  # zero features where biases are zero
    return TensorDict(depth=depth, holding=holding, batch_size=3)


def prepared(network, scene):
    """In float64; with biases, unless zero features are wanted."""
    generator = torch.Generator().manual_seed(3)
    if scene != "nothing":
        for name, parameter in network.named_parameters():
            if name.endswith("bias"):
                parameter.data.normal_(generator=generator).mul_(0.1)
    return network.double().requires_grad_(False)


def make(function, group, scene, size=16, **kwargs):
    hidden = 16 if size == 256 else 8
    generator = torch.Generator().manual_seed(11)
    return prepared(
        function(group, hidden=hidden, image_size=size, generator=generator, **kwargs), scene
    )


def actions(scale=1.0):
    generator = torch.Generator().manual_seed(5)
    return scale * (2 * torch.rand(3, 5, generator=generator, dtype=torch.float64) - 1)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("group", GROUPS)
def test_strict_actor(group, scene, size):
    actor = make(make_actor, group, scene, size)

    def policy(depth, holding, action):
        dist = actor.get_dist(TensorDict(depth=depth, holding=holding, batch_size=3))
        return {
            "loc": dist.loc,
            "scale": dist.scale,
            "greedy": dist.deterministic_sample,
            "log_prob": dist.log_prob(action),
        }

    assert_equivariant(
        policy,
        group,
        {**scenes(scene, size), "action": actions(0.57)},  # (x, y) inside the disc
        {"depth": turn_image, **dict.fromkeys(("action", "loc", "greedy"), turn_action)},
        case=f"strict actor, {scene}",
    )


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("group", GROUPS)
def test_strict_critic(group, scene, size):
    critic = make(make_critic, group, scene, size)

    def values(**inputs):
        values = critic(TensorDict(inputs, 3))["state_action_value"]
        assert values.shape == (3, 2)
        return {"values": values}

    assert_equivariant(
        values,
        group,
        {**scenes(scene, size), "action": actions()},
        {"depth": turn_image, "action": turn_action},
        case=f"strict critic, {scene}",
    )


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("group", GROUPS)
def test_paper_networks_under_their_declared_representation(group, scene):
    actor, critic = (make(each, group, scene, mode="paper") for each in (make_actor, make_critic))

    def both(depth, holding, action):
        data = actor(TensorDict(depth=depth, holding=holding, batch_size=3))
        values = critic(data.clone().set("action", action))["state_action_value"]
        return {**data.select("loc", "scale"), "values": values}

    assert_equivariant(
        both,
        group,
        {**scenes(scene, 16), "action": actions()},
        {"depth": turn_image, **dict.fromkeys(("action", "loc"), turn_action_of_the_paper)},
        case=f"paper networks, {scene}",
    )


def test_what_the_paper_mode_gets_wrong_physically():
    """Reflected scenes want the opposite theta; a turned Gaussian has its deviations turned."""
    actor, data = make(make_actor, "D4", "random", mode="paper"), scenes("random", 16)
    critic = make(make_critic, "D4", "random", mode="paper")
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


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("scene", SCENES)
def test_encoder_permutes_its_regular_fields(group, scene):
    encoder = make(EquivariantEncoder, group, scene)
    assert_equivariant(
        lambda **inputs: {"features": encoder(**inputs)},
        group,
        dict(scenes(scene, 16)),
        {"depth": turn_image, "features": turn_fields(encoder.out_type)},
        case=f"encoder, {scene}",
    )


@pytest.mark.parametrize("group", GROUPS)
def test_convolution_of_mixed_fields(group):
    symmetry = SymmetryGroup(group)
    fields = FieldType.of(symmetry, ACTION) + FieldType.regular(symmetry, 1)
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
    actor = prepared(make_cnn_actor(hidden=8, image_size=16), "random")
    with pytest.raises(AssertionError, match=r"CNN: loc under 90° errs by [\d.]+, more"):
        assert_equivariant(
            lambda **inputs: dict(actor(TensorDict(inputs, 3)).select("loc")),
            "C4",
            dict(scenes("random", 16)),
            {"depth": turn_image, "loc": turn_action},
            case="CNN",
            tolerance=1e-4,
        )


@pytest.mark.parametrize("group", ["C8", "D8"])
def test_error_at_other_angles_is_bounded_not_zero(group, record_property):
    """45 degrees do not map pixels onto pixels: the error is reported, and is not chance."""
    actor = make(make_actor, group, "random", size=32)
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
