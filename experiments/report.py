"""Measures how exactly the networks of a run have the symmetry, before and after training.

python experiments/report.py run=outputs/demo
python experiments/report.py run=outputs/demo group=d8 observations=64 output=outputs/demo_d8

Writes a page, a table and a picture of errors against the angle; docs/equivariance.md tells how to
read them.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from entry_point import entry_point

from equirl.config import ReportJob

if TYPE_CHECKING:
    from tensordict import TensorDict

    from equirl.config import Config
    from equirl.symmetry import Element, EquivarianceReport, SymmetryGroup
    from equirl.training import Learner

#: The reports of one network, under what they were measured on and when: ("random", "before").
Reports = dict[tuple[str, str], "EquivarianceReport"]

PAGE, TABLE, PICTURE = "equivariance.md", "equivariance.csv", "equivariance.png"


@entry_point("report", ReportJob)
def main(job: ReportJob) -> None:
    """Prints the tables and writes page, table and picture."""
    from equirl.analysis import write_table
    from equirl.analysis.angles import plot_errors
    from equirl.config import write_atomically
    from equirl.symmetry import SymmetryGroup
    from equirl.training import load_learner

    config, state, learner = load_learner(job.run, job.device, job.backend)
    group = SymmetryGroup(job.group or config.group)
    folder = Path(job.output or job.run)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    reports = measure(job, config, learner, observe(job, config, state), group)
    page, rows = describe(config, state["step"], group, reports), records(reports)
    with writing(folder):
        write_atomically(folder / PAGE, page)
        write_table(folder / TABLE, rows)
        plot_errors(rows, folder / PICTURE, title=f"Equivariance under {group.name}")
    print(page)
    print(f"page: {folder / PAGE}")


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Within it, trouble with the disk ends the program in a sentence."""
    try:
        yield
    except OSError as error:
        sys.exit(f"error: cannot write output={folder}: {error}")


def observe(job: ReportJob, config: Config, state: dict[str, Any]) -> dict[str, TensorDict]:
    """Returns random observations, and those of the run's replay buffer."""
    from tensordict import TensorDict

    from equirl.symmetry import random_observations
    from equirl.training import make_run_env, replay_observations

    with closing(make_run_env(config)) as env:
        depth = env.observation_spec["depth"].high.max().item()
    size, stored = config.observed_size, state["buffer"]
    rows = TensorDict(stored["rows"], batch_size=[stored["size"]])
    return {
        "random": random_observations(job.observations, size, max_depth=depth, seed=job.seed),
        "replay": replay_observations(rows, depth, job.observations),
    }


def measure(
    job: ReportJob,
    config: Config,
    learner: Learner,
    observations: dict[str, TensorDict],
    group: SymmetryGroup,
) -> dict[str, Reports]:
    """Returns the reports of policy and critic."""
    from tqdm import tqdm

    from equirl.modules import shared_filters
    from equirl.symmetry import equivariance_report
    from equirl.training import make_networks

    trained = (learner.policy, learner.critic)
    stages = {"before": make_networks(config), "after": trained}
    reports: dict[str, Reports] = {"policy": {}, "critic": {}}
    shown = "{l_bar}{bar}| {elapsed}, {remaining} left"
    with shared_filters(), tqdm(total=8, bar_format=shown, leave=False) as bar:
        for kind, seen in observations.items():
            for stage, networks in stages.items():
                for of_network, network in zip(reports.values(), networks, strict=True):
                    of_network[kind, stage] = equivariance_report(
                        network,
                        group,
                        seen,
                        elements=elements_of(group, job.angles),
                        keep_theta=job.keep_theta,
                        layers=job.layers,
                        seed=job.seed,
                        progress=bar.update,
                    )
    return reports


def elements_of(group: SymmetryGroup, angles: int) -> list[Element]:
    """Returns evenly spaced turns, with reflections if the group has them, and its elements."""
    from equirl.symmetry import Element

    flips = (False, True) if group.reflections else (False,)
    even = [Element(math.tau * k / angles, flip) for flip in flips for k in range(angles)]
    own = group.elements if group.is_finite else group.grid_elements
    # The same angle by two ways differs by rounding.
    return list({(round(g.angle, 9), g.reflected): g for g in (*even, *own)}.values())


def records(reports: dict[str, Reports]) -> list[dict[str, Any]]:
    """Returns the rows of the table."""
    return [
        {"network": network, "observations": kind, "training": stage, **row}
        for network, of_network in reports.items()
        for (kind, stage), report in of_network.items()
        for row in report.records()
    ]


def describe(config: Config, steps: int, group: SymmetryGroup, reports: dict[str, Reports]) -> str:
    """Returns the page."""
    from equirl.symmetry import error_table, layer_table
    from equirl.training import describe_task
    from equirl.training.networks import describe_method

    lines = [
        f"# Equivariance: {describe_task(config)}, {describe_method(config)}",
        "",
        f"Errors under {group.name} before training and after {steps:,} steps, in the units of "
        "each quantity, on random pictures and on the run's own. docs/equivariance.md tells how to "
        "read them.",
        "",
        f"![Errors against the angle]({PICTURE})",
    ]
    for network, of_network in reports.items():
        labelled = {f"{kind}, {stage}": report for (kind, stage), report in of_network.items()}
        first = next(iter(labelled.values()))
        lines += ["", f"## {network.capitalize()}", "", error_table(labelled)]
        if first.names("layer"):
            lines += ["", layer_table(labelled)]
        lines += ["", *_remarks(labelled)]
    return "\n".join([*lines, ""])


def _remarks(reports: dict[str, EquivarianceReport]) -> list[str]:
    """What the tables do not say, each sentence once."""
    said: dict[str, list[str]] = {}
    for label, report in reports.items():
        for remark in report.remarks:
            said.setdefault(remark, []).append(label)
    return [
        f"- {remark}" if len(labels) == len(reports) else f"- {'; '.join(labels)}: {remark}"
        for remark, labels in said.items()
    ]


if __name__ == "__main__":
    main()
