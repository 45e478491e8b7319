"""What equirl is measured against: the paper's networks in escnn's modules, updated by the book.

The networks hold the weights of ours and compute the same numbers, but for the networks of SO(2)
and O(2) in mode ``strict``: escnn's norm max-pooling takes one of tied maxima, as mode ``paper``
does, where ours shares them. The update is soft actor-critic written out plainly, and takes our
networks as well as escnn's.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from equirl.config.schema import AlgorithmConfig
from equirl.modules import (
    EquivariantEncoder,
    EquivariantPolicy,
    EquivariantQHeads,
    FieldReLU,
    FieldType,
    GatedNonlinearity,
    RadialTanhNormal,
    SteerableConv,
    SteerableLinear,
)
from equirl.modules.blocks import field_blocks
from equirl.modules.coupling import fixed_couplings
from equirl.modules.layout import stack_observation
from equirl.modules.nonlinearity import make_activation

with warnings.catch_warnings():
    # py3nj serves SO(3) only and needs a Fortran compiler; planar groups do not use it.
    warnings.filterwarnings("ignore", message="`py3nj` package not found")
    import escnn.nn as enn
    from escnn import gspaces


def escnn_type(fields: FieldType) -> enn.FieldType:
    """The same fields in escnn."""
    finite, mirrored = fields.group.is_finite, fields.group.reflections
    n = fields.group.rotations if finite else -1
    space = gspaces.flipRot2dOnR2(n) if mirrored else gspaces.rot2dOnR2(n)
    irreps: dict[str, tuple[int, ...]]
    if mirrored:
        irreps = {"trivial": (0, 0), "sign": (1, 0), "vector": (1, 1)}
        irreps |= {"vector_2": (1, 2), "vector_3": (1, 3), "vector_x": (0, 1), "vector_y": (1, 1)}
    else:
        irreps = {"trivial": (0,), "vector": (1,), "vector_2": (2,), "vector_3": (3,)}
        irreps |= {"vector_x": (1,)}
    kinds = {kind: space.irrep(*irreps[kind]) for kind in fields.kinds if kind != "regular"}
    if "regular" in fields.kinds:
        kinds["regular"] = space.regular_repr
    return enn.FieldType(space, [kinds[field] for field in fields.fields])


def escnn_convolution(ours: SteerableConv | SteerableLinear) -> enn.R2Conv:
    """escnn's convolution with the weights of our layer, which are laid out as escnn's.

    Its bases, which escnn keeps for the rest of the process, are made of our coefficients: escnn's
    own differ by signs from machine to machine, and with them what weights mean.
    """
    in_type, out_type = escnn_type(ours.in_type), escnn_type(ours.out_type)
    with fixed_couplings(in_type.fibergroup):
        theirs = enn.R2Conv(
            in_type,
            out_type,
            ours.kernel_size,
            padding=getattr(ours, "padding", 0),
            initialize=False,
        )
    theirs.load_state_dict(theirs.state_dict() | ours.state_dict())  # it has buffers besides
    return theirs


def escnn_layer(
    layer: SteerableConv | SteerableLinear, activation: FieldReLU | GatedNonlinearity
) -> list[enn.EquivariantModule]:
    """A convolution and the activation after it, whose gates come in escnn's order."""
    if isinstance(activation, FieldReLU):
        convolution = escnn_convolution(layer)
        return [convolution, enn.ReLU(convolution.out_type, inplace=True)]
    fields = activation.out_type
    count = len(fields.fields)
    # escnn hands the gates out to fields of one channel first, then to those of two.
    gates = sorted(range(count), key=lambda index: fields.dim(fields.fields[index]))
    order = [*range(count), *(count + gate for gate in gates)]
    convolution = escnn_convolution(_select(layer, order))
    kinds = ["gated"] * count + ["gate"] * count
    gated = enn.GatedNonLinearity1(convolution.out_type, kinds)
    with torch.no_grad():  # theirs is subtracted
        gated.bias.copy_(-activation.bias[gates])
    return [convolution, gated]


class EscnnEncoder(nn.Module):
    """Seven ``R2Conv`` with activations and max-pooling, the weights those of our encoder.

    With a finite group ReLU and pointwise maxima; with SO(2) and O(2) ``GatedNonLinearity1`` and
    ``NormMaxPool``, which takes one of tied maxima whatever the mode of ours.
    """

    def __init__(self, ours: EquivariantEncoder):
        super().__init__()
        self.image_size, self.out_type = ours.image_size, ours.out_type
        self.channels, self.invariants = ours.channels, ours.invariants
        pool_of = enn.PointwiseMaxPool if ours.out_type.is_permuted else enn.NormMaxPool
        modules: list[enn.EquivariantModule] = []
        for layer, activation, pool in zip(ours.layers, ours.activations, ours.pools, strict=True):
            modules += escnn_layer(cast(SteerableConv, layer), cast(FieldReLU, activation))
            if not isinstance(pool, nn.Identity):
                modules.append(pool_of(modules[-1].out_type, 2))
        self.layers = enn.SequentialModule(*modules)

    def forward(self, image: Tensor, invariants: Tensor | None = None) -> Tensor:
        """Maps (B, channels, S, S) and (B, invariants) to hidden fields (B, size)."""
        x = stack_observation(image, invariants, self.channels, self.invariants, self.image_size)
        return self.layers(self.layers.in_type(x)).tensor.flatten(1)


class EscnnLinear(nn.Module):
    """A 1 x 1 ``R2Conv`` between vectors of fields."""

    def __init__(self, ours: SteerableLinear):
        super().__init__()
        self.convolution = escnn_convolution(ours)

    def forward(self, x: Tensor) -> Tensor:
        """Maps (B, in size) to (B, out size)."""
        return self.convolution(self.convolution.in_type(x[..., None, None])).tensor.flatten(1)


class EscnnQHeads(nn.Module):
    """The critic's heads, each two 1 x 1 ``R2Conv`` about a pooling to invariants.

    ``GroupPooling`` with a finite group; with SO(2) and O(2) ``NormPool``, whose norms are those
    of ours but for a millionth.
    """

    def __init__(self, ours: EquivariantQHeads):
        super().__init__()
        self.heads = nn.ModuleList()
        pool_of = enn.GroupPooling if ours.in_type.group.is_finite else enn.NormPool
        for index, value in enumerate(ours.values):
            modules = escnn_layer(*_head(ours, index))
            modules.append(pool_of(modules[-1].out_type))
            last = escnn_convolution(cast(SteerableLinear, value))
            self.heads.append(enn.SequentialModule(*modules, last))

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Maps features (B, size) and actions (B, 5) to values (B, heads)."""
        x = torch.cat([features, action], -1)[..., None, None]
        heads = cast(list[enn.SequentialModule], list(self.heads))
        return torch.cat([head(head.in_type(x)).tensor.flatten(1) for head in heads], -1)


class Critic(nn.Module):
    """An encoder and the heads that judge an action, ours or escnn's."""

    def __init__(self, encoder: nn.Module, heads: nn.Module):
        super().__init__()
        self.encoder, self.heads = encoder, heads

    def forward(self, depth: Tensor, holding: Tensor, action: Tensor) -> Tensor:
        """Values (B, heads)."""
        return self.heads(self.encoder(depth, holding), action)


def escnn_policy(ours: EquivariantPolicy) -> EquivariantPolicy:
    """A copy of our policy whose encoder and head are escnn's."""
    policy = copy.deepcopy(ours)
    policy.add_module("encoder", EscnnEncoder(ours.encoder))
    policy.add_module("head", EscnnLinear(ours.head))
    return policy.train()


def escnn_critic(ours: Critic) -> Critic:
    """A copy of our critic in escnn's modules."""
    encoder, heads = cast(EquivariantEncoder, ours.encoder), cast(EquivariantQHeads, ours.heads)
    return Critic(EscnnEncoder(encoder), EscnnQHeads(heads)).train()


class TextbookSAC:
    """Soft actor-critic by the book: every network is run where the formulas name it.

    An update encodes five times: the next state by the actor and by the target critic and,
    for the actor's loss, the state by the critic, without gradients in the encoder; the
    state by the critic and by the actor with gradients. Same losses, in the same order of
    random draws, as `Learner`.

    Args:
        policy: Maps depth and flag to mean and deviation.
        critic: Maps depth, flag and action to values (B, heads).
        target: A copy of the critic, to follow it.
        settings: The algorithm's numbers.
    """

    def __init__(
        self,
        policy: EquivariantPolicy,
        critic: Critic,
        target: Critic,
        settings: AlgorithmConfig | None = None,
    ):
        self.policy, self.critic, self.target = policy, critic, target.requires_grad_(False)
        self.settings = settings = settings or AlgorithmConfig(name="sac")
        self.log_alpha = torch.tensor(settings.alpha).log().requires_grad_()
        self.optimizers = [
            torch.optim.Adam(parameters, lr=settings.learning_rate, fused=True)
            for parameters in (policy.parameters(), critic.parameters(), [self.log_alpha])
        ]

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One gradient step on a batch of transitions; returns the three losses."""
        state, following = (
            (observation["depth"], observation["holding"]) for observation in (batch, batch["next"])
        )
        alpha = self.log_alpha.detach().exp()
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)

        with torch.no_grad():
            action, log_prob = self._act(*following)
            value = self.target(*following, action).min(-1).values - alpha * log_prob
            live = 1 - batch["next", "terminated"].squeeze(-1).float()
            target = batch["next", "reward"].squeeze(-1) + self.settings.discount * live * value
        error = self.critic(*state, batch["action"]) - target.unsqueeze(-1)
        loss_qvalue = error.square().mean(0).sum()
        loss_qvalue.backward()

        action, log_prob = self._act(*state)
        self.critic.requires_grad_(False)
        q = self.critic(*state, action).min(-1).values
        self.critic.requires_grad_(True)
        loss_actor = (alpha * log_prob - q).mean()
        surprise = log_prob.detach() + self.settings.target_entropy
        loss_alpha = -(self.log_alpha * surprise).mean()
        (loss_actor + loss_alpha).backward()

        for optimizer in self.optimizers:
            optimizer.step()
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.critic.parameters(), strict=True)
            for slow, fast in pairs:
                slow.lerp_(fast, self.settings.tau)
        losses = {"loss_actor": loss_actor, "loss_qvalue": loss_qvalue, "loss_alpha": loss_alpha}
        return {name: loss.item() for name, loss in losses.items()}

    def _act(self, depth: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        loc, scale = self.policy(depth, holding)
        return RadialTanhNormal(loc, scale, self.policy.out_rep).rsample_and_log_prob()


def _head(
    ours: EquivariantQHeads, index: int
) -> tuple[SteerableLinear, FieldReLU | GatedNonlinearity]:
    """One head's part of the joint hidden layer and of its activation."""
    joint, heads = ours.activation, len(ours.values)
    fields = len(joint.out_type.fields)
    mine = slice(index * fields // heads, (index + 1) * fields // heads)
    places = list(range(fields))[mine]
    activation = make_activation(FieldType(joint.out_type.group, joint.out_type.fields[mine]))
    if isinstance(joint, GatedNonlinearity):  # the gates of all heads follow the fields of all
        places += [fields + place for place in places]
        activation.load_state_dict({"bias": joint.bias.detach()[mine]})
    return cast(SteerableLinear, _select(ours.hidden, places)), activation


def _select(
    layer: SteerableConv | SteerableLinear, places: Sequence[int]
) -> SteerableConv | SteerableLinear:
    """The layer whose output fields are those of another at these places, in this order."""
    kinds, biased = layer.out_type.fields, ("regular", "trivial")
    out_type = FieldType(layer.out_type.group, tuple(kinds[place] for place in places))
    weights, start = [], 0
    for block in field_blocks(layer.in_type, layer.out_type, layer.kernel_size):
        rows = layer.weights.detach()[start : start + block.size].view(block.fields_out, -1)
        start += block.size
        of_kind = [place for place, kind in enumerate(kinds) if kind == block.out]
        weights.append(rows[[of_kind.index(p) for p in places if kinds[p] == block.out]].flatten())
    state = {"weights": torch.cat(weights)}
    if layer.bias is not None:
        with_bias = [place for place, kind in enumerate(kinds) if kind in biased]
        chosen = [with_bias.index(place) for place in places if kinds[place] in biased]
        state["bias"] = layer.bias.detach()[chosen]
    part: SteerableConv | SteerableLinear
    if isinstance(layer, SteerableConv):
        part = SteerableConv(layer.in_type, out_type, layer.kernel_size, layer.padding)
    else:
        part = SteerableLinear(layer.in_type, out_type)
    part.load_state_dict(state)
    return part
