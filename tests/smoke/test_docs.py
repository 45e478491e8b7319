"""Every command of README and docs is one that its script takes, and the reference can be built.

A command is composed or parsed by the script itself, up to the job it would begin: a key that was
renamed or a word that is misspelt in a page fails here. What examples of Python print is tested
in test_readme.py.
"""

import argparse
import importlib
import itertools
import os
import re
import shlex
import subprocess
import sys
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import entry_point
import hydra
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.commands import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
#: Whose public names are the reference.
PACKAGES = ("symmetry", "modules", "objectives", "data", "envs", "collectors", "training")
PACKAGES += ("analysis", "config")
REFUSED = re.compile(r"^(\$ python .*)\nerror: ", re.MULTILINE)  # shown for its complaint
SCRIPT = re.compile(r"python experiments/(\w+)\.py([^|;&>]*)")


def commands(page: Path) -> list[str]:
    """The commands in a page: lines of its blocks, and spans of its text."""
    text = page.read_text().replace("\\\n", " ")
    blocks = re.findall(r"^ *```\w*\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines()]
    lines = [line for line in lines if line not in REFUSED.findall(text)]
    spans = re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    return [
        " ".join(found[0].split())
        for line in [*lines, *spans]
        if (found := SCRIPT.search(line.replace("\n", " ")))
    ]


COMMANDS = [
    pytest.param(page, command, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, command in enumerate(dict.fromkeys(commands(page)))
]


class Taken(BaseException):
    """A script has taken its command line; what it would do then is not of interest."""


def jobs_of(config, overrides: list[str]) -> list[list[str]]:
    """Overrides of as many runs of a sweep as it takes to meet each of its values once."""
    params = config.hydra.sweeper.get("params") or {}
    parser = OverridesParser.create()
    given = parser.parse_overrides([f"{key}={value}" for key, value in params.items()] + overrides)
    values = {}
    for each in given:  # the command line's come last
        texts = each.sweep_string_iterator() if each.is_sweep_override() else None
        key = each.get_key_element()
        values[key] = [f"{key}={text}" for text in texts] if texts else [each.input_line]
    longest = max(map(len, values.values()))
    columns = [itertools.islice(itertools.cycle(column), longest) for column in values.values()]
    return [list(job) for job in zip(*columns, strict=True)]


def compose_only(*, version_base: str, config_path: str, config_name: str):
    """In the place of ``hydra.main``: composes the jobs of the command line; none has a folder."""

    def decorate(job):
        def run() -> None:
            flags = {text for text in sys.argv[1:] if text.startswith("--")}
            assert flags <= {"--multirun", "--help"}, flags
            overrides = [text for text in sys.argv[1:] if text not in flags]
            with initialize_config_dir(config_path, version_base=version_base):
                jobs = [overrides]
                if "--multirun" in flags:
                    told = [text for text in overrides if text.startswith(("hydra", "+experiment"))]
                    jobs = jobs_of(compose(config_name, told, return_hydra_config=True), overrides)
                for each in jobs:
                    with pytest.raises(Taken):
                        job(compose(config_name, each))
            raise Taken

        return run

    return decorate


@pytest.fixture
def take(monkeypatch, tmp_path):
    """Hands a command line to its script, in a folder where nothing is; ends where work begins."""
    to_config, parse_args = entry_point.to_config, argparse.ArgumentParser.parse_args

    def checked(values, schema):
        try:
            to_config(values, schema)
        except entry_point.ConfigError as error:
            pytest.fail(str(error))
        raise Taken

    def parsed(*arguments):
        parse_args(*arguments)
        raise Taken

    def call(command: str) -> None:
        script, rest = SCRIPT.match(command).groups()
        arguments = shlex.split(os.path.expandvars(rest), comments=True)
        module = importlib.import_module(script)
        if hasattr(module, "is_finished"):  # compare.py looks whether runs are there
            monkeypatch.setattr(module, "is_finished", lambda folder: True)
        monkeypatch.setattr(sys, "argv", [f"{script}.py", *arguments])
        with pytest.raises(Taken):
            module.main()

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "2")
    monkeypatch.setattr(hydra, "main", compose_only)
    monkeypatch.setattr(entry_point, "to_config", checked)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parsed)
    return call


@pytest.mark.parametrize(("page", "command"), COMMANDS)
def test_its_script_takes_the_command(take, page, command, tmp_path):
    # What a page has its reader save is there.
    for name, code in re.findall(
        r"[Ss]ave it as `(\w+\.py)`.*?```python\n(.*?)```", page.read_text(), re.DOTALL
    ):
        (tmp_path / name).write_text(code)
    take(command.replace("/path/to/meshes", "household"))  # the reader's own are not there


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_complaints_are_those_that_are_shown(take, page):
    for command, complaint in re.findall(r"^\$ (python .*)\n(error: .*)", page.read_text(), re.M):
        with pytest.raises(SystemExit, match=re.escape(complaint)):
            take(command)


def test_commands_are_found_in_blocks_and_in_the_text():
    found = {page.stem: commands(page) for page in PAGES}
    assert len(found["README"]) > 15 and len(found["sweeps"]) > 5
    wrapped = (
        "python experiments/train.py env.image_size=32 method.hidden=8 steps=600 env.robot=hand"
    )
    assert any(command.startswith(wrapped) for command in found["equivariance"])


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("train.py gruop=d4", "gruop"),
        ("train.py group=q4", "q4"),
        ("train.py --multirun group=d4,q4", "q4"),
        ("train.py +experiment=fig12 preset=pocket", "pocket"),
        ("train.py +experiment=fig12 augmentation.copies=0,-1", "copies=-1"),
        ("train.py hydra/launcher=rocket +experiment=fig12", "rocket"),
        ("train.py env.options.goal_sied=0.1", "goal_sied"),
        ("evaluate.py run=outputs/demo episodse=3", "episodse"),
        ("figures.py sweep=outputs/sweep figrue=12", "figrue"),
        ("audit.py --tasks block_piking", "block_piking"),
        ("compare.py outputs/comparison", "LABEL=FOLDER"),
    ],
)
def test_a_mistake_is_found(take, command, complaint, capsys):
    with pytest.raises((SystemExit, pytest.fail.Exception)) as error:
        take(f"python experiments/{command}")
    assert complaint in f"{error.value} {capsys.readouterr().err}"


def check_links(site: Path) -> dict[Path, set[str]]:
    """Follows every link to its file and anchor; returns the anchors of each page."""
    texts = {path: path.read_text() for path in site.rglob("*.html")}
    ids = {path: set(re.findall(r'\bid="([^"]+)"', text)) for path, text in texts.items()}
    broken, followed = [], 0
    for path, text in texts.items():
        assert not re.search(r'<(script|link|img)[^>]+(src|href)="(https?:)?//', text), path
        for link in re.findall(r'<(?:a|img)[^>]+(?:href|src)="([^"]+)"', text):
            file, _, anchor = unquote(unescape(link)).partition("#")
            target = Path(os.path.normpath(path.parent / file)) if file else path
            if ":" not in file and "${" not in file:  # which a search puts in
                followed += 1
                if not target.exists() or (anchor and anchor not in ids.get(target, {anchor})):
                    broken.append(f"{path.relative_to(site)}: {link}")
    assert followed > 300 and not broken, broken
    return ids


def test_links_of_the_pages_lead_to_files_and_anchors(tmp_path, monkeypatch):
    for library in ("pdoc", "markdown", "pygments"):
        pytest.importorskip(library)
    monkeypatch.syspath_prepend(ROOT / "docs")
    importlib.import_module("build_site").write_pages(tmp_path)
    (tmp_path / "reference").mkdir()
    (tmp_path / "reference" / "index.html").touch()  # made by the test below
    pages = check_links(tmp_path)
    assert tmp_path / "docs" / "index.html" in pages and tmp_path / "README.html" in pages


@pytest.mark.slow
def test_the_site_has_all_public_names(tmp_path):
    pytest.importorskip("pdoc")
    command = [sys.executable, str(ROOT / "docs" / "build_site.py"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0 and "arning" not in done.stderr, done.stderr
    ids = check_links(tmp_path)
    for package in PACKAGES:
        names = importlib.import_module(f"equirl.{package}").__all__
        reference = ids[tmp_path / "reference" / "equirl" / f"{package}.html"]
        assert set(names) <= reference, set(names) - reference
