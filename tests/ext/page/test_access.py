"""Access to the page: the guard refuses foreign hosts, origins and large bodies; logins, cookies and sessions."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterator, MutableMapping
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.database import DatabaseError
from pebble.extensions.fleet.people import SESSION_S
from pebble.extensions.fleet.roles import Role
from pebble.extensions.page.access import guard as guard_module
from pebble.extensions.page.access import login
from pebble.extensions.page.access.guard import CONTENT_SECURITY_POLICY, FORM, MAX_BODY, Guard
from pebble.extensions.page.app import create_app
from pebble.extensions.page.setting import WebSettings
from pebble.transports import MqttSettings
from tests.ext.fleet.conftest import cheap_hashes as cheap_hashes
from tests.support import WAIT_S, quickly, until

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
    app: Any, method: str = "GET", path: str = "/", headers: Any = None, chunks: Any = (b"",), *, scheme: str = "http"
) -> tuple[int, dict[str, str], str]:
    """Return status, headers and body of the response to a request, as uvicorn hands it over."""
    more = [{"type": "http.request", "body": chunk, "more_body": True} for chunk in chunks]
    more[-1]["more_body"] = False
    sent = _run(app, headers or [("host", OWN)], more, type="http", method=method, scheme=scheme, path=path)
    body = b"".join(message.get("body", b"") for message in sent[1:])
    return sent[0]["status"], {k.decode(): v.decode() for k, v in sent[0]["headers"]}, body.decode()


def connect(app: Any, headers: Any, *, scheme: str = "ws") -> str:
    """Return the type of the first answer to a WebSocket."""
    waiting = [{"type": "websocket.connect"}]
    return str(_run(app, headers, waiting, type="websocket", scheme=scheme, path="/ws/control")[0]["type"])


def _run(app: Any, headers: Any, waiting: list[Any], **scope: Any) -> list[MutableMapping[str, Any]]:
    """Return what the application sends."""
    sent: list[MutableMapping[str, Any]] = []

    async def receive() -> Any:
        return waiting.pop(0) if waiting else await asyncio.Event().wait()

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    given = headers.items() if isinstance(headers, dict) else headers
    pairs = [(name.lower().encode(), value.encode("latin-1")) for name, value in given]
    usual = {"query_string": b"", "client": ("127.0.0.1", 50000), "server": ("127.0.0.1", 8080), "headers": pairs}
    asyncio.run(app({**scope, **usual}, receive, send))
    return sent


POST = {"host": OWN, "origin": f"http://{OWN}", "content-type": "application/json"}


#: Settings, hosts that are known then, and others.
HOSTS: dict[str, tuple[dict[str, Any], list[str], list[str]]] = {
    "own names": (
        {},
        [OWN, "LOCALHOST:8080", "[::1]:8080", "127.0.0.1.:8080", "localhost", "192.168.1.20:8080"],
        ["evil.test:8080", "127.0.0.1.evil.test:8080", "evil.test:8080@127.0.0.1:8080", "127.0.0.1:8080 evil.test",
         "127.0.0.1:", ":8080", "127.0.0.1:٨٠٨٠".encode().decode("latin-1"), "127.0.0.1:99999999999999999999",
         "[::1:8080", "[evil.test]:8080", "2130706433", ""],
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
    for host, status in (("robots.local", 200), ("10.0.0.5", 200), ("other.local", 421)):
        assert ask(guard, headers={"host": f"{host}:8080"}, scheme="https")[0] == status


#: Values of the header, of which there may be several.
FOREIGN = [
    (), ("null",), ("http://evil.test",), ("http://127.0.0.1:8081",), ("http://127.0.0.1",), ("https://127.0.0.1:8080",),
    ("http://localhost:8080",), ("http://127.0.0.1:8080/",), ("http://127.0.0.1:8080", "http://evil.test"),
]  # fmt: skip


@pytest.mark.parametrize("origins", FOREIGN)
def test_a_foreign_origin_may_neither_post_nor_open_a_socket(app: App, guard: Guard, origins: tuple[str, ...]) -> None:
    for kind in ("application/json", FORM):
        headers = [("host", OWN), ("content-type", kind), *(("origin", origin) for origin in origins)]
        status, _, text = ask(guard, "POST", "/api/estop", headers, [b"{}"])
        assert (status, text) == (403, "this request comes from another site\n")
        assert connect(guard, headers) == "websocket.close"
    assert app.requests == []


def test_its_own_origin_may(guard: Guard) -> None:
    assert ask(guard, "POST", "/api/estop", POST, [b"{}"])[0] == 200
    assert connect(guard, POST) == "websocket.accept"
    https = {**POST, "origin": f"https://{OWN}"}
    assert connect(guard, https, scheme="wss") == "websocket.accept"
    assert connect(guard, https) == "websocket.close"


def test_other_methods_are_refused(app: App, guard: Guard) -> None:
    assert {ask(guard, method, headers=POST)[0] for method in ("PUT", "OPTIONS", "BREW")} == {405}
    assert app.requests == []


def test_only_json_is_read_but_for_the_form_of_a_stop(guard: Guard) -> None:
    for kind in ("", "text/plain", FORM, "application/jsonx"):
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


def test_each_response_has_the_security_headers(guard: Guard) -> None:
    wanted = {
        "content-security-policy": CONTENT_SECURITY_POLICY,
        "x-content-type-options": "nosniff",
        "x-frame-options": "DENY",
        "referrer-policy": "no-referrer",
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-resource-policy": "same-origin",
        "cache-control": "no-store",
    }
    for _, headers, _ in (ask(guard), ask(guard, headers={"host": "evil.test"}), ask(guard, "POST")):
        assert wanted.items() <= headers.items()
        assert "microphone=(self)" in headers["permissions-policy"]
        assert "access-control-allow-origin" not in headers
    assert ask(guard, path="/own")[1]["content-security-policy"] == "own"
    assert "default-src 'none'" in CONTENT_SECURITY_POLICY
    assert not [word for word in ("unsafe", "*", "data:") if word in CONTENT_SECURITY_POLICY]


# -- logins


pytestmark = pytest.mark.usefixtures("cheap_hashes")
PASSWORD = "correct horse"
URL = {"http": "http://pebble.test:8080", "https": "https://pebble.test:8080"}


class Site:
    """The routes of a server that is not connected, and one that names the session."""

    def __init__(self, *, login_: bool = True, https: bool = True) -> None:
        settings = WebSettings(
            broker=MqttSettings(host="127.0.0.1"),
            names=("pebble.test:8080",),
            server="<fair> & co",
            login=login_,
            certificate=Path("server.pem") if https else None,
        )
        self.url = URL["https" if https else "http"]
        self.app = create_app(settings)
        self.people, self.audit = self.app.state.people, Audit(None)
        self.people.add("alice", PASSWORD, Role.DRIVER)
        self.app.state.audit = self.audit
        self.app.routes.append(Route("/who", _who))

    def run(self, work: Callable[[httpx.AsyncClient], Awaitable[Any]], address: str = "192.0.2.7") -> Any:
        async def inside() -> Any:
            transport = httpx.ASGITransport(app=self.app, client=(address, 50000))
            async with httpx.AsyncClient(transport=transport, base_url=self.url) as client:
                return await work(client)

        return asyncio.run(inside())

    async def post(self, client: httpx.AsyncClient, path: str, body: Any) -> httpx.Response:
        return await client.post(path, json=body, headers={"origin": self.url})

    async def log_in(self, client: httpx.AsyncClient, user: str = "alice", password: str = PASSWORD) -> httpx.Response:
        return await self.post(client, "/api/login", {"user": user, "password": password})

    def close(self) -> None:
        self.audit.close()
        self.people.close()


async def _who(request: Request) -> JSONResponse:
    session = login.session_of(request)
    return JSONResponse(None if session is None else [session.user, session.role])


@pytest.fixture
def site() -> Iterator[Site]:
    site = Site()
    yield site
    site.close()


def test_a_login_lasts_until_logout(site: Site) -> None:
    async def work(client: httpx.AsyncClient) -> None:
        assert (await client.get("/who")).json() is None
        await site.log_in(client)
        before = client.cookies["__Host-pebble"]
        answer = await site.log_in(client)
        assert (answer.status_code, answer.json()) == (200, {"ok": True, "why": ""})
        assert (await client.get("/who")).json() == ["alice", "driver"]
        token = client.cookies["__Host-pebble"]
        assert (site.people.session(before), token != before) == (None, True)
        assert (await site.post(client, "/api/logout", {})).status_code == 200
        assert "__Host-pebble" not in client.cookies
        assert (await client.get("/who", headers={"cookie": f"__Host-pebble={token}"})).json() is None

    site.run(work)
    noted = lambda: {(one.what, one.user, one.address) for one in site.audit.read(10)}
    assert until(lambda: noted() == {(what, "alice", "192.0.2.7") for what in ("login", "logout")})


@pytest.mark.parametrize(
    ("https", "name", "more"), [(True, "__Host-pebble", {"secure"}), (False, "pebble", set[str]())]
)
def test_the_cookie(https: bool, name: str, more: set[str]) -> None:
    site = Site(https=https)
    cookie = site.run(site.log_in).headers["set-cookie"]
    first, *rest = [part.strip() for part in cookie.split(";")]
    assert first.startswith(f"{name}=")
    usual = {"httponly", "path=/", "samesite=strict", f"max-age={int(SESSION_S)}"}
    assert {part.lower() for part in rest} == usual | more
    removed = site.run(lambda client: site.post(client, "/api/logout", {})).headers["set-cookie"]
    assert removed.startswith(f'{name}="";')
    site.close()


def test_wrong_passwords_and_unknown_names_have_the_same_answer(site: Site) -> None:
    async def work(client: httpx.AsyncClient) -> list[httpx.Response]:
        return [await site.log_in(client, "alice", "wrong horse"), await site.log_in(client, "bob", "wrong horse")]

    wrong, unknown = site.run(work)
    assert wrong.status_code == unknown.status_code == 401
    assert wrong.content == unknown.content == b'{"ok":false,"why":"User or password is wrong"}'
    assert wrong.headers == unknown.headers
    assert until(lambda: [(one.what, one.user) for one in site.audit.read(10)] == [("login-refused", "alice")])


def test_while_the_database_cannot_be_written_a_login_says_so(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def is_full(*_: object) -> None:
        raise DatabaseError(None, OSError("disk is full"))

    for step in ("check", "start_session"):
        with monkeypatch.context() as patched:
            patched.setattr(site.people, step, is_full)
            assert site.run(site.log_in).status_code == 503, step
    assert site.run(site.log_in).status_code == 200


def test_password_hashes_hold_up_nothing_else(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()
    monkeypatch.setattr(site.people, "check", lambda *_: release.wait(WAIT_S) and None)

    async def work(client: httpx.AsyncClient) -> None:
        tries = [asyncio.create_task(site.log_in(client)) for _ in range(50)]
        while sum(one.done() for one in tries) < 18:  # those beyond 32 are refused at once
            await asyncio.sleep(0.02)
        with quickly():
            assert (await client.get("/who")).status_code == 200
            await asyncio.to_thread(lambda: None)
        assert sum(one.done() for one in tries) == 18
        release.set()
        codes = [answer.status_code for answer in await asyncio.gather(*tries)]
        assert (codes.count(401), codes.count(429)) == (32, 18)

    site.run(work)


def test_without_login_everybody_is_admin() -> None:
    site = Site(login_=False, https=False)
    assert site.run(lambda client: client.get("/who")).json() == ["local", "admin"]
    answer = site.run(lambda client: client.get("/login"))
    assert (answer.status_code, answer.headers["location"]) == (303, "./")
    assert site.run(lambda client: site.post(client, "/api/logout", {})).status_code == 200
    site.close()


def test_the_page_names_the_server_and_needs_no_session(site: Site) -> None:
    answer = site.run(lambda client: client.get("/login"))
    assert (answer.status_code, answer.headers["cache-control"]) == (200, "no-store")
    assert '<span class="server">&lt;fair&gt; &amp; co</span>' in answer.text
    assert f"./static/{site.app.state.version}/login.js" in answer.text
    assert "{" not in answer.text
    assert "style=" not in answer.text
