"""Connections that strangers hold, and a full disk: a real server gives up the ones, and goes on beside the other."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from pebble.extensions.page import serve
from pebble.extensions.page.access import login
from pebble.runtime.rate_limit import RateLimitedLog
from tests.ext.page.attacker import PASSWORDS, Hall
from tests.ext.page.served import Served
from tests.kit.played_robot import RecordingRobot
from tests.small_disk import SmallDisk
from tests.support import Broker, needs_root, until

STOP = {"op": "estop", "stop": "0123456789abcdef"}


def test_held_connections_keep_out_neither_a_person_nor_a_stop(broker: Broker, tmp_path: Path) -> None:
    with (
        Hall(broker.port, tmp_path) as hall,
        RecordingRobot(broker.port, "pebble/robots/held") as robot,
        hall.page("driver") as page,
        ExitStack() as held,
    ):
        assert page.knows(robot.base)
        hall.served.listener.listen(2048)  # as the program does
        for _ in range(400):
            held.enter_context(socket.create_connection(("127.0.0.1", hall.served.port), 5))
        with hall.client("viewer") as client:
            stopped = client.post("/api/estop", json=STOP | {"ref": robot.base}, headers={"origin": hall.served.origin})
            assert (client.get("/healthz").status_code, stopped.status_code) == (200, 202)
        assert until(lambda: robot.latched)
        page.send("estop", ref=robot.base, stop="00000000000000ff")
        assert until(lambda: page.value(robot.base, "web/estop", "stop") == "00000000000000ff")
        assert not page.closed


UPGRADE = (
    b"GET /ws/control HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)


def test_a_connection_without_a_request_is_closed(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve, "REQUEST_S", 0.5)
    with Served(broker.port) as served, ExitStack() as held:
        began = time.monotonic()
        for sent in (b"", b"GET / HTTP/1.1\r\n", UPGRADE):
            held.enter_context(socket.create_connection(("127.0.0.1", served.port), 5)).sendall(sent)
        assert until(lambda: len(served.open) == 3)
        assert until(lambda: not served.open)
        assert time.monotonic() - began > 0.4


@pytest.mark.parametrize(
    ("limits", "sent"),
    [
        ({"UNREAD_S": 1.0}, b"GET /login HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 2000),
        (
            {"PING_S": 0.2, "PONG_S": 0.2},
            UPGRADE.replace(b"Host: x", b"Host: localhost\r\nOrigin: http://localhost") + b"\r\n",
        ),
    ],
    ids=["answers", "a socket with a ping"],
)
def test_a_client_that_reads_nothing_is_closed(
    broker: Broker, monkeypatch: pytest.MonkeyPatch, limits: dict[str, float], sent: bytes
) -> None:
    for name, seconds in limits.items():
        monkeypatch.setattr(serve, name, seconds)
    with Served(broker.port) as served, socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", served.port))
        client.sendall(sent)
        assert until(lambda: len(served.open) == 1)
        assert until(lambda: not served.open)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[SmallDisk]:
    disk = SmallDisk(tmp_path / "state")
    disk.mount()
    yield disk
    disk.close()


@needs_root
def test_with_a_full_disk_a_login_names_what_is_wrong_and_driving_and_stops_go_on(
    broker: Broker, disk: SmallDisk, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(login, "_log", RateLimitedLog(logging.getLogger("login")))  # it has logged nothing yet
    with (
        Hall(broker.port, disk.root, recordings=None) as hall,
        RecordingRobot(broker.port, "pebble/robots/full") as robot,
        hall.page("driver") as page,
        hall.client("driver") as client,
    ):
        headers = {"origin": hall.served.origin}

        def log_in() -> int:
            body = {"user": "admin", "password": PASSWORDS["admin"]}
            with hall.client() as new:
                return new.post("/api/login", json=body, headers=headers).status_code

        assert page.knows(robot.base)
        assert page.ready()
        assert page.take(robot.base)
        with disk.full():
            assert until(lambda: log_in() == 503)
            page.send("picture-from", ref=robot.base, source=robot.base)
            page.drive(robot.base, 1, x=0.5)
            assert until(lambda: any(one.get("x") for one in robot.drives())), page.refused
            assert client.post("/api/estop", json=STOP | {"ref": robot.base}, headers=headers).status_code == 202
            assert until(lambda: robot.latched)
            assert not page.closed
            assert client.get("/").status_code == 200
        assert until(lambda: log_in() == 200)
        assert until(lambda: "stop" in {entry.what for entry in hall.served.app.state.audit.read(100)})
    assert "people.sqlite: database or disk is full: nobody can log in" in caplog.text
    assert [record for record in caplog.records if record.exc_info] == []
