"""Makes the TLS context of a connection to a broker. Errors name the setting and its file."""

import ssl
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pebble.errors import TransportError
from pebble.transports.settings import TlsSettings

_T = TypeVar("_T")


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
