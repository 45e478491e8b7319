"""The tables that put equirl beside escnn, as a user asks for them, at the smallest size."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SMALLEST = "--hidden 8 --image 16 --batch 8 --repeats 1 --threads 1".split()


@pytest.mark.slow
def test_every_table_beside_escnn():
    tables = ["layers", "kernels", "peak", "threads"]
    command = [sys.executable, "experiments/benchmark.py", "--only", *tables, *SMALLEST]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    for table in tables:
        _, _, after = done.stdout.partition(f"## {table}\n")
        header, separator, *rows = [
            line for line in after.partition("##")[0].splitlines() if line.startswith("|")
        ]
        assert rows or table == "threads"  # where there are no native kernels
        assert {line.count("|") for line in (header, separator, *rows)} == {header.count("|")}
    assert "| 8 | escnn, textbook |" in done.stdout
