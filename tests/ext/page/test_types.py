"""The files of the page: its types and messages are those of the server, and vendored ones are npm's."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.kit.npm import package
from tests.support import ROOT
from tools import messages_docs

pytestmark = pytest.mark.computing
VENDOR = ROOT / "pebble/extensions/page/static/vendor"
ENTRIES: list[dict[str, Any]] = json.loads((VENDOR / "vendor.json").read_text())


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry["file"])
def test_a_file_is_that_of_the_package(entry: dict[str, Any]) -> None:
    """To update one: ``npm install --save-dev --save-exact NAME@VERSION``, then copy the file and adapt vendor.json."""
    content = (VENDOR / entry["file"]).read_bytes()
    assert hashlib.sha256(content).hexdigest() == entry["sha256"]
    locked = json.loads((ROOT / "package-lock.json").read_text())["packages"][f"node_modules/{entry['name']}"]
    assert (locked["version"], locked["integrity"]) == (entry["version"], entry["integrity"])
    if "made" not in entry:  # browsers resolve no bare imports, and the page's policy forbids an import map
        origin = (package(entry["name"]) / entry["path"]).read_bytes()
        assert content == origin.replace(b'from"preact"', b'from"./preact.mjs"')
    assert f"{entry['name']} {entry['version']} ({entry['licence']})" in (VENDOR / "LICENSES").read_text()
    assert entry["integrity"].startswith("sha512-")


def test_there_is_no_other_file() -> None:
    known = {"vendor.json", "LICENSES", *(entry["file"] for entry in ENTRIES)}
    assert {path.name for path in VENDOR.iterdir()} == known


def test_the_page_is_typed() -> None:
    """Vendored files are minified, and have no types."""
    compiler, project = package("typescript") / "lib" / "tsc.js", Path(__file__).parent / "tsconfig.json"
    command = ["node", str(compiler), "-p", str(project), "--pretty", "false"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert [line for line in done.stdout.splitlines() if "error TS" in line and "/vendor/" not in line] == []
    assert done.stderr == ""


def test_the_declarations_are_current() -> None:
    assert messages_docs.DECLARATIONS.read_text() == messages_docs.declarations()
