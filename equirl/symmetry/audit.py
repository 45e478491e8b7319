"""Does an environment have the symmetry? It is played against its own transformed copies.

The copies are made by `audit_transforms`, which shares no code with what is checked here but
the group's elements.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase

from equirl.symmetry.audit_quantities import FLAGS
from equirl.symmetry.audit_result import EnvAudit, describe
from equirl.symmetry.audit_transforms import (
    displace_objects,
    transform_action,
    transform_image,
    transform_scene,
)
from equirl.symmetry.groups import Element, SymmetryGroup

__all__ = ["Auditable", "Policy", "audit_env"]

Policy = Callable[[TensorDictBase], TensorDictBase]

_IDENTITY = Element(0.0)
_DISPLACED = 3  # copies with displaced objects, each in directions of its own


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
        env: The environment, or one with transforms around it, which are not audited.
        group: The group or its name.
        scenes: How many scenes.
        steps: Length of an episode, unless it ends earlier.
        seed: Of the scenes and of what is drawn here.
        policy: Writes ``action`` for the original episodes, for example an expert; copies replay
            it. None: actions are uniform in [-1, 1].
        reference: An environment of the same task that plays the same scenes and actions, for
            example with ``robot="hand"``: what only ``env`` shows is then due to its arm.
        pixel_tolerance: Depths differ if they do by more than this, m.
        displacement: Of the objects in the copies that show how much is noise, m.

    Returns:
        The errors, with tables of them and findings about their causes.

    Raises:
        ValueError: If the group has no element to audit, or there is nothing to play.
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
    originals = [_original(env, seed + index, steps, policy, rng) for index in range(scenes)]
    chiral = [_without_mirror_image(env, original.scene) for original in originals]
    environments = _labelled(env, reference)
    rows = []
    for label, environment in environments.items():
        for index, original in enumerate(originals):
            copies = _copies(elements, displacement, reflect=not chiral[index])
            for row in _audit_episode(environment, original, copies, pixel_tolerance, rng):
                rows.append({"environment": label, "scene": index, **row})
    return EnvAudit(
        group=group,
        elements=elements,
        left_out=tuple(g for g in group.some_elements() if not g.preserves_grid),
        environments=tuple(environments),
        unreflectable={index: names for index, names in enumerate(chiral) if names},
        actions=np.array([action for original in originals for action in original.actions]),
        comparisons={column: np.array([row[column] for row in rows]) for column in rows[0]},
    )


def _labelled(env: Auditable, reference: Auditable | None) -> dict[str, Auditable]:
    name = str(getattr(env, "robot", "audited"))
    if reference is None:
        return {name: env}
    other = str(getattr(reference, "robot", "reference"))
    return {name: env, other if other != name else f"{other} (reference)": reference}


def _without_mirror_image(env: Auditable, scene: Any) -> tuple[str, ...]:
    """Names of a scene's objects whose shape has no mirror plane y = 0."""
    bodies = getattr(getattr(env, "task", None), "bodies", {})
    names = dict.fromkeys(getattr(scene, "names", ()))
    return tuple(
        name for name in names if not getattr(bodies.get(name), "has_mirror_symmetry", True)
    )


# Copies ---------------------------------------------------------------------------------------


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
        values = transform_scene(scene.as_dict(), self.element)
        if self.distance:
            values = displace_objects(values, self.distance, rng)
        return type(scene).from_dict(values)

    def action(self, action: np.ndarray) -> np.ndarray:
        return transform_action(action, self.element, self.kind == "theta kept")


def _copies(elements: Sequence[Element], displacement: float, reflect: bool) -> list[_Copy]:
    copies = [_Copy("repeated")]
    copies += [_Copy("displaced", distance=displacement) for _ in range(_DISPLACED)]
    for element in elements:
        if not element.reflected:
            copies.append(_Copy("turned", element))
        elif reflect:
            copies += [_Copy("reflected", element), _Copy("theta kept", element)]
    return copies


# Playing --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Moment:
    """An environment before the first action or after one."""

    depth: np.ndarray  # (..., S, S), m
    flags: dict[str, float]
    scene: dict[str, Any]

    @classmethod
    def of(cls, env: Auditable, tensordict: TensorDictBase) -> _Moment:
        absent = torch.zeros(1)
        flags = {key: float(tensordict.get(key, absent).reshape(-1)[0]) for key in FLAGS}
        return cls(tensordict["depth"].cpu().numpy(), flags, env.get_scene().as_dict())

    @property
    def done(self) -> bool:
        return bool(self.flags["terminated"] or self.flags["truncated"])

    def transformed(self, element: Element) -> _Moment:
        """What a transformed copy should look like."""
        depth = transform_image(self.depth, element)
        return _Moment(depth, self.flags, transform_scene(self.scene, element))

    def errors(self, seen: _Moment, pixel_tolerance: float) -> dict[str, float]:
        """How far ``seen`` is off, for the key of each quantity."""
        pixels = np.abs(self.depth.astype(np.float64) - seen.depth)
        errors = {
            "depth": float((pixels > pixel_tolerance).mean()),
            "depth_mean": float(pixels.mean()),
            "depth_max": float(pixels.max()),
        }
        errors |= {key: float(self.flags[key] != seen.flags[key]) for key in FLAGS}
        for key in ("position", "yaw", "aperture"):
            errors[key] = float(np.linalg.norm(np.subtract(self.scene[key], seen.scene[key])))
        centres, others = (np.reshape(m.scene["objects"], (-1, 7))[:, :3] for m in (self, seen))
        errors["objects"] = float(np.linalg.norm(centres - others, axis=1).max(initial=0.0))
        return errors


@dataclass(frozen=True)
class _Play:
    """What was played from a scene."""

    scene: Any
    actions: list[np.ndarray]  # each (5,)
    moments: list[_Moment]  # before the first action and after each

    @property
    def scenes(self) -> list[Any]:
        """What was measured before each action."""
        return [type(self.scene).from_dict(moment.scene) for moment in self.moments[:-1]]


def _play(
    env: Auditable, scene: Any, choose: Callable[[TensorDictBase], np.ndarray], steps: int
) -> _Play:
    """Plays from ``scene`` until ``steps`` or the end."""
    current = env.set_scene(scene)
    play = _Play(scene, [], [_Moment.of(env, current)])
    for _ in range(steps):
        play.actions.append(choose(current))
        current.set("action", torch.from_numpy(play.actions[-1]))
        after = env.step(current)["next"]
        play.moments.append(_Moment.of(env, after))
        if play.moments[-1].done:
            break
        current = after.exclude("reward")
    return play


def _replay(env: Auditable, scene: Any, actions: Sequence[np.ndarray]) -> _Play:
    remaining = iter(actions)
    return _play(env, scene, lambda _: next(remaining), len(actions))


def _original(
    env: Auditable, seed: int, steps: int, policy: Policy | None, rng: np.random.Generator
) -> _Play:
    """Plays an episode on the scene of ``seed``."""

    def choose(observation: TensorDictBase) -> np.ndarray:
        if policy is None:
            return rng.uniform(-1, 1, 5).astype(np.float32)
        return policy(observation)["action"].cpu().numpy().copy()

    env.set_seed(seed)
    env.reset()
    return _play(env, env.get_scene(), choose, steps)


# Comparing ------------------------------------------------------------------------------------


def _audit_episode(
    env: Auditable,
    original: _Play,
    copies: Sequence[_Copy],
    pixel_tolerance: float,
    rng: np.random.Generator,
) -> Iterator[dict[str, Any]]:
    """Plays an episode and its copies: every step from the same state, then the whole of it."""
    starts = zip(original.scenes, original.actions, strict=True)
    steps = [_replay(env, scene, [action]) for scene, action in starts]
    episode = _replay(env, original.scenes[0], original.actions)
    for copy in copies:
        name = {"kind": copy.kind, "element": describe(copy.element)}
        for index, play in enumerate(steps):
            rest, step = _compare(env, play, copy, pixel_tolerance, rng)
            yield {**name, "play": "rest", "step": index, **rest}
            yield {**name, "play": "step", "step": index + 1, **step}
        _, *rows = _compare(env, episode, copy, pixel_tolerance, rng)
        for index, row in enumerate(rows, start=1):
            yield {**name, "play": "episode", "step": index, **row}


def _compare(
    env: Auditable, mine: _Play, copy: _Copy, pixel_tolerance: float, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Plays a copy; compares the two moment by moment, until the first of them ends."""
    actions = [copy.action(action) for action in mine.actions]
    seen = _replay(env, copy.scene(mine.scene, rng), actions)
    moments = list(zip(mine.moments, seen.moments, strict=False))
    rows = []
    for step, (one, other) in enumerate(moments):
        before = max(step - 1, 0)
        rows.append(
            {
                "clipped": _clips(env, mine, before) or _clips(env, seen, before),
                "last": step == len(moments) - 1,
                **one.transformed(copy.element).errors(other, pixel_tolerance),
            }
        )
    return rows


def _clips(env: Auditable, play: _Play, step: int) -> bool:
    """Whether the environment clips the target of the action of ``step`` to its workspace."""
    workspace = getattr(env, "workspace", None)
    if workspace is None:
        return False
    position = np.array(play.moments[step].scene["position"])
    target = position + workspace.position_step * play.actions[step][1:4]
    return bool(np.abs(workspace.clip(target) - target).max() > 1e-9)
