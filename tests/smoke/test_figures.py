"""Figures of sweeps, as a user calls them."""

import csv
import re
import shlex
from pathlib import Path

import ceilings
import pytest

from equirl.analysis.ceilings import CEILINGS
from equirl.analysis.labels import task_name
from tests.analysis.run_folders import write_run

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "figures.md").read_text()


@pytest.fixture
def sweep(tmp_path):
    """Two variants with two seeds each, one of the runs unfinished."""
    for copies in (0, 4):
        for seed in (0, 1):
            test = [1, 1, 1, copies // 4] if copies + seed != 5 else None
            changes = {"augmentation_copies": copies, "seed": seed}
            write_run(tmp_path / "sweep" / f"{copies}-{seed}", test=test, **changes)
    return tmp_path / "sweep"


def test_picture_and_tables(here, sweep):
    code, out, err = here("figures.py", f"sweep={sweep}", "figure=12")
    assert code == 0, err
    picture = (sweep / "figure_12.png").read_bytes()
    assert picture[:4] == b"\x89PNG" and len(picture) < 200_000
    page = (sweep / "table.md").read_text()
    assert page in out and "![Figure 12: rotated copies](figure_12.png)" in page
    assert "| Block Picking | no augmentation | 2 of 2 | 75.0% ± 0.0% | 75.0% |" in page
    assert "| Block Picking | 4 copies | 1 of 2 | 100.0% | 100.0% | - | 300 |" in page
    assert "- 4-1: unfinished, at step 400 of 400" in page
    assert "- missing: Block Picking, 16 copies, seeds 0, 1" in page
    with open(sweep / "table.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["variant"] for row in rows] == ["no augmentation", "4 copies"]
    assert float(rows[0]["success"]) == 0.75 and rows[1]["low"] == "nan"


def test_without_a_figure_and_into_another_folder(here, sweep, tmp_path):
    output = tmp_path / "a" / "b"
    keys = [f"output={output}", "smoothing=100", "title=Mine"]
    code, out, err = here("figures.py", f"sweep={sweep}", *keys)
    assert code == 0, err
    assert sorted(path.name for path in output.iterdir()) == [
        *("figure_sweep.png", "table.csv", "table.md")
    ]
    page = (output / "table.md").read_text()
    assert page.startswith("# Mine\n") and "previous 100 steps" in page
    assert "0.800 ± 0.000 | 400 |" in page  # of the last episode alone
    assert "missing" not in page and not list(sweep.glob("*.png"))


def test_a_single_run_and_several_tasks(here, sweep, tmp_path):
    code, out, err = here("figures.py", f"sweep={sweep / '0-0'}", f"output={tmp_path / 'one'}")
    assert code == 0 and "| Block Picking | Equivariant SAC, D4 | 1 of 1 | 75.0% |" in out, err
    for seed in (0, 1):
        write_run(sweep / f"p{seed}", env_task="block_pushing", augmentation_copies=0, seed=seed)
    code, out, err = here("figures.py", f"sweep={sweep}")
    assert code == 0, err
    assert "| all tasks | no augmentation | 4 of 4 | 75.0% ± 0.0% |" in out
    assert "- missing: Block Pushing, 4 copies, seeds 0, 1" in out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["sweep=/nonexistent"], "sweep=/nonexistent: expected the folder of a sweep"),
        (["sweep={sweep}", "figure=17"], "figure=17: expected one of groups, 12, 13, 14, 15, 16"),
        (["sweep={sweep}", "smoothing=0"], "smoothing=0: expected 1 or more"),
        (["sweep={sweep}", "output=/proc/none"], "cannot write output=/proc/none"),
        (["sweep={sweep}", "colour=red"], "colour"),
        ([], "sweep= is missing"),
    ],
)
def test_bad_input_ends_in_a_sentence_that_names_it(here, sweep, arguments, named):
    code, _, err = here("figures.py", *(text.format(sweep=sweep) for text in arguments))
    assert code == 1 and named in err and "Traceback" not in err


def test_a_sweep_without_anything_to_draw(here, tmp_path):
    code, _, err = here("figures.py", f"sweep={tmp_path}")
    assert code == 1 and "with runs" in err
    write_run(tmp_path / "a", returns=[], success=[], test=None)
    code, _, err = here("figures.py", f"sweep={tmp_path}")
    assert code == 1 and "nothing to draw yet; a: no episode has ended, left out" in err
    for name in "bcdefg":
        write_run(tmp_path / name, returns=[], success=[], test=None)
    code, _, err = here("figures.py", f"sweep={tmp_path}")
    assert code == 1 and err.strip().endswith("; c: no episode has ended, left out; and 4 more")


def test_dollar_signs_in_folders_titles_and_values(here, tmp_path):
    for seed in (0, 1):
        write_run(tmp_path / "a$b_{$c" / f"{seed}", seed=seed, demos_file=f"$HOME/{seed}$x^")
    code, out, err = here("figures.py", f"sweep='{tmp_path / 'a$b_{$c'}'")
    assert code == 0 and "demos.file=$HOME/0$x^" in out, err
    code, out, err = here("runs.py", str(tmp_path / "a$b_{$c"), "--html", str(tmp_path / "a.html"))
    assert code == 0, err


def test_the_commands_of_the_page(here, sweep, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outputs = tmp_path / "outputs"
    for name in ("a", "b", "c"):
        write_run(outputs / "sweep" / name, group="C4" if name == "c" else "D4")
    (outputs / "experiments" / "fig12").mkdir(parents=True)
    sweep.rename(outputs / "experiments" / "fig12" / "laptop")
    commands = re.findall(r"^python experiments/(\S+) ?(.*)$", PAGE, re.MULTILINE)
    called = [name for name, _ in commands]
    assert called == [*["figures.py"] * 2, "ceilings.py", *["runs.py"] * 3, "compare.py"]
    for name, text in commands:
        arguments = shlex.split(text)
        if name == "ceilings.py":  # minutes
            continue
        if "--watch" in arguments:
            arguments = arguments[: arguments.index("--watch")]
        code, _, err = here(name, *arguments)
        assert code == 0, (name, text, err)
    assert (outputs / "figures" / "figure_sweep.png").exists()
    assert (outputs / "experiments" / "fig12" / "laptop" / "table.md").exists()
    assert (outputs / "report.html").exists() and (outputs / "comparison" / "table.md").exists()


def test_the_page_has_the_ceilings_of_the_code():
    for (task, mode), value in CEILINGS.items():
        (row,) = re.findall(rf"^\| {task_name(task)} \| (\S+) \| (\S+) \|$", PAGE, re.MULTILINE)
        assert float(row[mode == "paper"]) == value


def test_the_experts_earn_what_the_table_says(capsys):
    """Two episodes each: picking has no spread."""
    ceilings.main(["--episodes", "2", "--tasks", "block_picking"])
    lines = capsys.readouterr().out.splitlines()
    for mode in ("strict", "paper"):
        value = f"{CEILINGS['block_picking', mode]:.3f}"
        assert f"| block_picking | {mode} | {value} | 0.000 | 100.0% | 7.0 |" in lines
