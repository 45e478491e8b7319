"""Shows a policy at work: a film, and a contact sheet of what the network sees.

python experiments/watch.py env=block_pushing policy=expert
python experiments/watch.py env=clutter_grasping policy=random env.options.object_count=10
python experiments/watch.py policy=outputs/demo episodes=5
"""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from entry_point import entry_point
from hydra.core.hydra_config import HydraConfig

from equirl.config import Config, ConfigError, WatchJob

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

    from equirl.envs import ManipulationEnv


@entry_point("watch", WatchJob)
def main(job: WatchJob) -> None:
    """Plays episodes, says how they ended and where the pictures are."""
    from equirl.training import load_policy, make_run_env

    if job.policy in ("expert", "random"):
        config, policy = Config(env=job.env), None
    else:
        _check_run(job.policy)
        config, policy = load_policy(job.policy, "auto", "auto")
    with closing(make_run_env(config)) as env:
        _watch(job, config, env, policy or _scripted(job.policy, env, job.seed))


def _check_run(folder: str) -> None:
    """Refuses what is no policy, and keys that the run of a learned policy settles."""
    if not Path(folder).is_dir():
        raise ConfigError(f"policy={folder}: expected expert, random or the folder of a run")
    for text in HydraConfig.get().overrides.task:
        if text.startswith("env"):
            raise ConfigError(f"{text}: leave it out, policy={folder} is watched in its own task")


def _scripted(name: str, env: ManipulationEnv, seed: int) -> TensorDictModuleBase:
    """The task's expert, or a policy that draws every action uniformly."""
    import torch
    from tensordict.nn import TensorDictModule

    from equirl.envs import make_expert

    if name == "expert":
        return make_expert(env)
    generator = torch.Generator().manual_seed(seed)
    return TensorDictModule(
        lambda _: 2 * torch.rand(5, generator=generator) - 1,
        in_keys=["holding"],
        out_keys=["action"],
    )


def _watch(
    job: WatchJob, config: Config, env: ManipulationEnv, policy: TensorDictModuleBase
) -> None:
    """Plays and draws; an episode goes on with the scene of the last where the task has it so."""
    from equirl.training import describe_task
    from equirl.training.sheet import draw_sheet, outcome
    from equirl.training.video import open_film, record

    task = config.env.task
    folder = Path(job.output or f"outputs/watch/{task}/{Path(job.policy).name}".replace(":", "."))
    film, sheet = folder / "film.mp4", folder / "sheet.png"
    shown = []
    env.set_seed(job.seed)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with open_film(film, fps=job.fps) as add:
            for number in range(1, job.episodes + 1):
                scene = ", the scene goes on" if env.scene_continues else ""
                frames = record(env, policy, device=config.torch_device, side=job.size)
                print(f"episode {number}{scene}: {outcome(frames, env)}", flush=True)
                for frame in frames:
                    add(frame)
                if number <= job.sheet_episodes:
                    shown.append(frames)
        title = f"{describe_task(config)}: {job.policy}"
        draw_sheet(shown, env, sheet, title=title)
    except OSError as error:
        sys.exit(f"error: cannot write output={folder}: {error}")
    print(f"film: {film}\nsheet: {sheet}")


if __name__ == "__main__":
    main()
