"""Tables are written as they are read, and as Markdown shows them."""

import pytest

from equirl.analysis.tables import TableError, markdown_row, markdown_table, read_table, write_table


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "test.csv"
    write_table(path, [{"seed": 3, "return": 0.1 + 0.2}, {"return": -1e-9, "seed": 4}])
    assert path.read_text().splitlines()[0] == "seed,return"
    assert read_table(path) == {"seed": [3, 4], "return": [0.1 + 0.2, -1e-9]}
    write_table(path, [{"label": "a,b"}])
    assert path.read_bytes() == b'label\n"a,b"\n'


def test_a_column_that_the_first_row_has_not_is_refused(tmp_path):
    with pytest.raises(ValueError, match="minutes"):
        write_table(tmp_path / "a.csv", [{"step": 1}, {"step": 2, "minutes": 3}])


def test_a_line_cut_short_is_left_out(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("step,value\n1,0.5\n2,0.25\n3,0.")
    assert read_table(path) == {"step": [1, 2], "value": [0.5, 0.25]}
    assert read_table(tmp_path / "missing.csv") == {}


def test_a_markdown_table_has_a_line_a_row():
    lines = markdown_table(["run", "steps"], [("a", 1), ("b", 2)]).splitlines()
    assert lines == ["| run | steps |", "| --- | --- |", "| a | 1 |", "| b | 2 |"]


def test_a_bar_in_a_cell_ends_no_cell():
    assert markdown_row(["a|b", 1]) == r"| a\|b | 1 |"


def test_what_cannot_be_read_is_named(tmp_path):
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(TableError, match="a.csv cannot be read: Is a directory"):
        read_table(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("step\n")
    assert read_table(tmp_path / "b.csv" / "metrics.csv") == {}
