"""Sweeps whose runs are processes: several at a time, killed, stopped, queued again."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import run_processes
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.commands import ROOT, SMOKE, finish, start

#: A run of a second or two, on as many threads as its launcher gives it.
TINY = [*(key for key in SMOKE if key != "threads=1"), "steps=12", "demos.episodes=1"]
TINY += ["evaluation.every=12", "evaluation.episodes=1", "evaluation.final_episodes=1"]
TINY += ["evaluation.video_episodes=0", "replay.start=5"]


def wait_for(condition, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def processes_in(sweep: Path, run: str = "") -> list[int]:
    """Those that train a run of a sweep, by what stands on their command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_text().split("\0")
        except OSError:  # it has ended
            continue
        if any(w.startswith("resume=") and f"{sweep}/" in w and run in w for w in words):
            found.append(int(path.parent.name))
    return found


def test_joblib_trains_several_and_survives_what_kills_one(tmp_path):
    """One is killed, of which the other knows nothing; Ctrl-C then lets that save itself.

    It reaches an idle worker, too, as a terminal's does. And the folder has an odd name.
    """
    tmp_path = tmp_path / "größe, x=1"
    sweep = ["--multirun", *TINY, "seed=0,1", "steps=100000"]
    sweep += [f"hydra.sweep.dir={run_processes.quoted(tmp_path)}"]
    sweep += ["hydra/launcher=joblib", "hydra.launcher.n_jobs=3"]
    process = start("train.py", *sweep, start_new_session=True)
    wait_for(lambda: len(list(tmp_path.glob("*/checkpoint.pt"))) == 2)
    (first,) = processes_in(tmp_path, "seed-0")
    (second,) = processes_in(tmp_path, "seed-1")  # at the same time
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: list(tmp_path.glob("*/failed.txt")))
    assert Path(f"/proc/{second}").exists()
    os.killpg(process.pid, signal.SIGINT)
    code, out, err = finish(process)
    assert code == 1 and "2 runs: 1 begun, 1 failed" in out and "ended early" not in err
    assert "1 run failed:\nseed=0: killed by SIGKILL, as when the memory is full" in err
    assert not processes_in(tmp_path)
    (log,) = tmp_path.glob("*seed-1*/log.txt")
    assert "stopping soon, nothing is lost" in log.read_text()
    for folder in tmp_path.glob("*seed-*"):
        expected = max(1, len(os.sched_getaffinity(0)) // 2)
        assert f"threads: {expected}\n" in (folder / "config.yaml").read_text()


def test_slurms_local_double_runs_and_skips(here, tmp_path):
    sweep = ["--multirun", *TINY, "seed=0", f"hydra.sweep.dir={tmp_path}"]
    sweep += ["hydra/launcher=slurm_local"]
    code, out, err = here("train.py", *sweep)
    assert code == 0 and "1 run: 1 finished" in out, err
    (log,) = (path.read_text() for path in tmp_path.glob(".submitit/*/*.out"))
    assert ": begins" in log and ": finished" in log and "run folder" not in out
    code, out, err = here("train.py", *sweep)
    assert code == 0 and out.count("1 finished") == 2, err
    assert len(list(tmp_path.glob(".submitit/*/*.out"))) == 1  # no job was made


STUB = """
import os, signal, sys, time
from pathlib import Path
folder = Path(sys.argv[1].removeprefix('resume=').strip('"'))
def save(number, frame):
    time.sleep(0.3)
    (folder / "saved").touch()
    sys.exit(130)
signal.signal(signal.SIGTERM, save)
(folder / "begun").touch()
{rest}
time.sleep(60)
"""


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """Puts a script in the place of the training, which saves itself when it is told to end."""

    def call(rest: str = "") -> Path:
        script = tmp_path / "stub.py"
        script.write_text(STUB.format(rest=rest))
        monkeypatch.setattr(run_processes, "SCRIPT", script)
        folder = tmp_path / "run"
        folder.mkdir()
        return folder

    return call


@pytest.mark.parametrize(
    ("rest", "reason"),
    [
        ("sys.exit('error: the disk is full')", "the disk is full"),
        ("raise ZeroDivisionError('planted')", "ZeroDivisionError: planted"),
        ("import os; os.kill(os.getpid(), 9)", "killed by SIGKILL, as when the memory is full"),
        ("import os; os.abort()", "killed by SIGABRT"),
        ("import os; os.kill(os.getpid(), 35)", "killed by signal 35"),  # a real-time one
        ("sys.exit(3)", "exit code 3"),
        ("print('error: before'); raise ZeroDivisionError('after')", "ZeroDivisionError: after"),
        (
            "print('error: the disk is full\\nException ignored in: x\\nTraceback (most recent')\n"
            "sys.exit(1)",
            "the disk is full",
        ),
    ],
)
def test_what_a_process_dies_of_is_kept(stub, rest, reason):
    folder = stub(rest)
    assert run_processes.run_in_process(folder, [], threads=1) == f"failed: {reason}"
    assert (folder / "failed.txt").read_text() == f"{reason}\n"


def test_what_keeps_a_process_from_beginning_is_kept(stub):
    folder = stub()
    (folder / "log.txt").mkdir()
    outcome = run_processes.run_in_process(folder, [], threads=1)
    assert outcome.startswith("failed: ") and "Is a directory: '.../log.txt'" in outcome
    assert (folder / "failed.txt").read_text() == outcome.removeprefix("failed: ") + "\n"


def test_a_run_that_trains_elsewhere_has_not_failed(stub):
    folder = stub(f"sys.exit({run_processes.IN_USE})")
    (folder / "failed.txt").write_text("of an earlier attempt\n")
    assert run_processes.run_in_process(folder, [], threads=1) == "another process trains it"
    assert not (folder / "failed.txt").exists()


def test_a_failure_of_before_is_forgotten_when_the_process_begins(stub):
    folder = stub("sys.exit(int((folder / 'failed.txt').exists()))")
    (folder / "failed.txt").write_text("of an earlier attempt\n")
    assert run_processes.run_in_process(folder, [], threads=1) == "finished"


@pytest.mark.parametrize("private", [True, False])
def test_no_path_is_kept_unless_asked(stub, private):
    folder = stub("sys.exit('error: no space for /home/somebody/run')")
    arguments = [] if private else ["logging.private=false"]
    run_processes.run_in_process(folder, arguments, threads=1)
    kept = (folder / "failed.txt").read_text()
    assert kept == ("no space for .../run\n" if private else "no space for /home/somebody/run\n")


def test_threads_are_set_before_libraries_are_loaded(stub):
    folder = stub("import os; print(*sorted(os.environ.items())); sys.exit(0)")
    assert run_processes.run_in_process(folder, [], threads=3) == "finished"
    log = (folder / "log.txt").read_text()
    assert all(f"('{name}_NUM_THREADS', '3')" in log for name in ("OMP", "MKL", "NUMBA"))


def test_a_file_stops_runs_and_lets_none_begin(stub, tmp_path):
    folder = stub()
    watched = run_processes.RunInProcess([tmp_path / "stop"], {str(folder): []})
    threading.Thread(
        target=lambda: (wait_for((folder / "begun").exists), (tmp_path / "stop").touch())
    ).start()
    assert watched({"resume": str(folder)}) == "stopped"
    assert (folder / "saved").exists() and not (folder / "failed.txt").exists()
    (folder / "begun").unlink()
    assert watched({"resume": str(folder)}) == "stopped" and not (folder / "begun").exists()


def test_a_run_saves_itself_before_its_job_is_queued_again(stub, monkeypatch):
    """As when a job reaches its time limit: submitit's handler queues it and ends the process."""
    folder = stub()
    seen = []

    def requeue(number, frame):
        seen.append((folder / "saved").exists())

    before = signal.signal(signal.SIGUSR2, requeue)
    try:
        threading.Thread(
            target=lambda: (
                wait_for((folder / "begun").exists),
                os.kill(os.getpid(), signal.SIGUSR2),
            )
        ).start()
        assert run_processes.run_in_process(folder, [], threads=1) == "stopped"
        assert seen == [True] and signal.getsignal(signal.SIGUSR2) is requeue
    finally:
        signal.signal(signal.SIGUSR2, before)


def test_ctrl_c_counts_where_the_sweep_watches_its_runs_itself(stub, tmp_path):
    """As joblib lets it with n_jobs=1."""
    folder, stop, handlers = stub(), tmp_path / "asked", set()

    def should_stop() -> bool:
        handlers.add(signal.getsignal(signal.SIGINT))
        return stop.exists()

    with run_processes.on_interrupt(stop.touch):
        threading.Thread(
            target=lambda: (
                wait_for((folder / "begun").exists),
                os.kill(os.getpid(), signal.SIGINT),
            )
        ).start()
        outcome = run_processes.run_in_process(folder, [], threads=1, should_stop=should_stop)
    assert outcome == "stopped" and (folder / "saved").exists()
    assert signal.SIG_IGN not in handlers


def test_a_run_can_be_interrupted_though_its_watcher_cannot(stub):
    """By its own number, from elsewhere: the watcher of a worker has the signal blocked."""
    folder = stub("signal.signal(signal.SIGINT, save); os.kill(os.getpid(), signal.SIGINT)")
    with run_processes.on_interrupt(lambda: None):
        assert run_processes.run_in_process(folder, [], threads=1) == "stopped"


def test_a_signal_may_come_while_the_process_is_asked_how_it_is(stub, monkeypatch):
    """Whoever asks holds a lock, for which a handler that waited would wait for ever."""
    folder, started = stub(), []
    honest = subprocess.Popen

    def popen(*arguments, **options):
        started.append(honest(*arguments, **options))
        return started[-1]

    def should_stop() -> bool:
        if (folder / "begun").exists() and not seen["asking"]:
            seen["asking"] = True
            (process,) = started
            with process._waitpid_lock:
                release = threading.Timer(10, process._waitpid_lock.release)  # else for ever
                release.start()
                os.kill(os.getpid(), signal.SIGUSR2)
                release.cancel()
        return False

    seen = {"asking": False, "requeued": False}
    monkeypatch.setattr(run_processes.subprocess, "Popen", popen)
    before = signal.signal(signal.SIGUSR2, lambda *_: seen.update(requeued=True))
    try:
        outcome = run_processes.run_in_process(folder, [], threads=1, should_stop=should_stop)
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert outcome == "stopped" and seen["requeued"] and (folder / "saved").exists()


def test_no_run_outlives_a_killed_worker(stub, tmp_path):
    folder = stub()
    code = (
        "import sys, run_processes; from pathlib import Path; "
        f"run_processes.SCRIPT = Path({str(tmp_path / 'stub.py')!r}); "
        f"run_processes.run_in_process(Path({str(folder)!r}), [], threads=1)"
    )
    worker = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT / "experiments")
    wait_for((folder / "begun").exists)
    worker.kill()
    worker.wait()
    wait_for((folder / "saved").exists, 10)


def test_watchers_load_no_torch():
    code = "import sys, run_processes; assert 'torch' not in sys.modules"
    paths = os.pathsep.join([str(ROOT / "experiments"), str(ROOT)])
    subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": paths}, check=True
    )


@pytest.mark.parametrize(
    "text", ["größe", "a b, x=1", 'the "first"', "it's", "a\\b", "ends in \\", '\\"', "{a: [b]}"]
)
def test_hydra_reads_what_was_quoted(text):
    parser = OverridesParser.create()
    (parsed,) = parser.parse_overrides([f"logging.wandb_project={run_processes.quoted(text)}"])
    assert parsed.value() == text and not parsed.is_sweep_override()


def test_slurms_configuration_is_one_that_submitit_takes():
    """Without a cluster: the launcher is built, and its keys are those of its form."""
    from hydra import compose, initialize_config_dir
    from hydra_plugins.hydra_submitit_launcher.config import SlurmQueueConf

    from equirl.config import register

    register()
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = compose("config", ["hydra/launcher=slurm"], return_hydra_config=True)
    launcher = config.hydra.launcher
    assert set(launcher) == set(SlurmQueueConf.__dataclass_fields__)
    assert launcher.max_num_timeout > 0 and launcher.array_parallelism == 32
