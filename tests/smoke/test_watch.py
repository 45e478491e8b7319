"""Looking at tasks, policies and objects, as a user calls it."""

import re
import sys
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import object_sheet
import pytest
import torch
import watch as watch_script

from equirl.config import to_config
from equirl.data.robomimic import write_demonstrations
from tests.commands import frames_of
from tests.transitions import transitions

SMALL = ["env.image_size=16", "env.robot=hand", "size=32"]


@pytest.fixture
def watch(monkeypatch, capsys):
    """Calls the entry point in this process; returns what it prints, or its complaint."""

    def call(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["watch.py", *SMALL, *arguments])
        try:
            watch_script.main()
        except SystemExit as exit:
            assert exit.code != 0
            return f"{exit.code}\n{capsys.readouterr().err}"
        return capsys.readouterr().out

    return call


def check(folder: Path, printed: str, side: int, *, filmed: int | None = None) -> np.ndarray:
    """The film has a frame a step and one more an episode; the sheet shows something.

    Args:
        folder: Where they are.
        printed: What was said.
        side: Pixels of a picture.
        filmed: Of a file: how many of its episodes are filmed, without pictures of the scene.

    Returns:
        The frames.
    """
    assert f"film: {folder / 'film.mp4'}" in printed
    assert f"sheet: {folder / 'sheet.png'}" in printed
    lengths = [int(steps) for steps in re.findall(r"episode \d.* (\d+) step", printed)][:filmed]
    pictures = frames_of(folder / "film.mp4", side)
    pictures = pictures.reshape(-1, side, side, 3) if filmed else pictures
    assert len(pictures) == sum(lengths) + len(lengths) and pictures[0].std() > 10
    sheet = imageio.imread(folder / "sheet.png")
    assert sheet.shape[1] > 800 and sheet.std() > 30
    return pictures


def test_the_expert(watch, tmp_path):
    printed = watch("env=block_pushing", "policy=expert", "episodes=1", f"output={tmp_path}")
    assert "episode 1: success after" in printed
    check(tmp_path, printed, 32)


def test_a_scene_of_clutter_goes_on(watch, tmp_path):
    printed = watch(
        "env=clutter_grasping",
        "policy=random",
        "env.max_steps=2",
        "env.options.object_count=2",
        "episodes=2",
        f"output={tmp_path}",
    )
    assert "episode 1: no success in 2 steps" in printed
    assert "episode 2, the scene goes on: no success in 2 steps" in printed
    check(tmp_path, printed, 32)


def test_the_policy_of_a_run_in_its_own_environment(watch, tmp_path, monkeypatch):
    from equirl.training import train

    values = {
        "env": {"task": "block_picking", "image_size": 16, "max_steps": 3, "robot": "hand"},
        "method": {"name": "equivariant", "hidden": 8},
        "algorithm": {"name": "sac", "batch_size": 2},
        "augmentation": {"name": "none"},
        "demos": {"episodes": 0},
        "evaluation": {"final_episodes": 1, "video_episodes": 0},
        "logging": {"progress": False},
        "steps": 1,
    }
    train(to_config(values), tmp_path / "run")
    policy = f"policy={tmp_path / 'run'}"
    assert "env.image_size=16: leave it out" in watch(policy)
    monkeypatch.setattr(sys.modules[__name__], "SMALL", ["size=32"])
    output = tmp_path / "watched"
    printed = watch(policy, "episodes=1", f"output={output}")
    assert "in 3 steps" in printed
    check(output, printed, 32)


def test_a_file_of_demonstrations(watch, tmp_path, monkeypatch):
    """Each of its episodes is named, the first ones are drawn; nothing is simulated."""
    path = tmp_path / "demos.hdf5"
    episodes = [transitions(steps, seed=steps) for steps in (3, 3, 4)]
    for episode, reward in zip(episodes, (1, 0, 1), strict=True):
        episode["next", "reward"] = torch.eye(len(episode))[:, -1:] * reward
    environment = {"task": "block_pushing", "view": 0.45, "max_steps": 3}
    write_demonstrations(path, episodes, environment=environment)
    assert "env.image_size=16: leave it out" in watch(f"policy={path}")
    monkeypatch.setattr(sys.modules[__name__], "SMALL", ["size=32"])
    monkeypatch.setattr("equirl.envs.ManipulationEnv.__init__", None)
    monkeypatch.chdir(tmp_path)
    printed = watch(f"policy={path}", "episodes=2", "sheet_episodes=1")
    said = ["success after 3 steps", "no success in 3 steps", "success after 4 steps"]
    assert re.findall(r"episode \d: (.*)", printed) == said
    frames = check(Path("outputs", "watch", "block_pushing", "demos"), printed, 32, filmed=2)
    seen = [*episodes[0]["depth"], episodes[0]["next", "depth"][-1], *episodes[1]["depth"]]
    for frame, depth in zip(frames, seen, strict=False):  # near is bright
        brightness = frame.mean(-1).reshape(16, 2, 16, 2).mean((1, 3))
        assert np.corrcoef(brightness.ravel(), -depth.numpy().ravel())[0, 1] > 0.9


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("notes.hdf5", "error: policy={}: not an HDF5 file"),
        (
            "notes.txt",
            "error: {} is not a readable checkpoint: File is not a zip file; expected the",
        ),
    ],
)
def test_a_file_that_holds_nothing_to_watch_is_told(watch, tmp_path, monkeypatch, name, told):
    monkeypatch.setattr(sys.modules[__name__], "SMALL", [])
    (tmp_path / name).write_text("neither demonstrations nor a policy")
    complaint = watch(f"policy={tmp_path / name}")
    assert told.format(tmp_path / name) in complaint
    assert "Traceback" not in complaint


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["policy=exprt"], "policy=exprt: expected expert, random, the folder of a run, the file"),
        (["colour=red"], "colour"),
        (["env=block_stacking"], "block_stacking"),
        (["env.options.colour=red"], "BlockPicking has no option colour"),
        (["env.max_steps=0"], "env.max_steps=0: expected 1 or more"),
        (["env.image_size=7"], "env.image_size=7: expected an even number"),
        (["episodes=0"], "episodes=0: expected 1 or more"),
        (["size=33"], "size=33: expected an even number"),
        (["fps=slow"], "slow"),
        (["output=/proc/none"], "cannot write output=/proc/none"),
    ],
)
def test_bad_input_ends_in_a_sentence_that_names_it(watch, arguments, named):
    complaint = watch(*arguments)
    assert named in complaint and "Traceback" not in complaint


def test_a_folder_without_a_run_is_no_policy(watch, tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "SMALL", [])
    assert "not the folder of a run" in watch(f"policy={tmp_path}")


def test_every_household_object_is_drawn(tmp_path, capsys):
    sheet = tmp_path / "objects.png"
    object_sheet.main(["--output", str(sheet), "--size", "24", "--columns", "38"])
    assert f"76 objects: {sheet}" in capsys.readouterr().out
    picture = imageio.imread(sheet)[..., :3]
    assert picture.shape[1] > 38 * 24 and picture.std() > 10


def test_a_sheet_of_ones_own_meshes(tmp_path, capsys, monkeypatch):
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((2, 3, 4)).export(tmp_path / "meshes" / "brick.obj")
    sheet = tmp_path / "own.png"
    main = object_sheet.main
    main(["--meshes", str(tmp_path / "meshes"), "--output", str(sheet)])
    assert "1 objects" in capsys.readouterr().out
    assert imageio.imread(sheet).std() > 10
    with pytest.raises(SystemExit, match=r"error: .*absent does not exist"):
        main(["--meshes", str(tmp_path / "absent"), "--output", str(sheet)])
    with pytest.raises(SystemExit, match="cannot write --output"):
        main(["--meshes", str(tmp_path / "meshes"), "--output", str(tmp_path / "no" / "a.png")])
