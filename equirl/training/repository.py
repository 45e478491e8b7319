"""Which code a run was made with: the commit, and what differs from it."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import equirl
from equirl.training.folder import CHANGES

__all__ = ["describe_repository"]

#: Bytes of a difference that is kept; a larger one is only counted.
_LARGEST_CHANGES = 200_000
_GIT_SECONDS = 20.0  # a repository on a slow disk

#: New files that are named; of more, their number is told.
_MOST_NEW = 100


def describe_repository(folder: Path, earlier: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The commit that the code is at and what differs from it; None without a repository.

    It is the repository of equirl itself, or, when equirl was installed as a package, that of
    the working folder, where a task of the user's may be.

    Args:
        folder: The run's folder, where a difference to the commit is kept.
        earlier: The sessions so far; what one of them has kept is not kept again.
    """
    source = Path(equirl.__file__).parent
    if _git(source, "ls-files", "--error-unmatch", "__init__.py") is not None:
        place, of = source, "equirl"
    else:  # a package in an environment inside another repository is no part of it
        place, of = Path(), "the working folder"
    top = _git(place, "rev-parse", "--show-toplevel")
    commit = _git(place, "rev-parse", "HEAD")
    if top is None or commit is None:
        return None
    root = Path(_text(top))
    changes = _uncommitted(root)
    others = _git(root, "ls-files", "--others", "--exclude-standard", "-z", "--", "*.py") or b""
    new = [name for name in os.fsdecode(others).split("\0") if name]
    more = [f"and {len(new) - _MOST_NEW} more"] if len(new) > _MOST_NEW else []
    code: dict[str, Any] = {
        "of": of,
        "commit": _text(commit),
        "dirty": bool(changes or new),
        "untracked": new[:_MOST_NEW] + more,  # beside it: a patch does not hold them
        "changes": None,
        "digest": _digest(changes, root, new),
    }
    if changes:
        code["changes"] = _keep_changes(changes, code["digest"], folder, earlier)
    return code


def _digest(changes: bytes, root: Path, new: list[str]) -> str:
    """The same for the same code: of the difference to the commit and of the new files."""
    digest = hashlib.blake2b(changes, digest_size=8)
    for name in new:
        digest.update(os.fsencode(f"\0{name}\0"))
        with suppress(OSError):  # gone since it was listed, or not ours to read
            digest.update(hashlib.blake2b((root / name).read_bytes()).digest())
    return digest.hexdigest()


#: What makes a difference one that `git apply` takes, whatever the user has configured.
_APPLICABLE = (
    *("--no-ext-diff", "--no-textconv", "--no-color", "--binary", "--unified=3"),
    *("--src-prefix=a/", "--dst-prefix=b/", "--submodule=short"),
)


def _uncommitted(root: Path) -> bytes:
    """The difference of a repository's files to its commit; empty when it cannot be told.

    Through a copy of the index, which `git diff` would refresh: another program may be using it.
    """
    index = _git(root, "rev-parse", "--git-path", "index") or b""
    try:
        with TemporaryDirectory() as temporary:
            copy = Path(temporary, "index")
            # With its time, by which git knows what may have changed since.
            shutil.copy2(root / _text(index), copy)
            command = ("diff", *_APPLICABLE, "HEAD")
            return _git(root, *command, GIT_INDEX_FILE=str(copy)) or b""
    except OSError:  # no index, or no room for a copy
        return b""


def _keep_changes(
    changes: bytes, digest: str, folder: Path, earlier: list[dict[str, Any]]
) -> str | None:
    """Writes a difference beside the record and returns its file; None of one too large."""
    if len(changes) > _LARGEST_CHANGES:
        return None
    kept = {
        session["code"]["digest"]: session["code"]["changes"]
        for session in earlier
        if session["code"] and session["code"]["changes"]
    }
    if digest in kept:
        return kept[digest]
    name = CHANGES
    if kept:  # each session's code can be had again
        name = f"{Path(CHANGES).stem}_{len(earlier) + 1}{Path(CHANGES).suffix}"
    partial = folder / f"{name}.partial"
    partial.write_bytes(changes)  # as they are: sources may be of any encoding
    os.replace(partial, folder / name)
    return name


def _git(place: Path, *arguments: str, **variables: str) -> bytes | None:
    """What git answers; None where it is missing, has no repository or refuses."""
    elsewhere = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")  # set within hooks of another
    environment = {key: value for key, value in os.environ.items() if key not in elsewhere}
    try:
        done = subprocess.run(
            ["git", *arguments],
            cwd=place,
            capture_output=True,
            timeout=_GIT_SECONDS,
            check=True,
            stdin=subprocess.DEVNULL,
            env=environment | variables,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout


def _text(answer: bytes) -> str:
    """An answer of one line: a commit, or a path of whatever encoding."""
    return os.fsdecode(answer).strip()
