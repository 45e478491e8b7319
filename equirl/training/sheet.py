"""Contact sheets: what the network sees at every step of an episode, and what is then done."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from equirl.envs import Action, ManipulationEnv
from equirl.envs.workspace import WORKSPACE, Workspace
from equirl.training.video import COLORS, EXPONENT, Frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

__all__ = ["Setting", "draw_sheet", "outcome"]

_DPI = 100
# Lengths on paper, inches.
_TILE = 1.6  # side of a picture
_GAP = 0.1
_CAPTION = 0.2  # above a picture, and below it
_MARGIN = 0.15
_TITLE = 0.36
_HEADING = 0.26  # above the pictures of an episode
_FOOT = 0.75
_COLUMNS = (5, 12)  # fewest and most pictures in a row

_BAR = 0.1  # m, the scale bar
_STILL = 0.02  # smaller components of an action are not shown
_TEXT, _FAINT, _GOOD, _HELD, _ARROW = "#222222", "#666666", "#2e7d32", "#c2410c", "#ff4d4d"
_LEGEND = (
    "The gripper is in the middle, x points down, y to the right. "
    "The action that follows: red arrow, displacement in x and y, to scale; "
    "↑ ↓ in z; ↺ ↻ turn; ↔ opening of the fingers."
)


@dataclass(frozen=True)
class Setting:
    """What a sheet has to know of an environment; of a recording, there is no more.

    Attributes:
        view: Length of a side of the depth image, m.
        max_steps: Of an episode without success; 0 when it is not known.
        workspace: How far actions go.
    """

    view: float
    max_steps: int = 0
    workspace: Workspace = WORKSPACE

    @classmethod
    def of(cls, env: ManipulationEnv | Setting) -> Setting:
        """The setting of an environment."""
        if isinstance(env, Setting):
            return env
        return cls(env.task.view, env.max_steps, env.workspace)


def draw_sheet(
    episodes: Sequence[Sequence[Frame]],
    env: ManipulationEnv | Setting,
    path: Path,
    *,
    title: str = "",
) -> Path:
    """Writes a contact sheet as a PNG file.

    Args:
        episodes: What `record` returned for each, or `recorded_frames`.
        env: Where they were played, or what is known of it.
        path: The file to write.
        title: Above everything.

    Returns:
        ``path``.

    Raises:
        OSError: The file cannot be written.
    """
    setting = Setting.of(env)
    sizes = [len(frames) + 2 * _has_scene(frames) for frames in episodes]
    columns = _columns(sizes)
    rows = [math.ceil(size / columns) for size in sizes]
    pitch = _TILE + 2 * _CAPTION + _GAP
    width = 2 * _MARGIN + columns * (_TILE + _GAP) - _GAP
    height = 2 * _MARGIN + _TITLE + len(rows) * _HEADING + sum(rows) * pitch + _FOOT
    page = _Page(width, height)
    page.write(_MARGIN, _MARGIN, title, size=13, weight="bold")
    top = _MARGIN + _TITLE
    for number, (frames, count) in enumerate(zip(episodes, rows, strict=True), start=1):
        page.write(_MARGIN, top, f"Episode {number}: {outcome(frames, setting)}", size=10)
        top += _HEADING
        places = (
            page.picture(
                _MARGIN + index % columns * (_TILE + _GAP),
                top + index // columns * pitch + _CAPTION,
            )
            for index in range(len(frames) + 2)
        )
        if _has_scene(frames):
            _show_scene(next(places), frames[0], "the scene at the start")
        for step, frame in enumerate(frames):
            image = _show_depth(next(places), frame, step, setting)
        if _has_scene(frames):
            _show_scene(next(places), frames[-1], "the scene at the end")
        top += count * pitch
    page.explain(top, image)
    page.save(path)
    return path


def _has_scene(frames: Sequence[Frame]) -> bool:
    """Whether there are pictures of the scene, which are shown at the start and the end."""
    return frames[0].picture is not None


def _columns(sizes: Sequence[int]) -> int:
    """How many pictures to put in a row: a page of good shape, with few rows left half empty."""
    fewest, most = _COLUMNS
    about = round(math.sqrt(2 * sum(sizes)))
    choices = range(max(fewest, min(about, most) - 1), min(max(about, fewest) + 1, most) + 1)
    return min(choices, key=lambda count: sum(-size % count for size in sizes))


def outcome(frames: Sequence[Frame], env: ManipulationEnv | Setting) -> str:
    """How an episode in ``env`` ended, in words."""
    count = len(frames) - 1
    steps = f"{count} step{'s' if count > 1 else ''}"
    if frames[-1].reward > 0:
        return f"success after {steps}"
    if count < env.max_steps:
        return f"an object left the workspace after {steps}"
    return f"no success in {steps}"


class _Page:
    """A figure laid out in inches from its upper left corner."""

    def __init__(self, width: float, height: float):
        from matplotlib.figure import Figure

        self._size = np.array([width, height])
        self._figure = Figure(figsize=(width, height), dpi=_DPI)  # draws by Agg: no display

    def write(self, left: float, top: float, text: str, **style: Any) -> None:
        x, y = (left, top) / self._size
        self._figure.text(x, 1 - y, text, va="top", color=_TEXT, **style)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        x, y, w, h = np.array([left, top, width, height]) / np.tile(self._size, 2)
        return self._figure.add_axes((x, 1 - y - h, w, h))

    def picture(self, left: float, top: float) -> Axes:
        axes = self.axes(left, top, _TILE, _TILE)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
        return axes

    def explain(self, top: float, image: AxesImage) -> None:
        """Adds the scale of depths and the legend."""
        colors = self.axes(_MARGIN + 0.1, top + 0.08, 2.4, 0.12)
        ticks = [0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25]
        bar = self._figure.colorbar(image, cax=colors, orientation="horizontal", ticks=ticks)
        bar.ax.set_xticklabels([f"{tick:g}" for tick in ticks])
        bar.set_label("depth below the gripper (m)", size=8, color=_TEXT)
        bar.ax.tick_params(labelsize=8, colors=_TEXT)
        left = _MARGIN + 2.8
        words = int((self._size[0] - left) * 15.5)  # letters of this size in a line
        self.write(left, top + 0.05, _wrapped(_LEGEND, words), size=8.5, linespacing=1.4)

    def save(self, path: Path) -> None:
        self._figure.savefig(path, dpi=_DPI, facecolor="white")


def _wrapped(text: str, width: int) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, width))


def _show_scene(axes: Axes, frame: Frame, caption: str) -> None:
    assert frame.picture is not None
    axes.imshow(frame.picture)
    _write(axes, 0, True, caption, color=_FAINT)


def _write(axes: Axes, x: float, above: bool, text: str, **style: Any) -> None:
    """Writes above or below a picture, from ``x``, a share of its width."""
    y, side = (1.03, "baseline") if above else (-0.03, "top")
    axes.text(x, y, text, va=side, transform=axes.transAxes, size=8.5, **style)


def _show_depth(axes: Axes, frame: Frame, step: int, setting: Setting) -> AxesImage:
    from matplotlib.colors import PowerNorm

    half = setting.view / 2
    image = axes.imshow(
        frame.depth,
        cmap=COLORS,
        norm=PowerNorm(EXPONENT, 0, frame.deepest),
        extent=(-half, half, half, -half),
        interpolation="nearest",
    )
    _write(axes, 0, True, f"step {step}", color=_TEXT, weight="bold")
    if frame.holding:
        _write(axes, 1, True, "holding", color=_HELD, ha="right")
    if frame.reward:
        _write(axes, 1, False, f"reward {frame.reward:g}", color=_GOOD, weight="bold", ha="right")
    if step == 0:
        axes.plot([0.9 * half - _BAR, 0.9 * half], [0.88 * half] * 2, color="white", lw=2.5)
        middle = 0.9 * half - _BAR / 2
        axes.text(middle, 0.84 * half, "10 cm", color="white", size=8, ha="center", va="bottom")
    if frame.action is not None:
        _show_action(axes, frame.action, setting)
    return image


def _show_action(axes: Axes, action: np.ndarray, env: ManipulationEnv | Setting) -> None:
    """Draws the displacement in x and y as an arrow and writes the rest below."""
    space = env.workspace
    wanted = Action(*action.tolist())
    dx, dy, dz = wanted.displacement(space)
    if math.hypot(wanted.x, wanted.y) > _STILL:
        tip = (dy, dx)
        style = {"arrowstyle": "-|>", "color": _ARROW, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", xy=tip, xytext=(0, 0), arrowprops=style)
    words = []
    if abs(wanted.z) > _STILL:
        words.append(f"{'↑' if dz > 0 else '↓'} {100 * abs(dz):.1f} cm")
    if abs(wanted.theta) > _STILL:
        turn = math.degrees(wanted.turn(space))
        words.append(f"{'↺' if turn > 0 else '↻'} {abs(turn):.0f}°")
    words.append(f"↔ {100 * wanted.aperture(space):.0f} cm")
    _write(axes, 0, False, "   ".join(words), color=_TEXT)
