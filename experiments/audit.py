"""Measures whether the simulated tasks have the symmetry, with the arm and with the free hand.

    python experiments/audit.py --tasks block_picking block_pushing --group D4 --scenes 10 --steps 8

Prints a Markdown table with a row for each task, kind of actions and robot; with ``--details`` the
tables of each audit follow, with what was found. Cells with three numbers are typical errors of
copies that are turned / reflected / displaced by 1 µm, which shows how much is noise; copies replay
the actions of the original scene.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from command_line import at_least

from equirl.analysis.tables import markdown_row, markdown_table
from equirl.envs import make_env, make_expert
from equirl.envs.tasks import TASKS
from equirl.symmetry import EnvAudit, SymmetryGroup, audit_env
from equirl.symmetry.audit_quantities import shown

#: How the expert limits (x, y) of an action; random actions fill the box.
ACTIONS = {"random": None, "expert": "norm", "expert_box": "box"}


def main(given: list[str] | None = None) -> None:
    """Audits and prints."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--actions", nargs="+", choices=ACTIONS, default=["random", "expert"])
    parser.add_argument("--group", default="D4")
    parser.add_argument("--scenes", type=at_least(1), default=10)
    parser.add_argument("--steps", type=at_least(1), default=8)
    parser.add_argument("--seed", type=at_least(0), default=0)
    parser.add_argument("--image-size", type=at_least(2), default=128)
    parser.add_argument("--details", action="store_true")
    arguments = parser.parse_args(given)
    try:
        SymmetryGroup(arguments.group)
        make_env(arguments.tasks[0], image_size=arguments.image_size)
    except ValueError as error:
        parser.error(str(error))
    print(markdown_table(["task", "actions", "robot", *COLUMNS], []))
    details = ""
    for task in arguments.tasks:
        for actions in arguments.actions:
            audit = audit_task(task, actions, arguments)
            for robot in audit.environments:
                cells = [task, actions, robot]
                cells += [column(audit, robot) for column in COLUMNS.values()]
                print(markdown_row(cells), flush=True)
            details += f"\n## {task}, actions: {actions}\n\n{audit}\n"
    if arguments.details:
        print(details)


def audit_task(task: str, actions: str, arguments: argparse.Namespace) -> EnvAudit:
    """Audits the arm against the free hand."""
    size = arguments.image_size
    env = make_env(task, image_size=size, robot="panda")
    hand = make_env(task, image_size=size, robot="hand")
    clip = ACTIONS[actions]
    audit = audit_env(
        env,
        arguments.group,
        scenes=arguments.scenes,
        steps=arguments.steps,
        seed=arguments.seed,
        policy=make_expert(env, horizontal_clip=clip) if clip else None,
        reference=hand,
    )
    env.close()
    hand.close()
    return audit


def errors(key: str, scale: float, *kinds: str, **where: Any) -> Callable[[EnvAudit, str], str]:
    """A cell with the typical error of ``key`` in each kind of copy."""

    def cell(audit: EnvAudit, robot: str) -> str:
        values = [audit.typical(key, kind=kind, environment=robot, **where) for kind in kinds]
        return " / ".join(shown(scale * value) for value in values)

    return cell


COPIES = ("turned", "reflected", "displaced")
STEP = {"play": "step"}
END = {"play": "episode", "last": True}
#: What is shown of an audit and a robot: errors of copies turned / reflected / displaced by 1 µm,
#: which is the noise. "At the end" is of episodes, "after a step" from the same state.
COLUMNS: dict[str, Callable[[EnvAudit, str], str]] = {
    "pixels at rest, %": errors("depth", 1e2, *COPIES, play="rest"),
    "gripper after a step, mm": errors("position", 1e3, *COPIES, **STEP),
    "objects after a step, mm": errors("objects", 1e3, *COPIES, **STEP),
    "pixels at the end, %": errors("depth", 1e2, *COPIES, **END),
    "objects at the end, mm": errors("objects", 1e3, *COPIES, **END),
    "reward differs, %": errors("reward", 1e2, *COPIES, **END),
    "yaw after a step, mrad (reflected / theta kept)": errors(
        "yaw", 1e3, "reflected", "theta kept", **STEP
    ),
    "targets clipped, %": lambda audit, _: shown(1e2 * audit.clipped_targets),
    "(x, y) leaving the box, %": lambda audit, _: shown(1e2 * audit.leaving_box),
}


if __name__ == "__main__":
    main()
