"""Evaluates the policy of a run on held-out scenes.

python experiments/evaluate.py run=outputs/demo episodes=200
python experiments/evaluate.py run=outputs/demo video=policy.mp4 first=100
"""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig

from equirl.config import ConfigError, EvaluateJob, register, to_config

os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # as in train.py
register()
_log = logging.StreamHandler()  # for the package's own messages, to the standard error


@hydra.main(version_base="1.3", config_path="../conf", config_name="evaluate")
def main(values: DictConfig) -> None:
    """Prints the success rate and, on request, films the first episodes."""
    from tqdm import tqdm

    from equirl.training import (
        CheckpointError,
        Purpose,
        evaluate,
        film_policy,
        load_policy,
        make_run_env,
        scene_seed,
    )

    logging.getLogger("equirl").addHandler(_log)
    logging.getLogger("equirl").setLevel(logging.INFO)
    try:
        job = to_config(values, EvaluateJob)
        config, policy = load_policy(Path(job.run), job.device, job.backend)
    except (ConfigError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    device = config.torch_device
    seeds = [
        scene_seed(config.seed, Purpose.TEST, job.first + index) for index in range(job.episodes)
    ]
    env = make_run_env(config)
    with tqdm(total=len(seeds), unit="episode", leave=False) as bar:
        print(evaluate(env, policy, seeds, device=device, on_episode=lambda _: bar.update(1)))
    if job.video:
        try:
            film_policy(env, policy, seeds[: job.video_episodes], Path(job.video), device=device)
        except OSError as error:
            sys.exit(f"error: cannot write video={job.video}: {error}")
        print(f"video: {job.video}")
    env.close()


if __name__ == "__main__":
    main()
