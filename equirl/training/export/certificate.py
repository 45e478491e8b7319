"""What an exported policy says of itself: a dictionary that fits into JSON, and a page of it."""

from __future__ import annotations

import math
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
    remembered,
    turning_errors,
)

__all__ = ["describe_policy", "image_of", "measure", "summary"]

_FORMAT = 1
#: The symmetry of the simulated tasks, which policies without any are measured against.
_TASK_GROUP = "D4"
#: At so many elements between those of the pixel grid it is measured, or fewer.
_MOST_BETWEEN = 8


def image_of(config: Config) -> HeightmapSpec:
    """What the depth image of a run shows."""
    view = make_task(config.env.task, **config.env.options).view
    return HeightmapSpec(config.observed_size, view)


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
                "meaning": "numbers from -1 to 1; what each stands for grows evenly with it, from "
                "`low` at -1 to `high` at 1, in `unit`",
                "components": {
                    "gripper": _component("distance between the fingers", "m", 0.0, opening),
                    "x": _component("displacement along world x", "m", -step, step),
                    "y": _component("displacement along world y", "m", -step, step),
                    "z": _component("displacement upwards", "m", -step, step),
                    "theta": _component("turn about the vertical, x to y", "rad", -turn, turn),
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


def _component(meaning: str, unit: str, low: float, high: float) -> dict[str, Any]:
    return {"meaning": meaning, "unit": unit, "low": float(low), "high": float(high)}


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
        The part of a certificate that is about symmetry. ``exact_on_grid`` holds only if every
        output turns as in the world, up to rounding, by the elements that map pixels onto pixels;
        ``between`` has the errors by others, None for a group that has no others.
    """
    measured = SymmetryGroup(group or _TASK_GROUP)
    elements = _measured_elements(measured)
    rules = [PHYSICAL, PAPER] if group and mode == PAPER else [PHYSICAL]
    policy = remembered(policy)  # rules differ in what is expected alone
    symmetry: dict[str, Any] = {}
    for rule in rules:
        rows = turning_errors(policy, observations, measured, elements, rule)
        grid = [row for row in rows if row["on_grid"]]
        between = [row for row in rows if not row["on_grid"]]
        exact = {
            name: bool(grid) and all(row[name]["largest"] <= tolerance[name] for row in grid)
            for name in OUTPUTS
        }
        over = {name: _together([row[name] for row in between]) for name in OUTPUTS if between}
        symmetry[rule] = {"exact_on_grid": exact, "between": over or None, "errors": rows}
    return {
        "elements_of": measured.name,
        "observations": len(observations.depth),
        "tolerance": tolerance,
        "symmetry": symmetry,
        "exact_on_grid": all(symmetry[PHYSICAL]["exact_on_grid"].values()),
    }


def _measured_elements(group: SymmetryGroup) -> list[Element]:
    """All that map pixels onto pixels but the identity, and some of the others."""
    grid = [g for g in group.grid_elements if g != Element(0.0)]
    others = [g for g in group.some_elements(8) if not g.preserves_grid]
    return grid + others[:: max(1, math.ceil(len(others) / _MOST_BETWEEN))]


def _together(errors: list[dict[str, float]]) -> dict[str, float]:
    """The errors by several elements as one: means, and the largest."""
    over = {key: sum(error[key] for error in errors) / len(errors) for key in errors[0]}
    return {**over, "largest": max(error["largest"] for error in errors)}


def summary(certificate: dict[str, Any]) -> str:
    """A certificate as a page of Markdown."""
    about, image = certificate, certificate["image"]
    policy = f"{about['group']}, {about['mode']} mode" if about["group"] else "no symmetry built in"
    lines = [
        f"{about['method']} policy ({policy}) of {about['task']}, seed {about['seed']}, "
        f"{about['steps']} steps; equirl {about['equirl']}, torch {about['torch']}",
        f"image: {image['pixels']} x {image['pixels']} pixels, {image['side_m']:g} m a side",
        f"measured on {about['observations']} observations",
    ]
    if "batches" in about:
        lines.append(f"compared in batches of {', '.join(map(str, about['batches']))}")
    for key, text in _LINES.items():
        if key in about:
            errors = ", ".join(f"{name} {error:.1e}" for name, error in about[key].items())
            lines.append(f"{text}: {errors}")
    for rule, found in about["symmetry"].items():
        rows, group = [row for row in found["errors"] if row["on_grid"]], about["elements_of"]
        if found["between"]:
            number = len(found["errors"]) - len(rows)
            rows.append({"element": f"{number} others of {group}", **found["between"]})
        cells = [[row["element"], *(_cell(row[name]) for name in OUTPUTS)] for row in rows]
        cells.append(["mean size", *(f"{rows[0][name]['size']:.1e}" for name in OUTPUTS)])
        lines += ["", _RULES[rule], "", markdown_table(["turn", *OUTPUTS], cells).strip()]
        lines += ["", _verdict(found, group)]
    return "\n".join(lines)


_LINES = {
    "rounding": "float32 instead of float64, at most",
    "difference": "this file instead of the policy of the run, at most",
    "tolerance": "up to here an error counts as rounding",
}
_RULES = {
    PHYSICAL: "Errors when the scene is turned, as the world turns; mean (largest):",
    PAPER: "Errors when the scene is turned, as the paper's networks declare it (theta and the "
    "deviations are invariants); mean (largest):",
}


def _cell(error: dict[str, float]) -> str:
    return f"{error['mean']:.1e} ({error['largest']:.1e})"


def _verdict(found: dict[str, Any], group: str) -> str:
    """What holds, in sentences."""
    grid, between = any(row["on_grid"] for row in found["errors"]), found["between"]
    scope = f"the turns of {group} that map pixels onto pixels"
    good = ", ".join(name for name in OUTPUTS if found["exact_on_grid"][name])
    bad = ", ".join(name for name in OUTPUTS if not found["exact_on_grid"][name])
    if not grid:
        verdict = f"Nothing is certified as exact: no turn of {group} maps pixels onto pixels."
    elif not bad:
        verdict = f"Exact up to rounding under {scope}: {good}."
    else:
        rest = f"; exact up to rounding: {good}" if good else ""
        verdict = f"Not exact under {scope}: {bad}{rest}."
    if between is None:
        return verdict
    where, error = "Between them" if grid else "At those it has", between["action"]
    return (
        f"{verdict} {where} the action, of a mean size of {error['size']:.1e}, errs by "
        f"{error['mean']:.1e} in the mean and {error['largest']:.1e} at most; turning the picture "
        f"there and back changes it by {error['there_and_back']:.1e} in the mean."
    )
