"""Whole robots and the page's server for tests with a browser: the truth is in the traces of the robots' motors.

``with Stage() as stage`` has the demo's four robots (4 s), ``with Stage("minilamp")`` only one (1.5 s).
"""

from __future__ import annotations

import threading
import time
from typing import Any
from urllib.parse import urlsplit

from pebble.contract.identity import Identity
from pebble.extensions.lab.rig.testbed import ROBOTS, Testbed


class Stage(Testbed):
    """Brokers and the named robots (none: all four), and the page's server; no operator drives them.

    ``robots``, by name, are traced: ``entries()`` is what each MCU received and did, with time.monotonic_ns().
    ``settings`` are fields of WebSettings. ``url`` of the page ends with a slash. Raises PebbleError.
    """

    keep = False

    def __init__(self, *names: str, **settings: Any) -> None:
        super().__init__(threading.Event(), names or ROBOTS)
        self._settings = settings

    def start(self) -> None:
        self.start_brokers()
        self.start_page(**self._settings)
        self.start_robots()
        self.server.wait()
        self.url = self.server.url
        self.wait_until_ready()

    def restart_server(self) -> None:
        """Start it again at the same address; ends the old one if it runs."""
        self.start_page(**{**self._settings, "port": urlsplit(self.url).port}).wait()

    def ref(self, name: str) -> str:
        return Identity("pebble", "robots", name).base

    def motors(self, name: str) -> list[tuple[int, tuple[float, float]]]:
        """Every change of its motors, oldest first: monotonic ns, left and right."""
        return [(entry.ns, entry.motors) for entry in self.robots[name].entries() if entry.motors is not None]

    def motions(self, name: str) -> list[tuple[int, int]]:
        """From when until when its motors ran at the same speeds; now if they run."""
        changes = self.motors(name)
        ends = [*(ns for ns, _ in changes[1:]), time.monotonic_ns()]
        return [(ns, end) for (ns, speeds), end in zip(changes, ends, strict=False) if any(speeds)]

    def wheels_turning(self, name: str, since_ns: int | None = None) -> bool:
        """Whether its motors run now; with ``since_ns`` whether they have run at any time since then."""
        since_ns = time.monotonic_ns() if since_ns is None else since_ns
        return max((end for _, end in self.motions(name)), default=0) > since_ns

    def restart_broker(self) -> None:
        """Start the operators' broker again at the same port, without its retained messages. Raises PebbleError."""
        self.end(self.remote_broker)
        self.remote_broker = self.broker("remote-broker", port=self.broker_port)
        self.remote_broker.wait()
