"""The benchmark's tables, as a user asks for them, at the smallest size."""

import sys

import benchmark
import pytest

from equirl.envs.tasks import TASKS

SMALLEST = (
    "--hidden 8 --image 16 --batch 8 --repeats 1 --threads 1 --steps 4 --camera 8 --workers 2"
).split()


@pytest.fixture
def tables(monkeypatch, capfd):
    """Runs the benchmark and returns the rows of each table, by name."""

    def run(*names):
        monkeypatch.setattr(sys, "argv", ["benchmark.py", "--only", *names, *SMALLEST])
        benchmark.main()
        out = capfd.readouterr().out
        return {name: rows(out.partition(f"## {name}\n")[2].partition("##")[0]) for name in names}

    return run


def rows(text):
    """Returns the cells of each row below the header, of one table after the other."""
    found = []
    for table in text.split("\n\n"):
        lines = [line for line in table.splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in lines}) <= 1
        found += [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    return found


def test_tables_of_the_environments(tables):
    printed = tables("environment", "profile", "scaling")
    for name in ("environment", "profile"):
        assert [row[:2] for row in printed[name]] == [
            [task, robot] for task in TASKS for robot in ("panda", "hand")
        ]
    for row in printed["environment"]:
        speed, _, earlier, ratio, without_camera = (float(cell.split()[0]) for cell in row[2:7])
        assert speed > earlier and ratio > without_camera > 1
    for row in printed["profile"]:
        simulation_steps, _, *shares, _ = map(float, row[2:])
        assert 10 < simulation_steps < 60
        assert sum(shares) == pytest.approx(100, abs=4)  # each is rounded
    expected = [(task, kind) for task in TASKS for kind in ("1 in process", "2 workers")]
    scaling, growth = printed["scaling"][: len(expected)], printed["scaling"][len(expected) :]
    assert [tuple(row[:2]) for row in scaling] == expected
    for row in scaling:
        assert row[5] == "-" if row[1] == "1 in process" else float(row[5]) > 1
    assert [row[0] for row in growth] == list(TASKS)


@pytest.mark.slow
def test_every_table_beside_escnn(tables):
    printed = tables("layers", "kernels", "peak", "threads")
    for name, table in printed.items():
        assert table or name == "threads"  # where there are no native kernels
    assert ["8", "escnn, textbook"] in [row[:2] for row in printed["kernels"]]
