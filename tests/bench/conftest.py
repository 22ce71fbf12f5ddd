"""What tests of several comparisons share."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    """Where the bench makes its folders; short, because of unix sockets."""
    folder = tmp_path / "t"
    folder.mkdir()
    return folder
