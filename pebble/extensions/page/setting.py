"""The settings of an operator page, from options or from a robot's config."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pebble.config import Config, Mqtt
from pebble.config.security import SecurityLevel
from pebble.contract.identity import Identity
from pebble.errors import ConfigError
from pebble.extensions.page.config import PEOPLE, ListedRobot, WebInterface
from pebble.extensions.recordings.config import Recorder
from pebble.runtime.connections import REMOTE_RECONNECT_S, mqtt_settings
from pebble.transports import MqttSettings

DEFAULT_PORT = 8080


@dataclass(frozen=True, slots=True, kw_only=True)
class WebSettings:
    """The settings of an operator page. ``certificate`` and ``key`` None: plain http.

    ``login`` False: everybody is admin; only on loopback.
    """

    broker: MqttSettings
    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT  # 0: a free one
    names: tuple[str, ...] = ()  # further host names by which browsers may address it
    server: str = ""  # its name; "": this machine's
    login: bool = False
    level: SecurityLevel = "open"  # of its robots
    listed: dict[str, ListedRobot] = field(default_factory=dict)  # by base: robots that the config knows
    people: Path | None = None  # the database of users, sessions and settings; None: in memory
    certificate: Path | None = None
    key: Path | None = None
    recordings: Path | None = None  # the folder of a recorder, to look at; None: none
    authority: Path | None = None  # offered for download, so that phones can trust it
    cameras_in_turn: bool = False  # for a moment each, while a page shows the fleet: the demo's
    expand: bool = False  # groups of streams
    plain_http_drive: bool = True  # False: over plain http from another machine nothing drives
    say: Callable[[str], None] | None = None  # gets a line when the broker cannot be reached, and when it can again

    @property
    def name(self) -> str:
        """Return the name of this server on pages and for other servers."""
        return self.server or socket.gethostname().partition(".")[0] or "server"


def settings_of(config: Config) -> WebSettings:
    """Return the settings of the page in ``config``. Raises ConfigError with the key and what to do.

    Whether there is a user, where ``login`` is true, is known only from a database: ``pebble.extensions.page.run``.
    """
    web = config.section(WebInterface)
    if not web.local and web.tls.certificate is None and not web.plain_http:
        raise ConfigError(
            f"web_interface.host: other machines reach {web.host}, which needs a certificate and a user: run "
            f"`pebble cert init` and `pebble web user add`, and write web_interface.tls; or write 127.0.0.1"
        )
    for key in ("certificate", "key", "ca"):
        _check_readable(f"web_interface.tls.{key}", getattr(web.tls, key))
    return WebSettings(
        broker=mqtt_settings(_broker(config), reconnect_max_s=REMOTE_RECONNECT_S, program="web"),
        host=web.host,
        port=web.port,
        names=web.names,
        server=web.server or "",
        login=has_login(web),
        people=people_of(config),
        certificate=web.tls.certificate,
        key=web.tls.key,
        authority=web.tls.ca,
        level=config.security.level,
        listed=_listed(config),
        plain_http_drive=web.plain_http_drive,
        expand=web.expand,
        recordings=_recordings(config),
    )


def has_login(web: WebInterface) -> bool:
    return not web.local or web.tls.certificate is not None


def people_of(config: Config) -> Path:
    return config.section(WebInterface).people or config.state_dir() / PEOPLE


def _listed(config: Config) -> dict[str, ListedRobot]:
    identity = config.identity
    return {
        Identity(listed.system or identity.system, listed.type or identity.type, listed.id).base: listed
        for listed in config.section(WebInterface).robots
        if listed.id is not None
    }


def _recordings(config: Config) -> Path | None:
    web, recorder = config.section(WebInterface), config.section(Recorder)
    if web.recordings is not None:
        return web.recordings
    return recorder.place if recorder.enabled else None


def _broker(config: Config) -> Mqtt:
    """Return the broker of ``web_interface.mqtt``, or else that of the robot's bridge."""
    web, bridge = config.section(WebInterface), config.services.mqtt_bridge
    if web.mqtt.host:
        return web.mqtt
    if bridge.remote is not None and bridge.remote.kind != "mqtt":
        raise ConfigError(
            f'web_interface.mqtt.host: is missing, and the robot\'s own connection is "{bridge.remote.kind}"; '
            "the page needs MQTT: write the name of a broker that robots connect to"
        )
    if not bridge.remote_mqtt.host:
        raise ConfigError(
            "web_interface.mqtt.host: is missing, and so is services.mqtt_bridge.remote_mqtt.host: "
            "write the name of the broker that robots connect to"
        )
    return bridge.remote_mqtt


def _check_readable(key: str, file: Path | None) -> None:
    """Raise ConfigError if there is a file and it cannot be read."""
    try:
        if file is not None:
            file.open("rb").close()
    except OSError as error:
        raise ConfigError(f"{key}: {file} cannot be read: {error.strerror}; `pebble cert init` makes one") from None
