"""Equivariance as an auxiliary loss: asked of networks that are not built with it."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torchrl.objectives import LossModule

from equirl.modules import shared_filters
from equirl.symmetry import SymmetrySpec, manipulation_spec

__all__ = ["EquivarianceLoss"]


class EquivarianceLoss(LossModule):
    """How far actor and critic are from the symmetry, on a batch that is turned at random.

    For transitions with states s and actions a, each with a rotation g of its own, pi(s) the greedy
    action and Q_i the heads of the critic,

    * ``loss_actor_equivariance``  = weight mean 1/2 (pi(g s) - g pi(s))^2, over rows and
      components;
    * ``loss_critic_equivariance`` = weight mean 1/2 (Q_i(g s, g a) - Q_i(s, a))^2, over rows and
      heads.

    Gradients go through both sides. The rotation is a true one, of image and action alike, as the
    symmetry states it; nothing is clipped. It is a term beside any loss that trains the same
    networks, whose parameters it shares; networks that are equivariant by construction leave
    nothing of it but interpolation.

    Args:
        actor: The policy.
        critic: Observation and action to ``state_action_value``.
        weight: Factor of both terms.
        quarter_turns: Whether g is one of the four quarter turns, which permute pixels, instead of
            any angle, which interpolates between them.
        spec: How each key transforms; that of planar manipulation when None.
        generator: Source of the rotations, on the CPU; torch's global one if None.

    Forward:
        Takes a tensordict of batch size (B,) with observation and ``action``; returns one of
        the two scalars.

    Raises:
        ValueError: The weight is not a number of 0 or more.
    """

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    critic_network: TensorDictModuleBase
    critic_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModuleBase,
        *,
        weight: float = 1.0,
        quarter_turns: bool = False,
        spec: SymmetrySpec | None = None,
        generator: torch.Generator | None = None,
    ):
        if not 0 <= weight < math.inf:
            raise ValueError(f"weight={weight!r}: expected a number of 0 or more")
        super().__init__()
        self.out_keys = ["loss_actor_equivariance", "loss_critic_equivariance"]
        self.convert_to_functional(actor, "actor_network")
        self.convert_to_functional(critic, "critic_network")
        self.weight = weight
        self.quarter_turns = quarter_turns
        self.spec = manipulation_spec() if spec is None else spec
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The two terms of a batch, see the class."""
        keys = {*self.actor_network.in_keys, *self.critic_network.in_keys}
        seen = tensordict.select(*keys)
        turn = self._draw(len(seen))
        both = TensorDict.cat([seen, turn(seen)], 0)
        with shared_filters(apart=True):  # its graph must outlive that of other losses
            with self.actor_network_params.to_module(self.actor_network):
                greedy = self.actor_network.get_dist(both.copy()).deterministic_sample
            with self.critic_network_params.to_module(self.critic_network):
                values = self.critic_network(both.copy())["state_action_value"]
        straight, turned = greedy.chunk(2)
        expected = turn(TensorDict({"action": straight}, seen.batch_size))["action"]
        errors = (turned - expected, torch.sub(*values.chunk(2)))
        terms = [self.weight * 0.5 * error.pow(2).mean() for error in errors]
        return TensorDict(dict(zip(self.out_keys, terms, strict=True)))

    def _draw(self, count: int) -> Callable[[TensorDictBase], TensorDictBase]:
        """Draws a rotation for each row; returns what turns the rows by them."""
        if self.quarter_turns:
            turns = torch.randint(4, (count,), generator=self.generator)
            return lambda rows: self.spec.quarter_turns(rows, turns.to(rows["action"].device))
        angles = math.tau * torch.rand(count, generator=self.generator)
        return lambda rows: self.spec.rotate(rows, angles.to(rows["action"].device))
