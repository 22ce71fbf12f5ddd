"""Counts what a tree of this project consists of, at one revision or side by side at several.

``python tools/tree_stats.py [REVISION …]``, by default the first commit before the folders were rearranged, and HEAD.
Counted are tracked Python files of the product: everything but tests and tools; then what tests, pages and documents
consist of.
"""

from __future__ import annotations

import ast
import io
import posixpath
import re
import statistics
import subprocess
import sys
import tarfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import PurePosixPath

from retired_names import fragments, identifiers, retired

BEFORE = "456f31d"
SMALL = 40  # lines
#: Folders inside `pebble/` that only people's machines need; everything else runs on a robot or on its MCU.
OFF_ROBOT = ("bench", "client", "commands", "demo", "doctor", "flash", "impair", "rig", "simulation")
#: Top-level folders that are imported as parts of the package (docs/decisions/0002).
LINKED = ("bench", "rig", "services", "simulation", "transports")
MANY = 15  # attributes of one class
#: Methods of named tuples and :func:`os._exit`, which are public in spite of their names.
PUBLIC = {"_asdict", "_exit", "_fields", "_make", "_replace"}
_JS_IMPORT = re.compile(r"""(?:from|import|import\()\s*["'](\.[^"']+\.js)["']""")


class Tree:
    """The product's Python files at one revision, by module name."""

    def __init__(self, revision: str) -> None:
        archive = subprocess.run(["git", "archive", revision], capture_output=True, check=True).stdout
        self.product: dict[str, str] = {}
        self.all: dict[str, str] = {}
        self.scripts: dict[str, str] = {}  # modules of the page
        self.words = 0  # in documents
        self.folders: Counter[str] = Counter()
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            for member in files:
                suffix = PurePosixPath(member.name).suffix
                if not member.isfile() or suffix not in (".py", ".js", ".md"):
                    continue
                source = (files.extractfile(member) or io.BytesIO()).read().decode()
                is_product = not member.name.startswith(("tests/", "tools/"))
                if suffix == ".py":
                    self.all[member.name] = source
                if suffix == ".py" and is_product:
                    self.product[member.name] = source
                if suffix == ".js" and is_product and "vendor" not in member.name:
                    self.scripts[member.name] = source
                if suffix == ".md" and member.name.startswith(("docs/", "README", "CHANGELOG")):
                    self.words += len(source.split())
                if suffix != ".md" and is_product:
                    self.folders[str(PurePosixPath(member.name).parent)] += 1
        self.parsed = {path: ast.parse(source) for path, source in self.product.items()}
        self.modules = {_module(path): path for path in self.product}

    def imports(self) -> dict[str, set[str]]:
        """Which modules of the product each of them imports."""
        found: dict[str, set[str]] = {}
        for path, tree in self.parsed.items():
            names = set(_imported(tree, self.modules)) & self.modules.keys()
            found[_module(path)] = names - {_module(path)}
        return found

    def page_imports(self) -> dict[str, set[str]]:
        """Which modules of the page each of them imports, at once or later."""
        return {
            path: {posixpath.normpath(posixpath.join(posixpath.dirname(path), to)) for to in _JS_IMPORT.findall(source)}
            for path, source in self.scripts.items()
        }

    def private_uses(self) -> int:
        """How many times tests name what begins with an underscore in something that is not theirs."""
        tests = (ast.parse(source) for path, source in self.all.items() if path.startswith("tests/"))
        return sum(_is_private_use(node) for tree in tests for node in ast.walk(tree))


def _is_private_use(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Attribute)
        and node.attr.startswith("_")
        and not node.attr.startswith("__")
        and node.attr not in PUBLIC
        and not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"))
    )


def _module(path: str) -> str:
    parts = PurePosixPath(path).with_suffix("").parts
    if parts[0] in LINKED:
        parts = ("pebble", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(tree: ast.Module, modules: dict[str, str]) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for name in node.names:
                whole = f"{node.module}.{name.name}"
                yield whole if whole in modules else node.module


def _lines(source: str) -> int:
    return len(source.splitlines())


def _attributes(node: ast.ClassDef) -> int:
    """How many attributes the methods of a class assign to ``self``."""
    return len(
        {
            target.attr
            for target in ast.walk(node)
            if isinstance(target, ast.Attribute)
            and isinstance(target.ctx, ast.Store)
            and isinstance(target.value, ast.Name)
            and target.value.id == "self"
        }
    )


def _on_robot(path: str) -> bool:
    parts = PurePosixPath(path).parts
    return (parts[1] if parts[0] == "pebble" else parts[0]) not in OFF_ROBOT


def _is_bench(path: str) -> bool:
    return path.startswith(("bench/", "pebble/bench/", "pebble/impair/"))


def _circles(imports: dict[str, set[str]]) -> int:
    """How many groups of modules import each other in a circle, a package's own ``__init__`` left out."""
    reach: dict[str, set[str]] = {}
    for start in imports:
        seen: set[str] = set()
        waiting = list(imports[start])
        while waiting:
            module = waiting.pop()
            if module not in seen:
                seen.add(module)
                waiting += imports.get(module, ())
        reach[start] = seen
    groups = {
        frozenset(m for m in reach if start in reach[m] and m in reach[start])
        for start in reach
        if start in reach[start]
    }
    return len(groups)


def statistics_of(revision: str) -> dict[str, str]:
    """The rows of the table for one revision."""
    tree = Tree(revision)
    lines = {path: _lines(source) for path, source in tree.product.items()}
    total = sum(lines.values())
    imports = tree.imports()
    importers = Counter(target for targets in imports.values() for target in targets)
    attributes = {
        f"{path}:{node.name}": _attributes(node)
        for path, parsed in tree.parsed.items()
        for node in ast.walk(parsed)
        if isinstance(node, ast.ClassDef)
    }
    functions = [
        (node.end_lineno or node.lineno) - node.lineno + 1
        for parsed in tree.parsed.values()
        for node in ast.walk(parsed)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    names: dict[str, int] = defaultdict(int)
    for source in tree.all.values():
        for _, name in identifiers(source):
            if retired(name):
                names[name] += 1
    tests = sum(_lines(source) for path, source in tree.all.items() if path.startswith("tests/"))
    folder, files = tree.folders.most_common(1)[0]
    other, other_files = next((f, n) for f, n in tree.folders.most_common() if not _is_bench(f + "/"))
    largest = max(attributes, key=attributes.__getitem__)
    class_ = largest.partition(":")[2]
    busiest = max(imports, key=lambda module: len(imports[module]))
    return {
        "product files": str(len(tree.product)),
        "product lines": str(total),
        "lines outside bench": str(sum(n for path, n in lines.items() if not _is_bench(path))),
        "share that runs on a robot": f"{sum(n for path, n in lines.items() if _on_robot(path)) / total:.0%}",
        f"files of {SMALL} lines or fewer": str(sum(n <= SMALL for n in lines.values())),
        "modules with one importer": str(sum(importers[module] == 1 for module in tree.modules)),
        "largest folder": f"{folder} {files}",
        "largest folder but bench": f"{other} {other_files}",
        "most attributes in one class": f"{class_} {attributes[largest]}",
        "most project imports in one module": f"{busiest} {len(imports[busiest])}",
        f"classes with more than {MANY} attributes": str(sum(n > MANY for n in attributes.values())),
        "import circles": str(_circles(imports)),
        "import circles of the page": str(_circles(tree.page_imports())),
        "median function, lines": f"{statistics.median(functions):.0f}",
        "longest function, lines": str(max(functions)),
        "retired identifiers, tests included": f"{len(names)} ({sum(names.values())} places)",
        "docstrings that are fragments": str(sum(len(list(fragments(source))) for source in tree.all.values())),
        "lines of tests": str(tests),
        "private uses in tests": str(tree.private_uses()),
        "words in documents": str(tree.words),
    }


def main(revisions: list[str]) -> None:
    columns = [(revision, statistics_of(revision)) for revision in revisions]
    width = max(len(row) for row in columns[0][1])
    widths = [max(len(revision), *map(len, rows.values())) for revision, rows in columns]
    print(" " * width, *(f"{revision:>{w}}" for (revision, _), w in zip(columns, widths, strict=True)), sep="  ")
    for row in columns[0][1]:
        print(f"{row:{width}}", *(f"{rows[row]:>{w}}" for (_, rows), w in zip(columns, widths, strict=True)), sep="  ")


if __name__ == "__main__":
    main(sys.argv[1:] or [BEFORE, "HEAD"])
