"""Builds the pages and the reference of all public names as HTML that opens without a network.

python docs/build_site.py [FOLDER]

The folder (``site``) mirrors the repository, so that relative links stay what they are: Markdown
becomes HTML, source that a page points to is shown in colours, pictures are copied. The reference
lies in ``reference``, made by pdoc of what each package lists in ``__all__``.
"""

from __future__ import annotations

import html
import os
import re
import shutil
import sys
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from urllib.parse import unquote

import pdoc
from markdown import Markdown
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import get_lexer_for_filename
from pygments.util import ClassNotFound

ROOT = Path(__file__).parents[1]
START = Path("docs/index.md")
#: Packages whose public names are the reference; their files are left out.
REFERENCE = ["equirl", r"!equirl\.\w+\.", "equirl.envs.tasks", "equirl.envs.objects"]
COPIED = {".png", ".mp4", ".csv", ".json", ".gif"}
STYLE = """
body { max-width: 60rem; margin: 0 auto; padding: 1rem 1.5rem 4rem; font: 16px/1.55 sans-serif; }
body { color: #222; } a { color: #1a5fa8; } img, video { max-width: 100%; }
nav { border-bottom: 1px solid #ddd; padding-bottom: .5rem; } nav a { margin-right: 1.2rem; }
pre { background: #f6f6f6; padding: .8rem; overflow-x: auto; } code { font-size: 90%; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th, td { border: 1px solid #ddd; padding: .3rem .6rem; text-align: left; vertical-align: top; }
"""


def main() -> None:
    """Builds everything, and says where."""
    site = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "site").resolve()
    shutil.rmtree(site / "reference", ignore_errors=True)
    count = write_pages(site)
    write_reference(site / "reference")
    (site / "index.html").write_text(
        f'<!doctype html><meta http-equiv="refresh" content="0; url={shown(START)}">\n'
    )
    print(f"{count} pages and the reference: {os.path.relpath(site / 'index.html')}")


def write_reference(folder: Path) -> None:
    """Writes a page a package, with its public names and their docstrings."""
    pdoc.render.configure(docformat="google", show_source=False, footer_text="equirl")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, and of annotations inherited from them
        for name in ("envs", "modules", "training"):  # pdoc would suppress what libraries look up
            import_module(f"equirl.{name}")
        pdoc.pdoc(*REFERENCE, output_directory=folder)
    for path in folder.rglob("*.html"):  # pdoc links members that others' classes have, to nowhere
        text = path.read_text()
        ids = set(re.findall(r'\bid="([^"]+)"', text))
        path.write_text(
            re.sub(
                r'<a href="#([^"]+)">(.*?)</a>',
                lambda link, ids=ids: link[0] if link[1] in ids else link[2],
                text,
            )
        )


def write_pages(site: Path) -> int:
    """Writes the pages of README and docs and all that they point to; returns how many."""
    waiting = [Path("README.md"), *(p.relative_to(ROOT) for p in (ROOT / "docs").glob("*.md"))]
    done: set[Path] = set()
    while waiting:
        source = waiting.pop()
        if source in done:
            continue
        done.add(source)
        target = site / shown(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix in COPIED:
            shutil.copyfile(ROOT / source, target)
            continue
        body = render(source)
        waiting += (path for path, _ in linked(source, body) if path not in done)
        target.write_text(page(source, redirect(source, body)))
    return len(done)


def shown(source: Path) -> str:
    """Where a file or folder of the repository is found in the site."""
    if (ROOT / source).is_dir():
        return (source / "index.html").as_posix()
    if source.suffix in COPIED:
        return source.as_posix()
    name = source.with_suffix(".html") if source.suffix == ".md" else f"{source.as_posix()}.html"
    return Path(name).as_posix()


def render(source: Path) -> str:
    """The body of a page: of Markdown, of source in colours, or of a list of a folder's files."""
    path = ROOT / source
    if path.is_dir():
        names = sorted(p.name for p in path.iterdir() if p.suffix in (".py", ".md", ".yaml"))
        return "".join(f'<p><a href="{name}">{name}</a></p>\n' for name in names)
    text = path.read_text()
    if source.suffix == ".md":
        return Markdown(extensions=["tables", "fenced_code", "sane_lists", "toc"]).convert(text)
    try:
        lexer = get_lexer_for_filename(source.name)
    except ClassNotFound:
        return f"<pre>{html.escape(text)}</pre>"
    return highlight(text, lexer, HtmlFormatter(noclasses=True))


def linked(source: Path, body: str) -> Iterator[tuple[Path, str]]:
    """What a page points to in the repository, and the link as it is written.

    Raises:
        FileNotFoundError: There is no such file.
    """
    for link in re.findall(r'(?:href|src)="([^"]+)"', body):
        file = unquote(html.unescape(link)).partition("#")[0]
        if not file or ":" in file:
            continue
        folder = source if (ROOT / source).is_dir() else source.parent
        path = Path(os.path.normpath(ROOT / folder / file))
        if not path.exists() or not path.is_relative_to(ROOT):
            raise FileNotFoundError(f"{source} points to {link}, which is not in the repository")
        yield path.relative_to(ROOT), link


def redirect(source: Path, body: str) -> str:
    """The body with its links pointing to where things are in the site."""
    here = Path(shown(source)).parent
    for path, link in dict.fromkeys(linked(source, body)):
        _, sign, anchor = link.partition("#")
        there = os.path.relpath(shown(path), here) + sign + anchor
        body = re.sub(rf'(href|src)="{re.escape(link)}"', rf'\1="{there}"', body)
    return body


def page(source: Path, body: str) -> str:
    """A whole page, with the way back to the others."""
    here = Path(shown(source)).parent
    ways = {"equirl": shown(START), "README": "README.html", "reference": "reference/index.html"}
    links = "".join(
        f'<a href="{os.path.relpath(way, here)}">{name}</a>' for name, way in ways.items()
    )
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{source}</title>'
        f"<style>{STYLE}</style></head>\n<body><nav>{links}</nav>\n{body}\n</body></html>\n"
    )


if __name__ == "__main__":
    main()
