"""Writes bounds.md: every constant that limits what others can add, with its value and the comment beside it.

Program: ``python tools/bounds.py FOLDER``; docs/bounds.md explains the rule.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
_FOLDERS = ("pebble", "transports", "services", "firmware")
_OTHERS = ("pebble/extensions/lab/", "pebble/extensions/scripts/perception/")  # nothing of strangers is counted there
_CONSTANT = re.compile(
    r"^((?:\w+, )*(?:_?(?:MAX|MOST)(?:_[A-Z_]+)?|_?(?:[A-Z]+_)*(?:LIMIT|RESERVE|WAITING|REMEMBERED|TOPICS)))"
    r"(?:: Final)? = (\(?[\w ]*\d[^#\n]*)(?:# *(?!noqa)(.*))?$",
    re.MULTILINE,
)


class Bound(NamedTuple):
    """A constant, or several in one assignment; `why` is empty if it has no comment."""

    file: str
    name: str
    value: str
    why: str


def bounds() -> Iterator[Bound]:
    """Yield the bounds of all sources, file by file."""
    for folder in _FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            file = str(path.relative_to(ROOT))
            if not file.startswith(_OTHERS):
                yield from _bounds(file, path.read_text(encoding="utf-8"))


def _bounds(file: str, text: str) -> Iterator[Bound]:
    """Yield the bounds of one file; the reason is the comment in the lines above, and the one behind the value."""
    for match in _CONSTANT.finditer(text):
        above = re.search(r"((?:^#.*\n)*)\Z", text[: match.start()], re.MULTILINE)
        lines = re.sub(r"^#:? ?", "", above[1] if above else "", flags=re.MULTILINE).split("\n")
        why = " ".join([*filter(None, lines), match[3] or ""]).strip()
        yield Bound(file, match[1], match[2].strip(), why)


def table() -> str:
    """Return the table of all bounds."""
    rows = [f"| `{bound.file}` | `{bound.name}` | `{bound.value}` | {bound.why} |" for bound in bounds()]
    return "\n".join(["# Bounds\n", "| file | constant | value | what it bounds |", "|---|---|---|---|", *rows, ""])


if __name__ == "__main__":
    (Path(sys.argv[1]) / "bounds.md").write_text(table(), encoding="utf-8")
