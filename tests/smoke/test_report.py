"""The report of a run, as a user calls it."""

import csv

import pytest

from equirl.config import to_config
from equirl.training import train


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of a few steps; paper mode, whose defects the report shows."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    values = {
        "env": {"task": "block_picking", "image_size": 16, "max_steps": 12, "robot": "hand"},
        "method": {"name": "equivariant", "hidden": 8},
        "algorithm": {"name": "sac", "batch_size": 4},
        "augmentation": {"name": "buffer", "copies": 4},
        "replay": {"start": 10},
        "demos": {"episodes": 1},
        "evaluation": {"final_episodes": 1, "video_episodes": 0},
        "logging": {"progress": False},
        "mode": "paper",
        "group": "D4",
        "steps": 4,
        "threads": 1,
    }
    train(to_config(values), folder)
    return folder


def table(folder):
    with open(folder / "equivariance.csv") as file:
        return list(csv.DictReader(file))


def test_page_table_and_picture(here, folder):
    code, out, err = here("report.py", f"run={folder}", "observations=4", "angles=8")
    assert code == 0, err
    page = (folder / "equivariance.md").read_text()
    assert page in out and f"page: {folder / 'equivariance.md'}" in out
    assert "D4-equivariant SAC (paper mode)" in page and "after 4 steps" in page
    for row in (
        "| log-probability | replay, after |",
        "| Q | random, before |",
        "| encoder.layers.0",
    ):
        assert row in page
    assert (folder / "equivariance.png").read_bytes()[:4] == b"\x89PNG"
    rows = table(folder)
    assert {row["network"] for row in rows} == {"policy", "critic"}
    ends = [row for row in rows if row["name"] == "mean" and row["level"] == "end to end"]
    assert len(ends) == 2 * 2 * 16  # random and replay, before and after, turns and reflections
    for row in ends:
        if row["kind"] == "quarter turns":
            assert float(row["max"]) < 1e-4
        elif row["kind"] == "reflections of the grid":
            assert float(row["max"]) > 1e-4  # of theta
    before, after = (
        [row["mean"] for row in ends if row["training"] == stage] for stage in ("before", "after")
    )
    assert before != after


def test_the_papers_theta_and_another_group_and_folder(here, folder, tmp_path):
    output = tmp_path / "new" / "page"
    keys = ["observations=2", "angles=2", "keep_theta=true", "group=c8", "layers=false"]
    keys.append(f"output={output}")
    code, out, err = here("report.py", f"run={folder}", *keys)
    assert code == 0, err
    assert "C8, 8 elements, 2 observations, actions trivial + vector + trivial + trivial." in out
    assert {row["level"] for row in table(output)} == {"end to end"} and "| layer |" not in out
    assert len({row["angle"] for row in table(output)}) == 8
    assert {row["reflected"] for row in table(output)} == {"False"}


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["group=so3"], "group=so3: unknown symmetry group"),
        (["observations=0"], "observations=0: expected 1 or more"),
        (["angles=0"], "angles=0: expected 1 or more"),
        (["output=/proc/none"], "cannot write output=/proc/none"),
        (["device=cuda:7"], "cuda:7"),
        (["colour=red"], "colour"),
    ],
)
def test_bad_input_ends_in_a_sentence_that_names_it(here, folder, arguments, named):
    code, _, err = here("report.py", f"run={folder}", *arguments)
    assert code == 1 and named in err and "Traceback" not in err


def test_only_writing_is_called_trouble_with_the_disk(here, folder, monkeypatch):
    def fails(*args, **kwargs):
        raise OSError("no library here")

    monkeypatch.setattr("equirl.symmetry.equivariance_report", fails)
    with pytest.raises(OSError, match="no library here"):
        here("report.py", f"run={folder}", "observations=1", "angles=1")


def test_a_folder_without_a_run(here, tmp_path):
    code, _, err = here("report.py", f"run={tmp_path}")
    assert code == 1 and "not the folder of a run" in err
    code, _, err = here("report.py")
    assert code == 1 and "run" in err and "Traceback" not in err
