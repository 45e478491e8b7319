"""What runs are called in figures and tables: the paper's words for what differs among them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from equirl.analysis.runs import Run, natural_order

__all__ = [
    "TASKS",
    "between_tasks",
    "differing_keys",
    "group_variants",
    "listed",
    "shortened",
    "task_name",
    "variant_label",
]

#: The paper's tasks, in its order.
TASKS = ("block_picking", "clutter_grasping", "block_pushing", "block_in_bowl")

#: Keys that leave what is learned alone, and what runs are repeated over.
_NEUTRAL = ("seed", "steps", "checkpoint_every", "device", "threads", "backend")
_NEUTRAL_GROUPS = ("evaluation.", "logging.")

#: In one of these groups, yet it changes the numbers that are averaged.
_TOLD = ("evaluation.discount",)

#: Methods that make nothing of the group; all others, a reader's own too, are told with it.
_GROUPLESS = ("cnn", "drq", "rad", "ferm")

_METHODS = {"equivariant": "Equivariant", "cnn": "CNN", "drq": "DrQ", "rad": "RAD", "ferm": "FERM"}
_ALGORITHMS = {"sac": "SAC", "sacfd": "SACfD"}
_AUGMENTATIONS = {
    "none": "no augmentation",
    "online": "rotated when sampled",
    "auxiliary": "auxiliary loss",
}

#: Values in the order of a legend; of groups, their families.
_ORDER: dict[str, Iterable[str]] = {
    "group": ("C", "D", "SO", "O"),
    "method.name": _METHODS,
    "algorithm.name": _ALGORITHMS,
    "augmentation.name": _AUGMENTATIONS,
}

#: Keys that have words of their own, in the order of a label.
_NAMED = (
    *("group", "method.name", "algorithm.name"),
    *("augmentation.name", "augmentation.copies", "demos.episodes"),
)


def differing_keys(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys whose values are not the same in all configurations, in the first ones' order."""
    names = dict.fromkeys(name for config in configs for name in config)
    return [name for name in names if len({str(config.get(name)) for config in configs}) > 1]


def task_name(task: str) -> str:
    """The name of a task, for titles: of ``"block_in_bowl"`` Block in Bowl."""
    words = task.rpartition(":")[2].replace("_", " ").split()
    return " ".join(word if word == "in" else word[:1].upper() + word[1:] for word in words)


def shortened(text: str, longest: int) -> str:
    """A text without its middle: names and labels of a sweep differ at their ends, too.

    Args:
        text: Any.
        longest: The letters it may have.
    """
    if len(text) <= longest:
        return text
    half = (longest - 1) // 2
    return f"{text[:half]}…{text[len(text) - half :]}"


def listed(texts: Sequence[str], most: int, separator: str = ", ") -> str:
    """The first texts in a line, and how many more there are: ``"a, b, and 3 more"``."""
    more = [f"and {len(texts) - most} more"] if len(texts) > most else []
    return separator.join([*texts[:most], *more])


def group_variants(runs: Sequence[Run], always: Sequence[str] = ()) -> dict[str, list[Run]]:
    """Sorts runs into variants, each with a label in the paper's words.

    Two runs of a task are of one variant if they differ by the seed and by keys that leave
    what is learned alone only. Runs of two tasks are if they agree in what the paper varies;
    `between_tasks` tells of the rest. A key that goes with another, as an option of a method
    does, is not mentioned, nor is the value that most runs have of a key without words of its
    own, where something else is told.

    Args:
        runs: Those that are drawn or listed together, of one or more tasks.
        always: Keys with words of their own to tell even if they do not differ, since they will.

    Returns:
        Runs by labels such as ``"no augmentation"``, ``"4 copies"`` or ``"CNN SACfD"`` (what is
        trained, if nothing differs), numbers ascending and words in the paper's order.
    """
    differing = differing_keys([run.keys for run in runs])
    chosen = [name for name in _NAMED if name in differing or name in always]
    for name in differing:
        if name not in chosen and not _is_neutral(name) and _differs(name, runs, chosen):
            chosen.append(name)
    usual = {name: value for name in chosen if (value := _usual(name, runs)) is not None}
    grouped: dict[str, list[Run]] = {}
    for run in sorted(runs, key=lambda run: [_rank(name, run.keys.get(name)) for name in chosen]):
        grouped.setdefault(variant_label(run.keys, chosen, usual), []).append(run)
    return grouped


def between_tasks(variants: Mapping[str, Sequence[Run]]) -> list[str]:
    """What a line over all tasks puts together that was not trained alike.

    Args:
        variants: Runs by label, see `group_variants`.

    Returns:
        A sentence for each key that has another value for one task than for another.
    """
    found: dict[str, dict[str, list[str]]] = {}
    for members in variants.values():
        for name in differing_keys([run.keys for run in members]):
            if not _is_neutral(name) and name not in _NAMED:
                for run in members:
                    values = found.setdefault(name, {}).setdefault(task_name(run.task), [])
                    values.append(str(run.keys.get(name, "not set")))
    return [
        f"{name} differs between tasks: "
        + ", ".join(f"{' or '.join(dict.fromkeys(told))} for {task}" for task, told in own.items())
        for name, own in found.items()
    ]


def _is_neutral(name: str) -> bool:
    """Whether runs with several values of a key are repetitions of one variant."""
    grouped = name.startswith(_NEUTRAL_GROUPS) and name not in _TOLD
    return grouped or name in (*_NEUTRAL, "env.task")


def _rank(name: str, value: object) -> tuple[int, float, list[tuple[int, str]]]:
    """Where a value stands among those of its key."""
    words = list(_ORDER.get(name, ()))
    text = str(value)
    if (family := text.rstrip("0123456789")) in words:
        return 0, words.index(family), natural_order(text)
    number = value if isinstance(value, int | float) else 0.0
    return 1, number, natural_order(text)


def _usual(name: str, runs: Sequence[Run]) -> str | None:
    """The value of a key that more than half of the runs have, if there is one."""
    value, count = Counter(str(run.keys.get(name)) for run in runs).most_common(1)[0]
    return value if 2 * count > len(runs) else None


def _differs(name: str, runs: Sequence[Run], chosen: Sequence[str]) -> bool:
    """Whether a key differs among runs of a task that would have one label."""
    values: dict[tuple[str, str], str] = {}
    for run in runs:
        place = (run.task, variant_label(run.keys, chosen))
        value = str(run.keys.get(name))
        if values.setdefault(place, value) != value:
            return True
    return False


def variant_label(
    keys: Mapping[str, Any], chosen: Sequence[str], usual: Mapping[str, str] | None = None
) -> str:
    """What is special about a configuration, in the paper's words.

    Args:
        keys: The configuration.
        chosen: The keys to tell; what is trained, if there are none.
        usual: Values that need not be told of those keys that have no words of their own.
    """
    parts = []
    grouped = "group" in keys and keys.get("method.name") not in _GROUPLESS
    trained = "method.name" in chosen or "algorithm.name" in chosen
    if trained or not chosen:
        parts.append(_trained(keys))
    if grouped and ("group" in chosen or not chosen):
        parts.append(_group(str(keys.get("group"))))
    if "augmentation.name" in chosen or "augmentation.copies" in chosen:
        parts.append(_augmentation(keys))
    if "demos.episodes" in chosen:
        parts.append(_counted(keys.get("demos.episodes"), "demonstration"))
    others = [name for name in chosen if name not in _NAMED]
    unusual = [name for name in others if str(keys.get(name)) != (usual or {}).get(name)]
    told = unusual if parts or unusual else others
    return ", ".join([*parts, *(f"{name}={keys.get(name)}" for name in told)]) or _trained(keys)


def _trained(keys: Mapping[str, Any]) -> str:
    method, algorithm = str(keys.get("method.name")), str(keys.get("algorithm.name"))
    return f"{_METHODS.get(method, method)} {_ALGORITHMS.get(algorithm, algorithm)}"


def _group(name: str) -> str:
    return {"SO2": "SO(2)", "O2": "O(2)"}.get(name.upper(), name.upper())


def _augmentation(keys: Mapping[str, Any]) -> str:
    name, copies = str(keys.get("augmentation.name")), keys.get("augmentation.copies")
    if name == "buffer":
        return _counted(copies, "copy", "copies") if copies else _AUGMENTATIONS["none"]
    return _AUGMENTATIONS.get(name, f"{name} augmentation")


def _counted(count: object, one: str, many: str = "") -> str:
    if count == 1:
        return f"1 {one}"
    return f"{count or 'no'} {many or one + 's'}"
