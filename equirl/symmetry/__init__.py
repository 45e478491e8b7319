"""The symmetry, stated once: groups, representations, and how every key transforms."""

from .audit import audit_env
from .audit_result import EnvAudit
from .groups import Element, SymmetryGroup
from .representations import Irrep, Representation, ScalarField
from .spec import ACTION, ACTION_PAPER, SymmetrySpec, action_representation, manipulation_spec

__all__ = [
    "ACTION",
    "ACTION_PAPER",
    "Element",
    "EnvAudit",
    "Irrep",
    "Representation",
    "ScalarField",
    "SymmetryGroup",
    "SymmetrySpec",
    "action_representation",
    "audit_env",
    "manipulation_spec",
]
