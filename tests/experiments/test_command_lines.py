"""What is wrong on a command line is named in one sentence."""

import argparse
import sys

import benchmark
import compare
import object_sheet
import pytest
from command_line import at_least

from equirl.analysis.tables import read_table, write_table


@pytest.fixture
def complaint(capsys, monkeypatch):
    """Calls an entry point with bad arguments; returns what it says."""

    def call(main, *arguments):
        monkeypatch.setattr(sys, "argv", ["script.py", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code not in (0, None)
        said = capsys.readouterr().err
        return said if isinstance(stopped.value.code, int) else f"{said}{stopped.value.code}"

    return call


@pytest.fixture
def run(tmp_path):
    """The folder of a run, as far as a comparison looks into it."""
    folder = tmp_path / "run"
    folder.mkdir()
    episodes = [(1, 4), (0, 9), (1, 5)]
    write_table(folder / "test.csv", [{"success": s, "length": n} for s, n in episodes])
    scores = [(5, 0.5), (10, 0.9), (15, 0.8)]
    validations = [{"step": n, "success_rate": s, "low": s, "high": s} for n, s in scores]
    write_table(folder / "validation.csv", validations)
    times = [{"step": step, "minutes": step / 10, "update_ms": 12.4} for step in (5, 10, 15)]
    write_table(folder / "timing.csv", times)
    return folder


@pytest.mark.parametrize("text", ["0", "-3", "1.5", "many", ""])
def test_a_number_that_is_too_small_or_none(text):
    with pytest.raises(argparse.ArgumentTypeError, match=f"integer of 1 or more, got '{text}'"):
        at_least(1)(text)
    assert (at_least(0)("0"), at_least(-3)("-3")) == (0, -3)


def test_runs_of_one_label_are_one_group(run, tmp_path, capsys, monkeypatch):
    output = tmp_path / "new" / "comparison"
    compare.main([str(output), f"D4={run}", f"CNN={run}", f"D4={run}"])
    (header, line, *rows) = (output / "table.md").read_text().splitlines()
    assert rows[0] == "| D4 | run | 2/3 | 21% to 94% | 4.5 | 10 | 1.0 | 1.5 | 12 |"
    assert [row.split()[1] for row in rows] == ["D4", "D4", "CNN"]
    assert capsys.readouterr().out == "\n".join([header, line, *rows, ""])
    assert (output / "runs.csv").read_text().count("2/3") == 3
    assert (output / "curves.png").read_bytes()[:4] == b"\x89PNG"


def test_bad_groups_of_runs_are_named(complaint, run, tmp_path):
    def compared(*groups):
        return complaint(compare.main, tmp_path / "out", *groups)

    assert "required: LABEL=FOLDER" in compared()
    for text in ("D4=", f"={run}", "D4=,"):
        assert f"expected LABEL=FOLDER[,FOLDER...], got '{text}'" in compared(text)
    for folder in ("/nonexistent", tmp_path):
        named = f"{folder} is not the folder of a finished run"
        assert named in compared(f"D4={run},{folder}")
    write_table(tmp_path / "test.csv", [{"return": 1}])
    assert "test.csv, line 1: expected a header with success, length" in compared(f"D4={tmp_path}")
    assert "or the folder of finished runs, got '/nonexistent'" in compared("/nonexistent")
    assert not (tmp_path / "out").exists()


def test_an_output_that_cannot_be_written_is_named(complaint, run):
    output = run / "test.csv" / "below"
    assert f"cannot write to {output}" in complaint(compare.main, output, f"D4={run}")
    assert read_table(run / "test.csv")["success"] == [1, 0, 1]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--only", "speed"], "invalid choice: 'speed'"),
        (["--steps", "0"], "argument --steps: expected an integer of 1 or more, got '0'"),
        (["--repeats", "-2"], "argument --repeats: expected an integer of 1 or more, got '-2'"),
        (["--workers", "2", "none"], "argument --workers: expected an integer of 1 or more"),
        (["--threads", "0"], "argument --threads: "),
        (["--image", "100"], "image_size=100 is not supported"),
        (["--hidden", "16", "12"], "hidden=12 is not supported"),
        (["--group", "so3"], "so3"),
    ],
)
def test_bad_arguments_of_the_benchmark_are_named(complaint, arguments, named):
    assert named in complaint(benchmark.main, *arguments)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "required: --output"),
        (["--output", "a.png", "--columns", "0"], "argument --columns: expected an integer of 1"),
        (["--output", "a.png", "--size", "x"], "argument --size: expected an integer of 1"),
        (["--output", "a.xyz"], "argument --output: expected a PNG file, got a.xyz"),
    ],
)
def test_bad_arguments_of_the_object_sheet_are_named(complaint, arguments, named):
    assert named in complaint(object_sheet.main, *arguments)
