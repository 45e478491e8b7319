"""The symmetry, stated once: groups, representations, and how every key transforms."""

from equirl.symmetry.audit import audit_env
from equirl.symmetry.audit_result import EnvAudit
from equirl.symmetry.groups import Element, SymmetryGroup
from equirl.symmetry.report import equivariance_report
from equirl.symmetry.report_observations import random_observations
from equirl.symmetry.report_result import EquivarianceReport, error_table, layer_table
from equirl.symmetry.representations import Irrep, Representation, ScalarField
from equirl.symmetry.spec import (
    ACTION,
    ACTION_PAPER,
    SymmetrySpec,
    action_representation,
    check_mode,
    manipulation_spec,
)

__all__ = [
    "ACTION",
    "ACTION_PAPER",
    "Element",
    "EnvAudit",
    "EquivarianceReport",
    "Irrep",
    "Representation",
    "ScalarField",
    "SymmetryGroup",
    "SymmetrySpec",
    "action_representation",
    "audit_env",
    "check_mode",
    "equivariance_report",
    "error_table",
    "layer_table",
    "manipulation_spec",
    "random_observations",
]
