"""What equirl is measured against: the paper's networks in escnn's modules, updated by the book.

The networks hold the weights of ours and compute the same numbers. The update is soft
actor-critic written out plainly, and takes our networks as well as escnn's.
"""

from __future__ import annotations

import copy
import warnings
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from equirl.config.schema import AlgorithmConfig
from equirl.modules import (
    EquivariantEncoder,
    EquivariantPolicy,
    EquivariantQHeads,
    FieldType,
    RadialTanhNormal,
    SteerableConv,
    SteerableLinear,
)
from equirl.modules.blocks import field_blocks
from equirl.modules.layout import stack_observation

with warnings.catch_warnings():
    # py3nj serves SO(3) only and needs a Fortran compiler; planar groups do not use it.
    warnings.filterwarnings("ignore", message="`py3nj` package not found")
    import escnn.nn as enn
    from escnn import gspaces


def escnn_type(fields: FieldType) -> enn.FieldType:
    """The same fields in escnn."""
    n, mirrored = fields.group.rotations, fields.group.reflections
    space = gspaces.flipRot2dOnR2(n) if mirrored else gspaces.rot2dOnR2(n)
    kinds = {"regular": space.regular_repr, "trivial": space.trivial_repr}
    if mirrored:
        kinds |= {"sign": space.irrep(1, 0), "vector": space.irrep(1, 1)}
        kinds |= {"vector_x": space.irrep(0, 1), "vector_y": space.irrep(1, 1)} if n == 2 else {}
    else:
        kinds |= {"vector": space.irrep(1), "vector_x": space.irrep(1)}
    return enn.FieldType(space, [kinds[field] for field in fields.fields])


def escnn_convolution(ours: SteerableConv | SteerableLinear) -> enn.R2Conv:
    """escnn's convolution with the weights of our layer, which are laid out as escnn's."""
    theirs = enn.R2Conv(
        escnn_type(ours.in_type),
        escnn_type(ours.out_type),
        ours.kernel_size,
        padding=getattr(ours, "padding", 0),
        initialize=False,
    )
    theirs.load_state_dict(theirs.state_dict() | ours.state_dict())  # it has buffers besides
    return theirs


class EscnnEncoder(nn.Module):
    """Seven ``R2Conv`` with ReLU and max-pooling, the weights those of our encoder."""

    def __init__(self, ours: EquivariantEncoder):
        super().__init__()
        self.image_size, self.out_type = ours.image_size, ours.out_type
        modules: list[enn.EquivariantModule] = []
        for layer, pool in zip(ours.layers, ours.pools, strict=True):
            convolution = escnn_convolution(cast(SteerableConv, layer))
            modules += [convolution, enn.ReLU(convolution.out_type, inplace=True)]
            modules += [enn.PointwiseMaxPool(convolution.out_type, 2)] if pool else []
        self.layers = enn.SequentialModule(*modules)

    def forward(self, depth: Tensor, holding: Tensor) -> Tensor:
        """Maps (B, 1, S, S) and (B, 1) to regular fields (B, size)."""
        x = stack_observation(depth, holding, self.image_size)
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
    """The critic's heads, each two 1 x 1 ``R2Conv`` about a ``GroupPooling``."""

    def __init__(self, ours: EquivariantQHeads):
        super().__init__()
        self.heads = nn.ModuleList()
        for hidden, value in zip(_split(ours.hidden, len(ours.values)), ours.values, strict=True):
            first = escnn_convolution(hidden)
            last = escnn_convolution(cast(SteerableLinear, value))
            between = enn.ReLU(first.out_type, inplace=True), enn.GroupPooling(first.out_type)
            self.heads.append(enn.SequentialModule(first, *between, last))

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


def _split(joint: SteerableLinear, heads: int) -> list[SteerableLinear]:
    """The layers of which ``joint`` is the stack, each with its share of the output fields."""
    fields = joint.out_type.fields[: len(joint.out_type.fields) // heads]
    parts = []
    for head in range(heads):
        part = SteerableLinear(joint.in_type, FieldType(joint.in_type.group, fields))
        weights, start = [], 0
        for block in field_blocks(joint.in_type, joint.out_type, 1):
            of_block = joint.weights.detach()[start : start + block.size]
            weights.append(of_block.chunk(heads)[head])
            start += block.size
        state = {"weights": torch.cat(weights)}
        if joint.bias is not None:
            state["bias"] = joint.bias.detach().chunk(heads)[head]
        part.load_state_dict(state)
        parts.append(part)
    return parts
