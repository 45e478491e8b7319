"""The equivariant critic: one encoder, and heads that judge an action."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn

from equirl.modules.encoder import EquivariantEncoder
from equirl.modules.fields import FieldType
from equirl.modules.nonlinearity import make_activation
from equirl.modules.pooling import make_invariant_pool
from equirl.modules.steerable import SteerableLinear
from equirl.modules.wiring import OBSERVATION_KEYS, as_critic, check_keys, resolve_action
from equirl.symmetry import Representation, SymmetryGroup

__all__ = ["EquivariantQHeads", "make_critic"]


class EquivariantQHeads(nn.Module):
    """Invariant values of an action given steerable features (appendix A, figure 7 bottom).

    Args:
        features: Hidden fields of the encoder, see `FieldType.hidden`.
        action: How the action transforms; None for the manipulation action of the mode.
        mode: Which representation the action enters with; in ``"strict"`` theta changes
            its sign under reflections, in ``"paper"`` it is an invariant.
        heads: Number of independent estimates.
        width: Hidden fields of each head's hidden layer; as many as the features when
            None, as in the paper.
        generator: Source of the initial weights; torch's global one if None.

    Attributes:
        in_type: The features' fields followed by the action's.
        in_rep: The action's representation.
        out_type: One invariant per head.
    """

    def __init__(
        self,
        features: FieldType,
        *,
        action: Representation | None = None,
        mode: str = "strict",
        heads: int = 2,
        width: int | None = None,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        if not isinstance(heads, int) or heads < 1:
            raise ValueError(f"heads={heads!r}: expected a positive integer")
        group = features.group
        hidden = len(features.fields) // len(FieldType.hidden(group, 1).fields)
        if features != FieldType.hidden(group, hidden):
            raise ValueError(f"expected the hidden fields of an encoder, got {features}")
        width = hidden if width is None else width
        if not isinstance(width, int) or width < 1:
            raise ValueError(f"width of the heads, {width!r}: expected a positive integer")
        self.in_rep = resolve_action(action, mode)
        self.in_type = features + FieldType.of(group, self.in_rep)
        self.out_type = FieldType.trivial(group, heads)
        # The heads' first layers side by side: one filter, one product.
        fields = FieldType.hidden(group, heads * width)
        self.activation, self.pool = make_activation(fields), make_invariant_pool(fields)
        self.hidden = SteerableLinear(self.in_type, self.activation.in_type, generator=generator)
        invariants = FieldType.trivial(group, len(self.pool.out_type.fields) // heads)
        value = FieldType.trivial(group, 1)
        self.values = nn.ModuleList(
            SteerableLinear(invariants, value, generator=generator) for _ in range(heads)
        )

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Maps features (*batch, size) and actions (*batch, dim) to values (*batch, heads)."""
        x = self.activation(self.hidden(torch.cat([features, action], -1)))
        parts = self.pool(x).chunk(len(self.values), -1)
        return torch.cat([value(part) for value, part in zip(self.values, parts, strict=True)], -1)


def make_critic(
    group: SymmetryGroup | str,
    *,
    hidden: int = 64,
    image_size: int = 128,
    mode: str = "strict",
    action: Representation | None = None,
    in_keys: Sequence[NestedKey] = OBSERVATION_KEYS,
    channels: int = 1,
    invariants: int = 1,
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
    writes ``state_action_value`` (*batch, heads). For another environment, name its keys and
    state how its action transforms; `docs/custom_pipeline.md` does.

    Parameters at the paper's size, in either mode: C4 590,170; C8 and D4 1,178,970;
    D8 2,356,570; SO2 1,487,642; O2 1,133,322 (1,132,682 in ``strict``).

    Args:
        group: The symmetry group or its name: any ``C<n>`` or ``D<n>``, ``SO2`` or ``O2``.
        hidden: Number of hidden fields; 64 in the paper. A multiple of 8 (16 for 256 px).
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.
        mode: ``"strict"``: both values are invariant under the physical action.
            ``"paper"``: theta enters as an invariant.
        action: How the action transforms; None for the manipulation action of the mode.
        in_keys: Keys of the image and, if there are ``invariants``, of these.
        channels: Channels of the image.
        invariants: Length of the vector of invariants, 0 if there is none.
        heads: Number of estimates, which share the encoder.
        head_width: Hidden fields of each head's hidden layer; ``hidden`` when None, as in
            the paper. Narrow encoders profit from wider heads, which cost little.
        backend: Of the encoder: ``"native"``, the kernels for CPUs; ``"dense"``, torch's own;
            ``"auto"``, the faster one. They differ by rounding only, and share parameters.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Raises:
        ValueError: An argument is none of the above.
    """
    check_keys(in_keys, invariants)
    encoder = EquivariantEncoder(
        group,
        hidden=hidden,
        image_size=image_size,
        channels=channels,
        invariants=invariants,
        mode=mode,
        backend=backend,
        device=device,
        generator=generator,
    )
    q_heads = EquivariantQHeads(
        encoder.out_type,
        action=action,
        mode=mode,
        heads=heads,
        width=head_width,
        generator=generator,
    )
    q_heads.to(next(encoder.parameters()).device)
    return as_critic(encoder, q_heads, in_keys)
