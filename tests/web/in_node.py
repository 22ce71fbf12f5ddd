"""Modules of the page in Node.js, without a browser."""

from __future__ import annotations

import json
import select
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.support import ROOT

STATIC = ROOT / "pebble" / "web" / "static"
_EVALUATOR = Path(__file__).with_name("evaluate.mjs")
_TIMEOUT_S = 30.0


@cache
def _evaluator() -> subprocess.Popen[str]:
    """One for all tests of this process, with which it ends, since its input does."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    return subprocess.Popen(["node", str(_EVALUATOR)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def evaluate(imports: dict[str, str], steps: str, given: Any = None) -> Any:
    """The value of ``result`` after ``steps``, which see ``given``.

    ``imports``: the names that are imported, or "* as name", by the module below the page's static files. Raises
    AssertionError with the error of the steps.
    """
    lines = [
        f"import {names if names.startswith('*') else f'{{ {names} }}'} from {json.dumps((STATIC / path).as_uri())};"
        for path, names in imports.items()
    ]
    lines += ['import { parentPort as _parent } from "node:worker_threads";']
    lines += [
        f"const given = {json.dumps(given)};",
        "let result;",
        steps,
        "_parent.postMessage(JSON.stringify(result ?? null));",
    ]
    node = _evaluator()
    assert node.stdin is not None
    assert node.stdout is not None
    node.stdin.write(json.dumps({"source": "\n".join(lines), "given": given}) + "\n")
    node.stdin.flush()
    if not select.select([node.stdout], [], [], _TIMEOUT_S)[0]:
        node.kill()
        _evaluator.cache_clear()
        pytest.fail(f"no result within {_TIMEOUT_S:.0f} s")
    answer = json.loads(node.stdout.readline())
    assert "error" not in answer, answer["error"]
    return json.loads(answer["value"])
