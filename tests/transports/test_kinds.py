"""Transports are found by kind: ours by name, a third party's through its entry point."""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from pebble.errors import TransportError
from pebble.transports import GROUP, State, create
from pebble.transports.memory import MemoryHub, MemoryTransport


class TheirTransport(MemoryTransport):
    """A transport as a third party's package would define it."""


def install(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    points = EntryPoints([EntryPoint(name="theirs", value=value, group=GROUP)])
    monkeypatch.setattr("importlib.metadata.entry_points", points.select)


def test_a_third_party_registers_through_an_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "tests.transports.test_kinds:TheirTransport")
    with create("theirs", "client", MemoryHub()) as transport:
        assert type(transport).__name__ == "TheirTransport"
        assert transport.state is State.CONNECTED


def test_an_unknown_kind_names_the_known_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "tests.transports.test_kinds:TheirTransport")
    with pytest.raises(TransportError, match='no transport "carrier-pigeon": known are ') as refused:
        create("carrier-pigeon", "client", None)
    assert {"memory", "mqtt", "theirs", "zenoh"} <= set(str(refused.value).partition("known are ")[2].split(", "))


def not_a_transport(client_id: str, settings: object, *, will: object) -> str:
    return client_id


def test_what_is_not_a_transport_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "tests.transports.test_kinds:not_a_transport")
    with pytest.raises(TransportError, match="is not a pebble"):
        create("theirs", "client", None)
