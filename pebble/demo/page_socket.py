"""What a browser does at the operator page's server, without a browser: it drives, and starts scripts."""

import json
import re
import threading
import time
import urllib.request
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

_READ_S = 5.0


class PageSocket:
    """The control socket of one page, without a login. Values are those that the server has sent last."""

    def __init__(self, url: str) -> None:
        from websockets.sync.client import connect  # optional

        with urllib.request.urlopen(url, timeout=_READ_S) as answer:  # noqa: S310 - of this machine
            (version, *_) = re.findall(r"/static/([^/\"]+)/", answer.read().decode())
        self._state: dict[tuple[str, str], Any] = {}
        self._gestures = 0
        self._socket = connect(f"ws://{urlsplit(url).netloc}/ws/control", origin=url.rstrip("/"), max_size=None)  # type: ignore[arg-type]
        threading.Thread(target=self._read, name="page", daemon=True).start()
        self._send("hello", version=version, device="demo", name="the demo's page")

    def value(self, ref: str, metric: str, field: str) -> Any:
        """None: the server has sent none."""
        value = self._state.get((ref, metric))
        return value.get(field) if isinstance(value, dict) else None

    def take(self, ref: str) -> None:
        """Ask for control."""
        self._send("lease", ref=ref, take=True)

    def holds(self, ref: str) -> bool:
        return self.value(ref, "web/driver", "you") is True

    def begin_gesture(self) -> None:
        """A person lets the stick go and takes it again: the server has ended a gesture that came late."""
        self._gestures += 1

    def drive(self, ref: str, z: float) -> None:
        """To be repeated 20 times a second, in one gesture."""
        self._send("drive", ref=ref, g=self._gestures, t=_now_ms(), z=z)

    def let_go(self, ref: str) -> None:
        """The stick comes to rest, and control is given back. A drive that breaks off ends scripts."""
        for _ in range(3):
            self.drive(ref, 0.0)
        self._send("lease", ref=ref, take=False)

    def start_script(self, ref: str, file: str) -> None:
        self._send("autonomy", ref=ref, file=file)

    def close(self) -> None:
        self._socket.close()

    def _send(self, op: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"op": op, **fields}))

    def _read(self) -> None:
        from websockets.exceptions import ConnectionClosed  # optional

        with suppress(ConnectionClosed, OSError):
            for text in self._socket:
                message = json.loads(text)
                if message["op"] == "ping":
                    self._send("echo", n=message["n"], t=_now_ms())
                elif message["op"] == "state":
                    self._state |= {(ref, metric): value for ref, metric, value, _ in message["set"]}


def _now_ms() -> float:
    return 1000 * time.monotonic() % 1e9
