"""Fixtures for tests of several comparisons."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    """The folder for temporary files of the bench; short, because of Unix sockets."""
    folder = tmp_path / "t"
    folder.mkdir()
    return folder
