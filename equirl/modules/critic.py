"""The equivariant critic: one encoder, and heads that judge an action."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn

from equirl.modules.encoder import EquivariantEncoder
from equirl.modules.fields import FieldType
from equirl.modules.pooling import GroupMaxPool
from equirl.modules.steerable import SteerableLinear
from equirl.modules.wiring import as_critic
from equirl.symmetry import SymmetryGroup, action_representation

__all__ = ["EquivariantQHeads", "make_critic"]


class EquivariantQHeads(nn.Module):
    """Invariant values of an action given regular features (appendix A, figure 7 bottom).

    Args:
        features: Regular fields of the encoder.
        mode: Which representation the action enters with; in ``"strict"`` theta changes
            its sign under reflections, in ``"paper"`` it is an invariant.
        heads: Number of independent estimates.
        width: Regular fields of each head's hidden layer; as many as the features when
            None, as in the paper.
        generator: Source of the initial weights; torch's global one if None.

    Attributes:
        in_type: The features' fields followed by the action's.
        in_rep: The action's representation in this mode.
        out_type: One invariant per head.
    """

    def __init__(
        self,
        features: FieldType,
        *,
        mode: str = "strict",
        heads: int = 2,
        width: int | None = None,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        if not isinstance(heads, int) or heads < 1:
            raise ValueError(f"heads={heads!r}: expected a positive integer")
        width = len(features.fields) if width is None else width
        if not isinstance(width, int) or width < 1:
            raise ValueError(f"head_width={width!r}: expected a positive integer")
        group = features.group
        self.in_rep = action_representation(mode)
        self.in_type = features + FieldType.of(group, self.in_rep)
        self.out_type = FieldType.trivial(group, heads)
        # The heads' first layers side by side: one filter, one product.
        hidden = FieldType.regular(group, heads * width)
        self.hidden = SteerableLinear(self.in_type, hidden, generator=generator)
        self.pool = GroupMaxPool(hidden)
        invariants, value = FieldType.trivial(group, width), FieldType.trivial(group, 1)
        self.values = nn.ModuleList(
            SteerableLinear(invariants, value, generator=generator) for _ in range(heads)
        )

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Maps features (*batch, size) and actions (*batch, 5) to values (*batch, heads)."""
        x = self.hidden(torch.cat([features, action], -1))
        parts = self.pool(F.relu(x, inplace=True)).chunk(len(self.values), -1)
        return torch.cat([value(part) for value, part in zip(self.values, parts, strict=True)], -1)


def make_critic(
    group: SymmetryGroup | str,
    *,
    hidden: int = 64,
    image_size: int = 128,
    mode: str = "strict",
    heads: int = 2,
    head_width: int | None = None,
    backend: str = "auto",
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> TensorDictSequential:
    """An invariant critic for soft actor-critic (paper, appendix A, figure 7 bottom).

    Two modules in sequence, so that a loss can encode a state once and judge several
    actions: ``critic[0]`` reads ``depth`` (*batch, 1, S, S) and ``holding`` (*batch, 1) and
    writes ``_features``; ``critic[1]`` reads ``_features`` and ``action`` (*batch, 5) and
    writes ``state_action_value`` (*batch, heads).

    Parameters at the paper's size, in either mode: C4 590,170; C8 and D4 1,178,970;
    D8 2,356,570.

    Args:
        group: The symmetry group or its name: any ``C<n>`` or ``D<n>``.
        hidden: Number of regular fields; 64 in the paper. A multiple of 8 (16 for 256 px).
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.
        mode: ``"strict"``: both values are invariant under the physical action.
            ``"paper"``: theta enters as an invariant.
        heads: Number of estimates, which share the encoder.
        head_width: Regular fields of each head's hidden layer; ``hidden`` when None, as in
            the paper. Narrow encoders profit from wider heads, which cost little.
        backend: Of the encoder: ``"native"``, the kernels for CPUs; ``"dense"``, torch's own;
            ``"auto"``, the faster one. They differ by rounding only, and share parameters.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Raises:
        ValueError: An argument is none of the above.
    """
    encoder = EquivariantEncoder(
        group,
        hidden=hidden,
        image_size=image_size,
        backend=backend,
        device=device,
        generator=generator,
    )
    q_heads = EquivariantQHeads(
        encoder.out_type, mode=mode, heads=heads, width=head_width, generator=generator
    )
    q_heads.to(next(encoder.parameters()).device)
    return as_critic(encoder, q_heads)
