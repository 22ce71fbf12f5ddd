"""MQTT brokers for the demo, on loopback: mosquitto where it is installed, else amqtt from the extra ``demo``."""

from __future__ import annotations

import os
import shutil
import socket
import sys
import threading
from collections.abc import Sequence
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path

from pebble.demo.programs import Program
from pebble.errors import PebbleError

_HOST = "127.0.0.1"
_SBIN = "/usr/sbin:/usr/local/sbin"  # where Debian puts brokers and users' PATH does not look
_START_S = 15.0  # amqtt takes a while to import on a small machine


class BrokerKind(StrEnum):
    MOSQUITTO = "mosquitto"
    EMBEDDED = "embedded"


class Broker:
    """A running broker; ``program`` is to be ended by whoever made it."""

    def __init__(self, name: str, kind: BrokerKind, folder: Path, extra: Sequence[str] = ()) -> None:
        """``extra``: more lines for mosquitto's configuration; amqtt has none."""
        self.port = free_port()
        mosquitto = kind is BrokerKind.MOSQUITTO
        command = mosquitto_command(self.port, folder / name, extra) if mosquitto else _amqtt(self.port)
        self.program = Program(name, command, folder / f"{name}.log")

    def wait(self, ending: threading.Event) -> None:
        """Until it answers, or ``ending``; raises PebbleError if it does not, or has ended: then a stranger answers."""
        self.program.wait_until(lambda: self._answers() and not self.program.ended, _START_S, ending)

    def _answers(self) -> bool:
        try:
            socket.create_connection((_HOST, self.port), 0.2).close()
        except OSError:
            return False
        return True


def best_kind() -> BrokerKind:
    """What this machine has. Raises PebbleError naming both remedies when it has neither."""
    if _mosquitto_path() is not None:
        return BrokerKind.MOSQUITTO
    if find_spec("amqtt") is not None:
        return BrokerKind.EMBEDDED
    raise PebbleError(
        "no broker: install mosquitto (apt install mosquitto) or amqtt (pip install 'pebble-robot[demo]')"
    )


def _mosquitto_path() -> str | None:
    return shutil.which("mosquitto") or shutil.which("mosquitto", path=_SBIN)


def mosquitto_command(port: int, stem: Path, extra: Sequence[str] = (), host: str = _HOST) -> list[str]:
    """How to start one that listens there; its configuration is written to ``stem`` and ``.conf``."""
    path = _mosquitto_path()
    if path is None:
        raise PebbleError("mosquitto is not installed: apt install mosquitto")
    config = stem.with_suffix(".conf")
    lines = [f"listener {port} {host}", "allow_anonymous true", "log_dest stderr", *extra]
    if os.geteuid() == 0:
        lines.append("user root")  # a change of user would undo the tie to our life that Program made
    config.write_text("\n".join(lines) + "\n")
    return [path, "-c", str(config)]


def _amqtt(port: int) -> list[str]:
    return [sys.executable, "-m", "pebble.demo.embedded_broker", str(port)]


def free_port() -> int:
    """Nobody listens on it here, with or without a loopback device; in a new network namespace nobody does anyway."""
    with socket.socket() as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])
