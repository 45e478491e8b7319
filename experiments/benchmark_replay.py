"""The table of the replay buffer: ours beside TorchRL's own, without transforms."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import torch
from measuring import milliseconds, print_header, print_row, ratio, take_turns
from tensordict import TensorDict, TensorDictBase
from torchrl.data import (
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)

from equirl.collectors import DemonstrationCollector
from equirl.data import Priorities, make_replay_buffer, protect_demonstrations
from equirl.envs import make_env

_CAPACITY = 10_000  # transitions, copies counted
_CALLS = 10  # of one measurement, which are short

#: How transitions are drawn, and the buffer of TorchRL's that draws like that: it has no half
#: and half.
_KINDS: dict[str, tuple[int, dict[str, Any]]] = {
    "uniform, no copies": (0, {}),
    "uniform": (4, {}),
    "prioritized": (4, {"priorities": Priorities()}),
    "symmetric": (4, {"symmetric": True}),
}


def replay(arguments: argparse.Namespace) -> None:
    """Milliseconds to store a transition and to draw a batch, and bytes of a transition."""
    print(
        f"{arguments.image} x {arguments.image}, batch {arguments.batch}, medians. Plain is "
        "TorchRL's TensorDictReplayBuffer (of prioritized: TensorDictPrioritizedReplayBuffer) "
        "without transforms, which stores float32, draws nothing turned and has no copies. Ours "
        "has 4 copies unless said otherwise. Ratios are ours over plain, medians of a round's "
        "(smallest to largest).\n"
    )
    transitions = _demonstrated(arguments)
    for measured in ("extend", "sample"):
        print_header("sampling", f"{measured} ms", "plain ms", "ratio", "a second")
        for name, (copies, options) in _KINDS.items():
            ours, plain = _buffers(transitions, arguments.batch, copies, options)
            make = _storing if measured == "extend" else _drawing
            calls = {"ours": make(ours, transitions), "plain": make(plain, transitions)}
            seconds = take_turns(calls, arguments.repeats, warm_up=2)
            each = {kind: [time / _CALLS for time in times] for kind, times in seconds.items()}
            drawn = 1 if measured == "extend" else arguments.batch
            speed = drawn / (sum(each["ours"]) / len(each["ours"]))
            times = (milliseconds(each[kind]) for kind in ("ours", "plain"))
            print_row(name, *times, ratio(each["ours"], each["plain"]), f"{speed:,.0f}")
        print()
    print_header("sampling", "kB a transition", "plain kB", "ratio")
    for name, (copies, options) in _KINDS.items():
        sizes = [_bytes(buffer) for buffer in _buffers(transitions, 1, copies, options)]
        print_row(name, *(f"{size / 1e3:.1f}" for size in sizes), f"{sizes[0] / sizes[1]:.2f}")


def _demonstrated(arguments: argparse.Namespace) -> TensorDictBase:
    """Transitions of the expert, in the form that training stores."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(_CAPACITY))
    env = make_env("block_picking", image_size=arguments.image)
    for _ in DemonstrationCollector(env, episodes=10, seed=0, replay_buffer=buffer):
        pass
    env.close()
    return buffer.storage[: len(buffer)].clone()


def _buffers(
    transitions: TensorDictBase, batch: int, copies: int, options: dict[str, Any]
) -> tuple[ReplayBuffer, ReplayBuffer]:
    """Ours and TorchRL's own, both filled."""
    generator = torch.Generator().manual_seed(0)
    ours = make_replay_buffer(
        _CAPACITY * (copies + 1), copies=copies, batch_size=batch, generator=generator, **options
    )
    storage = LazyTensorStorage(_CAPACITY)
    plain: ReplayBuffer
    if "priorities" in options:
        plain = TensorDictPrioritizedReplayBuffer(
            alpha=0.6, beta=0.4, storage=storage, batch_size=batch
        )
    else:
        plain = TensorDictReplayBuffer(storage=storage, batch_size=batch)
    for buffer in (ours, plain):
        buffer.extend(transitions.clone())
    if options:
        protect_demonstrations(ours)
    ours.extend(transitions[:1].clone())  # experience, for what draws half of it
    return ours, plain


def _storing(buffer: ReplayBuffer, transitions: TensorDictBase) -> Callable[[], None]:
    one = transitions[:1].clone()

    def store() -> None:
        for _ in range(_CALLS):
            buffer.extend(one)

    return store


def _drawing(buffer: ReplayBuffer, transitions: TensorDictBase) -> Callable[[], None]:
    def draw() -> None:
        for _ in range(_CALLS):
            buffer.sample()

    return draw


def _bytes(buffer: ReplayBuffer) -> float:
    """Bytes a stored transition takes."""
    rows: TensorDict = buffer.storage[: len(buffer)]
    return sum(leaf.nbytes for leaf in rows.values(True, True)) / len(buffer)
