"""The ``ssl`` module of a simulated board: CPython's TLS with MicroPython's interface, non-blocking."""

import ssl
from types import SimpleNamespace
from typing import Any

from pebble.extensions.lab.simulation.micropython.faults import WouldHang


class Context:
    """MicroPython's SSLContext for clients."""

    def __init__(self, _protocol: int) -> None:
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self.verify_mode = int(ssl.CERT_REQUIRED)

    def load_verify_locations(self, *, cadata: bytes) -> None:
        """Set the trusted certificates, DER or PEM."""
        is_pem = cadata.startswith(b"-----BEGIN")
        try:
            self._context.load_verify_locations(cadata=cadata.decode() if is_pem else cadata)
        except ssl.SSLError:
            raise ValueError("invalid cert") from None

    def wrap_socket(
        self, sock: Any, *, server_hostname: str | None = None, do_handshake_on_connect: bool = True
    ) -> Any:
        """Make a connected socket encrypt its data. Its reads and writes continue the handshake."""
        if do_handshake_on_connect:
            raise WouldHang("a blocking TLS handshake: use wrap_socket(…, do_handshake_on_connect=False)")
        self._context.check_hostname = server_hostname is not None and self.verify_mode != ssl.CERT_NONE
        self._context.verify_mode = ssl.VerifyMode(self.verify_mode)
        sock.secure(self._context, server_hostname)
        return sock


def ssl_module() -> SimpleNamespace:
    return SimpleNamespace(
        SSLContext=Context,
        PROTOCOL_TLS_CLIENT=int(ssl.PROTOCOL_TLS_CLIENT),
        CERT_NONE=int(ssl.CERT_NONE),
        CERT_REQUIRED=int(ssl.CERT_REQUIRED),
    )


def as_on_a_board(error: ssl.SSLError) -> OSError:
    """Return ``error`` as MicroPython's mbedTLS raises it: a plain OSError with a negative number and a text."""
    code = -0x2700 if isinstance(error, ssl.SSLCertVerificationError) else -0x7200
    return OSError(code, str(error.reason or "SSL"))
