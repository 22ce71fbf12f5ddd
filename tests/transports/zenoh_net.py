"""The Zenoh network of the shared suite: our hub, with a journal, as a process of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from pebble.transports import Message, QoS, State, ZenohSettings, create
from pebble.transports.zenoh import session as zenoh_session
from tests.support import WAIT_S, until
from tests.transports.forked import Forked
from tests.transports.net import Net


class HubProcess:
    """`python -m pebble.extensions.lab.rig.hub` in `run_dir`; `start` waits until it serves."""

    def __init__(self, run_dir: Path, journal: Path | None = None) -> None:
        self.settings = ZenohSettings(run_dir=run_dir, journal=journal)
        self._process: Forked | None = None

    def start(self) -> HubProcess:
        settings = msgspec.json.encode(self.settings, enc_hook=str).decode()
        self._process = Forked("pebble.extensions.lab.rig.hub", [settings])
        probe = create("zenoh", "probe", dataclasses.replace(self.settings, client=True, listen=())).open(WAIT_S)
        assert probe.state is State.CONNECTED, probe.problem
        probe.close()
        return self

    def kill(self) -> None:
        self.end(signal.SIGKILL)

    def end(self, number: int = signal.SIGTERM) -> tuple[int | None, str]:
        """Returns the exit code and what it wrote to stderr."""
        process, self._process = self._process, None
        assert process is not None
        os.kill(process.pid, signal.SIGCONT)
        os.kill(process.pid, number)
        return process.wait(WAIT_S), process.printed

    def signal(self, number: int) -> None:
        os.kill(self.pid, number)

    @property
    def running(self) -> bool:
        return self._process is not None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def wait_until_stored(self) -> None:
        """Wait until the hub has stored every retained message that running clients have published.

        The hub answers a subscriber only then; our own retained message shows that it has.
        """
        answered: list[Message] = []
        with create("zenoh", "settler", dataclasses.replace(self.settings, client=True)) as client:
            client.publish("settle", b"?", qos=QoS.DELIVERED, retain=True)
            client.subscribe("#", lambda message: answered.append(message))
            assert until(lambda: any(message.topic == "settle" and message.retain for message in answered))
            client.publish("settle", b"", qos=QoS.DELIVERED, retain=True)


@contextlib.contextmanager
def stranger_at(settings: ZenohSettings) -> Iterator[zenoh.Session]:
    """A program that speaks Zenoh as it likes, connected to ``settings.connect``."""
    session = zenoh_session.open_session(zenoh_session.session_config(settings, "client", listen=[], connect=[]))
    try:
        assert until(lambda: list(session.info.routers_zid()))
        yield session
    finally:
        zenoh_session.close_session(session)


class ZenohNet(Net):
    kind = "zenoh"

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._journal = folder / "journal"
        self.hub = HubProcess(folder / "run", self._journal)

    def settings(self, **changes: Any) -> ZenohSettings:
        return dataclasses.replace(self.hub.settings, **changes)

    def start_network(self) -> None:
        if not self.hub.running:
            self.hub.start()

    def stop_network(self, *, forget: bool = False) -> None:
        if self.hub.running:
            try:
                self.hub.wait_until_stored()
            finally:
                self.hub.kill()
        if forget:
            self._journal.unlink()

    def heal(self) -> None:
        if self.hub.running:
            self.thaw_network()
        else:
            self.start_network()

    def freeze_network(self) -> None:
        self.hub.signal(signal.SIGSTOP)

    def thaw_network(self) -> None:
        self.hub.signal(signal.SIGCONT)
