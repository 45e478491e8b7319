"""Steerable layers, the networks built from them, their distribution, and the baselines."""

from equirl.modules.actor import EquivariantPolicy, make_actor
from equirl.modules.backend import BACKENDS, NativeUnavailable, resolve_backend
from equirl.modules.cnn import CNNEncoder, make_cnn_actor, make_cnn_critic
from equirl.modules.critic import EquivariantQHeads, make_critic
from equirl.modules.distributions import RadialTanhNormal
from equirl.modules.encoder import EquivariantEncoder
from equirl.modules.ferm import (
    FERM_FEATURES,
    FERMEncoder,
    make_ferm_actor,
    make_ferm_critic,
    tie_convolutions,
)
from equirl.modules.fields import FieldType
from equirl.modules.filters import shared_filters
from equirl.modules.layout import CenterCropped, uncropped
from equirl.modules.methods import METHODS
from equirl.modules.nonlinearity import FieldReLU, GatedNonlinearity
from equirl.modules.pooling import FieldMaxPool, GroupMaxPool, NormMaxPool, NormPool
from equirl.modules.rad import make_rad_actor, make_rad_critic
from equirl.modules.steerable import SteerableConv, SteerableLinear

__all__ = [
    "BACKENDS",
    "FERM_FEATURES",
    "METHODS",
    "CNNEncoder",
    "CenterCropped",
    "EquivariantEncoder",
    "EquivariantPolicy",
    "EquivariantQHeads",
    "FERMEncoder",
    "FieldMaxPool",
    "FieldReLU",
    "FieldType",
    "GatedNonlinearity",
    "GroupMaxPool",
    "NativeUnavailable",
    "NormMaxPool",
    "NormPool",
    "RadialTanhNormal",
    "SteerableConv",
    "SteerableLinear",
    "make_actor",
    "make_cnn_actor",
    "make_cnn_critic",
    "make_critic",
    "make_ferm_actor",
    "make_ferm_critic",
    "make_rad_actor",
    "make_rad_critic",
    "resolve_backend",
    "shared_filters",
    "tie_convolutions",
    "uncropped",
]
