"""Finds docstrings whose first line leaves open whether the thing returns, is or does something.

Program: ``python tools/docstrings.py [PATH…]``; the whole product without paths. A function's first line begins with a
verb ("Return the rank of …"), a bool's with "True if", a class's and a module's with a noun ("A table of …"); a
property may have either.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_RIDDLE = re.compile(
    r"(What|Whatever|Whether|Who|Whom|Whose|Which|How|Where|When|Why|It|Those|One (that|of|which)|That (of|which))\b"
    r"|.*\b(of which|anew)\b"
)
_NOUN = re.compile(r"(The|A|An)\b")


def findings(path: Path) -> Iterator[str]:
    """Yield one line for each docstring of a file that has such a first line."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = (ast.get_docstring(node) or "").partition("\n")[0]
            if _RIDDLE.match(first) or (_is_plain_function(node) and _NOUN.match(first)):
                yield f"{path}:{getattr(node, 'lineno', 1)}: {first}"


def _is_plain_function(node: ast.AST) -> bool:
    """True if the node is a function and no property."""
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not any(
        ast.unparse(decorator).endswith(("property", ".setter")) for decorator in node.decorator_list
    )


def _product() -> list[Path]:
    """Return the tracked Python files that are no tests."""
    listed = subprocess.check_output(["git", "-C", str(ROOT), "ls-files", "*.py"], text=True).splitlines()
    return [ROOT / name for name in listed if not name.startswith("tests/") and not (ROOT / name).is_symlink()]


def main(arguments: list[str]) -> int:
    """Print the findings; return 1 if there are any."""
    files = [] if arguments else _product()
    for path in map(Path, arguments):
        files += [path] if path.is_file() else path.rglob("*.py")
    lines = [line for path in files for line in findings(path)]
    print(*lines, sep="\n", end="\n" if lines else "")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
