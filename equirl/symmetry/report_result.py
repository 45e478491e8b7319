"""What an equivariance report measured: its errors, and tables of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from equirl.symmetry.audit_result import markdown_table
from equirl.symmetry.groups import Element, SymmetryGroup

__all__ = [
    "BETWEEN",
    "ON_GRID",
    "EquivarianceReport",
    "Kind",
    "error_table",
    "kind_of",
    "layer_table",
]


class Kind(StrEnum):
    """Kinds of elements, apart in the tables since different things are exact for them."""

    IDENTITY = "identity"  #: the same again; an error here is noise
    GRID_TURN = "quarter turns"  #: of the group, as all that follow but the last
    GRID_REFLECTION = "reflections of the grid"
    OTHER_TURN = "other turns"
    OTHER_REFLECTION = "other reflections"
    OUTSIDE = "outside the group"


#: Kinds of elements of the group: those that map the pixel grid onto itself, and the others.
ON_GRID = (Kind.GRID_TURN, Kind.GRID_REFLECTION)
BETWEEN = (Kind.OTHER_TURN, Kind.OTHER_REFLECTION)
_MOVING = tuple(kind for kind in Kind if kind is not Kind.IDENTITY)
#: What there is in columns that are known beforehand.
_VALUES = {"kind": tuple(Kind), "level": ("end to end", "layer")}


def kind_of(element: Element, group: SymmetryGroup) -> Kind:
    """Returns the kind of an element, for networks of ``group``."""
    if element.quarter_turns == 0 and not element.reflected:
        return Kind.IDENTITY
    if element not in group:
        return Kind.OUTSIDE
    if element.preserves_grid:
        return Kind.GRID_REFLECTION if element.reflected else Kind.GRID_TURN
    return Kind.OTHER_REFLECTION if element.reflected else Kind.OTHER_TURN


@dataclass(frozen=True)
class EquivarianceReport:
    """What `equivariance_report` measured.

    Attributes:
        group: Whose elements are told from others.
        elements: The elements measured.
        observations: How many observations.
        action: How each block of an action was to transform.
        unmeasured: Layers whose fields the report does not know.
        rows: Columns of one length, a row for each quantity, or layer, and element:
            ``level`` (``"end to end"`` or ``"layer"``); ``name``; ``fields`` of a layer;
            ``kind`` (a `Kind`); ``angle``, degrees; ``reflected``; ``mean`` and ``max``, absolute
            errors over observations and components; ``interpolated``, the mean change when the
            picture is turned there and back, nan where that is exact and for layers; ``size``,
            the mean absolute value of the quantity.
    """

    group: SymmetryGroup
    elements: tuple[Element, ...]
    observations: int
    action: tuple[str, ...]
    unmeasured: tuple[str, ...]
    rows: dict[str, np.ndarray]

    def select(self, **conditions: Any) -> dict[str, np.ndarray]:
        """Returns some of the rows.

        Args:
            conditions: For columns of `rows`, a value or a tuple of values.

        Raises:
            ValueError: There is no such column, kind or level.
        """
        for column, values in conditions.items():
            _check("column", (column,), self.rows)
            if column in _VALUES:
                _check(column, (values,) if isinstance(values, str) else values, _VALUES[column])
        chosen = np.ones(len(self.rows["name"]), dtype=bool)
        for column, values in conditions.items():
            chosen &= np.isin(self.rows[column], values)
        return {column: values[chosen] for column, values in self.rows.items()}

    def error(self, name: str, **conditions: Any) -> tuple[float, float]:
        """Returns mean and largest error of a quantity or layer; nan where nothing was measured.

        Args:
            name: A quantity (``"mean"``, ``"sigma"``, ``"log-probability"``, ``"action"``, ``"Q"``)
                or a layer.
            conditions: As for `select`; without a ``kind``, all elements but the identity.

        Raises:
            ValueError: There is no such name, column, kind or level.
        """
        _check("name", (name,), dict.fromkeys(self.rows["name"].tolist()))
        rows = self.select(name=name, **{"kind": _MOVING, **conditions})
        if not len(rows["mean"]):
            return math.nan, math.nan
        return float(rows["mean"].mean()), float(rows["max"].max())

    def there_and_back(self, name: str) -> float:
        """Returns a quantity's mean change when pictures are turned there and back.

        It is nan where all elements map the pixel grid onto itself.

        Args:
            name: A quantity.
        """
        changes = self.select(level="end to end", name=name)["interpolated"]
        changes = changes[~np.isnan(changes)]
        return float(changes.mean()) if len(changes) else math.nan

    def names(self, level: str) -> list[str]:
        """Returns the quantities, or the layers in the order of their calls."""
        return list(dict.fromkeys(self.select(level=level)["name"].tolist()))

    def records(self) -> list[dict[str, Any]]:
        """Returns the rows one by one, for a CSV table."""
        columns = {column: values.tolist() for column, values in self.rows.items()}
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def table(self) -> str:
        """Returns the errors end to end and after each layer, as Markdown."""
        remarks = "\n".join(f"- {remark}" for remark in self.remarks)
        tables = [error_table({"": self})]
        if self.names("layer"):
            tables.append(layer_table({"error": self}))
        return "\n\n".join([*tables, remarks])

    def __str__(self) -> str:
        return self.table()

    @property
    def remarks(self) -> list[str]:
        """What the tables do not say, in sentences."""
        remarks = [
            f"{self.group.name}, {len(self.elements)} elements, {self.observations} observations, "
            f"actions {' + '.join(self.action)}."
        ]
        noise = self.select(level="end to end", kind=Kind.IDENTITY)["max"].max(initial=0.0)
        if noise > 0:
            remarks.append(f"Not repeatable: the same again differs by up to {_number(noise)}.")
        if self.unmeasured:
            remarks.append(f"Not measured, of fields unknown here: {', '.join(self.unmeasured)}.")
        return remarks


def _check(what: str, wanted: Iterable[str], known: Iterable[str]) -> None:
    known = tuple(known)
    for value in wanted:
        if value not in known:
            raise ValueError(f"{what}={value!r}: expected one of {', '.join(known)}")


def error_table(reports: Mapping[str, EquivarianceReport]) -> str:
    """Returns the errors end to end, mean and largest, as Markdown.

    Args:
        reports: Of the same quantities and elements, under what tells them apart.
    """
    first, labelled = next(iter(reports.values())), len(reports) > 1
    kinds = [kind for kind in _MOVING if kind in first.rows["kind"]]
    between = any(not element.preserves_grid for element in first.elements)
    header = ["error: mean (largest)", *(["on"] * labelled), "size", *kinds]
    rows = []
    for name in first.names("end to end"):
        for label, report in reports.items():
            size = _number(report.select(level="end to end", name=name)["size"][0])
            errors = [_cell(*report.error(name, level="end to end", kind=kind)) for kind in kinds]
            row = [name, *([label] * labelled), size, *errors]
            if between:
                row.append(_number(report.there_and_back(name)))
            rows.append(row)
    return markdown_table(header + ["there and back"] * between, rows)


def layer_table(reports: Mapping[str, EquivarianceReport]) -> str:
    """Returns the errors after each layer, mean (largest) of the layer's size, as Markdown.

    Args:
        reports: Of the same layers and elements, under what heads their columns.
    """
    first, rows = next(iter(reports.values())), []
    for name in first.names("layer"):
        fields = str(first.select(level="layer", name=name)["fields"][0])
        for place, kinds in (("on the grid", ON_GRID), ("others", BETWEEN)):
            where: dict[str, Any] = {"level": "layer", "name": name, "kind": kinds}
            if not len(first.select(**where)["mean"]):
                continue
            cells = [
                f"{_cell(*report.error(**where))} of {_number(report.select(**where)['size'][0])}"
                for report in reports.values()
            ]
            rows.append([name, fields, place, *cells])
    return markdown_table(["layer", "fields", "elements", *reports], rows)


def _cell(mean: float, largest: float) -> str:
    return "-" if math.isnan(mean) else f"{_number(mean)} ({_number(largest)})"


def _number(value: float) -> str:
    """Two digits."""
    return "-" if math.isnan(value) else f"{float(f'{value:.2g}'):g}"
