"""Exported policies where they are used: in other processes, and of other pipelines."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import run_exported
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from equirl.modules import make_actor
from equirl.symmetry import Representation
from equirl.training.export import FrozenPolicy

ROOT = Path(__file__).parents[2]


def test_a_policy_of_another_pipeline_is_frozen_and_exported_by_hand():
    """As docs/export.md shows."""
    actor = make_actor(
        "D4",
        hidden=8,
        image_size=16,
        in_keys=["pixels"],
        channels=2,
        invariants=0,
        action=Representation("vector"),
    )
    policy, pixels = FrozenPolicy(actor), torch.rand(5, 2, 16, 16)
    batch = torch.export.Dim("batch", min=1)
    program = torch.export.export(policy, (pixels[:2],), dynamic_shapes=(({0: batch},),))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = actor(TensorDict({"pixels": pixels}, [5]))
    for found in (policy(pixels), program.module()(pixels)):
        for name, value in zip(["action", "loc", "scale"], found, strict=True):
            assert value.shape == (5, 2)
            torch.testing.assert_close(value, expected[name], atol=5e-6, rtol=0)
    frozen = {type(module).__module__.partition(".")[0] for module in program.module().modules()}
    assert frozen == {"torch"}


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
        assert "exact at the turns that map pixels onto pixels\n" in done.stdout
        errors = [float(line.split("off by ")[1]) for line in done.stdout.splitlines()[3:]]
        assert len(errors) == 7 and max(errors) < 1e-5


def test_the_example_takes_turns_and_units_from_the_certificate(export, capsys):
    _, certificate, path = export(".onnx", "C2", observations=3)
    run_exported.main([str(path)])
    policy, exact, _, *turned = capsys.readouterr().out.splitlines()
    assert "group C2, mode strict" in policy and "no symmetry" not in policy
    assert exact == "exact at the turns that map pixels onto pixels"
    assert len(turned) == 1 and turned[0].startswith("turned: 180°")
    assert float(turned[0].split("off by ")[1]) < 1e-5
    meanings = certificate["outputs"]["action"]["components"]
    action = np.array([1.0, 0.5, -1.0, 0.0, 0.5])
    shown = run_exported.shown(action, meanings)
    assert "( +25.0,  -50.0,   +0.0) mm, turn  +22.5 degrees, fingers 80.0 mm" in shown
    shown = run_exported.shown(action, meanings | {"x": {"low": -0.1, "high": 0.1}})
    assert "( +50.0, " in shown
    measured = {
        "exact_on_grid": {"action": False},
        "between": {"action": {"mean": 0.012, "largest": 0.3, "there_and_back": 0.01}},
    }
    said = run_exported.certified(measured)
    assert said.startswith("not exact at the turns that map pixels onto pixels; between them")
    assert "1.2e-02 in the mean, 3.0e-01 at most" in said and "there and back: 1.0e-02" in said
