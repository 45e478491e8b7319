"""The equivariant actor: a squashed Gaussian whose parameters turn with the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from equirl.modules.distributions import RadialTanhNormal
from equirl.modules.encoder import EquivariantEncoder
from equirl.modules.fields import FieldType
from equirl.modules.steerable import SteerableLinear
from equirl.modules.wiring import OBSERVATION_KEYS, as_actor, check_keys, resolve_action
from equirl.symmetry import Representation, SymmetryGroup

__all__ = ["LOG_STD_RANGE", "EquivariantPolicy", "make_actor"]

#: Bounds of the logarithm of the standard deviation.
LOG_STD_RANGE = (-20.0, 2.0)


class EquivariantPolicy(nn.Module):
    """Encoder and head: the Gaussian's mean, an action, and invariant standard deviations.

    Args:
        encoder: Maps an observation to hidden fields.
        action: How the action transforms; None for the manipulation action of the mode.
        mode: ``"strict"``: the mean transforms like the physical action and each of its
            irreducible blocks has one standard deviation, so that x and y share theirs.
            ``"paper"`` (appendix A): theta's mean is an invariant and each component has its
            own standard deviation.
        generator: Source of the head's initial weights; torch's global one if None.

    Attributes:
        in_type: The encoder's input fields.
        out_rep: The action's representation, which the mean obeys.
        sharing: For each log standard deviation, how many components of the action it serves.
        distribution: What mean and deviations are the parameters of, besides
            ``distribution_options``.
    """

    def __init__(
        self,
        encoder: EquivariantEncoder,
        *,
        action: Representation | None = None,
        mode: str = "strict",
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.encoder = encoder
        self.out_rep = resolve_action(action, mode)
        self.sharing: tuple[int, ...]
        self.distribution: type[torch.distributions.Distribution]
        self.distribution_options: dict[str, Any]
        self.in_type = encoder.in_type
        group = self.in_type.group
        if mode == "paper":
            self.sharing = (1,) * self.out_rep.dim
            self.distribution, self.distribution_options = TanhNormal, {}
        else:
            self.sharing = tuple(irrep.dim for irrep in self.out_rep.irreps)
            self.distribution = RadialTanhNormal
            self.distribution_options = {"representation": self.out_rep}
        out_type = FieldType.of(group, self.out_rep) + FieldType.trivial(group, len(self.sharing))
        self.head = SteerableLinear(self.encoder.out_type, out_type, generator=generator)
        self.to(next(encoder.parameters()).device)

    def forward(self, image: Tensor, invariants: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Maps an observation, see the encoder, to mean and deviation, both (*batch, dim)."""
        out = self.head(self.encoder(image, invariants))
        loc, log_std = out.split([self.out_rep.dim, len(self.sharing)], -1)
        scale = log_std.clamp(*LOG_STD_RANGE).exp()
        shared = zip(scale.split(1, -1), self.sharing, strict=True)
        return loc, torch.cat([s.expand(*s.shape[:-1], count) for s, count in shared], -1)


def make_actor(
    group: SymmetryGroup | str,
    *,
    hidden: int = 64,
    image_size: int = 128,
    mode: str = "strict",
    action: Representation | None = None,
    in_keys: Sequence[NestedKey] = OBSERVATION_KEYS,
    channels: int = 1,
    invariants: int = 1,
    backend: str = "auto",
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> ProbabilisticActor:
    """An equivariant policy for soft actor-critic (paper, appendix A, figure 7 top).

    Reads ``depth`` (*batch, 1, S, S) and ``holding`` (*batch, 1); writes ``loc``, ``scale``,
    ``action`` (each (*batch, 5)) and ``action_log_prob``. For another environment, name its
    keys and state how its action transforms; `docs/custom_pipeline.md` does.

    Parameters at the paper's size (``strict`` shares one deviation between x and y, and
    has no bias on theta where reflections change its sign, nor weights to it in O(2)'s head
    but from sign fields):

    =====  =========  =========
    group  strict     paper
    =====  =========  =========
    C4       557,087    557,152
    C8     1,113,119  1,113,184
    D4     1,113,118  1,113,184
    D8     2,225,182  2,225,248
    SO2    1,394,271  1,394,336
    O2     1,047,438  1,047,504
    =====  =========  =========

    Args:
        group: The symmetry group or its name: any ``C<n>`` or ``D<n>``, ``SO2`` or ``O2``.
        hidden: Number of hidden fields; 64 in the paper. A multiple of 8 (16 for 256 px).
        image_size: Side of the image: 16, 32, 64, 128 or 256 pixels.
        mode: ``"strict"``: the distribution is exactly equivariant under the physical
            action; x and y are squashed radially onto the unit disc. ``"paper"``: the
            published policy, an elementwise squashed Gaussian with theta an invariant.
        action: How the action transforms; None for the manipulation action of the mode.
        in_keys: Keys of the image and, if there are ``invariants``, of these.
        channels: Channels of the image.
        invariants: Length of the vector of invariants, 0 if there is none.
        backend: Of the encoder: ``"native"``, the kernels for CPUs; ``"dense"``, torch's own;
            ``"auto"``, the faster one. They differ by rounding only, and share parameters.
        device: Where the parameters live; ``"auto"`` for the first GPU if there is one.
        generator: Source of the initial weights, on the CPU; torch's global one if None.

    Raises:
        ValueError: An argument is none of the above.

    Example:
        >>> actor = make_actor("D4", hidden=16, image_size=64)
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
    policy = EquivariantPolicy(encoder, action=action, mode=mode, generator=generator)
    return as_actor(policy, policy.distribution, in_keys, **policy.distribution_options)
