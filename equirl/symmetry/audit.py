"""Does an environment have the symmetry? It is played against its own transformed copies.

The audit turns and reflects raw arrays with arithmetic of its own. It shares no code with what it
checks: neither with the scenes' own `turned` and `reflected`, nor with the representations that
networks and replay buffers are built from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase

from .groups import Element, SymmetryGroup

__all__ = [
    "QUANTITIES",
    "Cause",
    "EnvAudit",
    "Finding",
    "Quantity",
    "audit_env",
    "markdown_table",
    "shown",
]

Policy = Callable[[TensorDictBase], TensorDictBase]


class Auditable(Protocol):
    """What the audit asks of an environment; `equirl.envs.ManipulationEnv` has it.

    Scenes are values with ``as_dict()`` and ``from_dict(values)``: ``position`` (3,) m, ``yaw``
    rad, ``aperture`` m, ``objects`` (N, 7) rows (x, y, z, qx, qy, qz, qw), ``areas`` (M, 3) rows
    (x, y, yaw); the symmetry leaves the vertical through the origin in place. Observations have
    ``depth`` (..., S, S) and ``holding``.

    Used where they exist: ``robot``, a name; ``workspace``, whose ``position_step`` and ``clip``
    tell which targets are clipped; ``task.bodies[name].has_mirror_symmetry``, without which every
    object is taken to be its own mirror image.
    """

    def set_seed(self, seed: int) -> Any:
        """Makes the scene of the next reset a function of ``seed``."""

    def reset(self) -> TensorDictBase:
        """Draws a scene; returns its observation."""

    def get_scene(self) -> Any:
        """Returns the measured scene."""

    def set_scene(self, scene: Any) -> TensorDictBase:
        """Starts from ``scene`` at rest; returns its observation."""

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Plays ``action``; writes ``next``."""


@dataclass(frozen=True)
class Quantity:
    """Something that is compared.

    Attributes:
        key: a key of the environment's tensordict, or an entry of the scene behind it.
        error: what the numbers are.
        unit: what they are shown in; they are stored in m, rad or as a share.
        scale: from the stored unit to the shown one.
        tolerance: an excess over the noise that is no finding, after a step, in the stored unit; a
            tenth of it when nothing has moved yet.
    """

    key: str
    error: str
    unit: str
    scale: float
    tolerance: float


#: What is compared, in the order of the table.
QUANTITIES = (
    Quantity("depth", "differing pixels", "%", 1e2, 5e-3),
    Quantity("depth_mean", "mean difference", "mm", 1e3, math.inf),
    Quantity("depth_max", "largest difference", "mm", 1e3, math.inf),
    Quantity("holding", "differs", "%", 1e2, 2e-2),
    Quantity("reward", "differs", "%", 1e2, 2e-2),
    Quantity("terminated", "differs", "%", 1e2, 2e-2),
    Quantity("truncated", "differs", "%", 1e2, 2e-2),
    Quantity("position", "distance", "mm", 1e3, 2e-5),
    Quantity("yaw", "difference", "mrad", 1e3, 1e-4),
    Quantity("aperture", "difference", "mm", 1e3, 2e-5),
    Quantity("objects", "distance of the worst", "mm", 1e3, 1e-4),
)
_BY_KEY = {quantity.key: quantity for quantity in QUANTITIES}
_FLAGS = ("holding", "reward", "terminated", "truncated")
_STATE = ("position", "yaw", "aperture", "objects")

_IDENTITY = Element(0.0)
_DISPLACED = 3  # copies with displaced objects, each in directions of its own
_NOISE_FACTOR = 3.0  # an error is a finding when it exceeds the noise so many times


# Transformations of raw arrays ----------------------------------------------------------------


def _plane(element: Element) -> np.ndarray:
    """The element's matrix on (x, y): exact, its entries are 0, 1 and -1."""
    turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), element.quarter_turns or 0)
    return turn @ np.diag([1, -1]) if element.reflected else turn


def _transform_image(image: np.ndarray, element: Element) -> np.ndarray:
    """Moves the pixels of (..., S, S), whose rows grow with x and columns with y."""
    if element.reflected:
        image = np.flip(image, axis=-1)
    return np.rot90(image, element.quarter_turns or 0, axes=(-2, -1))


def _transform_action(action: np.ndarray, element: Element, keep_theta: bool = False) -> np.ndarray:
    """Moves (x, y) of an action (5,) and reverses theta under reflection unless ``keep_theta``."""
    moved = action.copy()
    moved[1:3] = _plane(element) @ action[1:3]
    if element.reflected and not keep_theta:
        moved[4] = -action[4]
    return moved


def _transform_scene(values: Mapping[str, Any], element: Element) -> dict[str, Any]:
    """Moves everything in a scene's dictionary about the vertical through the origin."""
    plane, sign = _plane(element), -1.0 if element.reflected else 1.0
    angle = (element.quarter_turns or 0) * math.pi / 2
    position = np.array(values["position"], dtype=np.float64)
    position[:2] = plane @ position[:2]
    objects = _rows(values["objects"], 7)
    objects[:, :2] = objects[:, :2] @ plane.T
    x, y, z, w = objects[:, 3:].T * np.array([[sign], [1.0], [sign], [1.0]])
    sin, cos = math.sin(angle / 2), math.cos(angle / 2)
    turned = (cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z)
    objects[:, 3:] = np.stack(turned, axis=1)
    areas = _rows(values.get("areas", ()), 3)
    areas[:, :2] = areas[:, :2] @ plane.T
    areas[:, 2] = sign * areas[:, 2] + angle
    moved = {"position": position, "objects": objects, "areas": areas}
    lists = {key: array.tolist() for key, array in moved.items()}
    return {**values, **lists, "yaw": sign * values["yaw"] + angle}


def _displace_objects(
    values: Mapping[str, Any], distance: float, rng: np.random.Generator
) -> dict[str, Any]:
    """Moves each object of a scene's dictionary by ``distance`` (m) in a horizontal direction."""
    objects = _rows(values["objects"], 7)
    angles = rng.uniform(0, math.tau, len(objects))
    objects[:, :2] += distance * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return {**values, "objects": objects.tolist()}


def _rows(values: Any, width: int) -> np.ndarray:
    return np.array(values, dtype=np.float64).reshape(-1, width)


def _describe(element: Element) -> str:
    """``"90°"``, ``"flip"``, ``"flip, 90°"``: first the reflection, then the turn."""
    turn = f"{90 * (element.quarter_turns or 0)}°"
    if not element.reflected:
        return turn
    return "flip" if turn == "0°" else f"flip, {turn}"


# Playing --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Moment:
    """An environment before the first action or after one."""

    depth: np.ndarray  # (..., S, S), m
    flags: dict[str, float]
    scene: dict[str, Any]

    @property
    def done(self) -> bool:
        return bool(self.flags["terminated"] or self.flags["truncated"])

    def transformed(self, element: Element) -> _Moment:
        """What a transformed copy should look like."""
        depth = _transform_image(self.depth, element)
        return _Moment(depth, self.flags, _transform_scene(self.scene, element))

    def errors(self, seen: _Moment, pixel_tolerance: float) -> dict[str, float]:
        """How far ``seen`` is off, for the key of each quantity."""
        pixels = np.abs(self.depth.astype(np.float64) - seen.depth)
        errors = {
            "depth": float((pixels > pixel_tolerance).mean()),
            "depth_mean": float(pixels.mean()),
            "depth_max": float(pixels.max()),
        }
        errors |= {key: float(self.flags[key] != seen.flags[key]) for key in _FLAGS}
        for key in ("position", "yaw", "aperture"):
            errors[key] = float(np.linalg.norm(np.subtract(self.scene[key], seen.scene[key])))
        centres, others = (_rows(m.scene["objects"], 7)[:, :3] for m in (self, seen))
        errors["objects"] = float(np.linalg.norm(centres - others, axis=1).max(initial=0.0))
        return errors


@dataclass(frozen=True)
class _Copy:
    """One way to copy a scene and its actions.

    ``kind`` is ``"repeated"`` (the same again), ``"displaced"`` (objects moved by ``distance``),
    ``"turned"``, ``"reflected"`` or ``"theta kept"`` (reflected without theta's change of sign).
    """

    kind: str
    element: Element = _IDENTITY
    distance: float = 0.0

    def scene(self, scene: Any, rng: np.random.Generator) -> Any:
        if self.kind == "repeated":
            return scene
        values = _transform_scene(scene.as_dict(), self.element)
        if self.distance:
            values = _displace_objects(values, self.distance, rng)
        return type(scene).from_dict(values)

    def action(self, action: np.ndarray) -> np.ndarray:
        return _transform_action(action, self.element, self.kind == "theta kept")


@dataclass(frozen=True)
class _Plan:
    """An episode of the audited environment."""

    scenes: list[Any]  # before each action
    actions: list[np.ndarray]  # each (5,)


def _moment(env: Auditable, tensordict: TensorDictBase) -> _Moment:
    absent = torch.zeros(1)
    flags = {key: float(tensordict.get(key, absent).reshape(-1)[0]) for key in _FLAGS}
    return _Moment(tensordict["depth"].cpu().numpy(), flags, env.get_scene().as_dict())


def _play(
    env: Auditable, scene: Any, choose: Callable[[TensorDictBase, int], np.ndarray], steps: int
) -> tuple[list[_Moment], list[np.ndarray]]:
    """Plays from ``scene`` until ``steps`` or the end; returns moments and actions."""
    current = env.set_scene(scene)
    moments, actions = [_moment(env, current)], list[np.ndarray]()
    for index in range(steps):
        actions.append(choose(current, index))
        current.set("action", torch.from_numpy(actions[-1]))
        after = env.step(current)["next"]
        moments.append(_moment(env, after))
        if moments[-1].done:
            break
        current = after.exclude("reward")
    return moments, actions


def _replay(env: Auditable, scene: Any, actions: Sequence[np.ndarray]) -> list[_Moment]:
    return _play(env, scene, lambda _, index: actions[index], len(actions))[0]


def _clips(env: Auditable, scene: Mapping[str, Any], action: np.ndarray) -> bool:
    """Whether the environment would clip the target of ``action`` to its workspace."""
    workspace = getattr(env, "workspace", None)
    if workspace is None:
        return False
    target = np.array(scene["position"]) + workspace.position_step * action[1:4]
    return bool(np.abs(workspace.clip(target) - target).max() > 1e-9)


def _without_mirror_image(env: Auditable, scene: Any) -> tuple[str, ...]:
    """Names of a scene's objects whose shape has no mirror plane y = 0."""
    bodies = getattr(getattr(env, "task", None), "bodies", {})
    names = dict.fromkeys(getattr(scene, "names", ()))
    return tuple(
        name
        for name in names
        if name in bodies and not getattr(bodies[name], "has_mirror_symmetry", True)
    )


def _compare(
    env: Auditable,
    copy: _Copy,
    actions: Sequence[np.ndarray],
    mine: Sequence[_Moment],
    seen: Sequence[_Moment],
    pixel_tolerance: float,
) -> Iterator[dict[str, Any]]:
    """Compares two plays moment by moment, until the first of them ends."""
    moments = min(len(mine), len(seen))
    for step in range(moments):
        before, action = max(step - 1, 0), actions[max(step - 1, 0)]
        yield {
            "clipped": _clips(env, mine[before].scene, action)
            or _clips(env, seen[before].scene, copy.action(action)),
            "last": step == moments - 1,
            **mine[step].transformed(copy.element).errors(seen[step], pixel_tolerance),
        }


def _audit_plan(
    env: Auditable,
    plan: _Plan,
    copies: Sequence[_Copy],
    pixel_tolerance: float,
    rng: np.random.Generator,
) -> Iterator[dict[str, Any]]:
    """Plays a plan and its copies: every step from the same state, then the whole episode."""
    pairs = list(zip(plan.scenes, plan.actions, strict=True))
    steps = [_replay(env, scene, [action]) for scene, action in pairs]
    episode = _replay(env, plan.scenes[0], plan.actions)
    for copy in copies:
        name = {"kind": copy.kind, "element": _describe(copy.element)}
        for index, (scene, action) in enumerate(pairs):
            seen = _replay(env, copy.scene(scene, rng), [copy.action(action)])
            rows = _compare(env, copy, [action], steps[index], seen, pixel_tolerance)
            for play, row in zip(("rest", "step"), rows, strict=True):
                yield {**name, "play": play, "step": index + (play == "step"), **row}
        actions = [copy.action(action) for action in plan.actions]
        seen = _replay(env, copy.scene(plan.scenes[0], rng), actions)
        rows = _compare(env, copy, plan.actions, episode, seen, pixel_tolerance)
        for index, row in enumerate(rows):
            if index > 0:
                yield {**name, "play": "episode", "step": index, **row}


# The audit ------------------------------------------------------------------------------------


class Cause(StrEnum):
    """Why something differs."""

    REPEAT = "not repeatable"  #: the same scene and actions again do not give the same
    REST = "at rest"  #: differs before anything moves: the picture, or how a scene is set
    THETA = "sign of theta"  #: agrees under reflection when theta does not change its sign
    CLIPPING = "clipping"  #: agrees unless a target is clipped to the workspace
    JUDGEMENT = "judgement"  #: differs although the states agree
    ARM = "arm"  #: the reference agrees, or differs much less
    DYNAMICS = "dynamics"  #: anything else that happens in a step


@dataclass(frozen=True)
class Finding:
    """Something that differs by more than the noise.

    Attributes:
        environment: where.
        key: what.
        kind: in which copies.
        cause: why.
        error: how much it typically differs (m, rad or a share), see `EnvAudit.typical`.
        noise: how much it does when objects are displaced a little.
    """

    environment: str
    key: str
    kind: str
    cause: Cause
    error: float
    noise: float

    def __str__(self) -> str:
        quantity = _BY_KEY[self.key]
        error, noise = (shown(value * quantity.scale) for value in (self.error, self.noise))
        return (
            f"{self.environment}, {self.key}, {self.kind}: {self.cause} "
            f"({quantity.error} {error} {quantity.unit}, noise {noise})"
        )


@dataclass(frozen=True)
class EnvAudit:
    """What `audit_env` measured.

    A comparison is of one kind: ``"repeated"``, the same again; ``"displaced"``, with the objects
    moved a little, which shows how much is noise; ``"turned"``; ``"reflected"``; ``"theta kept"``,
    reflected with theta as it was, the simplification of the paper. And of one play: ``"rest"``, a
    scene that was set and not yet played; ``"step"``, one step from there; ``"episode"``, where
    errors add up.

    Attributes:
        group: whose elements were audited.
        elements: the audited elements, all without the identity.
        left_out: elements of the group that do not map the pixel grid, and the square bin and
            workspace, onto themselves: they are no symmetries to ask for.
        environments: what the audited environment is called, then the reference, if there is one.
        unreflectable: for scenes that were only turned: the objects that are not their own
            mirror images.
        actions: the actions played, shape (n, 5).
        comparisons: columns of one length: ``environment``, ``play``, ``kind``, ``element`` (such
            as ``"flip, 90°"``), ``scene``, ``step``, ``clipped`` (a target was clipped to the
            workspace), ``last`` (of its play), and the error of each of `QUANTITIES` (m, rad or a
            share).
    """

    group: SymmetryGroup
    elements: tuple[Element, ...]
    left_out: tuple[Element, ...]
    environments: tuple[str, ...]
    unreflectable: dict[int, tuple[str, ...]]
    actions: np.ndarray
    comparisons: dict[str, np.ndarray]

    def select(self, key: str, **conditions: Any) -> tuple[np.ndarray, np.ndarray]:
        """Returns some of the errors of ``key``, and the scenes they are from.

        Args:
            key: a key of `QUANTITIES`.
            conditions: for columns of `comparisons`, a value or a tuple of values.
        """
        chosen = np.ones(len(self.comparisons["scene"]), dtype=bool)
        for column, values in conditions.items():
            chosen &= np.isin(self.comparisons[column], values)
        return self.comparisons[key][chosen], self.comparisons["scene"][chosen]

    def typical(self, key: str, **conditions: Any) -> float:
        """Returns the error of ``key`` to expect; nan if nothing was compared.

        It is the mean over the comparisons of a scene and the median of those over scenes: rare
        events, which contact makes of any rounding, do not count. Of yes and no, and at rest, it is
        the mean over all.

        Args:
            key: a key of `QUANTITIES`.
            conditions: as for `select`.
        """
        errors, scenes = self.select(key, **conditions)
        if len(errors) == 0:
            return math.nan
        if key in _FLAGS or conditions.get("play") == "rest":
            return float(errors.mean())
        return float(np.median([errors[scenes == scene].mean() for scene in np.unique(scenes)]))

    def largest(self, key: str, **conditions: Any) -> float:
        """Returns the largest of the errors that `typical` summarizes, or nan."""
        errors, _ = self.select(key, **conditions)
        return float(errors.max()) if len(errors) else math.nan

    def growth(self, key: str, **conditions: Any) -> np.ndarray:
        """Returns the typical error of ``key`` after each step of an episode, shape (steps,)."""
        last = self.comparisons["step"].max(initial=0)
        steps = range(1, int(last) + 1)
        return np.array([self.typical(key, play="episode", step=t, **conditions) for t in steps])

    @property
    def clipped_targets(self) -> float:
        """The share of steps whose target was clipped to the workspace."""
        clipped, _ = self.select("clipped", play="step", environment=self.environments[0])
        return float(clipped.mean())

    @property
    def outside_disc(self) -> float:
        """The share of (x, y) actions that lie outside the unit disc."""
        return float((np.hypot(*self.actions[:, 1:3].T) > 1 + 1e-6).mean())

    @property
    def leaving_box(self) -> float:
        """The share of (x, y) actions that a uniform rotation takes out of [-1, 1]²."""
        norm = np.maximum(np.hypot(*self.actions[:, 1:3].T.astype(np.float64)), 1.0)
        # A vector of norm r in [1, sqrt 2] is outside for 8 arccos(1 / r) of the full angle.
        return float((4 / math.pi * np.arccos(1 / norm)).mean())

    @property
    def findings(self) -> list[Finding]:
        """What differs by more than the noise, and why; at most one for a key and a kind."""
        found = []
        for environment in self.environments:
            found += self._unrepeatable(environment)
            for quantity in QUANTITIES:
                for kind in ("turned", "reflected"):
                    cause = self._cause(quantity.key, environment, kind)
                    if cause is not None:
                        found.append(self._finding(quantity.key, environment, kind, cause))
        return found

    def _unrepeatable(self, environment: str) -> list[Finding]:
        """At most one finding, of the scene rather than of what is computed from it."""
        for key in ("objects", "position", "yaw", "aperture", "depth", *_FLAGS):
            error = self.largest(key, environment=environment, kind="repeated")
            if error > 0:
                return [Finding(environment, key, "repeated", Cause.REPEAT, error, 0.0)]
        return []

    def _finding(self, key: str, environment: str, kind: str, cause: Cause) -> Finding:
        where = {"environment": environment, "play": "rest" if cause is Cause.REST else "step"}
        error, noise = (self.typical(key, kind=each, **where) for each in (kind, "displaced"))
        return Finding(environment, key, kind, cause, error, noise)

    def _cause(self, key: str, environment: str, kind: str) -> Cause | None:
        """Why ``key`` differs, or None if it does not by more than the noise."""
        tolerance = _BY_KEY[key].tolerance

        def error(kind: str, environment: str = environment, **more: Any) -> float:
            where = {"environment": environment, "play": "step", "kind": kind} | more
            return self.typical(key, **where)

        def exceeds(error: float, other: float, tolerance: float = tolerance) -> bool:
            return error > _NOISE_FACTOR * other + tolerance  # not so if one is nan

        noise = error("displaced")
        if exceeds(error(kind, play="rest"), error("displaced", play="rest"), tolerance / 10):
            return Cause.REST
        free, clipped = error(kind, clipped=False), error(kind, clipped=True)
        if exceeds(clipped, max(noise, error("displaced", clipped=True))) and not (
            exceeds(free, noise)
        ):
            return Cause.CLIPPING
        if not exceeds(error(kind), noise):
            return None
        if kind == "reflected" and exceeds(error(kind), error("theta kept")):
            return Cause.THETA
        if key in _FLAGS and self._judged_differently(key, environment, kind):
            return Cause.JUDGEMENT
        reference = self.environments[-1]
        if environment == reference:
            return Cause.DYNAMICS
        if self._cause(key, reference, kind) is None:
            return Cause.ARM
        return Cause.ARM if exceeds(error(kind), error(kind, reference)) else Cause.DYNAMICS

    def _judged_differently(self, key: str, environment: str, kind: str) -> bool:
        where = {"environment": environment, "play": "step", "kind": kind}
        errors = {each: self.select(each, **where)[0] for each in (key, *_STATE)}
        agree = np.all([errors[each] < _BY_KEY[each].tolerance for each in _STATE], axis=0)
        return bool(agree.any() and errors[key][agree].mean() > _BY_KEY[key].tolerance)

    def table(self) -> str:
        """Returns the errors, how they grow, and the findings, as Markdown."""
        remarks = "\n".join(f"- {remark}" for remark in self.remarks)
        return "\n\n".join((self._error_table(), self._growth_table(), remarks))

    def __str__(self) -> str:
        return self.table()

    def _error_table(self) -> str:
        both = ("turned", "reflected")
        columns: dict[str, dict[str, Any]] = {"at rest": {"play": "rest", "kind": both}}
        for kind in (*both, "theta kept", "displaced"):
            columns[f"step: {kind}"] = {"play": "step", "kind": kind}
        for kind in (*both, "displaced"):
            columns[f"episode: {kind}"] = {"play": "episode", "kind": kind, "last": True}
        rows = [
            [f"{quantity.key}, {quantity.error}, {quantity.unit}", environment]
            + [self._cell(quantity, environment=environment, **where) for where in columns.values()]
            for quantity in QUANTITIES
            for environment in self.environments
        ]
        return markdown_table(["error: typical (largest)", "environment", *columns], rows)

    def _cell(self, quantity: Quantity, **conditions: Any) -> str:
        typical = shown(quantity.scale * self.typical(quantity.key, **conditions))
        if quantity.key in _FLAGS:
            return typical
        return f"{typical} ({shown(quantity.scale * self.largest(quantity.key, **conditions))})"

    def _growth_table(self) -> str:
        rows = []
        for key in ("depth", "position", "objects"):
            quantity = _BY_KEY[key]
            for environment in self.environments:
                for kind in ("turned", "reflected", "displaced"):
                    errors = quantity.scale * self.growth(key, environment=environment, kind=kind)
                    name = f"{key}, {quantity.error}, {quantity.unit}"
                    rows.append([name, environment, kind, *map(shown, errors)])
        steps = range(1, len(rows[0]) - 2)
        return markdown_table(
            ["typical error after step", "environment", "copy", *map(str, steps)], rows
        )

    @property
    def remarks(self) -> list[str]:
        """What the tables do not say, in sentences."""
        turns = sum(not element.reflected for element in self.elements)
        remarks = [
            f"{self.group.name}: {turns} turns and {len(self.elements) - turns} reflections audited"
            f", {len(self.left_out)} elements left out.",
            *(f"{name}: {self._told_apart(name)}." for name in self.environments),
            f"{self.clipped_targets:.0%} of the targets are clipped to the workspace. "
            f"{self.outside_disc:.0%} of the (x, y) actions lie outside the unit disc; a uniform "
            f"rotation takes {self.leaving_box:.1%} out of [-1, 1]².",
        ]
        for scene, names in self.unreflectable.items():
            listed = ", ".join(names)
            remarks.append(f"Scene {scene} is not reflected: no mirror plane y = 0 in {listed}.")
        findings = [f"Differs: {finding}." for finding in self.findings]
        return remarks + (findings or ["Nothing differs by more than the noise."])

    def _told_apart(self, environment: str) -> str:
        """Errors of the gripper after a step: by theta's sign, by clipping and by element."""
        where = {"environment": environment, "play": "step"}

        def error(key: str, kinds: str | Sequence[str], **more: Any) -> str:
            return shown(1e3 * self.typical(key, kind=kinds, **where, **more))

        both = ("turned", "reflected")
        elements = ", ".join(
            f"{error('position', both, element=name)} ({name})"
            for name in map(_describe, self.elements)
        )
        return (
            f"reflected, yaw errs by {error('yaw', 'reflected')} mrad after a step, by "
            f"{error('yaw', 'theta kept')} if theta keeps its sign; position by "
            f"{error('position', both, clipped=True)} mm where a target is clipped, by "
            f"{error('position', both, clipped=False)} elsewhere; by element, {elements}"
        )


def shown(value: float) -> str:
    """Returns an error as the tables have it: two digits, a bound if small, "-" for nan."""
    if math.isnan(value):
        return "-"
    return "<0.001" if 0 < value < 1e-3 else f"{float(f'{value:.2g}'):g}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


@torch.no_grad()
def audit_env(
    env: Auditable,
    group: SymmetryGroup | str,
    *,
    scenes: int = 10,
    steps: int = 8,
    seed: int = 0,
    policy: Policy | None = None,
    reference: Auditable | None = None,
    pixel_tolerance: float = 1e-3,
    displacement: float = 1e-6,
) -> EnvAudit:
    """Measures where an environment does not commute with a group.

    For each scene an episode is played; then, for each element, every step of it from the
    transformed state with the transformed action, and the whole episode from the transformed start.
    What the copies show is compared with the transformed original.

    Only the elements shared with D4 are audited, those that map the pixel grid, the square bin and
    the square workspace onto themselves; for C8, say, the eighth turns are left out, because no
    cell of this shape has them. Scenes with objects that are not their own mirror images are turned
    and not reflected. Afterwards the environments stand anywhere: set their seeds before use.

    Args:
        env: the environment, or one with transforms around it, which are not audited.
        group: the group or its name.
        scenes: how many scenes.
        steps: length of an episode, unless it ends earlier.
        seed: of the scenes and of what is drawn here.
        policy: writes ``action`` for the original episodes, for example an expert; copies replay
            it. None: actions are uniform in [-1, 1].
        reference: an environment of the same task that plays the same scenes and actions, for
            example with ``robot="hand"``: what only ``env`` shows is then due to its arm.
        pixel_tolerance: depths differ if they do by more than this, m.
        displacement: of the objects in the copies that show how much is noise, m.

    Returns:
        The errors, with tables of them and findings about their causes.

    Raises:
        ValueError: if the group has no element to audit, or there is nothing to play.
    """
    group = SymmetryGroup(group)
    elements = tuple(g for g in group.grid_elements if g != _IDENTITY)
    if not elements:
        raise ValueError(
            f"{group.name} has no element but the identity that maps a square pixel grid onto "
            "itself; nothing can be audited: try C4 or D4"
        )
    for name, count in (("scenes", scenes), ("steps", steps)):
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count!r}")
    # Transforms do not see that a scene is set: what they wrap is audited.
    env, reference = getattr(env, "base_env", env), getattr(reference, "base_env", reference)
    rng = np.random.default_rng(seed)
    plans = [_plan(env, seed + index, steps, policy, rng) for index in range(scenes)]
    names = {index: _without_mirror_image(env, plan.scenes[0]) for index, plan in enumerate(plans)}
    rows = []
    environments = _labelled(env, reference)
    for label, environment in environments.items():
        for index, plan in enumerate(plans):
            copies = _copies(elements, displacement, reflect=not names[index])
            for row in _audit_plan(environment, plan, copies, pixel_tolerance, rng):
                rows.append({"environment": label, "scene": index, **row})
    return EnvAudit(
        group=group,
        elements=elements,
        left_out=tuple(g for g in group.elements if not g.preserves_grid),
        environments=tuple(environments),
        unreflectable={index: found for index, found in names.items() if found},
        actions=np.array([action for plan in plans for action in plan.actions]),
        comparisons={column: np.array([row[column] for row in rows]) for column in rows[0]},
    )


def _labelled(env: Auditable, reference: Auditable | None) -> dict[str, Auditable]:
    name = str(getattr(env, "robot", "audited"))
    if reference is None:
        return {name: env}
    other = str(getattr(reference, "robot", "reference"))
    return {name: env, other if other != name else f"{other} (reference)": reference}


def _plan(
    env: Auditable, seed: int, steps: int, policy: Policy | None, rng: np.random.Generator
) -> _Plan:
    """Plays an original episode on the scene of ``seed``."""

    def choose(observation: TensorDictBase, _: int) -> np.ndarray:
        if policy is None:
            return rng.uniform(-1, 1, 5).astype(np.float32)
        return policy(observation)["action"].cpu().numpy().copy()

    env.set_seed(seed)
    env.reset()
    scene = env.get_scene()
    moments, actions = _play(env, scene, choose, steps)
    return _Plan([type(scene).from_dict(moment.scene) for moment in moments[:-1]], actions)


def _copies(elements: Sequence[Element], displacement: float, reflect: bool) -> list[_Copy]:
    copies = [_Copy("repeated")]
    copies += [_Copy("displaced", distance=displacement) for _ in range(_DISPLACED)]
    for element in elements:
        if not element.reflected:
            copies.append(_Copy("turned", element))
        elif reflect:
            copies += [_Copy("reflected", element), _Copy("theta kept", element)]
    return copies
