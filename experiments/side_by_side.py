"""Tables that put equirl's backends and escnn's modules side by side, in one run."""

from __future__ import annotations

import argparse
import copy
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from escnn_reference import Critic, EscnnEncoder, TextbookSAC, escnn_critic, escnn_policy
from measuring import (
    free_memory,
    mebibytes,
    milliseconds,
    print_header,
    print_row,
    ratio,
    run_config,
    take_turns,
)
from tensordict import TensorDict

from equirl.modules import (
    EquivariantEncoder,
    NativeUnavailable,
    make_actor,
    make_critic,
    resolve_backend,
)
from equirl.symmetry import SymmetryGroup
from equirl.training import Learner

#: What makes an update. The first three run the very same textbook code, so that they
#: differ by their kernels alone; the last is equirl's own, without redundant passes.
UPDATES = {
    "escnn": "escnn, textbook",
    "dense": "dense, textbook",
    "native": "native, textbook",
    "learner": "native, equirl's Learner",
}


def kernels(arguments: argparse.Namespace) -> None:
    """Milliseconds of one SAC update at the paper's head width, the variants taking turns."""
    print(
        f"{arguments.group}, {arguments.image} x {arguments.image}, batch {arguments.batch}, "
        f"{arguments.repeats} rounds; ratios are medians of a round's (smallest to largest)\n"
    )
    variants = available(UPDATES, arguments.group)
    print_header("hidden", "update", "ms", "times as fast as escnn", "as the row above")
    for hidden in arguments.hidden:
        updates = {name: _update(name, hidden, *_setting(arguments)) for name in variants}
        seconds = take_turns(updates, arguments.repeats)
        above = ""
        for name in variants:
            others = [ratio(seconds[other], seconds[name]) for other in ("escnn", above) if above]
            print_row(hidden, UPDATES[name], milliseconds(seconds[name]), *(others or ["1", "-"]))
            above = name


def peak(arguments: argparse.Namespace) -> None:
    """Peak resident memory of updates, each variant in a process of its own.

    "Process" is all of it, libraries included, while it updates; "update" what that is above
    the process at rest before its first update. What building the networks takes, which is
    much with escnn, counts in neither.
    """
    print(f"{arguments.group}, {arguments.image} x {arguments.image}, batch {arguments.batch}\n")
    variants = available(UPDATES, arguments.group)
    print_header("hidden", "update", "process MiB", "of escnn's", "update MiB", "of escnn's")
    for hidden in arguments.hidden:
        escnn: tuple[float, float] | None = None
        for name in variants:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                setting = name, hidden, *_setting(arguments), arguments.threads
                used = pool.submit(_peak_of_updates, *setting).result()
            escnn = escnn or used
            cells: list[str] = []
            for mine, its in zip(used, escnn, strict=True):
                cells += [f"{mine:.0f}", f"{mine / its:.0%}"]
            print_row(hidden, UPDATES[name], *cells)


def threads(arguments: argparse.Namespace) -> None:
    """One update of equirl's Learner on one thread and on two, taking turns."""
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    print(f"Load average {load:.2f} on {cores} cores: two threads need two idle cores.\n")
    variants = available(["learner"], arguments.group)
    print_header("hidden", "update", "1 thread ms", "2 threads ms", "times as fast")
    for hidden in arguments.hidden:
        for name in variants:
            update = _update(name, hidden, *_setting(arguments))
            calls = {count: _on_threads(count, update) for count in (1, 2)}
            seconds = take_turns(calls, arguments.repeats)
            cells = map(milliseconds, seconds.values())
            print_row(hidden, UPDATES[name], *cells, ratio(seconds[1], seconds[2]))
    torch.set_num_threads(arguments.threads)


def layers(arguments: argparse.Namespace) -> None:
    """Milliseconds of the encoder, forward without gradients and forward with backward."""
    print(f"{arguments.group}, {arguments.image} x {arguments.image}, batch {arguments.batch}\n")
    backends = available(["escnn", "dense", "native"], arguments.group)
    columns = [*(f"{name} ms" for name in backends), *(f"escnn / {name}" for name in backends[1:])]
    print_header("hidden", "pass", *columns)
    batch = _random_batch(arguments.image, arguments.batch)
    observation = batch["depth"], batch["holding"]
    for hidden in arguments.hidden:
        encoders = {name: _encoder(name, hidden, arguments) for name in backends}
        for title, run in (("forward", _forward), ("forward + backward", _forward_backward)):
            calls = {name: _bind(run, encoder, *observation) for name, encoder in encoders.items()}
            seconds = take_turns(calls, arguments.repeats)
            cells = [milliseconds(seconds[name]) for name in backends]
            cells += [ratio(seconds["escnn"], seconds[name]) for name in backends[1:]]
            print_row(hidden, title, *cells)


def available(variants: Iterable[str], group: str) -> list[str]:
    """Those of the variants that this machine can run."""
    try:
        resolve_backend("native", SymmetryGroup(group))
    except (ValueError, NativeUnavailable) as error:
        print(f"{error}\n")
        return [name for name in variants if name not in ("native", "learner")]
    return list(variants)


def _setting(arguments: argparse.Namespace) -> tuple[str, int, int]:
    return arguments.group, arguments.image, arguments.batch


def _update(variant: str, hidden: int, group: str, image: int, size: int) -> Callable[[], dict]:
    """A function that makes one update, always on the same batch."""
    batch = _random_batch(image, size)
    if variant == "learner":
        learner = Learner(run_config(group, image, hidden, backend="native"))
        return lambda: learner.update(batch.copy())
    backend = "native" if variant == "native" else "dense"
    made: dict[str, Any] = {
        "hidden": hidden,
        "image_size": image,
        "backend": backend,
        "generator": torch.Generator().manual_seed(0),
    }
    policy = make_actor(group, **made).module[0].module
    critic = Critic(*(part.module for part in make_critic(group, **made).module))
    if variant == "escnn":
        policy, critic, target = escnn_policy(policy), escnn_critic(critic), escnn_critic(critic)
    else:
        target = copy.deepcopy(critic)
    sac = TextbookSAC(policy, critic, target)
    return lambda: sac.update(batch)


def _encoder(variant: str, hidden: int, arguments: argparse.Namespace) -> torch.nn.Module:
    backend = "native" if variant == "native" else "dense"
    size = {"hidden": hidden, "image_size": arguments.image, "backend": backend}
    generator = torch.Generator().manual_seed(0)
    encoder = EquivariantEncoder(arguments.group, **size, generator=generator)
    return EscnnEncoder(encoder).train() if variant == "escnn" else encoder


def _random_batch(image: int, size: int) -> TensorDict:
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(size, *shape, generator=generator)

    state, following = (
        {"depth": 0.3 * uniform(1, image, image), "holding": uniform(1).round()} for _ in range(2)
    )
    done = uniform(1) < 0.1
    following |= {"reward": done.float(), "done": done, "terminated": done}
    return TensorDict(state | {"action": 1.4 * uniform(5) - 0.7, "next": following}, [size])


def _forward(encoder: torch.nn.Module, depth: torch.Tensor, holding: torch.Tensor) -> None:
    with torch.no_grad():
        encoder(depth, holding)


def _forward_backward(encoder: torch.nn.Module, depth: torch.Tensor, holding: torch.Tensor) -> None:
    encoder.zero_grad(set_to_none=True)
    encoder(depth, holding).square().mean().backward()


def _bind(function: Callable, *arguments: object) -> Callable[[], None]:
    return lambda: function(*arguments)


def _on_threads(count: int, update: Callable[[], dict]) -> Callable[[], None]:
    def call() -> None:
        torch.set_num_threads(count)
        update()

    return call


def _peak_of_updates(
    variant: str, hidden: int, group: str, image: int, size: int, threads: int
) -> tuple[float, float]:
    """MiB of this process at the peak of three updates, and how much that is above its rest."""
    torch.set_num_threads(threads)
    _update(variant, 8, group, 16, 8)()  # loads what is loaded at first use
    update = _update(variant, hidden, group, image, size)
    free_memory()  # of building, which would hide what updates take
    rest = mebibytes("self/status", "VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    for _ in range(3):
        update()
    highest = mebibytes("self/status", "VmHWM")
    return highest, highest - rest
