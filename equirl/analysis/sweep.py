"""The runs of a sweep by task and variant: what their tables hold, and their mean curves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from equirl.analysis.labels import TASKS, between_tasks, group_variants, task_name, variant_label
from equirl.analysis.pictures import COLOURS, DASHES
from equirl.analysis.runs import METRICS, TEST, VALIDATION, Run
from equirl.analysis.statistics import mean_and_error, moving_return
from equirl.analysis.tables import TableError, read_table

__all__ = ["FIGURES", "Curve", "Figure", "RunTables", "Sweep", "collect"]


@dataclass(frozen=True)
class Figure:
    """A figure of the paper.

    Attributes:
        title: Above it.
        key: The key that differs among its variants.
        values: Those of the key.
    """

    title: str
    key: str
    values: tuple[str | int, ...]


_METHODS = ("equivariant", "cnn", "drq", "rad", "ferm")

#: The paper's simulation figures: appendices F, G and H, and its comparison of groups.
FIGURES = {
    "groups": Figure("Symmetry groups", "group", ("C4", "C8", "D4", "D8", "SO2", "O2")),
    "12": Figure("Figure 12: rotated copies", "augmentation.copies", (0, 2, 4, 8, 16)),
    "13": Figure("Figure 13: demonstrations", "demos.episodes", (0, 10, 20, 40)),
    "14": Figure("Figure 14: SAC and SACfD", "algorithm.name", ("sac", "sacfd")),
    "15": Figure("Figure 15: against CNN baselines, SAC", "method.name", _METHODS),
    "16": Figure("Figure 16: against CNN baselines, SACfD", "method.name", _METHODS),
}


@dataclass(frozen=True)
class Curve:
    """Mean over runs, where all of them have data.

    Attributes:
        steps: Environment steps, shape (S,).
        mean: Shape (S,).
        error: Standard error of the mean, shape (S,); NaN for a single run.
        runs: How many runs it is the mean of.
    """

    steps: np.ndarray
    mean: np.ndarray
    error: np.ndarray
    runs: int


@dataclass(frozen=True)
class RunTables:
    """A run and the columns of its tables that figures are made of.

    Attributes:
        run: The folder.
        steps: Step at which each training episode ended, shape (E,).
        returns: Its discounted return, shape (E,).
        validation_steps: Steps of the validations, shape (V,).
        validation_success: Their success rates, shape (V,).
        test_success: Success rate on the test scenes; None before they are played, or if their
            table is damaged.
    """

    run: Run
    steps: np.ndarray
    returns: np.ndarray
    validation_steps: np.ndarray
    validation_success: np.ndarray
    test_success: float | None

    @property
    def end(self) -> float:
        """The step up to which its curve is known: the last of a finished run is."""
        last = float(self.steps[-1]) if len(self.steps) else 0.0
        return max(last, float(self.run.steps)) if self.test_success is not None else last


@dataclass(frozen=True)
class Sweep:
    """Runs by task and variant.

    Attributes:
        cells: The tables of the runs of each task's key and variant's label, by seed and one a
            seed; those of runs that have begun.
        remarks: What is missing, unfinished, damaged or there twice, a sentence each.
    """

    cells: Mapping[tuple[str, str], Sequence[RunTables]]
    remarks: Sequence[str]

    @property
    def tasks(self) -> list[str]:
        """The tasks' keys."""
        return list(dict.fromkeys(task for task, _ in sorted(self.cells, key=_task_place)))

    @property
    def variants(self) -> list[str]:
        """The variants' labels, in the order of a legend."""
        return list(dict.fromkeys(variant for _, variant in self.cells))

    def returns(self, task: str, variant: str, window: int = 500) -> Curve | None:
        """Behaviour return over the previous ``window`` steps, ten points a window or run.

        Returns:
            None where no step has data of all runs.
        """
        tables = self.cells.get((task, variant), ())
        if not tables:
            return None
        end = min(each.end for each in tables)
        grid = _grid(end, window)
        rows = [moving_return(each.steps, each.returns, window, grid) for each in tables]
        return _curve(grid, np.array(rows))

    def ahead(
        self, task: str, variant: str, window: int = 500
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """What `returns` leaves out: the curves of single runs, from where another one ends.

        Yields:
            Steps and returns, shape (S,) each.
        """
        tables = self.cells.get((task, variant), ())
        common = min((each.end for each in tables), default=0.0)
        for each in tables:
            if each.end > common:
                grid = _grid(each.end, window)
                grid = grid[max(np.searchsorted(grid, common, side="right") - 1, 0) :]
                yield grid, moving_return(each.steps, each.returns, window, grid)

    def success(self, task: str, variant: str) -> Curve | None:
        """Greedy success on the validation scenes, at the steps at which all runs have one.

        Returns:
            None where there is no such step, as long as a run has had no validation.
        """
        tables = self.cells.get((task, variant), ())
        if not tables:
            return None
        # Of a step that stands twice, the later rate.
        rates = [
            dict(zip(each.validation_steps, each.validation_success, strict=True))
            for each in tables
        ]
        shared = sorted(set.intersection(*map(set, rates)))
        return _curve(np.array(shared), np.array([[own[step] for step in shared] for own in rates]))

    def success_ahead(self, task: str, variant: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """What `success` leaves out: of each run, from the last validation that all have.

        Yields:
            Steps and success rates, shape (V,) each.
        """
        curve = self.success(task, variant)
        last = curve.steps[-1] if curve else -np.inf
        for each in self.cells.get((task, variant), ()):
            later = each.validation_steps >= last
            if np.count_nonzero(each.validation_steps > last):
                yield each.validation_steps[later], each.validation_success[later]

    def test(self, task: str, variant: str) -> list[float]:
        """Success on the test scenes of each finished run."""
        tables = self.cells.get((task, variant), ())
        return [each.test_success for each in tables if each.test_success is not None]


def collect(runs: Sequence[Run], figure: Figure | None = None) -> Sweep:
    """Reads the tables of runs, those that are still written included.

    A run that cannot be read, or has not ended an episode, is left out and told of. So are the
    runs of a variant that repeat a seed, but for the one that is furthest: they are no further
    evidence.

    Args:
        runs: Those of a sweep.
        figure: The figure of the paper they are for: what its variants are called, even while
            one alone has begun, and which are missing.
    """
    remarks = [run.damage or f"{run.name}: not begun" for run in runs if not run.keys]
    cells: dict[tuple[str, str], list[RunTables]] = {}
    known = [run for run in runs if run.keys]
    variants = group_variants(known, [figure.key] if figure else [])
    for variant, members in variants.items():
        begun: dict[tuple[str, int], list[RunTables]] = {}
        for run in sorted(members, key=lambda run: (_task_place((run.task, "")), _seed(run))):
            tables = _read(run, remarks)
            if tables:
                begun.setdefault((run.task, _seed(run)), []).append(tables)
        for (task, seed), repeated in begun.items():
            # Of two that are as far, the finished one.
            kept = max(repeated, key=lambda each: (each.end, each.test_success is not None))
            cells.setdefault((task, variant), []).append(kept)
            for each in repeated:
                if each is not kept:
                    remarks.append(
                        f"{each.run.name}: left out, {kept.run.name} is of the same variant with "
                        f"seed {seed}, too, and as far or further"
                    )
                elif each.test_success is None:
                    at = f"at step {each.steps[-1]:.0f}"
                    remarks.append(f"{each.run.name}: unfinished, {at} of {each.run.steps}")
    missing, uneven = _missing(known, variants, figure), between_tasks(variants)
    return Sweep(cells, [*remarks, *missing, *uneven, *_too_many(cells)])


def _read(run: Run, remarks: list[str]) -> RunTables | None:
    """The tables of a run; what is damaged is left out and told in a remark."""
    try:
        metrics = read_table(run.folder / METRICS, ["step", "discounted_return"])
        validation = read_table(run.folder / VALIDATION, ["step", "success_rate"])
    except TableError as error:
        remarks.append(f"{error}: the run is left out")
        return None
    if not metrics:
        remarks.append(f"{run.name}: no episode has ended, left out")
        return None
    try:
        test = read_table(run.folder / TEST, ["success"]) if run.is_finished else {}
    except TableError as error:
        remarks.append(f"{error}: the run counts as unfinished")
        test = {}
    success = test.get("success", [])
    return RunTables(
        run,
        np.array(metrics["step"], dtype=float),
        np.array(metrics["discounted_return"], dtype=float),
        np.array(validation.get("step", []), dtype=float),
        np.array(validation.get("success_rate", []), dtype=float),
        sum(success) / len(success) if success else None,
    )


def _grid(end: float, window: int) -> np.ndarray:
    """The steps at which curves up to ``end`` are evaluated."""
    spacing = max(1, min(window // 10, int(end) // 10))
    return np.arange(spacing, end + 1, spacing)


def _curve(steps: np.ndarray, rows: np.ndarray) -> Curve | None:
    """The mean of rows, shape (runs, S), at the steps where none is NaN."""
    whole = ~np.isnan(rows).any(axis=0)
    if not whole.any():
        return None
    mean, error = mean_and_error(rows[:, whole])
    return Curve(steps[whole], mean, error, len(rows))


def _too_many(cells: Iterable[tuple[str, str]]) -> list[str]:
    """What a figure of more variants than there are kinds of lines asks its reader to bear."""
    count, kinds = len({variant for _, variant in cells}), len(COLOURS) * len(DASHES)
    if count <= kinds:
        return []
    return [f"{count} variants: from {kinds + 1} on their lines look as those from 1 on"]


def _missing(
    runs: Sequence[Run], variants: Mapping[str, Sequence[Run]], figure: Figure | None
) -> list[str]:
    """What the tasks and seeds that have begun lack to be even."""
    seeds = sorted({_seed(run) for run in runs})
    lacking: dict[str, list[str]] = {}
    expected = _expected(runs, variants, figure)
    for task in dict.fromkeys(run.task for run in runs):
        for variant, members in expected.items():
            there = {_seed(run) for run in members if run.task == task}
            absent = [str(seed) for seed in seeds if seed not in there]
            if absent:
                name = f"{task_name(task)}, {variant}"
                lacking[name] = absent
    return [
        f"missing: {name}, seed{'s' if len(absent) > 1 else ''} {', '.join(absent)}"
        for name, absent in lacking.items()
    ]


def _expected(
    runs: Sequence[Run], variants: Mapping[str, Sequence[Run]], figure: Figure | None
) -> dict[str, Sequence[Run]]:
    """Runs by variant, without any for variants of the figure that have not begun."""
    grouped = dict(variants)
    if figure and runs:
        begun = {str(run.keys.get(figure.key)) for run in runs}
        for value in figure.values:
            if str(value) not in begun:
                keys = {**runs[0].keys, figure.key: value}
                grouped.setdefault(variant_label(keys, [figure.key]), [])
    return grouped


def _seed(run: Run) -> int:
    seed = run.keys.get("seed")
    return seed if isinstance(seed, int) else 0


def _task_place(cell: tuple[str, str]) -> tuple[int, str]:
    """The paper's order of tasks, others after them."""
    task = cell[0]
    return (TASKS.index(task) if task in TASKS else len(TASKS)), task
