"""Measures what the experts earn: the ceiling of the figures of experiments/figures.py.

python experiments/ceilings.py --episodes 200

Failed episodes count, too. The table it prints stands in equirl/analysis/ceilings.py.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from functools import partial

from command_line import at_least

from equirl.analysis.ceilings import DISCOUNT
from equirl.analysis.labels import TASKS
from equirl.analysis.tables import markdown_row


def main(arguments: list[str] | None = None) -> None:
    """Prints the mean discounted return of each task's expert, in both modes."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--episodes", type=at_least(2), default=200, help="of each task and mode")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS, metavar="TASK")
    given = parser.parse_args(arguments)
    print(markdown_row(["task", "mode", "return", "standard error", "success", "steps"]))
    print(markdown_row(["---"] * 6))
    for task in given.tasks:
        for mode in ("strict", "paper"):
            print(markdown_row([task, mode, *measure(task, mode, given.episodes)]), flush=True)


def measure(task: str, mode: str, episodes: int) -> list[str]:
    """Plays an expert as a run would act in training; scenes go on where the task has it so.

    Returns:
        Mean discounted return with its standard error, success and mean length, for a table.
    """
    import numpy as np

    from equirl.collectors import Episode, OnlineCollector
    from equirl.config import Config
    from equirl.config.schema import EnvConfig
    from equirl.training import Purpose, make_run_env, scene_seed
    from equirl.training.environment import make_run_expert

    config = Config(env=EnvConfig(task=task, image_size=16), mode=mode)
    seeds = partial(scene_seed, config.seed, Purpose.DEMONSTRATIONS)
    played: list[Episode] = []
    with closing(make_run_env(config)) as env:
        expert = make_run_expert(config, env)
        collector = OnlineCollector(env, expert, seeds, discount=DISCOUNT)
        while len(played) < episodes:
            _, episode = collector.step(collector.act())
            if episode:
                played.append(episode)
    returns = np.array([episode.discounted_return for episode in played])
    return [
        f"{returns.mean():.3f}",
        f"{returns.std(ddof=1) / np.sqrt(episodes):.3f}",
        f"{np.mean([episode.success for episode in played]):.1%}",
        f"{np.mean([episode.length for episode in played]):.1f}",
    ]


if __name__ == "__main__":
    main()
