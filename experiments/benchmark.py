"""Measures environment, replay and networks on this machine; prints Markdown tables.

Each number stands beside a plain reference that was measured in turns with it: what else runs
on the machine slows both, and their ratio holds.

python experiments/benchmark.py --json benchmark.json > benchmark.md
python experiments/benchmark.py --quick
python experiments/benchmark.py --only environment profile scaling --threads 1
python experiments/benchmark.py --only update --methods equivariant cnn --groups D4 C8 --threads 2
python experiments/benchmark.py --only replay build memory --hidden 64 --threads 1
python experiments/benchmark.py --only kernels peak threads --threads 1 --repeats 5
python experiments/benchmark.py --only layers --hidden 16 --image 64 --threads 1
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # before TorchRL is imported
os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # as in entry_point.py

import benchmark_replay
import benchmark_updates
import environment_benchmark
import side_by_side
import torch
from command_line import at_least
from measuring import begin_section, command_line, machine, save_results

from equirl.modules import METHODS
from equirl.modules.layout import check_sizes
from equirl.symmetry import SymmetryGroup

_GROUPS = ("C4", "C8", "D4", "D8", "SO2", "O2")

#: What `--quick` measures, and how little of it: seconds, to see that everything runs.
_QUICK = {
    "only": ["environment", "profile", "replay", "build", "update", "acting"],
    "threads": 1,
    "steps": 4,
    "repeats": 1,
    "image": 16,
    "camera": 8,
    "workers": [2],
    "groups": ["C4", "D4"],
    "hidden": [8],
    "batch": 8,
}


def main() -> None:
    """Runs the chosen tables."""
    tables: dict[str, Callable[[argparse.Namespace], None]] = {
        "environment": environment_benchmark.environment,
        "profile": environment_benchmark.profile,
        "scaling": environment_benchmark.scaling,
        "replay": benchmark_replay.replay,
        "build": benchmark_updates.build,
        "update": benchmark_updates.update,
        "acting": benchmark_updates.acting,
        "memory": benchmark_updates.memory,
        "layers": side_by_side.layers,
        "kernels": side_by_side.kernels,
        "peak": side_by_side.peak,
        "threads": side_by_side.threads,
    }
    arguments = _arguments(list(tables))
    torch.set_num_threads(arguments.threads)
    measured_on = machine()
    versions = ", ".join(f"{name} {number}" for name, number in measured_on["versions"].items())
    print(
        f"`{command_line()}`\n\n{measured_on['processor']} ({measured_on['instruction_set']}), "
        f"{measured_on['cores']} cores with a load average of {measured_on['load_average']:.2f}, "
        f"{arguments.threads} torch threads; {versions}\n"
    )
    for name, table in tables.items():
        if arguments.only is None or name in arguments.only:
            begin_section(name)
            table(arguments)
            print()
            if arguments.json:  # what there is, after each: the whole takes long
                save_results(arguments.json, measured_on)


def _arguments(tables: list[str]) -> argparse.Namespace:
    count = at_least(1)
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--only", choices=tables, nargs="+", help="these tables alone")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write them, too")
    parser.add_argument("--quick", action="store_true", help="everything in seconds, once")
    parser.add_argument("--threads", type=count, default=torch.get_num_threads())
    parser.add_argument("--steps", type=count, default=1000, help="environment steps to time")
    parser.add_argument("--repeats", type=count, default=15, help="rounds to time")
    parser.add_argument("--image", type=count, default=128, help="pixels a side")
    parser.add_argument("--camera", type=count, default=512, help="pixels a side, the earlier way")
    parser.add_argument("--workers", type=count, nargs="+", default=[2, 4], help="of `scaling`")
    networks = parser.add_argument_group("tables of networks")
    networks.add_argument("--methods", choices=list(METHODS), nargs="+", help="all by default")
    networks.add_argument("--groups", nargs="+", default=list(_GROUPS), help="of `equivariant`")
    networks.add_argument("--group", default="D4", help="of acting, layers, kernels, peak, threads")
    networks.add_argument("--hidden", type=count, nargs="+", default=[16, 32, 64])
    networks.add_argument("--batch", type=count, default=64)
    if parser.parse_known_args()[0].quick:
        parser.set_defaults(**_QUICK)
    arguments = parser.parse_args()
    try:
        for group in (arguments.group, *arguments.groups):
            SymmetryGroup(group)
        for hidden in arguments.hidden:
            check_sizes(hidden, arguments.image)
    except ValueError as error:
        parser.error(str(error))
    if arguments.json and not arguments.json.absolute().parent.is_dir():
        parser.error(f"--json: there is no folder {arguments.json.parent}")
    return arguments


if __name__ == "__main__":
    main()
