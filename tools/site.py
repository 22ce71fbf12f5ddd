"""Writes build/site: the documents, the output of `make docs` and the API as a static site; a broken link ends it.

Pages are those of docs/, in the order of docs/README.md. Links to other files of the repository become plain text.
"""

import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCE, SITE = ROOT / "build" / "site-source", ROOT / "build" / "site"
#: Pages beside docs/, and where they are on the site.
BESIDE = {
    "README.md": "index.md",
    "SECURITY.md": "SECURITY.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
}
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?!https?:|#)([^)#\s]+)(#[^)]*)?\)")
#: Sphinx' settings. Pages load nothing from other servers.
CONFIG = """
project = "Pebble"
html_theme = "furo"
html_title = "Pebble"
html_copy_source = html_show_sourcelink = False
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 4
myst_all_links_external = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "separated"
suppress_warnings = ["misc.highlighting_failure", "myst.header", "ref.python", "toc.not_included"]
"""
#: By the title of a page: modules, and what of each is shown; "": all that is public.
API = {
    "Scripts": {"pebble.extensions.scripts.script.robot": "", "pebble.cameras": ""},
    "Services": {"pebble.service": "", "pebble.runtime.service": "", "pebble.motors.motor_owner": ""},
    "Extensions": {"pebble.extension": "Extension, Program, Stage, Command, Facts"},
    "Transports": {"pebble.transports": "", "pebble.transports.base": ""},
    "Contract": {"pebble.contract.channels": "", "pebble.contract.payloads": ""},
}


def main() -> int:
    """Build the site; return Sphinx' exit code."""
    shutil.rmtree(SOURCE, ignore_errors=True)
    shutil.copytree(ROOT / "docs", SOURCE, ignore=shutil.ignore_patterns("README.md"))
    # By file or folder of the repository: its page.
    pages = {ROOT / "docs" / path.relative_to(SOURCE): path for path in SOURCE.rglob("*") if path.is_file()}
    pages |= {ROOT / name: SOURCE / place for name, place in BESIDE.items()}
    pages[ROOT / "docs/README.md"] = SOURCE / "reading.md"
    for name in ("decisions", "results"):
        pages[ROOT / "docs" / name / "README.md"] = SOURCE / name / "index.md"
        pages[ROOT / "docs" / name] = SOURCE / name / "index.md"
    for origin, page in pages.items():
        if page.suffix == ".md":
            text = (origin if origin.is_file() else origin / "README.md").read_text()
            page.write_text(LINK.sub(partial(_link, origin, page, pages), text))
    shutil.copytree(ROOT / "build" / "docs", SOURCE / "tables")
    for title, modules in API.items():
        page = SOURCE / "api" / f"{title.lower()}.md"
        page.parent.mkdir(exist_ok=True)
        parts = (
            f"```{{eval-rst}}\n.. automodule:: {name}\n   :members: {shown}\n```\n" for name, shown in modules.items()
        )
        page.write_text(f"# {title}\n\n" + "\n".join(parts))
    with (SOURCE / "index.md").open("a") as index:
        index.write(f"\n{_index()}")
    (SOURCE / "conf.py").write_text(CONFIG)
    shutil.rmtree(SITE, ignore_errors=True)
    command = [sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "--keep-going", str(SOURCE), str(SITE)]
    code = subprocess.run(command, check=False).returncode
    if code == 0:
        print(f"pebble: {SITE.relative_to(ROOT)}/index.html, {len(list(SITE.rglob('*.html')))} pages")
    return code


def _link(origin: Path, page: Path, pages: dict[Path, Path], link: re.Match[str]) -> str:
    """Return a link in the site's form; a link to another file becomes its text, a broken one is unchanged."""
    folder = origin if origin.is_dir() else origin.parent
    file = (folder / link[3]).resolve()  # of a link: [1] "!" of a picture, [2] text, [3] file, [4] heading
    if file not in pages:
        return link[2] if file.exists() else link[0]
    to = pages[file]
    words = _title(file) if link[2] == file.name and file.suffix == ".md" else link[2]
    return f"{link[1]}[{words}]({_relative(to, page.parent)}{link[4] or ''})"


def _title(page: Path) -> str:
    """Return the heading of a page up to a colon, as text for links."""
    heading, _, _ = page.read_text().removeprefix("# ").partition("\n")
    return heading.partition(":")[0]


def _relative(to: Path, folder: Path) -> str:
    """Return the way from ``folder`` to a file, such as ``../page.md``."""
    up = 0
    while not to.is_relative_to(folder):
        folder, up = folder.parent, up + 1
    return "../" * up + str(to.relative_to(folder))


def _index() -> str:
    """Return the tree of pages, in the order of the index and by its headings; each page once."""
    parts = [("Pebble", ["reading"])]
    seen: set[str] = set()
    for part in (SOURCE / "reading.md").read_text().split("\n**")[1:]:  # each begins with its heading, in bold
        heading, _, lines = part.partition("**")
        targets = [link[3] for link in LINK.finditer(lines)]
        links = [target.removesuffix(".md") for target in targets if target.endswith(".md")]
        parts.append((heading, [link for link in dict.fromkeys(links) if link not in seen]))
        seen.update(links)
    parts.append(("Tables", [f"tables/{page.stem}" for page in sorted((SOURCE / "tables").glob("*.md"))]))
    parts.append(("API", [f"api/{title.lower()}" for title in API]))
    return "".join(
        f"```{{toctree}}\n:hidden:\n:maxdepth: 1\n:caption: {heading}\n\n" + "\n".join(pages) + "\n```\n\n"
        for heading, pages in parts
    )


if __name__ == "__main__":
    sys.exit(main())
