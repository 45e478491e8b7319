"""What a finished run leaves in its folder: a page, curves and a video."""

from __future__ import annotations

from pathlib import Path

from equirl.analysis import read_table
from equirl.analysis.curves import plot_run
from equirl.config import Config, write_atomically
from equirl.training.environment import describe_task
from equirl.training.evaluation import Evaluation
from equirl.training.folder import CURVES, FILES, REPORT
from equirl.training.networks import describe_method
from equirl.training.provenance import read_record, summarize_record

__all__ = ["write_report"]


def write_report(
    folder: Path, config: Config, evaluation: Evaluation, *, video: Path | None = None
) -> Path:
    """Writes ``report.md`` with its curves.

    Args:
        folder: The run's folder.
        config: The run's configuration.
        evaluation: The trained policy on the test scenes.
        video: The film of the learned policy, if one was made.

    Returns:
        The page's path.
    """
    plot_run(folder, folder / CURVES)
    timing = read_table(folder / "timing.csv")
    low, high = evaluation.interval
    solved = [episode.length for episode in evaluation.episodes if episode.success]
    lines = [
        f"# {describe_task(config)}, {describe_method(config)}",
        "",
        f"**{evaluation.success_rate:.0%} success** on {len(evaluation.episodes)} held-out "
        f"scenes (95 % confidence interval {low:.0%} to {high:.0%}), greedy policy, after "
        f"{config.steps:,} environment steps.",
        "",
        "| | |",
        "| --- | --- |",
        f"| mean discounted return (discount {config.evaluation.discount}) "
        f"| {evaluation.discounted_return:.3f} |",
    ]
    if solved:
        lines.append(f"| mean length of a successful episode | {sum(solved) / len(solved):.1f} |")
    if timing:
        lines.append(f"| training time | {timing['minutes'][-1]:.1f} minutes |")
        lines.append(f"| one update | {timing['update_ms'][-1]:.0f} ms |")
    lines += [
        f"| seed | {config.seed} |",
        "",
        f"![Learning curves]({CURVES})",
        "",
        "Left above: success of the greedy policy on validation scenes with its confidence "
        "interval. Right above: what the exploring policy earned while training.",
        "",
    ]
    if video:
        lines += [f"The learned policy at work: [{video.name}]({video.name}).", ""]
    failures = [str(i) for i, episode in enumerate(evaluation.episodes) if not episode.success]
    if failures:
        lines += [f"Test scenes it failed, by number: {', '.join(failures)}.", ""]
    if not timing.get("update_ms", [0.0])[-1]:
        lines += ["**No update was made**: the replay buffer never held enough.", ""]
    if record := read_record(folder):
        lines += ["## How it was made", "", *summarize_record(record), ""]
    lines += [
        "| file | what |",
        "| --- | --- |",
        *(
            f"| `{name}` | {what} |"
            for name, what in FILES.items()
            if name == REPORT or (folder / name).exists()
        ),
        "",
    ]
    page = folder / REPORT
    write_atomically(page, "\n".join(lines))
    return page
