"""`pebble topic expand`, and the page's server with `web_interface.expand`, at a real broker."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest

from pebble.extensions.page.server import expand
from pebble.extensions.thin.packed import joined, packed
from pebble.transports import MqttSettings, QoS, create
from tests.support import ROOT, Broker, Child, until

BASE = "pebble/robots/goob"
STREAMS = {"touch-sensors": b'{"value": {"a0": 1}}', "wheel-odometry": b'{"value": {"x": 1.50}}'}
TEXT = joined(STREAMS)


@contextmanager
def command(broker: Broker) -> Iterator[None]:
    words = [sys.executable, "-m", "pebble.cli", "topic", "expand", f"mqtt://127.0.0.1:{broker.port}"]
    process = Child(words, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(10)


@contextmanager
def page(broker: Broker) -> Iterator[None]:
    loop = asyncio.new_event_loop()
    task = loop.create_task(expand(MqttSettings(host="127.0.0.1", port=broker.port)))
    thread = threading.Thread(target=_run, args=(loop, task))
    thread.start()
    try:
        yield
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(10)


def _run(loop: asyncio.AbstractEventLoop, task: asyncio.Task[None]) -> None:
    with suppress(asyncio.CancelledError):
        loop.run_until_complete(task)


@pytest.mark.parametrize("beside", [command, page])
def test_plain_topics_come_of_groups(broker: Broker, beside: Callable[[Broker], Iterator[None]]) -> None:
    seen: dict[str, bytes] = {}
    robot = create("mqtt", "robot", MqttSettings(host="127.0.0.1", port=broker.port)).open(10)
    robot.subscribe(f"{BASE}/#", lambda message: seen.update({message.topic: message.payload}), qos=QoS.DELIVERED)
    wire = b'{"group_hz": 2, "dict_id": 3, "dict": "%s"}' % TEXT.replace(b'"', b'\\"')
    robot.publish(f"{BASE}/outgoing/wire", wire, qos=QoS.DELIVERED, retain=True)
    with beside(broker):  # type: ignore[attr-defined]
        assert until(lambda: f"{BASE}/incoming/expander" in seen, 30)

        def comes() -> bool:
            robot.publish(f"{BASE}/outgoing/group", packed(TEXT, 3, TEXT), qos=QoS.LATEST)
            return until(lambda: all(seen.get(f"{BASE}/outgoing/{metric}") for metric in STREAMS), 1)

        assert until(comes, 20)
    assert {metric: seen[f"{BASE}/outgoing/{metric}"] for metric in STREAMS} == STREAMS
    robot.close()
