"""The pure parts of the firmware, compiled as for a board, inside the real MicroPython: the tests of `pure/` again."""

from __future__ import annotations

import ast
import json
import shutil
from pathlib import Path

import pytest

from tests.firmware.micropython import SCRIPTS, compile_all, run
from tests.support import ROOT

pytestmark = pytest.mark.computing

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
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], str]:
    """Each test's traceback, "" for those that pass."""
    root = compile_all(tmp_path_factory.mktemp("firmware"))
    for file in PURE.glob("test_*.py"):
        shutil.copy(file, root)
    (root / "vectors").mkdir()
    shutil.copy(ROOT / "tests" / "vectors" / "commands.json", root / "vectors")
    (root / "modules.json").write_text(json.dumps([file.stem for file in PURE.glob("test_*.py")]))
    done = run(root, SCRIPTS / "run_tests.py")
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('["test_')]
    return {(module, test): error for module, test, error in lines}


@pytest.mark.parametrize(("module", "name"), functions())
def test_in_micropython(module: str, name: str, outcomes: dict[tuple[str, str], str]) -> None:
    assert (module, name) in outcomes, f"MicroPython did not run it: {outcomes}"
    assert outcomes[module, name] == "", f"in MicroPython:\n{outcomes[module, name]}"
