"""``pebble foxglove`` as a process beside a real broker, and robots on it."""

from __future__ import annotations

import json
import re
import select
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pebble.contract import codec
from pebble.contract.channels import Channel
from pebble.transports import MqttSettings, QoS, Transport, create
from tests.commands.command_line import program
from tests.support import Broker

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"


def client(broker: Broker, name: str = "robot") -> Transport:
    return create("mqtt", name, MqttSettings(host="127.0.0.1", port=broker.port)).open(5)


class Live:
    """The process, once it is ready."""

    def __init__(self, robots: Broker | str, *options: str) -> None:
        """``robots``: all of a broker, or a config file."""
        where = (robots,) if isinstance(robots, str) else ("--url", f"mqtt://127.0.0.1:{robots.port}")
        self.process = program("foxglove", *where, "--port", "0", *options)
        assert self.process.stdout is not None
        assert select.select([self.process.stdout], [], [], 30)[0], "nothing was printed"
        self.line = self.process.stdout.readline()
        found = re.search(r"ws://\S+", self.line)
        assert found is not None, self.line + self.errors()
        self.address = found[0]

    def errors(self) -> str:
        self.process.kill()
        return self.process.communicate()[1]

    def end(self, by: signal.Signals = signal.SIGINT) -> tuple[int, str, float]:
        """Exit code, what it printed at last, and how long that took."""
        began = time.monotonic()
        self.process.send_signal(by)
        _, errors = self.process.communicate(timeout=20)
        return self.process.returncode, errors, time.monotonic() - began


@contextmanager
def live(broker: Broker, *options: str) -> Iterator[Live]:
    one = Live(broker, *options)
    try:
        yield one
    finally:
        if one.process.poll() is None:
            one.end()


def publish(robot: Transport, base: str, channel: Channel, value: Any) -> None:
    robot.publish(channel.topic(base), codec.encode(channel, value), qos=QoS.DELIVERED, retain=channel.default_retain)


def run_to_its_end(*arguments: str) -> subprocess.CompletedProcess[str]:
    process = program("foxglove", *arguments)
    out, errors = process.communicate(timeout=60)
    return subprocess.CompletedProcess(arguments, process.returncode, out, errors)


def online(robot: Transport, base: str, count: int = 1) -> None:
    robot.publish(f"{base}/outgoing/online", json.dumps({"t": count}).encode(), qos=QoS.DELIVERED, retain=True)
