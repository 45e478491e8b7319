"""Runs and sweeps that take no time."""

import sweeping

from equirl.config import TrainJob, to_config
from tests.commands import SMOKE

#: A run of a second or two.
TINY = [*SMOKE, "steps=12", "demos.episodes=1", "evaluation.every=12", "evaluation.episodes=1"]
TINY += ["evaluation.final_episodes=1", "evaluation.video_episodes=0", "replay.start=5"]


def make_run(overrides: list[str], **changes) -> sweeping.Run:
    names = {"method": {"name": "equivariant"}, "algorithm": {"name": "sac"}}
    names |= {"env": {"task": "block_picking"}, "augmentation": {"name": "buffer"}}
    return sweeping.Run(overrides, sweeping.as_config(to_config(names | changes, TrainJob)))
