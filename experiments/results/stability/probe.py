"""Looks into a run that has fallen: which of its policies fail, and what its critic believes.

python experiments/results/stability/probe.py outputs/my_run 60

Prints, over validation scenes, how often the actor and its running average succeed, acting by their
means and by sampling; then the critic's values along the expert's episodes, and at the states in
which the averaged policy's failed episodes pass their second half.
"""

from __future__ import annotations

import sys
from contextlib import closing
from statistics import mean

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from equirl.training import (
    Learner,
    Purpose,
    load_learner,
    make_run_env,
    make_run_expert,
    scene_seed,
)

_ALIKE = 0.25  # actions whose components deviate by less are called alike


def play(env: EnvBase, policy: TensorDictModuleBase, seed: int) -> tuple[list, bool]:
    """Returns the states with their actions, and whether the episode succeeded."""
    env.set_seed(seed, static_seed=True)
    state, path = env.reset(), []
    while True:
        path.append(policy(state.clone()))
        after = env.step(state.set("action", path[-1]["action"]))
        if after["next", "done"]:
            return path, after["next", "reward"].item() > 0.5
        state = step_mdp(after)


def value(learner: Learner, state: TensorDictBase, action: torch.Tensor) -> float:
    """The smaller of the critic's values of an action (5,) in a state."""
    asked = state.select("depth", "holding").set("action", action)
    return learner.critic(asked)["state_action_value"].min().item()


@torch.no_grad()
def main(folder: str, episodes: int) -> None:
    """Prints what the module's text promises."""
    torch.set_num_threads(1)
    config, _, learner = load_learner(folder, "cpu")
    scenes = [scene_seed(config.seed, Purpose.VALIDATION, k) for k in range(episodes)]
    acting = {"mean": ExplorationType.DETERMINISTIC, "sample": ExplorationType.RANDOM}
    policies = {"average": learner.policy, "actor": learner.actor}
    with closing(make_run_env(config)) as env:
        for name, policy in policies.items():
            for way, exploration in acting.items():
                torch.manual_seed(0)
                with set_exploration_type(exploration):
                    played = [play(env, policy, seed) for seed in scenes]
                lost = [path for path, success in played if not success]
                ends = [
                    torch.stack([s["action"] for s in path[-10:]]).std(0).max() for path in lost
                ]
                alike = sum(end.item() < _ALIKE for end in ends)
                print(f"{name}, {way}: {episodes - len(lost)} of {episodes} succeed;", end=" ")
                print(f"{alike} of {len(lost)} failures end with ten actions alike")
        rows = []
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            expert = make_run_expert(config, env)
            for seed in scenes:
                path, success = play(env, expert, seed)
                for left, state in enumerate(reversed(path)):
                    other = learner.policy(state.clone())["action"]
                    to_come = config.algorithm.discount**left if success else 0.0
                    own = value(learner, state, state["action"])
                    rows.append((left, to_come, own, value(learner, state, other)))
            failed = [path for path, ok in (play(env, learner.policy, s) for s in scenes) if not ok]
        print("steps before the end, return to come, value of expert's action, of policy's action")
        for left in sorted({row[0] for row in rows})[:10]:
            these = [row[1:] for row in rows if row[0] == left]
            print(left + 1, *(f"{mean(column):.2f}" for column in zip(*these, strict=True)))
        values = [value(learner, s, s["action"]) for path in failed for s in path[len(path) // 2 :]]
        if values:
            print(f"second half of {len(failed)} failures: value {mean(values):.2f}, truly 0")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 30)
