"""Steerable layers, the networks built from them, their distribution, and the baseline."""

from .actor import EquivariantPolicy, make_actor
from .cnn import CNNEncoder, make_cnn_actor, make_cnn_critic
from .critic import EquivariantQHeads, make_critic
from .distributions import RadialTanhNormal
from .encoder import EquivariantEncoder
from .fields import FieldType
from .filters import shared_filters
from .pooling import GroupMaxPool
from .steerable import SteerableConv, SteerableLinear

__all__ = [
    "CNNEncoder",
    "EquivariantEncoder",
    "EquivariantPolicy",
    "EquivariantQHeads",
    "FieldType",
    "GroupMaxPool",
    "RadialTanhNormal",
    "SteerableConv",
    "SteerableLinear",
    "make_actor",
    "make_cnn_actor",
    "make_cnn_critic",
    "make_critic",
    "shared_filters",
]
