"""How far runs are: states, numbers and totals, while they are written."""

import fcntl

import pytest

from equirl.analysis import runs as names
from equirl.analysis.runs import find_sweeps, read_runs
from equirl.analysis.status import read_status, total
from equirl.training import folder as training_folder
from equirl.training.folder import FolderError, claim_folder
from tests.analysis.run_folders import write_run


def status_of(folder):
    (run,) = read_runs(folder)
    return read_status(run)


def test_the_names_of_files_are_those_that_training_writes():
    for name in ("CONFIG", "LOCK", "METRICS", "TEST", "REPORT", "VIDEO"):
        assert getattr(names, name) == getattr(training_folder, name)
    assert {names.VALIDATION, names.TIMING} <= set(training_folder.FILES)


def test_a_finished_run(tmp_path):
    status = status_of(write_run(tmp_path / "a"))
    assert (status.state, status.step, status.success) == ("finished", 400, 0.75)
    assert status.last_return == pytest.approx(0.5) and status.minutes_left == 0


def test_a_run_is_running_as_long_as_its_process_holds_the_lock(tmp_path):
    folder = write_run(tmp_path / "a", returns=[0.5, 0.7], success=[0.2, 0.4], test=None)
    with claim_folder(folder):
        status = status_of(folder)
        assert status.state == "running" and status.step == 200 and status.success == 0.4
        # 100 steps in 2 minutes between the validations, 200 steps to go.
        assert status.speed == pytest.approx(50) and status.minutes_left == pytest.approx(4)
        with pytest.raises(FolderError, match="another run"), claim_folder(folder):
            pass
    assert status_of(folder).state == "stopped"
    with claim_folder(folder):  # looking has left no lock behind
        pass


def test_looking_leaves_the_folder_as_it_is(tmp_path):
    folder = write_run(tmp_path / "a", test=None)
    (folder / ".lock").write_text("kept")
    before = {path: path.stat().st_mtime_ns for path in [folder, *folder.iterdir()]}
    status_of(folder)
    assert before == {path: path.stat().st_mtime_ns for path in [folder, *folder.iterdir()]}
    (folder / ".lock").unlink()
    assert status_of(folder).state == "stopped" and not (folder / ".lock").exists()


def test_a_shared_lock_is_not_taken_for_a_run(tmp_path):
    folder = write_run(tmp_path / "a", test=None)
    with open(folder / ".lock") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        assert status_of(folder).state == "stopped"


def test_a_failed_run_tells_its_reason(tmp_path):
    folder = write_run(tmp_path / "a", returns=[0.5], success=[], test=None)
    (folder / "failed.txt").write_text("Traceback\n  line\nMemoryError: 9 GB\n\n")
    status = status_of(folder)
    assert (status.state, status.reason) == ("failed", "MemoryError: 9 GB")
    assert status.success is None and status.speed is None and status.minutes_left is None
    (folder / "config.yaml").unlink()
    assert status_of(folder).state == "failed"
    with claim_folder(folder):  # it is tried again
        assert status_of(folder).state == "running"


def test_waiting_and_unreadable_runs(tmp_path):
    waiting = write_run(tmp_path / "a", returns=[], success=[], test=None)
    assert status_of(waiting).state == "waiting" and status_of(waiting).last_return is None
    (waiting / "config.yaml").write_text("- 1\n")
    assert status_of(waiting).state == "failed" and "expected keys" in status_of(waiting).reason


def test_ends_of_tables(tmp_path):
    """Long tables are read from their end; what is cut or damaged is passed over."""
    folder = write_run(tmp_path / "a", returns=[0.0] * 3000 + [1.0] * 5, steps=10**6, test=None)
    assert (folder / "metrics.csv").stat().st_size > 1 << 15
    with open(folder / "metrics.csv", "a") as file:
        file.write("what\n999999,0")
    status = status_of(folder)
    assert status.step == 300500 and status.last_return == pytest.approx(1.0)
    (folder / "timing.csv").write_bytes(b"\xff\n")
    (folder / "validation.csv").write_text("")
    assert status_of(folder).speed is None and status_of(folder).success is None


def test_totals(tmp_path):
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", returns=[0.1], success=[0.1], test=None, seed=1)
    statuses = [read_status(run) for run in read_runs(tmp_path)]
    totals = total(statuses, planned=4)
    assert totals.counts == {"finished": 1, "stopped": 1} and totals.planned == 4
    assert (totals.step, totals.steps, totals.parallel) == (500, 800, 0)
    # 300 steps of b and twice 400 of those to come, 50 a minute.
    assert totals.minutes_left == pytest.approx(22)
    assert total([]).minutes_left is None and total(statuses[:1]).minutes_left == 0


def test_failed_runs_are_left_to_a_command_that_is_given_again(tmp_path):
    write_run(tmp_path / "a", returns=[0.1], success=[0.1], test=None)
    for name in ("b", "c"):
        write_run(tmp_path / name, returns=[0.1], success=[0.1], test=None)
        (tmp_path / name / "failed.txt").write_text("no memory\n")
    (tmp_path / "c" / "config.yaml").unlink()  # it failed before it had one

    def totals():
        return total([read_status(run) for run in read_runs(tmp_path)], planned=4)

    # 300 steps each of a and b, 400 each of c and of the one to come, 50 a minute.
    assert (totals().minutes_left, totals().parallel) == (pytest.approx(28), 0)
    with claim_folder(tmp_path / "a"):
        assert (totals().minutes_left, totals().parallel) == (pytest.approx(14), 1)
        with claim_folder(tmp_path / "b"):  # it is tried again
            assert (totals().minutes_left, totals().parallel) == (pytest.approx(20), 2)


def test_all_test_scenes_count_however_many(tmp_path):
    status = status_of(write_run(tmp_path / "a", test=[0] * 30_000 + [1] * 10_000))
    assert status.success == 0.25


def test_sweeps_are_found_by_folder_and_runs_are_not_searched(tmp_path):
    write_run(tmp_path / "sweep" / "a")
    write_run(tmp_path / "one" / "b")
    write_run(tmp_path / "one" / "b" / "wandb" / "config")
    write_run(tmp_path / ".hidden" / "c")
    write_run(tmp_path / ".hydra")
    write_run(tmp_path / "one" / ".hydra")
    found = [(path.name, [run.name for run in runs]) for path, runs in find_sweeps(tmp_path)]
    assert found == [("one", ["b"]), ("sweep", ["a"])]
    assert [run.name for _, runs in find_sweeps(tmp_path / "one" / "b") for run in runs] == ["b"]
    assert list(find_sweeps(tmp_path / "nothing")) == []
