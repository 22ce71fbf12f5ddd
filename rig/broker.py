"""MQTT brokers on loopback: mosquitto where it is installed, else amqtt from the extra ``demo``.

Program: ``python -m pebble.rig.broker PORT`` runs amqtt.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import socket
import sys
from collections.abc import Iterator, Sequence
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pebble.errors import PebbleError

HOST = "127.0.0.1"
_SBIN = "/usr/sbin:/usr/local/sbin"  # where Debian puts brokers, outside users' PATH


class BrokerKind(StrEnum):
    MOSQUITTO = "mosquitto"
    EMBEDDED = "embedded"


def best_kind() -> BrokerKind:
    """The best kind of broker installed on this machine. Raises PebbleError with both remedies if there is none."""
    if mosquitto_path() is not None:
        return BrokerKind.MOSQUITTO
    if find_spec("amqtt") is not None:
        return BrokerKind.EMBEDDED
    raise PebbleError(
        "no broker: install mosquitto (apt install mosquitto) or amqtt (pip install 'pebble-robot[demo]')"
    )


def mosquitto_path() -> str | None:
    """None if it is not installed."""
    return shutil.which("mosquitto") or shutil.which("mosquitto", path=_SBIN)


def mosquitto_command(port: int, stem: Path, extra: Sequence[str] = (), host: str = HOST) -> list[str]:
    """The command of a mosquitto on ``port``; writes its configuration to ``stem`` plus ``.conf``."""
    path = mosquitto_path()
    if path is None:
        raise PebbleError("mosquitto is not installed: apt install mosquitto")
    config = stem.with_suffix(".conf")
    lines = [f"listener {port} {host}", "allow_anonymous true", "log_dest stderr", *extra]
    if os.geteuid() == 0:
        lines.append("user root")  # a change of user would undo the parent-death signal that Program sets
    config.write_text("\n".join(lines) + "\n")
    return [path, "-c", str(config)]


def free_port() -> int:
    """An unused TCP port, also where there is no loopback device; in a new network namespace every port is unused."""
    with socket.socket() as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


class _Subscriptions(dict[str, Any]):
    """May grow during an iteration, which amqtt (0.12.1) interrupts to let other tasks run.

    Else a filter that is added meanwhile ends the service of a client, or a message misses subscribers.
    """

    def __iter__(self) -> Iterator[str]:
        return iter(list(self.keys()))

    def items(self) -> Any:
        return list(super().items())


async def serve_amqtt(port: int) -> None:
    """Run amqtt on loopback until the task is cancelled."""
    from amqtt.broker import Broker as AmqttBroker  # optional

    listeners = {"default": {"type": "tcp", "bind": f"{HOST}:{port}"}}
    plugins = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
    broker = AmqttBroker({"listeners": listeners, "plugins": plugins})
    broker._subscriptions = _Subscriptions()
    await broker.start()
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve_amqtt(int(sys.argv[1])))
