"""What a run tells of the computer it was made on: no absolute path, unless it is asked for."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["private_value", "private_word", "without_paths"]

#: What a path may follow at once: a flag, or ``file://``. A slash in the middle of a word is a
#: relative path's, or belongs to a date or a link.
_BEFORE = r"(?<![\w./~-])(-[A-Za-z]|\w+://|)"


def without_paths(text: str) -> str:
    """A text whose absolute paths are relative to the working folder or the user's.

    Of others the last part is left.
    """
    text = re.sub(r"(?<=['\"])/[^'\"\n]+(?=['\"])", _last_part, _relative(text))  # blanks and all
    path = r"(?:/[^/\s'\",;\[\]()]+)+/?"
    return re.sub(_BEFORE + path, lambda it: it[1] + _last_part(it), text)


def private_value(value: Any) -> Any:
    """A value of the configuration without absolute paths, those in its lists and mappings too."""
    if isinstance(value, Mapping):
        return {key: private_value(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [private_value(each) for each in value]
    if not isinstance(value, str):
        return value
    text = _relative(value)
    # A path as a whole, blanks and all.
    return f".../{Path(text).name}" if text.startswith("/") else without_paths(text)


def private_word(word: str) -> str:
    """A word of a command line, ``key=/a path`` for one, without absolute paths."""
    key, sign, value = word.partition("=")
    if "/" in key:  # a path with the sign in it, or no key at all
        key, sign, value = "", "", word
    bare = value.strip("'\"")
    return f"{key}{sign}{private_value(bare if bare.startswith('/') else value)}"


def _relative(text: str) -> str:
    """A text with names for the working folder and the user's, wherever they stand in it."""
    places = {str(Path.cwd()): ".", str(Path.home()): "~"}
    for place in sorted(places, key=len, reverse=True):  # one may be inside the other
        if place != "/":
            whole = rf"{_BEFORE}{re.escape(place)}(?!\w|[.-]\w)"
            text = re.sub(whole, rf"\1{places[place]}", text)
    return text


def _last_part(path: re.Match[str]) -> str:
    return f".../{Path(path[0]).name}"
