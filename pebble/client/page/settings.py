"""How one server of the operator page is set up: plain data."""

import socket
from dataclasses import dataclass
from pathlib import Path

from pebble.config.security import SecurityLevel
from pebble.transports import MqttSettings

DEFAULT_PORT = 8080


@dataclass(frozen=True, slots=True, kw_only=True)
class WebSettings:
    """``certificate`` and ``key`` None: plain http. ``login`` False: everybody is admin; only on loopback."""

    broker: MqttSettings
    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT  # 0: a free one
    names: tuple[str, ...] = ()  # further host names by which browsers may address it
    server: str = ""  # its name; "": this machine's
    login: bool = False
    level: SecurityLevel = "open"  # of its robots
    people: Path | None = None  # the database of users, sessions and settings; None: in memory
    certificate: Path | None = None
    key: Path | None = None
    recordings: Path | None = None  # the folder of a recorder, to look at; None: none
    authority: Path | None = None  # offered for download, so that phones can trust it
    plain_http_drive: bool = True  # False: over plain http from another machine nothing drives

    @property
    def name(self) -> str:
        """What it is called on pages and for other servers."""
        return self.server or socket.gethostname().partition(".")[0] or "server"
