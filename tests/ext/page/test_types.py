"""The types of the page's modules: a field that the server renames is an error where the page reads it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.kit.npm import package

pytestmark = pytest.mark.computing


def test_the_page_is_typed() -> None:
    """Vendored files are minified, and have no types."""
    compiler, project = package("typescript") / "lib" / "tsc.js", Path(__file__).parent / "tsconfig.json"
    command = ["node", str(compiler), "-p", str(project), "--pretty", "false"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert [line for line in done.stdout.splitlines() if "error TS" in line and "/vendor/" not in line] == []
    assert done.stderr == ""
