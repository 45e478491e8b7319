"""The page about a sweep: whole, offline and escaped."""

import base64
import json
from html.parser import HTMLParser
from pathlib import Path

import pytest

from equirl.analysis.page import sweep_page
from equirl.analysis.runs import read_runs
from equirl.analysis.status import read_status
from tests.analysis.run_folders import write_run

_VOID = {"meta", "img", "br", "link", "input"}


class Page(HTMLParser):
    """Tags that open and close in order, their attributes and the text between."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in _VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture
def sweep(tmp_path):
    """Two runs with films, one of them large, and a failed one; names that want escaping."""
    folder = tmp_path / '<sweep> & "co"'
    for seed, size in enumerate((100, 3000)):
        run = write_run(folder / f"copies#{seed}", seed=seed)
        (run / "policy.mp4").write_bytes(bytes(size))
        session = {"versions": {"torch": "2"}, "machine": {"cores": 2 + seed}, "code": None}
        (run / "run.json").write_text(json.dumps({"sessions": [{}, session]}))
    failed = write_run(folder / "z", returns=[], success=[], test=None, seed=2)
    (failed / "failed.txt").write_text("<script>alert(1)</script>\n")
    return folder


def page_of(folder, **options):
    runs = read_runs(folder)
    labels = {run.folder: f"<{run.name}>" for run in runs}
    statuses = [read_status(run) for run in runs]
    return sweep_page(folder, statuses, labels, summary="1 < 2", **options)


def test_the_page_is_whole_and_needs_nothing_else(sweep):
    page = Page(page_of(sweep, largest_video=1000))
    text = " ".join(page.text)
    for part in ('<sweep> & "co"', "1 < 2", "Results", "75.0%", "<copies#0>", "steps to 90 %"):
        assert part in text
    assert not page.all("script") and "failed: <script>alert(1)</script>" in text
    (image,) = page.all("img")
    data = image["src"].removeprefix("data:image/png;base64,")
    assert base64.b64decode(data)[:4] == b"\x89PNG"
    for tag, attributes in page.tags:
        for name in ("src", "href"):
            source = attributes.get(name, "")
            assert not source.startswith(("http", "/")), (tag, source)


def test_films_are_embedded_up_to_a_size_and_linked_above(sweep):
    page = Page(page_of(sweep, largest_video=1000))
    (film,) = page.all("video")
    assert base64.b64decode(film["src"].removeprefix("data:video/mp4;base64,")) == bytes(100)
    links = [each["href"] for each in page.all("a")]
    assert "copies%231/policy.mp4" in links and "copies%230/report.md" in links
    other = Page(page_of(sweep, base=sweep.parent / "elsewhere", largest_video=0))
    assert not other.all("video")
    assert f"../{'%3Csweep%3E%20%26%20%22co%22'}/copies%230/policy.mp4" in [
        each["href"] for each in other.all("a")
    ]


def test_a_film_that_is_removed_while_it_is_looked_at(sweep, monkeypatch):
    """As by a run that goes on: found, and gone before it is read."""
    read, find = Path.read_bytes, Path.exists

    def gone(path):
        if path.name == "policy.mp4":
            path.unlink()
        return read(path)

    def was_there(path, **options):
        return path.name == "policy.mp4" or find(path, **options)

    monkeypatch.setattr(Path, "read_bytes", gone)
    monkeypatch.setattr(Path, "exists", was_there)
    page = Page(page_of(sweep, largest_video=10_000))
    assert not page.all("video") and "copies%230/report.md" in [
        each["href"] for each in page.all("a")
    ]


def test_each_run_has_its_curves(sweep):
    page = Page(page_of(sweep))
    lines = page.all("polyline")
    assert [line["class"] for line in lines] == ["returns", "success"] * 2
    points = [tuple(map(float, pair.split(","))) for pair in lines[1]["points"].split()]
    # Success 0, 0.5, 0.9 and 1 after 100 to 400 of 400 steps, in a drawing of 180 by 48.
    assert points == [(45.0, 48.0), (90.0, 24.0), (135.0, 4.8), (180.0, 0.0)]


def test_configuration_and_environment(sweep):
    (sweep / "copies#0" / "run.json").write_text(
        '{"sessions": [{"versions": {"torch": "2"}, "machine": {"cores": 2, "gpus": ["x", "y"]}}]}'
    )
    text = " ".join(Page(page_of(sweep)).text)
    assert "machine.gpus x, y (1), - (1)" in text
    assert "seed 0 (1), 1 (1), 2 (1)" in text and "keys that are the same in all runs" in text
    assert "Of 2 runs, in the last session of each" in text
    assert "machine.cores 2 (1), 3 (1)" in text and "versions.torch 2 " in text


def test_damaged_tables_and_records_do_not_spoil_the_page(sweep):
    (sweep / "copies#0" / "metrics.csv").write_text("step\nwhat\n")
    (sweep / "copies#0" / "run.json").write_text('{"sessions": 3}')
    (sweep / "copies#1" / "run.json").write_text("{")
    text = " ".join(Page(page_of(sweep)).text)
    assert "metrics.csv, line 2: expected numbers" in text and "Environment" not in text
    for path in Path(sweep).glob("*/metrics.csv"):
        path.unlink()
    assert "no episode has ended" in " ".join(Page(page_of(sweep)).text)
