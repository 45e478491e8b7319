"""Recording demonstrations and training from them, as a user calls it."""

import logging
import re
import signal
from functools import partial
from pathlib import Path

import h5py
import pytest
import torch

from equirl.collectors import DemonstrationCollector
from equirl.config import to_config
from equirl.data import make_replay_buffer
from equirl.data.episodes import DatasetError
from equirl.data.robomimic import read_demonstrations, read_environment, write_demonstrations
from equirl.training import Purpose, make_run_env, make_run_expert, scene_seed
from equirl.training.demonstrations import record_demonstrations, store_demonstrations
from tests.commands import ROOT, SMOKE, start

SMALL = ["env.image_size=16", "env.robot=hand"]
PAGE = (ROOT / "docs" / "demonstrations.md").read_text()


def configuration(**changes):
    values = {
        "env": {"task": "block_picking", "image_size": 16, "robot": "hand"},
        "method": {"name": "equivariant", "hidden": 8},
        "algorithm": {"name": "sac"},
        "augmentation": {"name": "buffer", "copies": 2},
        "demos": {"episodes": 2},
        "seed": 5,
    }
    return to_config(values | changes)


def collected(config) -> list:
    """What a run of this configuration collects by itself."""
    env = make_run_env(config)
    seeds = partial(scene_seed, config.seed, Purpose.DEMONSTRATIONS)
    episodes = config.demos.episodes
    expert = make_run_expert(config, env)
    found = list(DemonstrationCollector(env, expert, episodes=episodes, seeds=seeds))
    env.close()
    return found


def make_buffer():
    return make_replay_buffer(500, copies=2, generator=torch.Generator().manual_seed(1))


def stored(config, buffer) -> None:
    env = make_run_env(config)
    try:
        assert len(list(store_demonstrations(config, env, buffer))) == config.demos.episodes
    finally:
        env.close()


@pytest.mark.parametrize("mode", ["strict", "paper"])
def test_a_recording_is_what_the_run_collects_bit_for_bit(here, tmp_path, mode):
    path = tmp_path / "new" / "demos.hdf5"
    code, out, err = here(
        "demonstrations.py", *SMALL, f"mode={mode}", "seed=5", "episodes=2", f"output={path}"
    )
    assert code == 0, err
    config = configuration(mode=mode, demos={"episodes": 2, "file": str(path)})
    episodes = collected(config)
    assert f"2 demonstrations, {sum(map(len, episodes))} steps: {path}" in out
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    expected, found = make_buffer(), make_buffer()
    for episode in episodes:
        expected.extend(episode)
    stored(config, found)
    assert (found.storage[:] == expected.storage[:]).all() and len(found) == len(expected)
    assert (found.sample() == expected.sample()).all()
    # Before the buffer rounds depths, too.
    for one, other in zip(read_demonstrations(path), episodes, strict=True):
        assert (one == other).all()
    about = read_environment(path)
    clip = "norm" if mode == "strict" else "box"
    assert (about["mode"], about["expert"]["horizontal_clip"]) == (mode, clip)
    assert (about["task"], about["view"], about["image_size"]) == ("block_picking", 0.3, 16)


def test_the_seed_of_each_scene_is_kept(tmp_path):
    config = configuration(
        env={"task": "clutter_grasping", "image_size": 16, "robot": "hand"}, demos={"episodes": 2}
    )
    record_demonstrations(config, tmp_path / "clutter.hdf5")
    with h5py.File(tmp_path / "clutter.hdf5") as file:
        kept = [dict(file[f"data/demo_{n}"].attrs) for n in range(2)]
    env = make_run_env(config)
    for number, (attributes, episode) in enumerate(zip(kept, collected(config), strict=True)):
        assert attributes["seed"] == scene_seed(5, Purpose.DEMONSTRATIONS, 0)
        assert attributes["episode"] == number  # the second one goes on with the heap
        assert attributes["num_samples"] == len(episode)
    env.set_seed(int(kept[0]["seed"]), static_seed=True)
    first = read_demonstrations(tmp_path / "clutter.hdf5")[0]
    assert torch.equal(env.reset()["depth"], first["depth"][0])
    env.close()


def test_actions_that_cannot_be_imitated_are_projected_and_said_once(tmp_path, caplog):
    path = tmp_path / "wide.hdf5"
    episodes = collected(configuration(mode="paper"))
    outside = sum(int((each["action"][:, 1:3].norm(dim=-1) > 1).sum()) for each in episodes)
    write_demonstrations(path, episodes)
    assert outside > 0
    for mode in ("paper", "strict"):
        config = configuration(mode=mode, demos={"episodes": 2, "file": str(path)})
        buffer = make_buffer()
        with caplog.at_level(logging.INFO, "equirl"):
            stored(config, buffer)
        lengths = buffer.storage[:]["action"][:, 1:3].norm(dim=-1)
        assert (lengths <= 1).all() == (mode == "strict")
    (said,) = [each.getMessage() for each in caplog.records if each.name == "equirl"]
    assert said.startswith(f"{outside} of {sum(map(len, episodes))} demonstrated actions")


def test_demonstrations_of_another_environment_do_not_train(tmp_path):
    path = tmp_path / "demos.hdf5"
    record_demonstrations(configuration(), path)
    base = {"task": "block_picking", "image_size": 16, "robot": "hand"}
    for changes, message in (
        ({"env": base | {"image_size": 32}}, "images of 16 pixels a side, expected 32"),
        ({"env": base | {"task": "block_pushing"}}, "task='block_picking', expected 'block_push"),
        ({"env": base | {"robot": "panda"}}, "robot='hand', expected 'panda'"),
        (
            {"env": base | {"options": {"lift_height": 0.12}}},
            "with options.lift_height=0.15, expected 0.12",
        ),
        ({"demos": {"episodes": 3}}, "holds 2 successful demonstrations, expected 3"),
    ):
        demos = {"episodes": 2} | changes.get("demos", {}) | {"file": str(path)}
        with pytest.raises(DatasetError, match=message):
            stored(configuration(**changes | {"demos": demos}), make_buffer())


def test_a_number_spelled_out_is_that_left_out(tmp_path):
    path = tmp_path / "demos.hdf5"
    record_demonstrations(configuration(), path)
    env = {"task": "block_picking", "image_size": 16, "robot": "hand"}
    env["options"] = {"lift_height": 0.15}  # the task's own
    stored(configuration(env=env, demos={"episodes": 2, "file": str(path)}), make_buffer())


def test_a_task_without_an_expert_trains_from_a_file(here, tmp_path, monkeypatch):
    (tmp_path / "quiet_tasks.py").write_text(
        "from dataclasses import dataclass\n"
        "from equirl.envs.tasks.block_picking import BlockPicking\n\n\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class Quiet(BlockPicking):\n"
        "    expert = None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "mine.hdf5"
    write_demonstrations(path, collected(configuration()))
    run = tmp_path / "run"
    arguments = ["env.task=quiet_tasks:Quiet", f"demos.file={path}", f"output={run}"]
    code, _, err = here("train.py", *SMOKE, "env.robot=hand", *arguments)
    assert code == 0, err
    code, _, err = here("train.py", *SMOKE, "env.task=quiet_tasks:Quiet")
    assert code == 1 and "has no expert; expected 0, or demos.file" in err


def test_a_sweep_over_files_is_compared_like_any_other(here, tmp_path):
    files = [tmp_path / name for name in ("one.hdf5", "two.hdf5")]
    for file in files:
        record_demonstrations(configuration(), file)
    sweep, given = tmp_path / "sweep", ",".join(map(str, files))
    code, _, err = here(
        "train.py", "--multirun", *SMOKE, "env.robot=hand", f"demos.file={given}",
        f"hydra.sweep.dir={sweep}",
    )  # fmt: skip
    assert code == 0, err
    runs = sorted(each.parent.parent for each in tmp_path.rglob("test.csv"))
    assert runs == [sweep, sweep]  # a folder each, side by side
    code, out, err = here("compare.py", str(tmp_path / "comparison"), str(sweep))
    assert code == 0, err
    assert "one.hdf5" in out and "two.hdf5" in out


def test_a_file_is_overwritten_on_request_only(here, tmp_path):
    path = tmp_path / "demos.hdf5"
    path.write_text("dear to someone")
    command = ["demonstrations.py", *SMALL, "episodes=1", f"output={path}"]
    code, _, err = here(*command)
    assert code == 1 and f"output={path}: it exists already" in err and "Traceback" not in err
    assert path.read_text() == "dear to someone"
    code, _, err = here(*command, "overwrite=true")
    assert code == 0, err
    assert len(read_demonstrations(path)) == 1


def test_an_interrupt_leaves_no_file(tmp_path):
    process = start("demonstrations.py", *SMALL, "episodes=5000", "output=demos.hdf5", cwd=tmp_path)
    shown = ""
    while not re.search(r"[1-9]\d*/5000", shown):  # it has begun to record
        letter = process.stderr.read(1)
        assert letter, shown
        shown += letter
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "stopped" in err and "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "output= is missing"),
        (["output=/proc/none/demos.hdf5"], "cannot write /proc/none/demos.hdf5"),
        (["output=."], "output=.: it is a folder"),
        (["output=a.hdf5", "expert.grip=1"], "expert: BlockPickingExpert has no option grip"),
        (["output=a.hdf5", "mode=exact"], "mode=exact: expected one of strict, paper"),
        (["output=a.hdf5", "episodes=0"], "episodes=0: expected 1 or more"),
        (["output=a.hdf5", "colour=red"], "colour"),
        (["output=a.hdf5", "env.max_steps=3"], "failed 20 episodes in a row"),
    ],
)
def test_bad_input_ends_in_a_sentence_that_names_it(here, arguments, named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = here("demonstrations.py", *SMALL, "episodes=1", *arguments)
    assert code != 0
    assert named in err and "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_the_pages_example_reads_a_file_without_us(here, tmp_path, monkeypatch, capsys):
    (example,) = re.findall(r"```py\n(.*?)```", PAGE, re.DOTALL)
    assert "equirl" not in example.replace("equirl_version", "")
    monkeypatch.chdir(tmp_path)
    code, _, err = here("demonstrations.py", *SMALL, "episodes=2", "output=demos.hdf5")
    assert code == 0, err
    exec(compile(example, "docs/demonstrations.md", "exec"), {})
    lengths = [len(each) for each in read_demonstrations(Path("demos.hdf5"))]
    said = capsys.readouterr().out
    assert "block_picking" in said and f"demo_0 {lengths[0]} (16, 16, 1)" in said
