"""The page's vendored files are those of npm's packages, and nothing else is among them."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from tests.support import ROOT

sys.path.insert(0, str(ROOT / "tools"))
import fetch_vendor  # type: ignore[import-not-found]

VENDOR = ROOT / "pebble" / "web" / "static" / "vendor"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    for path in VENDOR.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def test_every_file_is_that_of_the_list() -> None:
    assert fetch_vendor.problems() == []


def test_a_changed_file_is_noticed(folder: Path) -> None:
    (folder / "htm.mjs").write_text("export default 1;")
    assert fetch_vendor.problems(folder) == ["htm.mjs is not the file of vendor.json"]


def test_a_missing_and_an_unlisted_file_are_noticed(folder: Path) -> None:
    (folder / "hooks.mjs").rename(folder / "other.mjs")
    assert fetch_vendor.problems(folder) == ["hooks.mjs is missing", "other.mjs is not in vendor.json"]


def test_browsers_can_resolve_every_import() -> None:
    for path in VENDOR.glob("*.mjs"):
        assert all(name.startswith("./") for name in re.findall(r"""from ?["']([^"'\s]+)["']""", path.read_text())), (
            path.name
        )


def test_one_preact_is_used_by_all() -> None:
    """Hooks of a second copy would not work."""
    hooks = (VENDOR / "hooks.mjs").read_text()
    assert "./preact.mjs" in hooks
    assert len({entry["version"] for entry in _list() if entry["name"] == "preact"}) == 1


def test_each_package_has_its_licence() -> None:
    licences = (VENDOR / "LICENSES").read_text()
    for entry in _list():
        assert f"{entry['name']} {entry['version']} ({entry['licence']})" in licences
        assert entry["integrity"].startswith("sha512-")


def _list() -> list[dict[str, str]]:
    entries: list[dict[str, str]] = json.loads((VENDOR / "vendor.json").read_text())
    return entries
