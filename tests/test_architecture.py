"""The direction of imports between the rooms of the package."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "equirl"

#: What each room may import of ours, beside itself.
ALLOWED = {
    "symmetry": set(),
    "modules": {"symmetry"},
    "objectives": {"symmetry", "modules"},
    "data": {"symmetry"},
    "envs": {"symmetry"},
    "collectors": {"symmetry", "data", "envs"},
    "analysis": set(),
    "training": {
        "symmetry", "modules", "objectives", "data", "envs", "collectors", "analysis", "config",
    },
    "config": {"symmetry", "modules", "envs"},
}  # fmt: skip

#: Libraries that one place alone may import.
CONFINED = {
    "pybullet": "envs/bullet",
    "escnn": "modules/bases.py",
    "ctypes": "modules/native",
    "hydra": "config/",
    "wandb": "training/metrics.py",
    "imageio": "training/video.py",
    "gymnasium": "envs/gymnasium.py",
    "trimesh": "envs/objects/convex_pieces.py",
    "coacd": "envs/objects/convex_pieces.py",
    "tqdm": "training/progress.py",
    "onnxruntime": "training/export",
    "h5py": "data/robomimic.py",
}


def imports(path: Path) -> set[str]:
    """Absolute module names a file imports, at any depth."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                package = path.relative_to(PACKAGE.parent).parent.parts
                base = package[: len(package) - node.level + 1]
                source = ".".join([*base, *([node.module] if node.module else [])])
                names |= {source, *(f"{source}.{alias.name}" for alias in node.names)}
            elif node.module:
                names.add(node.module)
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # "module:name", looked up later (see equirl/config/schema.py).
            names |= set(re.findall(r"^(equirl\.[\w.]+):\w+$", node.value))
    return names


def files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("room", ALLOWED)
def test_rooms_import_only_what_they_may(room):
    for path in files():
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[0] != room:
            continue
        used = {name.split(".")[1] for name in imports(path) if name.startswith("equirl.")}
        rooms = used & set(ALLOWED)
        assert rooms <= ALLOWED[room] | {room}, f"{path} imports {rooms - ALLOWED[room]}"


def test_every_room_is_listed():
    rooms = {path.relative_to(PACKAGE).with_suffix("").parts[0] for path in files()}
    assert rooms - {"__init__"} == set(ALLOWED)


def test_what_files_take_from_one_another_is_public():
    """Each file lists its public names, and others import nothing else from it."""
    experiments = PACKAGE.parent / "experiments"
    for path in [*files(), *experiments.glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("equirl"):
                module = importlib.import_module(node.module)
                public = set(module.__all__) if hasattr(module, "__all__") else set()
                folder = Path(module.__file__).parent
                below = {p.stem for p in folder.iterdir()} if hasattr(module, "__path__") else set()
                taken = {alias.name for alias in node.names}
                assert taken <= public | below, f"{path}: {node.module} {taken - public - below}"


@pytest.mark.parametrize(("library", "place"), CONFINED.items())
def test_libraries_are_imported_in_one_place(library, place):
    users = {
        path.relative_to(PACKAGE).as_posix()
        for path in files()
        if any(name.split(".")[0] in {library, f"{library}_data"} for name in imports(path))
    }
    assert users and all(user.startswith(place) for user in users), users


@pytest.mark.parametrize(
    ("room", "absent"),
    [
        ("modules", "pybullet"),
        ("envs", "escnn"),
        ("envs", "pybullet"),  # until a scene is simulated
        ("training", "hydra"),
        ("config", "torch"),  # whose environment the entry points still have to set
    ],
)
def test_rooms_load_without_what_they_do_not_need(room, absent):
    code = f"import sys, equirl.{room}; assert {absent!r} not in sys.modules"
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)
