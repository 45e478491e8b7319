"""The kernels' constants are solved for; they hold what is exact, and no rounding."""

import os
import subprocess
import sys

import pytest

from equirl.modules.native.spectral import spectral_basis
from equirl.symmetry import SymmetryGroup

GROUPS = ("C4", "C8", "D4", "D8", "SO2", "O2")
CODE = f"""
import hashlib
from equirl.modules.native.spectral import spectral_basis
from equirl.symmetry import SymmetryGroup

for group in {GROUPS}:
    basis = spectral_basis(SymmetryGroup(group), "hidden")
    for values in (basis.expansion, basis.transposition):
        print(group, hashlib.sha256(values.numpy().tobytes()).hexdigest())
    print(basis.edge, basis.axis)
"""


@pytest.mark.parametrize("field", ["trivial", "hidden"])
@pytest.mark.parametrize("group", GROUPS)
def test_what_is_zero_is_exactly_zero(group, field):
    basis = spectral_basis(SymmetryGroup(group), field)
    constants = [basis.expansion]
    if basis.transposition is not None:
        constants.append(basis.transposition)
    for values in constants:
        sizes = values.abs()
        assert (sizes[sizes < 1e-9] == 0).all()
        assert sizes.max() > 0.1


def test_the_same_bytes_with_any_number_of_threads_of_linear_algebra():
    def constants(threads):
        limits = {f"{library}_NUM_THREADS": threads for library in ("OMP", "MKL", "OPENBLAS")}
        command = [sys.executable, "-c", CODE]
        done = subprocess.run(command, env=os.environ | limits, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    one = constants("1")
    assert one.count("\n") == 3 * len(GROUPS)
    assert one == constants("2")
