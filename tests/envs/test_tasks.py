"""The four tasks: where things start, what success is, what goes on to the next episode."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from tensordict import TensorDictBase
from torchrl.envs.utils import check_env_specs

from equirl.envs import PlacementError, Scene, make_env, make_expert, tasks
from equirl.envs.objects import Body, ConvexPolyhedron, ObjectSet
from equirl.envs.tasks import TASKS, State, make_task
from equirl.envs.tasks.block_in_bowl import BlockInBowl
from equirl.envs.tasks.block_picking import BlockPicking
from equirl.envs.tasks.block_pushing import BlockPushing
from equirl.envs.tasks.clutter_grasping import ClutterGrasping

HOME = Scene([0, 0, 0.2], 0.0, 0.08, [])
REST = (0, 0, 0, 1)


def state(task, objects, *, z=0.2, held=None, touching=False, areas=()) -> State:
    scene = Scene([0, 0, z], 0.0, 0.08, objects, areas=areas).named(task.bodies)
    return State(scene, held, lambda first, second: touching)


def samples(task, count: int = 200) -> list[Scene]:
    return [task.sample(np.random.default_rng(seed), HOME) for seed in range(count)]


def bricks(count: int = 1) -> ObjectSet:
    brick = ConvexPolyhedron.box([0.035, 0.025, 0.02])
    return ObjectSet([Body((brick,), 0.15, 0.6, name=f"brick{k}") for k in range(count)], "bricks")


@pytest.fixture
def clutter(make):
    return make("clutter_grasping", image_size=16, robot="hand", objects=bricks(3))


def expert_episode(env) -> Iterator[TensorDictBase]:
    """Plays an episode of the expert, step by step."""
    td, expert = env.reset(), make_expert(env, grasp="aligned")
    while not td["done"]:
        td = env.step(expert(td.clone()))["next"]
        yield td


def test_a_file_with_two_tasks_is_refused(monkeypatch):
    module = ModuleType("two")
    for name in ("First", "Second"):
        setattr(module, name, type(name, (BlockPicking,), {"__module__": "two"}))
    monkeypatch.setitem(sys.modules, "two", module)
    with pytest.raises(ImportError, match="two defines the tasks First, Second; expected one"):
        tasks._task_of("two")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("broken_task:Sorting", "'broken_task:Sorting' cannot be imported: ZeroDivisionError"),
        ("mistyped_task:Sorting", r"cannot be imported: SyntaxError: .*mistyped_task\.py, line 1"),
        ("no_such_package.tasks:Sorting", "cannot be imported: ModuleNotFoundError"),
        ("math:Sorting", "cannot be imported: AttributeError"),
        (".tasks:Sorting", "unknown task '.tasks:Sorting'"),
        ("math:pi", "must be a subclass of equirl.envs.tasks.base.Task, got 3.14"),
    ],
)
def test_tasks_that_cannot_be_imported_are_named(name, message, tmp_path, monkeypatch):
    (tmp_path / "broken_task.py").write_text("1 / 0\n")
    (tmp_path / "mistyped_task.py").write_text("class Sorting(\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=message):
        make_task(name)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_is_a_torchrl_environment(make, task):
    env = make(task, image_size=16, robot="hand")
    check_env_specs(env)
    rollout = env.rollout(4)
    assert rollout["depth"].min() >= 0 and rollout["depth"].max() <= np.float32(0.32)


def test_pushing_starts_with_the_goal_apart_from_the_cube():
    task = BlockPushing()
    for scene in samples(task):
        (cube,), (goal,) = scene.objects, scene.areas
        assert np.abs(cube[:2]).max() <= 0.09 and np.abs(goal[:2]).max() <= 0.085
        assert np.hypot(*(cube[:2] - goal[:2])) >= 0.09
        assert cube[2] == 0.025 and goal[2] == 0
    assert (task.view, task.margin, task.areas[0].side, task.areas[0].raise_by) == (
        0.45,
        0.05,
        0.09,
        0.02,
    )


@pytest.mark.parametrize(
    ("x", "z", "held", "success"),
    [
        (0.149, 0.025, None, True),
        (0.151, 0.025, None, False),  # too far
        (0.100, 0.031, None, False),  # not on the ground
        (0.100, 0.025, 0, False),  # still held
    ],
)
def test_success_of_pushing(x, z, held, success):
    goal = [[0.1, 0.0, 0.0]]
    assert (
        BlockPushing().succeeded(state(BlockPushing(), [[x, 0, z, *REST]], held=held, areas=goal))
        is success
    )


def test_bowl_and_cube_start_apart():
    task = BlockInBowl()
    for scene in samples(task):
        cube, bowl = scene.objects
        assert np.abs(cube[:2]).max() <= 0.09 and np.abs(bowl[:2]).max() <= 0.065
        assert np.hypot(*(cube[:2] - bowl[:2])) >= 0.17
        assert scene.names == () and len(task.bodies) == 2


TILTED = (np.sin(0.2), 0, 0, np.cos(0.2))  # by 0.4 rad, more than pi / 9


@pytest.mark.parametrize(
    ("x", "orientation", "held", "touching", "released_only", "success"),
    [
        (0.029, REST, None, True, True, True),
        (0.031, REST, None, True, True, False),
        (0.0, TILTED, None, True, True, False),
        (0.0, REST, None, False, True, False),
        (0.0, REST, 0, True, True, False),
        (0.0, REST, 0, True, False, True),
    ],
)
def test_success_of_block_in_bowl(x, orientation, held, touching, released_only, success):
    task = BlockInBowl(require_release=released_only)
    objects = [[x, 0, 0.04, *REST], [0, 0, 0.034, *orientation]]
    assert task.succeeded(state(task, objects, held=held, touching=touching)) is success


def test_in_the_papers_mode_a_held_cube_is_a_success():
    task = make_task("block_in_bowl", **BlockInBowl.paper_options)
    objects = [[0, 0, 0.04, *REST], [0, 0, 0.034, *REST]]
    assert task.succeeded(state(task, objects, held=0, touching=True))


def test_clutter_draws_kinds_sizes_and_places():
    task = ClutterGrasping(objects=bricks(4))
    scenes = samples(task, 50)
    names = {name for scene in scenes for name in scene.names}
    scales = np.array([scene.scales for scene in scenes])
    assert names == set(task.bodies) and len(scenes[0].names) == 5
    assert 0.8 <= scales.min() < 0.82 and 0.98 < scales.max() <= 1.0
    poses = np.stack([scene.objects for scene in scenes])
    assert (poses[..., 2] == 0.20).all() and np.abs(poses[..., :2]).max() <= 0.10
    yaws = 2 * np.arctan2(poses[..., 5], poses[..., 6])
    assert np.abs(yaws).max() <= np.pi / 4


def test_a_heap_has_come_to_rest_within_the_bin(clutter, act):
    for seed in range(6):
        clutter.set_seed(seed)
        td = clutter.reset()
        start = clutter.get_scene()
        assert len(start.objects) == 5
        assert all(clutter.workspace.contains(pose[:3], margin=0.05) for pose in start.objects)
        act(clutter, td, 1, 0, 0, 0, 0)
        moved = clutter.get_scene().objects[:, :3] - start.objects[:, :3]
        assert np.linalg.norm(moved, axis=1).max() < 5e-3


def test_a_grasped_object_is_gone_in_the_next_episode(clutter):
    for left in (4, 3, 2):
        *_, end = expert_episode(clutter)
        assert end["reward"] == 1 and clutter.scene_continues
        rest = clutter.get_scene().without(clutter.held_object())
        clutter.reset()
        after = clutter.get_scene()
        assert len(after.objects) == left and after.names == rest.names
        np.testing.assert_allclose(after.position, (0, 0, 0.2), atol=1e-6)
        assert after.aperture == pytest.approx(0.08) and clutter.held_object() is None


def test_a_new_scene_comes_when_all_are_gone_or_after_seven_episodes_or_when_one_is_lost(make, act):
    env = make("clutter_grasping", image_size=8, robot="hand", objects=bricks(), object_count=1)
    *_, end = expert_episode(env)
    assert end["reward"] == 1 and not env.scene_continues  # all gone
    env.reset()
    for episode in range(6):
        assert env.scene_continues, episode
        scene = env.get_scene()
        env.reset()
        np.testing.assert_allclose(env.get_scene().objects, scene.objects, atol=2e-3)
    assert not env.scene_continues  # the seventh has begun
    env.reset()
    lost = replace(env.get_scene(), objects=np.array([[0.26, 0, 0.03, *REST]]))
    env._simulation.place(lost)
    td = act(env, env.fake_tensordict().exclude("next"), 1, 0, 0, 0, 0)
    assert td["terminated"] and td["reward"] == 0 and not env.scene_continues


@pytest.mark.parametrize("limit", [0, 1, 2])
def test_a_scene_goes_on_for_as_many_episodes_as_asked_or_for_ever(make, limit):
    options = {"objects": bricks(), "object_count": 1, "max_scene_episodes": limit}
    env = make("clutter_grasping", image_size=8, robot="hand", **options)
    env.reset()
    episodes = 1
    while env.scene_continues and episodes < 9:
        env.reset()
        episodes += 1
    assert episodes == (limit or 9)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_can_be_asked_for_a_new_scene_at_each_reset(make, task):
    env = make(task, image_size=8, robot="hand", max_scene_episodes=1)
    env.reset()
    assert not env.scene_continues


def test_an_object_in_the_air_at_the_end_of_an_episode_falls_before_the_next(clutter):
    for td in expert_episode(clutter):
        heights = clutter.get_scene().objects[:, 2]
        if td["holding"] and heights.max() > 0.08:
            break
    assert not td["done"]
    clutter.reset()
    after = clutter.get_scene().objects[:, 2]
    assert len(after) == 5 and (after < 0.06).all()


def test_setting_a_scene_ends_the_one_that_goes_on(clutter):
    clutter.reset()
    clutter.set_scene(clutter.get_scene())
    assert not clutter.scene_continues


def test_every_number_can_be_set(make):
    env = make("block_pushing", image_size=16, robot="hand", goal_side=0.2, view=0.3)
    assert env.task.areas[0].side == 0.2 and env.task.view == 0.3
    assert make_task("block_in_bowl", bowl_width=0.2).bowl.extents[0] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "block_picking",
            {"lift": 0.1},
            "BlockPicking has no option lift; its options: .*lift_hei",
        ),
        ("block_picking", {"cube_side": 0}, "cube_side must be a finite number above 0, got 0"),
        ("block_picking", {"view": float("nan")}, "view must be .* got nan"),
        ("block_picking", {"lift_height": "high"}, "lift_height must be .* got 'high'"),
        ("block_pushing", {"goal_raise": -1}, "goal_raise must be .* 0 or more, got -1"),
        ("block_in_bowl", {"require_release": "no"}, "require_release must be True or False"),
        ("block_in_bowl", {"bowl_width": 0.05}, "bowl_width must be .*got 0.05"),
        ("block_in_bowl", {"bowl_distance": 0.05}, "bowl_distance must be above 0.122, .*got 0.05"),
        ("block_pushing", {"cube_side": 0.07}, "max_height must be above 0.035, .*got 0.03"),
        ("block_picking", {"cube_side": 0.09}, "cube_side must be less than 0.08, .* got 0.09"),
        ("block_picking", {"lift_height": 0.3}, "lift_height must be less than 0.25, .* got 0.3"),
        (
            "clutter_grasping",
            {"drop_height": 0.4},
            "drop_height must be less than 0.35, .* got 0.4",
        ),
        ("clutter_grasping", {"largest_scale": "x"}, "largest_scale must be .* got 'x'"),
        ("clutter_grasping", {"largest_scale": float("inf")}, "largest_scale must be .* got inf"),
        ("clutter_grasping", {"names": 5}, "names must be a list of names, got 5"),
        ("clutter_grasping", {"objects": 5}, "objects must be a folder or an ObjectSet, got 5"),
        ("clutter_grasping", {"object_count": 0}, "object_count must be an integer above 0, got 0"),
        ("clutter_grasping", {"object_count": 2.5}, "object_count must be an integer .* got 2.5"),
        ("clutter_grasping", {"largest_scale": 0.5}, "at least smallest_scale=0.8, got 0.5"),
        ("clutter_grasping", {"names": "mug"}, "names must be a list of names, got 'mug'"),
        (
            "clutter_grasping",
            {"objects": bricks(2), "names": ["brik1"]},
            "unknown object 'brik1' in bricks, which has 2, for example brick1",
        ),
    ],
)
def test_impossible_numbers_are_named(name, options, message):
    with pytest.raises(ValueError, match=message):
        make_task(name, **options)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "block_pushing",
            {"goal_distance": 0.5},
            "no place in 20000 tries for a goal .* 0.5 m from",
        ),
        (
            "block_in_bowl",
            {"bowl_distance": 0.4},
            "no place in 20000 tries for a bowl .* 0.4 m from",
        ),
        (
            "clutter_grasping",
            {"objects": bricks(), "start_half_width": 0.4, "placement_tries": 3},
            "no scene in 3 tries; in the last, brick0 was at .* outside",
        ),
        (
            "block_picking",
            {"cube_side": 0.015, "placement_tries": 5},
            r"no scene in 5 tries; in the last, cube was at \[.*0.008\] m, .* outside the work",
        ),
        (
            "block_pushing",
            {"goal_half_width": 50.0, "placement_tries": 5},
            "no scene in 5 tries; in the last, an area was at",
        ),
    ],
)
def test_impossible_scenes_end_with_the_tries_and_the_reason(make, name, options, message):
    env = make(name, image_size=8, robot="hand", **options)
    with pytest.raises(PlacementError, match=message):
        env.reset()
    with pytest.raises(RuntimeError, match="no scene yet; reset it first"):
        env.get_scene()


def test_numbers_may_be_of_numpy():
    assert make_task("block_pushing", goal_side=np.float32(0.1)).areas[0].side == np.float32(0.1)
    make_env("block_picking", image_size=np.int64(16)).close(raise_if_closed=False)


def test_scenes_may_be_wider_than_the_bin_as_long_as_some_fit(make):
    env = make("block_picking", image_size=8, robot="hand", start_half_width=0.3)
    for _ in range(10):
        env.reset()
        assert env.workspace.contains(env.get_scene().objects[0, :3])


def test_scenes_of_other_tasks_are_refused(make):
    env = make("block_pushing", image_size=8, robot="hand")
    cube = [[0, 0, 0.025, *REST]]
    with pytest.raises(ValueError, match="the scene has 0 areas, the task has 1"):
        env.set_scene(Scene([0, 0, 0.2], 0.0, 0.08, cube))
    with pytest.raises(ValueError, match="unknown object 'mug'"):
        env.set_scene(Scene([0, 0, 0.2], 0.0, 0.08, cube, names=["mug"], areas=[[0, 0, 0]]))
    with pytest.raises(RuntimeError, match="no scene yet; reset it first"):
        env.get_scene()


def test_scenes_that_a_task_could_not_judge_are_refused(make):
    env = make("block_in_bowl", image_size=8, robot="hand")
    poses = [[0.05, 0, 0.034, *REST], [-0.1, 0, 0.025, *REST]]
    with pytest.raises(ValueError, match=r"has the objects \('cube',\), the task has"):
        env.set_scene(Scene([0, 0, 0.2], 0.0, 0.08, poses[:1]))
    with pytest.raises(ValueError, match=r"has the objects \('bowl', 'cube'\), the task has"):
        env.set_scene(Scene([0, 0, 0.2], 0.0, 0.08, poses, names=["bowl", "cube"]))
    heap = make("clutter_grasping", image_size=8, robot="hand", objects=bricks())
    with pytest.raises(ValueError, match="the scene has no object"):
        heap.set_scene(HOME)


@pytest.mark.parametrize("size", [(0, 10), (10, -4), (10, 2.5)])
def test_pictures_of_impossible_sizes_are_refused(make, size):
    env = make("block_picking", image_size=8, robot="hand")
    env.reset()
    with pytest.raises(ValueError, match=r"must be a positive integer \(pixels\), got"):
        env.render(*size)
