"""Draws docs/images/turned_scene.png and feature_maps.png: what docs/concepts.md tells of.

python docs/images/draw_concepts.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import torch
from matplotlib.axes import Axes
from tensordict import TensorDictBase
from torch import Tensor

from equirl.envs import Scene, make_env, make_expert
from equirl.modules import EquivariantEncoder
from equirl.symmetry import Element, ScalarField, manipulation_spec
from equirl.symmetry.audit_transforms import transform_scene

TASK, SIZE, SEED = "block_pushing", 64, 3
QUARTER = Element(torch.pi / 2)
ARROW, FAINT = "#d1495b", "#777777"
FOLDER = Path(__file__).parent
NAMES = ("gripper", "x", "y", "z", "theta")


def main() -> None:
    """Draws both pictures beside this file."""
    plt.rcParams["font.size"] = 9
    env = make_env(TASK, image_size=SIZE, robot="hand", seed=SEED)
    expert, spec = make_expert(env), manipulation_spec()
    observation = env.reset()
    scene = env.get_scene()
    seen = expert(observation.clone())
    columns = [("s, and the expert's a", seen)]
    for element, name in (
        (QUARTER, "turned by 90°"),
        (Element(0.0, reflected=True), "reflected, y to -y"),
    ):
        # What is drawn comes from the simulator and the expert; that it is g s and g a is found.
        there = Scene(**transform_scene(scene.as_dict(), element))
        found, expected = expert(env.set_scene(there)), spec.transform(seen, element)
        assert torch.equal(found["depth"], expected["depth"])
        assert torch.allclose(found["action"], expected["action"], atol=1e-5)
        columns.append((name, found))
    draw_scenes(columns)
    draw_features(seen)
    env.close()


def draw_scenes(columns: list[tuple[str, TensorDictBase]]) -> None:
    """A column a scene: its picture with the move in (x, y), and all five numbers below."""
    figure, axes = plt.subplots(1, len(columns), figsize=(8.6, 4.3))
    figure.subplots_adjust(left=0.04, right=0.99, top=0.92, bottom=0.27, wspace=0.08)
    for each, (title, seen) in zip(axes, columns, strict=True):
        show(each, seen["depth"][0], "gray")
        each.set_title(title, size=11)
        action = seen["action"].tolist()
        middle, reach = (SIZE - 1) / 2, SIZE / 3.2
        end = (middle + reach * action[2], middle + reach * action[1])  # (column y, row x)
        style = {"arrowstyle": "-|>", "color": ARROW, "lw": 2.2, "shrinkA": 0, "shrinkB": 0}
        each.annotate("", xy=end, xytext=(middle, middle), arrowprops=style)
        numbers = "\n".join(f"{n:>7} {v:+.2f}" for n, v in zip(NAMES, action, strict=True))
        place = {"transform": each.transAxes, "ha": "center", "va": "top"}
        each.text(0.5, -0.04, numbers, family="monospace", linespacing=1.3, **place)
    axes[0].set_ylabel("x, rows downwards", color=FAINT)
    axes[0].text(0.02, 0.97, "y, columns", transform=axes[0].transAxes, va="top", color="white")
    figure.savefig(FOLDER / "turned_scene.png", dpi=110)


def draw_features(observation: TensorDictBase) -> None:
    """The eight channels of a regular field of D4, of a picture and of the picture turned."""
    encoder = EquivariantEncoder(
        "D4",
        hidden=16,
        image_size=SIZE,
        backend="dense",
        generator=torch.Generator().manual_seed(1),
    )
    pictures = observation["depth"], turn(observation["depth"])
    before, after = (features(encoder, each, observation["holding"]) for each in pictures)
    inner = slice(SIZE // 4 - 10, SIZE // 4 + 10)  # without the walls of the bin
    shown = before[:, inner, inner]
    limits = shown.quantile(0.01).item(), shown.quantile(0.99).item()
    figure, axes = plt.subplots(2, 9, figsize=(11, 3.0))
    figure.subplots_adjust(left=0.01, right=0.99, top=0.92, bottom=0.02, wspace=0.06, hspace=0.22)
    names = ("s", "g s")
    for row, picture, maps, name in zip(axes, pictures, (before, after), names, strict=True):
        outer = slice(2 * inner.start, 2 * inner.stop)
        show(row[0], picture[0, outer, outer], "gray")
        row[0].set_title(name, size=9)
        for channel, (each, values) in enumerate(zip(row[1:], maps, strict=True)):
            show(each, values[inner, inner], "magma", limits)
            title = f"channel {channel + 1}"
            if name == "g s":  # whose map is the turned map of exactly one channel at s
                errors = (turn(before) - values).abs().flatten(1).amax(1)
                assert errors.sort().values[0] < 1e-6 < errors.sort().values[1]
                title = f"{channel + 1} = {errors.argmin().item() + 1} turned"
            each.set_title(title, size=8)
    figure.savefig(FOLDER / "feature_maps.png", dpi=100)


def turn(image: Tensor) -> Tensor:
    """A quarter turn of pictures (..., S, S)."""
    return ScalarField().transform(image, QUARTER)


@torch.no_grad()
def features(encoder: EquivariantEncoder, depth: Tensor, holding: Tensor) -> Tensor:
    """The first regular field after the second layer, shape (8, S / 2, S / 2)."""
    seen: list[Tensor] = []
    handle = encoder.layers[1].register_forward_hook(lambda layer, given, out: seen.append(out))
    encoder(depth[None], holding[None])
    handle.remove()
    return seen[0][0, :8]


def show(
    axes: Axes,
    values: Tensor,
    colours: str,
    limits: tuple[float | None, float | None] = (None, None),
) -> None:
    """A picture without ticks, its colours between the limits or those of the values."""
    axes.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1])
    axes.set_xticks([])
    axes.set_yticks([])


if __name__ == "__main__":
    main()
