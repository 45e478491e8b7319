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


def test_a_policys_own_file_is_evaluated_and_watched_as_its_run(here, run, tmp_path):
    path = tmp_path / "policy.pt"
    code, out, err = here("export.py", f"run={run}", "format=policy", f"output={path}")
    assert code == 0 and out.endswith(f"policy: {path}\n"), err
    told = [here("evaluate.py", f"run={place}", "episodes=2") for place in (run, path)]
    assert told[0][:2] == told[1][:2] and "of 2 episodes succeed" in told[1][1]
    watched = here("watch.py", f"policy={path}", "episodes=1", f"output={tmp_path}", "size=64")
    assert watched[0] == 0 and "episode 1: " in watched[1], watched[2]
    assert (tmp_path / "film.mp4").is_file() and (tmp_path / "sheet.png").is_file()
    code, _, err = here("evaluate.py", f"run={run}/checkpoint.pt")
    assert code == 1 and "expected the run's folder" in err and "Traceback" not in err


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
        (["run={run}", "format=pickle"], "expected one of torch_export, onnx, policy"),
        (["run={run}", "format=onnx", "output=policy.pt2"], "expected a name in .onnx"),
        (["run={run}", "format=policy", "output=policy.pt2"], "expected a name in .pt"),
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
