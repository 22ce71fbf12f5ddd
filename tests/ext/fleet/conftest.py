"""Passwords that cost no time, for tests of everything else."""

from __future__ import annotations

import hashlib

import pytest


@pytest.fixture
def cheap_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    real = hashlib.scrypt
    monkeypatch.setattr(hashlib, "scrypt", lambda *given, **options: real(*given, **{**options, "n": 2}))
