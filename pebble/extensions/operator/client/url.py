"""The address of a connection: ``mqtt://host:port``, ``mqtts://host:port`` or ``zenoh:<run_dir>``."""

import os
from dataclasses import replace
from pathlib import Path

from pebble.config.hosts import HostError, broker_host, split
from pebble.config.text_files import read_password
from pebble.errors import PebbleError
from pebble.runtime.connections import ALL_VITAL
from pebble.transports import MqttSettings, TlsSettings, ZenohSettings

FORMS = "mqtt://HOST[:PORT], mqtts://… or zenoh:RUN_DIR"
_PORTS = {"mqtt": 1883, "mqtts": 8883}


class UrlError(PebbleError):
    """An error: a URL is no usable address. Example: ``--url http://x: use mqtt://HOST[:PORT], …``."""


def settings_of(
    url: str, *, password_file: Path | None = None, ca_cert: Path | None = None
) -> tuple[str, MqttSettings | ZenohSettings]:
    """Return the kind of transport and its settings. Raises UrlError, whose text never contains the password.

    The broker's password is the text of ``password_file``, which raises PebbleError, or the environment's value.
    """
    if password_file is None:
        password = os.environ.get("PEBBLE_PASSWORD")
    else:
        password = read_password(password_file, "--password-file")
    scheme, _, rest = url.partition(":")
    scheme = scheme.lower()
    if scheme == "zenoh":
        return "zenoh", _zenoh(rest)
    if scheme in _PORTS and rest.startswith("//"):
        return "mqtt", replace(_mqtt(url, password, ca_cert), password_file=password_file)
    raise UrlError(f"--url must be {FORMS}")


def _zenoh(path: str) -> ZenohSettings:
    if not path:
        raise UrlError("--url zenoh: names no run directory; `pebble check CONFIG` shows a robot's")
    run_dir = Path(path).expanduser().absolute()
    try:
        is_there = run_dir.is_dir()
    except OSError as error:
        raise UrlError(f"--url zenoh:{path}: {error.strerror}: run this as the user of the robot") from None
    if not is_there:
        raise UrlError(f"--url zenoh:{path}: there is no such directory, is the robot up? `pebble up CONFIG` starts it")
    return ZenohSettings(run_dir=run_dir, client=True)


def _mqtt(url: str, password: str | None, ca_cert: Path | None) -> MqttSettings:
    if "," in url:
        raise UrlError(f"--url names one broker: a name that has the addresses of all, or that of a cluster: {FORMS}")
    try:
        parts = split(url)
        host = broker_host(parts.host)
    except HostError as error:
        raise UrlError(f"--url {error}; use {FORMS}") from None
    if parts.password is not None:
        raise UrlError(
            "--url holds a password, which every user of this machine can read: put it into a file "
            "(--password-file FILE) or into the environment (PEBBLE_PASSWORD)"
        )
    if parts.rest.strip("/"):
        raise UrlError(f"--url must end after the port; topics are named separately: {FORMS}")
    port = _PORTS[parts.scheme] if parts.port is None else parts.port
    encrypted = parts.scheme == "mqtts"
    if ca_cert is not None and not encrypted:
        raise UrlError("--ca-cert has no use with mqtt://: use mqtts://")
    return MqttSettings(
        host=host,
        port=port,
        username=parts.user,
        vital=ALL_VITAL,  # small commands are sent even if the broker hangs up after them, see RefusedTopics
        password=password,
        tls=TlsSettings(ca_cert=ca_cert) if encrypted else None,
    )
