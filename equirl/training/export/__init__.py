"""Policies as files of their own, each with a certificate of what was measured on it."""

from equirl.training.export.certificate import summary
from equirl.training.export.exporting import (
    as_function,
    check_exported,
    export_actor,
    export_policy,
)
from equirl.training.export.formats import FORMATS, ExportError, load_exported, read_certificate
from equirl.training.export.frozen import FrozenPolicy
from equirl.training.export.measures import Observations

__all__ = [
    "FORMATS",
    "ExportError",
    "FrozenPolicy",
    "Observations",
    "as_function",
    "check_exported",
    "export_actor",
    "export_policy",
    "load_exported",
    "read_certificate",
    "summary",
]
