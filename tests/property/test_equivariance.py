"""Turn the scene and the policy turns with it, to rounding, for every grid element.

The transformations are written out here with rot90, flip and matrices, so that an error
in the package's own idea of a rotation cannot hide.
"""

import math

import numpy as np
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

TOLERANCE = 1e-9
slow = pytest.mark.slow
GROUPS = ("C4", "D4", "C8", "D8", "C2", "D2", *(pytest.param(g, marks=slow) for g in ("C6", "D3")))
SIZES = (16, pytest.param(32, marks=slow), pytest.param(64, marks=slow))
SIZES += (pytest.param(128, marks=slow), pytest.param(256, marks=slow))


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """These tensors are small: threads that wait for each other cost more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def grid_elements(group):
    """(quarter turns, reflected) for every element that maps the pixels onto themselves."""
    order = int(group[1:])
    turns = [k for k in range(4) if k * order % 4 == 0]
    return [(k, flip) for flip in ((False, True) if group[0] == "D" else (False,)) for k in turns]


def turn_image(image, turns, flip):
    return torch.rot90(image.flip(-1) if flip else image, turns, (-2, -1))


def turn_action(action, turns, flip, theta_is_invariant=False):
    """(gripper, x, y, z, theta): y -> -y and theta -> -theta, then x towards y."""
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][turns]
    vector = np.array([[c, -s], [s, c]]) @ np.diag([1, -1 if flip else 1])
    matrix = np.eye(5)
    matrix[1:3, 1:3] = vector
    matrix[4, 4] = -1 if flip and not theta_is_invariant else 1
    return action @ torch.tensor(matrix.T)


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


def close(actual, expected):
    torch.testing.assert_close(actual, expected, atol=TOLERANCE, rtol=0)


SCENES = ("random", "cube under the gripper", "nothing")


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("group", GROUPS)
def test_strict_actor(group, scene, size):
    actor, data = make(make_actor, group, scene, size), scenes(scene, size)
    before = actor.get_dist(data.clone())
    generator = torch.Generator().manual_seed(5)
    action = 0.57 * (2 * torch.rand(3, 5, generator=generator, dtype=torch.float64) - 1)
    for g in grid_elements(group):
        turned = data.clone().set("depth", turn_image(data["depth"], *g))
        after = actor.get_dist(turned)
        close(after.loc, turn_action(before.loc, *g))
        close(after.scale, before.scale)
        close(after.deterministic_sample, turn_action(before.deterministic_sample, *g))
        close(after.log_prob(turn_action(action, *g)), before.log_prob(action))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("group", GROUPS)
def test_strict_critic(group, scene, size):
    critic, data = make(make_critic, group, scene, size), scenes(scene, size)
    generator = torch.Generator().manual_seed(5)
    data["action"] = 2 * torch.rand(3, 5, generator=generator, dtype=torch.float64) - 1
    before = critic(data.clone())["state_action_value"]
    assert before.shape == (3, 2)
    for g in grid_elements(group):
        turned = data.clone().set("depth", turn_image(data["depth"], *g))
        turned["action"] = turn_action(data["action"], *g)
        close(critic(turned)["state_action_value"], before)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("group", GROUPS)
def test_paper_networks_under_their_declared_representation(group, scene):
    actor, data = make(make_actor, group, scene, mode="paper"), scenes(scene, 16)
    critic = make(make_critic, group, scene, mode="paper")
    before = critic(actor(data.clone()))
    for g in grid_elements(group):
        turned = data.clone().set("depth", turn_image(data["depth"], *g))
        after = actor(turned)
        close(after["loc"], turn_action(before["loc"], *g, theta_is_invariant=True))
        close(after["scale"], before["scale"])
        after["action"] = turn_action(before["action"], *g, theta_is_invariant=True)
        close(critic(after)["state_action_value"], before["state_action_value"])


def test_what_the_paper_mode_gets_wrong_physically():
    """Reflected scenes want the opposite theta; a turned Gaussian has its deviations turned."""
    actor, data = make(make_actor, "D4", "random", mode="paper"), scenes("random", 16)
    critic = make(make_critic, "D4", "random", mode="paper")
    before = actor(data.clone())
    mirrored = data.clone().set("depth", turn_image(data["depth"], 0, True))
    error = actor(mirrored)["loc"] - turn_action(before["loc"], 0, True)
    close(error[:, :4], torch.zeros(3, 4, dtype=torch.float64))
    close(error[:, 4], 2 * before["loc"][:, 4])
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
    encoder, data = make(EquivariantEncoder, group, scene), scenes(scene, 16)
    before = encoder(data["depth"], data["holding"])
    for turns, flip in grid_elements(group):
        after = encoder(turn_image(data["depth"], turns, flip), data["holding"])
        expected = encoder.out_type.transform(before, Element(turns * math.pi / 2, flip))
        close(after, expected)


@pytest.mark.parametrize("group", GROUPS)
def test_convolution_of_mixed_fields(group):
    symmetry = SymmetryGroup(group)
    fields = FieldType.of(symmetry, ACTION) + FieldType.regular(symmetry, 1)
    generator = torch.Generator().manual_seed(0)
    layer = SteerableConv(fields, fields, padding=1, generator=generator).double()
    layer.bias.data.normal_(generator=generator)
    x = torch.randn(2, fields.size, 6, 6, dtype=torch.float64, generator=generator)

    def turn(x, turns, flip):
        element = Element(turns * math.pi / 2, flip)
        return turn_image(fields.transform(x.movedim(1, -1), element).movedim(-1, 1), turns, flip)

    for g in grid_elements(group):
        close(layer(turn(x, *g)), turn(layer(x), *g))


def test_the_test_would_notice():
    """The baseline has no symmetry: the same measurement finds a large error."""
    actor = prepared(make_cnn_actor(hidden=8, image_size=16), "random")
    data = scenes("random", 16)
    before = actor(data.clone())["loc"]
    turned = data.clone().set("depth", turn_image(data["depth"], 1, False))
    assert (actor(turned)["loc"] - turn_action(before, 1, False)).abs().max() > 1e-4


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
