"""The depth image: its symmetries, bit for bit, and its values against hand computation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from equirl.envs import Scene, jit
from equirl.envs.heightmap import Heightmap, HeightmapSpec
from equirl.envs.objects import Body, ConvexPolyhedron, ObjectSet, bowl, cube
from equirl.envs.scene import Area
from equirl.envs.workspace import Workspace
from equirl.symmetry import Element
from equirl.symmetry.audit_transforms import transform_scene

QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
REFLECTION = np.diag([1.0, -1.0, 1.0])
AREAS = (Area(0.09, 0.02),)


def heightmap(size: int = 64, side: float = 0.30, bodies=None, areas=()) -> Heightmap:
    bodies = (cube(0.05, 0.1, 1.0),) if bodies is None else bodies
    return Heightmap(ObjectSet(bodies, "test"), HeightmapSpec(size, side), Workspace(), areas)


def random_scene(rng: np.random.Generator, objects: int = 1) -> Scene:
    poses = np.concatenate(
        (
            rng.uniform((-0.16, -0.16, 0.0), (0.16, 0.16, 0.1), (objects, 3)),
            Rotation.random(objects, random_state=rng.integers(2**31)).as_quat().reshape(-1, 4),
        ),
        axis=1,
    )
    position = rng.uniform((-0.15, -0.15, 0.01), (0.15, 0.15, 0.25))
    area = [[*rng.uniform(-0.1, 0.1, 2), rng.uniform(-4, 4)]]
    return Scene(position, rng.uniform(-4, 4), rng.uniform(0, 0.08), poses, areas=area)


def draw_moved(picture: Heightmap, scene: Scene, matrix: np.ndarray) -> np.ndarray:
    """Draws the scene moved by an exact signed permutation, without any trigonometry."""
    view, plane = picture.view(scene), matrix[:2, :2]
    areas = np.hstack((view.areas[:, :2] @ plane.T, view.areas[:, 2:] @ plane.T))
    moved = replace(
        view,
        vertices=view.vertices @ matrix.T,
        position=matrix @ view.position,
        finger_axis=plane @ view.finger_axis,
        areas=areas,
    )
    return picture.draw_view(moved)


@pytest.mark.parametrize("size", [10, 64, 126, 128])
def test_turns_and_reflections_of_the_scene_move_the_image_bit_for_bit(size):
    rng = np.random.default_rng(size)
    hull = Body((ConvexPolyhedron.hull(rng.normal(scale=0.03, size=(20, 3))),), 0.1, 1.0)
    bodies = (cube(0.05, 0.1, 1.0), hull, bowl(0.16, 0.07, 0.1, 1.0))
    picture = heightmap(size, bodies=bodies, areas=AREAS)
    for _ in range(40):
        scene = random_scene(rng, objects=3)
        image = picture.draw(scene)
        np.testing.assert_array_equal(draw_moved(picture, scene, np.eye(3)), image)
        turned = draw_moved(picture, scene, QUARTER_TURN)
        np.testing.assert_array_equal(turned, np.rot90(image, 1))
        i, j = rng.integers(size, size=2)
        assert turned[i, j] == image[j, size - 1 - i]
        mirrored = draw_moved(picture, scene, REFLECTION)
        np.testing.assert_array_equal(mirrored, np.flip(image, 1))


def test_an_axis_aligned_cube_whose_edges_run_through_pixel_centres_is_drawn_symmetrically():
    # pitch 1 cm, pixel centres at odd multiples of 5 mm: the cube's edges at 25 mm hit them.
    picture = heightmap(30)
    image = picture.draw(Scene([0, 0, 0.2], 0.0, 0.08, [[0, 0, 0.025, 0, 0, 0, 1]]))
    rows = np.flatnonzero(np.isclose(image, 0.15).any(1))
    assert rows.tolist() == [12, 13, 14, 15, 16, 17]  # closed: both edges are covered
    np.testing.assert_array_equal(image[8:22, 14] == image[8:22, 15], True)


def test_turned_scenes_agree_to_a_micrometre_but_for_silhouettes():
    picture, rng = heightmap(64, areas=AREAS), np.random.default_rng(0)
    for _ in range(20):
        scene = random_scene(rng)
        turned = Scene.from_dict(transform_scene(scene.as_dict(), Element(np.pi / 2)))
        off = np.abs(picture.draw(turned) - np.rot90(picture.draw(scene), 1)) > 1e-6
        assert off.mean() < 1e-3


def test_depths_are_distances_below_the_end_effector():
    picture = heightmap(128)
    scene = Scene([0.0, 0.0, 0.2], 0.0, 0.08, [[0.06, -0.03, 0.025, 0, 0, 0, 1]])
    image = picture.draw(scene)
    pitch = 0.30 / 128

    def at(x, y):
        return image[int(np.floor(x / pitch)) + 64, int(np.floor(y / pitch)) + 64]

    assert image.dtype == np.float32
    assert at(0.06, -0.03) == pytest.approx(0.15, abs=1e-6)  # top of the cube
    assert at(0.06 + 0.022, -0.03 - 0.022) == pytest.approx(0.15, abs=1e-6)
    assert at(0.06 + 0.027, -0.03) == pytest.approx(0.20, abs=1e-6)  # floor beside it
    assert at(-0.03, 0.06) == pytest.approx(0.20, abs=1e-6)  # rows are x, columns are y


def test_the_bin_rises_linearly_to_its_rim_and_there_is_nothing_outside():
    picture = heightmap(90, side=0.45)
    image = picture.draw(Scene([0.1, 0.0, 0.25], 0.0, 0.08, [[0, 0.1, 0.02, 0, 0, 0, 1]]))
    x = 0.1 + (np.arange(90) + 0.5 - 45) * 0.005
    column = image[:, 45]
    expected = np.where(x > 0.225, 0.0, np.clip((x - 0.15) / 0.075, 0, 1) * 0.10)
    seen = np.abs(x - 0.1) > 0.06  # beside the fingers
    np.testing.assert_allclose(column[seen], (0.25 - expected)[seen], atol=1e-6)


def test_the_fingers_are_two_rectangles_at_depth_zero_along_the_yaw():
    picture = heightmap(300)  # 1 mm a pixel
    image = picture.draw(Scene([0, 0, 0.2], 0.0, 0.06, [[0.1, 0.1, 0.025, 0, 0, 0, 1]]))
    rows, columns = np.nonzero(image == 0)
    x, y = rows - 149.5, columns - 149.5
    assert (np.abs(y).max(), np.abs(x).min(), np.abs(x).max()) == (9.5, 30.5, 44.5)
    assert len(rows) == 2 * 15 * 20
    quarter = picture.draw(Scene([0, 0, 0.2], np.pi / 2, 0.06, [[0.1, 0.1, 0.025, 0, 0, 0, 1]]))
    rows, columns = np.nonzero(quarter == 0)
    assert np.abs(rows - 149.5).max() == 9.5  # the fingers separate along y now


@pytest.mark.parametrize(("size", "side"), [(128, 0.45), (142, 0.45), (64, 0.30)])
def test_a_marked_area_raises_what_lies_in_it_and_keeps_its_metric_size(size, side):
    picture = heightmap(size, side, areas=AREAS)
    cube_pose = [0.06, 0.04, 0.025, 0, 0, 0, 1]
    scene = Scene([0, 0, 0.2], 0.0, 0.0, [cube_pose], areas=[[0.06, 0.05, 0.0]])
    raised = picture.draw(scene)
    plain = heightmap(size, side).draw(replace(scene, areas=[]))
    difference = plain - raised
    marked = difference > 1e-6
    np.testing.assert_allclose(difference[marked], 0.02, atol=1e-6)  # floor and cube alike
    assert marked.sum() * (side / size) ** 2 == pytest.approx(0.09**2, rel=0.06)
    rows, columns = np.nonzero(marked)
    centre = (np.array([rows.mean(), columns.mean()]) + 0.5 - size / 2) * side / size
    np.testing.assert_allclose(centre, (0.06, 0.05), atol=side / size)


def test_an_area_turns_with_its_yaw():
    picture = heightmap(128, 0.45, areas=AREAS)
    scene = Scene([0, 0, 0.2], 0.0, 0.0, [], areas=[[0.1, 0.0, np.pi / 4]])
    difference = heightmap(128, 0.45).draw(replace(scene, areas=[])) - picture.draw(scene)
    rows, columns = np.nonzero(difference > 1e-6)
    for side in (rows, columns):
        assert (np.ptp(side) + 1) * 0.45 / 128 == pytest.approx(0.09 * 2**0.5, abs=0.01)


def test_surfaces_above_the_fingers_are_clamped_and_depth_is_clipped():
    picture = heightmap(64)
    high = Scene([0, 0, 0.10], 0.0, 0.0, [[0.1, 0, 0.15, 0, 0, 0, 1]])
    assert picture.draw(high)[64 // 2 + 21, 32] == pytest.approx(0.01, abs=1e-6)
    # The ceiling is never below 0.05 m: at 0.02 m a cube's top is above the fingers, depth 0.
    low = Scene([0, 0, 0.02], 0.0, 0.0, [[0.1, 0, 0.025, 0, 0, 0, 1]])
    assert picture.draw(low)[64 // 2 + 21, 32] == 0.0
    image = picture.draw(Scene([0, 0, 0.25], 0.0, 0.08, [[0.3, 0.3, 0.5, 0, 0, 0, 1]]))
    assert image.max() <= np.float32(0.32)


def test_an_object_larger_than_the_image_or_outside_it_is_drawn_safely():
    big = heightmap(16, bodies=(cube(1.0, 0.1, 1.0),))
    image = big.draw(Scene([0, 0, 0.2], 0.0, 0.0, [[0, 0, -0.45, 0, 0, 0, 1]]))
    assert np.isclose(image, 0.15).mean() > 0.9
    outside = heightmap(16).draw(Scene([0, 0, 0.2], 0.0, 0.0, [[9, -9, 0, 0, 0, 0, 1]]))
    assert np.isfinite(outside).all()


def test_compilation_survives_a_read_only_installation(monkeypatch):
    class Numba:
        @staticmethod
        def njit(function=None, *, cache=False):
            if cache:
                raise RuntimeError("cannot cache function: no locator available")
            return function

    monkeypatch.setattr(jit, "numba", Numba)
    assert jit.compiled(abs)(-3) == 3
