"""Pages at a real server and a real broker: what reaches robots, with and without names, and what does not wait."""

from __future__ import annotations

import itertools
import secrets
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from pebble.contract import CAMERA
from pebble.extensions.media.video import make_encoder
from pebble.transports import MqttSettings, QoS, create
from tests.ext.page.attacker import Hall
from tests.ext.page.served import Page, Served
from tests.kit import mqtt_bytes
from tests.kit.played_robot import RecordingRobot
from tests.support import SOON_S, Broker, beside, until
from tests.tcp_proxy import SlowTcpProxy, TcpProxy

ZERO = {"x": 0.0, "z": 0.0, "y": 0.0}
FINAL = {**ZERO, "valid_ms": 0}
OWNER = {"owner": "serial", "boot": "00000000", "count": 1}
NAMES = itertools.count(1)


def last(robot: RecordingRobot) -> dict[str, Any] | None:
    drives = robot.drives()
    return drives[-1] if drives else None


def test_with_the_lease_a_gesture_moves_the_robot_and_its_release_stops_it(served, page, robot):
    page.drive(robot.base, 1, z=0.5)
    assert until(lambda: page.refused)
    assert page.refused[0] == {
        "op": "refused", "cmd": "drive", "ref": robot.base, "why": "Take control to drive", "g": 1, "n": 0,
    }  # fmt: skip
    assert page.take(robot.base)
    page.drive(robot.base, 2, z=0.5)
    assert until(lambda: last(robot) == {"x": 0.0, "z": 0.5, "y": 0.0, "valid_ms": 400})
    page.drive(robot.base, 2)
    assert until(lambda: last(robot) == ZERO)
    assert [one["z"] for one in robot.drives()] == [0.5, 0.0], "nothing of the first gesture"
    page.drive(robot.base, 3, z=0.5)
    assert until(lambda: last(robot) == FINAL), "a silent page is stopped"
    page.send("estop", ref=robot.base, stop="00000000000000ff", why="button")
    noted = lambda: [one.what for one in served.app.state.audit.read(100) if one.ref == robot.base]
    assert until(lambda: noted() == ["take", "drive", "stop"]), noted()


def test_a_clock_that_jumps_ends_the_connection(page, robot):
    assert page.take(robot.base)
    page.drive(robot.base, 2, z=0.5, age_ms=-5000)
    assert until(lambda: page.closed)
    assert "jumped" in page.bye["why"]
    assert until(lambda: not robot.drives() or last(robot) == FINAL)


def test_an_emergency_stop_is_repeated_until_the_robot_confirms_and_a_reset_names_what_was_shown(page, robot):
    page.send("estop", ref=robot.base, stop="00000000000000aa", why="button")
    assert until(lambda: page.value(robot.base, "web/estop", "sending") == "confirmed")
    view = page.value(robot.base, "web/estop")
    assert (view["latched"], view["by"], view["stop"]) == (True, "somebody at this computer", "00000000000000aa")
    assert page.take(robot.base)
    page.drive(robot.base, 1, z=0.5)
    assert until(lambda: page.refused)
    assert page.refused[0]["why"] == "Stopped by somebody without a login"
    (owner,) = view["owners"]
    shown = {key: owner[key] for key in ("owner", "boot", "count")}
    page.send("estop-reset", ref=robot.base, owners=[{**shown, "count": 99}])
    time.sleep(0.3)
    assert robot.latched
    page.send("estop-reset", ref=robot.base, owners=[shown])
    assert until(lambda: page.value(robot.base, "web/estop", "latched") is False)


def test_what_is_drawn_over_a_picture_comes_with_it(broker, page, robot):
    with RecordingRobot(broker.port, f"{robot.base}-eye") as eye:
        assert page.knows(eye.base)
        page.send("picture-from", ref=robot.base, source=eye.base)
        page.send("watch", ref=robot.base)

        def drawn(shapes):
            eye.publish("video-overlays", {"shapes": shapes})
            eye.publish("sensors/imu", {"value": 1})
            eye.publish("charging-level", {"value": len(shapes)})
            return page.value(eye.base, "video-overlays", "shapes") == shapes

        assert until(lambda: drawn([[[0, 0], [1, 1]]]))
        assert page.value(eye.base, "sensors/imu") is None
        page.send("picture-from", ref=robot.base, source="")
        assert until(lambda: page.value(robot.base, "web/picture-from", "source") == "")
        drawn([])
        assert until(lambda: page.value(eye.base, "charging-level", "value") == 0)
        assert page.value(eye.base, "video-overlays", "shapes") != []


# -- who may


def test_only_roles_with_the_right_take_control_over(broker, tmp_path):
    with (
        Hall(broker.port, tmp_path) as hall,
        RecordingRobot(broker.port, "pebble/robots/keeping", keeps=True) as robot,
        hall.page("admin") as admin,
        hall.page("driver") as driver,
        hall.page("maintainer") as maintainer,
    ):
        for page in (admin, driver, maintainer):
            assert page.knows(robot.base)
        assert admin.take(robot.base)
        driver.send("lease", ref=robot.base, take=True, over=True)
        assert until(lambda: driver.refused)
        assert admin.value(robot.base, "web/driver", "you") is True
        assert maintainer.take(robot.base, over=True)


def test_a_robot_that_checks_names_is_reset_only_by_safety_and_admin(broker, named, tmp_path):
    ref, account = named.base, MqttSettings(host="127.0.0.1", port=broker.port, username="page-1")
    with Hall(broker.port, tmp_path, broker=account) as hall:
        pages = [hall.page(role) for role in ("maintainer", "safety")]
        for page in pages:
            assert page.knows(ref)
            page.send("estop", ref=ref, stop="00c0ffee00c0ffee", why="")
            assert until(lambda page=page: page.value(ref, "web/estop", "latched"))
            page.send("estop-reset", ref=ref, owners=[OWNER])
        assert until(lambda: pages[0].refused)
        assert until(lambda: senders(named, "estop-reset") == ["page-1/safety"])
        assert ["reset" in page.welcome["named_rights"] for page in pages] == [False, True]
        for page in pages:
            page.close()


# -- names


def server(broker: Broker, account: str | None) -> Served:
    return Served(broker.port, broker=MqttSettings(host="127.0.0.1", port=broker.port, username=account))


@pytest.fixture
def named(broker: Broker) -> Iterator[RecordingRobot]:
    """Yield a robot that takes commands only with names."""
    with RecordingRobot(broker.port, f"pebble/robots/named{next(NAMES)}", keeps=True, named=True) as robot:
        yield robot


def senders(robot: RecordingRobot, metric: str) -> list[Any]:
    """Return who has sent each message of this metric."""
    topic = f"{robot.base}/incoming/{metric}"
    return [payload.get("by", "") for _, name, payload in list(robot.received) if name == topic]


def test_everything_has_the_servers_account_in_its_topic_and_the_person_beside_it(broker, named):
    ref = named.base
    with server(broker, "page-1") as hall, hall.page(name="ann") as page:
        assert page.knows(ref)
        assert page.ready()
        assert page.take(ref)
        assert page.value(ref, "web/driver", "checked") is True
        page.drive(ref, 1, z=0.5)
        page.send("lights", ref=ref, r=1.0, n=1)
        page.send("autonomy", ref=ref, file="", n=2)
        page.send("flag", ref=ref, name="mqtt-video", on=True, n=3)
        page.send("estop", ref=ref, stop="00c0ffee00c0ffee", why="")
        assert until(lambda: page.value(ref, "web/estop", "latched") is True)
        page.send("estop-reset", ref=ref, owners=[OWNER])
        assert until(lambda: page.value(ref, "web/estop", "latched") is False)
        for metric in ("control", "drive-values", "lights-solid", "autonomy-command", "estop-reset"):
            assert until(lambda metric=metric: "page-1/ann" in senders(named, metric)), metric
            assert set(senders(named, metric)) <= {"page-1/ann", "page-1"}, metric
        by_name = f"{ref}/incoming/by/page-1/"
        assert until(lambda: f"{by_name}flags/mqtt-video" in named.wire)
        assert f"{by_name}estop" in named.wire
        assert {topic for topic in named.wire if not topic.startswith(by_name)} == {f"{ref}/incoming/estop"}


def test_a_server_without_an_account_stops_and_else_shows_why_it_may_do_nothing(broker, named):
    ref = named.base
    with server(broker, None) as hall, hall.page() as page:
        assert page.knows(ref)
        assert page.ready()
        page.send("lease", ref=ref, take=True)
        page.send("lights", ref=ref, r=1.0, n=1)
        assert until(lambda: len(page.refused) == 2)
        assert {one["why"].partition(",")[0] for one in page.refused} == {f"{ref[14:]} takes commands only with a name"}
        page.send("stop", ref=ref)
        page.send("estop", ref=ref, stop="00c0ffee00c0ffee", why="")
        assert until(lambda: page.value(ref, "web/estop", "sending") == "confirmed")
        assert named.wire == {f"{ref}/incoming/drive-values", f"{ref}/incoming/estop"}


# -- an attacker at the broker


METRICS = ("status", "wheel-odometry", "logs", "mcu/x/describe", "autonomy-status")
ODD = (b"", b"[" * 60_000, b"9" * 60_000, b"\xff\xfe", b'{"t":1e999}', b'{"value":"\\ud800"}', b'{"value":NaN}')


def flood(port: int, messages: Iterable[tuple[str, bytes]]) -> None:
    """Publish everything with QoS 0, as fast as the broker takes it."""
    with socket.create_connection(("127.0.0.1", port), 30) as client:
        client.sendall(mqtt_bytes.connect(None, None))
        assert client.recv(4) == b"\x20\x02\x00\x00"
        for topic, payload in messages:
            client.sendall(mqtt_bytes.publish(topic, payload))
        client.sendall(mqtt_bytes.packet(0xC0, b""))
        assert client.recv(2) == b"\xd0\x00", "the broker has taken everything"


def test_large_and_odd_values_keep_no_page_from_driving(
    broker: Broker, page: Page, robot: RecordingRobot, caplog: pytest.LogCaptureFixture
) -> None:
    page.send("watch", ref=robot.base)
    sizes = (10, 60_000, 70_000, 1_000_000)
    large = (
        (f"pebble/robots/z{number}/outgoing/{metric}", b'{"value":"' + b"x" * sizes[number % 4] + b'"}')
        for number in range(200)
        for metric in ("status", "capabilities")
    )
    flood(broker.port, large)
    flood(broker.port, ((f"{robot.base}/outgoing/{metric}", payload) for payload in ODD for metric in METRICS))
    robot.publish("status", {"value": {"last": 1}})
    assert until(lambda: page.value(robot.base, "status", "value") == {"last": 1}), "what pages get is no JSON"
    assert until(lambda: page.moves(robot))
    page.send("stop", ref=robot.base)
    assert until(lambda: robot.drives()[-1]["z"] == 0)
    assert not page.closed, page.bye
    assert [record for record in caplog.records if record.exc_info] == []


# -- pictures over a slow connection


GOOB = "pebble/robots/goob"
KBITS, PICTURE_HZ = 64, 5
CAN = {
    "drive": {"available": True, "controls": True, "arbitrates": True},
    "estop": {"available": True, "owners": ["serial"]},
    "video": {"available": True, "controls": True, "topic": CAMERA.topic(GOOB), "encodings": ["json"]},
}


@pytest.fixture
def filmed(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, GOOB, capabilities=CAN) as running:
        running.publish_states()
        yield running


@contextmanager
def filming(port: int) -> Iterator[None]:
    """Pictures of goob, all the time, many times as much as the server's connection carries."""
    noise = np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8)
    picture = make_encoder("json", fps=PICTURE_HZ, quality=90).encode(noise, int(1000 * time.time()), keyframe=True)
    assert len(picture) * 8 * PICTURE_HZ > 4000 * KBITS
    ending = threading.Event()

    def film() -> None:
        while not ending.wait(1 / PICTURE_HZ):
            camera.publish(CAMERA.topic(GOOB), picture, qos=QoS.LATEST)

    with create("mqtt", "camera", MqttSettings(host="127.0.0.1", port=port)) as camera, beside(film, ending):
        yield


@contextmanager
def watching(served: Served) -> Iterator[None]:
    """A page that shows the pictures."""
    address = f"ws://127.0.0.1:{served.port}/ws/media?ref={GOOB}&can=json"
    with connect(address, origin=served.origin, max_size=None) as socket:

        def answer() -> None:
            with suppress(ConnectionClosed):
                for frame in socket:
                    socket.send(bytes(frame[:4]) + b"\0")  # type: ignore[arg-type]

        threading.Thread(target=answer, daemon=True).start()
        yield


def stop_s(page: Page) -> float:
    """How long a new emergency stop takes until the page shows that it is confirmed."""
    name, began = secrets.token_hex(8), time.monotonic()
    page.send("estop", ref=GOOB, stop=name, why="button")
    shown = {"sending": "confirmed", "stop": name}
    assert until(lambda: shown.items() <= (page.value(GOOB, "web/estop") or {}).items())
    return time.monotonic() - began


def test_neither_a_stop_nor_a_heartbeat_waits_behind_pictures(broker: Broker, filmed: RecordingRobot) -> None:
    with (
        SlowTcpProxy(broker.port, KBITS) as link,
        Served(link.port) as served,
        served.page() as page,
        filming(broker.port),
        watching(served),
    ):
        assert page.knows(GOOB)
        assert until(lambda: page.value(GOOB, "web/picture", "state") == "flowing")
        took, ages = [], []
        for _ in range(4):
            took.append(stop_s(page))
            passed = link.passed
            assert until(lambda: link.passed > passed + 50 * KBITS), "pictures have ended"  # noqa: B023
            ages.append(page.value(GOOB, "web/liveness", "latency_ms"))
        assert max(took) < SOON_S
        assert max(ages) < 1000 * SOON_S


class NoMediaProxy(TcpProxy):
    """A broker that hangs up on the server's second connection."""

    def passes(self, data: bytes) -> bool:
        return b"pebble-web-media" not in data


def test_driving_goes_on_where_the_second_connection_is_refused(broker: Broker, filmed: RecordingRobot) -> None:
    with NoMediaProxy(broker.port) as proxy, Served(proxy.port) as served, served.page() as page:
        assert page.knows(GOOB)
        assert page.ready()
        with watching(served):
            assert until(lambda: page.value(GOOB, "web/picture", "state") == "silent")
            assert "no connection to the broker for the picture: " in page.value(GOOB, "web/picture", "why")
            assert page.take(GOOB)
            page.drive(GOOB, 1, z=0.5)
            assert until(lambda: any(one["z"] for one in filmed.drives()))
            assert stop_s(page) < 4
