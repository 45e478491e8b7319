"""The report changes nothing, says what it cannot measure, and shows what it did."""

import copy
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from equirl.analysis.angles import plot_errors
from equirl.modules import make_actor, make_critic
from equirl.symmetry import ACTION, Element, SymmetryGroup, equivariance_report, random_observations
from equirl.symmetry.audit_transforms import transform_image
from tests.symmetry.report_networks import SEEN, acting, constant, judging, seeded


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
        (constant(1.0), SEEN, {}, r"trivial \+ vector \+ trivial \+ sign: .* got shape \(1,\)"),
        (constant(1.0), SEEN, {"action": ["vectr"]}, "expected a field trivial.* got 'vectr'"),
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
    lowest, highest = data["depth"].flatten(1).aminmax(dim=1)
    assert (lowest == 0).all() and torch.allclose(highest, torch.tensor(0.2))
    assert set(data["holding"].flatten().tolist()) <= {0.0, 1.0}
    many = random_observations(30, 32, max_depth=0.2)["depth"].numpy()
    landscapes, boxes, squares = many[::3], many[1::3], many[2::3]
    assert np.abs(np.diff(landscapes)).max() < 0.1  # smooth
    assert all(len(np.unique(scene)) <= 4 for scene in boxes)
    for element in SymmetryGroup("D4").elements:
        assert (transform_image(squares, element) == squares).all()
        moved = element.reflected or element.quarter_turns
        for scene in (*landscapes, *boxes):
            assert not moved or (transform_image(scene, element) != scene).any()
    assert len({scene.tobytes() for scene in squares}) == 10
    for size in (1, 2, 3):
        assert random_observations(3, size)["depth"].isfinite().all()


@pytest.mark.parametrize(
    ("count", "size", "named"),
    [
        (0, 32, "count=0"),
        (2.5, 32, "count=2.5"),
        (True, 32, "count=True"),
        (2, -1, "image_size=-1"),
        (2, "32", "image_size='32'"),
    ],
)
def test_numbers_of_observations_are_checked(count, size, named):
    with pytest.raises(ValueError, match=f"{named}: expected an integer of 1 or more"):
        random_observations(count, size)


def test_tables_and_picture(tmp_path):
    actor = seeded(make_actor, "C8")
    elements = [Element(math.tau * k / 12) for k in range(12)]
    report = equivariance_report(actor, "C8", SEEN, elements=elements)
    table = str(report)
    assert "| error: mean (largest) | size | quarter turns | outside the group |" in table
    assert "| layer | fields | elements | error |" in table
    assert "C8, 12 elements, 3 observations, actions trivial + vector + trivial + sign." in table
    records = report.records()
    assert len(records) == 4 * 12 + 3 * len(report.names("layer"))
    path = tmp_path / "errors.png"
    plot_errors([{"training": t, **row} for t in "ab" for row in records], path, title="C8")
    assert path.read_bytes()[:4] == b"\x89PNG"
    exact = equivariance_report(constant(0.0, 0, 0, 0, 0), "D4", SEEN)
    plot_errors(exact.records(), path)  # no error at all
    with pytest.raises(ValueError, match="got none"):
        plot_errors([], path)


def test_the_identity_alone_has_no_table_of_layers():
    report = equivariance_report(seeded(make_actor, "C4"), "C4", SEEN, elements=[Element(0.0)])
    table = report.table()
    assert "| mean |" in table and "| layer |" not in table
    assert not report.names("layer") and np.isnan(report.error("mean")).all()


def test_questions_to_the_report_are_checked():
    report = equivariance_report(constant(0, 0, 0, 0, 0), "C4", SEEN)
    for name, conditions, named in (
        ("mean", {}, "name='mean': expected one of action"),
        ("action", {"kind": "quarter turn"}, "kind='quarter turn': .* identity, quarter turns, "),
        ("action", {"kind": ("other turns", "x")}, "kind='x': expected one of"),
        ("action", {"angles": 90}, "column='angles': expected one of .*angle, reflected"),
        ("action", {"level": "layers"}, "level='layers': expected one of end to end, layer"),
    ):
        with pytest.raises(ValueError, match=named):
            report.error(name, **conditions)
    assert np.isnan(report.error("action", kind="other turns")).all()  # C4 has none
    assert np.isnan(report.error("action", angle=12)).all()
    assert math.isnan(report.there_and_back("action"))


def test_actions_are_drawn_from_the_symmetric_disc():
    drawn = []
    critic = judging(lambda depth, action: drawn.append(action) or action[:, :1])
    equivariance_report(critic, "C4", random_observations(16, 16), elements=[Element(0.0)])
    assert drawn[0][:, 1:3].norm(dim=-1).max() <= 1 and drawn[0].abs().max() > 0.5
    assert ACTION.dim == drawn[0].shape[1]
