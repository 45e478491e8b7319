"""The household objects: what is in the set, their sizes, symmetry and stable rest."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from equirl.envs.bullet.client import Client
from equirl.envs.bullet.loading import BodyLoader
from equirl.envs.objects import Body, ConvexPolyhedron
from equirl.envs.objects.household import KINDS, household_objects
from equirl.envs.objects.household.solids import block, laid, turned

BODIES = list(household_objects().values())


def fingerprint() -> str:
    """Returns a hash of all numbers that describe the set."""
    digest = hashlib.sha256()
    for body in household_objects().values():
        digest.update(repr((body.name, body.color, body.mass, body.friction)).encode())
        for piece in body.pieces:
            digest.update(piece.vertices.tobytes() + piece.triangles.tobytes())
    return digest.hexdigest()


def test_there_are_four_variants_of_nineteen_kinds():
    objects = household_objects()
    assert len(objects) == 76 and len(KINDS) == 19
    assert list(objects) == [f"{kind}_{variant}" for kind in KINDS for variant in range(4)]
    assert household_objects() is objects


def test_sizes_are_those_of_the_papers_objects():
    """Of the set of [P], in cm: shortest 1.4 to 5.9, middle 1.6 to 8.2, longest 6 to 17."""
    sides = 100 * np.sort([body.extents for body in BODIES], axis=1)
    np.testing.assert_allclose(np.median(sides, axis=0), (3.8, 5.0, 8.9), atol=0.3)
    smallest, greatest = sides.min(axis=0), sides.max(axis=0)
    assert (smallest >= (1.4, 1.6, 6.0)).all() and (greatest <= (5.9, 8.2, 17.0)).all()
    np.testing.assert_allclose(smallest, (1.4, 1.6, 6.0), atol=0.2)
    np.testing.assert_allclose(greatest, (5.9, 8.2, 17.0), atol=0.35)


def proportions(body: Body) -> np.ndarray:
    """Returns sides and radii of gyration relative to the longest side, shape (6,)."""
    lengths = np.concatenate((body.extents, np.sqrt(body.inertia / body.mass)))
    return lengths / body.extents.max()


@pytest.mark.parametrize("kind", KINDS)
def test_variants_of_a_kind_differ_in_their_proportions(kind):
    variants = [household_objects()[f"{kind}_{variant}"] for variant in range(4)]
    for one, other in combinations(variants, 2):
        difference = np.abs(proportions(one) - proportions(other)).max()
        assert difference > 0.015, f"{one.name} and {other.name} are alike"


@pytest.mark.parametrize("body", BODIES, ids=lambda body: body.name)
def test_each_object_is_sound(body):
    assert body.has_mirror_symmetry
    assert (body.mass, body.friction) == (0.15, 0.6)
    assert 1 <= len(body.pieces) <= 12
    volumes, centroids, _ = zip(*(piece.moments() for piece in body.pieces), strict=True)
    assert min(volumes) > 1e-8  # outward surfaces, no slivers
    np.testing.assert_allclose(np.average(centroids, axis=0, weights=volumes), 0, atol=1e-8)
    for piece in body.pieces:
        assert_closed(piece)


def assert_closed(piece: ConvexPolyhedron) -> None:
    """Each edge belongs to two triangles, which run through it in opposite directions."""
    edges = {(t[k], t[k - 1]) for t in piece.triangles.tolist() for k in range(3)}
    assert len(edges) == 3 * len(piece.triangles)
    assert {(end, start) for start, end in edges} == edges
    assert set(np.unique(piece.triangles)) == set(range(len(piece.vertices)))


def test_the_reflection_of_an_object_is_the_object_bit_for_bit():
    def pieces(body: Body, mirror: int) -> set[frozenset]:
        corners = [piece.vertices * (1, mirror, 1) + 0.0 for piece in body.pieces]
        return {frozenset(map(tuple, points.tolist())) for points in corners}

    for body in BODIES:
        assert pieces(body, 1) == pieces(body, -1), body.name


def test_objects_are_made_of_few_pieces_with_few_corners():
    assert np.mean([len(body.pieces) for body in BODIES]) < 4.3
    assert np.mean([len(body.vertices) for body in BODIES]) < 90


@pytest.mark.parametrize("body", BODIES, ids=lambda body: body.name)
def test_each_object_fits_between_the_open_fingers_in_some_direction(body):
    angles = np.linspace(0, np.pi, 36, endpoint=False)
    across = np.array([np.cos(angles), np.sin(angles)])
    widths = np.ptp(body.vertices[:, :2] @ across, axis=0)
    assert widths.min() < 0.07


def test_the_set_is_the_same_in_another_process():
    code = f"import sys; sys.path.insert(0, {os.path.dirname(__file__)!r}); import test_household"
    process = subprocess.run(
        [sys.executable, "-c", f"{code}; print(test_household.fingerprint())"],
        env={**os.environ, "PYTHONHASHSEED": "12345"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert process.stdout.split()[-1] == fingerprint()


@pytest.fixture(scope="module")
def dropped() -> dict[str, tuple[np.ndarray, float]]:
    """Drops each object from 3 cm, upright and turned by some yaw, at a place of its own.

    Returns, by name: how far it is from its place on the ground, shape (3,), m, and its speed, m/s,
    after 3 s.
    """
    client = Client()
    client.setGravity(0, 0, -9.81)
    client.setPhysicsEngineParameter(fixedTimeStep=1 / 120, numSolverIterations=20)
    floor = client.createCollisionShape(client.GEOM_BOX, halfExtents=(10, 10, 0.1))
    floor = client.createMultiBody(0, floor, basePosition=(0, 0, -0.1))
    client.changeDynamics(floor, -1, lateralFriction=0.5)
    loader, rng = BodyLoader(client, household_objects()), np.random.default_rng(0)
    loader.begin_world()
    places, loaded, height = {}, {}, np.array([0, 0, 0.03])
    for k, body in enumerate(BODIES):
        place = np.array([0.5 * (k % 10), 0.5 * (k // 10), -body.vertices[:, 2].min()])
        turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_quat()
        pose = np.concatenate((place + height, turn))
        places[body.name], loaded[body.name] = place, loader.load(body.name, 1.0, pose)
    for _ in range(360):
        client.stepSimulation()
    result = {}
    for name, index in loaded.items():
        position, _ = client.getBasePositionAndOrientation(index)
        speed = np.linalg.norm(client.getBaseVelocity(index)[0])
        result[name] = (np.subtract(position, places[name]), speed)
    client.close()
    loader.close()
    return result


@pytest.mark.parametrize("name", list(household_objects()))
def test_dropped_upright_it_comes_to_rest_where_and_as_it_fell(dropped, name):
    way, speed = dropped[name]
    assert speed < 0.005
    assert np.linalg.norm(way[:2]) < 0.02
    assert abs(way[2]) < 0.003  # a round one may roll a little; none lies on another side


def test_laid_pieces_rest_on_the_outline_below_their_centre():
    cone = laid([turned("x", [(0, 2.0), (6, 1.0)])])
    lowest = min(piece.vertices[:, 2].min() for piece in cone)
    touching = cone[0].vertices[:, 2] < lowest + 1e-6
    assert np.ptp(cone[0].vertices[touching, 0]) > 5  # lies on its side
    box = block((0, 1), 1, (0, 5))
    np.testing.assert_array_equal(laid([box])[0].vertices, box.vertices)  # stands already
