"""TLS: the versions that a connection accepts, slow handshakes, and files that others replace while it runs."""

from __future__ import annotations

import shutil
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from unittest import mock

import pytest

from pebble.extensions.fleet import certificates
from pebble.transports import State, create
from pebble.transports.hosts import Address
from pebble.transports.mqtt.client import Client, Opening
from pebble.transports.renewed import Renewed
from pebble.transports.settings import MqttSettings, TlsSettings
from pebble.transports.tls import make_context
from tests.support import ROOT, Broker, until

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


@pytest.mark.filterwarnings("ignore:ssl.TLSVersion")
def test_nothing_below_1_2() -> None:
    with pytest.raises(ssl.SSLError, match=r"(?i)version|protocol"):
        agreed(ssl.TLSVersion.TLSv1_1)
    for version in (ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3):
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


_PIECE, _PIECE_S, _PATIENCE_S = 150, 0.1, 0.4  # bytes, and seconds between them


@pytest.mark.parametrize("silent_after", [1000, 2])
def test_a_handshake_may_take_long_while_bytes_arrive(silent_after: int) -> None:
    context = make_context(TlsSettings(ca_cert=CERTS / "ca.crt"))
    with closing(SlowServer(silent_after)) as server:
        opening = Opening("id", MqttSettings(host="localhost"), context, None, server.address, _PATIENCE_S)
        client = Client(opening, mock.Mock(), bridge=False)
        began = time.monotonic()
        with nullcontext() if silent_after > 2 else pytest.raises(TimeoutError, match="TLS handshake"):
            client.open()
        client.close()
        assert time.monotonic() - began > _PATIENCE_S


def _number(file: Path) -> int:
    return int(file.read_text())


def _replaced(file: Path, text: str) -> None:
    fresh = file.with_name("fresh")
    fresh.write_text(text)
    fresh.replace(file)


def _linked(file: Path, text: str) -> None:
    """Renews as certbot does: the name stays, and leads to another file."""
    target = file.with_name(f"archive-{text}")
    target.write_text(text)
    file.unlink()
    file.symlink_to(target)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda file: _replaced(file, "2"), 2),
        (lambda file: _linked(file, "2"), 2),
        (lambda file: (shutil.rmtree(file.parent), file.parent.mkdir(), file.write_text("2")), 2),
        (lambda file: file.unlink(), 1),
        (lambda file: file.write_text("half writt"), 1),
        (lambda _file: None, 1),
    ],
)
def test_a_change_is_taken_up_and_what_cannot_be_used_is_not(
    tmp_path: Path, change: Callable[[Path], object], expected: int, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "certs" / "number"
    file.parent.mkdir()
    file.write_text("1")
    value = Renewed([file], lambda: _number(file))
    change(file)
    assert [value.get() for _ in range(3)] == [expected] * 3
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) <= 1
    shutil.rmtree(file.parent, ignore_errors=True)
    file.parent.mkdir()
    file.write_text("3")
    assert value.get() == 3


def test_a_robot_is_back_after_its_authority_its_certificate_and_its_password_were_renewed(tmp_path: Path) -> None:
    used, password, accounts = tmp_path / "used", tmp_path / "password", tmp_path / "accounts"

    def install(number: int) -> None:
        made = tmp_path / str(number)
        certificates.init(made, ["localhost"])
        shutil.copytree(made, used, dirs_exist_ok=True)
        password.write_text(f"secret {number}\n")
        subprocess.run(["mosquitto_passwd", "-c", "-b", accounts, "rover", f"secret {number}"], check=True)
        accounts.chmod(0o644)

    install(1)
    files = ("cafile ca.pem", "certfile server.pem", "keyfile server.key")
    options = [f"{name} {used}/{file}" for name, file in (line.split() for line in files)]
    for path in (used, *used.iterdir(), tmp_path):
        path.chmod(0o755)
    broker = Broker(tmp_path, *options, "allow_anonymous false", f"password_file {accounts}")
    settings = MqttSettings(
        host="localhost",
        port=broker.port,
        username="rover",
        password="secret 1",
        password_file=password,
        tls=TlsSettings(ca_cert=used / "ca.pem"),
    )
    try:
        with create("mqtt", "rover", settings) as client:
            assert client.state is State.CONNECTED, client.problem
            broker.stop()
            assert until(lambda: client.state is State.CONNECTING)
            install(2)
            for path in (used, *used.iterdir()):
                path.chmod(0o755)
            broker.start()
            assert until(lambda: client.state is State.CONNECTED), client.problem
    finally:
        broker.stop()
