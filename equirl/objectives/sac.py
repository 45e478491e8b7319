"""Soft actor-critic on TorchRL's loss, with one critic that holds both Q heads."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss as TorchRLSACLoss
from torchrl.objectives import ValueEstimators
from torchrl.objectives.sac import compute_rsample_log_prob

from equirl.modules import shared_filters

__all__ = ["SACLoss"]


class SACLoss(TorchRLSACLoss):
    """SAC losses for an actor and a critic of one encoder with several heads (appendix A).

    TorchRL's loss duplicates the whole Q-network for each critic and encodes the state
    anew for the actor's loss. Here the critic is a sequence of an encoder and heads: the
    features of the state are computed once and serve both losses, the actor's loss
    sends no gradient into the encoder or the heads, and every steerable filter is
    expanded once a call. Values and gradients are those of the textbook computation: with
    gamma the discount, alpha the temperature, H the target entropy, Q_i the heads and Q'_i
    those of the target critic, for transitions (s, a, r, s', terminated)

    * target:           y = r + gamma (1 - terminated) (min_i Q'_i(s', a') - alpha log pi(a'|s')),
      with a' ~ pi(.|s');
    * ``loss_qvalue`` = sum_i mean (Q_i(s, a) - y)^2;
    * ``loss_actor``  = mean (alpha log pi(b|s) - min_i Q_i(s, b)), with b ~ pi(.|s)
      reparameterised and Q_i held fixed;
    * ``loss_alpha``  = -mean (log alpha (log pi(b|s) + H)), the last factor held fixed.

    Transitions of a prioritized replay carry importance weights w, which make up for their being
    drawn more often than others (Schaul et al. 2016): then ``loss_qvalue`` is
    sum_i mean w (Q_i(s, a) - y)^2. Beyond the paper, a critic of more than two heads is an
    ensemble as in REDQ (Chen et al. 2021): each target takes the smaller of two heads drawn at
    random for the batch, and the actor climbs the mean of all.

    Args:
        actor: Stochastic policy, in_keys those of the observation.
        critic: A sequence of two modules: the encoder, observation to features, and the
            heads, features and action to ``state_action_value`` of shape (B, heads).
        alpha_init: Initial entropy temperature.
        target_entropy: Entropy that the temperature is tuned to, in nats.
        gamma: Discount factor.
        importance_weights: Whether ``priority_weight`` (B,), where a batch has it, weights the
            critic's loss; the paper's system computes weights and drops them.
        generator: Source of the losses' own randomness; torch's global one if None. Actions
            are drawn from the global one always, as in torch.distributions.

    Forward:
        Takes a tensordict of batch size (B,) and returns one of scalars ``loss_actor``,
        ``loss_qvalue`` (the sum over heads of the mean squared errors), ``loss_alpha``,
        ``alpha`` and ``entropy``; writes ``td_error`` (B,), the mean of the heads'
        absolute errors, into its input. The sum of the losses can be
        differentiated at once: each reaches its own parameters only. `backward`
        does so with less memory. Unlike TorchRL's losses it takes no loose tensors by name:
        the batch size cannot be told from images of one channel.

    Raises:
        TypeError: The critic is not a sequence of an encoder and heads.
        ValueError: A number is out of range.
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictSequential,
        *,
        alpha_init: float = 1e-2,
        target_entropy: float = -5.0,
        gamma: float = 0.99,
        importance_weights: bool = True,
        generator: torch.Generator | None = None,
    ):
        if not isinstance(critic, TensorDictSequential) or len(critic.module) != 2:
            raise TypeError(
                "the critic must be a TensorDictSequential of two modules, an encoder and "
                f"heads that return (B, heads); got {type(critic).__name__}"
            )
        if not 0 < gamma <= 1 or not math.isfinite(target_entropy) or not alpha_init > 0:
            raise ValueError(
                "expected gamma in (0, 1], a finite target_entropy and alpha_init above 0, got "
                f"gamma={gamma}, target_entropy={target_entropy}, alpha_init={alpha_init}"
            )
        super().__init__(
            actor,
            critic,
            num_qvalue_nets=None,
            loss_function="l2",
            alpha_init=alpha_init,
            target_entropy=target_entropy,
            # TorchRL would weight the actor's and the temperature's losses as well.
            use_prioritized_weights=False,
        )
        self.importance_weights = importance_weights
        self.generator = generator
        self._backward_at_once = False
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        # Reading it once turns the lazy attribute into a buffer, part of the state dict.
        _ = self.target_entropy

    def _make_vmap(self) -> None:
        """Replaces TorchRL's vmap over copies of a Q-network, in targets, by one call of ours."""

        def target_heads(tensordict: TensorDictBase, params: TensorDictParams) -> TensorDict:
            with params.to_module(self.qvalue_network, preserve_module_state=False):
                values = self.qvalue_network(tensordict.copy())
            q = values.get(self.tensor_keys.state_action_value)
            if q.shape[-1] > 2:
                q = q[..., torch.randperm(q.shape[-1], generator=self.generator)[:2]]
            stacked = {self.tensor_keys.state_action_value: q.movedim(-1, 0).unsqueeze(-1)}
            return TensorDict(stacked, [q.shape[-1], *tensordict.batch_size])

        self._vmap_qnetworkN0 = target_heads

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of a batch, see the class."""
        with shared_filters():
            loss_qvalue, critic = self.qvalue_v2_loss(tensordict)
            loss_actor, actor = self.actor_loss(tensordict)
        tensordict.set(self.tensor_keys.priority, critic["td_error"])
        log_prob = actor["log_prob"]
        losses = {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "loss_alpha": self._alpha_loss(log_prob).mean(),
            "alpha": self._alpha,
            "entropy": -log_prob.mean(),
        }
        further = {key: value for key, value in actor.items() if key.startswith("loss_")}
        return TensorDict(losses | further)

    def backward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of a batch, their gradients accumulated in the parameters.

        What ``forward`` and a backward pass of the sum of the losses do, but one network
        after the other, so that the activations of one encoder only are kept at a time.
        """
        self._backward_at_once = True
        try:
            losses = self(tensordict)
        finally:
            self._backward_at_once = False
        left = [value for key, value in losses.items() if key.startswith("loss_")]
        torch.stack([loss for loss in left if loss.requires_grad]).sum().backward()
        return losses

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Sum over heads of the mean squared Bellman error; keeps the state's features."""
        target = self._compute_target_v2(tensordict)
        encoder, heads = self.qvalue_network.module
        with self.qvalue_network_params.to_module(self.qvalue_network, preserve_module_state=False):
            values = encoder(tensordict.select(*self.qvalue_network.in_keys))
            heads(values)
        for key in encoder.out_keys:
            tensordict.set(key, values.get(key).detach())
        error = values.get(self.tensor_keys.state_action_value) - target.unsqueeze(-1)
        squared = error.pow(2)
        weights = tensordict.get(self.tensor_keys.priority_weight, None)
        if self.importance_weights and weights is not None:
            squared = squared * weights.to(squared).reshape(-1, 1)
        loss = squared.mean(0).sum()
        if self._backward_at_once:
            loss.backward()
            loss = loss.detach()
        return loss, {"td_error": error.detach().abs().mean(-1)}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean of alpha log pi(a|s) - min_i Q_i(s, a) over reparameterised actions a.

        Returns:
            The loss; ``log_prob`` (B,), detached, and the ``action`` (B, dim) itself.
        """
        with (
            set_exploration_type(ExplorationType.RANDOM),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            action, log_prob = compute_rsample_log_prob(self.actor_network.get_dist(tensordict))

        encoder, heads = self.qvalue_network.module
        values = tensordict.select(*encoder.out_keys).set(self.tensor_keys.action, action)
        with self._cached_detached_qvalue_params.to_module(
            self.qvalue_network, preserve_module_state=False
        ):
            heads(values)
        estimates = values.get(self.tensor_keys.state_action_value)
        q = estimates.mean(-1) if estimates.shape[-1] > 2 else estimates.min(-1).values
        loss = (self._alpha * log_prob - q).mean()
        return loss, {"log_prob": log_prob.detach(), "action": action}
