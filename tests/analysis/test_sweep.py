"""Sweeps: mean curves, the final table, what is missing; all numbers by hand."""

import numpy as np
import pytest

from equirl.analysis.ceilings import CEILINGS, expert_ceiling
from equirl.analysis.labels import TASKS
from equirl.analysis.runs import planned_runs, read_runs
from equirl.analysis.summary import summarise
from equirl.analysis.sweep import FIGURES, collect
from tests.analysis.run_folders import write_run

LABEL = "Equivariant SAC, D4"


def test_mean_and_error_over_seeds(tmp_path):
    write_run(tmp_path / "a", returns=[0.2, 0.4, 0.6, 0.8])
    write_run(tmp_path / "b", returns=[0.4, 0.4, 0.2, 0.8], success=[0, 0.1, 0.7, 1.0], seed=1)
    sweep = collect(read_runs(tmp_path))
    assert (sweep.tasks, sweep.variants, sweep.remarks) == (["block_picking"], [LABEL], [])
    curve = sweep.returns("block_picking", LABEL, window=200)
    at = {step: n for n, step in enumerate(curve.steps)}
    assert curve.steps[0] == 100 and curve.steps[-1] == 400 and curve.runs == 2
    # At 300: means of the second and third episode, 0.5 and 0.3.
    assert curve.mean[at[300]] == pytest.approx(0.4)
    assert curve.error[at[300]] == pytest.approx(0.1)
    success = sweep.success("block_picking", LABEL)
    np.testing.assert_allclose(success.mean, [0, 0.3, 0.8, 1.0])
    np.testing.assert_allclose(success.error, [0, 0.2, 0.1, 0])
    assert not [*sweep.ahead("block_picking", LABEL)]
    assert not [*sweep.success_ahead("block_picking", LABEL)]


def test_a_mean_is_drawn_where_all_seeds_have_data(tmp_path):
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", returns=[0.2, 0.2], success=[0.0], test=None, seed=1)
    sweep = collect(read_runs(tmp_path))
    curve = sweep.returns("block_picking", LABEL)
    assert curve.steps[-1] == 200 and curve.runs == 2
    assert sweep.success("block_picking", LABEL).steps.tolist() == [100]
    ((steps, returns),) = sweep.ahead("block_picking", LABEL)
    assert steps[0] == 200 and steps[-1] == 400  # without a gap
    assert returns[-1] == pytest.approx(0.5)  # of the run that is further: all its episodes
    ((steps, rates),) = sweep.success_ahead("block_picking", LABEL)
    assert (steps.tolist(), rates.tolist()) == ([100, 200, 300, 400], [0, 0.5, 0.9, 1])
    assert sweep.remarks == ["b: unfinished, at step 200 of 400"]
    (line,) = summarise(sweep)
    assert (line.runs, line.finished, line.step) == (2, 1, 200)
    assert line.success == 0.75 and np.isnan(line.error) and np.isnan(line.low)


def test_a_run_without_a_validation_has_no_part_in_a_mean_of_others(tmp_path):
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", returns=[0.2], success=[], test=None, seed=1)
    sweep = collect(read_runs(tmp_path))
    assert sweep.success("block_picking", LABEL) is None
    ((steps, rates),) = sweep.success_ahead("block_picking", LABEL)
    assert (steps.tolist(), rates.tolist()) == ([100, 200, 300, 400], [0, 0.5, 0.9, 1])


def test_of_a_seed_twice_in_a_variant_the_run_that_is_further_counts(tmp_path):
    """As after ``steps=400`` and then ``steps=800`` in a folder of its own."""
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", seed=1)
    far = {"returns": [0.1] * 6, "success": [0.0] * 6, "test": None, "steps": 800}
    write_run(tmp_path / "c", **far)
    write_run(tmp_path / "d", returns=[0.5], test=None, seed=1)
    write_run(tmp_path / "e", env_task="block_pushing")  # another task is no repetition
    sweep = collect(read_runs(tmp_path))
    names = [each.run.name for each in sweep.cells["block_picking", LABEL]]
    assert names == ["c", "b"] and ("block_pushing", LABEL) in sweep.cells
    assert sweep.remarks[:3] == [
        "a: left out, c is of the same variant with seed 0, too, and as far or further",
        "c: unfinished, at step 600 of 800",
        "d: left out, b is of the same variant with seed 1, too, and as far or further",
    ]
    assert summarise(sweep)[0].runs == 2


def test_the_final_table(tmp_path):
    outcomes = [[1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 0, 0], [0, 0, 0, 0]]
    for seed, outcome in enumerate(outcomes):
        write_run(tmp_path / f"p{seed}", test=outcome, seed=seed)
        never = {"success": [0.1, 0.2, 0.3, 0.4]} if seed else {}
        write_run(tmp_path / f"q{seed}", test=[1], seed=seed, env_task="block_pushing", **never)
    picking, pushing, both = summarise(collect(read_runs(tmp_path)))
    assert (picking.task, pushing.task, both.task) == (
        "Block Picking", "Block Pushing", "all tasks"
    )  # fmt: skip
    assert picking.success == pytest.approx((1 + 0.75 + 0.5) / 4)
    deviations = np.array([0.4375, 0.1875, -0.0625, -0.5625])
    error = np.sqrt((deviations**2).sum() / 3 / 4)
    assert picking.error == pytest.approx(error)
    assert picking.iqm == pytest.approx(0.625)  # of 0.75 and 0.5
    assert picking.low <= 0.25 and 0.8 <= picking.high <= 1
    assert (picking.reached, picking.steps_to_90) == (4, 300)
    assert pushing.reached == 1 and np.isnan(pushing.steps_to_90)
    assert both.finished == 8 and both.success == pytest.approx((0.5625 + 1) / 2)
    assert both.error == pytest.approx(error / 2)
    assert both.iqm == pytest.approx((0.75 + 1 + 1 + 1) / 4)
    assert both.cells()[6] == "5 of 8 runs" and pushing.cells()[6] == "1 of 4 runs"
    assert picking.cells()[3] == f"56.2% ± {error:.1%}" and picking.cells()[6] == "300"


def test_steps_to_90_are_a_median_in_which_never_is_late(tmp_path):
    curves = [[0.9, 1, 1, 1], [0, 0.9, 1, 1], [0, 0, 0.95, 1], [0, 0, 0, 0]]
    for seed, success in enumerate(curves):
        write_run(tmp_path / f"a{seed}", seed=seed, success=success)
        later = success if seed < 2 else [0.0] * 4
        write_run(tmp_path / f"b{seed}", seed=seed, success=later, env_task="block_pushing")
    picking, pushing, _ = summarise(collect(read_runs(tmp_path)))
    assert picking.steps_to_90 == 300 and picking.cells()[6] == "300 (3 of 4 runs)"
    assert np.isnan(pushing.steps_to_90) and pushing.reached == 2


def test_collapses_are_counted_over_runs_and_tasks(tmp_path):
    write_run(tmp_path / "a", success=[0.9, 0.1, 0.9, 0.3])
    write_run(tmp_path / "b", success=[0.9, 0.1, 0.9, 0.9], seed=1)
    write_run(tmp_path / "c", success=[0.9, 0.5, 0.9, 0.3], env_task="block_pushing")
    write_run(tmp_path / "d", success=[0.9, 0.5, 0.9, 0.9], env_task="block_pushing", seed=1)
    lines = summarise(collect(read_runs(tmp_path)))
    assert [line.collapses for line in lines] == [3, 1, 4]
    assert [line.cells()[7] for line in lines] == ["3", "1", "4"]


def test_errors_of_tasks_are_added_as_squares(tmp_path):
    for seed, outcome in enumerate([[1, 1], [1, 0]]):
        write_run(tmp_path / f"a{seed}", seed=seed, test=outcome)
        write_run(tmp_path / f"b{seed}", seed=seed, test=outcome, env_task="block_pushing")
    *_, both = summarise(collect(read_runs(tmp_path)))
    assert both.error == pytest.approx(0.25 * np.sqrt(2) / 2)  # each task: 0.25


def test_the_curve_of_a_finished_run_goes_to_its_last_step(tmp_path):
    write_run(tmp_path / "a", steps=450)
    assert collect(read_runs(tmp_path)).returns("block_picking", LABEL).steps[-1] == 450
    write_run(tmp_path / "b", steps=450, seed=1, test=None)
    assert collect(read_runs(tmp_path)).returns("block_picking", LABEL).steps[-1] == 400


def test_a_run_that_still_makes_its_report_is_unfinished(tmp_path):
    (write_run(tmp_path / "a") / "report.md").unlink()
    sweep = collect(read_runs(tmp_path))
    assert sweep.test("block_picking", LABEL) == []
    assert sweep.remarks == ["a: unfinished, at step 400 of 400"]


def test_no_line_over_all_tasks_while_one_has_no_finished_run(tmp_path):
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", env_task="block_pushing", test=None)
    assert {line.task for line in summarise(collect(read_runs(tmp_path)))} == {
        "Block Picking", "Block Pushing"
    }  # fmt: skip


def test_no_line_over_all_tasks_while_one_has_more_finished_runs(tmp_path):
    """Four runs of picking at 100 % and one each of the others at 0 % would have an IQM of 60 %."""
    tasks = ("block_pushing", "block_in_bowl", "clutter_grasping")
    for seed in range(4):
        write_run(tmp_path / f"p{seed}", seed=seed, test=[1])
        for task in tasks:
            test = [0] if seed == 0 else None
            write_run(tmp_path / f"{task}{seed}", seed=seed, env_task=task, test=test)
    assert "all tasks" not in {line.task for line in summarise(collect(read_runs(tmp_path)))}
    for folder in tmp_path.glob("*[123]"):
        (folder / "report.md").unlink(missing_ok=True)
    *_, both = summarise(collect(read_runs(tmp_path)))
    assert (both.task, both.finished, both.success, both.iqm) == ("all tasks", 4, 0.25, 0.0)


def test_what_differs_between_tasks_only_is_told(tmp_path):
    write_run(tmp_path / "a", env_max_steps=80, env_task="block_in_bowl", threads=1)
    for group in ("C4", "D4"):
        write_run(tmp_path / group, group=group, threads=2)
    sweep = collect(read_runs(tmp_path))
    assert sweep.variants == ["C4", "D4"] and sweep.remarks == [
        "missing: Block in Bowl, C4, seed 0",
        "env.max_steps differs between tasks: 50 for Block Picking, 80 for Block in Bowl",
    ]


def test_a_figure_calls_its_variants_by_its_key_from_the_first_on(tmp_path):
    write_run(tmp_path / "a", augmentation_copies=0)
    assert collect(read_runs(tmp_path)).variants == [LABEL]
    sweep = collect(read_runs(tmp_path), FIGURES["12"])
    assert sweep.variants == ["no augmentation"]
    assert sweep.remarks[0] == "missing: Block Picking, 2 copies, seed 0"
    assert len(sweep.remarks) == 4


def test_what_is_missing_is_told(tmp_path):
    for copies, seed in [(0, 0), (0, 1), (4, 0)]:
        write_run(tmp_path / f"{copies}-{seed}", augmentation_copies=copies, seed=seed)
    (tmp_path / "z").mkdir()
    (tmp_path / "z" / "failed.txt").write_text("no memory\n")
    sweep = collect(read_runs(tmp_path), FIGURES["12"])
    assert sweep.remarks == [
        "z: not begun",
        "missing: Block Picking, 4 copies, seed 1",
        "missing: Block Picking, 2 copies, seeds 0, 1",
        "missing: Block Picking, 8 copies, seeds 0, 1",
        "missing: Block Picking, 16 copies, seeds 0, 1",
    ]
    assert sweep.variants == ["no augmentation", "4 copies"]


def test_damaged_and_cut_tables(tmp_path):
    whole = write_run(tmp_path / "a")
    with open(whole / "metrics.csv", "a") as file:
        file.write("500,9")  # being written
    damaged = write_run(tmp_path / "b", seed=1)
    with open(damaged / "metrics.csv", "a") as file:
        file.write("500,what\n")
    (write_run(tmp_path / "c", seed=2) / "config.yaml").write_text("a: [")
    (write_run(tmp_path / "d", seed=3) / "metrics.csv").unlink()
    sweep = collect(read_runs(tmp_path))
    assert [each.run.name for each in sweep.cells["block_picking", LABEL]] == ["a"]
    unreadable, table, none = sweep.remarks
    assert f"{damaged / 'metrics.csv'}, line 6: expected numbers" in table and "left out" in table
    assert "c/config.yaml is not a readable configuration" in unreadable
    assert none == "d: no episode has ended, left out"


def test_a_table_that_cannot_be_read_leaves_its_run_out(tmp_path):
    folder = write_run(tmp_path / "a")
    (folder / "metrics.csv").unlink()
    (folder / "metrics.csv").mkdir()
    write_run(tmp_path / "b", seed=1)
    sweep = collect(read_runs(tmp_path))
    assert [each.run.name for each in sweep.cells["block_picking", LABEL]] == ["b"]
    path = folder / "metrics.csv"
    assert sweep.remarks == [f"{path} cannot be read: Is a directory: the run is left out"]


def test_a_damaged_table_of_test_scenes_leaves_the_curves(tmp_path):
    folder = write_run(tmp_path / "a")
    (folder / "test.csv").write_text("success,length\n1,what\n")
    sweep = collect(read_runs(tmp_path))
    assert sweep.success("block_picking", LABEL).mean.tolist() == [0, 0.5, 0.9, 1]
    assert sweep.test("block_picking", LABEL) == []
    damaged, unfinished = sweep.remarks
    assert damaged.startswith(f"{folder / 'test.csv'}, line 2: expected numbers")
    assert damaged.endswith("the run counts as unfinished")
    assert unfinished == "a: unfinished, at step 400 of 400"


def test_of_a_validation_that_stands_twice_the_later_one_counts(tmp_path):
    write_run(tmp_path / "a")
    with open(write_run(tmp_path / "b", seed=1) / "validation.csv", "a") as file:
        file.write("200,0.7,0,1\n")
    curve = collect(read_runs(tmp_path)).success("block_picking", LABEL)
    assert curve.steps.tolist() == [100, 200, 300, 400]
    np.testing.assert_allclose(curve.mean, [0, 0.6, 0.9, 1])


def test_ceilings_are_those_of_the_papers_tasks():
    assert {task for task, _ in CEILINGS} == set(TASKS)


def test_ceilings_hold_for_what_was_measured_only():
    keys = {"env.task": "block_pushing", "mode": "paper", "evaluation.discount": 0.99}
    assert expert_ceiling(keys) == CEILINGS["block_pushing", "paper"] == 0.946
    for other in (
        {"env.task": "my.package:Task"},
        {"mode": "strict", "env.robot": "hand"},
        {"evaluation.discount": 0.9},
        {"env.max_steps": 20},
        {"env.max_steps": 80},
        {"env.options.goal_side": 0.1},
        {"demos.options.grasp": "aligned"},
    ):
        assert expert_ceiling({**keys, **other}) is None


@pytest.mark.parametrize(
    ("params", "given", "expected"),
    [
        ("seed: 0,1,2,3\n      group: c4,d4", "[]", 8),
        ("seed: 0,1,2,3", "[seed=0, '+experiment=x', 'env=a,b,c']", 3),
        ("null", "['a=[1,2],[3,4]', 'b=\"x,y\"']", 2),
        ("null", "['seed=range(0,4)']", None),
    ],
)
def test_planned_runs(tmp_path, params, given, expected):
    body = f"params:\n      {params}" if params != "null" else "params: null"
    text = f"hydra:\n  sweeper:\n    {body}\n  overrides:\n    task: {given}\n"
    (tmp_path / "multirun.yaml").write_text(text)
    assert planned_runs(tmp_path) == expected
    assert planned_runs(tmp_path / "nothing") is None


def test_numbers_in_names_are_sorted_by_value(tmp_path):
    for name in ("copies-16", "copies-2", "copies-4", "10", "a"):
        write_run(tmp_path / name)
    write_run(tmp_path / ".hydra")
    names = [run.name for run in read_runs(tmp_path)]
    assert names == ["10", "a", "copies-2", "copies-4", "copies-16"]
