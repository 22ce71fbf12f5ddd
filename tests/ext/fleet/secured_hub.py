"""A Zenoh hub with the accounts of a fleet's folder: it knows clients by their certificates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pebble.extensions.fleet import applying, certificates
from pebble.extensions.fleet.folder import ZENOH, Fleet, Server
from pebble.extensions.fleet.roles import Account
from pebble.transports import TlsSettings, ZenohSettings
from tests.support import free_port
from tests.transports.zenoh_net import HubProcess


class SecuredHub:
    """The folder, with certificates for ``clients``, and the hub, which its user starts and ends."""

    def __init__(
        self, folder: Path, level: Literal["login", "named"], accounts: Mapping[str, Account], clients: Iterable[str]
    ) -> None:
        certificates.init(folder, ["127.0.0.1", "localhost"])
        self.folder, self.endpoint = folder, f"tls/127.0.0.1:{free_port()}"
        self.fleet = Fleet(level=level, brokers=(Server(host="127.0.0.1"),), hubs="here", accounts=dict(accounts))
        for name in clients:
            certificates.of_account(folder, name)
        applying.write_zenoh(folder, self.fleet)
        own = self._tls(folder / certificates.SERVER_CERT, folder / certificates.SERVER_KEY)
        self.hub = HubProcess(folder / "run", folder / "journal")
        self.hub.settings = replace(
            self.hub.settings, listen=(self.endpoint,), tls=own, access=folder / ZENOH, lease_ms=2000
        )

    def settings(self, name: str) -> ZenohSettings:
        """Return the settings of a client with the certificate of this account."""
        place = self.folder / certificates.ACCOUNTS
        tls = self._tls(place / f"{name}.pem", place / f"{name}.key")
        run_dir = self.folder / f"run-{name}"
        return ZenohSettings(run_dir=run_dir, connect=(self.endpoint,), tls=tls, client=True, account=name)

    def _tls(self, certificate: Path, key: Path) -> TlsSettings:
        return TlsSettings(ca_cert=self.folder / certificates.CA_CERT, client_cert=certificate, client_key=key)
