"""Tables of the networks: building them, acting, an update by its parts, memory.

Each method stands beside a plain one measured in the same rounds: soft actor-critic written out
in PyTorch, on a plain convolutional network of the same skeleton.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from functools import partial
from multiprocessing import get_context
from typing import Any

import torch
from escnn_reference import Critic, TextbookSAC
from measuring import mebibytes, milliseconds, peak_of, print_header, print_row, ratio, run_config
from measuring import take_turns as in_turns
from side_by_side import available
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.modules import TanhNormal

from equirl.collectors import DemonstrationCollector, OnlineCollector
from equirl.config import Config
from equirl.envs import ManipulationEnv, make_env
from equirl.modules import METHODS, make_cnn_actor, make_cnn_critic
from equirl.training import Learner, Purpose, make_networks, make_run_env, scene_seed
from equirl.training.replay import make_run_buffer

#: What a step of training consists of.
_PARTS = ("act", "environment", "store", "sample", "gradients", "Adam", "target", "contrastive")
#: Those of them that are an update; the plain one is measured against their sum.
_UPDATE = ("gradients", "Adam", "target", "contrastive")
_DEMONSTRATIONS = 5


class PlainSAC(TextbookSAC):
    """The textbook's update of a plain convolutional actor and critic, by elementwise tanh.

    Args:
        hidden: Width of the networks, as that of the method they are compared with.
        image: Pixels a side.
    """

    def __init__(self, hidden: int, image: int):
        size: dict[str, Any] = {"hidden": hidden, "image_size": image}
        policy = make_cnn_actor(**size).module[0].module
        critic = Critic(*(part.module for part in make_cnn_critic(**size).module))
        super().__init__(policy, critic, copy.deepcopy(critic))

    def _act(self, depth: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        distribution = TanhNormal(*self.policy(depth, holding))
        action = distribution.rsample()
        return action, distribution.log_prob(action)


def build(arguments: argparse.Namespace) -> None:
    """Seconds to build an actor and a critic: the first of their kind, and again."""
    hidden, size = arguments.hidden[-1], arguments.image
    print(
        f"hidden {hidden}, {size} x {size}; the ratio is of building again, to the plain CNN, "
        "medians of a round's (smallest to largest). escnn caches what it computes on disk.\n"
    )
    columns = ("first s", "again ms", "times the CNN's")
    print_header("method", "group", *columns, "actor parameters", "critic parameters")
    plain = run_config("D4", size, hidden, method="cnn")
    for method, group, config in _methods(arguments, hidden):
        start = time.perf_counter()
        networks = make_networks(config)
        first = time.perf_counter() - start
        calls = {"this": partial(make_networks, config), "plain": partial(make_networks, plain)}
        seconds = in_turns(calls, arguments.repeats)
        counts = (sum(p.numel() for p in net.parameters()) for net in networks)
        again = (milliseconds(seconds["this"]), ratio(seconds["this"], seconds["plain"]))
        print_row(method, group, f"{first:.2f}", *again, *(f"{count:,}" for count in counts))


def update(arguments: argparse.Namespace) -> None:
    """Milliseconds of a step of training and its parts, medians."""
    print(
        f"{arguments.image} x {arguments.image}, batch {arguments.batch}, SAC, 4 copies; "
        "gradients: losses and their gradients. An update is "
        f"{', '.join(_UPDATE)}. Plain: soft actor-critic written out in PyTorch on a plain CNN of "
        "the same hidden, on the same batches; the ratio is of a whole update to that, the "
        "median of a round's (smallest to largest).\n"
    )
    parts = (f"{part} ms" for part in _PARTS)
    print_header("method", "group", "hidden", *parts, "update ms", "plain ms", "ratio")
    for hidden in arguments.hidden:
        for method, group, config in _methods(arguments, hidden):
            with closing(_Step(config)) as step:
                plain = PlainSAC(hidden, arguments.image)
                calls = step.calls() | {"plain": lambda: plain.update(step.batch)}  # noqa: B023
                seconds = in_turns(calls, arguments.repeats, warm_up=2)
            whole = [sum(each) for each in zip(*_some(seconds, _UPDATE), strict=True)]
            cells = (milliseconds(seconds[part]) if part in calls else "-" for part in _PARTS)
            times = (milliseconds(whole), milliseconds(seconds["plain"]))
            print_row(method, group, hidden, *cells, *times, ratio(whole, seconds["plain"]))


def acting(arguments: argparse.Namespace) -> None:
    """Milliseconds to choose one action from one observation, filters expanded each time."""
    print(
        f"{arguments.group}, {arguments.image} x {arguments.image}; ratios to the plain CNN's, "
        "medians of a round's (smallest to largest).\n"
    )
    backends = available(["dense", "native"], arguments.group)
    columns = [column for name in backends for column in (f"{name} ms", f"{name} / CNN")]
    print_header("hidden", "CNN ms", *columns)
    with closing(make_env("block_picking", image_size=arguments.image)) as env:
        observation = env.reset()
    for hidden in arguments.hidden:
        make = partial(run_config, arguments.group, arguments.image, hidden)
        configs = {"CNN": make(method="cnn")} | {name: make(backend=name) for name in backends}
        calls = {
            name: _acting(make_networks(each)[0], observation) for name, each in configs.items()
        }
        seconds = in_turns(calls, arguments.repeats, warm_up=2)
        cells = []
        for name in backends:
            cells += [milliseconds(seconds[name]), ratio(seconds[name], seconds["CNN"])]
        print_row(hidden, milliseconds(seconds["CNN"]), *cells)


def memory(arguments: argparse.Namespace) -> None:
    """Peak resident memory of updates, each method in a process of its own; the replay buffer.

    "Process" is all of it, libraries included, while it updates; "update" what that is above
    the process at rest before its first update.
    """
    print(f"{arguments.image} x {arguments.image}, batch {arguments.batch}\n")
    print_header("method", "group", "hidden", "process MiB", "update MiB", "times the plain one's")
    for hidden in arguments.hidden:
        plain = _apart(arguments, None, hidden)
        print_row("plain", "-", hidden, *(f"{each:.0f}" for each in plain), "1")
        for method, group, config in _methods(arguments, hidden):
            used = _apart(arguments, config, hidden)
            cells = (f"{each:.0f}" for each in used)
            print_row(method, group, hidden, *cells, f"{used[1] / plain[1]:.2f}")
    print()
    config = run_config("D4", arguments.image, 8, batch=arguments.batch)
    with closing(make_run_env(config)) as env:
        buffer = _filled_buffer(config, env)
    rows = buffer.storage[: len(buffer)]
    row = sum(leaf.nbytes for leaf in rows.values(True, True)) / len(buffer)
    peak = mebibytes("self/status", "VmHWM") / 2**10
    side = f"{arguments.image} x {arguments.image}"
    print_header(f"replay, 100,000 transitions of {side}, 4 copies", "peak of this process")
    print_row(f"{row * 100_000 / 5 / 1e9:.2f} GB", f"{peak:.2f} GiB")


class _Step:
    """A step of training, as `TrainingRun` takes it, part by part."""

    def __init__(self, config: Config):
        self.env = make_run_env(config)
        self.learner = learner = Learner(config)
        seeds = partial(scene_seed, config.seed, Purpose.TRAINING)
        self.collector = OnlineCollector(self.env, learner.actor, seeds)
        self.buffer = _filled_buffer(config, self.env)
        self.batch = self.buffer.sample()
        self.action = self.collector.act()
        self.transition, _ = self.collector.step(self.action)

    def calls(self) -> dict[str, Callable[[], object]]:
        """The parts, in order; each works on what the one before left."""
        learner = self.learner
        calls: dict[str, Callable[[], object]] = {
            "act": self._act,
            "environment": self._move,
            "store": lambda: self.buffer.extend(self.transition),
            "sample": self._sample,
            "gradients": self._differentiate,
            "Adam": learner.optimizer.step,
            "target": learner.target_update.step,
        }
        if learner.representation:
            representation = learner.representation
            calls["contrastive"] = lambda: representation.update(self.batch)
        return calls

    def close(self) -> None:
        """Ends the simulation."""
        self.env.close()

    def _act(self) -> None:
        self.action = self.collector.act()

    def _move(self) -> None:
        self.transition, _ = self.collector.step(self.action)

    def _sample(self) -> None:
        self.batch = self.buffer.sample()

    def _differentiate(self) -> None:
        self.learner.optimizer.zero_grad(set_to_none=True)
        self.learner.loss.backward(self.batch)


def _methods(arguments: argparse.Namespace, hidden: int) -> Iterator[tuple[str, str, Config]]:
    """Yields each method with its group, if it has one, and its configuration."""
    for method in arguments.methods or METHODS:
        for group in arguments.groups if METHODS[method].equivariant else ("-",):
            config = run_config(
                "D4" if group == "-" else group,
                arguments.image,
                hidden,
                method=method,
                batch=arguments.batch,
            )
            yield method, group, config


def _some(seconds: dict[str, list[float]], names: tuple[str, ...]) -> list[list[float]]:
    return [seconds[name] for name in names if name in seconds]


def _acting(actor: torch.nn.Module, observation: TensorDictBase) -> Callable[[], None]:
    def act() -> None:
        with torch.no_grad():
            actor(observation.copy())

    return act


def _filled_buffer(config: Config, env: ManipulationEnv) -> ReplayBuffer:
    max_depth = env.observation_spec["depth"].high.max().item()
    buffer = make_run_buffer(config, max_depth, torch.Generator().manual_seed(0))
    for _ in DemonstrationCollector(env, episodes=_DEMONSTRATIONS, seed=0, replay_buffer=buffer):
        pass
    return buffer


def _apart(
    arguments: argparse.Namespace, config: Config | None, hidden: int
) -> tuple[float, float]:
    """MiB at the peak of updates of a process made for them, and above its rest."""
    setting = config, hidden, arguments.image, arguments.batch, arguments.threads
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_peak_of_updates, *setting).result()


def _peak_of_updates(
    config: Config | None, hidden: int, image: int, batch: int, threads: int
) -> tuple[float, float]:
    torch.set_num_threads(threads)
    filled = config or run_config("D4", image, hidden, method="cnn", batch=batch)
    with closing(_Step(filled)) as step:
        made = step.batch
        if config is None:
            plain = PlainSAC(hidden, image)
            return peak_of(lambda: plain.update(made))
        return peak_of(lambda: step.learner.update(made))
