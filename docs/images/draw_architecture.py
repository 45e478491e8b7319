"""Draws docs/images/architecture.png: how data goes through the rooms.

python docs/images/draw_architecture.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

INK, FAINT = "#222222", "#777777"
ROOMS = {  # colours of the rooms
    "envs": "#cfe3ee",
    "collectors": "#f8dcc4",
    "data": "#d6e8d2",
    "objectives": "#e6d9f0",
    "modules": "#f3d6e2",
    "training": "#eeeeee",
    "symmetry": "#fff1b8",
}
WIDTH, HEIGHT = 12.4, 8.3


def main() -> None:
    """Draws the figure and writes it beside this file."""
    plt.rcParams["font.size"] = 9
    figure = plt.figure(figsize=(WIDTH, HEIGHT))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(0, HEIGHT))
    axes.axis("off")

    def box(room: str, x: float, y: float, width: float, title: str, text: str = "") -> None:
        height = 1.02
        style = FancyBboxPatch(
            (x, y),
            width,
            height,
            "round,pad=0,rounding_size=0.08",
            fc=ROOMS[room],
            ec=FAINT,
            lw=0.8,
        )
        axes.add_patch(style)
        middle = x + width / 2
        axes.text(middle, y + height - 0.24, title, ha="center", va="center", weight="bold")
        axes.text(middle, y + (height - 0.3) / 2, text, ha="center", va="center", size=7.8)

    def arrow(start: tuple, end: tuple, text: str = "", where: tuple = (0, 0), **style) -> None:
        look = {"arrowstyle": "-|>", "color": INK, "lw": 1.1, "shrinkA": 0, "shrinkB": 0} | style
        axes.annotate("", xy=end, xytext=start, arrowprops=look)
        x, y = (start[0] + end[0]) / 2 + where[0], (start[1] + end[1]) / 2 + where[1]
        axes.text(x, y, text, ha="center", va="center", size=7.8, color=INK)

    def heading(x: float, y: float, text: str) -> None:
        axes.text(x, y, text, size=10, weight="bold", va="center", color=INK)

    heading(0.25, 8.0, "Acting: one observation from the simulator to the replay buffer")
    box("envs", 0.25, 6.65, 1.75, "Simulation", "PyBullet: poses\nand contacts")
    box("envs", 2.55, 6.65, 1.75, "Heightmap", "draws a Scene as seen\nfrom the gripper")
    box("envs", 4.85, 6.65, 1.95, "ManipulationEnv", "depth, holding,\nreward, done")
    box("collectors", 7.35, 6.65, 1.95, "SceneRollout", "transition; remembers seed\nand actions")
    box("data", 9.85, 6.65, 2.3, "ReplayBuffer.extend", "draws angles, stores depth\nin 16 bits")
    arrow((2.0, 7.16), (2.55, 7.16), "Scene", (0, 0.17))
    arrow((4.3, 7.16), (4.85, 7.16), "depth", (0, 0.17))
    arrow((6.8, 7.16), (7.35, 7.16))
    arrow((9.3, 7.16), (9.85, 7.16))

    box("collectors", 3.3, 5.1, 2.35, "OnlineCollector", "samples the actor; its own\nscenes")
    box(
        "collectors", 6.0, 5.1, 2.7, "DemonstrationCollector", "the task's Expert; keeps\nsuccesses"
    )
    arrow((4.5, 6.12), (7.7, 6.65), "action", (-0.95, 0.03))
    arrow((7.6, 6.12), (8.2, 6.65), "action", (0.35, -0.06))

    heading(4.6, 4.55, "Learning: one batch from the replay buffer to the optimiser")
    box(
        "data",
        9.85,
        3.2,
        2.3,
        "ReplayBuffer.sample",
        "float32 metres; turns each row\nby one of its angles",
    )
    box("training", 7.35, 3.2, 1.95, "Learner.update", "one gradient step")
    box("objectives", 4.6, 3.2, 2.2, "SACLoss.backward", "target, critic, actor,\ntemperature")
    box("modules", 2.2, 3.2, 1.95, "actor, critic", "steerable encoder\nand heads")
    box("training", 0.25, 3.2, 1.5, "Adam", "then the target:\nSoftUpdate")
    arrow((11.0, 6.65), (11.0, 4.22), "storage", (0.38, 0))
    arrow((9.85, 3.71), (9.3, 3.71), "batch", (0, 0.17))
    arrow((7.35, 3.71), (6.8, 3.71))
    arrow((4.6, 3.71), (4.15, 3.71))
    arrow((2.2, 3.71), (1.75, 3.71), "grad", (0, 0.17))
    arrow((3.2, 4.22), (4.0, 5.1), "policy", (-0.4, 0.06))

    heading(0.25, 2.55, "What is stated once")
    box(
        "symmetry",
        0.25,
        1.15,
        4.1,
        "SymmetryGroup + SymmetrySpec",
        "the group, and how each key transforms",
    )
    box("training", 8.05, 1.15, 4.1, "Config", "every key, its default and its range")
    box("envs", 4.65, 1.15, 3.1, "Task", "scene, success, planner")
    axes.text(0.35, 0.72, "→ networks, replay augmentation", size=8.5, va="center")
    axes.text(4.75, 0.72, "→ environment, expert, films", size=8.5, va="center")
    axes.text(8.15, 0.72, "← command line, conf/*.yaml   → TrainingRun", size=8.5, va="center")
    x = 0.25
    for room, colour in ROOMS.items():
        axes.add_patch(FancyBboxPatch((x, 0.17), 0.22, 0.18, "square,pad=0", fc=colour, ec=FAINT))
        axes.text(x + 0.3, 0.26, f"equirl.{room}", size=8, va="center", color=INK)
        x += 1.7
    figure.savefig(Path(__file__).with_name("architecture.png"), dpi=120)


if __name__ == "__main__":
    main()
