"""What runs are called in figures and tables: the paper's words for what differs among them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from equirl.analysis.runs import Run

__all__ = ["differing_keys", "group_variants", "task_name", "variant_label"]

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

#: Values in the order of a legend.
_ORDER: dict[str, Iterable[str]] = {
    "group": ("C4", "C8", "D4", "D8", "SO2", "O2"),
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


def group_variants(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Sorts runs into variants, each with a label in the paper's words.

    Two runs of a task are of one variant if they differ by the seed and by keys that leave
    what is learned alone only. A key that goes with another, as an option of a method does, is
    not mentioned.

    Args:
        runs: Those that are drawn or listed together, of one or more tasks.

    Returns:
        Runs by labels such as ``"no augmentation"``, ``"4 copies"`` or ``"CNN SACfD"`` (what is
        trained, if nothing differs), numbers ascending and words in the paper's order.
    """
    chosen = [name for name in _NAMED if _differs(name, runs, ())]
    for name in differing_keys([run.keys for run in runs]):
        if name not in chosen and not _is_neutral(name) and _differs(name, runs, chosen):
            chosen.append(name)
    grouped: dict[str, list[Run]] = {}
    for run in sorted(runs, key=lambda run: [_rank(name, run.keys.get(name)) for name in chosen]):
        grouped.setdefault(variant_label(run.keys, chosen), []).append(run)
    return grouped


def _is_neutral(name: str) -> bool:
    """Whether runs with several values of a key are repetitions of one variant."""
    grouped = name.startswith(_NEUTRAL_GROUPS) and name not in _TOLD
    return grouped or name in (*_NEUTRAL, "env.task")


def _rank(name: str, value: object) -> tuple[int, float, str]:
    """Where a value stands among those of its key."""
    words = list(_ORDER.get(name, ()))
    if str(value) in words:
        return 0, words.index(str(value)), ""
    number = value if isinstance(value, int | float) else 0.0
    return 1, number, str(value)


def _differs(name: str, runs: Sequence[Run], others: Sequence[str]) -> bool:
    """Whether a key differs among runs of a task that agree in the other keys."""
    values: dict[tuple[str, ...], str] = {}
    for run in runs:
        place = (run.task, *(str(run.keys.get(other)) for other in others))
        value = str(run.keys.get(name))
        if values.setdefault(place, value) != value:
            return True
    return False


def variant_label(keys: Mapping[str, Any], chosen: Sequence[str]) -> str:
    """What is special about a configuration, in the paper's words.

    Args:
        keys: The configuration.
        chosen: The keys to tell; what is trained, if there are none.
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
    for name in chosen:
        if name not in _NAMED:
            parts.append(f"{name}={keys.get(name)}")
    return ", ".join(parts) or _trained(keys)


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
