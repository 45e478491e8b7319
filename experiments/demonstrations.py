"""Records an expert's demonstrations as a dataset, in robomimic's HDF5 layout.

python experiments/demonstrations.py env=block_picking episodes=20 output=demos.hdf5 seed=0
python experiments/demonstrations.py env=clutter_grasping expert.grasp=aligned output=clutter.hdf5
"""

from __future__ import annotations

from entry_point import entry_point

from equirl.config import Config, DemonstrationsJob
from equirl.config.schema import DemosConfig


@entry_point("demonstrations", DemonstrationsJob)
def main(job: DemonstrationsJob) -> None:
    """Records the demonstrations that a run of this seed would collect by itself."""
    from tqdm import tqdm

    from equirl.training.demonstrations import record_demonstrations

    config = Config(
        env=job.env,
        demos=DemosConfig(episodes=job.episodes, options=job.expert),
        mode=job.mode,
        seed=job.seed,
    )
    with tqdm(total=job.episodes, unit="episode", leave=False) as bar:
        episodes = record_demonstrations(
            config, job.output, overwrite=job.overwrite, on_episode=lambda _: bar.update(1)
        )
    steps = sum(len(episode) for episode in episodes)
    print(f"{len(episodes)} demonstrations, {steps} steps: {job.output}")


if __name__ == "__main__":
    main()
