"""TensorBoard and wandb beside the tables: real ones, without a network or an account."""

import os
import platform
import subprocess
import sys
import textwrap
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pytest

from equirl.analysis.tables import read_rows
from equirl.config import load_config
from equirl.training import CONFIG, train
from equirl.training.metrics import MetricsLog
from tests.commands import frames_of
from tests.training.runs import run

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def nobody(monkeypatch, tmp_path):
    """A machine where nobody is logged in to wandb."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("WANDB_MODE", "offline")  # TorchRL sets it too, for good


@pytest.fixture
def tracked(small_config):
    """A small configuration with both trackers."""
    return lambda **changes: small_config(
        **{"logging": {"tensorboard": True, "wandb": True, "wandb_project": "tests"}, **changes}
    )


def tensorboard(folder: Path):
    """What TensorBoard has read of a folder, all of it."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    kinds = dict.fromkeys(("scalars", "images", "tensors", "histograms"), 0)
    return EventAccumulator(str(folder / "tensorboard"), size_guidance=kinds).Reload()


def wandb_records(folder: Path) -> list:
    """All records of the one offline run there is; wandb's own process may still be writing."""
    (path,) = folder.glob("wandb/offline-run-*/run-*.wandb")
    deadline = time.monotonic() + 30
    while not any(record.HasField("exit") for record in read_records(path)):
        assert time.monotonic() < deadline, "wandb has not written the end of its run"
        time.sleep(0.05)
    return read_records(path)


def read_records(path: Path) -> list:
    """What is in wandb's file, a log of LevelDB's form: blocks of 32 KiB, records in parts."""
    from wandb.proto.wandb_internal_pb2 import Record

    content, at, parts, records = path.read_bytes(), 7, b"", []  # after the file's own header
    while at + 7 <= len(content):
        if 32768 - at % 32768 < 7:  # of a block, too short for a header
            at += 32768 - at % 32768
            continue
        length, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]
        parts += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or the last part
            records.append(Record.FromString(parts))
            parts = b""
    return records


def wandb_points(folder: Path) -> list[dict[str, str]]:
    """The rows of the history, values as JSON."""
    return [
        {"/".join(item.nested_key) or item.key: item.value_json for item in record.history.item}
        for record in wandb_records(folder)
        if record.HasField("history")
    ]


def wandb_series(folder: Path, table: str, column: str) -> list[tuple[int, float]]:
    """One metric, a point a logged row."""
    step, name = f"{table}/step", f"{table}/{column}"
    points = [point for point in wandb_points(folder) if name in point]
    return [(int(point[step]), float(point[name])) for point in points]


def of_table(folder: Path, table: str, column: str) -> list[tuple[int, float]]:
    """One column of a table in the run's folder."""
    return [(row["step"], row[column]) for row in read_rows(folder / f"{table}.csv")]


def tensorboard_series(folder: Path, table: str, column: str) -> list[tuple[int, float]]:
    events = tensorboard(folder).Scalars(f"{table}/{column}")
    return [(event.step, event.value) for event in events]


def assert_trackers_show_the_tables(folder: Path) -> None:
    for table, column in (("metrics", "length"), ("validation", "low"), ("timing", "minutes")):
        expected = of_table(folder, table, column)
        assert expected
        for series in (wandb_series, tensorboard_series):  # this one in float32
            shown = series(folder, table, column)
            np.testing.assert_allclose(shown, expected, rtol=1e-6, err_msg=series.__name__)


def test_a_killed_and_resumed_run_has_each_point_once(tmp_path, tracked):
    """Killed after step 19: the checkpoint is of step 10, the rows after it are written again."""
    folder = tmp_path / "run"
    run(tracked(), folder, stop_after=10)
    checkpoint = (folder / "checkpoint.pt").read_bytes()
    identity = (folder / "wandb/id.txt").read_text()
    run(tracked(), folder, stop_after=19)
    (folder / "checkpoint.pt").write_bytes(checkpoint)
    run(tracked(), folder)
    assert_trackers_show_the_tables(folder)
    assert [step for step, _ in of_table(folder, "validation", "low")] == [10, 20]
    # The same wandb run, and neither tracker keeps files of earlier sessions.
    assert (folder / "wandb/id.txt").read_text() == identity
    (session,) = folder.glob("wandb/offline-run-*")
    assert identity.strip() in session.name
    assert len(list(folder.glob("tensorboard/*"))) == 1


def test_trackers_switched_on_late_show_the_run_from_its_start(tmp_path, tracked, small_config):
    run(small_config(), tmp_path / "run", stop_after=13)
    run(tracked(), tmp_path / "run")
    assert_trackers_show_the_tables(tmp_path / "run")


def test_trackers_have_configuration_result_and_film(tmp_path, tracked):
    folder = tmp_path / "run"
    outcome = train(tracked(evaluation={"video_episodes": 1}), folder)
    read = tensorboard(folder)
    assert [event.value for event in read.Scalars("test/success_rate")] == [outcome.success_rate]
    assert read.Scalars("test/discounted_return")[0].step == 24
    configuration = read.Tensors("configuration/text_summary")[0].tensor_proto.string_val[0]
    assert b"| group | C4 |" in configuration
    gif = imageio.mimread(read.Images("policy")[0].encoded_image_string, format="gif")
    film = frames_of(folder / "policy.mp4", 384)
    assert len(gif) == len(film) and gif[0].shape[:2] == film[0].shape[:2]
    assert np.abs(gif[0][..., :3].astype(int) - film[0]).mean() < 10  # of 255, in 256 colours

    records = wandb_records(folder)
    (config,) = (
        {item.key: item.value_json for item in record.run.config.update}
        for record in records
        if record.HasField("run")
    )
    assert config["group"] == '"C4"' and config["method.hidden"] == "8"
    assert load_config(folder / CONFIG).group == "C4"
    assert wandb_series(folder, "test", "success_rate") == [(24, outcome.success_rate)]
    (kept,) = folder.glob("wandb/offline-run-*/files/media/videos/*.mp4")
    assert kept.read_bytes() == (folder / "policy.mp4").read_bytes()
    assert any("policy/path" in point or "policy" in point for point in wandb_points(folder))


@pytest.mark.parametrize("private", [True, False])
def test_trackers_are_told_of_host_and_paths_on_request_only(tmp_path, tracked, private):
    logging = {"tensorboard": True, "wandb": True, "private": private}
    config = tracked(demos={"file": "/home/somebody/secret data/d.hdf5"}, logging=logging)
    config.env.options["meshes"] = {"folder": "/mnt/shared/meshes", "others": ["/mnt/more/pans"]}
    with closing(MetricsLog(tmp_path, config)) as log:
        log.rewind(0)
        log.write("metrics", {"step": 1, "length": 3})
    kept = str(wandb_records(tmp_path))
    kept += "".join(path.read_text() for path in tmp_path.glob("wandb/offline*/files/*"))
    events = b"".join(path.read_bytes() for path in tmp_path.glob("tensorboard/*")).decode("latin1")
    assert not private or str(ROOT) not in kept
    assert (str(tmp_path) in kept) is not private
    assert (f'"{platform.node()}"' in kept) is not private
    for shown in (kept, events):
        for path in ("/home/somebody", "secret data", "/mnt/shared", "/mnt/more"):
            assert (path in shown) is not private, path
        assert all(name in shown for name in ("/d.hdf5", "/meshes", "/pans"))
    assert config.demos.file.startswith("/home")  # which the run itself reads


def test_points_that_an_online_run_has_are_not_sent_again(tmp_path, small_config):
    """The server tells where a resumed run is, by its summary."""
    from equirl.training import metrics

    tracker = object.__new__(metrics._Wandb)
    sent = []

    class Logger:
        """What is used of TorchRL's logger, connected to a run of an earlier session."""

        experiment = SimpleNamespace(
            summary={"metrics/step": 20, "validation/step": 10, "test/step": 20, "_step": 7}
        )

        @staticmethod
        def log_metrics(values, step):
            sent.append((step, values))

    tracker._logger, tracker._offline = Logger, False
    tracker.begin({"metrics": [{"step": 12, "length": 5}, {"step": 20, "length": 3}]})
    tracker.begin({"validation": [{"step": 10, "low": 0.0}, {"step": 15, "low": 0.1}]})
    tracker.write("metrics", {"step": 18, "length": 3})
    tracker.write("metrics", {"step": 21, "length": 4})
    tracker.write("symmetry", {"step": 10, "mean": 0.5})
    # A finished run that is tested again, on other scenes: the step is the same, the result not.
    tracker.write("test", {"step": 20, "success_rate": 0.75})
    assert sent == [
        (15, {"validation/low": 0.1}),
        (21, {"metrics/length": 4}),
        (10, {"symmetry/mean": 0.5}),
        (20, {"test/success_rate": 0.75}),
    ]


FAILING = """
    import logging, os, resource, signal, sys, time
    from contextlib import suppress
    from pathlib import Path

    from equirl.config import load_config
    from equirl.training.metrics import MetricsLog

    logging.basicConfig(format="%(message)s")
    folder = Path(sys.argv[1])
    log = MetricsLog(folder, load_config(folder / "config.yaml"))
    log.rewind(0)
    log.write("metrics", {"step": 0, "length": 3})
    (events,) = folder.glob("tensorboard/*")
    log.trackers[0]._logger.experiment.flush()
    size = events.stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, size + 100))  # the disk is full
    for process in Path("/proc").glob("[0-9]*"):  # wandb's own process dies
        try:
            parent = f"PPid:\\t{os.getpid()}\\n" in (process / "status").read_text()
            if parent and b"wandb-core" in (process / "cmdline").read_bytes():
                os.kill(int(process.name), signal.SIGKILL)
        except OSError:
            continue  # ended while it was looked at
    step, deadline = 0, time.monotonic() + 20
    while step < 20 or (log.trackers and time.monotonic() < deadline):
        step += 1
        log.write("metrics", {"step": step, "length": 3})
        time.sleep(0.01)
        for tracker in log.trackers:
            if tracker.name == "TensorBoard":  # it writes every two minutes
                with suppress(OSError):
                    tracker._logger.experiment.flush()
    log.close()
    rows = (folder / "metrics.csv").read_text().splitlines()
    print("complete" if len(rows) == step + 2 else rows)
"""


def test_a_run_outlives_its_trackers(tmp_path, tracked):
    from equirl.config import save_config

    save_config(tracked(), tmp_path / "config.yaml")
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", textwrap.dedent(FAILING), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        # Its own wandb process, not the one that serves this one.
        env={key: value for key, value in os.environ.items() if key != "WANDB_SERVICE"},
    )
    assert done.returncode == 0 and "complete" in done.stdout, done.stderr
    for name in ("TensorBoard", "wandb"):
        assert done.stderr.count(f"{name} failed and gets nothing more") == 1, done.stderr
