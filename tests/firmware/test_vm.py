"""The pure parts of the firmware, compiled as for a board, inside the real MicroPython: the tests of `pure/` again."""

from __future__ import annotations

import ast
import functools
import json
import shutil
from pathlib import Path

import pytest

from tests.firmware.micropython import SCRIPTS, compile_all, run
from tests.support import ROOT

PURE = Path(__file__).parent / "pure"


def functions() -> list[tuple[str, str]]:
    """(file, test) of every test in pure/."""
    found = []
    for file in sorted(PURE.glob("test_*.py")):
        tree = ast.parse(file.read_text(), file.name)
        names = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
        found += [(file.stem, name) for name in names if name.startswith("test_")]
    return found


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compile_all(tmp_path_factory.mktemp("firmware"))


@functools.cache
def outcome(module: str, firmware: Path) -> dict[str, str]:
    """Each test's traceback, "" for those that pass; the interpreter is started once per file."""
    root = firmware.parent / module
    shutil.copytree(firmware, root)
    shutil.copy(PURE / f"{module}.py", root)
    (root / "vectors").mkdir()
    shutil.copy(ROOT / "tests" / "vectors" / "commands.json", root / "vectors")
    (root / "module.txt").write_text(module)
    done = run(root, SCRIPTS / "run_tests.py")
    assert done.returncode == 0, done.stdout + done.stderr
    return dict(json.loads(line) for line in done.stdout.splitlines() if line.startswith('["test_'))


@pytest.mark.parametrize(("module", "name"), functions())
def test_in_micropython(module: str, name: str, firmware: Path) -> None:
    results = outcome(module, firmware)
    assert name in results, f"MicroPython did not run it: {results}"
    assert results[name] == "", f"in MicroPython:\n{results[name]}"
