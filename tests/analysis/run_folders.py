"""Folders as runs leave them, with numbers that a test knows."""

from collections.abc import Sequence
from pathlib import Path

import yaml

from equirl.analysis.tables import write_table

KEYS = {
    "env": {"task": "block_picking", "image_size": 16, "robot": "panda", "max_steps": 50},
    "method": {"name": "equivariant", "hidden": 8},
    "algorithm": {"name": "sac"},
    "augmentation": {"name": "buffer", "copies": 4},
    "demos": {"episodes": 20, "file": "", "options": {}},
    "evaluation": {"every": 100, "discount": 0.99},
    "mode": "strict",
    "group": "D4",
    "steps": 400,
    "seed": 0,
}


def write_run(
    folder: Path,
    *,
    returns: Sequence[float] = (0.2, 0.4, 0.6, 0.8),
    success: Sequence[float] = (0.0, 0.5, 0.9, 1.0),
    test: Sequence[int] | None = (1, 1, 0, 1),
    **changes: object,
) -> Path:
    """Writes a run: an episode and a validation each 100 steps; unfinished without ``test``.

    Args:
        folder: Of the run.
        returns: Of the episodes.
        success: Of the validations.
        test: Of the test scenes.
        changes: Of the configuration; ``env_task="x"`` stands for ``env.task``.
    """
    keys = {name: dict(value) if isinstance(value, dict) else value for name, value in KEYS.items()}
    for name, value in changes.items():
        group, _, key = name.partition("_")
        if key:
            keys[group][key] = value
        else:
            keys[name] = value
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(keys, sort_keys=False))
    (folder / ".lock").touch()
    rows = [
        {"step": 100 * n, "episode": n - 1, "length": 50, "discounted_return": value}
        for n, value in enumerate(returns, start=1)
    ]
    if rows:
        write_table(folder / "metrics.csv", rows)
    rows = [
        {"step": 100 * n, "success_rate": value, "low": value, "high": value}
        for n, value in enumerate(success, start=1)
    ]
    if rows:
        write_table(folder / "validation.csv", rows)
        times = [{"step": row["step"], "minutes": row["step"] / 50, "update_ms": 5} for row in rows]
        write_table(folder / "timing.csv", times)
    if test is not None:
        write_table(folder / "test.csv", [{"success": each, "length": 9} for each in test])
        (folder / "report.md").write_text("# A run\n")
    return folder
