"""A server with a login and people of each role, and the tools of an attacker: raw sockets, foreign headers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

import httpx
from starlette.routing import Route, WebSocketRoute
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from pebble.extensions.fleet.people import People, User
from pebble.extensions.fleet.roles import Role
from pebble.transports import Message, MqttSettings, create
from tests.ext.page.served import Page, Served
from tests.support import WAIT_S

PASSWORDS = {role.value: f"sentinel-password-of-{role.value}" for role in Role}


@cache
def _one_of_each_role() -> bytes:
    """The database, made once: each password costs a fraction of a second."""
    with TemporaryDirectory() as folder:
        people = People(file := Path(folder) / "people.sqlite")
        for role in Role:
            people.add(role.value, PASSWORDS[role.value], role)
        people.close()
        return file.read_bytes()


class Hall:
    """A server with a login; each role has a person of that name."""

    def __init__(self, broker_port: int, folder: Path, **settings: Any) -> None:
        (folder / "people.sqlite").write_bytes(_one_of_each_role())
        self.people = People(folder / "people.sqlite")
        more = {"people": folder / "people.sqlite", "recordings": folder, **settings}
        self.served = Served(broker_port, login=True, **more)

    def __enter__(self) -> Self:
        self.served.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.served.__exit__(kind, error, tb)
        self.people.close()

    def cookie(self, name: str) -> str:
        """A new session."""
        role = next(user.role for user in self.people.list() if user.name == name)
        return f"pebble={self.people.start_session(User(name, role))}"

    def page(self, name: str, **options: Any) -> Page:
        return Page(self.served, cookie=self.cookie(name), **options)

    def client(self, name: str = "") -> httpx.Client:
        """Opens a connection for each request: on one that is kept, an answer may wait for an acknowledgement."""
        headers = {"cookie": self.cookie(name)} if name else {}
        limits = httpx.Limits(max_keepalive_connections=0)
        return httpx.Client(base_url=self.served.origin, headers=headers, timeout=WAIT_S, limits=limits)

    def socket(self, path: str, *, cookie: str = "", origin: str | None = "") -> ClientConnection:
        """A WebSocket with these headers. Raises InvalidStatus."""
        headers = {"cookie": cookie} if cookie else {}
        url = f"ws://127.0.0.1:{self.served.port}{path}"
        own = self.served.origin if origin == "" else origin
        return connect(url, origin=own, additional_headers=headers, max_size=None)  # type: ignore[arg-type]

    def refusal(self, path: str, **options: Any) -> int:
        """The status with which a WebSocket is refused; 101 if it is not."""
        try:
            self.socket(path, **options).close()
        except InvalidStatus as refused:
            return refused.response.status_code
        return 101

    def routes(self, kind: type[Route] | type[WebSocketRoute], method: str = "") -> Iterator[str]:
        """The paths that the server has, with something in place of parameters."""
        for route in self.served.app.routes:
            if isinstance(route, kind) and (not method or method in getattr(route, "methods", ())):
                yield route.path.replace("{ref:path}", "pebble/robots/goob").replace(
                    "{version}/{name:path}", f"{self.served.version}/main.js"
                )


class Everything:
    """Records all messages of a broker."""

    def __init__(self, port: int) -> None:
        self.messages: list[Message] = []
        self._transport = create("mqtt", "everything", MqttSettings(host="127.0.0.1", port=port))
        self._transport.open()
        self._transport.subscribe("#", self.messages.append, direct=True)

    def incoming(self, base: str = "") -> set[str]:
        """Return the topics of commands, to this component or to any."""
        return {one.topic for one in list(self.messages) if "/incoming/" in one.topic and one.topic.startswith(base)}

    def latched(self, name: str) -> bool:
        """True if all motor owners of this robot say that they are stopped."""
        prefix = f"pebble/robots/{name}/outgoing/estop/"
        states = {one.topic: one.payload for one in list(self.messages) if one.topic.startswith(prefix)}
        return bool(states) and all(json.loads(state)["latched"] for state in states.values())

    def close(self) -> None:
        self._transport.close()
