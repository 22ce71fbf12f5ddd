"""Makes private_config.json, a board's identity, Wi-Fi and broker, from the robot's config. The firmware reads it."""

import json
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pebble.config import Config, Mqtt, Secret
from pebble.config.hosts import is_loopback
from pebble.config.masking import masked
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.install.flash.boards import ESP8266, Firmware

FILE = "private_config.json"
CA_FILE = "ca.der"
_WIFI_NAME = 32  # bytes, IEEE 802.11
_WIFI_PASSWORD = range(8, 64)  # WPA2 passphrase
_NO_BROKER = (".example", ".invalid", ".test")  # RFC 2606


@dataclass(frozen=True, slots=True, kw_only=True)
class PrivateFiles:
    """The files that belong only to one board."""

    settings: dict[str, Any] = field(default_factory=dict)
    ca: bytes | None = field(default=None, repr=False)  # an authority's certificate, DER

    def text(self) -> str:
        """Return the content of private_config.json, including passwords."""
        return json.dumps(self.settings)

    def shown(self) -> str:
        """Return the content with *** in place of passwords, for messages."""
        return json.dumps(masked(self.settings))


def private_files(config: Config, firmware: Firmware, *, ssid: str, wifi_password: str) -> PrivateFiles:
    """Return the files made from the robot's config. Raises PebbleError for settings that the board cannot use."""
    if not 1 <= len(ssid.encode()) <= _WIFI_NAME:
        raise PebbleError(f"--wifi: a network name has 1 to {_WIFI_NAME} bytes")
    if wifi_password and len(wifi_password.encode()) not in _WIFI_PASSWORD:
        raise PebbleError("the Wi-Fi password must have 8 to 63 characters, or be empty for an open network")
    for key, name in (("system", config.robot.system), ("type", config.robot.type), ("id", config.robot.id)):
        if '"' in name or "\\" in name:  # the firmware does not escape JSON: firmware/common/settings.py
            raise ConfigError(f'robot.{key}: " and \\ are not allowed on a board')
    broker = config.local_mqtt
    robot = {"system": config.robot.system, "type": config.robot.type, "id": config.robot.id}
    if config.robot.name is not None:
        robot["name"] = config.robot.name
    mqtt: dict[str, Any] = {"host": broker.host, "port": broker.port}
    if broker.username is not None:
        mqtt["username"] = broker.username
    if broker.password is not None:
        mqtt["password"] = Secret(broker.password)
    mqtt["tls"], ca = _tls(broker, firmware)
    settings = {"robot": robot, "wifi": {"ssid": ssid, "password": Secret(wifi_password)}, "mqtt": mqtt}
    if security := config.security.on_board():
        settings["security"] = security
    return PrivateFiles(settings=settings, ca=ca)


def check_broker(config: Config) -> None:
    """Raise ConfigError for a broker address that no board can reach."""
    host = config.local_mqtt.host
    if host == "example" or host.endswith(_NO_BROKER):
        where = config.path or "the config"
        raise ConfigError(f"local_mqtt.host: {host} is only an example; set your broker's address in a copy of {where}")
    if is_loopback(host) or host in ("0.0.0.0", "::"):  # noqa: S104 - the unspecified addresses
        raise ConfigError(f"local_mqtt.host: on a board, {host} is the board itself; set the broker's network address")


def _tls(broker: Mqtt, firmware: Firmware) -> tuple[Any, bytes | None]:
    """Return the board's setting ``tls``, and the authority's certificate as DER if there is one."""
    tls = broker.tls
    if not tls.enabled:
        return False, None
    if firmware.board is ESP8266:
        raise ConfigError("local_mqtt.tls: an ESP8266 has too little memory for TLS; use a listener without TLS")
    if tls.client_cert is not None:
        raise ConfigError("local_mqtt.tls.client_cert: boards log in with username and password only")
    if tls.ca_cert is None:
        if tls.insecure:
            return True, None  # encrypted, but the broker is not authenticated
        raise ConfigError("local_mqtt.tls.ca_cert: a board has no certificates of its own; set the broker's authority")
    if tls.insecure:
        raise ConfigError("local_mqtt.tls.insecure: a board with ca_cert checks the host name too; remove one of them")
    return {"ca": f"/{CA_FILE}", "server_name": broker.host}, _der(tls.ca_cert)


def _der(path: Path) -> bytes:
    """Return the certificate of an authority as DER. Raises ConfigError for a file with several."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"local_mqtt.tls.ca_cert: {path}: {error.strerror}") from None
    if not content.startswith(b"-----BEGIN") and b"-----BEGIN CERTIFICATE-----" not in content:
        return content  # it is no PEM, so it is DER already
    if content.count(b"-----BEGIN CERTIFICATE-----") != 1:
        raise ConfigError(f"local_mqtt.tls.ca_cert: {path} must contain exactly one certificate for a board")
    try:
        return ssl.PEM_cert_to_DER_cert(content[content.index(b"-----BEGIN CERT") :].decode("ascii").strip())
    except ValueError as error:
        raise ConfigError(f"local_mqtt.tls.ca_cert: {path}: {error}") from None
