"""Runs are called by what differs among them, in the paper's words."""

from pathlib import Path

import pytest

from equirl.analysis.labels import differing_keys, group_variants, task_name
from equirl.analysis.runs import Run
from equirl.config import Config, flatten
from equirl.config.schema import is_execution, is_free
from equirl.modules import METHODS

BASE = {
    "env.task": "block_picking",
    "env.max_steps": 50,
    "method.name": "equivariant",
    "method.shift": 0,
    "algorithm.name": "sac",
    "augmentation.name": "buffer",
    "augmentation.copies": 4,
    "demos.episodes": 20,
    "evaluation.every": 200,
    "group": "D4",
    "mode": "strict",
    "steps": 100,
    "seed": 0,
}


def labels(*changes):
    runs = [Run(Path(str(n)), {**BASE, **change}) for n, change in enumerate(changes)]
    return {label: [run.name for run in found] for label, found in group_variants(runs).items()}


@pytest.mark.parametrize(
    ("key", "values", "expected"),
    [
        ("augmentation.copies", [16, 4, 0, 1], ["no augmentation", "1 copy", "4 copies", "16 co"]),
        ("demos.episodes", [10, 0], ["no demonstrations", "10 demonstrations"]),
        ("group", ["O2", "D8", "SO2", "C4"], ["C4", "D8", "SO(2)", "O(2)"]),
        ("method.name", ["ferm", "drq", "cnn"], ["CNN SAC", "DrQ SAC", "FERM SAC"]),
        ("algorithm.name", ["sacfd", "sac"], ["Equivariant SAC", "Equivariant SACfD"]),
        ("mode", ["paper", "strict"], ["mode=paper", "mode=strict"]),
        ("seed", [3, 1, 2], ["Equivariant SAC, D4"]),
    ],
)
def test_variants_of_one_key(key, values, expected):
    found = list(labels(*({key: value} for value in values)))
    assert [label[: len(name)] for label, name in zip(found, expected, strict=True)] == expected


def test_seeds_and_what_is_not_learned_are_no_variants():
    changes = [{"seed": 1}, {"steps": 9}, {"evaluation.every": 7}, {"threads": 2}, {}]
    assert labels(*changes) == {"Equivariant SAC, D4": ["0", "1", "2", "3", "4"]}


@pytest.mark.parametrize("key", flatten(Config()))
def test_a_repetition_differs_by_what_the_schema_says_too(key):
    """Keys of execution make no variant, and those that touch what is learned do."""
    found = labels({key: "a"}, {key: "b"})
    if is_execution(key):
        assert len(found) == 1
    if not is_free(key) and key not in ("seed", "env.task"):
        assert len(found) == 2


def test_another_discount_of_the_returns_is_another_variant():
    found = labels({}, {"evaluation.discount": 0.9}, {"evaluation.discount": 0.9, "seed": 1})
    assert sorted(map(sorted, found.values())) == [["0"], ["1", "2"]]
    assert "evaluation.discount=0.9" in found


def test_every_method_that_may_use_the_group_is_told_with_it():
    own = {"method.name": "mine"}
    assert labels(own, {**own, "group": "C4"}) == {"C4": ["1"], "D4": ["0"]}
    assert labels(own) == {"mine SAC, D4": ["0"]}
    for name, method in METHODS.items():
        changes = {"method.name": name}
        assert len(labels(changes, {**changes, "group": "C4"})) == 1 + method.equivariant, name


def test_a_key_that_goes_with_another_or_with_the_task_is_not_mentioned():
    found = labels({"method.name": "drq", "method.shift": 4}, {}, {"seed": 1})
    assert found == {"Equivariant SAC": ["1", "2"], "DrQ SAC": ["0"]}
    other = {"env.task": "block_in_bowl", "env.max_steps": 80}
    assert list(labels(other, {}, {"mode": "paper"})) == ["mode=paper", "mode=strict"]
    assert len(labels(other, {})) == 1


def test_two_keys_are_both_told_and_equal_augmentations_are_one():
    found = labels({"group": "C4", "augmentation.copies": 0}, {"group": "C4"}, {})
    assert list(found) == ["C4, no augmentation", "C4, 4 copies", "D4, 4 copies"]
    found = labels({"augmentation.name": "none"}, {"augmentation.copies": 0, "seed": 1}, {})
    assert {label: sorted(names) for label, names in found.items()} == {
        "no augmentation": ["0", "1"],
        "4 copies": ["2"],
    }
    assert "auxiliary loss" in labels({"augmentation.name": "auxiliary"}, {})


def test_names_of_tasks_and_differing_keys():
    assert task_name("block_in_bowl") == "Block in Bowl"
    assert task_name("my.package:StackCubes") == "StackCubes"
    assert differing_keys([{"a": 1, "b": 2}, {"a": 1, "b": 3, "c": 0}]) == ["b", "c"]
