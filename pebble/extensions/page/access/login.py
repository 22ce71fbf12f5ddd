"""Login, logout, and the session of a request."""

import asyncio
import dataclasses
import html
import logging
import socket
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated

import msgspec
from msgspec import Meta, Struct
from starlette.requests import HTTPConnection, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from pebble.extensions.fleet.database import DatabaseError
from pebble.extensions.fleet.people import SESSION_S, TooManyTriesError, User
from pebble.extensions.fleet.roles import LOCAL, Session
from pebble.extensions.page.setting import WebSettings
from pebble.extensions.page.static_files import root_of
from pebble.runtime.rate_limit import RateLimitedLog

_WAITING = 32  # logins that wait for the thread; each takes some 20 ms
_log = RateLimitedLog(logging.getLogger(__name__), period_s=60.0)
_NO_STORE = {"cache-control": "no-store"}


class Login(Struct, frozen=True):
    """The body of POST /api/login."""

    user: Annotated[str, Meta(max_length=64)]
    password: Annotated[str, Meta(max_length=512)]


_decoder = msgspec.json.Decoder(Login)


class _Hashing:
    """A thread for password hashes, so that other requests do not wait for them."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "login")
        self._waiting = 0

    async def check(self, request: Request, login: Login) -> User | None:
        """Check name and password. Raises TooManyTriesError, also while too many logins wait."""
        if self._waiting >= _WAITING:
            raise TooManyTriesError(5)  # seconds until the next try
        self._waiting += 1
        try:
            check = request.app.state.people.check
            return await asyncio.get_running_loop().run_in_executor(
                self._thread, check, login.user, login.password, address_of(request)
            )
        finally:
            self._waiting -= 1


_hashing = _Hashing()


def routes() -> list[Route]:
    return [
        Route("/login", _page),
        Route("/api/login", _login, methods=["POST"]),
        Route("/api/logout", _logout, methods=["POST"]),
    ]


def session_of(connection: HTTPConnection) -> Session | None:
    """Return the session of a request, read from the database each time; None without one.

    On a server without a login: the session LOCAL, with the person's ``name`` in the query of the address.
    """
    settings: WebSettings = connection.app.state.settings
    session: Session | None = None
    if not settings.login:
        session = named(LOCAL, connection.query_params.get("name", ""))
    elif token := connection.cookies.get(_cookie(settings)):
        session = connection.app.state.people.session(token)
    return session


def named(session: Session, name: str) -> Session:
    """Return the session with a person's ``name``; "" changes nothing. Only on a server without a login."""
    user = printable(name).strip()
    return dataclasses.replace(session, user=user) if user else session


def printable(text: str) -> str:
    """Return a client's text in the form shown to others: at most 32 characters, "?" for all but printable ASCII."""
    return "".join(char if " " <= char <= "~" else "?" for char in text[:32])


def address_of(connection: HTTPConnection) -> str:
    """Return the address of the browser, for the audit log; "" if it is unknown."""
    return connection.client.host if connection.client else ""


def _cookie(settings: WebSettings) -> str:
    """Return the cookie's name. Browsers accept ``__Host-`` names only from this host, over https, for all paths."""
    return "__Host-pebble" if settings.certificate else "pebble"


async def _page(request: Request) -> Response:
    """Answer with the login page; who has a session is sent on."""
    if session_of(request) is not None:
        return Response(status_code=303, headers={"location": root_of(request), **_NO_STORE})
    state = request.app.state
    name = html.escape(state.settings.server or socket.gethostname())
    page = state.static.files["login.html"].decode()
    page = page.replace("{version}", state.static.version).replace("{root}", root_of(request)).replace("{server}", name)
    return Response(page, media_type="text/html; charset=utf-8", headers=_NO_STORE)


async def _login(request: Request) -> Response:
    try:
        login = _decoder.decode(await request.body())
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return _answer(400, "This needs a user and a password")
    audit, address = request.app.state.audit, address_of(request)
    try:
        user = await _hashing.check(request, login)
    except TooManyTriesError as error:
        audit.write("login-limited", user=login.user, address=address)
        wait = max(1, round(error.wait_s))
        return _answer(429, f"Too many tries: wait {wait} s", **{"retry-after": str(wait)})
    except DatabaseError as error:
        return _unavailable("log in", error)
    if user is None:
        audit.write("login-refused", user=login.user, address=address)
        return _answer(401, "User or password is wrong")
    try:
        response = _logged_in(request, user, address)
    except DatabaseError as error:
        return _unavailable("log in", error)
    audit.write("login", user=user.name, address=address)
    return response


def _logged_in(request: Request, user: User, address: str) -> Response:
    """Begin a session in place of the browser's old one; return the answer with its cookie. Raises DatabaseError."""
    settings, people = request.app.state.settings, request.app.state.people
    if old := request.cookies.get(_cookie(settings)):
        people.end_session(old)
    response = _answer(200, "")
    response.set_cookie(
        _cookie(settings),
        people.start_session(user, address),
        max_age=int(SESSION_S),
        path="/",
        secure=settings.certificate is not None,
        httponly=True,
        samesite="strict",
    )
    return response


async def _logout(request: Request) -> Response:
    settings, people = request.app.state.settings, request.app.state.people
    session = session_of(request)
    response = _answer(200, "")
    if settings.login and session is not None:
        try:
            people.end_session(request.cookies[_cookie(settings)])
        except DatabaseError as error:  # this browser forgets its cookie in any case
            response = _unavailable("log out", error)
        request.app.state.audit.write("logout", user=session.user, address=address_of(request))
    secure = settings.certificate is not None
    response.delete_cookie(_cookie(settings), path="/", secure=secure, httponly=True, samesite="strict")
    return response


def _unavailable(action: str, error: DatabaseError) -> JSONResponse:
    _log.log(action, logging.ERROR, "%s: nobody can %s", error, action)
    return _answer(503, f"The server cannot store that you {action}: {error.why}")


def _answer(status: int, why: str, **headers: str) -> JSONResponse:
    return JSONResponse({"ok": status == 200, "why": why}, status, headers={**_NO_STORE, **headers})
