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


def _exists(name: str) -> bool:
    """A path from the top, or the name of a file somewhere in the sources."""
    return (ROOT / name).exists() or any(any((ROOT / folder).rglob(name)) for folder in OURS)
