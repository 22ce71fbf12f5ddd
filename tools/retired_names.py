"""Finds identifiers with a retired word, and docstrings that are no sentence: ``python tools/retired_names.py``.

It checks each word of the identifiers in tracked Python files, and names the standard term; comments and other strings
are not checked. A docstring that begins with a preposition, as in "Of what is sent.", has no subject.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

#: A word of an identifier (a regular expression, in lower case), and the term to use instead.
RETIRED = {
    "kept": "retained",
    "fabric": "local_transport, network",
    "bells?": "wakeup",
    "news": "announcer_pipe, messages",
    "roster": "peer_registry",
    "seats?": "presence_lock",
    "ledger": "in_flight",
    "tickets?": "pending_ack",
    "onlookers?|witness|observers?": "subscriber",
    "sightings?": "discovered_robot",
    "verdicts?": "result, assessment",
    "thrift": "rate_control",
    "clerk": "worker",
    "keepers?": "supervisor",
    "agreement": "reconciliation",
    "chatter": "device_log",
    "parked": "pending",
    "unwant": "release",
    "told|tells?|telling": "notified, notify",
    "hears?|heard|hearing": "received, receive",
    "says?|said|saying": "published, publish, report, log, message",
    "beats?|hearts?": "heartbeat",
    "fares?": "health, status",
    "settles?|settled|settling": "the one meant: acknowledged, synchronised, ready, quiet",
    "echoes": "loopback_filter, own messages",
    "whoever|somebody|nobody|anybody": "a name of what it is",
}
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_FRAGMENT = re.compile(r"(As|For|In|Of|With) [a-z`]")
_BEGINS_SO = re.compile(rf"""["']\\?\s*{_FRAGMENT.pattern}""")
#: Comments, strings and numbers, or a name, which is the group. The tokenizer of the library takes ten times as long.
_LEXEMES = re.compile(
    r"""\#[^\n]*
    | (?i:[bfru]{0,2}) (?: \"""(?:\\.|[^\\])*?\""" | '''(?:\\.|[^\\])*?''' | "(?:\\.|[^"\\\n])*" | '(?:\\.|[^'\\\n])*' )
    | \d\w*
    | ([^\W\d]\w*)""",
    re.DOTALL | re.VERBOSE,
)
_PATTERNS = {re.compile(pattern): instead for pattern, instead in RETIRED.items()}


@cache
def retired(identifier: str) -> str | None:
    """The replacement for the retired word in ``identifier``; None if it has none."""
    for word in _WORDS.findall(identifier):
        for pattern, instead in _PATTERNS.items():
            if pattern.fullmatch(word.lower()):
                return instead
    return None


def identifiers(source: str) -> Iterator[tuple[int, str]]:
    """Line number and text of every name in a Python source."""
    line, counted = 1, 0
    for found in _LEXEMES.finditer(source):
        if found[1]:
            line, counted = line + source.count("\n", counted, found.start()), found.start()
            yield line, found[1]


def fragments(source: str) -> Iterator[tuple[int, str]]:
    """Line number and first line of every docstring that begins with a preposition."""
    for node in ast.walk(ast.parse(source)) if _BEGINS_SO.search(source) else ():
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node) or ""
            if _FRAGMENT.match(text):
                yield node.body[0].lineno, text.splitlines()[0]


def main() -> int:
    files = subprocess.run(["git", "ls-files", "*.py"], capture_output=True, text=True, check=True).stdout.splitlines()
    found = 0
    for path in map(Path, files):
        if path.is_symlink() or not path.is_file():
            continue
        source = path.read_text()
        for line, name in identifiers(source):
            if instead := retired(name):
                found += 1
                print(f"{path}:{line}: {name} is retired; use {instead}")
        for line, text in fragments(source):
            found += 1
            print(f'{path}:{line}: "{text}" is no sentence; begin with its subject')
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
