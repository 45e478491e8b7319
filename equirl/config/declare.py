"""How a key of the configuration declares, on its line, what it may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, fields, is_dataclass
from pkgutil import resolve_name
from typing import Any

from omegaconf import MISSING

__all__ = [
    "ConfigError",
    "at_least",
    "check_values",
    "checked",
    "flatten",
    "keys_of",
    "mark",
    "one_of",
    "within",
]


class ConfigError(ValueError):
    """A key or value that no run can have; the message names it."""


def at_least(default: Any, lowest: float, **marks: bool) -> Any:
    """A number from ``lowest`` on; see `mark` for what else can be said of it."""
    return checked(default, lambda value: value >= lowest, f"{lowest} or more", **marks)


def within(default: float, low: float, high: float) -> Any:
    """A number above ``low``, at most ``high``."""
    expected = f"a number above {low:g}, at most {high:g}"
    return checked(default, lambda value: low < value <= high, expected)


def one_of(default: str, *allowed: str, source: str = "", **marks: bool) -> Any:
    """One of several words: the default, ``allowed``, or those that ``source`` lists.

    ``source`` is ``"module:name"``, looked up when a value is checked, so that the schema needs
    none of the libraries behind it; a default of ``MISSING`` is left to the files of ``conf``.
    """

    def words() -> list[str]:
        if source:
            return list(resolve_name(source))
        return [word for word in (default, *allowed) if word != MISSING]

    return checked(
        default,
        lambda value: value in words(),
        lambda: f"one of {', '.join(words())}",
        **marks,
    )


def checked(
    default: Any,
    valid: Callable[[Any], bool],
    expected: str | Callable[[], str],
    **marks: bool,
) -> Any:
    """A value that ``valid`` accepts; ``expected`` says in words what that is."""
    return field(default=default, metadata={"valid": valid, "expected": expected, **mark(**marks)})


def keys_of(schema: type, **marks: bool) -> Any:
    """A group of keys, all marked alike."""
    return field(default_factory=schema, metadata=mark(**marks))


def mark(*, free: bool = False, execution: bool = False) -> dict[str, bool]:
    """What a key touches, as metadata of its field.

    Args:
        free: Not what is learned: another value may be given when a run is resumed.
        execution: Nothing but where and how the run is computed, which makes it free, too: with
            another value it is the same run.
    """
    return {"free": free or execution, "execution": execution}


def check_values(config: Any, prefix: str = "") -> None:
    """Checks each value against the range that its field declares."""
    for entry in fields(config):
        value = getattr(config, entry.name)
        if is_dataclass(value):
            check_values(value, f"{prefix}{entry.name}.")
        elif "valid" in entry.metadata and not entry.metadata["valid"](value):
            key = f"{prefix}{entry.name}".removesuffix(".name")
            expected = entry.metadata["expected"]
            expected = expected() if callable(expected) else expected
            raise ConfigError(f"{key}={value}: expected {expected}")


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """The configuration as ``{"env.task": ...}``, for comparing and logging."""
    flat: dict[str, Any] = {}
    for entry in fields(config):
        value = getattr(config, entry.name)
        key = prefix + entry.name
        flat |= flatten(value, key + ".") if is_dataclass(value) else {key: value}
    return flat
