"""One assertion for everything that turns with the scene.

Rotations and reflections are written out here with rot90, flip and matrices, so that an error in
the package's own idea of them cannot hide.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch
from torch import Tensor

from equirl.modules import FieldType
from equirl.symmetry import Element

Turn = Callable[[Tensor, int, bool], Tensor]


def grid_elements(group: str) -> list[tuple[int, bool]]:
    """(quarter turns, reflected) for every element that maps the pixels onto themselves."""
    order = 4 if group in ("SO2", "O2") else int(group[1:])
    turns = [k for k in range(4) if k * order % 4 == 0]
    flips = (False, True) if group[0] in "DO" else (False,)
    return [(k, flip) for flip in flips for k in turns]


def turn_image(image: Tensor, turns: int, flip: bool) -> Tensor:
    return torch.rot90(image.flip(-1) if flip else image, turns, (-2, -1))


def turn_action(action: Tensor, turns: int, flip: bool, theta_is_invariant: bool = False) -> Tensor:
    """(gripper, x, y, z, theta): y -> -y and theta -> -theta, then x towards y."""
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][turns]
    vector = np.array([[c, -s], [s, c]]) @ np.diag([1, -1 if flip else 1])
    matrix = np.eye(5)
    matrix[1:3, 1:3] = vector
    matrix[4, 4] = -1 if flip and not theta_is_invariant else 1
    return action @ torch.tensor(matrix.T).to(action)


turn_action_of_the_paper = partial(turn_action, theta_is_invariant=True)


def turn_fields(fields: FieldType) -> Turn:
    """Turns channels (..., size) of one pixel, here by the package, which has tests of its own."""
    return lambda x, turns, flip: fields.transform(x, Element(turns * math.pi / 2, flip))


def stay(x: Tensor, turns: int, flip: bool) -> Tensor:
    return x


def assert_equivariant(
    function: Callable[..., Mapping[str, Tensor]],
    group: str,
    inputs: Mapping[str, Tensor],
    turns: Mapping[str, Turn],
    *,
    case: str = "",
    tolerance: float = 1e-9,
) -> None:
    """Asserts that turned inputs give turned outputs, for every grid element of ``group``.

    Args:
        function: Takes the inputs by name and returns outputs by name.
        group: The name of the group.
        inputs: What to turn.
        turns: How inputs and outputs turn, by name; the others do not.
        case: What is tested, for the message.
        tolerance: The largest absolute error.
    """

    def turned(values: Mapping[str, Tensor], element: tuple[int, bool]) -> dict[str, Tensor]:
        return {name: turns.get(name, stay)(value, *element) for name, value in values.items()}

    before = function(**inputs)
    assert turns.keys() <= inputs.keys() | before.keys()
    for element in grid_elements(group):
        after, expected = function(**turned(inputs, element)), turned(before, element)
        assert after.keys() == expected.keys()
        for name, value in expected.items():
            where = f"{case}: {name} under {90 * element[0]}°{' after a flip' * element[1]}"
            assert after[name].shape == value.shape, where
            error = (after[name] - value).abs().max().item()
            assert error <= tolerance, f"{where} errs by {error:.2g}, more than {tolerance:.2g}"
