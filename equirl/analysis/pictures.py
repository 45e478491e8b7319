"""What all figures share: matplotlib without a display, colours, and how a file is written."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "DASHES", "plain", "pyplot", "save"]

COLOURS = (
    *("#0b6e99", "#d9730d", "#448361", "#9065b0", "#c14c8a"),
    *("#b3261e", "#5b6770", "#8a6d1f"),
)

#: Of lines, for further rounds of the colours.
DASHES: tuple[Any, ...] = (
    *("-", (0, (4, 1.5)), (0, (1, 1.2))),
    *((0, (7, 1.5, 1, 1.5)), (0, (3, 1.2, 1, 1.2, 1, 1.2))),
)


def pyplot() -> Any:
    """Matplotlib's pyplot, imported when a figure is drawn, in the style of all figures."""
    import matplotlib

    matplotlib.use("Agg")  # no display is needed
    import matplotlib.pyplot as plt

    plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False, "font.size": 9})
    return plt


def plain(text: str) -> str:
    """A text as matplotlib is to be given it, whose dollar signs begin no formula.

    Its setting ``text.parse_math`` would take the exponents of logarithmic axes with them.
    """
    return text.replace("$", r"\$")


def save(figure: Figure, path: Path, *, palette: bool = False) -> None:
    """Writes a figure as PNG and forgets it.

    Args:
        figure: The figure.
        path: The file.
        palette: Whether to keep 255 colours only: a third of the size.
    """
    if palette:
        from PIL import Image

        with BytesIO() as file:
            figure.savefig(file, dpi=110, format="png")
            picture = Image.open(file).convert("RGB").quantize(255, dither=Image.Dither.NONE)
            picture.save(path, optimize=True)
    else:
        figure.savefig(path, dpi=110)
    pyplot().close(figure)
