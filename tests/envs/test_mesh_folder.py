"""A folder of meshes as an object set."""

from __future__ import annotations

import logging
import pickle
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from equirl.envs.objects import (
    Body,
    ConvexPolyhedron,
    MeshError,
    MeshFolder,
    ObjectSet,
    convex_pieces,
)

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("coacd")

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def moved(mesh, offset=(0.0, 0.0, 0.0), rotation=None):
    transform = np.eye(4)
    transform[:3, :3] = np.eye(3) if rotation is None else rotation.as_matrix()
    transform[:3, 3] = offset
    return mesh.copy().apply_transform(transform)


def box(*sides: float):
    return trimesh.creation.box(sides)


def annulus():
    return trimesh.creation.annulus(3, 5, 3, sections=12)


def cup():
    """A ring and the disc it stands on, which overlaps it."""
    ring = trimesh.creation.annulus(3, 4, 6, sections=12)
    return trimesh.util.concatenate(
        ring, moved(trimesh.creation.cylinder(4, 1, sections=12), [0, 0, -3])
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    return folder


@pytest.fixture(scope="module")
def shared_cache(tmp_path_factory) -> Path:
    """A cache for tests that are not about caching."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def load(folder, shared_cache):
    return partial(MeshFolder, folder, cache=shared_cache)


@pytest.fixture
def quick(monkeypatch):
    """Divides with less care, for tests that are not about the pieces."""
    careless = {"mcts_iterations": 5, "resolution": 200}
    monkeypatch.setattr(convex_pieces, "_DECOMPOSITION", convex_pieces._DECOMPOSITION | careless)


@pytest.fixture
def no_coacd(monkeypatch):
    """Makes it an error to divide a mesh."""

    def fail(parts):
        raise AssertionError("a mesh was divided")

    return lambda: monkeypatch.setattr(convex_pieces, "_decompose", fail)


def contains(piece: ConvexPolyhedron, point) -> bool:
    a, b, c = (piece.vertices[piece.triangles[:, k]] for k in range(3))
    return bool((np.einsum("ij,ij->i", np.cross(b - a, c - a), np.asarray(point) - a) <= 0).all())


def assert_same(first: ObjectSet, second: ObjectSet):
    assert list(first) == list(second)
    for one, other in zip(first.values(), second.values(), strict=True):
        assert (one.mass, one.friction, one.color) == (other.mass, other.friction, other.color)
        for piece, twin in zip(one.pieces, other.pieces, strict=True):
            assert piece.vertices.tobytes() == twin.vertices.tobytes()
            assert piece.triangles.tobytes() == twin.triangles.tobytes()


def test_the_files_of_a_folder_become_bodies_by_name(folder, load):
    box(4, 3, 2).export(folder / "c_binary.stl")
    (folder / "b_ascii.STL").write_text(box(4, 3, 2).export(file_type="stl_ascii"))
    box(4, 3, 2).export(folder / "a.obj")
    (folder / "notes.txt").write_text("no mesh")
    (folder / "._a.obj").write_bytes(b"\x00\x05")
    (folder / "deeper.obj").mkdir()
    bodies = load(mass=0.2, friction=0.5, rolling_friction=0.002)
    assert list(bodies) == ["a", "b_ascii", "c_binary"]
    assert len({body.color for body in bodies.values()}) == 3
    for name, body in bodies.items():
        assert isinstance(body, Body)
        assert (body.name, body.mass, body.friction) == (name, 0.2, 0.5)
        assert body.rolling_friction == 0.002
        np.testing.assert_allclose(body.extents, [0.09, 0.0675, 0.045], rtol=1e-6)
        np.testing.assert_allclose(body.vertices.mean(axis=0), 0, atol=1e-9)
    assert repr(bodies) == f"MeshFolder('the meshes in {folder}', 3 objects)"


@pytest.mark.parametrize("unit", [1e-3, 1, 1e3])
def test_meshes_of_unknown_units_are_scaled_to_fit(folder, load, unit):
    box(2 * unit, 9 * unit, 3 * unit).export(folder / "long.obj")
    box(6 * unit, 6 * unit, 3 * unit).export(folder / "wide.obj")
    bodies = load()
    np.testing.assert_allclose(bodies["long"].extents, [0.02, 0.09, 0.03], rtol=1e-5)
    np.testing.assert_allclose(bodies["wide"].extents, [0.07, 0.07, 0.035], rtol=1e-5)
    narrow = load(max_grasp_width=0.05)
    np.testing.assert_allclose(narrow["long"].extents, [0.02, 0.09, 0.03], rtol=1e-5)
    np.testing.assert_allclose(narrow["wide"].extents, [0.05, 0.05, 0.025], rtol=1e-5)


def test_the_size_does_not_depend_on_how_the_mesh_stands_in_its_file(folder, load):
    turn = Rotation.from_euler("zyx", (0.7, 0.4, -0.3))
    box(9, 3, 2).export(folder / "straight.obj")
    moved(box(9, 3, 2), (1000, -500, 30), turn).export(folder / "askew.obj")
    bodies = load()
    volumes = [body.pieces[0].moments()[0] for body in bodies.values()]
    assert volumes == pytest.approx([0.09 * 0.03 * 0.02] * 2, rel=1e-6)
    np.testing.assert_allclose(np.sort(turn.inv().apply(bodies["askew"].vertices)[:, 0])[-1], 0.045)


def test_explicit_scale_is_taken_as_it_is(folder, load):
    box(60, 40, 20).export(folder / "block.stl")
    np.testing.assert_allclose(load(scale=1e-3)["block"].extents, [0.06, 0.04, 0.02], rtol=1e-6)


@pytest.mark.parametrize(
    ("scale", "expected"),
    [
        (0.01, r"60 x 40 x 20|20 x 40 x 60 cm .*longest .* 20 cm, .*max_grasp_width = 7 cm"),
        (2e-4, r"0\.4 x 0\.8 x 1\.2 cm \(20 x 40 x 60 in the file's units\).*shortest .* 0\.8 cm"),
        (2e-3, r"4 x 8 x 12 cm .*units\); its middle side must be at most max_grasp_width = 7 cm"),
    ],
)
def test_explicit_scale_out_of_bounds_shows_the_numbers(folder, load, scale, expected):
    box(60, 40, 20).export(folder / "block.stl")
    with pytest.raises(MeshError, match=expected):
        load(scale=scale)


def assert_open_ring(body: Body):
    assert 4 <= len(body.pieces) <= 16
    assert max(len(piece.vertices) for piece in body.pieces) <= 32
    axis = np.linspace(-0.01, 0.01, 5)
    assert not any(contains(piece, (0, 0, z)) for piece in body.pieces for z in axis)
    around = [(0.028 * np.cos(a), 0.028 * np.sin(a), 0) for a in np.arange(0, 6, 0.5)]
    assert all(any(contains(piece, point) for piece in body.pieces) for point in around)


def test_holes_stay_open(folder, load, quick):
    annulus().export(folder / "ring.obj")
    assert_open_ring(load()["ring"])


@pytest.mark.slow
def test_holes_stay_open_with_all_care(folder, load):
    annulus().export(folder / "ring.obj")
    assert_open_ring(load()["ring"])


def test_overlapping_closed_parts_are_divided_one_by_one(folder, load, quick):
    cup().export(folder / "cup.obj")
    body = load()["cup"]
    assert 5 <= len(body.pieces) <= 16
    bottom, top = body.vertices[:, 2].min(), body.vertices[:, 2].max()
    assert not any(contains(piece, (0, 0, top - 0.01)) for piece in body.pieces)
    assert any(contains(piece, (0, 0, bottom + 0.005)) for piece in body.pieces)
    assert top - bottom == pytest.approx(0.07 * 6.5 / 8, rel=0.05)


def test_at_most_max_pieces(folder, load, quick):
    annulus().export(folder / "ring.obj")
    assert len(load(max_pieces=3)["ring"].pieces) == 3


def test_an_open_surface_is_given_walls_and_logged(folder, tmp_path, monkeypatch, caplog):
    coarse = {"preprocess_resolution": 20, "threshold": 0.5, "mcts_iterations": 5}
    monkeypatch.setattr(convex_pieces, "_DECOMPOSITION", convex_pieces._DECOMPOSITION | coarse)
    mesh = box(4, 3, 3)
    mesh.update_faces(np.arange(12) > 0)
    mesh.export(folder / "open.obj")
    body = MeshFolder(folder, cache=tmp_path / "cache")["open"]
    np.testing.assert_allclose(body.extents, [0.09, 0.07, 0.07], rtol=0.1)
    assert "open.obj is not a closed surface" in caplog.text


def test_inverted_triangles_make_no_difference(folder, load, quick):
    box(4, 3, 2).export(folder / "a.obj")
    inverted = box(4, 3, 2)
    inverted.invert()
    inverted.export(folder / "b.obj")
    volumes = [body.pieces[0].moments()[0] for body in load().values()]
    assert volumes == pytest.approx([0.09 * 0.0675 * 0.045] * 2)


def test_warm_and_cold_cache_give_the_same_bits(folder, tmp_path, load, quick, no_coacd):
    annulus().export(folder / "ring.obj")
    box(3, 4, 5).export(folder / "box.obj")
    first = load()
    assert_same(first, MeshFolder(folder, cache=tmp_path / "cold"))
    no_coacd()
    assert_same(first, load())
    # How large and heavy they are made is no matter of the cache.
    half = load(mass=0.3, max_grasp_width=0.035)
    np.testing.assert_allclose(half["ring"].vertices, first["ring"].vertices / 2, atol=1e-9)


def test_changed_files_and_options_are_divided_anew(folder, tmp_path, no_coacd):
    file = folder / "box.obj"
    box(3, 4, 5).export(file)
    before = MeshFolder(folder, cache=tmp_path)
    box(2, 4, 5).export(file)
    after = MeshFolder(folder, cache=tmp_path)
    np.testing.assert_allclose(after["box"].extents, [0.035, 0.07, 0.0875], rtol=1e-6)
    box(3, 4, 5).export(file)
    no_coacd()
    assert_same(MeshFolder(folder, cache=tmp_path), before)
    with pytest.raises(AssertionError, match="was divided"):
        MeshFolder(folder, cache=tmp_path, max_pieces=5)


@pytest.mark.parametrize("damage", ["truncated", "garbage", "empty", "flipped", "other"])
def test_a_damaged_cache_file_is_replaced(folder, tmp_path, no_coacd, caplog, damage):
    box(3, 4, 5).export(folder / "box.obj")
    before = MeshFolder(folder, cache=tmp_path / "cache")
    (file,) = (tmp_path / "cache").iterdir()
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0x40
    damaged = {"truncated": whole[:-200], "garbage": b"\x80\x04junk", "empty": b""}
    if damage == "other":
        np.savez(file, arr_0=np.zeros((4, 2)))
    else:
        file.write_bytes(damaged.get(damage, bytes(flipped)))
    assert_same(MeshFolder(folder, cache=tmp_path / "cache"), before)
    assert "is made anew" in caplog.text
    no_coacd()
    assert_same(MeshFolder(folder, cache=tmp_path / "cache"), before)


def test_an_unwritable_cache_is_only_a_warning(folder, tmp_path, caplog):
    for name in "ab":
        box(3, 4, 5).export(folder / f"{name}.obj")
    (tmp_path / "file").write_text("in the way")
    assert len(MeshFolder(folder, cache=tmp_path / "file" / "cache")) == 2
    (record,) = [r for r in caplog.records if "not kept for the next time" in r.message]
    assert record.levelno == logging.WARNING


def test_one_cache_serves_many_at_once(folder, tmp_path):
    for width in (2, 3, 4):
        box(width, 3, 4).export(folder / f"box_{width}.obj")
    cache = tmp_path / "cache"
    with ThreadPoolExecutor(3) as pool:
        sets = list(pool.map(lambda _: MeshFolder(folder, cache=cache), range(3)))
    assert_same(sets[0], sets[1])
    assert_same(sets[0], sets[2])
    assert sorted(file.suffix for file in cache.iterdir()) == [".npz"] * 3


@pytest.mark.parametrize(("variable", "below"), [("XDG_CACHE_HOME", ""), ("HOME", ".cache")])
def test_default_cache(folder, tmp_path, monkeypatch, variable, below):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv(variable, str(tmp_path / "user"))
    box(3, 4, 5).export(folder / "box.obj")
    MeshFolder(folder)
    assert len(list((tmp_path / "user" / below / "equirl" / "meshes").glob("*.npz"))) == 1


BROKEN = {
    "empty.obj": (b"", "the file is empty"),
    "faceless.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles in its 24 bytes"),
    "flat.obj": (TRIANGLE.encode(), r"too flat at any scale: it is 0 x .* at least 4%"),
    "garbage.obj": (b"\x00\xff\xfegarbage" * 40, "no triangles"),
    "garbage.stl": (bytes(range(256)) * 4, "no triangles in its 1024 bytes"),
    "index.obj": (TRIANGLE.replace("1 2 3", "1 2 9").encode(), "cannot be read as OBJ: IndexError"),
    "nan.obj": (
        TRIANGLE.replace("v 1", "v nan").encode(),
        r"1 of 3 .* not finite.*\[nan, 0.0, 0.0",
    ),
    "point.obj": (b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "too flat"),
}


def test_all_meshes_that_cannot_be_used_are_named_at_once(folder, load):
    for name, (content, _) in BROKEN.items():
        folder.joinpath(name.replace(".stl", "_.stl")).write_bytes(content)
    box(9, 9, 1).export(folder / "plate.obj")
    box(4, 3, 2).export(folder / "whole.obj")
    with pytest.raises(MeshError, match=r"9 of 10 meshes .* \(skip_refused=True") as caught:
        load()
    message = str(caught.value)
    for name, (_, reason) in BROKEN.items():
        name = name.replace(".stl", "_.stl")
        assert re.search(f"\n  {re.escape(name)}: .*{reason}", message), message
    assert re.search(r"plate.obj: .*0\.778 x 7 x 7 cm \(1 x 9 x 9 in .*shortest.*0\.8 cm", message)
    assert "whole" not in message


def test_refused_meshes_can_be_left_out(folder, load, caplog):
    (folder / "broken.obj").write_bytes(b"")
    with pytest.raises(MeshError, match=r"1 of 1 meshes cannot be used:\n  broken.obj: the file"):
        load(skip_refused=True)
    box(4, 3, 2).export(folder / "whole.obj")
    assert list(load(skip_refused=True)) == ["whole"]
    assert f"left out {folder / 'broken.obj'}: the file is empty" in caplog.text


def test_folders_without_meshes_are_refused(folder, tmp_path):
    with pytest.raises(MeshError, match=r"meshes has no meshes; .* of \.obj and \.stl files"):
        MeshFolder(folder)
    with pytest.raises(MeshError, match=r"nowhere does not exist; .* of \.obj and \.stl files"):
        MeshFolder(tmp_path / "nowhere")
    file = tmp_path / "mug.obj"
    file.write_text(TRIANGLE)
    with pytest.raises(MeshError, match=r"mug\.obj is not a folder; .* of \.obj and \.stl files"):
        MeshFolder(file)


def test_two_files_of_one_name_are_refused(folder):
    for name in ("box.obj", "box.STL", "other.obj"):
        (folder / name).touch()
    with pytest.raises(MeshError, match=r"but not apart: box\.STL, box\.obj$"):
        MeshFolder(folder)


def test_a_crash_of_coacd_refuses_the_mesh_only(folder, tmp_path, monkeypatch):
    annulus().export(folder / "ring.obj")
    crash = "import os, sys; print('Assertion failed', file=sys.stderr, flush=True); os.abort()"
    monkeypatch.setattr(convex_pieces, "_PROGRAM", crash)
    with pytest.raises(
        MeshError, match=r"ring\.obj: coacd failed \(exit code -6\): Assertion fail"
    ):
        MeshFolder(folder, cache=tmp_path / "cache")
    monkeypatch.setattr(convex_pieces, "_PROGRAM", "import time; time.sleep(60)")
    monkeypatch.setattr(convex_pieces, "_PATIENCE", 0.1)
    with pytest.raises(MeshError, match=r"did not divide its 96 triangles within 0\.1 s"):
        MeshFolder(folder, cache=tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("library", ["trimesh", "coacd"])
def test_missing_libraries_are_named(folder, monkeypatch, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=r"pip install 'equirl\[meshes\]'"):
        MeshFolder(folder)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mass": 0}, "mass must be .* above 0 kg, got 0"),
        ({"friction": -1}, "friction must be .* got -1"),
        ({"rolling_friction": float("nan")}, "rolling_friction must be .* got nan"),
        ({"max_grasp_width": 0.001}, "max_grasp_width must be .* at least 0.008 m, got 0.001"),
        ({"scale": 0.0}, "scale must be .* above 0, got 0.0"),
        ({"scale": float("inf")}, "scale must be .* got inf"),
        ({"max_pieces": 0}, "max_pieces must be .* got 0"),
        ({"max_pieces": 2.5}, "max_pieces must be .* whole, .* got 2.5"),
    ],
)
def test_impossible_options_are_refused(folder, options, message):
    with pytest.raises(ValueError, match=message):
        MeshFolder(folder, **options)


def test_the_set_survives_pickling(folder, load):
    box(4, 3, 2).export(folder / "box.obj")
    bodies = load()
    assert_same(bodies, pickle.loads(pickle.dumps(bodies)))
    assert list(bodies.subset(["box"])) == ["box"]
