"""Measures environment, update and acting on this machine; prints Markdown tables.

python experiments/benchmark.py
python experiments/benchmark.py --only environment profile scaling --threads 1
python experiments/benchmark.py --only update --threads 2
python experiments/benchmark.py --only kernels peak threads --threads 1 --repeats 5
python experiments/benchmark.py --only layers --hidden 16 --image 64 --threads 1
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import sys
import time
from collections.abc import Callable

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # before TorchRL is imported
os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # as in train.py

import environment_benchmark
import side_by_side
import torch
from side_by_side import available, milliseconds, take_turns
from tensordict import TensorDictBase

from equirl.collectors import DemonstrationCollector
from equirl.config import Config, to_config
from equirl.data import make_replay_buffer
from equirl.envs import make_env
from equirl.modules import make_actor, make_critic
from equirl.training import Learner


def main() -> None:
    """Runs the chosen tables."""
    tables: dict[str, Callable[[argparse.Namespace], None]] = {
        "environment": environment_benchmark.environment,
        "profile": environment_benchmark.profile,
        "scaling": environment_benchmark.scaling,
        "build": build,
        "update": update,
        "acting": acting,
        "memory": memory,
        "layers": side_by_side.layers,
        "kernels": side_by_side.kernels,
        "peak": side_by_side.peak,
        "threads": side_by_side.threads,
    }
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=tables, nargs="+", help="these tables alone")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--steps", type=int, default=1000, help="environment steps to time")
    parser.add_argument("--repeats", type=int, default=15, help="updates to time")
    parser.add_argument("--image", type=int, default=128, help="pixels a side")
    parser.add_argument("--camera", type=int, default=512, help="pixels a side, the earlier way")
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 4], help="of `scaling`")
    beside_escnn = parser.add_argument_group("tables layers, kernels, peak and threads")
    beside_escnn.add_argument("--group", default="D4")
    beside_escnn.add_argument("--hidden", type=int, nargs="+", default=[16, 32, 64])
    beside_escnn.add_argument("--batch", type=int, default=64)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    sys.stdout.reconfigure(line_buffering=True)  # each row when it is there, in a file too
    print(
        f"{platform.processor() or platform.machine()}, {arguments.threads} torch threads, "
        f"load average {os.getloadavg()[0]:.2f}\n"
    )
    for name, table in tables.items():
        if arguments.only is None or name in arguments.only:
            print(f"## {name}\n")
            table(arguments)
            print()


def build(arguments: argparse.Namespace) -> None:
    """Seconds to build an actor and a critic at the paper's size."""
    print("| group | seconds | actor parameters | critic parameters |")
    print("| --- | --- | --- | --- |")
    for group in ("C4", "C8", "D4", "D8"):
        start = time.perf_counter()
        networks = make_actor(group), make_critic(group)
        seconds = time.perf_counter() - start
        counts = [f"{sum(p.numel() for p in net.parameters()):,}" for net in networks]
        print(f"| {group} | {seconds:.2f} | {counts[0]} | {counts[1]} |")


def update(arguments: argparse.Namespace) -> None:
    """Milliseconds of one SAC update and its parts, medians; critic heads of 64 fields."""
    print("| group | hidden | image | sample and turn | losses and gradients | Adam | target |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    settings = [("D4", 8, 64), ("D4", 16, 64), ("C4", 16, 64), ("D4", 32, 64), ("D4", 64, 128)]
    for group, hidden, size in settings:
        config = _config(group, hidden, size)
        learner, buffer = Learner(config), _filled_buffer(config)
        parts: dict[str, list[float]] = {}
        for _ in range(arguments.repeats + 2):
            clock = _Clock(parts)
            batch = buffer.sample()
            clock("sample")
            learner.optimizer.zero_grad(set_to_none=True)
            learner.loss.backward(batch)
            clock("gradients")
            learner.optimizer.step()
            clock("adam")
            learner.target_update.step()
            clock("target")
        cells = " | ".join(milliseconds(times[2:]) for times in parts.values())
        print(f"| {group} | {hidden} | {size} | {cells} |")


def acting(arguments: argparse.Namespace) -> None:
    """Milliseconds to choose one action from one observation, filters expanded each time."""
    backends = available(["dense", "native"], "D4")
    print(f"| group | hidden | image | {' | '.join(f'{name} ms' for name in backends)} |")
    print("| --- | --- | --- " + "| --- " * len(backends) + "|")
    for group, hidden, size in (("D4", 8, 64), ("D4", 16, 64), ("D4", 32, 64), ("D4", 64, 128)):
        env = make_env("block_picking", image_size=size)
        observation = env.reset()
        env.close()
        calls = {}
        for backend in backends:
            config = _config(group, hidden, size, backend)
            calls[backend] = _acting(Learner(config).actor, observation)
        seconds = take_turns(calls, arguments.repeats, warm_up=2)
        cells = " | ".join(milliseconds(times) for times in seconds.values())
        print(f"| {group} | {hidden} | {size} | {cells} |")


def memory(arguments: argparse.Namespace) -> None:
    """What the replay buffer of the paper's setting takes, and the peak of this process."""
    config = _config("D4", 8, 128)
    buffer = _filled_buffer(config)
    rows = buffer.storage[: len(buffer)]
    row = sum(leaf.nbytes for leaf in rows.values(True, True)) / len(buffer)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print("| replay, 100,000 transitions of 128 x 128, 4 copies | peak of this process |")
    print("| --- | --- |")
    print(f"| {row * 100_000 / 5 / 1e9:.2f} GB | {peak:.2f} GiB |")


class _Clock:
    def __init__(self, parts: dict[str, list[float]]):
        self.parts, self.last = parts, time.perf_counter()

    def __call__(self, name: str) -> None:
        now = time.perf_counter()
        self.parts.setdefault(name, []).append(now - self.last)
        self.last = time.perf_counter()


def _acting(actor: torch.nn.Module, observation: TensorDictBase) -> Callable[[], None]:
    def act() -> None:
        with torch.no_grad():
            actor(observation.copy())

    return act


def _config(group: str, hidden: int, size: int, backend: str = "auto") -> Config:
    return to_config(
        {
            "env": {"task": "block_picking", "image_size": size},
            "method": {"name": "equivariant", "hidden": hidden, "head_width": 64},
            "algorithm": {"name": "sac"},
            "augmentation": {"name": "buffer"},
            "group": group,
            "backend": backend,
        }
    )


def _filled_buffer(config: Config):
    env = make_env(config.env.task, image_size=config.env.image_size)
    buffer = make_replay_buffer(
        10_000, batch_size=config.algorithm.batch_size, generator=torch.Generator()
    )
    for _ in DemonstrationCollector(env, episodes=10, seed=0, replay_buffer=buffer):
        pass
    return buffer


if __name__ == "__main__":
    main()
