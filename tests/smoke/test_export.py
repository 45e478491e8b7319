"""Exporting a run, as a user calls it."""

import importlib
import sys
from pathlib import Path

import pytest

from equirl.training.export import formats
from tests.commands import SMOKE


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The folder of a run that has barely begun."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    short = ["steps=4", "demos.episodes=1", "evaluation.final_episodes=1"]
    keys = [*SMOKE, *short, "evaluation.video_episodes=0", f"output={folder}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", *keys])
        importlib.import_module("train").main()
    return folder


@pytest.mark.parametrize("format", formats.FORMATS)
def test_export_and_check(here, run, format, tmp_path):
    path = tmp_path / f"new/policy{formats.FORMATS[format].suffix}"
    few = "observations=12"
    code, out, err = here("export.py", f"run={run}", f"format={format}", f"output={path}", few)
    assert code == 0, err
    assert "Exact up to rounding under the turns of C4" in out and f"policy: {path}" in out
    assert "equivariant policy (C4, strict mode) of block_picking, seed 0, 4 steps" in out
    code, out, err = here("export.py", f"check={path}", few)
    assert code == 0 and "Exact up to rounding" in out and "instead of the policy" not in out, err
    code, out, err = here("export.py", f"check={path}", f"run={run}", few)
    assert code == 0 and "instead of the policy of the run" in out, err
    assert "one action, one thread" in out


def test_the_example_turns_with_the_scene(here, run):
    code, _, err = here("export.py", f"run={run}", "format=onnx", "observations=4")
    assert code == 0, err
    code, out, err = here("run_exported.py", str(run / "policy.onnx"))
    assert code == 0 and out.count("off by") == 3, err
    code, _, err = here("run_exported.py", str(run / "none.onnx"))
    assert code == 1 and "none.onnx not found" in err
    code, _, err = here("run_exported.py", str(run / "config.yaml"))
    assert code == 1 and "is not a readable policy" in err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "run= is missing"),
        (["run={run}_none"], "run_none: expected the folder of a run"),
        (["run={run}", "format=pickle"], "expected one of torch_export, onnx"),
        (["run={run}", "format=onnx", "output=policy.pt2"], "expected a name in .onnx"),
        (["run={run}", "output={run}/config.yaml/policy.pt2"], "cannot write"),
        (["run={run}", "observations=0"], "observations=0: expected 1 or more"),
        (["check=policy.onnx"], "policy.onnx not found"),
        (["check={run}/config.yaml"], "ends in .pt2 or .onnx"),
        (["check=policy.onnx", "output=policy.onnx"], "output=policy.onnx: leave it out"),
    ],
)
def test_mistakes_end_in_one_sentence(here, run, arguments, named):
    code, _, err = here("export.py", *(argument.format(run=run) for argument in arguments))
    assert code == 1 and named in err and "Traceback" not in err


def test_without_the_extra_the_sentence_says_what_to_install(here, run, monkeypatch):
    monkeypatch.setattr(formats.importlib.util, "find_spec", lambda name: None)
    code, _, err = here("export.py", f"run={run}", "format=onnx")
    assert code == 1 and "pip install 'equirl[export]'" in err
