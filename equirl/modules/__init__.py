"""Steerable layers, the networks built from them, their distribution, and the baseline."""

from .actor import EquivariantPolicy, make_actor
from .backend import BACKENDS, NativeUnavailable, resolve_backend
from .cnn import CNNEncoder, make_cnn_actor, make_cnn_critic
from .critic import EquivariantQHeads, make_critic
from .distributions import RadialTanhNormal
from .encoder import EquivariantEncoder
from .fields import FieldType
from .filters import shared_filters
from .pooling import GroupMaxPool
from .steerable import SteerableConv, SteerableLinear

__all__ = [
    "BACKENDS",
    "CNNEncoder",
    "EquivariantEncoder",
    "EquivariantPolicy",
    "EquivariantQHeads",
    "FieldType",
    "GroupMaxPool",
    "NativeUnavailable",
    "RadialTanhNormal",
    "SteerableConv",
    "SteerableLinear",
    "make_actor",
    "make_cnn_actor",
    "make_cnn_critic",
    "make_critic",
    "resolve_backend",
    "shared_filters",
]
