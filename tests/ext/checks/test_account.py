"""What a broker does with the messages of an account: small and large ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.extensions.checks.broker import account
from pebble.extensions.checks.broker.account import robot_account
from pebble.extensions.checks.broker.login import broker as login
from pebble.transports.settings import MqttSettings, TlsSettings
from tests.sparing_broker import SparingBroker
from tests.support import ROOT, Broker
from tests.tcp_proxy import Hole

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


@pytest.mark.parametrize("loses_large", [False, True])
def test_a_way_that_loses_large_packets_is_named(tmp_path: Path, loses_large: bool) -> None:
    broker = Broker(tmp_path)
    way = SparingBroker(broker.port, longest=1500 if loses_large else 1 << 28)
    settings = MqttSettings(host="127.0.0.1", port=way.port)
    accepts, *more = [result.text for result in robot_account("b", settings, "pebble/robots/goob")]
    way.close()
    broker.stop()
    assert accepts == ACCEPTED[1]
    assert ["seems to lose large packets" in text for text in more] == [True] * loses_large


def test_a_way_that_loses_a_certificate_is_named(tmp_path: Path) -> None:
    files = ROOT / "tests" / "data" / "tls"
    options = (f"cafile {files}/ca.crt", f"certfile {files}/server.crt", f"keyfile {files}/server.key")
    broker = Broker(tmp_path, *options)
    with Hole(broker.port) as way:
        way.limit = 500
        settings = MqttSettings(host="localhost", port=way.port, tls=TlsSettings(ca_cert=files / "ca.crt"))
        (result,) = login("b", settings, answer_s=0.4)
    broker.stop()
    assert "seems to lose large packets" in result.text
