"""Shows a policy at work: a film, and a contact sheet of what the network sees.

python experiments/watch.py env=block_pushing policy=expert
python experiments/watch.py env=clutter_grasping policy=random env.options.object_count=10
python experiments/watch.py policy=outputs/demo episodes=5
python experiments/watch.py policy=policy.pt
python experiments/watch.py policy=demos.hdf5
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
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
    """Plays episodes, or reads them, says how they ended and where the pictures are."""
    from equirl.training import load_policy, make_run_env

    if job.policy in ("expert", "random"):
        config, policy = Config(env=job.env), None
    else:
        _check_path(job.policy)
        if _holds_demonstrations(Path(job.policy)):
            _watch_file(job)
            return
        config, policy = load_policy(job.policy, "auto", "auto")
    with closing(make_run_env(config)) as env:
        _watch(job, config, env, policy or _scripted(job.policy, env, job.seed))


def _holds_demonstrations(path: Path) -> bool:
    import h5py

    return path.is_file() and (path.suffix in (".hdf5", ".h5") or h5py.is_hdf5(path))


def _check_path(path: str) -> None:
    """Refuses what is no policy, and keys that a run or a file settles."""
    if not Path(path).exists():
        raise ConfigError(
            f"policy={path}: expected expert, random, the folder of a run, the file of a policy "
            "or one of demonstrations"
        )
    for text in HydraConfig.get().overrides.task:
        if text.startswith("env"):
            raise ConfigError(f"{text}: leave it out, policy={path} is watched in its own task")


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

    shown = []
    env.set_seed(job.seed)
    path = Path(job.policy)
    with _pictures(job, config.env.task, path.stem if path.is_file() else path.name) as (
        film,
        sheet,
    ):
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


def _watch_file(job: WatchJob) -> None:
    """Says how each episode of a file ended, and draws the first ones; nothing is simulated."""
    from equirl.data.episodes import DatasetError
    from equirl.data.robomimic import read_demonstrations, read_environment
    from equirl.training.demonstrations import recorded_frames
    from equirl.training.sheet import Setting, draw_sheet, outcome
    from equirl.training.video import open_film

    path = Path(job.policy)
    try:
        about = read_environment(path)
        episodes = [recorded_frames(each) for each in read_demonstrations(path, failed=True)]
    except DatasetError as error:
        raise ConfigError(f"policy={error}") from None
    task = about.get("task", "demonstrations")
    # Others do not say how wide their pictures are: as in most of our tasks.
    setting = Setting(about.get("view", 0.30), about.get("max_steps", 0))
    for number, frames in enumerate(episodes, start=1):
        print(f"episode {number}: {outcome(frames, setting)}")
    with _pictures(job, task, path.stem) as (film, sheet):
        with open_film(film, fps=job.fps, side=job.size) as add:
            for frames in episodes[: job.episodes]:
                for frame in frames:
                    add(frame)
        title = f"{task}: {path.name}".replace("_", " ").capitalize()
        draw_sheet(episodes[: job.sheet_episodes], setting, sheet, title=title)


@contextmanager
def _pictures(job: WatchJob, task: str, policy: str) -> Iterator[tuple[Path, Path]]:
    """Makes the folder of film and sheet, and says where they are."""
    folder = Path(job.output or f"outputs/watch/{task}/{policy}".replace(":", "."))
    film, sheet = folder / "film.mp4", folder / "sheet.png"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield film, sheet
    except OSError as error:
        sys.exit(f"error: cannot write output={folder}: {error}")
    print(f"film: {film}\nsheet: {sheet}")


if __name__ == "__main__":
    main()
