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
from equirl.modules import METHODS
from equirl.training.checkpoint import CheckpointError, check_same_config, load_checkpoint
from equirl.training.folder import CHECKPOINT, load_run_config
from equirl.training.losses import make_auxiliary_loss, make_loss
from equirl.training.networks import make_networks
from equirl.training.representation import RepresentationLearner
from equirl.training.seeding import Purpose, torch_generator

__all__ = ["Learner", "load_learner"]


class Learner:
    """Soft actor-critic as the paper trains it (appendix D).

    One update computes the losses from one set of parameters, takes one Adam step
    on each, then moves the target critic. The actor's steps chase a moving critic, so it
    swings about the policy it is learning; on request an exponential moving average of
    its parameters (Polyak averaging) is kept as the policy to evaluate. Experience is
    always collected with the actor itself.

    What a method or an augmentation adds to soft actor-critic is one of its parts: the kind of
    ``loss``, an ``auxiliary`` loss on the same networks, or a ``representation`` that is learned
    beside them.

    Args:
        config: The run's configuration.

    Attributes:
        actor: The policy that collects experience; it shares its parameters with the loss.
        critic: The critic, likewise; its target copy is the loss's own.
    """

    def __init__(self, config: Config):
        algorithm = config.algorithm
        self.generator = torch_generator(config.seed, Purpose.LOSSES)
        self.actor, self.critic = networks = make_networks(config)
        self.loss = make_loss(config, *networks, self.generator).to(config.torch_device)
        self.auxiliary = make_auxiliary_loss(config, *networks, self.generator)
        self.representation = None
        if METHODS[config.method.name].contrastive:
            self.representation = RepresentationLearner(config, *networks, self.generator)
        self.target_update = SoftUpdate(self.loss, tau=algorithm.tau)
        self.average = _average(self.actor, algorithm.averaging) if algorithm.averaging else None
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=algorithm.learning_rate, fused=True
        )

    @property
    def metric_names(self) -> tuple[str, ...]:
        """What `update` reports."""
        names = [*self.loss.out_keys, "td_error"]
        names += self.auxiliary.out_keys if self.auxiliary else []
        names += self.representation.metric_names if self.representation else []
        return tuple(names)

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
        metrics = {key: losses[key].item() for key in self.loss.out_keys}
        metrics["td_error"] = batch["td_error"].mean().item()
        if self.auxiliary:
            terms = self.auxiliary(batch)
            torch.stack(list(terms.values())).sum().backward()
            metrics |= {key: value.item() for key, value in terms.items()}
        self.optimizer.step()
        self.target_update.step()
        if self.representation:
            metrics |= self.representation.update(batch)
        if self.average is not None:
            self.average.update_parameters(self.actor)
        return metrics

    def pretrain(self, batch: TensorDictBase) -> dict[str, float]:
        """One step of the representation alone, before training; the target critic follows at once.

        Args:
            batch: Transitions of batch size (B,), of demonstrations.

        Returns:
            The representation's metrics.
        """
        assert self.representation is not None
        metrics = self.representation.update(batch)
        parameters = self.loss.qvalue_network_params.data
        self.loss.target_qvalue_network_params.data.update_(parameters)
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Networks, targets, temperature, optimiser and average."""
        state = {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
        }
        if self.representation is not None:
            state["representation"] = self.representation.state_dict()
        if self.average is not None:
            state["average"] = self.average.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        if self.representation is not None:
            self.representation.load_state_dict(state["representation"])
        if self.average is not None:
            self.average.load_state_dict(state["average"])


def _average(actor: ProbabilisticActor, decay: float) -> AveragedModel:
    """An exponential moving average of the actor, a plain mean while it is young."""

    def move(
        average: torch.Tensor, current: torch.Tensor, count: torch.Tensor | int
    ) -> torch.Tensor:
        return torch.lerp(average, current, max(1 - decay, 1 / (int(count) + 1)))

    return AveragedModel(actor, avg_fn=move)


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
