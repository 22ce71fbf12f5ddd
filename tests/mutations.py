"""Deliberate bugs in the product, each with the tests that must find it: is what tests prove still proved?

``python -m tests.forwarding.mutations [WORDS]``, and the same of ``tests.transports``, ``tests.client`` and
``tests.recordings.recorder``, put each bug, or those with these words, into a copy of the tree. One is found if a test
of its fails.
"""

# ruff: noqa: T201  (a program)

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from tests.support import ROOT

_LEFT_OUT = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache")


class Mutation(NamedTuple):
    """``old``, which occurs once in ``file``, is replaced by ``new``; ``tests``: files, and words for pytest's -k."""

    bug: str
    tests: str
    file: str
    old: str
    new: str


def parsed(text: str) -> list[Mutation]:
    """Mutations from blocks of lines: the bug and its tests, the file, what goes (-), and what comes (+)."""
    found = []
    for block in text.strip("\n").split("\n\n"):
        title, file, *changed = block.splitlines()
        bug, _, tests = title.partition(": ")
        old, new = ("\n".join(line[2:] for line in changed if line[0] == sign) for sign in "-+")
        found.append(Mutation(bug, tests, file, old, new))
    return found


def found_by(mutation: Mutation, tree: Path, tests: str) -> str:
    """The first test below ``tests`` that fails in ``tree``, a copy, with this bug; empty if none does."""
    file = tree / mutation.file
    text = file.read_text()
    assert text.count(mutation.old) == 1, f"{mutation.file} has changed: {mutation.bug}"
    file.write_text(text.replace(mutation.old, mutation.new))
    first, *more = mutation.tests.split(" -k ")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    command += ["-m", "not thorough", *(f"{tests}/{path}" for path in first.split())]
    command += [word for words in more for word in ("-k", words)]
    ran = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    file.write_text(text)
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", ran.stdout, re.MULTILINE)
    assert failed or ran.returncode == 0, ran.stdout[-2000:] + ran.stderr
    return failed[1] if failed else ""


def main(mutations: str, tests: str) -> int:
    """Try those whose bug has all words of the command line; returns how many no test has found."""
    chosen = [one for one in parsed(mutations) if all(word in one.bug for word in sys.argv[1:])]
    missed = 0
    with tempfile.TemporaryDirectory(prefix="pbl") as folder:
        tree = Path(folder, "tree")
        shutil.copytree(ROOT, tree, symlinks=True, ignore=_LEFT_OUT)
        for mutation in chosen:
            found = found_by(mutation, tree, tests)
            missed += not found
            print(f"{mutation.bug}: {f'found by {found}' if found else 'NOT FOUND'}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} found")
    return missed
