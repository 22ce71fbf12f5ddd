"""The page's vendored files are those of npm's packages, and nothing else is among them."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import pytest

from tests.kit.npm import package
from tests.support import ROOT

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
    assert {path.name for path in VENDOR.iterdir()} == {entry["file"] for entry in ENTRIES} | {
        "vendor.json",
        "LICENSES",
    }
