"""Trains Stable-Baselines3's SAC on one of equirl's environments.

    python experiments/stable_baselines3_sac.py
    python experiments/stable_baselines3_sac.py --env equirl/BlockPushing-v0 --steps 20000

It plugs an environment, its depth image and its expert into another library: a baseline without
symmetry, to which a few hundred steps teach next to nothing. Needs ``equirl[sb3]``.
"""

from __future__ import annotations

import argparse
import sys
from typing import cast

import gymnasium
import numpy as np
import torch
from command_line import at_least
from torch import nn

try:
    from stable_baselines3 import SAC
    from stable_baselines3.common.buffers import ReplayBuffer
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
except ModuleNotFoundError as error:
    sys.exit(f"error: {error}; this example needs: pip install 'equirl[sb3]'")

from tensordict import TensorDict

from equirl.envs import ROBOTS, ManipulationEnv, make_expert
from equirl.envs.gymnasium import GymnasiumEnv  # registers the environments too


class DepthAndHolding(BaseFeaturesExtractor):
    """Convolves ``depth`` (B, 1, S, S) and appends ``holding`` (B, 1).

    Stable-Baselines3 would by itself flatten the image: it takes only uint8 for one.
    """

    def __init__(self, space: gymnasium.spaces.Dict, width: int = 64):
        super().__init__(space, features_dim=width + 1)
        depth = space["depth"]
        assert isinstance(depth, gymnasium.spaces.Box)
        self.deepest = float(depth.high.max())
        convolutions: list[nn.Module] = []
        for inputs, outputs in ((1, 16), (16, 32), (32, 32)):
            convolutions += [nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.ReLU()]
        side = -(-depth.shape[-1] // 8)  # halved three times, rounding up
        linear = nn.Linear(32 * side * side, width)
        self.image = nn.Sequential(*convolutions, nn.Flatten(), linear, nn.ReLU())

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns features, shape (B, width + 1)."""
        image = self.image(observations["depth"] / self.deepest)
        return torch.cat([image, observations["holding"]], dim=-1)


def simulated(env: gymnasium.Env) -> ManipulationEnv:
    """equirl's own environment inside."""
    return cast(GymnasiumEnv, env.unwrapped).env


def add_demonstrations(buffer: ReplayBuffer, env: gymnasium.Env, episodes: int, seed: int) -> None:
    """Fills ``buffer`` with successful episodes of equirl's expert."""
    expert = make_expert(simulated(env))  # plans from the simulator's state
    observation, _ = env.reset(seed=seed)
    while episodes > 0:
        episode, over = [], False
        while not over:
            action = expert(TensorDict())["action"].numpy()
            after, reward, terminated, truncated, info = env.step(action)
            # What is only truncated is not done: its value is bootstrapped.
            episode.append((observation, after, action, np.array(reward), np.array(terminated)))
            observation, over = after, terminated or truncated
        if info["is_success"]:
            episodes -= 1
            for transition in episode:
                buffer.add(*transition, infos=[{}])
        observation, _ = env.reset()


def main(arguments: list[str] | None = None) -> SAC:
    """Trains, evaluates, prints what came out and returns the agent."""
    known = [name for name in gymnasium.registry if name.startswith("equirl/")]
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    some, any_number = at_least(1), at_least(0)
    parser.add_argument("--env", default="equirl/BlockPicking-v0", choices=known)
    parser.add_argument("--robot", default="panda", choices=list(ROBOTS))
    parser.add_argument("--image-size", type=some, default=32, help="pixels along a side")
    parser.add_argument("--steps", type=any_number, default=300, help="of training")
    parser.add_argument("--demos", type=any_number, default=5, help="episodes of the expert")
    parser.add_argument("--episodes", type=some, default=5, help="of the evaluation")
    parser.add_argument("--seed", type=any_number, default=0)
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)  # fastest for networks this small

    options = {"image_size": asked.image_size, "robot": asked.robot}
    try:
        env, other_env = (Monitor(gymnasium.make(asked.env, **options)) for _ in range(2))
    except ValueError as error:
        parser.error(str(error))
    seeds = [int(word) for word in np.random.SeedSequence(asked.seed).generate_state(3)]
    agent = SAC(
        "MultiInputPolicy",
        env,
        buffer_size=asked.steps + asked.demos * simulated(env).max_steps,
        batch_size=64,
        learning_starts=0,
        ent_coef="auto_0.01",
        policy_kwargs={"features_extractor_class": DepthAndHolding, "net_arch": [128, 128]},
        seed=seeds[0],
    )
    buffer = agent.replay_buffer
    assert buffer is not None
    add_demonstrations(buffer, other_env, asked.demos, seeds[1])
    print(f"{asked.demos} demonstrations: {buffer.size()} transitions")
    agent.learn(asked.steps)
    print(f"{agent.num_timesteps} steps of training")
    other_env.reset(seed=seeds[2])
    returns, _ = evaluate_policy(agent, other_env, asked.episodes, return_episode_rewards=True)
    assert isinstance(returns, list)
    print(f"{sum(each > 0 for each in returns)} of {asked.episodes} episodes succeed")
    env.close()
    other_env.close()
    return agent


if __name__ == "__main__":
    main()
