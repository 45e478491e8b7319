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
import time
from collections.abc import Callable

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # before TorchRL is imported
os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # as in entry_point.py

import environment_benchmark
import side_by_side
import torch
from command_line import at_least
from measuring import mebibytes, milliseconds, print_header, print_row, run_config, take_turns
from side_by_side import available
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer

from equirl.collectors import DemonstrationCollector
from equirl.config import Config
from equirl.data import make_replay_buffer
from equirl.envs import make_env
from equirl.modules import make_actor, make_critic
from equirl.modules.layout import check_sizes
from equirl.symmetry import SymmetryGroup
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
    count = at_least(1)
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--only", choices=tables, nargs="+", help="these tables alone")
    parser.add_argument("--threads", type=count, default=torch.get_num_threads())
    parser.add_argument("--steps", type=count, default=1000, help="environment steps to time")
    parser.add_argument("--repeats", type=count, default=15, help="updates to time")
    parser.add_argument("--image", type=count, default=128, help="pixels a side")
    parser.add_argument("--camera", type=count, default=512, help="pixels a side, the earlier way")
    parser.add_argument("--workers", type=count, nargs="+", default=[2, 4], help="of `scaling`")
    beside_escnn = parser.add_argument_group("tables layers, kernels, peak and threads")
    beside_escnn.add_argument("--group", default="D4")
    beside_escnn.add_argument("--hidden", type=count, nargs="+", default=[16, 32, 64])
    beside_escnn.add_argument("--batch", type=count, default=64)
    arguments = parser.parse_args()
    try:
        SymmetryGroup(arguments.group)
        for hidden in arguments.hidden:
            check_sizes(hidden, arguments.image)
    except ValueError as error:
        parser.error(str(error))
    torch.set_num_threads(arguments.threads)
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
    print_header("group", "seconds", "actor parameters", "critic parameters")
    for group in ("C4", "C8", "D4", "D8", "SO2", "O2"):
        start = time.perf_counter()
        networks = make_actor(group), make_critic(group)
        seconds = time.perf_counter() - start
        counts = (sum(p.numel() for p in net.parameters()) for net in networks)
        print_row(group, f"{seconds:.2f}", *(f"{count:,}" for count in counts))


def update(arguments: argparse.Namespace) -> None:
    """Milliseconds of one SAC update and its parts, medians; critic heads of 64 fields."""
    parts = ("sample and turn", "losses and gradients", "Adam", "target")
    print_header("group", "hidden", "image", *parts)
    settings = [("D4", 8, 64), ("D4", 16, 64), ("C4", 16, 64), ("D4", 32, 64), ("D4", 64, 128)]
    for group, hidden, size in settings:
        config = run_config(group, size, hidden, head_width=64)
        calls = zip(parts, _parts_of_an_update(config), strict=True)
        seconds = take_turns(dict(calls), arguments.repeats, warm_up=2)
        print_row(group, hidden, size, *map(milliseconds, seconds.values()))


def acting(arguments: argparse.Namespace) -> None:
    """Milliseconds to choose one action from one observation, filters expanded each time."""
    backends = available(["dense", "native"], "D4")
    print_header("group", "hidden", "image", *(f"{name} ms" for name in backends))
    for group, hidden, size in (("D4", 8, 64), ("D4", 16, 64), ("D4", 32, 64), ("D4", 64, 128)):
        env = make_env("block_picking", image_size=size)
        observation = env.reset()
        env.close()
        calls = {}
        for backend in backends:
            config = run_config(group, size, hidden, head_width=64, backend=backend)
            calls[backend] = _acting(Learner(config).actor, observation)
        seconds = take_turns(calls, arguments.repeats, warm_up=2)
        print_row(group, hidden, size, *map(milliseconds, seconds.values()))


def memory(arguments: argparse.Namespace) -> None:
    """What the replay buffer of the paper's setting takes, and the peak of this process."""
    buffer = _filled_buffer(run_config("D4", 128, 8))
    rows = buffer.storage[: len(buffer)]
    row = sum(leaf.nbytes for leaf in rows.values(True, True)) / len(buffer)
    peak = mebibytes("self/status", "VmHWM") / 2**10
    print_header("replay, 100,000 transitions of 128 x 128, 4 copies", "peak of this process")
    print_row(f"{row * 100_000 / 5 / 1e9:.2f} GB", f"{peak:.2f} GiB")


def _parts_of_an_update(config: Config) -> list[Callable[[], None]]:
    """What an update does, one after the other."""
    learner, buffer = Learner(config), _filled_buffer(config)
    batch = buffer.sample()

    def sample() -> None:
        nonlocal batch
        batch = buffer.sample()

    def differentiate() -> None:
        learner.optimizer.zero_grad(set_to_none=True)
        learner.loss.backward(batch)

    return [sample, differentiate, learner.optimizer.step, learner.target_update.step]


def _acting(actor: torch.nn.Module, observation: TensorDictBase) -> Callable[[], None]:
    def act() -> None:
        with torch.no_grad():
            actor(observation.copy())

    return act


def _filled_buffer(config: Config) -> ReplayBuffer:
    env = make_env(config.env.task, image_size=config.env.image_size)
    buffer = make_replay_buffer(
        10_000, batch_size=config.algorithm.batch_size, generator=torch.Generator()
    )
    for _ in DemonstrationCollector(env, episodes=10, seed=0, replay_buffer=buffer):
        pass
    return buffer


if __name__ == "__main__":
    main()
