"""Symmetric networks and replay in a TorchRL script that has nothing to do with manipulation.

    python experiments/custom_pipeline.py
    python experiments/custom_pipeline.py --group c4 --copies 0
    python experiments/custom_pipeline.py --plain --copies 0

A hopper looks for its target in a field of mines. The environment is Gymnasium's; wrapper,
collector, buffer, loss and target update are TorchRL's. From equirl come the symmetry, the actor,
the critic and the buffer's transform; docs/custom_pipeline.md goes through them one by one.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from command_line import at_least
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    Compose,
    EnvBase,
    GymWrapper,
    InitTracker,
    StepCounter,
    ToTensorImage,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    MLP,
    ConvNet,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from equirl.data import RotationAugmentation
from equirl.modules import make_actor, make_critic
from equirl.symmetry import Representation, ScalarField, SymmetryGroup, SymmetrySpec

SIZE = 16  # pixels along a side
MOVE = Representation("vector")  # the action: a step (x, y)
SPEC = SymmetrySpec({"pixels": ScalarField(), "action": MOVE})  # what it does not name is invariant

Networks = tuple[ProbabilisticActor, Sequence[TensorDictModuleBase]]


class MineField(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """A hopper in the plane: one target to land on, three mines not to.

    It sees itself from above, in the middle of ``pixels`` (16, 16, 2), uint8: the target in the
    first channel, the mines in the second, two units along a side. Rows grow with x and columns
    with y. ``reach`` (1,) tells how far its longest hop goes. The action (x, y) is a hop in units
    of the reach; longer ones than 1 are cut to 1. Landing on the target is worth 1. That or a
    mine ends the episode.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}
    radius = 0.15  # of target and mines
    reaches = (0.15, 0.45)

    def __init__(self) -> None:
        box = gymnasium.spaces.Box
        self.observation_space: gymnasium.Space[Any] = gymnasium.spaces.Dict(
            pixels=box(0, 255, (SIZE, SIZE, 2), np.uint8), reach=box(*self.reaches, (1,))
        )
        self.action_space = box(-1, 1, (2,))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Draws a field, or takes ``places`` (4, 2), the target's first, and ``reach``."""
        super().reset(seed=seed)
        state = options or {}
        self.reach = float(state.get("reach", self.np_random.uniform(*self.reaches)))
        self.places = np.array(state.get("places", self._draw_places()), dtype=np.float64)
        return self._observation(), {}

    def _draw_places(self) -> np.ndarray:
        while True:
            places = self.np_random.uniform(-0.8, 0.8, (4, 2))
            apart = np.linalg.norm(places[:, None] - places, axis=-1)[np.triu_indices(4, 1)]
            if np.linalg.norm(places, axis=-1).min() > 2 * self.radius < apart.min():
                return places

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Hops; everything else moves past the hopper."""
        x, y = np.asarray(action, dtype=np.float64)
        self.places -= self.reach / max(1.0, math.hypot(x, y)) * np.array([x, y])
        touched = (self.places**2).sum(-1) < self.radius**2
        return self._observation(), float(touched[0]), bool(touched.any()), False, {}

    def _observation(self) -> dict[str, np.ndarray]:
        centres = (2 * np.arange(SIZE) + 1 - SIZE) / SIZE
        x, y = centres[:, None, None] - self.places[:, 0], centres[:, None] - self.places[:, 1]
        inside = (self.radius - np.sqrt(x**2 + y**2)) * SIZE / 2  # in pixels
        discs = (255 * (inside + 0.5).clip(0, 1)).round().astype(np.uint8)
        pixels = np.stack([discs[..., 0], discs[..., 1:].max(-1)], -1)
        return {"pixels": pixels, "reach": np.array([self.reach], dtype=np.float32)}


def make_env(seed: int) -> EnvBase:
    """The environment for TorchRL: ``pixels`` (2, 16, 16) float32, 20 hops an episode."""
    transforms = Compose(ToTensorImage(), StepCounter(20), InitTracker())
    env = TransformedEnv(GymWrapper(MineField()), transforms)
    env.set_seed(seed)
    return env


def symmetric_networks(group: SymmetryGroup | str) -> Networks:
    """An actor and two critics of equirl's."""
    sizes: dict[str, Any] = {"hidden": 8, "image_size": SIZE, "channels": 2, "invariants": 1}
    keys: dict[str, Any] = {"in_keys": ["pixels", "reach"], "action": MOVE}
    critics = [make_critic(group, heads=1, **sizes, **keys) for _ in range(2)]
    return make_actor(group, **sizes, **keys), critics


class PlainNetwork(nn.Module):
    """Convolutions of an image and a perceptron of what they give, beside some vectors."""

    def __init__(self, in_features: int, out_features: int):
        super().__init__()
        self.image = ConvNet(2, num_cells=[32, 64, 64], kernel_sizes=3, strides=2, paddings=1)
        self.head = MLP(256 + in_features, out_features, num_cells=[128])

    def forward(self, pixels: torch.Tensor, *vectors: torch.Tensor) -> torch.Tensor:
        """Maps (*batch, 2, 16, 16) and vectors (*batch, n) to (*batch, out_features)."""
        return self.head(self.image(pixels), *vectors)


def plain_networks() -> Networks:
    """An actor and two critics of TorchRL's parts, for comparison."""
    observation = ["pixels", "reach"]
    network = TensorDictModule(PlainNetwork(1, 4), observation, ["parameters"])
    gaussian = TensorDictModule(NormalParamExtractor(), ["parameters"], ["loc", "scale"])
    actor = ProbabilisticActor(
        TensorDictSequential(network, gaussian),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critics = [ValueOperator(PlainNetwork(3, 1), [*observation, "action"]) for _ in range(2)]
    return actor, critics


def train(networks: Networks, env: EnvBase, steps: int, copies: int) -> ReplayBuffer:
    """Soft actor-critic with one update a step, on any networks; returns the buffer."""
    actor, critics = networks
    # Without vmap the critics run one after the other, on equirl's native kernels.
    loss = SACLoss(
        actor,
        critics,
        loss_function="l2",
        alpha_init=0.1,
        target_entropy=-2.0,
        deactivate_vmap=True,
    )
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.95)
    target = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(max(steps, 1)),
        transform=RotationAugmentation(copies, spec=SPEC),
        batch_size=64,
    )
    for data in Collector(env, actor, frames_per_batch=20, total_frames=steps):
        buffer.extend(data.reshape(-1))  # one row a transition
        for _ in range(len(data)):
            losses = loss(buffer.sample())
            optimizer.zero_grad()
            (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
            optimizer.step()
            target.step()
    return buffer


@torch.no_grad()
@set_exploration_type(ExplorationType.DETERMINISTIC)
def success(actor: ProbabilisticActor, episodes: int) -> float:
    """The share of greedy episodes, always the same ones, that end on the target."""
    env = make_env(seed=1_000_000)
    rewards = [env.rollout(20, actor)["next", "reward"].sum() for _ in range(episodes)]
    return torch.stack(rewards).mean().item()


@torch.no_grad()
@set_exploration_type(ExplorationType.DETERMINISTIC)
def turning_error(
    actor: ProbabilisticActor, observations: TensorDictBase, group: SymmetryGroup
) -> float:
    """The largest difference between turned actions and actions for what was turned."""
    errors = []
    for element in group.grid_elements:  # the others do not map pixels to pixels
        expected = SPEC.transform(actor(observations), element)["action"]
        errors.append(actor(SPEC.transform(observations, element))["action"] - expected)
    return torch.stack(errors).abs().max().item()


def main(arguments: list[str] | None = None) -> ProbabilisticActor:
    """Trains, prints what came out and returns the actor."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    some, any_number = at_least(1), at_least(0)
    parser.add_argument("--group", default="D4", help="C<n>, D<n>, SO2 or O2")
    parser.add_argument("--plain", action="store_true", help="networks without symmetry")
    parser.add_argument("--copies", type=any_number, default=4, help="turned, of each transition")
    parser.add_argument("--steps", type=some, default=2000, help="of training")
    parser.add_argument("--episodes", type=some, default=200, help="of each evaluation")
    parser.add_argument("--seed", type=any_number, default=0)
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.manual_seed(asked.seed)
    try:
        group = SymmetryGroup(asked.group)
        networks = plain_networks() if asked.plain else symmetric_networks(group)
    except ValueError as error:
        parser.error(str(error))
    actor = networks[0]
    print(f"{success(actor, asked.episodes):.0%} of {asked.episodes} episodes before training")
    start = time.process_time()
    buffer = train(networks, make_env(asked.seed), asked.steps, asked.copies)
    print(f"{asked.steps} steps and updates in {time.process_time() - start:.0f} s of CPU time")
    print(f"{success(actor, asked.episodes):.0%} of {asked.episodes} episodes after training")
    print(f"turned actions differ by {turning_error(actor, buffer.sample(), group):.1g}")
    return actor


if __name__ == "__main__":
    main()
