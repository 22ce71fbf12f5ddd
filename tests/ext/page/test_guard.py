"""The guard refuses foreign hosts, foreign origins and large bodies, whatever the application would answer."""

from __future__ import annotations

import asyncio
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.fleet import certificates
from pebble.extensions.page.access import guard as guard_module
from pebble.extensions.page.access.guard import CONTENT_SECURITY_POLICY, FORM, MAX_BODY, Guard
from pebble.extensions.page.setting import WebSettings
from pebble.transports import MqttSettings

HERE = ("127.0.0.1", 8080)
OWN = "127.0.0.1:8080"


class App:
    """Accepts everything, and remembers what it received."""

    def __init__(self) -> None:
        self.requests: list[str] = []
        self.bodies: list[bytes] = []

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self.requests.append(scope["path"])
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.accept"})
            return
        if scope["method"] == "POST":
            self.bodies.append((await receive())["body"])
        headers = [(b"content-security-policy", b"own")] if scope["path"] == "/own" else []
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": b"reached"})


def settings_for(**options: Any) -> WebSettings:
    return WebSettings(broker=MqttSettings(host="127.0.0.1"), **options)


@pytest.fixture
def app() -> App:
    return App()


@pytest.fixture
def guard(app: App) -> Guard:
    return Guard(app, settings=settings_for())


def ask(
    app: Any,
    method: str = "GET",
    path: str = "/",
    headers: list[tuple[str, str]] | dict[str, str] | None = None,
    chunks: list[bytes] | None = None,
    *,
    scheme: str = "http",
) -> tuple[int, dict[str, str], str]:
    """One request as uvicorn hands it over: status, headers and body of the response."""
    pairs = list(headers.items()) if isinstance(headers, dict) else list(headers or [("host", OWN)])
    waiting = [
        {"type": "http.request", "body": chunk, "more_body": number < len(chunks or []) - 1}
        for number, chunk in enumerate(chunks or [b""])
    ]
    sent = _run(app, pairs, waiting, type="http", method=method, scheme=scheme, path=path, server=HERE)
    body = b"".join(message.get("body", b"") for message in sent[1:])
    return sent[0]["status"], {k.decode(): v.decode() for k, v in sent[0]["headers"]}, body.decode()


def connect(app: Any, headers: list[tuple[str, str]], *, scheme: str = "ws", path: str = "/ws/control") -> str:
    """One WebSocket: the type of the first answer."""
    waiting = [{"type": "websocket.connect"}]
    return str(_run(app, headers, waiting, type="websocket", scheme=scheme, path=path, server=HERE)[0]["type"])


def _run(app: Any, headers: list[tuple[str, str]], waiting: list[Any], **scope: Any) -> list[MutableMapping[str, Any]]:
    """What the application sends."""
    sent: list[MutableMapping[str, Any]] = []

    async def receive() -> Any:
        return waiting.pop(0) if waiting else await asyncio.Event().wait()

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    pairs = [(name.lower().encode(), value.encode("latin-1")) for name, value in headers]
    more = {"query_string": b"", "client": ("127.0.0.1", 50000), "headers": pairs}
    asyncio.run(app({**scope, **more}, receive, send))
    return sent


POST = {"host": OWN, "origin": f"http://{OWN}", "content-type": "application/json"}


#: Settings, hosts that are known then, and others.
HOSTS: dict[str, tuple[dict[str, Any], list[str], list[str]]] = {
    "own names": (
        {},
        [OWN, "localhost:8080", "LOCALHOST:8080", "[::1]:8080", "127.0.0.1.:8080", "localhost", "192.168.1.20:8080"],
        ["evil.test:8080", "127.0.0.1.evil.test:8080", "localhost.evil.test:8080", "evil.test:8080@127.0.0.1:8080",
         "127.0.0.1:8080 evil.test", "127.0.0.1:", ":8080", "127.0.0.1:٨٠٨٠".encode().decode("latin-1"),
         "127.0.0.1:99999999999999999999", "::1:8080", "[::1:8080", "[evil.test]:8080", "0x7f.1", "2130706433", ""],
    ),
    "further names": (
        {"names": ("Fair.local", "tunnel.example:9000")},
        ["fair.local:8080", "fair.local", "tunnel.example:9000", "tunnel.example"], ["local:8080", "example:9000"],
    ),
    "for others: the machine's names": (
        {"host": "0.0.0.0"}, ["lab.example.org:8080", "lab.local:8080", "localhost:8080", "[fe80::1]:8080"],
        ["example.org:8080", "evil.test:8080"],
    ),
    "a wildcard covers one level": (
        {"names": ("*.example.org",)}, ["lab.example.org:8080"], ["a.lab.example.org:8080", "example.org:8080"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTS)
def test_only_known_hosts_are_served(app: App, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "Lab.example.org")
    settings, known, others = HOSTS[name]
    guard = Guard(app, settings=settings_for(**settings))
    for host in others:
        status, _, text = ask(guard, headers={"host": host})
        assert (status, "--name" in text) == (421, True), host
    assert app.requests == []
    for host in known:
        assert ask(guard, headers={"host": host})[0] == 200, host


def test_a_request_without_host_or_with_two_is_refused(app: App, guard: Guard) -> None:
    assert ask(guard, headers=[("accept", "*/*")])[0] == 421
    assert ask(guard, headers=[("host", OWN), ("host", OWN)])[0] == 421
    assert app.requests == []


def test_with_a_certificate_it_has_the_names_of_it(app: App, tmp_path: Path) -> None:
    certificates.init(tmp_path, ["robots.local", "10.0.0.5"])
    guard = Guard(app, settings=settings_for(host="0.0.0.0", certificate=tmp_path / "server.pem"))
    assert ask(guard, headers={"host": "robots.local:8080"}, scheme="https")[0] == 200
    assert ask(guard, headers={"host": "10.0.0.5:8080"}, scheme="https")[0] == 200
    assert ask(guard, headers={"host": "other.local:8080"}, scheme="https")[0] == 421


FOREIGN = [
    [],
    [("origin", "null")],
    [("origin", "")],
    [("origin", "http://evil.test")],
    [("origin", "http://127.0.0.1:8081")],
    [("origin", "http://127.0.0.1")],
    [("origin", "https://127.0.0.1:8080")],
    [("origin", "http://localhost:8080")],
    [("origin", "http://127.0.0.1:8080.evil.test")],
    [("origin", "http://127.0.0.1:8080/")],
    [("origin", "http://127.0.0.1:8080"), ("origin", "http://evil.test")],
    [("origin", "http://evil.test http://127.0.0.1:8080")],
]


@pytest.mark.parametrize("kind", ["application/json", FORM])
@pytest.mark.parametrize("origin", FOREIGN)
def test_a_foreign_origin_may_neither_post_nor_open_a_socket(
    app: App, guard: Guard, origin: list[tuple[str, str]], kind: str
) -> None:
    headers = [("host", OWN), ("content-type", kind), *origin]
    status, _, text = ask(guard, "POST", "/api/estop", headers, [b"{}"])
    assert (status, text) == (403, "this request comes from another site\n")
    assert connect(guard, headers) == "websocket.close"
    assert app.requests == []


def test_the_own_origin_may(guard: Guard) -> None:
    assert ask(guard, "POST", "/api/estop", POST, [b"{}"])[0] == 200
    assert connect(guard, list(POST.items())) == "websocket.accept"
    https = {**POST, "origin": f"https://{OWN}"}
    assert connect(guard, list(https.items()), scheme="wss") == "websocket.accept"
    assert connect(guard, list(https.items())) == "websocket.close"


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "CONNECT", "BREW"])
def test_other_methods_are_refused(app: App, guard: Guard, method: str) -> None:
    assert ask(guard, method, headers=POST)[0] == 405
    assert app.requests == []


@pytest.mark.parametrize("kind", ["", "text/plain", FORM, "multipart/form-data", "application/jsonx"])
def test_only_json_is_read_but_for_the_form_of_a_stop(guard: Guard, kind: str) -> None:
    assert ask(guard, "POST", "/api/estop", {**POST, "content-type": kind})[0] == (200 if kind == FORM else 415)
    assert ask(guard, "POST", "/api/login", {**POST, "content-type": kind}, [b"{}"])[0] == 415
    assert ask(guard, "POST", "/api/login", {**POST, "content-type": "Application/JSON; charset=utf-8"})[0] == 200


def test_a_body_is_passed_on_whole_and_a_larger_one_is_not_read_to_the_end(app: App, guard: Guard) -> None:
    assert ask(guard, "POST", "/", POST, [b"x" * 1000, b"y" * (MAX_BODY - 1000)])[0] == 200
    assert app.bodies == [b"x" * 1000 + b"y" * (MAX_BODY - 1000)]
    status, headers, text = ask(guard, "POST", "/", POST, [b"x" * MAX_BODY, b"y", b"never read"])
    assert (status, text, headers["connection"]) == (413, "the body has more than 16384 bytes\n", "close")
    assert len(app.requests) == 1


def test_a_body_that_takes_too_long_is_given_up(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard_module, "BODY_S", 0.05)

    async def slowly(scope: Any, receive: Any, send: Any) -> None:
        async def half() -> Any:
            await asyncio.sleep(0.02)
            return {"type": "http.request", "body": b"x", "more_body": True}

        await Guard(app, settings=settings_for())(scope, half, send)

    assert ask(slowly, "POST", "/", POST)[0] == 408
    assert app.requests == []


def test_a_request_that_waits_while_the_server_ends_gets_an_answer() -> None:
    async def ended(scope: Any, receive: Any, send: Any) -> None:
        async def waits(*_: Any) -> None:
            raise asyncio.CancelledError

        await Guard(waits, settings=settings_for())(scope, receive, send)

    status, _, text = ask(ended)
    assert (status, text) == (503, "the server ends\n")


SECURITY = {
    "content-security-policy": CONTENT_SECURITY_POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


def test_each_response_has_the_security_headers(guard: Guard) -> None:
    for _, headers, _ in (ask(guard), ask(guard, headers={"host": "evil.test"}), ask(guard, "POST")):
        assert SECURITY.items() <= headers.items()
        assert "microphone=(self)" in headers["permissions-policy"]
        assert "access-control-allow-origin" not in headers
    assert ask(guard, path="/own")[1]["content-security-policy"] == "own"


def test_the_policy_has_no_unsafe_source() -> None:
    assert "default-src 'none'" in CONTENT_SECURITY_POLICY
    assert "worker-src 'self'" in CONTENT_SECURITY_POLICY
    assert not [word for word in ("unsafe", "*", "data:") if word in CONTENT_SECURITY_POLICY]
