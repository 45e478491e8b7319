"""Demonstrations of a run as a file: recorded, stored into the replay buffer, shown."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer

from equirl.collectors import DemonstrationCollector
from equirl.config import Config
from equirl.data.episodes import project_onto_disc
from equirl.data.robomimic import read_demonstrations, write_demonstrations
from equirl.envs import ManipulationEnv
from equirl.envs.workspace import WORKSPACE
from equirl.training.environment import make_run_env, make_run_expert
from equirl.training.seeding import Purpose, scene_seed
from equirl.training.video import Frame

__all__ = [
    "describe_environment",
    "record_demonstrations",
    "recorded_frames",
    "store_demonstrations",
]

_log = logging.getLogger("equirl")

#: What a run's environment has to share with that of its demonstrations: what pictures, actions
#: and rewards mean.
_SHARED = ("task", "image_size", "view", "robot", "options")


def describe_environment(config: Config, env: ManipulationEnv) -> dict[str, Any]:
    """What a file of demonstrations keeps of the environment of a run.

    Args:
        config: Of the run.
        env: What `make_run_env` made of it.
    """
    return {
        "task": config.env.task,
        "image_size": env.observation_spec["depth"].shape[-1],
        "view": env.task.view,
        "robot": env.robot,
        "max_steps": env.max_steps,
        "time_limit": env.time_limit,
        "options": {each.name: getattr(env.task, each.name) for each in fields(env.task)},
    }


def record_demonstrations(
    config: Config,
    path: str | Path,
    *,
    overwrite: bool = False,
    on_episode: Callable[[TensorDictBase], None] | None = None,
) -> list[TensorDictBase]:
    """Writes the demonstrations that a run of this configuration would collect.

    Args:
        config: Of the run; it settles environment, expert, scenes and number of episodes.
        path: The file.
        overwrite: Whether to replace a file that is there.
        on_episode: Called after each episode, for progress.

    Returns:
        The episodes.

    Raises:
        DatasetError: The file exists, or cannot be written.
        DemonstrationError: The expert does not solve the task as configured.
        PlacementError: The task's numbers allow no scene.
    """
    seeds = partial(scene_seed, config.seed, Purpose.DEMONSTRATIONS)
    episodes, scenes = [], []
    with closing(make_run_env(config)) as env:
        expert = make_run_expert(config, env)
        collector = DemonstrationCollector(env, expert, episodes=config.demos.episodes, seeds=seeds)
        for episode in collector:
            episodes.append(episode)
            scene = collector.state_dict()["scene"]
            # A scene may serve several episodes, failed ones among them.
            scenes.append({"seed": seeds(scene["first"]), "episode": len(scene["actions"]) - 1})
            if on_episode:
                on_episode(episode)
        environment = describe_environment(config, env)
    environment |= {"mode": config.mode, "expert": expert.options}
    write_demonstrations(
        path, episodes, environment=environment, attributes=scenes, overwrite=overwrite
    )
    return episodes


def store_demonstrations(
    config: Config, env: ManipulationEnv, buffer: ReplayBuffer
) -> Iterator[TensorDictBase]:
    """Writes the first demonstrations of a run's file into its buffer, yielding each.

    In ``strict`` mode actions that no equivariant policy can imitate are projected onto the disc
    first, whatever the method, so that all have the same demonstrations; how many is said once.

    Args:
        config: Of the run, with ``demos.file`` and ``demos.episodes``.
        env: The run's environment, that of the demonstrations.
        buffer: The run's replay buffer.

    Raises:
        DatasetError: There is no such file, or it is none of demonstrations in this environment.
    """
    described = describe_environment(config, env)
    episodes: list[TensorDictBase] = list(
        read_demonstrations(
            config.demos.file,
            episodes=config.demos.episodes,
            environment={key: described[key] for key in _SHARED},
        )
    )
    if config.mode == "strict":
        episodes, outside = project_onto_disc(episodes)
        if outside:
            _log.info(
                "%d of %d demonstrated actions had (x, y) outside the unit disc, where the "
                "equivariant policies of mode=strict act, and were projected onto it",
                outside,
                sum(map(len, episodes)),
            )
    for episode in episodes:
        buffer.extend(episode)
        yield episode


def recorded_frames(episode: TensorDictBase) -> list[Frame]:
    """What was seen and done in a recorded episode, for films and contact sheets.

    Args:
        episode: Shape [T], with the keys of `TRANSITION_KEYS`.

    Returns:
        A frame for the start and one for each step, without pictures of the scene.
    """
    after = episode["next"]
    actions = [*episode["action"].numpy(), None]
    rewards = [0.0, *after["reward"][:, 0].tolist()]
    frames = []
    for step, (action, reward) in enumerate(zip(actions, rewards, strict=True)):
        seen = episode[step] if step < len(episode) else after[-1]
        frames.append(
            Frame(
                picture=None,
                depth=seen["depth"][0].numpy(),
                deepest=WORKSPACE.z_max,
                holding=bool(seen["holding"].item()),
                reward=reward,
                action=action,
            )
        )
    return frames
