"""Pictures on their way to a server behind a slow connection, and what must not wait for them."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from pebble.contract import CAMERA
from pebble.extensions.media.video import make_encoder
from pebble.transports import MqttSettings, QoS, create
from tests.ext.page.served import FREE, Page, Served
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until
from tests.tcp_proxy import SlowTcpProxy, TcpProxy

GOOB = "pebble/robots/goob"
KBITS, PICTURE_HZ = 64, 5
CAN = {
    "drive": {"available": True, "controls": True, "topic": f"{GOOB}/incoming/drive-values", "arbitrates": True},
    "estop": {"available": True, "owners": ["serial"]},
    "video": {"available": True, "controls": True, "topic": CAMERA.topic(GOOB), "encodings": ["json"]},
}


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, GOOB, capabilities=CAN) as running:
        running.publish("estop/serial", FREE, retain=True)
        yield running


@contextmanager
def filming(port: int) -> Iterator[None]:
    """Pictures of goob, all the time, many times as much as the server's connection carries."""
    noise = np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8)
    picture = make_encoder("json", fps=PICTURE_HZ, quality=90).encode(noise, int(1000 * time.time()), keyframe=True)
    assert len(picture) * 8 * PICTURE_HZ > 4000 * KBITS
    ending = threading.Event()
    with create("mqtt", "camera", MqttSettings(host="127.0.0.1", port=port)) as camera:

        def film() -> None:
            while not ending.wait(1 / PICTURE_HZ):
                camera.publish(CAMERA.topic(GOOB), picture, qos=QoS.LATEST)

        thread = threading.Thread(target=film)
        thread.start()
        try:
            yield
        finally:
            ending.set()
            thread.join()


@contextmanager
def watching(served: Served) -> Iterator[None]:
    """A page that shows the pictures."""
    address = f"ws://127.0.0.1:{served.port}/ws/media?ref={GOOB}&can=json"
    with connect(address, origin=served.origin, max_size=None) as socket:

        def answer() -> None:
            with suppress(ConnectionClosed):
                for frame in socket:
                    socket.send(bytes(frame[:4]) + b"\0")  # type: ignore[arg-type]

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield
    thread.join(5)


def stop_s(page: Page) -> float:
    """How long a new emergency stop takes until the page shows that it is confirmed."""
    name, began = secrets.token_hex(8), time.monotonic()
    page.send("estop", ref=GOOB, stop=name, why="button")
    shown = {"sending": "confirmed", "stop": name}
    assert until(lambda: shown.items() <= (page.value(GOOB, "web/estop") or {}).items(), 10)
    return time.monotonic() - began


def test_neither_a_stop_nor_a_heartbeat_waits_behind_pictures(broker: Broker, robot: RecordingRobot) -> None:
    with (
        SlowTcpProxy(broker.port, KBITS) as link,
        Served(link.port) as served,
        served.page() as page,
        filming(broker.port),
        watching(served),
    ):
        assert page.knows(GOOB)
        assert until(lambda: page.value(GOOB, "web/picture", "state") == "flowing", 30)
        took, ages = [], []
        for _ in range(8):
            took.append(stop_s(page))
            passed = link.passed
            assert until(lambda: link.passed > passed + 50 * KBITS), "pictures have ended"  # noqa: B023
            ages.append(page.value(GOOB, "web/liveness", "latency_ms"))
        assert max(took) < 4
        assert max(ages) < 3000


class NoMediaProxy(TcpProxy):
    """A broker that hangs up on the server's second connection."""

    def passes(self, data: bytes) -> bool:
        return b"pebble-web-media" not in data


def test_driving_goes_on_where_the_second_connection_is_refused(broker: Broker, robot: RecordingRobot) -> None:
    with NoMediaProxy(broker.port) as proxy, Served(proxy.port) as served, served.page() as page:
        assert page.knows(GOOB)
        assert page.ready()
        with watching(served):
            assert until(lambda: page.value(GOOB, "web/picture", "state") == "silent", 10)
            assert "no connection to the broker for the picture: " in page.value(GOOB, "web/picture", "why")
            assert page.take(GOOB)
            page.drive(GOOB, 1, z=0.5)
            assert until(lambda: any(one["z"] for one in robot.drives()))
            assert stop_s(page) < 4
