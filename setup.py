"""Builds the native kernels; setup.cfg holds the metadata.

One source, compiled once for each of three instruction sets; the package picks the best one the
processor has when it runs. The results are plain shared libraries for ctypes, not Python modules:
Python's headers are not needed. A library that cannot be built is left out, and the package then
does without it.
"""

from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

FOLDER = "equirl/modules/native"
FLAGS = ["-O3", "-g0", "-std=c++17", "-fPIC", "-fno-exceptions", "-fno-rtti"]
# For the compiler only. Linked with it, a library would bring an OpenMP runtime of its own; left
# open, its calls find the one torch has loaded, and both share a pool of threads.
OPENMP = ["-fopenmp"]
INSTRUCTION_SETS = {
    "avx512": [
        *["-mavx512f", "-mavx512vl", "-mavx512dq", "-mavx512bw", "-mfma", "-mavx2"],
        "-mprefer-vector-width=512",
    ],
    "avx2": ["-mavx2", "-mfma"],
    "plain": [],
}


class BuildKernels(build_ext):
    """Leaves no library of an earlier source behind where the present one does not compile."""

    def build_extension(self, extension: Extension) -> None:
        """Compiles anew, also after a build that left its results in the build folder."""
        Path(self.get_ext_fullpath(extension.name)).unlink(missing_ok=True)
        super().build_extension(extension)

    def copy_extensions_to_source(self) -> None:
        """Replaces the libraries in the source tree, as an editable installation wants them."""
        for extension in self.extensions:
            Path(self.get_ext_fullpath(extension.name)).unlink(missing_ok=True)
        super().copy_extensions_to_source()


setup(
    ext_modules=[
        Extension(
            f"equirl.modules.native._{name}",
            [f"{FOLDER}/{name}.cpp", f"{FOLDER}/{name}_one.cpp"],
            depends=[*map(str, Path(FOLDER).glob("*.hpp")), "setup.py"],
            language="c++",
            extra_compile_args=[*FLAGS, *OPENMP, *flags],
            # Its own functions first, should another library have one of the same name.
            extra_link_args=["-Wl,-Bsymbolic"],
            optional=True,
        )
        for name, flags in INSTRUCTION_SETS.items()
    ],
    cmdclass={"build_ext": BuildKernels},
)
