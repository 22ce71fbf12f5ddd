"""Fixtures for tests of several comparisons."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def temporary() -> Iterator[Path]:
    """The folder for temporary files of the bench; short, because of Unix sockets: it would take another one."""
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        yield Path(folder)
