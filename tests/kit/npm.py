"""npm's packages, which ``make`` installs as package-lock.json pins them."""

import os
from pathlib import Path

import pytest

from tests.support import ROOT

MODULES = ROOT / "node_modules"


def package(name: str) -> Path:
    """Return the folder of a package. Without it or Node.js the test is skipped, or fails in CI."""
    folder = MODULES / name
    if not (folder.exists() and (MODULES / ".bin" / "node").exists()):
        missing = pytest.fail if os.environ.get("CI") == "true" else pytest.skip
        missing(f"needs {name} and Node.js: make check installs them")
    return folder
