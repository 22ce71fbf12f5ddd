"""Rules for the files of the page that no browser enforces."""

from __future__ import annotations

import base64
import gzip
import hashlib
import re
import subprocess
from collections.abc import Iterable
from graphlib import TopologicalSorter
from importlib.resources import files
from pathlib import Path

import pytest
from starlette.requests import Request

import pebble.extensions.page
from pebble.extensions.page.access.guard import CONTENT_SECURITY_POLICY
from pebble.extensions.page.static_files import StaticFiles, stripped
from tests.kit.npm import package
from tests.support import some

STATIC = Path(pebble.extensions.page.__file__).parent / "static"
OURS = [
    path for path in sorted(STATIC.rglob("*")) if path.suffix in (".js", ".css", ".html") and "vendor" not in path.parts
]
SUFFIXES = (".js", ".mjs", ".css", ".html", ".svg", ".webmanifest")
SERVED = [path for path in sorted(STATIC.rglob("*")) if path.suffix in SUFFIXES]
MOST_KB = 90  # compressed, for all that one load of the page fetches until it shows pictures, with its font
FONT = "vendor/figtree.woff2"
PRINT = ["--allowJs", "--removeComments", "--noCheck", "--noLib", "--noResolve"]

HTML_FROM_TEXT = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function\(|srcdoc|setHTML"
STORED_NAMES = ("http://www.w3.org/2000/svg", "http://www.w3.org/1999/xhtml")  # names of markup, never fetched


def found(pattern: str, sources: Iterable[tuple[Path, str]], flags: int = 0) -> dict[str, list[str]]:
    """What a pattern matches, by file."""
    matches = {str(path.relative_to(STATIC)): re.findall(pattern, text, flags) for path, text in sources}
    return {name: texts for name, texts in matches.items() if texts}


def test_no_text_becomes_markup_or_code() -> None:
    assert found(HTML_FROM_TEXT, ((path, path.read_text()) for path in OURS)) == {}


def test_no_other_host_is_named() -> None:
    def code(path: Path) -> str:
        text = re.sub("|".join(STORED_NAMES), "", path.read_text())
        return re.sub(r"/\*.*?\*/|^\s*//[^\n]*", "", text, flags=re.DOTALL | re.MULTILINE)

    hosts = r"(?:https?:)?//[a-z0-9-]+\.[a-z]{2,}[^\s\"'`]*"
    assert found(hosts, ((path, code(path)) for path in SERVED)) == {}


def test_what_is_safety_or_media_needs_no_framework() -> None:
    imports = r'(?:from|import) "(?!\./|(?:\.\./)+core/browser|\.\./[\w-]+\.js)([^"]+)"'
    sources = [path for folder in ("core", "media") for path in (STATIC / folder).rglob("*.js")]
    assert found(imports, ((path, path.read_text()) for path in sources)) == {}


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


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    """Not even those that are fetched later."""
    graph = {}
    for path in STATIC.rglob("*.js"):
        names = re.findall(r"(?:from |import\()\"(\.[^\"]+)\"", stripped(path.read_bytes(), "js").decode())
        graph[path] = {(path.parent / name).resolve() for name in names}
    tuple(TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("screen", ["fleet", "robot"])
def test_a_load_of_the_page_is_small(screen: str) -> None:
    """The size includes the worker that decodes pictures."""
    served = StaticFiles(files("pebble.extensions.page") / "static").files
    modules = [STATIC / name for name in ("main.js", f"ui/{screen}/{screen}.js", "media/video-worker.js")]
    names = {str(path.relative_to(STATIC.resolve())) for one in modules for path in _imported(one.resolve())}
    names |= {f"{screen}.html", "app.css", "app-icon.svg", "icons.svg", "manifest.webmanifest", FONT}
    names |= {f"{screen}.css", "faces.svg"} & set(served)
    size = sum(len(gzip.compress(served[name].replace(b"{root}", b"../../../../"), 9)) for name in names)
    assert size <= 1000 * MOST_KB, f"{size} bytes in {len(names)} files"


def test_markup_has_no_style_of_its_own_and_one_script_whose_hash_the_policy_names() -> None:
    static = StaticFiles(files("pebble.extensions.page") / "static")
    answer = static.page(Request({"type": "http", "path": "/", "raw_path": b"/", "headers": []}))
    (script,) = re.findall(rb"<script>(.*?)</script>", bytes(answer.body), re.DOTALL)
    source = f" 'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
    assert answer.headers["content-security-policy"].replace(source, "") == CONTENT_SECURITY_POLICY
    for path in STATIC.glob("*.html"):
        markup = path.read_text().replace("<script>{start}</script>", "")
        assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\sstyle=|\son[a-z]+=", markup), path.name


def test_what_is_sent_is_the_same_program(tmp_path: Path) -> None:
    """Each module, printed without comments by TypeScript, before and after; markup ignores indentation."""
    compiler = package("typescript") / "lib" / "tsc.js"
    paths = []
    for path in some((path for path in SERVED if path.suffix in (".js", ".mjs")), 10):
        paths += [tmp_path / when / path.relative_to(STATIC) for when in ("before", "after")]
        for place, source in zip(paths[-2:], (path.read_bytes(), stripped(path.read_bytes(), "js")), strict=True):
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(source)
    options = ["--module", "esnext", "--target", "esnext"]
    folders = ["--rootDir", str(tmp_path), "--outDir", str(tmp_path / "out")]
    command = ["node", str(compiler), *PRINT, *options, *folders, *paths]
    subprocess.run(command, capture_output=True, check=False, timeout=60)  # it misses all types, and prints
    for before, after in zip(paths[::2], paths[1::2], strict=True):
        printed = [(tmp_path / "out" / one.relative_to(tmp_path)).read_text() for one in (before, after)]
        assert re.sub(r"(?m)^\s+", "", printed[0]) == re.sub(r"(?m)^\s+", "", printed[1])
