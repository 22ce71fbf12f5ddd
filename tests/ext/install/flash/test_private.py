"""What is written into private_config.json, what is refused, and what is shown of it."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.install.flash.boards import FIRMWARE, Firmware
from pebble.extensions.install.flash.private import check_broker, private_files
from tests.support import ROOT

CA = ROOT / "tests" / "data" / "tls" / "ca.crt"
C6, D1 = FIRMWARE["minilamp"], FIRMWARE["benjr"]


def config(env: dict[str, str] | None = None, *, security: Any = None, **broker: Any) -> Config:
    robot = {"id": "lamp", "type": "lamps", "name": "Lamp", "platform": "esp32"}
    raw = {"robot": robot, "local_mqtt": {"host": "broker.lab", **broker}}
    raw |= {"security": security} if security else {}
    return parse(raw, folder=Path.cwd(), env=env or {})


def test_the_settings_hold_identity_wifi_and_broker() -> None:
    private = private_files(config(port=1884), C6, ssid="Lab", wifi_password="geheim123")
    assert private.settings == {
        "robot": {"system": "pebble", "type": "lamps", "id": "lamp", "name": "Lamp"},
        "wifi": {"ssid": "Lab", "password": "geheim123"},
        "mqtt": {"host": "broker.lab", "port": 1884, "tls": False},
    }
    assert private.ca is None


@pytest.mark.parametrize(
    ("security", "section"),
    [
        ({"level": "open"}, None),
        ({"strangers": "drive"}, {"level": "open", "strangers": "drive"}),
        ({"level": "named"}, {"level": "named", "strangers": "refuse"}),
    ],
)
def test_the_level_goes_along(security: dict[str, str], section: dict[str, str] | None) -> None:
    login = {"username": "lamp", "password": "geheim", "tls": {"enabled": True, "ca_cert": str(CA)}}
    private = private_files(config(security=security, **login), C6, ssid="Lab", wifi_password="")
    assert private.settings.get("security") == section


def test_names_that_the_firmware_refuses_never_get_to_a_board() -> None:
    for name in ('la"mp', "la\\mp"):
        named = parse({"robot": {"id": name}, "local_mqtt": {"host": "broker.lab"}}, folder=Path("/"), env={})
        with pytest.raises(ConfigError, match=r"robot\.id: .* are not allowed on a board"):
            private_files(named, C6, ssid="Lab", wifi_password="")


def test_the_brokers_password_comes_from_a_file_or_the_environment(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("von der datei\n")
    given = {"von der datei": config(username="ann", password_file=str(file))}
    given["aus env"] = config({"PW": "aus env"}, username="ann", password_env="PW")
    for password, one in given.items():
        private = private_files(one, C6, ssid="Lab", wifi_password="")
        assert private.settings["mqtt"]["password"] == password
        assert password not in private.shown() + repr(private)
        assert '"password": "***"' in private.shown()
        assert password in private.text()


def test_an_authority_goes_along_as_der() -> None:
    private = private_files(config(tls={"enabled": True, "ca_cert": str(CA)}), C6, ssid="Lab", wifi_password="")
    assert private.settings["mqtt"]["tls"] == {"ca": "/ca.der", "server_name": "broker.lab"}
    assert private.ca == ssl.PEM_cert_to_DER_cert(CA.read_text())
    unchecked = private_files(config(tls={"enabled": True, "insecure": True}), C6, ssid="Lab", wifi_password="")
    assert unchecked.settings["mqtt"]["tls"] is True, "it has to be asked for"


@pytest.mark.parametrize(
    ("firmware", "tls", "problem"),
    [
        (C6, {}, r"tls\.ca_cert: a board has no certificates"),
        (C6, {"insecure": True, "ca_cert": str(CA)}, r"tls\.insecure: a board with ca_cert checks the host name too"),
        (C6, {"ca_cert": "two.crt"}, "exactly one certificate"),
        (C6, {"ca_cert": "/nowhere"}, "there is no file /nowhere"),
        (D1, {"ca_cert": str(CA)}, "an ESP8266 has too little memory"),
    ],
)
def test_what_a_board_cannot_do_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, firmware: Firmware, tls: dict[str, Any], problem: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("two.crt").write_text(CA.read_text() * 2)
    with pytest.raises(PebbleError, match=problem):
        private_files(config(tls={"enabled": True, **tls}), firmware, ssid="Lab", wifi_password="")


@pytest.mark.parametrize(("ssid", "password"), [("", "geheim123"), ("x" * 33, "geheim123"), ("Lab", "short")])
def test_a_wifi_that_cannot_be_is_refused_without_its_password(ssid: str, password: str) -> None:
    with pytest.raises(PebbleError) as problem:
        private_files(config(), C6, ssid=ssid, wifi_password=password)
    assert password not in str(problem.value)


@pytest.mark.parametrize("host", ["broker.example", "localhost", "::1"])
def test_a_broker_that_no_board_reaches_is_refused(host: str) -> None:
    with pytest.raises(PebbleError, match=f"local_mqtt.host: .*{host}"):
        check_broker(config(host=host))
    check_broker(config(host="192.168.1.2"))
