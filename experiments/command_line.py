"""What the scripts check on their command lines."""

from __future__ import annotations

import argparse
from collections.abc import Callable


def at_least(lowest: int) -> Callable[[str], int]:
    """Returns a type of arguments for argparse: an integer that is not below ``lowest``."""

    def number(text: str) -> int:
        if not text.removeprefix("-").isdecimal() or int(text) < lowest:
            raise argparse.ArgumentTypeError(
                f"expected an integer of {lowest} or more, got {text!r}"
            )
        return int(text)

    return number
