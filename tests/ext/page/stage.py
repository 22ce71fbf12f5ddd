"""Whole robots and the page's server for tests with a browser: the truth is in the traces of the robots' motors.

``with Stage() as stage`` has the demo's four robots (4 s), ``with Stage("minilamp")`` only one (1.5 s).
"""

from __future__ import annotations

import threading
import time
from typing import Any

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

    def ref(self, name: str) -> str:
        return Identity("pebble", "robots", name).base

    def motors(self, name: str) -> list[tuple[int, tuple[float, float]]]:
        """Every change of its motors, oldest first: monotonic ns, left and right."""
        return [(entry.ns, entry.motors) for entry in self.robots[name].entries() if entry.motors is not None]

    def wheels_turning(self, name: str, since_ns: int) -> bool:
        """True if its motors run, or have run at any time since then."""
        changes = self.motors(name)
        ends = [*(ns for ns, _ in changes[1:]), time.monotonic_ns()]
        return any(end > since_ns for end, (_, speeds) in zip(ends, changes, strict=False) if any(speeds))

    def restart_broker(self) -> None:
        """Start the operators' broker again at the same port, without its retained messages. Raises PebbleError."""
        self.end(self.remote_broker)
        self.remote_broker = self.broker("remote-broker", port=self.broker_port)
        self.remote_broker.wait()
