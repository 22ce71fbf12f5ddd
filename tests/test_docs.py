"""The hand-written documents point to things that are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support import ROOT

GENERATED = ("topics.md", "configuration.md", "web-messages.md")
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    *(path for path in sorted((ROOT / "docs").rglob("*.md")) if path.name not in GENERATED),
]
BOUNDS = ROOT / "docs" / "bounds.md"
LINK = re.compile(r"\]\((?!https?:)([^)#]+)")
#: `folder/`, `folder/file.py` or `file.py`; what begins like a topic below a robot's identity is none, and what is
#: below build/ is written by a run
CODE = re.compile(
    r"`((?!(?:incoming|outgoing|flags|sensors|mcu|by|build)/)(?:[\w.-]+/)+[\w.-]*|[\w-]+\.(?:py|md|toml|json))`"
)
OURS = ("pebble", "transports", "services", "simulation", "bench", "rig", "firmware")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    broken = [link for link in LINK.findall(document.read_text()) if not (document.parent / link).exists()]
    assert broken == []


#: A decision is left as it was written: the files it names are those of its time.
OF_TODAY = [path for path in DOCUMENTS if path.parent.name != "decisions"]


@pytest.mark.parametrize("document", OF_TODAY, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_it_names_exist(document: Path) -> None:
    missing = [name for name in CODE.findall(document.read_text()) if not _exists(name)]
    assert missing == []


#: Names of constants that limit what others can add, and tokens of docs/bounds.md such as `web/stops.py:MAX_STOPS`.
BOUND = re.compile(
    r"^((?:\w+, )*(?:_?(?:MAX|MOST)(?:_[A-Z_]+)?|_?(?:[A-Z]+_)*(?:LIMIT|RESERVE|WAITING|REMEMBERED|TOPICS)))"
    r"(?:: Final)? = \(?[\w ]*\d",
    re.MULTILINE,
)
TOKEN = re.compile(r"`([\w/.-]+\.(?:py|js)):([\w,]+)`")
LISTED = [(path, name) for path, names in TOKEN.findall(BOUNDS.read_text()) for name in names.split(",")]


def test_the_table_of_bounds_names_each() -> None:
    sources = [path for folder in OURS for path in (ROOT / folder).rglob("*.py")]
    shown = {path: str(path.relative_to(ROOT)).removeprefix("pebble/") for path in sources}
    others = ("demo/", "bench/", "rig/", "simulation/", "perception/")  # nothing of strangers is counted there
    found = {
        (name, constant)
        for path, name in shown.items()
        if not name.startswith(others)
        for constants in BOUND.findall(path.read_text())
        for constant in constants.split(", ")
    }
    assert found - set(LISTED) == set(), "add a row to docs/bounds.md"


def test_the_table_of_bounds_names_nothing_else() -> None:
    def defines(path: str, name: str) -> bool:
        file = ROOT / path if path.startswith("firmware/") else ROOT / "pebble" / path
        return bool(re.search(rf"^(?:export )?(?:const )?(?:\w+, )*{name}\b", file.read_text(), re.MULTILINE))

    assert [one for one in LISTED if not defines(*one)] == []


def _exists(name: str) -> bool:
    """A path from the top, or the name of a file somewhere in the sources."""
    return (ROOT / name).exists() or any(any((ROOT / folder).rglob(name)) for folder in OURS)
