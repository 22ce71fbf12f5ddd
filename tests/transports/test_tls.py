"""The versions of TLS that a connection accepts."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from contextlib import closing, nullcontext, suppress
from unittest import mock

import pytest

from pebble.extensions.paho.client import PahoClient
from pebble.transports.hosts import CONNECT_TIMEOUT_S, Address
from pebble.transports.mqtt.client import Client, Opening
from pebble.transports.settings import MqttSettings, TlsSettings
from pebble.transports.tls import make_context
from tests.support import ROOT

CERTS = ROOT / "tests" / "data" / "tls"
EVERY_CIPHER = "ALL:@SECLEVEL=0"


def shake_hands(ours: ssl.SSLContext, theirs: ssl.SSLContext) -> ssl.SSLObject:
    """Return our end of a connection to localhost; in memory."""
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = ours.wrap_bio(back, there, server_hostname="localhost")
    server = theirs.wrap_bio(there, back, server_side=True)
    for end in (client, server) * 4:
        with suppress(ssl.SSLWantReadError):
            end.do_handshake()
    return client


def agreed(version: ssl.TLSVersion) -> str | None:
    """Return what a connection agrees on with a server that speaks only ``version``."""
    theirs = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    theirs.load_cert_chain(CERTS / "server.crt", CERTS / "server.key")
    theirs.set_ciphers(EVERY_CIPHER)
    theirs.minimum_version = theirs.maximum_version = version
    return shake_hands(make_context(TlsSettings(ca_cert=CERTS / "ca.crt")), theirs).version()


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1])
@pytest.mark.filterwarnings("ignore:ssl.TLSVersion")
def test_nothing_below_1_2(version: ssl.TLSVersion) -> None:
    with pytest.raises(ssl.SSLError, match=r"(?i)version|protocol"):
        agreed(version)


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_1_2_and_1_3(version: ssl.TLSVersion) -> None:
    assert agreed(version) == version.name.replace("_", ".")


class SlowServer:
    """Accepts one TLS connection, and sends a few bytes at a time; ``silent_after`` so many pieces it sends no more."""

    def __init__(self, silent_after: int) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = Address(socket.AF_INET, self._listener.getsockname())
        self._left = silent_after
        self.ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.ended.set()
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(CERTS / "server.crt", CERTS / "server.key")
        there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
        tls = context.wrap_bio(there, back, server_side=True)
        sock, _ = self._listener.accept()
        with sock, suppress(OSError):
            while data := sock.recv(65536):
                there.write(data)
                with suppress(ssl.SSLWantReadError):
                    tls.do_handshake()
                while self._left and (piece := back.read(_PIECE)):
                    sock.sendall(piece)
                    self._left -= 1
                    self.ended.wait(_PIECE_S)


_PIECE, _PIECE_S = 150, 0.4  # bytes at 3 kbit/s


@pytest.mark.parametrize("client_class", [Client, PahoClient])
@pytest.mark.parametrize("silent_after", [1000, 2])
def test_a_handshake_may_take_long_while_bytes_arrive(silent_after: int, client_class: type[Client]) -> None:
    context = make_context(TlsSettings(ca_cert=CERTS / "ca.crt"))
    with closing(SlowServer(silent_after)) as server:
        opening = Opening("id", MqttSettings(host="localhost"), context, None, server.address)
        client = client_class(opening, mock.Mock(), bridge=False)
        began = time.monotonic()
        with nullcontext() if silent_after > 2 else pytest.raises(TimeoutError, match="TLS handshake"):
            client.open()
        client.close()
        assert time.monotonic() - began > CONNECT_TIMEOUT_S
