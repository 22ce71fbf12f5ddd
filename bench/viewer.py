"""A viewer of the operator page without a browser: it answers pings, counts bytes, and notes what it learns when."""

from __future__ import annotations

import json
import secrets
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Self
from urllib.parse import urlsplit

from pebble.errors import PebbleError

_STEP_S = 0.005


class Viewer:
    """Times are CLOCK_MONOTONIC, ns. A message that comes late to it has come late to a person, too."""

    def __init__(self, url: str) -> None:
        from websockets.sync.client import connect  # optional

        host = urlsplit(url).netloc
        options: dict[str, Any] = {"origin": f"http://{host}", "compression": None, "max_size": None}
        self._socket = connect(f"ws://{host}/ws/control", **options)
        self.bytes = 0
        self.offline_at: dict[str, int] = {}  # by component
        self.online: set[str] = set()
        self.omitted = 0  # messages of which the server says that it does not show them
        self._stops: dict[str, dict[str, Any]] = {}  # by component, as the server shows them
        self._send("hello", version="")
        self._thread = threading.Thread(target=self._read, name="viewer", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._thread.join()

    def stop_all(self) -> tuple[str, int]:
        """Press STOP ALL; its name, and when."""
        name, at = secrets.token_hex(8), time.monotonic_ns()
        self._send("estop", ref="", stop=name, why="bench")
        return name, at

    def confirmed(self, name: str) -> int:
        """How many components have confirmed this stop, as the page shows them."""
        return sum(one["stop"] == name and one["sending"] == "confirmed" for one in list(self._stops.values()))

    def all_offline(self, bases: Iterable[str]) -> bool:
        return set(bases) <= set(self.offline_at)

    def until(self, condition: Callable[[], bool], timeout: float, problem: Callable[[], str]) -> int:
        """When the condition became true. Raises PebbleError."""
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                raise PebbleError(f"after {timeout:.0f} s {problem()}")
            time.sleep(_STEP_S)
        return time.monotonic_ns()

    def _send(self, op: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"op": op, **fields}))

    def _read(self) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            for text in self._socket:
                self.bytes += len(text)
                self._take(json.loads(text))
        except ConnectionClosed:
            pass

    def _take(self, message: dict[str, Any]) -> None:
        if message["op"] == "ping":
            self._send("echo", n=message["n"], t=time.monotonic() * 1000)
        elif message["op"] == "state":
            for ref, metric, value, _ in message["set"]:
                self._note(ref, metric, value)

    def _note(self, ref: str, metric: str, value: Any) -> None:
        if metric == "web/liveness":
            if value["online"] is False:
                self.offline_at.setdefault(ref, time.monotonic_ns())
                self.online.discard(ref)
            elif value["online"]:
                self.offline_at.pop(ref, None)
                self.online.add(ref)
        elif metric == "web/estop":
            self._stops[ref] = value
        elif metric == "web/broker":
            self.omitted = value["robots_omitted"]
