"""Logging in and out, cookies, and what a session is."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.database import DatabaseError
from pebble.extensions.fleet.people import SESSION_S, People
from pebble.extensions.fleet.roles import Role
from pebble.extensions.page.access import login
from pebble.extensions.page.access.guard import Guard
from pebble.extensions.page.setting import WebSettings
from pebble.transports import MqttSettings
from tests.ext.fleet.conftest import cheap_hashes as cheap_hashes
from tests.support import until

pytestmark = pytest.mark.usefixtures("cheap_hashes")
PASSWORD = "correct horse"
URL = {"http": "http://pebble.test:8080", "https": "https://pebble.test:8080"}
STATIC = files("pebble.extensions.page") / "static"


class Site:
    """The routes of a login behind the guard, and one that names the session."""

    def __init__(self, *, login_: bool = True, https: bool = True) -> None:
        self.people, self.audit = People(None), Audit(None)
        self.people.add("alice", PASSWORD, Role.DRIVER)
        self.settings = WebSettings(
            broker=MqttSettings(host="127.0.0.1"),
            names=("pebble.test:8080",),
            server="<fair> & co",
            login=login_,
            certificate=Path("server.pem") if https else None,
        )
        self.url = URL["https" if https else "http"]
        routes = [Route("/who", _who), *login.routes()]
        self.app = Starlette(routes=routes, middleware=[Middleware(Guard, settings=self.settings)])
        state = self.app.state
        state.recognise = lambda *_: None
        state.settings, state.people, state.audit = self.settings, self.people, self.audit
        pages = {"login.html": (STATIC / "login.html").read_bytes()}
        state.static = SimpleNamespace(files=pages, version="0123456789ab")

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
        answer = await site.log_in(client)
        assert (answer.status_code, answer.json()) == (200, {"ok": True, "why": ""})
        assert (await client.get("/who")).json() == ["alice", "driver"]
        token = client.cookies["__Host-pebble"]
        assert (await site.post(client, "/api/logout", {})).status_code == 200
        assert "__Host-pebble" not in client.cookies
        assert (await client.get("/who", headers={"cookie": f"__Host-pebble={token}"})).json() is None

    site.run(work)
    assert until(lambda: len(site.audit.read(10)) == 2)
    assert [(one.what, one.user, one.address) for one in site.audit.read(10)] == [
        ("login", "alice", "192.0.2.7"),
        ("logout", "alice", "192.0.2.7"),
    ]


@pytest.mark.parametrize(
    ("https", "name", "attributes"),
    [
        (True, "__Host-pebble", {"httponly", "path=/", "samesite=strict", "secure"}),
        (False, "pebble", {"httponly", "path=/", "samesite=strict"}),
    ],
)
def test_the_cookie(https: bool, name: str, attributes: set[str]) -> None:
    site = Site(https=https)
    cookie = site.run(site.log_in).headers["set-cookie"]
    first, *rest = [part.strip() for part in cookie.split(";")]
    assert first.startswith(f"{name}=")
    assert {part.lower() for part in rest} == attributes | {f"max-age={int(SESSION_S)}"}
    removed = site.run(lambda client: site.post(client, "/api/logout", {})).headers["set-cookie"]
    assert removed.startswith(f'{name}="";')
    assert "max-age=0" in removed.lower()
    site.close()


def test_a_new_login_ends_the_old_session(site: Site) -> None:
    async def work(client: httpx.AsyncClient) -> None:
        await site.log_in(client)
        before = client.cookies["__Host-pebble"]
        await site.log_in(client)
        assert client.cookies["__Host-pebble"] != before
        assert site.people.session(before) is None

    site.run(work)


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
    monkeypatch.setattr(site.people, "check", lambda *_: release.wait(10) and None)

    async def work(client: httpx.AsyncClient) -> None:
        tries = [asyncio.create_task(site.log_in(client)) for _ in range(50)]
        await asyncio.sleep(0.2)
        start = time.monotonic()
        assert (await client.get("/who")).status_code == 200
        await asyncio.to_thread(lambda: None)
        assert time.monotonic() - start < 0.5
        assert sum(one.done() for one in tries) == 18, "those beyond 32 are refused at once"
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
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert answer.headers["cache-control"] == "no-store"
    assert '<span class="server">&lt;fair&gt; &amp; co</span>' in answer.text
    assert "./static/0123456789ab/login.js" in answer.text
    assert "{" not in answer.text
    assert "style=" not in answer.text
    assert answer.text.count("<script") == answer.text.count('<script type="module" src="./static/')
