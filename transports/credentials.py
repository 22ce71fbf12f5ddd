"""What a connection to a broker presents, and whom it trusts: as the files say when it is made."""

from __future__ import annotations

import ssl
from pathlib import Path

from pebble.transports.renewed import Renewed
from pebble.transports.settings import MqttSettings
from pebble.transports.tls import make_context


class Credentials:
    """Raises TransportError for certificates that cannot be used. Those that come later replace the ones before."""

    def __init__(self, settings: MqttSettings) -> None:
        self._password = settings.password
        self._password_file: Renewed[str] | None = None
        self._tls: Renewed[ssl.SSLContext] | None = None
        if (file := settings.password_file) is not None:
            self._password_file = Renewed([file], lambda: _password(file), self._password)
        if (tls := settings.tls) is not None:
            system = ssl.get_default_verify_paths()
            trusted = (tls.ca_cert,) if tls.ca_cert else (Path(system.cafile or system.openssl_cafile), system.capath)
            files = *(None if file is None else Path(file) for file in trusted), tls.client_cert, tls.client_key
            self._tls = Renewed(files, lambda: make_context(tls))

    def context(self) -> ssl.SSLContext | None:
        """None: without TLS."""
        return None if self._tls is None else self._tls.get()

    def password(self) -> str | None:
        return self._password if self._password_file is None else self._password_file.get()


def _password(file: Path) -> str:
    text = file.read_text(encoding="utf-8-sig").rstrip("\n")
    if not text:
        raise ValueError(f"the password file {file} is empty")
    return text
