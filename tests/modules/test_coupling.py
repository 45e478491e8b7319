"""Clebsch-Gordan coefficients couple as they must, and are the same wherever they are computed."""

import math
import os
import subprocess
import sys
import threading

import numpy as np
import pytest
from escnn.group import cyclic_group, dihedral_group, o2_group, so2_group

from equirl.modules.coupling import clebsch_gordan, fixed_couplings

O2 = o2_group(6)
GROUPS = {"O2": O2, **{f"D{n}": dihedral_group(n) for n in (2, 3, 4, 8, 12)}}


def irreps(group):
    """All irreps of a dihedral group, and those of O(2) whose products escnn has."""
    return [irrep for irrep in group.irreps() if group is not O2 or irrep.id[1] <= 3]


def random_elements(group, count=5):
    rng = np.random.default_rng(0)
    if group is O2:  # not the generators that the equations are made of
        return [O2.element((int(rng.integers(2)), rng.uniform(0, math.tau))) for _ in range(count)]
    return [group.elements[index] for index in rng.integers(len(group.elements), size=count)]


@pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
def test_coefficients_commute_are_isometric_and_begin_positive(group):
    elements = random_elements(group)
    for first in irreps(group):
        for second in irreps(group):
            found = 0
            for product in group.irreps():
                coefficients = clebsch_gordan(first, second, product)
                assert coefficients.shape[:2] == (first.size, second.size)
                assert coefficients.shape[3] == product.size
                if not coefficients.shape[2]:
                    continue
                found += product.size
                into = coefficients.reshape(-1, product.size)
                np.testing.assert_allclose(into.T @ into, np.eye(product.size), atol=1e-12)
                for g in elements:
                    pair = np.kron(first(g), second(g))
                    np.testing.assert_allclose(pair @ into, into @ product(g), atol=1e-12)
                entries = into[np.abs(into) > 1e-9]
                assert entries[0] > 0
            assert found == first.size * second.size  # the products are all there is


@pytest.mark.parametrize("name", ["D4", "O2"])
def test_they_are_those_of_escnn_but_for_the_sign(name):
    group = GROUPS[name]
    for first in irreps(group):
        for second in irreps(group)[:3]:
            for product in group.irreps():
                ours = clebsch_gordan(first, second, product)
                theirs = group._clebsh_gordan_coeff(first.id, second.id, product.id)
                assert ours.shape == theirs.shape
                sign = 1 if (ours * theirs).sum() >= 0 else -1
                np.testing.assert_allclose(ours, sign * theirs, atol=1e-6)


def test_two_vectors_by_hand():
    """x x' + y y' is invariant, x y' - y x' a sign, and the rest a vector of frequency 2."""
    vector, half = O2.irrep(1, 1), math.sqrt(0.5)
    for product, expected in (
        (O2.irrep(0, 0), [[half], [0], [0], [half]]),
        (O2.irrep(1, 0), [[0], [half], [-half], [0]]),
        (O2.irrep(1, 2), [[half, 0], [0, half], [0, half], [-half, 0]]),
    ):
        found = clebsch_gordan(vector, vector, product).reshape(4, -1)
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert clebsch_gordan(vector, vector, O2.irrep(1, 3)).shape == (2, 2, 0, 2)


def test_products_that_occur_twice_are_refused():
    vector, trivial = (cyclic_group(4).irrep(k) for k in (1, 0))
    with pytest.raises(ValueError, match="irrep_0 occurs more than once in irrep_1 times irrep_1"):
        clebsch_gordan(vector, vector, trivial)


def test_escnn_uses_them_inside_only():
    group = dihedral_group(6)
    vector, other = group.irrep(1, 1), group.irrep(1, 2)
    before = dict(vars(group))
    with pytest.raises(RuntimeError, match="stop"), fixed_couplings(group):
        with fixed_couplings(group):  # the inner leaves the outer as it was
            pass
        ours = group._clebsh_gordan_coeff(vector, vector.id, other)
        assert np.array_equal(ours, clebsch_gordan(vector, vector, other))
        found = dict(group._tensor_product_irreps(vector.id, vector.id))
        assert found == {(0, 0): 1, (1, 0): 1, (1, 2): 1}
        raise RuntimeError("stop")
    assert vars(group).keys() == before.keys()


@pytest.mark.parametrize("group", [cyclic_group(8), so2_group(3)], ids=str)
def test_groups_with_closed_forms_are_left_alone(group):
    with fixed_couplings(group):
        assert "_clebsh_gordan_coeff" not in vars(group)


def test_threads_take_turns():
    group, order = dihedral_group(5), []

    def work():
        with fixed_couplings(group):
            order.append("thread")

    with fixed_couplings(group):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join(0.1)
        order.append("outer")
    thread.join()
    assert order == ["outer", "thread"]
    assert "_clebsh_gordan_coeff" not in vars(group)


BUILD = """
import hashlib, sys
import numpy as np, torch
seed, cache = sys.argv[1:]
if cache == "without":  # as on a machine where escnn never ran
    import joblib
    keep = lambda function: function
    joblib.Memory.cache = lambda self, function=None, **options: function or keep
from equirl.modules import make_actor, make_critic
np.random.seed(int(seed))
before = np.random.get_state()[1:3]
for group in ("O2", "D8"):
    parts = []
    for make in (make_actor, make_critic):
        generator = torch.Generator().manual_seed(0)
        network = make(group, hidden=8, image_size=16, backend="dense", generator=generator)
        for module in network.modules():
            if hasattr(module, "filter"):
                parts += [module.weights, module.filter()]
    data = b"".join(part.detach().contiguous().numpy().tobytes() for part in parts)
    print(group, len(parts), hashlib.sha256(data).hexdigest())
after = np.random.get_state()[1:3]
print("numpy drew", not (np.array_equal(before[0], after[0]) and before[1] == after[1]))
"""


def test_networks_are_the_same_in_every_process_and_draw_no_random_numbers():
    """Weights mean the same on any machine, so that a run can be read on another."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", BUILD, *arguments],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            text=True,
        )
        for arguments in (("1", "with"), ("2", "without"))
    ]
    first, second = (process.communicate(timeout=120)[0].splitlines() for process in processes)
    assert first == second
    assert [line.split()[:2] for line in first] == [["O2", "24"], ["D8", "24"], ["numpy", "drew"]]
    assert first[-1] == "numpy drew False"
