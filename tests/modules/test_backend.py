"""The native backend: its build, finding it, and the choice between it and the dense one."""

import ctypes
import logging
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from equirl.modules import backend, make_actor, make_critic, resolve_backend
from equirl.modules.native import library
from equirl.symmetry import SymmetryGroup
from equirl.training.checkpoint import check_same_config

ROOT = Path(__file__).parents[2]
D4 = SymmetryGroup("D4")


def built(name: str) -> bool:
    return library.library_path(name).exists()


COMPILER = shlex.split(os.environ.get("CXX") or "g++")[0]


@pytest.fixture(autouse=True)
def forget():
    """Every test finds and chooses anew."""
    for cached in (library.load, backend._faster_backend):
        cached.cache_clear()
    yield
    for cached in (library.load, backend._faster_backend):
        cached.cache_clear()


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """A function that sets what the processor can and which libraries are built."""

    def pretend(capability: str, *built: str) -> None:
        monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
        for name in built:
            (tmp_path / name).touch()

    monkeypatch.setattr(library, "library_path", lambda name: tmp_path / name)
    monkeypatch.setattr(library, "_open", lambda path: path)
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    return pretend


def spoken(caplog) -> list[tuple[str, str]]:
    return [(r.levelname, r.message) for r in caplog.records if r.name == "equirl"]


@pytest.mark.parametrize(
    ("capability", "built", "chosen"),
    [
        ("AVX512", ("AVX-512", "AVX2", "baseline"), "AVX-512"),
        ("AVX2", ("AVX-512", "AVX2", "baseline"), "AVX2"),
        ("DEFAULT", ("AVX-512", "AVX2", "baseline"), "baseline"),
        ("SVE256", ("baseline",), "baseline"),
        ("AVX512", ("AVX2", "baseline"), "AVX2"),
        ("AVX512", ("baseline",), "baseline"),
    ],
)
def test_the_best_library_is_loaded_that_is_built_and_runs_here(machine, capability, built, chosen):
    machine(capability, *built)
    assert library.load().instruction_set == chosen
    assert library.load() is library.load()
    assert resolve_backend("native", D4) == "native"


def test_auto_takes_native_where_it_is_faster_and_says_so_once(machine, caplog):
    caplog.set_level(logging.INFO, "equirl")
    machine("AVX512", "AVX-512")
    assert [resolve_backend("auto", D4) for _ in range(3)] == ["native"] * 3
    ((level, message),) = spoken(caplog)
    assert level == "INFO" and "native" in message and "AVX-512" in message


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [((SymmetryGroup("C6"),), "C6 lacks the quarter turns"), ((D4, "cuda:0"), "on cuda:0")],
)
def test_auto_takes_dense_where_the_kernels_do_not_serve(machine, caplog, arguments, reason):
    caplog.set_level(logging.INFO, "equirl")
    machine("AVX512", "AVX-512")
    assert [resolve_backend("auto", *arguments) for _ in range(3)] == ["dense"] * 3
    ((level, message),) = spoken(caplog)
    assert level == "INFO" and reason in message
    with pytest.raises(ValueError, match="serves"):
        resolve_backend("native", *arguments)


def test_auto_takes_dense_on_processors_never_measured(machine, caplog, monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    caplog.set_level(logging.INFO, "equirl")
    machine("DEFAULT", "baseline")
    assert resolve_backend("auto", D4) == "dense"
    assert "never measured on aarch64" in spoken(caplog)[0][1]
    assert resolve_backend("native", D4) == "native"


def test_without_a_library_auto_warns_once_and_native_says_what_to_do(machine, caplog):
    machine("AVX512")
    assert [resolve_backend("auto", D4) for _ in range(3)] == ["dense"] * 3
    ((level, message),) = spoken(caplog)
    assert level == "WARNING" and "not built" in message and "install g++" in message
    with pytest.raises(RuntimeError, match="backend='native' cannot be used: .*not built"):
        resolve_backend("native", D4)
    assert resolve_backend("dense", D4) == "dense"


@pytest.mark.skipif(not any(map(built, library.INSTRUCTION_SETS)), reason="nothing is built")
def test_a_library_of_another_version_is_refused(monkeypatch):
    monkeypatch.setattr(library, "INTERFACE", -1)
    with pytest.raises(RuntimeError, match="another version of equirl"):
        library.load()


def test_a_library_that_does_not_load_is_no_crash(monkeypatch, tmp_path):
    monkeypatch.setattr(library, "library_path", lambda name: tmp_path / "damaged.so")
    (tmp_path / "damaged.so").write_bytes(b"not a library")
    with pytest.raises(RuntimeError, match=r"cannot be loaded \(.*damaged\.so"):
        resolve_backend("native", D4)


@pytest.mark.parametrize("name", ["fast", "Native", "", None])
def test_other_names_are_refused(name):
    expected = "expected one of auto, native, dense"
    with pytest.raises(ValueError, match=expected):
        resolve_backend(name, D4)
    with pytest.raises(ValueError, match=expected):
        make_actor("C4", hidden=8, image_size=16, backend=name)
    with pytest.raises(ValueError, match=expected):
        make_critic("C4", hidden=8, image_size=16, backend=name)


def test_parameters_are_the_same_on_every_backend():
    def state(make, name):
        generator = torch.Generator().manual_seed(0)
        return make("D4", hidden=8, image_size=16, backend=name, generator=generator).state_dict()

    try:
        library.load()
        others = ("auto", "native")
    except library.NativeUnavailable:
        others = ("auto",)
    for make in (make_actor, make_critic):
        dense = state(make, "dense")
        for name in others:
            other = state(make, name)
            assert list(other) == list(dense)
            assert all(torch.equal(other[key], dense[key]) for key in dense)


def test_a_run_may_go_on_with_another_backend():
    check_same_config({"backend": "dense"}, {"backend": "native"}, ROOT)
    check_same_config({"backend": "auto"}, {}, ROOT)  # of an earlier version


def build(folder: Path, **environment: str) -> list[Path]:
    """Compiles the kernels as an installation does; returns the libraries that came out."""
    places = [f"--build-lib={folder / 'lib'}", f"--build-temp={folder / 'temp'}"]
    done = subprocess.run(
        [sys.executable, "setup.py", "build_ext", *places],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return sorted(folder.glob("lib/**/*.so"))


@pytest.mark.skipif(not shutil.which(COMPILER), reason="no C++ compiler")
def test_kernels_compile_and_share_the_threads_of_torch(tmp_path):
    def runtimes() -> set[str]:
        mapped = Path("/proc/self/maps").read_text().split()
        return {path for path in mapped if "libgomp" in path or "libomp" in path}

    pytest.importorskip("setuptools")
    libraries, before = build(tmp_path), runtimes()
    assert {path.name.split(".")[0] for path in libraries} == {"_avx512", "_avx2", "_plain"}
    for path in libraries:
        ctypes.CDLL(str(path), mode=os.RTLD_NOW)
    assert runtimes() == before


def test_installing_without_a_compiler_builds_nothing_and_succeeds(tmp_path):
    pytest.importorskip("setuptools")
    assert build(tmp_path, CC="/nonexistent", CXX="/nonexistent") == []
