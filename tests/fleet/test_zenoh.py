"""What each account gets through at a Zenoh hub, which knows it by its certificate: the same as at a broker.

The hub and all clients are processes of their own, with TLS; expected by hand, as in test_attempts.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import pytest
import zenoh

from pebble.fleet import applying, certificates
from pebble.fleet.folder import ZENOH, Fleet, Server, save
from pebble.fleet.roles import Account
from pebble.transports import Message, QoS, TlsSettings, ZenohSettings, create
from pebble.transports.zenoh import session as zenoh_session
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.admission import SESSIONS
from tests.fleet.test_attempts import ACCOUNTS, FRED, GOOB, TOPICS, lets_through
from tests.fleet.zenoh_account import Plan
from tests.support import free_port, until
from tests.transports.forked import Forked
from tests.transports.zenoh_net import HubProcess

NAMES = (*ACCOUNTS, "admin")
DRIVE, STATE, FLAG = f"{GOOB}/incoming/drive-values", f"{GOOB}/outgoing/status", f"{GOOB}/incoming/flags/mqtt-video"
NAMED = f"{GOOB}/incoming/by/otto/drive-values"


class Hall:
    """A fleet's folder with its Zenoh hub; ``received``: what a local program heard, by who sent it."""

    def __init__(self, folder: Path, level: Literal["login", "named"]) -> None:
        certificates.init(folder, ["127.0.0.1", "localhost"])
        accounts = {**ACCOUNTS, "admin": Account(roles=("admin",))}
        self.folder, self.endpoint = folder, f"tls/127.0.0.1:{free_port()}"
        self.fleet = Fleet(level=level, brokers=(Server(host="127.0.0.1"),), hubs="here", accounts=accounts)
        for name in NAMES:
            certificates.of_account(folder, name)
        applying.write_zenoh(folder, self.fleet)
        self.local = ZenohSettings(run_dir=folder / "run", client=True)
        own = self._tls(folder / certificates.SERVER_CERT, folder / certificates.SERVER_KEY)
        self.hub = HubProcess(folder / "run", folder / "journal")
        self.hub.settings = replace(
            self.hub.settings, listen=(self.endpoint,), tls=own, access=folder / ZENOH, lease_ms=2000
        )
        self.received: list[tuple[str, str]] = []

    @contextmanager
    def running(self) -> Iterator[Hall]:
        self.hub.start()
        try:
            with create("zenoh", "eye", self.local) as self.eye:
                self.eye.subscribe("#", lambda message: self.received.append((message.payload.decode(), message.topic)))
                yield self
        finally:
            self.hub.end()

    def settings(self, name: str) -> ZenohSettings:
        place = self.folder / certificates.ACCOUNTS
        tls = self._tls(place / f"{name}.pem", place / f"{name}.key")
        run_dir = self.folder / f"run-{name}"
        return ZenohSettings(run_dir=run_dir, connect=(self.endpoint,), tls=tls, client=True, account=name)

    def _tls(self, certificate: Path, key: Path) -> TlsSettings:
        return TlsSettings(ca_cert=self.folder / certificates.CA_CERT, client_cert=certificate, client_key=key)

    @contextmanager
    def account(self, name: str, **plan: Any) -> Iterator[Forked]:
        text = msgspec.json.encode(Plan(self.settings(name), name, **plan), enc_hook=str).decode()
        process = Forked("tests.fleet.zenoh_account", text)
        try:
            assert process.stdout.readline() == "CONNECTED\n", process.printed
            yield process
        finally:
            process.kill()
            process.wait(10)

    def of(self, name: str) -> set[str]:
        return {topic for sender, topic in self.received if sender == name}

    def mark(self, text: str) -> None:
        """Wait until all that came before has been received: a stop of the viewer's comes through."""
        with self.account("vera", topics=[f"a/b/{text}/incoming/estop"]) as vera:
            play(vera)
            assert until(lambda: f"a/b/{text}/incoming/estop" in self.of("vera"))


def play(process: Forked) -> list[str]:
    """Have an account publish all; returns what it has received until then."""
    process.stdin.write("\n")
    process.stdin.flush()
    found: list[str] = json.loads(process.stdout.readline())
    return found


@pytest.fixture(scope="module", params=["login", "named"])
def hall(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    with Hall(tmp_path_factory.mktemp("hall") / "hall", request.param).running() as hall:
        yield hall


def test_each_account_writes_what_it_may_and_nothing_else(hall: Hall) -> None:
    wrong, expected = [], {}
    for name in NAMES:
        expected[name] = {topic for topic in TOPICS if lets_through(name, topic, hall.fleet.level)}
        with hall.account(name, topics=TOPICS) as client:
            play(client)
            assert until(lambda name=name: expected[name] <= hall.of(name)), (name, expected[name] - hall.of(name))
    hall.mark("written")
    for name in set(NAMES) - {"vera"}:
        wrong += [(name, topic) for topic in sorted(hall.of(name) ^ expected[name])]
    assert wrong == []
    assert len(NAMES) * len(TOPICS) > 1_000
