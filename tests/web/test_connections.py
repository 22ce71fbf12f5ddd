"""Clients that send or read slowly, or connect too often, are refused; real sockets, a real uvicorn."""

from __future__ import annotations

import asyncio
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from pebble.fleet import certificates
from pebble.web.access import connections
from pebble.web.access.connections import HttpProtocol, Listener, Loop, WebSocketProtocol
from tests.support import until

LARGE = 8_000_000  # more than sockets buffer
UPGRADE = (
    b"GET /ws HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


async def app(scope: Any, receive: Any, send: Any) -> None:
    """``/large`` is large, ``/ws`` accepts and waits; all else says hello."""
    if scope["type"] == "lifespan":
        return
    await receive()
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        while (await receive())["type"] != "websocket.disconnect":
            pass
        return
    body = b"x" * LARGE if scope["path"] == "/large" else b"hello"
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % len(body))]})
    await send({"type": "http.response.body", "body": body})


class Serving:
    """The server in a thread of this process."""

    def __init__(self, listener: Listener, **options: Any) -> None:
        self.listener = listener
        listener.bind(("127.0.0.1", 0))
        self.port = listener.getsockname()[1]
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                http=HttpProtocol,
                ws=WebSocketProtocol,
                log_config=None,
                lifespan="off",
                ws_ping_interval=0.3,
                ws_ping_timeout=0.3,
                **{"timeout_keep_alive": 1, **options},
            )
        )
        self._server.capture_signals = NoSignals  # type: ignore[method-assign]
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert until(lambda: self._server.started)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=Loop) as runner:
            runner.run(self._server.serve(sockets=[self.listener]))

    def connect(self, *, small: bool = False) -> socket.socket:
        client = socket.socket()
        if small:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", self.port))
        client.settimeout(5)
        return client

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join(10)
        self.listener.close()


class NoSignals:
    def __enter__(self) -> None:
        return None

    def __exit__(self, *_: object) -> None:
        return None


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Serving]]:
    for name, seconds in {"HANDSHAKE_S": 0.5, "HEAD_S": 0.5, "RESPONSE_S": 1.0, "FLUSH_S": 0.3}.items():
        monkeypatch.setattr(connections, name, seconds)
    running: list[Serving] = []

    def start(**options: Any) -> Serving:
        limits = {name: options.pop(name) for name in ("limit", "each", "strangers") if name in options}
        running.append(Serving(Listener(socket.AF_INET, **limits), **options))
        return running[-1]

    yield start
    for one in running:
        one.close()


def is_closed(client: socket.socket) -> bool:
    try:
        while client.recv(65536):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        pass
    return True


def ended_after(client: socket.socket, parts: Iterable[bytes] = (), pause: float = 0.02) -> float:
    """Send one part after the other, then nothing; after how many seconds the server closed the connection."""
    start = time.monotonic()
    try:
        for part in parts:
            client.sendall(part)
            time.sleep(pause)
    except (ConnectionError, TimeoutError):
        return time.monotonic() - start
    return time.monotonic() - start if is_closed(client) else float("inf")


def get(client: socket.socket, path: str = "/") -> bytes:
    client.sendall(b"GET %s HTTP/1.1\r\nHost: x\r\n\r\n" % path.encode())
    answer = b""
    while not answer.endswith(b"hello"):
        answer += client.recv(65536)
    return answer


_HEAD = b"GET / HTTP/1.1\r\nHost: x\r\nX-Long: " + b"x" * 1000
_WHOLE, _BEGUN = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"GET / HTTP/1.1\r\n"

#: Requests that are answered before, what is sent then at once, and then piece by piece, and when it is closed: the
#: least shows that it was this limit and no other one.
SLOW: dict[str, tuple[int, bytes, list[bytes], float, float]] = {
    "nothing": (0, b"", [], 0.4, 2),
    "a head of a byte now and then": (0, b"", [bytes([byte]) for byte in _HEAD], 0.3, 2),
    "half a head of a WebSocket": (0, UPGRADE[:-2], [], 0.4, 2),
    "a fourth request that does not end": (3, _BEGUN, [b"X: y\r\n"] * 200, 0.3, 2),
    "a pipelined one": (0, _WHOLE + _BEGUN, [], 0.2, 2.5),
    "no second request": (1, b"", [], 0.6, 2.5),
    "a body that never ends": (0, b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\n", [b"x"] * 400, 0, 4),
}


def test_an_answer_waits_for_no_acknowledgement_of_the_one_before(
    serve: Callable[..., Serving], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[socket.socket] = []
    accept = Listener.accept

    def remember(listener: Listener) -> tuple[socket.socket, Any]:
        taken.append((accepted := accept(listener))[0])
        return accepted

    monkeypatch.setattr(Listener, "accept", remember)
    with serve().connect():
        assert until(lambda: bool(taken) and bool(taken[0].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)))


def test_who_sends_too_slowly_is_closed(serve: Callable[..., Serving]) -> None:
    serving = serve()

    def seconds(answered: int, first: bytes, parts: list[bytes], *_: float) -> float:
        client = serving.connect()
        for _ in range(answered):
            assert get(client).startswith(b"HTTP/1.1 200")
        client.sendall(first)
        return ended_after(client, parts)

    with ThreadPoolExecutor(len(SLOW)) as pool:
        found = dict(zip(SLOW, pool.map(lambda row: seconds(*row), SLOW.values()), strict=True))
    assert {name: took for name, took in found.items() if not SLOW[name][3] <= took <= SLOW[name][4]} == {}


def test_a_slow_but_whole_request_is_answered(serve: Callable[..., Serving]) -> None:
    client = serve().connect()
    for part in (b"GET / HTTP/1.1\r\n", b"Host: x\r\n", b"\r\n"):
        client.sendall(part)
        time.sleep(0.1)
    assert client.recv(65536).startswith(b"HTTP/1.1 200")


def test_a_client_that_does_not_read_is_given_up_also_if_it_asks_for_the_end(serve: Callable[..., Serving]) -> None:
    serving = serve()
    clients = [serving.connect(small=True) for _ in range(2)]
    for client, more in zip(clients, (b"", b"Connection: close\r\n"), strict=True):
        client.sendall(b"GET /large HTTP/1.1\r\nHost: x\r\n%s\r\n" % more)
    assert until(lambda: serving.listener.connections == 2)
    assert until(lambda: serving.listener.connections == 0, 4)
    for client in clients:
        client.close()


def test_an_open_websocket_is_not_limited_but_must_answer_pings(serve: Callable[..., Serving]) -> None:
    client = serve().connect()
    client.sendall(UPGRADE)
    assert b" 101 " in client.recv(65536)
    end = time.monotonic() + 2
    while time.monotonic() < end:
        ping = client.recv(65536)
        assert ping[0] == 0x89
        mask = bytes(4)
        client.sendall(bytes([0x8A, 0x80 | ping[1]]) + mask + ping[2:])
    assert 0.1 <= ended_after(client) <= 2


def test_a_websocket_that_pings_and_does_not_read_costs_no_memory(serve: Callable[..., Serving]) -> None:
    serving = serve()
    client = serving.connect(small=True)
    client.sendall(UPGRADE)
    assert until(lambda: serving.listener.connections == 1)
    ping = bytes([0x89, 0xFD]) + bytes(4) + b"x" * 125
    ended_after(client, [ping * 100] * 100_000, 0)
    assert until(lambda: serving.listener.connections == 0, 4)


#: The users of the first connections ("": without a login; "-": it also sends nothing), and how many of them, and of a
#: flood of 40 silent ones after them, remain in 20 places.
HELD = {
    "without a login": ([""], 12, [""]),
    "without a login, some silent": (["", "-", ""], 12, ["", ""]),
    "more without a login than there are places": ([""] * 14, 12, [""] * 11),
    "a person's and one without a login": (["ann", "ann", ""], 14, ["ann", "ann", ""]),
    "more of one person than one may have": (["ann"] * 8, 16, ["ann"] * 8),
    "of many people, but for the last place": ([f"p{n}" for n in range(20)], 20, [f"p{n}" for n in range(19)]),
}


@pytest.mark.parametrize(("users", "all_in_all", "remaining"), HELD.values(), ids=HELD)
def test_who_has_logged_in_keeps_a_place_and_the_oldest_silent_one_of_the_others_gives_way(
    serve: Callable[..., Serving],
    monkeypatch: pytest.MonkeyPatch,
    users: list[str],
    all_in_all: int,
    remaining: list[str],
) -> None:
    for name, value in {"MAX_PERSON": 4, "HEAD_S": 60.0}.items():
        monkeypatch.setattr(connections, name, value)
    serving = serve(limit=20, strangers=12, timeout_keep_alive=60)
    held: list[tuple[str, socket.socket]] = []
    for user in users:
        client = serving.connect()
        if user != "-":
            get(client)
        if user not in ("", "-"):
            serving.listener.recognise(client.getsockname(), user)
        held.append((user, client))
    flood = [serving.connect() for _ in range(40)]
    expected = len(users) + len(flood) - all_in_all
    assert until(lambda: serving.listener.ended == expected), serving.listener.ended
    assert [user for user, client in held if not _has_ended(client)] == remaining
    assert sum(not _has_ended(client) for client in flood) == all_in_all - len(remaining)
    assert get(serving.connect()).startswith(b"HTTP/1.1 200"), "whoever comes now is served"
    for client in flood:
        client.close()


def _has_ended(client: socket.socket) -> bool:
    client.settimeout(0.05)
    return is_closed(client)


def test_each_other_address_has_its_own_limit(serve: Callable[..., Serving], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "_is_loopback", lambda address: address == "127.0.0.1")
    serving = serve(each=2)

    def connect(address: str) -> socket.socket:
        client = socket.socket()
        client.bind((address, 0))
        client.connect(("127.0.0.1", serving.port))
        client.settimeout(5)
        return client

    held = [connect("127.0.0.2") for _ in range(2)]
    for client in held:
        get(client)
    newest = connect("127.0.0.2")
    assert is_closed(held[0]), "the oldest of its own"
    assert get(connect("127.0.0.3"))
    assert get(newest)
    assert get(held[1])
    local = [connect("127.0.0.1") for _ in range(5)]
    assert all(get(client) for client in local)


def test_a_flood_of_connections_leaves_nothing_behind(serve: Callable[..., Serving]) -> None:
    serving = serve(limit=20)
    for _ in range(300):
        serving.connect().close()
    assert until(lambda: serving.listener.connections == 0)
    assert get(serving.connect()).startswith(b"HTTP/1.1 200")


@pytest.fixture(scope="module")
def tls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tls")
    certificates.init(folder, ["127.0.0.1"])
    return folder


def test_a_tls_handshake_that_does_not_end_is_closed(serve: Callable[..., Serving], tls: Path) -> None:
    serving = serve(ssl_certfile=tls / "server.pem", ssl_keyfile=tls / "server.key")
    silent, half = serving.connect(), serving.connect()
    half.sendall(b"\x16\x03\x01\x02\x00\x01")
    assert until(lambda: serving.listener.connections == 2)
    assert 0.3 <= ended_after(silent) <= 2
    assert until(lambda: serving.listener.connections == 0)
    with ssl.create_default_context(cafile=tls / "ca.pem").wrap_socket(
        serving.connect(), server_hostname="127.0.0.1"
    ) as client:
        assert get(client).startswith(b"HTTP/1.1 200")
        client.sendall(b"GET / HTTP/1.1\r\n")
        assert 0.3 <= ended_after(client) <= 2


def test_garbage_is_answered_and_closed(serve: Callable[..., Serving]) -> None:
    serving = serve()
    for garbage in (b"\x16\x03\x01\x02\x00\x01\x00", b"GET\r\n\r\n", b"\x00" * 100_000, b"GET / HTTP/1.1\r\n\r\n"):
        client = serving.connect()
        client.sendall(garbage)
        assert is_closed(client)
    assert until(lambda: serving.listener.connections == 0)
