"""The ``ssl`` module of a simulated board: CPython's TLS behind MicroPython's interface, non-blocking."""

import ssl
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pebble.extensions.lab.simulation.micropython.faults import WouldHang
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLIN, Stream

_CHUNK = 4096


class TlsStream(Stream):
    """TLS over another stream. Reads and writes continue the handshake, and return None until it is done."""

    def __init__(self, raw: Any, context: ssl.SSLContext, server_hostname: str | None) -> None:
        self._raw = raw
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._in, self._out, server_hostname=server_hostname)
        self._unsent = b""
        self._handshake_done = False

    def close(self) -> None:
        self._raw.close()

    def setblocking(self, blocking: bool) -> None:
        self._raw.setblocking(blocking)

    def ready(self, mask: int) -> int:
        """Return the events for poll() of the board: decrypted bytes count as readable."""
        pending = POLLIN if self._handshake_done and self._tls.pending() else 0
        return int(self._raw.ready(mask)) | (pending & mask)

    def _receive(self, size: int) -> bytes | None:
        while True:
            try:
                if self._handshake():
                    return self._tls.read(size)
            except ssl.SSLWantReadError:
                pass
            except (ssl.SSLZeroReturnError, ssl.SSLEOFError):
                return b""
            except ssl.SSLError as error:
                raise _as_on_a_board(error) from None
            finally:
                self._flush()
            if not self._read_raw():
                return None

    def _send(self, data: bytes) -> int | None:
        if not self._flush():
            return None
        try:
            while not self._handshake():
                self._flush()
                if not self._read_raw():
                    return None
            sent = self._tls.write(data[:_CHUNK])
        except ssl.SSLError as error:
            raise _as_on_a_board(error) from None
        self._flush()
        return sent

    def _handshake(self) -> bool:
        if not self._handshake_done:
            try:
                self._tls.do_handshake()
            except ssl.SSLWantReadError:
                return False
            self._handshake_done = True
        return True

    def _read_raw(self) -> bool:
        """Read encrypted bytes; False if there are none."""
        data = self._raw.read(_CHUNK)
        if data == b"":
            self._in.write_eof()
        elif data is not None:
            self._in.write(data)
        return data is not None

    def _flush(self) -> bool:
        """Send encrypted bytes; False if some are left."""
        self._unsent += self._out.read()
        if self._unsent:
            sent = self._raw.write(self._unsent)
            self._unsent = self._unsent[sent or 0 :]
        return not self._unsent


class Context:
    """MicroPython's SSLContext for clients."""

    def __init__(self, protocol: int) -> None:
        if protocol != ssl.PROTOCOL_TLS_CLIENT:
            raise ValueError("only TLS clients are simulated")
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self.verify_mode = int(ssl.CERT_REQUIRED)

    def load_verify_locations(self, cafile: str | None = None, cadata: bytes | str | None = None) -> None:
        """Set the trusted certificates, DER or PEM."""
        data = Path(cafile).read_bytes() if cafile is not None else cadata
        if isinstance(data, bytes) and data.startswith(b"-----BEGIN"):
            data = data.rstrip(b"\0").decode()
        try:
            self._context.load_verify_locations(cadata=data)
        except ssl.SSLError:
            raise ValueError("invalid cert") from None

    def wrap_socket(
        self,
        sock: Any,
        *,
        server_side: bool = False,
        do_handshake_on_connect: bool = True,
        server_hostname: str | None = None,
    ) -> TlsStream:
        if server_side or do_handshake_on_connect:
            raise WouldHang("a blocking TLS handshake: use wrap_socket(…, do_handshake_on_connect=False)")
        self._context.check_hostname = server_hostname is not None and self.verify_mode != ssl.CERT_NONE
        self._context.verify_mode = ssl.VerifyMode(self.verify_mode)
        return TlsStream(sock, self._context, server_hostname)


def ssl_module() -> SimpleNamespace:
    return SimpleNamespace(
        SSLContext=Context,
        PROTOCOL_TLS_CLIENT=int(ssl.PROTOCOL_TLS_CLIENT),
        CERT_NONE=int(ssl.CERT_NONE),
        CERT_OPTIONAL=int(ssl.CERT_OPTIONAL),
        CERT_REQUIRED=int(ssl.CERT_REQUIRED),
    )


def _as_on_a_board(error: ssl.SSLError) -> OSError:
    """Convert to MicroPython's errors of mbedTLS: plain OSErrors with a negative number and a text."""
    code = -0x2700 if isinstance(error, ssl.SSLCertVerificationError) else -0x7200
    return OSError(code, str(error.reason or "SSL"))
