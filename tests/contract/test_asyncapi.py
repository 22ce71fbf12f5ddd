"""docs/asyncapi.yaml is valid for AsyncAPI's own parser, and has every channel."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import CHANNELS, asyncapi
from pebble.contract.asyncapi import document
from pebble.contract.docs import ASYNCAPI
from pebble.contract.schemas import schemas
from tests.support import ROOT

BUNDLE = ROOT / ".venv" / "asyncapi" / "browser" / "index.js"

#: Prints the errors, and the address and action of each operation. The bundle is made for browsers.
READ = """
globalThis.self = globalThis;
const Parser = require(process.argv[1]);
new Parser().parse(require("fs").readFileSync(0, "utf8")).then(({document, diagnostics}) => {
  const errors = diagnostics.filter((one) => one.severity === 0).map((one) => `${one.path.join(".")}: ${one.message}`);
  const operations = document?.operations().all() ?? [];
  const found = operations.map((one) => [one.channels().all()[0].address(), one.action()]);
  console.log(JSON.stringify({errors, operations: found}));
});
"""


def parsed(text: str, tmp_path: Path) -> dict[str, Any]:
    if shutil.which("node") is None or not BUNDLE.exists():
        missing = pytest.fail if os.environ.get("CI") == "true" else pytest.skip
        missing("needs Node.js (apt install nodejs) and the parser (python tools/fetch_npm.py .venv asyncapi)")
    bundle = tmp_path / "parser.cjs"
    shutil.copy(BUNDLE, bundle)
    command = ["node", "-e", READ, str(bundle)]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=True, timeout=120)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_its_own_parser_takes_it_and_finds_every_channel(tmp_path: Path) -> None:
    found = parsed(document(), tmp_path)
    assert found["errors"] == []
    actions = {"incoming": "receive", "outgoing": "send"}
    levels = "{system}/{type}/{id}"
    assert found["operations"] == [[f"{levels}/{one.suffix}", actions[one.direction]] for one in CHANNELS]


@pytest.mark.thorough
def test_a_struct_that_was_renamed_is_found(tmp_path: Path) -> None:
    found = parsed(document().replace("    Drive:\n", "    Motion:\n"), tmp_path)
    assert any("Drive" in error for error in found["errors"])


def test_a_field_that_was_renamed_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The file in docs/ is not that of a contract in which one field has another name."""
    text = json.dumps(schemas())
    assert '"reset_refused"' in text
    monkeypatch.setattr(asyncapi, "schemas", lambda: json.loads(text.replace('"reset_refused"', '"reset_denied"')))
    file = ROOT / "docs" / ASYNCAPI
    assert asyncapi.document() != file.read_text()
    monkeypatch.undo()
    assert asyncapi.document() == file.read_text()
