"""Shows how much product and tests have grown: ``python tools/tree_growth.py [REVISION]``.

Tests may grow as fast as the product, not faster. Lines of tracked Python, JavaScript and style sheets are counted.
"""

from __future__ import annotations

import subprocess
import sys

COUNTED = ("*.py", "*.js", "*.mjs", "*.css")
#: Until there is a release: where tests had last grown faster than the product.
SINCE = "0d69cb2"
_TESTS = ("tests/", "tools/")


def git(*words: str) -> str:
    return subprocess.run(["git", *words], capture_output=True, text=True, check=True).stdout


def growth(since: str) -> tuple[int, int]:
    """Lines of the product and of tests that were added, less those removed, in the working tree."""
    product = tests = 0
    for row in git("diff", "--numstat", "--no-renames", since, "--", *COUNTED).splitlines():
        added, removed, path = row.split("\t", 2)
        if added == "-" or "/vendor/" in path:
            continue
        if path.startswith(_TESTS):
            tests += int(added) - int(removed)
        else:
            product += int(added) - int(removed)
    return product, tests


if __name__ == "__main__":
    revision = next(iter(sys.argv[1:]), SINCE)
    try:
        print("pebble: lines since {}: product {:+}, tests {:+}".format(revision, *growth(revision)))
    except (OSError, subprocess.CalledProcessError):
        print("pebble: growth is not known: no git, or not a whole clone")
