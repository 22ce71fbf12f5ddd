"""Files that others replace while a process runs."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from pebble.extensions.fleet import certificates
from pebble.transports import MqttSettings, State, TlsSettings, create
from pebble.transports.renewed import Renewed
from tests.support import Broker, until


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
        (lambda file: file.write_text("22"), 22),
        (lambda file: _replaced(file, "2"), 2),
        (lambda file: _linked(file, "2"), 2),
        (lambda file: (shutil.rmtree(file.parent), file.parent.mkdir(), file.write_text("2")), 2),
        (lambda file: file.unlink(), 1),
        (lambda file: shutil.rmtree(file.parent), 1),
        (lambda file: file.write_text("half writt"), 1),
        (lambda file: file.write_text(""), 1),
        (lambda file: (file.unlink(), file.mkdir()), 1),
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
