"""What can go wrong ends in one clear sentence, and nothing is lost."""

import contextlib
import itertools
import re
import resource
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.commands import SMOKE, call, finish, start

#: A run whose end takes no films, long enough to be met while it trains.
RUN = [*SMOKE, "steps=150", "evaluation.every=50", "evaluation.video_episodes=0"]
TABLES = ("metrics.csv", "validation.csv", "test.csv")


def sentence(err: str) -> str:
    """The one line that says what is wrong; there is no traceback."""
    assert "Traceback" not in err, err
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, err
    return lines[0]


def wait_for(condition, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def rows(folder: Path) -> int:
    path = folder / "metrics.csv"
    return len(path.read_text().splitlines()) if path.exists() else 0


def assert_same_tables(first: Path, second: Path) -> None:
    for table in TABLES:
        assert (first / table).read_bytes() == (second / table).read_bytes(), table


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run that nothing happened to."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    code, _, err = call("train.py", *RUN, f"output={folder}")
    assert code == 0, err
    return folder


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["sede=1"], "sede: there is no such key; did you mean seed?"),
        (["+image_size=32"], "image_size: there is no such key; did you mean env.image_size?"),
        (["steps=many"], "steps: Value 'many' of type 'str' could not be converted to Integer"),
        (["env=5"], "Got int"),
        (["env=stacking"], "env=stacking: expected one of block_in_bowl, block_picking"),
        (["method.hidden=8000000000"], "memory does not hold such a run"),
        (["replay.capacity=1000000000000000"], "memory does not hold such a run"),
        (["group=c100000"], "group=c100000"),
        (["threads=100000"], "threads=100000: this machine has"),
        (["env.options.cube_side=2"], "cube_side must be less than 0.08"),
    ],
)
def test_keys_types_and_sizes(here, arguments, named, tmp_path):
    code, _, err = here("train.py", *SMOKE, f"output={tmp_path / 'run'}", *arguments)
    assert code == 1 and named in sentence(err)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_ctrl_c_while_training(here, count, whole, tmp_path):
    """The first stops after the step, the others at once, whatever the code is doing."""
    folder = tmp_path / "run"
    process = start("train.py", *RUN, f"output={folder}")
    wait_for(lambda: rows(folder) > 1)
    for _ in range(count):
        process.send_signal(signal.SIGINT)
        time.sleep(0.03)
    code, _, err = finish(process)
    assert code == 130 and "Traceback" not in err, err
    assert count > 1 or str(folder) in err  # a further one may cut the last words short
    assert here("train.py", f"resume={folder}")[0] == 0
    assert_same_tables(folder, whole)


def test_ctrl_c_while_starting(tmp_path):
    """Imports take seconds; nothing has been written yet."""
    process = start("train.py", *RUN, f"output={tmp_path / 'run'}")
    wait_for(lambda: "torch" in Path(f"/proc/{process.pid}/maps").read_text())
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == 130 and err.endswith("\nstopped\n") and not (tmp_path / "run").exists()


def test_ctrl_c_while_testing(here, tmp_path):
    """The policy is there, its test is not: resumed, it is tested from the start."""
    folder = tmp_path / "run"
    process = start(
        "train.py", *RUN, "steps=1", "evaluation.final_episodes=2000", f"output={folder}"
    )
    wait_for((folder / "checkpoint.pt").exists)
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == 130 and str(folder) in err and not (folder / "test.csv").exists()
    code, out, err = here("train.py", f"resume={folder}", "evaluation.final_episodes=2")
    assert code == 0 and "of 2 episodes succeed" in out, err


def test_ctrl_c_before_training(tmp_path):
    """While demonstrations are collected, of which there would be a hundred thousand."""
    folder = tmp_path / "run"
    process = start("train.py", *SMOKE, "demos.episodes=100000", f"output={folder}")
    wait_for((folder / "config.yaml").exists)
    time.sleep(0.5)
    process.send_signal(signal.SIGTERM)
    code, _, err = finish(process)
    assert code == 130 and "Traceback" not in err and not (folder / "checkpoint.pt").exists()


def limited(size: int):
    """What a process calls first so that no file it writes grows beyond ``size`` bytes."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def test_a_checkpoint_that_cannot_be_written(here, whole, tmp_path):
    folder = tmp_path / "run"
    assert here("train.py", *RUN, "steps=20", f"output={folder}")[0] == 0
    checkpoint = (folder / "checkpoint.pt").read_bytes()
    code, _, err = call(
        "train.py", f"resume={folder}", "steps=150", preexec_fn=limited(len(checkpoint) // 2)
    )
    assert code == 1 and "the previous file is kept" in sentence(err)
    assert (folder / "checkpoint.pt").read_bytes() == checkpoint
    assert not list(folder.glob("*.partial"))
    code, _, err = here("train.py", f"resume={folder}", "steps=150")
    assert code == 0 and "goes on after step 20" in err
    assert_same_tables(folder, whole)


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 16 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("file systems cannot be mounted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk(here, small_disk, whole, tmp_path):
    folder = small_disk / "run"
    filler = small_disk / "filler"
    assert here("train.py", *RUN, "steps=20", f"output={folder}")[0] == 0
    with open(filler, "wb", buffering=0) as file, contextlib.suppress(OSError):
        for _ in itertools.count():
            file.write(bytes(4096))
    code, _, err = here("train.py", f"resume={folder}", "steps=150")
    assert code == 1 and "No space left" in sentence(err)
    filler.unlink()
    code, _, err = here("train.py", f"resume={folder}", "steps=150")
    assert code == 0, err
    assert_same_tables(folder, whole)


@pytest.mark.parametrize("length", [0, 1000, -1])
def test_a_truncated_checkpoint(here, length, whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    path = folder / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:length])
    damaged = path.read_bytes()
    for script, key in (("train.py", "resume"), ("evaluate.py", "run")):
        changes = ["steps=170"] if key == "resume" else []
        code, _, err = here(script, f"{key}={folder}", *changes)
        assert code == 1 and f"{path} is not a readable checkpoint" in sentence(err)
    assert path.read_bytes() == damaged
    assert_same_tables(folder, whole)  # nothing was touched


@pytest.mark.parametrize("damage", [b"\n", b"\xbb\n", b"a,b\n", None])
def test_a_damaged_table(here, damage, whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    path = folder / "metrics.csv"
    content = path.read_bytes()
    path.write_bytes(content.partition(b"\n")[2] if damage is None else content + damage)
    damaged = path.read_bytes()
    code, _, err = here("train.py", f"resume={folder}", "steps=170")
    assert code == 1 and str(path) in sentence(err)
    assert path.read_bytes() == damaged and "steps: 150" in (folder / "config.yaml").read_text()
    code, _, err = here("compare.py", str(tmp_path / "out"), str(folder))
    assert code == 2 and (f"{path}, line" in err or f"{path} is no table" in err)


def test_a_checkpoint_whose_bytes_have_changed(here, whole, tmp_path):
    """Torch does not look at the check sums; a run must not go on with other numbers."""
    folder = shutil.copytree(whole, tmp_path / "run")
    path = folder / "checkpoint.pt"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    code, _, err = here("train.py", f"resume={folder}", "steps=170")
    assert code == 1 and "is damaged" in sentence(err)
    assert_same_tables(folder, whole)


def test_a_configuration_edited_by_hand(here, whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace("tau: 0.01", "tau: 0.5"))
    code, _, err = here("train.py", f"resume={folder}")
    assert code == 1 and "algorithm.tau is 0.01 there and 0.5 here" in sentence(err)


def test_a_folder_whose_configuration_is_not_a_runs(here, tmp_path):
    (tmp_path / "config.yaml").write_text("colour: red\n")
    code, _, err = here("train.py", *RUN, f"output={tmp_path}")
    assert code == 1 and "colour: there is no such key" in sentence(err)
    assert (tmp_path / "config.yaml").read_text() == "colour: red\n"


def test_results_without_their_checkpoint_are_kept(here, whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    (folder / "checkpoint.pt").unlink()
    for changes, named in (([], "whose checkpoint.pt is gone"), (["seed=4"], "seed is 0 there")):
        code, _, err = here("train.py", *RUN, *changes, f"output={folder}")
        assert code == 1 and named in sentence(err)
    assert_same_tables(folder, whole)


def test_folders_of_a_sweep_have_names_that_fit(here, tmp_path):
    keys = [f"env.options.{name}=0.1" for name in ("goal_side", "goal_raise", "reach", "margin")]
    sweep = [*RUN, "env=block_pushing", "steps=1", "demos.episodes=0", *keys, "group=c2,c4"]
    sweep += ["env.options.start_half_width=0.05", "env.options.goal_half_width=0.05"]
    sweep += ["env.options.goal_distance=0.01", "evaluation.discount=0.98", "replay.start=99"]
    code, _, err = here("train.py", "--multirun", *sweep, f"hydra.sweep.dir={tmp_path}")
    assert code == 0, err
    names = [path.name for path in tmp_path.iterdir() if path.is_dir()]
    assert len(names) == 2 and all(len(name) == 200 for name in names)


def test_two_runs_into_one_folder(here, tmp_path):
    folder = tmp_path / "run"
    first = start("train.py", *RUN, "steps=1000000", f"output={folder}")
    wait_for(lambda: rows(folder) > 1)
    code, _, err = here("train.py", *RUN, f"output={folder}")
    assert code == 75 and f"another run is writing to {folder}" in sentence(err)
    first.send_signal(signal.SIGINT)
    assert finish(first)[0] == 130
    assert "steps: 1000000" in (folder / "config.yaml").read_text()


def test_another_run_into_a_used_folder(here, whole):
    before = {path: path.read_bytes() for path in whole.glob("*.*") if path.is_file()}
    code, _, err = here("train.py", *RUN, "seed=5", f"output={whole}")
    assert code == 1 and "seed is 0 there and 5 here" in sentence(err)
    assert all(path.read_bytes() == content for path, content in before.items())


def test_a_run_that_is_finished_is_left_alone(here, whole):
    before = {path.name: path.stat().st_mtime_ns for path in whole.glob("[!.]*")}
    code, out, err = here("train.py", *RUN, f"output={whole}")
    assert code == 0 and "of 3 episodes succeed" in out and "finished already" in err
    assert before == {path.name: path.stat().st_mtime_ns for path in whole.glob("[!.]*")}


def test_a_resume_that_is_refused_changes_nothing(here, whole):
    before = (whole / "config.yaml").read_text()
    code, _, err = here("train.py", f"resume={whole}", "steps=10")
    assert code == 1 and "is at step 150, beyond steps=10" in sentence(err)
    assert (whole / "config.yaml").read_text() == before


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (b"env: [", "is not a readable configuration"),
        (b"\xe6\x00", "is not a readable configuration"),
        (b"- 1\n- 2\n", "expected keys and values"),
        (b"", "env.task= is missing"),
        (b"stepz: 3\n", "stepz: there is no such key; did you mean steps?"),
    ],
)
def test_a_damaged_configuration(here, text, named, tmp_path):
    (tmp_path / "config.yaml").write_bytes(text)
    code, _, err = here("train.py", f"resume={tmp_path}")
    assert code == 1 and named in sentence(err)


def test_a_stopped_sweep_goes_on(here, tmp_path):
    sweep = [*RUN[:1], *RUN[2:], "group=c4,d4", f"hydra.sweep.dir={tmp_path}"]
    process = start("train.py", "--multirun", *sweep)
    wait_for(lambda: any(rows(folder) > 1 for folder in tmp_path.iterdir()))
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == 130 and "the same command and 'hydra.sweep.dir=" in err
    code, out, err = here("train.py", "--multirun", *sweep)
    assert code == 0 and out.count("episodes succeed") == 2, err
    assert re.search(r"goes on after step \d+", err)


def test_a_film_needs_the_name_of_a_film(here, whole, tmp_path):
    code, _, err = here("evaluate.py", f"run={whole}", f"video={tmp_path / 'film.txt'}")
    assert code == 1 and "expected the name of an .mp4 file" in sentence(err)
