"""Recordings of episodes, films and contact sheets."""

from itertools import pairwise

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from equirl.envs import make_env, make_expert
from equirl.training.evaluation import play
from equirl.training.sheet import draw_sheet, outcome
from equirl.training.video import film_policy, open_film, record
from tests.commands import frames_of

IDLE = TensorDictModule(lambda depth: torch.eye(5)[0], ["depth"], ["action"])  # stays open


def test_a_recording_is_what_the_environment_gives_and_gets(env):
    frames = record(env, make_expert(env), seed=3, side=32)
    assert len(frames) - 1 == play(env, make_expert(env), seed=3).length
    assert [frame.reward for frame in frames] == [0.0] * (len(frames) - 1) + [1.0]
    assert frames[0].holding is False and frames[-1].holding is True
    assert frames[-1].action is None
    env.set_seed(3, static_seed=True)
    seen = env.reset()
    for frame in frames:
        assert frame.picture.shape == (32, 32, 3)
        np.testing.assert_array_equal(frame.depth, seen["depth"][0])
        if frame.action is not None:
            seen = env.step(seen.set("action", torch.from_numpy(frame.action)))["next"]
    for before, after in pairwise(frames):
        assert np.abs(after.picture.astype(int) - before.picture).mean() > 0.5


def test_without_a_seed_a_recording_goes_on_with_the_scene():
    env = make_env("clutter_grasping", image_size=16, robot="hand", max_steps=2, seed=1)
    first = record(env, IDLE, side=16)
    assert env.scene_continues
    objects = env.get_scene().names
    second = record(env, IDLE, side=16)
    assert env.get_scene().names == objects
    assert np.abs(second[0].depth - first[-1].depth).mean() < 1e-3
    env.close()


def test_a_film_has_a_frame_for_the_start_and_each_step(env, tmp_path):
    film = film_policy(env, make_expert(env), [0, 1], tmp_path / "film.mp4", fps=5)
    lengths = [play(env, make_expert(env), seed=seed).length for seed in (0, 1)]
    pictures = frames_of(film, 384)
    assert len(pictures) == sum(lengths) + 2
    scene, depth = np.hsplit(pictures[0], 2)
    assert scene.std() > 10 and depth.std() > 10


def test_a_film_that_cannot_be_written_says_so(env, tmp_path):
    with pytest.raises(OSError, match="missing"):
        film_policy(env, IDLE, [0], tmp_path / "missing" / "film.mp4")
    with (
        pytest.raises(OSError, match="no.mp4 could not be written"),
        open_film(tmp_path / "no.mp4"),
    ):
        pass


def test_a_sheet_grows_with_what_it_shows(env, tmp_path):
    expert = record(env, make_expert(env), seed=0, side=32)
    idle = record(env, IDLE, seed=0, side=32)
    assert outcome(expert, env) == f"success after {len(expert) - 1} steps"
    assert outcome(idle, env) == "no success in 10 steps"
    assert outcome(idle[:4], env) == "an object left the workspace after 3 steps"
    sheets = [
        imageio.imread(draw_sheet(shown, env, tmp_path / "sheet.png", title="Block picking"))
        for shown in ([expert], [expert, idle])
    ]
    assert sheets[1].shape[0] > 1.5 * sheets[0].shape[0]
    for sheet in sheets:
        assert sheet.shape[1] > 800 and sheet.std() > 30
        assert (sheet[:5] == 255).all() and (sheet[:, :5] == 255).all()  # nothing is cut off


def test_an_action_is_written_in_metres_and_degrees(env):
    from matplotlib.figure import Figure

    from equirl.training.sheet import _show_action

    axes = Figure().add_subplot()
    _show_action(axes, np.array([0.0, 0.0, 1.0, -0.5, 0.2], np.float32), env)
    arrow, words = axes.texts
    assert words.get_text() == "↓ 2.5 cm   ↺ 9°   ↔ 4 cm"
    assert arrow.xy == (env.workspace.position_step, 0.0)  # y points to the right
