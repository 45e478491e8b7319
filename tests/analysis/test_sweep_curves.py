"""What a figure of a sweep shows: the numbers of its sweep, and texts that can be read."""

import numpy as np
import pytest

from equirl.analysis import collect, draw_sweep, plot_sweep, read_runs, summarise
from equirl.analysis.ceilings import CEILINGS
from equirl.analysis.curves import plot_runs
from equirl.analysis.pictures import COLOURS, DASHES, pyplot
from tests.analysis.run_folders import write_run

LABEL = "Equivariant SAC, D4"
TESTS = [[1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0], [1, 0, 0, 0]]


@pytest.fixture
def draw(tmp_path):
    """Draws what a test has written, and lays it out as saving does."""

    def call(**options):
        sweep = collect(read_runs(tmp_path))
        figure = draw_sweep(sweep, **options)
        figure.canvas.draw()
        return figure, sweep

    yield call
    pyplot().close("all")


def texts_of(figure):
    """All texts of the legend, and the title."""
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()], figure.get_suptitle()


def assert_inside(figure):
    """Nothing is cut, and panels do not lie over one another's titles or the legend."""
    renderer, whole = figure.canvas.get_renderer(), figure.bbox
    boxes = [legend.get_window_extent(renderer) for legend in figure.legends]
    boxes += [axes.get_tightbbox(renderer) for axes in figure.axes]
    boxes += [text.get_window_extent(renderer) for text in figure.texts]
    for box in boxes:
        assert whole.x0 <= box.x0 and box.x1 <= whole.x1, (box, whole)
        assert whole.y0 <= box.y0 and box.y1 <= whole.y1, (box, whole)
    for n, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[n + 1 :])


def test_lines_bands_and_bars_are_the_numbers_of_the_sweep(draw, tmp_path):
    for seed, test in enumerate(TESTS):
        returns = [0.1 * seed, 0.2, 0.4 + 0.1 * seed, 0.8]
        write_run(tmp_path / f"{seed}", seed=seed, test=test, returns=returns)
    write_run(tmp_path / "late", seed=4, test=None, returns=[0.2, 0.3], success=[0.1])
    figure, sweep = draw(window=200)
    above, below, final = figure.axes
    mean, *ahead, ceiling = above.get_lines()
    curve = sweep.returns("block_picking", LABEL, 200)
    np.testing.assert_allclose(mean.get_xydata(), np.stack([curve.steps, curve.mean], axis=1))
    for line, (steps, values) in zip(ahead, sweep.ahead("block_picking", LABEL, 200), strict=True):
        np.testing.assert_allclose(line.get_xydata(), np.stack([steps, values], axis=1))
        assert line.get_linewidth() < mean.get_linewidth()
    assert set(ceiling.get_ydata()) == {CEILINGS["block_picking", "strict"]}
    (band,) = above.collections
    corners = band.get_paths()[0].vertices
    for side in (curve.mean - curve.error, curve.mean + curve.error):
        for corner in zip(curve.steps, side, strict=True):
            assert np.isclose(corners, corner).all(axis=1).any(), corner
    success = sweep.success("block_picking", LABEL)
    np.testing.assert_allclose(below.get_lines()[0].get_ydata(), success.mean)
    (bar,), (summary,) = final.patches, summarise(sweep)
    assert 0 < summary.low < summary.high <= 1 and summary.iqm != summary.success
    assert bar.get_x() == pytest.approx(summary.low)
    assert bar.get_width() == pytest.approx(summary.high - summary.low)
    (stroke,) = final.get_lines()
    assert set(stroke.get_xdata()) == {summary.iqm}
    assert texts_of(figure) == ([f"{LABEL} (5 seeds)", "expert"], "Block Picking")


def test_a_variant_with_more_finished_runs_of_one_task_is_unfinished(draw, tmp_path):
    for seed in range(2):
        for group in ("C4", "D4"):
            test = [1] if group == "C4" or seed == 0 else None
            write_run(tmp_path / f"p{group}{seed}", group=group, seed=seed)
            changes = {"env_task": "block_pushing", "group": group, "seed": seed}
            write_run(tmp_path / f"q{group}{seed}", test=test, **changes)
    figure, _ = draw()
    final = figure.axes[-1]
    places = {text.get_text(): text.get_position()[1] for text in final.texts}
    assert places == {"88%": 0, "unfinished": -1} and len(final.patches) == 1
    assert [axes.get_title() for axes in figure.axes[::2]] == [
        *("Block Picking", "Block Pushing", "success on test scenes")
    ]


def test_variants_are_told_apart_by_numbers_and_by_lines(draw, tmp_path):
    kinds = len(COLOURS) * len(DASHES)
    assert kinds == 40  # as docs/figures.md says
    for copies in range(kinds):
        write_run(tmp_path / f"{copies}", augmentation_copies=copies, returns=[0.5, 0.5])
    figure, sweep = draw()
    labels, _ = texts_of(figure)
    assert labels[:2] == ["1: no augmentation (1 seed)", "2: 1 copy (1 seed)"]
    assert labels[39:] == ["40: 39 copies (1 seed)", "expert"]
    final = figure.axes[-1]
    rows = dict(zip(final.get_yticks(), final.get_yticklabels(), strict=True))
    strokes = zip(final.get_lines(), figure.legends[0].get_lines(), strict=False)
    for number, (stroke, sample) in enumerate(strokes, start=1):
        assert rows[np.mean(stroke.get_ydata())].get_text() == str(number)
        assert stroke.get_color() == sample.get_color()
    looks = {(line.get_color(), str(line._dash_pattern)) for line in figure.axes[0].get_lines()}
    assert len(looks) == kinds + 1  # and the expert's
    assert sweep.remarks == []
    assert_inside(figure)
    write_run(tmp_path / "more", augmentation_copies=kinds)
    (remark,) = collect(read_runs(tmp_path)).remarks
    assert remark == "41 variants: from 41 on their lines look as those from 1 on"


@pytest.mark.parametrize("test", [None, [1, 0]])
def test_long_labels_and_titles_are_not_cut(draw, tmp_path, test):
    for name in ("a", "b"):
        write_run(tmp_path / name, demos_file="demonstrations_of_a_robot/" * 30 + name, test=test)
    figure, _ = draw(title="a very long title of many words " * 6)
    labels, title = texts_of(figure)
    for label, name in zip(labels[:2], ("a", "b"), strict=True):
        assert "demos.file=demo" in label and "…" in label and f"{name} (1 seed)" in label
    assert title.count("\n") >= 1 and title.endswith("Block Picking")
    assert_inside(figure)
    figure, _ = draw(title="x" * 3000)
    assert texts_of(figure)[1].endswith("…")
    assert_inside(figure)


def test_dollar_signs_are_letters(draw, tmp_path):
    title, sign = "costs $a_{ and $b^", "$\\frac$"
    write_run(tmp_path / "a", env_task="my:$x_{$", method_name=sign)
    write_run(tmp_path / "b", env_task="block_picking", method_name=sign)
    figure, sweep = draw(title=title)
    plot_sweep(sweep, tmp_path / "sweep.png", title=title)
    plot_runs({sign: [tmp_path / "a"]}, tmp_path / "runs.png", title=title)
    labels, _ = texts_of(figure)  # drawn as formulas they end in an error
    assert labels[0].replace("\\$", "$") == f"{sign} SAC, D4 (1 seed)"
    assert_inside(figure)


def test_exponents_of_logarithmic_axes_are_formulas():
    _, axes = pyplot().subplots()
    axes.set(yscale="log", ylim=(1e-4, 1))
    label = axes.get_yticklabels()[0]
    assert "10^" in label.get_text() and label.get_parse_math()
    pyplot().close("all")
