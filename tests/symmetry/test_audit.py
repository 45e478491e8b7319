"""The audit sees exact symmetry as such, and names the key and the cause of planted faults."""

import functools
import math
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torchrl.envs import DoubleToFloat, TransformedEnv

from equirl.envs import Scene, make_env, make_expert
from equirl.symmetry import ACTION, Element, ScalarField, SymmetryGroup, audit_env
from equirl.symmetry.audit_result import Cause
from equirl.symmetry.audit_transforms import transform_action, transform_image, transform_scene

D4 = SymmetryGroup("D4").elements


class Bounds:
    """The workspace."""

    position_step = 0.05

    def __init__(self, x: float, y: float):
        self.high = np.array([x, y, 0.25])

    def clip(self, position):
        return np.clip(position, [*-self.high[:2], 0.01], self.high)


class PointWorld:
    """A point on a plane that drags discs along; exactly symmetric unless a fault is planted."""

    def __init__(self, fault=None, mirrored=True):
        self.fault = fault
        self.workspace = Bounds(0.05, 0.04) if fault == "clipping" else Bounds(0.15, 0.15)
        body = SimpleNamespace(has_mirror_symmetry=mirrored)
        self.task = SimpleNamespace(bodies={"first": body, "second": body})
        self.steps_ever = 0

    def set_seed(self, seed):
        self.rng = np.random.default_rng(seed)

    def reset(self):
        objects = np.zeros((2, 7))
        objects[:, :2] = self.rng.uniform(-0.1, 0.1, (2, 2))
        objects[:, 3:] = Rotation.random(2, self.rng).as_quat()
        return self.set_scene(Scene([0, 0, 0.2], 0.0, 0.08, objects, names=("first", "second")))

    def get_scene(self):
        return self.scene

    def set_scene(self, scene):
        self.scene = scene
        return self.observe()

    def step(self, tensordict):
        scene, action = self.scene, tensordict["action"].numpy().astype(np.float64)
        self.steps_ever += 1
        scale = np.array([1.03 if self.fault == "dynamics" else 1.0, 1.0, 1.0])
        position = self.workspace.clip(scene.position + 0.05 * scale * action[1:4])
        if self.fault == "memory":
            position[2] = 0.1 + 1e-4 * self.steps_ever
        objects = scene.objects.copy()
        near = np.hypot(*(objects[:, :2] - scene.position[:2]).T) < 0.05
        objects[near, :2] += position[:2] - scene.position[:2]
        turn = math.pi / 4 * action[4]
        if self.fault == "theta":  # the sense of theta turns over with the scene
            turn *= np.sign(np.cross(*scene.objects[:, :2]))
        aperture = 0.04 * (action[0] + 1)
        self.scene = Scene(position, scene.yaw + turn, aperture, objects, names=scene.names)
        after = self.observe()
        x, y = abs(position[0]), abs(position[1])
        success = (x if self.fault == "reward" else max(x, y)) > 0.06
        after.set("reward", torch.tensor([float(success)]))
        after.set("terminated", torch.tensor([success]))
        after.set("truncated", torch.tensor([False]))
        return tensordict.set("next", after)

    def observe(self):
        scene, size = self.scene, 32
        shift = 0.0 if self.fault == "pivot" else 0.5
        centres = (np.arange(size) + shift - size / 2) * 0.3 / size
        x, y = centres[:, None], centres[None, :]
        depth = np.full((size, size), scene.position[2])
        for where in scene.objects:
            inside = np.hypot(x - where[0] + scene.position[0], y - where[1] + scene.position[1])
            depth[inside < 0.033] -= 0.05
        cos, sin = math.cos(scene.yaw), math.sin(scene.yaw)
        depth[(abs(cos * x + sin * y) < 0.0437) & (abs(cos * y - sin * x) < 0.0131)] = 0.0
        if self.fault == "picture":
            depth = np.roll(depth, 1, axis=0)
        near = np.hypot(*(scene.objects[:, :2] - scene.position[:2]).T) < 0.05
        values = {
            "depth": torch.tensor(depth[None], dtype=torch.float32),
            "holding": torch.tensor([float(near.any())]),
        }
        return TensorDict(values)


@functools.cache  # what is measured does not change
def audited(fault=None, group="D4", **options):
    return audit_env(PointWorld(fault), group, scenes=4, steps=5, **options)


def example(rng) -> Scene:
    objects = np.concatenate((rng.normal(size=(3, 3)), Rotation.random(3, rng).as_quat()), 1)
    return Scene(rng.normal(size=3), rng.normal(), 0.05, objects, areas=rng.normal(size=(2, 3)))


def moved(scene, element) -> Scene:
    return Scene.from_dict(transform_scene(scene.as_dict(), element))


@pytest.mark.parametrize("element", SymmetryGroup("D8").elements)
def test_scenes_move_by_the_matrix_of_the_element(element):
    mirror = np.diag([1, -1 if element.reflected else 1, 1])
    matrix = Rotation.from_euler("z", element.angle).as_matrix() @ mirror

    def axes(yaws):
        return np.stack((np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)), -1)

    rng = np.random.default_rng(0)
    for _ in range(20):
        scene = example(rng)
        seen = moved(scene, element)
        assert (seen.aperture, seen.grip) == (scene.aperture, scene.grip)
        for get in (
            lambda each: each.position,
            lambda each: each.objects[:, :3],
            lambda each: axes(np.array(each.yaw)),
            lambda each: axes(each.areas[:, 2]),
            lambda each: each.areas * (1, 1, 0),
        ):
            np.testing.assert_allclose(get(seen), get(scene) @ matrix.T, atol=1e-12)
        before, after = (Rotation.from_quat(each.objects[:, 3:]) for each in (scene, seen))
        # A body is its own mirror image: the reflection is undone in its frame.
        expected = matrix @ before.as_matrix() @ mirror
        np.testing.assert_allclose(after.as_matrix(), expected, atol=1e-12)


@pytest.mark.parametrize("element", D4)
def test_on_the_grid_positions_are_moved_exactly(element):
    scene = seen = example(np.random.default_rng(0))
    for _ in range(4):
        seen = moved(seen, element)
    np.testing.assert_array_equal(seen.position, scene.position)
    np.testing.assert_array_equal(seen.objects[:, :3], scene.objects[:, :3])
    np.testing.assert_array_equal(seen.areas[:, :2], scene.areas[:, :2])


def test_pixels_are_not_turned_by_half_a_quarter():
    with pytest.raises(ValueError, match="quarter turns, .* got a turn by 45°"):
        transform_image(np.zeros((4, 4)), Element(math.pi / 4))


@pytest.mark.parametrize("element", D4)
def test_images_and_actions_move_as_the_package_moves_them(element):
    image, action = torch.rand(1, 6, 6), torch.rand(5) * 2 - 1
    turned = transform_image(image.numpy(), element)
    assert np.array_equal(turned, ScalarField().transform(image, element).numpy())
    played = transform_action(action.numpy(), element)
    np.testing.assert_allclose(played, ACTION.transform(action, element).numpy(), atol=1e-7)


def test_exact_symmetry_has_no_error():
    audit = audited()
    assert audit.findings == []
    for kind in ("repeated", "turned", "reflected"):
        for key in ("depth_max", "holding", "reward", "terminated", "position", "yaw", "objects"):
            assert audit.largest(key, kind=kind) < 1e-6, (kind, key)
    assert audit.comparisons["reward"].shape == audit.comparisons["element"].shape
    assert "Nothing differs" in str(audit)
    assert set(audit.comparisons["play"]) == {"rest", "step", "episode"}
    # The noise of 1 micrometre does show.
    assert audit.largest("objects", kind="displaced") == pytest.approx(1e-6, rel=1e-3)


@pytest.mark.parametrize(
    ("fault", "cause", "keys"),
    [
        ("picture", Cause.REST, {"depth"}),
        ("pivot", Cause.REST, {"depth"}),
        ("theta", Cause.THETA, {"depth", "yaw"}),
        ("reward", Cause.JUDGEMENT, {"reward", "terminated"}),
        ("clipping", Cause.CLIPPING, {"position"}),
        ("dynamics", Cause.DYNAMICS, {"position"}),
        ("memory", Cause.REPEAT, {"position"}),
    ],
)
def test_planted_faults_are_named(fault, cause, keys):
    findings = audited(fault).findings
    assert keys <= {finding.key for finding in findings if finding.cause is cause}, findings
    if cause is not Cause.REPEAT:
        assert {finding.cause for finding in findings} == {cause}, findings
    assert any(cause in str(finding) for finding in findings)


def test_what_only_the_audited_environment_shows_is_its_arm():
    audit = audited("dynamics", reference=PointWorld())
    assert {finding.cause for finding in audit.findings} == {Cause.ARM}
    assert {finding.environment for finding in audit.findings} == {"audited"}
    assert audit.typical("position", environment="reference", kind="turned") == 0


def test_error_of_theta_without_its_sign():
    audit = audited()
    turns = np.abs(audit.actions[:, 4]) * math.pi / 2
    kept = {"kind": "theta kept", "play": "step"}
    assert audit.largest("yaw", **kept) == pytest.approx(turns.max(), rel=1e-6)
    assert audit.largest("yaw", kind="reflected", play="step") < 1e-12
    assert audit.largest("yaw", **kept, element="flip, 90°") > 0.1


def test_errors_grow_along_an_episode():
    growth = audited("dynamics").growth("position", kind="turned")
    assert growth.shape == (5,)
    assert growth[2] > 1.5 * growth[0] > 0


def test_actions_that_a_rotation_takes_out_of_the_box():
    audit = audited()
    angles = np.linspace(0, 2 * math.pi, 721)[:-1]
    turned = audit.actions[:, 1:3].astype(float) @ np.array(
        [[np.cos(angles), np.sin(angles)], [-np.sin(angles), np.cos(angles)]]
    ).transpose(2, 0, 1)
    outside = (np.abs(turned) > 1).any(-1).mean()
    assert audit.leaving_box == pytest.approx(outside, abs=0.01)
    assert audit.outside_disc > 0 and audit.clipped_targets > 0

    def disc(tensordict):
        x, y = 0.8, 0.6
        return tensordict.set("action", torch.tensor([0.0, x, y, 0.0, 0.3]))

    inside = audited(policy=disc)
    assert inside.outside_disc == 0 and inside.leaving_box < 1e-3
    np.testing.assert_allclose(inside.actions[0], [0.0, 0.8, 0.6, 0.0, 0.3], rtol=1e-6)


def test_elements_that_are_audited():
    audit = audited(group="c8")
    assert len(audit.elements) == 3 and len(audit.left_out) == 4
    assert set(audit.comparisons["element"]) == {"0°", "90°", "180°", "270°"}
    assert math.isnan(audit.typical("depth", kind="reflected"))
    assert "4 elements left out" in audit.table()
    with pytest.raises(ValueError, match="C3 has no element"):
        audited(group="C3")


@pytest.mark.parametrize(("group", "counts"), [("SO2", (3, 0)), ("O2", (3, 4))])
def test_of_a_continuous_group_the_grid_elements_are_audited(group, counts):
    audit = audited(group=group)
    assert len(audit.elements) == sum(counts)
    assert all(element.preserves_grid for element in audit.elements)
    expected = f"{group}: {counts[0]} turns and {counts[1]} reflections audited, all other elements"
    assert expected in audit.table()
    assert audit.findings == []


@pytest.mark.parametrize("option", ["scenes", "steps"])
def test_there_must_be_something_to_play(option):
    with pytest.raises(ValueError, match=f"{option} must be at least 1, got 0"):
        audit_env(PointWorld(), "C4", **{option: 0})


def test_objects_without_a_mirror_plane_are_not_reflected():
    audit = audit_env(PointWorld(mirrored=False), "D4", scenes=2, steps=2)
    assert audit.unreflectable == {0: ("first", "second"), 1: ("first", "second")}
    assert set(audit.comparisons["kind"]) == {"repeated", "displaced", "turned"}
    assert "Scene 0 is not reflected: no mirror plane y = 0 in first, second" in audit.table()
    assert audit.findings == []


def test_the_free_hand_picks_blocks_symmetrically():
    env = make_env("block_picking", image_size=64, robot="hand")
    audit = audit_env(TransformedEnv(env, DoubleToFloat()), "D4", scenes=2, policy=make_expert(env))
    env.close()
    assert audit.environments == ("hand",)
    assert audit.findings == []
    assert audit.comparisons["last"].any() and not audit.select("reward", kind="turned")[0].any()
    for kind in ("turned", "reflected"):
        assert audit.largest("depth", play="rest", kind=kind) < 2e-3  # silhouettes
        assert audit.largest("terminated", kind=kind) == 0
        assert audit.largest("position", kind=kind, play="step") < 1e-5
    assert audit.typical("yaw", kind="theta kept", play="step") > 1e-2


def test_the_arm_is_told_from_the_hand():
    env, hand = (make_env("block_picking", image_size=64, robot=name) for name in ("panda", "hand"))
    audit = audit_env(env, "C4", scenes=2, steps=3, reference=hand)
    env.close()
    hand.close()
    found = {(finding.environment, finding.key, finding.cause) for finding in audit.findings}
    assert ("panda", "position", Cause.ARM) in found
    assert {environment for environment, _, _ in found} == {"panda"}


def test_entry_point(capsys, monkeypatch):
    script = Path(__file__).parents[2] / "experiments" / "audit.py"
    options = "--tasks block_picking --group C4 --scenes 1 --steps 2 --image-size 32 --details"
    monkeypatch.setattr(sys, "argv", [str(script), *options.split()])
    runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out
    assert "| block_picking | random | hand |" in printed
    assert "| block_picking | expert | panda |" in printed
    assert "3 turns and 0 reflections audited" in printed
