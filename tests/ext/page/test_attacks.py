"""Attempts of an attacker with a browser, or with a socket, against the real server: each is refused."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

import httpx
import pytest
from starlette.routing import Route, WebSocketRoute
from websockets.exceptions import ConnectionClosed

from pebble.extensions.fleet.roles import Role
from pebble.extensions.page import app, control
from pebble.extensions.page import messages as m
from tests.ext.page.attacker import PASSWORDS, Everything, Hall
from tests.ext.page.served import Page, Served, now_ms
from tests.kit.played_robot import RecordingRobot
from tests.support import WAIT_S, Broker, until

GOOB = "pebble/robots/goob"
OWNER = {"owner": "serial", "boot": "00000000", "count": 1}
STOP = {"op": "estop", "ref": GOOB, "stop": "0123456789abcdef"}
PUBLIC = {"/login", "/ca.pem", "/healthz", "/api/login", "/api/logout"}
HERE = Path(__file__).resolve().parents[3] / "pebble/extensions/page"


@pytest.fixture(scope="module")
def hall(broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    with Hall(broker.port, tmp_path_factory.mktemp("hall")) as hall:
        yield hall


@pytest.fixture(scope="module")
def everything(broker: Broker) -> Iterator[Everything]:
    recorder = Everything(broker.port)
    yield recorder
    recorder.close()


@pytest.fixture(scope="module")
def goob(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, GOOB) as robot:
        yield robot


def raw(hall: Hall, request: bytes) -> bytes:
    """The answer to these bytes."""
    with socket.create_connection(("127.0.0.1", hall.served.port), 10) as client:
        client.sendall(request)
        return b"".join(iter(lambda: client.recv(65536), b""))


# -- other sites


def test_another_site_opens_no_socket_posts_nothing_and_is_served_nothing(hall: Hall, everything: Everything) -> None:
    """The guard, which test_access has, stands before every route."""
    cookie, origin = hall.cookie("admin"), "http://evil.test"
    for path in hall.routes(WebSocketRoute):
        assert hall.refusal(f"{path}?ref={GOOB}&can=json", cookie=cookie, origin=origin) == 403, path
    with hall.client("admin") as client:
        for path in hall.routes(Route, "POST"):
            assert client.post(path, headers={"origin": origin}, data=STOP).status_code == 403, path
        assert client.get("/").status_code == 200, "the session has ended"
    for path in hall.routes(Route, "GET"):
        request = f"GET {path} HTTP/1.1\r\nHost: evil.test\r\nCookie: {cookie}\r\nConnection: close\r\n\r\n"
        assert raw(hall, request.encode()).startswith(b"HTTP/1.1 421 ")
    assert not {topic for topic in everything.incoming() if topic.endswith("/estop")}


# -- without a session


def revoked(hall: Hall) -> str:
    cookie = hall.cookie("admin")
    hall.people.end_session(cookie.partition("=")[2])
    return cookie


def test_without_a_session_there_is_nothing(hall: Hall, everything: Everything) -> None:
    cookies = {"none": "", "revoked": revoked(hall), "of https": "__Host-" + hall.cookie("admin")}
    for kind, cookie in cookies.items():
        for path in hall.routes(WebSocketRoute):
            assert hall.refusal(f"{path}?ref={GOOB}&can=json", cookie=cookie) == 403, (kind, path)
        with httpx.Client(base_url=hall.served.origin, headers={"cookie": cookie}) as client:
            for path in hall.routes(Route, "GET"):
                if path not in PUBLIC and not path.startswith("/static/"):
                    assert client.get(path).status_code in (303, 401), (kind, path)
            for path in hall.routes(Route, "POST"):
                if path not in PUBLIC:
                    answer = client.post(path, json=STOP, headers={"origin": hall.served.origin})
                    assert answer.status_code == 401, (kind, path)
            form = client.post("/api/estop", data=STOP, headers={"origin": hall.served.origin})
            assert (form.status_code, "log in first" in form.text) == (401, True), kind
    assert not {topic for topic in everything.incoming() if topic.endswith("/estop")}


@pytest.mark.parametrize("how", ["role", "logout"])
def test_a_session_that_is_revoked_while_driving_ends(
    hall: Hall, broker: Broker, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    for module in (app, control):
        monkeypatch.setattr(module, "CHECK_S", 60.0)  # what changes the session ends it
    base = f"pebble/robots/revoked-{how}"
    hall.people.add(f"mallory-{how}", "sentinel of mallory", Role.DRIVER)
    cookie = hall.cookie(f"mallory-{how}")
    with RecordingRobot(broker.port, base) as robot, Page(hall.served, cookie=cookie) as page:
        assert page.knows(base)
        assert page.ready()
        pictures = hall.socket(f"/ws/media?ref={base}&can=json", cookie=cookie)
        assert page.moves(robot)
        if how == "role":
            hall.people.set_role("mallory-role", Role.VIEWER)
        else:
            headers = {"cookie": cookie, "origin": hall.served.origin}
            assert httpx.post(f"{hall.served.origin}/api/logout", json={}, headers=headers).status_code == 200

        def ends() -> bool:
            with suppress(ConnectionClosed):
                page.drive(base, int(now_ms()), z=0.5)
            return page.closed

        assert until(ends, 4.0, step=0.05)
        assert page.bye["why"]
        assert until(lambda: robot.drives()[-1]["z"] == 0), "the wheels stop"
        with pytest.raises(ConnectionClosed):
            pictures.recv(timeout=WAIT_S)
        if how != "role":
            assert hall.refusal("/ws/control", cookie=cookie) == 403
        pictures.close()


# -- roles


def ops(ref: str) -> dict[str, dict[str, Any]]:
    """One message of each kind that a page can send."""
    return {
        "hello": {"version": "x"},
        "echo": {"n": 0, "t": 0},
        "watch": {"ref": ref},
        "read-logs": {"ref": ref, "on": True},
        "lease": {"ref": ref, "take": True, "over": True},
        "drive": {"ref": ref, "g": 1, "t": now_ms(), "z": 0.5},
        "stop": {"ref": ref},
        "estop": {"ref": ref, "stop": "0123456789abcdef"},
        "estop-end": {"stop": "0123456789abcdef"},
        "estop-reset": {"ref": ref, "owners": [OWNER]},
        "picture-from": {"ref": ref, "source": GOOB},
        "lights": {"ref": ref, "r": 1},
        "soundboard": {"ref": ref, "file": "horn.wav"},
        "autonomy": {"ref": ref, "file": "follow"},
        "outlet": {"ref": ref, "outlet": "o1", "on": True},
        "mcu": {"ref": ref, "uid": "imu", "name": "led", "value": {}},
        "action": {"ref": ref, "name": "reboot"},
        "flag": {"ref": ref, "name": "mqtt-video", "on": False},
        "board": {"ref": ref, "do": "allow"},
    }


#: What a viewer may send: it moves nothing and changes nothing for others, but a stop.
FOR_VIEWERS = {"hello", "echo", "watch", "read-logs", "stop", "estop", "estop-end"}


@pytest.mark.parametrize(("role", "may"), [("viewer", FOR_VIEWERS), ("driver", set(ops("")) - {"action", "board"})])
def test_what_a_role_may_not(hall: Hall, broker: Broker, everything: Everything, role: str, may: set[str]) -> None:
    base, asked = f"pebble/robots/seen-by-{role}", sorted(set(ops(GOOB)) - may)
    assert set(ops(GOOB)) == {kind.__struct_config__.tag for kind in get_args(m.FromPage)}
    with RecordingRobot(broker.port, base) as robot, hall.page(role) as page:
        assert page.knows(base)
        assert page.ready()
        for op in asked:
            page.send(op, **ops(base)[op])
        assert until(lambda: len(page.refused) >= len(asked)), page.refused
        why = f"The role {role} may not do this"
        assert [(one["cmd"], one["why"]) for one in page.refused] == [(op, why) for op in asked]
        with hall.client(role) as client:
            assert client.get("/api/audit", params={"ref": base}).status_code == 403
        time.sleep(0.2)
        assert everything.incoming(base) == set()
        page.send("estop", ref=base, stop=role.encode().hex().zfill(16))
        assert until(lambda: robot.latched), "each may stop"


# -- paths


TRAVERSALS = ["../server.py", "..%2fserver.py", "..%252fserver.py", "..%5cserver.py", "//etc/passwd", "main.js%00.py"]


def test_nothing_but_the_pages_files_is_served(hall: Hall) -> None:
    secrets = (HERE / "server.py").read_bytes()[:60], b"root:", b"Traceback"
    for path in TRAVERSALS:
        for place in ("", "r/", "static/", "static/../", f"static/{hall.served.version}/"):
            request = f"GET /{place}{path} HTTP/1.1\r\nHost: 127.0.0.1:{hall.served.port}\r\nConnection: close\r\n\r\n"
            answer = raw(hall, request.encode())
            assert answer.split(b" ", 2)[1] in (b"303", b"307", b"400", b"404"), (place, path, answer[:100])
            assert [secret for secret in secrets if secret in answer] == [], (place, path)


# -- the control socket


_DRIVE = '{"op":"drive","ref":"pebble/robots/goob","g":%s,"t":%s,"x":0,"z":%s}'
#: No messages of the contract: each would be one but for a detail.
BAD_MESSAGES: dict[str, str | bytes] = {
    "z is NaN": _DRIVE % (1, 1, "NaN"),
    "z is too large": _DRIVE % (1, 1, "1.001"),
    "t is infinite": _DRIVE % (1, "Infinity", 0.5),
    "17 KB": json.dumps({"op": "watch", "ref": GOOB, "more": "x" * 17 * 1024}),
    "deep list": "[" * 16_000,
    "half a surrogate": '{"op":"watch","ref":"\\ud800"}',
    "hello again": '{"op":"hello","version":"x"}',
    "binary": b'{"op":"stop","ref":"x"}',
}


@pytest.mark.parametrize("kind", BAD_MESSAGES)
def test_what_is_not_understood_ends_the_connection_and_moves_nothing(
    hall: Hall, goob: RecordingRobot, kind: str
) -> None:
    with hall.page("admin") as page:
        assert page.knows(GOOB)
        assert page.ready()
        assert page.take(GOOB)
        since = time.monotonic()
        page.send_raw(BAD_MESSAGES[kind])
        assert until(lambda: page.closed)
        assert page.bye["why"]
        assert not [one for one in goob.drives(since) if one["x"] or one["z"]]


UNKNOWN = "pebble/robots/unknown"  # a robot that is off is stopped when it comes
REFS = ["#", f"{GOOB}/incoming/drive-values", f"/{GOOB}", "pebble/robots/\0", "__proto__", UNKNOWN]


def test_names_of_robots_are_no_topics(hall: Hall, goob: RecordingRobot, everything: Everything) -> None:
    cookie = hall.cookie("admin")
    with hall.page("admin") as page, hall.client("admin") as client:
        assert page.knows(GOOB)
        assert page.ready()
        for ref in REFS:
            published = len(everything.messages)
            for op, fields in ops(ref).items():
                if op not in {"hello", "echo"}:
                    page.send(op, **fields)
            page.send("watch", ref="")
            assert client.get("/api/snapshot.jpg", params={"ref": ref}).status_code == 404, ref
            time.sleep(0.3)
            assert not page.closed, (ref, page.bye)
            sent = {one.topic for one in everything.messages[published:] if "/incoming/" in one.topic}
            repeated = {f"{UNKNOWN}/incoming/estop", f"{UNKNOWN}/incoming/drive-values"}
            assert sent <= (repeated if ref == UNKNOWN else set()), ref
            page.send("estop-end", stop="0123456789abcdef")
            assert hall.refusal(f"/ws/media?ref={quote(ref)}", cookie=cookie) == 403, ref


def test_a_viewer_does_not_talk(hall: Hall, goob: RecordingRobot) -> None:
    with hall.socket(f"/ws/sound?ref={GOOB}&can=opus", cookie=hall.cookie("viewer")) as talker:
        talker.send(b"\x01" + bytes(648))
        assert json.loads(talker.recv(timeout=WAIT_S)) == {
            "talk": 0,
            "on": False,
            "why": "The role viewer may not do this",
        }


ODD_BODIES = [
    b"", b"[" * 16_000, b"x" * 17_000,
    b'{"op":"estop","ref":"\xff"}', b'{"user":"\xff","password":"x"}', b'{"user":"\\ud800","password":"x"}',
]  # fmt: skip


@pytest.mark.parametrize("body", ODD_BODIES, ids=lambda body: repr(body[:30]))
def test_odd_bodies_stop_nothing(hall: Hall, everything: Everything, body: bytes) -> None:
    headers = {"origin": hall.served.origin, "content-type": "application/json"}
    before = len(everything.incoming())
    with hall.client("admin") as client:
        for path in hall.routes(Route, "POST"):
            if path != "/api/logout":
                expected = (400, 413, *(404,) * ("{" in path))
                assert client.post(path, content=body, headers=headers).status_code in expected, path
    assert len(everything.incoming()) == before


# -- slow and many


def test_a_socket_without_hello_is_closed(hall: Hall, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "HELLO_S", 0.3)
    with hall.socket("/ws/control", cookie=hall.cookie("admin")) as silent:
        assert json.loads(silent.recv(timeout=WAIT_S))["why"] == "no hello"
        with pytest.raises(ConnectionClosed):
            silent.recv(timeout=WAIT_S)


def test_a_viewer_ends_no_other_persons_stop(hall: Hall, everything: Everything) -> None:
    topic = "pebble/robots/off/incoming/estop"
    count = lambda: len([one for one in everything.messages if one.topic == topic])
    with hall.page("driver") as page, hall.page("viewer") as mallory:
        page.send("estop", ref="pebble/robots/off", stop="00000000000000ff")
        assert until(count)
        mallory.send("estop-end", stop="00000000000000ff")
        assert until(lambda: [one["why"] for one in mallory.refused] == ["The role viewer may not do this"])
        before = count()
        assert until(lambda: count() >= before + 2), "it is no longer sent"
        page.send("estop-end", stop="00000000000000ff")


# -- guessing


def test_passwords_cannot_be_guessed(broker: Broker, tmp_path: Path) -> None:
    """How often one may try is tested where people are kept; which address counts is decided here."""
    with Hall(broker.port, tmp_path) as hall, hall.client() as client:

        def log_in(user: str, password: str, **forwarded: str) -> int:
            headers = {"origin": hall.served.origin, **forwarded}
            return client.post("/api/login", json={"user": user, "password": password}, headers=headers).status_code

        assert [log_in(f"x{number}", f"guess {number}") for number in range(7)] == [401] * 5 + [429] * 2
        assert log_in("admin", PASSWORDS["admin"]) == 429, "also for the right one"
        for name in ("x-forwarded-for", "forwarded", "x-real-ip", "x-client-ip"):
            assert log_in("driver", PASSWORDS["driver"], **{name: "192.0.2.1"}) == 429, f"{name} is not believed"
        audit = hall.served.app.state.audit
        assert until(lambda: "login-limited" in {one.what for one in audit.read(9)})


# -- secrets


def test_no_secret_leaves_the_server(broker: Broker, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    hall = Hall(broker.port, tmp_path)
    settings = hall.served.settings
    secret = replace(settings.broker, username="sentinel-user", password="sentinel-broker-password")
    hall.served = Served(broker.port, login=True, people=settings.people, broker=secret)
    seen: list[bytes] = []
    with hall, hall.client("admin") as client, hall.page("admin") as page:
        token = client.headers["cookie"].partition("=")[2]
        for path in hall.routes(Route, "GET"):
            answer = client.get(path)
            seen += [answer.content, str(answer.headers).encode()]
        for password in (PASSWORDS["admin"], "sentinel-guess"):
            body = {"user": "admin", "password": password}
            seen.append(client.post("/api/login", json=body, headers={"origin": hall.served.origin}).content)
        seen.append(repr((page.welcome, page.state)).encode())
        audit = repr(hall.served.app.state.audit.read(1000)).encode()
        everything = b"\n".join([*seen, audit, repr(hall.served.settings).encode(), caplog.text.encode()])
        secrets = ["sentinel-broker-password", token, *PASSWORDS.values(), "sentinel-guess"]
        assert [secret for secret in secrets if secret.encode() in everything] == []
        assert str(tmp_path).encode() not in b"\n".join(seen)
