"""The types of the page's modules: a field that the server renames is an error where the page reads it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.kit.npm import package
from tests.support import ROOT

pytestmark = pytest.mark.computing

PROJECT = Path(__file__).parent / "tsconfig.json"


def complaints(project: Path) -> list[str]:
    """What the compiler says of our own files; vendored ones are minified, and have no types."""
    compiler = package("typescript") / "lib" / "tsc.js"
    command = ["node", str(compiler), "-p", str(project), "--pretty", "false"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    return [line for line in done.stdout.splitlines() if "error TS" in line and "/vendor/" not in line]


def test_the_page_is_typed_and_a_field_that_the_server_does_not_have_is_noticed(tmp_path: Path):
    core = ROOT / "pebble/extensions/page/static/core/store.js"
    wrong = tmp_path / "wrong.js"
    wrong.write_text(f'import {{ Store }} from "{core}";\nnew Store().get("", "web/broker")?.value.is_connected;\n')
    settings = PROJECT.read_text().replace("../../", f"{ROOT}/").replace('"include": [', f'"include": ["{wrong}", ')
    project = tmp_path / "tsconfig.json"
    project.write_text(settings)
    (line,) = complaints(project)
    assert "'is_connected' does not exist on type 'BrokerView'" in line
