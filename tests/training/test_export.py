"""Exported policies: they do what the policy does, and say truly whether they turn."""

import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from equirl.envs.action import Action
from equirl.training import (
    ExportError,
    check_exported,
    load_exported,
    read_certificate,
)
from equirl.training.export import exporting, formats, frozen, summary
from equirl.training.export.certificate import measure
from equirl.training.export.measures import Observations, batch_sizes, make_observations
from tests.equivariance import assert_equivariant, turn_action, turn_image

ROOT = Path(__file__).parents[2]
SUFFIXES = [".pt2", ".onnx"]


def assert_same(policy, actor):
    """Asserts that a file does what an actor does, for several numbers of images."""
    for count in (1, 2, 9):
        depth, holding = 0.3 * torch.rand(count, 1, 16, 16), torch.rand(count, 1).round()
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            expected = actor(TensorDict({"depth": depth, "holding": holding}, [count]))
        found = policy(depth.numpy(), holding.numpy())
        assert found.keys() == {"action", "loc", "scale"}
        for name, value in found.items():
            assert value.shape == (count, 5)
            torch.testing.assert_close(torch.from_numpy(value), expected[name], atol=5e-6, rtol=0)


@pytest.mark.parametrize(
    ("case", "suffix"),
    [
        ("D4", ".pt2"),
        ("D4", ".onnx"),
        ("C4", ".pt2"),
        ("C8", ".onnx"),
        ("D8", ".pt2"),
        ("SO2", ".pt2"),
        ("O2", ".onnx"),
    ],
)
def test_equivariant_policies_are_certified(export, case, suffix):
    actor, certificate, path = export(suffix, case, observations=24)
    policy = load_exported(path)
    assert_same(policy, actor)
    assert max(certificate["difference"].values()) < 5e-6
    assert certificate == read_certificate(path) == json.loads(json.dumps(certificate))
    assert certificate["exact_on_grid"] and "Not exact" not in summary(certificate)

    def act(depth, holding):
        out = policy(np.ascontiguousarray(depth.numpy()), holding.numpy())
        return {name: torch.from_numpy(value) for name, value in out.items()}

    turned = {"depth": turn_image, "action": turn_action, "loc": turn_action}
    inputs = {"depth": 0.3 * torch.rand(4, 1, 16, 16), "holding": torch.ones(4, 1)}
    assert_equivariant(act, case, inputs, turned, case=case, tolerance=5e-6)


def test_errors_between_pixels_are_measured_and_said(export):
    _, certificate, _ = export(".pt2", "C8", observations=12)
    found = certificate["symmetry"]["physical"]
    degrees = {on_grid: [] for on_grid in (True, False)}
    for row in found["errors"]:
        degrees[row["on_grid"]].append(row["degrees"])
    assert degrees == {True: [90, 180, 270], False: [45, 135, 225, 315]}
    for name, error in found["between"].items():
        rows = [row[name] for row in found["errors"] if not row["on_grid"]]
        assert error["largest"] == max(row["largest"] for row in rows) > 1e-3
        assert 1e-4 < error["mean"] < error["largest"]
        assert error["there_and_back"] > 1e-4 and error["size"] > 1e-2
    error = found["between"]["action"]
    page = summary(certificate)
    assert "that map pixels onto pixels: action, loc, scale. Between them the action" in page
    assert f"errs by {error['mean']:.1e} in the mean and {error['largest']:.1e} at most" in page
    assert "| 4 others of C8 |" in page


def test_of_groups_with_many_elements_some_are_measured(export):
    _, certificate, path = export(".pt2", "C4", observations=3)
    assert certificate["symmetry"]["physical"]["between"] is None
    assert "Between" not in summary(certificate) and "others" not in summary(certificate)
    seen = make_observations(1, 16, 0.32)
    found = measure(load_exported(path), seen, certificate["tolerance"], "D100", "strict")
    on_grid = [row["on_grid"] for row in found["symmetry"]["physical"]["errors"]]
    assert on_grid.count(True) == 7 and on_grid.count(False) == 8


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_policy_without_symmetry_says_so(export, suffix):
    actor, certificate, path = export(suffix, "CNN", observations=24)
    assert_same(load_exported(path), actor)
    assert certificate["group"] is None and not certificate["exact_on_grid"]
    found = certificate["symmetry"]["physical"]
    assert not any(found["exact_on_grid"].values()) and found["between"] is None
    assert min(row["action"]["largest"] for row in found["errors"]) > 1e-3
    assert "Not exact under the turns of D4" in summary(certificate)
    assert "no symmetry built in" in summary(certificate)


def test_the_papers_policy_says_under_what_it_is_exact(export):
    actor, certificate, path = export(".pt2", "D4 paper", observations=24)
    assert_same(load_exported(path), actor)
    symmetry = certificate["symmetry"]
    assert not certificate["exact_on_grid"] and all(symmetry["paper"]["exact_on_grid"].values())
    for row in symmetry["physical"]["errors"]:
        assert row["reflected"] == ("y reversed" in row["element"])
        assert row["reflected"] == (row["action"]["largest"] > 1e-3)  # the sign of theta
        assert (row["degrees"] in (90, 270)) == (row["scale"]["largest"] > 1e-3)
    page = summary(certificate)
    assert page.index("Not exact under the turns of D4") < page.index("Exact up to rounding")


@pytest.mark.parametrize("case", ["SO2 paper", "O2 paper"])
def test_where_ties_are_broken_by_order_nothing_is_exact(export, case):
    actor, certificate, path = export(".pt2", case, observations=12)
    assert_same(load_exported(path), actor)
    for found in certificate["symmetry"].values():
        assert not any(found["exact_on_grid"].values()) and found["between"]


def test_the_certificate_says_what_goes_in_and_out(export):
    _, certificate, path = export(".pt2", observations=70)
    facts = {"task": "block_picking", "steps": 7, "seed": 0, "group": "D4", "mode": "strict"}
    assert facts.items() <= certificate.items()
    assert certificate["image"]["side_m"] == 0.3 and certificate["image"]["pixels"] == 16
    assert certificate["inputs"]["depth"]["shape"] == ["batch", 1, 16, 16]
    components = certificate["outputs"]["action"]["components"]
    assert list(components) == list(Action._fields)
    ranges = {name: (c["low"], c["high"], c["unit"]) for name, c in components.items()}
    assert ranges["gripper"] == (0, 0.08, "m") and ranges["x"] == ranges["z"] == (-0.05, 0.05, "m")
    assert ranges["theta"] == (-math.pi / 4, math.pi / 4, "rad")
    assert certificate["batches"] == [1, 2, 3, 64] == batch_sizes(70)
    assert len(certificate["symmetry"]["physical"]["errors"]) == 7
    with zipfile.ZipFile(path) as archive:
        contents = b"".join(archive.read(name) for name in archive.namelist())
    assert str(ROOT).encode() not in contents


def test_the_squash_can_be_redone_from_the_mean(export):
    """As a user who samples has to."""
    _, certificate, path = export(".pt2")
    out = load_exported(path)(*make_observations(3, 16, 0.32))
    x, y = out["loc"][:, 1], out["loc"][:, 2]
    length = np.hypot(x, y)
    expected = np.tanh(out["loc"])
    expected[:, 1:3] = (np.tanh(length) / length)[:, None] * out["loc"][:, 1:3]
    np.testing.assert_allclose(out["action"], expected, atol=1e-5)
    assert "length r becomes tanh(r)" in certificate["squash"]


def test_without_turns_of_the_grid_nothing_is_certified(export):
    _, certificate, path = export(".pt2", observations=3)
    seen = make_observations(3, 16, 0.32)
    found = measure(load_exported(path), seen, certificate["tolerance"], "C3", "strict")
    assert not found["exact_on_grid"] and found["symmetry"]["physical"]["between"]
    page = summary(certificate | found)
    assert "Nothing is certified as exact: no turn of C3 maps pixels onto pixels. At those" in page


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_that_differs_is_refused(export, suffix, monkeypatch, tmp_path):
    plain = frozen._plain

    def tampered(layer):
        out = plain(layer)
        if isinstance(out, nn.Linear):
            out.weight.data *= 1.01
        return out

    earlier = tmp_path / f"policy{suffix}"
    earlier.write_text("an earlier one")
    monkeypatch.setattr(frozen, "_plain", tampered)
    with pytest.raises(ExportError, match=r"is not written: its \w+ differs by .* explains"):
        export(suffix)
    assert [path.name for path in tmp_path.iterdir()] == [earlier.name]
    assert earlier.read_text() == "an earlier one"


def test_a_policy_that_is_not_finite_is_refused(export, monkeypatch, tmp_path):
    monkeypatch.setattr(exporting, "as_function", lambda actor: lambda *inputs: {
        name: np.full((len(inputs[0]), 5), np.nan, np.float32) for name in formats.OUTPUTS
    })  # fmt: skip
    with pytest.raises(ExportError, match="differs by nan"):
        export(".pt2")
    assert not list(tmp_path.iterdir())


def test_a_file_changed_later_is_found_out(export):
    onnx = pytest.importorskip("onnx")
    _, certificate, path = export(".onnx")
    assert check_exported(path, observations=20)["exact_on_grid"] and certificate["exact_on_grid"]
    model = onnx.load(path)
    for weight in model.graph.initializer:
        if weight.name.endswith("head.weight"):
            values = onnx.numpy_helper.to_array(weight).copy()
            values[1, 0] += 0.5
            weight.CopyFrom(onnx.numpy_helper.from_array(values, weight.name))
    onnx.save(model, path)
    with pytest.raises(ExportError, match="is not what its certificate says: action is said"):
        check_exported(path)
    assert str(ROOT).encode() not in path.read_bytes()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_policy_is_named(suffix, tmp_path):
    path = tmp_path / f"policy{suffix}"
    for read in (read_certificate, load_exported, check_exported):
        with pytest.raises(ExportError, match=r"policy\.\w+ not found"):
            read(path)
    path.write_text("something else")
    for read in (read_certificate, load_exported, check_exported):
        with pytest.raises(ExportError, match="is not a readable exported policy"):
            read(path)


def test_a_certificate_that_lacks_something_is_refused(export):
    _, certificate, path = export(".pt2", "C4", observations=3)
    program = torch.export.load(path)

    def rewritten(**changes):
        text = json.dumps(certificate | changes)
        torch.export.save(program, path, extra_files={formats.CERTIFICATE: text})
        return path

    assert check_exported(rewritten(), observations=3)["exact_on_grid"]
    for changes, lacking in {
        "tolerance": {"action": 1e-5, "loc": 1e-5},
        "image": {"pixels": "sixteen", "side_m": 0.3, "max_depth_m": 0.32},
        "symmetry": {},
        "group": 4,
    }.items():
        with pytest.raises(ExportError, match=rf"certificate lacks {changes}") as raised:
            check_exported(rewritten(**{changes: lacking}))
        assert "KeyError" not in str(raised.value)
    with pytest.raises(ExportError, match="not of format 1"):
        read_certificate(rewritten(format=2))


def test_names_folders_and_packages_are_checked_first(export, monkeypatch, tmp_path):
    with pytest.raises(ExportError, match=r"policy\.pth: expected .* ends in \.pt2 or \.onnx"):
        export(".pth")
    (tmp_path / "policy.pt2").mkdir()
    with pytest.raises(ExportError, match="cannot write .*it is a folder"):
        export(".pt2")
    monkeypatch.setattr(formats.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ExportError, match=r"onnx, onnxscript, onnxruntime.*'equirl\[export\]'"):
        export(".onnx")


def test_observations_are_stored_ones_and_drawn_ones():
    stored = Observations(*(array[5:] for array in make_observations(15, 16, 0.32)))
    seen = make_observations(20, 16, 0.32, stored)
    assert seen.depth.shape == (20, 1, 16, 16) and seen.holding.shape == (20, 1)
    assert (seen.depth[:10] == stored.depth).all() and (seen.depth[10] != stored.depth[0]).any()
    assert len(make_observations(4, 16, 0.32, stored).depth) == 4
    assert seen.depth.dtype == np.float32 and 0 <= seen.depth.min() <= seen.depth.max() <= 0.33
    assert sum(batch_sizes(200)) == 200 and batch_sizes(2) == [1, 1]
