"""A page about a sweep that opens without a network: figures, tables, films, differences."""

from __future__ import annotations

import base64
import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from html import escape
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

import numpy as np

from equirl.analysis.labels import differing_keys, listed, task_name
from equirl.analysis.runs import METRICS, REPORT, VALIDATION, VIDEO, flatten
from equirl.analysis.statistics import moving_return
from equirl.analysis.status import Status
from equirl.analysis.summary import COLUMNS, summarise
from equirl.analysis.sweep import Figure, collect
from equirl.analysis.sweep_curves import plot_sweep
from equirl.analysis.tables import TableError, read_table

__all__ = ["sweep_page"]

#: Bytes of all films together that a page takes; those after them are linked.
_ALL_VIDEOS = 20_000_000

#: Of `run.json`: what the last session of a run was trained with.
_RECORD, _ENVIRONMENT = "run.json", ("versions", "code", "machine", "computing")

#: Of the small curves, where the page's style does not reach them.
_PEN = 'fill="none" stroke-width="1.6" vector-effect="non-scaling-stroke"'
_STROKES = {"returns": "#0b6e99", "success": "#448361"}

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { color-scheme: light dark; --text: #1f2428; --soft: #5b6770; --line: #d5dade;
  --back: #ffffff; --card: #f5f7f8; --returns: #0b6e99; --success: #448361; }
@media (prefers-color-scheme: dark) { :root { --text: #e4e7ea; --soft: #9aa5ae; --line: #3a4249;
  --back: #16191c; --card: #1f2428; --returns: #58b4dd; --success: #7fc29b; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--text); background: var(--back);
  max-width: 1280px; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.5rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
p.soft, caption, figcaption { color: var(--soft); text-align: left; }
.wide { overflow-x: auto; } td:nth-child(n+4) { white-space: nowrap; }
table { border-collapse: collapse; font-size: 0.88rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 0.3rem 0.9rem 0.3rem 0; vertical-align: middle;
  border-bottom: 1px solid var(--line); }
th { color: var(--soft); font-weight: 600; white-space: nowrap; }
figure { margin: 1rem 0; } figure img { max-width: 100%; background: #fff; border-radius: 6px; }
.running { color: var(--returns); font-weight: 600; } .failed { color: #c4453a; }
.stopped, .waiting { color: var(--soft); }
svg { width: 180px; height: 48px; background: var(--card); border-radius: 4px; display: block; }
.returns { stroke: var(--returns); color: var(--returns); }
.success { stroke: var(--success); color: var(--success); }
video { width: 220px; border-radius: 4px; display: block; }
a { color: var(--returns); } details { margin: 0.6rem 0; } summary { cursor: pointer; }
</style>
</head>
<body>
<h1>$title</h1>
<p class="soft">$summary</p>
$sections
</body>
</html>
""")


def sweep_page(
    folder: Path,
    statuses: Sequence[Status],
    labels: Mapping[Path, str],
    *,
    summary: str = "",
    figure: Figure | None = None,
    base: Path | None = None,
    largest_video: int = 300_000,
) -> str:
    """Returns the page in HTML.

    Args:
        folder: The sweep's folder.
        statuses: Of its runs.
        labels: What each run's folder is called.
        summary: How far the sweep is, in a sentence.
        figure: The figure of the paper that the sweep is for.
        base: The folder that the page is written to, which its links start from; the sweep's
            when None.
        largest_video: Bytes of a film that is put into the page; a larger one is linked.
    """
    base = base or folder
    runs = [status.run for status in statuses]
    sweep = collect(runs, figure)
    title = figure.title if figure else folder.resolve().name
    sections = []
    if sweep.cells:
        with TemporaryDirectory() as place:
            picture = Path(place, "figure.png")
            plot_sweep(sweep, picture, title=title)
            data = _data("image/png", picture)
        caption = (
            "Mean over runs where all of them have data; shading: standard error; thin: runs that "
            "are further than the others; dashed: the expert. Right: interquartile mean of the "
            "success on test scenes, with its stratified bootstrap interval at 95 %."
        )
        sections += [
            f'<figure><img src="{data}" alt="Learning curves"><figcaption>{caption}</figcaption>'
            "</figure>",
            "<h2>Results</h2>",
            _table(COLUMNS, ([escape(cell) for cell in line.cells()] for line in summarise(sweep))),
        ]
    if sweep.remarks:
        lines = "".join(f"<li>{escape(remark)}</li>" for remark in sweep.remarks)
        sections += ["<h2>Missing, unfinished or damaged</h2>", f"<ul>{lines}</ul>"]
    sections += [
        "<h2>Runs</h2>",
        '<p class="soft">Curves from step 0 to the last, from 0 to 1: <span class="returns">'
        'discounted return over the previous 500 steps</span>, <span class="success">greedy '
        "success</span>. Success in the table is that of the last validation, or on the test "
        "scenes of a finished run.</p>",
        _table(
            ("run", "what", "state", "steps", "return", "success", "curves", "film"),
            _run_rows(statuses, labels, base, largest_video),
        ),
        "<h2>Configuration</h2>",
        *_configuration([run.keys for run in runs if run.keys]),
        *_environment([run.folder for run in runs]),
    ]
    return _PAGE.substitute(
        title=escape(title), summary=escape(summary), sections="\n".join(sections)
    )


def _run_rows(
    statuses: Sequence[Status], labels: Mapping[Path, str], base: Path, largest: int
) -> Iterator[list[str]]:
    embedded = 0
    for status in statuses:
        run = status.run
        report, film = run.folder / REPORT, run.folder / VIDEO
        name = escape(run.name)
        shown = ""
        with suppress(OSError):  # none; a run that goes on removes its own at any moment
            size = film.stat().st_size
            if size <= largest and embedded + size <= _ALL_VIDEOS:
                source = _data("video/mp4", film)
                embedded += size
                shown = f'<video controls preload="none" src="{source}"></video>'
            else:
                shown = f'<a href="{_link(film, base)}">{size / 1e6:.1f} MB</a>'
        reason = f": {status.reason}" if status.reason else ""
        yield [
            f'<a href="{_link(report, base)}">{name}</a>' if report.exists() else name,
            escape(labels.get(run.folder, "")),
            f'<span class="{status.state}">{escape(status.state + reason)}</span>',
            f"{status.step:,} of {run.steps:,}",
            "-" if status.last_return is None else f"{status.last_return:.2f}",
            "-" if status.success is None else f"{status.success:.0%}",
            _curves(status),
            shown,
        ]


def _curves(status: Status) -> str:
    """Return and success of a run as a small drawing."""
    folder, width = status.run.folder, max(status.run.steps, status.step, 1)
    try:
        metrics = read_table(folder / METRICS, ["step", "discounted_return"])
        validation = read_table(folder / VALIDATION, ["step", "success_rate"])
    except TableError as error:
        return escape(str(error))
    lines = []
    if metrics:
        ends = np.array(metrics["step"], dtype=float)
        grid = np.linspace(ends[0], ends[-1], 60)
        returns = moving_return(ends, np.array(metrics["discounted_return"]), at=grid)
        lines.append(_polyline("returns", grid / width, returns))
    if validation:
        rates = np.array(validation["success_rate"])
        lines.append(_polyline("success", np.array(validation["step"]) / width, rates))
    if not lines:
        return ""
    drawing = 'viewBox="0 -4 180 56" preserveAspectRatio="none" role="img"'
    return f"<svg {drawing}><title>return and success</title>{''.join(lines)}</svg>"


def _polyline(name: str, across: np.ndarray, height: np.ndarray) -> str:
    """A line through points of the unit square; those that are no numbers are left out."""
    known = ~np.isnan(height)
    points = zip(180 * across[known], 48 - 48 * np.clip(height[known], 0, 1), strict=True)
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline class="{name}" points="{path}" {_PEN} stroke="{_STROKES[name]}"/>'


def _configuration(configs: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The keys that differ, each with its values, and those that all runs share."""
    differing = differing_keys(configs)
    if differing:
        rows = ([f"<code>{escape(name)}</code>", _values(configs, name)] for name in differing)
        yield _table(("key", "values"), rows)
    if configs:
        shared = [name for name in configs[0] if name not in differing]
        rows = ([f"<code>{escape(name)}</code>", escape(str(configs[0][name]))] for name in shared)
        yield _details(f"{len(shared)} keys that are the same in all runs", ("key", "value"), rows)


def _environment(folders: Sequence[Path]) -> Iterator[str]:
    """Versions, code and machine of the runs' last sessions, where they were recorded."""
    records = []
    for folder in folders:
        try:
            session = json.loads((folder / _RECORD).read_text())["sessions"][-1]
            told = flatten({name: session.get(name) for name in _ENVIRONMENT})
            records.append({name: _joined(value) for name, value in told})
        except (OSError, ValueError, TypeError, LookupError, AttributeError):
            continue  # older than the record, or not begun
    if not records:
        return
    names = dict.fromkeys(name for record in records for name in record)
    rows = ([f"<code>{escape(name)}</code>", _values(records, name)] for name in names)
    yield "<h2>Environment</h2>"
    text = f"Of {len(records)} runs, in the last session of each"
    yield _details(text, ("what", "values"), rows)


def _values(configs: Sequence[Mapping[str, Any]], name: str) -> str:
    """The values of a key, with the number of runs that have each unless it is the same."""
    counts = Counter(str(config.get(name, "-")) for config in configs)
    if len(counts) == 1:
        return escape(next(iter(counts)))
    shown = [
        f"{task_name(value) if name == 'env.task' else value} ({count})"
        for value, count in counts.most_common()
    ]
    return escape(listed(shown, 12))


def _joined(value: object) -> object:
    """A list in words."""
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else value


def _table(headings: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of cells that are HTML already."""
    head = "".join(f"<th>{escape(name)}</th>" for name in headings)
    body = "\n".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{head}</tr>\n{body}\n</table></div>'


def _details(text: str, headings: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    return f"<details><summary>{escape(text)}</summary>{_table(headings, rows)}</details>"


def _data(kind: str, path: Path) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _link(path: Path, base: Path) -> str:
    return escape(quote(Path(os.path.relpath(path, base)).as_posix()))
