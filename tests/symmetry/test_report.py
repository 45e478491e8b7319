"""The report sees exact symmetry, measures known faults by their number, and changes nothing."""

import copy
import itertools
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import distributions as D
from torch import nn
from torchrl.modules import ProbabilisticActor

from equirl.analysis.angles import plot_errors
from equirl.modules import FieldType, make_actor, make_cnn_actor, make_cnn_critic, make_critic
from equirl.symmetry import (
    ACTION,
    Element,
    ScalarField,
    SymmetryGroup,
    equivariance_report,
    random_observations,
)
from equirl.symmetry.audit_transforms import (
    field_matrix,
    interpolate_image,
    transform_deviations,
    transform_fields,
)

HALF, QUARTER, FLIP = Element(math.pi), Element(math.pi / 2), Element(0.0, reflected=True)
SEEN = random_observations(3, 16)
FIELDS = ("regular", "trivial", "sign", "vector", "vector_2", "vector_3")


def seeded(make, *args, **kwargs):
    size = {"hidden": 8, "image_size": 16, "generator": torch.Generator().manual_seed(0)}
    return make(*args, **size, **kwargs)


def acting(function) -> TensorDictModule:
    """A policy of a function from depth (B, 1, S, S) to actions."""
    return TensorDictModule(function, in_keys=["depth"], out_keys=["action"])


def constant(*action: float) -> TensorDictModule:
    return acting(lambda depth: torch.tensor(action).expand(len(depth), -1))


def judging(function) -> TensorDictModule:
    """A critic of a function from depth and action to values."""
    return TensorDictModule(function, ["depth", "action"], ["state_action_value"])


# Its own arithmetic ---------------------------------------------------------------------------


def test_a_regular_field_is_a_function_on_the_group():
    group = SymmetryGroup("C4")
    moved = transform_fields(np.array([1.0, 2, 3, 4]), ["regular"], QUARTER, group)
    assert moved.tolist() == [4, 1, 2, 3]  # the value at h is now at g h
    group = SymmetryGroup("D2")  # (g f)(h) = f(g^-1 h): a reflection exchanges h and g h
    values = np.array([1.0, 2, 3, 4])  # at 0, half a turn, flip, flip and half a turn
    assert transform_fields(values, ["regular"], FLIP, group).tolist() == [3, 4, 1, 2]
    turned_flip = Element(math.pi, reflected=True)
    assert transform_fields(values, ["regular"], turned_flip, group).tolist() == [4, 3, 2, 1]


@pytest.mark.parametrize("name", ["C4", "D4", "C3", "D3", "D8"])
def test_fields_obey_the_group_law_and_agree_with_those_of_the_networks(name):
    group = SymmetryGroup(name)
    for field, (g, h) in itertools.product(FIELDS, itertools.product(group.elements, repeat=2)):
        both = field_matrix(field, g, group) @ field_matrix(field, h, group)
        np.testing.assert_allclose(field_matrix(field, g @ h, group), both, atol=1e-12)
    fields = ("trivial", "regular", "regular", "vector", "sign", "vector")
    values = torch.randn(5, 2 * group.order + 6, dtype=torch.float64)
    for element in group.elements:
        theirs = FieldType(group, fields).transform(values, element)
        ours = transform_fields(values.numpy(), fields, element, group)
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_irreducible_fields_by_hand():
    group, eighth = SymmetryGroup("O2"), Element(math.pi / 4, reflected=True)
    values = np.array([1.0, 2, 3, 4, 5, 6])
    moved = transform_fields(values, ["vector_2", "sign", "vector", "trivial"], eighth, group)
    root = math.sqrt(0.5)  # vector_2: (1, -2) by a right angle; vector: (4, -5) by half of one
    np.testing.assert_allclose(moved, [2, 1, -3, root * 9, root * -1, 6])
    turned = transform_fields(np.ones(2), ["vector_x", "vector_y"], HALF, SymmetryGroup("D2"))
    assert turned.tolist() == [-1, -1]
    turned = transform_fields(np.ones(2), ["vector_x", "vector_y"], FLIP, SymmetryGroup("D2"))
    assert turned.tolist() == [1, -1]
    matrices = transform_deviations(np.array([1.0, 2, 3]), ["vector", "sign"], QUARTER, group)
    np.testing.assert_allclose(matrices, [2, 0, 0, 1, 3], atol=1e-15)
    with pytest.raises(ValueError, match="regular of a finite group, got 'regular'"):
        field_matrix("regular", FLIP, group)
    with pytest.raises(ValueError, match=r"expected 3 channels, got an array of shape \(6,\)"):
        transform_fields(values, ["vector", "sign"], FLIP, group)


@pytest.mark.parametrize("element", [Element(0.4), Element(-2.1, reflected=True), Element(math.pi)])
def test_a_picture_of_a_plane_is_the_plane_turned(element):
    """Bilinear interpolation is exact for planes; rows are x, columns y."""
    size = 32
    x, y = np.meshgrid(np.arange(size) - 15.5, np.arange(size) - 15.5, indexing="ij")
    moved = interpolate_image((0.3 * x - 0.7 * y)[None, None], element)[0, 0]
    direction = field_matrix("vector", element, SymmetryGroup("O2")) @ [0.3, -0.7]
    inside = np.hypot(x, y) < 15  # elsewhere the border was replicated
    np.testing.assert_allclose(moved[inside], (direction[0] * x + direction[1] * y)[inside])
    picture = SEEN["depth"].double()
    theirs = ScalarField().transform(picture, element)
    np.testing.assert_allclose(interpolate_image(picture.numpy(), element), theirs, atol=1e-9)


# Networks that have the symmetry, and that have not -------------------------------------------


@pytest.mark.parametrize(
    "group", ["C4", "D4", "C8", "C3", pytest.param("O2", marks=pytest.mark.slow)]
)
def test_strict_networks_are_exact_where_pixels_are(group):
    for network in (seeded(make_actor, group), seeded(make_critic, group)):
        report = equivariance_report(copy.deepcopy(network).double(), group, SEEN)
        exact = report.select(kind=("quarter turns", "reflections of the grid"))
        assert (exact["max"] < 1e-9).all() and (exact["size"] > 1e-4).all()
        assert not report.unmeasured
        if group == "C3":  # has no such elements
            last = report.names("layer")[-1]
            assert not len(exact["name"]) and report.error(last)[0] > 1e-4
            continue
        assert {"end to end", "layer"} == set(exact["level"])
        assert len(report.names("layer")) >= 6
        if group in ("C8", "O2"):
            for name in report.names("end to end"):
                mean, largest = report.error(name, kind="other turns")
                assert 1e-6 < mean < largest
            between = report.select(kind="other turns", level="end to end")
            assert (between["interpolated"] > 0).all()


def test_quantities_and_layers_have_their_names():
    report = equivariance_report(seeded(make_actor, "C4"), "C4", SEEN)
    assert report.names("end to end") == ["mean", "sigma", "log-probability", "action"]
    layers = report.names("layer")
    assert layers[0] == "encoder.layers.0" and layers[-2:] == ["encoder", "head"]
    critic = equivariance_report(seeded(make_critic, "C4"), "C4", SEEN)
    assert critic.names("end to end") == ["Q"]
    assert critic.names("layer")[-1] == "EquivariantQHeads"


def test_a_network_without_symmetry():
    for network in (seeded(make_cnn_actor), seeded(make_cnn_critic)):
        report = equivariance_report(network, "D4", SEEN)
        assert not report.names("layer")
        for name in report.names("end to end"):
            rows = report.select(name=name, kind="quarter turns")
            assert (rows["mean"] > 1e-3 * rows["size"]).all(), name


def test_the_papers_policy_errs_physically_and_not_under_its_own_representation():
    actor = seeded(make_actor, "D4", mode="paper").double()
    physical = equivariance_report(actor, "D4", SEEN)
    declared = equivariance_report(actor, "D4", SEEN, keep_theta=True)
    for name in ("mean", "action"):
        assert physical.error(name, kind="quarter turns")[1] < 1e-9
        assert physical.error(name, kind="reflections of the grid")[0] > 1e-3
        assert declared.error(name)[1] < 1e-9
    for report in (physical, declared):  # x and y have deviations of their own
        assert report.error("sigma", angle=90)[0] > 1e-3
        assert report.error("sigma", angle=180)[1] < 1e-9
    theta = equivariance_report(actor, "D4", SEEN, elements=[FLIP]).error("mean")
    with torch.no_grad():
        expected = 2 * actor(SEEN.double())["loc"][:, 4].abs()
    assert theta == pytest.approx((expected.mean().item() / 5, expected.max().item()))


def test_errors_of_an_action_are_measured_by_their_number():
    report = equivariance_report(constant(0.5, 0.3, 0.0, 0.9, 0.2), "D4", SEEN)
    assert report.names("end to end") == ["action"]
    assert report.error("action", angle=180, reflected=False) == pytest.approx((0.6 / 5, 0.6))
    assert report.error("action", angle=90, reflected=False) == pytest.approx((0.6 / 5, 0.3))
    assert report.error("action", angle=0) == pytest.approx((0.4 / 5, 0.4))  # theta
    assert report.error("action", kind="identity") == (0, 0)
    kept = equivariance_report(constant(0.5, 0.3, 0, 0.9, 0.2), "D4", SEEN, keep_theta=True)
    assert kept.error("action", angle=0) == (0, 0)


def test_deviations_and_log_probabilities_are_measured_by_their_number():
    scale = torch.tensor([1.0, 0.5, 2, 1, 1])
    network = TensorDictModule(
        lambda depth: (torch.zeros(len(depth), 5), scale.expand(len(depth), 5)),
        in_keys=["depth"],
        out_keys=["loc", "scale"],
    )
    actor = ProbabilisticActor(
        network,
        in_keys=["loc", "scale"],
        distribution_class=lambda loc, scale: D.Independent(D.Normal(loc, scale), 1),
    )
    report = equivariance_report(actor, "C4", SEEN, seed=5)
    assert report.error("mean") == (0, 0)
    assert report.error("sigma", angle=90) == pytest.approx((3 / 7, 1.5))
    assert report.error("sigma", angle=180) == pytest.approx((0, 0), abs=1e-15)
    with torch.random.fork_rng():
        torch.manual_seed(5)
        x, y = D.Normal(0, scale.expand(3, 5)).sample()[:, 1:3].square().T
    expected = ((x - y) * (1 / 0.5**2 - 1 / 2**2) / 2).abs()
    measured = report.error("log-probability", angle=(90, 270))
    assert measured == pytest.approx((expected.mean().item(), expected.max().item()), rel=1e-4)


def test_errors_of_values_are_measured_by_their_number():
    by_x = judging(lambda depth, action: 3 * action[:, 1:2])
    data = SEEN.clone().set("action", torch.tensor([[0, 0.5, 0.1, 0, 0.7]]).expand(3, 5))
    report = equivariance_report(by_x, "D4", data)
    assert report.error("Q", angle=180, reflected=False) == pytest.approx((3.0, 3.0))
    assert report.error("Q", angle=0) == (0, 0)
    by_corner = judging(lambda depth, action: depth[:, :, 0, 0])
    report = equivariance_report(by_corner, "C4", data)  # a quarter turn brings the upper right
    corners = (data["depth"][:, 0, 0, 0] - data["depth"][:, 0, 0, -1]).abs()
    expected = corners.mean().item(), corners.max().item()
    assert report.error("Q", angle=90) == pytest.approx(expected)
    drawn = equivariance_report(judging(lambda depth, action: action), "C4", SEEN, elements=[HALF])
    assert 0 < drawn.error("Q")[1] <= 2


def test_an_error_shows_after_the_layer_that_makes_it():
    actor = seeded(make_actor, "C4").double()
    report = equivariance_report(actor, "C4", SEEN)
    names = report.names("layer")
    broken = actor.get_submodule("module.0.module.encoder.layers.1")
    channels = broken.out_type.size

    def shift_one_channel(module, args, output):
        return output + (torch.arange(channels) == 2).double().view(1, -1, 1, 1)

    broken.register_forward_hook(shift_one_channel, prepend=True)
    report = equivariance_report(actor, "C4", SEEN, elements=[QUARTER])
    at = names.index("encoder.layers.1")
    for name in names[:at]:
        assert report.error(name)[1] < 1e-9
    # The shift should be in the next channel of the field, and is in this one.
    assert report.error("encoder.layers.1") == pytest.approx((2 / channels, 1.0))
    for name in names[at + 1 :]:
        assert report.error(name)[1] > 1e-3, name


def test_pictures_and_actions_of_another_task():
    """Three channels, nested keys, an action (x, y) alone: towards the brightest side."""

    def slope(rgb):
        across = torch.arange(16) - 7.5
        image = rgb.mean(1)
        return torch.stack(
            [(image * across[:, None]).sum((1, 2)), (image * across).sum((1, 2))], -1
        )

    policy = TensorDictModule(slope, in_keys=[("camera", "rgb")], out_keys=["action"])
    data = TensorDict({"camera": {"rgb": torch.rand(2, 4, 3, 16, 16)}}, [2, 4])
    report = equivariance_report(policy, "D8", data, action=("vector",))
    assert report.observations == 8
    assert report.error("action", kind=("quarter turns", "reflections of the grid"))[1] < 1e-4
    wrong = equivariance_report(policy, "D8", data, action=("trivial", "trivial"))
    assert wrong.error("action", kind="quarter turns")[1] > 1
    with pytest.raises(ValueError, match=r"expected action \(\*batch, 5\) .* got shape \(8, 2\)"):
        equivariance_report(policy, "D8", data)


# What it leaves alone, and what it refuses ----------------------------------------------------


def test_nothing_is_touched():
    class Noisy(nn.Module):
        def __init__(self):
            super().__init__()
            self.linear, self.norm = nn.Linear(256, 5), nn.BatchNorm1d(5)
            self.dropout = nn.Dropout()

        def forward(self, depth):
            return self.dropout(self.norm(self.linear(depth.flatten(1))))

    for network in (acting(Noisy()), seeded(make_actor, "D4"), seeded(make_critic, "D4")):
        data, state = SEEN.clone(), copy.deepcopy(network.state_dict())
        modes = [module.training for module in network.modules()]
        attributes = [dict(vars(module)) for module in network.modules()]
        generator, numbers = torch.get_rng_state(), np.random.get_state()[1].copy()
        first = equivariance_report(network, "D4", data)
        assert torch.equal(torch.get_rng_state(), generator)
        assert (np.random.get_state()[1] == numbers).all()
        assert modes == [module.training for module in network.modules()]
        for module, before in zip(network.modules(), attributes, strict=True):
            assert vars(module).keys() == before.keys()
            assert not module._forward_hooks and vars(module).get("backend") == before.get(
                "backend"
            )
        for key, value in network.state_dict().items():
            assert torch.equal(value, state[key]), key
        assert (data == SEEN).all() and not any(p.grad is not None for p in network.parameters())
        torch.rand(3)  # the report does not depend on what was drawn before
        second = equivariance_report(network, "D4", data)
        for column, values in first.rows.items():
            np.testing.assert_array_equal(second.rows[column], values)


def test_noise_is_told():
    report = equivariance_report(acting(lambda depth: torch.rand(len(depth), 5)), "C4", SEEN)
    assert any("Not repeatable" in remark for remark in report.remarks)


@pytest.mark.parametrize(
    ("network", "observations", "options", "named"),
    [
        (TensorDictModule(nn.ReLU(), ["depth"], ["x"]), SEEN, {}, r"out_keys \['x'\]"),
        (nn.ReLU(), SEEN, {}, "got ReLU"),
        (constant(1.0), SEEN, {}, r"trivial \+ vector \+ trivial \+ sign, got shape \(3, 1\)"),
        (constant(1.0), SEEN.exclude("depth"), {}, "reads 'depth', got observations with holding"),
        (constant(1.0), SEEN[:0], {}, "at least one observation"),
        (constant(1.0), SEEN, {"elements": []}, "at least one element"),
        (
            constant(1.0),
            TensorDict({"depth": torch.zeros(3, 1, 4, 6)}, [3]),
            {},
            r"square pictures, got depth of shape \(3, 1, 4, 6\)",
        ),
    ],
)
def test_what_cannot_be_measured_is_named(network, observations, options, named):
    with pytest.raises(ValueError, match=named):
        equivariance_report(network, "C4", observations, **options)


def test_random_observations_are_what_they_say():
    data = random_observations(5, 32, max_depth=0.2, seed=1)
    assert (data == random_observations(5, 32, max_depth=0.2, seed=1)).all()
    assert data["depth"].shape == (5, 1, 32, 32) and data["depth"].dtype == torch.float32
    assert data["depth"].amin() == 0 and data["depth"].amax() == pytest.approx(0.2)
    assert set(data["holding"].flatten().tolist()) <= {0.0, 1.0}
    steps = data["depth"].diff(dim=-1).abs()
    assert steps.max() < 0.1  # smooth
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        random_observations(0, 32)


# What is shown --------------------------------------------------------------------------------


def test_tables_and_picture(tmp_path):
    actor = seeded(make_actor, "C8")
    elements = [Element(math.tau * k / 12) for k in range(12)]
    report = equivariance_report(actor, "C8", SEEN, elements=elements)
    table = str(report)
    assert "| error: mean (largest) | size | quarter turns | outside the group |" in table
    assert "| layer | fields | elements | error |" in table
    assert "C8, 12 elements, 3 observations, actions trivial + vector + trivial + sign." in table
    records = report.records()
    assert len(records) == 4 * 12 + 4 * len(report.names("layer"))
    path = tmp_path / "errors.png"
    plot_errors([{"training": t, **row} for t in "ab" for row in records], path, title="C8")
    assert path.read_bytes()[:4] == b"\x89PNG"
    exact = equivariance_report(constant(0.0, 0, 0, 0, 0), "D4", SEEN)
    plot_errors(exact.records(), path)  # no error at all
    with pytest.raises(ValueError, match="got none"):
        plot_errors([], path)


def test_actions_are_drawn_from_the_symmetric_disc():
    drawn = []
    critic = judging(lambda depth, action: drawn.append(action) or action[:, :1])
    equivariance_report(critic, "C4", random_observations(16, 16), elements=[Element(0.0)])
    assert drawn[0][:, 1:3].norm(dim=-1).max() <= 1 and drawn[0].abs().max() > 0.5
    assert ACTION.dim == drawn[0].shape[1]
