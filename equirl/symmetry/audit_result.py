"""What an audit measured: its errors, what they are due to, and tables of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import product
from typing import Any

import numpy as np

from equirl.symmetry.audit_quantities import FLAGS, QUANTITIES, Quantity
from equirl.symmetry.groups import Element, SymmetryGroup

__all__ = ["Cause", "EnvAudit", "Finding", "describe", "markdown_table"]

_STATE = ("position", "yaw", "aperture", "objects")
_MOVED = ("turned", "reflected")
_NOISE_FACTOR = 3.0  # an error is a finding when it exceeds the noise so many times


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
        environment: Where.
        key: What.
        kind: In which copies.
        cause: Why.
        error: How much it typically differs (m, rad or a share), see `EnvAudit.typical`.
        noise: How much it does when objects are displaced a little.
    """

    environment: str
    key: str
    kind: str
    cause: Cause
    error: float
    noise: float

    def __str__(self) -> str:
        quantity = QUANTITIES[self.key]
        error, noise = map(quantity.shown, (self.error, self.noise))
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
        group: Whose elements were audited.
        elements: The audited elements, all without the identity.
        left_out: Elements of the group that do not map the pixel grid, and the square bin and
            workspace, onto themselves: they are no symmetries to ask for.
        environments: What the audited environment is called, then the reference, if there is one.
        unreflectable: For scenes that were only turned: the objects that are not their own
            mirror images.
        actions: The actions played, shape (n, 5).
        comparisons: Columns of one length: ``environment``, ``play``, ``kind``, ``element`` (such
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
            key: A key of `QUANTITIES`.
            conditions: For columns of `comparisons`, a value or a tuple of values.
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
            key: A key of `QUANTITIES`.
            conditions: As for `select`.
        """
        errors, scenes = self.select(key, **conditions)
        if len(errors) == 0:
            return math.nan
        if key in FLAGS or conditions.get("play") == "rest":
            return float(errors.mean())
        return float(np.median([errors[scenes == scene].mean() for scene in np.unique(scenes)]))

    def largest(self, key: str, **conditions: Any) -> float:
        """Returns the largest of the errors that `typical` summarizes, or nan."""
        errors, _ = self.select(key, **conditions)
        return float(errors.max()) if len(errors) else math.nan

    def growth(self, key: str, **conditions: Any) -> np.ndarray:
        """Returns the typical error of ``key`` after each step of an episode, shape (steps,)."""
        steps = range(1, int(self.comparisons["step"].max()) + 1)
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
            for key, kind in product(QUANTITIES, _MOVED):
                cause = self._cause(key, environment, kind)
                if cause is None:
                    continue
                play = "rest" if cause is Cause.REST else "step"
                error, noise = (
                    self.typical(key, environment=environment, play=play, kind=each)
                    for each in (kind, "displaced")
                )
                found.append(Finding(environment, key, kind, cause, error, noise))
        return found

    def _unrepeatable(self, environment: str) -> list[Finding]:
        """At most one finding, of the scene rather than of what is computed from it."""
        for key in ("objects", "position", "yaw", "aperture", "depth", *FLAGS):
            error = self.largest(key, environment=environment, kind="repeated")
            if error > 0:
                return [Finding(environment, key, "repeated", Cause.REPEAT, error, 0.0)]
        return []

    def _cause(self, key: str, environment: str, kind: str) -> Cause | None:
        """Why ``key`` differs, or None if it does not by more than the noise."""
        tolerance = QUANTITIES[key].tolerance

        def error(kind: str, environment: str = environment, **more: Any) -> float:
            where = {"environment": environment, "play": "step", "kind": kind} | more
            return self.typical(key, **where)

        def exceeds(error: float, other: float, tolerance: float = tolerance) -> bool:
            return error > _NOISE_FACTOR * other + tolerance  # not so if one is nan

        if exceeds(error(kind, play="rest"), error("displaced", play="rest"), tolerance / 10):
            return Cause.REST
        noise = error("displaced")
        clipped, free = (error(kind, clipped=where) for where in (True, False))
        most_noise = max(noise, error("displaced", clipped=True))
        if exceeds(clipped, most_noise) and not exceeds(free, noise):
            return Cause.CLIPPING
        if not exceeds(error(kind), noise):
            return None
        if kind == "reflected" and exceeds(error(kind), error("theta kept")):
            return Cause.THETA
        if key in FLAGS and self._judged_differently(key, environment, kind):
            return Cause.JUDGEMENT
        reference = self.environments[-1]
        if environment == reference:
            return Cause.DYNAMICS
        agrees = self._cause(key, reference, kind) is None
        better = agrees or exceeds(error(kind), error(kind, reference))
        return Cause.ARM if better else Cause.DYNAMICS

    def _judged_differently(self, key: str, environment: str, kind: str) -> bool:
        where = {"environment": environment, "play": "step", "kind": kind}
        errors = {each: self.select(each, **where)[0] for each in (key, *_STATE)}
        agree = np.all([errors[each] < QUANTITIES[each].tolerance for each in _STATE], axis=0)
        return bool(agree.any() and errors[key][agree].mean() > QUANTITIES[key].tolerance)

    def table(self) -> str:
        """Returns the errors, how they grow, and the findings, as Markdown."""
        remarks = "\n".join(f"- {remark}" for remark in self.remarks)
        return "\n\n".join((self._error_table(), self._growth_table(), remarks))

    def __str__(self) -> str:
        return self.table()

    def _error_table(self) -> str:
        columns: dict[str, dict[str, Any]] = {"at rest": {"play": "rest", "kind": _MOVED}}
        for kind in (*_MOVED, "theta kept", "displaced"):
            columns[f"step: {kind}"] = {"play": "step", "kind": kind}
        for kind in (*_MOVED, "displaced"):
            columns[f"episode: {kind}"] = {"play": "episode", "kind": kind, "last": True}
        rows = [
            [quantity.title, environment]
            + [self._cell(quantity, environment=environment, **where) for where in columns.values()]
            for quantity, environment in product(QUANTITIES.values(), self.environments)
        ]
        return markdown_table(["error: typical (largest)", "environment", *columns], rows)

    def _cell(self, quantity: Quantity, **conditions: Any) -> str:
        typical = quantity.shown(self.typical(quantity.key, **conditions))
        if quantity.key in FLAGS:
            return typical
        return f"{typical} ({quantity.shown(self.largest(quantity.key, **conditions))})"

    def _growth_table(self) -> str:
        rows = []
        keys, kinds = ("depth", "position", "objects"), (*_MOVED, "displaced")
        for key, environment, kind in product(keys, self.environments, kinds):
            growth = self.growth(key, environment=environment, kind=kind)
            errors = map(QUANTITIES[key].shown, growth)
            rows.append([QUANTITIES[key].title, environment, kind, *errors])
        steps = map(str, range(1, len(growth) + 1))
        return markdown_table(["typical error after step", "environment", "copy", *steps], rows)

    @property
    def remarks(self) -> list[str]:
        """What the tables do not say, in sentences."""
        turns = sum(not element.reflected for element in self.elements)
        left_out = len(self.left_out) if self.group.is_finite else "all other"
        remarks = [
            f"{self.group.name}: {turns} turns and {len(self.elements) - turns} reflections audited"
            f", {left_out} elements left out.",
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

        def error(key: str, **where: Any) -> str:
            value = self.typical(key, environment=environment, play="step", **where)
            return QUANTITIES[key].shown(value)

        elements = ", ".join(
            f"{error('position', kind=_MOVED, element=name)} ({name})"
            for name in map(describe, self.elements)
        )
        return (
            f"reflected, yaw errs by {error('yaw', kind='reflected')} mrad after a step, by "
            f"{error('yaw', kind='theta kept')} if theta keeps its sign; position by "
            f"{error('position', kind=_MOVED, clipped=True)} mm where a target is clipped, by "
            f"{error('position', kind=_MOVED, clipped=False)} elsewhere; by element, {elements}"
        )


def describe(element: Element) -> str:
    """Returns ``"90°"``, ``"flip"``, ``"flip, 90°"``: first the reflection, then the turn."""
    turn = f"{math.degrees(element.angle):g}°"
    if not element.reflected:
        return turn
    return "flip" if turn == "0°" else f"flip, {turn}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
