"""How long a run will take on this machine, before it is trained.

The parts of a step are timed one by one, a few times each, and multiplied by the steps that are
left. What cannot be known beforehand is how long episodes last: an untrained policy plays most
to the time limit, a trained one a few steps. Folders of like runs know better.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torchrl.envs import EnvBase

from equirl.analysis import TableError, read_table
from equirl.collectors import DemonstrationCollector, OnlineCollector
from equirl.config import Config, ConfigError, flatten
from equirl.modules import METHODS, shared_filters
from equirl.training.environment import make_run_env, make_run_expert
from equirl.training.folder import load_run_config
from equirl.training.learner import Learner
from equirl.training.replay import make_priorities, make_run_buffer
from equirl.training.seeding import Purpose, scene_seed, torch_generator

__all__ = ["Costs", "Estimator", "remaining_seconds"]

#: Of each quick part; the first, in which caches fill, is left out.
_REPEATS = 6

#: An update that is expected to last longer than this many seconds is timed on parts of a batch.
_PATIENCE = 2.0

#: How much of the time limit an episode of validation lasts, over a run that learns.
_SHARE = 0.4

#: Transitions of the buffer that is sampled from; the time hardly depends on it.
_CAPACITY = 1000


@dataclass(frozen=True)
class Costs:
    """Seconds that the parts of a run take.

    Attributes:
        demonstration: An episode of the expert, with its reset.
        pretraining: A step of a contrastive encoder's, before training.
        step: A step of training, with its updates; read from a run, with its share of checkpoints
            too, which are not measured.
        evaluation: An episode of the greedy policy; read from a run that measured its symmetry,
            with its share of that too.
        measured: Whether any was measured for the purpose, instead of read from a run.
    """

    demonstration: float
    pretraining: float
    step: float
    evaluation: float
    measured: bool = True


def remaining_seconds(config: Config, costs: Costs, step: int = 0, *, begun: bool = False) -> float:
    """What is left of a run.

    Args:
        config: Of the run.
        costs: What its parts take.
        step: Training steps done.
        begun: Whether demonstrations and pre-training are done.
    """
    every, checks = config.evaluation.every, config.evaluation
    validations = config.steps // every - step // every if every else 0
    seconds = (config.steps - step) * costs.step
    seconds += (validations * checks.episodes + checks.final_episodes) * costs.evaluation
    if not begun:
        if _collects(config):
            seconds += config.demos.episodes * costs.demonstration
        if _pretrains(config):
            seconds += config.method.pretraining * costs.pretraining
    return seconds


class Estimator:
    """Costs of runs: from folders of like ones, or measured, once for all that are alike."""

    def __init__(self) -> None:
        self._recorded: dict[str, dict[str, float]] = {}
        self._learning: dict[str, tuple[float, float, float]] = {}
        self._playing: dict[tuple[str, bool], tuple[float, float, float]] = {}

    def read(self, folder: Path) -> None:
        """Takes from a run's folder what its parts took, if there is one and it says so."""
        try:
            config = load_run_config(folder)
            parts = _recorded_parts(config, folder)
        except (ConfigError, TableError):
            return
        self._recorded.setdefault(_like(config, _ALL), {}).update(parts)

    def costs(self, config: Config) -> Costs:
        """The parts of a run; what has not been read or measured yet is measured.

        Measuring sets torch's threads to those of the run, and draws from its global generator.

        Raises:
            ConfigError: A device or a backend that this machine does not have.
        """
        recorded = self._recorded.get(_like(config, _ALL), {})
        if _needed(config) <= recorded.keys():
            unneeded = {"demonstration": 0.0, "pretraining": 0.0}
            return Costs(**(unneeded | recorded), measured=False)
        torch.set_num_threads(_threads(config))
        played = _like(config, _PLAYING), _collects(config)
        if played not in self._playing:
            self._playing[played] = _measure_playing(config)
        learnt = _like(config, _LEARNING)
        if learnt not in self._learning:
            self._learning[learnt] = _measure_learning(config)
        environment, reset, demonstration = self._playing[played]
        act, learning, pretraining = self._learning[learnt]
        length = max(1.0, _SHARE * config.env.max_steps)
        measured = {
            "demonstration": demonstration,
            "pretraining": pretraining,
            "step": environment + learning,
            "evaluation": reset + length * (act + environment),
        }
        return Costs(**(measured | recorded), measured=True)


#: Beginnings of the keys that the time of a network's part depends on, and that of the simulator's.
_LEARNING = (
    *("env.image_size", "method.", "algorithm.", "augmentation.", "replay.", "mode", "group"),
    *("device", "threads", "backend"),
)
_PLAYING = ("env.", "demos.options", "mode", "method.name")

#: And of what is read of a run, whose evaluations may measure the symmetry, too.
_ALL = (*_LEARNING, *_PLAYING, "evaluation.equivariance")

#: Of these, what changes numbers but no time.
_TIMELESS = (
    *("learning_rate", "discount", "tau", "alpha", "target_entropy", "momentum", "pretraining"),
    *("weight", "demonstration_weight", "exponent", "expert_bonus", "beta", "beta_steps", "start"),
    *("capacity", "importance_weights", "quarter_turns"),
)


#: What is read of a run's ``timing.csv``.
_COLUMNS = (
    *("demonstrations_ms", "pretraining_ms", "act_ms", "environment_ms", "replay_ms"),
    *("update_ms", "evaluation_ms", "checkpoint_ms"),
)


def _like(config: Config, beginnings: tuple[str, ...]) -> str:
    """The same for runs whose parts take the same time."""
    flat = flatten(config) | {"threads": _threads(config)}
    relevant = {
        key: value
        for key, value in flat.items()
        if key.startswith(beginnings) and key.rpartition(".")[2] not in _TIMELESS
    }
    return str(sorted(relevant.items(), key=lambda pair: pair[0]))


def _collects(config: Config) -> bool:
    """Whether a run begins with its expert's episodes; those from a file take none."""
    return config.demos.episodes > 0 and not config.demos.file


def _pretrains(config: Config) -> bool:
    """Whether a run trains a contrastive encoder on its demonstrations first."""
    contrastive = METHODS[config.method.name].contrastive
    return contrastive and config.demos.episodes > 0 and config.method.pretraining > 0


def _needed(config: Config) -> set[str]:
    """The parts of `Costs` that a run has."""
    optional = {"demonstration": _collects(config), "pretraining": _pretrains(config)}
    return {"step", "evaluation"} | {part for part, there in optional.items() if there}


def _recorded_parts(config: Config, folder: Path) -> dict[str, float]:
    """The parts of `Costs` that a run had, from its ``timing.csv``; none before its first row."""
    table = read_table(folder / "timing.csv", _COLUMNS)
    if not table or not table["update_ms"][-1]:
        return {}
    last = {name: table[name][-1] / 1e3 for name in _COLUMNS}
    updates, demonstrations = config.algorithm.updates, config.demos.episodes
    # Its clock is read once for the transition stored, then for each batch and its priorities.
    replays = 1 + updates * (2 if config.sampling == "prioritized" else 1)
    step = last["act_ms"] + last["environment_ms"] + replays * last["replay_ms"]
    step += updates * last["update_ms"] + last["checkpoint_ms"] / config.checkpoint_every
    parts = {
        "demonstration": last["demonstrations_ms"] / max(demonstrations, 1),
        "pretraining": last["pretraining_ms"],
        "step": step,
        "evaluation": last["evaluation_ms"] / config.evaluation.episodes,
    }
    # What it had not took no time, which would tell nothing of a run that has it.
    return {part: parts[part] for part in _needed(config)}


def _measure_playing(config: Config) -> tuple[float, float, float]:
    """Seconds of a step of the simulator, of a reset, and of a demonstration."""
    demonstration = 0.0
    with closing(make_run_env(config)) as env:
        env.set_seed(scene_seed(config.seed, Purpose.TRAINING))
        reset = _median(env.reset, 4)
        step = _time_steps(env)
        if _collects(config):
            collector = DemonstrationCollector(
                env,
                make_run_expert(config, env),
                episodes=_REPEATS,
                seeds=lambda index: scene_seed(config.seed, Purpose.DEMONSTRATIONS, index),
            )
            demonstration = _timed(lambda: list(collector)) / _REPEATS
    return step, reset, demonstration


def _time_steps(env: EnvBase) -> float:
    """Seconds of a step with random actions."""
    generator = torch.Generator().manual_seed(0)
    current, seconds = env.reset(), []
    for _ in range(4 * _REPEATS):
        action = 2 * torch.rand(5, generator=generator) - 1
        start = time.perf_counter()
        stepped = env.step(current.set("action", action))
        seconds.append(time.perf_counter() - start)
        after = stepped["next"]
        current = env.reset() if after["done"].item() else after
    return statistics.median(seconds[1:])


def _measure_learning(config: Config) -> tuple[float, float, float]:
    """Seconds of acting, of what a step does beside the simulator, and of pre-training."""
    capacity = _CAPACITY * (config.copies + 1)
    config = replace(config, replay=replace(config.replay, capacity=capacity))
    learner, priorities = Learner(config), make_priorities(config)
    with closing(make_run_env(config)) as env:
        depth = env.observation_spec["depth"].high.max().item()
        buffer = make_run_buffer(config, depth, torch_generator(config.seed, Purpose.REPLAY))
        collector = OnlineCollector(
            env,
            learner.actor,
            lambda index: scene_seed(config.seed, Purpose.TRAINING, index),
            device=config.torch_device,
        )
        transition, _ = collector.step(collector.act())
        for number in range(_REPEATS):  # some of an expert: batches may ask for them
            expert = torch.full_like(transition["expert"], number % 2 == 0)
            buffer.extend(transition.clone().set("expert", expert))

        def step(rows: int) -> None:
            with shared_filters():
                collector.act()
                buffer.extend(transition.clone())
                for _ in range(config.algorithm.updates):
                    if priorities:
                        priorities.anneal(buffer, 0)
                    batch = buffer.sample()[:rows]
                    learner.update(batch)
                    if priorities:
                        priorities.update(buffer, batch)

        with shared_filters():
            act = _median(collector.act, _REPEATS)
        rows, pretraining = config.algorithm.batch_size, 0.0
        learning = _by_parts(lambda n: _timed(lambda: step(n)), rows)
    if learner.representation is not None:
        pretraining = _by_parts(
            lambda n: _timed(lambda: learner.pretrain(buffer.sample()[:n])), rows
        )
    return act, learning, pretraining


def _threads(config: Config) -> int:
    """CPU threads of a run, as `TrainingRun` sets them."""
    return config.threads or os.cpu_count() or 1


def _by_parts(seconds: Callable[[int], float], size: int) -> float:
    """Seconds of a batch; of a slow one from those of smaller ones, on which they depend linearly.

    Args:
        seconds: Of a batch of so many rows.
        size: Rows of the batch in question.
    """
    small, larger = min(size, 8), min(size, 24)
    seconds(small)  # fills caches
    first = seconds(small)
    if first * size / small <= _PATIENCE:
        seconds(size)
        return statistics.median(seconds(size) for _ in range(3))
    second = seconds(larger)
    slope = max(0.0, second - first) / max(1, larger - small)
    return second + slope * (size - larger)


def _timed(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _median(call: Callable[[], object], repeats: int) -> float:
    """Median seconds of a call, the first left out."""
    return statistics.median([_timed(call) for _ in range(repeats + 1)][1:])
