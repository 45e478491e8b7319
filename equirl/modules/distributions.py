r"""A squashed Gaussian that commutes with rotations.

Squashing x and y each through tanh maps the plane to a square, which only the square's own
symmetries preserve. Squashing a vector's length maps it to the unit disc, which every
rotation and reflection preserves: a vector :math:`v` of length r becomes
:math:`\tanh(r)\,v/r`. One-dimensional components are squashed as usual.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor
from torch import distributions as D
from torch.distributions import constraints

from equirl.symmetry import Irrep, Representation

__all__ = ["RadialTanhNormal"]

# Below this squared length, quotients by the length are replaced by their series.
_SMALL = 1e-4
# Samples stay this far inside the boundary, where tanh can still be inverted well enough:
# nearer, rounding alone would decide the density of a stored action.
_LARGEST = 1 - 1e-6


class _UnitBlocks(constraints.Constraint):
    """Vectors whose every block has a length below one."""

    event_dim = 1

    def __init__(self, representation: Representation):
        self._representation = representation

    def check(self, value: Tensor) -> Tensor:
        lengths = [value[..., part].norm(dim=-1) for _, part in self._representation.blocks]
        return (torch.stack(lengths, -1) <= 1).all(-1)


class RadialTanhNormal(D.Distribution):
    r"""A Gaussian whose blocks are squashed to the unit interval or the unit disc.

    The log-determinant of the squash is :math:`\log(1-\tanh^2 r)` for every block, and
    :math:`\log(\tanh(r)/r)` more for a vector. If the deviation is the same in both
    components of a vector, transforming ``loc`` transforms the distribution.

    Args:
        loc: Mean of the Gaussian, shape (*batch, dim).
        scale: Its standard deviations, same shape.
        representation: Which components form vectors; its dimension is ``dim``.
        validate_args: As for every torch distribution; off if None.

    Raises:
        ValueError: The last dimension does not fit the representation.
    """

    has_rsample = True
    arg_constraints: ClassVar[dict] = {
        "loc": constraints.real_vector,
        "scale": constraints.independent(constraints.positive, 1),
    }

    def __init__(
        self,
        loc: Tensor,
        scale: Tensor,
        representation: Representation,
        validate_args: bool | None = None,
    ):
        if loc.shape[-1:] != (representation.dim,):
            raise ValueError(
                f"expected a last dimension of {representation.dim} for {representation}, "
                f"got loc of shape {tuple(loc.shape)}"
            )
        self.loc, self.scale = torch.broadcast_tensors(loc, scale)
        self.representation = representation
        super().__init__(self.loc.shape[:-1], self.loc.shape[-1:], validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Every block within the unit interval or disc."""
        return _UnitBlocks(self.representation)

    @property
    def deterministic_sample(self) -> Tensor:
        """The squashed mean of the Gaussian: the action of a greedy policy."""
        return self._squash(self.loc)

    @property
    def mode(self) -> Tensor:
        """The image of the Gaussian's mode; the squashed density may peak elsewhere."""
        return self.deterministic_sample

    @property
    def mean(self) -> Tensor:
        """Not available in closed form; average samples instead, as TorchRL does."""
        raise NotImplementedError("RadialTanhNormal has no closed-form mean: average samples")

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Reparametrised samples, of shape (*sample_shape, *batch, dim)."""
        return self._squash(self._draw(sample_shape))

    def rsample_and_log_prob(
        self, sample_shape: torch.Size | tuple[int, ...] = ()
    ) -> tuple[Tensor, Tensor]:
        """Samples and their log-density, from the values before the squash.

        Once tanh saturates the sample no longer determines them, so this is the accurate
        way to score a fresh sample; TorchRL's losses use it where it exists.
        """
        raw = self._draw(sample_shape)
        return self._squash(raw), self._log_prob_of_raw(raw)

    def sample_and_log_prob(
        self, sample_shape: torch.Size | tuple[int, ...] = ()
    ) -> tuple[Tensor, Tensor]:
        """As `rsample_and_log_prob`, without gradients through the sample."""
        with torch.no_grad():
            raw = self._draw(sample_shape)
            value = self._squash(raw)
        return value, self._log_prob_of_raw(raw)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density of ``value`` of shape (..., dim); shape (...).

        A block on or beyond the boundary, such as a stored or clipped action, is scored
        just inside it.
        """
        return self._log_prob_of_raw(self._unsquash(value))

    def expand(
        self, batch_shape: torch.Size, _instance: RadialTanhNormal | None = None
    ) -> RadialTanhNormal:
        """The same distribution over a larger batch."""
        shape = (*batch_shape, *self.event_shape)
        return type(self)(self.loc.expand(shape), self.scale.expand(shape), self.representation)

    def _draw(self, sample_shape: torch.Size | tuple[int, ...]) -> Tensor:
        shape = self._extended_shape(torch.Size(sample_shape))
        loc, scale = self.loc.expand(shape), self.scale.expand(shape)
        return loc + scale * torch.randn_like(loc)

    def _log_prob_of_raw(self, raw: Tensor) -> Tensor:
        normal = -0.5 * ((raw - self.loc) / self.scale) ** 2 - self.scale.log()
        constant = 0.5 * math.log(math.tau) * raw.shape[-1]
        return normal.sum(-1) - constant - self._log_det(raw)

    def _log_det(self, raw: Tensor) -> Tensor:
        total = torch.zeros_like(raw[..., 0])
        for irrep, part in self.representation.blocks:
            if irrep is Irrep.VECTOR:
                total = total + _log_det_radial(raw[..., part])
            else:
                total = total + _log_slope(raw[..., part.start])
        return total

    def _squash(self, raw: Tensor) -> Tensor:
        return torch.cat(
            [
                _squash_radial(raw[..., part])
                if irrep is Irrep.VECTOR
                else _inside(torch.tanh(raw[..., part]))
                for irrep, part in self.representation.blocks
            ],
            -1,
        )

    def _unsquash(self, value: Tensor) -> Tensor:
        return torch.cat(
            [
                _unsquash_radial(value[..., part])
                if irrep is Irrep.VECTOR
                else torch.atanh(_inside(value[..., part]))
                for irrep, part in self.representation.blocks
            ],
            -1,
        )


def _inside(x: Tensor) -> Tensor:
    return x.clamp(-_LARGEST, _LARGEST)


def _log_slope(r: Tensor) -> Tensor:
    """log(1 - tanh(r)^2), without cancellation for large r."""
    return 2 * (math.log(2) - r - F.softplus(-2 * r))


def _length(vector: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Squared length, whether it is small, and a length whose gradient is finite anyway."""
    squared = (vector * vector).sum(-1)
    small = squared < _SMALL
    return squared, small, torch.where(small, 1.0, squared).sqrt()


def _log_det_radial(raw: Tensor) -> Tensor:
    squared, small, r = _length(raw)
    exact = _log_slope(r) + torch.log(torch.tanh(r) / r)
    # Series of both terms in r^2, whose gradient at the origin is zero, not NaN.
    series = squared * (-4 / 3 + squared * (11 / 45 - squared * 188 / 2835))
    return torch.where(small, series, exact)


def _squash_radial(raw: Tensor) -> Tensor:
    squared, small, r = _length(raw)
    series = 1 + squared * (-1 / 3 + squared * (2 / 15 - squared * 17 / 315))
    ratio = torch.where(small, series, _inside(torch.tanh(r)) / r)
    return raw * ratio.unsqueeze(-1)


def _unsquash_radial(value: Tensor) -> Tensor:
    squared, small, r = _length(value)
    series = 1 + squared * (1 / 3 + squared * (1 / 5 + squared / 7))
    ratio = torch.where(small, series, torch.atanh(_inside(r)) / r)
    return value * ratio.unsqueeze(-1)
