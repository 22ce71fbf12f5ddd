"""Modules of the page in Node.js, without a browser: once, or for each row of a table."""

from __future__ import annotations

import json
import select
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest

from tests.support import ROOT

STATIC = ROOT / "pebble/extensions/page/static"
#: What is done, and the value of ``result`` after it, by what that shows.
Rows = Mapping[str, tuple[str, Any]]
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
    lines = ['import { parentPort as _parent } from "node:worker_threads";']
    lines += [_imported(path, names) for path, names in imports.items()]
    lines += [
        f"const given = {json.dumps(given)};",
        "let result;",
        steps,
        "_parent.postMessage(JSON.stringify(result ?? null));",
    ]
    node = _evaluator()
    assert node.stdin is not None
    assert node.stdout is not None
    node.stdin.write(json.dumps("\n".join(lines)) + "\n")
    node.stdin.flush()
    if not select.select([node.stdout], [], [], _TIMEOUT_S)[0]:
        node.kill()
        _evaluator.cache_clear()
        pytest.fail(f"no result within {_TIMEOUT_S:.0f} s")
    answer = json.loads(node.stdout.readline())
    assert "error" not in answer, answer["error"]
    return json.loads(answer["value"])


def _imported(path: str, names: str, query: str = "") -> str:
    to = names.removeprefix("* as ") if names.startswith("*") else f"{{ {names} }}"
    return f"const {to} = await import({json.dumps((STATIC / path).as_uri() + query)});"


@dataclass(frozen=True)
class Script:
    """Rows that have the same modules and the same steps ``before`` theirs; ``after`` may give ``result`` its value.

    ``anew``: the modules keep a state, and are new for each row.
    """

    imports: dict[str, str]
    before: str = ""
    after: str = ""
    anew: bool = False

    def results(self, table: Rows) -> list[Callable[[], Any]]:
        """Return what each row leads to. The first that is asked for runs all in one thread: to start it takes long."""

        @cache
        def answers() -> list[dict[str, Any]]:
            functions = [self._function(steps, f"?row={n}" * self.anew) for n, (steps, _) in enumerate(table.values())]
            found: list[dict[str, Any]] = evaluate({}, f"const rows = [{', '.join(functions)}];\n{_EACH}")
            return found

        def result(number: int) -> Any:
            answer = answers()[number]
            assert "error" not in answer, answer["error"]
            return answer.get("value")

        return [partial(result, number) for number in range(len(table))]

    def _function(self, steps: str, query: str) -> str:
        imports = "\n".join(_imported(path, names, query) for path, names in self.imports.items())
        body = f"{imports}\nlet result;\n{self.before}{steps}\n{self.after}"
        return f"async () => {{ {body}\nreturn {{ value: result }}; }}"


_EACH = """result = [];
for (const row of rows) {
  process.removeAllListeners("uncaughtException");
  result.push(await row().catch((error) => ({ error: String(error?.stack ?? error) })));
}"""


def rows(*tables: tuple[Script, Rows]) -> pytest.MarkDecorator:
    """Tests each row of some tables: ``found()`` is what its steps lead to."""
    return pytest.mark.parametrize(
        ("found", "expected"),
        [
            pytest.param(found, expected, id=name)
            for script, table in tables
            for (name, (_, expected)), found in zip(table.items(), script.results(table), strict=True)
        ],
    )
