"""Tests of what a broker does with the small messages of an account."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.extensions.checks.broker import account
from pebble.extensions.checks.broker.account import robot_account
from pebble.transports.settings import MqttSettings
from tests.support import Broker

ACCEPTED = ("b", "accepts what this account publishes")


@pytest.mark.parametrize(
    ("matters_s", "more"), [(account._MATTERS_S, []), (0.0, [("small messages at b", "are passed on at once")])]
)
def test_small_messages_are_judged_where_a_round_trip_matters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, matters_s: float, more: list[tuple[str, str]]
) -> None:
    monkeypatch.setattr(account, "_MATTERS_S", matters_s)
    broker = Broker(tmp_path, "set_tcp_nodelay true")
    settings = MqttSettings(host="127.0.0.1", port=broker.port)
    found = [(result.what, result.text) for result in robot_account("b", settings, "pebble/robots/goob")]
    broker.stop()
    assert found == [ACCEPTED, *more]
