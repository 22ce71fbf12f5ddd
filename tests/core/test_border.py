"""The core knows no extension: it imports nothing of what `OURS` names, and none of its texts names it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import grimp
import pytest

from pebble.extension import OURS
from tests.support import ROOT

DECLARE = {"pebble.extension", "pebble.public_names"}  # these hold the names, to find what is installed


def is_ours(module: str) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in OURS)


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("pebble", exclude_type_checking_imports=True)


def test_no_import_leaves_the_core(graph: grimp.ImportGraph) -> None:
    leaving = [
        f"{module} -> {imported}"
        for module in graph.modules
        if not is_ours(module)
        for imported in graph.find_modules_directly_imported_by(module)
        if is_ours(imported)
    ]
    assert leaving == []


def test_every_extension_is_named_in_ours(graph: grimp.ImportGraph) -> None:
    assert [name for name in graph.find_children("pebble.extensions") if name not in OURS] == []


def texts(path: Path) -> Iterator[str]:
    """Yield all texts but those that document."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    documentation = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documentation:
            yield node.value


def test_no_text_of_the_core_names_a_module_of_an_extension(graph: grimp.ImportGraph) -> None:
    named = []
    for module in sorted(graph.modules - DECLARE):
        place = ROOT / module.replace(".", "/")
        path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if not is_ours(module):
            named += [(module, text) for text in texts(path) if any(is_ours(word) for word in text.split())]
    assert named == []
