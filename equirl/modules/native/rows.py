"""The rows of the kernels' spectral tiles: what they compute, and in which order.

The kernels (regular.hpp, irreps.hpp) multiply pixel functions with the irreducible parts of a
field and sort the products by irrep. Here the same rows are written down as terms, from which
follows the filter that each spectral weight stands for.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

__all__ = ["Space", "corner_weights", "unit_filters", "without_noise"]

# A term of a row: pixel function, part of the input field, sign. A component is a sum of terms, a
# row has one component or, of a vector, two.
_Term = tuple[str, int, int]
_Row = list[list[_Term]]

_TOLERANCE = 1e-9
_DECIMALS = 11


class Space(Enum):
    """The groups the kernels work with, numbered as they number them."""

    C4 = 0
    D4 = 1
    SO2 = 2
    O2 = 3

    @property
    def mirror(self) -> bool:
        """Whether there are reflections."""
        return self in (Space.D4, Space.O2)

    @property
    def gates(self) -> int:
        """Gates of a hidden field, one for each of its irreps; none with a ReLU."""
        return {Space.SO2: 4, Space.O2: 5}.get(self, 0)

    @property
    def channels(self) -> int:
        """Channels of a hidden field."""
        return {Space.C4: 4, Space.D4: 8, Space.SO2: 7, Space.O2: 8}[self]


def unit_filters(space: Space, hidden: bool, forward: bool, edge: float, axis: float) -> np.ndarray:
    """The dense filter of each spectral weight of a pair of fields.

    Args:
        space: The group.
        hidden: Whether the input field is a hidden one; trivial otherwise.
        forward: To a hidden field with its gates; otherwise from one to a hidden field, as the
            gradient is propagated.
        edge: Weight of the corners in the pixel functions of even frequency.
        axis: Weight of the corners in the pixel functions x and y.

    Returns:
        Shape (weights, channels out, channels in, 9), float64.
    """
    functions = _pixel_functions(edge, axis)
    if space.gates:
        trivials_in = 1 if forward else 1 + space.gates
        rows = _irreducible_rows(space.mirror, trivials_in, hidden)
        width = space.channels + space.gates * (not forward) if hidden else 1
        parts_in = np.eye(width)
        parts_out = _irreducible_parts(space, 1 + space.gates * forward)
    else:
        rows = _regular_rows(space.mirror, hidden)
        fourier = _fourier(space.mirror)
        parts_in = fourier if hidden else np.ones((1, 1))
        singles = 4 if space.mirror else 2
        vectors = [fourier[start : start + 2] for start in range(singles, len(fourier), 2)]
        parts_out = [[fourier[single : single + 1]] for single in range(singles)] + [vectors]

    def filter_of(terms: list[_Term]) -> np.ndarray:
        return np.sum([s * np.outer(parts_in[part], functions[name]) for name, part, s in terms], 0)

    return np.stack(
        [
            np.sum(
                [
                    np.multiply.outer(channel, filter_of(terms))
                    for channel, terms in zip(copy, row, strict=True)
                ],
                axis=0,
            )
            for irrep, copies in zip(rows, parts_out, strict=True)
            for copy in copies
            for row in irrep
        ]
    )


def _irreducible_parts(space: Space, trivials: int) -> list[list[np.ndarray]]:
    """For each irrep its copies in a field, each the channels of its components."""
    channels = np.eye(space.channels + trivials - 1)
    ones, rest = list(channels[:trivials, None]), channels[trivials:]
    signs = [[rest[:1]]] if space.mirror else []
    vectors = rest[len(signs) :].reshape(3, 2, -1)
    return [ones, *signs, *([vector] for vector in vectors)]


def corner_weights(filters: np.ndarray) -> tuple[float, float] | None:
    """Weights of the corners beside an edge and beside an axis, from filters (N, 9).

    None if the filters span more than six functions with such weights.
    """
    _, scales, functions = np.linalg.svd(np.linalg.qr(filters, mode="r"))
    if scales[6] > _TOLERANCE * scales[0]:
        return None
    missing = functions[6:]
    weights = []
    plain = _pixel_functions(0.0, 0.0)
    for name, corners in (("edge", _pixel_functions(1.0, 0.0)), ("x", _pixel_functions(0.0, 1.0))):
        base, more = missing @ plain[name], missing @ (corners[name] - plain[name])
        weight = -float(base @ more / (more @ more))
        if np.abs(base + weight * more).max() > _TOLERANCE:
            return None
        weights.append(weight)
    edge, axis = without_noise(np.array(weights)).tolist()
    return edge, axis


def without_noise(solution: np.ndarray) -> np.ndarray:
    """What was solved for in float64, of any shape, rounded to 11 decimals.

    Its errors, up to 1e-14 and with them what should be zero, differ with the number of threads
    of the linear algebra. Training amplifies them until two runs of one seed part.
    """
    return np.round(solution, _DECIMALS) + 0.0  # no negative zeros


def _pixel_functions(edge: float, axis: float) -> dict[str, np.ndarray]:
    """The six functions on the 3 x 3 pixels; x grows with the rows, y with the columns."""
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij")
    corner, centre = np.abs(x * y), (1 - x**2) * (1 - y**2)
    functions = {
        "centre": centre,
        "edge": (1 - centre - corner) + edge * corner,
        "square": (x**2 - y**2),
        "cross": edge * x * y,
        "x": x * (1 - corner + axis * corner),
        "y": y * (1 - corner + axis * corner),
    }
    return {name: function.reshape(9) for name, function in functions.items()}


def _fourier(mirror: bool) -> np.ndarray:
    """Rows: one-dimensional irreps, then pairs of components of each vector."""
    cos, sin = np.array([1, 0, -1, 0]), np.array([0, 1, 0, -1])
    one, sign = np.ones(4), np.array([1, -1, 1, -1])
    if not mirror:
        return np.stack([one, sign, cos, sin])
    even = [np.concatenate([row, row]) for row in (one, sign, cos, sin)]
    odd = [np.concatenate([row, -row]) for row in (one, sign, -sin, cos)]
    return np.stack([even[0], odd[0], even[1], odd[1], even[2], even[3], odd[2], odd[3]])


def _regular_rows(mirror: bool, regular: bool) -> list[list[_Row]]:
    """For each one-dimensional irrep, then for the vector, the rows of an input field."""
    rows: list[list[_Row]] = [[] for _ in range(5 if mirror else 3)]
    vector = rows[-1]

    def add_vector(first: list[_Term], second: list[_Term]) -> None:
        vector.append([first, second])
        if not mirror:  # a vector may be turned as well: (a, b) and (-b, a)
            vector.append([[(name, part, -sign) for name, part, sign in second], first])

    if not regular:
        square, cross = (2, 3) if mirror else (1, 1)
        for irrep, name in ((0, "centre"), (0, "edge"), (square, "square"), (cross, "cross")):
            rows[irrep].append([[(name, 0, 1)]])
        add_vector([("x", 0, 1)], [("y", 0, 1)])
        return rows
    irreps, starts = (4, (4, 6)) if mirror else (2, (2,))
    square, cross = (2, 3) if mirror else (1, 1)
    for irrep in range(irreps):
        rows[irrep] += [
            [[("centre", irrep, 1)]],
            [[("edge", irrep, 1)]],
            [[("square", irrep ^ square, 1)]],
            [[("cross", irrep ^ cross, 1)]],
        ]
        products: list[list[_Row]] = [
            [[[("x", a, 1), ("y", a + 1, 1)]], [[("x", a + 1, 1), ("y", a, -1)]],
             [[("x", a, 1), ("y", a + 1, -1)]], [[("x", a + 1, 1), ("y", a, 1)]]]
            for a in starts
        ]  # fmt: skip
        if mirror:
            rows[irrep] += [product[irrep] for product in products]
        else:
            rows[irrep] += products[0][2 * irrep : 2 * irrep + 2]
    for a in starts:
        add_vector([("centre", a, 1)], [("centre", a + 1, 1)])
        add_vector([("edge", a, 1)], [("edge", a + 1, 1)])
        add_vector([("square", a, 1)], [("square", a + 1, -1)])
        add_vector([("cross", a + 1, 1)], [("cross", a, 1)])
    add_vector([("x", 0, 1)], [("y", 0, 1)])
    if mirror:
        add_vector([("y", 1, -1)], [("x", 1, 1)])
        add_vector([("x", 2, 1)], [("y", 2, -1)])
        add_vector([("y", 3, 1)], [("x", 3, 1)])
    else:
        add_vector([("x", 1, 1)], [("y", 1, -1)])
    return rows


def _irreducible_rows(mirror: bool, trivials: int, rest: bool) -> list[list[_Row]]:
    """For each irrep (trivial, sign, vectors of frequency 1 to 3) the rows of an input field.

    Args:
        mirror: Whether there are reflections, and so a sign irrep.
        trivials: Trivial parts of the field.
        rest: Whether it has the other irreps too.
    """
    rows: list[list[_Row]] = [[] for _ in range(5 if mirror else 4)]
    one, odd, vectors = rows[0], rows[1] if mirror else rows[0], rows[-3:]

    def add(frequency: int, first: list[_Term], second: list[_Term]) -> None:
        vectors[frequency - 1].append([first, second])
        if not mirror:  # v and i v
            turned = [(name, part, -sign) for name, part, sign in second]
            vectors[frequency - 1].append([turned, first])

    def product(a: str, b: str, part: int, sign: int) -> tuple[list[_Term], list[_Term]]:
        """Of (a, b) and the vector that starts at a part; the former conjugated for -1."""
        first: list[_Term] = [(a, part, 1), (b, part + 1, -sign)]
        return first, [(a, part + 1, 1), (b, part, sign)]

    for part in range(trivials):
        one.append([[("centre", part, 1)]])
        one.append([[("edge", part, 1)]])
        add(1, [("x", part, 1)], [("y", part, 1)])
        add(2, [("square", part, 1)], [("cross", part, 1)])
    if not rest:
        return rows
    part = trivials
    if mirror:
        odd.append([[("centre", part, 1)]])
        odd.append([[("edge", part, 1)]])
        add(1, [("y", part, -1)], [("x", part, 1)])
        add(2, [("cross", part, -1)], [("square", part, 1)])
        part += 1
    for frequency in (1, 2, 3):
        add(frequency, [("centre", part, 1)], [("centre", part + 1, 1)])
        add(frequency, [("edge", part, 1)], [("edge", part + 1, 1)])
        if frequency < 3:
            equal = ("x", "y") if frequency == 1 else ("square", "cross")
            even, uneven = product(*equal, part, -1)
            one.append([even])
            odd.append([uneven])
        if frequency == 1:
            real, imaginary = product("square", "cross", part, -1)
            add(1, real, [(name, k, -sign) for name, k, sign in imaginary])
            add(2, *product("x", "y", part, 1))
            add(3, *product("square", "cross", part, 1))
        elif frequency == 2:
            add(1, *product("x", "y", part, -1))
            add(3, *product("x", "y", part, 1))
        else:
            add(2, *product("x", "y", part, -1))
            add(1, *product("square", "cross", part, -1))
        part += 2
    return rows
