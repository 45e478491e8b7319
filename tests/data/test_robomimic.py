"""Demonstrations as files of robomimic's layout."""

import json

import h5py
import numpy as np
import pytest
import torch

from equirl import __version__
from equirl.data import TRANSITION_KEYS
from equirl.data.episodes import DatasetError, project_onto_disc
from equirl.data.robomimic import read_demonstrations, read_environment, write_demonstrations
from tests.transitions import transitions

WHERE = {"task": "block_picking", "image_size": 16, "view": 0.3, "options": {"sizes": (1, 2)}}


def demonstration(steps: int = 5, seed: int = 0, *, image_size: int = 16, success: bool = True):
    """An episode [T] that ends in success, or out of time."""
    episode = transitions(steps, image_size=image_size, seed=seed)
    last = torch.arange(steps).unsqueeze(-1) == steps - 1
    episode["expert"] = torch.ones(steps, 1, dtype=torch.bool)
    episode["next", "reward"] = (last & success).float()
    episode["next", "done"] = last
    episode["next", "terminated"] = last & success
    episode["next", "truncated"] = last & (not success)
    for key in ("depth", "holding"):
        episode["next", key][:-1] = episode[key][1:]
    return episode


@pytest.fixture
def ours(tmp_path):
    """A file of three episodes, and these."""
    episodes = [demonstration(4 + seed, seed) for seed in range(3)]
    path = tmp_path / "demos.hdf5"
    seeds = [{"seed": 2**58 + seed} for seed in range(3)]
    write_demonstrations(path, episodes, environment=WHERE, attributes=seeds)
    return path, episodes


@pytest.fixture
def foreign(tmp_path):
    """A file as others make them: other types and shapes, and none of our own datasets."""
    path, episode = tmp_path / "teleoperated.hdf5", demonstration(6, seed=7)
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {}})
        demo["actions"] = episode["action"].double().numpy()
        demo["rewards"] = episode["next", "reward"][:, 0].double().numpy()
        demo["dones"] = episode["next", "done"][:, 0].long().numpy()
        for group, seen in (("obs", episode), ("next_obs", episode["next"])):
            demo[f"{group}/depth"] = seen["depth"][:, 0].numpy()
            demo[f"{group}/holding"] = seen["holding"][:, 0].long().numpy()
    return path, episode


def edited(path, change):
    """The file after ``change`` of its first episode."""
    with h5py.File(path, "r+") as file:
        change(file["data/demo_0"])
    return path


def replaced(name, make):
    """A change that puts another dataset in place of one; ``make`` has the old values."""

    def change(demo):
        values = make(demo[name][()])
        del demo[name]
        demo[name] = values

    return change


def without(*names):
    def change(demo):
        for name in names:
            del demo[name]

    return change


def assert_same(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.batch_size == other.batch_size
        assert set(one.keys(True, True)) == set(TRANSITION_KEYS)
        for key in TRANSITION_KEYS:
            assert one[key].dtype == other[key].dtype and torch.equal(one[key], other[key]), key
            assert one[key].is_contiguous()


def test_what_is_read_is_what_was_written_bit_for_bit(ours):
    path, episodes = ours
    assert_same(read_demonstrations(path), episodes)
    assert_same(read_demonstrations(path, episodes=2, environment=WHERE), episodes[:2])
    assert read_environment(path) == {**WHERE, "options": {"sizes": [1, 2]}}


def test_the_layout_is_robomimics(ours):
    path, episodes = ours
    with h5py.File(path, "r", swmr=True, libver="latest") as file:  # as robomimic opens it
        data = file["data"]
        assert data.attrs["total"] == 4 + 5 + 6 and set(data) == {"demo_0", "demo_1", "demo_2"}
        about = json.loads(data.attrs["env_args"])
        assert (about["env_name"], about["type"]) == ("block_picking", 2)
        assert about["env_kwargs"]["view"] == 0.3 and about["equirl_version"] == __version__
        demo, episode = data["demo_1"], episodes[1]
        assert demo.attrs["num_samples"] == 5 and demo.attrs["seed"] == 2**58 + 1
        assert demo["obs/depth"].shape == (5, 16, 16, 1) and demo["obs/depth"].dtype == np.float32
        assert demo["obs/depth"].compression == "gzip"
        assert (demo["next_obs/depth"][2, 3, 4, 0] == episode["next", "depth"][2, 0, 3, 4]).all()
        assert demo["next_obs/holding"].shape == (5, 1) and demo["actions"].shape == (5, 5)
        assert demo["rewards"][()].tolist() == [0, 0, 0, 0, 1] == demo["dones"][()].tolist()
        assert demo["truncated"][()].tolist() == [0] * 5 and demo["rewards"].dtype == np.float32


def test_equal_episodes_make_equal_files(ours, tmp_path):
    path, episodes = ours
    seeds = [{"seed": 2**58 + seed} for seed in range(3)]
    again = tmp_path / "folder" / "again.hdf5"
    write_demonstrations(again, episodes, environment=WHERE, attributes=seeds)
    assert again.read_bytes() == path.read_bytes()
    assert [each.name for each in again.parent.iterdir()] == ["again.hdf5"]


def test_episodes_come_in_the_order_of_their_numbers(tmp_path):
    episodes = [demonstration(3, seed) for seed in range(12)]
    write_demonstrations(tmp_path / "many.hdf5", episodes)
    assert_same(read_demonstrations(tmp_path / "many.hdf5"), episodes)


def test_failed_episodes_are_skipped_unless_asked_for(tmp_path):
    path = tmp_path / "mixed.hdf5"
    episodes = [demonstration(4, seed, success=seed != 1) for seed in range(3)]
    write_demonstrations(path, episodes)
    assert_same(read_demonstrations(path, episodes=2), [episodes[0], episodes[2]])
    assert_same(read_demonstrations(path, failed=True), episodes)
    message = "holds 2 successful demonstrations and 1 without success, expected 3"
    with pytest.raises(DatasetError, match=message):
        read_demonstrations(path, episodes=3)


def test_a_filter_chooses_episodes(ours):
    path, episodes = ours
    with h5py.File(path, "r+") as file:
        file["mask/few"] = np.array([b"demo_2", b"demo_0"])
        file["mask/lost"] = ["demo_9"]
    assert_same(read_demonstrations(path, filter="few"), [episodes[0], episodes[2]])
    with pytest.raises(DatasetError, match=r"no filter 'all', expected one of \['few', 'lost'\]"):
        read_demonstrations(path, filter="all")
    with pytest.raises(DatasetError, match="the filter 'lost' names demo_9, which is not there"):
        read_demonstrations(path, filter="lost")


def test_files_of_others(foreign):
    path, episode = foreign
    # Their environment has another name, which says nothing about ours.
    assert_same(read_demonstrations(path, episodes=1, environment=WHERE), [episode])
    assert read_environment(path) == {}


def test_an_episode_of_others_ends_with_its_first_done(foreign):
    path, episode = foreign
    # Recorded for two steps more, in which the task stays done.
    later = replaced("rewards", lambda old: np.array([0, 0, 0, 1, 1, 1]))
    marked = replaced("dones", lambda old: np.array([0, 0, 0, 1, 1, 1]))
    (found,) = read_demonstrations(edited(edited(path, later), marked))
    assert torch.equal(found["depth"], episode["depth"][:4])
    assert torch.equal(found["next", "depth"], episode["next", "depth"][:4])
    for key in ("reward", "done", "terminated"):
        assert found["next", key].flatten().tolist() == [0, 0, 0, 1]
    assert not found["next", "truncated"].any()
    unmarked = edited(path, replaced("dones", lambda old: np.eye(6)[5]))
    with pytest.raises(DatasetError, match="demo_0 goes on after the reward of its step 4"):
        read_demonstrations(unmarked)


def test_a_failure_of_others_ran_out_of_time(foreign):
    path, _ = foreign
    nothing = edited(path, replaced("rewards", np.zeros_like))
    (found,) = read_demonstrations(nothing, failed=True)
    assert found["next", "truncated"].flatten().tolist() == [False] * 5 + [True]
    assert not found["next", "terminated"].any()
    with pytest.raises(DatasetError, match="holds 0 successful .* 1 without success, expected 1"):
        read_demonstrations(nothing)


def test_next_observations_are_found_in_the_observations(foreign):
    path, episode = foreign
    edited(path, without("next_obs"))
    with pytest.raises(DatasetError, match="demo_0 has no next_obs, .* or 7 rows of obs"):
        read_demonstrations(path)
    for key in ("depth", "holding"):
        last = episode["next", key][-1].numpy()
        last = last if key == "depth" else last.astype(int)
        edited(path, replaced(f"obs/{key}", lambda old, last=last: np.append(old, last, 0)))
    assert_same(read_demonstrations(path), [episode])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("obs/holding"), "there is no dataset demo_0/obs/holding"),
        (without("rewards"), "there is no dataset demo_0/rewards"),
        (without("truncated"), "there is no dataset demo_0/truncated"),
        (without("next_obs/depth"), "there is no dataset demo_0/next_obs/depth"),
        (
            replaced("actions", lambda old: old[:, :4]),
            r"actions has shape \(4, 4\), expected \(steps, 5\): gripper, x, y, z, theta",
        ),
        (replaced("actions", lambda old: old[:3]), "num_samples=4, but 3 actions"),
        (replaced("actions", lambda old: 2 * old), r"action holds .*, expected numbers in \[-1, 1"),
        (replaced("actions", lambda old: "none"), "actions holds object, expected numbers"),
        (replaced("rewards", lambda old: old[:2]), r"rewards has shape \(2,\), expected \(4,\)"),
        (replaced("rewards", lambda old: old * np.nan), "reward holds numbers that are not finite"),
        (
            replaced("obs/depth", lambda old: (1000 * old).astype(np.uint16)),
            "obs/depth holds uint16, expected floats, metres",
        ),
        (
            replaced("obs/depth", lambda old: 1000 * old),
            "depth holds .*, expected metres below the end effector",
        ),
        (replaced("obs/depth", lambda old: old[:, :8]), r"depth is .*\(4, 1, 8, 16\), expected"),
        (
            replaced("next_obs/depth", lambda old: old[:, ::2, ::2]),
            "demo_0 has images of 8 pixels a side, expected 16",
        ),
        (
            replaced("obs/holding", lambda old: old[..., None]),
            r"obs/holding has shape \(4, 1, 1\), expected \(4, 1\)",
        ),
    ],
)
def test_what_is_wrong_with_an_episode_is_named(ours, change, message):
    path, _ = ours
    with pytest.raises(DatasetError, match=f"^{path}: .*{message}"):
        read_demonstrations(edited(path, change))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "block_pushing"}, "task='block_picking', expected 'block_pushing'"),
        ({"view": 0.45}, "recorded with view=0.3, expected 0.45"),
        ({"options": {"sizes": (1, 3)}}, r"with options.sizes=\[1, 2\], expected \[1, 3\]"),
        ({"image_size": 32}, "demo_0 has images of 16 pixels a side, expected 32"),
    ],
)
def test_demonstrations_of_another_environment_are_refused(ours, changes, message):
    path, _ = ours
    with pytest.raises(DatasetError, match=message):
        read_demonstrations(path, environment={**WHERE, **changes})


def test_files_that_hold_no_demonstrations_are_told(ours, tmp_path):
    path, _ = ours
    with pytest.raises(DatasetError, match=f"{tmp_path}/none.hdf5: no such file"):
        read_demonstrations(tmp_path / "none.hdf5")
    with pytest.raises(DatasetError, match=f"{tmp_path} is a folder"):
        read_demonstrations(tmp_path)
    (tmp_path / "text.hdf5").write_text("demonstrations")
    with pytest.raises(DatasetError, match=r"text.hdf5: not an HDF5 file"):
        read_demonstrations(tmp_path / "text.hdf5")
    h5py.File(tmp_path / "empty.hdf5", "w").close()
    with pytest.raises(DatasetError, match="not robomimic's layout: there is no group /data"):
        read_demonstrations(tmp_path / "empty.hdf5")
    with h5py.File(tmp_path / "empty.hdf5", "w") as file:
        file.create_group("data")
    with pytest.raises(DatasetError, match="there is no group /data/demo_0"):
        read_demonstrations(tmp_path / "empty.hdf5")


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
def test_damage_does_not_pass_for_demonstrations(ours, share):
    path, episodes = ours
    whole = path.read_bytes()
    at = int(share * len(whole))
    path.write_bytes(whole[:at])
    with pytest.raises(DatasetError, match=f"^{path}"):
        read_demonstrations(path)
    # Sixteen wrong bytes: in a place that nobody reads, or they are found.
    path.write_bytes(whole[:at] + bytes(b ^ 0x5A for b in whole[at : at + 16]) + whole[at + 16 :])
    try:
        found = read_demonstrations(path)
    except DatasetError:
        return
    assert_same(found, episodes)


def test_what_is_no_demonstration_is_not_written(tmp_path):
    path = tmp_path / "no.hdf5"
    good, bad = demonstration(), demonstration()
    bad["action"] = 1.5 * torch.ones(5, 5)
    with pytest.raises(DatasetError, match=r"episode 1: action holds 1.5, expected numbers in"):
        write_demonstrations(path, [good, bad])
    for change, message in (
        ({"action": good["action"].double()}, "action is torch.float64"),
        ({"holding": good["holding"] * torch.nan}, "holding holds numbers that are not finite"),
    ):
        with pytest.raises(DatasetError, match=f"episode 0: {message}"):
            write_demonstrations(path, [good.clone().update(change)])
    with pytest.raises(DatasetError, match="episode 0: expert is missing"):
        write_demonstrations(path, [good.exclude("expert")])
    with pytest.raises(DatasetError, match="episode 1 has images of 32 pixels a side, expected 16"):
        write_demonstrations(path, [good, demonstration(image_size=32)])
    with pytest.raises(DatasetError, match=r"episode 0 has batch size \(0,\)"):
        write_demonstrations(path, [good[:0]])
    with pytest.raises(DatasetError, match="there is no episode to write"):
        write_demonstrations(path, [])
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_there_is_replaced_on_request_only(ours):
    path, episodes = ours
    with pytest.raises(DatasetError, match=f"{path} exists already"):
        write_demonstrations(path, episodes[:1])
    assert_same(read_demonstrations(path), episodes)
    write_demonstrations(path, episodes[:1], overwrite=True)
    assert_same(read_demonstrations(path), episodes[:1])
    with pytest.raises(DatasetError, match=f"cannot write {path}/below"):
        write_demonstrations(path / "below", episodes)


def test_a_full_disk_leaves_the_file_that_was_there(ours, monkeypatch):
    path, episodes = ours

    def full(_):
        raise OSError("no space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(DatasetError, match=f"cannot write {path}: no space left"):
        write_demonstrations(path, episodes[:1], overwrite=True)
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    assert_same(read_demonstrations(path), episodes)


def test_actions_off_the_disc_are_projected_and_counted():
    episode = demonstration(4)
    x_and_y = torch.tensor([[0.6, -0.7], [0.8, 0.6], [1.0, -1.0], [-0.9, 0.9]])
    episode["action"] = episode["action"].clone()
    episode["action"][:, 1:3] = x_and_y
    before = episode["action"].clone()
    (found,), count = project_onto_disc([episode])
    after = found["action"]
    # (0.8, 0.6) has length 1 in exact numbers, and a little more in float32.
    assert count == int((before[:, 1:3].double().square().sum(-1) > 1).sum()) >= 2
    assert torch.equal(after[0], before[0]) and torch.equal(episode["action"], before)
    assert torch.equal(after[:, [0, 3, 4]], before[:, [0, 3, 4]])
    assert (after[:, 1:3].double().square().sum(-1) <= 1).all()
    torch.testing.assert_close(after[2, 1:3], torch.tensor([0.5**0.5, -(0.5**0.5)]))
    torch.testing.assert_close(after[3, 1:3], torch.tensor([-(0.5**0.5), 0.5**0.5]))
    torch.testing.assert_close(after[1, 1:3], before[1, 1:3])
    assert torch.equal(found["depth"], episode["depth"])
    again, count = project_onto_disc([found])
    assert count == 0 and torch.equal(again[0]["action"], after)
