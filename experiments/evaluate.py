"""Evaluates the policy of a run on held-out scenes.

python experiments/evaluate.py run=outputs/demo episodes=200
python experiments/evaluate.py run=outputs/demo video=policy.mp4 first=100
python experiments/evaluate.py run=policy.pt
"""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path

from entry_point import entry_point

from equirl.config import ConfigError, EvaluateJob


@entry_point("evaluate", EvaluateJob)
def main(job: EvaluateJob) -> None:
    """Prints the success rate and, on request, films the first episodes."""
    from tqdm import tqdm

    from equirl.training import (
        Purpose,
        evaluate,
        film_policy,
        load_policy,
        make_run_env,
        scene_seed,
    )

    if job.video and Path(job.video).suffix != ".mp4":
        raise ConfigError(f"video={job.video}: expected the name of an .mp4 file")
    config, policy = load_policy(job.run, job.device, job.backend)
    numbers = range(job.first, job.first + job.episodes)
    seeds = [scene_seed(config.seed, Purpose.TEST, number) for number in numbers]
    device = config.torch_device
    with closing(make_run_env(config)) as env:
        with tqdm(total=len(seeds), unit="episode", leave=False) as bar:
            print(evaluate(env, policy, seeds, device=device, on_episode=lambda _: bar.update(1)))
        if job.video:
            try:
                film_policy(
                    env, policy, seeds[: job.video_episodes], Path(job.video), device=device
                )
            except OSError as error:
                sys.exit(f"error: cannot write video={job.video}: {error}")
            print(f"video: {job.video}")


if __name__ == "__main__":
    main()
