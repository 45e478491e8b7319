"""Exported policies: they do what the policy does, and say truly whether they turn."""

import json
import subprocess
import sys
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
    export_actor,
    load_exported,
    make_networks,
    read_certificate,
)
from equirl.training.export import exporting, formats, frozen, summary
from equirl.training.export.certificate import measure
from equirl.training.export.measures import Observations, batch_sizes, make_observations
from tests.equivariance import assert_equivariant, turn_action, turn_image

ROOT = Path(__file__).parents[2]
SUFFIXES = [".pt2", ".onnx"]
CASES = {
    "C4": {"group": "C4"},
    "C8": {"group": "C8"},
    "D4": {"group": "D4"},
    "O2": {"group": "O2", "backend": "dense"},
    "D4 paper": {"group": "D4", "mode": "paper"},
    "CNN": {"method": {"name": "cnn"}},
}


@pytest.fixture
def export(small_config, tmp_path):
    """Exports an untrained policy: its actor, its certificate and its file."""

    def call(suffix: str, case: str = "D4", **options):
        torch.manual_seed(0)
        config = small_config(device="cpu", **CASES[case])
        actor, _ = make_networks(config)
        path = tmp_path / f"policy{suffix}"
        return actor, export_actor(config, actor, path, steps=7, **options), path

    return call


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
    [("D4", ".pt2"), ("D4", ".onnx"), ("C4", ".pt2"), ("C8", ".onnx"), ("O2", ".onnx")],
)
def test_equivariant_policies_are_certified(export, case, suffix):
    actor, certificate, path = export(suffix, case, observations=24)
    policy = load_exported(path)
    assert_same(policy, actor)
    assert max(certificate["difference"].values()) < 5e-6
    assert certificate == read_certificate(path) == json.loads(json.dumps(certificate))
    assert certificate["exact"] and "Not exact" not in summary(certificate)

    def act(depth, holding):
        out = policy(np.ascontiguousarray(depth.numpy()), holding.numpy())
        return {name: torch.from_numpy(value) for name, value in out.items()}

    turned = {"depth": turn_image, "action": turn_action, "loc": turn_action}
    inputs = {"depth": 0.3 * torch.rand(4, 1, 16, 16), "holding": torch.ones(4, 1)}
    group = {"C8": "C4", "O2": "D4"}.get(case, case)
    assert_equivariant(act, group, inputs, turned, case=case, tolerance=5e-6)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_policy_without_symmetry_says_so(export, suffix):
    actor, certificate, path = export(suffix, "CNN", observations=24)
    assert_same(load_exported(path), actor)
    assert certificate["group"] is None and not certificate["exact"]
    found = certificate["symmetry"]["physical"]
    assert not any(found["exact"].values()) and min(row["action"] for row in found["errors"]) > 1e-3
    assert "Not exact under the turns of D4" in summary(certificate)
    assert "no symmetry built in" in summary(certificate)


def test_the_papers_policy_says_under_what_it_is_exact(export):
    actor, certificate, path = export(".pt2", "D4 paper", observations=24)
    assert_same(load_exported(path), actor)
    symmetry = certificate["symmetry"]
    assert not certificate["exact"] and all(symmetry["paper"]["exact"].values())
    for row in symmetry["physical"]["errors"]:
        assert ("y reversed" in row["element"]) == (row["action"] > 1e-3)  # the sign of theta
        assert ("90" in row["element"] or "270" in row["element"]) == (row["scale"] > 1e-3)
    page = summary(certificate)
    assert page.index("Not exact under the turns of D4") < page.index("Exact up to rounding")


def test_the_certificate_says_what_goes_in_and_out(export):
    _, certificate, path = export(".pt2", observations=70)
    facts = {"task": "block_picking", "steps": 7, "seed": 0, "group": "D4", "mode": "strict"}
    assert facts.items() <= certificate.items()
    assert certificate["image"]["side_m"] == 0.3 and certificate["image"]["pixels"] == 16
    assert certificate["inputs"]["depth"]["shape"] == ["batch", 1, 16, 16]
    meaning = certificate["outputs"]["action"]["meaning"]
    assert list(meaning) == list(Action._fields) and "0.785398 rad" in meaning["theta"]
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
    assert not found["exact"]
    assert "Nothing is certified: no turn of C3" in summary(certificate | found)


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
    assert check_exported(path, observations=20)["exact"] and certificate["exact"]
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


#: Makes a process in which what follows cannot be imported.
GUARD = """
import sys
class Guard:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent!r}:
            raise ImportError("not installed here: " + name)
sys.meta_path.insert(0, Guard())
"""
TORCH_ALONE = """
import json, torch
texts = {"certificate.json": ""}
policy = torch.export.load("policy.pt2", extra_files=texts).module()
action, loc, scale = policy(torch.rand(5, 1, 16, 16), torch.zeros(5, 1))
assert action.shape == (5, 5) and json.loads(texts["certificate.json"])["group"] == "D4"
"""
NUMPY_ALONE = f"""
import runpy
sys.argv = ["run_exported.py", "policy.onnx"]
runpy.run_path({str(ROOT / "experiments" / "run_exported.py")!r}, run_name="__main__")
"""


@pytest.mark.parametrize(
    ("suffix", "code", "absent"),
    [
        (".pt2", TORCH_ALONE, ["torchrl", "tensordict", "escnn", "equirl"]),
        (".onnx", NUMPY_ALONE, ["torch", "torchrl", "tensordict", "escnn", "equirl", "onnx"]),
    ],
    ids=["torch", "numpy"],
)
def test_files_run_where_equirl_is_not(export, suffix, code, absent):
    _, _, path = export(suffix)
    command = [sys.executable, "-c", GUARD.format(absent=absent) + code]
    done = subprocess.run(command, cwd=path.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if suffix == ".onnx":
        assert "certified to turn exactly: yes" in done.stdout
        errors = [float(line.split("off by ")[1]) for line in done.stdout.splitlines()[2:]]
        assert len(errors) == 3 and max(errors) < 1e-5
