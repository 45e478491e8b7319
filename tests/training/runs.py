"""Small runs, stopped anywhere, and what it means that two are the same."""

from contextlib import closing

import torch

from equirl.training import CHECKPOINT, TrainingRun, load_checkpoint


def run(config, folder, stop_after=None, stop_when=None) -> TrainingRun:
    """Trains in a folder until a step, or until a condition on the run, or to the end."""
    folder.mkdir(exist_ok=True)
    with closing(TrainingRun(config, folder)) as training:
        if stop_after is not None:
            training.should_stop = lambda: training.step >= stop_after
        if stop_when is not None:
            training.should_stop = lambda: stop_when(training)
        training.restore()
        training.run()
    return training


def assert_same(first, second, where=""):
    assert type(first) is type(second), where
    if isinstance(first, torch.Tensor):
        assert torch.equal(first, second), where
    elif isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_same(first[key], second[key], f"{where}/{key}")
    elif isinstance(first, list | tuple):
        assert len(first) == len(second), where
        for index, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, f"{where}/{index}")
    else:
        assert first == second, where


def assert_same_run(first, second):
    states = [load_checkpoint(folder / CHECKPOINT) for folder in (first, second)]
    for state in states:
        del state["clock"]
        state["config"].pop("steps")
    assert_same(*states)
    tables = {path.name for path in first.glob("*.csv")} - {"timing.csv"}
    assert {"metrics.csv", "validation.csv"} <= tables
    for table in tables:
        assert (first / table).read_bytes() == (second / table).read_bytes(), table
