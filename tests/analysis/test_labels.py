"""Runs are called by what differs among them, in the paper's words."""

from pathlib import Path

import pytest

from equirl.analysis.labels import differing_keys, group_variants, listed, shortened, task_name
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
        ("group", ["O2", "D12", "C10", "C6", "C12"], ["C6", "C10", "C12", "D12", "O(2)"]),
        ("group", ["D2", "C3", "C8", "C4"], ["C3", "C4", "C8", "D2"]),
        ("demos.file", ["of-10", "of-9"], ["demos.file=of-9", "demos.file=of-10"]),
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


@pytest.mark.parametrize(
    ("key", "value"), [("augmentation.copies", 0), ("group", "C4"), ("demos.episodes", 10)]
)
def test_what_the_paper_varies_makes_variants_across_tasks_too(key, value):
    assert len(labels({}, {"env.task": "block_pushing", key: value})) == 2


def test_the_usual_value_of_a_key_without_words_is_not_told():
    odd = {"algorithm.critics": 5}, {"augmentation.quarter_turns": True}
    usual = {"algorithm.critics": 2, "augmentation.quarter_turns": False}
    changes = [usual | change for change in ({}, {"group": "C4"}, {"group": "C8"}, *odd)]
    assert sorted(labels(*changes)) == [
        *("C4", "C8", "D4", "D4, algorithm.critics=5", "D4, augmentation.quarter_turns=True")
    ]
    alone = [{"algorithm.critics": 2, "seed": 1}, {"algorithm.critics": 2}, *odd[:1]]
    assert list(labels(*alone)) == ["algorithm.critics=2", "algorithm.critics=5"]
    even = [
        {"group": group, "mode": mode} for group in ("C4", "D4") for mode in ("paper", "strict")
    ]
    assert [*labels(*even)][:2] == ["C4, mode=paper", "C4, mode=strict"]


def test_runs_of_one_label_are_never_trained_differently():
    """Augmentations that are equal have one label, with which no other key may go."""
    none, zero = {"augmentation.name": "none"}, {"augmentation.copies": 0, "mode": "paper"}
    found = labels(none, zero, {})
    assert list(found) == ["no augmentation", "no augmentation, mode=paper", "4 copies"]


def test_a_key_is_told_that_will_differ():
    runs = [Run(Path("0"), BASE)]
    assert list(group_variants(runs, ["augmentation.copies"])) == ["4 copies"]


def test_texts_that_are_too_long_for_a_line():
    assert shortened("abcdefgh", 8) == "abcdefgh" and shortened("abcdefghi", 8) == "abc…ghi"
    assert listed(["a", "b", "c"], 3, "; ") == "a; b; c"
    assert listed(["a", "b", "c", "d", "e"], 3, "; ") == "a; b; c; and 2 more"


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
