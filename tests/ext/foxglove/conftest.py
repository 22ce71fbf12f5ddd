"""Requests are withdrawn soon after the last client has left."""

import pytest

from pebble.extensions.operator.client.media_request import shared


@pytest.fixture(autouse=True)
def _short_linger(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "LINGER_S", 0.4)
