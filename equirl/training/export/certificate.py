"""What an exported policy says of itself: a dictionary that fits into JSON, and a page of it."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from torchrl.modules import ProbabilisticActor

from equirl.analysis.tables import markdown_table
from equirl.config import Config
from equirl.envs.heightmap import HeightmapSpec
from equirl.envs.tasks import make_task
from equirl.envs.workspace import WORKSPACE
from equirl.modules import METHODS, RadialTanhNormal
from equirl.symmetry import Element, SymmetryGroup
from equirl.training.export.formats import OUTPUTS, Policy
from equirl.training.export.measures import (
    PAPER,
    PHYSICAL,
    Observations,
    answers,
    batch_sizes,
    turning_errors,
)

__all__ = ["describe_policy", "image_of", "measure", "summary"]

_FORMAT = 1
#: The symmetry of the simulated tasks, which policies without any are measured against.
_TASK_GROUP = "D4"


def image_of(config: Config) -> HeightmapSpec:
    """What the depth image of a run shows."""
    view = make_task(config.env.task, **config.env.options).view
    return HeightmapSpec(config.env.image_size, view)


def describe_policy(config: Config, actor: ProbabilisticActor, steps: int) -> dict[str, Any]:
    """All that a certificate says without a measurement.

    Args:
        config: Of the run.
        actor: The policy.
        steps: Training steps it has behind it.
    """
    equivariant = METHODS[config.method.name].equivariant
    image = image_of(config)
    step, turn, opening = WORKSPACE.position_step, WORKSPACE.yaw_step, WORKSPACE.max_aperture
    radial = actor.module[-1].distribution_class is RadialTanhNormal
    of_each = "gripper, x, y, z, theta, before the squash"
    return {
        "format": _FORMAT,
        "equirl": version("equirl"),
        "torch": version("torch"),
        "task": config.env.task,
        "method": config.method.name,
        "group": SymmetryGroup(config.group).name if equivariant else None,
        "mode": config.mode if equivariant else None,
        "seed": config.seed,
        "steps": steps,
        "image": {
            "pixels": image.size,
            "side_m": image.side,
            "max_depth_m": image.max_depth,
            "axes": "seen straight from above, centred on the gripper; rows grow with world x, "
            "columns with world y; turning the gripper does not turn it",
        },
        "inputs": {
            "depth": {
                "shape": ["batch", 1, image.size, image.size],
                "type": "float32",
                "unit": "m",
                "meaning": "depth below the end effector, clipped to the range; the fingers are "
                "drawn at depth 0",
            },
            "holding": {
                "shape": ["batch", 1],
                "type": "float32",
                "unit": "1",
                "meaning": "1 while the fingers hold an object, else 0",
            },
        },
        "outputs": {
            "action": {
                "shape": ["batch", 5],
                "type": "float32",
                "unit": "1",
                "meaning": {
                    "gripper": f"from -1 to 1: the fingers {opening:g} m (u + 1) / 2 apart",
                    "x": f"from -1 to 1: a displacement of {step:g} m u along world x",
                    "y": f"from -1 to 1: a displacement of {step:g} m u along world y",
                    "z": f"from -1 to 1: a displacement of {step:g} m u upwards",
                    "theta": f"from -1 to 1: a turn of {turn:.6g} rad u about the vertical, "
                    "from x to y",
                },
            },
            "loc": {
                "shape": ["batch", 5],
                "type": "float32",
                "unit": "1",
                "meaning": f"mean of a Gaussian of {of_each}; the squashed mean is the action",
            },
            "scale": {
                "shape": ["batch", 5],
                "type": "float32",
                "unit": "1",
                "meaning": f"its standard deviations, of {of_each}",
            },
        },
        "squash": "tanh of gripper, z and theta; (x, y) keep their direction, and their length r "
        "becomes tanh(r)"
        if radial
        else "tanh of each number",
    }


def measure(
    policy: Policy,
    observations: Observations,
    tolerance: dict[str, float],
    group: str | None,
    mode: str | None,
) -> dict[str, Any]:
    """Measures whether a policy turns with the scene.

    Args:
        policy: What is measured.
        observations: What it is measured on.
        tolerance: For each output the largest error that is rounding.
        group: Of the policy; None for one that has no symmetry, which is measured against D4.
        mode: Of the policy; in ``"paper"`` mode it is also measured against what its networks
            declare.

    Returns:
        The part of a certificate that is about symmetry. ``exact`` holds only if every output
        turns as in the world, up to rounding.
    """
    measured = SymmetryGroup(group or _TASK_GROUP)
    elements = [g for g in measured.grid_elements if g != Element(0.0)]
    rules = [PHYSICAL, PAPER] if group and mode == PAPER else [PHYSICAL]
    before = answers(policy, observations)
    symmetry: dict[str, Any] = {}
    errors = turning_errors(policy, observations, before, elements, rules)
    for rule, rows in errors.items():
        exact = {
            name: bool(rows) and all(float(row[name]) <= tolerance[name] for row in rows)
            for name in OUTPUTS
        }
        symmetry[rule] = {"errors": rows, "exact": exact}
    return {
        "elements_of": measured.name,
        "observations": len(observations.depth),
        "batches": sorted(set(batch_sizes(len(observations.depth)))),
        "tolerance": tolerance,
        "symmetry": symmetry,
        "exact": all(symmetry[PHYSICAL]["exact"].values()),
    }


def summary(certificate: dict[str, Any]) -> str:
    """A certificate as a page of Markdown."""
    about, image = certificate, certificate["image"]
    policy = f"{about['group']}, {about['mode']} mode" if about["group"] else "no symmetry built in"
    lines = [
        f"{about['method']} policy ({policy}) of {about['task']}, seed {about['seed']}, "
        f"{about['steps']} steps; equirl {about['equirl']}, torch {about['torch']}",
        f"image: {image['pixels']} x {image['pixels']} pixels, {image['side_m']:g} m a side",
        f"measured on {about['observations']} observations, in batches of "
        f"{', '.join(map(str, about['batches']))}; the numbers below are the largest errors",
    ]
    for key, text in _LINES.items():
        if key in about:
            lines.append(f"{text}: " + ", ".join(f"{n} {e:.1e}" for n, e in about[key].items()))
    for rule, found in about["symmetry"].items():
        rows = [
            [row["element"], *(f"{row[name]:.1e}" for name in OUTPUTS), f"{row['unturned']:.1e}"]
            for row in found["errors"]
        ]
        if rows:
            columns = ["turn", *OUTPUTS, "action, left unturned"]
            lines += ["", _RULES[rule], "", markdown_table(columns, rows).strip()]
        lines += ["", _verdict(found["exact"], bool(rows), about["elements_of"])]
    return "\n".join(lines)


_LINES = {
    "rounding": "float32 instead of float64",
    "difference": "this file instead of the policy of the run",
    "tolerance": "up to here an error counts as rounding",
}
_RULES = {
    PHYSICAL: "Errors when the scene is turned, as the world turns:",
    PAPER: "Errors when the scene is turned, as the paper's networks declare it (theta and the "
    "deviations are invariants):",
}


def _verdict(exact: dict[str, bool], measured: bool, group: str) -> str:
    if not measured:
        return f"Nothing is certified: no turn of {group} maps pixels onto pixels."
    scope = f"the turns of {group} that map pixels onto pixels"
    good = [name for name in OUTPUTS if exact[name]]
    bad = [name for name in OUTPUTS if not exact[name]]
    if not bad:
        return f"Exact up to rounding under {scope}: {', '.join(good)}."
    rest = f"; exact up to rounding: {', '.join(good)}" if good else ""
    return f"Not exact under {scope}: {', '.join(bad)}{rest}."
