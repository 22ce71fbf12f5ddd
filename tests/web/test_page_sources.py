"""Rules for the files of the page that no browser enforces."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import pytest

import pebble.web
from pebble.web.static_files import without_comments

STATIC = Path(pebble.web.__file__).parent / "static"
OURS = [path for path in STATIC.rglob("*") if path.suffix in (".js", ".css", ".html") and "vendor" not in path.parts]
SERVED = [path for path in STATIC.rglob("*") if path.suffix in (".js", ".mjs", ".css", ".html", ".svg", ".webmanifest")]
SENT_AS_THEY_ARE = (".html", ".svg", ".webmanifest")
MOST_KB = 60  # compressed, for all that one load of the page fetches

HTML_FROM_TEXT = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function\(|srcdoc|setHTML"
STORED_NAMES = ("http://www.w3.org/2000/svg", "http://www.w3.org/1999/xhtml")  # names of markup, never fetched


@pytest.mark.parametrize("path", OURS, ids=lambda path: str(path.relative_to(STATIC)))
def test_no_text_becomes_markup_or_code(path: Path):
    assert re.findall(HTML_FROM_TEXT, path.read_text()) == []


@pytest.mark.parametrize("path", SERVED, ids=lambda path: str(path.relative_to(STATIC)))
def test_no_other_host_is_named(path: Path):
    text = path.read_text()
    for name in STORED_NAMES:
        text = text.replace(name, "")
    code = re.sub(r"/\*.*?\*/|^\s*//[^\n]*", "", text, flags=re.DOTALL | re.MULTILINE)
    assert re.findall(r"(?:https?:)?//[a-z0-9-]+\.[a-z]{2,}[^\s\"'`]*", code) == []


@pytest.mark.parametrize("folder", ["core", "media"])
def test_what_is_safety_or_media_needs_no_framework(folder: str):
    for path in (STATIC / folder).glob("*.js"):
        imports = re.findall(r"from \"([^\"]+)\"", path.read_text())
        assert all(name.startswith("./") for name in imports), path.name


def _imported(module: Path) -> set[Path]:
    """A module and all that it imports."""
    found, pending = {module}, [module]
    while pending:
        path = pending.pop()
        names = re.findall(r"from ?\"(\.[^\"]+)\"", path.read_text())
        new = {(path.parent / name).resolve() for name in names} - found
        found |= new
        pending += new
    return found


def test_a_load_of_the_page_is_small():
    """Without the worker that decodes pictures: it is fetched when the first picture is shown."""
    more = [STATIC / name for name in ("index.html", "app.css", "icons.svg", "manifest.webmanifest")]
    files = [*sorted(_imported((STATIC / "main.js").resolve())), *more]
    served = [
        path.read_bytes() if path.suffix in SENT_AS_THEY_ARE else without_comments(path.read_bytes()) for path in files
    ]
    size = sum(len(gzip.compress(content, 9)) for content in served)
    assert size <= 1000 * MOST_KB, f"{size} bytes in {len(files)} files"


def test_markup_has_no_script_and_no_style_of_its_own():
    for path in STATIC.glob("*.html"):
        markup = path.read_text()
        assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\sstyle=|\son[a-z]+=", markup), path.name


def test_comments_are_blanked_and_nothing_else():
    code = ['const a = "// no"; // yes, but this line is code', "b = 1 /* in */ + 2;"]
    source = f"/** What.\n * @param {{string}} a */\n{code[0]}\n  // gone\n{code[1]}\n"
    assert without_comments(source.encode()).decode() == f"\n\n{code[0]}\n\n{code[1]}\n"


@pytest.mark.parametrize(
    "path", [path for path in SERVED if path.suffix in (".js", ".mjs")], ids=lambda path: path.name
)
def test_no_text_in_the_page_looks_like_a_comment(path: Path):
    """A line of a template that began with // would be blanked, too."""
    inside = re.findall(r"`[^`]*`", without_comments(path.read_bytes()).decode())
    assert all(text in path.read_text() for text in inside)
