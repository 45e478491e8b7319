"""The training run: demonstrations, then environment steps and updates in turn."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from equirl.collectors import DemonstrationCollector, Episode, OnlineCollector
from equirl.config import Config, ConfigError, flatten
from equirl.data import load_replay_state, protect_demonstrations, replay_state
from equirl.modules import shared_filters
from equirl.training.checkpoint import (
    CheckpointError,
    check_same_config,
    load_checkpoint,
    save_checkpoint,
)
from equirl.training.demonstrations import store_demonstrations
from equirl.training.environment import make_run_env, make_run_expert
from equirl.training.equivariance import replay_observations, symmetry_errors
from equirl.training.evaluation import Evaluation, evaluate
from equirl.training.folder import CHECKPOINT
from equirl.training.learner import Learner
from equirl.training.metrics import Averages, MetricsLog
from equirl.training.progress import Progress
from equirl.training.replay import make_priorities, make_run_buffer
from equirl.training.seeding import Purpose, scene_seed, seed_everything, torch_generator
from equirl.training.timing import Stopwatch

__all__ = ["TrainingRun"]

_log = logging.getLogger("equirl")

#: What the symmetry is measured on: so many of the first transitions, the demonstrations, which
#: stay the same until the buffer is full.
_OBSERVATIONS, _FIRST = 16, 64

#: Pre-training steps between two rows of their table.
_PRETRAINING_ROWS = 100

#: What the run's time is divided into.
PARTS = (
    *("demonstrations", "pretraining", "act", "environment"),
    *("replay", "update", "evaluation", "checkpoint"),
)


class TrainingRun:
    """One run of the paper's training (section 7 of its method, appendix D).

    Construction builds everything from the configuration, `restore` brings it to where the
    folder's checkpoint is, if there is one, `run` trains, `close` ends the simulations. A run
    stopped at any moment and resumed is the run never stopped, bit for bit on one thread.

    Args:
        config: The run's configuration.
        folder: Existing folder for metrics and checkpoints.
        should_stop: Asked after each step, each demonstration and before each test scene; True
            ends the run, with a checkpoint once training has begun.

    Raises:
        ConfigError: A device, processors, a backend or a tracker that this machine does not have.
    """

    def __init__(
        self, config: Config, folder: Path, should_stop: Callable[[], bool] = lambda: False
    ):
        processors = os.cpu_count() or 1
        if config.threads > processors:
            raise ConfigError(f"threads={config.threads}: this machine has {processors} processors")
        torch.set_num_threads(config.threads or processors)
        seed_everything(config.seed)
        self.config, self.folder, self.should_stop = config, folder, should_stop
        self.learner = Learner(config)
        self.env = make_run_env(config)
        self.evaluation_env = make_run_env(config)
        self.max_depth = self.env.observation_spec["depth"].high.max().item()
        self.generator = torch_generator(config.seed, Purpose.REPLAY)
        self.buffer = make_run_buffer(config, self.max_depth, self.generator)
        self.priorities = make_priorities(config)
        self.collector = OnlineCollector(
            self.env,
            self.learner.actor,
            partial(scene_seed, config.seed, Purpose.TRAINING),
            discount=config.evaluation.discount,
            device=config.torch_device,
        )
        self.log = MetricsLog(folder, config)
        self.clock = Stopwatch(PARTS)
        self.step = 0
        self.demonstrated = False  # whether the buffer has all demonstrations
        self.averages = Averages(self.learner.metric_names)
        self.progress = Progress(config.logging.progress)

    def restore(self) -> None:
        """Goes on where the folder's checkpoint is, if there is one.

        Raises:
            CheckpointError: It is damaged, incomplete, of another configuration, or of a step
                beyond the last one.
            TableError: A table is damaged; it is left as it is.
        """
        path = self.folder / CHECKPOINT
        if path.exists():
            state = load_checkpoint(path)
            try:
                self._restore(state, path)
            except KeyError as error:
                raise CheckpointError(f"{path} lacks {error}") from error
            _log.info("goes on after step %d", self.step)
        representation = self.learner.representation
        self.log.rewind(self.step, pretraining=representation.steps if representation else 0)

    def run(self) -> Evaluation | None:
        """Trains to the configured number of steps, then evaluates on the test scenes.

        Returns:
            The evaluation, or None when ``should_stop`` ended the run early.
        """
        if not (self._collect_demonstrations() and self._pretrain() and self._train()):
            return None
        episodes = self.config.evaluation.final_episodes
        with self.clock.measure("evaluation"):
            outcome = self._evaluate(Purpose.TEST, episodes)
        return outcome if len(outcome.episodes) == episodes else None

    def close(self) -> None:
        """Ends the trackers and the simulations."""
        self.log.close()
        for env in (self.env, self.evaluation_env):
            if not env.is_closed:
                env.close()

    def _collect_demonstrations(self) -> bool:
        """Fills the buffer, unless that was done; False when it was told to stop."""
        if self.demonstrated:
            return True
        with self.clock.measure("demonstrations"):
            for _ in self._demonstrations():
                if self.should_stop():
                    return False
                self._check_room()
        if self.config.sampling != "uniform" and len(self.buffer):
            protect_demonstrations(self.buffer)
        if self.config.algorithm.name == "sacfd" and not len(self.buffer):
            _log.info("algorithm=sacfd without demonstrations: its term is zero")
        self.demonstrated = True
        return True

    def _check_room(self) -> None:
        """Refuses demonstrations that fill a buffer in which they are to stay."""
        if self.config.sampling != "uniform" and len(self.buffer) == self.buffer.storage.max_size:
            raise ConfigError(
                f"replay.capacity={self.config.replay.capacity}: no room is left beside the "
                f"demonstrations, {self.config.copies} copies of each transition counted; expected "
                "more, or less of demos.episodes or augmentation.copies"
            )

    def _demonstrations(self) -> Iterable[TensorDictBase]:
        """Stores one demonstration after the other: from a file, or of the expert."""
        demos = self.config.demos
        if demos.file:
            return store_demonstrations(self.config, self.env, self.buffer)
        if not demos.episodes:
            return ()
        return DemonstrationCollector(
            self.env,
            make_run_expert(self.config, self.env),
            episodes=demos.episodes,
            seeds=partial(scene_seed, self.config.seed, Purpose.DEMONSTRATIONS),
            replay_buffer=self.buffer,
        )

    def _pretrain(self) -> bool:
        """Trains FERM's representation on the demonstrations; False when it was told to stop."""
        representation, total = self.learner.representation, self.config.method.pretraining
        if representation is None or self.step or not len(self.buffer):
            return True
        done = representation.steps
        with self.progress.bar(total=total, initial=done, desc="pretraining", unit="step") as bar:
            while representation.steps < total:
                with self.clock.measure("pretraining"):
                    metrics = self.learner.pretrain(self.buffer.sample())
                done, stop = representation.steps, self.should_stop()
                if done % _PRETRAINING_ROWS == 0 or done == total:
                    self.log.write("pretraining", {"step": done, **metrics})
                if stop or done % self.config.checkpoint_every == 0:
                    self._save()
                if stop:
                    return False
                bar.update(1)
        return True

    def _train(self) -> bool:
        """The loop of the paper; True when it reached the last step."""
        config = self.config
        with self.progress.bar(total=config.steps, initial=self.step, unit="step") as bar:
            while self.step < config.steps:
                with shared_filters():  # the actor's, from acting to the update
                    episode = self._step()
                self.step += 1
                if episode:
                    self._log_episode(episode)
                if config.evaluation.every and self.step % config.evaluation.every == 0:
                    self._validate()
                self.progress.advance(bar, self.clock.mean("update"))
                stop = self.should_stop()
                if stop or self.step % config.checkpoint_every == 0 or self.step == config.steps:
                    self._save()
                if stop and self.step < config.steps:
                    return False
        return True

    def _step(self) -> Episode | None:
        """One environment step and its updates; the episode's summary if it ended."""
        with self.clock.measure("act"):
            action = self.collector.act()
        with self.clock.measure("environment"):
            transition, episode = self.collector.step(action)
        with self.clock.measure("replay"):
            self.buffer.extend(transition)
        if len(self.buffer) * (self.config.copies + 1) >= self.config.replay.start:
            for number in range(self.config.algorithm.updates):
                # Only the first can use what the actor expanded: the graph of it is gone then.
                with shared_filters(apart=number > 0):
                    self._update()
        return episode

    def _update(self) -> None:
        """One update on a batch of the buffer."""
        with self.clock.measure("replay"):
            if self.priorities:
                self.priorities.anneal(self.buffer, self.step)
            batch = self.buffer.sample()
        with self.clock.measure("update"):
            self.averages.add(self.learner.update(batch))
        if self.priorities:
            with self.clock.measure("replay"):
                self.priorities.update(self.buffer, batch)

    def _log_episode(self, episode: Episode) -> None:
        self.progress.note(episode)
        row: dict[str, float | int] = {
            "step": self.step,
            "episode": self.collector.episode - 1,
            "length": episode.length,
            "success": int(episode.success),
            "return": episode.undiscounted_return,
            "discounted_return": episode.discounted_return,
        }
        self.log.write("metrics", row | self.averages.read())

    def _validate(self) -> None:
        with self.clock.measure("evaluation"):
            outcome = self._evaluate(Purpose.VALIDATION, self.config.evaluation.episodes)
            if self.config.evaluation.equivariance:
                self._log_symmetry()
        self.progress.greedy = f"{outcome.success_rate:.0%}"
        low, high = outcome.interval
        row = {
            "step": self.step,
            "episodes": len(outcome.episodes),
            "success_rate": outcome.success_rate,
            "low": low,
            "high": high,
            "discounted_return": outcome.discounted_return,
        }
        self.log.write("validation", row)
        self.log.write("timing", {"step": self.step, **self.clock.summary()})

    def _evaluate(self, purpose: Purpose, episodes: int) -> Evaluation:
        numbers: Iterable[int] = range(episodes)
        if purpose is Purpose.TEST:  # a validation is a part of its step and always whole
            numbers = takewhile(lambda _: not self.should_stop(), numbers)
        seeds = (scene_seed(self.config.seed, purpose, number) for number in numbers)
        name = f"{purpose.name.lower()} scenes"
        bar = self.progress.bar(total=episodes, desc=name, unit="episode", leave=False)
        with bar as shown:
            return evaluate(
                self.evaluation_env,
                self.learner.policy,
                seeds,
                discount=self.config.evaluation.discount,
                device=self.config.torch_device,
                on_episode=lambda _: shown.update(1),
            )

    def _log_symmetry(self) -> None:
        # Rows as they are stored: a sample would draw random numbers, and turn them.
        first = self.buffer.storage[: min(len(self.buffer), _FIRST)]
        observations = replay_observations(first, self.max_depth, _OBSERVATIONS)
        networks = (self.learner.policy, self.learner.critic)
        errors = symmetry_errors(networks, self.config.group, observations)
        self.log.write("symmetry", {"step": self.step, **errors})

    def _save(self) -> None:
        with self.clock.measure("checkpoint"):
            self._write_checkpoint()

    def _write_checkpoint(self) -> None:
        save_checkpoint(
            {
                "config": flatten(self.config),
                "step": self.step,
                "demonstrated": self.demonstrated,
                "learner": self.learner.state_dict(),
                "buffer": replay_state(self.buffer),
                "collector": self.collector.state_dict(),
                "averages": self.averages.state_dict(),
                "clock": self.clock.state_dict(),
                "replay_rng": self.generator.get_state(),
                "policy_rng": torch.get_rng_state(),
                "cuda_rng": self._cuda_rng(),
            },
            self.folder / CHECKPOINT,
        )

    def _restore(self, state: dict[str, Any], path: Path) -> None:
        check_same_config(flatten(self.config), state["config"], path)
        if state["step"] > self.config.steps:
            raise CheckpointError(
                f"{path} is at step {state['step']}, beyond steps={self.config.steps}"
            )
        self.step, self.demonstrated = state["step"], state["demonstrated"]
        self.learner.load_state_dict(state["learner"])
        load_replay_state(self.buffer, state["buffer"])
        self.collector.load_state_dict(state["collector"])
        self.averages.load_state_dict(state["averages"])
        self.clock.load_state_dict(state["clock"])
        # Last, since rebuilding the rest may draw random numbers.
        self.generator.set_state(state["replay_rng"])
        torch.set_rng_state(state["policy_rng"])
        if state["cuda_rng"] is not None and self._cuda_rng() is not None:
            torch.cuda.set_rng_state(state["cuda_rng"], self.config.torch_device)

    def _cuda_rng(self) -> torch.Tensor | None:
        device = self.config.torch_device
        return torch.cuda.get_rng_state(device) if device.startswith("cuda") else None
