"""Runs and sweeps listed, and the page about a sweep, as a user calls them."""

import os
import signal
import subprocess
import sys

import pytest

from equirl.training.folder import claim_folder
from tests.analysis.run_folders import write_run
from tests.commands import ROOT, finish, start


@pytest.fixture
def sweep(tmp_path):
    folder = tmp_path / "outputs" / "sweep"
    write_run(folder / "a")
    write_run(folder / "b", returns=[0.5, 0.7], success=[0.2, 0.4], test=None, seed=1)
    failed = write_run(folder / "c", returns=[], success=[], test=None, seed=2)
    (failed / "failed.txt").write_text("MemoryError: 9 GB\n")
    text = "hydra:\n  sweeper:\n    params: null\n  overrides:\n    task: ['seed=0,1,2,3']\n"
    (folder / "multirun.yaml").write_text(text)
    return folder


def rows_of(out):
    return {line.split()[0]: line for line in out.splitlines() if line.startswith("  ")}


def test_the_list(here, sweep):
    with claim_folder(sweep / "b"):
        code, out, err = here("runs.py", str(sweep))
    assert code == 0, err
    rows = rows_of(out)
    # Step, return, success, steps a minute, time left.
    assert rows["a"].split()[-5:] == ["400/400", "0.50", "75%", "50", "-"]
    assert rows["b"].split()[-6:] == ["200/400", "0.60", "40%", "50", "4", "min"]
    assert "Block Picking, Equivariant SAC, D4, seed 1  running" in rows["b"]
    assert "failed: MemoryError: 9 GB" in rows["c"]
    assert f"{sweep}: 3 runs" in out
    # 200 steps of b and 400 of the one to come, 50 a minute; none of c, which has failed.
    assert "1 running, 1 finished, 1 failed; 1 of 4 to come; 600 of 1,200 steps made; 12 min" in out
    assert out.strip().endswith("12 min left, 1 run at a time")


def test_the_training_that_is_left_when_nothing_runs(here, sweep):
    code, out, err = here("runs.py", str(sweep))
    assert code == 0, err
    # 200 steps of b, 400 of c and 400 of the one to come, 50 a minute.
    assert out.strip().endswith("steps made; 20 min of training left, nothing runs")


def test_a_reader_that_has_seen_enough_ends_it(sweep):
    ours, theirs = os.pipe()
    os.close(ours)  # as of head, once it has its lines
    command = [sys.executable, str(ROOT / "experiments" / "runs.py"), str(sweep)]
    held = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    for arguments in ([], ["--html", str(sweep / "a.html")]):
        done = subprocess.run(
            [*command, *arguments], stdout=theirs, stderr=subprocess.PIPE, env=held
        )
        assert (done.returncode, done.stderr) == (141, b"")
    os.close(theirs)


def test_all_folders_of_outputs_are_listed_by_default(here, sweep, tmp_path, monkeypatch):
    write_run(tmp_path / "outputs" / "block_picking" / "single", env_task="block_pushing")
    monkeypatch.chdir(tmp_path)
    code, out, err = here("runs.py")
    assert code == 0, err
    assert out.index("outputs/block_picking: 1 run\n") < out.index("outputs/sweep: 3 runs\n")
    assert "Block Pushing" in rows_of(out)["single"]


def test_long_names_lose_their_middle(here, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")
    for seed in (0, 1):
        write_run(tmp_path / f"{'x' * 200}_seed-{seed}", seed=seed)
    code, out, err = here("runs.py", str(tmp_path))
    assert code == 0, err
    names = [name for name in rows_of(out) if name.startswith("xxx")]
    assert [name[-8:] for name in names] == ["x_seed-0", "x_seed-1"]
    assert all("…" in name and len(name) <= 30 for name in names)


def test_no_runs_are_told_in_a_sentence(here, tmp_path):
    code, _, err = here("runs.py", str(tmp_path))
    assert code == 1 and err.strip() == f"no runs below {tmp_path}"
    code, _, err = here("runs.py", str(tmp_path), "--html", str(tmp_path / "a.html"))
    assert code == 1 and f"error: no runs below {tmp_path}" in err


def test_a_page_is_about_a_sweep_and_others_are_named(here, sweep):
    write_run(sweep.parent / "other" / "a")
    code, _, err = here("runs.py", str(sweep.parent), "--html", str(sweep / "a.html"))
    others = f"{sweep.parent / 'other'}, {sweep}"
    assert code == 1
    assert err.strip() == f"error: {sweep.parent} is no sweep; --html takes one of {others}"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--watch", "0"], "argument --watch: expected an integer of 1 or more, got '0'"),
        (["--html", "x.html", "--watch", "1"], "--html: expected one folder, and no --watch"),
        (["--html", "x.html", "--figure", "9"], "--figure 9: expected one of groups, 12"),
        (["--html", "/proc/none/x.html"], "cannot write /proc/none/x.html"),
    ],
)
def test_bad_input_ends_in_a_sentence_that_names_it(here, sweep, arguments, named):
    code, _, err = here("runs.py", str(sweep), *arguments)
    assert code != 0 and named in err and "Traceback" not in err


def test_the_page(here, sweep, tmp_path):
    path = tmp_path / "new" / "report.html"
    code, out, err = here("runs.py", str(sweep), "--html", str(path), "--figure", "13")
    assert code == 0 and f"page: {path}" in out, err
    page = path.read_text()
    assert page.startswith("<!doctype html>") and "Figure 13: demonstrations" in page
    assert '<a href="../outputs/sweep/a/report.md">a</a>' in page
    assert "failed: MemoryError: 9 GB" in page and "1 of 4 to come" in page
    assert "Block Picking, 20 demonstrations, seed 0" in page  # as in the figure


def test_the_list_loads_no_torch(sweep):
    code = (
        "import sys, runs; runs.main(sys.argv[1:]);"
        "sys.exit(str(sorted({'torch', 'hydra', 'matplotlib', 'scipy'} & set(sys.modules))))"
    )
    command = [sys.executable, "-c", code, str(sweep)]
    done = subprocess.run(command, cwd=ROOT / "experiments", capture_output=True, text=True)
    assert done.stderr.strip() == "[]" and "1 finished" in done.stdout


def test_watching_lists_again_and_ends_with_an_interrupt(sweep):
    process = start("runs.py", str(sweep), "--watch", "1")
    seen = 0
    while seen < 2:
        line = process.stdout.readline()
        assert line, process.stderr.read()
        seen += line == f"{sweep}: 3 runs\n"
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == 130 and "Traceback" not in err
