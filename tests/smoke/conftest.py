"""Entry points in this process, which is quicker, and in processes that end with their test."""

import importlib
import logging
import sys

import pytest

from tests.commands import end_all


@pytest.fixture(autouse=True)
def processes():
    """No process outlives the test that started it."""
    yield
    end_all()


@pytest.fixture(autouse=True)
def loggers():
    """Hydra sets up all loggers for good, where no run in this process does so again."""
    root, own = logging.getLogger(), logging.getLogger("equirl")
    levels = root.level, own.level
    yield
    root.setLevel(levels[0])
    own.setLevel(levels[1])
    own.disabled = False


@pytest.fixture
def here(monkeypatch, capsys):
    """Calls an entry point in this process: its exit code, its output and its complaints."""

    def call(script: str, *arguments: str) -> tuple[int, str, str]:
        module = importlib.import_module(script.removesuffix(".py"))
        monkeypatch.setattr(sys, "argv", [script, *arguments])
        capsys.readouterr()
        code, last = 0, ""
        try:
            module.main()
        except SystemExit as exit:
            code = exit.code if isinstance(exit.code, int) else int(exit.code is not None)
            last = exit.code if isinstance(exit.code, str) else ""
        out, err = capsys.readouterr()
        return code, out, f"{err}\n{last}"

    return call
