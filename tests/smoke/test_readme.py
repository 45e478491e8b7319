"""The examples of README and docs run as printed, and what they point to exists."""

import re
import subprocess
import sys
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
README = PAGES[0].read_text()
EXAMPLES = [
    pytest.param(code, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, code in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
]


@pytest.mark.parametrize("code", EXAMPLES)
def test_example_runs(code):
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    if "DemonstrationCollector" in code:
        assert "an expert episode of" in done.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_and_scripts_exist(page):
    text = page.read_text()
    links = re.findall(r"\]\((?!http)([^)#]+)\)", text)
    scripts = re.findall(r"python (experiments/\w+\.py)", text)
    assert links
    for path in links:
        assert (page.parent / path).exists(), path
    for path in scripts:
        assert (ROOT / path).exists(), path


def test_the_architecture_names_what_is_there():
    """Every name of code in the page occurs in the code."""
    inside = list(
        chain.from_iterable(ROOT.glob(f"{room}/**/*") for room in ("equirl", "experiments"))
    )
    files = [path for path in (*inside, *ROOT.glob("conf/*")) if path.suffix in (".py", ".yaml")]
    source = "\n".join(path.read_text() for path in files)
    page = (ROOT / "docs" / "architecture.md").read_text()
    names = set(re.findall(r"`([A-Za-z_][\w.]*)(?:\(\))?`", page))
    parts = {part for name in names for part in name.split(".")}
    folders = {path.name for path in [*ROOT.glob("*"), *inside]}
    missing = {p for p in parts if p not in folders and not re.search(rf"\b{p}\b", source)}
    assert len(names) > 20 and not missing and "@" not in page


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"`?make ([a-z-]+)`", README):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
