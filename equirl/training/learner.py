"""The learner: actor, critic and temperature, and one gradient step on all of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch.optim.swa_utils import AveragedModel
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SoftUpdate

from equirl.config import Config, flatten
from equirl.objectives import SACLoss
from equirl.training.checkpoint import CheckpointError, check_same_config, load_checkpoint
from equirl.training.folder import CHECKPOINT, load_run_config
from equirl.training.networks import make_networks

__all__ = ["Learner", "load_learner", "load_policy"]


class Learner:
    """Soft actor-critic as the paper trains it (appendix D).

    One update computes the three losses from one set of parameters, takes one Adam step
    on each, then moves the target critic. The actor's steps chase a moving critic, so it
    swings about the policy it is learning; on request an exponential moving average of
    its parameters (Polyak averaging) is kept as the policy to evaluate. Experience is
    always collected with the actor itself.

    Args:
        config: The run's configuration.

    Attributes:
        actor: The policy that collects experience; it shares its parameters with the loss.
        critic: The critic, likewise; its target copy is the loss's own.
    """

    def __init__(self, config: Config):
        algorithm = config.algorithm
        self.actor, self.critic = make_networks(config)
        self.loss = SACLoss(
            self.actor,
            self.critic,
            alpha_init=algorithm.alpha,
            target_entropy=algorithm.target_entropy,
            gamma=algorithm.discount,
        ).to(config.torch_device)
        self.target_update = SoftUpdate(self.loss, tau=algorithm.tau)
        self.average = _average(self.actor, algorithm.averaging) if algorithm.averaging else None
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=algorithm.learning_rate, fused=True
        )

    @property
    def metric_names(self) -> tuple[str, ...]:
        """What `update` reports."""
        return (*self.loss.out_keys, "td_error")

    @property
    def policy(self) -> ProbabilisticActor:
        """The policy to evaluate and to keep: the actor, or its average over recent updates."""
        return self.actor if self.average is None else self.average.module

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One gradient step.

        Args:
            batch: Transitions of batch size (B,).

        Returns:
            The losses, temperature and entropy, and the mean absolute Bellman error
            ``td_error``.
        """
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.loss.backward(batch)
        self.optimizer.step()
        self.target_update.step()
        if self.average is not None:
            self.average.update_parameters(self.actor)
        metrics = {key: losses[key].item() for key in self.loss.out_keys}
        return metrics | {"td_error": batch["td_error"].mean().item()}

    def state_dict(self) -> dict[str, Any]:
        """Networks, targets, temperature, optimiser and average."""
        state = {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
        if self.average is not None:
            state["average"] = self.average.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.average is not None:
            self.average.load_state_dict(state["average"])


def _average(actor: ProbabilisticActor, decay: float) -> AveragedModel:
    """An exponential moving average of the actor, a plain mean while it is young."""

    def move(
        average: torch.Tensor, current: torch.Tensor, count: torch.Tensor | int
    ) -> torch.Tensor:
        return torch.lerp(average, current, max(1 - decay, 1 / (int(count) + 1)))

    return AveragedModel(actor, avg_fn=move)


def load_policy(
    folder: str | Path, device: str | None = None, backend: str | None = None
) -> tuple[Config, ProbabilisticActor]:
    """The trained policy of a run's folder, with the run's configuration.

    Args:
        folder: The run's folder.
        device: Where to put the policy; where it was trained when None.
        backend: What an equivariant encoder runs on; what it was trained on when None.

    Raises:
        ConfigError: The folder is not that of a run, or the device or backend is not there.
        CheckpointError: It holds no readable checkpoint of that configuration.
    """
    config, _, learner = load_learner(folder, device, backend)
    return config, learner.policy


def load_learner(
    folder: str | Path, device: str | None = None, backend: str | None = None
) -> tuple[Config, dict[str, Any], Learner]:
    """What a run's folder holds: its configuration, its checkpoint, and the trained networks.

    Args:
        folder: The run's folder.
        device: Where to put the networks; where they were trained when None.
        backend: What equivariant encoders run on; what they were trained on when None.

    Raises:
        ConfigError: The folder is not that of a run, or the device or backend is not there.
        CheckpointError: It holds no readable checkpoint of that configuration.
    """
    folder = Path(folder)
    config = load_run_config(folder)
    config = replace(config, device=device or config.device, backend=backend or config.backend)
    state = load_checkpoint(folder / CHECKPOINT)
    check_same_config(flatten(config), state["config"], folder / CHECKPOINT)
    learner = Learner(config)
    if "learner" not in state:
        raise CheckpointError(f"{folder / CHECKPOINT} lacks 'learner'")
    learner.load_state_dict(state["learner"])
    return config, state, learner
