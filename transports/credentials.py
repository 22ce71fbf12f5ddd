"""The password and certificates of a connection to a broker, read again when their files change."""

import ssl
from pathlib import Path

from pebble.transports.renewed import Renewed
from pebble.transports.settings import MqttSettings, TlsSettings
from pebble.transports.tls import make_context


class Credentials:
    """The credentials of one client. Raises TransportError for certificates that cannot be used."""

    def __init__(self, settings: MqttSettings) -> None:
        self._password = settings.password
        self._password_file: Renewed[str] | None = None
        self._tls = None if settings.tls is None else renewed_context(settings.tls)
        if (file := settings.password_file) is not None:
            self._password_file = Renewed([file], lambda: _password(file), self._password)

    def context(self) -> ssl.SSLContext | None:
        """Return the context, or None without TLS."""
        return None if self._tls is None else self._tls.get()

    def password(self) -> str | None:
        return self._password if self._password_file is None else self._password_file.get()


def renewed_context(tls: TlsSettings) -> Renewed[ssl.SSLContext]:
    """Return the TLS context of these certificates, or of the system's authorities. Raises as `make_context`."""
    system = ssl.get_default_verify_paths()
    trusted = (system.cafile, system.capath) if tls.ca_cert is None else (tls.ca_cert,)
    files = [Path(file) for file in (*trusted, tls.client_cert, tls.client_key) if file is not None]
    return Renewed(files, lambda: make_context(tls))


def _password(file: Path) -> str:
    text = file.read_text(encoding="utf-8-sig").rstrip("\n")
    if not text:
        raise ValueError(f"the password file {file} is empty")
    return text
