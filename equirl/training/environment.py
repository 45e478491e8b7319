"""The environment of a run and its expert, from a configuration."""

from __future__ import annotations

import re

from equirl.config import Config
from equirl.envs import ManipulationEnv, make_env, make_expert
from equirl.envs.expert import Expert
from equirl.envs.tasks import find_task

__all__ = ["describe_task", "make_run_env", "make_run_expert"]


def describe_task(config: Config) -> str:
    """The name of a run's task, for titles."""
    name = find_task(config.env.task).__name__
    return re.sub("(?<=[a-z])(?=[A-Z])", " ", name).capitalize()


def make_run_env(config: Config) -> ManipulationEnv:
    """The environment of a run.

    ``paper`` mode stores time-outs as terminal and judges as the paper's implementation does.
    """
    paper = config.mode == "paper"
    options = find_task(config.env.task).paper_options if paper else {}
    return make_env(
        config.env.task,
        image_size=config.observed_size,
        robot=config.env.robot,
        max_steps=config.env.max_steps,
        time_limit="terminate" if paper else "truncate",
        **{**options, **config.env.options},
    )


def make_run_expert(config: Config, env: ManipulationEnv) -> Expert:
    """The expert of a run; ``paper`` mode clips its displacements as the paper does."""
    clip = {"horizontal_clip": "box"} if config.mode == "paper" else {}
    return make_expert(env, **clip | config.demos.options)
