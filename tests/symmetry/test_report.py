"""The report sees exact symmetry and measures known faults by their number."""

import copy

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import distributions as D
from torchrl.modules import ProbabilisticActor

from equirl.modules import make_actor, make_cnn_actor, make_cnn_critic, make_critic
from equirl.symmetry import Representation, equivariance_report, random_observations
from tests.symmetry.report_networks import FLIP, HALF, QUARTER, SEEN, constant, judging, seeded


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
    names = critic.names("layer")
    assert names[0] == "encoder.layers.0" and names[-1] == "heads" and "heads.hidden" in names
    assert {name.partition(".")[0] for name in names} == {"encoder", "heads"}


def test_layers_are_compared_on_the_grid_and_at_a_few_elements_between():
    backends, shares = [], []
    actor = seeded(make_actor, "O2", backend="native")
    encoder = actor.get_submodule("module.0.module.encoder")
    encoder.register_forward_hook(lambda module, *_: backends.append(module.backend))
    report = equivariance_report(actor, "O2", SEEN[:1], progress=shares.append)
    assert report.names("layer")[0] == "encoder.layers.0"  # in the order of their calls
    rows = report.select(name="encoder")
    between = np.char.startswith(rows["kind"], "other")
    assert between.sum() == 4 and (~between).sum() == 7
    assert {True, False} == set(rows["reflected"][between])
    assert len(report.select(name="mean")["mean"]) == 64
    assert backends.count("dense") == 1 + 11
    assert len(shares) == 64 + 11 and sum(shares) == pytest.approx(1)
    shares.clear()
    without = equivariance_report(actor, "O2", SEEN[:1], layers=False, progress=shares.append)
    assert not without.names("layer") and len(shares) == 64
    assert without.error("mean") == report.error("mean")


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


def test_ties_in_symmetric_scenes_tell_paper_from_strict():
    """The first of tied norms is not the first after a turn."""
    symmetric, others = random_observations(12, 16)[2::3], random_observations(12, 16)
    others = others[[i for i in range(12) if i % 3 != 2]]
    for mode, breaks in (("paper", True), ("strict", False)):
        actor = seeded(make_actor, "SO2", mode=mode).double()
        kind = "quarter turns"
        seen = equivariance_report(actor, "SO2", symmetric, layers=False).error("mean", kind=kind)
        assert (seen[1] > 1e-4) == breaks and (breaks or seen[1] < 1e-9)
        rest = equivariance_report(actor, "SO2", others, layers=False).error("mean", kind=kind)
        assert rest[1] < seen[1] if breaks else rest[1] < 1e-9


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
    declared = equivariance_report(policy, "D8", data, action=Representation("vector"))
    assert declared.action == ("vector",)
    np.testing.assert_array_equal(declared.rows["max"], report.rows["max"])
    with pytest.raises(ValueError, match=r"of 5 components, got shape \(2,\); say in action="):
        equivariance_report(policy, "D8", data)


def test_critics_of_another_action_are_told_apart():
    critic = seeded(make_critic, "D4", action=Representation("vector", "sign"))
    named = r"action=trivial \+ vector .* 5 components, got shape \(3,\); say in action="
    with pytest.raises(ValueError, match=named):
        equivariance_report(critic, "D4", SEEN)
    action = Representation("vector", "sign")
    assert equivariance_report(critic, "D4", SEEN, action=action).error("Q")[1] < 1e-5
    given = SEEN.clone().set("action", torch.zeros(3, 2))
    with pytest.raises(ValueError, match="expected the observations' action of 3 components"):
        equivariance_report(critic, "D4", given, action=action)
    weight = torch.ones(2, 1)
    plain = judging(lambda depth, action: action @ weight)  # nothing tells its size but failing
    with pytest.raises(ValueError, match=r"shapes depth .*, action \(3, 5\), with action=trivial"):
        equivariance_report(plain, "D4", SEEN)
