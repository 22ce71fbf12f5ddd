"""``pebble foxglove`` in a thread, or as a process, beside a real broker, and robots on it."""

from __future__ import annotations

import asyncio
import json
import re
import select
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext, suppress
from typing import Any

from pebble.contract import codec
from pebble.contract.channels import Channel
from pebble.extensions.foxglove.run import Settings, serve
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
        assert found is not None, self.line
        self.address = found[0]

    def end(self, by: signal.Signals = signal.SIGINT) -> tuple[int, str]:
        """Exit code, and what it printed at last."""
        self.process.send_signal(by)
        _, errors = self.process.communicate(timeout=5)
        return self.process.returncode, errors


class Inside:
    """The same in a thread of this process."""

    def __init__(self, broker: Broker) -> None:
        where = MqttSettings(host="127.0.0.1", port=broker.port)
        self._settings = Settings(where, f"mqtt://127.0.0.1:{broker.port}", "+/+/+", "127.0.0.1", 0)
        self._ready: Future[str] = Future()
        self._loop, self._ending = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self.address = self._ready.result(30)

    def end(self) -> None:
        with suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(20)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(serve(self._settings, self._ready.set_result, nullcontext(self._ending)))


@contextmanager
def live(broker: Broker) -> Iterator[Inside]:
    one = Inside(broker)
    try:
        yield one
    finally:
        one.end()


def publish(robot: Transport, base: str, channel: Channel, value: Any) -> None:
    robot.publish(channel.topic(base), codec.encode(channel, value), qos=QoS.DELIVERED, retain=channel.default_retain)


def online(robot: Transport, base: str, count: int = 1) -> None:
    robot.publish(f"{base}/outgoing/online", json.dumps({"t": count}).encode(), qos=QoS.DELIVERED, retain=True)
