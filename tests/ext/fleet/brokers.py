"""A mosquitto with the files that `pebble fleet init` writes, on loopback."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from pebble.extensions.fleet import applying
from pebble.extensions.fleet.broker_files import new_password
from pebble.extensions.fleet.certificates import CA_CERT
from pebble.extensions.fleet.folder import CONF, Fleet, Server, load
from pebble.extensions.fleet.roles import Account
from pebble.extensions.operator.places import mosquitto_path
from tests.ext.fleet.broker_client import BrokerClient, Place
from tests.support import WAIT_S, Child, free_port, listening, until

HOST = "127.0.0.1"


class FleetBroker:
    """A folder with accounts, and its broker; ``start`` and ``stop`` it. ``passwords``: of all accounts.

    ``unencrypted``: a port without TLS, as boards need it.
    """

    def __init__(
        self,
        folder: Path,
        accounts: Mapping[str, Account],
        *,
        level: Literal["login", "named"] = "login",
        unencrypted: int | None = None,
    ) -> None:
        folder.mkdir(exist_ok=True)
        self.folder, self.port, self.unencrypted = folder, free_port(), unencrypted
        server = Server(host=HOST, port=self.port, unencrypted=unencrypted)
        self.passwords = {name: new_password() for name in accounts}
        fleet = Fleet(level=level, brokers=(server,), accounts=dict(accounts))
        applying.make(folder, fleet, self.passwords)
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def fleet(self) -> Fleet:
        return load(self.folder)

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def place(self) -> Place:
        return Place(HOST, self.port, self.folder / CA_CERT)

    def __enter__(self) -> FleetBroker:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        command = [str(mosquitto_path()), "-c", str(self.folder / CONF), "-v"]  # what clients do is in the log
        log = (self.folder / "log").open("ab")
        self._process = Child(command, stdout=log, stderr=log)
        ports = [port for port in (self.port, self.unencrypted) if port is not None]
        assert until(lambda: all(map(listening, ports))), (self.folder / "log").read_text()

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(WAIT_S)
            self._process = None

    def change(self, after: Fleet, passwords: Mapping[str, str] | None = None) -> str:
        return applying.apply(self.folder, after, passwords)

    def add(self, name: str, account: Account) -> str:
        self.passwords[name] = new_password()
        return self.change(self.fleet.with_account(name, account), {name: self.passwords[name]})

    def renew(self, name: str) -> str:
        self.passwords[name] = new_password()
        return self.change(self.fleet, {name: self.passwords[name]})

    def remove(self, name: str) -> str:
        return self.change(self.fleet.without(name))

    def login(self, name: str) -> BrokerClient:
        return BrokerClient(self.place, name, self.passwords[name])


def accounts(roles: Iterable[str]) -> dict[str, Account]:
    """One account for each of these roles, named after it."""
    return {role: Account(roles=(role,)) for role in roles}
