"""The password and certificates of a connection to a broker, read again when their files change."""

import ssl
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pebble.errors import TransportError
from pebble.transports.renewed import Renewed
from pebble.transports.settings import MqttSettings, TlsSettings

_T = TypeVar("_T")


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


def make_context(tls: TlsSettings) -> ssl.SSLContext:
    """Return the TLS context for these certificates. Raises TransportError that names the field and the file."""
    for field in ("ca_cert", "client_cert", "client_key"):
        path: Path | None = getattr(tls, field)
        if path is not None and not path.is_file():
            raise TransportError(f"tls.{field}: there is no file {path}")
    if tls.client_key is not None and tls.client_cert is None:
        raise TransportError("tls.client_key is set without tls.client_cert")
    context = _try(f"tls.ca_cert: {tls.ca_cert}", lambda: ssl.create_default_context(cafile=tls.ca_cert))
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.check_hostname = not tls.insecure
    if (cert := tls.client_cert) is not None:
        _try(f"tls.client_cert: {cert}", lambda: context.load_cert_chain(cert, tls.client_key, no_password))
    return context


def _try(what: str, load: Callable[[], _T]) -> _T:
    try:
        return load()
    except OSError as error:  # ssl.SSLError is one
        raise TransportError(f"{what} cannot be used: {error}") from None


def no_password() -> str:
    """Raise an error: otherwise OpenSSL asks the terminal for the password of an encrypted key, and waits."""
    raise OSError("the key is encrypted, and no password can be entered")
