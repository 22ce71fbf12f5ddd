"""A server of the operator page in a thread, and a page without a browser."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from types import TracebackType
from typing import Any, Self

import uvicorn
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from pebble.extensions.page.serve import listen, server_config
from pebble.extensions.page.setting import WebSettings
from pebble.transports import MqttSettings
from tests.kit.played_robot import RecordingRobot
from tests.support import WAIT_S, until


class Served:
    """One server on a free loopback port; everything runs in this process, except the broker."""

    def __init__(self, broker_port: int, **settings: Any) -> None:
        broker = MqttSettings(host="127.0.0.1", port=broker_port)
        self.settings = WebSettings(**{"broker": broker, "port": 0, "server": "hall", **settings})
        self.listener = listen(self.settings)
        self.port = int(self.listener.getsockname()[1])
        self._uvicorn = uvicorn.Server(server_config(self.settings))
        self._thread = threading.Thread(target=self._run, name="served", daemon=True)

    @property
    def app(self) -> Any:
        return self._uvicorn.config.app

    @property
    def version(self) -> str:
        return str(self.app.state.version)

    @property
    def open(self) -> set[Any]:
        """The connections that are open."""
        return self._uvicorn.server_state.connections

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self._thread.start()
        assert until(lambda: self._uvicorn.started), "the server did not start"
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._uvicorn.should_exit = True
        self._thread.join(WAIT_S)
        self.listener.close()
        assert not self._thread.is_alive(), "the server did not end"

    def page(self, **options: Any) -> Page:
        return Page(self, **options)

    def _run(self) -> None:
        asyncio.run(self._uvicorn.serve(sockets=[self.listener]))


class Page:
    """What a page's control socket does: hello, echoes, and whatever a test sends."""

    def __init__(
        self, served: Served, *, device: str = "test", name: str = "", version: str = "", cookie: str = ""
    ) -> None:
        headers = {"cookie": cookie} if cookie else None
        self.state: dict[tuple[str, str], Any] = {}
        self.refused: list[dict[str, Any]] = []
        self.done: list[dict[str, Any]] = []
        self.logs: list[dict[str, Any]] = []  # with their lines
        self.welcome: dict[str, Any] = {}
        self.bye: dict[str, Any] = {}
        self.closed = False
        self.answers = True  # False: as a page that stands still
        self._socket: ClientConnection = connect(
            f"ws://127.0.0.1:{served.port}/ws/control", origin=served.origin, additional_headers=headers, max_size=None
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.send("hello", version=version or served.version, device=device, name=name)
        assert until(lambda: self.welcome or self.closed)

    def send(self, op: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"op": op, **fields}))

    def send_raw(self, data: str | bytes) -> None:
        self._socket.send(data)

    def drive(self, ref: str, g: int, *, x: float = 0.0, z: float = 0.0, age_ms: float = 0.0, **more: Any) -> None:
        self.send("drive", ref=ref, g=g, t=now_ms() - age_ms, x=x, z=z, **more)

    def take(self, ref: str, *, over: bool = False) -> bool:
        self.send("lease", ref=ref, take=True, over=over)
        return until(lambda: self.value(ref, "web/driver", "you") is True)

    def moves(self, robot: RecordingRobot) -> bool:
        """Take control and move the robot; each call is a new gesture."""
        gesture, since = int(now_ms()), time.monotonic()
        self.send("lease", ref=robot.base, take=True)

        def moved() -> bool:
            self.drive(robot.base, gesture, z=0.5)
            return any(one["z"] for one in robot.drives(since))

        return until(moved, 2, step=0.05)

    def value(self, ref: str, metric: str, field: str | None = None) -> Any:
        value = self.state.get((ref, metric))
        return value if field is None or value is None else value.get(field)

    def knows(self, ref: str, timeout: float = WAIT_S) -> bool:
        """Whether the component has become online."""
        return until(lambda: self.value(ref, "web/liveness", "online") is True, timeout)

    def ready(self) -> bool:
        """Whether enough echoes were exchanged to drive."""
        return until(lambda: self.state.get(("", "round trip"), -1) >= 0)

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _read(self) -> None:
        try:
            for text in self._socket:
                self._take(json.loads(text, parse_constant=_refuse, parse_int=_whole))
        except (ConnectionClosed, OSError):
            pass
        self.closed = True

    def _take(self, message: dict[str, Any]) -> None:
        match message["op"]:
            case "ping":
                self.state["", "round trip"] = message["round_trip_ms"]
                if self.answers:
                    self.send("echo", n=message["n"], t=now_ms())
            case "state":
                self.state |= {(ref, metric): value for ref, metric, value, _ in message["set"]}
                for ref in message["gone"]:
                    self.state = {key: value for key, value in self.state.items() if key[0] != ref}
            case "logs":
                self.logs.append(message)
            case "done":
                self.done.append(message)
            case "refused":
                self.refused.append(message)
            case "welcome":
                self.welcome = message
            case "bye":
                self.bye = message


def _refuse(constant: str) -> None:
    """Browsers read no NaN and no Infinity."""
    raise ValueError(f"{constant} is no JSON")


def _whole(digits: str) -> int | str:
    """Python reads no number of thousands of digits."""
    return int(digits) if len(digits) < 1000 else digits


def now_ms() -> float:
    """The page's clock, which has nothing to do with the server's."""
    return 1000 * time.monotonic() % 1e9 + 1e6
